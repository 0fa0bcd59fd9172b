"""From logs to matched gains: the whole match, joint by joint."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from pronk.arrays import Array, ComplexArray
from pronk.errors import IdentifiabilityError, PronkError
from pronk.logs.joint_log import JointLog
from pronk.match.arm import fit_together
from pronk.match.export import actuators, require_stable
from pronk.match.grid import (
    GridSearch,
    alike,
    axes,
    coarse_search,
    linearized,
    quick_search,
    search_all,
)
from pronk.match.measured_joint import (
    DriveGains,
    MeasuredJoint,
    Pair,
    gains_on_drive,
    logs_by_joint,
    measured_joints,
    merged,
    with_drive_gains,
)
from pronk.match.parameters import DRIVE_MODE, FREE, GAINS, GAINS_MODE, PARAMETERS, checked_names
from pronk.match.plausibility import CAUSES, findings, require_plausible
from pronk.match.randomization import matched_gains
from pronk.match.response_fit import Fit, refine, require_sweeps, response_fit
from pronk.match.result import (
    ZERO_ARMATURE,
    JointFit,
    MatchResult,
    amplitude_spread,
    held_out_flags,
)
from pronk.match.settings import MatchSettings
from pronk.match.simulated import SimRequest, responses
from pronk.match.time_fit import TIME_FIT, TimeFit, fit_joint, recorded
from pronk.match.torque import fit_drives, joint_fits
from pronk.match.translate import translated
from pronk.match.uncertainty import gain_interval
from pronk.response.estimate import excited_joints
from pronk.response.response import FrequencyResponse
from pronk.robots.robot import RobotSpec
from pronk.simulators.chain import moves_together, published
from pronk.simulators.linear import Plant
from pronk.simulators.load import joint_rigs
from pronk.simulators.mujoco import MujocoSimulator, mujoco_info
from pronk.simulators.profiles import profile
from pronk.simulators.simulator import JointRigs, SimulatorInfo

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


def match_logs(
    logs: Sequence[JointLog],
    robot: RobotSpec,
    *,
    mode: Mode = "gains",
    free: Sequence[str] = (),
    drive_gains: DriveGains | None = None,
    settings: MatchSettings | None = None,
    progress: Progress | None = None,
) -> MatchResult:
    """Match every joint that was excited in some logs.

    Sweeps of one joint at a time are matched in frequency; where several joints move at once the
    whole arm is fitted in time.

    Args:
        logs: One or more logs of one robot; a joint may be excited in several.
        robot: The robot.
        mode: `gains` finds stiffness and damping (the paper's); `drive` takes the stiffness for
            known and fits damping, armature, dry friction and delay, and by a torque channel
            armature, friction and torque scale.
        free: Parameters to fit in mode `drive` instead, out of `FREE`.
        drive_gains: Gains that were on the real drives, where the logs do not have them.
        settings: How to match; the fit in time if not given.
        progress: Called with the stage and the share of it that is done, 0 to 1.

    Raises:
        LogError: No joint of the robot was excited, or a log cannot be used.
        IdentifiabilityError: A joint's band is mostly incoherent or too short, or a parameter
            cannot be identified.
        PronkError: The device or simulator of the settings cannot be used here.
    """
    more: Any = {"mode": mode, "free": free, "drive_gains": drive_gains}
    return match_frameworks(logs, robot, (), settings=settings, progress=progress, **more)[""]


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
    """Match for several frameworks from one set of logs; arguments and errors as of `match_logs`.

    `names` are profiles, as `pronk.simulators.profiles.profile` takes them, for mode `gains`.
    Returns results by name; that of the robot's own simulator, where the logs are checked, by "".
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
    logs, every = [log for log in logs if excited_joints(log)] or logs, logs
    if (drives or remarks) and not any(map(excited_joints, logs)):
        if not (joints := joint_fits(robot, {}, drives, remarks)):
            reasons = "; ".join(dict.fromkeys(remarks.values()))
            raise IdentifiabilityError(
                f"{len(logs)} logs excite no joint by a commanded position and identify no drive "
                f"by torque: {reasons or 'record larger or faster motions'}."
            )
        gains = {name: joint.gains() for name, joint in joints.items()}
        found = matched_gains(robot, gains, logs, mujoco_info(robot))
        return {"": MatchResult(gains=found, joints={})}
    require_plausible(logs_by_joint(logs, robot), robot)
    fitted = checked_names(free, FREE) if free else DRIVE_MODE if mode == "drive" else GAINS_MODE
    work = _Work(logs=logs, settings=chosen, mode=mode)
    first: dict[tuple[object, ...], str] = {}
    for name in names:
        first.setdefault(_kind(robots[name]), name)
    first.pop(_kind(robot), None)
    clocks = {name: _Clock(progress, f"{name} ") for name in first.values()}
    waiting: dict[tuple[object, ...], Future[_Matched]] = {}
    # Simulations and products of large arrays leave the interpreter to the other threads.
    with ThreadPoolExecutor(chosen.threads) as pool:

        def begin(base: _Base) -> None:
            for kind, name in first.items():
                if work.measured:
                    work.found(robots[name], clock)
                dry = frameworks[name].friction == "N m"
                known = [n for n in fitted if dry or n != "frictionloss"]
                waiting[kind] = pool.submit(
                    _matched, work, robots[name], known, clocks[name], base=base
                )

        try:
            own = _matched(work, robot, fitted, clock, ready=begin)
            wrong = _wrong(work, own, clock)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        joints = joint_fits(own.robot, own.joints, drives, remarks)
        out = {"": replace(own, joints=joints).result(every, wrong, clock)}
        done = {_kind(own.robot): out[""]}
        for kind, one in waiting.items():
            done[kind] = one.result().result(every, wrong, clocks[first[kind]])
    for name, framework in frameworks.items():
        kind = _kind(robots[name])
        info = replace(framework.info, decimation=robots[name].decimation)
        theirs = replace(done[kind].gains, simulator=info)
        require_stable(framework, robots[name], actuators(theirs, robots[name], "joint"))
        seconds = done[kind].seconds if first.get(kind) == name else {}
        out[name] = replace(done[kind], gains=theirs, seconds=seconds)
    return out


def _kind(robot: RobotSpec) -> tuple[object, ...]:
    """What distinguishes the joints of one framework from those of another."""
    return (robot.law, robot.timestep_s, robot.decimation, *(j.drive for j in robot.joints))


Wrong = Mapping[str, tuple[tuple[str, ...], tuple[str, ...]]]
"""What contradicts the logs of each joint, and what would leave no trace in them."""


@dataclass(frozen=True, kw_only=True)
class _Base:
    """Joints in the robot's own simulator, at which those of other frameworks begin, by name."""

    plants: Mapping[str, Plant] = field(default_factory=dict)
    """Linearized."""
    gains: Mapping[str, Pair] = field(default_factory=dict)
    matched: Mapping[str, ComplexArray] = field(default_factory=dict)
    """Simulated responses with these gains, shape (f,) each."""

    def corrections(self, found: Found, robot: RobotSpec) -> list[Array]:
        """Log gain of each joint simulated over linearized, shape (inside,), for another robot.

        It is that of dry friction; without friction there is none.
        """
        out = []
        for name, (goal, *_) in found.items():
            amplitude = goal.trace.amplitude
            closed = self.plants[name].response(*self.gains[name], amplitude=amplitude)[0]
            out.append(np.log(np.abs(self.matched[name][goal.fit_mask] / closed)))
            if robot.joint(name).drive.frictionloss == 0.0:
                out[-1] = np.zeros_like(out[-1])
        return out

    def translated(self, name: str, other: Plant) -> Pair:
        """Gains with which another joint responds like this one, both linearized."""
        return translated(self.plants[name], other, self.gains[name]).after


@dataclass(frozen=True, kw_only=True)
class _Matched:
    """The joints of a robot in one simulator."""

    robot: RobotSpec
    """As it is simulated."""
    info: SimulatorInfo
    joints: dict[str, JointFit]
    fits: Mapping[str, TimeFit]
    """Those that were fitted in time."""
    excluded: Mapping[str, str]
    rate: float
    """Physics steps per second of the grid search."""

    def result(self, logs: Sequence[JointLog], wrong: Wrong, clock: _Clock) -> MatchResult:
        """The result for the simulator with these joints."""
        joints = {}
        for name, fit in self.joints.items():
            flags, unchecked = wrong.get(name, ((), ()))
            joints[name] = replace(fit, flags=(*fit.flags, *flags), unchecked=unchecked)
        gains = {name: joint.gains() for name, joint in joints.items()}
        return MatchResult(
            gains=matched_gains(self.robot, gains, logs, self.info),
            joints={name: joint for name, joint in joints.items() if joint.responses},
            seconds=clock.seconds,
            grid_steps_per_second=self.rate,
            excluded=self.excluded,
        )


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

    def fit_in_time(
        self, rigs: JointRigs, name: str, fitted: Sequence[str], start: Pair | None = None
    ) -> TimeFit:
        """Fit one joint in time, from some gains or those that were on the drive."""
        nominal = self.nominal(rigs.robot, name)
        begin = nominal | dict(zip(GAINS, start or self.on_drive[name], strict=True))
        sources = [log for log in self.logs if name in excited_joints(log)]
        records = recorded(sources, name, rigs.robot)
        return fit_joint(rigs, records, fitted, begin | {"delay": _START_S}, nominal)

    def nominal(self, robot: RobotSpec, name: str) -> dict[str, float]:
        """The published drive with the gains that were on it."""
        return published(robot, name) | dict(zip(GAINS, self.on_drive[name], strict=True))


def _matched(
    work: _Work,
    robot: RobotSpec,
    fitted: Sequence[str],
    clock: _Clock,
    *,
    base: _Base | None = None,
    ready: Callable[[_Base], None] = lambda base: None,
) -> _Matched:
    """Match the joints in one simulator.

    In the robot's own, `ready` is called with the `base` of other frameworks as soon as it is
    known.
    """
    logs, settings, mode = work.logs, work.settings, work.mode
    excluded: Mapping[str, str] = {}
    rate, info = float("nan"), mujoco_info(robot)
    fits: Mapping[str, TimeFit] = {}
    if any(moves_together(log) for log in logs):
        if settings.simulator != "mujoco":
            raise PronkError(
                f"simulator {settings.simulator}: several joints of these logs move at once, "
                "which only simulator mujoco matches; record one joint at a time."
            )
        ready(_Base())
        with clock.stage("fit"):
            joints, excluded = fit_together(
                logs, robot, fitted, threads=settings.threads, progress=clock.report
            )
    else:
        # The simulator first: a device that is missing must not cost the user an estimate.
        with joint_rigs(
            settings.simulator,
            robot,
            threads=settings.threads,
            device=settings.device,
            python=settings.simulator_python,
        ) as rigs:
            if mode == "gains" and "frictionloss" not in fitted:
                rigs.parameters -= {"frictionloss"}
            robot, info = rigs.robot, rigs.info
            found = work.found(robot, clock)
            if mode == "drive":
                joints, fits = _match_drives(work, rigs, found, fitted, clock)
            else:
                joints, fits, rate = _match_gains(work, rigs, found, clock, base, ready)
    return _Matched(robot=robot, info=info, joints=joints, fits=fits, excluded=excluded, rate=rate)


def _wrong(work: _Work, own: _Matched, clock: _Clock) -> Wrong:
    """Causes that the joints in the robot's own simulator show."""
    out = {}
    with clock.stage("plausibility"):
        for name, fit in own.joints.items():
            time_fit = own.fits.get(name)
            found, hidden = findings(work.logs, name, own.robot, fit=fit, time_fit=time_fit)
            out[name] = tuple(map(str, found)), tuple(CAUSES[cause][0] for cause in hidden)
    return out


class _Clock:
    """Wall time of each stage, and reports of progress."""

    def __init__(self, progress: Progress | None, prefix: str = "") -> None:
        self.seconds: dict[str, float] = {}
        self._progress = progress or (lambda stage, share: None)
        self._prefix = prefix
        self._stage = ""

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage; report its begin and end."""
        self._stage = name
        self.report(0.0)
        begin = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - begin
        self.report(1.0)

    def report(self, share: float) -> None:
        """Report the share of the stage that is done."""
        self._progress(self._prefix + self._stage, share)


Found = Mapping[str, Sequence[MeasuredJoint]]
"""Measured responses by joint; largest amplitude, the one that is matched, first."""


def _match_drives(
    work: _Work, rigs: JointRigs, found: Found, fitted: Sequence[str], clock: _Clock
) -> tuple[dict[str, JointFit], dict[str, TimeFit]]:
    """Mode drive: fit the drive of every joint, if the sweeps can separate its parameters."""
    for name, goals in found.items():
        require_sweeps(rigs.robot, name, goals, fitted)
    joints, fits = {}, {}
    with clock.stage("time fit"):
        for name, goals in found.items():
            fit = fits[name] = work.fit_in_time(rigs, name, fitted)
            if unknown := fit.estimate.unidentified:
                raise IdentifiabilityError(
                    f"{name}: these logs do not identify the {unknown[0]} (deviation "
                    f"{fit.estimate.sd[unknown[0]]:.2g}); {PARAMETERS[unknown[0]].remedy}; or hold "
                    "it at a known value."
                )
            requests = [
                SimRequest(goals[0], **_drive(rigs, fit.estimate.values)),
                SimRequest(goals[0], **_drive(rigs, work.nominal(rigs.robot, name))),
            ]
            matched, naive = responses(rigs, requests, whole=True)
            joints[name] = _time_joint_fit(rigs.robot, goals, fit, matched, naive)
            clock.report(len(joints) / len(found))
    return joints, fits


def _match_gains(
    work: _Work,
    rigs: JointRigs,
    found: Found,
    clock: _Clock,
    base: _Base | None,
    ready: Callable[[_Base], None],
) -> tuple[dict[str, JointFit], dict[str, TimeFit], float]:
    """Search by the paper's magnitude and, with method `time`, fit in time from there.

    Other frameworks begin at the joints of the robot's own simulator, the `base`: the search with
    what simulations correct there, the fit in time with its gains translated, without a search.
    Also returns the fits in time by joint, and physics steps per second of the grid; NaN where it
    was not searched whole.
    """
    settings, paper = work.settings, work.settings.method == "paper"
    main = [goals[0] for goals in found.values()]
    plants: dict[str, Plant] = {}
    if isinstance(rigs, MujocoSimulator):
        plants = {goal.joint: linearized(rigs, goal) for goal in main}
    grid, rate = axes(rigs.robot, settings.grid_points), float("nan")
    grids: dict[str, GridSearch] = {}
    by_amplitude: dict[str, list[Fit]] = {}
    if paper or not base:
        if isinstance(rigs, MujocoSimulator) and not settings.exhaustive:
            with clock.stage("quick search"):
                known = base.corrections(found, rigs.robot) if base else ()
                searched, fits = quick_search(rigs, main, *grid, exact=paper, corrections=known)
        else:
            with clock.stage("grid"):
                begin = time.perf_counter()
                searched = search_all(rigs, main, *grid, clock.report)
                # Everything the search does counts, not the simulator alone.
                rate = rigs.steps / (time.perf_counter() - begin)
            with clock.stage("refine"):
                fits = refine(rigs, main, [one.gains for one in searched])
        grids = dict(zip(found, searched, strict=True))
        by_amplitude = {name: [fit] for name, fit in zip(found, fits, strict=True)}
    gains = {name: fits[0].gains for name, fits in by_amplitude.items()}
    if base and not paper:
        gains = {name: base.translated(name, plants[name]) for name in found}
    fitted: dict[str, TimeFit] = {}
    if not paper:
        with clock.stage("time fit"):
            for name in found:
                fitted[name] = work.fit_in_time(rigs, name, TIME_FIT, gains[name])
                clock.report(len(fitted) / len(found))
    with clock.stage("responses"):
        requests = [
            SimRequest(goal, **_drive(rigs, fitted[goal.joint].estimate.values))
            if goal.joint in fitted
            else SimRequest(goal, *gains[goal.joint])
            for goal in main
        ]
        matched = responses(rigs, requests, whole=True)
        naive = responses(
            rigs, [SimRequest(goal, *work.on_drive[goal.joint]) for goal in main], whole=True
        )
    for name, time_fit in fitted.items():
        gains[name] = time_fit.estimate.values["stiffness"], time_fit.estimate.values["damping"]
    ready(_Base(plants=plants, gains=gains, matched=dict(zip(found, matched, strict=True))))
    if paper and not base:
        with clock.stage("amplitudes"):
            others = [goal for goals in found.values() for goal in goals[1:]]
            for fit in refine(rigs, others, [gains[goal.joint] for goal in others]):
                by_amplitude[fit.target.joint].append(fit)
    zero: dict[str, tuple[float, ComplexArray]] = {}
    wanted = settings.zero_armature and paper and not base
    if wanted and "armature" in rigs.parameters:
        with clock.stage("zero armature"):
            zero = _without_armature(rigs, main, *grid, clock)
    joints = {}
    for (name, goals), match, nominal in zip(found.items(), matched, naive, strict=True):
        if name in fitted:
            joints[name] = _time_joint_fit(
                rigs.robot, goals, fitted[name], match, nominal, grids.get(name)
            )
        else:
            own = by_amplitude[name]
            joints[name] = _joint_fit(
                rigs.robot, goals, own, grids[name], match, nominal, zero.get(name)
            )
    return joints, fitted, rate


def _drive(rigs: JointRigs, values: Mapping[str, float]) -> dict[str, float]:
    """Parameters of a fitted drive that a simulation takes."""
    settable = {*rigs.parameters, "delay"} - {"offset"}
    return {name: value for name, value in values.items() if name in settable}


def _time_joint_fit(
    robot: RobotSpec,
    goals: Sequence[MeasuredJoint],
    fit: TimeFit,
    matched: ComplexArray,
    naive: ComplexArray,
    grid: GridSearch | None = None,
) -> JointFit:
    """Put the findings of one joint together that was fitted in time."""
    goal, joint = goals[0], robot.joint(goals[0].joint)
    error_db = goal.rms_db(matched[goal.fit_mask])
    return response_fit(
        robot,
        goals,
        fit.estimate,
        matched,
        naive,
        error_db=error_db,
        **_grid_fields(grid),
        total95=fit.total95,
        held_out=fit.held_out,
        amplitude_gains=fit.amplitude_gains,
        flags=(
            *held_out_flags(fit.held_out),
            *_no_match(error_db, goal),
            *_time_flags(fit),
            *fit.estimate.flags,
            *_left_out(goal, joint.band_hz),
            *goal.warnings,
        ),
    )


def _grid_fields(grid: GridSearch | None) -> dict[str, Array]:
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
    if not fit.settled:
        yield "the fit in time did not settle"
    yield from amplitude_flags(fit.amplitude_gains)


def _without_armature(
    rigs: JointRigs,
    targets: Sequence[MeasuredJoint],
    stiffness: Array,
    damping: Array,
    clock: _Clock,
) -> dict[str, tuple[float, ComplexArray]]:
    """The search without rotor inertia (F13): by joint, error [dB] and response at its best."""
    errors, requests = [], []
    groups = alike(targets, rigs.robot)
    for k, group in enumerate(groups):
        for goal, grid in zip(
            group, coarse_search(rigs, group, stiffness, damping, armature=0.0), strict=True
        ):
            errors.append(grid.error_db)
            requests.append(SimRequest(goal, *grid.gains, armature=0.0))
        clock.report((k + 1) / len(groups))
    simulated = responses(rigs, requests, whole=True)
    names = [request.target.joint for request in requests]
    return dict(zip(names, zip(errors, simulated, strict=True), strict=True))


def _joint_fit(
    robot: RobotSpec,
    goals: Sequence[MeasuredJoint],
    fits: Sequence[Fit],
    grid: GridSearch,
    matched: ComplexArray,
    naive: ComplexArray,
    zero: tuple[float, ComplexArray] | None,
) -> JointFit:
    """Put one joint's findings together; `fits` are of each amplitude."""
    goal, fit, joint = goals[0], fits[0], robot.joint(goals[0].joint)
    held = {
        "armature": joint.drive.armature,
        "frictionloss": float("nan"),
        "delay": command_delay(goal.measured, matched, joint.band_hz),
    }
    found, by_amplitude = gain_interval(goal, fit.solution, held), amplitude_gains(fits)
    zero_db, zero_response = zero or (float("nan"), None)
    return response_fit(
        robot,
        goals,
        found,
        matched,
        naive,
        error_db=fit.error_db,
        **_grid_fields(grid),
        zero_armature_error_db=zero_db,
        zero_armature=zero_response,
        amplitude_gains=by_amplitude,
        flags=(
            *_warnings(fit, grid),
            *found.flags,
            *amplitude_flags(by_amplitude),
            *_left_out(goal, joint.band_hz),
            *goal.warnings,
            *_armature_flags(fit, zero_db),
        ),
    )


def _no_match_db(goal: MeasuredJoint) -> float:
    """Error in the band above which gains are no match [dB]."""
    return max(NO_MATCH_DB, NO_MATCH_INTERVALS * goal.measurement_error_db())


def _no_match(error_db: float, goal: MeasuredJoint) -> Iterator[str]:
    """Flag gains whose response is not the measured one."""
    limit = _no_match_db(goal)
    if not error_db <= limit:
        yield (
            f"no match: the best gains miss the measured response by {error_db:.2g} dB RMS, "
            f"more than {limit:.2g} dB; the model lacks something that the robot has"
        )


def _warnings(fit: Fit, grid: GridSearch) -> Iterator[str]:
    """Flags of the optimum of the paper's search."""
    yield from _no_match(fit.error_db, fit.target)
    if grid.at_edge:
        yield (
            f"at the edge of the grid ({grid.gains[0]:.3g} N m/rad, {grid.gains[1]:.3g} N m s/rad)"
        )
    if not fit.solution.settled:
        yield "the refinement did not settle; take the gains of the grid"
    if not fit.target.trace.policy_held:
        yield "the command does not change at the policy's rate; each physics step holds its own"


def _left_out(goal: MeasuredJoint, band_hz: tuple[float, float]) -> Iterator[str]:
    """Frequencies of the band that the fit did not use."""
    whole = int(goal.measured.band(*band_hz).sum())
    if left := whole - int(goal.fit_mask.sum()):
        yield f"{left} of {whole} frequencies left out for low coherence"


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
