"""From logs to matched gains: the whole match, joint by joint."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pronk.errors import PronkError
from pronk.logs.joint_log import JointLog
from pronk.match.arm import fit_whole_arm
from pronk.match.fit import DRIVE_MODE, GAINS_MODE, checked_names
from pronk.match.grid import GridSearch, alike, axes, coarse_search, quick_search, search_all
from pronk.match.measured_joint import (
    MeasuredJoint,
    SimRequest,
    gains_on_drive,
    logs_by_joint,
    measured_joints,
    merged,
    responses,
)
from pronk.match.ranges import matched_gains
from pronk.match.response_fit import FREE, Fit, fit_drive, interval, refine, require_sweeps
from pronk.match.result import ZERO_ARMATURE, JointFit, MatchResult, amplitude_spread
from pronk.match.settings import MatchSettings
from pronk.response.response import FrequencyResponse
from pronk.robots.robot import RobotSpec
from pronk.simulators.chain import moves_together
from pronk.simulators.mujoco import mujoco_info
from pronk.simulators.simulator import JointRigs, SimulatorInfo, joint_rigs

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
Progress = Callable[[str, float], None]

NO_MATCH_DB = 1.0
"""Error in the band above which the best gains are no match [dB]: twice the 0.5 dB that a match
of a good log stays below."""
NO_MATCH_INTERVALS = 3.0
"""A noisy log may miss by more: so many half-widths of the measured gain's own interval."""
NO_ARMATURE_RATIO = 5.0
"""Error without rotor inertia, over the matched one, from which on it is no match (F13)."""
SPREAD_MAX = 0.05
"""Relative change of stiffness between amplitudes that is worth a flag; the paper's own
randomization is 2 N m/rad on 20 (D3), twice that."""


def match_logs(
    logs: Sequence[JointLog],
    robot: RobotSpec,
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
        free: Parameters to fit in mode `drive` instead, out of `FREE`.
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
    clock = _Clock(progress)
    if any(moves_together(log) for log in logs):
        if chosen.simulator != "mujoco":
            raise PronkError(
                f"simulator {chosen.simulator}: several joints of these logs move at once, which "
                "only simulator mujoco matches; record one joint at a time."
            )
        with clock.stage("fit"):
            names = GAINS_MODE if mode == "gains" else DRIVE_MODE
            joints, excluded = fit_whole_arm(
                logs, robot, names, threads=chosen.threads, progress=clock.report
            )
        return _result(logs, robot, mujoco_info(robot), joints, clock, excluded=excluded)
    # The simulator first: a device that is missing must not cost the user an estimate.
    with joint_rigs(chosen.simulator, robot, threads=chosen.threads, device=chosen.device) as rigs:
        if mode == "drive":
            joints = _drives(rigs, logs, checked_names(free or DRIVE_MODE, FREE), chosen, clock)
            return _result(logs, rigs.robot, rigs.info, joints, clock)
        joints, rate = _gains(rigs, logs, chosen, clock)
        return _result(logs, rigs.robot, rigs.info, joints, clock, rate=rate)


def _result(
    logs: Sequence[JointLog],
    robot: RobotSpec,
    info: SimulatorInfo,
    joints: Mapping[str, JointFit],
    clock: _Clock,
    *,
    rate: float = float("nan"),
    excluded: Mapping[str, str] | None = None,
) -> MatchResult:
    gains = {name: joint.gains() for name, joint in joints.items()}
    return MatchResult(
        gains=matched_gains(robot, gains, logs, info),
        joints={name: joint for name, joint in joints.items() if joint.responses},
        seconds=clock.seconds,
        grid_steps_per_second=rate,
        excluded=excluded or {},
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
        """Report the share of the stage that is done."""
        if self._progress is not None:
            self._progress(self._stage, share)


@dataclass
class _Joint:
    """One joint: what was measured and what the search found."""

    targets: list[MeasuredJoint]
    """Largest amplitude, the one that is matched, first."""
    on_drive: tuple[float, float]
    """Gains on the real drive while the log was made."""
    fits: list[Fit] = field(default_factory=list)
    """One an amplitude."""
    grid: GridSearch | None = None
    zero: GridSearch | None = None
    """The search without rotor inertia."""
    matched: ComplexArray = field(default_factory=lambda: np.empty(0, dtype=np.complex128))
    naive: ComplexArray = field(default_factory=lambda: np.empty(0, dtype=np.complex128))
    zero_response: ComplexArray | None = None


def _collect(
    logs: Sequence[JointLog], robot: RobotSpec, settings: MatchSettings, clock: _Clock
) -> dict[str, _Joint]:
    """Responses of every excited joint, in the robot's order."""
    out = {}
    with clock.stage("estimate"):
        for name, sources in (where := logs_by_joint(logs, robot)).items():
            out[name] = _Joint(
                targets=merged([measured_joints(log, name, robot, settings) for log in sources]),
                on_drive=gains_on_drive(sources[0], name, robot),
            )
            clock.report(len(out) / len(where))
    return out


def _drives(
    rigs: JointRigs,
    logs: Sequence[JointLog],
    names: tuple[str, ...],
    settings: MatchSettings,
    clock: _Clock,
) -> dict[str, JointFit]:
    """Mode drive: fit the drive of every joint, if the sweeps can separate its parameters."""
    found = _collect(logs, rigs.robot, settings, clock)
    for name, one in found.items():
        require_sweeps(rigs.robot, name, one.targets, names)
    joints = {}
    with clock.stage("fit"):
        for name, one in found.items():
            joints[name] = fit_drive(rigs, one.targets, one.on_drive, names)
            clock.report(len(joints) / len(found))
    return joints


def _gains(
    rigs: JointRigs, logs: Sequence[JointLog], settings: MatchSettings, clock: _Clock
) -> tuple[dict[str, JointFit], float]:
    """The paper's search and its refinement; physics steps per second of the grid."""
    found = _collect(logs, rigs.robot, settings, clock)
    joints = list(found.values())
    main = [one.targets[0] for one in joints]
    stiffness, damping = axes(rigs.robot, settings.grid_points)
    rate = float("nan")
    if settings.method == "quick":
        with clock.stage("quick search"):
            for one, quick in zip(
                joints, quick_search(rigs, main, stiffness, damping), strict=True
            ):
                one.grid, one.fits = quick.grid, [quick.fit]
    else:
        with clock.stage("grid"):
            begin = time.perf_counter()
            grids = search_all(rigs, main, stiffness, damping, clock.report)
            # Everything the search does counts, not the simulator alone.
            rate = rigs.count.steps / (time.perf_counter() - begin)
        with clock.stage("refine"):
            fits = refine(rigs, main, [grid.gains for grid in grids])
        for one, grid, fit in zip(joints, grids, fits, strict=True):
            one.grid, one.fits = grid, [fit]
    with clock.stage("amplitudes"):
        others = [goal for one in joints for goal in one.targets[1:]]
        best = [_pair(found[goal.joint].fits[0]) for goal in others]
        for fit in refine(rigs, others, best):
            found[fit.target.joint].fits.append(fit)
    with clock.stage("responses"):
        requests = [SimRequest(one.targets[0], *_pair(one.fits[0])) for one in joints]
        requests += [SimRequest(one.targets[0], *one.on_drive) for one in joints]
        simulated = responses(rigs, requests, whole=True)
        for k, one in enumerate(joints):
            one.matched, one.naive = simulated[k], simulated[len(joints) + k]
    if settings.zero_armature and "armature" in rigs.parameters:
        with clock.stage("zero armature"):
            _without_armature(rigs, found, stiffness, damping, clock)
    return {name: _joint_fit(rigs.robot, one) for name, one in found.items()}, rate


def _pair(fit: Fit) -> tuple[float, float]:
    return fit.stiffness, fit.damping


def _without_armature(
    simulator: JointRigs,
    found: Mapping[str, _Joint],
    stiffness: Array,
    damping: Array,
    clock: _Clock,
) -> None:
    """The search without rotor inertia (F13), and whole responses at its best nodes."""
    groups = alike([one.targets[0] for one in found.values()], simulator.robot)
    requests = []
    with simulator.without_armature() as rigs:
        for k, group in enumerate(groups):
            grids = coarse_search(rigs.rig(group[0].joint), group, stiffness, damping)
            for goal, grid in zip(group, grids, strict=True):
                found[goal.joint].zero = grid
                requests.append(SimRequest(goal, *grid.gains))
            clock.report((k + 1) / len(groups))
        for request, response in zip(requests, responses(rigs, requests, whole=True), strict=True):
            found[request.target.joint].zero_response = response


def _joint_fit(robot: RobotSpec, found: _Joint) -> JointFit:
    """Put one joint's findings together."""
    goal, fit, grid = found.targets[0], found.fits[0], found.grid
    assert grid is not None
    joint = robot.joint(goal.joint)
    uncertainty = interval(fit)
    per_amplitude = amplitude_gains(found.fits)
    zero_db = float("nan") if found.zero is None else found.zero.error_db
    band = goal.measured.band(*joint.band_hz)
    return JointFit(
        joint=goal.joint,
        responses=tuple(one.measured for one in found.targets),
        stiffness=fit.stiffness,
        damping=fit.damping,
        armature=joint.drive.armature,
        delay_s=command_delay(goal.measured, found.matched, joint.band_hz),
        ci95=uncertainty.ci95,
        covariance=uncertainty.covariance,
        band_hz=joint.band_hz,
        error_db=fit.error_db,
        naive_error_db=goal.rms_db(found.naive[goal.fit_mask]),
        coherence_min=float(goal.measured.coherence[band].min()),
        matched=found.matched,
        naive=found.naive,
        grid_stiffness=grid.stiffness,
        grid_damping=grid.damping,
        grid_error=grid.error,
        zero_armature_error_db=zero_db,
        zero_armature=found.zero_response,
        repeat_gains=uncertainty.repeat_gains,
        amplitude_gains=per_amplitude,
        flags=(
            *_warnings(fit, grid),
            *uncertainty.flags,
            *amplitude_flags(per_amplitude),
            *_left_out(goal, band),
            *goal.warnings,
            *_armature_flags(fit, zero_db),
        ),
    )


def _no_match_db(fit: Fit) -> float:
    """Error in the band above which gains are no match [dB]."""
    return max(NO_MATCH_DB, NO_MATCH_INTERVALS * fit.target.measurement_error_db())


def _warnings(fit: Fit, grid: GridSearch) -> Iterator[str]:
    """Flags of the optimum."""
    limit = _no_match_db(fit)
    if not fit.error_db <= limit:
        yield (
            f"no match: the best gains miss the measured response by {fit.error_db:.2g} dB RMS, "
            f"more than {limit:.2g} dB; the model lacks something that the robot has"
        )
    if grid.at_edge:
        yield (
            f"at the edge of the grid ({grid.gains[0]:.3g} N m/rad, {grid.gains[1]:.3g} N m s/rad)"
        )
    if not fit.solution.settled:
        yield "the refinement did not settle; take the gains of the grid"
    if not fit.target.trace.policy_held:
        yield "the command does not change at the policy's rate; each physics step holds its own"


def _left_out(goal: MeasuredJoint, band: NDArray[np.bool_]) -> Iterator[str]:
    """Frequencies of the band that the fit did not use."""
    left, whole = int(band.sum()) - int(goal.fit_mask.sum()), int(band.sum())
    if left:
        yield f"{left} of {whole} frequencies left out for low coherence"


def _armature_flags(fit: Fit, zero_db: float) -> Iterator[str]:
    """What the search without rotor inertia found (F13)."""
    if not np.isfinite(zero_db):
        return
    ratio = zero_db / max(fit.error_db, 1e-6)
    if ratio >= NO_ARMATURE_RATIO and zero_db > _no_match_db(fit):
        verdict = "no match, the best node misses"
    else:
        # A light rotor on a heavy link: other gains make up for it.
        verdict = "not ruled out by this joint, its best node misses"
    yield f"{ZERO_ARMATURE}{verdict} by {zero_db:.2g} dB RMS, {ratio:.3g} times the match"


def amplitude_gains(fits: Sequence[Fit]) -> Array:
    """(amplitude, stiffness, damping) of each amplitude fitted by itself, shape (m, 3)."""
    rows = [(fit.target.measured.amplitude, *_pair(fit)) for fit in fits]
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
