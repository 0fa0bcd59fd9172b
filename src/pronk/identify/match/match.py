"""From logs to matched gains: the whole match, for one robot and one simulator."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from pronk.arrays import Array
from pronk.errors import IdentifiabilityError, PronkError
from pronk.identify.logs.checks import unwrapped
from pronk.identify.logs.joint_log import Excitation, JointLog
from pronk.identify.match.checks import (
    EFFORT_LIMIT,
    SLOW_GAIN,
    check_armature,
    check_excitations,
    check_explained_motion,
    check_mean_position,
    check_response,
    unexplained_motion,
)
from pronk.identify.match.compared import (
    COHERENCE_MIN,
    ComparedResponses,
    compare,
    compare_recordings,
)
from pronk.identify.match.compliance import JointDynamics, find_compliance
from pronk.identify.match.drive_fit import fit_drives, nominal_drives
from pronk.identify.match.gains import FittedValue
from pronk.identify.match.magnitude import (
    fit_magnitude,
    grid_axes,
    search_grid,
    search_without_armature,
)
from pronk.identify.match.measured import (
    DB,
    MeasuredJoint,
    logs_by_joint,
    measured_joints,
    rms,
    simulated_response,
)
from pronk.identify.match.nominal_gains import (
    DriveGains,
    Pair,
    assumed_held_gains,
    robot_as_recorded,
    with_drive_gains,
)
from pronk.identify.match.notes import match_notes
from pronk.identify.match.parameters import (
    DRIVE_MODE,
    FREE,
    GAINS_MODE,
    PARAMETERS,
    WITHOUT_FRICTION,
    checked_names,
)
from pronk.identify.match.physical import physical_drives
from pronk.identify.match.ranges import group_gains
from pronk.identify.match.replay import ChainReplay, JointReplay
from pronk.identify.match.result import (
    NO_MATCH,
    DriveFit,
    GridSearch,
    JointResult,
    MatchResult,
    joint_gains,
)
from pronk.identify.match.settings import MatchSettings
from pronk.identify.match.simulation import Simulation, find_simulation
from pronk.identify.match.torque_column import check_torque_scale
from pronk.identify.match.torque_fit import fit_torque_drives, left_out_by_torque, with_torque
from pronk.identify.match.torque_limit import (
    MISFIT,
    effort_limit_reached,
    fit_flat_limit,
    fit_torque_limit,
    may_be_limited,
    stated_limit_flag,
    with_flat_limits,
)
from pronk.identify.match.uncertainty import widen_by_step
from pronk.identify.response.response import ShortExcitationError
from pronk.identify.simulators.chain import ChainSimulation, branches, moves_together
from pronk.identify.simulators.info import SimulatorInfo
from pronk.identify.simulators.simulator import JointRigs
from pronk.identify.simulators.stability import joint_stability_share
from pronk.progress import Progress, no_progress
from pronk.robots import ROBOT_NAMES
from pronk.robots.menagerie import MENAGERIE
from pronk.robots.model import bench_inertia
from pronk.robots.robot import RobotSpec

Method = Literal["time", "paper"]
Mode = Literal["gains", "drive"]

NO_MATCH_DB = 1.0
"""Error in the band above which the best gains are no match [dB]: twice the 0.5 dB that a match
of a good log stays below."""
LEFT_OUT = 0.25
"""Share of the frequencies of the band left out for low coherence that is worth a flag: the lowest
ones of a chirp of 20 s and those above three times the resonance are incoherent on good logs too.
`MatchQuality.coherence_min` has the lowest coherence."""
LIMITED_FACTOR = 3.0
"""What the step leaves open of gains that were fitted with the torque limit, over what it leaves
open of others: a limited joint shows its gains between two limits alone. Measured on 12 joints of
`tests/joint_mechanisms.py` (saturation, limit wrong, seed 5)."""
NEAR_LIMIT = 0.5
"""Share of the limit of stability from which on a search may have ended at it: finite differences
and longer steps of the search diverge well below."""
OPEN_STEP = 1.7
"""`damping timestep / (2 inertia)` from which on the step leaves gains open by a factor of two or
more (`uncertainty.STEP_SHARE`). Explicit drives are not stable from 1 on."""
NO_MATCH_INTERVALS = 3.0
"""A noisy log may miss by more: so many half-widths of the measured gain's own interval."""


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
    once, the whole leg or arm is simulated and fitted in time; `match_chains` says what differs.

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

    Examples:
        >>> import pronk
        >>> robot = pronk.load_robot("mini_cheetah")
        >>> log = pronk.read_log("logs/FR_knee.mcap", robot=robot)
        >>> result = pronk.match([log], robot)
        >>> result.gains.joints["FR_knee"].stiffness
    """
    settings = settings or MatchSettings()
    robot = robot_as_recorded(robot, drive_gains, logs)
    simulation = find_simulation(simulator, robot)
    check_choices(method, mode, settings, simulation)
    parameters = fitted_parameters(mode, settings, simulation)
    recorded_logs = logs
    logs = with_drive_gains([unwrapped(log) for log in logs], robot, drive_gains)
    torque_fits = fit_torque_drives(logs, robot) if mode == "drive" else {}
    excited_logs = [log for log in logs if log.excited_joints]
    if torque_fits and not excited_logs:
        return match_by_torque(logs, simulation, torque_fits)
    if any(moves_together(log) for log in excited_logs):
        if method == "paper":
            raise PronkError(
                "method paper with logs in which several joints move at once; the paper's method "
                "compares magnitudes of one joint at a time: leave the method out, and the leg or "
                "arm is fitted in time."
            )
        return match_chains(logs, simulation, parameters, torque_fits, settings, progress)

    with simulation.open_rigs(settings.threads, settings.simulator_python) as rigs:
        sources = logs_by_joint(excited_logs or logs, robot)
        excitation_flags = {}
        measured = {}
        nominal: dict[str, dict[str, float]] = {}
        for name, joint_logs in sources.items():
            excitations = excitations_of(joint_logs, name)
            excitation_flags[name] = (
                *check_armature(robot.joint(name), parameters, excitations),
                *assumed_held_gains(robot, name, recorded_logs),
                *check_excitations(excitations, robot),
            )
            try:
                measured[name] = measured_joints(joint_logs, name, rigs.robot, settings)
            except ShortExcitationError as error:
                # The fit in time needs no response, and mode paper nothing else.
                if method == "paper" or settings.estimator.segment_s is not None:
                    raise
                measured[name] = []
                excitation_flags[name] = (*excitation_flags[name], f"no response: {error}")
            nominal |= nominal_drives(joint_logs, [name], rigs.robot)
            progress("estimate", len(measured) / len(sources))

        grids: dict[str, GridSearch] = {}
        if method == "paper":
            grids = search_grids(rigs, measured, settings.grid_points, progress)

        fits: dict[str, DriveFit] = {}
        physical: dict[str, dict[str, FittedValue]] = {}
        for name, responses in measured.items():
            if method == "paper":
                fits[name] = fit_magnitude(rigs, responses, grids[name])
            else:
                excitations = excitations_of(sources[name], name)
                replay = JointReplay(rigs, excitations)
                try:
                    fit = fit_drives(
                        replay,
                        parameters=parameters,
                        nominal={name: nominal[name]},
                        unidentified="refuse" if mode == "drive" else "flag",
                    )[name]
                except IdentifiabilityError as error:
                    raise IdentifiabilityError(
                        f"{error}{wrong_stiffness(replay, parameters, nominal[name])}"
                    ) from error
                is_stable = not simulation.uses_mujoco or (
                    joint_stability_share(rigs.robot, name, nominal[name]) < 1.0
                )
                is_amplified = any(flag.startswith(SLOW_GAIN) for flag in excitation_flags[name])
                # A limit holds an unstable simulation back, and would be taken for a cause. It does
                # not let a joint move farther than commanded either.
                if rigs.sets_effort_limit and is_stable and not is_amplified:
                    fit = fit_torque_limit(
                        replay, excitations, rigs.robot, fit, parameters, nominal[name]
                    )
                if simulation.uses_mujoco and is_stable:
                    fit = without_speed_line(
                        fit, simulation, settings, excitations, parameters, nominal[name]
                    )
                if mode == "drive" and simulation.name == "mujoco":
                    widened_fits, drive_values = physical_drives(
                        replay, {name: fit}, rigs.robot, settings.gain_uncertainty
                    )
                    fit = widened_fits[name]
                    physical |= drive_values
                fits[name] = with_step_uncertainty(fit, rigs.robot)
                if simulation.uses_mujoco:
                    excitation_flags[name] = (
                        *stability_flags(fit, rigs.robot, nominal[name]),
                        *excitation_flags[name],
                    )
            progress("fit", len(fits) / len(measured))

        joints: dict[str, JointResult] = {}
        for name, fit in with_torque(fits, torque_fits, robot).items():
            if name in measured:
                reached = effort_limit_reached(excitations_of(sources[name], name), robot, fit)
                excitation_flags[name] = with_limit_flag(excitation_flags[name], reached)
                excitation_flags[name] = (
                    *excitation_flags[name],
                    *check_torque_scale(excitations_of(sources[name], name), fit),
                )
            if not measured.get(name):
                flags = excitation_flags.get(name, ())
                if name in measured:
                    replay = JointReplay(rigs, excitations_of(sources[name], name))
                    (simulated,) = replay.positions([{name: fit.values}])
                    recorded = [recording.position for recording in replay.recordings]
                    flags = (*check_explained_motion(recorded, simulated), *flags)
                gains = joint_gains(fit, robot, flags=flags)
                gains = replace(gains, physical=physical.get(name, {}))
                joints[name] = JointResult(
                    joint=name, gains=gains, fit=fit, drive_gains=pair_of(nominal.get(name))
                )
                continue
            target = measured[name][0]
            compared = compare(
                rigs.robot,
                measured[name],
                matched=simulated_response(rigs, target, compared_values(fit, method)),
                nominal=simulated_response(rigs, target, nominal[name]),
            )
            zero_armature = None
            if method == "paper" and settings.zero_armature and "armature" in rigs.parameters:
                zero_armature = search_without_armature(
                    rigs, target, compared.error_db, no_match_db(target)
                )
            compliance = compliance_flag(fit, target, compared, rigs.robot, nominal[name])
            flags = joint_flags(fit, target, compared, excitation_flags[name], compliance)
            named = any(flag.startswith((NO_MATCH, EFFORT_LIMIT)) for flag in (*fit.flags, *flags))
            if not named:
                excitations = excitations_of(sources[name], name)
                flags = (
                    *unexplained_motion(excitations, fit.rmse, target.measured.amplitude),
                    *flags,
                )
            gains = joint_gains(fit, robot, compared, flags)
            joints[name] = JointResult(
                joint=name,
                gains=replace(gains, physical=physical.get(name, {})),
                fit=fit,
                drive_gains=pair_of(nominal[name]),
                responses=compared,
                grid=grids.get(name),
                zero_armature=zero_armature,
            )
            progress("responses", len(joints) / len(fits))
        excluded = left_out_by_torque(torque_fits, joints)
        result = match_result(simulation, simulation.info(rigs), joints, logs, excluded, method)
        return replace(result, gain_uncertainty=settings.gain_uncertainty)


def without_speed_line(
    fit: DriveFit,
    simulation: Simulation,
    settings: MatchSettings,
    excitations: Sequence[Excitation],
    parameters: Sequence[str],
    nominal: Mapping[str, float],
) -> DriveFit:
    """Fit a joint without the torque-speed line of its drive where the torque limit is reached.

    Args:
        fit: The fit with the line.
        simulation: The robot in its simulator.
        settings: The threads and the interpreter of the simulator.
        excitations: Excitations of the joint.
        parameters: Names of the parameters that were fitted.
        nominal: All parameters of the joint with the gains stated for its drive.
    """
    if not may_be_limited(excitations, simulation.robot, fit, nominal):
        return fit
    robot = simulation.robot
    flat_robot = with_flat_limits(robot, fit.joint)
    if flat_robot is not None:
        flat = replace(simulation, robot=flat_robot)
        with flat.open_rigs(settings.threads, settings.simulator_python) as rigs:
            replay = JointReplay(rigs, excitations)
            flat_fit = fit_flat_limit(replay, excitations, robot, fit, parameters, nominal)
        if flat_fit is not fit:
            return flat_fit
    flags = stated_limit_flag(excitations, robot, fit, nominal)
    return replace(fit, flags=(*flags, *fit.flags))


def wrong_stiffness(
    replay: JointReplay, parameters: Sequence[str], nominal: Mapping[str, float]
) -> str:
    """Say that the stiffness stated for a drive contradicts the log, where it does.

    Args:
        replay: Recordings of a joint whose drive could not be identified with that stiffness.
        parameters: Names of the parameters that were fitted.
        nominal: All parameters of the joint with the gains stated for its drive.

    Returns:
        A sentence with the stiffness that the log gives, to follow another one; empty where the
        stiffness was fitted, is not identified, or agrees.
    """
    if "stiffness" in parameters:
        return ""
    joint = replay.joints[0]
    fit = fit_drives(replay, parameters=GAINS_MODE, nominal={joint: nominal})[joint]
    low, high = fit.total95["stiffness"]
    known = fit.sd["stiffness"] <= PARAMETERS["stiffness"].sd_max
    stated = nominal["stiffness"]
    if not known or low <= stated <= high:
        return ""
    return (
        f" The stiffness stated for {joint}, {stated:.4g} N m/rad, may be the reason: mode drive "
        f"takes it as known, and with the armature of the robot's file this log gives "
        f"{fit.values['stiffness']:.4g} N m/rad ({low:.3g} to {high:.3g}). State the gains that "
        "were on the drive (--drive-gains), or match in mode gains."
    )


def stability_flags(
    fit: DriveFit, robot: RobotSpec, nominal: Mapping[str, float]
) -> tuple[str, ...]:
    """Say that the gains stated for a drive are not stable in the simulator's drive law.

    A search cannot pass the limit of stability. Where the joint is damped far above critical, gains
    below it that have the same ratio follow the command alike, so that the response does not show
    that they are several times too small.

    Args:
        fit: Fit of a joint.
        robot: The robot with the step and the drive law of the simulator.
        nominal: All parameters of the joint with the gains stated for its drive.

    Returns:
        A flag, which begins with `NO_MATCH` where the matched gains are near the limit; none where
        the stated gains are stable.
    """
    stated_share = joint_stability_share(robot, fit.joint, nominal)
    if stated_share < 1.0:
        return ()
    share = joint_stability_share(robot, fit.joint, fit.values)
    flag = (
        f"stability: the gains stated for the drive, {nominal['stiffness']:.4g} N m/rad and "
        f"{nominal['damping']:.4g} N m s/rad, are {stated_share:.2g} times the limit of drive law "
        f"{robot.law.label} at {1e3 * robot.timestep_s:g} ms"
    )
    if share < NEAR_LIMIT:
        return (f"{flag}; those matched are {share:.2g} times the limit",)
    return (
        f"{NO_MATCH}{flag}, which no search can pass; the gains that were found are {share:.2g} "
        "times the limit. They may follow the command alike, and are not those of the drive: take "
        "a smaller timestep_s in the robot's file, or match for a framework whose drives are "
        "implicit, as --simulator isaaclab-implicit",
    )


def with_step_uncertainty(fit: DriveFit, robot: RobotSpec) -> DriveFit:
    """Widen the total intervals of the gains by what the simulator's step leaves open."""
    inertia, _ = bench_inertia(robot, robot.joint(fit.joint).original[0])
    step_share = fit.values["damping"] * robot.timestep_s / (2.0 * inertia)
    flags = fit.flags
    if step_share > OPEN_STEP:
        flags = (
            *flags,
            f"step: damping times the step of {1e3 * robot.timestep_s:g} ms is "
            f"{2.0 * step_share:.2g} times the inertia, so that the response tells the ratio of "
            "the gains alone; gains of the same ratio follow the command alike and give way to "
            "loads otherwise. Take a smaller step",
        )
    if "effort_limit" in fit.sd:
        step_share *= LIMITED_FACTOR
    total95 = widen_by_step(fit.total95, fit.values, step_share)
    return replace(fit, total95=total95, flags=flags)


def check_choices(method: str, mode: str, settings: MatchSettings, simulation: Simulation) -> None:
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
    if simulation.framework is not None and mode == "drive":
        raise PronkError(
            f"profile {simulation.name} in mode drive; a profile is matched in mode gains."
        )


def fitted_parameters(
    mode: Mode, settings: MatchSettings, simulation: Simulation
) -> tuple[str, ...]:
    """Return the names of the parameters that a fit in time searches.

    Raises:
        PronkError: A parameter that the settings name is not known.
    """
    if settings.fitted:
        return checked_names(settings.fitted, FREE)
    if mode == "drive":
        return DRIVE_MODE
    framework = simulation.framework
    if framework is not None and framework.friction != "N m":
        # The framework has no dry friction in newton metres that could be fitted.
        return WITHOUT_FRICTION
    return GAINS_MODE


def excitations_of(logs: Sequence[JointLog], joint: str) -> list[Excitation]:
    """Return every excitation of a joint in some logs."""
    excitations: list[Excitation] = []
    for log in logs:
        excitations.extend(log.excitations(joint))
    return excitations


def search_grids(
    rigs: JointRigs,
    measured: Mapping[str, Sequence[MeasuredJoint]],
    points: int,
    progress: Progress,
) -> dict[str, GridSearch]:
    """Search the paper's grid for the largest amplitude of every joint (F7).

    Args:
        rigs: Joints in the simulator.
        measured: Measured responses by joint, the largest amplitude first.
        points: Points of each axis of the grid.
        progress: Called with the stage and the share of it that is done.

    Returns:
        Error over the grid by joint.
    """
    stiffness, damping = grid_axes(rigs.robot, points)
    targets = []
    for amplitudes in measured.values():
        targets.append(amplitudes[0])
    searches = search_grid(rigs, targets, stiffness, damping, progress=progress)
    return dict(zip(measured, searches, strict=True))


def match_chains(
    logs: Sequence[JointLog],
    simulation: Simulation,
    parameters: Sequence[str],
    torque_fits: Mapping[str, DriveFit],
    settings: MatchSettings,
    progress: Progress,
) -> MatchResult:
    """Match legs or arms whose joints moved together, one chain after the other.

    With a fixed base chains do not move each other. The steps are those of `match` in another
    order, and some of its choices do not apply:

    - The fit comes first, always in time; method `paper` is refused. The response of a joint is
      estimated afterwards, from the recording with the most coherent frequencies
      (`compare_recordings`): it judges the fit and takes no part in it.
    - Parameters of a joint that the logs do not identify are held at their nominal value, where
      `match` flags them (mode `gains`) or refuses them (mode `drive`).
    - Of the settings, `coherence_min` is not used: frequencies of a coherence below
      `compared.COHERENCE_MIN` are not compared.
    - An incoherent band is no error. The joint then has no response, and the share of its motion
      that the simulation explains says whether it is a match (`check_explained_motion`).

    Args:
        logs: Logs of one robot, in some of which several joints move at once.
        simulation: The robot in its simulator.
        parameters: Names of the parameters to fit.
        torque_fits: Drives by a torque channel.
        settings: The threads of the simulator, the estimator and the uncertainty of the stated
            gains are used.
        progress: Called with the stage and the share of it that is done.

    Raises:
        PronkError: The simulator moves one joint at a time only.
        IdentifiabilityError: The logs identify too few parameters of a joint.
    """
    simulation.require_mujoco()
    robot = simulation.robot
    logs_in_motion = [log for log in logs if log.excited_joints]
    excitation_flags = {}
    for name, joint_logs in logs_by_joint(logs_in_motion, robot).items():
        excitations = excitations_of(joint_logs, name)
        excitation_flags[name] = (
            *check_armature(robot.joint(name), parameters, excitations),
            *check_excitations(excitations, robot),
        )
    fits: dict[str, DriveFit] = {}
    all_nominal: dict[str, dict[str, float]] = {}
    physical: dict[str, dict[str, FittedValue]] = {}
    responses: dict[str, ComparedResponses] = {}
    motion_flags: dict[str, tuple[str, ...]] = {}
    excluded: dict[str, str] = {}
    chains = branches(logs_in_motion, robot)
    for number, joint_names in enumerate(chains):

        def report(share: float, number: int = number) -> None:
            progress("fit", (number + share) / len(chains))

        with ChainSimulation(
            robot, logs_in_motion, joints=joint_names, threads=settings.threads
        ) as chain:
            replay = ChainReplay(chain)
            nominal = nominal_drives(chain.logs, chain.joints, robot)
            all_nominal |= nominal
            chain_fits = fit_drives(
                replay,
                parameters=parameters,
                nominal=nominal,
                unidentified="hold",
                progress=report,
            )
            matched = {name: fit.values for name, fit in chain_fits.items()}
            matched_positions, nominal_positions = chain.run([matched, nominal])
            for column, name in enumerate(chain.joints):
                joint_matched = joint_positions(matched_positions, column)
                measured = [log.position[:, log.column(name)] for log in chain.logs]
                travels = [float(np.ptp(log.command[:, log.column(name)])) for log in chain.logs]
                compared = compare_recordings(
                    robot,
                    name,
                    chain.logs,
                    matched=joint_matched,
                    nominal=joint_positions(nominal_positions, column),
                    highest_hz=replay.trusted_hz[name],
                    estimator=settings.estimator,
                )
                if compared is not None:
                    responses[name] = compared
                    motion_flags[name] = compared_flags(compared)
                else:
                    motion_flags[name] = check_explained_motion(measured, joint_matched)
                motion_flags[name] = (
                    *motion_flags[name],
                    *check_mean_position(measured, joint_matched, 0.5 * max(travels)),
                    *stability_flags(chain_fits[name], robot, nominal[name]),
                )
            if "stiffness" not in parameters:
                chain_fits, drive_values = physical_drives(
                    replay, chain_fits, robot, settings.gain_uncertainty
                )
                physical |= drive_values
            for name, fit in chain_fits.items():
                reached = effort_limit_reached(excitations_of(logs_in_motion, name), robot, fit)
                excitation_flags[name] = (
                    *with_limit_flag(excitation_flags[name], reached),
                    *check_torque_scale(excitations_of(logs_in_motion, name), fit),
                )
            fits.update(chain_fits)
            excluded.update(chain.excluded)
    joints = {}
    for name, fit in with_torque(fits, torque_fits, robot).items():
        flags = (*motion_flags.get(name, ()), *excitation_flags.get(name, ()))
        gains = joint_gains(fit, robot, responses.get(name), flags)
        gains = replace(gains, physical=physical.get(name, {}))
        joints[name] = JointResult(
            joint=name,
            gains=gains,
            fit=fit,
            drive_gains=pair_of(all_nominal.get(name)),
            responses=responses.get(name),
        )
    excluded = left_out_by_torque(torque_fits, joints) | excluded
    result = match_result(simulation, simulation.info(), joints, logs, excluded)
    return replace(result, gain_uncertainty=settings.gain_uncertainty)


def pair_of(nominal: Mapping[str, float] | None) -> Pair | None:
    """Return the stiffness and damping of a nominal drive; None without one."""
    if nominal is None:
        return None
    return nominal["stiffness"], nominal["damping"]


def compared_flags(compared: ComparedResponses) -> tuple[str, ...]:
    """Check the response of a joint that moved together with others, as `joint_flags` does."""
    measured = compared.measured[0]
    used = measured.band(*compared.band_hz, COHERENCE_MIN)
    relative = measured.relative_error(0.95)[used]
    limit_db = max(NO_MATCH_DB, NO_MATCH_INTERVALS * DB * rms(relative))
    return check_response(measured, compared.matched, used, limit_db)


def joint_positions(positions: Sequence[Array], column: int) -> list[Array]:
    """Return the positions of one joint, one array of shape (n,) a log [rad]."""
    return [log_positions[:, column] for log_positions in positions]


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


def compliance_flag(
    fit: DriveFit,
    target: MeasuredJoint,
    compared: ComparedResponses,
    robot: RobotSpec,
    nominal: Mapping[str, float],
) -> str:
    """Name a compliance between motor and link where the match does not explain the log.

    Args:
        fit: Fit of the joint.
        target: Its measured response.
        compared: Measured and simulated response.
        robot: The robot, which has the inertias.
        nominal: Parameters of its drive with the stated gains.

    Returns:
        The flag of `find_compliance`; empty where the match explains the log.
    """
    explained = not fit.rmse > MISFIT * target.measured.amplitude
    if explained and compared.error_db <= no_match_db(target):
        return ""
    inertia, pull = bench_inertia(robot, robot.joint(fit.joint).original[0])
    armature = robot.joint(fit.joint).drive.armature
    if nominal["damping"] <= 0.0 or not 0.0 < armature < inertia:
        return ""
    joint = JointDynamics(
        motor_inertia=armature,
        link_inertia=inertia - armature,
        pull=pull,
        stiffness=nominal["stiffness"],
        damping=nominal["damping"],
    )
    return find_compliance(target.measured, target.fit_mask, joint)


def joint_flags(
    fit: DriveFit,
    target: MeasuredJoint,
    compared: ComparedResponses,
    excitation_flags: Sequence[str],
    compliance: str = "",
) -> tuple[str, ...]:
    """Return what warns of a joint beside its fit: the torque limit first, then its response.

    Args:
        fit: Fit of the joint, whose flags may say that the torque was limited.
        target: Measured response.
        compared: Measured and simulated response.
        excitation_flags: Flags of its excitations.
        compliance: Flag that names a compliance; empty where none can be told.
    """
    limit_is_named = any(flag.startswith(EFFORT_LIMIT) for flag in fit.flags)
    limit_flags = []
    other_flags = []
    for flag in excitation_flags:
        if not flag.startswith(EFFORT_LIMIT):
            other_flags.append(flag)
        elif not limit_is_named:
            limit_flags.append(flag)
    causes = list(limit_flags)
    if compliance and not limit_is_named and not limit_flags:
        causes.append(compliance)
    flags = [
        *causes,
        *check_response(
            target.measured,
            compared.matched,
            target.fit_mask,
            no_match_db(target),
            cause_is_named=limit_is_named or bool(causes),
        ),
        *other_flags,
    ]
    excited_count = int(target.excited_mask.sum())
    incoherent_count = excited_count - int(target.fit_mask.sum())
    if incoherent_count > LEFT_OUT * excited_count:
        flags.append(
            f"{incoherent_count} of {excited_count} frequencies left out for low coherence"
        )
    flags.extend(target.warnings)
    return tuple(flags)


def with_limit_flag(flags: Sequence[str], reached: Sequence[str]) -> tuple[str, ...]:
    """Add to the flags of a joint's excitations that its torque limit was reached, once."""
    if any(flag.startswith(EFFORT_LIMIT) for flag in flags):
        return tuple(flags)
    return (*flags, *reached)


def match_by_torque(
    logs: Sequence[JointLog], simulation: Simulation, torque_fits: Mapping[str, DriveFit]
) -> MatchResult:
    """Return the result of logs that excite no joint by a commanded position.

    Raises:
        IdentifiabilityError: The torques identify no drive.
    """
    joints = {}
    robot = simulation.robot
    for name, fit in with_torque({}, torque_fits, robot).items():
        joints[name] = JointResult(joint=name, gains=joint_gains(fit, robot), fit=fit)
    if not joints:
        reasons: dict[str, None] = {}
        for fit in torque_fits.values():
            reasons.update(dict.fromkeys(fit.flags))
        if not reasons:
            for name, reason in left_out_by_torque(torque_fits, joints).items():
                reasons[f"{name}: {reason}"] = None
        raise IdentifiabilityError(
            f"{len(logs)} logs excite no joint by a commanded position and identify no drive "
            f"by torque: {'; '.join(reasons) or 'record larger or faster motions'}."
        )
    excluded = left_out_by_torque(torque_fits, joints)
    return match_result(simulation, simulation.info(), joints, logs, excluded)


def match_result(
    simulation: Simulation,
    simulator: SimulatorInfo,
    joints: Mapping[str, JointResult],
    logs: Sequence[JointLog],
    excluded: Mapping[str, str] | None = None,
    method: Method = "time",
) -> MatchResult:
    """Put the results of all joints together, with the training ranges of their groups.

    Args:
        simulation: The robot in its simulator.
        simulator: Description of the simulator that the gains hold for.
        joints: Results by joint.
        logs: Every log that went in.
        excluded: Reasons by joint for joints that moved and were not matched.
        method: Method of the match, which decides how training gains are rounded.

    Raises:
        PronkError: Gains of a joint that is a match are not stable at the step of a framework.
    """
    gains = {name: joint.gains for name, joint in joints.items()}
    simulation.require_stable({name: joint for name, joint in gains.items() if joint.matched})
    virtual = False
    for log in logs:
        virtual = virtual or log.virtual
    return MatchResult(
        robot=simulation.robot.name,
        simulator=simulator,
        joints=joints,
        groups=group_gains(simulation.robot, gains, method),
        logs=hashes_by_name(logs),
        virtual=virtual,
        excluded=excluded or {},
        robot_path=file_of_robot(simulation.robot),
        notes=match_notes(logs, joints, simulation.robot),
    )


def hashes_by_name(logs: Sequence[JointLog]) -> dict[str, str]:
    """Return the SHA-256 of each log by the name of its file.

    Files of one name in several folders, as two sweeps of a robot have, are named with as many of
    their folders as tell them apart.
    """
    paths = [Path(log.source or "log") for log in logs]
    hashes = {}
    for path, log in zip(paths, logs, strict=True):
        others = [other for other in paths if other != path]
        count = 1
        while count < len(path.parts) and any(
            other.parts[-count:] == path.parts[-count:] for other in others
        ):
            count += 1
        hashes[Path(*path.parts[-count:]).as_posix()] = log.origin.sha256
    return hashes


def file_of_robot(robot: RobotSpec) -> str:
    """Return the file of a robot, or its name in MuJoCo Menagerie.

    It is empty for a robot that ships with pronk or has no file.
    """
    if robot.source.startswith(MENAGERIE):
        return robot.source
    if robot.source in ROBOT_NAMES or not Path(robot.source).is_file():
        return ""
    return robot.source
