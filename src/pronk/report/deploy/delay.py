"""The delay of a loop that was closed on a robot, beside the delays that its policy trained with.

Two parts, both from the log. From a state to the first command that answers it: measured by the
servo, for every order. From a command to its torque: the shift at which

    torque(t) = kp (target(t - shift) - q(t)) - kd v(t)

fits best what the robot says it gave, with the gains of its drives. It holds what the bus, the
drives and the robot's stamping of its states add. Targets change from tick to tick only, so it is
an interval about as wide as a tick. The sum of both parts is what training calls the command delay.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.report.deploy.data import Spread, flying, spread
from pronk.robots.robot import Robot
from pronk.runtime.log import DeployLog

Array = NDArray[np.float64]

_SHIFTS = np.arange(0.0, 0.0305, 0.00025)
"""Tried, as multiples of the virtual robot's physics step [s]."""
_EXPLAINED = 0.8
"""Least share of the torque's variance that the law must explain to be believed."""
_GENTLE = 0.5
"""Share of its effort limit below which a drive follows the law whatever the battery gives."""
_AS_GOOD = 1.1
"""Residuals up to this multiple of the least are no worse."""
_LEAST = 250
"""Fewest ticks to fit: half a second."""
_UNKNOWN = (float("nan"), float("nan"))


@dataclass(frozen=True, kw_only=True)
class Delay:
    """Measured, beside what was trained for [s]."""

    trained: tuple[float, float] | None
    """None where the log does not say."""
    answer: Spread
    """From a state to the first command that answers it, while the policy decided."""
    drives: tuple[float, float]
    """From a command on the wire to its torque, bounds; NaN where it could not be told."""

    @property
    def whole(self) -> tuple[float, float]:
        """Median answer with the drives' least, 95 % of the answers with their most [s]."""
        return self.answer.p50 + self.drives[0], self.answer.p95 + self.drives[1]

    @property
    def longest(self) -> float:
        """The upper end of what is known [s]: of the whole, or else of the answers alone."""
        return self.whole[1] if np.isfinite(self.whole[1]) else self.answer.p95

    @property
    def within(self) -> bool | None:
        """Whether the delay is at most the longest trained for; None where it is unknown."""
        if self.trained is None or not np.isfinite(self.longest):
            return None
        return bool(self.longest <= self.trained[1])


def delay(log: DeployLog, robot: Robot | None) -> Delay:
    """What was measured.

    Args:
        log: Of the run.
        robot: With the gains of its drives; None leaves the drives' part unknown.
    """
    trained = log.header.get("policy", {}).get("delay_range_s")
    return Delay(
        trained=None if trained is None else (float(trained[0]), float(trained[1])),
        answer=spread(log.latency[flying(log)]),
        drives=_UNKNOWN if robot is None else shift(log, robot),
    )


def shift(log: DeployLog, robot: Robot) -> tuple[float, float]:
    """The shifts at which the targets explain the torques best, from the least to the most [s].

    NaN where there is too little to fit, where torques are not measured, where the law explains
    too little of them, or where the longest shift tried is among the best.
    """
    kp = np.array([joint.stiffness for joint in robot.joints])
    kd = np.array([joint.damping for joint in robot.joints])
    gentle = _GENTLE * np.array([joint.drive.effort_limit for joint in robot.joints])
    wire = log.time + log.work
    first = np.concatenate([[True], np.diff(log.state_sequence) > 0])  # each state once
    use = flying(log) & first & (log.state_time - _SHIFTS[-1] > wire[0])
    if use.sum() < _LEAST:
        return _UNKNOWN
    t, q, v, given = (
        values[use] for values in (log.state_time, log.position, log.velocity, log.torque)
    )
    lefts = []
    for by in _SHIFTS:
        target = log.sent[np.searchsorted(wire, t - by, side="right") - 1]
        asked = kp * (target - q) - kd * v
        there = np.isfinite(given) & (np.abs(asked) < gentle)  # false where damped
        if there.sum() < _LEAST or np.var(given[there]) == 0.0:
            return _UNKNOWN
        lefts.append(np.mean((given - asked)[there] ** 2) / np.var(given[there]))
    left = np.array(lefts)
    good = _SHIFTS[left <= _AS_GOOD * left.min()]
    if 1.0 - left.min() < _EXPLAINED or good[-1] == _SHIFTS[-1]:
        return _UNKNOWN
    return float(good[0]), float(good[-1])
