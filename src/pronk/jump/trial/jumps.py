"""Flight phases and the figures of a jump, from the recorded motion of one robot.

Trials of the virtual robot and the evaluation in the training simulator record trunk and foot
contacts; a sample's contacts belong to its position. What follows a fall is not measured.

A flight phase is a stretch of `flight_s` or longer without a foot on the ground, from its lift-off
(first sample in the air) to its touchdown (first sample on the ground). A jump input that rises at
sample c has the flights that lift off within `search_s`. Fast gaits fly, too, but do not lift the
trunk: a high flight lasts `long_s` and its trunk rises more than `rise` over standing height. The
main flight is the longest high one, the first of equal ones; without one there was no jump.

`FIGURES` has unit and equation of every figure, in the symbols of `SYMBOLS`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple, Self

import numpy as np

from pronk.arrays import Array, Mask
from pronk.jump.virtual.capture import Capture
from pronk.policy.script import Script
from pronk.robots import motor as drive
from pronk.robots.legged import legged
from pronk.robots.robot import RobotSpec

GRAVITY = 9.81
"""[m/s^2]"""
RISE = 0.03
"""Over standing height; a flight in which the trunk goes higher is a jump, commanded or not [m]."""
FALLEN_COSINE = 0.34
"""A trunk that leans further (70 degrees) has fallen, as in training."""
FALLEN_HEIGHT = 0.08
"""A trunk that is lower lies on the ground, as in training [m]."""
AVERAGE_S = 0.01
"""Over which joint speeds are averaged [s]."""
SETTLE_S = 1.0
"""Time to reach the commanded speed, left out of the figures of the run [s]."""
SYMBOLS = (
    "c: the jump input rises. l, d: lift-off and touchdown of the main flight, the longest in "
    "which the trunk rises more than 3 cm over standing. e: d + 0.5 s. p, z, v: position, height "
    "and velocity of the trunk's origin. f_i, r: centre and radius of a foot. u: direction of "
    "p_d - p_l in the plane."
)


@dataclass(frozen=True, kw_only=True)
class JumpRules:
    """Times [s] and heights [m] of the definitions."""

    flight_s: float = 0.015
    """Shortest flight phase: three physics steps of training."""
    long_s: float = 0.06
    """Shortest high flight; a ballistic hop of this length rises 4 mm."""
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
    standing_height: float
    """Of the trunk, in the default pose."""
    rise: float = RISE
    """Over standing height, what a high flight exceeds."""

    @classmethod
    def of(cls, robot: RobotSpec, **times: float) -> Self:
        """Return the rules with the standing height of a robot."""
        return cls(standing_height=legged(robot.source).standing_height, **times)

    @property
    def high(self) -> float:
        """Trunk height that a high flight exceeds [m]."""
        return self.standing_height + self.rise

    @property
    def upright_cosine(self) -> float:
        """Cosine of the largest tilt of an upright robot."""
        return math.cos(math.radians(self.tilt_deg))


# ---- motion ----


def heading(orientation: Array) -> Array:
    """Yaw of unit quaternions w, x, y, z [rad]: atan2(2 (w z + x y), 1 - 2 (y^2 + z^2)). (...,)."""
    w, x, y, z = np.moveaxis(np.asarray(orientation), -1, 0)
    yaw: Array = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return yaw


def cosine_of_tilt(orientation: Array) -> Array:
    """Vertical part of the trunk's z axis, 1 - 2 (x^2 + y^2), of quaternions w, x, y, z. (...,)."""
    cosine: Array = 1.0 - 2.0 * (orientation[..., 1] ** 2 + orientation[..., 2] ** 2)
    return cosine


def along(vector: Array, orientation: Array, command: Sequence[float]) -> Array:
    """Parts of horizontal vectors (..., 2 or more) along the commanded direction. (...,).

    `vector` is in the world, `orientation` the trunk's, `command` a velocity in the trunk's frame.
    """
    direction = heading(orientation) + math.atan2(command[1], command[0])
    part: Array = vector[..., 0] * np.cos(direction) + vector[..., 1] * np.sin(direction)
    return part


def steps(capture: Capture, seconds: float) -> int:
    """Samples in a time, to the nearest."""
    return round(seconds / capture.dt)


def sample_at(capture: Capture, time: float) -> int:
    """First sample at or after a time on the capture's clock [s]."""
    return int(np.searchsorted(capture.time, time - 1e-3 * capture.dt))


def fallen_at(capture: Capture) -> int:
    """First sample at which the robot lies or leans too far; the sample count if it never does.

    A robot whose motion is not finite has fallen.
    """
    upright = cosine_of_tilt(capture.orientation) >= FALLEN_COSINE
    fallen = ~(upright & (capture.position[:, 2] >= FALLEN_HEIGHT))
    return int(np.argmax(fallen)) if fallen.any() else len(fallen)


# ---- flights ----


class Flight(NamedTuple):
    """A flight phase: samples `liftoff` .. `touchdown` - 1."""

    liftoff: int
    touchdown: int

    @property
    def samples(self) -> int:
        """Length in samples."""
        return self.touchdown - self.liftoff


class JumpFlights(NamedTuple):
    """The flight phases of one jump input, the high ones of them, and all others."""

    all: tuple[Flight, ...]
    high: tuple[Flight, ...]
    uncommanded: tuple[Flight, ...]

    @property
    def main(self) -> Flight | None:
        """The longest of the high ones; None if there was no jump."""
        return max(self.high, key=lambda phase: phase.samples, default=None)


def flights(contact: Mask, *, least: int) -> tuple[Flight, ...]:
    """Return the flight phases of `least` samples or more that have ended, in their order.

    `contact`: feet on the ground. (T, 4)
    """
    airborne = ~np.asarray(contact, dtype=bool).any(axis=-1)
    edges = np.flatnonzero(np.diff(airborne.astype(np.int8), prepend=0)).tolist()
    pairs = zip(edges[0::2], edges[1::2], strict=False)
    return tuple(Flight(begin, end) for begin, end in pairs if end - begin >= least)


def jump_flights(capture: Capture, on: int | None, rules: JumpRules, end: int) -> JumpFlights:
    """Sort the flight phases by whether they belong to the jump input that rises at sample `on`.

    Samples from `end` on are left out.
    """
    z = capture.position[:, 2]
    phases = flights(capture.contact[:end], least=steps(capture, rules.flight_s))
    last = -1 if on is None else on + steps(capture, rules.search_s)
    own = tuple(phase for phase in phases if on is not None and on <= phase.liftoff <= last)
    long = (phase for phase in own if phase.samples >= steps(capture, rules.long_s))
    high = tuple(phase for phase in long if z[slice(*phase)].max() > rules.high)
    return JumpFlights(own, high, tuple(phase for phase in phases if phase not in own))


def uncommanded_height(capture: Capture, on: int | None, rules: JumpRules) -> float:
    """Highest trunk in a flight phase that belongs to no jump input [m]; NaN without one.

    `on` is the first sample with the jump input, None for a robot that only walks.
    """
    tops = [
        capture.position[slice(*phase), 2].max()
        for phase in jump_flights(capture, on, rules, fallen_at(capture)).uncommanded
        if phase.liftoff >= steps(capture, rules.grace_s)
    ]
    return float(max(tops, default=math.nan))


# ---- definitions of figures ----


@dataclass(frozen=True, kw_only=True)
class Figure:
    """What a figure of a run is."""

    name: str
    unit: str
    says: str
    """Its equation."""
    joints: bool = False
    """One number for each joint."""

    @property
    def column(self) -> str:
        """Heading of its column in a table, unit included."""
        unit = self.unit.replace("/", "_per_").replace(" ", "_")
        return self.name if unit == "1" else f"{self.name}_{unit}"


def number(unit: str, says: str, *, joints: bool = False) -> Any:
    """Declare a figure that is a number, or one of each joint: its unit and its equation."""
    metadata = {"unit": unit, "says": says, "joints": joints}
    return field(default=() if joints else math.nan, metadata=metadata)


@dataclass(frozen=True, kw_only=True)
class JumpFigures:
    """One jump. A figure that does not exist (no jump, no landing) is NaN."""

    standing: bool
    """The robot had not fallen when the jump input came."""
    found: bool = False
    """There was a jump."""
    non_foot_contact: bool = False
    """Something but a foot touched the ground, from c to 2 s after d."""
    fell: bool = False
    """The robot fell, at any time of the run."""
    upright: bool = False
    """There was a jump, and 2 s after d the robot stood, tilted by 30 degrees at most."""

    height: float = number("m", "max z - min z over c .. e (paper E5)")
    apex_gain: float = number(
        "m", "max z over l .. d-1, less the height of the trunk in the default pose"
    )
    rise: float = number("m", "max z over l .. d-1, less z_l")
    ballistic: float = number("m", "v_z^2 / 2g with v_z at l: the rise of a ballistic flight")
    clearance: float = number(
        "m",
        "max over l .. d-1 of min over the feet of (height of f_i - r): all feet are this high at "
        "once",
    )
    clearance_half: float = number(
        "m",
        "min over the middle half of l .. d-1 of min over the feet of (height of f_i - r): no foot "
        "is lower for half of the flight",
    )
    distance: float = number("m", "|p_d - p_l| in the plane (paper E6, reading A17)")
    along: float = number("m", "(p_d - p_l) along the commanded direction, heading at l")
    distance_minima: float = number(
        "m",
        "|p_b - p_a| in the plane, z_a the least over c .. l and z_b the least over d .. e "
        "(the other reading of A17)",
    )
    gap: float = number(
        "m",
        "min over the feet of f_i . u at its first contact from d on, less max over the feet of "
        "f_i . u at its last contact before l (reading A16)",
    )
    lift_off_velocity: float = number("m/s", "v_z at l (reading A6)")
    horizontal_velocity: float = number("m/s", "|v_xy| at l")
    delay: float = number("s", "time from c to l")
    duration: float = number("s", "time from l to d")
    flights: float = number("1", "flight phases that lift off from c to c + 1.5 s")
    high_flights: float = number("1", "those of them that are 60 ms or longer and high")
    speed: float = number(
        "m/s", "mean velocity along the command and the heading, from 1 s after it to c"
    )
    roll_rate_rms: float = number("rad/s", "root mean square of the roll rate while accelerating")
    roll_rate_peak: float = number("rad/s", "greatest |roll rate| while accelerating")
    pitch_rate_rms: float = number("rad/s", "root mean square of the pitch rate while accelerating")
    pitch_rate_peak: float = number("rad/s", "greatest |pitch rate| while accelerating")
    energy: float = number(
        "J", "electrical energy over c .. e, what comes back into the battery taken off"
    )
    cost_of_transport: float = number(
        "1", "electrical energy / (m g |p_c - p_b|) from b, 1 s after the command to run, to c"
    )
    peak_torque: tuple[float, ...] = number(
        "N m", "greatest |motor torque| over c .. e", joints=True
    )
    peak_speed: tuple[float, ...] = number(
        "rad/s", "greatest |joint speed|, averaged over 10 ms, over c .. e", joints=True
    )
    torque_margin: tuple[float, ...] = number(
        "1",
        "least distance over c .. e of the motor torque from the drive's torque-speed curve at "
        "nominal bus voltage and that speed, as a share of the effort limit; 0 on the curve, "
        "negative beyond it, where a motor gives more than the model of its drive",
        joints=True,
    )

    @property
    def success(self) -> bool:
        """The landing: upright 2 s later, and nothing but feet touched the ground."""
        return self.upright and not self.non_foot_contact


def figures_of(kind: type[Any]) -> dict[str, Figure]:
    """Return every figure that is a number, by name, of a dataclass of figures."""
    return {one.name: Figure(name=one.name, **one.metadata) for one in fields(kind) if one.metadata}


FIGURES: Mapping[str, Figure] = figures_of(JumpFigures)


# ---- figures of a capture ----


def measure(
    capture: Capture,
    script: Script,
    robot: RobotSpec,
    *,
    began: float,
    rules: JumpRules | None = None,
) -> JumpFigures:
    """Return the figures of one run.

    `began` is when the policy took over, on the capture's clock [s]; `rules` are those of the robot
    if None.
    """
    rules, body = rules or JumpRules.of(robot), legged(robot.source)
    run, on = (sample_at(capture, began + t) for t in (script.start, script.on))
    count = fallen_at(capture)
    fell = count < len(capture.time)
    if on >= count:
        return JumpFigures(standing=False, fell=fell)
    found = jump_flights(capture, on, rules, count)
    main = found.main
    seconds = rules.search_s if main is None else rules.tail_s
    last = (on if main is None else main.touchdown) + steps(capture, seconds)
    end = min(last, count - 1)
    settled = (main.touchdown + steps(capture, rules.upright_s)) if main else end
    figures: dict[str, Any] = {
        **_rates(capture, run, on),
        **_run(capture, script, run + steps(capture, SETTLE_S), on, mass=body.total_mass),
        **_loads(capture, robot, on, end),
    }
    if main is not None:
        figures |= _flight(capture, script, on, main, end, rules, body.foot_radius)
    return JumpFigures(
        standing=True,
        fell=fell,
        found=main is not None,
        flights=float(len(found.all)),
        high_flights=float(len(found.high)),
        upright=main is not None
        and settled < count
        and bool(cosine_of_tilt(capture.orientation[settled]) >= rules.upright_cosine),
        height=float(np.ptp(capture.position[on : end + 1, 2])),
        non_foot_contact=bool(capture.other_contact[on : settled + 1].any()),
        energy=float(capture.electrical_power[on : end + 1].sum() * capture.dt),
        **figures,
    )


def _flight(
    capture: Capture,
    script: Script,
    on: int,
    main: Flight,
    end: int,
    rules: JumpRules,
    foot_radius: float,
) -> dict[str, float]:
    """The figures of the main flight."""
    up, down = main
    plane, z = capture.position[:, :2], capture.position[:, 2]
    displacement, vertical = plane[down] - plane[up], float(capture.velocity[up, 2])
    before, after = on + int(np.argmin(z[on : up + 1])), down + int(np.argmin(z[down : end + 1]))
    apex = float(z[up:down].max())
    low = capture.foot_position[up:down, :, 2].min(axis=1) - foot_radius
    quarter = len(low) // 4
    figures = {
        "apex_gain": apex - rules.standing_height,
        "rise": float(apex - z[up]),
        "ballistic": vertical**2 / (2.0 * GRAVITY),
        "clearance": float(low.max()),
        "clearance_half": float(low[quarter : len(low) - quarter].min()),
        "distance": float(np.hypot(*displacement)),
        "distance_minima": float(np.hypot(*(plane[after] - plane[before]))),
        "gap": _gap(capture, main),
        "lift_off_velocity": vertical,
        "horizontal_velocity": float(np.hypot(*capture.velocity[up, :2])),
        "delay": (up - on) * capture.dt,
        "duration": main.samples * capture.dt,
    }
    if any(script.command[:2]):
        figures["along"] = float(along(displacement, capture.orientation[up], script.command))
    return figures


def _rates(capture: Capture, start: int, on: int) -> dict[str, float]:
    """Roll and pitch rates in the trunk's frame while the robot accelerates (R7)."""
    rates = capture.angular_velocity[start:on, :2]
    if not len(rates):
        return {}
    rms, peak = np.sqrt(np.mean(rates**2, axis=0)), np.abs(rates).max(axis=0)
    return {
        f"{axis}_rate_{what}": float(values[i])
        for i, axis in enumerate(("roll", "pitch"))
        for what, values in (("rms", rms), ("peak", peak))
    }


def _run(capture: Capture, script: Script, start: int, on: int, *, mass: float) -> dict[str, float]:
    """Speed and cost of transport of the steady run before the jump."""
    if start >= on:
        return {}
    travelled = float(np.hypot(*(capture.position[on, :2] - capture.position[start, :2])))
    work = float(capture.electrical_power[start:on].sum() * capture.dt)
    figures = {"cost_of_transport": work / (mass * GRAVITY * travelled)} if travelled else {}
    if any(script.command[:2]):
        speed = along(capture.velocity[start:on], capture.orientation[start:on], script.command)
        figures["speed"] = float(speed.mean())
    return figures


def _loads(capture: Capture, robot: RobotSpec, on: int, end: int) -> dict[str, tuple[float, ...]]:
    """Peaks of each joint, and how near to its torque-speed curve they come."""
    # Links ring on their belts at 100 Hz and more; what the motors turn at is the average.
    samples, half = np.arange(on, end + 1), max(1, round(0.5 * AVERAGE_S / capture.dt))
    late, early = np.minimum(samples + half, len(capture.time) - 1), np.maximum(samples - half, 0)
    turned = capture.joint_position[late] - capture.joint_position[early]
    speed = turned / (capture.time[late] - capture.time[early])[:, None]
    torque = capture.torque[on : end + 1]
    margins = []
    for i, motor in enumerate(joint.drive for joint in robot.joints):
        limits = (motor.stall_torque, motor.no_load_speed, motor.effort_limit)
        low, high = drive.torque_limits(speed[:, i], *limits)
        least = np.minimum(high - torque[:, i], torque[:, i] - low).min()
        margins.append(float(least) / motor.effort_limit)
    return {
        "peak_torque": tuple(np.abs(torque).max(axis=0).tolist()),
        "peak_speed": tuple(np.abs(speed).max(axis=0).tolist()),
        "torque_margin": tuple(margins),
    }


def _gap(capture: Capture, flight: Flight) -> float:
    """Widest gap across the way of travel without a foothold (reading A16) [m].

    NaN if a foot never stood before or never touches again, or nothing was travelled.
    """
    up, down = flight
    displacement = capture.position[down, :2] - capture.position[up, :2]
    length = float(np.hypot(*displacement))
    before, after = capture.contact[:up], capture.contact[down:]
    if length == 0.0 or not (before.any(axis=0).all() and after.any(axis=0).all()):
        return math.nan
    travelled = capture.foot_position[:, :, :2] @ (displacement / length)
    feet = np.arange(travelled.shape[1])
    left = travelled[up - 1 - before[::-1].argmax(axis=0), feet]
    met = travelled[down + after.argmax(axis=0), feet]
    return float(met.min() - left.max())
