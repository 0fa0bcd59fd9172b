"""A sweep of the training simulator itself, written down as a log.

The truth of such a log is known exactly: the match must find it again. Used by the known-truth
tests, by the comparison of engine detail and by the benchmark.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from pronk.logs.joint_log import Segment, SweepLog
from pronk.robots.robot import Robot
from pronk.simulators.command_trace import CommandTrace
from pronk.simulators.mujoco import simulate
from pronk.simulators.simulator import JointRigs, play

Array = NDArray[np.float64]


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


def synthetic_log(
    robot: Robot,
    joint: str,
    asks: Sequence[Excitation],
    stiffness: float,
    damping: float,
    *,
    rate_hz: float = 500.0,
    noise: Sequence[Array] | None = None,
    armature: float | None = None,
    frictionloss: float | None = None,
    held_stiffness: Mapping[str, float] | None = None,
    held_damping: Mapping[str, float] | None = None,
    simulator: JointRigs | None = None,
    threads: int = 2,
) -> SweepLog:
    """Sweep one joint of the training simulator with known gains.

    Args:
        robot: The robot; with a finer `timestep_s` (and more `decimation`) a finer simulator.
        joint: The joint to ask.
        asks: Signals, asked one after the other.
        stiffness: Gain of the asked joint [N m/rad].
        damping: Gain of the asked joint [N m s/rad].
        rate_hz: Rate of the log [Hz].
        noise: Added to the position of the joint [rad], one array a segment in the order of the
            log (ask by ask, repeat by repeat), each at least as long as the segment.
        armature: Rotor inertia of the asked joint [kg m^2]; the drive's if not given.
        frictionloss: Dry friction of the asked joint [N m]; the drive's if not given.
        held_stiffness: Gains of the joints that are held; the robot's if not given.
        held_damping: Gains of the joints that are held; the robot's if not given.
        simulator: Rigs of another simulator, which then also gives the timestep.
        threads: Threads of the simulator.

    Returns:
        A log of this joint alone, `stiffness` and `damping` being those of the robot's drive (what
        a match would be told), not those simulated.
    """
    if simulator is not None:
        robot = simulator.robot
    asked = robot.joint(joint)
    pose = np.array([j.default_position for j in robot.joints])
    centre = asked.default_position
    tick = robot.timestep_s * robot.decimation
    per_tick = round(tick * rate_hz)
    rate = per_tick / tick
    commands, positions = [], []
    segments: list[Segment] = []
    begin = 0
    for ask in asks:
        rest = np.zeros(round(ask.settle_s / tick))
        ticks = centre + np.concatenate([rest, ask.offsets, rest])
        question = CommandTrace(
            joint=joint,
            start=0.0,
            timestep=robot.timestep_s,
            command=np.repeat(ticks, robot.decimation),
            pose=pose,
            amplitude=float(np.abs(ask.offsets).max()),
        )
        if simulator is not None:
            rig = simulator.rig(joint)
            answer = play(rig, question, np.array([stiffness]), np.array([damping]))[0]
        else:
            answer = simulate(
                robot,
                question,
                stiffness,
                damping,
                armature=armature,
                frictionloss=frictionloss,
                held_stiffness=held_stiffness,
                held_damping=held_damping,
                threads=threads,
            )[0]
        count = len(ticks) * per_tick
        times = np.minimum(np.arange(count) / rate, question.time[-1])
        position = make_interp_spline(question.time, answer, k=3)(times)
        for repeat in range(ask.repeats):
            extra = 0.0 if noise is None else noise[len(segments)][:count]
            commands.append(np.repeat(ticks, per_tick))
            positions.append(position + extra)
            segments.append(
                Segment(
                    kind=ask.kind,
                    joints=(joint,),
                    start=begin / rate,
                    stop=(begin + count - 1) / rate,
                    amplitude=question.amplitude,
                    repeat=repeat,
                    band_hz=ask.band_hz,
                    clamped=asked.clamped,
                )
            )
            begin += count
    return SweepLog(
        robot=robot.name,
        joints=(joint,),
        time=np.arange(begin) / rate,
        command=np.concatenate(commands)[:, None],
        position=np.concatenate(positions)[:, None],
        segments=tuple(segments),
        stiffness=np.array([asked.stiffness]),
        damping=np.array([asked.damping]),
        pose=np.array([centre]),
        virtual=True,
        source=f"rehearsal of {joint}",
    )
