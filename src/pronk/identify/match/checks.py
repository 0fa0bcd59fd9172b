"""Checks of the excitations of a joint before the fit, and of the matched response after it.

Each check is one function with its equation. Limits hold for any position-controlled joint: none of
them was set by the logs of a particular robot. What would make every matched number meaningless is
a LogError: another joint moved, a sign is flipped, or an angle is in degrees. What only weakens a
match is a flag, one sentence with the way out.

No check sees gains that are stated wrongly for the drive: a match finds the product of the gains
and the torque constant, so that wrongly stated gains change no matched number. A position that was
filtered, a compliant gear and an inertia that the model does not have all show alike, as a response
that no gains reach (`check_response`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from pronk.arrays import Array, ComplexArray, Mask
from pronk.errors import LogError
from pronk.identify.logs.joint_log import Excitation
from pronk.identify.match.measured import DB
from pronk.identify.match.result import NO_MATCH
from pronk.identify.response.response import FrequencyResponse
from pronk.robots.model import bench_inertia
from pronk.robots.robot import Joint, RobotSpec

DEGREES = 180.0 / math.pi
"""Degrees in a radian, the factor by which a wrong unit scales a column."""
TURN = 2.0 * math.pi
"""Radians in a turn."""
COLUMN_UNITS = (
    (DEGREES, "degrees", "radians"),
    (1.0 / DEGREES, "radians", "degrees"),
    (TURN, "radians", "turns"),
    (1.0 / TURN, "turns", "radians"),
    (360.0, "degrees", "turns"),
    (1.0 / 360.0, "turns", "degrees"),
)
"""Gains of the slow response of a joint whose columns have two units: gain, unit of the position,
unit of the command."""
UNIT_TOLERANCE = 0.05
"""Largest relative difference of the gain of a slow response from one of `COLUMN_UNITS` that looks
like these units. Most drives follow slow commands within it, and a gear of 50 : 1 is outside of it
for a position of the motor."""
FOLLOWS = 2.0
"""Largest factor between the motions of a joint and of its command, at low frequency and in one
unit, of a joint that follows its command."""
LEAST_DEGREES = 0.7
"""Least half of the travel of a command that may be in degrees: 0.7 degrees, 0.012 rad, are less
than the dry friction of most drives lets through, and 0.7 rad are more than most joints are
excited with."""

LOWEST_HZ = 0.25
"""Lowest frequency of the slow response [Hz]: below it a chirp of 20 s is in its ramp."""
SLOW_SHARE = 0.2
"""Share of the joint's band that counts as slow. A drive of resonance f and damping ratio 0.3 or
more is within 10 % of its command there."""
SLOWEST_TOP_HZ = 1.0
"""Highest frequency of the slow response [Hz], for joints whose band is wide."""
EXCITED_SHARE = 0.05
"""Magnitude of the command over its largest from which on a frequency counts as excited."""
COHERENT = 0.8
"""Coherence from which on the slow response is judged: less than a quarter of the motion is then
due to something else."""
OPPOSITE = -0.7
"""Cosine of the phase of the slow response below which the joint moves against its command: more
than 135 degrees, where no drive of a moving joint is at a fifth of its band."""

SAMPLES_A_PERIOD = 6.0
"""Least samples in a period at the top of the band. A position that is interpolated linearly
between six samples a period loses 1 - sinc(1/6)^2 = 9 % of its amplitude, between three 32 %."""
CLOCK_TOLERANCE = 2e-3
"""Largest relative difference of the period of the commands from the stated one. Crystals keep
1e-4, and a sweep of 20 s at 50 Hz slips by two ticks at 2e-3."""
HELD = 0.85
"""Sharpness of the instants of change from which on a command counts as held between ticks: 1 where
it changes at the ticks alone, and about 0 where it changes with every sample."""
SMOOTHED = 0.1
"""Sharpness below which a command counts as computed anew for every sample: commands at 200 Hz in a
log of 188 Hz have up to 0.06, those held for 20 ms and then filtered at 10 Hz 0.14 or more."""
HELD_SHARE = 0.1
"""Share of the samples in motion at which a command does not change from which on it is held, at
whatever rate: one that was filtered changes with every sample."""
OTHER_RATE = 0.05
"""Relative difference from the robot's policy rate beyond which commands are taken to be sent at
another rate, rather than timed by a clock that runs wrongly."""

STILL_SHARE = 0.02
"""Travel of the position over that of the command within a second below which a joint stands: -34
dB, which no joint reaches inside its band."""
STILL_COMMAND_RAD = 0.15
"""Least travel of the command for a joint to count as standing [rad]: dry friction holds the elbow
of an SO-101 against 0.08 rad."""

LIMITED_SHARE = 0.01
"""Share of the time at the effort limit from which on a joint counts as limited. A response is
linear only as long as the torque is; at 1 % of the time its first harmonic changes by less than
0.1 dB."""

AMPLIFIED = 1.5
"""Slow response over what the drive and gravity explain from which on a joint moves too far. The
slow response of a hip of the virtual Mini Cheetah is within 0.3 of 1."""
SLOW_GAIN = "slow gain: "
"""Beginning of the flag on a joint that moves farther than it is commanded to."""

EXPLAINED_MIN = 0.8
"""Least share of a joint's motion that a match explains. An error of `match.NO_MATCH_DB` at every
frequency, 12 % of the amplitude, with a phase error of 0.4 rad leaves 0.8."""
EFFORT_LIMIT = "effort limit: "
"""Beginning of the flag on a drive at its torque limit."""
FITTING_SHARE = 0.9
"""Torque of a recommended amplitude over the effort limit."""

TORQUE_COMPUTED = "computed"
"""Value of a log's metadata `torque` where the column was computed from the command."""


def check_excitations(excitations: Sequence[Excitation], robot: RobotSpec) -> tuple[str, ...]:
    """Check the excitations of one joint before it is matched.

    Args:
        excitations: Excitations of one joint, of one or several logs.
        robot: The robot.

    Returns:
        Flags, one sentence each: too few samples, another clock, a joint that stands still, is
        commanded too little or moves farther than commanded, a measured torque at the effort limit.
        Empty for a joint whose unit is not radians.

    Raises:
        LogError: Another joint moved, a sign is flipped, or angles are in degrees.
    """
    flags: list[str] = []
    for excitation in excitations:
        if excitation.log.unit(excitation.joint) != "rad":
            continue
        joint = robot.joint(excitation.joint)
        for problem in (
            wrong_joint(excitation, robot),
            wrong_unit(excitation, joint),
            wrong_sign(excitation, joint),
        ):
            if problem:
                source = excitation.source or "log"
                raise LogError(f"{source}: {excitation.joint}: {problem}.")
        for flag in (
            position_jump(excitation, joint),
            standstill(excitation, joint),
            small_command(excitation),
            slow_gain(excitation, robot),
            too_few_samples(excitation, joint),
            wrong_clock(excitation, robot.policy_rate_hz),
            effort_limit_measured(excitation, joint),
        ):
            if flag and not _is_repeated(flag, flags):
                flags.append(flag)
    return tuple(flags)


def _is_repeated(flag: str, flags: Sequence[str]) -> bool:
    """Return whether flags hold one of the same check, which begins with the same word."""
    check = flag.split(":")[0]
    return any(other.split(":")[0] == check for other in flags)


# ---- errors: what makes every number meaningless ----


def wrong_joint(excitation: Excitation, robot: RobotSpec) -> str:
    """Say how the recorded joint is not the excited one.

    The log names another joint, or a joint whose command stands still travelled twice as far as
    the commanded joint and more than half of its command: dynamic coupling of a limb moves its
    other joints less than the excited one. The slow responses tell the cause where they can: the
    columns are exchanged if the other joint follows this command and the commanded one does not,
    and a joint whose position is 180 / pi times its own command has columns of two units.

    Args:
        excitation: Excitation of a joint.
        robot: The robot.

    Returns:
        What was seen and the way out; empty if nothing contradicts the joint.
    """
    log = excitation.log
    remedy = (
        "give the order or the names of the file's joints (--joint-order, --joint-names), or check "
        "the wiring"
    )
    stated = log.origin.metadata.get("excited", excitation.joint)
    if stated != excitation.joint:
        return f"the log says that {stated} was excited; {remedy}"
    command_travel = np.ptp(log.command[excitation.samples], axis=0)
    travel = np.ptp(log.position[excitation.samples], axis=0)
    column = log.column(excitation.joint)
    largest = max(0.5 * command_travel[column], 2.0 * travel[column])
    for other, name in enumerate(log.joints):
        commanded = other == column or command_travel[other] > 0.0
        if commanded or log.unit(name) != "rad" or travel[other] <= largest:
            continue
        seen = f"{name} moved by {travel[other]:.2g} rad while {excitation.joint} was commanded"
        return f"{seen}; {_cause_of_motion(excitation, name, robot, remedy)}"
    return ""


def _cause_of_motion(excitation: Excitation, other: str, robot: RobotSpec, remedy: str) -> str:
    """Say why a joint may have moved farther than the excited one.

    Args:
        excitation: Excitation of a joint.
        other: The joint that moved, whose command stood still.
        robot: The robot.
        remedy: The way out where columns are exchanged.

    Returns:
        The cause if the slow responses show it, else what would look so; with the way out.
    """
    log = excitation.log
    joint = robot.joint(excitation.joint)
    if other in log.excited_joints and other in robot.joint_names:
        for other_excitation in log.excitations(other):
            other_gain = abs(slow_response(other_excitation, robot.joint(other)))
            if _is_in_degrees(other_gain):
                return f"where {other} is commanded, {_two_units(other_gain)}"
    gain = abs(slow_response(excitation, joint))
    follows = 1.0 / FOLLOWS < gain < FOLLOWS
    other_position = log.position[excitation.samples, log.column(other)]
    other_gain = abs(slow_gain_of(excitation, joint, other_position))
    if not follows and 1.0 / FOLLOWS < other_gain < FOLLOWS:
        return (
            f"at low frequency it moves {other_gain:.2g} times as far as that command, which "
            f"{excitation.joint} does not follow, so the columns are another joint's: {remedy}"
        )
    causes = f"something else that moves {other}, as a hand, or a drive that is off"
    units = (
        "joints of two units in one file (--unit rad, with --scale "
        f"JOINT={1.0 / DEGREES:.6f} for each joint in degrees)"
    )
    if not follows:
        column_units = _column_units(gain)
        if column_units is not None:
            units = f"{_looks_of_two_units(gain, column_units)}, {units}"
        return (
            "so would look, and this log does not tell them apart: columns of another joint "
            f"({remedy}), {units}, and {causes}"
        )
    swing = 0.5 * float(np.ptp(excitation.command))
    small = ""
    if swing * DEGREES < LEAST_DEGREES:
        small = (
            f" Its command swings by {swing:.2g} rad, {swing * DEGREES:.2g} degrees, as one in "
            "radians that is read in degrees does"
        )
    return (
        f"{excitation.joint} follows its command ({gain:.2g} times at low frequency), so the "
        f"columns are its own. So would look, and this log does not tell them apart: {units}, and "
        f"{causes}.{small}"
    )


def _column_units(gain: float) -> tuple[str, str] | None:
    """Return the units of position and command whose ratio a gain is; None if it is none."""
    for ratio, position_unit, command_unit in COLUMN_UNITS:
        if abs(gain / ratio - 1.0) < UNIT_TOLERANCE:
            return position_unit, command_unit
    return None


def _is_in_degrees(gain: float) -> bool:
    """Return True if a position is so many times its command that its unit must be degrees."""
    units = _column_units(gain)
    return units is not None and units[0] == "degrees" and gain > 1.0


def _looks_of_two_units(gain: float, column_units: tuple[str, str]) -> str:
    """Return in words the units of position and command whose ratio a gain is."""
    position_unit, command_unit = column_units
    return (
        f"a position in {position_unit} beside a command in {command_unit} ({gain:.3g} times the "
        "command at low frequency)"
    )


def _two_units(gain: float) -> str:
    """Say that a position in degrees stands beside a command in another unit."""
    units = _column_units(gain)
    assert units is not None
    position_unit, command_unit = units
    return (
        f"the position is {gain:.3g} times the command at low frequency, so that it is in "
        f"{position_unit} and the command in {command_unit}: convert one of the two columns "
        "(--unit and --scale change both alike)"
    )


def wrong_unit(excitation: Excitation, joint: Joint) -> str:
    """Say how angles are in degrees where radians are stated.

    The command leaves the range of the joint by more than a radian and is inside of it in degrees,
    or the slow response has a gain of 180 / pi or pi / 180, within a factor of two: drives follow
    slow commands with a gain near 1. A position that is 180 / pi times too small is also that of a
    joint at rest which the excited one shakes; its command is in degrees only if it is large enough
    for that (`LEAST_DEGREES`). A larger command may still be one in radians of a joint that
    something holds; the two look alike, and both are named. A command outside of the range may also
    be of another zero, unless it travels farther than the joint can.

    Args:
        excitation: Excitation of a joint.
        joint: Its model.

    Returns:
        What was seen and the way out; empty if the unit fits.
    """
    command = excitation.command
    lowest = float(command.min())
    highest = float(command.max())
    low, high = joint.range
    gain = abs(slow_response(excitation, joint))
    if _is_in_degrees(gain):
        return _two_units(gain)
    if 1.0 / FOLLOWS < gain / DEGREES < FOLLOWS:
        return (
            f"at low frequency the position is {gain:.3g} times the command; so would look, and "
            "this log does not tell them apart: a position in degrees beside a command in radians, "
            "and a position of the motor, before its gear: convert the position"
        )
    large = 0.5 * (highest - lowest) > LEAST_DEGREES
    if 1.0 / FOLLOWS < gain * DEGREES < FOLLOWS and large:
        return (
            f"at low frequency the position is {gain:.3g} times the command; either the command is "
            "in degrees and the position in radians: convert the command, or the joint is stuck "
            "or held: free it and record again"
        )
    outside = lowest < low - 1.0 or highest > high + 1.0
    fits_in_degrees = low <= lowest / DEGREES and highest / DEGREES <= high
    if not (outside and fits_in_degrees):
        return ""
    seen = (
        f"the command goes from {lowest:.3g} to {highest:.3g}, the joint from {low:.3g} to "
        f"{high:.3g} rad"
    )
    degrees = (
        f"read the log with --unit deg, or with --scale {joint.name}={1.0 / DEGREES:.6f} if this "
        "joint alone is in degrees"
    )
    if highest - lowest > high - low + 2.0:
        return f"{seen}; degrees are read as radians: {degrees}"
    other_causes = (
        "another zero than that of the robot's file, columns of another joint, and a range in the "
        "robot's file that is too small"
    )
    if not large:
        return f"{seen}; so would look, and this log does not tell them apart: {other_causes}"
    return (
        f"{seen}; so would look, and this log does not tell them apart: degrees that are read as "
        f"radians ({degrees}), {other_causes}"
    )


def wrong_sign(excitation: Excitation, joint: Joint) -> str:
    """Say how the position has the other sign than the command: `cos(phase) < OPPOSITE`.

    A sign is flipped where the position moves about as far as the command. A joint that moves far
    less may be another one, which the excited joint pushes the other way.

    Args:
        excitation: Excitation of a joint.
        joint: Its model.

    Returns:
        What was seen and the way out; empty if the signs agree.
    """
    response = slow_response(excitation, joint)
    gain = abs(response)
    if not response.real < OPPOSITE * gain:
        return ""
    seen = "at low frequency the position moves against the command"
    remedy = "negate the position or the command when reading"
    if 1.0 / FOLLOWS < gain < FOLLOWS:
        return f"{seen}; a sign is flipped: {remedy}"
    return (
        f"{seen}, {gain:.2g} times as far; so would look, and this log does not tell them apart: a "
        f"flipped sign ({remedy}) beside another scale or a drive that is far too weak, and the "
        "column of another joint, which the excited one pushes the other way (--joint-order, "
        "--joint-names)"
    )


def slow_response(excitation: Excitation, joint: Joint) -> complex:
    """Compute the response of a joint to the slow part of its command, as `slow_gain_of` does.

    Args:
        excitation: Excitation of a joint.
        joint: Its model.

    Returns:
        Complex gain; NaN where nothing slow is excited or the motion is not coherent with it.
    """
    return slow_gain_of(excitation, joint, excitation.position)


def slow_gain_of(excitation: Excitation, joint: Joint, motion: Array) -> complex:
    """Compute the response of some motion to the slow part of a command.

    `sum(conj(U) Y) / sum(conj(U) U)` over the excited frequencies from `LOWEST_HZ` to a fifth of
    the joint's band, for the spectra U of the command and Y of the motion.

    Args:
        excitation: Excitation of a joint, which has the command.
        joint: Its model.
        motion: Position of this or another joint at the samples of the excitation, shape (n,).

    Returns:
        Complex gain; NaN where nothing slow is excited or the motion is not coherent with it.
    """
    time = excitation.time
    grid, step = np.linspace(time[0], time[-1], len(time), retstep=True)
    command = np.interp(grid, time, excitation.command)
    position = np.interp(grid, time, motion)
    command_spectrum = np.fft.rfft(command - command.mean())
    position_spectrum = np.fft.rfft(position - position.mean())
    hz = np.fft.rfftfreq(len(grid), float(step))
    top_hz = min(SLOWEST_TOP_HZ, SLOW_SHARE * joint.band_hz[1])
    slow = (hz >= LOWEST_HZ) & (hz <= top_hz)
    size = np.abs(command_spectrum)
    excited = slow & (size > EXCITED_SHARE * size[slow].max(initial=0.0))

    cross = complex(np.vdot(command_spectrum[excited], position_spectrum[excited]))
    command_power = float(np.sum(np.abs(command_spectrum[excited]) ** 2))
    position_power = float(np.sum(np.abs(position_spectrum[excited]) ** 2))
    if command_power == 0.0 or position_power == 0.0:
        return complex(math.nan)
    if abs(cross) ** 2 < COHERENT * command_power * position_power:
        return complex(math.nan)
    return cross / command_power


# ---- flags: what weakens a match ----


def standstill(excitation: Excitation, joint: Joint) -> str:
    """Say when a joint stands still for a second while its command moves.

    Inside the joint's band it stands where it moves by less than `STILL_SHARE` of its command;
    above the band, where the reading does not change at all.

    Args:
        excitation: Excitation of a joint.
        joint: Its model.

    Returns:
        What was seen and the way out; empty if the joint moves.
    """
    time = excitation.time
    least_travel = max(0.5 * float(np.ptp(excitation.command)), STILL_COMMAND_RAD)
    edges = np.searchsorted(time, np.arange(time[0], time[-1], 1.0))
    for first, stop in pairwise(edges):
        command = excitation.command[first:stop]
        if stop - first < 4 or np.ptp(command) < least_travel:
            continue
        crossings = np.count_nonzero(np.diff(np.sign(command - command.mean())))
        inside_band = crossings <= 2.0 * joint.band_hz[1]
        travel = float(np.ptp(excitation.position[first:stop]))
        slow_standstill = inside_band and travel < STILL_SHARE * float(np.ptp(command))
        if travel == 0.0 or slow_standstill:
            gain = abs(slow_response(excitation, joint))
            units = ""
            column_units = _column_units(gain)
            if column_units is not None:
                units = f"{_looks_of_two_units(gain, column_units)}, "
            return (
                f"standstill: {excitation.joint} does not move at {time[first]:.1f} s while its "
                f"command does; {units}a drive that is off, an encoder that is stuck and friction "
                "above the torque of the drive all show like this: check them and record again"
            )
    return ""


def small_command(excitation: Excitation) -> str:
    """Say when a command swings by less than `LEAST_DEGREES` degrees.

    So little is lost in the dry friction of most drives. A file in radians that is read in degrees
    has such commands, and nothing else in it shows the unit.

    Args:
        excitation: Excitation of a joint.

    Returns:
        What was seen and the way out; empty for a larger command.
    """
    swing = 0.5 * float(np.ptp(excitation.command))
    if swing * DEGREES >= LEAST_DEGREES:
        return ""
    return (
        f"amplitude: the command swings by {swing:.2g} rad, {swing * DEGREES:.2g} degrees, less "
        "than the dry friction of most drives lets through; excite it farther, or read the log "
        "with --unit rad if its angles are in radians"
    )


JUMP_SPEED = 3.0
"""Speed between two samples, over the no-load speed of the drive, from which on a position jumps:
no drive turns so fast, and three times leave room for a wrong no-load speed in the robot's file."""
JUMP_RAD = 0.1
"""Least jump of a position that counts [rad]: far above the noise of an encoder at any rate."""


def slow_gain(excitation: Excitation, robot: RobotSpec) -> str:
    """Say when a joint moves farther than commanded: by `AMPLIFIED` or more, in all too.

    Against a stiffness `k` and a pull `g` of gravity a drive follows slow commands with a gain of
    `k / (k + g)`, which is above 1 where gravity pulls the joint over. Neither friction nor a limit
    of the torque makes it larger.

    Args:
        excitation: Excitation of a joint.
        robot: The robot.

    Returns:
        What was seen and the way out; empty if the gain is explained.
    """
    joint = robot.joint(excitation.joint)
    gain = abs(slow_response(excitation, joint))
    # Of a small command the little that is slow may be less than what else moves the joint.
    is_larger = np.ptp(excitation.position) >= AMPLIFIED * np.ptp(excitation.command)
    if not (gain >= AMPLIFIED and is_larger):
        return ""
    stiffness = joint.stiffness
    if excitation.log.stiffness is not None:
        stated = float(excitation.log.stiffness[excitation.log.column(excitation.joint)])
        stiffness = stated if math.isfinite(stated) else stiffness
    _, pull = bench_inertia(robot, joint.original[0])
    if stiffness + pull <= 0.0 or gain < AMPLIFIED * stiffness / (stiffness + pull):
        return ""
    return (
        f"{SLOW_GAIN}at low frequency {excitation.joint} moves {gain:.2g} times as far as its "
        "command, which no stiffness explains; columns of two scales look so (one of them at the "
        "motor and the other at the joint, or in another unit), and a command that is not the one "
        "the drive got: name the right columns, or give --scale"
    )


def position_jump(excitation: Excitation, joint: Joint) -> str:
    """Say when the position jumps between two samples, as after a reset of the encoder.

    Args:
        excitation: Excitation of a joint.
        joint: Its model, which has the no-load speed.

    Returns:
        What was seen and the way out; empty if nothing jumps.
    """
    changes = np.abs(np.diff(excitation.position))
    speeds = changes / np.diff(excitation.time)
    jumps = (changes > JUMP_RAD) & (speeds > JUMP_SPEED * joint.drive.no_load_speed)
    if not jumps.any():
        return ""
    largest = int(np.argmax(np.where(jumps, changes, 0.0)))
    return (
        f"position column: it jumps by {changes[largest]:.2g} rad between two samples at "
        f"{excitation.time[largest]:.2f} s, {int(jumps.sum())} times in all, faster than the drive "
        "turns without a load; use the part of the log before or after, or record again"
    )


def too_few_samples(excitation: Excitation, joint: Joint) -> str:
    """Say when a log is too slow for the band: `rate / top of the band < SAMPLES_A_PERIOD`.

    Args:
        excitation: Excitation of a joint.
        joint: Its model.

    Returns:
        What was seen and the way out; empty if the rate suffices.
    """
    top_hz = joint.band_hz[1]
    samples = excitation.log.rate_hz / top_hz
    if samples >= SAMPLES_A_PERIOD:
        return ""
    return (
        f"sample rate: {excitation.log.rate_hz:.3g} samples a second are {samples:.2g} a period at "
        f"{top_hz:g} Hz, fewer than {SAMPLES_A_PERIOD:g}; log faster, or lower the joint's band"
    )


def wrong_clock(excitation: Excitation, policy_rate_hz: float) -> str:
    """Say when commands that are held between ticks change at another rate than stated.

    The period T of the ticks is where `|sum(|change| exp(2 pi i t / T))|` is largest near the
    stated one; that sum over `sum(|change|)` is the sharpness, 1 where the command changes at the
    ticks alone. The stated rate is the log's, or else the robot's policy rate.

    Args:
        excitation: Excitation of a joint.
        policy_rate_hz: Rate at which the robot's commands are sent [Hz].

    Returns:
        What was seen and the way out; empty if the rates agree or nothing can be said.
    """
    log = excitation.log
    stated_hz = log.origin.metadata.get("command_rate_hz")
    tick_s = 1.0 / (float(stated_hz) if stated_hz else policy_rate_hz)
    if log.rate_hz * tick_s < 3.0:
        return ""  # too few samples in a tick to see when the command changes
    changes = np.abs(np.diff(excitation.command))
    if not changes.any():
        return ""
    period_s, sharpness = _period_of_changes(excitation.time[1:], changes, tick_s)
    if sharpness < SMOOTHED and not stated_hz:
        return ""  # commands that are computed for every sample have no ticks
    difference = abs(period_s / tick_s - 1.0)
    if not stated_hz and difference > OTHER_RATE:
        return ""  # sent at a rate of its own, which the robot's file need not know
    moving = np.flatnonzero(changes)
    held_share = float(np.mean(changes[moving[0] : moving[-1] + 1] == 0.0))
    if sharpness > HELD and difference > CLOCK_TOLERANCE:
        cause = "the timestamps run at a wrong rate: check the clock and the unit of the time"
        if not stated_hz:
            cause += (
                ", or the command was sent at another rate than the robot's policy rate: state the "
                "rate of the commands in the log or the robot's file"
            )
        return (
            f"clock: the command changes every {1e3 * period_s:.2f} ms instead of every "
            f"{1e3 * tick_s:.2f} ms, {period_s / tick_s:.4f} times; {cause}"
        )
    smoothed = sharpness < HELD and held_share < HELD_SHARE
    if smoothed and (stated_hz or difference < CLOCK_TOLERANCE):
        return (
            f"command column: it changes all the time instead of once in {1e3 * tick_s:.1f} ms; it "
            "was filtered or interpolated: log the command as it was sent"
        )
    return ""


def _period_of_changes(times: Array, changes: Array, tick_s: float) -> tuple[float, float]:
    """Return the period near a tick at which changes recur [s], and its sharpness from 0 to 1."""
    span = float(times[-1] - times[0])
    rate_hz = (len(times) - 1) / span
    padded = 4 * len(changes)
    spectrum = np.abs(np.fft.rfft(changes, padded))
    hz = np.fft.rfftfreq(padded, 1.0 / rate_hz)
    near = np.flatnonzero((hz > 0.75 / tick_s) & (hz < 1.33 / tick_s))
    peak_hz = hz[near[np.argmax(spectrum[near])]]
    # The timestamps themselves, about the peak, at a tenth of the resolution of the excitation.
    fine_hz = peak_hz + np.linspace(-0.5, 0.5, 21) / span
    changed = changes > 0.0
    turns = np.exp(2j * np.pi * np.outer(fine_hz, times[changed]))
    lengths = np.abs(turns @ changes[changed])
    best = int(np.argmax(lengths))
    return 1.0 / float(fine_hz[best]), float(lengths[best] / changes.sum())


def effort_limit_measured(excitation: Excitation, joint: Joint) -> str:
    """Say for how much of the time the measured torque of a drive is at its effort limit.

    Without a torque column nothing is said before the fit: the gains that are stated for a drive
    may be off by half, and so would be the torque that they ask for
    (`torque_limit.effort_limit_reached` judges by the matched ones).

    Args:
        excitation: Excitation of a joint.
        joint: Its model, which has the effort limit.

    Returns:
        What was seen and the way out; empty if the torque stays below the limit.
    """
    torque = excitation.torque
    limit = joint.drive.effort_limit
    if excitation.log.origin.metadata.get("torque") == TORQUE_COMPUTED or torque is None:
        return ""
    stiffness = excitation.log.stiffness
    column = excitation.log.column(excitation.joint)
    stated = math.nan if stiffness is None else float(stiffness[column])
    return effort_limit_flag(np.abs(torque), limit, stated, excitation.amplitude)


def effort_limit_flag(torque: Array, limit: float, stiffness: float, amplitude: float) -> str:
    """Say for how much of the time torques are at or above a limit.

    Args:
        torque: Sizes of the torque [N m], shape (n,).
        limit: The limit [N m]; infinite where there is none.
        stiffness: Stiffness of the drive [N m/rad], for a fitting amplitude; NaN if unknown.
        amplitude: Amplitude of the excitation [rad].

    Returns:
        What was seen and the way out; empty for less than `LIMITED_SHARE` of the time.
    """
    if not math.isfinite(limit) or not np.ptp(torque) > 0.0:
        return ""
    share = float(np.mean(torque >= limit))
    if share < LIMITED_SHARE:
        return ""
    remedy = "excite it with a smaller amplitude"
    if FITTING_SHARE * limit < amplitude * stiffness:
        remedy = f"excite it with {FITTING_SHARE * limit / stiffness:.2g} rad or less"
    return (
        f"{EFFORT_LIMIT}for {100.0 * share:.0f} % of the excitation the torque is at or above the "
        f"{limit:g} N m of the drive (up to {torque.max():.3g} N m), where the joint does "
        f"not respond linearly; {remedy}, or correct effort_limit in the robot's file"
    )


# ---- after the fit ----

LIKELY_CAUSES = (
    "friction that depends on load or speed",
    "backlash or a dead band",
    "a compliance between motor and link",
    "an inertia or a payload that the model does not have",
    "a wrong scale of the position",
    "a filter of the position, of the speed or of the command",
    "a slow torque",
    "an integral part, a feed-forward or a profile in the servo",
    "a torque or speed limit",
)
"""What makes a response that no gains reach. One response does not tell them apart: each of the
mechanisms of `tests/joint_mechanisms.py` is closest, for some size of it, to one of the others."""


def check_response(
    measured: FrequencyResponse,
    simulated: ComplexArray,
    used: Mask,
    limit_db: float,
    *,
    cause_is_named: bool = False,
) -> tuple[str, ...]:
    """Check the response with the matched gains against the measured one.

    The error is `20 log10 |simulated / measured|`, its size the root mean square over the used
    frequencies.

    Args:
        measured: Measured response of a joint.
        simulated: Simulated response with the matched gains, shape (f,).
        used: Frequencies that the match compares, shape (f,).
        limit_db: Error above which the gains are no match [dB].
        cause_is_named: True if another flag says why, so that no causes are listed.

    Returns:
        A flag that begins with `NO_MATCH` and says how large the error is, at which frequencies,
        and what would look so; none if the gains are a match.
    """
    error_db = DB * np.log(np.abs(simulated[used] / measured.response[used]))
    size_db = float(np.sqrt(np.mean(error_db**2)))
    if size_db <= limit_db:
        return ()
    hz = measured.frequency_hz[used]
    thirds = np.array_split(np.arange(len(hz)), 3)
    sizes_db = [float(np.sqrt(np.mean(error_db[third] ** 2))) for third in thirds]
    third = thirds[int(np.argmax(sizes_db))]
    direction = "less" if error_db[third].mean() > 0.0 else "more"
    flag = (
        f"{NO_MATCH}the best gains miss the measured response by {size_db:.2g} dB RMS, more than "
        f"{limit_db:.2g} dB; from {hz[third[0]]:.2g} to {hz[third[-1]]:.2g} Hz, where the error is "
        f"largest, the real joint moves {direction} than the simulated one"
    )
    if cause_is_named:
        return (flag,)
    return (
        f"{flag}. So would look, and this log does not tell them apart: {', '.join(LIKELY_CAUSES)}",
    )


UNEXPLAINED = 0.05
"""Error in time, as a share of the amplitude and without the noise of the encoder, from which on it
is said that a match leaves some of the motion unexplained: 0.4 dB. Of 60 honest joints of 5 g to
50 kg (`tests/joint_mechanisms.py`, seed 4101) 56 leave up to 0.011; the largest, 0.015 to 0.039,
have commands at 100 or 200 Hz in a log of 188 Hz, which does not show when they were sent. Below it
the total interval holds what such an error may hide (`uncertainty.widen_by_misfit`)."""
STEPPED = 0.25
"""Share of different readings up to which a position counts as one of an encoder with steps."""


def unexplained_motion(
    excitations: Sequence[Excitation], rmse: float, amplitude: float
) -> tuple[str, ...]:
    """Say how much of a joint's motion a fit in time leaves unexplained.

    Args:
        excitations: Excitations of the joint.
        rmse: Root mean square error of the fit [rad]; NaN where it was not fitted in time.
        amplitude: Largest amplitude of the command [rad].

    Returns:
        A flag with the error and what would look so; none if it is below `UNEXPLAINED`.
    """
    readings = np.concatenate([excitation.position for excitation in excitations])
    levels = np.unique(readings)
    noise = 0.0
    if 1 < len(levels) < STEPPED * len(readings):
        noise = float(np.median(np.diff(levels))) / math.sqrt(12.0)
    unexplained = math.sqrt(max(rmse**2 - noise**2, 0.0)) if math.isfinite(rmse) else 0.0
    if unexplained <= UNEXPLAINED * amplitude:
        return ()
    return (
        f"unexplained: the best gains leave {1e3 * unexplained:.2g} mrad RMS of the motion "
        f"unexplained, {100.0 * unexplained / amplitude:.2g} % of the amplitude, so their values "
        "hold for this motion alone. So would look, and this log does not tell them apart: "
        f"{', '.join(LIKELY_CAUSES)}",
    )


STANDS_ELSEWHERE = 0.1
"""Mean difference of position, as a share of the amplitude, from which on a joint that gravity
loads does not stand where the simulated one does. Matched joints of a real Go2 and a real SO-101
that moved together are within 0.013 of it; the hips of a Go2 whose columns of left and right are
exchanged are off by 0.23 to 0.34."""


def check_mean_position(
    measured: Sequence[Array], simulated: Sequence[Array], amplitude: float
) -> tuple[str, ...]:
    """Check where a joint that moved together with others stands on the mean.

    How far a joint sags under gravity shows its stiffness where joints moved together, so that a
    sag that the model does not have ends in a wrong stiffness however well the motion about the
    mean fits.

    Args:
        measured: Measured positions of the joint [rad], shape (n,) a recording.
        simulated: Simulated positions with the matched gains [rad], shape (n,) a recording.
        amplitude: Half of the largest travel of the joint's command [rad].

    Returns:
        A flag that begins with `NO_MATCH` and says how far it is off and what would look so; none
        where it stands within `STANDS_ELSEWHERE` of the amplitude.
    """
    differences = []
    for simulated_position, measured_position in zip(simulated, measured, strict=True):
        differences.append(simulated_position - measured_position)
    mean = float(np.concatenate(differences).mean())
    if not abs(mean) > STANDS_ELSEWHERE * amplitude:
        return ()
    return (
        f"{NO_MATCH}pose: on the mean the joint stands {abs(mean):.2g} rad "
        f"{'below' if mean > 0.0 else 'above'} the simulated one, "
        f"{100.0 * abs(mean) / amplitude:.0f} % of the amplitude, so that its stiffness makes up "
        "for a sag that the model does not have. So would look, and this log does not tell them "
        "apart: columns of another joint, as left and right exchanged (--joint-order), a base that "
        "hangs otherwise than in the model, an offset of the encoder, a wrong sign, and a payload",
    )


def check_armature(
    joint: Joint, parameters: Sequence[str], excitations: Sequence[Excitation]
) -> tuple[str, ...]:
    """Check that the rotor inertia with which gains are matched can be that of a motor.

    Gains of a joint whose rotor inertia is left out may answer nearly alike and be several times
    too small. The virtual robot of a model without it has none either.

    Args:
        joint: The joint.
        parameters: Names of the parameters that are fitted.
        excitations: Its excitations.

    Returns:
        A flag that begins with `NO_MATCH` if the robot's file has no rotor inertia for the joint.
    """
    virtual = all(excitation.log.virtual for excitation in excitations)
    if joint.drive.armature > 0.0 or "armature" in parameters or virtual:
        return ()
    return (
        f"{NO_MATCH}armature: the rotor inertia of {joint.name} is 0 in the robot's file; write "
        "the motor's rotor inertia times the gear ratio squared there, from its data sheet, or fit "
        "it with --mode drive",
    )


def check_explained_motion(
    measured: Sequence[Array], simulated: Sequence[Array]
) -> tuple[str, ...]:
    """Check the motion of a joint of which no response could be estimated.

    The explained share is `1 - mean((simulated - measured)^2) / var(measured)`, each recording
    about its mean, so that an encoder's offset does not count.

    Args:
        measured: Measured positions of the joint [rad], shape (n,) a recording.
        simulated: Simulated positions with the matched gains [rad], shape (n,) a recording.

    Returns:
        A flag that begins with `NO_MATCH` if less than `EXPLAINED_MIN` is explained.
    """
    error = 0.0
    motion = 0.0
    for measured_position, simulated_position in zip(measured, simulated, strict=True):
        difference = simulated_position - measured_position
        error += float(np.sum((difference - difference.mean()) ** 2))
        motion += float(np.sum((measured_position - measured_position.mean()) ** 2))
    explained = 1.0 - error / motion if motion > 0.0 else 0.0
    if explained >= EXPLAINED_MIN:
        return ()
    return (
        f"{NO_MATCH}the simulation explains {100.0 * max(explained, 0.0):.0f} % of the joint's "
        f"motion, less than {100.0 * EXPLAINED_MIN:.0f} %, and no response of it could be "
        "compared; record a motion in which this joint moves more",
    )
