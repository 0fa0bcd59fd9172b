"""The drives of the robot and the battery that feeds them, as mjlab actuators.

A drive is mjlab's `DcMotorActuator`. At the start of each physics step it gives

    torque = clip(stiffness (command - q) - damping qdot, low, high),
    high = min(effort_limit, stall_torque (1 - qdot / no_load_speed)), low its mirror image,

or the effort limit, where a joint turns so fast that the line is beyond it. This is the law of
`pronk.robots.motor`, with which gains are matched; a test compares the two.

The battery (not in the paper, whose bus voltage is constant, S5) sags with the power that the
drives draw. With the torques tau of the last physics step and the speeds omega of this one,

    P = sum(tau omega + tau^2 / back_emf),        electrical power [W]
    V = (U + sqrt(U^2 - 4 R P)) / 2,              from V = U - R P / V

with U the voltage at no load, R the resistance, and V at least U / 2, where the power is greatest.
tau^2 / back_emf is the heat in the windings: with motor constant K (no-load speed U / K, stall
torque K U / r), back_emf = stall_torque / no_load_speed = K^2 / r. Stall torque and no-load speed
change in proportion to V. V follows over a few steps, since power and voltage depend on each other.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from mjlab.actuator import DcMotorActuator, DcMotorActuatorCfg
from torch import Tensor

from pronk.errors import PronkError, RobotError
from pronk.jump.train.gains import TrainingGains
from pronk.jump.train.mdp.masks import overwrite
from pronk.robots.robot import RobotSpec

if TYPE_CHECKING:
    from mjlab.entity import Entity

_VOLTAGE_STEP = 0.3
"""Fraction of the way to its new value that the voltage covers in a physics step."""


def drive_cfgs(robot: RobotSpec, gains: TrainingGains) -> tuple[DcMotorActuatorCfg, ...]:
    """Configure one actuator for each joint group, in the robot's order of groups.

    Args:
        robot: The robot.
        gains: Nominal gains of its joint groups.

    Raises:
        PronkError: Gains of another robot, or a group with different drives.
    """
    if gains.robot != robot.name:
        raise PronkError(f"gains of {gains.robot} were given for the drives of {robot.name}.")
    cfgs = []
    for group in robot.groups:
        joints = robot.group(group)
        group_gains = gains.groups[group]  # by joint: until `events.randomize_drives`
        drive = joints[0].drive
        for joint in joints:
            if joint.drive != drive:
                raise RobotError(
                    f"the joints of {robot.name}'s group {group} have different drives; expected "
                    "one drive for all joints of a group."
                )
        frictionloss = group_gains.frictionloss
        if math.isnan(frictionloss):
            frictionloss = drive.frictionloss
        cfgs.append(
            DcMotorActuatorCfg(
                target_names_expr=tuple(joint.name for joint in joints),
                stiffness=group_gains.stiffness,
                damping=group_gains.damping,
                armature=drive.armature,
                frictionloss=frictionloss,
                viscous_damping=drive.viscous_damping,
                effort_limit=drive.effort_limit,
                saturation_effort=drive.stall_torque,
                velocity_limit=drive.no_load_speed,
            )
        )
    return tuple(cfgs)


class Battery:
    """Batteries of N robots. Voltages are relative to the rated voltage of the drives."""

    def __init__(self, entity: Entity) -> None:
        """Start at the rated voltage and without resistance."""
        self._entity = entity
        self._drives = [drive for drive in entity.actuators if isinstance(drive, DcMotorActuator)]
        self._rated_stall_torques = [drive.saturation_effort.clone() for drive in self._drives]
        self._rated_speeds = [drive.velocity_limit_motor.clone() for drive in self._drives]
        # Heat in the windings per torque squared [rad/s per N m]. (N, joints)
        self._heat = torch.zeros_like(entity.data.joint_vel)
        for drive in self._drives:
            back_emf = drive.saturation_effort / drive.velocity_limit_motor
            self._heat[:, drive.target_ids] = 1.0 / back_emf
        self._strength = torch.ones_like(self._heat[:, :1])
        self.no_load = torch.ones_like(self._heat[:, :1])
        """U over the rated voltage. (N, 1)"""
        self.drop = torch.zeros_like(self.no_load)
        """4 R over the square of the rated voltage [1/W]. (N, 1)"""
        self.voltage = torch.ones_like(self.no_load)
        """V over the rated voltage. (N, 1)"""
        self.ideal = True
        """All batteries hold the rated voltage, so that nothing is computed."""

    def set(self, voltage: Tensor, resistance: Tensor, rated: float) -> None:
        """Give every robot its battery.

        Args:
            voltage: U of each robot [V], (N, 1).
            resistance: R of each robot [ohm], (N, 1).
            rated: Rated voltage of the drives [V].
        """
        self.no_load.copy_(voltage / rated)
        self.drop.copy_(4.0 * resistance / rated**2)
        self.voltage.copy_(self.no_load)
        self.ideal = False
        self._apply()

    def weaken(self, strength: Tensor) -> None:
        """Give the motors of each robot a share of their nominal motor constant.

        Stall torque, K U / r, is in proportion to the motor constant K, no-load speed, U / K, in
        inverse proportion, and the heat per torque squared to its inverse square.

        Args:
            strength: The shares, (N, 1).
        """
        change = strength / self._strength
        for stall_torque, speed in zip(self._rated_stall_torques, self._rated_speeds, strict=True):
            stall_torque.mul_(change)
            speed.div_(change)
        self._heat.div_(change.square())
        self._strength = strength
        self._apply()

    def advance(self) -> None:
        """Lower the voltage by the power drawn in the last physics step, before the next one."""
        if self.ideal:
            return
        data = self._entity.data
        torque = data.qfrc_actuator
        power = (torch.addcmul(data.joint_vel, torque, self._heat) * torque).sum(1, keepdim=True)
        root = torch.addcmul(self.no_load.square(), self.drop, power, value=-1.0)
        new_voltage = 0.5 * (self.no_load + root.clamp_min_(0.0).sqrt_())
        self.voltage.lerp_(new_voltage, _VOLTAGE_STEP)
        self._apply()

    def reset(self, robots: Tensor) -> None:
        """Return the batteries of some robots, bool (N,), to no load.

        A power that is not finite has spoiled the voltage.
        """
        if not self.ideal:
            overwrite(self.voltage, robots[:, None], self.no_load)

    def _apply(self) -> None:
        """Scale the torque-speed lines of the drives by the voltage."""
        # In place: mjlab computes with views of these tensors.
        for i, drive in enumerate(self._drives):
            torch.mul(self._rated_stall_torques[i], self.voltage, out=drive.saturation_effort)
            torch.mul(self._rated_speeds[i], self.voltage, out=drive.velocity_limit_motor)
