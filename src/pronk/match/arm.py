"""Arms whose joints moved together: the whole arm is simulated as recorded and fitted in time.

Responses of single joints would be mixed up with each other there, and dry friction under load,
which dominates the servos of small arms, has no frequency response. Residuals are simulated less
recorded positions over the samples that the drives could follow. One joint's parameters move its
own position far more than its neighbours', so the Jacobian is taken block-diagonal: one simulation
per parameter, in which that of every joint is changed at once.

What the recordings identify is fitted; what they do not is held at the published value, and a flag
names it. Blocks of the jackknife are pieces of 20 s.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pronk.errors import IdentifiabilityError, LogError
from pronk.logs.joint_log import JointLog
from pronk.match.fit import (
    PARAMETERS,
    Estimate,
    Solution,
    begin,
    block_moves,
    bounds,
    checked_names,
    estimate,
    jackknife,
    solve,
)
from pronk.match.identifiability import EXPERIMENTS
from pronk.match.measured_joint import DB, trusted_samples
from pronk.match.result import JointFit
from pronk.response.estimate import estimate as estimate_response
from pronk.response.response import FrequencyResponse
from pronk.robots.robot import RobotSpec
from pronk.simulators.chain import ChainSimulation, Drives, JointDrive, excited_joints

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

BLOCK_S = 20.0
"""Length of a block of the jackknife [s]: many times the joints' memory of half a second."""
MIN_BLOCKS = 3
COHERENCE_MIN = 0.8
"""Frequencies whose coherence is lower do not count towards an error in dB."""
_ROUNDS = 15
_SETTLED = 1e-3
"""Relative change of cost or parameters that ends the search: far below the intervals."""
_HOLD_FIRST = ("armature", "stiffness", "delay", "offset", "frictionloss", "damping")
"""Of several parameters that cannot be distinguished, the first of these is held."""


class TimeProblem:
    """Residuals of the drives of one arm in time, as a `Problem`."""

    def __init__(
        self,
        arm: ChainSimulation,
        masks: Sequence[Mask],
        fitted: Mapping[str, tuple[str, ...]],
        start: Drives,
        progress: Callable[[int], None],
    ) -> None:
        """Take in the recordings.

        Args:
            arm: The arm and its recordings.
            masks: Samples to use, shape (n, joints) a recording.
            fitted: Names of the parameters to fit, by joint.
            start: Drives to begin with; the robot's published ones if not given.
            progress: Called with the number of simulations so far.
        """
        self.arm, self.fitted = arm, fitted
        self.slots = [(joint, name) for joint in arm.joints for name in fitted[joint]]
        """Joint and name of every searched number."""
        published = {joint: JointDrive.published(arm.robot, joint) for joint in arm.joints}
        self._start = published | dict(start)
        names = [name for _, name in self.slots]
        self.low, self.high = bounds(names)
        self.begin = begin(
            names,
            [getattr(self._start[joint], name) for joint, name in self.slots],
            [joint in start for joint, _ in self.slots],
        )
        self.measured = arm.measured()
        self._masks = masks
        self._kinds = [name for name in PARAMETERS if name in names]
        self._evaluations, self._progress = 0, progress
        self._last: tuple[Array, Array] | None = None

    def drives(self, x: Array) -> dict[str, JointDrive]:
        """Drives that some searched numbers stand for."""
        out = dict(self._start)
        for (joint, name), value in zip(self.slots, x, strict=True):
            out[joint] = replace(out[joint], **{name: PARAMETERS[name].unscaled(float(value))})
        return out

    def residual(self, x: Array) -> Array:
        """Simulated less measured [rad], 0 where not trusted, one joint after another."""
        if self._last is None or not np.array_equal(self._last[0], x):
            self._last = (x.copy(), self._simulated([self.drives(x)])[0])
        return self._last[1]

    def jacobian(self, x: Array) -> Array:
        """Derivative of `residual`, block-diagonal, shape (joints * rows, p)."""
        step = np.array([PARAMETERS[name].step for _, name in self.slots])
        step = np.where(x + step <= self.high, step, -step)
        moved = np.clip(x + step, self.low, self.high)
        step = moved - x
        sets = []
        for kind in self._kinds:
            mine = np.array([name == kind for _, name in self.slots])
            sets.append(self.drives(np.where(mine, moved, x)))
        before, after = self.residual(x), self._simulated(sets)
        out = np.zeros((len(before), len(x)))
        for i, (joint, name) in enumerate(self.slots):
            block = self.block(joint)
            out[block, i] = (after[self._kinds.index(name)][block] - before[block]) / step[i]
        return out

    def block(self, joint: str) -> slice:
        """Rows of the residual that are a joint's."""
        rows = sum(len(part) for part in self.measured)
        first = self.arm.joints.index(joint) * rows
        return slice(first, first + rows)

    def residuals(self, positions: Sequence[Array]) -> Array:
        """Residuals of simulated positions, one array a recording."""
        parts = []
        for position, measured, mask in zip(positions, self.measured, self._masks, strict=True):
            # What diverged is as wrong as a joint can be, not undefined.
            wrong = np.clip(np.nan_to_num(position - measured, nan=np.pi), -np.pi, np.pi)
            parts.append(np.where(mask, wrong, 0.0))
        return np.asarray(np.concatenate(parts).T.ravel())

    def _simulated(self, sets: Sequence[Drives]) -> list[Array]:
        out = [self.residuals(positions) for positions in self.arm.run(sets)]
        self._evaluations += len(sets)
        self._progress(self._evaluations)
        return out


def fit_whole_arm(
    logs: Sequence[JointLog],
    robot: RobotSpec,
    names: Sequence[str],
    *,
    most_held: int = 2,
    threads: int = 2,
    progress: Callable[[float], None] | None = None,
) -> tuple[dict[str, JointFit], dict[str, str]]:
    """Fit drive parameters of every joint that moves in some recordings.

    Args:
        logs: Recordings of one arm; several joints may move at once.
        robot: The robot.
        names: Parameters to fit, out of `PARAMETERS`.
        most_held: How many parameters of a joint may be held at the published value, one after
            the other, because the recordings do not identify them.
        threads: Threads of the simulator.
        progress: Called with the share that is done, 0 to 1.

    Returns:
        Fits by joint, and joints that moved but were not fitted with the reason.

    Raises:
        PronkError: A parameter is unknown or there is none.
        LogError: Nothing moves in radians, or the recordings are too short for intervals.
        IdentifiabilityError: A parameter is still not identified; the message names it and what to
            record.
    """
    if not logs:
        raise LogError("no recordings; the fit of an arm needs at least one.")
    names = checked_names(names, tuple(PARAMETERS))
    most = _ROUNDS * (1 + len(names))

    def report(evaluations: int) -> None:
        if progress is not None:
            progress(min(evaluations / most, 0.99))

    with ChainSimulation(robot, logs, threads=threads) as arm:
        masks, limit_hz = _trusted(arm)
        blocks = _blocks(logs)
        if (count := len(np.unique(blocks))) < MIN_BLOCKS:
            raise LogError(
                f"the recordings make {count} blocks of {BLOCK_S:g} s; intervals need at least "
                f"{MIN_BLOCKS}."
            )
        held: dict[str, tuple[str, ...]] = dict.fromkeys(arm.joints, ())
        start: dict[str, JointDrive] = {}
        while True:
            fitted = {j: tuple(n for n in names if n not in held[j]) for j in arm.joints}
            problem = TimeProblem(arm, masks, fitted, start, report)
            solution = solve(problem, tolerance=_SETTLED, rounds=_ROUNDS)
            estimates = _estimates(problem, solution, np.concatenate(masks).T, blocks)
            unknown = {j: e.unidentified for j, e in estimates.items() if e.unidentified}
            if not unknown:
                break
            start = problem.drives(solution.x)
            for joint, few in unknown.items():
                if len(held[joint]) == most_held or len(fitted[joint]) == 1:
                    _refuse(unknown)
                worst = min(few, key=_HOLD_FIRST.index)
                held[joint] = (*held[joint], worst)
                value = getattr(JointDrive.published(robot, joint), worst)
                start[joint] = replace(start[joint], **{worst: value})
        fits = _joint_fits(problem, solution, estimates, held, masks, limit_hz)
        return fits, arm.excluded


def _trusted(arm: ChainSimulation) -> tuple[list[Mask], dict[str, float]]:
    """Samples to use, shape (n, joints) a recording, and each joint's trusted frequency [Hz].

    The frequency is infinite where no recording ran out of coherence.
    """
    masks, limit = [], dict.fromkeys(arm.joints, float("inf"))
    for log in arm.logs:
        excited, _ = excited_joints(log, arm.robot)
        mask = np.zeros((len(log.time), len(arm.joints)), dtype=bool)
        for i, joint in enumerate(arm.joints):
            if joint in excited:
                mask[:, i], highest = trusted_samples(log, joint)
                if not mask[:, i].all():
                    limit[joint] = min(limit[joint], highest)
        masks.append(mask)
    return masks, limit


def _blocks(logs: Sequence[JointLog]) -> NDArray[np.int64]:
    """Number of the block of every sample of all recordings, shape (rows,)."""
    out, first = [], 0
    for log in logs:
        span = log.time[-1] - log.time[0]
        count = max(round(span / BLOCK_S), 1)
        share = ((log.time - log.time[0]) / span * count).astype(np.int64)
        out.append(first + np.minimum(share, count - 1))
        first += count
    return np.concatenate(out)


def _estimates(
    problem: TimeProblem, solution: Solution, masks: Mask, blocks: NDArray[np.int64]
) -> dict[str, Estimate]:
    """Values and intervals of every joint; those at a bound are flagged."""
    out = {}
    for (joint, names), mask in zip(problem.fitted.items(), masks, strict=True):
        rows = problem.block(joint)
        mine = [i for i, (name, _) in enumerate(problem.slots) if name == joint]
        jacobian = solution.jacobian[rows][:, mine][mask]
        moves = block_moves(jacobian, solution.residual[rows][mask], blocks[mask])
        drive = vars(problem.drives(solution.x)[joint])
        found = estimate(names, solution.x[mine], jackknife(moves), len(moves) - 1, drive)
        flags = tuple(
            f"{name} at the bound of the search, {found.values[name]:.3g} {PARAMETERS[name].unit}"
            for name, i in zip(names, mine, strict=True)
            if solution.at_bound[i] and name != "delay"  # no delay is a possible result
        )
        out[joint] = replace(found, flags=flags)
    return out


def _refuse(unknown: Mapping[str, tuple[str, ...]]) -> None:
    """Raise for parameters that are not identified."""
    words = "; ".join(f"{joint}: {', '.join(names)}" for joint, names in unknown.items())
    wanted = {name for names in unknown.values() for name in names}
    cures = "; ".join(EXPERIMENTS[name] for name in PARAMETERS if name in wanted)
    raise IdentifiabilityError(
        f"these recordings do not identify {words}; fit fewer parameters, or record more: {cures}."
    )


def _joint_fits(
    problem: TimeProblem,
    solution: Solution,
    estimates: Mapping[str, Estimate],
    held: Mapping[str, tuple[str, ...]],
    masks: Sequence[Mask],
    limit_hz: Mapping[str, float],
) -> dict[str, JointFit]:
    """Every joint with the response of the recording that shows most of its band."""
    arm, out = problem.arm, {}
    matched, naive = arm.run([problem.drives(solution.x), {}])
    naive_residual = problem.residuals(naive)
    for i, (name, found) in enumerate(estimates.items()):
        low, high = arm.robot.joint(name).band_hz
        band = (low, min(high, limit_hz[name]))
        best: tuple[int, Mask, FrequencyResponse] | None = None
        for k, log in enumerate(arm.logs):
            try:
                measured = estimate_response(log, name)[0]
            except LogError:
                continue  # not excited, or stuck, in this recording
            inside = measured.band(*band, COHERENCE_MIN)
            if best is None or inside.sum() > best[1].sum():
                best = (k, inside, measured)
        rows = problem.block(name)
        mask = np.concatenate(masks)[:, i]
        share = mask.sum() / sum(len(p) for p in problem.measured if np.isfinite(p[0, i]))
        flags = [
            f"{one} held at {found.values[one]:.4g}: these recordings do not identify it; "
            f"{EXPERIMENTS[one]}"
            for one in held[name]
        ]
        if np.isfinite(limit_hz[name]):
            flags.append(
                f"used up to {limit_hz[name]:.2g} Hz, where the coherence falls "
                f"({100 * share:.0f} % of the samples)"
            )
        fit = JointFit(
            joint=name,
            stiffness=found.values["stiffness"],
            damping=found.values["damping"],
            armature=found.values["armature"],
            frictionloss=found.values["frictionloss"],
            delay_s=found.values["delay"],
            ci95=found.ci95,
            covariance=found.covariance,
            held=held[name],
            rmse=_rms(solution.residual[rows][mask]),
            published_rmse=_rms(naive_residual[rows][mask]),
            flags=(*flags, *found.flags),
        )
        if best is not None and best[1].any():
            k, inside, measured = best
            one, other = (_response(arm.logs[k], name, p[k][:, i]) for p in (matched, naive))
            fit = replace(
                fit,
                responses=(measured,),
                band_hz=band,
                coherence_min=float(measured.coherence[inside].min()),
                matched=one.response,
                naive=other.response,
                error_db=_rms(DB * np.log(one.gain[inside] / measured.gain[inside])),
                naive_error_db=_rms(DB * np.log(other.gain[inside] / measured.gain[inside])),
            )
        out[name] = fit
    return out


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _response(log: JointLog, joint: str, position: Array) -> FrequencyResponse:
    """Response of a simulated position, through the same estimator as the recording's."""
    positions = log.position.copy()
    positions[:, log.column(joint)] = position
    return estimate_response(replace(log, position=positions), joint)[0]
