"""The gains that training draws about: those of a `gains.yaml`, or the nominal gains.

By group, as in the paper, every joint is drawn in the range of its group, which covers all joints
of the group. By joint each joint is drawn about its own pair, in an ellipse as wide as its own
evidence is, with stiffness and damping correlated as the match found them; dry friction and the
command delay are drawn in their intervals (`joint_draws`).

Nominal gains are those of the real drives, put into the simulator as they are (reading A20 of S4);
the paper calls such a policy naive. With ranges and delay of a match everything else stays the
same, but for the dry friction: that of the robot's drives goes with nominal gains, and that of the
match with matched ones where the file has it (schema 2).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pronk.errors import ArtefactError, PronkError
from pronk.files import sha256
from pronk.identify.match.gains import (
    FittedValue,
    GroupGains,
    Interval,
    JointGains,
    MatchedGains,
    load_gains,
    require_matched,
)
from pronk.identify.match.ranges import LOWEST_OF_GAIN
from pronk.identify.match.uncertainty import LEAST_SHARE
from pronk.identify.simulators.info import SimulatorInfo, mujoco_info
from pronk.robots.robot import Joint, RobotSpec

NAIVE = "naive"
"""The choice of the nominal gains, which needs no file."""
NAIVE_STIFFNESS_RANGE = 2.0
"""Half-width of the randomization of the nominal stiffness [N m/rad] (paper D3)."""
NAIVE_DAMPING_RANGE = 0.05
"""Half-width of the randomization of the nominal damping [N m s/rad] (paper D4)."""

HIGHEST_CORRELATION = 0.995
"""Largest correlation of stiffness and damping, in magnitude: an ellipse needs two axes."""

GainsName = Literal["naive", "matched"]


@dataclass(frozen=True, kw_only=True)
class TrainingGains:
    """Gains and their ranges by joint group, and their origin."""

    name: GainsName
    robot: str
    groups: Mapping[str, GroupGains]
    """Gains of each joint group, in the robot's order of groups."""
    joints: Mapping[str, GroupGains] = field(default_factory=dict)
    """Gains of each joint with ranges and ellipse of its own; empty where they are by group."""
    frictions: Mapping[str, Interval] = field(default_factory=dict)
    """Lowest and highest dry friction of each joint [N m]; empty where gains are by group."""
    delay_span_s: Interval | None = None
    """Shortest and longest command delay by the intervals of the joints [s]; None where gains are
    by group."""
    delay_s: float = 0.0
    """Command delay of the real joint beyond the simulator's, mean of the joints [s]."""
    sha256: str = ""
    """Hash of the `gains.yaml` that nominals or ranges come from; empty without one."""
    virtual: bool = False
    """True if that file rests on pronk's virtual robot."""
    unmatched: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Joints of that file that are no match, with the reasons."""

    def __post_init__(self) -> None:
        """Refuse ranges that reach zero, and a negative delay."""
        for name, gains in (*self.groups.items(), *self.joints.items()):
            _check_range(f"stiffness of {name}", gains.stiffness, gains.stiffness_range)
            _check_range(f"damping of {name}", gains.damping, gains.damping_range)
        if not (math.isfinite(self.delay_s) and self.delay_s >= 0.0):
            raise PronkError(f"the command delay is {self.delay_s} s; it must be 0 or more.")

    def of(self, joint: Joint) -> GroupGains:
        """Return the gains of a joint: its own, or those of its group."""
        return self.joints.get(joint.name) or self.groups[joint.group]


def _check_range(gain: str, nominal: float, half_width: float) -> None:
    """Refuse a range that is negative or reaches zero."""
    if not 0.0 <= half_width < nominal:
        raise PronkError(
            f"{gain} is {nominal:g} +- {half_width:g}; training needs a range that is not negative "
            "and stays above zero."
        )


def training_gains(
    choice: str | Path,
    robot: RobotSpec,
    *,
    like: Path | None = None,
    allow_unmatched: bool = False,
    by_joint: bool = False,
) -> TrainingGains:
    """Return the gains to train with.

    Args:
        choice: `naive` for the nominal gains, or a `gains.yaml` for this robot and simulator.
        robot: The robot.
        like: A `gains.yaml` whose ranges and delay are used about the nominal gains, its
            ellipsoids moved along (reading A20). Without it their ranges are the paper's (D3, D4)
            and the delay is 0.
        allow_unmatched: Accept a file with joints that are no match.
        by_joint: Draw each joint about its own gains, friction and delay in their intervals, not
            about those of its group. About nominal gains the ellipses of `like` are moved along,
            and the friction is that of the robot's drives.

    Raises:
        UnmatchedError: A joint of the file is no match.
        ArtefactError: A file that is missing, or of another robot or simulator.
        PronkError: Impossible gains, or ranges given beside those of a file.
    """
    is_naive = str(choice) == NAIVE
    if like is not None and not is_naive:
        raise PronkError(
            f"ranges like {like} were requested with the gains of {choice}; "
            "they go with the choice 'naive' only, a gains.yaml has its own."
        )
    nominal_groups = {}
    if is_naive:
        for group in robot.groups:
            nominal_groups[group] = _nominal_gains(robot, group)
    if is_naive and like is None:
        if by_joint:
            raise PronkError(
                "gains by joint need the intervals of a gains.yaml; nominal gains alone have none."
            )
        return TrainingGains(name="naive", robot=robot.name, groups=nominal_groups)
    path = like or Path(choice)
    matched = _matched_gains(path, robot)
    require_matched(matched, allow_unmatched, str(path))
    groups = {}
    for group in robot.groups:
        groups[group] = matched.groups[group]
        if is_naive:
            groups[group] = _moved_ranges(nominal_groups[group], matched.groups[group])
    delays = [joint.delay_s.value for joint in matched.joints.values()]
    joints: dict[str, GroupGains] = {}
    frictions: dict[str, Interval] = {}
    if by_joint:
        joints = joint_draws(matched, robot, path)
        for joint in robot.joints:
            if is_naive:
                nominal = nominal_groups[joint.group]
                joints[joint.name] = _moved_ranges(nominal, joints[joint.name])
                frictions[joint.name] = (joint.drive.frictionloss, joint.drive.frictionloss)
            else:
                frictions[joint.name] = _friction_span(matched.joints[joint.name], joint)
    return TrainingGains(
        name="naive" if is_naive else "matched",
        robot=robot.name,
        groups=groups,
        joints=joints,
        frictions=frictions,
        delay_span_s=_delay_span(matched) if by_joint else None,
        delay_s=math.fsum(delays) / len(delays),
        sha256=sha256(path),
        virtual=matched.virtual,
        unmatched=matched.unmatched,
    )


def joint_draws(matched: MatchedGains, robot: RobotSpec, path: Path) -> dict[str, GroupGains]:
    """Return what each joint of a robot is drawn about, and how far.

    The half-widths of a joint are those of its intervals (`total95`, which holds the spread over
    amplitudes; `repeat95` where nothing else is known) and of that spread, at least `LEAST_SHARE`
    of the gain. A file of the first schema has neither a total interval nor the spread of the
    damping: there the damping spreads by the same share as the stiffness. The ellipse has these
    half-widths and the correlation of `covariance`, 0 where that is not known.

    Args:
        matched: Matched gains.
        robot: The robot.
        path: The file, for messages.

    Returns:
        Pair, half-widths and ellipse of each joint, in the robot's order.

    Raises:
        ArtefactError: The file lacks joints of the robot.
    """
    missing = [name for name in robot.joint_names if name not in matched.joints]
    if missing:
        raise ArtefactError(
            f"{path}: no gains of {', '.join(missing)}; training by joint needs all joints: match "
            "their logs in the same run of `pronk match`, or train by group."
        )
    draws = {}
    for joint in robot.joints:
        gains = matched.joints[joint.name]
        spread = gains.quality.amplitude_spread
        spread = spread if math.isfinite(spread) else 0.0
        has_total = math.isfinite(gains.damping.total95[0])
        stiffness_range = _reach(gains.stiffness, spread)
        damping_range = _reach(gains.damping, 0.0 if has_total else spread)
        shared = _correlation(gains) * stiffness_range * damping_range
        draws[joint.name] = GroupGains(
            stiffness=gains.stiffness.value,
            damping=gains.damping.value,
            stiffness_range=stiffness_range,
            damping_range=damping_range,
            frictionloss=gains.frictionloss.value,
            ellipsoid=((stiffness_range**2, shared), (shared, damping_range**2)),
            ellipsoid_center=(gains.stiffness.value, gains.damping.value),
        )
    return draws


def _reach(gain: FittedValue, spread: float) -> float:
    """Return the half-width of a joint's gain, by its intervals and a relative spread."""
    low, high = _known_interval(gain)
    reach = max(high - gain.value, gain.value - low)
    reach = max(reach, spread * gain.value, LEAST_SHARE * gain.value)
    return min(reach, (1.0 - LOWEST_OF_GAIN) * gain.value)


def _correlation(gains: JointGains) -> float:
    """Return the correlation of a joint's stiffness and damping; 0 where it is not known."""
    covariance = np.array(gains.covariance)
    variances = np.diag(covariance)
    if not (np.isfinite(covariance).all() and (variances > 0.0).all()):
        return 0.0
    correlation = float(covariance[0, 1] / np.sqrt(variances.prod()))
    return min(max(correlation, -HIGHEST_CORRELATION), HIGHEST_CORRELATION)


def _known_interval(fitted: FittedValue) -> Interval:
    """Return the total interval of a value, that by repeats, or the value alone."""
    for low, high in (fitted.total95, fitted.repeat95):
        if math.isfinite(low) and math.isfinite(high):
            return min(low, fitted.value), max(high, fitted.value)
    return fitted.value, fitted.value


def _friction_span(gains: JointGains, joint: Joint) -> Interval:
    """Return the lowest and the highest dry friction of a joint [N m]."""
    if math.isnan(gains.frictionloss.value):
        return joint.drive.frictionloss, joint.drive.frictionloss
    low, high = _known_interval(gains.frictionloss)
    return max(low, 0.0), high


def _delay_span(matched: MatchedGains) -> Interval:
    """Return the shortest and the longest command delay by the intervals of all joints [s]."""
    ends: list[float] = []
    for joint in matched.joints.values():
        ends += _known_interval(joint.delay_s)
    return max(min(ends), 0.0), max(ends)


def _nominal_gains(robot: RobotSpec, group: str) -> GroupGains:
    """Return the gains of a group's real drives, with the paper's ranges."""
    pairs = {(joint.stiffness, joint.damping) for joint in robot.group(group)}
    if len(pairs) > 1:
        raise PronkError(
            f"the joints of {robot.name}'s group {group} have different gains on their drives; "
            "training with nominal gains needs one pair a group."
        )
    stiffness, damping = pairs.pop()
    return GroupGains(
        stiffness=stiffness,
        damping=damping,
        stiffness_range=NAIVE_STIFFNESS_RANGE,
        damping_range=NAIVE_DAMPING_RANGE,
        ellipsoid_center=(stiffness, damping),
    )


def _moved_ranges(nominal: GroupGains, ranges: GroupGains) -> GroupGains:
    """Move the ranges of one group to the nominal gains of another."""
    stiffness_center, damping_center = ranges.ellipsoid_center
    stiffness_shift = nominal.stiffness - ranges.stiffness
    damping_shift = nominal.damping - ranges.damping
    return replace(
        ranges,
        stiffness=nominal.stiffness,
        damping=nominal.damping,
        frictionloss=nominal.frictionloss,
        ellipsoid_center=(stiffness_center + stiffness_shift, damping_center + damping_shift),
    )


def _matched_gains(path: Path, robot: RobotSpec) -> MatchedGains:
    """Read a `gains.yaml` for this robot and the training simulator."""
    gains = load_gains(path)
    if gains.robot != robot.name:
        raise ArtefactError(
            f"{path}: gains of {gains.robot}; training {robot.name} needs gains of {robot.name}, "
            "or the choice 'naive'."
        )
    # Gains hold for the simulator that they were matched in, and for no other.
    training_simulator = _simulator_settings(mujoco_info(robot))
    gains_simulator = _simulator_settings(gains.simulator)
    differing = []
    for name, value in training_simulator.items():
        if gains_simulator[name] != value:
            differing.append(name)
    if differing:
        has = ", ".join(f"{name} {gains_simulator[name]}" for name in differing)
        needs = ", ".join(f"{name} {training_simulator[name]}" for name in differing)
        raise ArtefactError(
            f"{path}: gains matched in a simulator with {has}; training uses {needs}, where they "
            "mean another joint: match the logs again with this pronk, or `pronk translate` them."
        )
    missing = [group for group in robot.groups if group not in gains.groups]
    if missing:
        raise ArtefactError(
            f"{path}: no training gains for {', '.join(missing)}; match logs of every joint group "
            f"({', '.join(robot.groups)}) in one run of `pronk match`."
        )
    if not gains.joints:
        raise ArtefactError(f"{path}: no joints, so no command delay; `pronk match` writes them.")
    return gains


def _simulator_settings(info: SimulatorInfo) -> dict[str, Any]:
    """Return what gains depend on: all but the patch of the version, which keeps the physics."""
    settings = asdict(info)
    settings["version"] = ".".join(info.version.split(".")[:2])
    settings["profile"] = ""
    return settings
