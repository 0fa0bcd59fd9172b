"""TrainingGains: the gains that training draws about, from `gains.yaml` or the naive ones.

Naive gains are those of the real drives, put into the simulator as they are (paper S4, reading
A20). Everything else stays the same, so that two policies differ by their nominal gains alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

from pronk.errors import ArtefactError, PronkError
from pronk.files import sha256
from pronk.identify.match.gains import GroupGains, MatchedGains, load_gains
from pronk.identify.simulators.mujoco import mujoco_info
from pronk.robots.robot import RobotSpec

NAIVE = "naive"
"""The choice of gains that needs no file."""
NAIVE_STIFFNESS_RANGE = 2.0
"""Half-width of the randomization of naive stiffness [N m/rad] (paper D3)."""
NAIVE_DAMPING_RANGE = 0.05
"""Half-width of the randomization of naive damping [N m s/rad] (paper D4)."""

GainsName = Literal["naive", "matched"]


@dataclass(frozen=True, kw_only=True)
class TrainingGains:
    """Nominal gains and their ranges by joint group, and their origin."""

    name: GainsName
    robot: str
    groups: Mapping[str, GroupGains]
    """In the robot's order of groups."""
    delay_s: float = 0.0
    """Command delay of the real joint beyond the simulator's, mean of the joints [s]."""
    sha256: str = ""
    """Hash of the `gains.yaml` that nominals or ranges come from; empty without one."""
    virtual: bool = False
    """True if that file rests on pronk's virtual robot."""

    def __post_init__(self) -> None:
        """Refuse ranges that reach zero, and a negative delay."""
        for group, gains in self.groups.items():
            for what in ("stiffness", "damping"):
                nominal, half = getattr(gains, what), getattr(gains, f"{what}_range")
                if not 0.0 <= half < nominal:
                    raise PronkError(
                        f"{what} of {group} is {nominal:g} +- {half:g}; training needs a range "
                        "that is not negative and stays above zero."
                    )
        if not (math.isfinite(self.delay_s) and self.delay_s >= 0.0):
            raise PronkError(f"the command delay is {self.delay_s} s; it must be 0 or more.")


def training_gains(
    choice: str | Path, robot: RobotSpec, *, like: Path | None = None
) -> TrainingGains:
    """The gains to train with: `naive`, or those of a `gains.yaml` for this robot and simulator.

    `like` is a `gains.yaml` whose ranges and delay are used about the naive nominals, its
    ellipsoids moved along (reading A20). Without it the ranges of naive gains are the paper's (D3,
    D4) and the delay is 0.
    """
    naive = str(choice) == NAIVE
    if like is not None and not naive:
        raise PronkError(
            f"ranges like {like} were requested with the gains of {choice}; "
            "they go with the choice 'naive' only, a gains.yaml has its own."
        )
    groups = {group: _naive(robot, group) for group in robot.groups} if naive else {}
    if naive and like is None:
        return TrainingGains(name="naive", robot=robot.name, groups=groups)
    path = like or Path(choice)
    matched = _matched(path, robot)
    for group in robot.groups:
        own = matched.groups[group]
        groups[group] = _about(groups[group], own) if naive else own
    delays = [joint.delay_s.value for joint in matched.joints.values()]
    return TrainingGains(
        name="naive" if naive else "matched",
        robot=robot.name,
        groups=groups,
        delay_s=math.fsum(delays) / len(delays),
        sha256=sha256(path),
        virtual=matched.virtual,
    )


def _naive(robot: RobotSpec, group: str) -> GroupGains:
    pairs = {(joint.stiffness, joint.damping) for joint in robot.group(group)}
    if len(pairs) > 1:
        raise PronkError(
            f"the joints of {robot.name}'s group {group} have different gains on their drives; "
            "naive training needs one pair a group."
        )
    stiffness, damping = pairs.pop()
    return GroupGains(
        stiffness=stiffness,
        damping=damping,
        stiffness_range=NAIVE_STIFFNESS_RANGE,
        damping_range=NAIVE_DAMPING_RANGE,
        ellipsoid_center=(stiffness, damping),
    )


def _about(nominal: GroupGains, ranges: GroupGains) -> GroupGains:
    """The ranges of one group about the nominal gains of another."""
    center = ranges.ellipsoid_center
    return replace(
        ranges,
        stiffness=nominal.stiffness,
        damping=nominal.damping,
        frictionloss=nominal.frictionloss,
        ellipsoid_center=(
            center[0] + (nominal.stiffness - ranges.stiffness),
            center[1] + (nominal.damping - ranges.damping),
        ),
    )


def _matched(path: Path, robot: RobotSpec) -> MatchedGains:
    gains = load_gains(path)
    if gains.robot != robot.name:
        raise ArtefactError(
            f"{path}: gains of {gains.robot}; training {robot.name} needs gains of {robot.name}, "
            "or the choice 'naive'."
        )
    # Gains hold for the simulator that they were matched in, and for no other; patches of MuJoCo
    # keep its physics.
    used, got = (
        asdict(info) | {"version": ".".join(info.version.split(".")[:2]), "profile": ""}
        for info in (mujoco_info(robot), gains.simulator)
    )
    differing = [name for name in used if got[name] != used[name]]
    if differing:
        has, needs = (
            ", ".join(f"{name} {info[name]}" for name in differing) for info in (got, used)
        )
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
