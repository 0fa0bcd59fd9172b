"""Matched gains as configuration of a simulator, as text to read and to paste.

Every export names the simulator the gains hold for: the same numbers in another engine, at
another timestep or with another actuator law are another joint. Delays are rounded to physics
whole steps where a simulator has no other delay.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from pronk.errors import PronkError
from pronk.match.gains import MatchedGains
from pronk.robots import load_robot
from pronk.robots.model import add_drives, free_spec
from pronk.robots.robot import Drive, RobotSpec


@dataclass(frozen=True, kw_only=True)
class GroupDrive:
    """One joint group as every export needs it."""

    group: str
    joints: tuple[str, ...]
    stiffness: float
    """[N m/rad]"""
    damping: float
    """[N m s/rad]"""
    stiffness_range: tuple[float, float]
    """Lowest and highest of the uniform randomization [N m/rad]."""
    damping_range: tuple[float, float]
    """Lowest and highest of the uniform randomization, not below 0 [N m s/rad]."""
    armature: float
    """[kg m^2]"""
    drive: Drive
    """Limits and friction; the dry friction is the matched one where it was fitted."""
    delay_steps: int
    """Command delay in physics steps."""
    stribeck: float
    """Share of the dry friction that motion takes away."""


def group_drives(gains: MatchedGains, robot: RobotSpec) -> list[GroupDrive]:
    """The matched groups, in the robot's order. Fitted friction and delay are averaged.

    Raises:
        PronkError: The gains are of another robot, or hold no group.
    """
    if gains.robot != robot.name:
        raise PronkError(f"the gains are those of {gains.robot}, not of {robot.name}.")
    out = []
    for name in (name for name in robot.groups if name in gains.groups):
        group, members = gains.groups[name], robot.group(name)
        drive = members[0].drive
        matched = [gains.joints[j.name] for j in members if j.name in gains.joints]
        armature = [j.armature for j in matched] or [drive.armature]
        dry = [j.frictionloss for j in matched if not np.isnan(j.frictionloss)]
        delay = float(np.mean([j.delay_s for j in matched] or [0.0]))
        out.append(
            GroupDrive(
                group=name,
                joints=tuple(j.name for j in members),
                stiffness=group.stiffness,
                damping=group.damping,
                stiffness_range=_about(group.stiffness, group.stiffness_range),
                damping_range=_about(group.damping, group.damping_range),
                armature=float(np.mean(armature)),
                drive=replace(drive, frictionloss=float(np.mean(dry or [drive.frictionloss]))),
                delay_steps=round(delay / gains.simulator.timestep_s),
                stribeck=float(np.mean([j.stribeck for j in matched] or [0.0])),
            )
        )
    if not out:
        raise PronkError(
            f"the gains of {gains.robot} hold no joint group; match some joints first."
        )
    return out


def mjlab_text(gains: MatchedGains, robot: RobotSpec) -> str:
    """Python source for mjlab: `ACTUATORS`, a tuple of configs, and `EVENTS`, a dict of events.

    The events draw absolute gains for every environment (D3, D4); they address the actuators by
    their place in `ACTUATORS`, so keep the order.
    """
    drives = group_drives(gains, robot)
    actuators = "".join(
        f"    DcMotorActuatorCfg(  # {drive.group}\n"
        f"        target_names_expr={_names(drive.joints)},\n"
        f"{_fields(drive, 'frictionloss', viscous_damping='viscous_damping')}"
        + (
            f"        delay_min_lag={drive.delay_steps},  # physics steps\n"
            f"        delay_max_lag={drive.delay_steps},\n"
            if drive.delay_steps
            else ""
        )
        + "    ),\n"
        for drive in drives
    )
    events = "".join(
        f'    "{drive.group}_gains": EventTermCfg(\n'
        f"        func=dr.pd_gains,\n"
        f'        mode="startup",\n'
        f"        params={{\n"
        f'            "asset_cfg": SceneEntityCfg("robot", actuator_ids=[{index}]),\n'
        f'            "kp_range": {_pair(drive.stiffness_range)},\n'
        f'            "kd_range": {_pair(drive.damping_range)},\n'
        f'            "operation": "abs",\n'
        f"        }},\n"
        f"    ),\n"
        for index, drive in enumerate(drives)
    )
    return (
        f"{_comment(_header(gains) + _without_stribeck(drives))}\n\n"
        "from mjlab.actuator import DcMotorActuatorCfg\n"
        "from mjlab.envs.mdp import dr\n"
        "from mjlab.managers.event_manager import EventTermCfg\n"
        "from mjlab.managers.scene_entity_config import SceneEntityCfg\n\n"
        f"ACTUATORS = (\n{actuators})\n\nEVENTS = {{\n{events}}}\n"
    )


def mjcf_text(gains: MatchedGains, robot: RobotSpec) -> str:
    """The whole robot as MJCF with a native `dcmotor` for every joint.

    Its torque is the PD law with the groups' gains, clipped by the torque-speed line and the
    effort limit. MuJoCo treats native drives explicitly under Euler only, so the integrator is
    Euler: it gives the trajectories of the training simulator (see `pronk.robots.model`). Joints
    that were not matched have the robot's published gains. MuJoCo has no delay of a position
    command in its drives; a matched delay is named in the comment. Dry friction that falls with
    speed is the LuGre friction of the drive.
    """
    drives = group_drives(gains, robot)
    by_joint = {joint: drive for drive in drives for joint in drive.joints}
    spec = free_spec(robot)
    for name, drive in by_joint.items():
        spec.joint(name).armature = drive.armature
        spec.joint(name).frictionloss = drive.drive.frictionloss
    spec.option.timestep = gains.simulator.timestep_s
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    add_drives(
        spec,
        robot,
        robot.joint_names,
        stiffness={name: drive.stiffness for name, drive in by_joint.items()},
        damping={name: drive.damping for name, drive in by_joint.items()},
        stribeck={name: drive.stribeck for name, drive in by_joint.items() if drive.stribeck},
    )
    spec.compile()
    late = [f"{d.group} {d.delay_steps} steps" for d in drives if d.delay_steps]
    comment = _header(gains)
    if late:
        comment += "\nCommand delays that this file does not have: " + ", ".join(late) + "."
    return f"<!--\n{comment}\n-->\n{spec.to_xml()}"


def isaaclab_text(gains: MatchedGains, robot: RobotSpec) -> str:
    """Python source for Isaac Lab: `ACTUATORS`, a dict of `DCMotorCfg` by group.

    Isaac Lab runs PhysX; its first line is a warning that the gains must be matched there anew.
    """
    drives = group_drives(gains, robot)
    entries = "".join(
        f'    "{drive.group}": DCMotorCfg(\n'
        f"        joint_names_expr={list(drive.joints)!r},\n"
        f"{_fields(drive, 'friction')}"
        f"    ),  # draw stiffness from {_pair(drive.stiffness_range)}, "
        f"damping from {_pair(drive.damping_range)}\n"
        for drive in drives
    )
    warning = (
        "NOT MATCHED IN THIS SIMULATOR. Isaac Lab runs PhysX, whose integrator and joint friction "
        "are not MuJoCo's:\nwith the same numbers the joints respond differently. Take them as a "
        "start, sweep the joints in\nIsaac Lab with the log's own commands, and match again."
    )
    return (
        f"{_comment(f'{warning}{chr(10) * 2}{_header(gains)}' + _without_stribeck(drives))}\n\n"
        f"from isaaclab.actuators import DCMotorCfg\n\nACTUATORS = {{\n{entries}}}\n"
    )


def _fields(drive: GroupDrive, friction: str, **extra: str) -> str:
    """Arguments of an actuator, by the simulator's names, one a line."""
    own = {name: getattr(drive, name) for name in ("stiffness", "damping", "armature")}
    names = {
        friction: "frictionloss",
        **extra,
        "effort_limit": "effort_limit",
        "saturation_effort": "stall_torque",
        "velocity_limit": "no_load_speed",
    }
    own |= {name: getattr(drive.drive, field) for name, field in names.items()}
    return "".join(f"        {name}={_number(value)},\n" for name, value in own.items())


EXPORTS: Mapping[str, Callable[[MatchedGains, RobotSpec], str]] = {
    "mjlab": mjlab_text,
    "mjcf": mjcf_text,
    "isaaclab": isaaclab_text,
}
"""What `export_text` can write."""


def export_text(gains: MatchedGains, target: str, robot: RobotSpec | None = None) -> str:
    """The gains as text for one of `EXPORTS`; the robot is found by its name if not given.

    Raises:
        PronkError: The target is unknown, or the gains hold no group.
        RobotError: The robot is unknown.
    """
    if target not in EXPORTS:
        raise PronkError(f"no export to {target!r}; expected one of {', '.join(EXPORTS)}.")
    return EXPORTS[target](gains, robot or load_robot(gains.robot))


def _header(gains: MatchedGains) -> str:
    """What every export begins with."""
    simulator = gains.simulator
    lines = [
        f"Gains of {gains.robot}, matched by pronk.",
        f"They hold for {simulator.engine} {simulator.version}, timestep "
        f"{simulator.timestep_s:g} s, decimation {simulator.decimation},",
        f"integrator {simulator.integrator}, actuator law {simulator.actuator}. In any other "
        "simulator match again.",
    ]
    if gains.virtual:
        lines.append("The logs came from pronk's virtual robot, not from hardware.")
    lines += [f"Log {name}, SHA-256 {digest}" for name, digest in gains.logs.items()]
    return "\n".join(lines)


def _without_stribeck(drives: Sequence[GroupDrive]) -> str:
    """Name friction that falls with speed where the simulator's does not."""
    shares = [f"{one.group} {one.stribeck:.2g}" for one in drives if one.stribeck]
    if not shares:
        return ""
    return (
        "\nDry friction is that at rest. In motion the matched joints lose this share of it, which "
        f"this file\ndoes not have: {', '.join(shares)}."
    )


def _comment(text: str) -> str:
    return "\n".join(f"# {line}".rstrip() for line in text.splitlines())


def _about(centre: float, half: float) -> tuple[float, float]:
    return round(max(centre - half, 0.0), 9), round(centre + half, 9)


def _number(value: float) -> str:
    return repr(float(f"{value:.7g}"))


def _pair(values: tuple[float, float]) -> str:
    return f"({_number(values[0])}, {_number(values[1])})"


def _names(names: tuple[str, ...]) -> str:
    return "(" + " ".join(f'"{name}",' for name in names) + ")"
