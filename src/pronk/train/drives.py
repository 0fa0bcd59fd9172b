"""The robot's drives as mjlab actuators: the law that was matched, now in training.

mjlab's `DcMotorActuator` computes at the start of each physics step

    torque = clip(stiffness (command - q) - damping qdot, low, high),
    high = min(effort_limit, stall_torque (1 - qdot / no_load_speed)), low its mirror image,

which is the law of `pronk.drive` and, by a test, of the bench model that `match` asks.
"""

from __future__ import annotations

from mjlab.actuator import DcMotorActuatorCfg

from pronk.errors import PronkError, RobotError
from pronk.robots.robot import Drive, Robot
from pronk.train.gains import TrainingGains


def actuators(robot: Robot, gains: TrainingGains) -> tuple[DcMotorActuatorCfg, ...]:
    """One actuator per joint group, in the robot's order of groups.

    Commands are delayed before they come here (`pronk.train.actions`).

    Args:
        robot: Gives the drives.
        gains: Gives stiffness and damping of each group.

    Raises:
        RobotError: Joints of one group have different drives.
        PronkError: The gains are another robot's.
    """
    if gains.robot != robot.name:
        raise PronkError(f"gains of {gains.robot} were given for the drives of {robot.name}.")
    return tuple(_actuator(robot, group, gains) for group in robot.groups)


def _actuator(robot: Robot, group: str, gains: TrainingGains) -> DcMotorActuatorCfg:
    drive = _drive(robot, group)
    return DcMotorActuatorCfg(
        target_names_expr=tuple(joint.name for joint in robot.group(group)),
        stiffness=gains.groups[group].stiffness,
        damping=gains.groups[group].damping,
        armature=drive.armature,
        frictionloss=drive.frictionloss,
        viscous_damping=drive.viscous_damping,
        effort_limit=drive.effort_limit,
        saturation_effort=drive.stall_torque,
        velocity_limit=drive.no_load_speed,
    )


def _drive(robot: Robot, group: str) -> Drive:
    drives = [joint.drive for joint in robot.group(group)]
    if any(drive != drives[0] for drive in drives):
        raise RobotError(
            f"the joints of {robot.name}'s group {group} have different drives; a group is built "
            "alike."
        )
    return drives[0]
