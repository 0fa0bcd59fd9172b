"""The test rig on a GPU: thousands of gain pairs at once in MuJoCo Warp.

Model and commands are those of `pronk.identify.simulators.mujoco.JointTestRig`; MuJoCo Warp
computes in single precision and stops its solver at a tolerance of 1e-6 instead of 1e-8. With the
paper's chirp on the Mini Cheetah (measured on Warp's CPU device, all 2,500 nodes) the median node's
largest difference is 3e-7 rad, the best cell is the same and its response agrees within 1e-5 dB.
Only a stiff knee with little damping, which this chirp makes chaotic, differs visibly: by 0.09 rad
and 0.3 dB at the corner 27 N m/rad, 0.1 N m s/rad, where rounding the command to single precision
moves the double precision just as far.

A step costs a GPU about the same for one simulation as for thousands. So the grid is stepped
there; runs of fewer than `LEAST` simulations (the refinement, which takes differences between
neighbouring gains) and implicit drive laws stay on the processor, in double precision.

Imported only when used: it needs the extra `pronk[train]`.
"""

from __future__ import annotations

import copy
import gc
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import mujoco
import mujoco_warp
import numpy as np
import warp as wp
from numpy.typing import NDArray

from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.identify.simulators.command_trace import CommandTrace
from pronk.identify.simulators.mujoco import JointTestRig
from pronk.identify.simulators.simulator import Values
from pronk.robots.drive_law import EXPLICIT
from pronk.robots.model import set_drive_gains
from pronk.robots.robot import RobotSpec

LEAST = 200
"""Fewer simulations than this run on the processor: a 20 s chirp takes an H200 1.0 s for 10
simulations as for 500 (measured), and two cores have simulated some 200 by then."""
MOST = 8192
"""Simulations in flight at once: 8,192 x 5,000 steps are 160 MB on the device, or twice that when
each has its own command."""
_GRAPH_DRIVER = (12, 4)  # CUDA driver from which a captured step may hold the solver's loop

wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)


def _before_step(
    joint: int,
    actuator: int,
    target: wp.array2d[float],
    qpos: wp.array2d[float],
    clock: wp.array[int],
    ctrl: wp.array2d[float],
    position: wp.array2d[float],
) -> None:
    """Store the excited joint's position and set the command of this step.

    Every world keeps its own clock, so a captured step needs nothing from the host.
    """
    world = wp.tid()
    step = clock[world]
    position[step, world] = qpos[world, joint]
    ctrl[world, actuator] = target[step, world % target.shape[1]]
    clock[world] = step + 1


_READ_AND_COMMAND = wp.kernel(_before_step)


class WarpTestRig(JointTestRig):
    """A rig whose large runs are stepped by MuJoCo Warp."""

    def __init__(
        self,
        robot: RobotSpec,
        joint: str,
        *,
        device: Any,
        least: int = LEAST,
        **options: Any,
    ) -> None:
        """Compile the model; the device is Warp's, `options` are those of `JointTestRig`."""
        self._device = device
        super().__init__(robot, joint, **options)
        self._least = least
        self._worlds: _Worlds | None = None

    def close(self) -> None:
        """Stop the threads and give the device's memory back."""
        super().close()
        self._worlds = None

    def run(
        self, traces: Sequence[CommandTrace], values: Values, steps: int
    ) -> Iterator[tuple[slice, Array]]:
        """Yield the excited joint's positions a chunk at a time; see `JointRigs.run`."""
        total = len(values["stiffness"])
        gains_alone = set(values) == {"stiffness", "damping"}
        if total < self._least or not gains_alone or self.robot.law != EXPLICIT:
            yield from super().run(traces, values, steps)
            return
        for begin in range(0, total, MOST):
            batch = slice(begin, min(begin + MOST, total))
            own = traces if len(traces) == 1 else traces[batch]
            excited = [trace.excitation(self.robot, steps) for trace in own]
            raw = self._step(excited, values["stiffness"][batch], values["damping"][batch])
            self.steps += raw.size
            centre = np.array([pose[self.index] for pose, _ in excited])
            for first in range(0, raw.shape[1], self.chunk):
                part = slice(first, min(first + self.chunk, raw.shape[1]))
                about = centre if len(centre) == 1 else centre[part]
                position = raw[:, part].T.astype(np.float64) - about[:, None]
                yield slice(begin + part.start, begin + part.stop), position

    def _step(
        self, excited: Sequence[tuple[Array, Array]], stiffness: Array, damping: Array
    ) -> NDArray[np.float32]:
        """Positions of the excited joint [rad], shape (steps, n), all simulated at once.

        `excited` holds pose and command (`CommandTrace.excitation`), one for all or one each.
        """
        count, steps, ways = len(stiffness), len(excited[0][1]), len(excited)
        shared = ways == 1
        control = np.array([self.control(pose) for pose, _ in excited])
        target = np.stack([pose[self.index] + command for pose, command in excited], axis=1)
        gains = np.empty((count, *self.model.actuator_gainprm.shape))
        start = np.empty((count, self.model.nq))
        scratch = copy.copy(self.model)
        rest: dict[float, Array] = {}
        for i, (kp, kd) in enumerate(zip(stiffness.tolist(), damping.tolist(), strict=True)):
            set_drive_gains(scratch, self.joint.name, self.joint.drive, kp, kd)
            gains[i] = scratch.actuator_gainprm
            if not shared or kp not in rest:
                first = control[i % ways].copy()
                first[self.actuator] = target[0, i % ways]
                rest[kp] = self.equilibrium(first[self._columns], kp)
            start[i] = rest[kp]
        worlds = self._worlds
        if worlds is None or not worlds.fits(count, steps, shared):
            self._worlds = None  # gives the memory back before more is taken
            worlds = self._worlds = _Worlds(self, self._device, count, steps, shared)
        return worlds.run(start, gains, control, target)


class _Worlds:
    """Memory on the device for so many simulations of one rig, and the captured step."""

    def __init__(
        self, rig: JointTestRig, device: Any, count: int, steps: int, shared: bool
    ) -> None:
        self._device, self._count, self._steps, self._shared = device, count, steps, shared
        model = copy.copy(rig.model)
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
        # Rows of friction, limits and equalities; there are no contacts on the rig.
        rows = model.nv + 2 * model.njnt + 6 * model.neq
        with wp.ScopedDevice(device):
            self._model = mujoco_warp.put_model(model)
            self._data = mujoco_warp.put_data(
                model, mujoco.MjData(model), nworld=count, nconmax=0, njmax=rows
            )
            kind = self._model.actuator_gainprm.dtype
            self._model.actuator_gainprm = wp.zeros((count, model.nu), dtype=kind)
            self._clock = wp.zeros(count, dtype=int)
            self._target = wp.zeros((steps, 1 if shared else count), dtype=float)
            self._position = wp.zeros((steps, count), dtype=float)
            self._inputs = (int(model.jnt_qposadr[rig.index]), rig.actuator)
            # Kernels are compiled and loaded by this step; none of that may be captured.
            self._step()
            self._graph = self._capture()

    def fits(self, count: int, steps: int, shared: bool) -> bool:
        """True if a run of this size needs no more memory and is excited alike."""
        return self._shared == shared and count <= self._count and steps <= self._steps

    def run(self, start: Array, gains: Array, control: Array, target: Array) -> NDArray[np.float32]:
        """Position of the excited joint at the start of each step, shape (steps, n).

        Shapes: positions at rest (n, nq), parameters of the actuators (n, nu, parameters), commands
        of the joints that are held (1 or n, nu) and of the excited one (steps, 1 or n).
        """
        steps, count = len(target), len(start)
        # Worlds to spare repeat the last simulation; commands to spare are never reached.
        spare = np.minimum(np.arange(self._count), count - 1)
        ways = slice(None) if self._shared else spare
        held = np.zeros((self._steps, target.shape[1]))
        held[:steps] = target
        with wp.ScopedDevice(self._device):
            self._data.qpos.assign(start[spare].astype(np.float32))
            own = np.broadcast_to(control[ways], (self._count, control.shape[1]))
            self._data.ctrl.assign(own.astype(np.float32))
            self._data.qvel.zero_()
            self._data.qacc_warmstart.zero_()
            self._data.time.zero_()
            self._model.actuator_gainprm.assign(gains[spare].astype(np.float32))
            self._target.assign(held[:, ways].astype(np.float32))
            self._clock.zero_()
            step = partial(wp.capture_launch, self._graph) if self._graph else self._step
            for _ in range(steps):
                step()
            return np.asarray(self._position.numpy()[:steps, :count])

    def _step(self) -> None:
        """Read, command, step."""
        inputs = [*self._inputs, self._target, self._data.qpos, self._clock]
        outputs = [self._data.ctrl, self._position]
        wp.launch(_READ_AND_COMMAND, dim=self._count, inputs=inputs, outputs=outputs)
        mujoco_warp.step(self._model, self._data)

    def _capture(self) -> Any:
        """The step as a CUDA graph; None where it cannot be captured."""
        if (
            not self._device.is_cuda
            or not wp.is_mempool_enabled(self._device)
            or (wp.get_cuda_driver_version() or (0, 0)) < _GRAPH_DRIVER
        ):
            return None
        # Destroying an old graph meanwhile would be captured as well.
        collecting = gc.isenabled()
        gc.disable()
        try:
            with wp.ScopedCapture() as capture:
                self._step()
        finally:
            if collecting:
                gc.enable()
        return capture.graph


def find_device(name: str) -> Any:
    """The Warp device called `cuda` or `warp-cpu`; PronkError if there is no CUDA device."""
    if name == "warp-cpu":
        return wp.get_device("cpu")
    if not wp.is_cuda_available():
        raise PronkError(
            'device "cuda" needs an NVIDIA GPU and its driver, and no CUDA device was found; use '
            'device "cpu".'
        )
    return wp.get_device("cuda")
