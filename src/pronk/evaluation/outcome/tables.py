"""Tables of a trial: the paper's Table III beside ours, landings, drives, bars, definitions.

No cell is left out: one that could not be measured holds a dash and its count says why.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pronk.evaluation.metrics import FIGURES
from pronk.evaluation.outcome.comparison import scatter
from pronk.evaluation.outcome.criteria import JUMPS, checks
from pronk.evaluation.outcome.published import TABLE_III, Pair, in_paper_order
from pronk.evaluation.outcome.table_text import (
    Sheet,
    counted,
    number,
    pair,
    place,
    spread,
    virtual_note,
)
from pronk.evaluation.result import Trial
from pronk.evaluation.summary import Cell

DEFINITIONS = "Definitions"
"""Title of the table of equations."""


def sheets(trial: Trial) -> tuple[Sheet, ...]:
    """All tables, in the order in which they are read."""
    found = [table_iii(trial, figure) for figure in ("height", "distance")]
    found.append(landings(trial))
    found += [more(trial, subject.name) for subject in trial.subjects]
    found.append(drives(trial))
    found += [scatter(trial, other.name) for other in trial.subjects[1:]]
    return (*found, bars(trial), definitions())


def table_iii(trial: Trial, figure: str) -> Sheet:
    """The paper's Table III beside ours, for `height` or `distance`."""
    subjects = in_paper_order(subject.name for subject in trial.subjects)
    rows = []
    for case in trial.cases:
        paper = TABLE_III.get(case.name)
        published: Mapping[str, Pair] = getattr(paper, figure) if paper else {}
        own = (trial.cell(name, case.name) for name in subjects)
        rows.append(
            (
                case.name,
                *(pair(published.get(gains)) for gains in ("naive", "matched")),
                *(f"{spread(cell.figures[figure])} {counted(cell)}" for cell in own),
            )
        )
    means: list[str] = []
    for gains in ("naive", "matched"):
        stds = [getattr(paper, figure)[gains][1] for paper in TABLE_III.values()]
        means.append(f"+- {sum(stds) / len(stds):.3f}")
    for name in subjects:
        stds = [trial.cell(name, case).figures[figure].std for case in trial.pooled]
        mean = sum(stds) / len(stds)
        means.append(f"+- {number(mean)}" if math.isfinite(mean) else "-")
    rows.append(("mean scatter", *means))
    return Sheet(
        title=f"{figure.capitalize()} [m]: mean +- standard deviation (jumps found of those asked)",
        columns=(
            "command",
            "paper, naive",
            "paper, matched",
            *(f"{name}, {place(trial)}" for name in subjects),
        ),
        rows=tuple(rows),
        notes=(
            f"{figure}: {FIGURES[figure].says}.",
            f"mean scatter: mean of the standard deviations over {', '.join(trial.pooled)}.",
            "paper: five jumps a cell on the real robot, of one policy each (E2, A21).",
            virtual_note(trial),
        ),
    )


def landings(trial: Trial) -> Sheet:
    """What became of every jump that was asked for."""
    rows = []
    for cell in trial.cells:
        low, high = (100.0 * share for share in cell.success_ci95)
        rows.append(
            (
                f"{cell.policy}: {cell.case}",
                str(cell.n),
                str(cell.told),
                str(cell.found),
                str(cell.succeeded),
                f"{100.0 * cell.success:.0f} ({low:.0f} to {high:.0f})",
                str(cell.fell),
                spread(cell.figures["high_flights"], 2),
            )
        )
    return Sheet(
        title="Landings",
        columns=(
            "policy: command",
            "asked",
            "standing",
            "jumped",
            "landed",
            "success [%] (95 %)",
            "fell",
            "high flights",
        ),
        rows=tuple(rows),
        notes=(
            "landed: upright 2 s after touchdown, and nothing but feet touched the ground; of all "
            "asked. fell: at any time of the run.",
        ),
    )


_MORE = (
    "apex_gain",
    "rise",
    "ballistic",
    "clearance",
    "clearance_half",
    "along",
    "distance_minima",
    "gap",
    "lift_off_velocity",
    "horizontal_velocity",
    "delay",
    "duration",
    "speed",
    "roll_rate_rms",
    "roll_rate_peak",
    "pitch_rate_rms",
    "pitch_rate_peak",
    "energy",
    "cost_of_transport",
)


def more(trial: Trial, policy: str | None = None) -> Sheet:
    """Every other figure of one policy, or of all, with every command."""
    cells = [cell for cell in trial.cells if policy in (None, cell.policy)]
    whose = f" of {policy}" if policy else ""
    return Sheet(
        title=f"Every other figure{whose}: mean +- standard deviation",
        columns=("figure", *(c.case if policy else f"{c.policy}: {c.case}" for c in cells)),
        rows=tuple(
            (
                f"{name} [{FIGURES[name].unit}]",
                *(spread(cell.figures[name]) for cell in cells),
            )
            for name in _MORE
        ),
        notes=(virtual_note(trial),),
    )


def drives(trial: Trial) -> Sheet:
    """How hard the drives work: the greatest of all jumps, by joint."""
    rows = []
    for subject in trial.subjects:
        cells = [cell for cell in trial.cells if cell.policy == subject.name]
        for joint in trial.joint_names:
            torque = _extreme(cells, "peak_torque", joint, max, "most")
            speed = _extreme(cells, "peak_speed", joint, max, "most")
            margin = _extreme(cells, "torque_margin", joint, min, "least")
            rows.append(
                (
                    f"{subject.name}: {joint}",
                    number(torque, 1),
                    number(speed, 1),
                    number(margin, 3),
                )
            )
    return Sheet(
        title="Drives: the greatest of all jumps",
        columns=("policy: joint", "torque [N m]", "speed [rad/s]", "margin [1]"),
        rows=tuple(rows),
        notes=(f"margin: {FIGURES['torque_margin'].says}.",),
    )


def _extreme(cells: list[Cell], name: str, joint: str, choose: Any, which: str) -> float:
    values = [getattr(cell.joints[name][joint], which) for cell in cells]
    known = [value for value in values if math.isfinite(value)]
    return float(choose(known)) if known else math.nan


def bars(trial: Trial) -> Sheet:
    """What the first policy must show."""
    found = checks(trial)
    rows = []
    for check in found:
        unit = f" {check.unit}" if check.unit else ""
        value = number(check.value, 4) + unit if math.isfinite(check.value) else "-"
        bar = f"{check.sense} {check.bar:g}{unit}"
        rows.append((check.what, value, bar, "yes" if check.passed else "NO"))
    passed = sum(check.passed for check in found)
    least = min(trial.cell(trial.subjects[0].name, case).n for case in trial.pooled)
    few = (f"The bars are meant for {JUMPS} jumps with each command; these are of {least}.",)
    return Sheet(
        title=f"Bars of {trial.subjects[0].name}: the paper's matched column, and more",
        columns=("what", "measured", "bar", "passed"),
        rows=tuple(rows),
        notes=(f"{passed} of {len(found)} bars passed.", *(few if least < JUMPS else ())),
    )


def definitions() -> Sheet:
    """What every figure is."""
    return Sheet(
        title=DEFINITIONS,
        columns=("figure", "unit", "equation"),
        rows=tuple((name, figure.unit, figure.says) for name, figure in FIGURES.items()),
        notes=(
            "c: the jump input rises. l, d: lift-off and touchdown of the main flight, the longest "
            "in which the trunk rises more than 3 cm over standing. e: d + 0.5 s. p, z, v: "
            "position, height and velocity of the trunk's origin. f_i, r: centre and radius of a "
            "foot. u: direction of p_d - p_l in the plane.",
        ),
    )
