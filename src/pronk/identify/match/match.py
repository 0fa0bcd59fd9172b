"""From logs to matched gains: the whole match, for one robot and one simulator."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

from pronk.errors import IdentifiabilityError, PronkError
from pronk.identify.logs.joint_log import Excitation, JointLog
from pronk.identify.match.checks import check_recordings, check_response
from pronk.identify.match.compared import ComparedResponses, compare, compare_recordings
from pronk.identify.match.drive_fit import fit_drives, nominal_drives
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
from pronk.identify.match.nominal_gains import DriveGains, with_drive_gains
from pronk.identify.match.parameters import DRIVE_MODE, FREE, GAINS_MODE, checked_names
from pronk.identify.match.ranges import group_gains
from pronk.identify.match.replay import ChainReplay, JointReplay
from pronk.identify.match.result import (
    DriveFit,
    GridSearch,
    JointResult,
    MatchResult,
    joint_gains,
)
from pronk.identify.match.settings import MatchSettings
from pronk.identify.match.torque_fit import fit_torque_drives, with_torque
from pronk.identify.simulators.chain import ChainSimulation, branches, moves_together
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
    torque_fits: dict[str, DriveFit] = {}
    if mode == "drive":
        torque_fits = fit_torque_drives(all_logs, robot)
        if torque_fits and not excited_logs:
            return match_by_torque(robot, all_logs, torque_fits)
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
            chains = fit_chains(excited_logs, simulated_robot, parameters, settings, report)
        for name, fit in with_torque(chains.fits, torque_fits, robot).items():
            responses = chains.responses.get(name)
            flags = (*fit.flags, *recording_flags.get(name, ()))
            joints[name] = JointResult(
                joint=name, gains=joint_gains(fit, responses, flags), fit=fit, responses=responses
            )
        info = simulator_info(mujoco_info(robot), framework, simulated_robot)
        result = match_result(
            robot, info, joints, all_logs, excluded=chains.excluded, seconds=seconds
        )
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
        fits = with_torque(fits, torque_fits, robot)

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
                        rigs, target, nominal_drives(sources[name], [name], rigs.robot)[name]
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


def fit_in_time(
    rigs: JointRigs,
    logs: Sequence[JointLog],
    joint_name: str,
    parameters: Sequence[str],
    mode: Mode,
) -> DriveFit:
    """Fit the drive of one joint that moved alone.

    Args:
        rigs: Joints in the simulator.
        logs: Logs that excite the joint.
        joint_name: The joint.
        parameters: Names of the parameters to fit.
        mode: In mode `drive` a parameter that is not identified is an error, else it is flagged.

    Raises:
        IdentifiabilityError: The logs do not identify a parameter, in mode `drive`.
    """
    excitations: list[Excitation] = []
    for log in logs:
        excitations += log.excitations(joint_name)
    fits = fit_drives(
        JointReplay(rigs, excitations),
        parameters=parameters,
        nominal=nominal_drives(logs, [joint_name], rigs.robot),
        unidentified="refuse" if mode == "drive" else "flag",
    )
    return fits[joint_name]


@dataclass(frozen=True, kw_only=True)
class ChainFits:
    """Drives of legs or arms whose joints moved together."""

    fits: Mapping[str, DriveFit]
    """Drive of each joint."""
    responses: Mapping[str, ComparedResponses]
    """Responses of each joint of which a recording gives one."""
    excluded: Mapping[str, str]
    """Reason why a joint that moved was not fitted, by joint."""


def fit_chains(
    logs: Sequence[JointLog],
    robot: RobotSpec,
    parameters: Sequence[str],
    settings: MatchSettings,
    report: Callable[[float], None],
) -> ChainFits:
    """Fit the drives of every chain that moves in some logs, one chain after the other.

    With a fixed base chains (legs) do not move each other.

    Args:
        logs: Logs in which several joints move at once.
        robot: The robot as it is simulated.
        parameters: Names of the parameters to fit; those of a joint that the logs do not identify
            are held at the nominal value.
        settings: Threads of the simulator.
        report: Called with the share that is done.

    Raises:
        IdentifiabilityError: The logs identify too few parameters of a joint.
    """
    fits: dict[str, DriveFit] = {}
    responses: dict[str, ComparedResponses] = {}
    excluded: dict[str, str] = {}
    chains = branches(logs, robot)
    for number, joints in enumerate(chains):

        def report_chain(share: float, number: int = number) -> None:
            report((number + share) / len(chains))

        with ChainSimulation(robot, logs, joints=joints, threads=settings.threads) as simulation:
            replay = ChainReplay(simulation)
            nominal = nominal_drives(simulation.logs, simulation.joints, robot)
            chain_fits = fit_drives(
                replay,
                parameters=parameters,
                nominal=nominal,
                unidentified="hold",
                progress=report_chain,
            )
            matched = {name: fit.values for name, fit in chain_fits.items()}
            matched_positions, nominal_positions = simulation.run([matched, nominal])
            for column, name in enumerate(simulation.joints):
                compared = compare_recordings(
                    robot,
                    name,
                    simulation.logs,
                    matched=[positions[:, column] for positions in matched_positions],
                    nominal=[positions[:, column] for positions in nominal_positions],
                    highest_hz=replay.trusted_hz[name],
                )
                if compared is not None:
                    responses[name] = compared
            fits.update(chain_fits)
            excluded.update(simulation.excluded)
    return ChainFits(fits=fits, responses=responses, excluded=excluded)


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
    robot: RobotSpec, logs: Sequence[JointLog], torque_fits: Mapping[str, DriveFit]
) -> MatchResult:
    """Return the result of logs that excite no joint by a commanded position.

    Raises:
        IdentifiabilityError: The torques identify no drive.
    """
    joints = {}
    for name, fit in with_torque({}, torque_fits, robot).items():
        gains = joint_gains(fit, None, fit.flags)
        joints[name] = JointResult(joint=name, gains=gains, fit=fit)
    if not joints:
        reasons: dict[str, None] = {}
        for fit in torque_fits.values():
            reasons.update(dict.fromkeys(fit.flags))
        raise IdentifiabilityError(
            f"{len(logs)} logs excite no joint by a commanded position and identify no drive "
            f"by torque: {'; '.join(reasons) or 'record larger or faster motions'}."
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
