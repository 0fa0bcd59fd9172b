"""The paper's point: gains belong to a simulator, not to a robot alone.

A real drive closes its loop at 40 kHz (S4); the training simulator closes it every 5 ms. The same
gains therefore answer differently. Here the same drive is asked in a simulator fine enough to
have converged and in the training simulator, and the training simulator's gains are matched.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pronk.excitation.signals import Chirp
from pronk.match.grid import axes
from pronk.match.measured_joint import DB, targets
from pronk.match.quick import quick_search
from pronk.match.settings import MatchSettings
from pronk.match.synthetic_log import Ask, rehearse
from pronk.robots.robot import Robot
from pronk.simulators.batch import Job, Simulator

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

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
    log = rehearse(
        fine,
        joint,
        [Ask(offsets=chirp.samples(1.0 / tick), band_hz=chirp.band_hz)],
        *gains,
        threads=chosen.threads,
    )
    goal = targets(log, joint, robot, chosen)[0]
    with Simulator(robot, threads=chosen.threads) as simulator:
        best = quick_search(simulator, [goal], *axes(robot, chosen.grid_points))[0].fit
        matched = (best.stiffness, best.damping)
        coarse_answer, matched_answer = simulator.responses(
            [Job(goal, *gains), Job(goal, *matched)], whole=True
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
