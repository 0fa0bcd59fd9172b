"""Fit of single joints in the time domain, with the simulator itself as the model.

Residuals are simulated less measured positions at the timestamps of the log, of every repeat of
every excitation in which the joint alone was excited. Dry friction, which changes the response
with the amplitude, and the delay are fitted with the gains, so that neither passes for stiffness
or damping. Each octave and each amplitude counts alike: a residual is divided by the square root
of the frequency, in which a linear chirp spends its time, and by the amplitude. The mean of each
repeat is left out: the zero of an encoder is no dynamics.

Every fourth part of what was recorded is kept aside first, and the fit is compared there with the
nominal gains, the nominal gains with the best delay, and a plain fit of stiffness, damping and
delay. The result is fitted to everything.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.interpolate import CubicSpline

from pronk.arrays import Array, Mask
from pronk.logs.joint_log import JointLog
from pronk.match.fit import Problem, Solution, solve_together
from pronk.match.parameters import GAINS, PARAMETERS
from pronk.match.uncertainty import Estimate, block_moves, estimate, jackknife
from pronk.response.estimate import excitations
from pronk.robots.robot import RobotSpec
from pronk.simulators.command_trace import CommandTrace, command_trace
from pronk.simulators.simulator import JointRigs

Masks = Sequence[Sequence[Mask]]
"""Samples of each repeat of each excitation."""

TIME_FIT = ("stiffness", "damping", "frictionloss", "delay")
"""What is fitted where the armature is known."""
_PLAIN = ("stiffness", "damping", "delay")
_SETTLED = 1e-3
"""Relative change of the cost, to come, that ends a search: half as much of an error."""
_LONGEST = 1.0
"""Longest step of the logarithm of a parameter: friction may be a hundred times off."""
_LOWEST_HZ = 0.3
"""Frequencies below count alike: a chirp is ramped up there and the joint follows one to one."""
_BLOCKS = 8
"""Parts of an excitation that are left out in turn, and of which every fourth is kept aside where
there are no repeats."""
_OVERSAMPLED = 2.0
"""Samples a physics step from which on only some of them are used."""


class Repeat(NamedTuple):
    """One recording of a command."""

    time: Array
    """Timestamps after the first step of the command [s], shape (n,)."""
    position: Array
    """Measured, in the coordinate of the joint [rad], shape (n,)."""
    weight: Array
    """Of each residual [1/rad], shape (n,)."""


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """One command to one joint, and what its repeats recorded."""

    trace: CommandTrace
    amplitude: float
    """[rad]"""
    repeats: tuple[Repeat, ...]

    def at(self, time: Array, delay: float) -> Array:
        """Instants of the simulation that some timestamps show with a delay [s], shape (n,)."""
        last = (len(self.trace.command) - 1) * self.trace.timestep
        return np.clip(time - delay, 0.0, last)


@dataclass(frozen=True, kw_only=True)
class TimeFit:
    """The drive of one joint, fitted in time."""

    estimate: Estimate
    """Parameters and their intervals by the repeats."""
    total95: Mapping[str, tuple[float, float]]
    """95 % interval of each fitted parameter with what the model does not explain: the gains of
    each amplitude by itself, and those without each part of the excitations."""
    amplitude_gains: Array
    """(amplitude, stiffness, damping) of each amplitude fitted by itself, shape (m, 3)."""
    held_out: Mapping[str, float]
    """RMSE [rad] on what was kept aside: `nominal`, `nominal_delayed`, `plain`, `matched`."""
    settled: bool
    at_bound: tuple[str, ...]
    """Fitted parameters that ended at a bound of the search."""
    problem: TimeProblem
    """What was fitted."""
    solution: Solution
    """Its optimum, with residuals and Jacobian."""


def recorded(logs: Sequence[JointLog], joint: str, robot: RobotSpec) -> list[Recorded]:
    """Every excitation of one joint in some logs, repeats together, largest amplitude first.

    Raises:
        LogError: The joint was not excited, or its unit is not radians.
    """
    found: list[Recorded] = []
    for log in logs:
        for part in (part for group in excitations(log, joint) for part in group):
            trace = command_trace(part, part.segments[0], joint, robot)
            repeat = _repeat(part, trace)
            for i, known in enumerate(found):
                if known.trace.same_as(trace, robot):
                    found[i] = replace(known, repeats=(*known.repeats, repeat))
                    break
            else:
                amplitude = part.segments[0].amplitude
                found.append(Recorded(trace=trace, amplitude=amplitude, repeats=(repeat,)))
    return sorted(found, key=lambda one: -one.amplitude)


def _repeat(part: JointLog, trace: CommandTrace) -> Repeat:
    """Samples of one excitation, with the weight of each."""
    every = max(1, int(part.rate_hz * trace.timestep / _OVERSAMPLED + 1e-6))
    inside = np.flatnonzero((part.time >= trace.time[0]) & (part.time <= trace.time[-1]))[::every]
    weight = np.full(len(inside), 1.0 / part.segments[0].amplitude)
    if part.frequency is not None:
        # Between excitations the joint is at rest, which holds nothing of its dynamics.
        hz = np.nan_to_num(part.frequency[inside], nan=np.inf)
        weight = weight / np.sqrt(np.maximum(hz, _LOWEST_HZ))
    return Repeat(
        time=part.time[inside] - trace.start,
        position=part.position[inside, part.column(trace.joint)],
        weight=weight,
    )


class Simulations:
    """What was recorded of one joint, and its simulations so far."""

    def __init__(self, rigs: JointRigs, records: Sequence[Recorded]) -> None:
        self.records = records
        self.joint = records[0].trace.joint
        self._rigs = rigs
        self._names = [n for n in PARAMETERS if n in rigs.parameters - {"delay"}]
        self._known: dict[tuple[float, ...], list[CubicSpline]] = {}

    def tracks(self, drives: Sequence[Mapping[str, float]]) -> list[list[CubicSpline]]:
        """Position over time after the first step, of each drive and record, without delay [rad].

        A joint begins at rest and does not change with time, so a delay of its command is the same
        delay of its position, and needs no simulation of its own. Pi where it diverged.
        """
        keys = [tuple(drive[name] for name in self._names) for drive in drives]
        if new := [key for key in dict.fromkeys(keys) if key not in self._known]:
            rigs, traces = self._rigs, [one.trace for one in self.records]
            centre = traces[0].pose[rigs.robot.joint_names.index(self.joint)]
            sign = rigs.robot.joint(self.joint).original[1]
            values = dict(zip(self._names, np.repeat(new, len(traces), axis=0).T, strict=True))
            runs = [trace for _ in new for trace in traces]
            whole = np.empty((len(runs), max(len(trace.command) for trace in traces)))
            for part, position in rigs.run(runs, values, whole.shape[1]):
                whole[part] = position
            whole = centre + sign * np.clip(np.nan_to_num(whole, nan=np.pi), -np.pi, np.pi)
            for k, key in enumerate(new):
                mine = whole[k * len(traces) :]
                self._known[key] = [
                    CubicSpline(trace.time - trace.start, row[: len(trace.command)])
                    for trace, row in zip(traces, mine, strict=False)
                ]
        return [self._known[key] for key in keys]

    def rmse(self, drive: Mapping[str, float], masks: Masks) -> float:
        """Root mean square of simulated less measured position, each octave counting alike [rad].

        Over some samples; the mean of each repeat is left out.
        """
        squares, weights = 0.0, 0.0
        for one, track, own in zip(self.records, self.tracks([drive])[0], masks, strict=True):
            for repeat, mask in zip(one.repeats, own, strict=True):
                if mask.any():
                    at = one.at(repeat.time[mask], drive["delay"])
                    wrong, weight = track(at) - repeat.position[mask], repeat.weight[mask] ** 2
                    squares += float(weight @ (wrong - wrong.mean()) ** 2)
                    weights += float(weight.sum())
        return float(np.sqrt(squares / weights))


class TimeProblem(Problem):
    """Residuals of the drive of one joint in time."""

    def __init__(
        self,
        simulations: Simulations,
        fitted: Sequence[str],
        start: Mapping[str, float],
        masks: Masks | None = None,
    ) -> None:
        """Fit some parameters; `start` has all of them, `masks` the samples used, all if None."""
        joint = simulations.joint
        super().__init__({joint: start}, {joint: fitted}, refitted=(joint,))
        self.simulations, self.records, self.fitted = simulations, simulations.records, fitted
        self._masks = masks or [
            [np.ones(len(repeat.time), dtype=bool) for repeat in one.repeats]
            for one in self.records
        ]
        self._cache: dict[bytes, tuple[Array, Array]] = {}

    def drive(self, x: Array) -> dict[str, float]:
        """All parameters of the joint that some searched numbers stand for."""
        return self.values(x)[self.simulations.joint]

    def residual(self, x: Array) -> Array:
        """Weighted simulated less measured position, means removed, shape (m,)."""
        return self._at(x)[0]

    def jacobian(self, x: Array) -> Array:
        """Derivative of `residual`, by forward differences; of the delay exact, shape (m, p)."""
        return self._at(x)[1]

    def _at(self, x: Array) -> tuple[Array, Array]:
        if x.tobytes() not in self._cache:
            steps = np.array([PARAMETERS[name].step for name in self.fitted])
            steps = np.where(x + steps <= self.high, steps, -steps)
            moved = [i for i, name in enumerate(self.fitted) if name != "delay"]
            points = [x, *(x + np.where(np.arange(len(x)) == i, steps, 0.0) for i in moved)]
            tracks = self.simulations.tracks([self.drive(point) for point in points])
            delay, rows, slopes = self.drive(x)["delay"], [], []
            for n, (one, masks) in enumerate(zip(self.records, self._masks, strict=True)):
                for repeat, mask in zip(one.repeats, masks, strict=True):
                    if not mask.any():
                        continue
                    at = one.at(repeat.time[mask], delay)
                    simulated = [track[n](at) for track in tracks]
                    both = np.empty((1 + len(x), len(at)))
                    both[0] = simulated[0] - repeat.position[mask]
                    for i, row in zip(moved, simulated[1:], strict=True):
                        both[1 + i] = (row - simulated[0]) / steps[i]
                    if "delay" in self.fitted:
                        both[1 + self.fitted.index("delay")] = -tracks[0][n](at, 1)
                    both = (both - both.mean(axis=1, keepdims=True)) * repeat.weight[mask]
                    rows.append(both[0])
                    slopes.append(both[1:])
            self._cache[x.tobytes()] = np.concatenate(rows), np.hstack(slopes).T
        return self._cache[x.tobytes()]


def fit_joint(
    rigs: JointRigs,
    records: Sequence[Recorded],
    fitted: Sequence[str],
    start: Mapping[str, float],
    nominal: Mapping[str, float],
) -> TimeFit:
    """Fit some parameters of one joint's drive.

    `start` has all parameters, of those fitted where to begin; `nominal` is the drive as published,
    with the gains that were on it.
    """
    fitted = [n for n in fitted if n == "delay" or n in rigs.parameters]
    kept, aside = _split(records)
    simulations = Simulations(rigs, records)

    def fit(names: Sequence[str], begin: Mapping[str, float]) -> dict[str, float]:
        if not names:
            return dict(begin)
        problem = TimeProblem(simulations, names, begin, kept)
        return problem.drive(_solved(problem).x)

    trained, plain = fit(fitted, start), [name for name in _PLAIN if name in fitted]
    drives = {
        "nominal": nominal,
        "nominal_delayed": fit(("delay",), {**nominal, "delay": trained["delay"]}),
        "plain": fit(plain, {**nominal, **{name: trained[name] for name in plain}}),
        "matched": trained,
    }
    errors = {name: simulations.rmse(drive, aside) for name, drive in drives.items()}
    problem = TimeProblem(simulations, fitted, trained)
    solution = _solved(problem)
    found, by_amplitude = _estimate(problem, solution), _by_amplitude(problem, solution)
    return TimeFit(
        estimate=found,
        total95=_total(problem, solution, found, by_amplitude),
        amplitude_gains=by_amplitude,
        held_out=errors,
        settled=solution.settled,
        at_bound=tuple(n for n, at in zip(fitted, solution.at_bound, strict=True) if at),
        problem=problem,
        solution=solution,
    )


def _solved(problem: TimeProblem) -> Solution:
    return solve_together([problem], tolerance=_SETTLED, longest=_LONGEST)[0]


def _split(records: Sequence[Recorded]) -> tuple[list[list[Mask]], list[list[Mask]]]:
    """Samples to fit and to keep aside: the last repeat, or every fourth part without repeats."""
    kept = []
    for one in records:
        count = len(one.repeats)
        if count > 1:
            row = [np.full(len(r.time), k < count - 1) for k, r in enumerate(one.repeats)]
        else:
            row = [_part(one.repeats[0]) % 4 != 3]
        kept.append(row)
    return kept, [[~mask for mask in row] for row in kept]


def _part(repeat: Repeat) -> NDArray[np.int64]:
    """Number of the part of an excitation that each sample is in, shape (n,)."""
    return (_BLOCKS * np.arange(len(repeat.time)) // len(repeat.time)).astype(np.int64)


def _numbers(records: Sequence[Recorded]) -> tuple[NDArray[np.int64], ...]:
    """Excitation, repeat and part of each residual, counted through, shapes (m,)."""
    rows = [
        (np.full(len(r.time), i), np.full(len(r.time), k), _part(r))
        for i, one in enumerate(records)
        for k, r in enumerate(one.repeats)
    ]
    excitation, repeat, part = (np.concatenate(column) for column in zip(*rows, strict=True))
    most = max(len(one.repeats) for one in records)
    return excitation, excitation * most + repeat, excitation * _BLOCKS + part


def _estimate(problem: TimeProblem, solution: Solution) -> Estimate:
    """Parameters with intervals by the repeats of each excitation; by parts without repeats."""
    excitation, repeat, part = _numbers(problem.records)
    size, freedom = len(solution.x), 0
    covariance = np.zeros((size, size))
    whole = np.linalg.pinv(solution.jacobian)
    for number in np.unique(excitation):
        mine = np.unique(repeat[excitation == number])
        if len(mine) > 1:
            moves = np.array([whole[:, repeat == k] @ solution.residual[repeat == k] for k in mine])
            covariance += jackknife(moves * len(mine) / (len(mine) - 1))
            freedom += len(mine) - 1
    if not freedom:
        moves = block_moves(solution.jacobian, solution.residual, part)
        covariance, freedom = jackknife(moves), len(moves) - 1
    return estimate(problem.fitted, solution.x, covariance, freedom, problem.drive(solution.x))


def _by_amplitude(problem: TimeProblem, solution: Solution) -> Array:
    """Amplitude, stiffness and damping of each amplitude by itself, shape (m, 3).

    To first order about the common optimum, friction and delay held.
    """
    excitation = _numbers(problem.records)[0]
    amplitudes = np.array([one.amplitude for one in problem.records])
    columns = [problem.fitted.index(name) for name in GAINS if name in problem.fitted]
    out = []
    for amplitude in dict.fromkeys(amplitudes.tolist()):
        mine = np.isin(excitation, np.flatnonzero(amplitudes == amplitude))
        x = solution.x.copy()
        x[columns] -= np.linalg.pinv(solution.jacobian[mine][:, columns]) @ solution.residual[mine]
        own = problem.drive(x)
        out.append((amplitude, *(own[name] for name in GAINS)))
    return np.array(out)


def _total(
    problem: TimeProblem, solution: Solution, found: Estimate, by_amplitude: Array
) -> dict[str, tuple[float, float]]:
    """Intervals that cover what the model does not explain.

    Repeats and parts of the excitations in quadrature. The gains of several amplitudes show that
    better than the parts, which then count with their deviation alone; no interval is narrower
    than the change between amplitudes.
    """
    part = _numbers(problem.records)[2]
    moves = block_moves(solution.jacobian, solution.residual, part)
    spread = np.sqrt(np.diag(jackknife(moves)))
    out = {}
    for name, at, sd in zip(problem.fitted, solution.x, spread, strict=True):
        kind, change = PARAMETERS[name], 0.0
        ends = [max(end, 1e-9) if kind.log else end for end in found.ci95[name]]
        if name in GAINS and len(by_amplitude) > 1:
            own = [kind.scaled(value) - at for value in by_amplitude[:, 1 + GAINS.index(name)]]
            change = float(np.abs(own).max())
        else:
            sd *= stats.t.ppf(0.975, len(moves) - 1)
        half = [max(np.hypot(kind.scaled(end) - at, sd), change) for end in ends]
        low, high = (
            kind.unscaled(at + sign * min(h, 20.0))
            for sign, h in zip((-1.0, 1.0), half, strict=True)
        )
        out[name] = (low, high)
    return out
