"""The tables of a deployment's page."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pronk.evaluation.tables import Sheet
from pronk.report.deploy import data as deploy_data
from pronk.report.deploy import times as deploy_times
from pronk.report.deploy.data import Intervention
from pronk.report.deploy.delay import Delay
from pronk.report.shell import number
from pronk.robots.robot import Robot
from pronk.runtime.log import DeployLog
from pronk.runtime.safety import FilterAction

_LEVEL_WORDS = {
    FilterAction.LIMIT: "target moved",
    FilterAction.HOLD: "last one held",
    FilterAction.DAMP: "damped",
    FilterAction.LATCH: "damped, latched",
}


def delays(found: Delay) -> Sheet:
    """The parts of the delay, their sum, and what was trained for."""
    trained = found.trained or (np.nan, np.nan)
    rows = (
        ("state to command", found.answer.p50, found.answer.p95, "median to 95 %, measured"),
        ("command to torque", *found.drives, "fitted: bus, drives, stamping of states"),
        ("whole", *found.whole, "their sum: what training calls the command delay"),
        ("trained for", *trained, "by the contract in the policy's file"),
    )
    return Sheet(
        title="Delay",
        columns=("[ms]", "from", "to", "what it is"),
        rows=tuple(
            (name, number(1e3 * low, 1), number(1e3 * high, 1), what)
            for name, low, high, what in rows
        ),
    )


def interventions(done: Sequence[Intervention]) -> Sheet:
    """What the filter changed, and why."""
    return Sheet(
        title="Safety filter",
        columns=("what was done", "ticks", "farthest [rad]", "joint", "why"),
        rows=tuple(
            (
                _LEVEL_WORDS[one.level],
                str(one.ticks),
                number(one.largest),
                one.joint.replace("_", " ") or "-",
                one.reason.text,
            )
            for one in done
        ),
        notes=("joint: the one whose target was moved most often for this reason.",),
    )


def tracking(log: DeployLog, robot: Robot | None) -> Sheet:
    """How each joint followed, and what it gave."""
    limits = log.header.get("limits", {})
    effort = {} if robot is None else {j.name: j.drive.effort_limit for j in robot.joints}
    speed = dict(zip(log.joints, limits.get("speed", ()), strict=False))
    rows = []
    for one in deploy_data.tracking(log):
        rows.append(
            (
                one.joint.replace("_", " "),
                number(one.standing),
                number(one.error),
                number(one.largest),
                number(one.torque, 1),
                _of(one.torque_largest, effort.get(one.joint)),
                _of(one.speed_largest, speed.get(one.joint)),
            )
        )
    return Sheet(
        title="Joints",
        columns=(
            "joint",
            "error standing, RMS [rad]",
            "error, RMS [rad]",
            "largest [rad]",
            "torque, RMS [N\u00a0m]",
            "largest [N\u00a0m]",
            "fastest [rad/s]",
        ),
        rows=tuple(rows),
        notes=(
            "error: the target in force less the measured position. All but the first column: "
            "while the policy decided. Torques as the robot tells them, of the drives' effort "
            "limits; speeds of those at which the filter sees a fault.",
        ),
    )


def _of(value: float, limit: float | None) -> str:
    known = limit is not None and np.isfinite(value)
    return number(value, 1) + (f" of {limit:.0f}" if known else "")


def times(log: DeployLog) -> Sheet:
    """Quantiles of everything that was timed."""
    found = deploy_times.times(log)
    rows = []
    for one in found:
        at = deploy_data.spread(one.values)
        cells = (at.p50, at.p95, at.p99, at.p99_9, at.largest)
        rows.append((one.name, str(at.n), *(number(1e3 * value) for value in cells)))
    return Sheet(
        title="Times [ms]",
        columns=("[ms]", "n", "50 %", "95 %", "99 %", "99.9 %", "largest"),
        rows=tuple(rows),
        notes=(
            *(f"{one.name}: {one.says}." for one in found),
            "A quantile is left out where fewer than one value lies beyond it.",
        ),
    )


def said(log: DeployLog) -> Sheet:
    """All events, in their order."""
    rows = []
    for event in sorted(log.events, key=lambda event: event.time):
        at = float(deploy_data.seconds(log, event.time))
        rows.append((f"{at:.3f}", event.kind, event.text))
    return Sheet(
        title=f"Everything that was said ({len(rows)} lines)",
        columns=("time [s]", "kind", "text"),
        rows=tuple(rows),
        notes=("Before the first tick times are negative.",),
    )
