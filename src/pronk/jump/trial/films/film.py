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
"""Indices of samples."""

FPS = 25.0
"""Frames per second of a film; half of it in a GIF, whose clock ticks every 10 ms [1/s]."""
SCHEMA = "pronk/film/2"

_AROUND_S = 0.06
"""Time before lift-off and after touchdown that is slowed down with the flight [s]."""
_FOLLOW_S = 0.25
"""Standard deviation of the Gaussian by which the camera's path is smoothed [s]."""
_LOOK_HEIGHT = 0.30
"""Height that the camera looks at while the trunk is at its median height [m]."""
_QUARTER = math.radians(20.0)
"""Angle by which the camera stands off the side, towards the robot's face [rad]."""
_LANDED_S = 0.35
"""Time of the last pose of a strip after touchdown [s]."""
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
    """Name or path of the robot."""
    title: str
    """The command."""
    note: str
    """Text below the title."""
    events: JumpEvents | None
    """Moments of the jump; None if there was none."""
    origin: tuple[float, float]
    """Zero of the tape on the floor: the trunk at lift-off, or at the start [m]."""
    direction: float
    """Direction of travel, and of the tape, in the world [rad]."""
    azimuth: float
    """Azimuth of the camera's view in the world; the robot travels to the right [rad]."""
    time: Array
    """Time of each frame on the capture's clock [s]. (F,)"""
    rate: Array
    """Speed of the film, 1 for real time. (F,)"""
    qpos: Array
    """Trunk position [m], orientation w, x, y, z, joints [rad]. (F, 7 + joints)"""
    look: Array
    """Point that the camera looks at [m]. (F, 3)"""
    labels: tuple[str, ...]
    """Labels of the poses, empty for one in between."""
    pose_time: Array
    """Time of each pose since lift-off [s]. (P,)"""
    pose_qpos: Array
    """Poses of the strip, as `qpos`. (P, 7 + joints)"""

    @property
    def jumping(self) -> Mask:
        """Frames in which the jump input is on. (F,)."""
        if self.events is None:
            return np.zeros(len(self.time), dtype=bool)
        return (self.time >= self.events.on) & (self.time < self.events.off)


def plan_film(
    capture: Capture,
    *,
    robot: str,
    title: str,
    note: str = "",
    events: JumpEvents | None,
    span: tuple[float, float],
    slow: float = 1.0,
) -> Film:
    """Plan a film of a capture.

    Args:
        capture: The recorded motion.
        robot: Name or path of the robot.
        title: The command.
        note: Text below the title.
        events: Moments of the jump; None if there was none.
        span: First and last moment of the film on the capture's clock [s].
        slow: How many times slower than real time the flight is [1].
    """
    begin = max(float(capture.time[0]), span[0])
    end = min(float(capture.time[-1]), span[1])
    times, rates = _frame_times(begin, end, events, slow)
    frames = _samples(capture, times)
    direction = _direction(capture, events, begin, end)
    zero_time = begin
    labels: tuple[str, ...] = ()
    poses = frames[:0]
    pose_time = capture.time[poses]
    if events is not None:
        zero_time = events.liftoff
        labels, poses = _poses(capture, events)
        pose_time = capture.time[poses] - events.liftoff
    zero = _sample(capture, zero_time)
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
        pose_time=pose_time,
        pose_qpos=qpos[poses],
    )


def _frame_times(
    begin: float, end: float, events: JumpEvents | None, slow: float
) -> tuple[list[float], list[float]]:
    """Return the time of each frame [s], and the speed of the film there [1]."""
    slow_from = math.inf
    slow_until = math.inf
    if events is not None:
        slow_from = events.liftoff - _AROUND_S
        slow_until = events.touchdown + _AROUND_S
    times = []
    rates = []
    time = begin
    while time <= end + 1e-9:
        rate = 1.0 / slow if slow_from <= time < slow_until else 1.0
        times.append(time)
        rates.append(rate)
        time += rate / FPS
    return times, rates


def _samples(capture: Capture, times: list[float]) -> Samples:
    """Return the nearest samples to times on the capture's clock [s]."""
    dt = capture.dt if len(capture.time) > 1 else 1.0
    nearest = np.rint((np.array(times) - capture.time[0]) / dt).astype(np.intp)
    clipped: Samples = np.clip(nearest, 0, len(capture.time) - 1)
    return clipped


def _sample(capture: Capture, time: float) -> int:
    """Return the nearest sample to a time on the capture's clock [s]."""
    return int(_samples(capture, [time])[0])


def _direction(capture: Capture, events: JumpEvents | None, begin: float, end: float) -> float:
    """Return the direction of travel in flight, else over the film, else the heading [rad]."""
    spans = [(begin, end)]
    if events is not None:
        spans.insert(0, (events.liftoff, events.touchdown))
    for start, stop in spans:
        origin = capture.position[_sample(capture, start)]
        x, y, _ = capture.position[_sample(capture, stop)] - origin
        if math.hypot(x, y) >= _MEASURED:
            return math.atan2(y, x)
    return float(heading(capture.orientation[_sample(capture, begin)]))


def _poses(capture: Capture, events: JumpEvents) -> tuple[tuple[str, ...], Samples]:
    """Return the labels of the strip's poses and their samples."""
    height = capture.position[:, 2]
    liftoff = _sample(capture, events.liftoff)
    touchdown = _sample(capture, events.touchdown)
    on = min(_sample(capture, events.on), liftoff)
    crouch = on + int(np.argmin(height[on : liftoff + 1]))
    apex = liftoff + int(np.argmax(height[liftoff : touchdown + 1]))
    landed = min(touchdown + round(_LANDED_S / capture.dt), len(height) - 1)
    labels = ("crouch", "lift-off", "", "apex", "", "touchdown", "landed")
    samples = (
        crouch,
        liftoff,
        (liftoff + apex) // 2,
        apex,
        (apex + touchdown) // 2,
        touchdown,
        landed,
    )
    return labels, np.array(samples, dtype=np.intp)
