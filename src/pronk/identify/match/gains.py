"""Matched gains: the file `gains.yaml`, which training, export and prediction read.

The file holds the simulator that the gains hold for, the drive of each joint with the intervals of
its parameters, the training gains and ranges of each joint group, and the hashes of the logs.
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

from pronk.errors import ArtefactError, UnmatchedError
from pronk.files import converted, read_yaml, write_text
from pronk.identify.simulators.info import SimulatorInfo
from pronk.names import check_names
from pronk.robots.menagerie import MENAGERIE

SCHEMA = "pronk/gains/2"
FIRST_SCHEMA = "pronk/gains/1"
"""Schema whose joints had one flat list of numbers. It is still read: the contract of a policy
holds the SHA-256 of the file that it was trained with, so those files cannot be written anew."""

HEADER = """\
# Matched gains. Which numbers to use:
#   groups   For training: stiffness and damping of each joint group, and how far to
#            randomize them (plus or minus the range). `pronk export` writes these.
#   joints   For the simulation of one joint, or of this one robot: the values of the
#            joint, with dry friction and delay, which go with them.
# They hold for the simulator below and for no other: its drive law, its step, and
# the inertia of this robot's model. They are not the gains of the drive itself.
# Intervals are 95 % intervals. total95: use this one. repeat95: spread of the
# repeats alone. matched: false says that no gains explain the log.
"""
"""First lines of the file, for the people who open it."""
FIELD_COMMENTS = {
    "timestep_s": "s",
    "stiffness": "N m/rad",
    "damping": "N m s/rad",
    "armature": "kg m^2, rotor inertia through the gear",
    "frictionloss": "N m, dry friction",
    "stribeck": "share of the dry friction that motion takes away",
    "delay_s": "s, delay of the command",
    "covariance": "of stiffness and damping",
    "band_hz": "Hz, compared frequencies",
    "error_db": "dB, error of the gain over frequency",
    "nominal_error_db": "dB, the same with the gains of the real drive",
    "coherence_min": "0 to 1, lowest of the measured response",
    "amplitude_spread": "relative change of the stiffness between amplitudes",
    "stiffness_range": "N m/rad, half of the width",
    "damping_range": "N m s/rad, half of the width",
    "ellipsoid": "shape matrix that covers stiffness and damping of the joints",
    "logs": "SHA-256 of each recording",
}
"""Comment behind a field of the file, by its name."""

NAN = float("nan")
Interval = tuple[float, float]
"""Lower and upper end."""
UNKNOWN: Interval = (NAN, NAN)
"""Interval of a value that was held, or of which nothing is known."""

LARGEST = 1e6
"""Largest stiffness, damping, armature, friction or range that is read, in SI units. The stiffest
joints of small robots have 1e3 N m/rad; a larger number is a wrong unit or a damaged file."""
LONGEST_DELAY_S = 1.0
"""Longest command delay that is read [s]; drives of robots have a few milliseconds."""


@dataclass(frozen=True, kw_only=True)
class FittedValue:
    """A parameter of a joint's drive with its two 95 % intervals, in the unit of the parameter.

    Intervals are NaN where the value was held, or where nothing is known about its uncertainty.
    """

    value: float
    repeat95: Interval = UNKNOWN
    """95 % interval by the spread of the repeats alone. Where nothing was repeated, as where joints
    moved together, it is by blocks of time, and by the coherence with method `paper`."""
    total95: Interval = UNKNOWN
    """95 % interval with the change between amplitudes and between parts of the recording, which
    the model does not explain. That of joints that moved together is `repeat95`; NaN with method
    `paper`."""

    def scaled(self, factor: float) -> FittedValue:
        """Return the value and its intervals times a factor that is not negative."""
        return FittedValue(
            value=factor * self.value,
            repeat95=(factor * self.repeat95[0], factor * self.repeat95[1]),
            total95=(factor * self.total95[0], factor * self.total95[1]),
        )


ZERO = FittedValue(value=0.0)
"""Parameter that a drive does not have."""
NOT_STATED = FittedValue(value=NAN)
"""Parameter for which the robot's own figure holds."""


@dataclass(frozen=True, kw_only=True)
class TorqueParameter:
    """A parameter of a joint's drive, identified by a torque channel."""

    value: float
    """Value in the unit of `match.torque_fit.UNITS`; NaN if the recordings leave it open."""
    ci95: Interval
    """95 % interval by blocks of the recordings; NaN where they leave it open."""
    reason: str = ""
    """Why the parameter is not identified; empty if it is."""

    @property
    def identified(self) -> bool:
        """True if the recordings identify the parameter."""
        return not self.reason


@dataclass(frozen=True, kw_only=True)
class MatchQuality:
    """How well the simulated response of a joint agrees with the measured one."""

    band_hz: Interval = UNKNOWN
    """Lowest and highest frequency that was compared [Hz]."""
    error_db: float = NAN
    """Root mean square of the gain error in the band with the matched gains [dB]."""
    nominal_error_db: float = NAN
    """Root mean square of the gain error in the band with the gains of the real drive [dB]."""
    coherence_min: float = NAN
    """Lowest coherence of the measured response, 0 to 1: in the whole band, or at the compared
    frequencies of a joint that moved together with others."""
    amplitude_spread: float = NAN
    """Largest relative change of the stiffness between amplitudes; NaN with one amplitude."""


@dataclass(frozen=True, kw_only=True)
class JointGains:
    """Parameters of the simulated drive with which a joint responds like the real one."""

    stiffness: FittedValue
    """Stiffness of the drive [N m/rad]."""
    damping: FittedValue
    """Damping of the drive [N m s/rad]."""
    armature: FittedValue
    """Rotor inertia at the joint, through the gear [kg m^2]."""
    frictionloss: FittedValue = NOT_STATED
    """Dry friction at rest that goes with the gains [N m]; NaN for that of the robot's drive."""
    stribeck: FittedValue = ZERO
    """Share of the dry friction that motion takes away, 0 to 1."""
    delay_s: FittedValue = ZERO
    """Delay of the command that goes with the gains [s]."""
    covariance: tuple[Interval, Interval] = (UNKNOWN, UNKNOWN)
    """Covariance of (stiffness, damping) by what `FittedValue.repeat95` is by: the repeats, or
    blocks of time or the coherence where nothing was repeated."""
    quality: MatchQuality = MatchQuality()
    """Agreement of the simulated with the measured response."""
    torque: Mapping[str, TorqueParameter] = field(default_factory=dict)
    """The drive by a torque channel (mode `drive`), by the names of `match.torque_fit.UNITS`."""
    physical: Mapping[str, FittedValue] = field(default_factory=dict)
    """Damping, armature, frictionloss and delay [s] of the drive itself (mode `drive`), where the
    values above are equivalents in the simulator's law at its step (`match.physical`)."""
    flags: tuple[str, ...] = ()
    """Warnings about this match, one sentence each: of its excitations and response (`checks`), of
    amplitudes and frequencies left out (`measured`, `match`), and of its fit (`drive_fit` or
    `magnitude`, `result`, `torque_fit`)."""
    matched: bool = True
    """False if these gains are no match: the simulated response is not the measured one, or the
    logs do not identify a gain. Files of earlier versions have only joints that count as
    matched."""
    reasons: tuple[str, ...] = ()
    """Why the gains are no match; empty if they are one."""


@dataclass(frozen=True, kw_only=True)
class GroupGains:
    """Gains and ranges of one joint group, from which training draws."""

    stiffness: float
    """Middle of the range of the stiffness [N m/rad]."""
    damping: float
    """Middle of the range of the damping [N m s/rad]."""
    stiffness_range: float
    """Half-width of the uniform distribution of the stiffness [N m/rad]."""
    damping_range: float
    """Half-width of the uniform distribution of the damping [N m s/rad]."""
    frictionloss: float = NAN
    """Mean dry friction that goes with the gains [N m]; NaN for that of the robot's drives."""
    ellipsoid: tuple[Interval, Interval] = ((0.0, 0.0), (0.0, 0.0))
    """Shape matrix E of the ellipsoid `{x : (x - c)^T E^-1 (x - c) <= 1}` of (stiffness, damping)
    that covers the joints and their intervals."""
    ellipsoid_center: tuple[float, float] = (0.0, 0.0)
    """Centre c of the ellipsoid."""


@dataclass(frozen=True, kw_only=True)
class MatchedGains:
    """Matched gains of a robot, and what they rest on."""

    robot: str
    """Name of the robot."""
    simulator: SimulatorInfo
    """Simulator that the gains hold for."""
    joints: Mapping[str, JointGains]
    """Matched joints, in the robot's order."""
    groups: Mapping[str, GroupGains]
    """Joint groups with a matched joint, in the robot's order."""
    logs: Mapping[str, str] = field(default_factory=dict)
    """SHA-256 of every log that went in, by its file name."""
    virtual: bool = False
    """True if any log came from pronk's virtual robot."""
    robot_path: str = ""
    """File of the robot, so that no command needs `--robot`; empty for a robot that ships with
    pronk. In `gains.yaml` it is relative to the folder of that file."""

    @property
    def unmatched(self) -> dict[str, tuple[str, ...]]:
        """Reasons by joint of the joints that are no match."""
        unmatched = {}
        for name, joint in self.joints.items():
            if not joint.matched:
                unmatched[name] = joint.reasons or ("it is marked as no match",)
        return unmatched

    def __repr__(self) -> str:
        """Name the robot, the simulator and the number of matched joints."""
        where = self.simulator.profile or self.simulator.engine
        return f"<MatchedGains of {self.robot} for {where}: {len(self.joints)} joints>"


def require_matched(gains: MatchedGains, allow_unmatched: bool, source: str = "") -> None:
    """Refuse gains with joints that are no match.

    Args:
        gains: Matched gains.
        allow_unmatched: True to accept them; what is made of them then carries the mark.
        source: File of the gains, for the message.

    Raises:
        UnmatchedError: A joint is no match; the message names each with its reasons.
    """
    if allow_unmatched or not gains.unmatched:
        return
    joints = []
    for name, reasons in gains.unmatched.items():
        joints.append(f"{name} ({'; '.join(reasons)})")
    place = f"{source}: " if source else ""
    raise UnmatchedError(
        f"{place}no match of {', '.join(joints)}. Record and match these joints again, or give "
        "--allow-unmatched (allow_unmatched=True in Python) to use their gains all the same."
    )


def save_gains(path: Path, gains: MatchedGains) -> None:
    """Write `gains.yaml`, whole or not at all.

    Args:
        path: File to write; missing folders are made.
        gains: Matched gains.

    Raises:
        PronkError: The file cannot be written.
    """
    joints = {}
    for name, joint in gains.joints.items():
        joints[name] = _joint_entry(joint)
    groups = {}
    for name, group in gains.groups.items():
        groups[name] = _group_entry(group)
    body: dict[str, Any] = {"schema": SCHEMA, "robot": gains.robot}
    if gains.robot_path:
        body["robot_path"] = gains.robot_path
        if not gains.robot_path.startswith(MENAGERIE):
            body["robot_path"] = _relative_path(gains.robot_path, path.parent)
    body |= {
        "virtual": gains.virtual,
        "simulator": _simulator_entry(gains.simulator),
        "joints": joints,
        "groups": groups,
        "logs": dict(gains.logs),
    }
    text = yaml.dump(body, Dumper=_Dumper, sort_keys=False, width=10_000)
    write_text(path, f"{HEADER}{_with_units(text)}")


def load_gains(path: Path) -> MatchedGains:
    """Read `gains.yaml`.

    Args:
        path: File that `pronk match` or `pronk translate` wrote.

    Returns:
        The matched gains.

    Raises:
        ArtefactError: The file is missing, is not YAML, is of another schema, has a field that is
            missing or misspelled, or has a name or a value that cannot be.
    """
    body = read_yaml(path, missing="`pronk match` writes one")
    schema = body.pop("schema", None) if isinstance(body, dict) else type(body).__name__
    if schema not in (SCHEMA, FIRST_SCHEMA):
        raise ArtefactError(
            f"{path}: schema {schema!r}; this pronk reads {SCHEMA!r} and {FIRST_SCHEMA!r}. "
            "Match the logs again with `pronk match`."
        )
    if schema == FIRST_SCHEMA and isinstance(body.get("joints"), dict):
        joints = {}
        for name, entry in body["joints"].items():
            joints[name] = _joint_of_first_schema(entry)
        body["joints"] = joints
    gains = converted(body, MatchedGains, path)
    check_names((gains.robot, *gains.joints, *gains.groups), str(path), ArtefactError)
    for name, joint in gains.joints.items():
        _check_joint(joint, f"{path}: joints.{name}")
    for name, group in gains.groups.items():
        _check_group(group, f"{path}: groups.{name}")
    if gains.robot_path and not gains.robot_path.startswith(MENAGERIE):
        robot_path = (path.resolve().parent / gains.robot_path).resolve()
        gains = replace(gains, robot_path=str(robot_path))
    return gains


# ---- what the file must hold ----


def _check_joint(joint: JointGains, place: str) -> None:
    """Refuse values of a joint that no drive has; errors begin with `place`."""
    _check_value(joint.stiffness.value, LARGEST, f"{place}.stiffness")
    _check_value(joint.damping.value, LARGEST, f"{place}.damping")
    _check_value(joint.armature.value, LARGEST, f"{place}.armature")
    if not math.isnan(joint.frictionloss.value):
        _check_value(joint.frictionloss.value, LARGEST, f"{place}.frictionloss")
    _check_value(joint.stribeck.value, 1.0, f"{place}.stribeck")
    _check_value(joint.delay_s.value, LONGEST_DELAY_S, f"{place}.delay_s")


def _check_group(group: GroupGains, place: str) -> None:
    """Refuse values of a group that no drive has; errors begin with `place`."""
    _check_value(group.stiffness, LARGEST, f"{place}.stiffness")
    _check_value(group.damping, LARGEST, f"{place}.damping")
    _check_value(group.stiffness_range, LARGEST, f"{place}.stiffness_range")
    _check_value(group.damping_range, LARGEST, f"{place}.damping_range")
    if not math.isnan(group.frictionloss):
        _check_value(group.frictionloss, LARGEST, f"{place}.frictionloss")


def _check_value(value: float, largest: float, place: str) -> None:
    """Refuse a value that is not between 0 and the largest."""
    if not 0.0 <= value <= largest:
        raise ArtefactError(f"{place} is {value:g}; expected 0 to {largest:g}.")


# ---- entries of the file ----


def _with_units(text: str) -> str:
    """Write the unit of each field as a comment at the end of its line."""
    lines = []
    for line in text.rstrip("\n").split("\n"):
        name = line.strip().partition(":")[0]
        comment = FIELD_COMMENTS.get(name)
        lines.append(f"{line}  # {comment}" if comment else line)
    return "\n".join(lines) + "\n"


class _OneLineList(list[Any]):
    """A list that is written on one line."""


class _Dumper(yaml.SafeDumper):
    """SafeDumper that writes `_OneLineList`."""


def _represent_list(dumper: yaml.SafeDumper, entry: _OneLineList) -> yaml.Node:
    return dumper.represent_sequence("tag:yaml.org,2002:seq", entry, flow_style=True)


_Dumper.add_representer(_OneLineList, _represent_list)


def _simulator_entry(simulator: SimulatorInfo) -> dict[str, Any]:
    """Return the entry of the simulator; an empty name is left out."""
    entry: dict[str, Any] = {}
    if simulator.profile:
        entry["profile"] = simulator.profile
    entry["engine"] = simulator.engine
    if simulator.version:
        entry["version"] = simulator.version
    entry["timestep_s"] = _rounded(simulator.timestep_s)
    entry["decimation"] = simulator.decimation
    entry["integrator"] = simulator.integrator
    entry["actuator"] = simulator.actuator
    entry["law"] = simulator.law
    entry["iterations"] = simulator.iterations
    return entry


def _relative_path(path: str, folder: Path) -> str:
    """Return a path relative to a folder; an absolute one where no relative one leads there."""
    try:
        return Path(os.path.relpath(path, folder.resolve())).as_posix()
    except ValueError:
        return Path(path).as_posix()


def _joint_entry(joint: JointGains) -> dict[str, Any]:
    """Return the entry of a joint; what is not known is left out."""
    entry: dict[str, Any] = {"matched": joint.matched}
    if joint.reasons:
        entry["reasons"] = list(joint.reasons)
    entry["stiffness"] = _value_entry(joint.stiffness)
    entry["damping"] = _value_entry(joint.damping)
    entry["armature"] = _value_entry(joint.armature)
    if not math.isnan(joint.frictionloss.value):
        entry["frictionloss"] = _value_entry(joint.frictionloss)
    if joint.stribeck.value != 0.0:
        entry["stribeck"] = _value_entry(joint.stribeck)
    if joint.delay_s.value != 0.0:
        entry["delay_s"] = _value_entry(joint.delay_s)
    if math.isfinite(joint.covariance[0][0]):
        entry["covariance"] = _matrix_entry(joint.covariance)
    entry["quality"] = _quality_entry(joint.quality)
    if joint.torque:
        entry["torque"] = {}
        for name, parameter in joint.torque.items():
            entry["torque"][name] = _torque_entry(parameter)
    if joint.physical:
        entry["physical"] = {}
        for name, fitted in joint.physical.items():
            entry["physical"][name] = _value_entry(fitted)
    if joint.flags:
        entry["flags"] = list(joint.flags)
    return entry


def _value_entry(fitted: FittedValue) -> dict[str, Any]:
    entry: dict[str, Any] = {"value": _rounded(fitted.value)}
    if math.isfinite(fitted.repeat95[0]):
        entry["repeat95"] = _interval_entry(fitted.repeat95)
    if math.isfinite(fitted.total95[0]):
        entry["total95"] = _interval_entry(fitted.total95)
    return entry


def _quality_entry(quality: MatchQuality) -> dict[str, Any]:
    entry: dict[str, Any] = {}
    if math.isfinite(quality.band_hz[0]):
        entry["band_hz"] = _interval_entry(quality.band_hz)
    numbers = {
        "error_db": quality.error_db,
        "nominal_error_db": quality.nominal_error_db,
        "coherence_min": quality.coherence_min,
        "amplitude_spread": quality.amplitude_spread,
    }
    for name, value in numbers.items():
        if math.isfinite(value):
            entry[name] = _rounded(value)
    return entry


def _torque_entry(parameter: TorqueParameter) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "value": _rounded(parameter.value),
        "ci95": _interval_entry(parameter.ci95),
    }
    if parameter.reason:
        entry["reason"] = parameter.reason
    return entry


def _group_entry(group: GroupGains) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "stiffness": _rounded(group.stiffness),
        "damping": _rounded(group.damping),
        "stiffness_range": _rounded(group.stiffness_range),
        "damping_range": _rounded(group.damping_range),
    }
    if not math.isnan(group.frictionloss):
        entry["frictionloss"] = _rounded(group.frictionloss)
    entry["ellipsoid"] = _matrix_entry(group.ellipsoid)
    entry["ellipsoid_center"] = _interval_entry(group.ellipsoid_center)
    return entry


def _interval_entry(interval: Sequence[float]) -> _OneLineList:
    return _OneLineList(_rounded(end) for end in interval)


def _matrix_entry(matrix: Sequence[Sequence[float]]) -> _OneLineList:
    return _OneLineList(_interval_entry(row) for row in matrix)


def _rounded(value: float) -> float:
    """Round to six significant digits, a tenth of what any of these numbers is known to."""
    return float(f"{value:.6g}")


# ---- the first schema ----


def _joint_of_first_schema(entry: Any) -> Any:
    """Return a joint's entry of the first schema as one of the present schema.

    Fields that the first schema did not have stay in the entry, so that they are refused by name.
    """
    if not isinstance(entry, dict):
        return entry
    flat = dict(entry)
    joint: dict[str, Any] = {}
    for name in ("stiffness", "damping", "armature", "frictionloss", "stribeck", "delay_s"):
        if name in flat:
            joint[name] = {"value": flat.pop(name)}
    for name in ("stiffness", "damping"):
        for interval, first_name in (("repeat95", "ci95"), ("total95", "total95")):
            if f"{name}_{first_name}" in flat and name in joint:
                joint[name][interval] = flat.pop(f"{name}_{first_name}")
    quality: dict[str, Any] = {}
    for name in ("band_hz", "error_db", "coherence_min", "amplitude_spread"):
        if name in flat:
            quality[name] = flat.pop(name)
    if "naive_error_db" in flat:
        quality["nominal_error_db"] = flat.pop("naive_error_db")
    joint["quality"] = quality
    for name in ("grid_stiffness", "grid_damping", "unchecked"):
        # The optimum on the grid is in match.npz.
        flat.pop(name, None)
    joint.update(flat)
    return joint
