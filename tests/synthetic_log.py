"""Logs of a simulator's own sweeps, whose gains are known exactly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import make_interp_spline
from scipy.signal import lfilter

from pronk.arrays import Array
from pronk.identify.logs.joint_log import JointLog, LogOrigin
from pronk.identify.logs.segment import Segment
from pronk.identify.simulators.command_trace import CommandTrace
from pronk.identify.simulators.mujoco import MujocoSimulator
from pronk.identify.simulators.simulator import JointRigs
from pronk.robots.robot import RobotSpec


@dataclass(frozen=True, kw_only=True)
class Excitation:
    """One signal to one joint."""

    offsets: Array
    """Command about the pose at each policy tick [rad], shape (ticks,)."""
    kind: str = "chirp"
    band_hz: tuple[float, float] = (0.1, 25.0)
    repeats: int = 1
    settle_s: float = 0.5
    """Rest before and after the signal [s]."""


def coloured_noise(
    rng: np.random.Generator,
    shape: tuple[int, ...],
    *,
    deviation: float,
    corner_hz: float,
    rate_hz: float,
) -> Array:
    """Stationary first-order autoregressive noise along the last axis.

    `x[k+1] = a x[k] + sqrt(1 - a^2) deviation w[k]` with `a = exp(-2 pi corner / rate)`, begun in
    its stationary distribution.
    """
    a = float(np.exp(-2.0 * np.pi * corner_hz / rate_hz))
    white = rng.standard_normal(shape)
    white[..., 1:] *= np.sqrt(1.0 - a * a)
    return np.asarray(deviation * lfilter([1.0], [1.0, -a], white, axis=-1))


def simulate(
    robot: RobotSpec,
    trace: CommandTrace,
    stiffness: ArrayLike,
    damping: ArrayLike,
    *,
    armature: float | None = None,
    frictionloss: float | None = None,
    threads: int = 2,
) -> Array:
    """Simulate one command in the training simulator with many gain pairs; see `JointRigs.play`.

    It begins at rest where gravity leaves the joint with its first command. Gains [N m/rad,
    N m s/rad] are scalars or of shape (b,); the drive's armature and friction if None.
    """
    stiffness_values, damping_values = np.broadcast_arrays(
        np.atleast_1d(stiffness), np.atleast_1d(damping)
    )
    values = {
        "stiffness": np.asarray(stiffness_values, dtype=np.float64),
        "damping": np.asarray(damping_values, dtype=np.float64),
    }
    runs = len(values["stiffness"])
    if armature is not None:
        values["armature"] = np.full(runs, armature)
    if frictionloss is not None:
        values["frictionloss"] = np.full(runs, frictionloss)
    with MujocoSimulator(robot, threads=threads) as simulator:
        return simulator.play(trace, values)


def synthetic_log(
    robot: RobotSpec,
    joint: str,
    excitations: Sequence[Excitation],
    stiffness: float | Array,
    damping: float | Array,
    *,
    rate_hz: float = 500.0,
    noise: Sequence[Array] | None = None,
    delay_s: float = 0.0,
    simulator: JointRigs | None = None,
    armature: float | None = None,
    frictionloss: float | None = None,
    threads: int = 2,
) -> JointLog:
    """Sweep one joint of the training simulator with known gains.

    Args:
        robot: The robot; with a finer `timestep_s` (and more `decimation`) a finer simulator.
        joint: The joint to excite.
        excitations: Signals, one after the other.
        stiffness: Stiffness of the excited joint [N m/rad], one value or one for each repeat.
        damping: Damping of the excited joint [N m s/rad], one value or one for each repeat.
        rate_hz: Rate of the log [Hz].
        noise: Added to the position of the joint [rad], one array a segment in the order of the
            log (signal by signal, repeat by repeat), each at least as long as the segment.
        delay_s: Delay from a command to its effect [s], not necessarily whole steps.
        simulator: Rigs of another simulator, which then also gives the timestep.
        armature: Armature of the joint [kg m^2]; the drive's if None.
        frictionloss: Dry friction of the joint [N m]; the drive's if None.
        threads: Simulations at the same time.

    Returns:
        A log of this joint alone; its `stiffness` and `damping` are those of the robot's drive, not
        those simulated.
    """
    if simulator is not None:
        robot = simulator.robot
    excited_joint = robot.joint(joint)
    centre = excited_joint.default_position
    tick = robot.timestep_s * robot.decimation
    samples_per_tick = round(tick * rate_hz)
    rate = samples_per_tick / tick
    commands = []
    positions = []
    segments: list[Segment] = []
    begin = 0
    for excitation in excitations:
        settling = np.zeros(round(excitation.settle_s / tick))
        ticks = centre + np.concatenate([settling, excitation.offsets, settling])
        trace = CommandTrace(
            joint=joint,
            start=0.0,
            timestep=robot.timestep_s,
            command=np.repeat(ticks, robot.decimation),
            pose=np.array([robot_joint.default_position for robot_joint in robot.joints]),
            amplitude=float(np.abs(excitation.offsets).max()),
        )
        if simulator is not None:
            values = {"stiffness": np.atleast_1d(stiffness), "damping": np.atleast_1d(damping)}
            simulated = simulator.play(trace, values)
        else:
            simulated = simulate(
                robot,
                trace,
                stiffness,
                damping,
                armature=armature,
                frictionloss=frictionloss,
                threads=threads,
            )
        count = len(ticks) * samples_per_tick
        times = np.clip(np.arange(count) / rate - delay_s, 0.0, trace.time[-1])
        position = make_interp_spline(trace.time, simulated, k=3, axis=1)(times)
        for repeat in range(excitation.repeats):
            recorded = position[repeat % len(position)]
            if noise is not None:
                recorded = recorded + noise[len(segments)][:count]
            commands.append(np.repeat(ticks, samples_per_tick))
            positions.append(recorded)
            segment = Segment(
                kind=excitation.kind,
                joints=(joint,),
                start=begin / rate,
                stop=(begin + count - 1) / rate,
                amplitude=trace.amplitude,
                repeat=repeat,
                band_hz=excitation.band_hz,
                clamped=excited_joint.clamped,
            )
            segments.append(segment)
            begin += count
    return JointLog(
        robot=robot.name,
        joints=(joint,),
        time=np.arange(begin) / rate,
        command=np.concatenate(commands)[:, None],
        position=np.concatenate(positions)[:, None],
        segments=tuple(segments),
        stiffness=np.array([excited_joint.stiffness]),
        damping=np.array([excited_joint.damping]),
        pose=np.array([centre]),
        origin=LogOrigin(source=f"synthetic log of {joint}", virtual=True),
    )
