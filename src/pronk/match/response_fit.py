"""Fit the drive of a joint to its measured responses, with the simulator itself as the model.

Mode gains: the gain in dB of one amplitude gives stiffness and damping (the paper's F7 to F11, off
the grid). Mode drive: gain and phase of every amplitude together give damping, armature, friction
and delay: the phase holds the delay, and dry friction shows in how the response changes with the
amplitude. Frequencies are weighted by their coherence.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pronk.errors import IdentifiabilityError
from pronk.match.fit import Problem, Solution, solve, solve_together
from pronk.match.identifiability import bench_experiment, require_identifiable
from pronk.match.measured_joint import DB, MeasuredJoint, residual_db
from pronk.match.parameters import FREE, GAINS, PARAMETERS
from pronk.match.result import JointFit
from pronk.match.simulated import SimRequest, responses
from pronk.match.uncertainty import Estimate, estimate, repeat_covariance
from pronk.robots.robot import RobotSpec
from pronk.simulators.simulator import JointRigs

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Pair = tuple[float, float]
"""Stiffness [N m/rad] and damping [N m s/rad]."""

_NOISE_MIN = 0.01
"""Least standard deviation of the log response to plan with: no model is better than 1 %."""


class ResponseProblem(Problem):
    """Residuals of one joint's drive in frequency, at one or more amplitudes."""

    def __init__(
        self,
        rigs: JointRigs,
        goals: Sequence[MeasuredJoint],
        fitted: Sequence[str],
        start: Mapping[str, float],
        *,
        phase: bool,
    ) -> None:
        """Take the joint at each amplitude to fit, largest first; `phase`: fit the phase too.

        What is missing in `start` keeps the simulator's value.
        """
        super().__init__({goals[0].joint: start}, {goals[0].joint: fitted})
        self.goals, self.phase = goals, phase
        self._rigs, self._late = rigs, "delay" in fitted
        # The effect of a delay is known without a simulation.
        self._steps = np.diag([PARAMETERS[n].step for n in fitted if n != "delay"])
        self._steps = np.pad(self._steps, ((0, 0), (0, int(self._late))))
        self._cache: dict[bytes, tuple[Array, Array]] = {}

    def requests(self, x: Array) -> list[SimRequest]:
        """What to simulate for residual and Jacobian at a point."""
        points = [self.values(point)[self.goals[0].joint] for point in (x, *(x + self._steps))]
        return [SimRequest(goal, **values) for goal in self.goals for values in points]

    def take(self, x: Array, simulated: Sequence[ComplexArray]) -> None:
        """Make residual and Jacobian at a point of the responses to `requests`."""
        parts, slopes = [], []
        count = 1 + len(self._steps)
        for k, goal in enumerate(self.goals):
            measured = goal.measured.response[goal.fit_mask]
            mine = np.array(simulated[k * count : (k + 1) * count])
            rows = residual_db(mine, measured, self.phase)
            slope = (rows[1:] - rows[0]) / self._steps.max(axis=1, initial=0.0)[:, None]
            if self._late:
                # Its phase is -omega * delay.
                late = np.concatenate([np.zeros(len(goal.omega)), -DB * goal.omega])
                slope = np.vstack([slope, late])
            weight = goal.weights(self.phase)
            parts.append(rows[0] * weight)
            slopes.append(slope * weight)
        self._cache[x.tobytes()] = np.concatenate(parts), np.concatenate(slopes, axis=1).T

    def residual(self, x: Array) -> Array:
        """Weighted gain (and phase) of simulated over measured responses, shape (m,)."""
        return self._at(x)[0]

    def jacobian(self, x: Array) -> Array:
        """Derivative of `residual` by forward differences, shape (m, p)."""
        return self._at(x)[1]

    def _at(self, x: Array) -> tuple[Array, Array]:
        if x.tobytes() not in self._cache:
            evaluate(self._rigs, [(self, x)])
        return self._cache[x.tobytes()]


def evaluate(rigs: JointRigs, points: Sequence[tuple[ResponseProblem, Array]]) -> None:
    """Simulate all problems at their points in one go."""
    requests = [problem.requests(x) for problem, x in points]
    simulated = responses(rigs, [one for own in requests for one in own])
    first = 0
    for (problem, x), own in zip(points, requests, strict=True):
        problem.take(x, simulated[first : first + len(own)])
        first += len(own)


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Gains of one joint at one amplitude, off the grid."""

    target: MeasuredJoint
    """The measured response."""
    solution: Solution

    @property
    def stiffness(self) -> float:
        """Stiffness [N m/rad]."""
        return float(np.exp(self.solution.x[0]))

    @property
    def damping(self) -> float:
        """Damping [N m s/rad]."""
        return float(np.exp(self.solution.x[1]))

    @property
    def gains(self) -> Pair:
        """Stiffness and damping."""
        return self.stiffness, self.damping

    @property
    def gain_db(self) -> Array:
        """Gain of the simulated over the measured response in the band [dB], shape (inside,)."""
        return np.asarray(self.solution.residual * self.target.deviation_db())

    @property
    def error_db(self) -> float:
        """Root mean square of `gain_db`, frequencies counting alike [dB]."""
        return float(np.sqrt(np.mean(self.gain_db**2)))


def refine(rigs: JointRigs, targets: Sequence[MeasuredJoint], start: Sequence[Pair]) -> list[Fit]:
    """Find the gains that minimize the weighted squared gain error, one fit a target.

    `start` holds the (stiffness, damping) to begin with, one a target.
    """
    problems = []
    for goal, pair in zip(targets, start, strict=True):
        values = dict(zip(GAINS, pair, strict=True))
        problems.append(ResponseProblem(rigs, [goal], GAINS, values, phase=False))
        problems[-1].begin = np.log(np.asarray(pair))
    solutions = solve_together(problems, lambda points: evaluate(rigs, points))
    return [Fit(target=one, solution=s) for one, s in zip(targets, solutions, strict=True)]


def require_sweeps(
    robot: RobotSpec, joint: str, goals: Sequence[MeasuredJoint], free: tuple[str, ...]
) -> None:
    """Refuse what sweeps cannot separate before anything is fitted (`require_identifiable`)."""
    first, nominal = bench_experiment(robot, joint)
    experiments = [
        replace(
            first,
            amplitude=goal.measured.amplitude,
            phase=True,
            frequency_hz=goal.omega / (2.0 * np.pi),
            noise=max(_NOISE_MIN, float(np.median(goal.deviation_db())) / DB),
        )
        for goal in goals
    ]
    try:
        require_identifiable(free, experiments, nominal)
    except IdentifiabilityError as error:
        raise IdentifiabilityError(f"{joint}: {error}") from None


def fit_drive(
    rigs: JointRigs, goals: Sequence[MeasuredJoint], on_drive: Pair, fitted: tuple[str, ...]
) -> JointFit:
    """Fit one joint's drive to gain and phase of its responses at all amplitudes.

    `goals` are the joint at every amplitude, largest first; `on_drive` the gains on the real drive.

    Raises:
        IdentifiabilityError: The repeats leave a fitted parameter unknown.
    """
    goal, name = goals[0], goals[0].joint
    drive = rigs.robot.joint(name).drive
    known = dict(zip(FREE, (*on_drive, drive.armature, drive.frictionloss, 0.0), strict=True))
    problem = ResponseProblem(rigs, goals, fitted, known, phase=True)
    solution = solve(problem, tolerance=1e-7, rounds=100)
    covariance, freedom = repeat_covariance(goals, solution, phase=True)
    found = estimate(fitted, solution.x, covariance, freedom, known)
    if freedom and found.unidentified:
        unknown = found.unidentified[0]
        raise IdentifiabilityError(
            f"{name}: these sweeps do not identify the {unknown} (deviation "
            f"{found.sd[unknown]:.2g}); {PARAMETERS[unknown].remedy}; or hold it at a known value."
        )
    requests = [SimRequest(goal, **values) for values in (found.values, known)]
    matched, naive = responses(rigs, requests, whole=True)
    flags = () if freedom else ("one repeat: no interval; record three or more",)
    return response_fit(
        rigs.robot,
        goals,
        found,
        matched,
        naive,
        error_db=goal.rms_db(matched[goal.fit_mask]),
        flags=flags if solution.settled else (*flags, "the fit did not settle"),
    )


def response_fit(
    robot: RobotSpec,
    goals: Sequence[MeasuredJoint],
    found: Estimate,
    matched: ComplexArray,
    naive: ComplexArray,
    **more: Any,
) -> JointFit:
    """Result of a joint that was fitted to its responses at each amplitude, largest first."""
    goal, band_hz = goals[0], robot.joint(goals[0].joint).band_hz
    return JointFit.of(
        goal.joint,
        found,
        responses=tuple(one.measured for one in goals),
        band_hz=band_hz,
        naive_error_db=goal.rms_db(naive[goal.fit_mask]),
        coherence_min=float(goal.measured.coherence[goal.measured.band(*band_hz)].min()),
        matched=matched,
        naive=naive,
        **more,
    )
