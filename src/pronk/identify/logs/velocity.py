"""The velocity column of a log beside the derivative of its position.

Logs hold velocities of another unit, of another sign, filtered by the drive, or of the motor's side
of a gear. A velocity that is not the derivative of the position is not used, and said with its
number.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pronk.arrays import Array
from pronk.identify.logs.joint_log import JointLog

TOP_SHARE = 0.1
"""Share of the log's rate up to which the two are compared: above it the derivative of the position
is noise."""
TOP_HZ = 10.0
"""Highest frequency at which the two are compared [Hz]: twice that of most motions of robots."""
LONGEST_SHIFT_S = 0.1
"""Longest delay of the column that is searched [s]: more than any filter of a drive has."""
SCALE_ERROR = 0.1
"""Relative difference of the scale from which on the column is another quantity."""
LATE_S = 0.03
"""Delay of the column from which on it is no velocity of the sample it stands in [s]. Servos on a
bus read it a sample of 20 ms apart (SO-101); at 5 Hz this is 54 degrees."""
ALIKE = 0.9
"""Correlation from which on the column is the velocity but for scale and delay."""
AS_GOOD = 1e-3
"""Correlation by which another shift has to be better."""
SAMPLES_A_PERIOD = 20.0
"""Samples in a period of the highest compared frequency."""
LEAST_MOTION_RAD = 0.01
"""Least root mean square motion of a position whose derivative tells something [rad]."""


@dataclass(frozen=True, kw_only=True)
class VelocityColumn:
    """What the velocity column of a joint is, beside the derivative of its position."""

    scale: float
    """Column over derivative, negative where the signs differ."""
    delay_s: float
    """How much later the column is [s]."""
    correlation: float
    """Correlation of the two, without the delay, 0 to 1."""

    @property
    def usable(self) -> bool:
        """True if the column is the derivative of the position."""
        return (
            self.correlation >= ALIKE
            and abs(self.scale - 1.0) <= SCALE_ERROR
            and abs(self.delay_s) <= LATE_S
        )

    def note(self, joint: str) -> str:
        """Say what the column is; empty if it is the velocity of the joint."""
        if self.usable:
            return ""
        if self.correlation < ALIKE:
            return (
                f"the velocity column of {joint} is not the derivative of its position "
                f"(correlation {self.correlation:.2f}) and is not used"
            )
        late = ""
        if abs(self.delay_s) > LATE_S:
            when = "later" if self.delay_s > 0.0 else "earlier"
            late = f" and {1e3 * abs(self.delay_s):.0f} ms {when}"
        return (
            f"the velocity column of {joint} is {self.scale:.3g} times the derivative of its "
            f"position{late} (correlation {self.correlation:.4f}) and is not used"
        )


def velocity_column(log: JointLog, joint: str) -> VelocityColumn | None:
    """Compare the velocity of a joint with the derivative of its position.

    Args:
        log: A log.
        joint: One of its joints.

    Returns:
        What the column is; None if there is none, if the joint hardly moves, or if the log is too
        short to tell.
    """
    if log.velocity is None:
        return None
    column = log.column(joint)
    rate_hz = log.rate_hz
    count = len(log.time)
    if count < 64 or np.std(log.position[:, column]) < LEAST_MOTION_RAD:
        return None
    grid = np.linspace(log.time[0], log.time[-1], count)
    position = np.interp(grid, log.time, log.position[:, column])
    velocity = np.interp(grid, log.time, log.velocity[:, column])
    cutoff_hz = min(TOP_HZ, TOP_SHARE * rate_hz)
    stride = max(1, int(rate_hz / (SAMPLES_A_PERIOD * cutoff_hz)))
    derivative = _slow_part(np.gradient(position, grid), rate_hz, cutoff_hz)[::stride]
    slow_velocity = _slow_part(velocity, rate_hz, cutoff_hz)[::stride]
    if np.std(slow_velocity) == 0.0 or np.std(derivative) == 0.0:
        return VelocityColumn(scale=0.0, delay_s=0.0, correlation=0.0)
    reach = min(round(LONGEST_SHIFT_S * rate_hz / stride), len(derivative) // 8)
    shifts = range(-reach, reach + 1)
    correlations = {shift: _correlation(derivative, slow_velocity, shift) for shift in shifts}
    highest = max(abs(correlation) for correlation in correlations.values())
    # A sine of the other sign is the same sine half a period later: the shortest shift counts.
    near = [shift for shift in shifts if abs(correlations[shift]) >= highest - AS_GOOD]
    shift = min(near, key=abs)
    ratio = float(np.std(slow_velocity) / np.std(derivative))
    return VelocityColumn(
        scale=float(np.copysign(ratio, correlations[shift])),
        delay_s=shift * stride / rate_hz,
        correlation=abs(correlations[shift]),
    )


def _slow_part(values: Array, rate_hz: float, cutoff_hz: float) -> Array:
    """Return the part of some values below a frequency, without phase shift."""
    from scipy import signal  # slow to import

    sections = signal.butter(2, cutoff_hz, fs=rate_hz, output="sos")
    return np.asarray(signal.sosfiltfilt(sections, values - values.mean()))


def _correlation(derivative: Array, velocity: Array, shift: int) -> float:
    """Return the correlation of a derivative with a velocity that is `shift` samples later."""
    count = len(derivative) - abs(shift)
    first = derivative[max(-shift, 0) : max(-shift, 0) + count]
    second = velocity[max(shift, 0) : max(shift, 0) + count]
    return float(np.corrcoef(first, second)[0, 1])


def velocity_note(log: JointLog, joint: str, source: str) -> str:
    """Say behind the name of a file what its velocity column is; empty if nothing is wrong."""
    comparison = velocity_column(log, joint)
    if comparison is None or comparison.usable:
        return ""
    return f"{source}: {comparison.note(joint)}"
