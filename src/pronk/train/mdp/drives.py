"""The robot's drives as mjlab actuators: the law that was matched, now in training.

The law of `pronk.actuator.model` and, by a test, of the bench model that `match` asks: at the
start of each
physics step

    torque = clip(stiffness (command - q) - damping qdot, low, high),
    high = min(effort_limit, stall_torque (1 - qdot / no_load_speed)), low its mirror image,

or the effort limit, where a joint turns so fast that the line is beyond it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from mjlab.actuator import DcMotorActuator, DcMotorActuatorCfg
from torch import Tensor

from pronk.errors import PronkError, RobotError
from pronk.robots.robot import Drive, RobotSpec
from pronk.train.gains import TrainingGains

if TYPE_CHECKING:
    from mjlab.actuator.actuator import ActuatorCmd
    from mjlab.entity import Entity


class PositionDriveCfg(DcMotorActuatorCfg):
    """mjlab's DC motor behind a PD law, of which positions alone are commanded."""

    def build(
        self, entity: Entity, target_ids: list[int], target_names: list[str]
    ) -> PositionDrive:
        """The actuator of an entity."""
        return PositionDrive(self, entity, target_ids, target_names)


class PositionDrive(DcMotorActuator[PositionDriveCfg]):
    """The same law as mjlab's, in 9 operations where it takes 21.

    The law is computed in every physics step, and on a GPU the host issues operations slower than
    the device completes them.
    """

    param_names = ("stiffness", "damping", "force_limit", "saturation_effort", "back_emf")

    def initialize(self, *args: Any) -> None:
        """Set up the parameters, called by mjlab."""
        super().initialize(*args)
        self.back_emf = self.saturation_effort / self.velocity_limit_motor
        """Torque lost to speed [N m s/rad]. (N, joints)"""

    @staticmethod
    def control_law(params: dict[str, Tensor], cmd: ActuatorCmd) -> Tensor:
        """Torque [N m]. (N, joints).

        Args:
            params: Of every joint, by name. (N, joints)
            cmd: Commanded position and position [rad], velocity [rad/s]. (N, joints)
        """
        stall, limit, back_emf = (
            params[name] for name in ("saturation_effort", "force_limit", "back_emf")
        )
        commanded = params["stiffness"] * (cmd.position_target - cmd.pos)
        commanded = torch.addcmul(commanded, params["damping"], cmd.vel, value=-1.0)
        # Without the back-EMF both ends of the line are at the stall torque, whatever the speed.
        torque = torch.addcmul(commanded, back_emf, cmd.vel).clamp(-stall, stall)
        return torch.addcmul(torque, back_emf, cmd.vel, value=-1.0).clamp(-limit, limit)


def actuators(robot: RobotSpec, gains: TrainingGains) -> tuple[PositionDriveCfg, ...]:
    """One actuator per joint group, in the robot's order of groups.

    Commands are delayed before they come here (`pronk.train.mdp.actions`).

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


def _actuator(robot: RobotSpec, group: str, gains: TrainingGains) -> PositionDriveCfg:
    drive = _drive(robot, group)
    return PositionDriveCfg(
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


def _drive(robot: RobotSpec, group: str) -> Drive:
    drives = [joint.drive for joint in robot.group(group)]
    if any(drive != drives[0] for drive in drives):
        raise RobotError(
            f"the joints of {robot.name}'s group {group} have different drives; a group is built "
            "alike."
        )
    return drives[0]
