"""The H1 estimate of a fixed command as a matrix.

With the command given, H1 is linear in the position: `H = position @ A`, A complex of shape
(samples, f) and computed once. A grid of simulated positions becomes responses in one matrix
product, by the same segments, windows, means and interpolation that the measured log went through.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pronk.response.estimator import Estimator
from pronk.response.grid import Grid, grid_over, held_mean, hold, pull_back
from pronk.response.spectra import layout, rests, segment_spectra

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, kw_only=True)
class H1Operator:
    """Linear map from the positions of one question to its response."""

    omega: Array
    """[rad/s], shape (f,)."""
    time: Array
    """Measured timestamps of the log it was built for [s], shape (n,)."""
    grid: Grid
    """The analysis grid."""
    weights: ComplexArray
    """Map from positions on the grid, shape (grid.count, f)."""
    excitation: Array
    """Sum of |U|^2: the weight of this question among repeats, shape (f,)."""

    @classmethod
    def build(
        cls,
        time: Array,
        command: Array,
        estimator: Estimator,
        *,
        rate_hz: float | None = None,
        padded: bool | None = None,
    ) -> H1Operator:
        """Compute the map for one command.

        Args:
            time: Measured timestamps [s], shape (n,).
            command: Command in force at each [rad], shape (n,).
            estimator: Must ask for H1: the others are not linear in the position.
            rate_hz: Rate of the analysis grid; that of the timestamps if not given. `estimate`
                takes one rate for all questions of a log (`estimate.log_rate`).
            padded: The question starts and ends at rest; read off the command if not given
                (`spectra.rests`), as `estimate` does.

        Raises:
            PronkError: The estimator is not H1.
            LogError: The question is shorter than two segments.
        """
        grid = grid_over(time, rate_hz)
        held = held_mean(time, command, grid)
        at_rest = rests(held, grid.rate_hz) if padded is None else padded
        where = layout(grid, estimator, padded=at_rest)
        excited = segment_spectra(held, where, estimator)
        uu = np.asarray((np.abs(excited) ** 2).sum(axis=0))
        scale = 1.0 / np.maximum(uu, np.finfo(np.float64).tiny)
        conjugate = np.conj(excited) * (scale / hold(where.omega, grid.rate_hz))
        samples = np.arange(len(where.window)) / grid.rate_hz
        kernel = where.window[:, None] * np.exp(-1j * np.outer(samples, where.omega))
        # Taking the mean of a segment away is taking the mean of the kernel away.
        kernel -= kernel.mean(axis=0)
        # Padding repeats the first and last sample; its weights gather on them.
        before = max(0, -int(where.starts[0]))
        after = max(0, int(where.starts[-1]) + len(where.window) - grid.count)
        spread = np.zeros((before + grid.count + after, len(where.omega)), dtype=np.complex128)
        for start, row in zip(where.starts + before, conjugate, strict=True):
            spread[start : start + len(where.window)] += kernel * row
        weights = spread[before : before + grid.count].copy()
        weights[0] += spread[:before].sum(axis=0)
        weights[-1] += spread[before + grid.count :].sum(axis=0)
        return cls(
            omega=where.omega,
            time=np.asarray(time, dtype=np.float64),
            grid=grid,
            weights=weights,
            excitation=uu,
        )

    def matrix(self, sample_times: Array) -> ComplexArray:
        """Map from positions sampled at other instants, so that `H = positions @ matrix`.

        The cubic interpolation onto the analysis grid is included. For a large batch multiply by
        `matrix.real` and `matrix.imag` apart, made contiguous, with the batch in one dimension:
        numpy turns real positions into complex ones otherwise.

        Args:
            sample_times: Increasing instants on the clock of the log [s], shape (m,), for
                instance the physics steps of a simulation from `time[0]` on.

        Returns:
            Shape (m, f).

        Raises:
            LogError: The instants do not span the question.
        """
        return pull_back(self.weights, np.asarray(sample_times, dtype=np.float64), self.grid)

    @cached_property
    def _own(self) -> Array:
        """Map from positions at the measured timestamps, real beside imaginary, (n, 2 f)."""
        own = self.matrix(self.time)
        return np.concatenate([own.real, own.imag], axis=1)

    def apply(self, position: Array) -> ComplexArray:
        """Response of positions at the measured timestamps.

        Args:
            position: Shape (..., n).

        Returns:
            Shape (..., f).
        """
        # One real product of two matrices: the only kind that runs at full speed.
        values = np.asarray(position, dtype=np.float64)
        answer = values.reshape(-1, values.shape[-1]) @ self._own
        width = len(self.omega)
        joined = answer[:, :width] + 1j * answer[:, width:]
        return np.asarray(joined.reshape(*values.shape[:-1], width))


def combine(responses: Sequence[ComplexArray], operators: Sequence[H1Operator]) -> ComplexArray:
    """Response over several repeats, each weighted by its excitation.

    Equal to H1 of all their segments together; for repeats of one command it is their mean.

    Args:
        responses: One per operator, shape (..., f) each.
        operators: Of repeats of one question, on the same frequencies.
    """
    weight = np.array([operator.excitation for operator in operators])
    share = weight / np.maximum(weight.sum(axis=0), np.finfo(np.float64).tiny)
    return np.asarray(sum(r * s for r, s in zip(responses, share, strict=True)))
