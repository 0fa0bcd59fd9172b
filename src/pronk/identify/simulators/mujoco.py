"""The training simulator: whole chains, and one joint excited on the test rig.

The model is `pronk.robots.model.bench_spec`: fixed base, the joint's own chain, explicit PD at the
start of each 5 ms step, clipped by the torque-speed curve. `mujoco.rollout` runs thousands of gain
pairs on its threads; the trajectories are those of the training environment.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial

import mujoco
import mujoco.rollout
import numpy as np

from pronk.arrays import Array
from pronk.errors import PronkError, RobotError
from pronk.identify.response.grid import held_mean
from pronk.identify.simulators.command_trace import CommandTrace
from pronk.identify.simulators.simulator import (
    CHUNK,
    PARAMETERS,
    Closing,
    JointRigs,
    SimulatorInfo,
    Values,
)
from pronk.robots.model import bench_spec, set_drive_gains, set_passive
from pronk.robots.robot import RobotSpec

Drives = Mapping[str, Mapping[str, float]]
"""Parameter name to value by joint name; the robot's own where one is missing."""

_SAG_ROUNDS = 4
"""Rounds of `q = target - gravity(q) / stiffness`; each gains two digits at 17 N m/rad."""
DEVICES = ("cpu", "cuda", "warp-cpu")
"""`cpu`: `mujoco.rollout` on its threads, in double precision. `cuda`: MuJoCo Warp on the GPU, in
single precision. `warp-cpu`: MuJoCo Warp on the processor, slow, to compare precisions."""


def mujoco_info(robot: RobotSpec) -> SimulatorInfo:
    """Describe the training simulator of a robot."""
    return SimulatorInfo(
        profile="mjlab",
        version=mujoco.__version__,
        timestep_s=robot.timestep_s,
        decimation=robot.decimation,
    )


class Chain(Closing):
    """One chain of joints on a fixed base, a command for every joint."""

    def __init__(
        self,
        robot: RobotSpec,
        joint: str,
        *,
        spec: mujoco.MjSpec | None = None,
        threads: int = 2,
    ) -> None:
        """Compile the chain of a joint; `spec` is its bench model where that was extended."""
        self.robot, self.model = robot, (spec or bench_spec(robot, joint)).compile()
        self.joints = tuple(self.model.joint(i).name for i in range(self.model.njnt))
        self._stiffness = np.array([robot.joint(name).stiffness for name in self.joints])
        # One actuator a joint; map joint order to the columns of ctrl.
        self._columns = np.array([self.model.actuator(name).id for name in self.joints])
        self._data = [mujoco.MjData(self.model) for _ in range(threads)]
        self._pool = mujoco.rollout.Rollout(nthread=threads if threads > 1 else 0)

    def close(self) -> None:
        """Stop the threads."""
        self._pool.close()

    def _set(self, model: mujoco.MjModel, name: str, values: Mapping[str, float]) -> None:
        """Give a model parameters of a joint; the robot's own where one is missing."""
        joint, dof = self.robot.joint(name), self.joints.index(name)
        gains = {n: values.get(n, getattr(joint, n)) for n in ("stiffness", "damping")}
        set_drive_gains(model, name, joint.drive, **gains, law=self.robot.law)
        for parameter in ("armature", "frictionloss"):
            array, own = (getattr(m, f"dof_{parameter}") for m in (model, self.model))
            value = values.get(parameter, float(own[dof]))
            if array[dof] != value:
                set_passive(model, name, **{parameter: value})

    def rest_position(self, target: Array, stiffness: Array) -> Array:
        """Positions at rest with the drives at a target: what gravity leaves [rad], (chain,)."""
        model, data = self.model, self._data[0]
        mujoco.mj_resetData(model, data)
        data.qpos[:] = target
        for _ in range(_SAG_ROUNDS):
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_comVel(model, data)
            mujoco.mj_rne(model, data, 0, data.qfrc_bias)
            data.qpos[:] = target - data.qfrc_bias / stiffness
        return np.array(data.qpos)

    def rollout(self, command: Array, sets: Sequence[Drives], start: Array | None = None) -> Array:
        """Positions at the start of each step and after the last, of runs from rest.

        Args:
            command: Target positions during each step [rad], shape (runs, steps, chain).
            sets: Parameters (delays apart) of each run.
            start: First positions [rad], shape (runs, chain); where gravity leaves the chain with
                the first command if None.

        Returns:
            Shape (runs, steps + 1, chain) [rad]; NaN where a run diverged.
        """
        model = self.model
        models = [copy.copy(model) for _ in sets]
        first = np.empty((len(sets), model.nq))
        for run, (own, drives) in enumerate(zip(models, sets, strict=True)):
            stiffness = self._stiffness.copy()
            for row, name in enumerate(self.joints):
                if values := drives.get(name):
                    stiffness[row] = values.get("stiffness", stiffness[row])
                    self._set(own, name, values)
            first[run] = (
                self.rest_position(command[run, 0], stiffness) if start is None else start[run]
            )
        parts = self.robot.law.iterations
        control = np.zeros((len(command), parts * command.shape[1], model.nu))
        control[..., self._columns] = np.repeat(command, parts, axis=1)
        state = full_states(model, first)
        after, _ = self._pool.rollout(
            models,
            self._data,
            state,
            control,
            nstep=control.shape[1],
            skip_checks=False,
            control_spec=mujoco.mjtState.mjSTATE_CTRL.value,
        )
        after = after[:, parts - 1 :: parts]
        return np.concatenate([state[:, None], after], axis=1)[..., 1 : 1 + model.nq]


def full_states(model: mujoco.MjModel, positions: Array) -> Array:
    """States at rest at given positions, shapes (n, nq) to (n, state size)."""
    full = mujoco.mjtState.mjSTATE_FULLPHYSICS
    state = np.zeros((len(positions), mujoco.mj_stateSize(model, full)))
    # Full physics begins with time, then qpos, then qvel.
    state[:, 1 : 1 + model.nq] = positions
    return state


class JointTestRig(Chain):
    """One joint on the test rig, the original of a mirrored family, with many parameter sets.

    Only the excited joint's position is kept (a `jointpos` sensor, read at the start of each step).
    """

    def __init__(
        self, robot: RobotSpec, joint: str, *, threads: int = 2, chunk: int = CHUNK
    ) -> None:
        """Compile the model; `chunk` simulations are in flight at once."""
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
        self.joint, self.index = robot.joint(joint), self.joints.index(joint)
        self.actuator = int(self._columns[self.index])
        """Column of the excited joint's command."""
        self.chunk, self.steps = max(1, chunk // robot.law.iterations), 0
        self._sensor = int(self.model.sensor_adr[self.model.sensor("excited").id])
        self._models: list[mujoco.MjModel] = []

    def control(self, pose: Array) -> Array:
        """Commands that hold the chain at a pose [rad], shape (actuators,)."""
        out = np.zeros(self.model.nu)
        out[self._columns] = pose
        return out

    def equilibrium(self, target: Array, stiffness: float) -> Array:
        """Positions at rest with this stiffness at the excited joint [rad], shape (chain,)."""
        gains = self._stiffness.copy()
        gains[self.index] = stiffness
        return self.rest_position(target, gains)

    def run(
        self, traces: Sequence[CommandTrace], values: Values, steps: int
    ) -> Iterator[tuple[slice, Array]]:
        """Yield the excited joint's positions a chunk at a time; see `JointRigs.run`."""
        total = len(values["stiffness"])
        size, parts = min(self.chunk, total), self.robot.law.iterations
        while len(self._models) < size:
            self._models.append(copy.copy(self.model))
        control = np.empty((size, parts * steps, self.model.nu))
        sensor = np.empty((size, parts * steps, self.model.nsensordata))
        initial = full_states(self.model, np.zeros((size, self.model.nq)))
        centre = np.empty(size)
        shared = len(traces) == 1
        rest: dict[float, Array] = {}
        for begin in range(0, total, size):
            part = slice(begin, min(begin + size, total))
            n = part.stop - part.start
            for row, i in enumerate(range(part.start, part.stop)):
                kp = float(values["stiffness"][i])
                own = {name: float(v[i]) for name, v in values.items()}
                self._set(self._models[row], self.joint.name, own)
                if not shared or begin == 0:
                    pose, command = traces[0 if shared else i].excitation(self.robot, steps)
                    centre[row] = pose[self.index]
                    control[row][:, self._columns] = pose
                    control[row][:, self.actuator] += np.repeat(command, parts)
                if not shared or kp not in rest:
                    rest[kp] = self.equilibrium(control[row][0, self._columns], kp)
                initial[row, 1 : 1 + self.model.nq] = rest[kp]
            self._pool.rollout(
                self._models[:n],
                self._data,
                initial[:n],
                control[:n],
                sensordata=sensor[:n],
                nstep=parts * steps,
                skip_checks=True,
                control_spec=mujoco.mjtState.mjSTATE_CTRL.value,
            )
            self.steps += n * steps
            yield part, sensor[:n, ::parts, self._sensor] - centre[:n, None]


def rig_on(device: str) -> Callable[..., JointTestRig]:
    """The class of the rig for one of `DEVICES`; PronkError if it cannot be used here."""
    if device not in DEVICES:
        raise PronkError(f"device {device!r}; expected one of {', '.join(DEVICES)}.")
    if device == "cpu":
        return JointTestRig
    try:
        from pronk.identify.simulators.warp import WarpTestRig, find_device
    except ModuleNotFoundError as error:
        raise PronkError(
            f'device "{device}" needs MuJoCo Warp, and {error.name} is not installed; '
            'pip install "pronk[train]", or use device "cpu".'
        ) from error
    return partial(WarpTestRig, device=find_device(device))


class MujocoSimulator(JointRigs):
    """A robot's joints in MuJoCo, each branch on a fixed base; models are compiled once."""

    def __init__(self, robot: RobotSpec, *, threads: int = 2, device: str = "cpu") -> None:
        """Find the device; large runs of one joint are simulated there."""
        self.robot, self.info, self.joints = robot, mujoco_info(robot), robot.joint_names
        self.parameters = frozenset(PARAMETERS)
        self._new_rig = partial(rig_on(device), threads=threads)
        self._rigs: dict[str, JointTestRig] = {}

    def close(self) -> None:
        """Stop the threads of every rig."""
        for rig in self._rigs.values():
            rig.close()
        self._rigs.clear()

    def rig(self, joint: str) -> JointTestRig:
        """The rig that is simulated for a joint: that of its mirrored original."""
        original = self.robot.joint(joint).original[0]
        if original not in self._rigs:
            self._rigs[original] = self._new_rig(self.robot, original)
        return self._rigs[original]

    def run(
        self, traces: Sequence[CommandTrace], values: Values, steps: int
    ) -> Iterator[tuple[slice, Array]]:
        """See `JointRigs.run`."""
        rig = self.rig(traces[0].joint)
        before = rig.steps
        for part, position in rig.run(traces, values, steps):
            self.steps, before = self.steps + rig.steps - before, rig.steps
            yield part, position

    def rollout(self, command: Array, values: Values, *, locked: Sequence[str] = ()) -> Array:
        """Simulate B runs from rest at the first command; see `Simulator.rollout`."""
        if unknown := set(values) - self.parameters:
            raise PronkError(
                f"MuJoCo sets {', '.join(PARAMETERS)}, not {', '.join(sorted(unknown))}."
            )
        steps, held = command.shape[1], command.copy()
        sets = [
            {
                joint: {name: float(array[run, k]) for name, array in values.items()}
                for k, joint in enumerate(self.joints)
            }
            for run in range(len(command))
        ]
        edges = self.robot.timestep_s * np.arange(steps + 1)
        delays = values.get("delay", np.empty((0, 0)))
        for run, k in np.argwhere(delays):
            late = edges - delays[run, k]
            held[run, :, k] = held_mean(edges[:-1], command[run, :, k], late)
        out = np.repeat(command[:, :1], steps, axis=1)
        for root, _ in self.robot.branches(set(self.joints) - set(locked)):
            with Chain(self.robot, root, threads=1) as chain:
                columns = [self.joints.index(name) for name in chain.joints]
                out[..., columns] = chain.rollout(held[..., columns], sets)[:, :-1]
        return out
