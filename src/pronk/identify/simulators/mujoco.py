"""MuJoCo: whole chains, and one joint excited on the test rig.

The model is `pronk.robots.model.bench_spec`: the joint's own chain on a fixed base, with the
physics step and the drive law of the robot. A robot as it is loaded has those of the training
environment, whose trajectories the simulation then gives: an explicit PD at the start of each step
of `RobotSpec.timestep_s`, clipped by the torque-speed curve. A profile of a framework gives the
robot another step and another law. `mujoco.rollout` runs thousands of gain pairs on its threads.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence

import mujoco
import mujoco.rollout
import numpy as np

from pronk.arrays import Array
from pronk.errors import PronkError, RobotError
from pronk.identify.response.grid import held_mean
from pronk.identify.simulators.command_trace import CommandTrace
from pronk.identify.simulators.info import mujoco_info
from pronk.identify.simulators.simulator import (
    CHUNK,
    SETTABLE_PARAMETERS,
    Closing,
    JointRigs,
    Values,
)
from pronk.robots.model import bench_spec, set_drive_gains, set_passive
from pronk.robots.robot import RobotSpec

_REST_ROUNDS = 4
"""Rounds of `q = target - gravity(q) / stiffness`; each gains two digits at 17 N m/rad."""
_FULL_PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS
"""State of a simulation: time, positions, speeds and activations, in this order."""


class Chain(Closing):
    """One chain of n joints on a fixed base, with a command for every joint."""

    def __init__(
        self,
        robot: RobotSpec,
        joint: str,
        *,
        spec: mujoco.MjSpec | None = None,
        threads: int = 2,
    ) -> None:
        """Compile the chain of a joint.

        Args:
            robot: The robot.
            joint: The joint whose chain is simulated.
            spec: The bench model of the joint where it was extended; `bench_spec` if None.
            threads: Simulations at the same time.
        """
        self.robot = robot
        self.model = (spec or bench_spec(robot, joint)).compile()
        self.joints = tuple(self.model.joint(index).name for index in range(self.model.njnt))
        self._stiffness = np.array([robot.joint(name).stiffness for name in self.joints])
        # One actuator a joint; map the order of joints to the columns of ctrl.
        self._columns = np.array([self.model.actuator(name).id for name in self.joints])
        self._data = [mujoco.MjData(self.model) for _ in range(threads)]
        self._pool = mujoco.rollout.Rollout(nthread=threads if threads > 1 else 0)

    def close(self) -> None:
        """Stop the threads."""
        self._pool.close()

    def rest_position(self, target: Array, stiffness: Array) -> Array:
        """Compute the positions at which gravity and the drives balance.

        Args:
            target: Target positions of the drives [rad], shape (n,).
            stiffness: Stiffness of the drives [N m/rad], shape (n,).

        Returns:
            Positions at rest [rad], shape (n,).
        """
        data = self._data[0]
        mujoco.mj_resetData(self.model, data)
        data.qpos[:] = target
        for _ in range(_REST_ROUNDS):
            mujoco.mj_kinematics(self.model, data)
            mujoco.mj_comPos(self.model, data)
            mujoco.mj_comVel(self.model, data)
            mujoco.mj_rne(self.model, data, 0, data.qfrc_bias)
            data.qpos[:] = target - data.qfrc_bias / stiffness
        return np.array(data.qpos)

    def rollout(
        self, command: Array, values: Values | None = None, start: Array | None = None
    ) -> Array:
        """Simulate runs from rest.

        Args:
            command: Target positions during each step [rad], shape (runs, steps, n).
            values: Name of a parameter (not delay) to its values, each of shape (runs, n); those
                of the robot where a name is missing.
            start: First positions [rad], shape (runs, n); where gravity leaves the chain with
                the first command if None.

        Returns:
            Positions at the start of each step and after the last [rad], shape
            (runs, steps + 1, n); NaN where a run diverged.
        """
        values = values or {}
        runs = len(command)
        models = [copy.copy(self.model) for _ in range(runs)]
        first = np.empty((runs, self.model.nq))
        for run, model in enumerate(models):
            for column, name in enumerate(self.joints):
                joint_values = {key: float(array[run, column]) for key, array in values.items()}
                if joint_values:
                    self._set(model, name, joint_values)
            if start is None:
                stiffness = self._stiffness
                if "stiffness" in values:
                    stiffness = values["stiffness"][run]
                first[run] = self.rest_position(command[run, 0], stiffness)
            else:
                first[run] = start[run]
        iterations = self.robot.law.iterations
        control = np.zeros((runs, iterations * command.shape[1], self.model.nu))
        control[..., self._columns] = np.repeat(command, iterations, axis=1)
        state = full_states(self.model, first)
        later_states, _ = self._pool.rollout(
            models,
            self._data,
            state,
            control,
            nstep=control.shape[1],
            skip_checks=False,
            control_spec=mujoco.mjtState.mjSTATE_CTRL.value,
        )
        later_states = later_states[:, iterations - 1 :: iterations]
        states = np.concatenate([state[:, None], later_states], axis=1)
        return states[..., 1 : 1 + self.model.nq]

    def _set(self, model: mujoco.MjModel, name: str, values: Mapping[str, float]) -> None:
        """Give a model parameters of a joint; the robot's where one is missing."""
        joint = self.robot.joint(name)
        stiffness = values.get("stiffness", joint.stiffness)
        damping = values.get("damping", joint.damping)
        set_drive_gains(model, name, joint.drive, stiffness, damping, self.robot.law)
        limit = values.get("effort_limit", joint.drive.effort_limit)
        model.actuator_forcerange[self.model.actuator(name).id] = (-limit, limit)
        # The constants that MuJoCo derives are computed anew only where a value changes.
        dof = self.joints.index(name)
        armature = values.get("armature", float(self.model.dof_armature[dof]))
        if model.dof_armature[dof] != armature:
            set_passive(model, name, armature=armature)
        frictionloss = values.get("frictionloss", float(self.model.dof_frictionloss[dof]))
        if model.dof_frictionloss[dof] != frictionloss:
            set_passive(model, name, frictionloss=frictionloss)


def full_states(model: mujoco.MjModel, positions: Array) -> Array:
    """Return states at rest at given positions, shapes (n, nq) to (n, state size)."""
    state = np.zeros((len(positions), mujoco.mj_stateSize(model, _FULL_PHYSICS)))
    state[:, 1 : 1 + model.nq] = positions
    return state


class JointTestRig(Chain):
    """One joint on the test rig, the original of a mirrored family, with many parameter sets.

    Only the excited joint's position is kept (a `jointpos` sensor, read at the start of each step).
    """

    def __init__(
        self, robot: RobotSpec, joint: str, *, threads: int = 2, chunk: int = CHUNK
    ) -> None:
        """Compile the model.

        Args:
            robot: The robot.
            joint: The joint that is excited.
            threads: Simulations at the same time.
            chunk: Simulations in flight at once.

        Raises:
            RobotError: The bench model of the joint does not hold it.
        """
        spec = bench_spec(robot, joint)
        spec.add_sensor(
            name="excited",
            type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=joint,
        )
        super().__init__(robot, joint, spec=spec, threads=threads)
        if joint not in self.joints:
            raise RobotError(f"the bench model of {joint} holds {', '.join(self.joints)} instead.")
        self.joint = robot.joint(joint)
        self.index = self.joints.index(joint)
        """Index of the excited joint in the chain."""
        self.actuator = int(self._columns[self.index])
        """Column of the excited joint's command."""
        self.chunk = max(1, chunk // robot.law.iterations)
        """Simulations in flight at once."""
        self.steps = 0
        """Physics steps done so far."""
        self._sensor = int(self.model.sensor_adr[self.model.sensor("excited").id])
        self._models: list[mujoco.MjModel] = []

    def control(self, pose: Array) -> Array:
        """Return the commands that hold the chain at a pose [rad], shape (actuators,)."""
        control = np.zeros(self.model.nu)
        control[self._columns] = pose
        return control

    def equilibrium(self, target: Array, stiffness: float) -> Array:
        """Compute the rest of the chain with another stiffness at the excited joint.

        Args:
            target: Target positions of the drives [rad], shape (n,).
            stiffness: Stiffness of the excited joint [N m/rad].

        Returns:
            Positions at rest [rad], shape (n,).
        """
        chain_stiffness = self._stiffness.copy()
        chain_stiffness[self.index] = stiffness
        return self.rest_position(target, chain_stiffness)

    def run(
        self, traces: Sequence[CommandTrace], values: Values, steps: int
    ) -> Iterator[tuple[slice, Array]]:
        """Yield the excited joint's positions a chunk at a time; see `JointRigs.run`."""
        total = len(values["stiffness"])
        size = min(self.chunk, total)
        iterations = self.robot.law.iterations
        while len(self._models) < size:
            self._models.append(copy.copy(self.model))
        control = np.empty((size, iterations * steps, self.model.nu))
        sensor = np.empty((size, iterations * steps, self.model.nsensordata))
        initial = full_states(self.model, np.zeros((size, self.model.nq)))
        centre = np.empty(size)
        shared_trace = len(traces) == 1
        # Where gravity leaves the chain, by the stiffness of the excited joint.
        rest_by_stiffness: dict[float, Array] = {}
        for begin in range(0, total, size):
            count = min(size, total - begin)
            for row in range(count):
                index = begin + row
                stiffness = float(values["stiffness"][index])
                row_values = {name: float(array[index]) for name, array in values.items()}
                self._set(self._models[row], self.joint.name, row_values)
                if not shared_trace or begin == 0:
                    trace = traces[0] if shared_trace else traces[index]
                    pose, offsets = trace.excitation(self.robot, steps)
                    centre[row] = pose[self.index]
                    control[row][:, self._columns] = pose
                    control[row][:, self.actuator] += np.repeat(offsets, iterations)
                if not shared_trace or stiffness not in rest_by_stiffness:
                    target = control[row][0, self._columns]
                    rest_by_stiffness[stiffness] = self.equilibrium(target, stiffness)
                initial[row, 1 : 1 + self.model.nq] = rest_by_stiffness[stiffness]
            self._pool.rollout(
                self._models[:count],
                self._data,
                initial[:count],
                control[:count],
                sensordata=sensor[:count],
                nstep=iterations * steps,
                skip_checks=True,
                control_spec=mujoco.mjtState.mjSTATE_CTRL.value,
            )
            self.steps += count * steps
            position = sensor[:count, ::iterations, self._sensor] - centre[:count, None]
            yield slice(begin, begin + count), position


class MujocoSimulator(JointRigs):
    """A robot's joints in MuJoCo, each branch on a fixed base; models are compiled once."""

    def __init__(self, robot: RobotSpec, *, threads: int = 2) -> None:
        """Take the joints of a robot; `threads` simulations run at the same time."""
        self.robot = robot
        self.info = mujoco_info(robot)
        self.joints = robot.joint_names
        self.parameters = frozenset(SETTABLE_PARAMETERS)
        self.sets_effort_limit = True
        self._threads = threads
        self._rigs: dict[str, JointTestRig] = {}

    def close(self) -> None:
        """Stop the threads of every rig."""
        for rig in self._rigs.values():
            rig.close()
        self._rigs.clear()

    def rig(self, joint: str) -> JointTestRig:
        """Return the rig on which a joint is simulated: that of its mirrored original."""
        original = self.robot.joint(joint).original[0]
        if original not in self._rigs:
            self._rigs[original] = JointTestRig(self.robot, original, threads=self._threads)
        return self._rigs[original]

    def run(
        self, traces: Sequence[CommandTrace], values: Values, steps: int
    ) -> Iterator[tuple[slice, Array]]:
        """See `JointRigs.run`."""
        for part, position in self.rig(traces[0].joint).run(traces, values, steps):
            self.steps += len(position) * steps
            yield part, position

    def rollout(self, command: Array, values: Values, *, locked: Sequence[str] = ()) -> Array:
        """Simulate B runs from rest at the first command; see `Simulator.rollout`."""
        unknown = set(values) - self.parameters
        if unknown:
            raise PronkError(
                f"MuJoCo sets {', '.join(SETTABLE_PARAMETERS)}, not {', '.join(sorted(unknown))}."
            )
        steps = command.shape[1]
        delayed_command = command.copy()
        if "delay" in values:
            edges = self.robot.timestep_s * np.arange(steps + 1)
            delay = values["delay"]
            for run, column in np.argwhere(delay):
                delayed_command[run, :, column] = held_mean(
                    edges[:-1], command[run, :, column], edges - delay[run, column]
                )
        position = np.repeat(command[:, :1], steps, axis=1)
        for root, _ in self.robot.branches(set(self.joints) - set(locked)):
            with Chain(self.robot, root, threads=1) as chain:
                columns = [self.joints.index(name) for name in chain.joints]
                chain_values = {}
                for name, array in values.items():
                    if name != "delay":
                        chain_values[name] = array[:, columns]
                runs = chain.rollout(delayed_command[..., columns], chain_values)
                position[..., columns] = runs[:, :-1]
        return position
