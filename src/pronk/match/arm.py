"""Arms whose joints moved together: the whole arm is simulated as recorded and fitted in time.

Responses of single joints would be mixed up with each other there, and dry friction under load,
which dominates the servos of small arms, has no frequency response. Residuals are simulated less
recorded positions over the samples that the drives could follow (`pronk.match.sample_mask`). One
joint's parameters move its own position far more than its neighbours', so the Jacobian is taken
block-diagonal: one simulation per parameter, in which that of every joint is changed at once.

What the recordings identify is fitted; what they do not is held at the published value, and a flag
names it. Blocks of the jackknife are pieces of 20 s.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pronk.errors import IdentifiabilityError, LogError, PronkError
from pronk.logs.joint_log import JointLog
from pronk.match import parameters as search
from pronk.match.gains import MatchedGains
from pronk.match.identifiability import EXPERIMENTS
from pronk.match.parameters import DRIVE_MODE, GAINS_MODE, PARAMETERS, checked_names
from pronk.match.problem import Solution, solve
from pronk.match.ranges import matched_gains
from pronk.match.result import JointFit, MatchResult
from pronk.match.sample_mask import trusted_samples
from pronk.match.uncertainty import Estimate, block_moves, estimate, jackknife
from pronk.response.estimate import estimate as estimate_response
from pronk.response.response import FrequencyResponse
from pronk.robots.robot import Robot
from pronk.simulators.chain import ChainSimulation, Drives, JointDrive, excited_joints
from pronk.simulators.mujoco import mujoco_info

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Progress = Callable[[str, float], None]

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
_STAGES = 3


@dataclass(frozen=True, kw_only=True)
class ArmJoint:
    """What was fitted for one joint of an arm."""

    estimate: Estimate
    rmse: float
    """Simulated less recorded position over the trusted samples [rad]."""
    published_rmse: float
    """The same with the robot's published parameters."""
    trusted_hz: float
    """Frequency up to which the recordings are used [Hz]; infinite if to their end."""
    trusted_share: float
    """Share of the samples that are used."""
    flags: tuple[str, ...] = ()

    @property
    def drive(self) -> JointDrive:
        """The fitted drive."""
        return JointDrive(**self.estimate.values)


@dataclass(frozen=True, kw_only=True)
class ArmFit:
    """A fitted arm."""

    joints: Mapping[str, ArmJoint]
    excluded: Mapping[str, str] = field(default_factory=dict)
    """Joints that moved and were not fitted, and why."""

    @property
    def drives(self) -> dict[str, JointDrive]:
        """Fitted drives by joint name."""
        return {name: joint.drive for name, joint in self.joints.items()}


class TimeProblem:
    """Residuals of the drives of one arm in time, as a `Problem`."""

    def __init__(
        self,
        arm: ChainSimulation,
        fitted: Mapping[str, tuple[str, ...]],
        start: Drives,
        progress: Callable[[int], None] | None = None,
    ) -> None:
        """Take in the recordings.

        Args:
            arm: The arm and its recordings.
            fitted: Names of the parameters to fit, by joint.
            start: Drives to begin with; the robot's published ones if not given.
            progress: Called with the number of simulations so far.
        """
        self.arm = arm
        self.fitted = fitted
        self.slots = [(joint, name) for joint in arm.joints for name in fitted[joint]]
        """Joint and name of every searched number."""
        self._start = {
            joint: start.get(joint) or JointDrive.published(arm.robot, joint)
            for joint in arm.joints
        }
        names = [name for _, name in self.slots]
        self.low, self.high = search.bounds(names)
        self.begin = search.begin(
            names,
            [getattr(self._start[joint], name) for joint, name in self.slots],
            [joint in start for joint, _ in self.slots],
        )
        self.measured = arm.measured()
        self.masks, self.limit_hz = trusted(arm)
        self._kinds = [name for name in PARAMETERS if name in names]
        self._evaluations = 0
        self._progress = progress
        self._last: tuple[Array, Array] | None = None

    @property
    def rows(self) -> int:
        """Samples of all recordings together."""
        return sum(len(part) for part in self.measured)

    def drives(self, x: Array) -> dict[str, JointDrive]:
        """Drives that some searched numbers stand for."""
        out = dict(self._start)
        for (joint, name), value in zip(self.slots, x, strict=True):
            out[joint] = replace(out[joint], **{name: PARAMETERS[name].unscaled(float(value))})
        return out

    def residual(self, x: Array) -> Array:
        """Simulated less measured [rad], 0 where not trusted, one joint after another."""
        if self._last is None or not np.array_equal(self._last[0], x):
            self._last = (x.copy(), self.differences([self.drives(x)])[0])
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
        before, after = self.residual(x), self.differences(sets)
        out = np.zeros((len(before), len(x)))
        for i, (joint, name) in enumerate(self.slots):
            block = self.block(joint)
            out[block, i] = (after[self._kinds.index(name)][block] - before[block]) / step[i]
        return out

    def block(self, joint: str) -> slice:
        """Rows of the residual that are a joint's."""
        first = self.arm.joints.index(joint) * self.rows
        return slice(first, first + self.rows)

    def differences(self, sets: Sequence[Drives]) -> list[Array]:
        """Residuals of several sets of drives."""
        out = []
        for simulated in self.arm.run(sets):
            parts = []
            for position, measured, mask in zip(simulated, self.measured, self.masks, strict=True):
                # What diverged is as wrong as a joint can be, not undefined.
                wrong = np.clip(np.nan_to_num(position - measured, nan=np.pi), -np.pi, np.pi)
                parts.append(np.where(mask, wrong, 0.0))
            out.append(np.asarray(np.concatenate(parts).T.ravel()))
        self._evaluations += len(sets)
        if self._progress is not None:
            self._progress(self._evaluations)
        return out


def trusted(arm: ChainSimulation) -> tuple[list[Mask], dict[str, float]]:
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


def fit_arm(
    logs: Sequence[JointLog],
    robot: Robot,
    *,
    parameters: Sequence[str] | Mapping[str, Sequence[str]] = DRIVE_MODE,
    start: Drives | None = None,
    strict: bool = True,
    threads: int = 2,
    progress: Progress | None = None,
) -> ArmFit:
    """Fit drive parameters of every joint that moves in some recordings.

    Args:
        logs: Recordings of one arm; several joints may move at once.
        robot: The robot.
        parameters: Names out of `PARAMETERS`, for all joints or by joint name.
        start: Drives to begin with, the robot's published ones if not given. What is not fitted
            keeps these values.
        strict: Refuse parameters that the recordings cannot tell apart. Otherwise
            `Estimate.unidentified` names them.
        threads: Threads of the simulator.
        progress: Called with the stage and the share of it that is done, 0 to 1.

    Raises:
        PronkError: A parameter is unknown or there is none.
        LogError: Nothing moves in radians, or the recordings are too short for intervals.
        IdentifiabilityError: `strict`, and a parameter is not identified; the message names it
            and what to record.
    """
    if not logs:
        raise LogError("no recordings; fit_arm needs at least one.")
    with ChainSimulation(robot, logs, threads=threads) as arm:
        by_joint = parameters if isinstance(parameters, Mapping) else {}
        fitted = {
            joint: checked_names(by_joint.get(joint, ()) if by_joint else parameters, PARAMETERS)  # type: ignore[arg-type]
            for joint in arm.joints
        }
        most = _ROUNDS * (1 + len({name for names in fitted.values() for name in names}))

        def simulated(evaluations: int) -> None:
            if progress is not None:
                progress("fit", min(evaluations / most, 0.99))

        problem = TimeProblem(arm, fitted, start or {}, simulated)
        blocks = _blocks(logs)
        if (count := len(np.unique(blocks))) < MIN_BLOCKS:
            raise LogError(
                f"the recordings make {count} blocks of {BLOCK_S:g} s; intervals need at least "
                f"{MIN_BLOCKS}."
            )
        solution = solve(problem, tolerance=_SETTLED, rounds=_ROUNDS)
        fit = ArmFit(joints=_joints(problem, solution, blocks), excluded=arm.excluded)
    if progress is not None:
        progress("fit", 1.0)
    if strict:
        _refuse(fit)
    return fit


def _joints(
    problem: TimeProblem, solution: Solution, blocks: NDArray[np.int64]
) -> dict[str, ArmJoint]:
    """Values, intervals and flags of every joint at the optimum."""
    arm = problem.arm
    published = {joint: JointDrive.published(arm.robot, joint) for joint in arm.joints}
    naive = problem.differences([published])[0]
    masks = np.concatenate(problem.masks).T
    drives = problem.drives(solution.x)
    out = {}
    for column, joint in enumerate(arm.joints):
        rows, mask = problem.block(joint), masks[column]
        error = solution.residual[rows][mask]
        mine = [i for i, (name, _) in enumerate(problem.slots) if name == joint]
        names = problem.fitted[joint]
        moves = block_moves(solution.jacobian[rows][:, mine][mask], error, blocks[mask])
        found = estimate(
            names, solution.x[mine], jackknife(moves), len(moves) - 1, vars(drives[joint])
        )
        excited = sum(len(p) for p in problem.measured if np.isfinite(p[0, column]))
        out[joint] = ArmJoint(
            estimate=found,
            rmse=float(np.sqrt(np.mean(error**2))),
            published_rmse=float(np.sqrt(np.mean(naive[rows][mask] ** 2))),
            trusted_hz=problem.limit_hz[joint],
            trusted_share=float(mask.sum() / excited),
            flags=tuple(
                f"{name} at the bound of the search, {found.values[name]:.3g} "
                f"{PARAMETERS[name].unit}"
                for name, i in zip(names, mine, strict=True)
                if solution.at_bound[i] and name != "delay"  # no delay is a possible result
            ),
        )
    return out


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


def _refuse(fit: ArmFit) -> None:
    """Raise if a parameter of any joint is not identified."""
    unknown = {name: joint.estimate.unidentified for name, joint in fit.joints.items()}
    if not any(unknown.values()):
        return
    words = "; ".join(f"{joint}: {', '.join(names)}" for joint, names in unknown.items() if names)
    wanted = {name for names in unknown.values() for name in names}
    cures = "; ".join(EXPERIMENTS[name] for name in PARAMETERS if name in wanted)
    raise IdentifiabilityError(
        f"these recordings do not identify {words}; fit fewer parameters, or record more: {cures}."
    )


def match_arm(
    logs: Sequence[JointLog],
    robot: Robot,
    *,
    mode: Literal["gains", "drive"] = "gains",
    threads: int = 2,
    progress: Progress | None = None,
) -> MatchResult:
    """Match all joints of an arm that moved together.

    Args:
        logs: Recordings of one arm.
        robot: The robot.
        mode: `gains` fits stiffness, damping, dry friction and delay with the armature known;
            `drive` fits damping, armature, dry friction and delay with the stiffness known.
        threads: Threads of the simulator.
        progress: Called with the stage and the share of it that is done, 0 to 1.

    Raises:
        PronkError: The mode is unknown.
        LogError: Nothing moves in radians, or the recordings are too short.
        IdentifiabilityError: A joint's damping is not identified even with all else held.
    """
    if mode not in ("gains", "drive"):
        raise PronkError(f"mode {mode!r}; expected gains or drive.")
    names = GAINS_MODE if mode == "gains" else DRIVE_MODE
    clock = time.perf_counter()
    fit, held = _fit_what_is_identified(logs, robot, names, threads, progress)
    joints = _joint_fits(logs, robot, fit, held, threads)
    gains = {name: joint.gains() for name, joint in joints.items()}
    return MatchResult(
        gains=matched_gains(robot, gains, logs, mujoco_info(robot)),
        joints={name: joint for name, joint in joints.items() if joint.responses},
        seconds={"fit of the whole arm": time.perf_counter() - clock},
        excluded=fit.excluded,
    )


def drives_of(robot: Robot, gains: MatchedGains) -> dict[str, JointDrive]:
    """Drives of the matched joints, from the artefact."""
    out = {}
    for name, joint in gains.joints.items():
        known = robot.joint(name).drive
        dry = known.frictionloss if np.isnan(joint.frictionloss) else joint.frictionloss
        out[name] = JointDrive(
            stiffness=joint.stiffness,
            damping=joint.damping,
            armature=joint.armature,
            frictionloss=dry,
            delay=joint.delay_s,
        )
    return out


def _fit_what_is_identified(
    logs: Sequence[JointLog],
    robot: Robot,
    names: tuple[str, ...],
    threads: int,
    progress: Progress | None,
) -> tuple[ArmFit, dict[str, tuple[str, ...]]]:
    """Fit, hold one parameter of each joint that is not identified, and fit again."""
    wanted: Sequence[str] | Mapping[str, Sequence[str]] = names
    held: dict[str, tuple[str, ...]] = {}
    start: Drives = {}
    for stage in range(_STAGES):
        fit = fit_arm(
            logs,
            robot,
            parameters=wanted,
            start=start,
            strict=stage == _STAGES - 1,
            threads=threads,
            progress=progress,
        )
        unknown = {name: joint.estimate.unidentified for name, joint in fit.joints.items()}
        if not any(unknown.values()):
            break
        start = fit.drives
        for name, few in unknown.items():
            if few:
                worst = min(few, key=_HOLD_FIRST.index)
                held[name] = (*held.get(name, ()), worst)
                value = getattr(JointDrive.published(robot, name), worst)
                start = {**start, name: replace(start[name], **{worst: value})}
        wanted = {name: [p for p in names if p not in held.get(name, ())] for name in fit.joints}
    return fit, held


def _joint_fits(
    logs: Sequence[JointLog],
    robot: Robot,
    fit: ArmFit,
    held: Mapping[str, tuple[str, ...]],
    threads: int,
) -> dict[str, JointFit]:
    """Every joint with the response of the recording that shows most of its band."""
    with ChainSimulation(robot, logs, threads=threads) as arm:
        matched, naive = arm.run([fit.drives, {}])
        names = arm.joints
    out = {}
    for i, name in enumerate(names):
        joint, drive = fit.joints[name], fit.joints[name].drive
        low, high = robot.joint(name).band_hz
        band = (low, min(high, joint.trusted_hz))
        best: tuple[int, Mask, FrequencyResponse] | None = None
        for k, log in enumerate(logs):
            try:
                measured = estimate_response(log, name)[0]
            except LogError:
                continue  # not excited, or stuck, in this recording
            inside = measured.band(*band, COHERENCE_MIN)
            if best is None or inside.sum() > best[1].sum():
                best = (k, inside, measured)
        nan = float("nan")
        one = JointFit(
            joint=name,
            responses=(),
            stiffness=drive.stiffness,
            damping=drive.damping,
            armature=drive.armature,
            frictionloss=drive.frictionloss,
            delay_s=drive.delay,
            ci95=joint.estimate.ci95,
            covariance=joint.estimate.covariance,
            held=held.get(name, ()),
            band_hz=(nan, nan),
            error_db=nan,
            naive_error_db=nan,
            matched=np.empty(0, dtype=np.complex128),
            naive=np.empty(0, dtype=np.complex128),
            rmse=joint.rmse,
            published_rmse=joint.published_rmse,
            flags=_flags(joint, held.get(name, ())),
        )
        if best is not None and best[1].any():
            k, inside, measured = best
            found = [_response(logs[k], name, traces[k][:, i]) for traces in (matched, naive)]
            one = replace(
                one,
                responses=(measured,),
                band_hz=band,
                coherence_min=float(measured.coherence[inside].min()),
                matched=found[0].response,
                naive=found[1].response,
                error_db=_error_db(found[0], measured, inside),
                naive_error_db=_error_db(found[1], measured, inside),
            )
        out[name] = one
    return out


def _flags(joint: ArmJoint, held: tuple[str, ...]) -> tuple[str, ...]:
    flags = [
        f"{name} held at {joint.estimate.values[name]:.4g}: these recordings do not identify it; "
        f"{EXPERIMENTS[name]}"
        for name in held
    ]
    if np.isfinite(joint.trusted_hz):
        flags.append(
            f"used up to {joint.trusted_hz:.2g} Hz, where the coherence falls "
            f"({100 * joint.trusted_share:.0f} % of the samples)"
        )
    return (*flags, *joint.flags)


def _response(log: JointLog, joint: str, position: Array) -> FrequencyResponse:
    """Response of a simulated position, through the same estimator as the recording's."""
    positions = log.position.copy()
    positions[:, log.column(joint)] = position
    return estimate_response(replace(log, position=positions), joint)[0]


def _error_db(found: FrequencyResponse, measured: FrequencyResponse, inside: Mask) -> float:
    """Root mean square gain error [dB]."""
    ratio = found.gain[inside] / measured.gain[inside]
    return float(np.sqrt(np.mean((20.0 * np.log10(ratio)) ** 2)))
