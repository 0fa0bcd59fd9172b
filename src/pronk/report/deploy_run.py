"""Measures of a deployment's log: modes, jumps, delays, interventions, margins, timing."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pronk.arrays import Array, Mask
from pronk.deploy.runtime.deploy_log import DeployLog
from pronk.deploy.runtime.modes import POLICY_MODES, Mode
from pronk.deploy.runtime.reasons import FilterAction, Reason
from pronk.robots.robot import RobotSpec

QUANTILES = {"p50": 0.5, "p95": 0.95, "p99": 0.99, "p99_9": 0.999}
"""Names of quantiles, and their shares."""
_STEP_S = 0.02
"""Time between two steps of the policy [s]."""
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
_FEWEST_TICKS = 250
"""Fewest ticks to fit: half a second."""
_UNKNOWN = (float("nan"), float("nan"))


def quantiles(values: Array) -> dict[str, float]:
    """Return `n`, `QUANTILES` and `max` of the finite values; NaN if fewer than one lies beyond."""
    ordered = np.sort(values[np.isfinite(values)])
    count = len(ordered)
    result: dict[str, float] = {"n": count}
    for name, share in QUANTILES.items():
        result[name] = np.nan
        if count * (1.0 - share) > 1.0 - 1e-9:
            result[name] = ordered[int(np.ceil(share * count - 1e-9)) - 1]
    result["max"] = ordered[-1] if count else np.nan
    return result


def since_start(log: DeployLog, time: Array | float) -> Array:
    """Return times on the log's clock as times since its first tick [s]."""
    return np.asarray(np.asarray(time, dtype=float) - log.ticks.begun[0])


def policy_active(log: DeployLog) -> Mask:
    """Return the ticks in which the policy gave the targets, (T,)."""
    return np.asarray(np.isin(log.ticks.mode, POLICY_MODES))


@dataclass(frozen=True, kw_only=True)
class Stretch:
    """Time in one mode."""

    mode: Mode
    """Mode of the servo."""
    begin: float
    """Begin since the first tick [s]."""
    seconds: float
    """Length [s]."""


def stretches(log: DeployLog) -> list[Stretch]:
    """Return the modes one after the other."""
    begun = log.ticks.begun
    period = float(np.median(np.diff(begun))) if len(begun) > 1 else 0.0
    times = since_start(log, np.append(begun, begun[-1] + period))
    changes = np.flatnonzero(np.diff(log.ticks.mode)) + 1
    edges = [0, *changes.tolist(), len(begun)]
    result = []
    for first, end in pairwise(edges):
        mode = Mode(int(log.ticks.mode[first]))
        begin = float(times[first])
        result.append(Stretch(mode=mode, begin=begin, seconds=float(times[end]) - begin))
    return result


def fault_times(log: DeployLog) -> list[float]:
    """Return when faults began, since the first tick [s]."""
    return [float(since_start(log, event.time)) for event in log.events if event.kind == "fault"]


def jump_inputs(log: DeployLog) -> list[tuple[float, float]]:
    """Return the begin and end of each jump input, since the first tick [s]."""
    begun = log.steps.begun
    if not len(begun):
        return []
    times = since_start(log, np.append(begun, begun[-1] + _STEP_S))
    pressed = (log.steps.jump & log.steps.live).astype(int)
    edges = np.diff(np.concatenate([[0], pressed, [0]]))
    inputs = []
    for first, end in zip(np.flatnonzero(edges > 0), np.flatnonzero(edges < 0), strict=True):
        inputs.append((float(times[first]), float(times[end])))
    return inputs


def missed_ticks(log: DeployLog) -> int:
    """Return the number of ticks left out because their time had passed."""
    return int((np.diff(log.ticks.tick) - 1).sum())


def tilt_angles(log: DeployLog) -> Array:
    """Return the angle of the trunk's z axis from the vertical [rad]; NaN without an attitude."""
    orientation = log.ticks.state.orientation
    length = np.linalg.norm(orientation, axis=1)
    x = orientation[:, 1]
    y = orientation[:, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = 1.0 - 2.0 * (x * x + y * y) / length**2
        return np.asarray(np.arccos(np.clip(cosine, -1.0, 1.0)))


@dataclass(frozen=True, kw_only=True)
class Intervention:
    """What the safety filter did for one reason."""

    level: FilterAction
    """What it did."""
    reason: Reason
    """Why."""
    ticks: int
    """Number of ticks."""
    first: float
    """Time of the first, since the first tick of the log [s]."""
    largest: float
    """Largest change of a target [rad]; NaN while damped."""
    joint: str
    """Joint whose target was changed most often; empty while damped."""


def interventions(log: DeployLog) -> list[Intervention]:
    """Return what the safety filter did, by level and reason; the mildest first."""
    ticks = log.ticks
    with np.errstate(invalid="ignore"):
        change = np.nan_to_num(np.abs(ticks.sent - ticks.desired))
    result = []
    for level in FilterAction:
        if level is FilterAction.PASS:
            continue
        for reason in Reason:
            is_such = (ticks.level == level) & (ticks.reason == reason)
            if not is_such.any():
                continue
            times_changed = (change[is_such] > _MOVED).sum(axis=0)
            largest = float("nan")
            joint = ""
            if level < FilterAction.DAMP and times_changed.any():
                largest = float(change[is_such].max())
                joint = log.joints[int(times_changed.argmax())]
            result.append(
                Intervention(
                    level=level,
                    reason=reason,
                    ticks=int(is_such.sum()),
                    first=float(since_start(log, ticks.begun[is_such][0])),
                    largest=largest,
                    joint=joint,
                )
            )
    return result


def tracking_error(log: DeployLog, mask: Mask) -> Array:
    """Return the RMS of target in force less position, of each joint [rad], (joints,).

    The target in force is that of the tick before; NaN where there is none.

    Args:
        log: The log.
        mask: Ticks that count, (T,).
    """
    sent = log.ticks.sent
    in_force = np.vstack([np.full((1, sent.shape[1]), np.nan), sent[:-1]])
    error = (in_force - log.ticks.state.position)[mask]
    is_known = np.isfinite(error)
    count = is_known.sum(axis=0)
    square = np.where(is_known, error, 0.0) ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.sqrt(square.sum(axis=0) / count))


@dataclass(frozen=True, kw_only=True)
class Margin:
    """The largest value of a quantity beside its limit."""

    quantity: str
    """What was measured."""
    unit: str
    """Unit of it and of its limit."""
    largest: float
    """Largest value; NaN where it was not measured."""
    limit: float
    """Limit; NaN where it is not known."""
    joint: str = ""
    """Joint that came nearest to its limit; empty for a quantity of the trunk."""


def margins(log: DeployLog) -> list[Margin]:
    """Return the largest values of the run, up to the first fault, beside their limits."""
    limits = log.header.get("limits", {})
    joints = limits.get("joints", {})
    operating = limits.get("operating", {})
    ages = limits.get("ages", {})
    count = ticks_until_fault(log)
    state = log.ticks.state
    torque = state.torque[:count]
    if not torque.any():
        torque = np.full_like(torque, np.nan)  # this robot reports none
    return [
        _joint_margin(log, "joint speed", "rad/s", state.velocity[:count], joints.get("speed")),
        _joint_margin(log, "joint torque", "N m", torque, joints.get("torque")),
        _joint_margin(
            log,
            "motor temperature",
            "deg C",
            state.temperature[:count],
            [operating.get("temperature", np.nan)] * len(log.joints),
        ),
        Margin(
            quantity="tilt of the trunk",
            unit="rad",
            largest=_largest(tilt_angles(log)[:count]),
            limit=float(operating.get("tilt") or np.nan),
        ),
        Margin(
            quantity="age of the state",
            unit="s",
            largest=_largest(log.ticks.state_age[:count]),
            limit=float(ages.get("damp_s") or np.nan),
        ),
    ]


def _joint_margin(
    log: DeployLog, quantity: str, unit: str, values: Array, limits: list[float] | None
) -> Margin:
    """Return the margin of the joint that came nearest to its limit."""
    largest = []
    for column in range(len(log.joints)):
        largest.append(_largest(values[:, column]))
    if limits is None:
        limits = [float("nan")] * len(log.joints)
    shares = np.array(largest) / np.array(limits, dtype=float)
    if not np.isfinite(shares).any():
        shares = np.array(largest)
    if not np.isfinite(shares).any():
        return Margin(quantity=quantity, unit=unit, largest=float("nan"), limit=float("nan"))
    nearest = int(np.nanargmax(shares))
    return Margin(
        quantity=quantity,
        unit=unit,
        largest=largest[nearest],
        limit=float(limits[nearest]),
        joint=log.joints[nearest],
    )


def _largest(values: Array) -> float:
    """Return the largest size of the finite values; NaN without any."""
    finite = values[np.isfinite(values)]
    return float(np.abs(finite).max()) if len(finite) else float("nan")


def ticks_until_fault(log: DeployLog) -> int:
    """Return the number of ticks up to the first that damped for a fault, that one included."""
    is_fault = log.ticks.level >= FilterAction.DAMP
    return int(is_fault.argmax()) + 1 if is_fault.any() else len(is_fault)


@dataclass(frozen=True, kw_only=True)
class Delay:
    """Measured delay beside that of training [s]."""

    trained: tuple[float, float] | None
    """Range of the policy's training; None where the log does not hold it."""
    command: dict[str, float]
    """Quantiles from a state to the first command that uses it, while the policy was active."""
    drives: tuple[float, float]
    """Bounds from a command on the wire to its torque; NaN where it could not be estimated."""

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


def measured_delay(log: DeployLog, robot: RobotSpec | None) -> Delay:
    """Measure the delay; that of the drives with the gains of `robot`, unknown if None."""
    trained = log.header.get("policy", {}).get("delay_range_s")
    return Delay(
        trained=None if trained is None else (float(trained[0]), float(trained[1])),
        command=quantiles(log.ticks.latency[policy_active(log)]),
        drives=_UNKNOWN if robot is None else drive_delay(log, robot),
    )


def drive_delay(log: DeployLog, robot: RobotSpec) -> tuple[float, float]:
    """Return the delays with which targets explain torques best, least and most [s].

    NaN where there is too little to fit, where torques are not measured, where the law explains
    too little of them, or where the longest delay tried is among the best.
    """
    ticks = log.ticks
    stiffness = np.array([joint.stiffness for joint in robot.joints])
    damping = np.array([joint.damping for joint in robot.joints])
    effort_limit = np.array([joint.drive.effort_limit for joint in robot.joints])
    wire = ticks.begun + ticks.work
    is_new = np.concatenate([[True], np.diff(ticks.state.sequence) > 0])  # each state once
    used = policy_active(log) & is_new & (ticks.state.time - _SHIFTS[-1] > wire[0])
    if used.sum() < _FEWEST_TICKS:
        return _UNKNOWN
    time = ticks.state.time[used]
    position = ticks.state.position[used]
    velocity = ticks.state.velocity[used]
    torque = ticks.state.torque[used]
    residuals = []
    for shift in _SHIFTS:
        target = ticks.sent[np.searchsorted(wire, time - shift, side="right") - 1]
        expected = stiffness * (target - position) - damping * velocity
        # False where damped.
        compared = np.isfinite(torque) & (np.abs(expected) < _GENTLE * effort_limit)
        variance = np.var(torque[compared]) if compared.any() else 0.0
        if compared.sum() < _FEWEST_TICKS or variance == 0.0:
            return _UNKNOWN
        residuals.append(np.mean((torque - expected)[compared] ** 2) / variance)
    smallest = min(residuals)
    good_shifts = _SHIFTS[np.array(residuals) <= _AS_GOOD * smallest]
    if 1.0 - smallest < _EXPLAINED or good_shifts[-1] == _SHIFTS[-1]:
        return _UNKNOWN
    return float(good_shifts[0]), float(good_shifts[-1])


@dataclass(frozen=True, kw_only=True)
class TimedPart:
    """Something that was timed in every tick or step."""

    name: str
    """Short name."""
    meaning: str
    """From when to when."""
    seconds: Array
    """Times [s]."""


def timed_parts(log: DeployLog) -> list[TimedPart]:
    """Return everything that was timed."""
    live = log.steps.live
    parts = [
        TimedPart(
            name="servo tick late",
            meaning="from a tick's deadline to its begin",
            seconds=log.ticks.lateness,
        ),
        TimedPart(
            name="age of the state",
            meaning="from the newest state to the tick's begin, until a fault",
            seconds=log.ticks.state_age[: ticks_until_fault(log)],
        ),
        TimedPart(
            name="state to command",
            meaning="from a state to the first command on the wire that uses it",
            seconds=log.ticks.latency[policy_active(log)],
        ),
        TimedPart(
            name="servo's work",
            meaning="from a tick's begin until its command was on the wire",
            seconds=log.ticks.work,
        ),
        TimedPart(
            name="policy step late",
            meaning="from a step's deadline to its begin",
            seconds=log.steps.lateness[live],
        ),
        TimedPart(
            name="inference",
            meaning="observation built and network run",
            seconds=log.steps.decision[live],
        ),
    ]
    return [part for part in parts if np.isfinite(part.seconds).any()]
