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

from pronk.errors import LogError
from pronk.logs.joint_log import Segment, SweepLog
from pronk.match.arm.match import drives_of
from pronk.match.gains import JointGains, MatchedGains
from pronk.match.measured_joint import gains_on_drive
from pronk.match.prediction import JointPrediction, Prediction
from pronk.robots.robot import Robot
from pronk.simulators.chain import ChainSimulation, JointDrive, held_mean, moves_together
from pronk.simulators.command_trace import CommandTrace, command_trace
from pronk.simulators.mujoco import simulate

Array = NDArray[np.float64]


def predict(log: SweepLog, robot: Robot, gains: MatchedGains, *, threads: int = 2) -> Prediction:
    """Simulate a log with naive and with matched gains.

    Where several joints move at once the whole arm is simulated; otherwise each question to each
    joint by itself, the rest held as on the rig.

    Args:
        log: What to replay; any signal.
        robot: The robot.
        gains: Matched gains of the joints to replay.
        threads: Threads of the simulator.

    Raises:
        LogError: The log asks no joint that has matched gains, or the robots differ.
    """
    if gains.robot != robot.name:
        raise LogError(f"the gains are those of {gains.robot}, not of {robot.name}.")
    return (_arm if moves_together(log) else _bench)(log, robot, gains, threads)


def _arm(log: SweepLog, robot: Robot, gains: MatchedGains, threads: int) -> Prediction:
    """The whole arm at once."""
    matched = drives_of(robot, gains)
    with ChainSimulation(robot, [log], threads=threads) as rig:
        naive = {name: _on_drive(log, robot, name) for name in rig.joints}
        late = {
            name: replace(drive, delay=matched[name].delay) if name in matched else drive
            for name, drive in naive.items()
        }
        (answer,), (plain,), (delayed,) = rig.run([matched, naive, late])
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
                matched=answer[:, i],
                signal=kinds.get(name, "unknown"),
            )
        )
    return _prediction(log, out, excluded)


def _bench(log: SweepLog, robot: Robot, gains: MatchedGains, threads: int) -> Prediction:
    """One joint after the other, question by question."""
    out, excluded = [], {}
    segments = log.segments or _single(log)
    asked = {name for segment in segments for name in segment.joints}
    for name in robot.joint_names:
        if name not in asked:
            continue
        if name not in gains.joints:
            excluded[name] = _without_gains(name)
            continue
        mine = [segment for segment in segments if name in segment.joints]
        parts = [
            _replay(log.cut(one), one, name, robot, gains.joints[name], threads)
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
    part: SweepLog,
    segment: Segment,
    name: str,
    robot: Robot,
    gains: JointGains,
    threads: int,
) -> tuple[Array, ...]:
    """Time, command, measured, naive, naive with the delay and matched position of a question."""
    asked = command_trace(part, segment, name, robot)
    late = _delayed(asked, gains.delay_s)
    plain = _on_drive(part, robot, name)
    naive, naive_delayed = (
        simulate(robot, one, plain.stiffness, plain.damping, threads=threads)[0]
        for one in (asked, late)
    )
    matched = simulate(
        robot,
        late,
        gains.stiffness,
        gains.damping,
        armature=gains.armature,
        frictionloss=None if np.isnan(gains.frictionloss) else gains.frictionloss,
        threads=threads,
    )[0]
    # The last state is that at the start of the last step: no sample may lie beyond it.
    inside = (part.time >= asked.time[0]) & (part.time <= asked.time[-1])
    time, column = part.time[inside], part.column(name)
    answers = (
        np.asarray(CubicSpline(asked.time, one)(time)) for one in (naive, naive_delayed, matched)
    )
    return time, part.command[inside, column], part.position[inside, column], *answers


def _delayed(asked: CommandTrace, delay: float) -> CommandTrace:
    """The question with its command delayed."""
    if delay == 0.0:
        return asked
    edges = np.append(asked.time, asked.time[-1] + asked.timestep) - delay
    return CommandTrace(**{**vars(asked), "command": held_mean(asked.time, asked.command, edges)})


def _on_drive(log: SweepLog, robot: Robot, name: str) -> JointDrive:
    """The published drive, with the gains that were on it."""
    stiffness, damping = gains_on_drive(log, name, robot)
    return replace(JointDrive.published(robot, name), stiffness=stiffness, damping=damping)


def _single(log: SweepLog) -> tuple[Segment, ...]:
    """The whole log as one question to those whose command moves."""
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
    return f"{name} is left out: the gains have no entry for it; match a log in which it is asked."


def _prediction(
    log: SweepLog, joints: list[JointPrediction], excluded: dict[str, str]
) -> Prediction:
    if not joints:
        reasons = " ".join(excluded.values()) or "no joint is asked in it."
        raise LogError(f"{log.source or 'log'}: nothing to replay; {reasons}")
    return Prediction(
        joints=tuple(joints), source=log.source, virtual=log.virtual, excluded=excluded
    )
