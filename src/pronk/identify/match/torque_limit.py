"""A drive at its torque limit, found from the motion alone, with the limit as a free parameter.

Where the limit in the robot's file is right, the simulation is limited as the drive was, and the
torque that the matched gains ask for tells for how long (`effort_limit_reached`). The gains that
are stated for a drive do not tell: those of a robot's file may be off by half. Where the limit is
wrong, no gains explain the log: those of a plain fit are several times too small, with tight
intervals. What the drive gave shows in the motion itself, as inertia times acceleration.
`fit_torque_limit` compares it with what the stated gains ask for, and fits the limit with
everything else.

The limit is taken for the cause only where that explains the log: with `EXPLAINED` of the amplitude
as the error on held-out samples, `BETTER` times smaller than without. Over 21 mechanisms of
`tests/joint_mechanisms.py` (three each, seed 2) this finds the wrong limits and nothing else: a
filter, a compliance, a lag, a profile of the servo and play are either better by less, or leave
more of the motion unexplained.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pronk.arrays import Array
from pronk.identify.logs.joint_log import Excitation
from pronk.identify.match.checks import effort_limit_flag
from pronk.identify.match.drive_fit import fit_drives
from pronk.identify.match.replay import JointReplay
from pronk.identify.match.result import DriveFit
from pronk.robots.model import bench_inertia
from pronk.robots.robot import RobotSpec

MISFIT = 0.01
"""Error in time of a plain fit, as a share of the amplitude, from which on it is asked whether the
torque was limited. Honest joints of `tests/joint_mechanisms.py` are at 0.001 to 0.008."""
ASKED = 1.3
"""Torque that the stated gains ask for, over the largest that the motion shows, from which on the
drive may have been at its limit: friction and gravity, which the motion does not show, are less."""
EXPLAINED = 0.03
"""Error on held-out samples with the limit free, as a share of the amplitude, that explains a log:
0.25 dB."""
BETTER = 0.5
"""Error on held-out samples with the limit free over that without it, from which on the limit is
taken for the cause."""
AT_LIMIT = 0.03
"""Share of the excitation at the limit from which on it counts."""
KNOWN = 0.15
"""Relative deviation of the limit up to which it is known."""
LIMIT_FACTORS = (0.4, 0.55, 0.7, 0.8, 0.85, 0.9, 0.95, 1.0, 1.15, 1.4)
"""Limits at which the search may begin, over the torque that the motion shows."""
MARGIN = 0.9
"""Torque of a recommended amplitude over the limit."""
SHOWN = 0.8
"""Torque that the motion shows over the limit of the robot's file from which on it shows the
limit."""
NO_LINE = 1e4
"""No-load speed of a drive whose torque does not depend on its speed [rad/s]."""
SMOOTH_PERIODS = 2.0
"""Highest frequency of the acceleration over the top of the joint's band. Beyond it the noise of an
encoder, twice differentiated, is larger than the motion."""


@dataclass(frozen=True, kw_only=True)
class LimitedDrive:
    """What a joint's motion and the stated gains say of its torque."""

    delivered: float
    """Torque that the drive gave for nine tenths of the time or more [N m]."""
    demanded: Array
    """Size of the torque that the gains of the drive ask for [N m], shape (n,)."""


def drive_torques(
    excitations: Sequence[Excitation], robot: RobotSpec, values: Mapping[str, float]
) -> LimitedDrive:
    """Compare the torque that gains ask for with inertia times acceleration.

    Args:
        excitations: Excitations of one joint.
        robot: The robot, which has the joint's inertia and its band.
        values: Stiffness and damping of the drive, and the delay of the command.
    """
    name = excitations[0].joint
    inertia, pull = bench_inertia(robot, robot.joint(name).original[0])
    top_hz = SMOOTH_PERIODS * robot.joint(name).band_hz[1]
    delivered = []
    demanded = []
    for excitation in excitations:
        time = excitation.time
        grid = np.linspace(float(time[0]), float(time[-1]), len(time))
        step = (time[-1] - time[0]) / (len(time) - 1)
        position = np.interp(grid, time, excitation.position)
        # Without the line between its ends the position has no jump where a period would end.
        line = np.linspace(position[0], position[-1], len(position))
        spectrum = np.fft.rfft(position - line)
        omega = 2.0 * np.pi * np.fft.rfftfreq(len(position), float(step))
        spectrum[omega > 2.0 * np.pi * top_hz] = 0.0
        speed = np.fft.irfft(1j * omega * spectrum, len(position))
        acceleration = np.fft.irfft(-(omega**2) * spectrum, len(position))
        about_mean = position - position.mean()
        delivered.append(np.abs(inertia * acceleration + pull * about_mean))
        command = np.interp(grid - values["delay"], time, excitation.command)
        error = command - position
        demanded.append(np.abs(values["stiffness"] * error - values["damping"] * speed))
    return LimitedDrive(
        delivered=float(np.quantile(np.concatenate(delivered), 0.9)),
        demanded=np.concatenate(demanded),
    )


def effort_limit_reached(
    excitations: Sequence[Excitation], robot: RobotSpec, fit: DriveFit
) -> tuple[str, ...]:
    """Say for how much of the time the matched gains ask for more torque than the drive has.

    Args:
        excitations: Excitations of one joint.
        robot: The robot, whose limit the fit was made with.
        fit: The fit of the joint.

    Returns:
        A flag; none where less than `checks.LIMITED_SHARE` of the time is beyond the limit, and
        where the fit leaves more than `EXPLAINED` of the amplitude unexplained: its gains are not
        those of the drive then, and do not tell its torque.
    """
    if any(excitation.log.unit(fit.joint) != "rad" for excitation in excitations):
        return ()
    amplitude = max(excitation.amplitude for excitation in excitations)
    if fit.rmse > EXPLAINED * amplitude or "effort_limit" in fit.sd:
        return ()
    delay_s = max(fit.values.get("delay", 0.0), 0.0)
    torques = drive_torques(excitations, robot, {**fit.values, "delay": delay_s})
    limit = robot.joint(fit.joint).drive.effort_limit
    flag = effort_limit_flag(torques.demanded, limit, fit.values["stiffness"], amplitude)
    return (flag,) if flag else ()


def fit_torque_limit(
    replay: JointReplay,
    excitations: Sequence[Excitation],
    robot: RobotSpec,
    plain: DriveFit,
    parameters: Sequence[str],
    nominal: Mapping[str, float],
) -> DriveFit:
    """Fit a joint again with its torque limit free, where its motion shows a limit.

    Args:
        replay: Recordings of the joint, on rigs that set the limit.
        excitations: The excitations of the recordings.
        robot: The robot.
        plain: The fit with the limit of the robot's file.
        parameters: Names of the parameters that it fitted.
        nominal: All parameters of the joint with the gains stated for its drive.

    Returns:
        The fit with the limit free and a flag that says so, or the plain fit.
    """
    joint = plain.joint
    amplitude = max(recording.amplitude for recording in replay.recordings)
    if not plain.held_out or plain.rmse < MISFIT * amplitude:
        return plain
    delay_s = max(plain.values["delay"], 0.0)
    torques = drive_torques(excitations, robot, {**nominal, "delay": delay_s})
    asks_more = float(np.quantile(torques.demanded, 0.95)) > ASKED * torques.delivered
    file_limit = nominal["effort_limit"]
    asks_limit = float(np.mean(torques.demanded > file_limit)) > AT_LIMIT
    if not asks_more and not asks_limit:
        return plain

    start = dict(nominal)
    start["frictionloss"] = min(plain.values["frictionloss"], 0.1 * torques.delivered)
    start["effort_limit"] = _best_limit(replay, joint, start, torques.delivered, delay_s)
    limited = fit_drives(replay, parameters=(*parameters, "effort_limit"), nominal={joint: start})[
        joint
    ]
    error = limited.held_out["matched"]
    if error > EXPLAINED * amplitude or error > BETTER * plain.held_out["matched"]:
        return plain
    limit = limited.values["effort_limit"]
    torques = drive_torques(excitations, robot, limited.values)
    share = float(np.mean(torques.demanded > limit))
    held_out = {**plain.held_out, "matched": error}
    other_flags = []
    for flag in limited.flags:
        if not flag.startswith("effort_limit"):
            other_flags.append(flag)
    if share < AT_LIMIT or limited.sd["effort_limit"] > KNOWN:
        flag = (
            f"effort limit: the drive gave up to {torques.demanded.max():.3g} N m, more than the "
            f"{file_limit:g} N m of the robot's file, which was left out of the fit; correct "
            "effort_limit there"
        )
    else:
        fitting = MARGIN * limit / limited.values["stiffness"]
        flag = (
            f"effort limit: for {100.0 * share:.0f} % of the excitation the torque is at its "
            f"limit. The acceleration never exceeds what {limit:.3g} N m give, where the gains ask "
            f"for up to {torques.demanded.max():.3g} N m. The fit took this limit in place of "
            f"the {file_limit:g} N m of the robot's file; correct effort_limit there, and excite "
            f"the joint with {fitting:.2g} rad or less"
        )
    return replace(limited, held_out=held_out, flags=(flag, *other_flags))


def with_flat_limits(robot: RobotSpec, joint_name: str) -> RobotSpec | None:
    """Return a robot whose joint has its effort limit at every speed, without a torque-speed line.

    Args:
        robot: The robot.
        joint_name: The joint.

    Returns:
        The robot; None where the line is never below the effort limit.
    """
    joints = []
    for joint in robot.joints:
        if joint.name == joint_name:
            drive = joint.drive
            if not math.isfinite(drive.effort_limit) or drive.no_load_speed >= NO_LINE:
                return None
            drive = replace(drive, stall_torque=drive.effort_limit, no_load_speed=NO_LINE)
            joint = replace(joint, drive=drive)
        joints.append(joint)
    return replace(robot, joints=tuple(joints))


def fit_flat_limit(
    replay: JointReplay,
    excitations: Sequence[Excitation],
    robot: RobotSpec,
    plain: DriveFit,
    parameters: Sequence[str],
    nominal: Mapping[str, float],
) -> DriveFit:
    """Fit a joint again without the torque-speed line of its drive, where it is at its limit.

    A line that falls too early takes torque from a drive that is at its limit in motion, and no
    gains make up for it.

    Args:
        replay: Recordings of the joint, on rigs of `with_flat_limits`.
        excitations: The excitations of the recordings.
        robot: The robot with the line.
        plain: The fit with the line.
        parameters: Names of the parameters that it fitted.
        nominal: All parameters of the joint with the gains stated for its drive.

    Returns:
        The fit without the line and a flag that says so, or the plain fit.
    """
    amplitude = max(recording.amplitude for recording in replay.recordings)
    flat = fit_drives(replay, parameters=parameters, nominal={plain.joint: nominal})[plain.joint]
    error = flat.held_out["matched"]
    if error > EXPLAINED * amplitude or error > BETTER * plain.held_out["matched"]:
        return plain
    drive = robot.joint(plain.joint).drive
    delay_s = max(flat.values["delay"], 0.0)
    torques = drive_torques(excitations, robot, {**flat.values, "delay": delay_s})
    flag = effort_limit_flag(
        torques.demanded, drive.effort_limit, flat.values["stiffness"], amplitude
    )
    if not flag:
        return plain
    flag = (
        f"{flag}. The drive gives its limit at every speed of the log, where the robot's file has "
        f"less (stall_torque {drive.stall_torque:g} N m, no_load_speed {drive.no_load_speed:g} "
        "rad/s): the fit left that line out; correct these two"
    )
    return replace(flat, flags=(flag, *flat.flags))


def stated_limit_flag(
    excitations: Sequence[Excitation],
    robot: RobotSpec,
    plain: DriveFit,
    nominal: Mapping[str, float],
) -> tuple[str, ...]:
    """Say for how much of the time the stated gains ask for more torque than the drive has.

    It is for a log that no gains explain, so that there are none but those that are stated. The
    motion has to show the limit too: stated gains may be off by half.

    Args:
        excitations: Excitations of one joint.
        robot: The robot.
        plain: The fit with the limit of the robot's file.
        nominal: All parameters of the joint with the gains stated for its drive.

    Returns:
        A flag; none where the fit explains the log, or the motion stays below the limit.
    """
    amplitude = max(excitation.amplitude for excitation in excitations)
    delay_s = max(plain.values["delay"], 0.0)
    torques = drive_torques(excitations, robot, {**nominal, "delay": delay_s})
    limit = nominal["effort_limit"]
    if plain.rmse <= EXPLAINED * amplitude or torques.delivered < SHOWN * limit:
        return ()
    flag = effort_limit_flag(torques.demanded, limit, nominal["stiffness"], amplitude)
    return (f"{flag}. No gains explain this log, and these are by the stated ones",) if flag else ()


def may_be_limited(
    excitations: Sequence[Excitation],
    robot: RobotSpec,
    plain: DriveFit,
    nominal: Mapping[str, float],
) -> bool:
    """Return whether a fit misses a joint whose stated gains ask for more than its effort limit.

    Args:
        excitations: Excitations of the joint.
        robot: The robot.
        plain: The fit with the limit of the robot's file.
        nominal: All parameters of the joint with the gains stated for its drive.
    """
    amplitude = max(excitation.amplitude for excitation in excitations)
    if not plain.held_out or plain.rmse < MISFIT * amplitude or "effort_limit" in plain.sd:
        return False
    delay_s = max(plain.values["delay"], 0.0)
    torques = drive_torques(excitations, robot, {**nominal, "delay": delay_s})
    return float(np.mean(torques.demanded > nominal["effort_limit"])) > AT_LIMIT


def _best_limit(
    replay: JointReplay, joint: str, start: Mapping[str, float], delivered: float, delay_s: float
) -> float:
    """Return the limit with which the stated gains come nearest to the motion [N m]."""
    limits = []
    sets = []
    for factor in LIMIT_FACTORS:
        for delay in (0.0, 0.006, 0.012, delay_s):
            limits.append(factor * delivered)
            sets.append({joint: {**start, "effort_limit": factor * delivered, "delay": delay}})
    errors = []
    for positions in replay.positions(sets):
        squares = 0.0
        for recording, position in zip(replay.recordings, positions, strict=True):
            difference = (position - recording.position) * recording.weight
            squares += float(np.sum((difference - difference.mean()) ** 2))
        errors.append(squares)
    return limits[int(np.argmin(errors))]
