"""`python -m benchmarks frameworks`: matched gains in the engines themselves, beside the logs.

Every joint of the logs is matched for each framework with pronk's own computation of its drive law.
Then the engine simulates the recorded command with these gains, the response is estimated as the
log's was, and engine, law and recording are compared over the band: magnitude, and the phase that
the matched delay leaves, as a time. Of engines without dry friction in N m the frameworks are
matched without it. Joints that were excited alone are matched by the magnitude of the largest
amplitude, those that moved together in time.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from benchmarks.runner import machine
from pronk.arrays import Array, ComplexArray
from pronk.cli import console
from pronk.errors import PronkError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.readers import read_logs
from pronk.identify.logs.segment import Segment
from pronk.identify.match.gains import MatchedGains
from pronk.identify.match.match import match
from pronk.identify.match.measured import (
    DB,
    MeasuredJoint,
    logs_by_joint,
    measured_joints,
    simulated_response,
)
from pronk.identify.match.predict import drives_of
from pronk.identify.match.settings import MatchSettings
from pronk.identify.simulators.chain import (
    ChainSimulation,
    branches,
    moves_together,
)
from pronk.identify.simulators.load import joint_rigs, load_simulator
from pronk.identify.simulators.profiles import profile
from pronk.identify.simulators.simulator import Closing, Simulator
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec
from pronk.tables import Column, Table

ENGINES = {
    "mjlab": "mujoco",
    "isaaclab-explicit,friction=none": "examples/engines/sapien.py:torque",
    "isaaclab-implicit,friction=none": "examples/engines/sapien.py:isaaclab",
    "isaaclab-newton": "examples/engines/newton.py:drive",
    "genesis": "examples/engines/genesis.py:drive",
    "playground": "examples/engines/mjx.py:Mjx",
    "maniskill": "examples/engines/sapien.py:drive",
    "drake": "examples/engines/drake.py:drive",
    "newton-featherstone": "examples/engines/newton.py:featherstone",
}
"""Framework, and the value of `--simulator` that runs its engine."""
SETTINGS = MatchSettings(zero_armature=False)
BAND_HZ = (0.3, 3.4)
"""Where joints that move together are compared: SO-101's recordings are coherent below 3.5 Hz."""
EXCITED_SHARE = 0.05
"""Least amplitude of the command at a frequency that is compared, of its largest in the band."""


def errors(ratio: ComplexArray, omega: Array) -> tuple[float, float]:
    """RMS of a ratio of responses [dB], and of its phase as a time [ms]."""
    phase = np.unwrap(np.angle(ratio))
    level_db = DB * np.log(np.abs(ratio))
    lateness_ms = 1e3 * np.sqrt(np.mean(phase**2) / np.mean(omega**2))
    return float(np.sqrt(np.mean(level_db**2))), float(lateness_ms)


def joint_errors(
    engine: ComplexArray, law: ComplexArray, recorded: ComplexArray, omega: Array
) -> dict[str, float]:
    """Compare the responses of a joint in the engine, by its law, and as it was recorded."""
    engine_law = errors(engine / law, omega)
    engine_recorded = errors(engine / recorded, omega)
    law_recorded = errors(law / recorded, omega)
    return {
        "engine_law_db": engine_law[0],
        "engine_law_ms": engine_law[1],
        "engine_recorded_db": engine_recorded[0],
        "engine_recorded_ms": engine_recorded[1],
        "law_recorded_db": law_recorded[0],
        "law_recorded_ms": law_recorded[1],
    }


def compare_alone(
    targets: Sequence[MeasuredJoint],
    gains: MatchedGains,
    engine: str,
    python: Path | None,
    robot: RobotSpec,
) -> list[dict[str, float]]:
    """Compare joints that were excited one at a time."""
    rows = []
    with (
        joint_rigs("mujoco", robot, threads=1) as law_rigs,
        joint_rigs(engine, robot, python=python) as engine_rigs,
    ):
        for target in targets:
            joint = gains.joints[target.joint]
            values = {
                "stiffness": joint.stiffness.value,
                "damping": joint.damping.value,
                "delay": joint.delay_s.value,
            }
            if not np.isnan(joint.frictionloss.value):
                values["frictionloss"] = joint.frictionloss.value
            engine_values = dict(values)
            if "frictionloss" not in engine_rigs.parameters:
                engine_values.pop("frictionloss", None)
            used = target.fit_mask
            rows.append(
                joint_errors(
                    simulated_response(engine_rigs, target, engine_values)[used],
                    simulated_response(law_rigs, target, values)[used],
                    target.measured.response[used],
                    target.omega,
                )
            )
    return rows


class EngineChain(Closing):
    """A chain in any simulator, from rest at the first command; for `ChainSimulation`."""

    def __init__(self, simulator: Simulator, robot: RobotSpec, joint: str, *, threads: int) -> None:
        self.joints = robot.joint(joint).chain
        self.robot = robot
        self.simulator = simulator

    def rollout(self, command: Array, values: Mapping[str, Array], start: Array) -> Array:
        """See `pronk.identify.simulators.mujoco.Chain.rollout`; delays are in the command."""
        names = self.simulator.joints
        columns = [names.index(name) for name in self.joints]
        all_commands = np.empty((len(command), command.shape[1] + 1, len(names)))
        all_commands[:] = [self.robot.joint(name).default_position for name in names]
        all_commands[..., columns] = np.concatenate([command, command[:, -1:]], axis=1)
        all_values = {}
        for parameter in self.simulator.parameters - {"delay"}:
            robot_values = [self.robot.joint(name).parameters[parameter] for name in names]
            all_values[parameter] = np.tile(robot_values, (len(command), 1))
            all_values[parameter][:, columns] = values[parameter]
        locked = [name for name in names if name not in self.joints]
        position = self.simulator.rollout(all_commands, all_values, locked=locked)
        return np.asarray(position[..., columns])


def compare_together(
    log: JointLog, gains: MatchedGains, engine: str, python: Path | None, robot: RobotSpec
) -> list[dict[str, float]]:
    """Compare joints that moved at once: the response of each to its own command."""
    drives = drives_of(robot, gains)
    simulator = load_simulator(engine, robot, python=python)
    rate = (len(log.time) - 1) / np.ptp(log.time)
    hertz = np.fft.rfftfreq(len(log.time), 1.0 / rate)
    in_band = (hertz >= BAND_HZ[0]) & (hertz <= BAND_HZ[1])
    rows = []
    for branch in branches([log], robot):
        with ChainSimulation(robot, [log], joints=branch, threads=1) as chain:
            law_position = chain.run([drives])[0][0]
            recorded_position = chain.measured()[0]
            joints = chain.joints
        with ChainSimulation(
            robot, [log], joints=branch, threads=1, chain=partial(EngineChain, simulator)
        ) as chain:
            engine_position = chain.run([drives])[0][0]
        for column, joint in enumerate(joints):
            if joint not in gains.joints:
                continue
            command = spectrum(log.command[:, log.column(joint)])
            excited = np.abs(command) >= EXCITED_SHARE * np.abs(command[in_band]).max()
            compared = in_band & excited
            rows.append(
                joint_errors(
                    (spectrum(engine_position[:, column]) / command)[compared],
                    (spectrum(law_position[:, column]) / command)[compared],
                    (spectrum(recorded_position[:, column]) / command)[compared],
                    2.0 * np.pi * hertz[compared],
                )
            )
    if isinstance(simulator, Closing):
        simulator.close()
    return rows


def spectrum(signal: Array) -> ComplexArray:
    """Fourier transform of a signal about its mean, in Hann's window."""
    return np.asarray(np.fft.rfft(np.hanning(len(signal)) * (signal - signal.mean())))


def frameworks(
    paths: tyro.conf.Positional[tuple[Path, ...]],
    robot: str = "mini_cheetah",
    simulator_python: tuple[Path, ...] = (),
    only: tuple[str, ...] = (),
    seconds: float = float("inf"),
    drive_gains: Literal["default"] | None = None,
) -> console.Outcome:
    """Gains matched for frameworks, in the engines themselves, beside the logs.

    Args:
        paths: Logs, or folders of logs, as `pronk sweep` writes them.
        robot: A name, or a path to a robot.yaml, MJCF or URDF.
        simulator_python: Pythons that have the engines, if this one lacks them; repeat it.
        only: Frameworks, all if none is given; repeat it.
        seconds: Length of each log that is used, from its begin.
        drive_gains: `default`: the robot's gains were on its drives, of which the logs have none.
    """
    robot_spec = with_constant_friction(load_robot(robot))
    logs = [first_seconds(log, seconds) for log in read_logs(paths, robot=robot_spec)]
    rows: list[dict[str, Any]] = []
    with console.progress() as report:
        for name in only or ENGINES:
            gains = match(
                logs,
                robot_spec,
                name,
                method="paper",
                drive_gains=drive_gains,
                settings=SETTINGS,
                progress=report,
            ).gains
            joint_rows = compared_in_engine(
                logs, robot_spec, name, gains, (None, *simulator_python)
            )
            if not joint_rows:
                continue
            engine_recorded = [joint_row["engine_recorded_db"] for joint_row in joint_rows]
            row: dict[str, Any] = {
                "framework": name,
                "law": profile(name).drive_law.label,
                "engine": ENGINES[name],
                "joints": len(joint_rows),
            }
            for key in joint_rows[0]:
                row[key] = max(joint_row[key] for joint_row in joint_rows)
            row["engine_recorded_mean_db"] = float(np.mean(engine_recorded))
            rows.append(row)
            print(json.dumps(row), flush=True)
            report(name, 1.0)
    columns = [Column(heading=heading) for heading in ("framework", "law", "engine", "joints")]
    for pair in ("engine, law", "engine, recorded", "law, recorded"):
        columns.append(Column(heading=pair, unit="dB"))
        columns.append(Column(heading=pair, unit="ms", digits=2))
    columns.append(Column(heading="engine, recorded, mean", unit="dB"))
    title = "Engines with matched gains beside the law and the log, worst joint"
    if any(log.virtual for log in logs):
        title = "Engines with matched gains beside the law and the virtual robot's log, worst joint"
    cells = tuple(tuple(row.values()) for row in rows)
    console.show(Table(title=title, columns=tuple(columns), rows=cells))
    return console.Outcome(figures={"rows": rows, "machine": machine()})


def compared_in_engine(
    logs: Sequence[JointLog],
    robot: RobotSpec,
    name: str,
    gains: MatchedGains,
    pythons: Sequence[Path | None],
) -> list[dict[str, float]]:
    """Compare all joints in the engine of a framework, in the first Python that has it.

    A warning says why none has; the list is empty then.
    """
    framework_robot = profile(name).robot(robot)
    engine = ENGINES[name]
    reason = ""
    for python in pythons:
        try:
            if moves_together(logs[0]):
                return compare_together(logs[0], gains, engine, python, framework_robot)
            targets = []
            for joint, joint_logs in logs_by_joint(logs, framework_robot).items():
                targets.append(measured_joints(joint_logs, joint, framework_robot, SETTINGS)[0])
            return compare_alone(targets, gains, engine, python, framework_robot)
        except PronkError as error:
            reason = str(error)
    console.warn(f"{name}: {reason}")
    return []


def with_constant_friction(robot: RobotSpec) -> RobotSpec:
    """Return a robot whose dry friction is the same at all speeds, as that of the engines."""
    joints = []
    for joint in robot.joints:
        joints.append(replace(joint, drive=replace(joint.drive, stribeck_speed=0.0)))
    return replace(robot, joints=tuple(joints))


def first_seconds(log: JointLog, seconds: float) -> JointLog:
    """Return the first seconds of a log, without segments."""
    if not np.isfinite(seconds):
        return log
    begin = log.time[0]
    part = Segment(
        kind="unknown", joints=log.joints, start=begin, stop=begin + seconds, amplitude=np.nan
    )
    return replace(log.cut(part), segments=())
