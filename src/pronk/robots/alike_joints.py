"""Joints of a bare model that are built alike, by their names and numbers: those of all its legs.

A joint of a leg or a side is called by that leg or side and by its place there, as FL_calf_joint or
left_elbow. Joints of the same place share a group where the model says the same of them; where it
says nothing, what is assumed of them differs by little, as by the torque of gravity in the pose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set

from pronk.robots.leg_names import LEG_NAMES
from pronk.robots.load import DriveEntry, GroupEntry, RobotFile

SIDES = (*LEG_NAMES, "left", "right", "Left", "Right", "LEFT", "RIGHT", "l", "r", "L", "R")
"""What the name of a joint begins with, before an underscore."""
SAME_READ = 1e-6
"""Largest difference of numbers that a model states, as a share of the larger one."""
SAME_ASSUMED = 0.05
"""Largest difference of numbers that are assumed, as a share of the larger one."""
QUADRUPED_LEGS = 4
"""Number of legs that are named in the file."""


def place_on_side(joint: str) -> str:
    """Return the name of a joint without the leg or side that it begins with; empty without one."""
    side, _, place = joint.partition("_")
    return place if side in SIDES else ""


def alike_joints(
    file: RobotFile, joint_names: Sequence[str], assumed: Mapping[str, Set[str]]
) -> dict[str, tuple[str, ...]]:
    """Return the joints of each group of a file, by the name of the group.

    Args:
        file: A robot whose driven joints have a group and a drive each, of their own name.
        joint_names: All joints of the model, also those that are held.
        assumed: The numbers of each driven joint that are assumed, without its pose.

    Returns:
        Groups of two joints or more are called by the place of their joints, as `calf_joint`, and
        the pattern `*_calf_joint` matches these joints and no other one. All other joints are alone
        in a group of their own name.
    """
    by_place: dict[str, list[str]] = {}
    for joint in file.groups:
        by_place.setdefault(place_on_side(joint), []).append(joint)
    groups: dict[str, tuple[str, ...]] = {}
    for joint in file.groups:
        place = place_on_side(joint)
        members = by_place[place]
        matched = [name for name in joint_names if name.endswith(f"_{place}")]
        is_group = (
            place not in ("", *joint_names)
            and len(members) > 1
            and sorted(matched) == sorted(members)
            and all(_is_alike(file, members[0], member, assumed) for member in members)
        )
        if is_group:
            groups[place] = tuple(members)
        else:
            groups[joint] = (joint,)
    return groups


def quadruped_legs(groups: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    """Return the prefixes of four legs, in the order of the model; empty for any other robot.

    Args:
        groups: The joints of each group, as of `alike_joints`.
    """
    legs: list[tuple[str, ...]] = []
    for members in groups.values():
        if len(members) == QUADRUPED_LEGS:
            legs.append(tuple(joint.partition("_")[0] for joint in members))
    is_quadruped = len(set(legs)) == 1 and set(legs[0]) <= set(LEG_NAMES)
    return legs[0] if is_quadruped else ()


def _is_alike(file: RobotFile, first: str, second: str, assumed: Mapping[str, Set[str]]) -> bool:
    """Return whether the model says the same of two joints, and assumed numbers are close."""
    if file.groups[first].servo != file.groups[second].servo or assumed[first] != assumed[second]:
        return False
    for number, value in _numbers_of(file.groups[first], file.drives[first]).items():
        other = _numbers_of(file.groups[second], file.drives[second])[number]
        share = SAME_ASSUMED if number in assumed[first] else SAME_READ
        if abs(value - other) > share * max(abs(value), abs(other)):
            return False
    return True


def _numbers_of(group: GroupEntry, drive: DriveEntry) -> dict[str, float]:
    """Return the numbers of a joint that a model may say, by their name in the file."""
    return {
        "stiffness": group.stiffness or 0.0,
        "damping": group.damping or 0.0,
        "effort_limit": drive.effort_limit,
        "stall_torque": drive.stall_torque or 0.0,
        "no_load_speed": drive.no_load_speed or 0.0,
        "armature": drive.armature or 0.0,
        "frictionloss": drive.frictionloss,
        "viscous_damping": drive.viscous_damping,
    }
