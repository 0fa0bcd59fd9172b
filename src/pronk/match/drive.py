"""Identify damping, armature, friction and delay of swept joints at fixed stiffness.

Gain and phase of every amplitude are fitted together: the phase holds the delay, and dry friction
shows in how the response changes with the amplitude. Before any fit the Fisher information of the
sweeps decides whether they can tell the parameters apart (reading A10); if not, the error names
the experiment that would.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pronk.errors import IdentifiabilityError
from pronk.logs.joint_log import JointLog
from pronk.match.identifiability import EXPERIMENTS, bench_experiment, require_identifiable
from pronk.match.measured_joint import (
    DB,
    MeasuredJoint,
    gains_on_drive,
    logs_by_joint,
    measured_joints,
    merged,
)
from pronk.match.parameters import DRIVE_MODE, PARAMETERS, begin, bounds, checked_names
from pronk.match.problem import solve
from pronk.match.ranges import matched_gains
from pronk.match.refine import residual_db
from pronk.match.result import JointFit, MatchResult
from pronk.match.settings import MatchSettings
from pronk.match.uncertainty import estimate, jackknife
from pronk.robots.robot import Robot
from pronk.simulators.simulator import JointRig, joint_rigs

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Progress = Callable[[str, float], None]

FREE = ("stiffness", "damping", "armature", "frictionloss", "delay")
"""What `match_drives` can fit."""
_SETTLED = 1e-7
"""Relative change of cost or parameters that ends the search."""
_ROUNDS = 100
_NOISE_MIN = 0.01
"""Least standard deviation of the log response to plan with: no model is better than 1 %."""


def match_drives(
    logs: Sequence[JointLog],
    robot: Robot,
    *,
    free: Sequence[str] = DRIVE_MODE,
    settings: MatchSettings | None = None,
    progress: Progress | None = None,
) -> MatchResult:
    """Fit the drives of every joint that was excited in some sweeps.

    Args:
        logs: Sweeps of one robot, one joint at a time.
        robot: The robot.
        free: What to look for, out of `FREE`; the rest is taken for known.
        settings: Estimator, coherence limit, threads.
        progress: Called with the stage and the share of it that is done, 0 to 1.

    Raises:
        PronkError: A parameter is unknown, or there is none.
        LogError: No joint of the robot was excited, or a log cannot be used.
        IdentifiabilityError: The sweeps cannot tell the parameters apart.
    """
    names = checked_names(free, FREE)
    chosen = settings or MatchSettings()
    with joint_rigs(chosen.simulator, robot, threads=chosen.threads) as rigs:
        where = logs_by_joint(logs, rigs.robot)
        measured = {
            name: merged([measured_joints(log, name, rigs.robot, chosen) for log in sources])
            for name, sources in where.items()
        }
        for name, goals in measured.items():
            _require(rigs.robot, name, goals, names)
        joints = {}
        for k, (name, goals) in enumerate(measured.items()):
            if progress is not None:
                progress("fit", k / len(measured))
            on_drive = gains_on_drive(where[name][0], name, robot)
            joints[name] = fit_joint(rigs.rig(name), goals, on_drive, names)
        info = rigs.info
    if progress is not None:
        progress("fit", 1.0)
    gains = {name: joint.gains() for name, joint in joints.items()}
    return MatchResult(gains=matched_gains(robot, gains, logs, info), joints=joints)


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


class ResponseProblem:
    """Residuals of one joint's drive in frequency, all amplitudes together, as a `Problem`."""

    def __init__(
        self,
        rig: JointRig,
        goals: Sequence[MeasuredJoint],
        fitted: tuple[str, ...],
        known: Mapping[str, float],
    ) -> None:
        """Take in what was measured.

        Args:
            rig: The rig of the joint's original.
            goals: The joint at every amplitude, largest first.
            fitted: Names of the parameters to fit.
            known: Value of every one of `FREE`; of the fitted ones, where to begin.
        """
        self._rig, self._goals, self._fitted, self._known = rig, goals, fitted, known
        self.low, self.high = bounds(fitted)
        self.begin = begin(fitted, [known[name] for name in fitted], [False] * len(fitted))
        self._step = np.array([PARAMETERS[name].step for name in fitted])
        self._cache: dict[bytes, tuple[Array, Array]] = {}

    def values(self, x: Array) -> dict[str, float]:
        """Every parameter that some searched numbers stand for."""
        return {
            **self._known,
            **{n: PARAMETERS[n].unscaled(float(v)) for n, v in zip(self._fitted, x, strict=True)},
        }

    def residual(self, x: Array) -> Array:
        """Weighted gain and phase of simulated over measured responses, shape (m,)."""
        return self._at(x)[0]

    def jacobian(self, x: Array) -> Array:
        """Derivative of `residual` by forward differences, shape (m, p)."""
        return self._at(x)[1]

    def responses(self, goal: MeasuredJoint, drives: Sequence[Mapping[str, float]]) -> ComplexArray:
        """Full responses with several drives, the delay included, shape (drives, f)."""
        values = {name: np.array([drive[name] for drive in drives]) for name in FREE}
        command = goal.trace.mirrored(self._rig.robot)[2]
        late = np.exp(-1j * values.pop("delay")[:, None] * goal.measured.omega)
        ((_, position),) = self._rig.run([command], [self._rig.pose(goal.trace)], **values)
        return np.asarray(goal.full_response(position) * late)

    def _at(self, x: Array) -> tuple[Array, Array]:
        key = x.tobytes()
        if key not in self._cache:
            drives = [self.values(point) for point in (x, *(x + np.diag(self._step)))]
            parts = []
            for goal in self._goals:
                simulated = self.responses(goal, drives)[:, goal.fit_mask]
                measured = goal.measured.response[goal.fit_mask]
                parts.append(residual_db(goal, simulated, measured, True) * _weight(goal))
            rows = np.concatenate(parts, axis=1)
            self._cache[key] = rows[0], ((rows[1:] - rows[0]) / self._step[:, None]).T
        return self._cache[key]


def fit_joint(
    rig: JointRig,
    goals: Sequence[MeasuredJoint],
    on_drive: tuple[float, float],
    fitted: tuple[str, ...],
) -> JointFit:
    """Fit one joint's drive to its responses at all amplitudes.

    Args:
        rig: The rig of the joint's original.
        goals: The joint at every amplitude, largest first.
        on_drive: Stiffness and damping on the real drive.
        fitted: What to fit.

    Raises:
        IdentifiabilityError: The repeats leave a fitted parameter unknown.
    """
    goal = goals[0]
    joint = rig.robot.joint(goal.joint)
    known = {
        "stiffness": on_drive[0],
        "damping": on_drive[1],
        "armature": joint.drive.armature,
        "frictionloss": joint.drive.frictionloss,
        "delay": 0.0,
    }
    problem = ResponseProblem(rig, goals, fitted, known)
    solution = solve(problem, tolerance=_SETTLED, rounds=_ROUNDS)
    covariance, freedom = _covariance(goals, solution.jacobian)
    found = estimate(fitted, solution.x, covariance, freedom, known)
    if freedom and found.unidentified:
        name = found.unidentified[0]
        raise IdentifiabilityError(
            f"{joint.name}: these sweeps do not identify the {name} (deviation "
            f"{found.sd[name]:.2g}); {EXPERIMENTS[name]}; or hold it at a known value."
        )
    matched, naive = problem.responses(goal, [found.values, known])
    errors = [
        float(np.sqrt(np.mean(goal.error_db(one[goal.fit_mask]) ** 2))) for one in (matched, naive)
    ]
    flags = () if freedom else ("one repeat: no interval; record three or more",)
    return JointFit(
        joint=joint.name,
        responses=tuple(one.measured for one in goals),
        stiffness=found.values["stiffness"],
        damping=found.values["damping"],
        armature=found.values["armature"],
        frictionloss=found.values["frictionloss"],
        delay_s=found.values["delay"],
        ci95=found.ci95,
        covariance=found.covariance,
        band_hz=joint.band_hz,
        error_db=errors[0],
        naive_error_db=errors[1],
        coherence_min=float(goal.measured.coherence[goal.measured.band(*joint.band_hz)].min()),
        matched=matched,
        naive=naive,
        flags=flags if solution.settled else (*flags, "the fit did not settle"),
    )


def _weight(goal: MeasuredJoint) -> Array:
    """Weight of gain and of phase at each frequency [1/dB], shape (2 fit_mask,)."""
    return np.tile(1.0 / goal.deviation_db(), 2)


def _covariance(goals: Sequence[MeasuredJoint], jacobian: Array) -> tuple[Array, int]:
    """Covariance of the searched numbers from the scatter over repeats, and its freedom.

    Every repeat of every amplitude moves the optimum by `(J^T J)^-1 J^T` times what it differs
    from their mean.
    """
    influence = np.linalg.pinv(jacobian)
    covariance = np.zeros((len(influence), len(influence)))
    freedom = 0
    first = 0
    for goal in goals:
        count, width = len(goal.measured.repeats), 2 * int(goal.fit_mask.sum())
        part = influence[:, first : first + width]
        first += width
        if count < 2:
            continue
        mean = goal.measured.response[goal.fit_mask]
        change = residual_db(goal, goal.measured.repeats[:, goal.fit_mask], mean, True)
        covariance += jackknife((change * _weight(goal)) @ part.T / (count - 1))
        freedom += count - 1
    return covariance, freedom
