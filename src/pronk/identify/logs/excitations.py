"""Excitations of a log that does not name them, found in its commands.

A command that stands still for `REST_S` rests; between two rests of a joint lies a motion. One from
one end of its travel to the other, while nothing else moves, is a change of pose; the others are
excitations. Those of a joint are set apart where they are one signal, repeated or scaled; else they
count as one. Joints that are excited one after another have segments that do not overlap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from pronk.arrays import Array
from pronk.identify.logs.joint_log import JointLog, Segment

MOVED_RAD = 1e-3
"""Least travel of a command that excites a joint: two counts of a 12-bit encoder."""
REST_S = 0.4
"""Least rest between two motions [s]: twice what the estimator takes for rest."""
SHORTEST_S = 8.0
"""Shortest excitation [s] that is set apart: one window of the estimator, if it ends at rest."""
_OPEN_S = 12.0
"""The same where it does not end at rest: two windows that overlap by half."""
_TAIL_S = 0.2
"""Time after an excitation that is a rest at its end [s]."""
_STILL = 1e-6
"""Share of a command's travel below which a change of it is rounding."""
_BESIDE = 0.05
"""Share of its travel by which a command may lie beside where it is looked for."""
_MOST_POSES = 2
"""Changes of pose of one joint, to the pose and back; more of them are an excitation by steps."""
_ALIKE = 0.9
"""Correlation of two commands from which on they are one signal. Chirps to 10 Hz logged at 50 Hz,
half a sample apart, correlate to 0.93; chirps to 10 and to 9.8 Hz to 0.74, to 9 Hz to 0.22."""
_SLIP_S = 0.1
"""Shifts at which the correlation is searched [s]."""
_SAME_SIZE = 0.02
"""Relative difference of amplitudes below which they are the same."""


class _Motion(NamedTuple):
    """A stretch in which one command moves."""

    column: int
    first: int
    """Last sample before it moves."""
    last: int
    """First sample after it moved."""


def with_segments(log: JointLog) -> JointLog:
    """Return a log with a segment for each excitation, and a pose.

    A log that names segments keeps them. Where motions cannot be set apart, a joint whose command
    moves has one segment, from the first to the last of its motions.
    """
    if log.segments:
        return log
    motions = _motions(log)
    found, poses = _excitations(log, motions)
    segments: list[Segment] = []
    moved = ", ".join(dict.fromkeys(log.joints[one.column] for one in poses))
    notes = [f"changes of pose of {moved} count as no excitation"] if moved else []
    pose = log.command[min((motion.first for motion in found), default=0)].copy()
    for column in dict.fromkeys(motion.column for motion in found):
        joint, mine = log.joints[column], [m for m in found if m.column == column]
        # Repeats begin alike, so that they have the same command from their first sample on.
        lead = min(motion.first - _start(motion, motions) for motion in mine)
        sizes: list[float] = []
        for motion in mine:
            size = 0.5 * float(np.ptp(_command(log, motion)))
            size = next((s for s in sizes if abs(size / s - 1.0) <= _SAME_SIZE), size)
            later = (_start(m, motions) for m in motions if m.first >= motion.last)
            stop = min(later, default=len(log.time) - 1)
            segments.append(
                Segment(
                    kind="unknown",
                    joints=(joint,),
                    start=float(log.time[motion.first - lead]),
                    stop=float(log.time[stop]),
                    amplitude=size,
                    repeat=sizes.count(size),
                )
            )
            sizes.append(size)
        if len(mine) > 1:
            each = (f"{sizes.count(s)} at {s:.3g}" for s in dict.fromkeys(sizes))
            notes.append(f"{len(mine)} excitations of {joint} in its command: {', '.join(each)}")
        commands = np.concatenate([_command(log, motion) for motion in mine])
        middle = 0.5 * (commands.max() + commands.min())
        if abs(middle - pose[column]) > 0.5 * _BESIDE * np.ptp(commands):
            pose[column] = middle
    return replace(
        log,
        segments=tuple(sorted(segments, key=lambda segment: segment.start)),
        pose=pose if log.pose is None else log.pose,
        notes=(*log.notes, *notes),
    )


def _command(log: JointLog, motion: _Motion) -> Array:
    return log.command[motion.first : motion.last + 1, motion.column]


def _motions(log: JointLog) -> list[_Motion]:
    """Motions of every command, between rests."""
    out = []
    for column, command in enumerate(log.command.T):
        moves = np.flatnonzero(np.abs(np.diff(command)) > _STILL * np.ptp(command))
        if len(moves) and np.ptp(command) >= MOVED_RAD:
            rests = np.flatnonzero(log.time[moves[1:]] - log.time[moves[:-1] + 1] >= REST_S)
            firsts, lasts = moves[np.append(0, rests + 1)], moves[np.append(rests, -1)] + 1
            pairs = zip(firsts.tolist(), lasts.tolist(), strict=True)
            out += [_Motion(column, first, last) for first, last in pairs]
    return out


def _excitations(log: JointLog, motions: Sequence[_Motion]) -> tuple[list[_Motion], list[_Motion]]:
    """Excitations, and changes of pose that are none."""

    def swings(motion: _Motion) -> bool:
        command = _command(log, motion)
        return bool(abs(command[-1] - command[0]) < (1.0 - _BESIDE) * np.ptp(command))

    signals = [one for one in motions if swings(one)]
    poses: list[_Motion] = []
    for column in range(log.command.shape[1]) if signals else ():
        mine = [one for one in motions if one.column == column and one not in signals]
        beside = all(a.last <= b.first or b.last <= a.first for a in mine for b in signals)
        poses += mine if beside and len(mine) <= _MOST_POSES else []
    found = [one for one in motions if one not in poses]
    if poses:
        starts = log.command[[one.first for one in found]]
        if np.ptp(starts, axis=0).max() > _BESIDE * max(np.ptp(_command(log, m)) for m in found):
            # Excited in several poses, of which a log has one.
            found, poses = list(motions), []
    out = []
    for column in dict.fromkeys(one.column for one in found):
        mine = [one for one in found if one.column == column]
        if not _apart(log, mine, motions):
            mine = [_Motion(column, mine[0].first, mine[-1].last)]
        out += mine
    return out, poses


def _apart(log: JointLog, mine: Sequence[_Motion], motions: Sequence[_Motion]) -> bool:
    """True if the motions of one joint are long enough and one signal, repeated or scaled."""
    for motion in mine:
        after = min((m.first for m in motions if m.first >= motion.last), default=len(log.time) - 1)
        rests = log.time[after] - log.time[motion.last] >= _TAIL_S
        length = log.time[motion.last] - log.time[motion.first]
        if length < (SHORTEST_S if rests else _OPEN_S) or not _alike(log, mine[0], motion):
            return False
    return True


def _alike(log: JointLog, one: _Motion, other: _Motion) -> bool:
    """True if two motions follow one signal, repeated or scaled by a positive factor."""
    from scipy.signal import correlate  # slow to import

    pair = []
    for motion in (one, other):
        time = log.time[motion.first : motion.last + 1]
        grid = np.arange(0.0, time[-1] - time[0], 1.0 / log.rate_hz)
        values = np.interp(grid, time - time[0], _command(log, motion))
        pair.append((values - values[0]) / np.linalg.norm(values - values[0]))
    reach, zero = round(_SLIP_S * log.rate_hz), len(pair[1]) - 1
    if abs(len(pair[0]) - len(pair[1])) > reach:
        return False
    lags = correlate(pair[0], pair[1], method="fft")
    return bool(lags[max(zero - reach, 0) : zero + reach + 1].max() >= _ALIKE)


def _start(motion: _Motion, motions: Sequence[_Motion]) -> int:
    """Sample at which the segment of a motion may begin: in the middle of the rest before it."""
    before = max((m.last for m in motions if m.last <= motion.first), default=None)
    return 0 if before is None else motion.first - (motion.first - before) // 2
