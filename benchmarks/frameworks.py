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
from collections.abc import Callable, Mapping
from contextlib import ExitStack
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
    StribeckChain,
    branches,
    moves_together,
)
from pronk.identify.simulators.load import joint_rigs, load_simulator
from pronk.identify.simulators.profiles import profile
from pronk.identify.simulators.simulator import Closing, Simulator
from pronk.jump.trial.tables import table
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec

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
EXCITED = 0.05
"""Amplitude of the command at the frequencies that are compared, of its largest in the band."""


def errors(ratio: ComplexArray, omega: Array) -> dict[str, float]:
    """RMS of a ratio of responses [dB], and of its phase as a time [ms]."""
    phase = np.unwrap(np.angle(ratio))
    return {
        "db": float(np.sqrt(np.mean((DB * np.log(np.abs(ratio))) ** 2))),
        "ms": float(1e3 * np.sqrt(np.mean(phase**2) / np.mean(omega**2))),
    }


def pairs(of: dict[str, ComplexArray], omega: Array) -> dict[str, float]:
    """`errors` of the engine beside its law and the recording, and of the law beside it."""
    out: dict[str, float] = {}
    for one, other in (("engine", "law"), ("engine", "recorded"), ("law", "recorded")):
        found = errors(of[one] / of[other], omega)
        out |= {f"{one}_{other}_{key}": value for key, value in found.items()}
    return out


def alone(
    goals: list[MeasuredJoint], gains: MatchedGains, engine: str, python: Path | None, robot: Any
) -> list[dict[str, float]]:
    """Joints that were excited one at a time."""
    rows = []
    with ExitStack() as stack:
        law = stack.enter_context(joint_rigs("mujoco", robot, threads=1))
        rigs = stack.enter_context(joint_rigs(engine, robot, python=python))
        for goal in goals:
            joint = gains.joints[goal.joint]
            values = {
                "stiffness": joint.stiffness.value,
                "damping": joint.damping.value,
                "delay": joint.delay_s.value,
            }
            if not np.isnan(joint.frictionloss.value):
                values["frictionloss"] = joint.frictionloss.value
            of = {
                "engine": simulated_response(rigs, goal, values)[goal.fit_mask],
                "law": simulated_response(law, goal, values)[goal.fit_mask],
                "recorded": goal.measured.response[goal.fit_mask],
            }
            rows.append(pairs(of, goal.omega))
    return rows


class EngineChain(Closing):
    """A chain in any simulator, from rest at the first command; for `ChainSimulation`."""

    def __init__(self, simulator: Simulator, robot: RobotSpec, joint: str, *, threads: int) -> None:
        self.joints, self.robot, self.simulator = robot.joint(joint).chain, robot, simulator

    def rollout(self, command: Array, values: Mapping[str, Array], start: Array) -> Array:
        """See `pronk.identify.simulators.mujoco.Chain.rollout`; delays are in the command."""
        names = self.simulator.joints
        columns = [names.index(name) for name in self.joints]
        full = np.empty((len(command), command.shape[1] + 1, len(names)))
        full[:] = [self.robot.joint(name).default_position for name in names]
        full[..., columns] = np.concatenate([command, command[:, -1:]], axis=1)
        all_values = {}
        for key in self.simulator.parameters - {"delay"}:
            robot_values = [self.robot.joint(name).parameters[key] for name in names]
            all_values[key] = np.tile(robot_values, (len(command), 1))
            all_values[key][:, columns] = values[key]
        locked = [name for name in names if name not in self.joints]
        return np.asarray(self.simulator.rollout(full, all_values, locked=locked)[..., columns])


def together(
    log: JointLog, gains: MatchedGains, engine: str, python: Path | None, robot: Any
) -> list[dict[str, float]]:
    """Joints that moved at once: the response to each one's own command."""
    drives, rows = drives_of(robot, gains), []
    simulator = load_simulator(engine, robot, python=python)
    rate, window = (len(log.time) - 1) / np.ptp(log.time), np.hanning(len(log.time))
    hertz = np.fft.rfftfreq(len(log.time), 1.0 / rate)
    band = (hertz >= BAND_HZ[0]) & (hertz <= BAND_HZ[1])
    for branch in branches([log], robot):
        traces = {}
        chains: dict[str, Callable[..., Any]] = {"law": StribeckChain}
        chains["engine"] = partial(EngineChain, simulator)
        for name, other in chains.items():
            with ChainSimulation(robot, [log], joints=branch, threads=1, chain=other) as arm:
                traces[name], measured, joints = arm.run([drives])[0][0], arm.measured(), arm.joints
        traces["recorded"] = measured[0]
        for i, joint in enumerate(joints):
            if joint not in gains.joints:
                continue
            spectra = {
                n: np.fft.rfft(window * (y[:, i] - y[:, i].mean())) for n, y in traces.items()
            }
            command = log.command[:, log.column(joint)]
            u = np.fft.rfft(window * (command - command.mean()))
            there = band & (np.abs(u) >= EXCITED * np.abs(u[band]).max())
            of = {name: (y / u)[there] for name, y in spectra.items()}
            rows.append(pairs(of, 2.0 * np.pi * hertz[there]))
    if isinstance(simulator, Closing):
        simulator.close()
    return rows


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
        seconds: Of each log, from its begin.
        drive_gains: `default`: the robot's gains were on its drives, of which the logs have none.
    """
    known = load_robot(robot)
    # The engines' joints have one dry friction at all speeds.
    known = replace(
        known,
        joints=tuple(
            replace(one, drive=replace(one.drive, stribeck_speed=0.0)) for one in known.joints
        ),
    )
    logs = [_begin(log, seconds) for log in read_logs(paths, robot=known)]
    rows: list[dict[str, Any]] = []
    with console.progress() as report:
        for name in only or ENGINES:
            framework, engine = profile(name), ENGINES[name]
            own = framework.robot(known)
            gains = match(
                logs,
                known,
                name,
                method="paper",
                drive_gains=drive_gains,
                settings=SETTINGS,
                progress=report,
            ).gains
            found: list[dict[str, float]] = []
            for python in (None, *simulator_python):
                try:
                    if moves_together(logs[0]):
                        found = together(logs[0], gains, engine, python, own)
                    else:
                        goals = []
                        for joint, sources in logs_by_joint(logs, own).items():
                            goals.append(measured_joints(sources, joint, own, SETTINGS)[0])
                        found = alone(goals, gains, engine, python, own)
                    break
                except PronkError as error:
                    reason = str(error)
            if not found:
                console.warn(f"{name}: {reason}")
                continue
            row: dict[str, Any] = {
                "framework": name,
                "law": framework.drive_law.label,
                "engine": engine,
            }
            row |= {"joints": len(found)}
            for key in found[0]:
                row[key] = max(one[key] for one in found)
            row["engine_recorded_mean_db"] = float(
                np.mean([one["engine_recorded_db"] for one in found])
            )
            rows.append(row)
            print(json.dumps(row), flush=True)
            report(name, 1.0)
    columns = "framework | law | engine | joints"
    for one in ("engine, law", "engine, recorded", "law, recorded"):
        columns += f" | {one} [dB];3 | {one} [ms];2"
    sheet = table(
        f"{columns} | engine, recorded, mean [dB];3",
        [list(row.values()) for row in rows],
        title="Engines with matched gains beside the law and the log"
        + " of the virtual robot" * any(log.virtual for log in logs)
        + ", worst joint",
    )
    console.show_sheet(sheet)
    return console.Outcome(figures={"rows": rows, "machine": machine()})


def _begin(log: JointLog, seconds: float) -> JointLog:
    """The first seconds of a log without segments."""
    if not np.isfinite(seconds):
        return log
    begin = log.time[0]
    part = Segment(
        kind="unknown", joints=log.joints, start=begin, stop=begin + seconds, amplitude=np.nan
    )
    return replace(log.cut(part), segments=())
