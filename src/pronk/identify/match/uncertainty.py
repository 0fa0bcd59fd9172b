"""Confidence intervals of fitted parameters.

The unit of uncertainty is a block: a repeat of an excitation, or a piece of a recording in time.
Noise on a robot is coloured and neighbouring frequencies and samples share it, so intervals that
take them for independent are several times too narrow; blocks are independent whatever the colour.
Intervals are Student's t over the blocks, which holds with as few as three.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from pronk.arrays import Array
from pronk.identify.match.parameters import GAINS, PARAMETERS

WIDEST = 20.0
"""Widest half-width of an interval of a searched number: e^20 is as good as infinite, and does not
overflow."""


def jackknife(moves: Array) -> Array:
    """Covariance of an optimum that moves when one block is left out, shape (p, p).

    It is `(n - 1) / n sum (move - mean) (move - mean)^T`. Where the optimum is the mean of n
    repeats, `moves = repeats / (n - 1)` gives their sample covariance over n.

    Args:
        moves: Where the optimum moves without each block, shape (n, p).
    """
    about_mean = moves - np.mean(moves, axis=0)
    count = len(moves)
    return np.asarray((count - 1) / count * about_mean.T @ about_mean)


def block_moves(jacobian: Array, residual: Array, blocks: NDArray[np.int64]) -> Array:
    """Find where the optimum moves when one block of residuals is left out.

    To first order it is `(A - A_b)^-1 J_b^T r_b` with A = J^T J and A_b = J_b^T J_b.

    Args:
        jacobian: Derivative of the residuals, shape (m, p).
        residual: Residuals at the optimum, shape (m,).
        blocks: Number of the block of each residual, shape (m,).

    Returns:
        The moves, shape (blocks, p).
    """
    normal = jacobian.T @ jacobian
    # A parameter without effect must come out as very uncertain, not as an error.
    normal = normal + 1e-12 * np.trace(normal) * np.eye(len(normal))
    numbers = np.unique(blocks)
    moves = np.empty((len(numbers), jacobian.shape[1]))
    for row, number in enumerate(numbers):
        inside = blocks == number
        block_jacobian = jacobian[inside]
        remaining = normal - block_jacobian.T @ block_jacobian
        gradient = block_jacobian.T @ residual[inside]
        moves[row] = np.linalg.lstsq(remaining, gradient, rcond=None)[0]
    return moves


def repeat_moves(
    jacobian: Array,
    residual: Array,
    commands: NDArray[np.int64],
    recordings: NDArray[np.int64],
) -> list[Array]:
    """Find where the optimum moves when one repeat of a command is left out.

    To first order, by one Gauss-Newton step from the common optimum.

    Args:
        jacobian: Derivative of the residuals, shape (m, p).
        residual: Residuals at the optimum, shape (m,).
        commands: Number of the command of each residual, shape (m,).
        recordings: Number of the recording of each residual, shape (m,).

    Returns:
        The moves of each command that was repeated, shape (repeats, p), one array a command.
    """
    inverse = np.linalg.pinv(jacobian)
    moves_by_command = []
    for command in np.unique(commands):
        repeats = np.unique(recordings[commands == command])
        count = len(repeats)
        if count < 2:
            continue
        moves = np.empty((count, jacobian.shape[1]))
        for row, repeat in enumerate(repeats):
            inside = recordings == repeat
            moves[row] = inverse[:, inside] @ residual[inside]
        moves_by_command.append(moves * count / (count - 1))
    return moves_by_command


def time_blocks(times: Sequence[Array], length_s: float) -> list[NDArray[np.int64]]:
    """Cut recordings into blocks of about the same length.

    Args:
        times: Timestamps of each recording [s], shape (n,) each.
        length_s: Length of a block [s].

    Returns:
        Number of the block of each timestamp, counted through all recordings.
    """
    numbers = []
    first = 0
    for time in times:
        span = time[-1] - time[0]
        count = max(round(span / length_s), 1)
        block = ((time - time[0]) / span * count).astype(np.int64)
        numbers.append(first + np.minimum(block, count - 1))
        first += count
    return numbers


@dataclass(frozen=True, kw_only=True)
class Estimate:
    """Parameters of one joint with their uncertainty."""

    values: Mapping[str, float]
    """Every parameter, fitted or held."""
    covariance: Array
    """Covariance of (stiffness, damping), zero for what was held, shape (2, 2)."""
    sd: Mapping[str, float]
    """Standard deviation of each fitted parameter: relative, of delay and offset in [s], [rad]."""
    ci95: Mapping[str, tuple[float, float]]
    """95 % interval of each fitted parameter, by repeats or by blocks of time."""

    @property
    def unidentified(self) -> tuple[str, ...]:
        """Fitted parameters whose deviation is beyond the limit of `PARAMETERS`."""
        return tuple(name for name, sd in self.sd.items() if not sd <= PARAMETERS[name].sd_max)


def estimate_parameters(
    fitted: Sequence[str],
    x: Array,
    covariance: Array,
    freedom: int,
    values: Mapping[str, float],
) -> Estimate:
    """Turn searched numbers into parameters with intervals.

    Args:
        fitted: Names of the fitted parameters.
        x: Their searched numbers, shape (p,).
        covariance: Covariance of the searched numbers, shape (p, p).
        freedom: Degrees of freedom of the covariance, 1 or more.
        values: Value of every parameter, fitted or held.

    Returns:
        The parameters; intervals are symmetric about the searched numbers.
    """
    quantile = float(special.stdtrit(freedom, 0.975))
    deviation = np.sqrt(np.diag(covariance))
    sd = {}
    ci95 = {}
    scale = np.ones(len(fitted))
    for column, name in enumerate(fitted):
        parameter = PARAMETERS[name]
        half_width = min(quantile * float(deviation[column]), WIDEST)
        ci95[name] = interval_ends(name, float(x[column]), half_width, half_width)
        sd[name] = float(deviation[column])
        if parameter.log:
            scale[column] = values[name]
    of_values = covariance * np.outer(scale, scale)
    gain_covariance = np.zeros((2, 2))
    for row, row_name in enumerate(GAINS):
        for column, column_name in enumerate(GAINS):
            if row_name in fitted and column_name in fitted:
                entry = of_values[fitted.index(row_name), fitted.index(column_name)]
                gain_covariance[row, column] = entry
    return Estimate(values=values, covariance=gain_covariance, sd=sd, ci95=ci95)


def total_intervals(
    fitted: Sequence[str],
    x: Array,
    ci95: Mapping[str, tuple[float, float]],
    part_moves: Array,
    gains_by_amplitude: Array,
) -> dict[str, tuple[float, float]]:
    """Widen intervals so that they cover what the model does not explain.

    Where nothing was repeated, the given intervals are by blocks. Repeats and parts of the
    excitations count in quadrature. The gains of several amplitudes show what the model lacks
    better than the parts, which then count with their deviation alone; no interval of a gain is
    narrower than its change between amplitudes.

    Args:
        fitted: Names of the fitted parameters.
        x: Searched numbers at the optimum, shape (p,).
        ci95: Their intervals by repeats, or by blocks where nothing was repeated.
        part_moves: Where the optimum moves without each part of the excitations, shape (n, p).
        gains_by_amplitude: Amplitude, stiffness and damping of each amplitude, shape (m, 3).

    Returns:
        95 % interval of each fitted parameter.
    """
    deviation = np.sqrt(np.diag(jackknife(part_moves)))
    quantile = float(special.stdtrit(len(part_moves) - 1, 0.975))
    intervals = {}
    for name, center, part_deviation in zip(fitted, x, deviation, strict=True):
        parameter = PARAMETERS[name]
        part_width = quantile * part_deviation
        change = 0.0
        if name in GAINS and len(gains_by_amplitude) > 1:
            part_width = part_deviation
            for gain in gains_by_amplitude[:, 1 + GAINS.index(name)]:
                change = max(change, abs(parameter.scaled(gain) - center))
        widths = []
        for end in ci95[name]:
            number = parameter.scaled(max(end, 1e-9) if parameter.log else end)
            width = max(float(np.hypot(number - center, part_width)), change)
            widths.append(min(width, WIDEST))
        intervals[name] = interval_ends(name, float(center), widths[0], widths[1])
    return intervals


def interval_ends(
    name: str, center: float, low_width: float, high_width: float
) -> tuple[float, float]:
    """Return the ends of an interval of a parameter.

    A parameter that may vanish is searched in its logarithm, along which nothing changes near
    zero. Where its interval reaches beyond e, the widths are taken as relative ones: of a value of
    0.01 N m with a deviation of 300 % it is known that it is below some 0.07 N m.

    Args:
        name: Name of the parameter.
        center: Its searched number.
        low_width: Width of the interval below the searched number.
        high_width: Width above it.
    """
    parameter = PARAMETERS[name]
    value = parameter.unscaled(center)
    if parameter.log and parameter.may_vanish and max(low_width, high_width) > 1.0:
        return max(value * (1.0 - low_width), 0.0), value * (1.0 + high_width)
    return parameter.unscaled(center - low_width), parameter.unscaled(center + high_width)


STEP_SHARE = 0.4
"""Uncertainty of matched gains by the finite step of the simulator, over what the step changes. An
explicit step h acts as less inertia, by the share `c = damping h / (2 inertia)`, and gains that
move alike are lower by about c. No gains move alike at every frequency, so those that match best in
time and those that match best in the response differ: by 0.42 c at most over 40 joints of 2 to 9 Hz
(`tests/joint_mechanisms.py`, seed 1)."""
LEAST_SHARE = 0.005
"""Least relative half-width of a total interval: inertias of models have three digits at best."""


def widen_by_step(
    total95: Mapping[str, tuple[float, float]], values: Mapping[str, float], step_share: float
) -> dict[str, tuple[float, float]]:
    """Widen the intervals of the gains by what the finite step of the simulator leaves open.

    Args:
        total95: Intervals by name.
        values: Parameters by name.
        step_share: c, which is `damping timestep / (2 inertia)`.
    """
    return _widened_gains(total95, values, max(STEP_SHARE * step_share, LEAST_SHARE))


HONEST_MISFIT = 0.008
"""Unexplained motion, as a share of the amplitude, that widens no interval: 54 of 60 honest joints
of `tests/joint_mechanisms.py` (seed 4101) leave less than 0.010 and half of them less than 0.003,
the virtual robot 0.008."""
MISFIT_FACTOR = 13.0
"""Relative error of a gain over the unexplained share of the motion. For 42 joints with the faults
of `tests/joint_mechanisms.py` (seed 4102) it is 4 to 8 for backlash, an integral part, filters of
the position and Stribeck friction, and 2 for a dead band. Of 26 logs with such faults of the
benchmark `foreign` (seed 41), matched with gains that are off by 15 % or more, the intervals then
hold the gains of 11, and without it of none. A lag of the torque or of the command, friction that
grows with the load and a payload look as other gains do, and leave less unexplained."""


def widen_by_misfit(
    total95: Mapping[str, tuple[float, float]], values: Mapping[str, float], misfit: float
) -> dict[str, tuple[float, float]]:
    """Widen the intervals of the gains by what motion that the model does not explain may hide.

    Args:
        total95: Intervals by name.
        values: Parameters by name.
        misfit: Unexplained motion without noise, as a share of the amplitude.
    """
    if misfit <= HONEST_MISFIT:
        return dict(total95)
    return _widened_gains(
        total95, values, MISFIT_FACTOR * float(np.sqrt(misfit**2 - HONEST_MISFIT**2))
    )


def _widened_gains(
    total95: Mapping[str, tuple[float, float]], values: Mapping[str, float], extra: float
) -> dict[str, tuple[float, float]]:
    """Widen the intervals of the gains by a relative half-width, in quadrature."""
    widened = dict(total95)
    for name in GAINS:
        if name in total95 and values[name] > 0.0:
            parameter = PARAMETERS[name]
            center = parameter.scaled(values[name])
            widths = []
            for end in total95[name]:
                width = float(np.hypot(parameter.scaled(max(end, 1e-9)) - center, extra))
                widths.append(min(width, WIDEST))
            widened[name] = interval_ends(name, center, widths[0], widths[1])
    return widened
