"""Excitations of a log that does not name them, found in its commands.

A command rests where it stands still for `REST_S`; between two rests of a joint lies a motion. A
motion from one end of the command's travel to the other, while nothing else moves, is a change of
pose; every other motion is an excitation. The excitations of a joint are separate segments where
they are one signal, repeated or scaled, and long enough: eight seconds, or two if the command
returns to where it began and rests for half a second. Otherwise they count as one excitation. The
segments of joints that are excited one after another do not overlap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pronk.arrays import Array
from pronk.identify.logs.segment import Segment

MOVED_RAD = 1e-3
"""Least travel of a command that excites a joint: two counts of a 12-bit encoder."""
REST_S = 0.4
"""Least rest between two motions [s]: twice what the estimator takes for rest."""
SHORTEST_S = 8.0
"""Shortest excitation [s] that has a segment of its own: one window of the estimator, if the
excitation ends at rest."""
_SHORTEST_IN_MOTION_S = 12.0
"""Shortest excitation that does not end at rest: two windows that overlap by half [s]."""
_SHORTEST_REPEAT_S = 2.0
"""Shortest excitation that has a segment of its own where the command returns to where it began and
rests before the next: it has segments of a second [s]."""
_REPEAT_REST_S = 0.5
"""Rest between such excitations [s]: a joint of 2 Hz and a damping ratio of a half has settled to
5 % by then."""
_TAIL_S = 0.2
"""Time after an excitation that counts as a rest at its end [s]."""
_SAMPLE_SLACK_S = 0.02
"""Time by which a rest may be shorter by the samples at its ends [s]: one at 50 Hz."""
_ROUNDING = 1e-6
"""Share of a command's travel below which a change of it is rounding."""
_POSE_SLACK = 0.05
"""Share of a command's travel by which it may differ from where it is expected to be."""
_MOST_POSE_CHANGES = 2
"""Changes of pose of one joint, to the pose and back; more of them are an excitation by steps."""
_SAME_SIGNAL = 0.9
"""Correlation of two commands from which on they are one signal. Chirps to 10 Hz logged at 50 Hz,
half a sample apart, correlate to 0.93; chirps to 10 and to 9.8 Hz to 0.74, to 9 Hz to 0.22."""
_SHIFT_S = 0.1
"""Shifts at which the correlation of two commands is searched [s]."""
_SAME_AMPLITUDE = 0.02
"""Relative difference of amplitudes below which they are the same."""


@dataclass(frozen=True, kw_only=True)
class Segmentation:
    """Excitations found in the commands of a log."""

    segments: tuple[Segment, ...]
    """Segments of kind `unknown`, in order of time; empty where no command moves."""
    pose: Array
    """Position that the commands are centred on [rad], shape (joints,)."""
    notes: tuple[str, ...]
    """Remarks on what was found, for the log's notes."""


class _Motion(NamedTuple):
    """A stretch of samples in which the command of one joint moves."""

    column: int
    """Column of the joint."""
    begin: int
    """Last sample before the command moves."""
    end: int
    """First sample after the command moved."""

    def values(self, command: Array) -> Array:
        """Command of the joint during the motion [rad], shape (end - begin + 1,)."""
        return np.asarray(command[self.begin : self.end + 1, self.column])


def find_segments(time: Array, command: Array, joints: Sequence[str]) -> Segmentation:
    """Find the excitations of every joint in its command.

    Where the motions of a joint are not repeats of one signal, the joint has one segment, from the
    first of its motions to the last.

    Args:
        time: Timestamps, increasing [s], shape (n,).
        command: Position commands in force [rad], shape (n, joints).
        joints: Names of the columns.

    Returns:
        Segments, the pose they are centred on, and notes.
    """
    motions = _motions(time, command)
    excitations, pose_changes = _separate(time, command, motions)
    notes = []
    if pose_changes:
        moved_joints = ", ".join(joints[column] for column in _by_column(pose_changes))
        notes.append(f"changes of pose of {moved_joints} count as no excitation")
    pose_sample = 0
    if excitations:
        pose_sample = min(motion.begin for motion in excitations)
    pose = command[pose_sample].copy()
    segments: list[Segment] = []
    for column, repeats in _by_column(excitations).items():
        amplitudes = _amplitudes(command, repeats)
        # Repeats begin alike, so that they have the same command from their first sample on.
        lead = len(time)
        for motion in repeats:
            lead = min(lead, motion.begin - _earliest_start(motion, motions))
        for k, motion in enumerate(repeats):
            segments.append(
                Segment(
                    kind="unknown",
                    joints=(joints[column],),
                    start=float(time[motion.begin - lead]),
                    stop=float(time[_latest_stop(motion, motions, len(time) - 1)]),
                    amplitude=amplitudes[k],
                    repeat=amplitudes[:k].count(amplitudes[k]),
                )
            )
        if len(repeats) > 1:
            counts = []
            for amplitude in dict.fromkeys(amplitudes):
                counts.append(f"{amplitudes.count(amplitude)} at {amplitude:.3g}")
            notes.append(
                f"{len(repeats)} excitations of {joints[column]} in its command: "
                f"{', '.join(counts)}"
            )
        values = np.concatenate([motion.values(command) for motion in repeats])
        middle = 0.5 * (values.max() + values.min())
        if abs(middle - pose[column]) > 0.5 * _POSE_SLACK * np.ptp(values):
            pose[column] = middle
    segments.sort(key=lambda segment: segment.start)
    return Segmentation(segments=tuple(segments), pose=pose, notes=tuple(notes))


def _motions(time: Array, command: Array) -> list[_Motion]:
    """Motions of every command between its rests, column by column in order of time."""
    motions = []
    for column, values in enumerate(command.T):
        travel = np.ptp(values)
        moves = np.flatnonzero(np.abs(np.diff(values)) > _ROUNDING * travel)
        if len(moves) == 0 or travel < MOVED_RAD:
            continue
        rests = np.flatnonzero(time[moves[1:]] - time[moves[:-1] + 1] >= REST_S)
        begins = moves[np.append(0, rests + 1)].tolist()
        ends = (moves[np.append(rests, -1)] + 1).tolist()
        for begin, end in zip(begins, ends, strict=True):
            motions.append(_Motion(column, begin, end))
    return motions


def _by_column(motions: Sequence[_Motion]) -> dict[int, list[_Motion]]:
    """Motions of each joint by its column, in the order of the motions."""
    by_column: dict[int, list[_Motion]] = {}
    for motion in motions:
        by_column.setdefault(motion.column, []).append(motion)
    return by_column


def _separate(
    time: Array, command: Array, motions: Sequence[_Motion]
) -> tuple[list[_Motion], list[_Motion]]:
    """Separate motions into excitations and changes of pose.

    Motions of one joint that are not repeats of one signal are joined to one excitation.
    """
    pose_changes = _pose_changes(command, motions)
    excitations = [motion for motion in motions if motion not in pose_changes]
    if pose_changes:
        starts = command[[motion.begin for motion in excitations]]
        widest = max(np.ptp(motion.values(command)) for motion in excitations)
        if np.ptp(starts, axis=0).max() > _POSE_SLACK * widest:
            # The joints are excited in several poses, of which a log has one.
            excitations = list(motions)
            pose_changes = []
    separated = []
    for column, repeats in _by_column(excitations).items():
        if _are_repeats(time, command, repeats, motions):
            separated += repeats
        else:
            separated.append(_Motion(column, repeats[0].begin, repeats[-1].end))
    return separated, pose_changes


def _pose_changes(command: Array, motions: Sequence[_Motion]) -> list[_Motion]:
    """Motions that take a joint from one end of its travel to the other while no signal runs.

    Where every motion is of that kind, none is a change of pose: they are an excitation by steps.
    """
    signals = []
    for motion in motions:
        values = motion.values(command)
        if abs(values[-1] - values[0]) < (1.0 - _POSE_SLACK) * np.ptp(values):
            signals.append(motion)
    if not signals:
        return []
    ramps = [motion for motion in motions if motion not in signals]
    pose_changes: list[_Motion] = []
    for joint_ramps in _by_column(ramps).values():
        alone = not any(_overlaps(ramp, signals) for ramp in joint_ramps)
        if alone and len(joint_ramps) <= _MOST_POSE_CHANGES:
            pose_changes += joint_ramps
    return pose_changes


def _overlaps(motion: _Motion, signals: Sequence[_Motion]) -> bool:
    """Return True if a signal runs during a motion."""
    return any(motion.begin < signal.end and signal.begin < motion.end for signal in signals)


def _are_repeats(
    time: Array, command: Array, repeats: Sequence[_Motion], motions: Sequence[_Motion]
) -> bool:
    """Return True if motions of one joint are long enough and one signal, repeated or scaled."""
    for motion in repeats:
        next_motion = len(time) - 1
        for later in motions:
            if later.begin >= motion.end:
                next_motion = min(next_motion, later.begin)
        rest_s = time[next_motion] - time[motion.end]
        values = motion.values(command)
        returns = abs(values[-1] - values[0]) <= _POSE_SLACK * np.ptp(values)
        is_last = motion.end == max(repeat.end for repeat in repeats)
        shortest = _SHORTEST_IN_MOTION_S
        if rest_s >= _TAIL_S:
            shortest = SHORTEST_S
        if returns and rest_s >= (_TAIL_S if is_last else _REPEAT_REST_S - _SAMPLE_SLACK_S):
            shortest = _SHORTEST_REPEAT_S
        if time[motion.end] - time[motion.begin] < shortest:
            return False
        if not _same_signal(time, command, repeats[0], motion):
            return False
    return True


def _same_signal(time: Array, command: Array, first: _Motion, second: _Motion) -> bool:
    """Return True if two motions follow one signal, repeated or scaled by a positive factor."""
    from scipy.signal import correlate  # slow to import

    rate_hz = (len(time) - 1) / (time[-1] - time[0])
    reach = round(_SHIFT_S * rate_hz)
    first_signal = _normalized(time, command, first, rate_hz)
    second_signal = _normalized(time, command, second, rate_hz)
    if abs(len(first_signal) - len(second_signal)) > reach:
        return False
    correlation = correlate(first_signal, second_signal, method="fft")
    no_shift = len(second_signal) - 1
    near = correlation[max(no_shift - reach, 0) : no_shift + reach + 1]
    return bool(near.max() >= _SAME_SIGNAL)


def _normalized(time: Array, command: Array, motion: _Motion, rate_hz: float) -> Array:
    """Command during a motion on a uniform grid, from zero and with norm one, shape (samples,)."""
    seconds = time[motion.begin : motion.end + 1]
    grid = np.arange(0.0, seconds[-1] - seconds[0], 1.0 / rate_hz)
    values = np.interp(grid, seconds - seconds[0], motion.values(command))
    moved = values - values[0]
    return np.asarray(moved / np.linalg.norm(moved))


def _amplitudes(command: Array, repeats: Sequence[_Motion]) -> list[float]:
    """Half the travel of each motion [rad]; amplitudes that differ little have the first's."""
    amplitudes: list[float] = []
    for motion in repeats:
        amplitude = 0.5 * float(np.ptp(motion.values(command)))
        for earlier in amplitudes:
            if abs(amplitude / earlier - 1.0) <= _SAME_AMPLITUDE:
                amplitude = earlier
                break
        amplitudes.append(amplitude)
    return amplitudes


def _earliest_start(motion: _Motion, motions: Sequence[_Motion]) -> int:
    """Sample at which the segment of a motion may begin: in the middle of the rest before it."""
    ends = [earlier.end for earlier in motions if earlier.end <= motion.begin]
    if not ends:
        return 0
    return motion.begin - (motion.begin - max(ends)) // 2


def _latest_stop(motion: _Motion, motions: Sequence[_Motion], end_of_log: int) -> int:
    """Sample at which the segment of a motion ends: where the next motion's segment may begin."""
    stop = end_of_log
    for later in motions:
        if later.begin >= motion.end:
            stop = min(stop, _earliest_start(later, motions))
    return stop
