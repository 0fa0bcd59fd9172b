"""Measures of a deployment's log: modes, jumps, delays, interventions, tracking, timing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise, product
from typing import Any

import numpy as np

from pronk.arrays import Array, Mask
from pronk.deploy.runtime.log import DeployLog
from pronk.deploy.runtime.modes import Mode
from pronk.deploy.runtime.safety import FilterAction, Reason
from pronk.report.style import rms
from pronk.robots.robot import RobotSpec

POLICY_MODES = (Mode.POLICY, Mode.HALT)
"""Modes in which the policy gives the targets."""
QUANTILES = {"p50": 0.5, "p95": 0.95, "p99": 0.99, "p99_9": 0.999}
_MOVED = 1e-9
"""Smaller changes of a target are rounding [rad]."""
_SHIFTS = np.arange(0.0, 0.0305, 0.00025)
"""Delays tried for the drives, multiples of the virtual robot's physics step [s]."""
_EXPLAINED = 0.8
"""Least share of the torque's variance that the drive law must explain."""
_GENTLE = 0.5
"""Share of its effort limit below which a drive follows the law at any battery voltage."""
_AS_GOOD = 1.1
"""Residuals up to this multiple of the least are no worse."""
_LEAST = 250
"""Fewest ticks to fit: half a second."""
_UNKNOWN = (float("nan"), float("nan"))


def quantiles(values: Array) -> dict[str, float]:
    """Return `n`, `QUANTILES` and `max` of the finite values; NaN if fewer than one lies beyond."""
    found = np.sort(values[np.isfinite(values)])
    n, of = len(found), {}
    for name, share in QUANTILES.items():
        beyond = n * (1.0 - share) > 1.0 - 1e-9
        of[name] = found[int(np.ceil(share * n - 1e-9)) - 1] if beyond else np.nan
    return {"n": n} | of | {"max": found[-1] if n else np.nan}


def seconds(log: DeployLog, time: Array | float) -> Array:
    """Return times on the log's clock as times since its first tick [s]."""
    return np.asarray(np.asarray(time, dtype=float) - log.time[0])


def policy_active(log: DeployLog) -> Mask:
    """Return the ticks in which the policy gave the targets, (T,)."""
    return np.asarray(np.isin(log.mode, POLICY_MODES))


def stretches(log: DeployLog) -> list[tuple[Mode, float, float]]:
    """Return the modes one after the other, with begin since the first tick and length [s]."""
    edges = [0, *(np.flatnonzero(np.diff(log.mode)) + 1), len(log.time)]
    period = float(np.median(np.diff(log.time))) if len(log.time) > 1 else 0.0
    t = seconds(log, np.append(log.time, log.time[-1] + period))
    return [(Mode(int(log.mode[a])), float(t[a]), float(t[b] - t[a])) for a, b in pairwise(edges)]


def faults(log: DeployLog) -> list[float]:
    """Return when faults began, since the first tick [s]."""
    return [float(seconds(log, one.time)) for one in log.events if one.kind == "fault"]


def jumps(log: DeployLog) -> list[tuple[float, float]]:
    """Return the begin and end of each jump input, since the first tick [s]."""
    if not len(log.step_time):
        return []
    t = seconds(log, np.append(log.step_time, log.step_time[-1] + 0.02))
    edges = np.diff(np.concatenate([[0], (log.jump & log.step_live).astype(int), [0]]))
    ends = zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True)
    return [(float(t[a]), float(t[b])) for a, b in ends]


def missed(log: DeployLog) -> int:
    """Return the number of ticks left out because their time had passed."""
    return int((np.diff(log.tick) - 1).sum())


def tilt(log: DeployLog) -> Array:
    """Return the angle of the trunk's z axis from the vertical [rad]; NaN without an attitude."""
    size = np.linalg.norm(log.orientation, axis=1)
    x, y = log.orientation[:, 1], log.orientation[:, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y) / size**2, -1.0, 1.0)))


def interventions(log: DeployLog) -> list[dict[str, Any]]:
    """Return what the safety filter did, by level and reason; the mildest first.

    `level` and `reason` are names, `why` is the reason in words; `ticks` is their number, `first`
    the time since the first tick [s], `largest` the largest change of a target [rad] and `joint`
    the one that was changed most often: NaN and empty while damped.
    """
    found = []
    with np.errstate(invalid="ignore"):
        change = np.nan_to_num(np.abs(log.sent - log.desired))
    for level, reason in product(list(FilterAction)[1:], Reason):
        there = (log.level == level) & (log.reason == reason)
        if there.any():
            often = (change[there] > _MOVED).sum(axis=0)
            moved = level < FilterAction.DAMP and bool(often.any())
            one: dict[str, Any] = {"level": level.name, "reason": reason.name, "why": reason.text}
            one |= {"ticks": int(there.sum()), "first": float(seconds(log, log.time[there][0]))}
            one["largest"] = float(change[there].max()) if moved else float("nan")
            one["joint"] = log.joints[int(often.argmax())] if moved else ""
            found.append(one)
    return found


def in_force(log: DeployLog) -> Array:
    """Return the target of the drives when each state was measured [rad], (T, joints).

    The one of the tick before; NaN for the first tick and after a damped one.
    """
    return np.vstack([np.full((1, log.sent.shape[1]), np.nan), log.sent[:-1]])


def _largest(values: Array) -> Array:
    """Of the finite values of each column; NaN without any."""
    size = np.where(np.isfinite(values), np.abs(values), -1.0).max(axis=0, initial=-1.0)
    return np.where(size >= 0.0, size, np.nan)


def tracking(log: DeployLog) -> dict[str, Array]:
    """Return how each joint followed its targets, (joints,); NaN where there was no such time.

    `error`, `largest`: target in force less position while the policy was active, RMS and largest
    [rad]; `standing`: RMS in the mode `STAND` [rad]; `torque`, `torque_largest`: as the robot
    reports them [N m]; `speed_largest` [rad/s].
    """
    error, active = in_force(log) - log.position, policy_active(log)
    torque = log.torque if log.torque.any() else np.full_like(log.torque, np.nan)
    return {
        "standing": rms(error[log.mode == Mode.STAND], axis=0),
        "error": rms(error[active], axis=0),
        "largest": _largest(error[active]),
        "torque": rms(torque[active], axis=0),
        "torque_largest": _largest(torque[active]),
        "speed_largest": _largest(log.velocity[active]),
    }


@dataclass(frozen=True, kw_only=True)
class Delay:
    """Measured delay beside that of training [s]."""

    trained: tuple[float, float] | None
    """Range of the policy's training; None where the log does not hold it."""
    command: Mapping[str, float]
    """Quantiles from a state to the first command that uses it, while the policy was active."""
    drives: tuple[float, float]
    """From a command on the wire to its torque, bounds; NaN where it could not be estimated."""

    @property
    def drives_known(self) -> bool:
        """Whether the delay of the drives could be estimated."""
        return bool(np.isfinite(self.drives).all())

    @property
    def total(self) -> tuple[float, float]:
        """Median of the command with the drives' least; its 95 % with the drives' most [s]."""
        return self.command["p50"] + self.drives[0], self.command["p95"] + self.drives[1]

    @property
    def longest(self) -> float:
        """Upper end of what is known [s]: of the total, else of the commands alone."""
        return self.total[1] if np.isfinite(self.total[1]) else self.command["p95"]

    @property
    def within(self) -> bool | None:
        """Whether the delay is at most the longest of training; None where it is unknown."""
        if self.trained is None or not np.isfinite(self.longest):
            return None
        return bool(self.longest <= self.trained[1])


def delay(log: DeployLog, robot: RobotSpec | None) -> Delay:
    """Measure the delay; that of the drives with the gains of `robot`, unknown if None."""
    trained = log.header.get("policy", {}).get("delay_range_s")
    return Delay(
        trained=None if trained is None else (float(trained[0]), float(trained[1])),
        command=quantiles(log.latency[policy_active(log)]),
        drives=_UNKNOWN if robot is None else drive_delay(log, robot),
    )


def drive_delay(log: DeployLog, robot: RobotSpec) -> tuple[float, float]:
    """Return the delays with which targets explain torques best, least and most [s].

    NaN where there is too little to fit, where torques are not measured, where the law explains
    too little of them, or where the longest delay tried is among the best.
    """
    kp = np.array([joint.stiffness for joint in robot.joints])
    kd = np.array([joint.damping for joint in robot.joints])
    gentle = _GENTLE * np.array([joint.drive.effort_limit for joint in robot.joints])
    wire = log.time + log.work
    first = np.concatenate([[True], np.diff(log.state_sequence) > 0])  # each state once
    use = policy_active(log) & first & (log.state_time - _SHIFTS[-1] > wire[0])
    if use.sum() < _LEAST:
        return _UNKNOWN
    t, q, v, measured = (a[use] for a in (log.state_time, log.position, log.velocity, log.torque))
    residuals = []
    for by in _SHIFTS:
        target = log.sent[np.searchsorted(wire, t - by, side="right") - 1]
        expected = kp * (target - q) - kd * v
        there = np.isfinite(measured) & (np.abs(expected) < gentle)  # false where damped
        if there.sum() < _LEAST or np.var(measured[there]) == 0.0:
            return _UNKNOWN
        residuals.append(np.mean((measured - expected)[there] ** 2) / np.var(measured[there]))
    left = np.array(residuals)
    good = _SHIFTS[left <= _AS_GOOD * left.min()]
    if 1.0 - left.min() < _EXPLAINED or good[-1] == _SHIFTS[-1]:
        return _UNKNOWN
    return float(good[0]), float(good[-1])


def times(log: DeployLog) -> dict[str, tuple[Array, str]]:
    """Return everything that was timed [s] by name, and what it is."""
    bad = log.level >= FilterAction.DAMP
    until_fault = int(bad.argmax()) + 1 if bad.any() else len(bad)
    live, age = log.step_live, log.state_age[:until_fault]
    latency = log.latency[policy_active(log)]
    found = {
        "servo tick late": (log.lateness, "from a tick's deadline to its begin"),
        "age of the state": (age, "from the newest state to the tick's begin, until a fault"),
        "state to command": (latency, "from a state to the first command on the wire that uses it"),
        "servo's work": (log.work, "from a tick's begin until its command was on the wire"),
        "policy step late": (log.step_lateness[live], "from a step's deadline to its begin"),
        "inference": (log.decision[live], "observation built and network run"),
    }
    return {name: one for name, one in found.items() if np.isfinite(one[0]).any()}
