"""`python -m benchmarks engine`: the same drive at a fine step and in the training simulator.

Gains belong to a simulator, not to a robot alone. A real drive closes its loop at 40 kHz (S4); the
training simulator closes it every 5 ms, so the same gains give another response. The same drive is
simulated at a step fine enough to have converged and in the training simulator, whose gains are
then matched.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text

from benchmarks.synthetic_log import Excitation, synthetic_log
from pronk.excitation.signals import Chirp
from pronk.match.grid import axes
from pronk.match.measured_joint import DB, SimRequest, measured_joints, responses
from pronk.match.quick import quick_search
from pronk.match.settings import MatchSettings
from pronk.robots import load_robot
from pronk.robots.robot import Robot
from pronk.simulators.mujoco import MujocoSimulator

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

JOINTS = ("FR_hip_roll", "FR_hip_pitch", "FR_knee")
ROBOT = "mini_cheetah"
FINE_TIMESTEP_S = 0.00025


@dataclass(frozen=True, kw_only=True)
class EngineGap:
    """One joint in a fine and in the training simulator."""

    joint: str
    omega: Array
    """[rad/s], shape (f,)."""
    band_hz: tuple[float, float]
    fine: ComplexArray
    """Response of the fine simulator with the drive's gains, shape (f,)."""
    coarse: ComplexArray
    """Response of the training simulator with the same gains, shape (f,)."""
    matched: ComplexArray
    """Response of the training simulator with the matched gains, shape (f,)."""
    gains: tuple[float, float]
    """Stiffness and damping of the drive."""
    matched_gains: tuple[float, float]
    """Stiffness and damping that make the training simulator answer alike."""

    def gap_db(self, other: ComplexArray) -> Array:
        """Gain of another response over the fine one in the band [dB], shape (inside,)."""
        hz = self.omega / (2.0 * np.pi)
        inside = (hz >= self.band_hz[0] - 1e-9) & (hz <= self.band_hz[1] + 1e-9)
        return np.asarray(DB * np.log(np.abs(other / self.fine))[inside])

    @property
    def equal_gains_rms_db(self) -> float:
        """Gap with equal gains, RMS over the band [dB]."""
        return float(np.sqrt(np.mean(self.gap_db(self.coarse) ** 2)))

    @property
    def equal_gains_max_db(self) -> float:
        """Gap with equal gains, largest in the band [dB]."""
        return float(np.abs(self.gap_db(self.coarse)).max())

    @property
    def matched_rms_db(self) -> float:
        """Gap after the match, RMS over the band [dB]."""
        return float(np.sqrt(np.mean(self.gap_db(self.matched) ** 2)))


def engine_gap(
    robot: Robot,
    joint: str,
    *,
    stiffness: float | None = None,
    damping: float | None = None,
    fine_timestep_s: float = FINE_TIMESTEP_S,
    signal: Chirp | None = None,
    settings: MatchSettings | None = None,
) -> EngineGap:
    """Ask one joint in a fine simulator and in the training simulator.

    Both get the same command, held at the policy's rate, and go through the same estimator.

    Args:
        robot: The robot.
        joint: The joint.
        stiffness: Gain of the drive [N m/rad]; the robot's if not given.
        damping: Gain of the drive [N m s/rad]; the robot's if not given.
        fine_timestep_s: Step of the fine simulator [s].
        signal: The question; the paper's chirp if not given.
        settings: Estimator and threads.
    """
    chosen = settings or MatchSettings()
    asked = robot.joint(joint)
    gains = (
        asked.stiffness if stiffness is None else stiffness,
        asked.damping if damping is None else damping,
    )
    chirp = signal or Chirp()
    tick = robot.timestep_s * robot.decimation
    fine = replace(robot, timestep_s=fine_timestep_s, decimation=round(tick / fine_timestep_s))
    log = synthetic_log(
        fine,
        joint,
        [Excitation(offsets=chirp.samples(1.0 / tick), band_hz=chirp.band_hz)],
        *gains,
        threads=chosen.threads,
    )
    goal = measured_joints(log, joint, robot, chosen)[0]
    with MujocoSimulator(robot, threads=chosen.threads) as simulator:
        best = quick_search(simulator, [goal], *axes(robot, chosen.grid_points))[0].fit
        matched = (best.stiffness, best.damping)
        coarse_answer, matched_answer = responses(
            simulator, [SimRequest(goal, *gains), SimRequest(goal, *matched)], whole=True
        )
    return EngineGap(
        joint=joint,
        omega=goal.measured.omega,
        band_hz=asked.band_hz,
        fine=goal.measured.response,
        coarse=coarse_answer,
        matched=matched_answer,
        gains=gains,
        matched_gains=matched,
    )


def run(
    progress: Callable[[str, float], None] | None = None, *, threads: int = 2
) -> tuple[EngineGap, ...]:
    """The gap of one joint of each group, with the gains of the robot's drives."""
    robot = load_robot(ROBOT)
    gaps = []
    for k, joint in enumerate(JOINTS):
        if progress is not None:
            progress("engine", k / len(JOINTS))
        gaps.append(engine_gap(robot, joint, settings=MatchSettings(threads=threads)))
    if progress is not None:
        progress("engine", 1.0)
    return tuple(gaps)


def table(gaps: tuple[EngineGap, ...]) -> Table:
    """A row a joint."""
    made = Table(title=Text("The same drive at a 0.25 ms step and in the 5 ms training simulator"))
    made.title_justify = "left"
    made.add_column("joint")
    for column in (
        "gains of the drive",
        "gap with equal gains, RMS (largest) [dB]",
        "gains that answer alike in training",
        "gap after the match, RMS [dB]",
    ):
        made.add_column(Text(column), justify="right")
    for gap in gaps:
        made.add_row(
            gap.joint,
            "{:g} / {:g}".format(*gap.gains),
            f"{gap.equal_gains_rms_db:.2f} ({gap.equal_gains_max_db:.2f})",
            "{:.2f} / {:.3f}".format(*gap.matched_gains),
            f"{gap.matched_rms_db:.3f}",
        )
    return made
