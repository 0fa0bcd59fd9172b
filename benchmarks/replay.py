"""A log as the peers see it: commands and positions at the physics steps, and the bench model."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np
from numpy.typing import NDArray

from pronk.errors import LogError
from pronk.logs.joint_log import JointLog
from pronk.robots.model import bench_spec, set_drive_gains
from pronk.robots.robot import Robot

Array = NDArray[np.float64]

_SAME = 1e-9
"""Commands and sample intervals that differ by less are the same [rad, s]."""


@dataclass(frozen=True, kw_only=True)
class Replay:
    """What time-domain tools need of a log."""

    joint: str
    robot: Robot
    spec: Any
    """The bench model as an MjSpec, with a position sensor of the joint's name."""
    model: Any
    """The same, compiled."""
    column: int
    """Of the joint in the model's positions and controls."""
    control: Array
    """Command of every drive at each step [rad], shape (steps, drives)."""
    position: Array
    """Measured positions of the joint, shape (repeats, steps)."""
    initial: Array
    """Full physics state at rest where each repeat was met, shape (repeats, state)."""

    @classmethod
    def of(cls, log: JointLog, joint: str, robot: Robot) -> Replay:
        """Read a log.

        Args:
            log: Sampled at the physics steps; its segments ask one and the same command.
            joint: The joint that was asked.
            robot: Gives the bench model; joints that are held stand at their default position.

        Raises:
            LogError: The log is not sampled so, or its repeats differ in their commands.
        """
        spec = bench_spec(robot, joint)
        spec.add_sensor(
            name=joint,
            type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=joint,
        )
        model = spec.compile()
        column = int(model.joint(joint).qposadr[0])
        parts = [log.cut(segment) for segment in log.segments if joint in segment.joints]
        where = log.source or "log"
        if not parts:
            raise LogError(f"{where}: no segment asks {joint}.")
        asked = parts[0].command[:, parts[0].column(joint)]
        for part in parts:
            if np.abs(np.diff(part.time) - robot.timestep_s).max() > _SAME:
                raise LogError(
                    f"{where}: sampled every {np.diff(part.time).mean():.6f} s, give or take "
                    f"{np.ptp(np.diff(part.time)):.1e} s; the peers replay row by row and need "
                    f"exactly the physics step of {robot.timestep_s} s."
                )
            own = part.command[:, part.column(joint)]
            if len(own) != len(asked) or np.abs(own - asked).max() > _SAME:
                raise LogError(f"{where}: the repeats of {joint} differ in their commands.")
        names = [model.actuator(i).name for i in range(model.nu)]
        held = [robot.joint(name).default_position for name in names]
        control = np.tile(held, (len(asked), 1))
        control[:, names.index(joint)] = asked
        position = np.array([part.position[:, part.column(joint)] for part in parts])
        # At rest until the command first changes: the mean of what was measured by then.
        still = max(int(np.argmax(asked != asked[0])), 1)
        data = mujoco.MjData(model)
        size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        initial = np.empty((len(parts), size))
        for row, met in zip(initial, position[:, :still].mean(axis=1), strict=True):
            data.qpos[:] = [
                robot.joint(model.joint(i).name).default_position for i in range(model.nq)
            ]
            data.qpos[column] = met
            mujoco.mj_getState(model, data, row, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        return cls(
            joint=joint,
            robot=robot,
            spec=spec,
            model=model,
            column=column,
            control=control,
            position=position,
            initial=initial,
        )

    @property
    def time(self) -> Array:
        """Of each step since the first [s], shape (steps,)."""
        return np.asarray(np.arange(len(self.control)) * self.robot.timestep_s, dtype=np.float64)

    def with_gains(self, stiffness: float, damping: float) -> Any:
        """A copy of the compiled model with other gains on the joint's drive."""
        model = copy.copy(self.model)
        drive = self.robot.joint(self.joint).drive
        set_drive_gains(model, self.joint, drive, stiffness, damping)
        return model

    def positions(self, gains: Array, pool: Any, datas: list[Any]) -> Array:
        """Simulated positions of many gain pairs, from the mean state that the repeats began in.

        Args:
            gains: Stiffness and damping, shape (b, 2 or more).
            pool: A `mujoco.rollout.Rollout`.
            datas: One `MjData` a thread of the pool.

        Returns:
            At the start of each step [rad], shape (b, steps).
        """
        models = [self.with_gains(float(pair[0]), float(pair[1])) for pair in gains]
        begin = np.tile(self.initial.mean(axis=0), (len(models), 1))
        control = np.broadcast_to(self.control, (len(models), *self.control.shape))
        _, sensor = pool.rollout(models, datas, begin, np.ascontiguousarray(control))
        return np.asarray(sensor[:, :, self.model.sensor(self.joint).adr[0]])
