"""What the figures of a trial are drawn from: numbers by policy and command, and what was seen."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pronk.evaluation.protocol import RATES
from pronk.evaluation.published import PAPER_RATIOS, TABLE_III, in_paper_order
from pronk.evaluation.results import Results, Row
from pronk.report.trial.cells import Published, Values
from pronk.report.trial.ratios import Ratio
from pronk.report.trial.traces import Trace
from pronk.virtual import capture as capture_file
from pronk.virtual.capture import Capture

Array = NDArray[np.float64]

BEFORE_S, AFTER_S = 0.5, 2.0
"""Window of the height traces about the jump input [s]."""
TRACE_RATE_HZ = 250.0
"""Rate that traces are drawn at: no figure is wide enough to show more."""


def policies(trial: Results) -> list[str]:
    """Names of the policies, a naive one first, as in the paper's table."""
    return in_paper_order(subject.name for subject in trial.subjects)


def values(trial: Results, figure: str, cases: Sequence[str]) -> Values:
    """One figure of every jump that was found, by policy and command."""
    return {
        name: {case: trial.values(name, case, figure) for case in cases} for name in policies(trial)
    }


def published(figure: str) -> Published:
    """The paper's Table III, `height` or `distance`, by policy and command; empty for others."""
    if figure not in ("height", "distance"):
        return {}
    return {
        gains: {case: getattr(cell, figure)[gains] for case, cell in TABLE_III.items()}
        for gains in ("naive", "matched")
    }


def naive_over_matched(trial: Results, figure: str) -> list[Ratio]:
    """Ratios of the standard deviations with the naive policy above the line, whichever came first.

    Empty unless the trial has the paper's two policies, and without those of too few jumps for an
    interval. The first is over all commands.
    """
    found = []
    paper = published(figure)
    for ratio in trial.ratios:
        if ratio.figure != figure or {ratio.policy, ratio.other} != {"naive", "matched"}:
            continue
        value, low, high = ratio.value, ratio.low, ratio.high
        if not (math.isfinite(value) and value > 0.0 and math.isfinite(low)):
            continue
        if ratio.other == "matched":
            value, low, high = 1.0 / value, 1.0 / high, 1.0 / low if low > 0.0 else math.inf
        if ratio.case is None:
            theirs = PAPER_RATIOS.get(figure)
        elif ratio.case in paper.get("naive", {}):
            theirs = paper["naive"][ratio.case][1] / paper["matched"][ratio.case][1]
        else:
            theirs = None
        found.append(
            Ratio(
                words=ratio.case or "mean over the commands",
                value=value,
                interval=(low, high),
                paper=theirs,
                overall=ratio.case is None,
            )
        )
    return found


@dataclass(frozen=True, kw_only=True)
class Seen:
    """What the captures of a trial give the figures, by policy and then by command."""

    height: dict[str, dict[str, list[Trace]]]
    """Trunk height [m] over the time since the jump input [s]."""
    roll: dict[str, dict[str, list[Trace]]]
    """Roll rate [rad/s] over the time since the command to run [s], at `RATES` alone."""
    pitch: dict[str, dict[str, list[Trace]]]
    """Pitch rate, the same."""
    hardest: HardestJump | None
    """Of the first policy."""
    missing: int
    """Captures that the table names and the folder does not hold."""


@dataclass(frozen=True, kw_only=True)
class HardestJump:
    """The jump that comes nearest to the drives' torque-speed curves."""

    row: Row
    velocity: Array
    """Of the joints, from the input to `AFTER_S` later [rad/s]. (T, joints)"""
    torque: Array
    """Of the motors, joint side [N m]. (T, joints)"""


def hardest(rows: Sequence[Row]) -> Row | None:
    """The jump with the least torque margin of any joint; None without a jump."""
    found = [row for row in rows if row.figures.found and len(row.figures.torque_margin)]
    return min(found, key=lambda row: min(row.figures.torque_margin), default=None)


def cut(time: Array, value: Array, start: float, end: float) -> Trace:
    """A stretch of a series, from a new zero at 0, thinned to `TRACE_RATE_HZ`.

    Args:
        time: Since the new zero [s]. (T,)
        value: (T,)
        start: First time of the stretch [s].
        end: Last time [s].
    """
    inside = np.flatnonzero((time >= start) & (time <= end))
    if len(inside) > 1:
        dt = float(time[inside[-1]] - time[inside[0]]) / (len(inside) - 1)
        inside = inside[:: max(1, round(1.0 / (TRACE_RATE_HZ * dt)))]
    return Trace(time=time[inside], value=value[inside])


def _captures(trial: Results, folder: Path) -> Iterator[tuple[Row, Path]]:
    for row in trial.rows:
        if row.capture:
            yield row, folder / row.capture


def see(
    trial: Results, folder: Path, *, told: Callable[[float], None] = lambda share: None
) -> Seen | None:
    """Read the captures of a trial; None if it kept none, or none is there any more.

    Args:
        trial: Whose table names them.
        folder: Where they are.
        told: Told the share of them that is read.

    Raises:
        ArtefactError: A capture is damaged.
    """
    kept = list(_captures(trial, folder))
    present = [(row, path) for row, path in kept if path.exists()]
    if not present:
        return None
    found: dict[str, dict[str, dict[str, list[Trace]]]] = {
        what: {name: {} for name in policies(trial)} for what in ("height", "roll", "pitch")
    }
    worst = hardest([row for row, _ in present if row.policy == trial.subjects[0].name])
    jump = None
    for i, (row, path) in enumerate(present):
        seen = capture_file.load(path)
        for what, trace in _traces(row, seen).items():
            found[what][row.policy].setdefault(row.case, []).append(trace)
        if row is worst:
            jump = _hardest(row, seen)
        told((i + 1) / len(present))
    return Seen(**found, hardest=jump, missing=len(kept) - len(present))


def _traces(row: Row, seen: Capture) -> dict[str, Trace]:
    since = seen.time - row.began
    script = row.script
    found = {
        "height": cut(since - script.on, seen.position[:, 2], -BEFORE_S, AFTER_S),
    }
    if row.case == RATES.name:
        for i, what in enumerate(("roll", "pitch")):
            rate = seen.angular_velocity[:, i]
            found[what] = cut(since - script.start, rate, 0.0, script.run_s)
    return found


def _hardest(row: Row, seen: Capture) -> HardestJump:
    since = seen.time - row.began - row.script.on
    inside = (since >= 0.0) & (since <= AFTER_S)
    return HardestJump(row=row, velocity=seen.joint_velocity[inside], torque=seen.torque[inside])
