"""Plausibility of a log: timestamps, motion of the joints, unit of the angles, correlation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from pronk.arrays import Array
from pronk.errors import LogError
from pronk.identify.logs.joint_log import Excitation, JointLog
from pronk.identify.logs.options import ANGLE_UNITS, TIME_UNITS

PLAUSIBLE_HZ = (5.0, 50_000.0)
"""Lowest and highest sample rate that a log can have [Hz]; another one means a wrong unit, as a
slower log does not resolve a joint and no drive logs faster."""
RATE_TOLERANCE = 1e-3
"""Largest relative difference of the measured from an expected rate. Crystals keep 1e-4; at 1e-3 a
sweep of 20 s slips by one tick of 50 Hz from its start to its end."""
_GAP = 2.5
"""Intervals longer than this many typical ones are gaps: more than one sample is lost."""

LARGEST_COMMAND = 6.3
"""Largest plausible peak of a command about its middle: a full turn [rad]."""
LARGEST_POSITION = 4.0 * np.pi
"""Largest plausible position: two turns [rad]."""

_ONE_UNIT = 10.0
"""Largest factor between the travels of a position and its command that may have one unit: a joint
amplifies its command by less at its resonance, and lets more through above it."""

_UNMOVED = 0.01
"""Share of the command's travel below which a joint did not move; chirps begin far below any
joint's bandwidth, where it follows one to one."""
_FEW_STEPS = 3.0
"""Encoder steps within which a joint counts as unmoved."""
_NEAR_END = 0.005
"""Share of the position's travel that counts as being at its end."""
_MOVES_ON = 0.15
"""Share of the command's travel that the command must move outward while the joint is at its end. A
joint that friction holds at its turning point stands still while the command comes back, not while
it moves on."""
_LONGEST_TURN_S = 0.1
"""Longest time at an end that is the turning point of an oscillation [s]."""
_SATURATED = 0.05
"""Share of the time from the first to the last change of a joint's command, at an end, that makes
the joint saturated."""

_LAGS_S = (0.0, 0.02, 0.04, 0.08, 0.15, 0.3)
"""Delays of a position behind its command that are tried where a command is guessed [s]."""
_LEAST_CORRELATION = 0.5
"""Least correlation of a guessed command, delayed, with the position."""
_CLOSE_CORRELATION = 0.8
"""Correlation of a position that follows closely."""
_CLOSE_SLOPE = 0.3
"""Difference from one of the slope of a position that follows closely over its command."""
_TRAVEL_RATIOS = (0.2, 5.0)
"""Travel of a position over that of its guessed command."""

CORRELATION_LIMIT = 0.1
"""Highest absolute correlation of two simultaneous commands that passes without a warning."""
_LONGEST_LAG_S = 0.5
"""Largest lag at which commands are correlated [s]: longer than a joint's impulse response."""

WRAPPED_TURN = 0.9
"""Share of a turn from which on a change between two samples is a reading that wraps: no joint
turns so far within a sample, and no other error of an encoder is as large."""
_ROUNDING_RAD = 1e-3
"""Rounding of a reading within a turn [rad]: that of three decimals, or of pi as 3.14."""


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Regularity of measured timestamps."""

    samples: int
    """Number of samples."""
    duration_s: float
    """Time from the first sample to the last [s]."""
    rate_hz: float
    """Mean sample rate over the whole record [Hz]."""
    typical_s: float
    """Median interval [s]."""
    jitter_s: float
    """Standard deviation of the intervals, gaps left out [s]."""
    drift_s: float
    """Largest deviation of the timestamps from a straight line [s]."""
    gaps: tuple[tuple[float, float], ...] = ()
    """Start [s] and length [s] of each interval in which samples are missing."""

    @property
    def lost(self) -> int:
        """Samples missing in the gaps, by the typical interval."""
        count = 0
        for _, length in self.gaps:
            count += round(length / self.typical_s) - 1
        return count

    def words(self) -> str:
        """Return one line for a log's notes."""
        text = (
            f"{self.samples} samples at {self.rate_hz:.2f} Hz over {self.duration_s:.2f} s, "
            f"jitter {1e3 * self.jitter_s:.3f} ms, drift {1e3 * self.drift_s:.2f} ms"
        )
        if self.gaps:
            start, length = max(self.gaps, key=lambda gap: gap[1])
            text += (
                f", {len(self.gaps)} gaps with about {self.lost} samples lost (the longest "
                f"{length:.3f} s at {start:.3f} s)"
            )
        return text


def examine_time(time: Array) -> Timing:
    """Measure rate, jitter, drift and gaps of two or more increasing timestamps [s]."""
    intervals = np.diff(time)
    typical = float(np.median(intervals))
    is_gap = intervals > _GAP * typical
    samples = np.arange(len(time))
    straight = np.polynomial.Polynomial.fit(samples, time, 1)
    duration = float(time[-1] - time[0])
    gaps = [(float(time[i]), float(intervals[i])) for i in np.flatnonzero(is_gap)]
    return Timing(
        samples=len(time),
        duration_s=duration,
        rate_hz=(len(time) - 1) / duration,
        typical_s=typical,
        jitter_s=float(np.std(intervals[~is_gap])),
        drift_s=float(np.abs(time - straight(samples)).max()),
        gaps=tuple(gaps),
    )


def check_unit(time: Array, source: str, unit: str) -> None:
    """Refuse timestamps whose rate fits another unit of time, which the LogError names.

    Args:
        time: Timestamps, converted from `unit` to seconds, shape (n,).
        source: The file, for the message.
        unit: Unit they were read in, one of `TIME_UNITS`.
    """
    rate_hz = 1.0 / float(np.median(np.diff(time)))
    low, high = PLAUSIBLE_HZ
    if low <= rate_hz <= high:
        return
    # Of several units that fit, the likely one is nearest to the usual rate of 500 Hz.
    likely = ""
    likely_distance = np.inf
    for name, seconds in TIME_UNITS.items():
        rate_in_unit = rate_hz * TIME_UNITS[unit] / seconds
        distance = abs(np.log(rate_in_unit / 500.0))
        if low <= rate_in_unit <= high and distance < likely_distance:
            likely = name
            likely_distance = distance
    hint = "no unit of time fits them"
    if likely:
        hint = f"the timestamps are probably in {likely} (--time-unit {likely}, or convert them)"
    raise LogError(
        f"{source}: read in {unit!r}, its samples come at {rate_hz:.4g} Hz; expected {low:g} to "
        f"{high:g} Hz; {hint}."
    )


def check_rate(timing: Timing, source: str, expected_hz: float) -> None:
    """Refuse an expected rate that differs from the measured one; the LogError gives both."""
    # Lost samples do not make the clock slow.
    measured_hz = (timing.samples + timing.lost - 1) / timing.duration_s
    if abs(measured_hz / expected_hz - 1.0) > RATE_TOLERANCE:
        apart_s = abs(timing.samples / expected_hz - timing.samples / measured_hz)
        raise LogError(
            f"{source}: --rate-hz {expected_hz:g}, but the timestamps come at {measured_hz:.2f} Hz "
            f"({apart_s:.2f} s apart by the end); leave --rate-hz out to use the timestamps."
        )


def check_motion(excitation: Excitation) -> None:
    """Refuse an excitation in which the joint did not move, with a LogError."""
    travel = float(np.ptp(excitation.position))
    commanded = float(np.ptp(excitation.command))
    levels = np.unique(excitation.position)
    encoder_step = float(np.diff(levels).min()) if len(levels) > 1 else 0.0
    few_steps = travel <= _FEW_STEPS * encoder_step and travel < 0.5 * commanded
    if travel < _UNMOVED * commanded or few_steps:
        unit = excitation.log.unit(excitation.joint)
        if unit == "unknown":
            unit = "of an unknown unit"
        raise LogError(
            f"{excitation.source or 'log'}: {excitation.joint} did not move: its command travels "
            f"{commanded:.3g} {unit}, its position {travel:.3g}; check that its drive was enabled, "
            "the joint free, the columns named right, and command and position of one unit."
        )


def position_follows(
    time: Array, command: Array, position: Array, *, closely: bool = False
) -> bool:
    """Return True if a position moves as if some numbers were the commands to it.

    Numbers that do not move are accepted. Torques and speeds differ from the position in size, in
    their middle, or in phase; a torque against gravity may not.

    Args:
        time: Timestamps [s], shape (n,).
        command: The numbers, shape (n,).
        position: Position in the same unit, shape (n,).
        closely: True to ask for a motion of nearly the same size, as of a stiff joint.
    """
    travel = float(np.ptp(command))
    moved = float(np.ptp(position))
    if travel == 0.0:
        return True
    low, high = _TRAVEL_RATIOS
    offset = abs(float(np.median(command) - np.median(position)))
    if not low < moved / travel < high or offset > 0.5 * max(travel, moved):
        return False
    for lag in _LAGS_S:
        delayed = np.interp(time - lag, time, command)
        if np.ptp(delayed) == 0.0:
            continue
        correlation = float(np.corrcoef(delayed, position)[0, 1])
        slope = correlation * float(np.std(position) / np.std(delayed))
        if not closely and correlation > _LEAST_CORRELATION:
            return True
        if correlation > _CLOSE_CORRELATION and abs(slope - 1.0) < _CLOSE_SLOPE:
            return True
    return False


def saturation_note(log: JointLog, joint: str) -> str:
    """Return a warning if a joint rests at an end while its command moves on, or ""."""
    column = log.column(joint)
    position = log.position[:, column]
    command = log.command[:, column]
    travel = float(np.ptp(position))
    commanded = float(np.ptp(command))
    if travel == 0.0 or commanded == 0.0:
        return ""
    saturated_s = 0.0
    for sign in (1.0, -1.0):
        outward = sign * position
        at_end = outward >= outward.max() - _NEAR_END * travel
        for first, stop in np.flatnonzero(np.diff(np.pad(at_end, 1))).reshape(-1, 2):
            length_s = float(log.time[stop - 1] - log.time[first])
            stretch = sign * command[first:stop]
            moves_on = stretch.max() - stretch[0] > _MOVES_ON * commanded
            if length_s >= _LONGEST_TURN_S and moves_on:
                saturated_s += length_s
    # Of a sweep of many joints each moves for a small part of the log.
    changes = np.flatnonzero(np.diff(command))
    excited_s = float(log.time[changes[-1] + 1] - log.time[changes[0]])
    share = min(saturated_s / excited_s, 1.0)
    if share <= _SATURATED:
        return ""
    return (
        f"{joint} is saturated: for {100.0 * share:.0f} % of its excitation it stays at an end of "
        "its travel while its command moves on; excite it with a smaller amplitude or farther from "
        "its stops"
    )


def check_radians(log: JointLog, joint: str) -> None:
    """Refuse a joint in radians that moves as only degrees would, with a LogError.

    Where one of command and position is too large and the other is not, the two have different
    units or zeros, which no unit of the file mends.
    """
    if log.unit(joint) != "rad":
        return
    column = log.column(joint)
    command = log.command[:, column]
    position = log.position[:, column]
    swing = 0.5 * float(np.ptp(command))
    command_farthest = float(np.abs(command).max())
    position_farthest = float(np.abs(position).max())
    command_is_large = swing > LARGEST_COMMAND or command_farthest > LARGEST_POSITION
    position_is_large = position_farthest > LARGEST_POSITION
    if not (command_is_large or position_is_large):
        return
    if swing > LARGEST_COMMAND:
        excess = f"its command swings by {swing:.3g}"
    else:
        excess = f"it reaches {max(command_farthest, position_farthest):.3g}"
    seen = (
        f"{log.source or 'log'}: {joint} is read in radians and {excess}, more than a joint turns"
    )
    moved = float(np.ptp(position))
    if command_is_large != position_is_large and swing > 0.0 and moved > 0.0:
        ratio = moved / (2.0 * swing)
        offset = abs(float(np.median(command) - np.median(position)))
        if not 1.0 / _ONE_UNIT < ratio < _ONE_UNIT:
            raise LogError(
                f"{seen}, and its position moves {ratio:.3g} times as far as its command. A column "
                f"in degrees beside one in radians ({np.rad2deg(1.0):.1f} or "
                f"{np.deg2rad(1.0):.4f} times), a position of the motor before its gear and a "
                "joint that is held look so; convert the column that is too large (--unit and "
                "--scale change both alike)."
            )
        if offset > moved + 2.0 * swing:
            raise LogError(
                f"{seen}, and its position moves {ratio:.3g} times as far as its command, but "
                f"{offset:.3g} away from it: the two have different zeros, so that no unit of the "
                "file fits both; shift one of the columns."
            )
    raise LogError(
        f"{seen}; the file is probably in degrees (--unit deg; --scale {joint}="
        f"{ANGLE_UNITS['deg']:.6f} if this joint alone is; or convert it)."
    )


def unwrapped(log: JointLog) -> JointLog:
    """Return a log whose angles do not wrap at pi, with a note where they did.

    Args:
        log: A log; its columns in radians are unwrapped, command and position alike, and a position
            that is whole turns away from its command is brought to it.
    """
    turn = 2.0 * np.pi
    command = log.command.copy()
    position = log.position.copy()
    notes = []
    for column, name in enumerate(log.joints):
        if log.unit(name) != "rad":
            continue
        changes = np.abs(np.diff(log.position[:, column]))
        wraps = int(np.sum(np.abs(changes - turn) < (1.0 - WRAPPED_TURN) * turn))
        # A reading that wraps never leaves one turn.
        if wraps == 0 or np.ptp(log.position[:, column]) > turn + _ROUNDING_RAD:
            continue
        for angles in (command, position):
            angles[:, column] = np.unwrap(angles[:, column], discont=WRAPPED_TURN * turn)
        away = float(np.median(position[:, column] - command[:, column]))
        position[:, column] -= turn * round(away / turn)
        notes.append(f"{name}: the position wraps at a turn {wraps} times; it was unwrapped")
    if not notes:
        return log
    return replace(log, command=command, position=position, notes=(*log.notes, *notes))


def correlation_note(time: Array, command: Array, joints: Sequence[str]) -> str:
    """Return a warning that names the two most correlated commands, or "" below the limit.

    The largest absolute correlation over lags up to half a second counts. With correlated commands,
    the motion that one joint causes in another looks like a response to the other's own command:
    the coherence stays near one while the response is wrong. A command that never changes
    correlates with nothing.

    Args:
        time: Timestamps [s], shape (n,).
        command: Commands in force [rad], shape (n, joints).
        joints: Names of the columns.
    """
    from scipy.signal import correlate  # slow to import

    # The command is held, so reading it on a uniform grid moves no edge by more than a sample.
    rate_hz = (len(time) - 1) / float(time[-1] - time[0])
    grid = time[0] + np.arange(len(time)) / rate_hz
    index = np.clip(np.searchsorted(time, grid + 0.5 / rate_hz) - 1, 0, len(time) - 1)
    centred = command[index] - command[index].mean(axis=0)
    norms = np.linalg.norm(centred, axis=0)
    moving = [i for i in range(len(joints)) if norms[i] > 1e-9 * np.sqrt(len(time))]
    no_lag = len(time) - 1
    reach = min(round(_LONGEST_LAG_S * rate_hz), no_lag)
    largest = CORRELATION_LIMIT
    pair = ""
    for i, j in combinations(moving, 2):
        correlation = correlate(centred[:, j] / norms[j], centred[:, i] / norms[i], method="fft")
        peak = float(np.abs(correlation[no_lag - reach : no_lag + reach + 1]).max())
        if peak > largest:
            largest = peak
            pair = f"{joints[j]} and {joints[i]}"
    if not pair:
        return ""
    return (
        f"the commands of {pair} correlate to {min(largest, 1.0):.2f} (limit "
        f"{CORRELATION_LIMIT:g}): a response may contain the effect of one joint on the other; "
        "excite one joint at a time or use multisines on different harmonics"
    )
