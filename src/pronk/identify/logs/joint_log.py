"""JointLog: commanded and measured motion of joints, in memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pronk.arrays import Array
from pronk.errors import LogError
from pronk.names import check_names

SIGNAL_KINDS = ("chirp", "log_chirp", "multisine", "sine_steps", "unknown")
_PER_JOINT = ("stiffness", "damping", "pose", "units")


@dataclass(frozen=True, kw_only=True)
class Segment:
    """One excitation: a signal sent to some joints between two instants of the log."""

    kind: str
    """One of `SIGNAL_KINDS`."""
    joints: tuple[str, ...]
    """Excited joints (several only with uncorrelated signals)."""
    start: float
    """First instant, on the clock of `JointLog.time` [s]."""
    stop: float
    """Last instant, settling included [s]."""
    amplitude: float
    """Peak of the command about the pose [rad]; NaN if unknown."""
    repeat: int = 0
    """Number of this repeat of the same excitation, from 0."""
    band_hz: tuple[float, float] = (0.0, 0.0)
    """Lowest and highest excited frequency [Hz]."""
    period_s: float | None = None
    """Period of a periodic signal [s]; None for chirps."""
    clamped: tuple[str, ...] = ()
    """Joints that were fixed mechanically meanwhile."""

    def __post_init__(self) -> None:
        """Refuse an unknown kind and a segment that ends before it starts."""
        if self.kind not in SIGNAL_KINDS:
            raise LogError(
                f"segment kind {self.kind!r}; expected one of {', '.join(SIGNAL_KINDS)}."
            )
        if not self.stop > self.start:
            raise LogError(f"a segment ends at {self.stop} s, before it starts at {self.start} s.")


@dataclass(frozen=True, kw_only=True)
class JointLog:
    """A recording of commands and positions, one column per joint.

    Positions are absolute joint angles in the robot's convention; timestamps are as measured.
    """

    robot: str
    """Name of the robot, for instance mini_cheetah."""
    joints: tuple[str, ...]
    """Names of the columns."""
    time: Array
    """Measured timestamps, strictly increasing [s], shape (n,)."""
    command: Array
    """Position command in force at each sample [rad], shape (n, joints)."""
    position: Array
    """Measured position [rad], shape (n, joints)."""
    velocity: Array | None = None
    """Measured velocity [rad/s], shape (n, joints), if there is any."""
    torque: Array | None = None
    """Measured or current-derived joint torque [N m], shape (n, joints), if there is any."""
    frequency: Array | None = None
    """Instantaneous frequency of the signal [Hz], shape (n,); NaN between excitations."""
    segments: tuple[Segment, ...] = ()
    stiffness: Array | None = None
    """Gains on the drives [N m/rad], shape (joints,); None if unknown."""
    damping: Array | None = None
    """Gains on the drives [N m s/rad], shape (joints,); None if unknown."""
    pose: Array | None = None
    """Position the signals are centred on [rad], shape (joints,)."""
    units: tuple[str, ...] | None = None
    """Unit of each column's position: `rad`, or `unknown` where the source gives another scale."""
    virtual: bool = False
    """True if the machine was pronk's virtual robot."""
    source: str = ""
    """File or link it came from."""
    sha256: str = ""
    """Hash of the file it was read from; empty for a log that was never a file."""
    complete: bool = True
    """False if the recording was cut short or its file is truncated."""
    notes: tuple[str, ...] = ()
    """Remarks of the reader: jitter, drift, gaps, dropped rows."""
    metadata: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse wrong shapes, numbers that are not finite, and time that does not increase."""
        where = self.source or "log"
        n, width = len(self.time), len(self.joints)
        check_names((self.robot, *self.joints), where, LogError)
        check_increasing(self.time, where, "sample {}".format)
        if width == 0:
            raise LogError(f"{where}: no joints.")
        if len(set(self.joints)) != width:
            raise LogError(f"{where}: a joint is named twice in {', '.join(self.joints)}.")
        shapes = dict.fromkeys(("command", "position", "velocity", "torque"), (n, width))
        for name, shape in (shapes | dict.fromkeys(_PER_JOINT, (width,))).items():
            values = getattr(self, name)
            if values is None:
                continue
            if np.shape(values) != shape:
                raise LogError(
                    f"{where}: {name} has shape {np.shape(values)}; expected {shape} "
                    f"({n} timestamps, {width} joints)."
                )
            if name in shapes and not np.isfinite(values).all():
                row, column = np.argwhere(~np.isfinite(values))[0]
                raise LogError(
                    f"{where}: {name} of {self.joints[column]} is not finite at sample {row} "
                    f"(t = {self.time[row]:.3f} s); drop or repair such rows before reading."
                )
        for segment in self.segments:
            for joint in segment.joints:
                self.column(joint)

    def column(self, joint: str) -> int:
        """Index of a joint's column; a LogError lists the joints if it is not one of them."""
        if joint not in self.joints:
            raise LogError(
                f"{self.source or 'log'}: no joint {joint!r}; it has {', '.join(self.joints)}."
            )
        return self.joints.index(joint)

    def unit(self, joint: str) -> str:
        """Unit of a joint's position, `rad` unless the log declares another."""
        return self.units[self.column(joint)] if self.units else "rad"

    @property
    def rate_hz(self) -> float:
        """Mean sample rate over the whole log [Hz]."""
        return float((len(self.time) - 1) / (self.time[-1] - self.time[0]))

    def cut(self, segment: Segment) -> JointLog:
        """The part of the log inside one segment, as a log of its own (same clock)."""
        first = int(np.searchsorted(self.time, segment.start - 1e-9))
        last = int(np.searchsorted(self.time, segment.stop + 1e-9, side="right"))
        if last - first < 2:
            raise LogError(
                f"{self.source or 'log'}: segment {segment.start:.3f} to {segment.stop:.3f} s "
                f"holds {max(last - first, 0)} samples; the log spans {self.time[0]:.3f} to "
                f"{self.time[-1]:.3f} s."
            )
        names = ("time", "command", "position", "velocity", "torque", "frequency")
        rows = {name: getattr(self, name) for name in names}
        part: dict[str, Any] = {n: None if v is None else v[first:last] for n, v in rows.items()}
        return replace(self, segments=(segment,), **part)


def check_increasing(time: Array, where: str, row: Callable[[int], str]) -> None:
    """Refuse timestamps that are not finite, repeat or go back.

    The LogError begins with `where`, the file, and names the sample by `row`, as in `row 7`.
    """
    if len(time) < 2:
        raise LogError(f"{where}: {len(time)} samples; a log needs at least 2.")
    if not np.isfinite(time).all():
        lost = row(int(np.argmin(np.isfinite(time))))
        raise LogError(f"{where}: the timestamp in {lost} is missing or not a number.")
    steps = np.diff(time)
    if (steps > 0.0).all():
        return
    i = int(np.argmin(steps > 0.0)) + 1
    if steps[i - 1] == 0.0:
        raise LogError(
            f"{where}: {row(i)} repeats the timestamp {time[i]:.9g} of the one before; timestamps "
            "must increase (--drop-duplicates drops rows that repeat the one before in full)."
        )
    raise LogError(
        f"{where}: time goes back in {row(i)}, from {time[i - 1]:.9g} to {time[i]:.9g}; sort or "
        "split the file."
    )
