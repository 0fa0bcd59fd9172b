"""The plan of a film of a capture, made without graphics: poses, camera and times of each frame."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from pronk.arrays import Array, Mask
from pronk.jump.trial.jumps import heading
from pronk.jump.virtual.capture import Capture

Samples = NDArray[np.intp]

FPS = 25.0
"""Frames per second of a film; half of it in a GIF, whose clock ticks every 10 ms."""
SCHEMA = "pronk/film/2"

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
class JumpEvents:
    """Rise and fall of the jump input, lift-off and touchdown, on the capture's clock [s]."""

    on: float
    off: float
    liftoff: float
    touchdown: float


@dataclass(frozen=True, kw_only=True)
class Film:
    """F frames to render, and the P poses of the strip (none without a jump)."""

    robot: str
    """Name or path."""
    title: str
    """The command."""
    note: str
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
    def jumping(self) -> Mask:
        """Frames in which the jump input is on. (F,)."""
        on, off = (self.events.on, self.events.off) if self.events else (math.inf, math.inf)
        return (self.time >= on) & (self.time < off)


def plan(
    capture: Capture,
    *,
    robot: str,
    title: str,
    note: str = "",
    events: JumpEvents | None,
    span: tuple[float, float],
    slow: float = 1.0,
) -> Film:
    """Plan a film of a capture from the first to the last moment of `span` [s].

    The flight, if there are `events` of a jump, is `slow` times slower than real time.
    """
    begin, end = max(float(capture.time[0]), span[0]), min(float(capture.time[-1]), span[1])
    since, until = (events.liftoff, events.touchdown) if events else (math.inf, math.inf)
    now, times, rates = begin, [], []
    while now <= end + 1e-9:
        times.append(now)
        rates.append(1.0 / slow if since - _AROUND_S <= now < until + _AROUND_S else 1.0)
        now += rates[-1] / FPS
    frames = _samples(capture, *times)
    poses, labels = _poses(capture, events) if events else (frames[:0], ())
    (zero,) = _samples(capture, events.liftoff if events else begin)
    direction = _direction(capture, events, begin, end)
    facing = math.cos(direction - float(heading(capture.orientation[zero])))
    # The trunk's path, smoothed, with half of its rise.
    look = gaussian_filter1d(capture.position, _FOLLOW_S / capture.dt, axis=0, mode="nearest")
    look[:, 2] = _LOOK_HEIGHT + 0.5 * (look[:, 2] - np.median(capture.position[:, 2]))
    qpos = np.hstack([capture.position, capture.orientation, capture.joint_position])
    return Film(
        robot=robot,
        title=title,
        note=note,
        events=events,
        origin=(float(capture.position[zero, 0]), float(capture.position[zero, 1])),
        direction=direction,
        azimuth=direction + 0.5 * math.pi + math.copysign(_QUARTER, facing),
        time=np.array(times),
        rate=np.array(rates),
        qpos=qpos[frames],
        look=look[frames],
        labels=labels,
        pose_time=capture.time[poses] - (events.liftoff if events else 0.0),
        pose_qpos=qpos[poses],
    )


def _samples(capture: Capture, *times: float) -> Samples:
    """The nearest samples to times on the capture's clock [s]."""
    dt = capture.dt if len(capture.time) > 1 else 1.0
    nearest = np.rint((np.array(times) - capture.time[0]) / dt).astype(np.intp)
    clipped: Samples = np.clip(nearest, 0, len(capture.time) - 1)
    return clipped


def _direction(capture: Capture, events: JumpEvents | None, begin: float, end: float) -> float:
    """Of travel: in flight, else over the film, else the robot's heading [rad]."""
    spans = [(events.liftoff, events.touchdown)] if events else []
    for span in (*spans, (begin, end)):
        x, y, _ = np.diff(capture.position[_samples(capture, *span)], axis=0)[0]
        if math.hypot(x, y) >= _MEASURED:
            return math.atan2(y, x)
    return float(heading(capture.orientation[_samples(capture, begin)])[0])


def _poses(capture: Capture, events: JumpEvents) -> tuple[Samples, tuple[str, ...]]:
    """Samples of the strip and their labels."""
    z = capture.position[:, 2]
    on, up, down = _samples(capture, events.on, events.liftoff, events.touchdown).tolist()
    on, top = min(on, up), up + int(np.argmax(z[up : down + 1]))
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
