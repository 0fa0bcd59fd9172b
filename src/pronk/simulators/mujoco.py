"""The training simulator with one joint excited on the test rig, and whole chains.

The model is `pronk.robots.model.bench_spec`: fixed base, the joint's own chain, explicit PD at the
start of each 5 ms step, clipped by the torque-speed curve. `mujoco.rollout` runs thousands of gain
pairs on its threads; the trajectories are those of the training environment.

Only the excited joint's position is kept (a `jointpos` sensor, read at the start of each step). A
joint that mirrors another is simulated as that other (`Joint.original`).
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np
from numpy.typing import ArrayLike, NDArray

from pronk.errors import PronkError, RobotError
from pronk.response.grid import held_mean
from pronk.robots.model import bench_spec, set_drive_gains, set_passive
from pronk.robots.robot import RobotSpec
from pronk.simulators.command_trace import CommandTrace, original_pose
from pronk.simulators.simulator import CHUNK, PARAMETERS, Closing, Count, SimulatorInfo, play

Array = NDArray[np.float64]

_SAG_ROUNDS = 4
"""Rounds of `q = target - gravity(q) / stiffness`; each gains two digits at 17 N m/rad."""
DEVICES = ("cpu", "cuda", "warp-cpu")
"""`cpu`: `mujoco.rollout` on its threads, in double precision. `cuda`: MuJoCo Warp on the GPU, in
single precision. `warp-cpu`: MuJoCo Warp on the processor, slow, to compare precisions."""


def rest_position(
    model: mujoco.MjModel, data: mujoco.MjData, target: Array, stiffness: Array
) -> Array:
    """Positions at rest with the drives at a target: what gravity leaves [rad], shape (nq,)."""
    mujoco.mj_resetData(model, data)
    data.qpos[:] = target
    for _ in range(_SAG_ROUNDS):
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_rne(model, data, 0, data.qfrc_bias)
        data.qpos[:] = target - data.qfrc_bias / stiffness
    return np.array(data.qpos)


def full_states(model: mujoco.MjModel, positions: Array) -> Array:
    """States at rest at given positions, shapes (n, nq) to (n, state size)."""
    full = mujoco.mjtState.mjSTATE_FULLPHYSICS
    state = np.zeros((len(positions), mujoco.mj_stateSize(model, full)))
    # Full physics begins with time, then qpos, then qvel.
    state[:, 1 : 1 + model.nq] = positions
    return state


def roll(
    pool: mujoco.rollout.Rollout,
    models: Sequence[mujoco.MjModel],
    data: Sequence[mujoco.MjData],
    positions: Array,
    control: Array,
) -> Array:
    """Positions at the start of each step and after the last, shape (n, steps + 1, nq).

    Args:
        pool: Threads.
        models: One a run.
        data: One a thread.
        positions: Positions at rest that the runs begin at, shape (n, nq).
        control: Commands, shape (n, steps, nu).
    """
    nq, state = models[0].nq, full_states(models[0], positions)
    after, _ = pool.rollout(
        models,
        data,
        state,
        control,
        nstep=control.shape[1],
        skip_checks=False,
        control_spec=mujoco.mjtState.mjSTATE_CTRL.value,
    )
    return np.concatenate([state[:, None], after], axis=1)[..., 1 : 1 + nq]


class JointTestRig(Closing):
    """One joint on the test rig, the original of a mirrored family, with many gain pairs."""

    def __init__(
        self,
        robot: RobotSpec,
        joint: str,
        *,
        armature: float | None = None,
        frictionloss: float | None = None,
        threads: int = 2,
        chunk: int = CHUNK,
    ) -> None:
        """Compile the model.

        Args:
            robot: The robot.
            joint: The joint to excite; the original of a mirrored family.
            armature: Rotor inertia of the excited joint [kg m^2]; the drive's if not given.
            frictionloss: Dry friction of the excited joint [N m]; the drive's if not given.
            threads: Threads of the simulator.
            chunk: Simulations in flight at once.
        """
        self.robot = robot
        self.joint = robot.joint(joint)
        spec = bench_spec(
            robot,
            joint,
            armature=None if armature is None else {joint: armature},
            frictionloss=None if frictionloss is None else {joint: frictionloss},
        )
        spec.add_sensor(
            name="excited",
            type=mujoco.mjtSensor.mjSENS_JOINTPOS,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=joint,
        )
        self.model = spec.compile()
        self.chain = tuple(self.model.joint(i).name for i in range(self.model.njnt))
        if joint not in self.chain:
            raise RobotError(f"the bench model of {joint} holds {', '.join(self.chain)} instead.")
        self.index = self.chain.index(joint)
        self.threads = threads
        self.chunk = chunk
        self.count = Count()
        self._stiffness = np.array([robot.joint(name).stiffness for name in self.chain])
        self._sensor = int(self.model.sensor_adr[self.model.sensor("excited").id])
        # One actuator a joint; map joint order to the columns of ctrl.
        self._ctrl = np.array([self.model.actuator(name).id for name in self.chain])
        self._models: list[mujoco.MjModel] = []
        self._passive_set = False
        self._data = [mujoco.MjData(self.model) for _ in range(threads)]
        self._pool = mujoco.rollout.Rollout(nthread=threads if threads > 1 else 0)

    def close(self) -> None:
        """Stop the threads."""
        self._pool.close()

    def pose(self, trace: CommandTrace) -> Array:
        """Where the chain of this model is held for a trace [rad], shape (chain,)."""
        chain = self.robot.joint(self.joint.name).chain or (self.joint.name,)
        by_name = dict(zip(chain, original_pose(trace, self.robot), strict=True))
        return np.array(
            [by_name.get(name, self.robot.joint(name).default_position) for name in self.chain]
        )

    @property
    def actuator(self) -> int:
        """Column of the excited joint's command."""
        return int(self._ctrl[self.index])

    def control(self, pose: Array) -> Array:
        """Commands that hold the chain at a pose [rad], shape (actuators,)."""
        out = np.zeros(self.model.nu)
        out[self._ctrl] = pose
        return out

    def torque_model(self) -> mujoco.MjModel:
        """A copy whose excited joint takes a torque [N m] and has no dry friction of its own."""
        model = copy.copy(self.model)
        i = self.actuator
        model.actuator_gaintype[i] = mujoco.mjtGain.mjGAIN_FIXED
        model.actuator_biastype[i] = mujoco.mjtBias.mjBIAS_NONE
        model.actuator_dyntype[i] = mujoco.mjtDyn.mjDYN_NONE
        model.actuator_gainprm[i] = 0.0
        model.actuator_gainprm[i, 0] = 1.0
        model.actuator_ctrllimited[i] = False
        model.actuator_forcelimited[i] = False
        model.dof_frictionloss[self.index] = 0.0
        return model

    def _equilibrium(self, target: Array, stiffness: float) -> Array:
        """Positions at rest with the drives at a target: what gravity leaves, shape (chain,)."""
        gains = self._stiffness.copy()
        gains[self.index] = stiffness
        return rest_position(self.model, self._data[0], target, gains)

    def run(
        self,
        commands: Sequence[Array],
        poses: Sequence[Array],
        stiffness: Array,
        damping: Array,
        *,
        armature: Array | None = None,
        frictionloss: Array | None = None,
    ) -> Iterator[tuple[slice, Array]]:
        """Yield the excited joint's positions a chunk at a time; see `JointRig.run`."""
        total, steps = len(stiffness), len(commands[0])
        size = min(self.chunk, total)
        while len(self._models) < size:
            self._models.append(copy.copy(self.model))
        control = np.empty((size, steps, self.model.nu))
        sensor = np.empty((size, steps, self.model.nsensordata))
        initial = full_states(self.model, np.zeros((size, self.model.nq)))
        centre = np.empty(size)
        shared = len(commands) == 1 and len(poses) == 1
        rest: dict[float, Array] = {}
        for begin in range(0, total, size):
            part = slice(begin, min(begin + size, total))
            n = part.stop - part.start
            for row, i in enumerate(range(part.start, part.stop)):
                kp = float(stiffness[i])
                set_drive_gains(
                    self._models[row], self.joint.name, self.joint.drive, kp, float(damping[i])
                )
                if self._passive_set or armature is not None or frictionloss is not None:
                    self._set_passive(self._models[row], i, armature, frictionloss)
                if not shared or begin == 0:
                    pose = poses[0 if len(poses) == 1 else i]
                    centre[row] = pose[self.index]
                    control[row][:, self._ctrl] = pose
                    control[row][:, self.actuator] += commands[0 if len(commands) == 1 else i]
                if not shared or kp not in rest:
                    rest[kp] = self._equilibrium(control[row][0, self._ctrl], kp)
                initial[row, 1 : 1 + self.model.nq] = rest[kp]
            before = time.perf_counter()
            self._pool.rollout(
                self._models[:n],
                self._data,
                initial[:n],
                control[:n],
                sensordata=sensor[:n],
                nstep=steps,
                skip_checks=True,
                control_spec=mujoco.mjtState.mjSTATE_CTRL.value,
            )
            self.count.seconds += time.perf_counter() - before
            self.count.steps += n * steps
            yield part, sensor[:n, :, self._sensor] - centre[:n, None]
        self._passive_set = armature is not None or frictionloss is not None

    def _set_passive(
        self, model: mujoco.MjModel, i: int, armature: Array | None, frictionloss: Array | None
    ) -> None:
        """Give a model the armature and friction of simulation i, or the rig's own."""
        own = self.model.dof_armature[self.index], self.model.dof_frictionloss[self.index]
        set_passive(
            model,
            self.joint.name,
            armature=float(own[0] if armature is None else armature[i]),
            frictionloss=float(own[1] if frictionloss is None else frictionloss[i]),
        )


def rig_on(device: str) -> Callable[..., JointTestRig]:
    """The class of the rig for one of `DEVICES`; PronkError if it cannot be used here."""
    if device not in DEVICES:
        raise PronkError(f"device {device!r}; expected one of {', '.join(DEVICES)}.")
    if device == "cpu":
        return JointTestRig
    try:
        from pronk.simulators.warp import WarpTestRig, find_device
    except ModuleNotFoundError as error:
        raise PronkError(
            f'device "{device}" needs MuJoCo Warp, and {error.name} is not installed; '
            'pip install "pronk[train]", or use device "cpu".'
        ) from error
    find_device(device)
    return partial(WarpTestRig, device=device)


def mujoco_info(robot: RobotSpec) -> SimulatorInfo:
    """Describe the training simulator of a robot."""
    return SimulatorInfo(
        version=mujoco.__version__, timestep_s=robot.timestep_s, decimation=robot.decimation
    )


class MujocoSimulator(Closing):
    """A robot's joints in MuJoCo, each branch on a fixed base; models are compiled once.

    `rig` is the fast path: one joint, many gain pairs, on CPU threads or (MuJoCo Warp) a GPU.
    """

    def __init__(
        self,
        robot: RobotSpec,
        *,
        armature: float | None = None,
        threads: int = 2,
        device: str = "cpu",
    ) -> None:
        """Prepare for rigs with `armature` [kg m^2] at the excited joint; the drive's if None."""
        self.robot = robot
        self.info = mujoco_info(robot)
        self.joints = robot.joint_names
        self.parameters = frozenset(PARAMETERS)
        self._new_rig = rig_on(device)
        self._device = device
        self._armature = armature
        self._threads = threads
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
            self._rigs[original] = self._new_rig(
                self.robot, original, armature=self._armature, threads=self._threads
            )
        return self._rigs[original]

    def without_armature(self) -> MujocoSimulator:
        """The same with no rotor inertia at the excited joint."""
        return MujocoSimulator(self.robot, armature=0.0, threads=self._threads, device=self._device)

    def rollout(
        self, command: Array, values: Mapping[str, Array], *, locked: Sequence[str] = ()
    ) -> Array:
        """Simulate B runs from rest at the first command; see `Simulator.rollout`."""
        if unknown := set(values) - self.parameters:
            raise PronkError(
                f"MuJoCo sets {', '.join(PARAMETERS)}, not {', '.join(sorted(unknown))}."
            )
        out = np.repeat(command[:, :1], command.shape[1], axis=1)
        left = [name for name in self.joints if name not in locked]
        while left:
            # Branches do not feel each other: take the shortest chain with most of the joints.
            root = max(
                (j for j in self.robot.joints if left[0] in (j.chain or (j.name,))),
                key=lambda joint: (len(set(joint.chain) & set(left)), -len(joint.chain)),
            )
            columns = [self.joints.index(name) for name in root.chain or (root.name,)]
            chosen = {name: array[:, columns] for name, array in values.items()}
            out[..., columns] = self._chain(root.name, columns, command[..., columns], chosen)
            left = [name for name in left if self.joints.index(name) not in columns]
        return out

    def _chain(
        self, root: str, columns: list[int], command: Array, values: Mapping[str, Array]
    ) -> Array:
        """Simulate one chain whose joints all have commands, shape (B, T, chain)."""
        model = bench_spec(self.robot, root).compile()
        names = [self.joints[k] for k in columns]
        runs, steps = command.shape[:2]
        control = np.zeros((runs, steps, model.nu))
        rest = np.zeros((runs, model.nq))
        models = [copy.copy(model) for _ in range(runs)]
        data = mujoco.MjData(model)
        edges = self.robot.timestep_s * np.arange(steps + 1)
        address = [int(model.joint(name).qposadr[0]) for name in names]
        for b, one in enumerate(models):
            stiffness = np.empty(model.nv)
            for k, name in enumerate(names):
                joint = self.robot.joint(name)
                own = {parameter: float(array[b, k]) for parameter, array in values.items()}
                kp = own.get("stiffness", joint.stiffness)
                stiffness[address[k]] = kp
                set_drive_gains(one, name, joint.drive, kp, own.get("damping", joint.damping))
                passive = own.get("armature"), own.get("frictionloss")
                set_passive(one, name, armature=passive[0], frictionloss=passive[1])
                track = command[b, :, k]
                if delay := own.get("delay", 0.0):
                    track = held_mean(edges[:-1], track, edges - delay)
                control[b, :, model.actuator(name).id] = track
            target = np.empty(model.nq)
            target[address] = command[b, 0]
            rest[b] = rest_position(one, data, target, stiffness)
        with mujoco.rollout.Rollout(nthread=0) as pool:
            return roll(pool, models, [data], rest, control)[:, :-1, address]

    @property
    def count(self) -> Count:
        """Steps and seconds of all rigs together."""
        counts = [rig.count for rig in self._rigs.values()]
        return Count(sum(count.steps for count in counts), sum(count.seconds for count in counts))


def simulate(
    robot: RobotSpec, trace: CommandTrace, stiffness: ArrayLike, damping: ArrayLike, **options: Any
) -> Array:
    """Simulate one command in the training simulator with many gain pairs; see `play`.

    It begins at rest where gravity leaves the joint with its first command. Gains [N m/rad,
    N m s/rad] are scalars or of shape (b,); `options` are those of `JointTestRig`.
    """
    kp, kd = np.broadcast_arrays(
        np.atleast_1d(np.asarray(stiffness, dtype=np.float64)),
        np.atleast_1d(np.asarray(damping, dtype=np.float64)),
    )
    with JointTestRig(robot, robot.joint(trace.joint).original[0], **options) as rig:
        return play(rig, trace, kp, kd)
