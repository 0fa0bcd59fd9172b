"""JointLog: commanded and measured motion of joints, in memory, and its excitations."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pronk.arrays import Array
from pronk.errors import LogError
from pronk.identify.logs.segment import Segment
from pronk.identify.logs.segmentation import Segmentation, find_segments
from pronk.names import check_names

_SAME_INSTANT_S = 1e-9
"""Timestamps closer than this are the same instant [s]: far below a tick of any logger."""


START_NS = "start_ns"
"""Metadata of a log whose clock is made to begin at zero: that instant on the clock of the
recorder [ns]."""


@dataclass(frozen=True, kw_only=True)
class LogOrigin:
    """Where a log comes from."""

    source: str = ""
    """File or link it came from."""
    sha256: str = ""
    """Hash of the file it was read from; empty for a log that was never a file."""
    virtual: bool = False
    """True if the machine was pronk's virtual robot."""
    complete: bool = True
    """False if the recording was cut short or its file is truncated."""
    metadata: dict[str, str] = field(default_factory=dict)
    """Named remarks of the recorder, for instance the link and the rate of the servo."""


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
    """Excitations as the recording names them, or as `read_log` found them in the commands."""
    stiffness: Array | None = None
    """Gains on the drives [N m/rad], shape (joints,); None if unknown."""
    damping: Array | None = None
    """Gains on the drives [N m s/rad], shape (joints,); None if unknown."""
    pose: Array | None = None
    """Position the signals are centred on [rad], shape (joints,)."""
    units: tuple[str, ...] | None = None
    """Unit of each column's position: `rad`, or `unknown` where the source gives another scale."""
    notes: tuple[str, ...] = ()
    """Remarks of the reader: jitter, drift, gaps, dropped rows."""
    origin: LogOrigin = LogOrigin()
    """File or link that the log came from, and whether it is whole."""

    def __post_init__(self) -> None:
        """Refuse wrong shapes, numbers that are not finite, and time that does not increase."""
        source = self.source or "log"
        samples = len(self.time)
        width = len(self.joints)
        check_names((self.robot, *self.joints), source, LogError)
        check_increasing(self.time, source, "sample {}".format)
        if width == 0:
            raise LogError(f"{source}: no joints.")
        if len(set(self.joints)) != width:
            raise LogError(f"{source}: a joint is named twice in {', '.join(self.joints)}.")
        per_sample = {
            "command": self.command,
            "position": self.position,
            "velocity": self.velocity,
            "torque": self.torque,
        }
        per_joint = {
            "stiffness": self.stiffness,
            "damping": self.damping,
            "pose": self.pose,
            "units": self.units,
        }
        for name, values in per_sample.items():
            if values is not None:
                self._check_shape(name, np.shape(values), (samples, width))
                self._check_finite(name, values)
        for name, entries in per_joint.items():
            if entries is not None:
                self._check_shape(name, np.shape(entries), (width,))
        for segment in self.segments:
            for joint in segment.joints:
                self.column(joint)

    def _check_shape(self, name: str, shape: tuple[int, ...], expected: tuple[int, ...]) -> None:
        if shape != expected:
            raise LogError(
                f"{self.source or 'log'}: {name} has shape {shape}; expected {expected} "
                f"({len(self.time)} timestamps, {len(self.joints)} joints)."
            )

    def _check_finite(self, name: str, values: Array) -> None:
        if not np.isfinite(values).all():
            row, column = np.argwhere(~np.isfinite(values))[0]
            raise LogError(
                f"{self.source or 'log'}: {name} of {self.joints[column]} is not finite at sample "
                f"{row} (t = {self.time[row]:.3f} s); drop or repair such rows before reading."
            )

    @property
    def source(self) -> str:
        """File or link that the log came from; empty if it has none."""
        return self.origin.source

    @property
    def virtual(self) -> bool:
        """True if the machine was pronk's virtual robot."""
        return self.origin.virtual

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

    def segmented(self) -> JointLog:
        """Return the log with the excitations that its commands show, where it names none.

        A log that `read_log` returned is segmented already.
        """
        if self.segments:
            return self
        found = self._segmentation
        return replace(
            self,
            segments=found.segments,
            pose=found.pose if self.pose is None else self.pose,
            notes=(*self.notes, *found.notes),
        )

    @cached_property
    def _segmentation(self) -> Segmentation:
        return find_segments(self.time, self.command, self.joints)

    @property
    def excited_joints(self) -> tuple[str, ...]:
        """Names of the joints that were excited, in the order of the columns."""
        excited = set[str]()
        for segment in self.segments or self._segmentation.segments:
            excited.update(segment.joints)
        return tuple(joint for joint in self.joints if joint in excited)

    def excitations(self, joint: str) -> tuple[Excitation, ...]:
        """Excitations of one joint: the largest amplitude first, repeats in order of time.

        An amplitude that the recording does not state is read off the command.

        Raises:
            LogError: The joint was not excited, or its command stands still in a segment; the
                message lists the joints that were excited.
        """
        self.column(joint)
        log = self.segmented()
        source = self.source or "log"
        excitations = []
        for segment in log.segments:
            if joint not in segment.joints:
                continue
            excitation = Excitation(
                log=log, joint=joint, segment=segment, samples=log.samples(segment)
            )
            travel = float(np.ptp(excitation.command))
            if travel == 0.0:
                raise LogError(
                    f"{source}: the command of {joint} stands still between {segment.start:.3f} "
                    f"and {segment.stop:.3f} s; the joint was not excited."
                )
            if np.isnan(segment.amplitude):
                stated = replace(segment, amplitude=travel / 2.0)
                excitation = replace(excitation, segment=stated)
            excitations.append(excitation)
        if not excitations:
            excited = ", ".join(log.excited_joints) or "no joints"
            raise LogError(f"{source}: {joint} was not excited; {excited} were.")
        ordered: list[Excitation] = []
        for repeats in group_repeats(excitations):
            ordered += repeats
        return tuple(ordered)

    def samples(self, segment: Segment) -> slice:
        """Rows of the log inside a segment, its ends included; a LogError if fewer than two."""
        first = int(np.searchsorted(self.time, segment.start - _SAME_INSTANT_S))
        stop = int(np.searchsorted(self.time, segment.stop + _SAME_INSTANT_S, side="right"))
        if stop - first < 2:
            raise LogError(
                f"{self.source or 'log'}: segment {segment.start:.3f} to {segment.stop:.3f} s "
                f"holds {max(stop - first, 0)} samples; the log spans {self.time[0]:.3f} to "
                f"{self.time[-1]:.3f} s."
            )
        return slice(first, stop)

    def cut(self, segment: Segment) -> JointLog:
        """Return the part of the log inside one segment, as a log of its own (same clock)."""
        rows = self.samples(segment)
        return replace(
            self,
            segments=(segment,),
            time=self.time[rows],
            command=self.command[rows],
            position=self.position[rows],
            velocity=None if self.velocity is None else self.velocity[rows],
            torque=None if self.torque is None else self.torque[rows],
            frequency=None if self.frequency is None else self.frequency[rows],
        )


@dataclass(frozen=True, kw_only=True)
class Excitation:
    """One excitation of one joint: the signal, and what was recorded of the joint during it.

    Arrays have shape (n,), a row for each sample of the excitation.
    """

    log: JointLog
    """The log that holds the excitation."""
    joint: str
    """Name of the excited joint."""
    segment: Segment
    """The signal: its kind, amplitude (never NaN), repeat, band, period and clamped joints."""
    samples: slice
    """Rows of the log that were recorded during the excitation."""

    @property
    def amplitude(self) -> float:
        """Peak of the command about the pose [rad]."""
        return self.segment.amplitude

    @property
    def source(self) -> str:
        """File or link that the log came from; empty if it has none."""
        return self.log.source

    @property
    def rate_hz(self) -> float:
        """Mean sample rate during the excitation [Hz]."""
        return float((len(self.time) - 1) / (self.time[-1] - self.time[0]))

    @property
    def time(self) -> Array:
        """Measured timestamps, on the clock of the log [s], shape (n,)."""
        return self.log.time[self.samples]

    @property
    def command(self) -> Array:
        """Position command in force [rad], shape (n,)."""
        return self._column(self.log.command)

    @property
    def position(self) -> Array:
        """Measured position [rad], shape (n,)."""
        return self._column(self.log.position)

    @property
    def velocity(self) -> Array | None:
        """Measured velocity [rad/s], shape (n,); None if the log has none."""
        return None if self.log.velocity is None else self._column(self.log.velocity)

    @property
    def torque(self) -> Array | None:
        """Measured or current-derived joint torque [N m], shape (n,); None if the log has none."""
        return None if self.log.torque is None else self._column(self.log.torque)

    @property
    def frequency(self) -> Array | None:
        """Instantaneous frequency of the signal [Hz], shape (n,); None if the log has none."""
        return None if self.log.frequency is None else self.log.frequency[self.samples]

    @property
    def pose(self) -> Array:
        """Position of every joint of the log that the signal is centred on [rad], (joints,).

        It is the first command of the excitation where the log has no pose.
        """
        if self.log.pose is not None:
            return self.log.pose
        return np.asarray(self.log.command[self.samples.start])

    def _column(self, values: Array) -> Array:
        return np.asarray(values[self.samples, self.log.column(self.joint)])


def group_repeats(excitations: Sequence[Excitation]) -> tuple[tuple[Excitation, ...], ...]:
    """Group excitations of one joint that repeat one another, the largest amplitude first.

    Repeats have the same kind, amplitude, period, band and clamped joints.
    """
    groups: dict[tuple[object, ...], list[Excitation]] = {}
    for excitation in excitations:
        segment = excitation.segment
        signal = (
            round(segment.amplitude, 6),
            segment.kind,
            segment.period_s,
            segment.band_hz,
            segment.clamped,
        )
        groups.setdefault(signal, []).append(excitation)
    by_amplitude = sorted(groups.values(), key=lambda repeats: -repeats[0].amplitude)
    return tuple(tuple(repeats) for repeats in by_amplitude)


def check_increasing(time: Array, source: str, row: Callable[[int], str]) -> None:
    """Refuse timestamps that are not finite, repeat or go back, with a LogError.

    Args:
        time: Timestamps, shape (n,).
        source: The file, for the message.
        row: Names a sample as the user finds it in the file, as in `row 7`.
    """
    if len(time) < 2:
        raise LogError(f"{source}: {len(time)} samples; a log needs at least 2.")
    missing = np.flatnonzero(~np.isfinite(time))
    if len(missing):
        raise LogError(
            f"{source}: the timestamp in {row(int(missing[0]))} is missing or not a number."
        )
    not_later = np.flatnonzero(np.diff(time) <= 0.0)
    if len(not_later) == 0:
        return
    i = int(not_later[0]) + 1
    if time[i] == time[i - 1]:
        raise LogError(
            f"{source}: {row(i)} repeats the timestamp {time[i]:.9g} of the one before; timestamps "
            "must increase."
        )
    raise LogError(
        f"{source}: time goes back in {row(i)}, from {time[i - 1]:.9g} to {time[i]:.9g}; sort or "
        "split the file."
    )
