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

from pronk.identify.simulators.simulator import PARAMETERS, SimulatorInfo
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
        self.parameters = frozenset(PARAMETERS)
        self._own = {
            "stiffness": [joint.stiffness for joint in robot.joints],
            "damping": [joint.damping for joint in robot.joints],
            "armature": [joint.drive.armature for joint in robot.joints],
            "frictionloss": [joint.drive.frictionloss for joint in robot.joints],
            "delay": [0.0 for _ in robot.joints],
        }

    def rollout(
        self, command: Array, values: Mapping[str, Array], *, locked: Sequence[str] = ()
    ) -> Array:
        """Simulate runs from rest at the first command, shape (B, T, J) [rad]."""
        own = {name: np.broadcast_to(v, command[:, 0].shape) for name, v in self._own.items()}
        kp, kd, armature, friction, delay = ({**own, **values}[name] for name in PARAMETERS)
        free = ~np.isin(self.joints, locked)
        step, inertia = self.info.timestep_s, LINK_INERTIA + armature
        late = np.round(delay / step).astype(int)
        position, speed = command[:, 0].copy(), np.zeros_like(kp)
        out = np.empty_like(command)
        for k in range(command.shape[1]):
            out[:, k] = position
            at = np.maximum(k - late, 0)[:, None]
            target = np.take_along_axis(command, at, axis=1)[:, 0]
            speed = speed + step / inertia * (kp * (target - position) - kd * speed)
            stop = step / inertia * friction
            speed = free * np.sign(speed) * np.maximum(np.abs(speed) - stop, 0.0)
            position = position + step * speed
        return out
