"""Least squares over the parameters of drives: what is searched, what is compared, the search."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from pronk.arrays import Array, Mask
from pronk.identify.match.parameters import PARAMETERS, SearchRange
from pronk.identify.match.replay import Replay
from pronk.identify.simulators.chain import DriveValues

Ranges = Mapping[str, Mapping[str, SearchRange]]
"""Where each parameter of each joint is searched."""

TOLERANCE = 1e-3
"""Relative change of the cost or of the parameters that ends a search: far below the intervals."""
EVALUATIONS = 15
"""Most evaluations of one search; four to six are usual."""
OUT_OF_EVALUATIONS = 0
"""Status with which `scipy.optimize.least_squares` says that it ran out of evaluations."""
AT_BOUND = 1e-3
"""Distance from a bound, as a share of the range of the search, from which on a fit is at it."""


class DriveVector:
    """The numbers that a search moves, and the drives that they stand for."""

    def __init__(
        self,
        fitted: Mapping[str, Sequence[str]],
        start: DriveValues,
        ranges: Ranges | None = None,
    ) -> None:
        """Choose what is searched.

        Args:
            fitted: Names of the fitted parameters of each joint. The delay is one for all joints.
            start: All parameters of each joint; the fitted ones where the search begins.
            ranges: Where the parameters of each joint are searched; the bounds of `PARAMETERS`
                where a joint is missing.
        """
        self.fitted = fitted
        self.start = start
        self.names: list[str] = []
        """Name of each searched number."""
        self.columns: dict[str, list[int]] = {}
        """Searched numbers of each joint, in the order of its fitted parameters."""
        begin = []
        low = []
        high = []
        for joint, names in fitted.items():
            self.columns[joint] = []
            for name in names:
                if name == "delay" and "delay" in self.names:
                    self.columns[joint].append(self.names.index("delay"))
                    continue
                self.columns[joint].append(len(self.names))
                self.names.append(name)
                parameter = PARAMETERS[name]
                lowest = parameter.low
                highest = parameter.high
                if ranges is not None and joint in ranges:
                    lowest = ranges[joint][name].low
                    highest = ranges[joint][name].high
                begin.append(parameter.scaled(max(start[joint][name], lowest)))
                low.append(parameter.scaled(lowest))
                high.append(parameter.scaled(highest))
        self.low = np.array(low)
        """Lower bounds, shape (p,)."""
        self.high = np.array(high)
        """Upper bounds, shape (p,)."""
        margin = 1e-3 * (self.high - self.low)
        self.begin = np.clip(np.array(begin), self.low + margin, self.high - margin)
        """Where the search begins, shape (p,)."""

    def drives(self, x: Array) -> dict[str, dict[str, float]]:
        """Parameters by joint that some searched numbers, shape (p,), stand for."""
        drives = {joint: dict(values) for joint, values in self.start.items()}
        for joint, names in self.fitted.items():
            for name, column in zip(names, self.columns[joint], strict=True):
                drives[joint][name] = PARAMETERS[name].unscaled(float(x[column]))
        return drives

    def column(self, joint: str, name: str) -> int:
        """Searched number of a fitted parameter of a joint."""
        return self.columns[joint][self.fitted[joint].index(name)]


class Residuals:
    """Weighted differences between simulated and measured positions, over searched numbers."""

    def __init__(self, replay: Replay, samples: Sequence[Mask], vector: DriveVector) -> None:
        """Choose what is compared.

        Args:
            replay: Recordings and their simulation.
            samples: Samples of each recording to compare, shape (n,) each.
            vector: What is searched.
        """
        self.replay = replay
        self.vector = vector
        self._samples = samples
        self._last_x: Array | None = None
        self._last_residual = np.empty(0)
        self._last_jacobian_x: Array | None = None
        self._last_jacobian = np.empty((0, 0))
        numbers = []
        commands = []
        blocks = []
        weights = []
        amplitudes = []
        for number, recording in enumerate(replay.recordings):
            mask = samples[number]
            count = int(mask.sum())
            numbers.append(np.full(count, number))
            commands.append(np.full(count, recording.command))
            amplitudes.append(np.full(count, recording.amplitude))
            blocks.append(recording.block[mask])
            weights.append(recording.weight[mask])
        self.recording = np.concatenate(numbers)
        """Number of the recording of each residual, shape (m,)."""
        self.command = np.concatenate(commands)
        """Number of the command of each residual, shape (m,)."""
        self.amplitude = np.concatenate(amplitudes)
        """Amplitude of each residual [rad], shape (m,); NaN for joints that moved together."""
        self.block = np.concatenate(blocks)
        """Number of the block of the jackknife of each residual, shape (m,)."""
        self.weight = np.concatenate(weights)
        """Weight of each residual [1/rad], shape (m,)."""

    def rows(self, joint: str) -> Mask:
        """Tell which residuals are a joint's, shape (m,)."""
        of_joint = np.array([recording.joint == joint for recording in self.replay.recordings])
        return np.asarray(of_joint[self.recording])

    def compared(self, positions: Sequence[Array]) -> Array:
        """Weighted differences of the simulated positions of each recording, shape (m,)."""
        differences = []
        for number, recording in enumerate(self.replay.recordings):
            mask = self._samples[number]
            if not mask.any():
                continue
            difference = positions[number][mask] - recording.position[mask]
            # A simulation that diverged is as wrong as a joint can be, not undefined.
            difference = np.clip(np.nan_to_num(difference, nan=np.pi), -np.pi, np.pi)
            if recording.mean_free:
                difference = difference - difference.mean()
            differences.append(difference * recording.weight[mask])
        return np.concatenate(differences)

    def residual(self, x: Array) -> Array:
        """Weighted differences at some searched numbers, shape (m,)."""
        if self._last_x is None or not np.array_equal(x, self._last_x):
            (positions,) = self.replay.positions([self.vector.drives(x)])
            self._last_x = x.copy()
            self._last_residual = self.compared(positions)
        return self._last_residual

    def jacobian(self, x: Array) -> Array:
        """Derivative of `residual`, shape (m, p), by forward differences.

        A residual depends on the parameters of its own joint. One simulation serves a parameter of
        all joints.
        """
        if self._last_jacobian_x is None or not np.array_equal(x, self._last_jacobian_x):
            self._last_jacobian = self._differences(x)
            self._last_jacobian_x = x.copy()
        return self._last_jacobian

    def _differences(self, x: Array) -> Array:
        """Simulate with each parameter changed, and return the derivatives, shape (m, p)."""
        vector = self.vector
        step = np.empty(len(x))
        for column, name in enumerate(vector.names):
            step[column] = PARAMETERS[name].step
            if name == "delay":
                step[column] = self.replay.delay_step_s
        step = np.where(x + step <= vector.high, step, -step)
        moved = np.clip(x + step, vector.low, vector.high)
        names = list(dict.fromkeys(vector.names))
        sets = []
        for name in names:
            changed = np.array(vector.names) == name
            sets.append(vector.drives(np.where(changed, moved, x)))
        before = self.residual(x)
        after = {}
        for name, positions in zip(names, self.replay.positions(sets), strict=True):
            after[name] = self.compared(positions)
        jacobian = np.zeros((len(before), len(x)))
        for joint, columns in vector.columns.items():
            rows = self.rows(joint)
            for column in columns:
                change = after[vector.names[column]][rows] - before[rows]
                jacobian[rows, column] = change / (moved[column] - x[column])
        return jacobian

    def rmse(self, residual: Array, joint: str) -> float:
        """Root mean square difference of a joint, weighted as the fit weights it [rad]."""
        rows = self.rows(joint)
        squares = float(np.sum(residual[rows] ** 2))
        return float(np.sqrt(squares / np.sum(self.weight[rows] ** 2)))

    def misfit(self, residual: Array, joint: str) -> float:
        """Root mean square difference of a joint without its noise, weighted as `rmse` [rad].

        Noise of two samples is independent, so that products of neighbouring differences have
        none of it: `sqrt(mean(r_i r_(i+1)))`.
        """
        rows = self.rows(joint)
        of_joint = residual[rows]
        weight = self.weight[rows]
        neighbours = self.recording[rows][1:] == self.recording[rows][:-1]
        products = float(np.sum((of_joint[1:] * of_joint[:-1])[neighbours]))
        weights = float(np.sum((weight[1:] * weight[:-1])[neighbours]))
        return float(np.sqrt(max(products, 0.0) / weights)) if weights > 0.0 else 0.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Optimum:
    """The best drives of a search."""

    residuals: Residuals
    """What was minimized."""
    x: Array
    """Searched numbers, shape (p,)."""
    residual: Array
    """Weighted differences there, shape (m,)."""
    jacobian: Array
    """Derivative of the residual, shape (m, p)."""
    settled: bool
    """False if the search ran out of evaluations."""

    @property
    def cost(self) -> float:
        """Sum of the squared residuals."""
        return float(self.residual @ self.residual)

    @property
    def vector(self) -> DriveVector:
        """What was searched."""
        return self.residuals.vector

    def drives(self) -> dict[str, dict[str, float]]:
        """All parameters of each joint."""
        return self.vector.drives(self.x)

    def at_bound(self, joint: str) -> tuple[str, ...]:
        """Fitted parameters of a joint at a bound of the search that is no possible result."""
        vector = self.vector
        names = []
        for name, column in zip(vector.fitted[joint], vector.columns[joint], strict=True):
            near = AT_BOUND * (vector.high[column] - vector.low[column])
            at_low = self.x[column] - vector.low[column] < near
            at_high = vector.high[column] - self.x[column] < near
            if at_high or (at_low and not PARAMETERS[name].may_vanish):
                names.append(name)
        return tuple(names)


def minimize_residuals(
    residuals: Residuals, *, tolerance: float = TOLERANCE, evaluations: int = EVALUATIONS
) -> Optimum:
    """Minimize the sum of squared residuals within the bounds, from where their vector begins.

    It is the trust-region reflective method (Branch, Coleman and Li, SIAM J. Sci. Comput. 21,
    1999).

    Args:
        residuals: What to minimize.
        tolerance: Relative change of the cost or of the numbers that ends the search.
        evaluations: Most evaluations of the residuals.
    """
    vector = residuals.vector
    if not vector.names:
        nothing = np.empty(0)
        residual = residuals.residual(nothing)
        jacobian = np.empty((len(residual), 0))
        return Optimum(
            residuals=residuals, x=nothing, residual=residual, jacobian=jacobian, settled=True
        )

    def stop_at_optimum(x: Array) -> None:
        """End the search where another step promises less than the tolerance.

        The search itself would simulate that step and its derivatives to find out.
        """
        residual = residuals.residual(x)
        jacobian = residuals.jacobian(x)
        step = np.linalg.lstsq(jacobian, residual, rcond=None)[0]
        promised = float(np.sum((jacobian @ step) ** 2))
        if promised < tolerance * float(residual @ residual):
            raise StopIteration

    result = least_squares(
        residuals.residual,
        vector.begin,
        jac=residuals.jacobian,
        bounds=(vector.low, vector.high),
        x_scale="jac",
        xtol=tolerance,
        ftol=tolerance,
        max_nfev=evaluations,
        callback=stop_at_optimum,
    )
    return Optimum(
        residuals=residuals,
        x=np.asarray(result.x),
        residual=np.asarray(result.fun),
        jacobian=np.asarray(result.jac),
        settled=result.status != OUT_OF_EVALUATIONS,
    )
