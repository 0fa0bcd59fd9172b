"""What a jump was: flight phases and the figures of one jump, from the series of one robot.

The definitions stand here, once; `pronk.evaluation.training_sim.flight` computes the same for
thousands of robots while they run. Samples k = 0, 1, ... are taken at every
physics step, at times k dt; foot contacts of a sample belong to its position. The trunk is
followed at the origin of its frame, z up, the world's frame.

Flight phase: samples l .. d-1 without any foot on the ground, at least `flight_s` long; l is its
lift-off, d (the first sample with a foot on the ground) its touchdown, (d - l) dt its duration.
Shorter gaps are contact chatter. Sampling cuts up to one step off each end.

A jump belongs to a jump input that rises at sample c. Its flights are those with
c <= l <= c + search_s / dt. A running robot has flights too, `long_s` or longer in a fast gait, but
they do not lift the trunk. So a flight is a high one if it lasts `long_s` or more and max z over
its samples is more than `rise` over standing height. The main flight is the longest of the high
ones, at equal length the first; without one there was no jump. Then

    height       max z - min z over samples c .. d + tail_s / dt          (paper E5)
                 (without a jump: over c .. c + search_s / dt)
    apex         max z over samples l .. d-1
    delay        (l - c) dt
    vertical     vz at l;  horizontal  |v_xy| at l                        (reading A6)
    distance     |xy_d - xy_l|                                            (reading A17)
    along        (xy_d - xy_l) . R_yaw(l) u, u the unit command in the trunk's frame
    upright      at d + upright_s / dt the robot has not fallen and the trunk's z axis is within
                 `tilt_deg` of the vertical

A series ends where the robot falls.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pronk.errors import PronkError
from pronk.robots.mini_cheetah.model import standing_height

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

RISE = 0.03
"""Over standing height; a flight whose trunk goes higher is a jump, asked for or not [m]."""


@dataclass(frozen=True, kw_only=True)
class JumpRules:
    """Times [s] and heights that the definitions rest on."""

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
    standing_height: float = field(default_factory=standing_height)
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
    """One robot, from its start to its fall or to the end."""

    position: Array
    """Trunk, world frame [m]. (T, 3)"""
    velocity: Array
    """Trunk, world frame [m/s]. (T, 3)"""
    orientation: Array
    """Trunk, unit quaternions w, x, y, z. (T, 4)"""
    contact: Mask
    """Feet on the ground. (T, 4)"""
    dt: float
    """Time between samples [s]."""

    def __post_init__(self) -> None:
        """Refuse series of different lengths.

        Raises:
            PronkError: A shape is not the one that is said.
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
        """How many samples it lasts."""
        return self.touchdown - self.liftoff


@dataclass(frozen=True, kw_only=True)
class Jump:
    """The figures of one jump, as the module says; NaN where there was none."""

    flights: int
    """Flight phases that belong to the jump input."""
    long_flights: int
    """Those of `long_s` or more."""
    high_flights: int
    """Those of them that are high."""
    height: float
    """[m]"""
    apex: float = math.nan
    """Over ground [m]."""
    delay: float = math.nan
    """[s]"""
    duration: float = math.nan
    """Of the main flight [s]."""
    vertical: float = math.nan
    """[m/s]"""
    horizontal: float = math.nan
    """[m/s]"""
    distance: float = math.nan
    """[m]"""
    along: float = math.nan
    """[m]"""
    upright: bool = False

    @property
    def found(self) -> bool:
        """True if there was a jump."""
        return self.high_flights > 0


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


def along(displacement: Array, orientation: Array, command: Array) -> Array:
    """Part of a horizontal displacement along the commanded direction [m].

    Args:
        displacement: World frame [m]. (..., 2)
        orientation: Of the trunk at lift-off, w, x, y, z. (..., 4)
        command: Horizontal velocity in the trunk's frame [m/s]; zero gives NaN. (..., 2)
    """
    yaw = heading(orientation)
    forward, left = command[..., 0], command[..., 1]
    speed = np.hypot(forward, left)
    x = np.cos(yaw) * forward - np.sin(yaw) * left
    y = np.sin(yaw) * forward + np.cos(yaw) * left
    dot = displacement[..., 0] * x + displacement[..., 1] * y
    part: Array = np.divide(dot, speed, out=np.full(np.shape(dot), np.nan), where=speed > 0.0)
    return part


def flights(contact: Mask, *, least: int) -> tuple[Flight, ...]:
    """Flight phases that have ended, in their order.

    Args:
        contact: Feet on the ground. (T, 4)
        least: Shortest flight phase [samples].
    """
    airborne = ~np.asarray(contact, dtype=bool).any(axis=-1)
    edges = np.flatnonzero(np.diff(airborne.astype(np.int8), prepend=0))
    begins, ends = edges[0::2], edges[1::2]
    return tuple(
        Flight(liftoff=int(begin), touchdown=int(end))
        for begin, end in zip(begins, ends, strict=False)
        if end - begin >= least
    )


def commanded(
    phases: Sequence[Flight], on: int | None, rules: JumpRules, dt: float
) -> tuple[Flight, ...]:
    """Those flight phases that belong to the jump input that rises at sample `on`."""
    if on is None:
        return ()
    last = on + steps(rules.search_s, dt)
    return tuple(phase for phase in phases if on <= phase.liftoff <= last)


@dataclass(frozen=True, kw_only=True)
class Answer:
    """The flight phases that belong to a jump input, in their order."""

    all: tuple[Flight, ...]
    long: tuple[Flight, ...]
    """Those of `long_s` or more."""
    high: tuple[Flight, ...]
    """Those of them that are high."""

    @property
    def main(self) -> Flight | None:
        """The longest of the high ones; None if there was no jump."""
        return max(self.high, key=lambda phase: phase.samples, default=None)


def answer(series: Series, on: int, rules: JumpRules) -> Answer:
    """The flight phases that belong to the jump input which rises at sample `on`.

    Args:
        series: The robot.
        on: First sample with the jump input.
        rules: Of the definitions.
    """
    z = series.position[:, 2]
    phases = flights(series.contact, least=series.steps(rules.flight_s))
    own = commanded(phases, on, rules, series.dt)
    long = tuple(phase for phase in own if phase.samples >= series.steps(rules.long_s))
    high = (phase for phase in long if z[phase.liftoff : phase.touchdown].max() > rules.high)
    return Answer(all=own, long=long, high=tuple(high))


def measure(series: Series, on: int, command: Sequence[float], rules: JumpRules) -> Jump | None:
    """The jump that belongs to the input which rises at sample `on`.

    Args:
        series: The robot.
        on: First sample with the jump input.
        command: Forward and left velocity command [m/s].
        rules: Of the definitions.

    Returns:
        The jump; None if the robot fell before the command.
    """
    if on >= len(series.position):
        return None
    dt, z = series.dt, series.position[:, 2]
    found = answer(series, on, rules)
    own, long, main = len(found.all), len(found.long), found.main
    if main is None:
        window = z[on : on + series.steps(rules.search_s) + 1]
        return Jump(flights=own, long_flights=long, high_flights=0, height=float(np.ptp(window)))
    up, down = main.liftoff, main.touchdown
    displacement = series.position[down, :2] - series.position[up, :2]
    end = down + series.steps(rules.upright_s)
    return Jump(
        flights=own,
        long_flights=long,
        high_flights=len(found.high),
        height=float(np.ptp(z[on : down + series.steps(rules.tail_s) + 1])),
        apex=float(z[up:down].max()),
        delay=(up - on) * dt,
        duration=main.samples * dt,
        vertical=float(series.velocity[up, 2]),
        horizontal=float(np.hypot(*series.velocity[up, :2])),
        distance=float(np.hypot(*displacement)),
        along=float(along(displacement, series.orientation[up], np.asarray(command[:2]))),
        upright=end < len(z) and cosine_of_tilt(series.orientation[end]) >= rules.upright_cosine,
    )


def cosine_of_tilt(orientation: Array) -> float:
    """Vertical part of the trunk's z axis, 1 - 2 (x^2 + y^2).

    Args:
        orientation: w, x, y, z. (4,)
    """
    _, x, y, _ = orientation
    return float(1.0 - 2.0 * (x * x + y * y))


def unasked_height(series: Series, on: int | None, rules: JumpRules) -> float:
    """Highest trunk in a flight phase that belongs to no jump input [m]; NaN without one.

    Args:
        series: The robot.
        on: First sample with the jump input; None for a robot that is never told to jump.
        rules: Of the definitions; flights that lift off within `grace_s` do not count.
    """
    phases = flights(series.contact, least=series.steps(rules.flight_s))
    own = commanded(phases, on, rules, series.dt)
    tops = [
        series.position[phase.liftoff : phase.touchdown, 2].max()
        for phase in phases
        if phase not in own and phase.liftoff >= series.steps(rules.grace_s)
    ]
    return float(max(tops, default=math.nan))
