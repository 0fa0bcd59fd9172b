"""`python -m benchmarks engine`: the same drive at a fine step and in the training simulator.

A real drive closes its loop at 40 kHz (paper S4), the training simulator every 5 ms; the same
gains give another response. The drive is simulated at a step fine enough to have converged and in
the training simulator, whose gains are then matched.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from benchmarks.runner import finish
from pronk.cli import console
from pronk.identify.excitation.signals import Chirp
from pronk.identify.match.magnitude import refine
from pronk.identify.match.measured import DB, measured_joints, simulated_response
from pronk.identify.match.settings import MatchSettings
from pronk.identify.simulators.mujoco import MujocoSimulator
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec
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
    equal_gains_max_db: float
    matched_rms_db: float


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
    settings, chirp, drive = MatchSettings(threads=2), signal or Chirp(), robot.joint(joint)
    gains = drive.stiffness, drive.damping
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
    robot, gaps = load_robot(ROBOT), {}
    with console.progress() as report:
        for k, joint in enumerate(JOINTS, start=1):
            gaps[joint] = engine_gap(robot, joint)
            report("engine", k / len(JOINTS))
    rows = [
        (
            joint,
            "{:g} / {:g}".format(*gap.gains),
            f"{gap.equal_gains_rms_db:.2f} ({gap.equal_gains_max_db:.2f})",
            "{:.2f} / {:.3f}".format(*gap.matched_gains),
            f"{gap.matched_rms_db:.3f}",
        )
        for joint, gap in gaps.items()
    ]
    columns = ["joint", "gains of the drive", "gap with equal gains, RMS (largest) [dB]"]
    columns += ["matched gains", "gap after the match, RMS [dB]"]
    title = "The same drive at a 0.25 ms step and in the 5 ms training simulator"
    figures = {joint: {"joint": joint} | vars(gap) for joint, gap in gaps.items()}
    return finish(figures, console.table(title, columns, rows))
