"""Prediction of a log that no fit has used, with nominal and with matched gains.

The commands of the log go to the simulator, held from each measured timestamp to the next, and the
simulated position is read at the measured timestamps. The nominal gains are those on the real
drive (the log's, or else the robot's published figures), put into the simulator with no delay; a
third simulation gives them the delay of the matched gains. No simulation gets a zero offset: an
encoder that is off is an error of all three.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.interpolate import CubicSpline

from pronk.arrays import Array
from pronk.errors import LogError, PronkError
from pronk.files import load_artefact, save_artefact
from pronk.frames import data_frame
from pronk.identify.logs.checks import unwrapped
from pronk.identify.logs.joint_log import Excitation, JointLog
from pronk.identify.match.gains import MatchedGains, require_matched
from pronk.identify.match.measured import rms
from pronk.identify.match.nominal_gains import (
    DriveGains,
    Pair,
    gains_on_drive,
    robot_as_recorded,
    with_drive_gains,
)
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

if TYPE_CHECKING:
    from pandas import DataFrame

SCHEMA = "pronk/prediction/3"
WITHOUT_GAINS = (
    "{} is left out: the gains have no entry for it; match a log in which it is excited."
)
"""Reason for which a joint is not predicted."""


@dataclass(frozen=True, kw_only=True)
class JointPrediction:
    """Measured and simulated response of one joint, at the timestamps of the log."""

    joint: str
    """Name of the joint."""
    time: Array
    """Instants at which the joint was excited, one excitation after another [s], shape (n,)."""
    command: Array
    """Position command in force [rad], shape (n,)."""
    measured: Array
    """Measured position [rad], shape (n,)."""
    nominal: Array
    """Position simulated with the gains of the real drive [rad], shape (n,)."""
    nominal_delayed: Array
    """Position simulated with the gains of the real drive and the delay of the matched gains
    [rad], shape (n,). Its error beside that with the matched gains shows what the gains alone are
    worth."""
    matched: Array
    """Position simulated with the matched gains and their delay [rad], shape (n,)."""
    signal: str = "unknown"
    """Kind of the signal that was replayed, as of `Segment.kind`."""
    unit: str = "rad"
    """Unit of the positions."""

    @property
    def rmse_nominal(self) -> float:
        """Root mean square error with the nominal gains [rad]."""
        return rmse(self.nominal, self.measured)

    @property
    def rmse_nominal_delayed(self) -> float:
        """Root mean square error with the nominal gains and the matched delay [rad]."""
        return rmse(self.nominal_delayed, self.measured)

    @property
    def rmse_matched(self) -> float:
        """Root mean square error with the matched gains [rad]."""
        return rmse(self.matched, self.measured)

    @property
    def r2_nominal(self) -> float:
        """Coefficient of determination with the nominal gains."""
        return r2(self.nominal, self.measured)

    @property
    def r2_matched(self) -> float:
        """Coefficient of determination with the matched gains."""
        return r2(self.matched, self.measured)


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Predictions of all joints of one log."""

    joints: tuple[JointPrediction, ...]
    """Predicted joints, in the robot's order."""
    source: str
    """File or link that the log came from."""
    virtual: bool
    """True if the log came from pronk's virtual robot."""
    excluded: Mapping[str, str] = field(default_factory=dict)
    """Joints that moved and were not predicted, with the reason for each."""
    unmatched: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Joints whose gains are no match, with the reasons."""
    fitted: bool = False
    """True if the gains were matched with this very log, so that this is a check of the fit."""
    gains: Mapping[str, Pair] = field(default_factory=dict)
    """Matched stiffness [N m/rad] and damping [N m s/rad] by predicted joint."""

    def __repr__(self) -> str:
        """Name the log and the errors of its joints."""
        errors = [f"{joint.joint} {joint.rmse_matched:.4g} {joint.unit}" for joint in self.joints]
        return f"<Prediction of {self.source or 'log'}: RMSE matched {', '.join(errors)}>"

    def to_dataframe(self) -> DataFrame:
        """Return the positions as a data frame of pandas, a row for each instant of each joint.

        The names of the columns end with the unit, `rad` or the log's own scale (`unknown`), so
        that the joints of one data frame must have one unit.

        Raises:
            PronkError: pandas is not installed, or the joints have different units.
        """
        units = sorted({joint.unit for joint in self.joints})
        if len(units) > 1:
            raise PronkError(
                f"the positions are in {' and '.join(units)}, and a data frame has one unit a "
                "column; read the log with the option scale (--scale JOINT=RAD)."
            )
        unit = units[0] if units else "rad"
        columns: dict[str, list[Any]] = {}
        for joint in self.joints:
            columns.setdefault("joint", []).extend([joint.joint] * len(joint.time))
            columns.setdefault("time_s", []).extend(joint.time)
            columns.setdefault(f"command_{unit}", []).extend(joint.command)
            columns.setdefault(f"measured_{unit}", []).extend(joint.measured)
            columns.setdefault(f"nominal_{unit}", []).extend(joint.nominal)
            columns.setdefault(f"nominal_delayed_{unit}", []).extend(joint.nominal_delayed)
            columns.setdefault(f"matched_{unit}", []).extend(joint.matched)
        return data_frame(columns)


def rmse(simulated: Array, measured: Array) -> float:
    """Return the root mean square difference of two arrays of one shape."""
    return rms(simulated - measured)


def r2(simulated: Array, measured: Array) -> float:
    """Return the coefficient of determination, `1 - mean((simulated - measured)^2) / var`.

    NaN for a measured position that does not move.
    """
    variance = float(np.var(measured))
    if variance == 0.0:
        return float("nan")
    return float(1.0 - np.mean((simulated - measured) ** 2) / variance)


def save_prediction(path: Path, prediction: Prediction) -> None:
    """Write a prediction, whole or not at all."""
    save_artefact(path, prediction, SCHEMA)


def load_prediction(path: Path) -> Prediction:
    """Read what `save_prediction` wrote; an ArtefactError says why another file is not one."""
    return load_artefact(path, Prediction, SCHEMA, what="a prediction", writer="pronk predict LOG")


def predict(
    log: JointLog,
    robot: RobotSpec,
    gains: MatchedGains,
    *,
    drive_gains: DriveGains | None = None,
    simulator: str = "mujoco",
    simulator_python: Path | None = None,
    threads: int = 2,
    allow_unmatched: bool = False,
) -> Prediction:
    """Simulate a log with nominal and with matched gains.

    Where several joints move at once each chain of them is simulated; otherwise each excitation of
    each joint by itself, with the other joints held as on the rig.

    Args:
        log: A log that the gains were not matched with.
        robot: The robot.
        gains: Matched gains.
        drive_gains: Stiffness and damping on the real drives by joint or joint group, where the
            log does not have them; or `default`, those of the robot's file.
        simulator: `mujoco`, `FILE.py:NAME`, or the name of an installed simulator. MuJoCo computes
            the drive law of the framework that the gains hold for.
        simulator_python: Python that the simulator runs in, if it is another.
        threads: Simulations at once.
        allow_unmatched: Also replay joints whose gains are no match; they are marked.

    Returns:
        Measured and simulated position of every excited joint that has matched gains.

    Raises:
        UnmatchedError: A joint is no match.
        LogError: The log excites no joint that has matched gains, or is of another robot.
        PronkError: The simulator is unknown, or cannot replay joints that move together.

    Examples:
        >>> import pronk
        >>> robot = pronk.load_robot("mini_cheetah")
        >>> result = pronk.match([pronk.read_log("logs/FR_knee.mcap", robot=robot)], robot)
        >>> fresh = pronk.read_log("fresh/FR_knee.mcap", robot=robot)
        >>> pronk.predict(fresh, robot, result.gains).joints[0].rmse_matched
    """
    if gains.robot != robot.name:
        raise LogError(f"the gains are those of {gains.robot}, not of {robot.name}.")
    require_matched(gains, allow_unmatched)
    robot = robot_as_recorded(robot, drive_gains, [log])
    if simulator == "mujoco" and gains.simulator.profile:
        robot = profile_of(gains.simulator).robot(robot)
    (log,) = with_drive_gains([unwrapped(log)], robot, drive_gains)
    if moves_together(log):
        if simulator != "mujoco":
            raise PronkError(
                f"{log.source or 'log'}: several joints move at once, which only simulator mujoco "
                f"replays, not {simulator}."
            )
        joints, excluded = _predict_chains(log, robot, drives_of(robot, gains), threads)
    else:
        with joint_rigs(simulator, robot, threads=threads, python=simulator_python) as rigs:
            joints, excluded = _predict_joints(log, rigs, drives_of(rigs.robot, gains))
    if not joints:
        reasons = " ".join(excluded.values()) or "no joint is excited in it."
        raise LogError(f"{log.source or 'log'}: nothing to replay; {reasons}")
    replayed_gains = {}
    for prediction in joints:
        joint_gains = gains.joints[prediction.joint]
        replayed_gains[prediction.joint] = (joint_gains.stiffness.value, joint_gains.damping.value)
    sha256 = log.origin.sha256
    return Prediction(
        joints=tuple(joints),
        source=log.source,
        virtual=log.virtual,
        excluded=excluded,
        unmatched=gains.unmatched,
        fitted=bool(sha256) and sha256 in gains.logs.values(),
        gains=replayed_gains,
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


def _nominal_drive(log: JointLog, robot: RobotSpec, name: str) -> dict[str, float]:
    """Return the published drive of a joint, with the gains that were on it in a log."""
    drive = published(robot, name)
    drive["stiffness"], drive["damping"] = gains_on_drive(log, name, robot)
    return drive


def _predict_chains(
    log: JointLog, robot: RobotSpec, matched: DriveValues, threads: int
) -> tuple[list[JointPrediction], dict[str, str]]:
    """Predict joints that move together, chain by chain.

    Returns:
        Predictions, and the reason for each joint that is left out.
    """
    predictions: list[JointPrediction] = []
    excluded: dict[str, str] = {}
    signals = {}
    for segment in log.segments:
        for name in segment.joints:
            signals[name] = segment.kind
    for branch in branches([log], robot):
        with ChainSimulation(robot, [log], joints=branch, threads=threads) as chain:
            nominal = {name: _nominal_drive(log, robot, name) for name in chain.joints}
            nominal_delayed = {}
            for name, drive in nominal.items():
                delay = matched[name]["delay"] if name in matched else drive["delay"]
                nominal_delayed[name] = drive | {"delay": delay}
            runs = chain.run([nominal, nominal_delayed, matched])
        # One log was simulated, with three sets of drives.
        nominal_position, delayed_position, matched_position = (run[0] for run in runs)
        excluded |= chain.excluded
        for index, name in enumerate(chain.joints):
            if name not in matched:
                excluded[name] = WITHOUT_GAINS.format(name)
                continue
            column = log.column(name)
            prediction = JointPrediction(
                joint=name,
                time=log.time,
                command=log.command[:, column],
                measured=log.position[:, column],
                nominal=nominal_position[:, index],
                nominal_delayed=delayed_position[:, index],
                matched=matched_position[:, index],
                signal=signals.get(name, "unknown"),
            )
            predictions.append(prediction)
    return predictions, excluded


def _predict_joints(
    log: JointLog, rigs: JointRigs, matched: DriveValues
) -> tuple[list[JointPrediction], dict[str, str]]:
    """Predict joints that move one after another, excitation by excitation.

    Returns:
        Predictions, and the reason for each joint that is left out.
    """
    predictions = []
    excluded = {}
    for name in rigs.robot.joint_names:
        if name not in log.excited_joints:
            continue
        if name not in matched:
            excluded[name] = WITHOUT_GAINS.format(name)
            continue
        excitations = sorted(log.excitations(name), key=lambda excitation: excitation.segment.start)
        parts = [_predict_excitation(excitation, rigs, matched[name]) for excitation in excitations]
        predictions.append(_joined(parts))
    return predictions, excluded


def _predict_excitation(
    excitation: Excitation, rigs: JointRigs, matched: Mapping[str, float]
) -> JointPrediction:
    """Predict one excitation of one joint."""
    trace = command_trace(excitation, rigs.robot)
    delayed_trace = trace
    if matched["delay"]:
        edges = np.append(trace.time, trace.time[-1] + trace.timestep)
        delayed_command = held_mean(trace.time, trace.command, edges - matched["delay"])
        delayed_trace = replace(trace, command=delayed_command)

    nominal = _nominal_drive(excitation.log, rigs.robot, excitation.joint)
    gain_names = ["stiffness", "damping"]
    drive_names = [*gain_names]
    for name in ("armature", "frictionloss"):
        if name in rigs.parameters:
            drive_names.append(name)

    # The last state is that at the start of the last step: no sample may lie beyond it.
    inside = (excitation.time >= trace.time[0]) & (excitation.time <= trace.time[-1])
    time = excitation.time[inside]
    return JointPrediction(
        joint=excitation.joint,
        time=time,
        command=excitation.command[inside],
        measured=excitation.position[inside],
        nominal=_played(rigs, trace, nominal, gain_names, time),
        nominal_delayed=_played(rigs, delayed_trace, nominal, gain_names, time),
        matched=_played(rigs, delayed_trace, matched, drive_names, time),
        signal=excitation.segment.kind,
    )


def _played(
    rigs: JointRigs,
    trace: CommandTrace,
    drive: Mapping[str, float],
    names: Sequence[str],
    time: Array,
) -> Array:
    """Simulate a command with some parameters of a drive; return the position at some instants."""
    values = {name: np.array([drive[name]]) for name in names}
    position = rigs.play(trace, values)[0]
    return np.asarray(CubicSpline(trace.time, position)(time))


def _joined(parts: Sequence[JointPrediction]) -> JointPrediction:
    """Return the predictions of several excitations of one joint, one after another."""
    times = []
    commands = []
    measured = []
    nominal = []
    nominal_delayed = []
    matched = []
    for part in parts:
        times.append(part.time)
        commands.append(part.command)
        measured.append(part.measured)
        nominal.append(part.nominal)
        nominal_delayed.append(part.nominal_delayed)
        matched.append(part.matched)
    return JointPrediction(
        joint=parts[0].joint,
        time=np.concatenate(times),
        command=np.concatenate(commands),
        measured=np.concatenate(measured),
        nominal=np.concatenate(nominal),
        nominal_delayed=np.concatenate(nominal_delayed),
        matched=np.concatenate(matched),
        signal=parts[0].signal,
    )
