"""A simulator of one's own: joints as independent rotors, stepped by an explicit integrator.

    pronk match log.mcap --robot mini_cheetah --simulator examples/my_simulator.py:Pendulum

Every joint is a rotor on a horizontal axis through its centre of mass:

    (LINK_INERTIA + armature) a = stiffness (command - q) - damping v - frictionloss sign(v)

with speed v, acceleration a and the command `delay` late. Semi-implicit Euler:
the speed first, then the position.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pronk.identify.simulators.info import SimulatorInfo
from pronk.identify.simulators.simulator import SETTABLE_PARAMETERS
from pronk.robots.robot import RobotSpec

Array = NDArray[np.float64]

LINK_INERTIA = 0.006
"""Inertia of the link about its joint [kg m^2]."""


class Pendulum:
    """Joints of a robot that do not feel each other."""

    def __init__(self, robot: RobotSpec) -> None:
        """Take the joints of a robot and their parameters."""
        self.info = SimulatorInfo(
            engine="numpy", version="1", timestep_s=0.002, decimation=10, integrator="euler"
        )
        self.joints = robot.joint_names
        self.parameters = frozenset(SETTABLE_PARAMETERS)
        self._robot_values = {
            "stiffness": np.array([joint.stiffness for joint in robot.joints]),
            "damping": np.array([joint.damping for joint in robot.joints]),
            "armature": np.array([joint.drive.armature for joint in robot.joints]),
            "frictionloss": np.array([joint.drive.frictionloss for joint in robot.joints]),
            "delay": np.zeros(len(robot.joints)),
        }

    def rollout(
        self, command: Array, values: Mapping[str, Array], *, locked: Sequence[str] = ()
    ) -> Array:
        """Simulate runs from rest at the first command; see `Simulator.rollout`.

        Args:
            command: Target positions during each step [rad], shape (B, T, J).
            values: Parameters that are not the robot's, each of shape (B, J).
            locked: Joints that are held at their first command.

        Returns:
            Positions at the start of each step [rad], shape (B, T, J).
        """
        runs, steps, joints = command.shape
        parameters = {}
        for name in SETTABLE_PARAMETERS:
            value = values.get(name, self._robot_values[name])
            parameters[name] = np.broadcast_to(value, (runs, joints))
        timestep = self.info.timestep_s
        inertia = LINK_INERTIA + parameters["armature"]
        delay_steps = np.round(parameters["delay"] / timestep).astype(int)
        friction_speed = timestep / inertia * parameters["frictionloss"]
        free = ~np.isin(self.joints, locked)

        position = command[:, 0].copy()
        speed = np.zeros((runs, joints))
        positions = np.empty((runs, steps, joints))
        for step in range(steps):
            positions[:, step] = position
            command_step = np.maximum(step - delay_steps, 0)[:, None]
            target = np.take_along_axis(command, command_step, axis=1)[:, 0]
            torque = parameters["stiffness"] * (target - position) - parameters["damping"] * speed
            speed = speed + timestep / inertia * torque
            speed = np.sign(speed) * np.maximum(np.abs(speed) - friction_speed, 0.0)
            speed[:, ~free] = 0.0
            position = position + timestep * speed
        return positions
