"""Gains of a joint off the grid, by the magnitude of its measured response (the paper's F7 to F11).

The simulator itself is the model; frequencies are weighted by their coherence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pronk.arrays import Array, ComplexArray
from pronk.errors import IdentifiabilityError
from pronk.identify.match.fit import CachedProblem, Solution, solve_together
from pronk.identify.match.identifiability import bench_experiment, require_identifiable
from pronk.identify.match.measured_joint import DB, MeasuredJoint, Pair, rms
from pronk.identify.match.parameters import GAINS, PARAMETERS
from pronk.identify.match.result import JointFit
from pronk.identify.match.simulated import SimRequest, responses
from pronk.identify.match.uncertainty import Estimate
from pronk.identify.simulators.linear import LinearJoint
from pronk.identify.simulators.simulator import JointRigs
from pronk.robots.robot import RobotSpec

_NOISE_MIN = 0.01
"""Least standard deviation of the log response to plan with: no model is better than 1 %."""


class ResponseProblem(CachedProblem):
    """Weighted gain of one joint's simulated response over the measured one, by its gains."""

    def __init__(
        self,
        rigs: JointRigs,
        goal: MeasuredJoint,
        start: Pair,
        linear: LinearJoint | None = None,
        correction: Array | None = None,
    ) -> None:
        """Begin at some stiffness and damping.

        The `linear` drive gives the Jacobian; with the `correction` of its log gain, shape
        (inside,), the residual as well, and nothing is simulated.
        """
        super().__init__({goal.joint: dict(zip(GAINS, start, strict=True))}, {goal.joint: GAINS})
        self.begin = np.log(np.asarray(start))
        # Near the optimum from the start, and as weak as any drive.
        self.low, self.high = np.full(2, -np.inf), np.full(2, np.inf)
        self.goal, self._rigs, self._linear, self._correction = goal, rigs, linear, correction
        self._steps = np.array([PARAMETERS[name].step for name in GAINS])

    def requests(self, x: Array) -> list[SimRequest]:
        """What to simulate for residual and Jacobian at a point."""
        if self._correction is not None:
            return []
        points = np.exp([x] if self._linear else [x, *(x + np.diag(self._steps))])
        return [SimRequest(self.goal, *pair) for pair in points.tolist()]

    def compared(self, x: Array, simulated: Sequence[ComplexArray]) -> tuple[Array, Array]:
        """Residual and Jacobian at a point, shapes (m,) and (m, 2), of responses to `requests`."""
        deviation, amplitude = self.goal.deviation_db(), self.goal.trace.amplitude
        if self._linear and self._correction is not None:
            closed = self._linear.response(*np.exp(x), amplitude=amplitude)
            simulated = [*(closed * np.exp(self._correction))]
        weighted = self.goal.error_db(np.array(simulated)) / deviation
        if self._linear:
            slope = self._linear.slope(*np.exp(x), amplitude=amplitude)
            jacobian = DB * slope / deviation[:, None]
        else:
            jacobian = (weighted[1:] - weighted[0]).T / self._steps
        return weighted[0], jacobian

    def evaluate(self, x: Array) -> tuple[Array, Array]:
        """Find residual and Jacobian."""
        return self.compared(x, responses(self._rigs, self.requests(x)))


def evaluate(rigs: JointRigs, points: Sequence[tuple[ResponseProblem, Array]]) -> None:
    """Simulate all problems at their points in one go."""
    requests = [problem.requests(x) for problem, x in points]
    simulated = iter(responses(rigs, [one for own in requests for one in own]))
    for (problem, x), own in zip(points, requests, strict=True):
        problem.known[x.tobytes()] = problem.compared(x, [next(simulated) for _ in own])


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Gains of one joint at one amplitude, off the grid."""

    target: MeasuredJoint
    solution: Solution

    @property
    def gains(self) -> Pair:
        """Stiffness [N m/rad] and damping [N m s/rad]."""
        stiffness, damping = np.exp(self.solution.x).tolist()
        return stiffness, damping

    @property
    def gain_db(self) -> Array:
        """Gain of the simulated over the measured response in the band [dB], shape (inside,)."""
        return np.asarray(self.solution.residual * self.target.deviation_db())

    @property
    def error_db(self) -> float:
        """Root mean square of `gain_db`, frequencies counting alike [dB]."""
        return rms(self.gain_db)


def refine(
    rigs: JointRigs,
    targets: Sequence[MeasuredJoint],
    start: Sequence[Pair],
    linear: Sequence[LinearJoint] = (),
    corrections: Sequence[Array] = (),
) -> list[Fit]:
    """Find the gains that minimize the weighted squared gain error, from a `start` each.

    With the `linear` drives of the targets steps are a third as long to compute, and the optimum is
    off by the part of the error that the joint cannot avoid times the error of the linear slope.
    With `corrections` of their log gain, shape (inside,) each, nothing is simulated.
    """
    none = [None] * len(targets)
    each = zip(targets, start, linear or none, corrections or none, strict=True)
    problems = [ResponseProblem(rigs, *one) for one in each]
    solutions = solve_together(problems, lambda points: evaluate(rigs, points))
    return [Fit(target=one, solution=s) for one, s in zip(targets, solutions, strict=True)]


def require_sweeps(
    robot: RobotSpec, joint: str, goals: Sequence[MeasuredJoint], free: Sequence[str]
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
