"""From logs to matched gains: the whole match, for one robot and one simulator."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

from pronk.errors import IdentifiabilityError, PronkError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match.arm import fit_together
from pronk.identify.match.checks import check_recordings, check_response
from pronk.identify.match.compared import compare
from pronk.identify.match.gains import TorqueParameter
from pronk.identify.match.magnitude import (
    fit_magnitude,
    grid_axes,
    search_grid,
    search_without_armature,
)
from pronk.identify.match.measured import (
    MeasuredJoint,
    logs_by_joint,
    measured_joints,
    simulated_response,
)
from pronk.identify.match.nominal_gains import DriveGains, gains_on_drive, with_drive_gains
from pronk.identify.match.parameters import (
    DRIVE_MODE,
    FREE,
    GAINS_MODE,
    PARAMETERS,
    checked_names,
)
from pronk.identify.match.ranges import group_gains
from pronk.identify.match.result import (
    DriveFit,
    GridSearch,
    JointResult,
    MatchResult,
    amplitude_flags,
    held_out_flags,
    joint_gains,
)
from pronk.identify.match.settings import MatchSettings
from pronk.identify.match.time_fit import fit_joint, recorded
from pronk.identify.match.torque import fit_drives, joint_fits
from pronk.identify.simulators.chain import moves_together, published
from pronk.identify.simulators.load import joint_rigs
from pronk.identify.simulators.mujoco import mujoco_info
from pronk.identify.simulators.profiles import Profile, load_profiles, profile
from pronk.identify.simulators.simulator import JointRigs, SimulatorInfo
from pronk.identify.simulators.stability import require_stable
from pronk.robots.robot import RobotSpec

Method = Literal["time", "paper"]
Mode = Literal["gains", "drive"]
Progress = Callable[[str, float], None]

NO_MATCH_DB = 1.0
"""Error in the band above which the best gains are no match [dB]: twice the 0.5 dB that a match
of a good log stays below."""
NO_MATCH_INTERVALS = 3.0
"""A noisy log may miss by more: so many half-widths of the measured gain's own interval."""
_START_S = 0.005
"""Delay from which the fit in time begins [s]: one physics step of the training simulator."""


def no_progress(stage: str, share: float) -> None:
    """Ignore the share of a stage that is done."""


def match(
    logs: Sequence[JointLog],
    robot: RobotSpec,
    simulator: str = "mujoco",
    *,
    method: Method = "time",
    mode: Mode = "gains",
    drive_gains: DriveGains | None = None,
    settings: MatchSettings | None = None,
    progress: Progress = no_progress,
) -> MatchResult:
    """Find the gains with which a simulated joint responds as the measured one.

    Joints that were excited one at a time are matched one by one. Where several joints moved at
    once, the whole leg or arm is simulated and fitted in time.

    Args:
        logs: One or more logs of one robot; a joint may be excited in several.
        robot: The robot, as of `pronk.load_robot`.
        simulator: Simulator that the gains shall hold for: `mujoco`, a profile of
            `pronk profiles` (`isaaclab-implicit`, or with a setting
            `isaaclab-implicit,timestep_s=0.0025`), `FILE.py:NAME`, or an installed simulator.
        method: `time` fits gains, dry friction and delay in time, all amplitudes together;
            `paper` compares the magnitude of the largest amplitude over a grid of gains.
        mode: `gains` finds stiffness and damping; `drive` takes the stiffness as known and fits
            damping, armature, dry friction and delay, and by a torque channel armature, friction
            and the scale of the torque.
        drive_gains: Stiffness and damping on the real drives by joint or joint group, where the
            logs do not have them; or `default`, those of the robot's file.
        settings: Settings that are rarely changed.
        progress: Called with a stage and the share of it that is done, 0 to 1.

    Returns:
        Gains of every excited joint with intervals, errors and flags, and training ranges of
        every joint group.

    Raises:
        LogError: No joint of the robot was excited, or a log cannot be used.
        IdentifiabilityError: A joint's band is mostly incoherent or too short, or the logs do not
            identify a parameter; the message says what to record.
        PronkError: A choice is not known, or the simulator cannot be used here.

    Example:
        >>> import pronk
        >>> robot = pronk.load_robot("mini_cheetah")
        >>> log = pronk.read_log("logs/FR_knee.mcap", robot=robot)
        >>> result = pronk.match([log], robot)
        >>> result.gains.joints["FR_knee"].stiffness
    """
    settings = settings or MatchSettings()
    framework = named_profile(simulator)
    check_choices(method, mode, settings, framework)
    parameters = fitted_parameters(mode, settings, framework)
    all_logs = with_drive_gains(logs, robot, drive_gains)
    excited_logs = [log for log in all_logs if log.excited_joints]
    torque_drives: Mapping[str, Mapping[str, TorqueParameter]] = {}
    torque_remarks: Mapping[str, str] = {}
    if mode == "drive":
        torque_drives, torque_remarks = fit_drives(all_logs, robot)
        if not excited_logs and (torque_drives or torque_remarks):
            return match_by_torque(robot, all_logs, torque_drives, torque_remarks)
    sources = logs_by_joint(excited_logs or all_logs, robot)
    recording_flags: dict[str, tuple[str, ...]] = {}
    for name, joint_logs in sources.items():
        recordings = [one for log in joint_logs for one in log.excitations(name)]
        recording_flags[name] = check_recordings(recordings, robot)
    seconds: dict[str, float] = {}
    joints: dict[str, JointResult] = {}

    if any(moves_together(log) for log in excited_logs):
        require_mujoco(simulator, framework)
        simulated_robot = robot if framework is None else framework.robot(robot)
        with timed("fit", seconds, progress) as report:
            chains, excluded = fit_together(
                excited_logs, simulated_robot, parameters, threads=settings.threads, progress=report
            )
        fits = {name: fit for name, (fit, _) in chains.items()}
        for name, fit in joint_fits(robot, fits, torque_drives, torque_remarks).items():
            responses = chains[name][1] if name in chains else None
            flags = (*fit.flags, *recording_flags.get(name, ()))
            joints[name] = JointResult(
                joint=name, gains=joint_gains(fit, responses, flags), fit=fit, responses=responses
            )
        info = simulator_info(mujoco_info(robot), framework, simulated_robot)
        result = match_result(robot, info, joints, all_logs, excluded=excluded, seconds=seconds)
        require_stable_gains(result, framework, simulated_robot)
        return result

    with open_rigs(simulator, robot, framework, settings) as rigs:
        measured: dict[str, list[MeasuredJoint]] = {}
        with timed("estimate", seconds, progress) as report:
            for name, joint_logs in sources.items():
                measured[name] = measured_joints(joint_logs, name, rigs.robot, settings)
                report(len(measured) / len(sources))

        searches: dict[str, GridSearch] = {}
        if method == "paper":
            with timed("grid", seconds, progress) as report:
                stiffness, damping = grid_axes(rigs.robot, settings.grid_points)
                targets = [amplitudes[0] for amplitudes in measured.values()]
                grids = search_grid(rigs, targets, stiffness, damping, progress=report)
                searches = dict(zip(measured, grids, strict=True))

        fits = {}
        with timed("fit", seconds, progress) as report:
            for name, amplitudes in measured.items():
                if method == "paper":
                    fits[name] = fit_magnitude(rigs, amplitudes, searches[name])
                else:
                    fits[name] = fit_in_time(rigs, sources[name], name, parameters, mode)
                report(len(fits) / len(measured))
        fits = joint_fits(robot, fits, torque_drives, torque_remarks)

        with timed("responses", seconds, progress) as report:
            for name, fit in fits.items():
                if name not in measured:
                    gains = joint_gains(fit, None, fit.flags)
                    joints[name] = JointResult(joint=name, gains=gains, fit=fit)
                    continue
                target = measured[name][0]
                responses = compare(
                    rigs.robot,
                    measured[name],
                    matched=simulated_response(rigs, target, compared_values(fit, method)),
                    nominal=simulated_response(
                        rigs, target, nominal_drive(sources[name][0], name, rigs.robot)
                    ),
                )
                zero_armature = None
                if method == "paper" and settings.zero_armature and "armature" in rigs.parameters:
                    zero_armature = search_without_armature(
                        rigs, target, responses.error_db, no_match_db(target)
                    )
                flags = (
                    *fit.flags,
                    *check_response(
                        target.measured, responses.matched, target.fit_mask, no_match_db(target)
                    ),
                    *unused_flags(target, robot),
                    *recording_flags[name],
                )
                joints[name] = JointResult(
                    joint=name,
                    gains=joint_gains(fit, responses, flags),
                    fit=fit,
                    responses=responses,
                    grid=searches.get(name),
                    zero_armature=zero_armature,
                )
                report(len(joints) / len(fits))
    info = simulator_info(rigs.info, framework, rigs.robot)
    result = match_result(robot, info, joints, all_logs, seconds=seconds)
    require_stable_gains(result, framework, rigs.robot)
    return result


def named_profile(simulator: str) -> Profile | None:
    """Return the profile that a simulator's name names, or None if it names none."""
    if simulator.split(",")[0] in load_profiles():
        return profile(simulator)
    return None


def check_choices(
    method: str, mode: str, settings: MatchSettings, framework: Profile | None
) -> None:
    """Refuse choices that are not known or do not go together.

    Raises:
        PronkError: The message names the choice, what was expected, and the way out.
    """
    if method not in get_args(Method):
        raise PronkError(f"method {method!r}; expected {' or '.join(get_args(Method))}.")
    if mode not in get_args(Mode):
        raise PronkError(f"mode {mode!r}; expected {' or '.join(get_args(Mode))}.")
    if mode == "drive" and method == "paper":
        raise PronkError(
            "method paper in mode drive; magnitudes alone do not identify a drive, so leave the "
            "method out, or match in mode gains."
        )
    if settings.fitted and mode != "drive":
        raise PronkError("parameters to fit can be named in mode drive only.")
    if framework is not None and mode == "drive":
        raise PronkError(
            f"profile {framework.name} in mode drive; a profile is matched in mode gains."
        )


def fitted_parameters(
    mode: Mode, settings: MatchSettings, framework: Profile | None
) -> tuple[str, ...]:
    """Return the names of the parameters that a fit in time searches."""
    if settings.fitted:
        return checked_names(settings.fitted, FREE)
    if mode == "drive":
        return DRIVE_MODE
    if framework is not None and framework.friction != "N m":
        # The framework has no dry friction in newton metres that could be fitted.
        return tuple(name for name in GAINS_MODE if name != "frictionloss")
    return GAINS_MODE


def require_mujoco(simulator: str, framework: Profile | None) -> None:
    """Refuse another simulator than MuJoCo where several joints moved at once.

    Raises:
        PronkError: The simulator is neither MuJoCo nor a profile, which MuJoCo computes.
    """
    if framework is None and simulator != "mujoco":
        raise PronkError(
            f"simulator {simulator}: several joints of these logs move at once, which only "
            "simulator mujoco matches; record one joint at a time."
        )


def open_rigs(
    simulator: str, robot: RobotSpec, framework: Profile | None, settings: MatchSettings
) -> JointRigs:
    """Open the joints of a robot in a simulator, or as a framework simulates them."""
    if framework is not None:
        return joint_rigs("mujoco", framework.robot(robot), threads=settings.threads)
    return joint_rigs(simulator, robot, threads=settings.threads, python=settings.simulator_python)


def simulator_info(
    info: SimulatorInfo, framework: Profile | None, robot: RobotSpec
) -> SimulatorInfo:
    """Describe the simulator that the gains hold for: that of the framework, if there is one."""
    if framework is None:
        return info
    return replace(framework.info, decimation=robot.decimation)


@dataclass(frozen=True, kw_only=True)
class MatchedDrive:
    """Drive of one matched joint, for the stability limit of a framework."""

    joints: tuple[str, ...]
    """Name of the joint."""
    stiffness: float
    """[N m/rad]"""
    damping: float
    """[N m s/rad]"""
    armature: float
    """Rotor inertia at the joint [kg m^2]."""


def require_stable_gains(result: MatchResult, framework: Profile | None, robot: RobotSpec) -> None:
    """Refuse gains that are not stable at the step of a framework.

    Raises:
        PronkError: The message names a smaller step.
    """
    if framework is None:
        return
    drives = []
    for name, joint in result.joints.items():
        drives.append(
            MatchedDrive(
                joints=(name,),
                stiffness=joint.gains.stiffness.value,
                damping=joint.gains.damping.value,
                armature=joint.gains.armature.value,
            )
        )
    require_stable(framework, robot, drives)


@contextmanager
def timed(
    stage: str, seconds: dict[str, float], progress: Progress
) -> Iterator[Callable[[float], None]]:
    """Time a stage and report its begin and its end; yield what reports the share that is done."""

    def report(share: float) -> None:
        progress(stage, share)

    report(0.0)
    begin = time.perf_counter()
    yield report
    seconds[stage] = time.perf_counter() - begin
    report(1.0)


def nominal_drive(log: JointLog, joint_name: str, robot: RobotSpec) -> dict[str, float]:
    """Return the drive as published, with the gains that were on it while a log was recorded."""
    drive = published(robot, joint_name)
    drive["stiffness"], drive["damping"] = gains_on_drive(log, joint_name, robot)
    return drive


def fit_in_time(
    rigs: JointRigs,
    logs: Sequence[JointLog],
    joint_name: str,
    parameters: Sequence[str],
    mode: Mode,
) -> DriveFit:
    """Fit the drive of one joint in time.

    Args:
        rigs: Joints in the simulator.
        logs: Logs that excite the joint.
        joint_name: The joint.
        parameters: Names of the parameters to fit.
        mode: In mode `drive` a parameter that is not identified is an error, else it is flagged.

    Raises:
        IdentifiabilityError: The logs do not identify a parameter, in mode `drive`.
    """
    nominal = nominal_drive(logs[0], joint_name, rigs.robot)
    start = nominal | {"delay": _START_S}
    fit = fit_joint(rigs, recorded(logs, joint_name, rigs.robot), parameters, start, nominal)
    values = fit.estimate.values
    flags = [*held_out_flags(fit.held_out)]
    for name in fit.at_bound:
        if name not in ("delay", "frictionloss"):  # none is a possible result
            unit = PARAMETERS[name].unit
            flags.append(f"{name} at the bound of the search, {values[name]:.3g} {unit}")
    for name in fit.estimate.unidentified:
        deviation = fit.estimate.sd[name]
        remedy = PARAMETERS[name].remedy
        if mode == "drive":
            raise IdentifiabilityError(
                f"{joint_name}: these logs do not identify the {name} (deviation "
                f"{deviation:.2g}); {remedy}; or hold it at a known value."
            )
        if name not in fit.at_bound:
            flags.append(f"{name} is not identified (deviation {deviation:.2g}); {remedy}")
    if not fit.solution.settled:
        flags.append("the fit in time did not settle")
    flags.extend(amplitude_flags(fit.amplitude_gains))
    flags.extend(fit.estimate.flags)
    return DriveFit(
        joint=joint_name,
        values=values,
        sd=fit.estimate.sd,
        ci95=fit.estimate.ci95,
        total95=fit.total95,
        covariance=fit.estimate.covariance,
        at_bound=fit.at_bound,
        held_out=fit.held_out,
        amplitude_gains=fit.amplitude_gains,
        settled=fit.solution.settled,
        flags=tuple(flags),
    )


def compared_values(fit: DriveFit, method: Method) -> Mapping[str, float]:
    """Return the parameters whose simulated response is compared with the measured one.

    Method `paper` compares magnitudes with the drive's own friction and without a delay (F9).
    """
    if method == "paper":
        return {"stiffness": fit.values["stiffness"], "damping": fit.values["damping"]}
    return fit.values


def no_match_db(target: MeasuredJoint) -> float:
    """Return the error in the band above which gains are no match [dB]."""
    return max(NO_MATCH_DB, NO_MATCH_INTERVALS * target.measurement_error_db())


def unused_flags(target: MeasuredJoint, robot: RobotSpec) -> list[str]:
    """Say which frequencies and amplitudes of a measured response were left out."""
    flags = []
    band_count = int(target.measured.band(*robot.joint(target.joint).band_hz).sum())
    incoherent_count = band_count - int(target.fit_mask.sum())
    if incoherent_count > 0:
        flags.append(f"{incoherent_count} of {band_count} frequencies left out for low coherence")
    flags.extend(target.warnings)
    return flags


def match_by_torque(
    robot: RobotSpec,
    logs: Sequence[JointLog],
    drives: Mapping[str, Mapping[str, TorqueParameter]],
    remarks: Mapping[str, str],
) -> MatchResult:
    """Return the result of logs that excite no joint by a commanded position.

    Raises:
        IdentifiabilityError: The torques identify no drive.
    """
    joints = {}
    for name, fit in joint_fits(robot, {}, drives, remarks).items():
        gains = joint_gains(fit, None, fit.flags)
        joints[name] = JointResult(joint=name, gains=gains, fit=fit)
    if not joints:
        reasons = "; ".join(dict.fromkeys(remarks.values()))
        raise IdentifiabilityError(
            f"{len(logs)} logs excite no joint by a commanded position and identify no drive "
            f"by torque: {reasons or 'record larger or faster motions'}."
        )
    return match_result(robot, mujoco_info(robot), joints, logs)


def match_result(
    robot: RobotSpec,
    simulator: SimulatorInfo,
    joints: Mapping[str, JointResult],
    logs: Sequence[JointLog],
    *,
    excluded: Mapping[str, str] | None = None,
    seconds: Mapping[str, float] | None = None,
) -> MatchResult:
    """Put the results of all joints together, with the training ranges of their groups."""
    gains = {name: joint.gains for name, joint in joints.items()}
    return MatchResult(
        robot=robot.name,
        simulator=simulator,
        joints=joints,
        groups=group_gains(robot, gains),
        logs={Path(log.source or "log").name: log.origin.sha256 for log in logs},
        virtual=any(log.virtual for log in logs),
        excluded=excluded or {},
        seconds=seconds or {},
    )
