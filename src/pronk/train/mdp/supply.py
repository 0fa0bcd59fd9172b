"""The battery: what the drives draw together lowers the voltage that each of them has.

The drives' law knows a rated voltage. A robot that jumps draws well over a kilowatt, and then the
battery and its wires decide how high: at resistance R they give at most U^2 / 4 R. In a physics
step, with the torques tau of the step before and the speeds omega of now,

    P = sum(tau omega + tau^2 / back_emf),        electrical power [W]
    V = (U + sqrt(U^2 - 4 R P)) / 2,              from V = U - R P / V

with U the voltage at no load, and V at least U / 2, where the power is greatest. tau^2 / back_emf
is the heat in the windings: with K the motor constant of the drive's law (no-load speed U / K,
stall torque K U / r), back_emf = stall_torque / no_load_speed = K^2 / r. Of the drives' law only
the stall torque changes, in proportion to V; torque lost to speed stays (`pronk.actuator.model`).

V follows over a few steps: the power answers to the voltage within a step, and answered at once the
two would chase each other.

Not in the paper, whose simulator has a bus voltage that holds (S5).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from mjlab.entity import Entity

from pronk.train.mdp.drives import PositionDrive

if TYPE_CHECKING:
    from mjlab.actuator import Actuator

_FOLLOW = 0.3
"""Share of the way to its new value that the voltage goes in a physics step."""


class Supply:
    """Batteries of N robots. Voltages are relative to the rated one of the drives' law."""

    def __init__(self, entity: Entity) -> None:
        """At the rated voltage, and without resistance, until something else is drawn.

        Args:
            entity: The robots; their drives are `PositionDrive`.
        """
        self._entity = entity
        self._drives = [(drive, drive.saturation_effort.clone()) for drive in _drives(entity)]
        speed = entity.data.joint_vel
        count, device = len(speed), speed.device
        self._heat = torch.zeros_like(speed)
        """Heat in the windings per torque squared [rad/s per N m]. (N, joints)"""
        for drive, _ in self._drives:
            self._heat[:, drive.target_ids] = 1.0 / drive.back_emf
        self.no_load = torch.ones(count, 1, device=device)
        """U over the rated voltage. (N, 1)"""
        self.drop = torch.zeros(count, 1, device=device)
        """4 R over the square of the rated voltage [1/W]. (N, 1)"""
        self.voltage = torch.ones(count, 1, device=device)
        """V over the rated voltage. (N, 1)"""
        self.idle = True
        """All batteries hold the rated voltage, so that nothing needs to be computed."""

    def set(self, voltage: torch.Tensor, resistance: torch.Tensor, rated: float) -> None:
        """Give every robot its battery.

        Args:
            voltage: At no load [V]. (N, 1)
            resistance: Of battery and wires [ohm]. (N, 1)
            rated: What the drives' stall torque is for [V].
        """
        self.no_load.copy_(voltage / rated)
        self.drop.copy_(4.0 * resistance / rated**2)
        self.voltage.copy_(self.no_load)
        self.idle = False
        self._give()

    def advance(self) -> None:
        """Before a physics step: what was drawn in the last one lowers the voltage in this one."""
        if self.idle:
            return
        data = self._entity.data
        torque = data.qfrc_actuator
        power = (torch.addcmul(data.joint_vel, torque, self._heat) * torque).sum(1, keepdim=True)
        root = torch.addcmul(self.no_load.square(), self.drop, power, value=-1.0)
        sagged = 0.5 * (self.no_load + root.clamp_min_(0.0).sqrt_())
        self.voltage.lerp_(sagged, _FOLLOW)
        self._give()

    def rest(self, robots: torch.Tensor | slice) -> None:
        """Forget what was drawn from some batteries: power that is no number leaves no voltage.

        Args:
            robots: Which.
        """
        if not self.idle:
            self.voltage[robots] = self.no_load[robots]

    def _give(self) -> None:
        for drive, rated in self._drives:
            torch.mul(rated, self.voltage, out=drive.saturation_effort)


def _drives(entity: Entity) -> list[PositionDrive]:
    actuators: list[Actuator] = list(entity.actuators)
    return [drive for drive in actuators if isinstance(drive, PositionDrive)]
