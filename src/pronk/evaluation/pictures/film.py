"""A film of a capture: which moments are shown, from where, and what is written beside them.

A film is a plan, made without any graphics: poses, camera and times, one row a frame.
`pronk.evaluation.pictures.frames` paints it.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from pronk.errors import PronkError
from pronk.evaluation.jump_events import JumpEvents
from pronk.evaluation.jumps import heading
from pronk.files import save_arrays, stored_arrays
from pronk.virtual.capture import Capture
from pronk.virtual.ground import Box, Ground

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FPS = 25.0
"""Frames per second of a film; half of it in a GIF, whose clock ticks every 10 ms."""
SCHEMA = "pronk/film/1"

_BEFORE_S = 1.0
_AFTER_S = 1.2
_AROUND_S = 0.06
"""Time before lift-off and after touchdown that is slowed down with the flight."""
_FOLLOW_S = 0.25
"""Standard deviation of the Gaussian through which the camera sees the trunk move."""
_LOOK_HEIGHT = 0.30
_QUARTER = 20.0
"""How far the camera stands off the side, towards the robot's face [deg]."""
_LANDED_S = 0.35
"""After touchdown, the last pose of a strip."""
_MEASURED = 0.1
"""Shortest displacement that has a direction [m]."""


@dataclass(frozen=True, kw_only=True)
class Film:
    """F frames to paint, and the poses of the strip."""

    robot: str
    title: str
    """The command."""
    note: str
    """What else has to be known, for instance which policy."""
    virtual: bool
    """True for the virtual robot; the frames say so."""
    marks: JumpEvents | None
    origin: tuple[float, float]
    """Zero of the tape on the floor: the trunk at lift-off, or at the start [m]."""
    direction: float
    """Of travel, and of the tape, in the world [rad]."""
    azimuth: float
    """Across the way, so that the robot travels to the right of the image, in the world [rad]."""
    quarter: float
    """How far the camera is turned from there, to see the robot's face [rad]."""
    ground: Ground
    """Floor and blocks."""
    time: Array
    """On the capture's clock [s]. (F,)"""
    rate: Array
    """Speed of the film, 1 for real time. (F,)"""
    qpos: Array
    """Trunk position [m], orientation w, x, y, z, joints [rad]. (F, 7 + joints)"""
    look: Array
    """Where the camera looks [m]. (F, 3)"""
    height: Array
    """Of the trunk's origin over the floor [m]. (F,)"""
    jumping: Mask
    """The jump input is on. (F,)"""
    labels: tuple[str, ...]
    """Of the P poses of the strip, empty for one on the way; no pose without a jump."""
    pose_time: Array
    """Since lift-off [s]. (P,)"""
    pose_qpos: Array
    """(P, 7 + joints)"""

    @property
    def frames(self) -> int:
        """How many."""
        return len(self.time)


def plan(
    capture: Capture,
    *,
    robot: str,
    title: str,
    note: str = "",
    virtual: bool = True,
    marks: JumpEvents | None = None,
    ground: Ground | None = None,
    start: float | None = None,
    end: float | None = None,
    slow: float = 1.0,
    fps: float = FPS,
) -> Film:
    """Plan a film of a capture.

    Args:
        capture: What was seen.
        robot: Whom, by name.
        title: The command.
        note: What else has to be known.
        virtual: Whether it was the virtual robot.
        marks: Of the jump; None for a robot that only walks.
        ground: Floor and blocks; None for a bare floor.
        start: First moment [s]; None: 1 s before lift-off, or the first sample.
        end: Last moment [s]; None: 1.2 s after touchdown, or the last sample.
        slow: How many times slower the flight is shown than it was.
        fps: Frames per second of the film.

    Raises:
        PronkError: No frame is left, or `slow` is below 1.
    """
    if not 1.0 <= slow < math.inf:
        raise PronkError(f"slow is {slow:g}; expected 1 (real time) or more, as in 4.")
    first, last = (float(capture.time[0]), float(capture.time[-1])) if len(capture.time) else (0, 0)
    begin = marks.liftoff - _BEFORE_S if marks else first
    finish = marks.touchdown + _AFTER_S if marks else last
    begin = max(first, begin if start is None else start)
    finish = min(last, finish if end is None else end)
    if not begin < finish:
        raise PronkError(
            f"a film from {begin:g} to {finish:g} s of a capture from {first:g} to {last:g} s; "
            "expected an end after the start."
        )
    time, rate = _clock(begin, finish, marks, slow, fps)
    shown = _samples(capture, time)
    moments, labels = _poses(capture, marks) if marks else (_samples(capture, np.zeros(0)), ())
    zero = _sample(capture, marks.liftoff if marks else begin)
    direction = _direction(capture, marks, begin, finish)
    jumping = np.zeros(len(time), dtype=bool)
    if marks:
        jumping = (time >= marks.on) & (time < marks.off)
    return Film(
        robot=robot,
        title=title,
        note=note,
        virtual=virtual,
        marks=marks,
        origin=(float(capture.position[zero, 0]), float(capture.position[zero, 1])),
        direction=direction,
        azimuth=direction + 0.5 * math.pi,
        quarter=_quarter(float(heading(capture.orientation[zero])), direction),
        ground=ground or Ground(),
        time=time,
        rate=rate,
        qpos=_qpos(capture, shown),
        look=_look(capture)[shown],
        height=capture.position[shown, 2].copy(),
        jumping=jumping,
        labels=labels,
        pose_time=capture.time[moments] - (marks.liftoff if marks else 0.0),
        pose_qpos=_qpos(capture, moments),
    )


def _clock(
    begin: float, finish: float, marks: JumpEvents | None, slow: float, fps: float
) -> tuple[Array, Array]:
    """Moments that are shown, and how fast the film is there."""
    times, rates, now = [], [], begin
    while now <= finish + 1e-9:
        flying = marks is not None and (
            marks.liftoff - _AROUND_S <= now < marks.touchdown + _AROUND_S
        )
        rate = 1.0 / slow if flying else 1.0
        times.append(now)
        rates.append(rate)
        now += rate / fps
    return np.array(times), np.array(rates)


def _samples(capture: Capture, times: Array) -> NDArray[np.intp]:
    """Samples next to some times."""
    if not len(times):
        return np.zeros(0, dtype=np.intp)
    dt = capture.dt if len(capture.time) > 1 else 1.0
    found = np.rint((times - capture.time[0]) / dt).astype(np.intp)
    clipped: NDArray[np.intp] = np.clip(found, 0, len(capture.time) - 1)
    return clipped


def _sample(capture: Capture, time: float) -> int:
    return int(_samples(capture, np.array([time]))[0])


def _qpos(capture: Capture, samples: NDArray[np.intp]) -> Array:
    parts = (capture.position, capture.orientation, capture.joint_position)
    return np.concatenate([part[samples] for part in parts], axis=1)


def _look(capture: Capture) -> Array:
    """Where a person who follows with the camera looks: the trunk's way, smoothed [m], (T, 3)."""
    sigma = _FOLLOW_S / capture.dt
    look = gaussian_filter1d(capture.position, sigma, axis=0, mode="nearest")
    rise = look[:, 2] - np.median(capture.position[:, 2])
    look[:, 2] = _LOOK_HEIGHT + 0.5 * rise
    return look


def _direction(capture: Capture, marks: JumpEvents | None, begin: float, finish: float) -> float:
    """Of travel: in flight, else over the film, else where the robot looks [rad]."""
    spans = [(begin, finish)]
    if marks:
        spans.insert(0, (marks.liftoff, marks.touchdown))
    for a, b in spans:
        way = capture.position[_sample(capture, b), :2] - capture.position[_sample(capture, a), :2]
        if float(np.hypot(*way)) >= _MEASURED:
            return math.atan2(way[1], way[0])
    return float(heading(capture.orientation[_sample(capture, begin)]))


def _quarter(yaw: float, direction: float) -> float:
    """How the camera is turned to see more of the robot's face than of its back [rad]."""
    return math.copysign(math.radians(_QUARTER), math.cos(direction - yaw))


def _poses(capture: Capture, marks: JumpEvents) -> tuple[NDArray[np.intp], tuple[str, ...]]:
    """Samples of a strip and their labels: crouch, lift-off, apex, touchdown, and between them."""
    up, down = _sample(capture, marks.liftoff), _sample(capture, marks.touchdown)
    z, on = capture.position[:, 2], min(_sample(capture, marks.on), up)
    top = up + int(np.argmax(z[up : down + 1]))
    last = min(down + round(_LANDED_S / capture.dt), len(z) - 1)
    named = (
        (on + int(np.argmin(z[on : up + 1])), "crouch"),
        (up, "lift-off"),
        ((up + top) // 2, ""),
        (top, "apex"),
        ((top + down) // 2, ""),
        (down, "touchdown"),
        (last, "landed"),
    )
    return np.array([k for k, _ in named], dtype=np.intp), tuple(label for _, label in named)


_ARRAYS = ("time", "rate", "qpos", "look", "height", "jumping", "pose_time", "pose_qpos")


def save(path: Path, film: Film) -> None:
    """Write a film's plan to an `.npz`, whole or not at all."""
    header = {name: value for name, value in asdict(film).items() if name not in _ARRAYS}
    arrays = {name: getattr(film, name) for name in _ARRAYS}
    save_arrays(path, {"schema": SCHEMA} | header, arrays)


def load(path: Path) -> Film:
    """Read what `save` wrote.

    Raises:
        ArtefactError: Missing, damaged, or of another schema.
    """
    with stored_arrays(path, SCHEMA, what="a film", writer="pronk trial") as (header, stored):
        del header["schema"]
        header["marks"] = JumpEvents(**header["marks"]) if header["marks"] else None
        header["origin"] = tuple(header["origin"])
        header["labels"] = tuple(header["labels"])
        ground = header["ground"]
        boxes = [{name: tuple(value) for name, value in box.items()} for box in ground["terrain"]]
        header["ground"] = Ground(**ground | {"terrain": tuple(Box(**box) for box in boxes)})
        return Film(**header, **{name: stored[name] for name in _ARRAYS})
