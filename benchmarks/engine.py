"""`python -m benchmarks engine`: the same drive at a fine step and in the training simulator.

A real drive closes its loop at 40 kHz (paper S4), the training simulator every 5 ms; the same
gains give another response. The drive is simulated at a step fine enough to have converged and in
the training simulator, whose gains are then matched.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np

from pronk.cli import console
from pronk.identify.excitation.signals import Chirp
from pronk.identify.match.magnitude import refine
from pronk.identify.match.measured import DB, measured_joints, simulated_response
from pronk.identify.match.settings import MatchSettings
from pronk.identify.simulators.mujoco import MujocoSimulator
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec
from pronk.tables import Column, Table
from tests.synthetic_log import Excitation, synthetic_log

ROBOT = "mini_cheetah"
JOINTS = ("FR_hip_roll", "FR_hip_pitch", "FR_knee")


@dataclass(frozen=True, kw_only=True)
class EngineGap:
    """One joint in the training simulator against the fine one, over the joint's band."""

    gains: tuple[float, float]
    """Stiffness [N m/rad] and damping [N m s/rad] of the drive."""
    matched_gains: tuple[float, float]
    """Those that give the training simulator the response of the fine one."""
    equal_gains_rms_db: float
    """RMS of the difference with the gains of the drive [dB]."""
    equal_gains_max_db: float
    """Largest difference with the gains of the drive [dB]."""
    matched_rms_db: float
    """RMS of the difference with the matched gains [dB]."""


def engine_gap(
    robot: RobotSpec,
    joint: str,
    *,
    fine_timestep_s: float = 0.00025,
    signal: Chirp | None = None,
) -> EngineGap:
    """Excite one joint, with the gains of its drive, in a fine and in the training simulator.

    Both get the same command, the paper's chirp if None, held at the policy's rate, and go through
    the same estimator.
    """
    settings = MatchSettings(threads=2)
    chirp = signal or Chirp()
    drive = robot.joint(joint)
    gains = (drive.stiffness, drive.damping)
    tick = robot.timestep_s * robot.decimation
    fine = replace(robot, timestep_s=fine_timestep_s, decimation=round(tick / fine_timestep_s))
    excitation = Excitation(offsets=chirp.samples(1.0 / tick), band_hz=chirp.band_hz)
    log = synthetic_log(fine, joint, [excitation], *gains, threads=settings.threads)
    target = measured_joints([log], joint, robot, settings)[0]
    with MujocoSimulator(robot, threads=settings.threads) as simulator:
        matched = refine(simulator, target, gains).gains
        errors_db = []
        for stiffness, damping in (gains, matched):
            values = {"stiffness": stiffness, "damping": damping}
            response = simulated_response(simulator, target, values)
            ratio = np.abs(response / target.measured.response)
            errors_db.append(DB * np.log(ratio[target.measured.band(*drive.band_hz)]))
    equal_db, matched_db = errors_db
    return EngineGap(
        gains=gains,
        matched_gains=matched,
        equal_gains_rms_db=float(np.sqrt(np.mean(equal_db**2))),
        equal_gains_max_db=float(np.abs(equal_db).max()),
        matched_rms_db=float(np.sqrt(np.mean(matched_db**2))),
    )


def engine() -> console.Outcome:
    """The same drive at a 0.25 ms step and in the 5 ms training simulator, before and after."""
    robot = load_robot(ROBOT)
    figures = {}
    rows = []
    with console.progress() as report:
        for number, joint in enumerate(JOINTS, start=1):
            gap = engine_gap(robot, joint)
            figures[joint] = {"joint": joint, **asdict(gap)}
            rows.append(
                (
                    joint,
                    "{:g} / {:g}".format(*gap.gains),
                    gap.equal_gains_rms_db,
                    gap.equal_gains_max_db,
                    "{:.2f} / {:.3f}".format(*gap.matched_gains),
                    gap.matched_rms_db,
                )
            )
            report("engine", number / len(JOINTS))
    table = Table(
        title="The same drive at a 0.25 ms step and in the 5 ms training simulator",
        columns=(
            Column(heading="joint"),
            Column(heading="gains of the drive"),
            Column(heading="gap with equal gains, RMS", unit="dB", digits=2),
            Column(heading="largest", unit="dB", digits=2),
            Column(heading="matched gains"),
            Column(heading="gap after the match, RMS", unit="dB"),
        ),
        rows=tuple(rows),
    )
    console.show(table)
    return console.Outcome(figures=figures)
