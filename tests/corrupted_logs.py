"""Sweeps that are wrong in a known way, for tests and for `python -m benchmarks wrong-inputs`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import signal

from pronk.arrays import Array
from pronk.errors import LogError
from pronk.identify.logs.checks import check_motion, check_radians
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match.checks import check_excitations
from pronk.robots.robot import RobotSpec

COLUMNS = ("command", "position", "velocity", "torque", "frequency")
OTHER_LEG = {"FR": "HR", "HR": "FR", "FL": "HL", "HL": "FL"}
OTHER_SIDE = {"FR": "FL", "FL": "FR", "HR": "HL", "HL": "HR"}
REFUSED = "refused"


@dataclass(frozen=True, kw_only=True)
class Case:
    """A log, the joint that it is said to excite, and the robot that it is said to be of."""

    log: JointLog
    joint: str
    robot: RobotSpec


Change = Callable[[Case, np.random.Generator], Case]


def judge(case: Case) -> tuple[set[str], str]:
    """Return the checks that a case fails, by the first words of their flags, and the sentences.

    A case that is an error has the check `refused`.
    """
    try:
        check_radians(case.log, case.joint)
        excitations = case.log.excitations(case.joint)
        for excitation in excitations:
            check_motion(excitation)
        flags = check_excitations(excitations, case.robot)
    except LogError as error:
        return {REFUSED}, str(error)
    return {flag.split(":")[0] for flag in flags}, "; ".join(flags)


def without_extra_columns(log: JointLog) -> JointLog:
    """Return time, command, position and the drive's gains alone."""
    origin = replace(log.origin, metadata={})
    return replace(log, origin=origin, frequency=None, velocity=None, torque=None)


def with_columns(case: Case, columns: tuple[str, ...], change: Callable[[Array], Array]) -> Case:
    """Change whole columns of a log, where it has them."""
    changed: dict[str, Any] = {}
    for name in columns:
        values = getattr(case.log, name)
        if values is not None:
            changed[name] = change(np.asarray(values, dtype=np.float64))
    return replace(case, log=replace(case.log, **changed))


def renamed(case: Case, other_leg: Mapping[str, str]) -> Case:
    """Name the joints of another leg."""

    def other_name(name: str) -> str:
        leg, joint = name.split("_", 1)
        return f"{other_leg[leg]}_{joint}"

    segments = []
    for segment in case.log.segments:
        joints = tuple(other_name(name) for name in segment.joints)
        clamped = tuple(other_name(name) for name in segment.clamped)
        segments.append(replace(segment, joints=joints, clamped=clamped))
    joints = tuple(other_name(name) for name in case.log.joints)
    log = replace(case.log, joints=joints, segments=tuple(segments))
    return replace(case, log=log, joint=other_name(case.joint))


def of_a_resting_leg(case: Case, _rng: np.random.Generator) -> Case:
    """Take the measured columns of a leg that rests."""
    resting = np.flatnonzero(case.log.time < case.log.segments[0].start)
    rows = resting[np.arange(len(case.log.time)) % len(resting)]
    return with_columns(case, ("position", "velocity", "torque"), lambda values: values[rows])


def swap_legs(case: Case, _rng: np.random.Generator) -> Case:
    """Name a front leg's joints as those of the hind leg."""
    return renamed(case, OTHER_LEG)


def swap_sides(case: Case, _rng: np.random.Generator) -> Case:
    """Name a left leg's joints as those of the right leg."""
    return renamed(case, OTHER_SIDE)


def flip_sign(case: Case, _rng: np.random.Generator) -> Case:
    """Give the motion the other sign."""
    return with_columns(case, ("position", "velocity"), np.negative)


def to_degrees(case: Case, rng: np.random.Generator) -> Case:
    """Write the command, the motion or both in degrees."""
    choices = [("command",), ("position", "velocity"), ("command", "position", "velocity")]
    return with_columns(case, choices[int(rng.integers(3))], np.rad2deg)


def double_motion(case: Case, _rng: np.random.Generator) -> Case:
    """Write the motion about its mean as that of a motor behind a gear of 2."""
    return with_columns(
        case, ("position", "velocity"), lambda values: 2.0 * values - values.mean(axis=0)
    )


def scale_time(case: Case, rng: np.random.Generator) -> Case:
    """Let the clock run fast or slow by 3 %."""
    factor = float(rng.choice([1.03, 1.0 / 1.03]))
    segments = []
    for segment in case.log.segments:
        start = factor * segment.start
        segments.append(replace(segment, start=start, stop=factor * segment.stop))
    log = replace(case.log, time=factor * case.log.time, segments=tuple(segments))
    return replace(case, log=log)


def thin_samples(case: Case, rng: np.random.Generator) -> Case:
    """Keep every tenth sample, 50 a second."""
    rows = slice(int(rng.integers(10)), None, 10)
    thinned: dict[str, Any] = {"time": case.log.time[rows]}
    for name in COLUMNS:
        values = getattr(case.log, name)
        if values is not None:
            thinned[name] = values[rows]
    return replace(case, log=replace(case.log, **thinned))


def filter_command(case: Case, rng: np.random.Generator) -> Case:
    """Filter the command by a Butterworth filter of first or second order, 10 to 30 Hz."""
    corner_hz = float(np.exp(rng.uniform(np.log(10.0), np.log(30.0))))
    order = int(rng.integers(1, 3))
    sections = signal.butter(order, corner_hz, fs=case.log.rate_hz, output="sos")

    def filtered(values: Array) -> Array:
        return np.asarray(values[0] + signal.sosfilt(sections, values - values[0], axis=0))

    return with_columns(case, ("command",), filtered)


def stop_joint(case: Case, rng: np.random.Generator) -> Case:
    """Let the excited joint stand still for 3 to 10 s."""
    column = case.log.column(case.joint)
    first = case.log.segments[0].start
    last = case.log.segments[-1].stop
    begin = rng.uniform(first, first + 0.7 * (last - first))
    end = begin + rng.uniform(3.0, 10.0)
    still = (case.log.time >= begin) & (case.log.time < end)

    def frozen(values: Array) -> Array:
        changed = values.copy()
        changed[still, column] = changed[int(np.argmax(still)), column]
        return changed

    return with_columns(case, ("position",), frozen)


def lower_effort_limit(case: Case, _rng: np.random.Generator) -> Case:
    """Give the drive half of the torque that the excitation takes."""
    limit = 1.0
    for recording in case.log.excitations(case.joint):
        assert case.log.stiffness is not None
        stiffness = case.log.stiffness[case.log.column(case.joint)]
        error = recording.command - recording.position
        limit = min(limit, 0.5 * float(np.abs(stiffness * error).max()))
    joints = []
    for joint in case.robot.joints:
        if joint.name == case.joint:
            joint = replace(joint, drive=replace(joint.drive, effort_limit=limit))
        joints.append(joint)
    return replace(case, robot=replace(case.robot, joints=tuple(joints)))


@dataclass(frozen=True, kw_only=True)
class Corruption:
    """What is done to a log, and which check has to find it."""

    change: Change
    check: str
    """First words of the flag, or `refused`."""
    in_bare_logs: bool = True
    """True if time, command and position alone show it."""


CORRUPTIONS: Mapping[str, Corruption] = {
    "columns of a resting leg": Corruption(change=of_a_resting_leg, check="standstill"),
    "legs swapped": Corruption(change=swap_legs, check=REFUSED, in_bare_logs=False),
    "sides swapped": Corruption(change=swap_sides, check=REFUSED, in_bare_logs=False),
    "sign flipped": Corruption(change=flip_sign, check=REFUSED),
    "degrees": Corruption(change=to_degrees, check=REFUSED),
    "motor side": Corruption(change=double_motion, check="slow gain"),
    "time x 1.03": Corruption(change=scale_time, check="clock"),
    "50 Hz": Corruption(change=thin_samples, check="sample rate"),
    "command filtered": Corruption(change=filter_command, check="command column"),
    "joint dead": Corruption(change=stop_joint, check="standstill"),
    # Without a torque column the matched gains tell, after the fit.
    "effort limit": Corruption(change=lower_effort_limit, check="effort limit", in_bare_logs=False),
}
