"""Exports to MuJoCo: the whole robot as MJCF, or what a model of one's own needs."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence

from pronk.identify.match.export.actuators import Actuator
from pronk.identify.match.export.target import ExportTarget
from pronk.identify.simulators.profiles import Profile
from pronk.robots.model import add_drives, free_spec, set_law
from pronk.robots.robot import RobotSpec

JOINT_ATTRIBUTES = ("damping", "armature", "frictionloss")
"""Attributes of a joint that the snippet sets."""


def mjcf_robot(
    _target: ExportTarget, actuators: Sequence[Actuator], _profile: Profile, robot: RobotSpec
) -> str:
    """Write the whole robot with a native `dcmotor` a joint, of any drive law.

    Joints that were not matched have the robot's published gains.
    """
    spec = free_spec(robot)
    set_law(spec.option, robot)
    stiffness = {}
    damping = {}
    stribeck = {}
    for actuator in actuators:
        for name in actuator.joints:
            spec.joint(name).armature = actuator.armature
            spec.joint(name).frictionloss = actuator.frictionloss
            stiffness[name] = actuator.stiffness
            damping[name] = actuator.damping
            if actuator.stribeck:
                stribeck[name] = actuator.stribeck
    add_drives(
        spec,
        robot,
        robot.joint_names,
        stiffness=stiffness,
        damping=damping,
        stribeck=stribeck,
    )
    for actuator in actuators:
        if actuator.delay_s:
            for name in actuator.joints:
                # Linear between steps is the mean of a held command over a step (`held_mean`).
                native = spec.actuator(name)
                native.delay = actuator.delay_s
                native.interp = 1
                native.nsample = math.ceil(actuator.delay_s / spec.option.timestep) + 1
    spec.compile()
    return str(spec.to_xml())


def mjcf_snippet(
    target: ExportTarget, actuators: Sequence[Actuator], profile: Profile, robot: RobotSpec
) -> str:
    """Write what a model of one's own needs: option, joint attributes, and actuators."""
    root = ET.fromstring(mjcf_robot(target, actuators, profile, robot))
    maker_names = {}
    for actuator in actuators:
        for name, maker_name in zip(actuator.joints, actuator.maker_joints, strict=True):
            maker_names[name] = maker_name

    timestep_s = robot.law.substep(robot.timestep_s)
    integrator = "Euler" if robot.law.kind == "explicit" else "implicitfast"
    flag = ""
    if robot.law.passive_damping == "explicit":
        flag = '<flag eulerdamp="disable"/>'
    lines = [f'<option timestep="{timestep_s!r}" integrator="{integrator}">{flag}</option>']
    for joint in root.iter("joint"):
        name = joint.get("name", "")
        if name in maker_names:
            attributes = [f'{key}="{joint.get(key, 0)}"' for key in JOINT_ATTRIBUTES]
            lines.append(f'<joint name="{maker_names[name]}" {" ".join(attributes)}/>')
    lines.append("<actuator>")
    for native in root.iterfind("actuator/*"):
        name = native.get("joint", "")
        if name in maker_names:
            native.set("name", maker_names[name])
            native.set("joint", maker_names[name])
            native.tail = None
            lines.append(f"  {ET.tostring(native, encoding='unicode')}")
    lines.append("</actuator>")
    return "\n".join(lines) + "\n"
