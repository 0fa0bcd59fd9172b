"""What the training task reads of a quadruped's model, and what of it a model lacks.

The task finds joints, feet and limbs by their names, and takes from the model that all legs hang
straight down where their joints are at zero, that left and right have the same axes, and that
nothing but the named parts touches the ground. A model that differs would train all the same, with
wrong lengths, a wrong mirror image or contacts that count for nothing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from pronk.arrays import Array
from pronk.errors import RobotError
from pronk.robots.leg_names import PLACES
from pronk.robots.legged import (
    HIP_PITCH,
    HIP_ROLL,
    KNEE,
    default_pose,
    hips,
    joints_of_leg,
    opposite_legs,
    posed,
)
from pronk.robots.robot import RobotSpec

LEG_JOINTS = ("hip roll", "hip pitch", "knee")
"""Joints of a leg from the hip down, in words."""
LEG_PARTS = ("thigh_collision", "shank_collision", "foot_collision")
"""Geoms of a leg that touch the ground, without the prefix."""
TRUNK = "trunk_collision"
"""Geom of the trunk."""
STRAIGHT = 0.05
"""Largest angle between a thigh or a shank and the vertical with all joints at zero [rad]."""
PARALLEL = 0.999
"""Smallest cosine of the angle between an axis and that of the trunk which it has to be."""
CENTRE = 1e-3
"""Largest distance of a foot's site from the centre of its sphere [m]."""
BENT = 0.1
"""Smallest angle of a knee in the default pose, of which the side that it bends to is read
[rad]."""
SAME_POSE = 1e-3
"""Largest difference of a left and a right joint in the default pose [rad]."""
SAME_HIP = 0.01
"""Largest distance of a hip from the mirror image of the one on the other side [m]."""
STEADY = 0.15
"""Smallest distance of the centre of mass from the foremost and from the hindmost foot, as a share
of the distance between these."""
PAGE = "docs/train-your-robot.md"
"""Page that has these rules."""


def require_quadruped(robot: RobotSpec) -> None:
    """Refuse a robot that the training task would read wrongly.

    Args:
        robot: The robot.

    Raises:
        RobotError: Something is missing; the message names all of it.
    """
    problems = quadruped_problems(robot)
    if problems:
        raise RobotError(
            f"{robot.source or robot.name} cannot be trained: {'; '.join(problems)}. {PAGE} says "
            "what a model must have."
        )


def quadruped_problems(robot: RobotSpec) -> list[str]:
    """List what the training task needs and a robot lacks, a clause each.

    Places and axes are looked at only where all names are there.

    Args:
        robot: The robot.
    """
    problems = _leg_problems(robot)
    if problems:
        return problems
    model = robot.build_spec().compile()
    problems = [*_group_problems(robot), *_name_problems(robot, model)]
    if problems:
        return problems
    opposite = opposite_legs(robot, model)
    at_zero, to_trunk = posed(robot, model, dict.fromkeys(robot.joint_names, 0.0))
    problems = [
        *_shape_problems(robot, model),
        *_axis_problems(robot, at_zero, to_trunk),
        *_side_problems(robot, model, opposite),
        *_straightness_problems(robot, at_zero, to_trunk),
        *_contact_problems(robot, model),
        *_pose_problems(robot, opposite),
    ]
    if not problems:
        problems = _balance_problems(robot, model)
    return problems


def _leg_problems(robot: RobotSpec) -> list[str]:
    """List what is wrong about the legs and the names of their joints."""
    if not robot.legs:
        return [
            "it has no legs, and the task is one of a quadruped; if it is one, name the prefixes "
            "of its joints in its robot.yaml, as in legs: [FR, FL, RR, RL]"
        ]
    legs = ", ".join(robot.legs)
    if len(robot.legs) != 4:
        return [f"its legs are {legs}; expected four, as FR, FL, RR and RL or LF, RF, LH and RH"]
    names = robot.joint_names
    first_joints = joints_of_leg(robot, robot.legs[0])
    rule = (
        f"expected {', '.join(LEG_JOINTS)} of each leg in this order, leg by leg, and called alike "
        "behind the prefix"
    )
    remedy = "rename the joints in the model, and hold others by `held` in its robot.yaml"
    if len(first_joints) != len(LEG_JOINTS):
        return [
            f"the joints of its leg {robot.legs[0]} are {', '.join(first_joints)}; {rule}: {remedy}"
        ]
    suffixes = _suffixes(robot)
    expected = _leg_by_leg(robot.legs, suffixes)
    if names == expected:
        return []
    if sorted(names) == sorted(expected):
        order = sorted(robot.legs, key=lambda leg: names.index(f"{leg}_{suffixes[0]}"))
        if names == _leg_by_leg(order, suffixes):
            return [
                f"the model has its legs in the order {', '.join(order)}, and `legs` in its "
                f"robot.yaml says {legs}; give them in the order of the model"
            ]
    return [f"its joints are {', '.join(names)}; {rule}, as {', '.join(expected)}: {remedy}"]


def _suffixes(robot: RobotSpec) -> list[str]:
    """Return the names of the joints of the first leg without its prefix."""
    leg = robot.legs[0]
    return [name.removeprefix(f"{leg}_") for name in joints_of_leg(robot, leg)]


def _leg_by_leg(legs: Sequence[str], suffixes: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the joints of all legs, one leg after the other."""
    names = []
    for leg in legs:
        for suffix in suffixes:
            names.append(f"{leg}_{suffix}")
    return tuple(names)


def _group_problems(robot: RobotSpec) -> list[str]:
    """Say which joint groups are not the four joints of one kind.

    Training reads gains group by group, and takes each as that of one joint of all legs.
    """
    kinds = []
    for number in range(len(LEG_JOINTS)):
        kinds.append(tuple(joints_of_leg(robot, leg)[number] for leg in robot.legs))
    groups = []
    for group in robot.groups:
        groups.append(tuple(joint.name for joint in robot.group(group)))
    if groups == kinds:
        return []
    patterns = []
    for suffix in _suffixes(robot):
        patterns.append(f'{suffix}: {{joints: "*_{suffix}", ...}}')
    return [
        f"its joint groups are {', '.join(robot.groups)}; expected three, each with one joint of "
        f"all legs from the hip down, as in groups: {', '.join(patterns)}"
    ]


def _name_problems(robot: RobotSpec, model: mujoco.MjModel) -> list[str]:
    """List the sites and geoms that are missing, and a base that cannot move."""
    problems = []
    if mujoco.mjtJoint.mjJNT_FREE not in model.jnt_type:
        problems.append("the base is fixed; give the trunk's body a <freejoint/>")
    sites = [f"{leg}_foot" for leg in robot.legs]
    missing_sites = _missing(model, mujoco.mjtObj.mjOBJ_SITE, sites)
    if missing_sites:
        problems.append(f"the model has no site {', '.join(missing_sites)}")
    missing_geoms = _missing(model, mujoco.mjtObj.mjOBJ_GEOM, _parts(robot))
    if missing_geoms:
        problems.append(f"the model has no geom {', '.join(missing_geoms)}")
    return problems


def _missing(model: mujoco.MjModel, kind: mujoco.mjtObj, names: Sequence[str]) -> list[str]:
    """Return the names that no element of a kind has."""
    return [name for name in names if mujoco.mj_name2id(model, kind, name) < 0]


def _parts(robot: RobotSpec) -> list[str]:
    """Return the names of the geoms that touch the ground."""
    parts = [TRUNK]
    for leg in robot.legs:
        for part in LEG_PARTS:
            parts.append(f"{leg}_{part}")
    return parts


def _shape_problems(robot: RobotSpec, model: mujoco.MjModel) -> list[str]:
    """List feet that are no spheres on the shank, and shanks that are no capsules along z."""
    other_feet = []
    other_sites = []
    other_shanks = []
    for leg in robot.legs:
        shank_body = model.joint(joints_of_leg(robot, leg)[KNEE]).bodyid[0]
        foot = model.geom(f"{leg}_foot_collision")
        site = model.site(f"{leg}_foot")
        is_sphere = foot.type[0] == mujoco.mjtGeom.mjGEOM_SPHERE
        if not is_sphere or foot.bodyid[0] != shank_body:
            other_feet.append(foot.name)
        elif site.bodyid[0] != shank_body or np.linalg.norm(site.pos - foot.pos) > CENTRE:
            other_sites.append(site.name)
        shank = model.geom(f"{leg}_shank_collision")
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, shank.quat)
        is_capsule = shank.type[0] == mujoco.mjtGeom.mjGEOM_CAPSULE
        if not is_capsule or shank.bodyid[0] != shank_body or abs(turn[8]) < PARALLEL:
            other_shanks.append(shank.name)
    problems = []
    if other_feet:
        problems.append(
            f"{', '.join(other_feet)}: expected a sphere of the body that the knee turns; a foot "
            "with a body of its own has to go into it"
        )
    if other_sites:
        problems.append(f"{', '.join(other_sites)}: expected a site at the centre of the foot")
    if other_shanks:
        problems.append(
            f"{', '.join(other_shanks)}: expected a capsule along the z axis of the body that the "
            "knee turns, since training changes its length"
        )
    return problems


def _axis_problems(robot: RobotSpec, data: mujoco.MjData, to_trunk: Array) -> list[str]:
    """List axes that are not the trunk's, or not those of the other legs.

    Args:
        robot: The robot.
        data: Its kinematics with all joints at zero.
        to_trunk: Axes of the trunk as rows, (3, 3).
    """
    model = data.model
    problems = []
    suffixes = _suffixes(robot)
    signs: dict[str, dict[str, float]] = {suffix: {} for suffix in suffixes}
    for leg in robot.legs:
        for number, name in enumerate(joints_of_leg(robot, leg)):
            direction = 0 if number == HIP_ROLL else 1
            component = float((to_trunk @ data.xaxis[model.joint(name).id])[direction])
            if abs(component) < PARALLEL:
                problems.append(
                    f"{name} does not turn about the trunk's {'xy'[direction]} axis with all "
                    "joints at zero"
                )
            signs[suffixes[number]][leg] = math.copysign(1.0, component)
    if problems:
        return [*problems, "the trunk's x axis has to point forwards and its z axis upwards"]
    for suffix, sign_of_leg in signs.items():
        if len(set(sign_of_leg.values())) > 1:
            positive = [leg for leg, sign in sign_of_leg.items() if sign > 0.0]
            negative = [leg for leg, sign in sign_of_leg.items() if sign < 0.0]
            problems.append(
                f"the axes of *_{suffix} differ in sign, + for {', '.join(positive)} and - for "
                f"{', '.join(negative)}; expected one sign for all legs"
            )
    pitch = suffixes[HIP_PITCH]
    knee = suffixes[KNEE]
    if not problems and signs[pitch] != signs[knee]:
        problems.append(
            f"the axes of *_{pitch} and *_{knee} have opposite signs; expected the same sign"
        )
    return problems


def _side_problems(
    robot: RobotSpec, model: mujoco.MjModel, opposite: Mapping[str, str]
) -> list[str]:
    """List hips that are no mirror images, and legs that are not where their names say."""
    places = hips(robot, model)
    hip_texts = []
    for leg, place in places.items():
        hip_texts.append(f"{leg} at x = {place[0]:.3f}, y = {place[1]:.3f} m")
    text = f"the hips are in the trunk's frame at zero: {'; '.join(hip_texts)}"
    if not opposite:
        return [f"{text}; expected two on its left, of larger y, and two on its right"]
    for leg, opposite_leg in opposite.items():
        image = places[opposite_leg] * (1.0, -1.0, 1.0)
        if np.linalg.norm(places[leg] - image) > SAME_HIP:
            return [f"{text}; expected those of {leg} and {opposite_leg} to be mirror images"]
    middle = float(np.mean([place[0] for place in places.values()]))
    misplaced = []
    for leg, place in places.items():
        end = "front" if place[0] > middle else "rear"
        side = "left" if place[1] > 0.0 else "right"
        if PLACES.get(leg.upper(), (end, side)) != (end, side):
            misplaced.append(f"{leg} is the {end} {side} leg")
    if misplaced:
        return [
            f"{text}: {', '.join(misplaced)}; the trunk's x axis has to point forwards and its "
            "y axis to the left"
        ]
    return []


def _straightness_problems(robot: RobotSpec, data: mujoco.MjData, to_trunk: Array) -> list[str]:
    """List legs that do not hang straight down with all joints at zero.

    Args:
        robot: The robot.
        data: Its kinematics with all joints at zero.
        to_trunk: Axes of the trunk as rows, (3, 3).
    """
    model = data.model
    bent = []
    for leg in robot.legs:
        joints = joints_of_leg(robot, leg)
        hip = data.xanchor[model.joint(joints[HIP_PITCH]).id]
        knee = data.xanchor[model.joint(joints[KNEE]).id]
        foot = data.geom_xpos[model.geom(f"{leg}_foot_collision").id]
        for part, upper, lower in (("thigh", hip, knee), ("shank", knee, foot)):
            x, _, z = to_trunk @ (lower - upper)
            angle = math.atan2(abs(x), -z)
            if angle > STRAIGHT:
                bent.append(f"the {part} of {leg} is {angle:.2f} rad off")
    if not bent:
        return []
    return [
        f"with all joints at zero {', '.join(bent)}; expected legs that hang straight down there: "
        "turn the bodies in the model, so that its joints are zero there"
    ]


def _contact_problems(robot: RobotSpec, model: mujoco.MjModel) -> list[str]:
    """List parts that touch no floor or one another, and whatever else collides.

    A floor has 1 as its contype and as its conaffinity.
    """
    parts = _parts(robot)
    others = []
    through = []
    among_themselves = []
    for index in range(model.ngeom):
        geom = model.geom(index)
        touches_floor = bool((geom.contype[0] | geom.conaffinity[0]) & 1)
        if geom.name not in parts:
            if touches_floor:
                others.append(geom.name or f"one of the body {model.body(geom.bodyid[0]).name}")
        elif not touches_floor:
            through.append(geom.name)
        elif geom.contype[0] & 1:
            among_themselves.append(geom.name)
    problems = []
    if through:
        problems.append(
            f'{", ".join(through)} would fall through the floor; expected contype="0" '
            'conaffinity="1"'
        )
    if among_themselves:
        problems.append(
            f"{', '.join(among_themselves)} touch parts of the robot too, for which the task has "
            'no room; expected contype="0" conaffinity="1"'
        )
    if others:
        problems.append(
            f"other geoms collide too: {', '.join(dict.fromkeys(others))}; their contacts count "
            "for nothing and take the room of those that do; expected "
            'contype="0" conaffinity="0"'
        )
    return problems


def _pose_problems(robot: RobotSpec, opposite: Mapping[str, str]) -> list[str]:
    """List straight knees, and left legs that are not the mirror image of the right ones."""
    problems = []
    position = default_pose(robot)
    compared: set[str] = set()
    for leg in robot.legs:
        joints = joints_of_leg(robot, leg)
        knee = position[joints[KNEE]]
        if abs(knee) < BENT:
            problems.append(
                f"poses.default has {joints[KNEE]} at {knee:g} rad; expected a "
                f"bent knee, {BENT:g} rad or more to either side"
            )
        if leg in compared or leg not in opposite:
            continue
        compared.add(opposite[leg])
        images = joints_of_leg(robot, opposite[leg])
        for number, (name, image) in enumerate(zip(joints, images, strict=True)):
            angle = position[name]
            expected = -angle if number == HIP_ROLL else angle
            if abs(position[image] - expected) > SAME_POSE:
                problems.append(
                    f"poses.default has {name} at {angle:g} rad and {image} at "
                    f"{position[image]:g} rad; expected {expected:g} rad there, the mirror image"
                )
    return problems


def _balance_problems(robot: RobotSpec, model: mujoco.MjModel) -> list[str]:
    """Say where the robot would tip over in its default pose."""
    data, to_trunk = posed(robot, model, default_pose(robot))
    base = model.body(robot.base_body).id
    feet = []
    for leg in robot.legs:
        foot = data.geom_xpos[model.geom(f"{leg}_foot_collision").id]
        feet.append(float((to_trunk @ (foot - data.xpos[base]))[0]))
    mass_x = float((to_trunk @ (data.subtree_com[base] - data.xpos[base]))[0])
    margin = STEADY * (max(feet) - min(feet))
    if not min(feet) + margin <= mass_x <= max(feet) - margin:
        return [
            f"in poses.default the centre of mass is at x = {mass_x:.3f} m and the feet are at "
            f"{min(feet):.3f} to {max(feet):.3f} m, so that it tips over; expected feet below the "
            "hips, as with the hip pitch at about minus half of the knee"
        ]
    return []
