"""Replay a log that the fit never saw, with naive and with matched gains.

The commands of the log go to the training simulator, held from each measured timestamp to the
next, and the simulated position is read at the measured timestamps. The naive column is the very
same simulation with the gains on the real drive (the log's, or else the robot's published
figures) put into the simulator, with no delay; a third column gives it the delay of the matched
gains. No column gets a zero offset: an encoder that is off costs all the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from pronk.errors import LogError, PronkError
from pronk.files import load_artefact, save_artefact
from pronk.logs.joint_log import JointLog, Segment
from pronk.match.gains import JointGains, MatchedGains
from pronk.match.measured_joint import gains_on_drive
from pronk.response.grid import held_mean
from pronk.robots.robot import RobotSpec
from pronk.simulators.chain import ChainSimulation, JointDrive, moves_together
from pronk.simulators.command_trace import CommandTrace, command_trace
from pronk.simulators.simulator import JointRigs, joint_rigs, play

Array = NDArray[np.float64]

SCHEMA = "pronk/prediction/2"


@dataclass(frozen=True, kw_only=True)
class JointPrediction:
    """One joint's response to a log, measured and simulated, at the log's timestamps."""

    joint: str
    time: Array
    """Instants at which the joint was excited, all segments in a row [s], shape (n,)."""
    command: Array
    """Position command in force [rad], shape (n,)."""
    measured: Array
    """[rad], shape (n,)."""
    naive: Array
    """Simulated with the gains of the real drive [rad], shape (n,)."""
    naive_delayed: Array
    """The same with the delay that goes with the matched gains [rad], shape (n,): what the gains
    alone are worth."""
    matched: Array
    """Simulated with the matched gains and their delay [rad], shape (n,)."""
    signal: str = "unknown"
    """Kind of the signal that was replayed."""
    unit: str = "rad"

    @property
    def rmse_naive(self) -> float:
        """Root mean square of naive less measured [rad]."""
        return rmse(self.naive, self.measured)

    @property
    def rmse_naive_delayed(self) -> float:
        """Root mean square of naive with the delay less measured [rad]."""
        return rmse(self.naive_delayed, self.measured)

    @property
    def rmse_matched(self) -> float:
        """Root mean square of matched less measured [rad]."""
        return rmse(self.matched, self.measured)

    @property
    def r2_naive(self) -> float:
        """Share of the measured variance that the naive simulation explains."""
        return r2(self.naive, self.measured)

    @property
    def r2_matched(self) -> float:
        """Share of the measured variance that the matched simulation explains."""
        return r2(self.matched, self.measured)


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """All joints of one log."""

    joints: tuple[JointPrediction, ...]
    source: str
    virtual: bool
    excluded: Mapping[str, str] = field(default_factory=dict)
    """Joints that moved and were not predicted, and why."""


def rmse(simulated: Array, measured: Array) -> float:
    """Root mean square difference."""
    return float(np.sqrt(np.mean((simulated - measured) ** 2)))


def r2(simulated: Array, measured: Array) -> float:
    """One less the share of the measured variance that is left over; NaN for a still joint."""
    spread = float(np.var(measured))
    if spread == 0.0:
        return float("nan")
    return float(1.0 - np.mean((simulated - measured) ** 2) / spread)


def save_prediction(path: Path, prediction: Prediction) -> None:
    """Write a prediction, whole or not at all."""
    save_artefact(path, prediction, SCHEMA)


def load_prediction(path: Path) -> Prediction:
    """Read what `save_prediction` wrote.

    Raises:
        ArtefactError: Missing, damaged or of another schema.
    """
    return load_artefact(path, Prediction, SCHEMA, what="a prediction", writer="pronk predict LOG")


def predict(
    log: JointLog,
    robot: RobotSpec,
    gains: MatchedGains,
    *,
    threads: int = 2,
    simulator: str = "mujoco",
) -> Prediction:
    """Simulate a log with naive and with matched gains.

    Where several joints move at once the whole arm is simulated; otherwise each segment of each
    joint by itself, the rest held as on the rig.

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


def drives_of(robot: RobotSpec, gains: MatchedGains) -> dict[str, JointDrive]:
    """Drives of the matched joints."""
    return {name: _drive(robot, name, joint) for name, joint in gains.joints.items()}


def _drive(robot: RobotSpec, name: str, joint: JointGains) -> JointDrive:
    known = robot.joint(name).drive.frictionloss
    return JointDrive(
        stiffness=joint.stiffness,
        damping=joint.damping,
        armature=joint.armature,
        frictionloss=known if np.isnan(joint.frictionloss) else joint.frictionloss,
        delay=joint.delay_s,
    )


def _arm(log: JointLog, robot: RobotSpec, gains: MatchedGains, threads: int) -> Prediction:
    """The whole arm at once."""
    matched = drives_of(robot, gains)
    with ChainSimulation(robot, [log], threads=threads) as rig:
        naive = {name: _on_drive(log, robot, name) for name in rig.joints}
        late = {
            name: replace(drive, delay=matched[name].delay) if name in matched else drive
            for name, drive in naive.items()
        }
        simulated = [positions for (positions,) in rig.run([naive, late, matched])]
        kinds = {name: s.kind for s in log.segments for name in s.joints}
        found = {}
        for i, name in enumerate(rig.joints):
            column = log.column(name)
            measured = log.time, log.command[:, column], log.position[:, column]
            found[name] = kinds.get(name, "unknown"), (*measured, *(p[:, i] for p in simulated))
        return _prediction(log, gains, found, rig.excluded)


def _joint_by_joint(log: JointLog, rigs: JointRigs, gains: MatchedGains) -> Prediction:
    """One joint after the other, segment by segment."""
    segments = log.segments or _single(log)
    excited = {name for segment in segments for name in segment.joints}
    found: dict[str, tuple[str, Sequence[Array]]] = {}
    for name in (name for name in rigs.robot.joint_names if name in excited):
        mine = sorted((s for s in segments if name in s.joints), key=lambda one: one.start)
        parts = []
        if name in gains.joints:
            parts = [_replay(log.cut(one), one, name, rigs, gains.joints[name]) for one in mine]
        kind = next(s.kind for s in segments if name in s.joints)
        found[name] = kind, [np.concatenate(columns) for columns in zip(*parts, strict=True)]
    return _prediction(log, gains, found, {})


def _replay(
    part: JointLog, segment: Segment, name: str, rigs: JointRigs, gains: JointGains
) -> tuple[Array, ...]:
    """Time, command, measured, naive, naive with the delay and matched position of a segment."""
    robot, rig = rigs.robot, rigs.rig(name)
    trace = command_trace(part, segment, name, robot)
    late = _delayed(trace, gains.delay_s)
    real, best = _on_drive(part, robot, name), _drive(robot, name, gains)
    own = {n: np.array([getattr(best, n)]) for n in ("armature", "frictionloss")}
    own = {n: value for n, value in own.items() if n in rigs.parameters}
    on_drive = np.array([real.stiffness]), np.array([real.damping])
    naive, naive_delayed = (play(rig, one, *on_drive)[0] for one in (trace, late))
    matched = play(rig, late, np.array([best.stiffness]), np.array([best.damping]), **own)[0]
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


def _on_drive(log: JointLog, robot: RobotSpec, name: str) -> JointDrive:
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


def _prediction(
    log: JointLog,
    gains: MatchedGains,
    found: Mapping[str, tuple[str, Sequence[Array]]],
    excluded: Mapping[str, str],
) -> Prediction:
    """Put joints together: by name the kind of signal and the columns of `JointPrediction`."""
    excluded = dict(excluded)
    joints = []
    for name, (kind, columns) in found.items():
        if name not in gains.joints:
            excluded[name] = (
                f"{name} is left out: the gains have no entry for it; match a log in which it is "
                "excited."
            )
            continue
        time, command, measured, naive, naive_delayed, matched = columns
        joints.append(
            JointPrediction(
                joint=name,
                time=time,
                command=command,
                measured=measured,
                naive=naive,
                naive_delayed=naive_delayed,
                matched=matched,
                signal=kind,
            )
        )
    if not joints:
        reasons = " ".join(excluded.values()) or "no joint is excited in it."
        raise LogError(f"{log.source or 'log'}: nothing to replay; {reasons}")
    return Prediction(
        joints=tuple(joints), source=log.source, virtual=log.virtual, excluded=excluded
    )
