"""Flight phases and the figures of a jump, from the recorded motion of one robot.

The only measure of a jump: trials of the virtual robot and the evaluation in the training simulator
record the trunk and the foot contacts and call `measure_jump`. Samples k = 0, 1, ... are those of
the physics steps, at times k dt; the foot contacts of a sample belong to its position. The trunk's
position is that of its frame's origin in the world, z up. A series ends where the robot falls.

Flight phase: samples l .. d-1 without any foot on the ground, at least `flight_s` long; l is its
lift-off, d (the first sample with a foot on the ground) its touchdown, (d - l) dt its duration.
Shorter gaps are contact chatter. Sampling cuts up to one step off each end.

A jump belongs to a jump input that rises at sample c. Its flights are those with
c <= l <= c + search_s / dt. A fast gait has flights of `long_s` or longer, too, but they do not
lift the trunk: a high flight lasts `long_s` or more with max z more than `rise` over standing
height. The main flight is the longest high one, at equal length the first; without one there was no
jump. With p, z the trunk's position and height, v its velocity, e = d + tail_s / dt:

    height                 max z - min z over c .. e                       (paper E5)
                           (without a jump: over c .. c + search_s / dt)
    apex_gain              max z over l .. d-1, less standing height
    rise, ballistic        max z over l .. d-1 less z_l;  v_z^2 / 2g at l
    delay, duration        (l - c) dt;  (d - l) dt
    lift_off_velocity      v_z at l;  horizontal_velocity |v_xy| at l      (reading A6)
    distance               |xy_d - xy_l|                                   (reading A17)
    along                  (xy_d - xy_l) . R_yaw(l) u, u the unit command in the trunk's frame
    distance_minima        |xy_b - xy_a|, z_a the least over c .. l, z_b the least over d .. e
    upright                at d + upright_s / dt the robot has not fallen and the trunk's z axis is
                           within `tilt_deg` of the vertical
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pronk.errors import PronkError
from pronk.robots.legged import legged

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

GRAVITY = 9.81
"""[m/s^2]"""
RISE = 0.03
"""Over standing height; a flight in which the trunk goes higher is a jump, commanded or not [m]."""


@dataclass(frozen=True, kw_only=True)
class JumpRules:
    """Times [s] and heights of the definitions."""

    flight_s: float = 0.015
    """Shortest flight phase: three physics steps."""
    long_s: float = 0.06
    """Shortest flight that is counted as a long one; a ballistic hop of this length rises 4 mm."""
    search_s: float = 1.5
    """A jump lifts off within this time after its command."""
    tail_s: float = 0.5
    """Time after touchdown that still belongs to the height."""
    upright_s: float = 2.0
    """Time after touchdown at which the robot must be upright."""
    tilt_deg: float = 30.0
    """Largest tilt of an upright robot [deg]."""
    grace_s: float = 0.5
    """Time after the start in which flights are not counted: the robot is set down."""
    standing_height: float = field(default_factory=lambda: legged("mini_cheetah").standing_height)
    """Of the trunk, in the default pose [m]."""
    rise: float = RISE
    """Over standing height, what a high flight exceeds [m]."""

    def __post_init__(self) -> None:
        """Refuse rules that contradict each other.

        Raises:
            PronkError: A number is not positive, or a long flight is shorter than a flight.
        """
        for name, value in vars(self).items():
            if not value > 0.0:
                raise PronkError(f"JumpRules.{name} is {value}; it must be positive.")
        if self.long_s < self.flight_s:
            raise PronkError(
                f"JumpRules.long_s is {self.long_s}; it must not be shorter than flight_s, "
                f"{self.flight_s}."
            )

    @property
    def high(self) -> float:
        """Trunk height that a high flight exceeds [m]."""
        return self.standing_height + self.rise

    @property
    def upright_cosine(self) -> float:
        """Cosine of the largest tilt of an upright robot."""
        return math.cos(math.radians(self.tilt_deg))


@dataclass(frozen=True, kw_only=True)
class Series:
    """The recorded motion of one robot, from its start to its fall or to the end."""

    position: Array
    """Trunk, world frame [m]. (T, 3)"""
    velocity: Array
    """Trunk, world frame [m/s]. (T, 3)"""
    orientation: Array
    """Trunk to world, unit quaternions w, x, y, z. (T, 4)"""
    contact: Mask
    """Feet on the ground. (T, 4)"""
    dt: float
    """Time between samples [s]."""

    def __post_init__(self) -> None:
        """Refuse arrays of other shapes.

        Raises:
            PronkError: A shape is not the documented one.
        """
        length = len(self.position)
        for name, width in (("position", 3), ("velocity", 3), ("orientation", 4), ("contact", 4)):
            shape = np.shape(getattr(self, name))
            if shape != (length, width):
                raise PronkError(f"Series.{name} has shape {shape}; expected {(length, width)}.")

    def steps(self, seconds: float) -> int:
        """Samples in a time, to the nearest."""
        return steps(seconds, self.dt)


@dataclass(frozen=True, kw_only=True)
class Flight:
    """A flight phase: samples `liftoff` .. `touchdown` - 1."""

    liftoff: int
    touchdown: int

    @property
    def samples(self) -> int:
        """Length in samples."""
        return self.touchdown - self.liftoff


@dataclass(frozen=True, kw_only=True)
class JumpFlights:
    """The flight phases of one jump input, and the others."""

    all: tuple[Flight, ...]
    high: tuple[Flight, ...]
    """Those of `long_s` or more that are high."""
    uncommanded: tuple[Flight, ...]
    """Those that belong to no jump input."""

    @property
    def main(self) -> Flight | None:
        """The longest of the high ones; None if there was no jump."""
        return max(self.high, key=lambda phase: phase.samples, default=None)


def steps(seconds: float, dt: float) -> int:
    """Whole steps in a time, to the nearest."""
    return round(seconds / dt)


def heading(orientation: Array) -> Array:
    """Yaw of unit quaternions, atan2(2 (w z + x y), 1 - 2 (y^2 + z^2)) [rad].

    Args:
        orientation: w, x, y, z. (..., 4)
    """
    w, x, y, z = np.moveaxis(np.asarray(orientation), -1, 0)
    yaw: Array = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return yaw


def cosine_of_tilt(orientation: Array) -> Array:
    """Vertical part of the trunk's z axis, 1 - 2 (x^2 + y^2). (...,).

    Args:
        orientation: w, x, y, z. (..., 4)
    """
    cosine: Array = 1.0 - 2.0 * (orientation[..., 1] ** 2 + orientation[..., 2] ** 2)
    return cosine


def along(displacement: Array, orientation: Array, command: Sequence[float]) -> float:
    """Part of a horizontal displacement along the commanded direction [m].

    Args:
        displacement: World frame [m]. (2,)
        orientation: Of the trunk at lift-off, w, x, y, z. (4,)
        command: Horizontal velocity in the trunk's frame [m/s]; zero gives NaN.
    """
    yaw, (forward, left) = float(heading(orientation)), command[:2]
    speed = math.hypot(forward, left)
    x = math.cos(yaw) * forward - math.sin(yaw) * left
    y = math.sin(yaw) * forward + math.cos(yaw) * left
    return float(displacement[0] * x + displacement[1] * y) / speed if speed else math.nan


def flights(contact: Mask, *, least: int) -> tuple[Flight, ...]:
    """Return the flight phases of `least` samples or more that have ended, in their order.

    `contact`: feet on the ground. (T, 4)
    """
    airborne = ~np.asarray(contact, dtype=bool).any(axis=-1)
    edges = np.flatnonzero(np.diff(airborne.astype(np.int8), prepend=0))
    return tuple(
        Flight(liftoff=int(begin), touchdown=int(end))
        for begin, end in zip(edges[0::2], edges[1::2], strict=False)
        if end - begin >= least
    )


def jump_flights(series: Series, on: int | None, rules: JumpRules) -> JumpFlights:
    """Sort the flight phases by whether they belong to the jump input.

    It is on from sample `on`, or never if None.
    """
    z = series.position[:, 2]
    phases = flights(series.contact, least=series.steps(rules.flight_s))
    last = -1 if on is None else on + series.steps(rules.search_s)
    own = tuple(phase for phase in phases if on is not None and on <= phase.liftoff <= last)
    long = (phase for phase in own if phase.samples >= series.steps(rules.long_s))
    high = (phase for phase in long if z[phase.liftoff : phase.touchdown].max() > rules.high)
    others = tuple(phase for phase in phases if phase not in own)
    return JumpFlights(all=own, high=tuple(high), uncommanded=others)


def uncommanded_height(series: Series, on: int | None, rules: JumpRules) -> float:
    """Highest trunk in a flight phase that belongs to no jump input [m]; NaN without one.

    Args:
        series: The robot.
        on: First sample with the jump input; None for a robot that only walks.
        rules: Of the definitions; flights that lift off within `grace_s` do not count.
    """
    tops = [
        series.position[phase.liftoff : phase.touchdown, 2].max()
        for phase in jump_flights(series, on, rules).uncommanded
        if phase.liftoff >= series.steps(rules.grace_s)
    ]
    return float(max(tops, default=math.nan))


def measure_jump(
    series: Series, on: int, command: Sequence[float], rules: JumpRules
) -> tuple[dict[str, Any], Flight | None]:
    """Measure the jump of the input that rises at sample `on`.

    Args:
        series: The robot; it has sample `on`.
        on: First sample with the jump input.
        command: Forward and left velocity command [m/s].
        rules: Of the definitions.

    Returns:
        The figures of the module by name; without a jump only `found`, `flights`, `high_flights`
        and `height`. And the main flight, or None.
    """
    dt, plane, z = series.dt, series.position[:, :2], series.position[:, 2]
    found = jump_flights(series, on, rules)
    main = found.main
    figures: dict[str, Any] = {
        "found": main is not None,
        "flights": float(len(found.all)),
        "high_flights": float(len(found.high)),
    }
    if main is None:
        window = z[on : on + series.steps(rules.search_s) + 1]
        return figures | {"height": float(np.ptp(window))}, None
    up, down = main.liftoff, main.touchdown
    end = down + series.steps(rules.tail_s) + 1
    judged = down + series.steps(rules.upright_s)
    displacement, vertical = plane[down] - plane[up], float(series.velocity[up, 2])
    before, after = on + int(np.argmin(z[on : up + 1])), down + int(np.argmin(z[down:end]))
    apex = float(z[up:down].max())
    return figures | {
        "upright": bool(
            judged < len(z) and cosine_of_tilt(series.orientation[judged]) >= rules.upright_cosine
        ),
        "height": float(np.ptp(z[on:end])),
        "apex_gain": apex - rules.standing_height,
        "rise": float(apex - z[up]),
        "ballistic": vertical**2 / (2.0 * GRAVITY),
        "distance": float(np.hypot(*displacement)),
        "along": along(displacement, series.orientation[up], command),
        "distance_minima": float(np.hypot(*(plane[after] - plane[before]))),
        "lift_off_velocity": vertical,
        "horizontal_velocity": float(np.hypot(*series.velocity[up, :2])),
        "delay": (up - on) * dt,
        "duration": main.samples * dt,
    }, main
