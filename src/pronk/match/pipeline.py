"""From logs to matched gains: the whole match, joint by joint."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pronk.errors import PronkError
from pronk.logs.joint_log import JointLog
from pronk.match.arm import match_arm
from pronk.match.diagnostics import (
    amplitude_flags,
    amplitude_gains,
    armature_flags,
    command_delay,
    missing,
    warnings,
)
from pronk.match.drive import match_drives
from pronk.match.grid import GridSearch, alike, axes, coarse_search, search_all
from pronk.match.measured_joint import (
    MeasuredJoint,
    SimRequest,
    gains_on_drive,
    logs_by_joint,
    measured_joints,
    merged,
    responses,
)
from pronk.match.parameters import DRIVE_MODE
from pronk.match.quick import quick_search
from pronk.match.ranges import matched_gains
from pronk.match.refine import Fit, refine
from pronk.match.result import JointFit, MatchResult
from pronk.match.settings import MatchSettings
from pronk.match.uncertainty import interval
from pronk.robots.robot import Robot
from pronk.simulators.chain import moves_together
from pronk.simulators.simulator import JointRigs, joint_rigs

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]


@dataclass
class _Measured:
    """One joint and all that was measured of it."""

    targets: list[MeasuredJoint]
    naive: tuple[float, float]
    """Gains on the real drive while the log was made."""

    @property
    def main(self) -> MeasuredJoint:
        """The response that is matched: that of the largest amplitude."""
        return self.targets[0]


@dataclass
class _Found:
    """What the search brought for one joint."""

    grid: GridSearch
    fit: Fit
    others: list[Fit] = field(default_factory=list)
    """Fits of the smaller amplitudes."""
    zero: GridSearch | None = None


def match_logs(
    logs: Sequence[JointLog],
    robot: Robot,
    *,
    mode: Literal["gains", "drive"] = "gains",
    free: Sequence[str] = (),
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
            known and fits damping, armature, dry friction and delay.
        free: Parameters to fit in mode `drive` instead.
        settings: How to match; the paper's search if not given.
        progress: Called with the stage and the share of it that is done, 0 to 1.

    Raises:
        LogError: No joint of the robot was excited, or a log cannot be used.
        IdentifiabilityError: A joint's band is mostly incoherent or too short, or a parameter
            cannot be identified.
        PronkError: The device or simulator of the settings cannot be used here.
    """
    chosen = settings or MatchSettings()
    if mode not in ("gains", "drive"):
        raise PronkError(f"mode {mode!r}; expected gains or drive.")
    if free and mode != "drive":
        raise PronkError("parameters to fit can be named in mode drive only.")
    if any(moves_together(log) for log in logs):
        if chosen.simulator != "mujoco":
            raise PronkError(
                f"simulator {chosen.simulator}: several joints of these logs move at once, which "
                "only simulator mujoco matches; record one joint at a time."
            )
        return match_arm(logs, robot, mode=mode, threads=chosen.threads, progress=progress)
    if mode == "drive":
        return match_drives(
            logs, robot, free=free or DRIVE_MODE, settings=chosen, progress=progress
        )
    return _match_gains(logs, robot, chosen, progress)


def _match_gains(
    logs: Sequence[JointLog], robot: Robot, chosen: MatchSettings, progress: Progress | None
) -> MatchResult:
    """The paper's search, its refinement and intervals, joint by joint."""
    clock = _Clock(progress)
    # The simulator first: a device that is missing must not cost the user an estimate.
    with joint_rigs(
        chosen.simulator, robot, threads=chosen.threads, device=chosen.device
    ) as simulator:
        robot = simulator.robot
        with clock.stage("estimate"):
            excited = _collect(logs, robot, chosen, clock)
        found, rate = _search(simulator, excited, chosen, clock)
        with clock.stage("amplitudes"):
            _fit_amplitudes(simulator, excited, found, chosen)
        with clock.stage("responses"):
            matched, naive = _final_responses(simulator, excited, found)
        zero: dict[str, NDArray[np.complex128]] = {}
        if chosen.zero_armature and "armature" in simulator.parameters:
            with clock.stage("zero armature"):
                zero = _without_armature(simulator, excited, found, chosen, clock)
    joints = {
        name: _joint_fit(
            robot, item, found[name], matched[name], naive[name], zero.get(name), chosen
        )
        for name, item in excited.items()
    }
    gains = {name: joint.gains() for name, joint in joints.items()}
    return MatchResult(
        gains=matched_gains(robot, gains, logs, simulator.info),
        joints=joints,
        seconds=clock.seconds,
        grid_steps_per_second=rate,
    )


class _Clock:
    """Wall time of each stage, and reports of progress."""

    def __init__(self, progress: Progress | None) -> None:
        self.seconds: dict[str, float] = {}
        self._progress = progress
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
        """Share of the stage that is done."""
        if self._progress is not None:
            self._progress(self._stage, share)


def _collect(
    logs: Sequence[JointLog], robot: Robot, settings: MatchSettings, clock: _Clock
) -> dict[str, _Measured]:
    """Responses of every joint excited, in the robot's order."""
    where = logs_by_joint(logs, robot)
    excited: dict[str, _Measured] = {}
    for i, (name, sources) in enumerate(where.items()):
        excited[name] = _Measured(
            targets=merged([measured_joints(log, name, robot, settings) for log in sources]),
            naive=gains_on_drive(sources[0], name, robot),
        )
        clock.report((i + 1) / len(where))
    return excited


def _search(
    simulator: JointRigs, excited: dict[str, _Measured], settings: MatchSettings, clock: _Clock
) -> tuple[dict[str, _Found], float]:
    """Best node and optimum off the grid of every joint; physics steps per second of the grid."""
    main = [item.main for item in excited.values()]
    stiffness, damping = axes(simulator.robot, settings.grid_points)
    if settings.method == "quick":
        with clock.stage("quick search"):
            quick = quick_search(
                simulator,
                main,
                stiffness,
                damping,
                weighting=settings.grid_weighting,
                use_phase=settings.use_phase,
            )
        return {
            goal.joint: _Found(grid=one.grid, fit=one.fit)
            for goal, one in zip(main, quick, strict=True)
        }, float("nan")
    with clock.stage("grid"):
        begin = time.perf_counter()
        grids = search_all(
            simulator, main, stiffness, damping, settings.grid_weighting, clock.report
        )
        # Everything the search does counts, not the simulator alone.
        rate = simulator.count.steps / (time.perf_counter() - begin)
    with clock.stage("refine"):
        fits = refine(
            simulator,
            main,
            [grid.gains for grid in grids],
            use_phase=settings.use_phase,
        )
    return {
        goal.joint: _Found(grid=grid, fit=fit)
        for goal, grid, fit in zip(main, grids, fits, strict=True)
    }, rate


def _fit_amplitudes(
    simulator: JointRigs,
    excited: dict[str, _Measured],
    found: dict[str, _Found],
    settings: MatchSettings,
) -> None:
    """Fit the smaller amplitudes, each by itself."""
    others = [goal for item in excited.values() for goal in item.targets[1:]]
    start = [(found[goal.joint].fit.stiffness, found[goal.joint].fit.damping) for goal in others]
    for fit in refine(simulator, others, start, use_phase=settings.use_phase):
        found[fit.target.joint].others.append(fit)


def _final_responses(
    simulator: JointRigs, excited: dict[str, _Measured], found: dict[str, _Found]
) -> tuple[dict[str, NDArray[np.complex128]], dict[str, NDArray[np.complex128]]]:
    """Whole responses with the matched and with the naive gains."""
    main = [item.main for item in excited.values()]
    requests = [
        SimRequest(goal, found[goal.joint].fit.stiffness, found[goal.joint].fit.damping)
        for goal in main
    ]
    requests += [SimRequest(item.main, *item.naive) for item in excited.values()]
    simulated = responses(simulator, requests, whole=True)
    names = list(excited)
    return (
        dict(zip(names, simulated[: len(names)], strict=True)),
        dict(zip(names, simulated[len(names) :], strict=True)),
    )


def _without_armature(
    simulator: JointRigs,
    excited: dict[str, _Measured],
    found: dict[str, _Found],
    settings: MatchSettings,
    clock: _Clock,
) -> dict[str, NDArray[np.complex128]]:
    """The search without rotor inertia (F13); whole responses at its best nodes."""
    stiffness, damping = axes(simulator.robot, settings.grid_points)
    groups = alike([item.main for item in excited.values()], simulator.robot)
    requests = []
    with simulator.without_armature() as rigs:
        for k, group in enumerate(groups):
            rig = rigs.rig(group[0].joint)
            for goal, grid in zip(
                group,
                coarse_search(rig, group, stiffness, damping, settings.grid_weighting),
                strict=True,
            ):
                found[goal.joint].zero = grid
                requests.append(SimRequest(goal, *grid.gains))
            clock.report((k + 1) / len(groups))
        simulated = responses(rigs, requests, whole=True)
    return {
        request.target.joint: response
        for request, response in zip(requests, simulated, strict=True)
    }


def _joint_fit(
    robot: Robot,
    item: _Measured,
    found: _Found,
    matched: NDArray[np.complex128],
    naive: NDArray[np.complex128],
    zero: NDArray[np.complex128] | None,
    settings: MatchSettings,
) -> JointFit:
    """Put one joint's findings together."""
    goal, fit, grid = item.main, found.fit, found.grid
    joint = robot.joint(goal.joint)
    bounds = interval(fit, level=settings.level, method=settings.interval)
    per_amplitude = amplitude_gains([fit, *found.others])
    naive_db = float(np.sqrt(np.mean(goal.error_db(naive[goal.fit_mask]) ** 2)))
    zero_db = float("nan") if found.zero is None else found.zero.error_db
    band = goal.measured.band(*joint.band_hz)
    return JointFit(
        joint=goal.joint,
        responses=tuple(one.measured for one in item.targets),
        stiffness=fit.stiffness,
        damping=fit.damping,
        armature=joint.drive.armature,
        delay_s=command_delay(goal.measured, matched, joint.band_hz),
        ci95={
            "stiffness": bounds.around(fit.stiffness, 0),
            "damping": bounds.around(fit.damping, 1),
        },
        covariance=bounds.covariance,
        band_hz=joint.band_hz,
        error_db=fit.error_db,
        naive_error_db=naive_db,
        coherence_min=float(goal.measured.coherence[band].min()),
        matched=matched,
        naive=naive,
        grid_stiffness=grid.stiffness,
        grid_damping=grid.damping,
        grid_error=grid.error,
        zero_armature_error_db=zero_db,
        zero_armature=zero,
        repeat_gains=bounds.repeat_gains,
        amplitude_gains=per_amplitude,
        flags=(
            *warnings(goal, fit, grid, settings),
            *bounds.flags,
            *amplitude_flags(per_amplitude),
            *missing(goal, band),
            *goal.warnings,
            *armature_flags(fit, zero_db, settings),
        ),
    )
