"""Page of a trial: outcome, Table III beside the paper's, figures, films, definitions."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pronk.arrays import Array
from pronk.errors import ArtefactError
from pronk.jump.trial import tables
from pronk.jump.trial.criteria import trial_checks
from pronk.jump.trial.protocol import RATES, in_paper_order
from pronk.jump.trial.results import SUMMARY, Results, load, share_interval
from pronk.jump.virtual import capture as capture_file
from pronk.report import style
from pronk.report import trial_figures as draw
from pronk.report.page import Part
from pronk.report.paper import published_jumps
from pronk.report.style import picture, rms
from pronk.report.trial_figures import Values

BEFORE_S, AFTER_S = 0.5, 2.0
"""Window of the height traces about the jump input [s]."""
TRACE_RATE_HZ = 250.0
"""Rate of drawn traces."""
Traces = dict[str, dict[str, dict[str, list[Array]]]]
"""By quantity, policy and command: runs as time [s] and value, each (2, T). `height` [m] over the
time since the jump input; `roll` and `pitch` rate [rad/s] over the time since the command to run,
of `RATES` alone."""


def policies(trial: Results) -> list[str]:
    """Return the names of the policies, `naive` first."""
    return in_paper_order(subject.name for subject in trial.subjects)


def values(trial: Results, figure: str) -> Values:
    """Return one figure of every jump, by policy and command."""
    return {
        name: {case.name: trial.values(name, case.name, figure) for case in trial.cases}
        for name in policies(trial)
    }


def _cut(time: Array, value: Array, start: float, end: float) -> Array:
    """Return `value` between two times, thinned to `TRACE_RATE_HZ`, as (2, T)."""
    inside = np.flatnonzero((time >= start) & (time <= end))
    if len(inside) > 1:
        dt = float(time[inside[-1]] - time[inside[0]]) / (len(inside) - 1)
        inside = inside[:: max(1, round(1.0 / (TRACE_RATE_HZ * dt)))]
    return np.stack([time[inside], value[inside]])


def traces(trial: Results, folder: Path) -> tuple[Traces, int] | None:
    """Read the captures of a trial, and count missing ones; None if there are none."""
    kept = [(row, folder / row.capture) for row in trial.rows if row.capture]
    present = [(row, path) for row, path in kept if path.exists()]
    if not present:
        return None
    axes = {"roll": 0, "pitch": 1}
    found: Traces = {what: {name: {} for name in policies(trial)} for what in ("height", *axes)}
    for row, path in present:
        capture = capture_file.load(path)
        since = capture.time - row.began - row.script.on
        own = {"height": _cut(since, capture.position[:, 2], -BEFORE_S, AFTER_S)}
        if row.case == RATES.name:
            run = capture.time - row.began - row.script.start
            for what, axis in axes.items():
                own[what] = _cut(run, capture.angular_velocity[:, axis], 0.0, row.script.run_s)
        for what, trace in own.items():
            found[what][row.policy].setdefault(row.case, []).append(trace)
    return found, len(kept) - len(present)


def films(folder: Path) -> tuple[dict[str, str], list[str]]:
    """Return pictures in a trial's folder as caption and `data:` address, and names of films."""
    # A folder with a trial of its own is a part of its own.
    inner = [path for path in folder.iterdir() if path.is_dir() and not (path / SUMMARY).exists()]
    png, gif, mp4 = (
        sorted(path for place in (folder, *inner) for path in place.glob(f"*.{kind}"))
        for kind in ("png", "gif", "mp4")
    )
    pictures = {f"{path.stem} ({path.suffix[1:]})": _image(path) for path in (*png, *gif)}
    return pictures, [str(path.relative_to(folder)) for path in mp4]


def _image(path: Path) -> str:
    from PIL import Image

    data = path.read_bytes()
    try:
        Image.open(io.BytesIO(data)).load()
    except Exception as error:
        raise ArtefactError(
            f"{path}: not a readable picture ({type(error).__name__}); delete it, or run `pronk "
            "trial` again."
        ) from error
    return style.data_uri(data, path.suffix[1:])


def part(path: Path) -> Part:
    """Make the part of the trial in `path`, a `summary.json`."""
    folder = path.parent
    trial = load(folder)
    where = tables.place(trial)
    checks, first = trial_checks(trial), trial.subjects[0].name
    passed = sum(check.passed for check in checks)
    pictures, names = films(folder)
    drawn = ("height", "distance", "gap")
    panels = [(f"{name} [m]", values(trial, name), published_jumps(name)) for name in drawn]
    content = {
        "trial": trial,
        "where": where,
        "totals": {name: _total(trial, name) for name in policies(trial)},
        "verdicts": [tables.verdict(trial, other.name) for other in trial.subjects[1:]],
        "cells": picture(draw.cells(panels)),
        "table_iii": [tables.table_iii(trial, figure) for figure in ("height", "distance")],
        "criteria": tables.criteria(trial),
        "scatter_table": tables.scatter(trial) if trial.ratios else None,
        "pictures": pictures,
        "films": names,
        "landings": tables.landings(trial),
        "more": {subject.name: tables.more(trial, subject.name) for subject in trial.subjects},
        "drives": tables.drives(trial),
        "definitions": tables.definitions(),
        "setup": _setup(trial),
    }
    return Part(
        kind="trial",
        title="Trial",
        virtual=trial.virtual,
        summary=f"{first}, {where}: {passed} of {len(checks)} acceptance criteria passed.",
        warning=passed < len(checks),
        content=content | _trace_figures(trial, folder),
        figures={"checks": [check.row() for check in checks]},
    )


def _total(trial: Results, name: str) -> dict[str, float]:
    """Counts over all commands, and the share of landings [%] with its interval."""
    own = [cell for cell in trial.cells if cell.policy == name]
    counts = {of: sum(getattr(cell, of) for cell in own) for of in ("n", "found", "fell")}
    landed, n = tables.tally(own)
    low, high = share_interval(landed, n)
    share = {"share": 100 * landed / n, "low": 100 * low, "high": 100 * high}
    return counts | {"landed": landed} | share


def _trace_figures(trial: Results, folder: Path) -> dict[str, Any]:
    """Figures that need captures; None without."""
    made: dict[str, Any] = dict.fromkeys(("rates", "rates_table", "rates_case", "heights"))
    if (found := traces(trial, folder)) is None:
        return made
    (height, roll, pitch), made["missing"] = found[0].values(), found[1]
    if any(roll.values()):
        quantities = {"roll rate [rad/s]": roll, "pitch rate [rad/s]": pitch}
        x_label = "time since the command to run [s]"
        made["rates"] = picture(draw.traces(quantities, x_label=x_label, level=0.0), dense=True)
        rows = [(name, rate_rms(roll[name]), rate_rms(pitch[name])) for name in roll]
        columns = "policy | roll rate, RMS [rad/s];2 | pitch rate, RMS [rad/s];2"
        made |= {"rates_table": tables.table(columns, rows), "rates_case": RATES.name}
    made["captured"] = sum(len(runs) for cases in height.values() for runs in cases.values())
    standing = float(trial.rules.get("standing_height", np.nan))
    label = "time since the jump input [s]"
    drawn = draw.traces({"trunk height [m]": height}, x_label=label, level=standing)
    return made | {"heights": picture(drawn, dense=True)}


def rate_rms(runs: Mapping[str, Sequence[Array]]) -> float:
    """Return the RMS of a rate over all runs with the command `RATES`; NaN without any."""
    return float(rms(np.concatenate([[np.nan], *(run[1] for run in runs.get(RATES.name, ()))])))


def _setup(trial: Results) -> tables.Sheet:
    """Return files of the policies and the gains that they were trained with, by joint group."""
    rows = []
    for one in trial.subjects:
        columns = [one.contract.get(name, ()) for name in ("joint_names", "stiffness", "damping")]
        groups: dict[str, str] = {}
        for name, stiffness, damping in zip(*columns, strict=False):
            group = style.joint_words(name.removeprefix(f"{style.leg_of(name)}_"))
            groups.setdefault(group, f"{group} {stiffness:.1f} / {damping:.3f}")
        gains = one.contract.get("gains", "unknown")
        rows.append((one.name, gains, ", ".join(groups.values()), one.path, one.sha256))
    heads = "policy | gains | stiffness [N m/rad] / damping [N m s/rad] | file | SHA-256"
    return tables.table(heads, rows)
