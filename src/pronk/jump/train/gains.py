"""The gains that training draws about: those of a `gains.yaml`, or the nominal gains.

Nominal gains are those of the real drives, put into the simulator as they are (reading A20 of S4);
the paper calls such a policy naive. Everything else stays the same, so that two policies differ by
the gains alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from pronk.errors import ArtefactError, PronkError
from pronk.files import sha256
from pronk.identify.match.gains import (
    GroupGains,
    MatchedGains,
    load_gains,
    require_matched,
)
from pronk.identify.simulators.info import SimulatorInfo, mujoco_info
from pronk.robots.robot import RobotSpec

NAIVE = "naive"
"""The choice of the nominal gains, which needs no file."""
NAIVE_STIFFNESS_RANGE = 2.0
"""Half-width of the randomization of the nominal stiffness [N m/rad] (paper D3)."""
NAIVE_DAMPING_RANGE = 0.05
"""Half-width of the randomization of the nominal damping [N m s/rad] (paper D4)."""

GainsName = Literal["naive", "matched"]


@dataclass(frozen=True, kw_only=True)
class TrainingGains:
    """Gains and their ranges by joint group, and their origin."""

    name: GainsName
    robot: str
    groups: Mapping[str, GroupGains]
    """Gains of each joint group, in the robot's order of groups."""
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
        for group, gains in self.groups.items():
            _check_range(f"stiffness of {group}", gains.stiffness, gains.stiffness_range)
            _check_range(f"damping of {group}", gains.damping, gains.damping_range)
        if not (math.isfinite(self.delay_s) and self.delay_s >= 0.0):
            raise PronkError(f"the command delay is {self.delay_s} s; it must be 0 or more.")


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
) -> TrainingGains:
    """Return the gains to train with.

    Args:
        choice: `naive` for the nominal gains, or a `gains.yaml` for this robot and simulator.
        robot: The robot.
        like: A `gains.yaml` whose ranges and delay are used about the nominal gains, its
            ellipsoids moved along (reading A20). Without it their ranges are the paper's (D3, D4)
            and the delay is 0.
        allow_unmatched: Accept a file with joints that are no match.

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
    return TrainingGains(
        name="naive" if is_naive else "matched",
        robot=robot.name,
        groups=groups,
        delay_s=math.fsum(delays) / len(delays),
        sha256=sha256(path),
        virtual=matched.virtual,
        unmatched=matched.unmatched,
    )


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
