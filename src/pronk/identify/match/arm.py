"""Arms whose joints moved together: the whole arm is simulated as recorded and fitted in time.

Responses of single joints would be mixed up with each other there, and dry friction under load,
which dominates the servos of small arms, has no frequency response. Residuals are simulated less
recorded positions over the samples that the drives could follow. One joint's parameters move its
own position far more than its neighbours', so the Jacobian is taken block-diagonal: one simulation
per parameter, in which that of every joint is changed at once. The delay is one for the chain: its
commands go out together, and a joint without gravity cannot separate a delay from stiffer gains.

What the recordings identify is fitted; what they do not is held at the published value, and a flag
names it. Blocks of the jackknife are pieces of 2.5 to 20 s, an eighth of all recordings; every
fourth is kept aside first, where the fit is compared with less fitting. With a fixed base chains
(legs) do not affect each other, and are fitted one after the other.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from pronk.arrays import Array, Mask
from pronk.errors import IdentifiabilityError, LogError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match.compared import ComparedResponses, compare_recordings
from pronk.identify.match.fit import Problem, Solution, solve
from pronk.identify.match.measured import rms
from pronk.identify.match.nominal_gains import gains_on_drive
from pronk.identify.match.parameters import GAINS, PARAMETERS, checked_names
from pronk.identify.match.result import HELD_OUT, DriveFit, held_out_flags
from pronk.identify.match.uncertainty import Estimate, block_moves, estimate, jackknife, time_blocks
from pronk.identify.simulators.chain import (
    ChainSimulation,
    DriveValues,
    branches,
    has_stribeck,
    published,
)
from pronk.robots.robot import RobotSpec

BLOCKS_S = (2.5, 20.0)
"""Shortest and longest block of the jackknife [s]: five times the joints' memory of half a second,
and many times."""
_BLOCKS = 8
"""Blocks of recordings that are too short for three of the longest."""
MIN_BLOCKS = 3
ChainFits = dict[str, tuple[DriveFit, ComparedResponses | None]]
"""By joint: its drive, and its responses where a recording has one."""
_PLAIN = ("stiffness", "damping", "delay")
_ROUNDS = 15
_SETTLED = 1e-3
"""Relative change of cost or parameters that ends the search: far below the intervals."""
_HOLD_FIRST = ["stribeck", "armature", "stiffness", "delay", "offset", "frictionloss", "damping"]
"""Of several parameters that cannot be distinguished, the first of these is held."""
_COHERENT = 0.95
_SEGMENT_S = 5.0
_EXCITED = 1e-3
"""Power of the command, over its largest, from which on a frequency counts as excited."""
_WIDE = 8.0
"""A recording shows where coherence ends only if it was coherent over three octaves below: a sweep
does; a few lines or a motion that mostly sticks do not."""
_WINDOW_S = 2.0
_AT_LIMIT = 0.25
"""Share of its power that a sine at the limit keeps, filtered forwards and backwards."""


class ArmProblem(Problem):
    """Residuals of the drives of one arm in time, one joint after another."""

    def __init__(
        self,
        arm: ChainSimulation,
        used: Mask,
        fitted: Mapping[str, Sequence[str]],
        nominal: DriveValues,
        found: DriveValues,
        progress: Callable[[int], None],
    ) -> None:
        """Take the recordings and which of their samples to use, shape (rows, joints).

        `found` holds drives from an earlier fit, the `nominal` ones where a joint is missing;
        `progress` is called with the number of simulations done.
        """
        super().__init__({**nominal, **found}, fitted, shared=("delay",), refitted=found)
        self.arm, self.fitted, self.used, self.nominal = arm, fitted, used, nominal
        self.measured = np.concatenate(arm.measured())
        """Shape (rows, joints) [rad]; NaN where a recording does not excite a joint."""
        self._progress = progress
        self._last: tuple[Array, Array] | None = None

    def columns(self, joint: str) -> list[int]:
        """Places of a joint's fitted parameters among the searched numbers."""
        return [self.column[joint, name] for name in self.fitted[joint]]

    def residual(self, x: Array) -> Array:
        """Simulated less measured [rad], 0 where not trusted, shape (joints * rows,)."""
        if self._last is None or not np.array_equal(self._last[0], x):
            self._last = (x.copy(), self._simulated([self.values(x)])[0])
        return self._last[1]

    def jacobian(self, x: Array) -> Array:
        """Derivative of `residual`, shape (joints * rows, p); block-diagonal but for the delay."""
        step = np.array([PARAMETERS[name].step for _, name in self.slots])
        step = np.where(x + step <= self.high, step, -step)
        moved = np.clip(x + step, self.low, self.high)
        kinds = np.array([name for _, name in self.slots])
        sets = {kind: self.values(np.where(kinds == kind, moved, x)) for kind in np.unique(kinds)}
        before = self.residual(x)
        after = dict(zip(sets, self._simulated(list(sets.values())), strict=True))
        out = np.zeros((len(before), len(x)))
        for joint in self.fitted:
            block = self.block(joint)
            for i in self.columns(joint):
                out[block, i] = (after[kinds[i]][block] - before[block]) / (moved[i] - x[i])
        return out

    def block(self, joint: str) -> slice:
        """Rows of the residual that are a joint's."""
        rows, i = len(self.measured), self.arm.joints.index(joint)
        return slice(i * rows, (i + 1) * rows)

    def residuals(self, positions: Sequence[Array]) -> Array:
        """Residuals of simulated positions, one array a recording."""
        wrong = np.concatenate(positions) - self.measured
        # What diverged is as wrong as a joint can be, not undefined.
        wrong = np.clip(np.nan_to_num(wrong, nan=np.pi), -np.pi, np.pi)
        return np.asarray(np.where(self.used, wrong, 0.0).T.ravel())

    def _simulated(self, sets: Sequence[DriveValues]) -> list[Array]:
        out = [self.residuals(positions) for positions in self.arm.run(sets)]
        self._progress(len(sets))
        return out


def fit_together(
    logs: Sequence[JointLog],
    robot: RobotSpec,
    names: Sequence[str],
    *,
    most_held: int = 2,
    threads: int = 2,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[ChainFits, dict[str, str]]:
    """Fit drive parameters of every joint that moves in some recordings, chain by chain.

    The base is fixed; several joints may move at once. `stribeck` is fitted with `frictionloss`
    where the drive has a Stribeck speed. Up to `most_held` parameters of a joint are held at the
    published value, one after the other, because the recordings do not identify them. `progress`
    is called with the share that is done, 0 to 1. Also returns joints that moved but were not
    fitted, with the reason.

    PronkError for an unknown parameter or none; LogError if nothing moves in radians or the
    recordings are too short for intervals; IdentifiabilityError names a parameter that is still not
    identified, and what to record.
    """
    if not logs:
        raise LogError("no recordings; the fit of an arm needs at least one.")
    names = checked_names(names, [name for name in PARAMETERS if name != "stribeck"])
    fits: ChainFits = {}
    excluded: dict[str, str] = {}
    chains = branches(logs, robot)
    for k, joints in enumerate(chains):
        with ChainSimulation(robot, logs, joints=joints, threads=threads) as arm:

            def report(share: float, k: int = k) -> None:
                progress((k + share) / len(chains))

            fits |= _fit_chain(arm, names, most_held, report)
            excluded |= arm.excluded
    return fits, excluded


def _fit_chain(
    arm: ChainSimulation, names: Sequence[str], most_held: int, progress: Callable[[float], None]
) -> ChainFits:
    """Fit the joints of one chain: first without every fourth block, then to everything."""
    used, limit_hz = trusted(arm)
    times, (short, length) = [log.time for log in arm.logs], BLOCKS_S
    if (whole := sum(map(np.ptp, times))) < MIN_BLOCKS * length:
        length = max(short, whole / _BLOCKS)
    blocks = np.concatenate(time_blocks(times, length))
    if (count := len(np.unique(blocks))) < MIN_BLOCKS:
        raise LogError(
            f"the recordings make {count} blocks of {BLOCKS_S[0]:g} s or more; intervals need at "
            f"least {MIN_BLOCKS}."
        )
    nominal = {
        joint: published(arm.robot, joint)
        | dict(zip(GAINS, gains_on_drive(log, joint, arm.robot), strict=True))
        for log, excited in zip(arm.logs, arm.excited, strict=True)
        for joint in excited
    }
    most, counted = 2 * _ROUNDS * (1 + len(names)), [0]

    def count_runs(more: int) -> None:
        counted[0] += more
        progress(min(counted[0] / most, 0.99))

    aside = blocks % 4 == 3
    if not aside.any():
        aside = blocks == blocks.max()
    kept, left = used & ~aside[:, None], used & aside[:, None]

    def fit(
        names: Mapping[str, Sequence[str]], begin: DriveValues, used: Mask
    ) -> tuple[ArmProblem, Solution]:
        problem = ArmProblem(arm, used, names, nominal, begin, count_runs)
        return problem, solve(problem, tolerance=_SETTLED, rounds=_ROUNDS)

    falling = ("stribeck",) if "frictionloss" in names else ()
    free = {j: (*names, *(falling if has_stribeck(arm.robot, j) else ())) for j in arm.joints}
    held: dict[str, tuple[str, ...]] = dict.fromkeys(arm.joints, ())
    found: dict[str, dict[str, float]] = {}
    while True:
        fitted = {j: tuple(n for n in free[j] if n not in held[j]) for j in arm.joints}
        problem, solution = fit(fitted, found, used)
        estimates = _estimates(problem, solution, blocks)
        found = problem.values(solution.x)
        if not (lost := _lost(problem, estimates, held, most_held)):
            break
        for joint, name in lost:
            held[joint] = (*held[joint], name)
            found[joint][name] = nominal[joint][name]
    drives: list[DriveValues] = [nominal]
    for few in (("delay",), _PLAIN, tuple(PARAMETERS)):
        some = {j: [n for n in fitted[j] if n in few] for j in arm.joints}
        begin = {j: nominal[j] | {n: found[j][n] for n in some[j]} for j in arm.joints}
        if any(some.values()):
            trial, best = fit(some, begin, kept)
            begin = trial.values(best.x)
        drives.append(begin)
    judge = ArmProblem(arm, left, fitted, nominal, found, count_runs)
    errors = dict(zip(HELD_OUT, map(judge.residuals, arm.run(drives)), strict=True))
    held_out = {
        joint: {name: rms(error[judge.block(joint)][own]) for name, error in errors.items()}
        for joint, own in zip(arm.joints, left.T, strict=True)
        if own.any()
    }
    return _joint_fits(problem, solution, estimates, held, limit_hz, held_out)


def _lost(
    problem: ArmProblem,
    estimates: Mapping[str, Estimate],
    held: Mapping[str, Sequence[str]],
    most_held: int,
) -> list[tuple[str, str]]:
    """Joints and parameters to hold because the recordings do not identify them.

    IdentifiabilityError if more than `most_held` of a joint, or all, would be held.
    """
    unknown = {j: e.unidentified for j, e in estimates.items() if e.unidentified}
    lost_delay = most_held and any("delay" in lost for lost in unknown.values())
    # No simulator has a delay below zero.
    none_late = any(
        e.ci95["delay"][0] < e.values["delay"] < 0.0 < e.ci95["delay"][1]
        for e in estimates.values()
        if "delay" in e.ci95
    )
    late = [joint for joint, names in problem.fitted.items() if "delay" in names]
    if (lost_delay or none_late) and all(len(problem.fitted[joint]) > 1 for joint in late):
        return [(joint, "delay") for joint in late]
    if any(
        len({*held[joint]} - {"delay"}) >= most_held or len(problem.fitted[joint]) == 1
        for joint in unknown
    ):
        words = "; ".join(f"{joint}: {', '.join(names)}" for joint, names in unknown.items())
        wanted = {name for names in unknown.values() for name in names}
        remedies = "; ".join(PARAMETERS[name].remedy for name in PARAMETERS if name in wanted)
        raise IdentifiabilityError(
            f"these recordings do not identify {words}; fit fewer parameters, or record more: "
            f"{remedies}."
        )
    return [(joint, min(lost, key=_HOLD_FIRST.index)) for joint, lost in unknown.items()]


def trusted_frequency(time: Array, command: Array, position: Array) -> float:
    """Frequency at which the coherence of a sweep falls below 0.95 [Hz], from arrays of shape (n,).

    A servo has limits of its own (acceleration, speed, torque) that no gain describes. Beyond them
    the response is no longer a linear joint's, and the coherence of a sweep that runs into them
    falls. Infinity if it does not, or if the recording is too narrow to show it.
    """
    rate = (len(time) - 1) / (time[-1] - time[0])
    width = min(round(_SEGMENT_S * rate), len(time))
    hz, power = signal.welch(command, rate, nperseg=width)
    if power.max() == 0.0 or np.ptp(position) == 0.0:
        return float("inf")
    _, coherence = signal.coherence(command, position, rate, nperseg=width)
    excited = power > _EXCITED * power.max()
    excited[0] = False  # each segment's mean is removed, so 0 Hz is not excited
    good = excited & (coherence >= _COHERENT)
    first = int(np.argmax(good))
    fallen = np.flatnonzero(excited[first:] & ~good[first:])
    if not good.any() or len(fallen) == 0:
        return float("inf")
    last = hz[first + fallen[0] - 1]
    return float(hz[first + fallen[0]]) if last >= _WIDE * hz[first] else float("inf")


def trusted_samples(log: JointLog, joint: str) -> tuple[Mask, float]:
    """Samples that a fit may use, and the trusted frequency [Hz].

    The mask, shape (n,), is false where, over two seconds, the command is mostly above the trusted
    frequency.
    """
    column, rate = log.column(joint), log.rate_hz
    command = log.command[:, column]
    limit = trusted_frequency(log.time, command, log.position[:, column])
    if not limit < 0.45 * rate:
        return np.ones(len(log.time), dtype=bool), limit
    about = command - command.mean()
    high = signal.sosfiltfilt(signal.butter(4, limit, "highpass", fs=rate, output="sos"), about)
    window = np.ones(max(round(_WINDOW_S * rate), 1))
    share = signal.fftconvolve(high**2, window, "same")
    whole = signal.fftconvolve(about**2, window, "same")
    return np.asarray(share <= _AT_LIMIT * np.maximum(whole, 0.0)), limit


def trusted(arm: ChainSimulation) -> tuple[Mask, dict[str, float]]:
    """Samples to use, shape (rows, joints), and each joint's trusted frequency [Hz].

    The frequency is infinite where no recording ran out of coherence.
    """
    masks, limit = [], dict.fromkeys(arm.joints, float("inf"))
    for log, excited in zip(arm.logs, arm.excited, strict=True):
        mask = np.zeros((len(log.time), len(arm.joints)), dtype=bool)
        for joint in excited:
            own, highest = trusted_samples(log, joint)
            mask[:, arm.joints.index(joint)] = own
            if not own.all():
                limit[joint] = min(limit[joint], highest)
        masks.append(mask)
    return np.concatenate(masks), limit


def _estimates(
    problem: ArmProblem, solution: Solution, blocks: NDArray[np.int64]
) -> dict[str, Estimate]:
    """Values and intervals of every joint; those at a bound are flagged."""
    out, values = {}, problem.values(solution.x)
    used = problem.used.T.ravel()
    numbers = np.tile(blocks, len(problem.arm.joints))[used]
    moves = block_moves(solution.jacobian[used], solution.residual[used], numbers)
    covariance = jackknife(moves)
    for joint, names in problem.fitted.items():
        mine = problem.columns(joint)
        own = covariance[np.ix_(mine, mine)]
        found = estimate(names, solution.x[mine], own, len(moves) - 1, values[joint])
        flags = tuple(
            f"{name} at the bound of the search, {found.values[name]:.3g} {PARAMETERS[name].unit}"
            for name, i in zip(names, mine, strict=True)
            if solution.at_bound[i]
            # That motion takes away no friction is a possible result.
            and not (name == "stribeck" and found.values[name] < 0.5)
        )
        out[joint] = replace(found, flags=flags)
    return out


def _joint_fits(
    problem: ArmProblem,
    solution: Solution,
    estimates: Mapping[str, Estimate],
    held: Mapping[str, tuple[str, ...]],
    limit_hz: Mapping[str, float],
    held_out: Mapping[str, Mapping[str, float]],
) -> ChainFits:
    """Every joint with the response of the recording that shows most of its band."""
    arm, out = problem.arm, {}
    matched, naive = arm.run([problem.values(solution.x), problem.nominal])
    naive_residual = problem.residuals(naive)
    for i, (name, found) in enumerate(estimates.items()):
        rows, mask, aside = problem.block(name), problem.used[:, i], held_out.get(name, {})
        flags = [
            f"{one} held at {found.values[one]:.4g}: these recordings do not identify it; "
            f"{PARAMETERS[one].remedy}"
            for one in held[name]
        ]
        if found.values["delay"] < 0.0:
            flags.append(
                f"delay {1e3 * found.values['delay']:.1f} ms: the log has the command later than "
                "the drive had it; 0 in the gains, which hold for earlier commands"
            )
        if np.isfinite(limit_hz[name]):
            share = mask.sum() / np.isfinite(problem.measured[:, i]).sum()
            flags.append(
                f"used up to {limit_hz[name]:.2g} Hz, where the coherence falls "
                f"({100 * share:.0f} % of the samples)"
            )
        compared = compare_recordings(
            arm.robot,
            name,
            arm.logs,
            matched=[positions[:, i] for positions in matched],
            nominal=[positions[:, i] for positions in naive],
            highest_hz=limit_hz[name],
        )
        fit = DriveFit(
            joint=name,
            values=found.values,
            sd=found.sd,
            ci95=found.ci95,
            total95=found.ci95,
            covariance=found.covariance,
            held=held[name],
            held_out=aside,
            rmse=rms(solution.residual[rows][mask]),
            nominal_rmse=rms(naive_residual[rows][mask]),
            settled=solution.settled,
            flags=(*held_out_flags(aside), *flags, *found.flags),
        )
        out[name] = (fit, compared)
    return out
