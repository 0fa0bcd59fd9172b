"""Plausibility of a log: timestamps, motion of the joints, unit of the angles, correlation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from pronk.arrays import Array
from pronk.errors import LogError
from pronk.identify.logs.joint_log import Excitation, JointLog

TIME_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Seconds in each unit of time."""
PLAUSIBLE_HZ = (5.0, 50_000.0)
"""Rates outside mean a wrong unit: slower ones do not resolve a joint, no drive logs faster."""
RATE_TOLERANCE = 1e-3
"""Largest relative difference of the measured from an expected rate. Crystals keep 1e-4; at 1e-3 a
20 s sweep slips by one 50 Hz tick from its end to its start."""
_GAP = 2.5
"""Intervals longer than this many typical ones are gaps: more than one sample is lost."""

LARGEST_COMMAND = 6.3
"""Largest plausible peak of a command about its middle: a full turn [rad]."""
LARGEST_POSITION = 4.0 * np.pi
"""Largest plausible position: two turns [rad]."""

_UNMOVED = 0.01
"""Share of the command's travel below which a joint did not move; chirps begin far below any
joint's bandwidth, where it follows one to one."""
_FEW_STEPS = 3.0
"""Encoder steps within which a joint counts as unmoved."""
_NEAR_END = 0.005
"""Share of the position's travel that counts as being at its end."""
_MOVES_ON = 0.15
"""Share of its own travel that the command must move outward meanwhile. A joint that friction holds
at its turning point stands still while the command comes back, not while it moves on."""
_LONG_RUN_S = 0.1
"""Time at an end from which on it is not the turning point of an oscillation [s]."""
_SATURATED = 0.05
"""Share of the time at an end, in such runs, that makes a joint saturated."""

CORRELATION_LIMIT = 0.1
"""Highest absolute correlation of two simultaneous commands that passes without a warning."""
_REACH_S = 0.5
"""Lags that are searched [s]: longer than a joint's impulse response."""


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Regularity of measured timestamps."""

    samples: int
    duration_s: float
    rate_hz: float
    """Mean over the whole record."""
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
        return sum(round(length / self.typical_s) - 1 for _, length in self.gaps)

    def words(self) -> str:
        """One line for a log's notes."""
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


def examine(time: Array) -> Timing:
    """Rate, jitter, drift and gaps of two or more increasing timestamps [s]."""
    steps = np.diff(time)
    typical = float(np.median(steps))
    gap = steps > _GAP * typical
    straight = np.polynomial.Polynomial.fit(np.arange(len(time)), time, 1)
    duration = float(time[-1] - time[0])
    return Timing(
        samples=len(time),
        duration_s=duration,
        rate_hz=(len(time) - 1) / duration,
        typical_s=typical,
        jitter_s=float(np.std(steps[~gap])),
        drift_s=float(np.abs(time - straight(np.arange(len(time)))).max()),
        gaps=tuple((float(time[i]), float(steps[i])) for i in np.flatnonzero(gap)),
    )


def check_unit(time: Array, where: str, unit: str) -> None:
    """Refuse timestamps [s], converted from `unit`, whose rate fits another, which is named."""
    rate = 1.0 / float(np.median(np.diff(time)))
    low, high = PLAUSIBLE_HZ
    if low <= rate <= high:
        return
    rates = {name: rate * TIME_UNITS[unit] / scale for name, scale in TIME_UNITS.items()}
    hint = "no unit of time fits them"
    if fitting := [name for name, hz in rates.items() if low <= hz <= high]:
        # Where several fit, the one nearest to the 500 Hz at which joints are usually logged.
        likely = min(fitting, key=lambda name: abs(np.log(rates[name] / 500.0)))
        hint = f"the timestamps are probably in {likely} (--time-unit {likely}, or convert them)"
    raise LogError(
        f"{where}: read in {unit!r}, its samples come at {rate:.4g} Hz; expected {low:g} to "
        f"{high:g} Hz; {hint}."
    )


def check_rate(timing: Timing, where: str, expected_hz: float) -> None:
    """Refuse an expected rate that differs from the measured one; the LogError gives both."""
    if not (np.isfinite(expected_hz) and expected_hz > 0.0):
        raise LogError(f"{where}: --rate-hz {expected_hz}; expected a positive number.")
    # Lost samples do not make the clock slow.
    measured = (timing.samples + timing.lost - 1) / timing.duration_s
    if abs(measured / expected_hz - 1.0) > RATE_TOLERANCE:
        late = abs(timing.samples / expected_hz - timing.samples / measured)
        raise LogError(
            f"{where}: --rate-hz {expected_hz:g}, but the timestamps come at {measured:.2f} Hz "
            f"({late:.2f} s apart by the end); leave --rate-hz out to use the timestamps."
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
            "the joint free, and the columns named right."
        )


def saturation_note(log: JointLog, joint: str) -> str:
    """A warning for a joint that rests at an end while its command moves on, or ""."""
    column = log.column(joint)
    position, command = log.position[:, column], log.command[:, column]
    travel, commanded = float(np.ptp(position)), float(np.ptp(command))
    if travel == 0.0 or commanded == 0.0:
        return ""
    total = 0.0
    for sign in (1.0, -1.0):
        near = sign * position >= (sign * position).max() - _NEAR_END * travel
        for first, stop in np.flatnonzero(np.diff(np.pad(near, 1))).reshape(-1, 2):
            length = float(log.time[stop - 1] - log.time[first])
            outward = sign * command[first:stop]
            if length >= _LONG_RUN_S and outward.max() - outward[0] > _MOVES_ON * commanded:
                total += length
    if (share := total / float(log.time[-1] - log.time[0])) <= _SATURATED:
        return ""
    return (
        f"{joint} is saturated: for {100.0 * share:.0f} % of the time it stays at an end of its "
        "travel while its command moves on; excite it with a smaller amplitude or farther from "
        "its stops"
    )


def check_radians(log: JointLog, joint: str) -> None:
    """Refuse a joint in radians that moves as only degrees would."""
    column = log.column(joint)
    command, position = log.command[:, column], log.position[:, column]
    peak = 0.5 * float(np.ptp(command))
    farthest = float(max(np.abs(position).max(), np.abs(command).max()))
    if log.unit(joint) != "rad" or (peak <= LARGEST_COMMAND and farthest <= LARGEST_POSITION):
        return
    what = f"it reaches {farthest:.3g}"
    if peak > LARGEST_COMMAND:
        what = f"its command swings by {peak:.3g}"
    raise LogError(
        f"{log.source or 'log'}: {joint} is read in radians and {what}, more than a joint "
        "turns; the file is probably in degrees (--unit deg, or convert it)."
    )


def correlation_note(time: Array, command: Array, joints: Sequence[str]) -> str:
    """A warning naming the two most alike commands (n, joints), or "" where none exceeds the limit.

    The largest absolute correlation over lags up to half a second counts. With correlated commands,
    the motion that one joint causes in another looks like a response to the other's own command:
    the coherence stays near one while the response is wrong. A command that never changes
    correlates with nothing.
    """
    from scipy.signal import correlate  # slow to import

    # The command is held, so reading it on a uniform grid moves no edge by more than a sample.
    rate_hz = (len(time) - 1) / float(time[-1] - time[0])
    grid = time[0] + np.arange(len(time)) / rate_hz
    index = np.clip(np.searchsorted(time, grid + 0.5 / rate_hz) - 1, 0, len(time) - 1)
    centred = command[index] - command[index].mean(axis=0)
    size = np.linalg.norm(centred, axis=0)
    moving = [i for i in range(len(joints)) if size[i] > 1e-9 * np.sqrt(len(time))]
    middle = len(time) - 1
    reach = min(round(_REACH_S * rate_hz), middle)
    largest, alike = CORRELATION_LIMIT, ""
    for one, other in combinations(moving, 2):
        first, second = (centred[:, i] / size[i] for i in (other, one))
        lags = correlate(first, second, method="fft")
        peak = float(np.abs(lags[middle - reach : middle + reach + 1]).max())
        if peak > largest:
            largest, alike = peak, f"{joints[other]} and {joints[one]}"
    return alike and (
        f"the commands of {alike} correlate to {min(largest, 1.0):.2f} (limit "
        f"{CORRELATION_LIMIT:g}): a response may contain the effect of one joint on the other; "
        "excite one joint at a time or use multisines on different harmonics"
    )
