"""The paper's match: gains by the magnitude of the measured response (F7 to F11).

Every gain pair of a grid of 50 x 50 is simulated and compared. From the best node a least squares
with the simulator as its model goes off the grid.

Readings, the paper being silent: the error is the mean over the estimator's frequencies inside
the joint's band of the squared difference of the gains in dB (what a Bode plot shows), every
frequency counting alike; gains of repeats are averaged (as complex responses) before the
comparison; phase is disregarded because a command delay turns it (F9); the armature stays as the
data sheet has it (S6). The least squares weights frequencies by their coherence.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from scipy import special
from scipy.optimize import least_squares

from pronk.arrays import Array, ComplexArray
from pronk.identify.match.measured import (
    FLOOR_DB,
    MeasuredJoint,
    grouped,
    rms,
    simulated_response,
)
from pronk.identify.match.nominal_gains import Pair
from pronk.identify.match.parameters import GAINS, PARAMETERS
from pronk.identify.match.result import DriveFit, GridSearch, ZeroArmature, amplitude_flags
from pronk.identify.match.uncertainty import jackknife
from pronk.identify.response.response import FrequencyResponse
from pronk.identify.simulators.simulator import JointRigs
from pronk.progress import Progress, no_progress
from pronk.robots.robot import RobotSpec

DIVERGED_DB = 100.0
"""Error of a simulation that diverged or did not move [dB]: beyond any response."""
IMPLICIT_REACH = 2.0
"""Largest gains of implicit drive laws over those of the explicit law that answer alike: 1.9 at a
knee of the Mini Cheetah at 10 ms."""
COARSE_POINTS = 13
"""Points of each axis of the two grids of the search without rotor inertia."""
NO_ARMATURE_RATIO = 5.0
"""Error without rotor inertia over the matched error from which on it is no match (F13)."""
_TOLERANCE = 1e-5
"""Relative change of the cost or of the logarithm of a gain that ends the least squares."""
_EVALUATIONS = 30
"""Most evaluations of the least squares; four to six are usual."""
_NOISE_BANDWIDTH = 1.5
"""Equivalent noise bandwidth of the Hann window in bins (Harris 1978, table 1): how many
neighbouring frequencies share their noise."""
_COHERENCE_OF_DELAY = 0.8
"""Least coherence of a frequency whose phase counts for the delay."""


def grid_axes(robot: RobotSpec, points: int = 50) -> tuple[Array, Array]:
    """Return the axes of a robot's grid.

    The paper's (F7) run from 13 to 27 N m/rad and from 0.1 to 0.7 N m s/rad in 50 points each.
    Those of implicit drive laws reach `IMPLICIT_REACH` times as far.

    Args:
        robot: The robot, with the drive law of its simulator.
        points: Points of each axis.

    Returns:
        Stiffness [N m/rad] and damping [N m s/rad], shape (points,) each.
    """
    reach = 1.0 if robot.law.kind == "explicit" else IMPLICIT_REACH
    stiffness_low, stiffness_high = robot.grid_stiffness
    damping_low, damping_high = robot.grid_damping
    stiffness = np.linspace(stiffness_low, reach * stiffness_high, points)
    damping = np.linspace(damping_low, reach * damping_high, points)
    return stiffness, damping


def mean_square(error_db: Array) -> Array:
    """Return the mean square [dB^2], shape (...), of gain errors [dB], shape (..., inside)."""
    clipped = np.clip(error_db, -DIVERGED_DB, DIVERGED_DB)
    finite = np.where(np.isfinite(error_db), clipped, DIVERGED_DB)
    count = error_db.shape[-1]
    # A product is several times faster than a mean along the last axis.
    return np.asarray(finite**2 @ np.full(count, 1.0 / count))


def search_grid(
    rigs: JointRigs,
    targets: Sequence[MeasuredJoint],
    stiffness: Array,
    damping: Array,
    *,
    armature: float | None = None,
    progress: Progress = no_progress,
) -> list[GridSearch]:
    """Simulate every gain pair of a grid and compare it with measured responses.

    Joints that mirror one another and are excited alike share one simulation.

    Args:
        rigs: Joints in the simulator.
        targets: Measured responses, one a joint.
        stiffness: Axis [N m/rad], shape (a,).
        damping: Axis [N m s/rad], shape (b,).
        armature: Rotor inertia [kg m^2]; that of the drives if None.
        progress: Called with the stage `grid` and the share of it that is done, 0 to 1.

    Returns:
        Error over the grid of each target, in the order of the targets.
    """

    def same_simulation(target: MeasuredJoint, other: MeasuredJoint) -> bool:
        return target.trace.same_as(other.trace, rigs.robot)

    pairs = np.stack(np.meshgrid(stiffness, damping, indexing="ij"), axis=-1).reshape(-1, 2)
    values = {"stiffness": pairs[:, 0], "damping": pairs[:, 1]}
    if armature is not None:
        values["armature"] = np.full(len(pairs), armature)
    errors: dict[str, Array] = {}
    groups = grouped(targets, same_simulation)
    for number, group in enumerate(groups):
        # A command may rest longer at its end than the others of its group.
        longest = max(group, key=lambda target: len(target.trace.command)).trace
        steps = max(target.steps for target in group)
        for target in group:
            errors[target.joint] = np.empty(len(pairs))
        for part, position in rigs.run([longest], values, steps):
            for target in group:
                error_db = target.error_db(target.fit_response(position))
                errors[target.joint][part] = mean_square(error_db)
            progress("grid", (number + part.stop / len(pairs)) / len(groups))
    shape = (len(stiffness), len(damping))
    searches = []
    for target in targets:
        error = errors[target.joint].reshape(shape)
        searches.append(GridSearch(stiffness=stiffness, damping=damping, error=error))
    return searches


@dataclass(frozen=True, kw_only=True)
class MagnitudeFit:
    """Gains of one joint at one amplitude, off the grid."""

    target: MeasuredJoint
    stiffness: float
    """[N m/rad]"""
    damping: float
    """[N m s/rad]"""
    residual: Array
    """Gain of the simulated over the measured response in standard deviations, shape (inside,)."""
    jacobian: Array
    """Derivative of the residual by the logarithms of the gains, shape (inside, 2)."""
    settled: bool
    """False if the least squares ended without reaching its tolerance."""

    @property
    def gains(self) -> Pair:
        """Stiffness [N m/rad] and damping [N m s/rad]."""
        return self.stiffness, self.damping

    @property
    def error_db(self) -> float:
        """Root mean square gain error in the band, every frequency counting alike [dB]."""
        return rms(self.residual * self.target.deviation_db())


def refine(rigs: JointRigs, target: MeasuredJoint, start: Pair) -> MagnitudeFit:
    """Find the gains that minimize the weighted squared gain error.

    The derivatives are forward differences; the three simulations of a point are one batch.

    Args:
        rigs: Joints in the simulator.
        target: The measured response.
        start: Stiffness and damping to begin at, for instance the best node of the grid.

    Returns:
        The gains with the residual and its derivatives there.
    """
    deviation_db = target.deviation_db()
    steps = np.array([PARAMETERS[name].step for name in GAINS])

    @cache
    def evaluate(log_stiffness: float, log_damping: float) -> tuple[Array, Array]:
        """Return residual and Jacobian at a point."""
        point = np.array([log_stiffness, log_damping])
        pairs = np.exp(point + np.vstack([np.zeros(2), np.diag(steps)]))
        values = {"stiffness": pairs[:, 0], "damping": pairs[:, 1]}
        responses = np.empty((3, len(deviation_db)), dtype=np.complex128)
        for part, position in rigs.run([target.trace], values, target.steps):
            responses[part] = target.fit_response(position)
        weighted = target.error_db(responses) / deviation_db
        return weighted[0], (weighted[1:] - weighted[0]).T / steps

    def residual(point: Array) -> Array:
        return evaluate(float(point[0]), float(point[1]))[0]

    def jacobian(point: Array) -> Array:
        return evaluate(float(point[0]), float(point[1]))[1]

    solution = least_squares(
        residual,
        np.log(start),
        jac=jacobian,
        x_scale="jac",
        xtol=_TOLERANCE,
        ftol=_TOLERANCE,
        gtol=None,
        max_nfev=_EVALUATIONS,
    )
    stiffness, damping = np.exp(solution.x).tolist()
    return MagnitudeFit(
        target=target,
        stiffness=stiffness,
        damping=damping,
        residual=residual(solution.x),
        jacobian=jacobian(solution.x),
        settled=bool(solution.success),
    )


@dataclass(frozen=True, kw_only=True)
class GainInterval:
    """Uncertainty of stiffness and damping, from the repeats of the measured response."""

    ci95: Mapping[str, tuple[float, float]]
    """95 % interval of `stiffness` and `damping`."""
    covariance: Array
    """Covariance of (stiffness, damping), shape (2, 2)."""
    repeat_gains: Array
    """(stiffness, damping) of each repeat fitted by itself, shape (repeats, 2)."""
    flags: tuple[str, ...] = field(default=())
    """Sentences on intervals that rest on too few repeats."""


def gain_interval(fit: MagnitudeFit) -> GainInterval:
    """Find the intervals of the gains of a fit by magnitude.

    Each repeat moves the optimum by one Gauss-Newton step with the derivatives at the common
    optimum, `(J^T J)^-1 J^T` times what the repeat differs from the mean: repeats differ by little.

    With one repeat there is nothing to compare; the interval is then that of the coherence
    (Fisher information of the weighted fit, widened by the correlation of neighbouring
    frequencies and by the misfit), which takes noise for white, and a flag states it.
    """
    target = fit.target
    optimum = np.array(fit.gains)
    deviation_db = target.deviation_db()
    influence = np.linalg.pinv(fit.jacobian)
    count = len(target.measured.repeats)
    flags: tuple[str, ...] = ()
    if count < 2:
        white_share = np.maximum(deviation_db**2 - FLOOR_DB**2, 0.0) / deviation_db**2
        freedom = max(len(fit.residual) - 2, 1)
        misfit = max(1.0, float(fit.residual @ fit.residual) / freedom)
        relative = _NOISE_BANDWIDTH * misfit * (influence * white_share) @ influence.T
        covariance = relative * np.outer(optimum, optimum)
        repeat_gains = optimum[None, :]
        quantile = float(special.ndtri(0.975))
        flags = ("one repeat: the interval assumes white noise",)
    else:
        # Residuals are simulated less measured: a larger response needs larger gains there.
        change = target.error_db(target.measured.repeats[:, target.fit_mask]) / deviation_db
        repeat_gains = optimum * np.exp(change @ influence.T)
        covariance = jackknife(repeat_gains / (count - 1))
        quantile = float(special.stdtrit(count - 1, 0.975))
        if count == 2:
            flags = ("two repeats: the interval is wide, three or more narrow it",)
    half_width = quantile * np.sqrt(np.diag(covariance))
    ci95 = {}
    for name, best, half in zip(GAINS, optimum.tolist(), half_width.tolist(), strict=True):
        ci95[name] = (max(best - half, 0.0), best + half)
    return GainInterval(ci95=ci95, covariance=covariance, repeat_gains=repeat_gains, flags=flags)


def command_delay(
    measured: FrequencyResponse, matched: ComplexArray, band_hz: tuple[float, float]
) -> float:
    """Find the delay of the measured response behind the matched one.

    The magnitude gives the gains (paper F9); phase = -omega * delay is a straight line through
    zero. Least squares over the joint's band: every frequency with enough coherence counts alike.

    Args:
        measured: The measured response, at f frequencies.
        matched: The simulated response, shape (f,).
        band_hz: The joint's band [Hz].

    Returns:
        The delay [s], never negative; zero where no frequency is coherent enough.
    """
    band = measured.band(*band_hz, _COHERENCE_OF_DELAY)
    if not band.any():
        return 0.0
    omega = measured.omega[band]
    lag = -np.unwrap(np.angle(measured.response[band] / matched[band]))
    return max(0.0, float(omega @ lag / (omega @ omega)))


def fit_magnitude(
    rigs: JointRigs, targets: Sequence[MeasuredJoint], search: GridSearch
) -> DriveFit:
    """Match one joint by the magnitude of its response, from the best node of the grid.

    Args:
        rigs: Joints in the simulator.
        targets: Measured responses of the joint, the largest amplitude, which is matched, first.
        search: The grid of the largest amplitude.

    Returns:
        The gains with their intervals; smaller amplitudes are fitted to show whether the gains
        change with the amplitude.
    """
    joint = rigs.robot.joint(targets[0].joint)
    fit = refine(rigs, targets[0], search.gains)
    rows = [(fit.target.measured.amplitude, fit.stiffness, fit.damping)]
    for target in targets[1:]:
        smaller = refine(rigs, target, fit.gains)
        rows.append((target.measured.amplitude, smaller.stiffness, smaller.damping))
    amplitude_gains = np.array(rows)
    interval = gain_interval(fit)
    gains = {"stiffness": fit.stiffness, "damping": fit.damping}
    matched = simulated_response(rigs, fit.target, gains)
    flags: list[str] = []
    if search.at_edge:
        flags.append(
            f"at the edge of the grid ({search.gains[0]:.3g} N m/rad, "
            f"{search.gains[1]:.3g} N m s/rad)"
        )
    if not fit.settled:
        flags.append("the refinement did not settle; take the gains of the grid")
    flags.extend(interval.flags)
    flags.extend(amplitude_flags(amplitude_gains))
    values = {
        **gains,
        "armature": joint.drive.armature,
        "frictionloss": float("nan"),
        "stribeck": 0.0,
        "delay": command_delay(fit.target.measured, matched, joint.band_hz),
    }
    return DriveFit(
        joint=joint.name,
        values=values,
        ci95=interval.ci95,
        covariance=interval.covariance,
        amplitude_gains=amplitude_gains,
        settled=fit.settled,
        flags=tuple(flags),
    )


def search_without_armature(
    rigs: JointRigs, target: MeasuredJoint, matched_error_db: float, no_match_db: float
) -> ZeroArmature:
    """Look for gains that match without rotor inertia (paper F13).

    A coarse grid over the robot's whole one, and a second one between the neighbours of its best
    node, show that no node fits at an eighth of the cost.

    Args:
        rigs: Joints in the simulator.
        target: The measured response.
        matched_error_db: Error of the match with the rotor inertia of the drive [dB].
        no_match_db: Error above which gains are no match [dB].

    Returns:
        The smallest error, the simulated response there, and whether it is ruled out.
    """
    stiffness, damping = grid_axes(rigs.robot, COARSE_POINTS)
    (coarse,) = search_grid(rigs, [target], stiffness, damping, armature=0.0)
    row, column = coarse.cell
    (fine,) = search_grid(
        rigs,
        [target],
        _around(stiffness, row),
        _around(damping, column),
        armature=0.0,
    )
    values = {"stiffness": fine.gains[0], "damping": fine.gains[1], "armature": 0.0}
    ratio = fine.error_db / max(matched_error_db, 1e-6)
    return ZeroArmature(
        error_db=fine.error_db,
        response=simulated_response(rigs, target, values),
        ruled_out=ratio >= NO_ARMATURE_RATIO and fine.error_db > no_match_db,
    )


def _around(axis: Array, index: int) -> Array:
    """Return an axis between the neighbours of a point of another axis."""
    low = axis[max(index - 1, 0)]
    high = axis[min(index + 1, len(axis) - 1)]
    return np.linspace(low, high, COARSE_POINTS)
