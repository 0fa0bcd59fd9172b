"""Mode `drive` for swept joints: the stiffness is known, what else the joint is made of is asked.

Gain and phase of every amplitude are fitted together: the phase holds the delay, and dry friction
shows in how the answer changes with the amplitude. Before any fit the Fisher information of these
very sweeps is asked whether they can tell the parameters apart (reading A10); pronk refuses what
they cannot, and names the experiment that would.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import least_squares

from pronk.errors import IdentifiabilityError, PronkError
from pronk.logs.joint_log import SweepLog
from pronk.match.gains import JointGains
from pronk.match.identifiability import EXPERIMENTS, bench_experiment, require_identifiable
from pronk.match.measured_joint import (
    DB,
    MeasuredJoint,
    gains_on_drive,
    logs_by_joint,
    measured_joints,
    merged,
)
from pronk.match.parameters import DRIVE_MODE, KINDS, gains_covariance
from pronk.match.ranges import matched_gains
from pronk.match.refine import residual_db
from pronk.match.result import JointMatch, MatchResult
from pronk.match.settings import MatchSettings
from pronk.robots.robot import Robot
from pronk.simulators.simulator import JointRig, joint_rigs

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Progress = Callable[[str, float], None]

FREE = ("stiffness", "damping", "armature", "frictionloss", "delay")
"""What `match_drives` can be asked for."""
_NOISE_MIN = 0.01
"""Least standard deviation of the log response to plan with: no model is better than 1 %."""


@dataclass(frozen=True, kw_only=True)
class DriveFit:
    """One joint's drive."""

    values: Mapping[str, float]
    """Every one of `FREE`, fitted or known."""
    fitted: tuple[str, ...]
    covariance: Array
    """Of the fitted ones in the units of `KINDS`, shape (p, p); NaN without repeats."""
    ci95: Mapping[str, tuple[float, float]]
    matched: ComplexArray
    """Response at the largest amplitude, shape (f,)."""
    naive: ComplexArray
    flags: tuple[str, ...] = ()


def _drive_responses(
    rig: JointRig, goal: MeasuredJoint, drives: Sequence[Mapping[str, float]]
) -> ComplexArray:
    """Full responses of a joint with several drives, the delay included, shape (drives, f)."""
    values = {name: np.array([drive[name] for drive in drives]) for name in FREE}
    command = goal.trace.mirrored(rig.robot)[2]
    late = values.pop("delay")
    ((_, position),) = rig.run([command], [rig.pose(goal.trace)], **values)
    return np.asarray(
        goal.full_response(position) * np.exp(-1j * late[:, None] * goal.measured.omega)
    )


def match_drives(
    logs: Sequence[SweepLog],
    robot: Robot,
    *,
    free: Sequence[str] = DRIVE_MODE,
    settings: MatchSettings | None = None,
    progress: Progress | None = None,
) -> MatchResult:
    """Fit the drives of every joint that was asked in some sweeps.

    Args:
        logs: Sweeps of one robot, one joint at a time.
        robot: The robot.
        free: What to look for, out of `FREE`; the rest is taken for known.
        settings: Estimator, coherence limit, threads.
        progress: Told the stage and the share of it that is done, 0 to 1.

    Raises:
        PronkError: A parameter is unknown, or none is asked.
        LogError: No joint of the robot was asked, or a log cannot be used.
        IdentifiabilityError: The sweeps cannot tell apart what was asked.
    """
    if not free or (unknown := [name for name in free if name not in FREE]):
        raise PronkError(
            f"free parameters {', '.join(unknown) if free else 'none'}; expected some of "
            f"{', '.join(FREE)}."
        )
    chosen = settings or MatchSettings()
    told = progress or (lambda _stage, _share: None)
    with joint_rigs(chosen.simulator, robot) as rigs:
        robot, info = rigs.robot, rigs.info
    where = logs_by_joint(logs, robot)
    asked = {
        name: merged([measured_joints(log, name, robot, chosen) for log in sources])
        for name, sources in where.items()
    }
    names = tuple(name for name in FREE if name in free)
    for name, goals in asked.items():
        _require(robot, name, goals, names)
    joints: dict[str, JointMatch] = {}
    gains: dict[str, JointGains] = {}
    for k, (name, goals) in enumerate(asked.items()):
        told("fit", k / len(asked))
        on_drive = gains_on_drive(where[name][0], name, robot)
        fit = fit_drive(robot, goals, on_drive, names, chosen)
        joints[name], gains[name] = _artefacts(robot, goals[0], goals, fit)
    told("fit", 1.0)
    return MatchResult(
        gains=matched_gains(robot, gains, logs, info),
        joints=joints,
    )


def _require(
    robot: Robot, joint: str, goals: Sequence[MeasuredJoint], free: tuple[str, ...]
) -> None:
    """Refuse what these sweeps cannot tell apart, before anything is fitted."""
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
    robot: Robot,
    goals: Sequence[MeasuredJoint],
    on_drive: tuple[float, float],
    free: tuple[str, ...],
    settings: MatchSettings,
) -> DriveFit:
    """Fit one joint's drive to its responses at all amplitudes.

    Args:
        robot: The robot.
        goals: The joint's targets, largest amplitude first.
        on_drive: Stiffness and damping on the real drive.
        free: What to look for.
        settings: Threads.

    Raises:
        IdentifiabilityError: A fitted parameter turns out to be unknown.
    """
    joint = robot.joint(goals[0].joint)
    known = {
        "stiffness": on_drive[0],
        "damping": on_drive[1],
        "armature": joint.drive.armature,
        "frictionloss": joint.drive.frictionloss,
        "delay": 0.0,
    }
    kinds = [KINDS[name] for name in free]
    steps = np.array([kind.step for kind in kinds])

    def drive(x: Array) -> dict[str, float]:
        found = {
            name: kind.unscaled(float(v)) for name, kind, v in zip(free, kinds, x, strict=True)
        }
        return {**known, **found}

    with joint_rigs(settings.simulator, robot, threads=settings.threads) as rigs:
        rig = rigs.rig(joint.name)

        def rows(x: Array) -> tuple[Array, Array]:
            """Weighted residuals and their Jacobian by forward differences."""
            points = [x, *(x + np.diag(steps))]
            parts = []
            for goal in goals:
                answers = _drive_responses(rig, goal, [drive(point) for point in points])[
                    :, goal.fit_mask
                ]
                measured = goal.measured.response[goal.fit_mask]
                parts.append(residual_db(goal, answers, measured, True) * _weight(goal))
            every = np.concatenate(parts, axis=1)
            return every[0], ((every[1:] - every[0]) / steps[:, None]).T

        cache: dict[bytes, tuple[Array, Array]] = {}

        def at(x: Array) -> tuple[Array, Array]:
            key = x.tobytes()
            if key not in cache:
                cache[key] = rows(x)
            return cache[key]

        def residual(x: Array) -> Array:
            return at(x)[0]

        def jacobian(x: Array) -> Array:
            return at(x)[1]

        low = np.array([kind.scaled(kind.low) for kind in kinds])
        high = np.array([kind.scaled(kind.high) for kind in kinds])
        start = np.array(
            [
                kind.scaled(max(known[name], kind.start))
                for name, kind in zip(free, kinds, strict=True)
            ]
        )
        found = least_squares(
            residual,
            np.clip(start, low + 1e-6, high - 1e-6),
            jac=jacobian,
            bounds=(low, high),
            x_scale=steps,
            xtol=1e-5,
            ftol=1e-8,
        )
        best = drive(found.x)
        matched, naive = _drive_responses(rig, goals[0], [best, known])
    scale = np.array([kind.slope(float(v)) for kind, v in zip(kinds, found.x, strict=True)])
    covariance, freedom = _covariance(goals, np.asarray(found.jac))
    deviation = np.sqrt(np.diag(covariance))
    flags = []
    if freedom == 0:
        flags.append("one repeat: no interval; record three or more")
    for name, kind, sd in zip(free, kinds, deviation, strict=True):
        # A logarithm's deviation is relative, as is the limit of such a kind.
        if freedom and not sd <= kind.sd_max:
            raise IdentifiabilityError(
                f"{joint.name}: these sweeps do not tell the {name} (deviation {sd:.2g}); "
                f"{EXPERIMENTS[name]}; or hold it at a known value."
            )
    if not found.success:
        flags.append("the fit did not settle")
    quantile = float(stats.t.ppf(0.975, freedom)) if freedom else float("nan")
    return DriveFit(
        values=best,
        fitted=free,
        covariance=covariance * np.outer(scale, scale),
        ci95={
            name: (kind.unscaled(v - quantile * sd), kind.unscaled(v + quantile * sd))
            for name, kind, v, sd in zip(free, kinds, found.x, deviation, strict=True)
        }
        if freedom
        else {},
        matched=matched,
        naive=naive,
        flags=tuple(flags),
    )


def _weight(goal: MeasuredJoint) -> Array:
    """Weight of gain and of phase at each frequency [1/dB], shape (2 inside,)."""
    return np.tile(1.0 / goal.deviation_db(), 2)


def _covariance(goals: Sequence[MeasuredJoint], jacobian: Array) -> tuple[Array, int]:
    """Covariance of the searched numbers from the scatter over repeats, and its freedom.

    Every repeat of every amplitude moves the optimum by `(J^T J)^-1 J^T` times what it differs
    from their mean; repeats are independent whatever the colour of their noise.
    """
    influence = np.linalg.pinv(jacobian)
    covariance = np.zeros((len(influence), len(influence)))
    freedom = 0
    begin = 0
    for goal in goals:
        count, width = len(goal.measured.repeats), 2 * int(goal.fit_mask.sum())
        part = influence[:, begin : begin + width]
        begin += width
        if count < 2:
            continue
        mean = goal.measured.response[goal.fit_mask]
        change = residual_db(goal, goal.measured.repeats[:, goal.fit_mask], mean, True)
        moved = (change * _weight(goal)) @ part.T
        covariance += np.atleast_2d(np.cov(moved.T, ddof=1)) / count
        freedom += count - 1
    return covariance, freedom


def _artefacts(
    robot: Robot, goal: MeasuredJoint, goals: Sequence[MeasuredJoint], fit: DriveFit
) -> tuple[JointMatch, JointGains]:
    """One joint's fit as the artefacts have it; there is no grid."""
    joint, values = robot.joint(goal.joint), fit.values
    covariance = gains_covariance(fit.fitted, fit.covariance)
    errors = [
        float(np.sqrt(np.mean(goal.error_db(answer[goal.fit_mask]) ** 2)))
        for answer in (fit.matched, fit.naive)
    ]
    band = goal.measured.band(*joint.band_hz)
    gains = JointGains(
        stiffness=values["stiffness"],
        damping=values["damping"],
        grid_stiffness=float("nan"),
        grid_damping=float("nan"),
        stiffness_ci95=fit.ci95.get("stiffness", (values["stiffness"],) * 2),
        damping_ci95=fit.ci95.get("damping", (values["damping"],) * 2),
        covariance=covariance,
        band_hz=joint.band_hz,
        error_db=errors[0],
        naive_error_db=errors[1],
        coherence_min=float(goal.measured.coherence[band].min()),
        armature=values["armature"],
        frictionloss=values["frictionloss"],
        delay_s=values["delay"],
        flags=fit.flags,
    )
    match = JointMatch(
        joint=goal.joint,
        responses=tuple(one.measured for one in goals),
        grid_stiffness=np.empty(0),
        grid_damping=np.empty(0),
        grid_error=np.empty((0, 0)),
        stiffness=values["stiffness"],
        damping=values["damping"],
        covariance=np.array(covariance),
        band_hz=joint.band_hz,
        matched=fit.matched,
        naive=fit.naive,
        error_db=errors[0],
        naive_error_db=errors[1],
        flags=fit.flags,
    )
    return match, gains
