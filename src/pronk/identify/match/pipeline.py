"""From logs to matched gains: the whole match, joint by joint."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from pronk.arrays import Array, ComplexArray
from pronk.errors import IdentifiabilityError, PronkError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match.arm import fit_together
from pronk.identify.match.checks import check_recordings, check_response
from pronk.identify.match.export.actuators import exported_actuators
from pronk.identify.match.grid import (
    GridSearch,
    alike,
    axes,
    coarse_search,
    linearized,
    quick_search,
    search_all,
)
from pronk.identify.match.measured_joint import (
    DriveGains,
    MeasuredJoint,
    Pair,
    gains_on_drive,
    logs_by_joint,
    measured_joints,
    merged,
    with_drive_gains,
)
from pronk.identify.match.parameters import (
    DRIVE_MODE,
    FREE,
    GAINS,
    GAINS_MODE,
    PARAMETERS,
    checked_names,
)
from pronk.identify.match.ranges import matched_gains
from pronk.identify.match.response_fit import Fit, refine, require_sweeps, response_fit
from pronk.identify.match.result import (
    ZERO_ARMATURE,
    JointFit,
    MatchResult,
    amplitude_spread,
    held_out_flags,
)
from pronk.identify.match.settings import MatchSettings
from pronk.identify.match.simulated import SimRequest, responses
from pronk.identify.match.time_fit import TIME_FIT, TimeFit, fit_joint, recorded
from pronk.identify.match.torque import fit_drives, joint_fits
from pronk.identify.match.translate import translated
from pronk.identify.match.uncertainty import gain_interval
from pronk.identify.response.response import FrequencyResponse
from pronk.identify.simulators.chain import moves_together, published
from pronk.identify.simulators.linear import LinearJoint
from pronk.identify.simulators.load import joint_rigs
from pronk.identify.simulators.mujoco import MujocoSimulator, mujoco_info
from pronk.identify.simulators.profiles import profile
from pronk.identify.simulators.simulator import JointRigs, SimulatorInfo
from pronk.identify.simulators.stability import require_stable
from pronk.robots.robot import RobotSpec

Progress = Callable[[str, float], None]
Mode = Literal["gains", "drive"]

NO_MATCH_DB = 1.0
"""Error in the band above which the best gains are no match [dB]: twice the 0.5 dB that a match
of a good log stays below."""
NO_MATCH_INTERVALS = 3.0
"""A noisy log may miss by more: so many half-widths of the measured gain's own interval."""
NO_ARMATURE_RATIO = 5.0
"""Error without rotor inertia, over the matched one, from which on it is no match (F13)."""
_START_S = 0.005
"""Delay from which the fit in time begins [s]: one physics step of the training simulator."""
SPREAD_MAX = 0.05
"""Relative change of stiffness between amplitudes that is worth a flag; the paper's own
randomization is 2 N m/rad on 20 (D3), twice that."""


def match_logs(logs: Sequence[JointLog], robot: RobotSpec, **options: Any) -> MatchResult:
    """Match every joint that was excited in some logs; options and errors of `match_frameworks`."""
    return match_frameworks(logs, robot, (), **options)[""]


def match_frameworks(
    logs: Sequence[JointLog],
    robot: RobotSpec,
    names: Sequence[str],
    *,
    mode: Mode = "gains",
    free: Sequence[str] = (),
    drive_gains: DriveGains | None = None,
    settings: MatchSettings | None = None,
    progress: Progress | None = None,
) -> dict[str, MatchResult]:
    """Match for several frameworks from one set of logs.

    Sweeps of one joint at a time are matched joint by joint; where several joints move at once the
    whole arm is fitted in time.

    Args:
        logs: One or more logs of one robot; a joint may be excited in several.
        robot: The robot.
        names: Profiles, as `pronk.identify.simulators.profiles.profile` takes them, for mode
            `gains`.
        mode: `gains` finds stiffness and damping (the paper's); `drive` takes the stiffness for
            known and fits damping, armature, dry friction and delay, and by a torque channel
            armature, friction and torque scale.
        free: Parameters to fit in mode `drive` instead, out of `FREE`.
        drive_gains: Gains that were on the real drives, where the logs do not have them.
        settings: How to match; the fit in time if not given.
        progress: Called with the stage and the share of it that is done, 0 to 1.

    Returns:
        Results by name; that of the robot's own simulator, where the logs are checked, by "".

    Raises:
        LogError: No joint of the robot was excited, or a log cannot be used.
        IdentifiabilityError: A joint's band is mostly incoherent or too short, or a parameter
            cannot be identified.
        PronkError: The simulator of the settings cannot be used here.
    """
    chosen, clock = settings or MatchSettings(), _Clock(progress)
    frameworks = {name: profile(name) for name in names}
    robots = {name: framework.robot(robot) for name, framework in frameworks.items()}
    logs = with_drive_gains(logs, robot, drive_gains)
    if mode not in ("gains", "drive"):
        raise PronkError(f"mode {mode!r}; expected gains or drive.")
    if free and mode != "drive":
        raise PronkError("parameters to fit can be named in mode drive only.")
    if names and (mode == "drive" or chosen.simulator != "mujoco"):
        raise PronkError(
            f"profile {', '.join(names)} in mode {mode} with simulator {chosen.simulator}; "
            "expected mode gains and simulator mujoco."
        )
    drives, remarks = fit_drives(logs, robot) if mode == "drive" else ({}, {})
    logs, every = [log for log in logs if log.excited_joints] or logs, logs
    if (drives or remarks) and not any(log.excited_joints for log in logs):
        if not (by_torque := joint_fits(robot, {}, drives, remarks)):
            reasons = "; ".join(dict.fromkeys(remarks.values()))
            raise IdentifiabilityError(
                f"{len(logs)} logs excite no joint by a commanded position and identify no drive "
                f"by torque: {reasons or 'record larger or faster motions'}."
            )
        return {"": _result(robot, by_torque, logs, mujoco_info(robot))}
    wrong: dict[str, tuple[str, ...]] = {}
    for joint, sources in logs_by_joint(logs, robot).items():
        recordings = [recording for log in sources for recording in log.excitations(joint)]
        wrong[joint] = check_recordings(recordings, robot)
    fitted = checked_names(free, FREE) if free else DRIVE_MODE if mode == "drive" else GAINS_MODE
    work = _Work(logs=logs, settings=chosen, mode=mode)
    own = _Match(work=work, robot=robot, fitted=fitted, clock=clock)
    others: dict[tuple[object, ...], _Match] = {}
    for name, framework in frameworks.items():
        if (kind := _kind(robots[name])) not in (_kind(robot), *others):
            dry = framework.friction == "N m"
            others[kind] = _Match(
                work=work,
                robot=robots[name],
                fitted=[n for n in fitted if dry or n != "frictionloss"],
                clock=_Clock(progress, name),
                base=own,
            )
    # Simulations and products of large arrays leave the interpreter to the other threads.
    with ThreadPoolExecutor(chosen.threads) as pool:
        waiting: dict[tuple[object, ...], Future[_Match]] = {}

        def begin() -> None:
            for kind, one in others.items():
                if work.measured:
                    work.found(one.robot, clock)
                waiting[kind] = pool.submit(one.run)

        try:
            own.ready = begin
            own.run()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        own.joints = joint_fits(own.robot, own.joints, drives, remarks)
        done = {_kind(own.robot): own.result(every, wrong)}
        out = {"": done[_kind(own.robot)]}
        for kind, future in waiting.items():
            done[kind] = future.result().result(every, wrong)
    for name, framework in frameworks.items():
        kind = _kind(robots[name])
        info = replace(framework.info, decimation=robots[name].decimation)
        theirs = replace(done[kind].gains, simulator=info)
        require_stable(framework, robots[name], exported_actuators(theirs, robots[name], "joint"))
        timed = kind in others and others[kind].clock.name == name
        seconds = done[kind].seconds if timed else {}
        out[name] = replace(done[kind], gains=theirs, seconds=seconds)
    return out


def _kind(robot: RobotSpec) -> tuple[object, ...]:
    """What distinguishes the joints of one framework from those of another."""
    return (robot.law, robot.timestep_s, robot.decimation, *(j.drive for j in robot.joints))


def _result(
    robot: RobotSpec,
    joints: Mapping[str, JointFit],
    logs: Sequence[JointLog],
    info: SimulatorInfo,
    **more: Any,
) -> MatchResult:
    """The result for one simulator; `more` are fields of `MatchResult`."""
    gains = {name: joint.gains() for name, joint in joints.items()}
    return MatchResult(
        gains=matched_gains(robot, gains, logs, info),
        joints={name: joint for name, joint in joints.items() if joint.responses},
        **more,
    )


class _Clock:
    """Wall time of each stage, and reports of progress."""

    def __init__(self, progress: Progress | None, name: str = "") -> None:
        self.seconds: dict[str, float] = {}
        self.name = name
        self._progress = progress or (lambda stage, share: None)
        self._stage = ""

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage; report its begin and end."""
        self._stage = f"{self.name} {name}".lstrip()
        self.report(0.0)
        begin = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - begin
        self.report(1.0)

    def report(self, share: float) -> None:
        """Report the share of the stage that is done."""
        self._progress(self._stage, share)


Found = Mapping[str, Sequence[MeasuredJoint]]
"""Measured responses by joint; largest amplitude, the one that is matched, first."""
Wrong = Mapping[str, tuple[str, ...]]
"""What contradicts the logs of each joint."""


@dataclass(frozen=True, kw_only=True)
class _Work:
    """Logs to match, and how; simulators with the same step share the measured responses."""

    logs: Sequence[JointLog]
    settings: MatchSettings
    mode: Mode
    measured: dict[tuple[float, int], Found] = field(default_factory=dict)
    """By timestep and decimation."""
    on_drive: dict[str, Pair] = field(default_factory=dict)
    """Gains that were on the real drives, by joint."""

    def found(self, robot: RobotSpec, clock: _Clock) -> Found:
        """Responses of every excited joint, in the robot's order, for the robot's timestep."""
        timing = robot.timestep_s, robot.decimation
        if timing not in self.measured and self.measured:
            first = next(iter(self.measured.values()))
            self.measured[timing] = {
                name: [goal.on(robot) for goal in goals] for name, goals in first.items()
            }
        elif not self.measured:
            found = {}
            with clock.stage("estimate"):
                for name, sources in (where := logs_by_joint(self.logs, robot)).items():
                    each = [measured_joints(log, name, robot, self.settings) for log in sources]
                    found[name] = merged(each)
                    self.on_drive[name] = gains_on_drive(sources[0], name, robot)
                    clock.report(len(found) / len(where))
            self.measured[timing] = found
        return self.measured[timing]


@dataclass(kw_only=True)
class _Match:
    """The joints of a robot in one simulator, and the way to them."""

    work: _Work
    robot: RobotSpec
    """As it is simulated."""
    fitted: Sequence[str]
    clock: _Clock
    base: _Match | None = None
    """That in the robot's own simulator, at which other frameworks begin."""
    ready: Callable[[], None] = lambda: None
    """Called as soon as other frameworks can begin at this one."""
    joints: Mapping[str, JointFit] = field(default_factory=dict)
    fits: dict[str, TimeFit] = field(default_factory=dict)
    """Joints that were fitted in time."""
    excluded: Mapping[str, str] = field(default_factory=dict)
    rate: float = float("nan")
    """Physics steps per second of the grid search; NaN where it was not searched whole."""
    plants: Mapping[str, LinearJoint] = field(default_factory=dict)
    """Linearized joints."""
    gains: dict[str, Pair] = field(default_factory=dict)
    matched: Mapping[str, ComplexArray] = field(default_factory=dict)
    """Simulated responses with these gains, shape (f,) each."""

    def __post_init__(self) -> None:
        self.info = mujoco_info(self.robot)

    def run(self) -> _Match:
        """Match the joints."""
        logs, settings = self.work.logs, self.work.settings
        if any(moves_together(log) for log in logs):
            if settings.simulator != "mujoco":
                raise PronkError(
                    f"simulator {settings.simulator}: several joints of these logs move at once, "
                    "which only simulator mujoco matches; record one joint at a time."
                )
            self.ready()
            with self.clock.stage("fit"):
                self.joints, self.excluded = fit_together(
                    logs,
                    self.robot,
                    self.fitted,
                    threads=settings.threads,
                    progress=self.clock.report,
                )
            return self
        # The simulator first: an engine that is missing must not cost the user an estimate.
        with joint_rigs(
            settings.simulator,
            self.robot,
            threads=settings.threads,
            python=settings.simulator_python,
        ) as rigs:
            if self.work.mode == "gains" and "frictionloss" not in self.fitted:
                rigs.parameters -= {"frictionloss"}
            self.robot, self.info = rigs.robot, rigs.info
            found = self.work.found(self.robot, self.clock)
            match = self._match_drives if self.work.mode == "drive" else self._match_gains
            self.joints = match(rigs, found)
        return self

    def result(self, logs: Sequence[JointLog], wrong: Wrong) -> MatchResult:
        """The result for the simulator, with what is wrong about the logs."""
        joints = {}
        for name, fit in self.joints.items():
            joints[name] = replace(fit, flags=(*fit.flags, *wrong.get(name, ())))
        return _result(
            self.robot,
            joints,
            logs,
            self.info,
            seconds=self.clock.seconds,
            grid_steps_per_second=self.rate,
            excluded=self.excluded,
        )

    def _nominal(self, name: str) -> dict[str, float]:
        """The published drive with the gains that were on it."""
        on_drive = zip(GAINS, self.work.on_drive[name], strict=True)
        return published(self.robot, name) | dict(on_drive)

    def _fit_in_time(
        self, rigs: JointRigs, name: str, fitted: Sequence[str], start: Pair
    ) -> TimeFit:
        """Fit one joint in time, from some gains."""
        nominal = self._nominal(name)
        begin = nominal | dict(zip(GAINS, start, strict=True)) | {"delay": _START_S}
        sources = [log for log in self.work.logs if name in log.excited_joints]
        fit = fit_joint(rigs, recorded(sources, name, rigs.robot), fitted, begin, nominal)
        self.fits[name] = fit
        return fit

    def _match_drives(self, rigs: JointRigs, found: Found) -> dict[str, JointFit]:
        """Mode drive: fit the drive of every joint, if the sweeps can separate its parameters."""
        for name, goals in found.items():
            require_sweeps(rigs.robot, name, goals, self.fitted)
        joints = {}
        with self.clock.stage("time fit"):
            for name, goals in found.items():
                fit = self._fit_in_time(rigs, name, self.fitted, self.work.on_drive[name])
                if unknown := fit.estimate.unidentified:
                    raise IdentifiabilityError(
                        f"{name}: these logs do not identify the {unknown[0]} (deviation "
                        f"{fit.estimate.sd[unknown[0]]:.2g}); {PARAMETERS[unknown[0]].remedy}; or "
                        "hold it at a known value."
                    )
                drives = fit.estimate.values, self._nominal(name)
                requests = [SimRequest(goals[0], **_drive(rigs, drive)) for drive in drives]
                matched, naive = responses(rigs, requests, whole=True)
                joints[name] = _time_joint_fit(rigs.robot, goals, fit, (matched, naive))
                self.clock.report(len(joints) / len(found))
        return joints

    def _match_gains(self, rigs: JointRigs, found: Found) -> dict[str, JointFit]:
        """Search by the paper's magnitude and, with method `time`, fit in time from there.

        Other frameworks begin at the joints of the robot's own simulator: the search with what
        simulations correct there, the fit in time with its gains translated, without a search.
        """
        paper, main = self.work.settings.method == "paper", [goals[0] for goals in found.values()]
        if isinstance(rigs, MujocoSimulator):
            self.plants = {goal.joint: linearized(rigs, goal) for goal in main}
        grids: dict[str, GridSearch] = {}
        fits: dict[str, list[Fit]] = {}
        if self.base and not paper:
            for name in found:
                first = self.base.plants[name], self.plants[name], self.base.gains[name]
                self.gains[name] = translated(*first).after
        else:
            for grid, fit in self._search(rigs, main):
                grids[fit.target.joint], fits[fit.target.joint] = grid, [fit]
                self.gains[fit.target.joint] = fit.gains
        if not paper:
            with self.clock.stage("time fit"):
                for name in found:
                    self._fit_in_time(rigs, name, TIME_FIT, self.gains[name])
                    self.clock.report(len(self.fits) / len(found))
        with self.clock.stage("responses"):
            best = {name: dict(zip(GAINS, pair, strict=True)) for name, pair in self.gains.items()}
            best |= {name: _drive(rigs, fit.estimate.values) for name, fit in self.fits.items()}
            requests = [SimRequest(goal, **best[goal.joint]) for goal in main]
            matched = responses(rigs, requests, whole=True)
            requests = [SimRequest(goal, *self.work.on_drive[goal.joint]) for goal in main]
            both = zip(matched, responses(rigs, requests, whole=True), strict=True)
        self.gains = {name: (best[name]["stiffness"], best[name]["damping"]) for name in found}
        self.matched = dict(zip(found, matched, strict=True))
        self.ready()
        zero: Mapping[str, tuple[float, ComplexArray]] = {}
        if paper and not self.base:
            with self.clock.stage("amplitudes"):
                others = [goal for goals in found.values() for goal in goals[1:]]
                for fit in refine(rigs, others, [self.gains[goal.joint] for goal in others]):
                    fits[fit.target.joint].append(fit)
            if self.work.settings.zero_armature and "armature" in rigs.parameters:
                with self.clock.stage("zero armature"):
                    zero = self._without_armature(rigs, main)
        joints = {}
        for (name, goals), own in zip(found.items(), both, strict=True):
            joints[name] = (
                _joint_fit(rigs.robot, goals, fits[name], own, grids[name], zero.get(name))
                if paper
                else _time_joint_fit(rigs.robot, goals, self.fits[name], own, grids.get(name))
            )
        return joints

    def _search(
        self, rigs: JointRigs, goals: Sequence[MeasuredJoint]
    ) -> Iterable[tuple[GridSearch, Fit]]:
        """The paper's search, whole or linearized, and the gains off its grid, one a joint."""
        settings, corrections = self.work.settings, []
        grid = axes(rigs.robot, settings.grid_points)
        if isinstance(rigs, MujocoSimulator) and not settings.exhaustive:
            with self.clock.stage("quick search"):
                if self.base:
                    corrections = [self.base._correction(goal, rigs.robot) for goal in goals]
                exact = settings.method == "paper"
                found = quick_search(rigs, goals, *grid, exact=exact, corrections=corrections)
            return zip(*found, strict=True)
        with self.clock.stage("grid"):
            begin = time.perf_counter()
            searched = search_all(rigs, goals, *grid, self.clock.report)
            # Everything the search does counts, not the simulator alone.
            self.rate = rigs.steps / (time.perf_counter() - begin)
        with self.clock.stage("refine"):
            return zip(searched, refine(rigs, goals, [one.gains for one in searched]), strict=True)

    def _correction(self, goal: MeasuredJoint, robot: RobotSpec) -> Array:
        """Log gain of a joint simulated over linearized, shape (inside,), for another robot.

        It is that of dry friction; without friction there is none.
        """
        if robot.joint(goal.joint).drive.frictionloss == 0.0:
            return np.zeros(len(goal.omega))
        plant, gains = self.plants[goal.joint], self.gains[goal.joint]
        closed = plant.response(*gains, amplitude=goal.trace.amplitude)[0]
        return np.asarray(np.log(np.abs(self.matched[goal.joint][goal.fit_mask] / closed)))

    def _without_armature(
        self, rigs: JointRigs, goals: Sequence[MeasuredJoint]
    ) -> dict[str, tuple[float, ComplexArray]]:
        """The search without rotor inertia (F13): by joint, error [dB] and response at its best."""
        grid, groups = axes(rigs.robot, self.work.settings.grid_points), alike(goals, rigs.robot)
        errors, requests = [], []
        for k, group in enumerate(groups):
            searched = coarse_search(rigs, group, *grid, armature=0.0)
            for goal, one in zip(group, searched, strict=True):
                errors.append(one.error_db)
                requests.append(SimRequest(goal, *one.gains, armature=0.0))
            self.clock.report((k + 1) / len(groups))
        found = zip(errors, responses(rigs, requests, whole=True), strict=True)
        return dict(zip([one.target.joint for one in requests], found, strict=True))


def _drive(rigs: JointRigs, values: Mapping[str, float]) -> dict[str, float]:
    """Parameters of a fitted drive that a simulation takes."""
    settable = {*rigs.parameters, "delay"} - {"offset"}
    return {name: value for name, value in values.items() if name in settable}


def _time_joint_fit(
    robot: RobotSpec,
    goals: Sequence[MeasuredJoint],
    fit: TimeFit,
    both: tuple[ComplexArray, ComplexArray],
    grid: GridSearch | None = None,
) -> JointFit:
    """Put the findings of one joint together that was fitted in time.

    `both` are simulated responses, with the matched gains and with those of the real drive.
    """
    error_db = goals[0].rms_db(both[0][goals[0].fit_mask])
    return response_fit(
        robot,
        goals,
        fit.estimate,
        *both,
        error_db=error_db,
        **_grid_fields(grid),
        total95=fit.total95,
        held_out=fit.held_out,
        amplitude_gains=fit.amplitude_gains,
        flags=(
            *held_out_flags(fit.held_out),
            *_no_match(both[0], goals[0]),
            *_time_flags(fit),
            *fit.estimate.flags,
            *_goal_flags(goals[0], robot),
        ),
    )


def _joint_fit(
    robot: RobotSpec,
    goals: Sequence[MeasuredJoint],
    fits: Sequence[Fit],
    both: tuple[ComplexArray, ComplexArray],
    grid: GridSearch,
    zero: tuple[float, ComplexArray] | None,
) -> JointFit:
    """The same for one joint by magnitude; `fits` are of each amplitude."""
    fit, joint, rows = fits[0], robot.joint(goals[0].joint), amplitude_gains(fits)
    held = {
        "armature": joint.drive.armature,
        "frictionloss": float("nan"),
        "delay": command_delay(goals[0].measured, both[0], joint.band_hz),
    }
    found = gain_interval(goals[0], fit.solution, held)
    zero_db, zero_response = zero or (float("nan"), None)
    return response_fit(
        robot,
        goals,
        found,
        *both,
        error_db=fit.error_db,
        **_grid_fields(grid),
        zero_armature_error_db=zero_db,
        zero_armature=zero_response,
        amplitude_gains=rows,
        flags=(
            *_search_flags(fit, grid, both[0]),
            *found.flags,
            *amplitude_flags(rows),
            *_goal_flags(goals[0], robot),
            *_armature_flags(fit, zero_db),
        ),
    )


def _grid_fields(grid: GridSearch | None) -> dict[str, Any]:
    """Fields of `JointFit` that hold a search of the grid."""
    return {} if grid is None else {f"grid_{name}": values for name, values in vars(grid).items()}


def _time_flags(fit: TimeFit) -> Iterator[str]:
    """Parameters at a bound or not identified; gains by the amplitude."""
    values = fit.estimate.values
    for name in fit.at_bound:
        if name not in ("delay", "frictionloss"):  # none is a possible result
            yield (f"{name} at the bound of the search, {values[name]:.3g} {PARAMETERS[name].unit}")
    for name in fit.estimate.unidentified:
        if name not in fit.at_bound:
            yield (
                f"{name} is not identified (deviation {fit.estimate.sd[name]:.2g}); "
                f"{PARAMETERS[name].remedy}"
            )
    if not fit.solution.settled:
        yield "the fit in time did not settle"
    yield from amplitude_flags(fit.amplitude_gains)


def _no_match_db(goal: MeasuredJoint) -> float:
    """Error in the band above which gains are no match [dB]."""
    return max(NO_MATCH_DB, NO_MATCH_INTERVALS * goal.measurement_error_db())


def _no_match(matched: ComplexArray, goal: MeasuredJoint) -> Iterator[str]:
    """Flag gains whose response is not the measured one."""
    yield from check_response(goal.measured, matched, goal.fit_mask, _no_match_db(goal))


def _search_flags(fit: Fit, grid: GridSearch, matched: ComplexArray) -> Iterator[str]:
    """Flags of the optimum of the paper's search."""
    yield from _no_match(matched, fit.target)
    if grid.at_edge:
        yield (
            f"at the edge of the grid ({grid.gains[0]:.3g} N m/rad, {grid.gains[1]:.3g} N m s/rad)"
        )
    if not fit.solution.settled:
        yield "the refinement did not settle; take the gains of the grid"
    if not fit.target.trace.policy_held:
        yield "the command does not change at the policy's rate; each physics step holds its own"


def _goal_flags(goal: MeasuredJoint, robot: RobotSpec) -> Iterator[str]:
    """Frequencies of the band that the fit did not use, and what could not be used beside them."""
    whole = int(goal.measured.band(*robot.joint(goal.joint).band_hz).sum())
    if left := whole - int(goal.fit_mask.sum()):
        yield f"{left} of {whole} frequencies left out for low coherence"
    yield from goal.warnings


def _armature_flags(fit: Fit, zero_db: float) -> Iterator[str]:
    """What the search without rotor inertia found (F13)."""
    if not np.isfinite(zero_db):
        return
    ratio = zero_db / max(fit.error_db, 1e-6)
    if ratio >= NO_ARMATURE_RATIO and zero_db > _no_match_db(fit.target):
        verdict = "no match, the best node misses"
    else:
        # A light rotor on a heavy link: other gains make up for it.
        verdict = "not ruled out by this joint, its best node misses"
    yield f"{ZERO_ARMATURE}{verdict} by {zero_db:.2g} dB RMS, {ratio:.3g} times the match"


def amplitude_gains(fits: Sequence[Fit]) -> Array:
    """(amplitude, stiffness, damping) of each amplitude fitted by itself, shape (m, 3)."""
    rows = [(fit.target.measured.amplitude, *fit.gains) for fit in fits]
    return np.array(rows).reshape(-1, 3)


def amplitude_flags(gains: Array) -> tuple[str, ...]:
    """Warn of gains, shape (m, 3), that change with the amplitude, as dry friction makes them."""
    spread = amplitude_spread(gains)
    if not spread > SPREAD_MAX:
        return ()
    largest, smallest = gains[:, 0].max(), gains[:, 0].min()
    return (
        f"friction: stiffness changes by {100.0 * spread:.0f} % between {smallest:.3g} and "
        f"{largest:.3g} rad; give the simulator the joint's dry friction, or match at the "
        "amplitude that the policy will use",
    )


def command_delay(
    measured: FrequencyResponse, matched: ComplexArray, band_hz: tuple[float, float]
) -> float:
    """Delay of the measured response behind the matched one [s], never negative.

    The magnitude gives the gains (paper F9); phase = -omega * delay is a straight line through
    zero. Least squares over the joint's band: every frequency with enough coherence counts alike.
    Zero where none has.
    """
    band = measured.band(*band_hz, 0.8)
    if not band.any():
        return 0.0
    omega = measured.omega[band]
    lag = -np.unwrap(np.angle(measured.response[band] / matched[band]))
    return max(0.0, float(omega @ lag / (omega @ omega)))
