"""Replay a log that the fit never saw, with naive and with matched gains.

The commands of the log go to the training simulator, held from each measured timestamp to the
next, and the simulated position is read at the measured timestamps. The naive column is the very
same simulation with the gains on the real drive (the log's, or else the robot's published
figures) put into the simulator, with no delay; a third column gives it the delay of the matched
gains. No column gets a zero offset: an encoder that is off costs all the same.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from pronk.errors import LogError, PronkError
from pronk.logs.joint_log import JointLog, Segment
from pronk.match.arm import drives_of
from pronk.match.gains import JointGains, MatchedGains
from pronk.match.measured_joint import gains_on_drive
from pronk.match.prediction import JointPrediction, Prediction
from pronk.response.grid import held_mean
from pronk.robots.robot import Robot
from pronk.simulators.chain import ChainSimulation, JointDrive, moves_together
from pronk.simulators.command_trace import CommandTrace, command_trace
from pronk.simulators.simulator import JointRigs, joint_rigs, play

Array = NDArray[np.float64]


def predict(
    log: JointLog,
    robot: Robot,
    gains: MatchedGains,
    *,
    threads: int = 2,
    simulator: str = "mujoco",
) -> Prediction:
    """Simulate a log with naive and with matched gains.

    Where several joints move at once the whole arm is simulated; otherwise each segment of each
    joint by itself, the rest held as on the rig.

    Args:
        log: What to replay; any signal.
        robot: The robot.
        gains: Matched gains of the joints to replay.
        threads: Threads of the simulator.
        simulator: What to replay in; see `pronk.simulators.simulator.load_simulator`.

    Raises:
        LogError: The log excites no joint that has matched gains, or the robots differ.
        PronkError: The simulator is unknown, or cannot replay joints that move together.
    """
    if gains.robot != robot.name:
        raise LogError(f"the gains are those of {gains.robot}, not of {robot.name}.")
    if moves_together(log):
        if simulator != "mujoco":
            raise PronkError(
                f"{log.source or 'log'}: several joints move at once, which only simulator mujoco "
                f"replays, not {simulator}."
            )
        return _arm(log, robot, gains, threads)
    with joint_rigs(simulator, robot, threads=threads) as rigs:
        return _joint_by_joint(log, rigs, gains)


def _arm(log: JointLog, robot: Robot, gains: MatchedGains, threads: int) -> Prediction:
    """The whole arm at once."""
    matched = drives_of(robot, gains)
    with ChainSimulation(robot, [log], threads=threads) as rig:
        naive = {name: _on_drive(log, robot, name) for name in rig.joints}
        late = {
            name: replace(drive, delay=matched[name].delay) if name in matched else drive
            for name, drive in naive.items()
        }
        (best,), (plain,), (delayed,) = rig.run([matched, naive, late])
        excluded = dict(rig.excluded)
        names = rig.joints
    kinds = {name: s.kind for s in log.segments for name in s.joints}
    out = []
    for i, name in enumerate(names):
        if name not in gains.joints:
            excluded[name] = _without_gains(name)
            continue
        column = log.column(name)
        out.append(
            JointPrediction(
                joint=name,
                time=log.time,
                command=log.command[:, column],
                measured=log.position[:, column],
                naive=plain[:, i],
                naive_delayed=delayed[:, i],
                matched=best[:, i],
                signal=kinds.get(name, "unknown"),
            )
        )
    return _prediction(log, out, excluded)


def _joint_by_joint(log: JointLog, rigs: JointRigs, gains: MatchedGains) -> Prediction:
    """One joint after the other, segment by segment."""
    robot = rigs.robot
    out, excluded = [], {}
    segments = log.segments or _single(log)
    excited = {name for segment in segments for name in segment.joints}
    for name in robot.joint_names:
        if name not in excited:
            continue
        if name not in gains.joints:
            excluded[name] = _without_gains(name)
            continue
        mine = [segment for segment in segments if name in segment.joints]
        parts = [
            _replay(log.cut(one), one, name, rigs, gains.joints[name])
            for one in sorted(mine, key=lambda segment: segment.start)
        ]
        joined = [np.concatenate(columns) for columns in zip(*parts, strict=True)]
        out.append(
            JointPrediction(
                joint=name,
                time=joined[0],
                command=joined[1],
                measured=joined[2],
                naive=joined[3],
                naive_delayed=joined[4],
                matched=joined[5],
                signal=mine[0].kind,
            )
        )
    return _prediction(log, out, excluded)


def _replay(
    part: JointLog,
    segment: Segment,
    name: str,
    rigs: JointRigs,
    gains: JointGains,
) -> tuple[Array, ...]:
    """Time, command, measured, naive, naive with the delay and matched position of a segment."""
    robot, rig = rigs.robot, rigs.rig(name)
    trace = command_trace(part, segment, name, robot)
    late = _delayed(trace, gains.delay_s)
    real = _on_drive(part, robot, name)
    gains_of_drive = np.array([real.stiffness]), np.array([real.damping])
    own = {
        "armature": np.array([gains.armature]),
        "frictionloss": np.array(
            [
                robot.joint(name).drive.frictionloss
                if np.isnan(gains.frictionloss)
                else gains.frictionloss
            ]
        ),
    }
    naive, naive_delayed = (play(rig, one, *gains_of_drive)[0] for one in (trace, late))
    matched = play(
        rig,
        late,
        np.array([gains.stiffness]),
        np.array([gains.damping]),
        **{k: v for k, v in own.items() if k in rigs.parameters},
    )[0]
    # The last state is that at the start of the last step: no sample may lie beyond it.
    inside = (part.time >= trace.time[0]) & (part.time <= trace.time[-1])
    time, column = part.time[inside], part.column(name)
    simulated = (
        np.asarray(CubicSpline(trace.time, one)(time)) for one in (naive, naive_delayed, matched)
    )
    return time, part.command[inside, column], part.position[inside, column], *simulated


def _delayed(trace: CommandTrace, delay: float) -> CommandTrace:
    """The trace with its command delayed [s]."""
    if delay == 0.0:
        return trace
    edges = np.append(trace.time, trace.time[-1] + trace.timestep) - delay
    return replace(trace, command=held_mean(trace.time, trace.command, edges))


def _on_drive(log: JointLog, robot: Robot, name: str) -> JointDrive:
    """The published drive, with the gains that were on it."""
    stiffness, damping = gains_on_drive(log, name, robot)
    return replace(JointDrive.published(robot, name), stiffness=stiffness, damping=damping)


def _single(log: JointLog) -> tuple[Segment, ...]:
    """The whole log as one segment of those whose command moves."""
    moving = np.ptp(log.command, axis=0) > 0.0
    names = tuple(name for name, moves in zip(log.joints, moving, strict=True) if moves)
    if not names:
        return ()
    return (
        Segment(
            kind="unknown",
            joints=names,
            start=float(log.time[0]),
            stop=float(log.time[-1]),
            amplitude=float("nan"),
        ),
    )


def _without_gains(name: str) -> str:
    return (
        f"{name} is left out: the gains have no entry for it; match a log in which it is excited."
    )


def _prediction(
    log: JointLog, joints: list[JointPrediction], excluded: dict[str, str]
) -> Prediction:
    if not joints:
        reasons = " ".join(excluded.values()) or "no joint is excited in it."
        raise LogError(f"{log.source or 'log'}: nothing to replay; {reasons}")
    return Prediction(
        joints=tuple(joints), source=log.source, virtual=log.virtual, excluded=excluded
    )
