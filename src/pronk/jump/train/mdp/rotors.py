"""Rotors behind belts or gears that give way, as the encoders of the drives see them.

An encoder on the rotor measures q + x and qdot + xdot of a joint at q, where the rotor is ahead of
the link by x (in joint coordinates). With the drive's torque tau, the rotor's inertia I (the
armature), its natural frequency w on its belt while the link is held, and damping ratio z,

    xddot + 2 z w xdot + w^2 x = tau / I - qddot.

The simulated joint itself stays rigid: what a belt stores and gives back is not modelled, and the
drives' law has the angle of the link. In a physics step tau and qddot are constant; the solution is
then exact, and stable for belts of any stiffness.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


class Rotors:
    """Rotors of N robots with J joints, relative to their links; rigid until `draw`."""

    def __init__(self, inertia: Tensor, timestep_s: float) -> None:
        """Let all rotors rest on their links.

        Args:
            inertia: Inertia of each rotor in joint coordinates [kg m^2], (N, J).
            timestep_s: Physics step [s].
        """
        self._inverse_inertia = 1.0 / inertia
        self._timestep_s = timestep_s
        self.offset = torch.zeros_like(inertia)
        """Angle of each rotor less that of its link [rad]. (N, J)"""
        self.speed = torch.zeros_like(inertia)
        """Speed of each rotor less that of its link [rad/s]. (N, J)"""
        self.frequency_hz = torch.full_like(inertia, math.inf)
        """Natural frequency of each rotor while its link is held [Hz]. (N, J)"""
        self.rigid = True
        """All rotors move with their links, so that nothing is computed."""

    def draw(self, frequency_hz: Tensor, damping_ratio: Tensor) -> None:
        """Give every rotor its belt.

        Args:
            frequency_hz: Natural frequency of each rotor while its link is held [Hz], (N, J).
            damping_ratio: Damping ratio of each, above 0 and below 1, (N, J).
        """
        self.frequency_hz = frequency_hz
        frequency = 2.0 * math.pi * frequency_hz
        decay = damping_ratio * frequency
        damped_frequency = frequency * (1.0 - damping_ratio.square()).sqrt()
        angle = damped_frequency * self._timestep_s
        size = torch.exp(-decay * self._timestep_s)
        cosine = size * torch.cos(angle)
        sine = size * torch.sin(angle) / damped_frequency
        # Offset and speed after a step, by those before it.
        self._offset_by_offset = cosine + decay * sine
        self._offset_by_speed = sine
        self._speed_by_offset = -frequency.square() * sine
        self._speed_by_speed = cosine - decay * sine
        self._inverse_square = frequency.square().reciprocal()
        self.rigid = False

    def advance(self, torque: Tensor, acceleration: Tensor) -> None:
        """Advance by a physics step.

        Args:
            torque: Torques of the drives in the step [N m], (N, J).
            acceleration: Accelerations of the links in it [rad/s^2], (N, J).
        """
        if self.rigid:
            return
        relative_acceleration = torque * self._inverse_inertia - acceleration
        steady_offset = relative_acceleration * self._inverse_square
        distance = self.offset - steady_offset
        new_distance = self._offset_by_offset * distance + self._offset_by_speed * self.speed
        speed = self._speed_by_offset * distance + self._speed_by_speed * self.speed
        self.offset.copy_(steady_offset + new_distance)
        self.speed.copy_(speed)

    def reset(self, robots: Tensor) -> None:
        """Put the rotors of some robots, bool (N,), at rest on their links."""
        if self.rigid:
            return
        self.offset.masked_fill_(robots[:, None], 0.0)
        self.speed.masked_fill_(robots[:, None], 0.0)
