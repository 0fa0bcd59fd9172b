"""Page of a trial: outcome, Table III beside the paper's, figures, films, definitions."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pronk.arrays import Array
from pronk.errors import ArtefactError
from pronk.files import write_text
from pronk.jump.trial import tables
from pronk.jump.trial.criteria import trial_checks
from pronk.jump.trial.protocol import PAPER_ROBOT, RATES, in_paper_order
from pronk.jump.trial.results import (
    SUMMARY,
    TrialResults,
    TriedPolicy,
    load_results,
    share_interval,
)
from pronk.jump.virtual import capture as capture_file
from pronk.report import style
from pronk.report.page import Part, page
from pronk.report.paper import published_jumps
from pronk.report.style import picture
from pronk.report.trial_figures import FEWEST_JUMPS, JumpPanel, Values, draw_jumps, draw_traces
from pronk.tables import Cell, Column, Table, counted

BEFORE_S = 0.5
"""Time before the jump input that the height traces show [s]."""
AFTER_S = 2.0
"""Time after the jump input that the height traces show [s]."""
TRACE_RATE_HZ = 250.0
"""Rate of drawn traces [Hz]."""
DRAWN_FIGURES = ("height", "distance", "gap")
"""Figures that are drawn beside the paper's."""

Runs = dict[str, dict[str, list[Array]]]
"""By policy and command: runs as time [s] and value, each (2, T)."""


@dataclass(frozen=True, kw_only=True)
class CapturedTraces:
    """What the captures of a trial show over time."""

    height: Runs
    """Height of the trunk [m] over the time since the jump input."""
    roll_rate: Runs
    """Roll rate [rad/s] over the time since the command to run, of `RATES` alone."""
    pitch_rate: Runs
    """Pitch rate [rad/s] over the time since the command to run, of `RATES` alone."""
    captured: int
    """Number of runs with a capture."""
    missing: int
    """Number of captures that the trial kept and the folder has not."""


def policy_names(trial: TrialResults) -> list[str]:
    """Return the names of the policies, `naive` first."""
    return in_paper_order(trial.policy_names)


def jump_values(trial: TrialResults, figure: str) -> Values:
    """Return one figure of every jump, by policy and command."""
    values = {}
    for name in policy_names(trial):
        values[name] = {case.name: trial.values(name, case.name, figure) for case in trial.cases}
    return values


def load_traces(trial: TrialResults, folder: Path) -> CapturedTraces | None:
    """Read the captures of a trial; None if the folder has none of them."""
    height: Runs = {}
    roll_rate: Runs = {}
    pitch_rate: Runs = {}
    for name in policy_names(trial):
        height[name] = {}
        roll_rate[name] = {}
        pitch_rate[name] = {}
    captured = 0
    missing = 0
    for row in trial.rows:
        if not row.capture:
            continue
        if not (folder / row.capture).exists():
            missing += 1
            continue
        captured += 1
        capture = capture_file.load_capture(folder / row.capture)
        since_jump = capture.time - row.began - row.script.on
        trace = _cut(since_jump, capture.position[:, 2], -BEFORE_S, AFTER_S)
        height[row.policy].setdefault(row.case, []).append(trace)
        if row.case == RATES.name:
            since_run = capture.time - row.began - row.script.start
            roll = _cut(since_run, capture.angular_velocity[:, 0], 0.0, row.script.run_s)
            pitch = _cut(since_run, capture.angular_velocity[:, 1], 0.0, row.script.run_s)
            roll_rate[row.policy].setdefault(row.case, []).append(roll)
            pitch_rate[row.policy].setdefault(row.case, []).append(pitch)
    if not captured:
        return None
    return CapturedTraces(
        height=height,
        roll_rate=roll_rate,
        pitch_rate=pitch_rate,
        captured=captured,
        missing=missing,
    )


def _cut(time: Array, value: Array, start: float, end: float) -> Array:
    """Return time and value between two times, thinned to `TRACE_RATE_HZ`. (2, T)."""
    inside = np.flatnonzero((time >= start) & (time <= end))
    if len(inside) > 1:
        dt = float(time[inside[-1]] - time[inside[0]]) / (len(inside) - 1)
        inside = inside[:: max(1, round(1.0 / (TRACE_RATE_HZ * dt)))]
    return np.stack([time[inside], value[inside]])


def rate_rms(runs: Mapping[str, Sequence[Array]]) -> float:
    """Return the RMS of a rate over all runs with the command `RATES`; NaN without any."""
    rates = [run[1] for run in runs.get(RATES.name, ())]
    if not rates:
        return float("nan")
    return float(np.sqrt(np.nanmean(np.square(np.concatenate(rates)))))


# ---- films ----


def film_pictures(folder: Path, ending: str) -> dict[str, str]:
    """Return the pictures of one kind in a trial's folder as `data:` addresses, by caption.

    Films of the same command stand beside each other, those of nominal gains first.
    """
    paths = _films(folder, ending)
    paths.sort(key=lambda path: (path.stem.partition("_")[2], not path.stem.startswith("naive")))
    return {path.stem.replace("_", " "): _picture_address(path) for path in paths}


def film_names(folder: Path) -> list[str]:
    """Return the names of the films in a trial's folder, relative to it."""
    return [str(path.relative_to(folder)) for path in _films(folder, "mp4")]


def _films(folder: Path, ending: str) -> list[Path]:
    """Return files of one kind in a trial's folder and in folders in it without a trial."""
    places = [folder]
    for path in folder.iterdir():
        if path.is_dir() and not (path / SUMMARY).exists():
            places.append(path)
    films: list[Path] = []
    for place in places:
        films += place.glob(f"*.{ending}")
    return sorted(films)


def _picture_address(path: Path) -> str:
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


# ---- the part ----


def trial_part(path: Path) -> Part:
    """Make the part of the trial in `path`, a `summary.json`."""
    folder = path.parent
    trial = load_results(folder)
    place = tables.place_words(trial.virtual)
    checks = trial_checks(trial)
    passed = sum(check.passed for check in checks)
    policy = trial.subjects[0].name
    is_paper_robot = trial.robot == PAPER_ROBOT
    panels = []
    for name in DRAWN_FIGURES:
        panels.append(
            JumpPanel(
                label=f"{name} [m]",
                values=jump_values(trial, name),
                published=published_jumps(name) if is_paper_robot else {},
            )
        )
    scatter_tables = []
    verdicts = []
    for other in trial.subjects[1:]:
        scatter_tables.append(tables.scatter_table(trial, other.name))
        verdicts.append(tables.scatter_verdict(trial, other.name))
    other_figures = {}
    for subject in trial.subjects:
        other_figures[subject.name] = tables.other_figures(trial, subject.name)
    content = {
        "trial": trial,
        "where": place,
        "totals": {name: _total(trial, name) for name in policy_names(trial)},
        "verdicts": verdicts,
        "cells": picture(draw_jumps(panels)),
        "table_iii": [tables.paper_table(trial, "height"), tables.paper_table(trial, "distance")],
        "paper": is_paper_robot,
        "criteria": tables.criteria_table(trial) if checks else None,
        "scatter_tables": scatter_tables,
        "moving": film_pictures(folder, "gif"),
        "stills": film_pictures(folder, "png"),
        "enough": all(cell.n >= FEWEST_JUMPS for cell in trial.cells_of(policy)),
        "films": film_names(folder),
        "landings": tables.landings(trial),
        "more": other_figures,
        "drives": tables.drive_loads(trial),
        "definitions": tables.definitions(),
        "setup": setup_table(trial.subjects),
        **_trace_content(trial, folder),
    }
    criteria = counted(len(checks), "acceptance criterion", "acceptance criteria")
    summary = f"{policy}, {place}: {passed} of {criteria} passed."
    if not checks:
        summary = f"{policy}, {place}; {trial.robot} has no acceptance criteria."
    return Part(
        kind="trial",
        title="Trial",
        virtual=trial.virtual,
        summary=summary,
        warning=passed < len(checks),
        content=content,
        figures={"checks": [check.row() for check in checks]},
    )


def write_trial_page(folder: Path) -> Path:
    """Write the page of the trial in a folder, `report.html`, and return its path."""
    part = replace(trial_part(folder / SUMMARY), source=SUMMARY)
    path = folder / "report.html"
    write_text(path, page(part.title, [part]))
    return path


def _total(trial: TrialResults, policy: str) -> dict[str, float]:
    """Return counts over all commands, and the share of landings [%] with its interval."""
    commanded = 0
    jumped = 0
    landed = 0
    fell = 0
    touched = 0
    for cell in trial.cells_of(policy):
        commanded += cell.n
        jumped += cell.found
        landed += cell.succeeded
        fell += cell.fell
        touched += cell.non_foot_contact
    low, high = share_interval(landed, commanded)
    return {
        "n": commanded,
        "found": jumped,
        "fell": fell,
        "landed": landed,
        "touched": touched,
        "share": 100.0 * landed / commanded,
        "low": 100.0 * low,
        "high": 100.0 * high,
    }


def _trace_content(trial: TrialResults, folder: Path) -> dict[str, Any]:
    """Return what the page shows of the captures; None without them."""
    content: dict[str, Any] = {
        "rates": None,
        "rates_table": None,
        "rates_case": RATES.name,
        "heights": None,
        "captured": 0,
        "missing": 0,
    }
    traces = load_traces(trial, folder)
    if traces is None:
        return content
    content["captured"] = traces.captured
    content["missing"] = traces.missing
    standing = float(trial.rules.get("standing_height", np.nan))
    heights = draw_traces(
        {"trunk height [m]": traces.height},
        x_label="time since the jump input [s]",
        level=standing,
    )
    content["heights"] = picture(heights, dense=True)
    if any(traces.roll_rate.values()):
        rates = draw_traces(
            {"roll rate [rad/s]": traces.roll_rate, "pitch rate [rad/s]": traces.pitch_rate},
            x_label="time since the command to run [s]",
            level=0.0,
        )
        content["rates"] = picture(rates, dense=True)
        content["rates_table"] = rates_table(traces)
    return content


def rates_table(traces: CapturedTraces) -> Table:
    """Return the RMS of roll and pitch rate of every policy."""
    rows: list[tuple[Cell, ...]] = []
    for policy, runs in traces.roll_rate.items():
        rows.append((policy, rate_rms(runs), rate_rms(traces.pitch_rate[policy])))
    return Table(
        title="",
        columns=(
            Column(heading="policy"),
            Column(heading="roll rate, RMS", unit="rad/s", digits=2),
            Column(heading="pitch rate, RMS", unit="rad/s", digits=2),
        ),
        rows=tuple(rows),
    )


def setup_table(subjects: Sequence[TriedPolicy]) -> Table:
    """Return files of the policies and the gains that they were trained with, by joint group."""
    rows: list[tuple[Cell, ...]] = []
    for subject in subjects:
        contract = subject.contract
        groups: dict[str, str] = {}
        names = contract.get("joint_names", ())
        stiffnesses = contract.get("stiffness", ())
        dampings = contract.get("damping", ())
        for name, stiffness, damping in zip(names, stiffnesses, dampings, strict=False):
            group = style.joint_words(name.removeprefix(f"{style.leg_of(name)}_"))
            groups.setdefault(group, f"{group} {stiffness:.1f} / {damping:.3f}")
        gains = contract.get("gains", "unknown")
        rows.append((subject.name, gains, ", ".join(groups.values()), subject.path, subject.sha256))
    return Table(
        title="",
        columns=(
            Column(heading="policy"),
            Column(heading="gains"),
            Column(heading="stiffness [N m/rad] / damping [N m s/rad]"),
            Column(heading="file"),
            Column(heading="SHA-256"),
        ),
        rows=tuple(rows),
    )
