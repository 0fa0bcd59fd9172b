"""The plan of a film of a capture, made without graphics: poses, camera and times of each frame."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from pronk.errors import PronkError
from pronk.evaluation.jumps import JumpEvents, heading
from pronk.virtual.capture import Capture

Array = NDArray[np.float64]
Samples = NDArray[np.intp]

FPS = 25.0
"""Frames per second of a film; half of it in a GIF, whose clock ticks every 10 ms."""
SCHEMA = "pronk/film/2"

_BEFORE_S, _AFTER_S = 1.0, 1.2
"""Shown before lift-off and after touchdown."""
_AROUND_S = 0.06
"""Time before lift-off and after touchdown that is slowed down with the flight."""
_FOLLOW_S = 0.25
"""Standard deviation of the Gaussian by which the camera's path is smoothed."""
_LOOK_HEIGHT = 0.30
_QUARTER = math.radians(20.0)
"""How far the camera stands off the side, towards the robot's face."""
_LANDED_S = 0.35
"""After touchdown, the last pose of a strip."""
_MEASURED = 0.1
"""Shortest displacement that has a direction [m]."""


@dataclass(frozen=True, kw_only=True)
class Film:
    """F frames to render, and the P poses of the strip (none without a jump)."""

    robot: str
    title: str
    """The command."""
    note: str
    virtual: bool
    """Of the virtual robot; the frames are labelled accordingly."""
    events: JumpEvents | None
    origin: tuple[float, float]
    """Zero of the tape on the floor: the trunk at lift-off, or at the start [m]."""
    direction: float
    """Of travel, and of the tape, in the world [rad]."""
    azimuth: float
    """Of the camera's view, in the world; the robot travels to the right of the image [rad]."""
    time: Array
    """On the capture's clock [s]. (F,)"""
    rate: Array
    """Speed of the film, 1 for real time. (F,)"""
    qpos: Array
    """Trunk position [m], orientation w, x, y, z, joints [rad]. (F, 7 + joints)"""
    look: Array
    """Where the camera looks [m]. (F, 3)"""
    labels: tuple[str, ...]
    """Of the poses, empty for one in between."""
    pose_time: Array
    """Since lift-off [s]. (P,)"""
    pose_qpos: Array
    """(P, 7 + joints)"""

    @property
    def jumping(self) -> NDArray[np.bool_]:
        """Frames in which the jump input is on. (F,)."""
        on, off = (self.events.on, self.events.off) if self.events else (math.inf, math.inf)
        return (self.time >= on) & (self.time < off)


def plan(
    capture: Capture,
    *,
    robot: str,
    title: str,
    note: str = "",
    virtual: bool = True,
    events: JumpEvents | None = None,
    start: float | None = None,
    end: float | None = None,
    slow: float = 1.0,
) -> Film:
    """Plan a film of a capture, which shows the flight `slow` times slower than real time.

    Without `start` and `end` [s] it is from 1 s before lift-off to 1.2 s after touchdown; without
    `events`, those of the jump, it is the whole capture.

    Raises:
        PronkError: No frame is left, or `slow` is below 1.
    """
    if not 1.0 <= slow < math.inf:
        raise PronkError(f"slow is {slow:g}; expected 1 (real time) or more, as in 4.")
    first, last = (float(capture.time[0]), float(capture.time[-1])) if len(capture.time) else (0, 0)
    if start is None:
        start = events.liftoff - _BEFORE_S if events else first
    if end is None:
        end = events.touchdown + _AFTER_S if events else last
    begin, finish = max(first, start), min(last, end)
    if not begin < finish:
        raise PronkError(
            f"a film from {begin:g} to {finish:g} s of a capture from {first:g} to {last:g} s; "
            "expected an end after the start."
        )
    time, rate = _clock(begin, finish, events, slow)
    frames = _samples(capture, time)
    poses, labels = _poses(capture, events) if events else (frames[:0], ())
    zero = _sample(capture, events.liftoff if events else begin)
    direction = _direction(capture, events, begin, finish)
    facing = math.cos(direction - float(heading(capture.orientation[zero])))
    return Film(
        robot=robot,
        title=title,
        note=note,
        virtual=virtual,
        events=events,
        origin=(float(capture.position[zero, 0]), float(capture.position[zero, 1])),
        direction=direction,
        azimuth=direction + 0.5 * math.pi + math.copysign(_QUARTER, facing),
        time=time,
        rate=rate,
        qpos=_qpos(capture, frames),
        look=_look(capture)[frames],
        labels=labels,
        pose_time=capture.time[poses] - (events.liftoff if events else 0.0),
        pose_qpos=_qpos(capture, poses),
    )


def _clock(
    begin: float, finish: float, events: JumpEvents | None, slow: float
) -> tuple[Array, Array]:
    """Times of the frames, and the film's speed at each."""
    times, rates, now = [], [], begin
    while now <= finish + 1e-9:
        flying = events is not None and (
            events.liftoff - _AROUND_S <= now < events.touchdown + _AROUND_S
        )
        times.append(now)
        rates.append(1.0 / slow if flying else 1.0)
        now += rates[-1] / FPS
    return np.array(times), np.array(rates)


def _samples(capture: Capture, times: Array) -> Samples:
    dt = capture.dt if len(capture.time) > 1 else 1.0
    nearest = np.rint((times - capture.time[0]) / dt).astype(np.intp)
    clipped: Samples = np.clip(nearest, 0, len(capture.time) - 1)
    return clipped


def _sample(capture: Capture, time: float) -> int:
    return int(_samples(capture, np.array([time]))[0])


def _qpos(capture: Capture, samples: Samples) -> Array:
    parts = (capture.position, capture.orientation, capture.joint_position)
    return np.concatenate([part[samples] for part in parts], axis=1)


def _look(capture: Capture) -> Array:
    """The trunk's path, smoothed, with half of its rise [m]. (T, 3)."""
    look = gaussian_filter1d(capture.position, _FOLLOW_S / capture.dt, axis=0, mode="nearest")
    look[:, 2] = _LOOK_HEIGHT + 0.5 * (look[:, 2] - np.median(capture.position[:, 2]))
    return look


def _direction(capture: Capture, events: JumpEvents | None, begin: float, finish: float) -> float:
    """Of travel: in flight, else over the film, else the robot's heading [rad]."""
    spans = [(events.liftoff, events.touchdown)] if events else []
    for a, b in (*spans, (begin, finish)):
        way = capture.position[_sample(capture, b), :2] - capture.position[_sample(capture, a), :2]
        if float(np.hypot(*way)) >= _MEASURED:
            return math.atan2(way[1], way[0])
    return float(heading(capture.orientation[_sample(capture, begin)]))


def _poses(capture: Capture, events: JumpEvents) -> tuple[Samples, tuple[str, ...]]:
    """Samples of the strip and their labels."""
    up, down = _sample(capture, events.liftoff), _sample(capture, events.touchdown)
    z, on = capture.position[:, 2], min(_sample(capture, events.on), up)
    top = up + int(np.argmax(z[up : down + 1]))
    labelled = {
        "crouch": on + int(np.argmin(z[on : up + 1])),
        "lift-off": up,
        "": (up + top) // 2,
        "apex": top,
        " ": (top + down) // 2,
        "touchdown": down,
        "landed": min(down + round(_LANDED_S / capture.dt), len(z) - 1),
    }
    return np.array([*labelled.values()], dtype=np.intp), tuple(map(str.strip, labelled))
