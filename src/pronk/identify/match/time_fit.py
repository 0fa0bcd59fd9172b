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

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.interpolate import CubicSpline

from pronk.arrays import Array, Mask
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match.fit import CachedProblem, Solution, solve_together
from pronk.identify.match.measured import grouped
from pronk.identify.match.parameters import GAINS, PARAMETERS
from pronk.identify.match.uncertainty import Estimate, block_moves, estimate, jackknife
from pronk.identify.simulators.command_trace import CommandTrace, command_trace
from pronk.identify.simulators.simulator import JointRigs
from pronk.robots.robot import RobotSpec

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


@dataclass(frozen=True, kw_only=True, eq=False)
class Repeat:
    """One recording of a command to a joint."""

    trace: CommandTrace
    """The command, that of the first repeat."""
    excitation: int
    """Number of the command, from 0; repeats have the same."""
    time: Array
    """Timestamps after the first step of the command [s], shape (n,)."""
    position: Array
    """Measured, in the coordinate of the joint [rad], shape (n,)."""
    weight: Array
    """Of each residual [1/rad], shape (n,)."""

    def at(self, mask: Mask, delay: float) -> Array:
        """Instants of the simulation that some timestamps show with a delay [s]."""
        last = (len(self.trace.command) - 1) * self.trace.timestep
        return np.clip(self.time[mask] - delay, 0.0, last)

    def part(self) -> NDArray[np.int64]:
        """Number of the part of the excitation that each sample is in, shape (n,)."""
        return (_BLOCKS * np.arange(len(self.time)) // len(self.time)).astype(np.int64)


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
    at_bound: tuple[str, ...]
    """Fitted parameters that ended at a bound of the search."""
    problem: TimeProblem
    """What was fitted."""
    solution: Solution
    """Its optimum, with residuals and Jacobian."""


def recorded(logs: Sequence[JointLog], joint: str, robot: RobotSpec) -> list[Repeat]:
    """Every excitation of one joint in some logs, repeats together, largest amplitude first.

    LogError if the joint was not excited, or its unit is not radians.
    """
    parts = [part for log in logs for part in log.excitations(joint)]
    pairs = [(part, command_trace(part, robot)) for part in parts]
    groups = grouped(pairs, lambda one, other: one[1].same_as(other[1], robot))
    groups.sort(key=lambda group: -group[0][1].amplitude)
    found = []
    for number, group in enumerate(groups):
        for part, trace in group:
            every = max(1, int(part.rate_hz * trace.timestep / _OVERSAMPLED + 1e-6))
            during = (part.time >= trace.time[0]) & (part.time <= trace.time[-1])
            inside = np.flatnonzero(during)[::every]
            weight = np.full(len(inside), 1.0 / trace.amplitude)
            if part.frequency is not None:
                # Between excitations the joint is at rest, which holds nothing of its dynamics.
                hz = np.nan_to_num(part.frequency[inside], nan=np.inf)
                weight = weight / np.sqrt(np.maximum(hz, _LOWEST_HZ))
            found.append(
                Repeat(
                    trace=group[0][1],
                    excitation=number,
                    time=part.time[inside] - trace.start,
                    position=part.position[inside],
                    weight=weight,
                )
            )
    return found


class Simulations:
    """What was recorded of one joint, and its simulations so far."""

    def __init__(self, rigs: JointRigs, repeats: Sequence[Repeat]) -> None:
        self.repeats, self.joint = repeats, repeats[0].trace.joint
        self.traces = list({one.excitation: one.trace for one in repeats}.values())
        """Commands by the number of the excitation."""
        self._rigs = rigs
        self._names = [n for n in PARAMETERS if n in rigs.parameters - {"delay"}]
        self._known: dict[tuple[float, ...], list[CubicSpline]] = {}

    def tracks(self, drives: Sequence[Mapping[str, float]]) -> list[list[CubicSpline]]:
        """Position over time after the first step, of each drive and command, without delay [rad].

        A joint begins at rest and does not change with time, so a delay of its command is the same
        delay of its position, and needs no simulation of its own. Pi where it diverged.
        """
        keys = [tuple(drive[name] for name in self._names) for drive in drives]
        if new := [key for key in dict.fromkeys(keys) if key not in self._known]:
            rigs, traces = self._rigs, self.traces
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

    def rmse(self, drive: Mapping[str, float], masks: Sequence[Mask]) -> float:
        """Root mean square of simulated less measured position, each octave counting alike [rad].

        Over some samples of each repeat, the mean of which is left out.
        """
        squares, weights = 0.0, 0.0
        (tracks,) = self.tracks([drive])
        for one, mask in zip(self.repeats, masks, strict=True):
            if mask.any():
                simulated = tracks[one.excitation](one.at(mask, drive["delay"]))
                wrong, weight = simulated - one.position[mask], one.weight[mask] ** 2
                squares += float(weight @ (wrong - wrong.mean()) ** 2)
                weights += float(weight.sum())
        return float(np.sqrt(squares / weights))


class TimeProblem(CachedProblem):
    """Residuals of the drive of one joint in time: weighted, less the mean of each repeat."""

    def __init__(
        self,
        simulations: Simulations,
        fitted: Sequence[str],
        start: Mapping[str, float],
        masks: Sequence[Mask] = (),
    ) -> None:
        """Fit some parameters.

        `start` has all of them, `masks` the samples of each repeat, all if empty.
        """
        joint = simulations.joint
        super().__init__({joint: start}, {joint: fitted}, refitted=(joint,))
        self.simulations, self.repeats, self.fitted = simulations, simulations.repeats, fitted
        self._masks = masks or [np.ones(len(one.time), dtype=bool) for one in self.repeats]

    def drive(self, x: Array) -> dict[str, float]:
        """All parameters of the joint that some searched numbers stand for."""
        return self.values(x)[self.simulations.joint]

    def evaluate(self, x: Array) -> tuple[Array, Array]:
        """Residual and Jacobian, by forward differences but for the delay, whose is exact."""
        steps = np.array([PARAMETERS[name].step for name in self.fitted])
        steps = np.where(x + steps <= self.high, steps, -steps)
        moved = [i for i, name in enumerate(self.fitted) if name != "delay"]
        points = [x, *(x + np.where(np.arange(len(x)) == i, steps, 0.0) for i in moved)]
        tracks = self.simulations.tracks([self.drive(point) for point in points])
        delay, columns = self.drive(x)["delay"], []
        for one, mask in zip(self.repeats, self._masks, strict=True):
            if not mask.any():
                continue
            at, own = one.at(mask, delay), [track[one.excitation] for track in tracks]
            simulated = own[0](at)
            both = np.empty((1 + len(x), len(at)))
            both[0] = simulated - one.position[mask]
            for i, track in zip(moved, own[1:], strict=True):
                both[1 + i] = (track(at) - simulated) / steps[i]
            if "delay" in self.fitted:
                both[1 + self.fitted.index("delay")] = -own[0](at, 1)
            columns.append((both - both.mean(axis=1, keepdims=True)) * one.weight[mask])
        residual, *slopes = np.hstack(columns)
        return residual, np.array(slopes).T


def fit_joint(
    rigs: JointRigs,
    repeats: Sequence[Repeat],
    fitted: Sequence[str],
    start: Mapping[str, float],
    nominal: Mapping[str, float],
) -> TimeFit:
    """Fit some parameters of one joint's drive.

    `start` has all parameters, of those fitted where to begin; `nominal` is the drive as published,
    with the gains that were on it.
    """
    fitted = [n for n in fitted if n == "delay" or n in rigs.parameters]
    kept = _kept(repeats)
    simulations = Simulations(rigs, repeats)

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
    aside = [~mask for mask in kept]
    errors = {name: simulations.rmse(drive, aside) for name, drive in drives.items()}
    problem = TimeProblem(simulations, fitted, trained)
    solution = _solved(problem)
    found, by_amplitude = _estimate(problem, solution), _by_amplitude(problem, solution)
    return TimeFit(
        estimate=found,
        total95=_total(problem, solution, found, by_amplitude),
        amplitude_gains=by_amplitude,
        held_out=errors,
        at_bound=tuple(n for n, at in zip(fitted, solution.at_bound, strict=True) if at),
        problem=problem,
        solution=solution,
    )


def _solved(problem: TimeProblem) -> Solution:
    return solve_together([problem], tolerance=_SETTLED, longest=_LONGEST)[0]


def _kept(repeats: Sequence[Repeat]) -> list[Mask]:
    """Samples to fit: all but the last repeat, or but every fourth part without repeats."""
    count = Counter(one.excitation for one in repeats)
    last = {one.excitation: one for one in repeats}
    return [
        one.part() % 4 != 3
        if count[one.excitation] == 1
        else np.full(len(one.time), one is not last[one.excitation])
        for one in repeats
    ]


def _numbers(repeats: Sequence[Repeat]) -> tuple[NDArray[np.int64], ...]:
    """Excitation, repeat and part of each residual, counted through, shapes (m,)."""
    lengths = [len(one.time) for one in repeats]
    excitation = np.repeat([one.excitation for one in repeats], lengths)
    part = np.concatenate([one.part() for one in repeats])
    repeat = np.repeat(np.arange(len(repeats)), lengths)
    return excitation, repeat, excitation * _BLOCKS + part


def _estimate(problem: TimeProblem, solution: Solution) -> Estimate:
    """Parameters with intervals by the repeats of each excitation; by parts without repeats."""
    excitation, repeat, part = _numbers(problem.repeats)
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
    excitation = _numbers(problem.repeats)[0]
    amplitudes = np.array([trace.amplitude for trace in problem.simulations.traces])
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
    part = _numbers(problem.repeats)[2]
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
        low, high = (max(np.hypot(kind.scaled(end) - at, sd), change) for end in ends)
        # e^20 is as good as infinite and does not overflow.
        out[name] = kind.unscaled(at - min(low, 20.0)), kind.unscaled(at + min(high, 20.0))
    return out
