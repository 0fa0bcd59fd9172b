"""Fit the drive of a joint to its measured responses, with the simulator itself as the model.

Mode gains: the gain in dB of one amplitude gives stiffness and damping (the paper's F7 to F11, off
the grid). Mode drive: gain and phase of every amplitude together give damping, armature, friction
and delay: the phase holds the delay, and dry friction shows in how the response changes with the
amplitude. Frequencies are weighted by their coherence.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from pronk.errors import IdentifiabilityError
from pronk.match.fit import (
    GAINS,
    PARAMETERS,
    Estimate,
    Solution,
    begin,
    bounds,
    estimate,
    jackknife,
    solve,
    solve_together,
)
from pronk.match.identifiability import EXPERIMENTS, bench_experiment, require_identifiable
from pronk.match.measured_joint import DB, FLOOR_DB, MeasuredJoint, SimRequest, responses
from pronk.match.result import JointFit
from pronk.robots.robot import RobotSpec
from pronk.simulators.simulator import JointRigs

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

FREE = ("stiffness", "damping", "armature", "frictionloss", "delay")
"""What mode drive can fit."""
_SHARED = 1.5
"""Equivalent noise bandwidth of the Hann window in bins (Harris 1978, table 1): how many
neighbouring frequencies share their noise."""
_NOISE_MIN = 0.01
"""Least standard deviation of the log response to plan with: no model is better than 1 %."""


def residual_db(simulated: ComplexArray, measured: ComplexArray, phase: bool) -> Array:
    """Simulated over measured response in dB, gain and then (if used) phase, shape (..., m).

    A radian of phase counts as a neper of gain, 8.69 dB: noise turns a response as much as it
    stretches it.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.log(np.asarray(simulated / measured, dtype=np.complex128))
    if not phase:
        return np.asarray(DB * ratio.real)
    return np.concatenate([DB * ratio.real, DB * np.unwrap(ratio.imag, axis=-1)], axis=-1)


class ResponseProblem:
    """Residuals of one joint's drive in frequency, as a `Problem`."""

    def __init__(
        self,
        rigs: JointRigs,
        goals: Sequence[MeasuredJoint],
        fitted: tuple[str, ...],
        known: Mapping[str, float],
        *,
        phase: bool,
        start: Array | None = None,
    ) -> None:
        """Take in what was measured.

        Args:
            rigs: The training simulator.
            goals: The joint at each amplitude to fit, largest first.
            fitted: Names of the parameters to fit, in the order of `PARAMETERS`.
            known: Values of the parameters; of the fitted ones, where to begin. What is missing
                keeps the simulator's value.
            phase: Fit the phase too.
            start: Searched numbers to begin with, instead of `known` moved inside the bounds.
        """
        self.goals, self.fitted, self.known, self.phase = goals, fitted, known, phase
        self.low, self.high = bounds(fitted)
        self.begin: Array = (
            begin(fitted, [known[n] for n in fitted], [False] * len(fitted))
            if start is None
            else start
        )
        self._rigs = rigs
        # The effect of a delay is known without a simulation.
        self._steps = np.diag([PARAMETERS[n].step for n in fitted if n != "delay"])
        if "delay" in fitted:
            self._steps = np.pad(self._steps, ((0, 0), (0, 1)))
        self._cache: dict[bytes, tuple[Array, Array]] = {}

    def values(self, x: Array) -> dict[str, float]:
        """Every parameter that some searched numbers stand for."""
        fitted = zip(self.fitted, x, strict=True)
        return {**self.known, **{n: PARAMETERS[n].unscaled(float(v)) for n, v in fitted}}

    def requests(self, x: Array) -> list[SimRequest]:
        """What to simulate for residual and Jacobian at a point."""
        points = [self.values(point) for point in (x, *(x + self._steps))]
        return [SimRequest(goal, **values) for goal in self.goals for values in points]

    def take(self, x: Array, simulated: Sequence[ComplexArray]) -> None:
        """Make residual and Jacobian at a point of the responses to `requests`."""
        parts, slopes = [], []
        count = 1 + len(self._steps)
        for k, goal in enumerate(self.goals):
            measured = goal.measured.response[goal.fit_mask]
            rows = residual_db(
                np.array(simulated[k * count : (k + 1) * count]), measured, self.phase
            )
            slope = (rows[1:] - rows[0]) / self._steps.max(axis=1, initial=0.0)[:, None]
            if "delay" in self.fitted:
                # Its phase is -omega * delay.
                late = np.concatenate([np.zeros(len(goal.omega)), -DB * goal.omega])
                slope = np.vstack([slope, late])
            weight = self.weight(goal)
            parts.append(rows[0] * weight)
            slopes.append(slope * weight)
        self._cache[x.tobytes()] = np.concatenate(parts), np.concatenate(slopes, axis=1).T

    def residual(self, x: Array) -> Array:
        """Weighted gain (and phase) of simulated over measured responses, shape (m,)."""
        return self._at(x)[0]

    def jacobian(self, x: Array) -> Array:
        """Derivative of `residual` by forward differences, shape (m, p)."""
        return self._at(x)[1]

    def weight(self, goal: MeasuredJoint) -> Array:
        """Weight of each residual of an amplitude [1/dB]."""
        return np.tile(1.0 / goal.deviation_db(), 1 + self.phase)

    def _at(self, x: Array) -> tuple[Array, Array]:
        if x.tobytes() not in self._cache:
            evaluate(self._rigs, [(self, x)])
        return self._cache[x.tobytes()]

    def repeat_moves(self, solution: Solution) -> list[Array]:
        """Where each repeat of each amplitude would move the optimum, shapes (repeats, p).

        By one Gauss-Newton step with the simulator's own derivatives at the common optimum,
        `(J^T J)^-1 J^T` times what the repeat differs from the mean: repeats differ by little.
        """
        influence = np.linalg.pinv(solution.jacobian)
        out, first = [], 0
        for goal in self.goals:
            weight = self.weight(goal)
            part = influence[:, first : first + len(weight)]
            first += len(weight)
            repeats = goal.measured.repeats[:, goal.fit_mask]
            change = residual_db(repeats, goal.measured.response[goal.fit_mask], self.phase)
            # Residuals are simulated less measured: a larger response needs larger gains there.
            out.append((change * weight) @ part.T)
        return out


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

    problem: ResponseProblem
    solution: Solution

    @property
    def target(self) -> MeasuredJoint:
        """The measured response."""
        return self.problem.goals[0]

    @property
    def stiffness(self) -> float:
        """Stiffness [N m/rad]."""
        return float(np.exp(self.solution.x[0]))

    @property
    def damping(self) -> float:
        """Damping [N m s/rad]."""
        return float(np.exp(self.solution.x[1]))

    @property
    def gain_db(self) -> Array:
        """Gain of the simulated over the measured response in the band [dB], shape (inside,)."""
        return np.asarray(self.solution.residual * self.target.deviation_db())

    @property
    def error_db(self) -> float:
        """Root mean square of `gain_db`, frequencies counting alike [dB]."""
        return float(np.sqrt(np.mean(self.gain_db**2)))


def refine(
    rigs: JointRigs, targets: Sequence[MeasuredJoint], start: Sequence[tuple[float, float]]
) -> list[Fit]:
    """Find the gains that minimize the weighted squared gain error, one pair a target.

    Args:
        rigs: The training simulator.
        targets: What to match.
        start: (stiffness, damping) to start from, one a target.
    """
    problems = [
        ResponseProblem(rigs, [goal], GAINS, {}, phase=False, start=np.log(np.asarray(pair)))
        for goal, pair in zip(targets, start, strict=True)
    ]
    solutions = solve_together(problems, lambda points: evaluate(rigs, points))
    return [
        Fit(problem=problem, solution=one) for problem, one in zip(problems, solutions, strict=True)
    ]


def interval(fit: Fit) -> Estimate:
    """Uncertainty of refined gains, from the repeats of the measured response.

    With one repeat there is nothing to compare; the interval is then that of the coherence
    (Fisher information of the weighted fit, widened by the correlation of neighbouring
    frequencies and by the misfit), which takes noise for white, and a flag states it.
    """
    goal, solution = fit.target, fit.solution
    optimum = np.array([fit.stiffness, fit.damping])
    count = len(goal.measured.repeats)
    flags: tuple[str, ...] = ()
    if count < 2:
        deviation = goal.deviation_db()
        white = np.maximum(deviation**2 - FLOOR_DB**2, 0.0) / deviation**2
        influence = np.linalg.pinv(solution.jacobian)
        free = max(len(solution.residual) - 2, 1)
        misfit = max(1.0, float(solution.residual @ solution.residual) / free)
        covariance = _SHARED * misfit * (influence * white) @ influence.T
        covariance = covariance * np.outer(optimum, optimum)
        gains, quantile = optimum[None, :], float(stats.norm.ppf(0.975))
        flags = ("one repeat: the interval assumes white noise",)
    else:
        gains = optimum * np.exp(fit.problem.repeat_moves(solution)[0])
        covariance = jackknife(gains / (count - 1))
        quantile = float(stats.t.ppf(0.975, count - 1))
        if count == 2:
            flags = ("two repeats: the interval is wide, three or more narrow it",)
    sd = np.sqrt(np.diag(covariance))
    ends = zip(GAINS, optimum.tolist(), (quantile * sd).tolist(), strict=True)
    return Estimate(
        values=dict(zip(GAINS, optimum.tolist(), strict=True)),
        covariance=covariance,
        sd=dict(zip(GAINS, (sd / optimum).tolist(), strict=True)),
        ci95={name: (max(gain - half, 0.0), gain + half) for name, gain, half in ends},
        repeat_gains=gains,
        flags=flags,
    )


def require_sweeps(
    robot: RobotSpec, joint: str, goals: Sequence[MeasuredJoint], free: tuple[str, ...]
) -> None:
    """Refuse what sweeps cannot separate, before anything is fitted.

    Raises:
        IdentifiabilityError: Names the parameters and the experiments that would help.
    """
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
    rigs: JointRigs,
    goals: Sequence[MeasuredJoint],
    on_drive: tuple[float, float],
    fitted: tuple[str, ...],
) -> JointFit:
    """Fit one joint's drive to gain and phase of its responses at all amplitudes.

    Args:
        rigs: The training simulator.
        goals: The joint at every amplitude, largest first.
        on_drive: Stiffness and damping on the real drive.
        fitted: What to fit, out of `FREE`.

    Raises:
        IdentifiabilityError: The repeats leave a fitted parameter unknown.
    """
    goal = goals[0]
    joint = rigs.robot.joint(goal.joint)
    drive = joint.drive
    known = dict(zip(FREE, (*on_drive, drive.armature, drive.frictionloss, 0.0), strict=True))
    problem = ResponseProblem(rigs, goals, fitted, known, phase=True)
    solution = solve(problem, tolerance=1e-7, rounds=100)
    counts = [len(one.measured.repeats) for one in goals]
    freedom = sum(count - 1 for count in counts)
    covariance = np.zeros((len(fitted), len(fitted)))
    for count, moves in zip(counts, problem.repeat_moves(solution), strict=True):
        if count > 1:
            covariance += jackknife(moves / (count - 1))
    found = estimate(fitted, solution.x, covariance, freedom, known)
    if freedom and found.unidentified:
        name = found.unidentified[0]
        raise IdentifiabilityError(
            f"{joint.name}: these sweeps do not identify the {name} (deviation "
            f"{found.sd[name]:.2g}); {EXPERIMENTS[name]}; or hold it at a known value."
        )
    requests = [SimRequest(goal, **values) for values in (found.values, known)]
    matched, naive = responses(rigs, requests, whole=True)
    flags = () if freedom else ("one repeat: no interval; record three or more",)
    return JointFit(
        joint=joint.name,
        responses=tuple(one.measured for one in goals),
        stiffness=found.values["stiffness"],
        damping=found.values["damping"],
        armature=found.values["armature"],
        frictionloss=found.values["frictionloss"],
        delay_s=found.values["delay"],
        ci95=found.ci95,
        covariance=found.covariance,
        band_hz=joint.band_hz,
        error_db=goal.rms_db(matched[goal.fit_mask]),
        naive_error_db=goal.rms_db(naive[goal.fit_mask]),
        coherence_min=float(goal.measured.coherence[goal.measured.band(*joint.band_hz)].min()),
        matched=matched,
        naive=naive,
        flags=flags if solution.settled else (*flags, "the fit did not settle"),
    )
