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
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from pronk.arrays import Array
from pronk.errors import LogError, PronkError
from pronk.files import load_artefact, save_artefact
from pronk.identify.logs.joint_log import Excitation, JointLog
from pronk.identify.match.gains import MatchedGains
from pronk.identify.match.measured_joint import DriveGains, gains_on_drive, rms, with_drive_gains
from pronk.identify.match.parameters import GAINS
from pronk.identify.response.grid import held_mean
from pronk.identify.simulators.chain import (
    ChainSimulation,
    DriveValues,
    branches,
    moves_together,
    published,
)
from pronk.identify.simulators.command_trace import CommandTrace, command_trace
from pronk.identify.simulators.load import joint_rigs
from pronk.identify.simulators.profiles import profile_of
from pronk.identify.simulators.simulator import JointRigs
from pronk.robots.robot import RobotSpec

SCHEMA = "pronk/prediction/2"
_WITHOUT_GAINS = (
    "{} is left out: the gains have no entry for it; match a log in which it is excited."
)


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

    rmse_naive = property(lambda self: rmse(self.naive, self.measured))
    rmse_naive_delayed = property(lambda self: rmse(self.naive_delayed, self.measured))
    rmse_matched = property(lambda self: rmse(self.matched, self.measured))
    r2_naive = property(lambda self: r2(self.naive, self.measured))
    r2_matched = property(lambda self: r2(self.matched, self.measured))


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
    return rms(simulated - measured)


def r2(simulated: Array, measured: Array) -> float:
    """One less the share of the measured variance that is left over; NaN for a still joint."""
    spread = float(np.var(measured))
    return float(1.0 - np.mean((simulated - measured) ** 2) / spread) if spread else float("nan")


def save_prediction(path: Path, prediction: Prediction) -> None:
    """Write a prediction, whole or not at all."""
    save_artefact(path, prediction, SCHEMA)


def load_prediction(path: Path) -> Prediction:
    """Read what `save_prediction` wrote; ArtefactError for another file."""
    return load_artefact(path, Prediction, SCHEMA, what="a prediction", writer="pronk predict LOG")


def predict(
    log: JointLog,
    robot: RobotSpec,
    gains: MatchedGains,
    *,
    drive_gains: DriveGains | None = None,
    threads: int = 2,
    simulator: str = "mujoco",
    simulator_python: Path | None = None,
) -> Prediction:
    """Simulate a log with naive and with matched gains.

    Where several joints move at once each chain of them is simulated; otherwise each segment
    of each joint by itself, the rest held as on the rig.

    Raises:
        LogError: The log excites no joint that has matched gains, or the robots differ.
        PronkError: The simulator is unknown, or cannot replay joints that move together.
    """
    if gains.robot != robot.name:
        raise LogError(f"the gains are those of {gains.robot}, not of {robot.name}.")
    if simulator == "mujoco" and gains.simulator.profile:
        robot = profile_of(gains.simulator).robot(robot)
    (log,) = with_drive_gains([log], robot, drive_gains)
    if moves_together(log):
        if simulator != "mujoco":
            raise PronkError(
                f"{log.source or 'log'}: several joints move at once, which only simulator mujoco "
                f"replays, not {simulator}."
            )
        joints, excluded = _together(log, robot, drives_of(robot, gains), threads)
    else:
        with joint_rigs(simulator, robot, threads=threads, python=simulator_python) as rigs:
            joints, excluded = _joint_by_joint(log, rigs, drives_of(rigs.robot, gains))
    if not joints:
        reasons = " ".join(excluded.values()) or "no joint is excited in it."
        raise LogError(f"{log.source or 'log'}: nothing to replay; {reasons}")
    return Prediction(
        joints=tuple(joints), source=log.source, virtual=log.virtual, excluded=excluded
    )


def drives_of(robot: RobotSpec, gains: MatchedGains) -> dict[str, dict[str, float]]:
    """Return the parameters of the drive of each matched joint, named as by `published`.

    Dry friction that the gains do not state is the robot's own.
    """
    drives = {}
    for name, joint in gains.joints.items():
        drive = published(robot, name)
        drive["stiffness"] = joint.stiffness.value
        drive["damping"] = joint.damping.value
        drive["armature"] = joint.armature.value
        drive["stribeck"] = joint.stribeck.value
        drive["delay"] = joint.delay_s.value
        if not np.isnan(joint.frictionloss.value):
            drive["frictionloss"] = joint.frictionloss.value
        drives[name] = drive
    return drives


def _on_drive(log: JointLog, robot: RobotSpec, name: str) -> dict[str, float]:
    """The published drive, with the gains that were on it."""
    pair = gains_on_drive(log, name, robot)
    return published(robot, name) | dict(zip(GAINS, pair, strict=True))


def _together(
    log: JointLog, robot: RobotSpec, matched: DriveValues, threads: int
) -> tuple[list[JointPrediction], dict[str, str]]:
    """Chain by chain; joints, and why others are left out."""
    joints: list[JointPrediction] = []
    left_out: dict[str, str] = {}
    kinds = {name: s.kind for s in log.segments for name in s.joints}
    for branch in branches([log], robot):
        with ChainSimulation(robot, [log], joints=branch, threads=threads) as arm:
            naive = {name: _on_drive(log, robot, name) for name in arm.joints}
            late = {
                name: drive | {"delay": matched[name]["delay"]} if name in matched else drive
                for name, drive in naive.items()
            }
            simulated = [positions for (positions,) in arm.run([naive, late, matched])]
        left_out |= arm.excluded
        for i, name in enumerate(arm.joints):
            if name not in matched:
                left_out[name] = _WITHOUT_GAINS.format(name)
                continue
            joints.append(
                JointPrediction(
                    joint=name,
                    time=log.time,
                    command=log.command[:, log.column(name)],
                    measured=log.position[:, log.column(name)],
                    naive=simulated[0][:, i],
                    naive_delayed=simulated[1][:, i],
                    matched=simulated[2][:, i],
                    signal=kinds.get(name, "unknown"),
                )
            )
    return joints, left_out


def _joint_by_joint(
    log: JointLog, rigs: JointRigs, matched: DriveValues
) -> tuple[list[JointPrediction], dict[str, str]]:
    """One joint after the other, segment by segment; returns as `_together`."""
    joints, left_out = [], {}
    for name in rigs.robot.joint_names:
        mine = []
        if name in log.excited_joints:
            mine = sorted(log.excitations(name), key=lambda excitation: excitation.segment.start)
        if mine and name not in matched:
            left_out[name] = _WITHOUT_GAINS.format(name)
        elif mine:
            parts = [_replay(excitation, rigs, matched[name]) for excitation in mine]
            rows: dict[str, Any] = {n: np.concatenate([p[n] for p in parts]) for n in parts[0]}
            joints.append(JointPrediction(joint=name, signal=mine[0].segment.kind, **rows))
    return joints, left_out


def _replay(part: Excitation, rigs: JointRigs, best: Mapping[str, float]) -> dict[str, Array]:
    """The arrays of `JointPrediction` for an excitation."""
    trace, late = command_trace(part, rigs.robot), best["delay"]
    delayed = trace
    if late:
        edges = np.append(trace.time, trace.time[-1] + trace.timestep) - late
        delayed = replace(trace, command=held_mean(trace.time, trace.command, edges))
    real = _on_drive(part.log, rigs.robot, part.joint)
    own = [n for n in ("armature", "frictionloss") if n in rigs.parameters]
    # The last state is that at the start of the last step: no sample may lie beyond it.
    inside = (part.time >= trace.time[0]) & (part.time <= trace.time[-1])
    time = part.time[inside]

    def played(command: CommandTrace, values: Mapping[str, float], names: Sequence[str]) -> Array:
        position = rigs.play(command, {n: np.array([values[n]]) for n in names})[0]
        return np.asarray(CubicSpline(trace.time, position)(time))

    return {
        "time": time,
        "command": part.command[inside],
        "measured": part.position[inside],
        "naive": played(trace, real, GAINS),
        "naive_delayed": played(delayed, real, GAINS),
        "matched": played(delayed, best, [*GAINS, *own]),
    }
