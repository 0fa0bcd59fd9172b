"""The actuators that an export writes: joint groups, or single joints, with their parameters."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from pronk.errors import PronkError, RobotError
from pronk.identify.match.gains import JointGains, MatchedGains
from pronk.identify.match.ranges import gain_and_range
from pronk.identify.simulators.profiles import Profile, load_profiles, profile_of
from pronk.robots import load_robot
from pronk.robots.menagerie import MENAGERIE
from pronk.robots.robot import Drive, Joint, RobotSpec

Per = Literal["group", "joint"]
"""Whether an actuator is a joint group or one joint."""


@dataclass(frozen=True, kw_only=True)
class Actuator:
    """Joints with the same parameters: a joint group, or one joint."""

    name: str
    """Name of the group or of the joint."""
    joints: tuple[str, ...]
    """Names of the joints in pronk."""
    maker_joints: tuple[str, ...]
    """Names of the same joints in the models of the robot's maker."""
    unmatched: tuple[str, ...]
    """Joints without a match of their own, which have the gains of their group."""
    no_match: Mapping[str, tuple[str, ...]]
    """Joints that are no match, with the reasons."""
    stiffness: float
    """Stiffness [N m/rad]."""
    damping: float
    """Damping [N m s/rad]."""
    stiffness_range: tuple[float, float]
    """Lowest and highest stiffness of the uniform randomization [N m/rad]."""
    damping_range: tuple[float, float]
    """Lowest and highest damping of the uniform randomization, 0 or more [N m s/rad]."""
    armature: float
    """Rotor inertia at the joint [kg m^2]."""
    frictionloss: float
    """Dry friction at rest [N m]."""
    stribeck: float
    """Share of the dry friction that motion takes away, 0 to 1."""
    delay_s: float
    """Delay of the command [s]."""
    drive: Drive
    """Limits and viscous friction of the drive."""

    def quantities(self) -> dict[str, float]:
        """Return what a simulator can be given of the actuator, by name, in SI units."""
        viscous_damping = self.drive.viscous_damping
        return {
            "stiffness": self.stiffness,
            "damping": self.damping,
            "armature": self.armature,
            "frictionloss": self.frictionloss,
            "viscous_damping": viscous_damping,
            "effort_limit": self.drive.effort_limit,
            "stall_torque": self.drive.stall_torque,
            "no_load_speed": self.drive.no_load_speed,
            # Dry friction in motion [N m].
            "sliding_friction": self.frictionloss * (1.0 - self.stribeck),
            # For an engine with one parameter for damping and viscous friction [N m s/rad].
            "all_damping": self.damping + viscous_damping,
            # Viscous friction per degree [N m s/degree].
            "viscous_per_degree": math.radians(viscous_damping),
        }


def exported_actuators(gains: MatchedGains, robot: RobotSpec, per: Per = "group") -> list[Actuator]:
    """List the matched groups, or the joints of these groups, in the robot's order.

    Args:
        gains: Matched gains.
        robot: The robot that they were matched for.
        per: `group` for an actuator with the gains and ranges of each group; `joint` for one with
            those of each joint, or of its group where the joint was not matched.

    Returns:
        Actuators. A group has the means of its joints for armature, friction and delay.

    Raises:
        PronkError: The gains are of another robot, or hold no group.
    """
    if gains.robot != robot.name:
        raise PronkError(
            f"the gains are those of {gains.robot}, not of {robot.name}; give the robot that they "
            "were matched for (--robot)."
        )
    if not gains.groups:
        raise PronkError(
            f"the gains of {gains.robot} hold no joint group; match some joints first."
        )
    actuators = []
    for group in robot.groups:
        if group not in gains.groups:
            continue
        members = robot.group(group)
        if per == "group":
            actuators.append(_group_actuator(gains, group, members))
        else:
            for joint in members:
                actuators.append(_joint_actuator(gains, joint, members))
    return actuators


def _group_actuator(gains: MatchedGains, group: str, members: Sequence[Joint]) -> Actuator:
    """Return the actuator of a whole group."""
    group_gains = gains.groups[group]
    return _actuator(
        gains,
        name=group,
        joints=members,
        gain_pair=(group_gains.stiffness, group_gains.damping),
        half_widths=(group_gains.stiffness_range, group_gains.damping_range),
        sources=_matched_gains(gains, members),
    )


def _joint_actuator(gains: MatchedGains, joint: Joint, members: Sequence[Joint]) -> Actuator:
    """Return the actuator of one joint of a group; of its group if it was not matched."""
    group_gains = gains.groups[joint.group]
    gain_pair = (group_gains.stiffness, group_gains.damping)
    half_widths = (group_gains.stiffness_range, group_gains.damping_range)
    sources = _matched_gains(gains, members)
    if joint.name in gains.joints:
        joint_gains = gains.joints[joint.name]
        gain_pair = (joint_gains.stiffness.value, joint_gains.damping.value)
        _, stiffness_range = gain_and_range([joint_gains.stiffness])
        _, damping_range = gain_and_range([joint_gains.damping])
        half_widths = (stiffness_range, damping_range)
        sources = [joint_gains]
    return _actuator(
        gains,
        name=joint.name,
        joints=[joint],
        gain_pair=gain_pair,
        half_widths=half_widths,
        sources=sources,
    )


def _matched_gains(gains: MatchedGains, joints: Sequence[Joint]) -> list[JointGains]:
    """Return the gains of those joints that are a match; where none is, of all that were fitted."""
    fitted = [gains.joints[joint.name] for joint in joints if joint.name in gains.joints]
    return [joint_gains for joint_gains in fitted if joint_gains.matched] or fitted


def _actuator(
    gains: MatchedGains,
    *,
    name: str,
    joints: Sequence[Joint],
    gain_pair: tuple[float, float],
    half_widths: tuple[float, float],
    sources: Sequence[JointGains],
) -> Actuator:
    """Return an actuator with a pair of gains, and the mean of what else the sources have.

    Args:
        gains: Matched gains.
        name: Name of the actuator.
        joints: Its joints.
        gain_pair: Stiffness [N m/rad] and damping [N m s/rad].
        half_widths: Half-widths of the ranges of both, in the same units.
        sources: Matched gains that armature, friction and delay are the means of.
    """
    stiffness, damping = gain_pair
    drive = joints[0].drive
    names = []
    maker_names = []
    unmatched = []
    no_match = {}
    for joint in joints:
        names.append(joint.name)
        maker_names.append(joint.own_name or joint.name)
        if joint.name not in gains.joints:
            unmatched.append(joint.name)
        elif joint.name in gains.unmatched:
            no_match[joint.name] = gains.unmatched[joint.name]
    armatures = []
    frictions = []
    stribecks = []
    delays_s = []
    for source in sources:
        armatures.append(source.armature.value)
        stribecks.append(source.stribeck.value)
        delays_s.append(source.delay_s.value)
        if not math.isnan(source.frictionloss.value):
            frictions.append(source.frictionloss.value)
    return Actuator(
        name=name,
        joints=tuple(names),
        maker_joints=tuple(maker_names),
        unmatched=tuple(unmatched),
        no_match=no_match,
        stiffness=stiffness,
        damping=damping,
        stiffness_range=_range_about(stiffness, half_widths[0]),
        damping_range=_range_about(damping, half_widths[1]),
        armature=_mean(armatures, drive.armature),
        frictionloss=_mean(frictions, drive.frictionloss),
        stribeck=_mean(stribecks, 0.0),
        delay_s=_mean(delays_s, 0.0),
        drive=drive,
    )


def _mean(values: Sequence[float], default: float) -> float:
    """Return the mean of some values, or a default without any."""
    return float(np.mean(values)) if values else default


def _range_about(middle: float, half_width: float) -> tuple[float, float]:
    """Return the ends of a range, 0 or more, free of the last binary digits."""
    return round(max(middle - half_width, 0.0), 9), round(middle + half_width, 9)


def profile_held(gains: MatchedGains) -> Profile:
    """Return the profile of the framework that gains hold for.

    Raises:
        PronkError: Their simulator has none; the message names the profiles.
    """
    try:
        return profile_of(gains.simulator)
    except PronkError:
        raise PronkError(
            f"the gains hold for simulator {gains.simulator.engine}, whose drive law pronk does "
            f"not know; match with --for NAME, one of {', '.join(load_profiles())}."
        ) from None


def robot_of(gains: MatchedGains) -> RobotSpec:
    """Load the robot of some gains, from its file or by its name.

    Raises:
        PronkError: The file is not there any more, or there is no robot of that name.
        RobotError: The file cannot be read.
    """
    if gains.robot_path:
        named = gains.robot_path.startswith(MENAGERIE)
        if not named and not Path(gains.robot_path).is_file():
            raise PronkError(
                f"the robot of the gains was {gains.robot_path}, which is not there; give "
                "--robot PATH, the robot.yaml or model that they were matched with."
            )
        return load_robot(gains.robot_path)
    try:
        return load_robot(gains.robot)
    except RobotError:
        raise PronkError(
            f"the robot {gains.robot!r} of the gains is none that pronk knows by name; give "
            "--robot PATH, the robot.yaml or model that they were matched with."
        ) from None
