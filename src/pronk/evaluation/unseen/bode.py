"""How wrong gains are on a robot, in the frequency domain: the paper's argument as a number.

A policy is trained in a simulator whose joints have some gains. The sweep says how the robot's
joints answer. The error of the gains is what the training simulator, asked the very same question
with those gains, answers more or less than the robot did:

    error(f) = 20 log10 |H_simulated(f)| / |H_measured(f)|                [dB]

over the joint's band (paper F11), through the estimator that made the measured response. Beside
the scatter of a policy's jumps this is the paper's case: gains that answer otherwise, jumps that
land elsewhere. It says nothing of what was outside the sweep (ground, mass, delay).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.errors import PronkError
from pronk.evaluation.result import Subject
from pronk.logs.joint_log import SweepLog
from pronk.match.measured_joint import (
    MeasuredJoint,
    SimRequest,
    logs_by_joint,
    measured_joints,
    responses,
)
from pronk.match.settings import MatchSettings
from pronk.robots.robot import Robot
from pronk.simulators.mujoco import MujocoSimulator

Array = NDArray[np.float64]
Gains = Mapping[str, tuple[float, float]]
"""Stiffness [N m/rad] and damping [N m s/rad] by joint."""


@dataclass(frozen=True, kw_only=True)
class BodeError:
    """One joint in the training simulator with some gains, against the robot's answer."""

    joint: str
    stiffness: float
    """In the training simulator [N m/rad]."""
    damping: float
    """In the training simulator [N m s/rad]."""
    omega: Array
    """Frequencies of the band that are coherent enough [rad/s]. (f,)"""
    error_db: Array
    """Simulated over measured gain [dB]. (f,)"""

    @property
    def rms_db(self) -> float:
        """Root mean square over the band, frequencies counting alike [dB]."""
        return float(np.sqrt(np.mean(self.error_db**2)))

    @property
    def largest_db(self) -> float:
        """Largest absolute error in the band [dB]."""
        return float(np.abs(self.error_db).max())


def gains_of(subject: Subject) -> dict[str, tuple[float, float]]:
    """The gains that a policy was trained with, by joint."""
    told = subject.contract
    pairs = zip(told["stiffness"], told["damping"], strict=True)
    return dict(zip(told["joint_names"], pairs, strict=True))


def bode_errors(
    logs: Sequence[SweepLog],
    robot: Robot,
    gains: Mapping[str, Gains],
    *,
    settings: MatchSettings | None = None,
) -> dict[str, tuple[BodeError, ...]]:
    """Errors of several sets of gains on one robot's sweep.

    Args:
        logs: The robot's sweep; the largest amplitude of each joint is compared.
        robot: The robot; its training simulator is asked.
        gains: By a name of your choice (for instance `naive`, `matched`), gains by joint.
        settings: Estimator and coherence limit, those of the match.

    Returns:
        By the same names, one error a joint that was asked, in the robot's order.

    Raises:
        LogError: The logs ask no joint or cannot be used.
        IdentifiabilityError: A joint's band is mostly incoherent.
        PronkError: A set lacks the gains of a joint that was asked.
    """
    chosen = settings or MatchSettings()
    goals = [
        max(
            (goal for log in sources for goal in measured_joints(log, joint, robot, chosen)),
            key=lambda goal: goal.measured.amplitude,
        )
        for joint, sources in logs_by_joint(logs, robot).items()
    ]
    for name, pairs in gains.items():
        for goal in goals:
            if goal.joint not in pairs:
                raise PronkError(
                    f"the gains {name!r} have none for {goal.joint}, which the sweep asked; give "
                    "a pair for every joint asked."
                )
    requests = [SimRequest(goal, *pairs[goal.joint]) for pairs in gains.values() for goal in goals]
    with MujocoSimulator(robot, threads=chosen.threads, device=chosen.device) as simulator:
        answers = responses(simulator, requests)
    errors = [_error(request, answer) for request, answer in zip(requests, answers, strict=True)]
    count = len(goals)
    return {name: tuple(errors[i * count : (i + 1) * count]) for i, name in enumerate(gains)}


def overall_rms_db(errors: Sequence[BodeError]) -> float:
    """Root mean square over joints, each counting alike [dB]."""
    return float(np.sqrt(np.mean([one.rms_db**2 for one in errors])))


def _error(request: SimRequest, answer: NDArray[np.complex128]) -> BodeError:
    goal: MeasuredJoint = request.target
    return BodeError(
        joint=goal.joint,
        stiffness=request.stiffness,
        damping=request.damping,
        omega=goal.omega,
        error_db=goal.error_db(answer),
    )
