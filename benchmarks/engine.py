"""`python -m benchmarks engine`: the same drive at a fine step and in the training simulator.

A real drive closes its loop at 40 kHz (paper S4), the training simulator every 5 ms; the same
gains give another response. The drive is simulated at a step fine enough to have converged and in
the training simulator, whose gains are then matched.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.runner import Progress, table
from benchmarks.synthetic_log import Excitation, synthetic_log
from pronk.cli import console
from pronk.excitation.signals import Chirp
from pronk.match.grid import axes, quick_search
from pronk.match.measured_joint import DB, measured_joints
from pronk.match.settings import MatchSettings
from pronk.match.simulated import SimRequest, responses
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec
from pronk.simulators.mujoco import MujocoSimulator

JOINTS = ("FR_hip_roll", "FR_hip_pitch", "FR_knee")
ROBOT = "mini_cheetah"
FINE_TIMESTEP_S = 0.00025


@dataclass(frozen=True, kw_only=True)
class EngineGap:
    """One joint in the training simulator against the fine one, over the joint's band."""

    joint: str
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
    fine_timestep_s: float = FINE_TIMESTEP_S,
    signal: Chirp | None = None,
    settings: MatchSettings | None = None,
) -> EngineGap:
    """Excite one joint in a fine simulator and in the training simulator.

    Both get the same command, held at the policy's rate, and go through the same estimator.

    Args:
        robot: The robot, with the gains of its drives.
        joint: The joint.
        fine_timestep_s: Step of the fine simulator [s].
        signal: The paper's chirp if not given.
        settings: Estimator and threads.
    """
    chosen, chirp, drive = settings or MatchSettings(), signal or Chirp(), robot.joint(joint)
    gains = drive.stiffness, drive.damping
    tick = robot.timestep_s * robot.decimation
    fine = replace(robot, timestep_s=fine_timestep_s, decimation=round(tick / fine_timestep_s))
    excitation = Excitation(offsets=chirp.samples(1.0 / tick), band_hz=chirp.band_hz)
    log = synthetic_log(fine, joint, [excitation], *gains, threads=chosen.threads)
    goal = measured_joints(log, joint, robot, chosen)[0]
    with MujocoSimulator(robot, threads=chosen.threads) as simulator:
        matched = quick_search(simulator, [goal], *axes(robot, chosen.grid_points))[1][0].gains
        requests = [SimRequest(goal, *gains), SimRequest(goal, *matched)]
        coarse, closed = responses(simulator, requests, whole=True)
    hz = goal.measured.omega / (2.0 * np.pi)
    inside = (hz >= drive.band_hz[0] - 1e-9) & (hz <= drive.band_hz[1] + 1e-9)

    def gap_db(response: NDArray[np.complex128]) -> NDArray[np.float64]:
        return np.asarray(DB * np.log(np.abs(response / goal.measured.response))[inside])

    return EngineGap(
        joint=joint,
        gains=gains,
        matched_gains=matched,
        equal_gains_rms_db=float(np.sqrt(np.mean(gap_db(coarse) ** 2))),
        equal_gains_max_db=float(np.abs(gap_db(coarse)).max()),
        matched_rms_db=float(np.sqrt(np.mean(gap_db(closed) ** 2))),
    )


def run(progress: Progress, *, threads: int = 2) -> list[EngineGap]:
    """The gap of one joint of each group, with the gains of the robot's drives."""
    robot, settings, gaps = load_robot(ROBOT), MatchSettings(threads=threads), []
    for k, joint in enumerate(JOINTS, start=1):
        gaps.append(engine_gap(robot, joint, settings=settings))
        progress("engine", k / len(JOINTS))
    return gaps


def engine(json_file: console.JsonFile = None) -> None:
    """The same drive at a 0.25 ms step and in the 5 ms training simulator, before and after.

    Args:
        json_file: Also write the figures to this file.
    """
    with console.progress() as report:
        gaps = run(report)
    columns = (
        "joint",
        "gains of the drive",
        "gap with equal gains, RMS (largest) [dB]",
        "matched gains",
        "gap after the match, RMS [dB]",
    )
    rows = [
        (
            gap.joint,
            "{:g} / {:g}".format(*gap.gains),
            f"{gap.equal_gains_rms_db:.2f} ({gap.equal_gains_max_db:.2f})",
            "{:.2f} / {:.3f}".format(*gap.matched_gains),
            f"{gap.matched_rms_db:.3f}",
        )
        for gap in gaps
    ]
    title = "The same drive at a 0.25 ms step and in the 5 ms training simulator"
    console.show(table(title, columns, rows))
    console.write_json(json_file, {gap.joint: vars(gap) for gap in gaps})
