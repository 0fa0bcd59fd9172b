"""The figures of one jump, from what cameras and force plates around the robot saw.

When the robot flies, lifts off and touches down, and what belongs to a jump input, is said in
`pronk.evaluation.jumps`, which training's evaluation uses too. In short, with samples k of the
capture:

    c       the jump input rises
    l, d    lift-off and touchdown of the main flight: the longest one in which the trunk rises
            more than 3 cm over standing; l its first sample without a foot on the ground, d the
            first sample with one again
    e       d + 0.5 s; without a jump c + 1.5 s
    p, z    position of the trunk's origin and its height [m]; v its velocity [m/s]
    f_i     centre of foot i, a sphere of radius r, over ground at height 0
    u       unit vector of travel, (p_d - p_l) in the plane, normalized

`FIGURES` has every figure with its unit and its equation; tables and pages print them from there.
A figure that does not exist (no jump, no landing) is NaN.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pronk.actuator import model as drive
from pronk.evaluation.jumps import Flight, JumpRules, Series, answer, heading
from pronk.evaluation.jumps import measure as measure_jump
from pronk.robots.mini_cheetah.constants import FOOT_RADIUS
from pronk.robots.robot import Robot
from pronk.runtime.script import Script
from pronk.virtual.capture import Capture

Array = NDArray[np.float64]

GRAVITY = 9.81
"""[m/s^2]"""
FALLEN_COSINE = 0.34
"""A trunk that leans further (70 degrees) has fallen, as in training."""
FALLEN_HEIGHT = 0.08
"""A trunk that is lower lies on the ground, as in training [m]."""
AVERAGE_S = 0.01
"""Over which joint speeds are averaged [s]."""
SETTLE_S = 1.0
"""Time to reach the commanded speed, left out of the walking figures [s]."""


@dataclass(frozen=True, kw_only=True)
class Figure:
    """What a figure of a jump is."""

    name: str
    unit: str
    """`1` for a number without one."""
    says: str
    """Its equation, in the symbols of the module."""
    joints: bool = False
    """True if there is one for every joint."""

    @property
    def column(self) -> str:
        """Name and unit, as a column of a table is called."""
        return self.name + UNITS[self.unit]


UNITS = {
    "1": "",
    "m": "_m",
    "s": "_s",
    "m/s": "_m_per_s",
    "rad/s": "_rad_per_s",
    "N m": "_N_m",
    "J": "_J",
}
"""How a unit is spelled in the name of a column."""


def _number(unit: str, says: str) -> Any:
    return field(default=math.nan, metadata={"unit": unit, "says": says})


def _joints(unit: str, says: str) -> Any:
    return field(default=(), metadata={"unit": unit, "says": says, "joints": True})


@dataclass(frozen=True, kw_only=True)
class JumpFigures:
    """One jump. Every number's unit and equation is in `FIGURES`."""

    told: bool
    """The robot had not fallen when the jump input came."""
    found: bool = False
    """There was a jump."""
    touched: bool = False
    """Something else than a foot touched the ground, from c to 2 s after d."""
    fell: bool = False
    """The robot fell, at any time of the run."""
    upright: bool = False
    """There was a jump, and 2 s after d the robot had not fallen and leant 30 degrees at most."""

    height: float = _number("m", "max z - min z over c .. e (paper E5)")
    apex_gain: float = _number(
        "m", "max z over l .. d-1, less the height of the trunk in the default pose"
    )
    rise: float = _number("m", "max z over l .. d-1, less z_l")
    ballistic: float = _number("m", "v_z^2 / 2g with v_z at l: what a stone would rise")
    clearance: float = _number(
        "m",
        "max over l .. d-1 of min over the feet of (height of f_i - r): all feet are this high at "
        "once",
    )
    clearance_half: float = _number(
        "m",
        "min over the middle half of l .. d-1 of min over the feet of (height of f_i - r): no foot "
        "is lower for half of the flight",
    )
    distance: float = _number("m", "|p_d - p_l| in the plane (paper E6, reading A17)")
    along: float = _number("m", "(p_d - p_l) along the commanded direction, heading at l")
    distance_minima: float = _number(
        "m",
        "|p_b - p_a| in the plane, z_a the least over c .. l and z_b the least over d .. e "
        "(the other reading of A17)",
    )
    gap: float = _number(
        "m",
        "min over the feet of f_i . u at its first contact from d on, less max over the feet of "
        "f_i . u at its last contact before l (reading A16)",
    )
    lift_off_velocity: float = _number("m/s", "v_z at l (reading A6)")
    horizontal_velocity: float = _number("m/s", "|v_xy| at l")
    delay: float = _number("s", "time from c to l")
    duration: float = _number("s", "time from l to d")
    flights: float = _number("1", "flight phases that lift off from c to c + 1.5 s")
    high_flights: float = _number("1", "those of them that are 60 ms or longer and high")
    speed: float = _number(
        "m/s", "mean velocity along the command and the heading, from 1 s after it to c"
    )
    roll_rate_rms: float = _number("rad/s", "root mean square of the roll rate while accelerating")
    roll_rate_peak: float = _number("rad/s", "greatest |roll rate| while accelerating")
    pitch_rate_rms: float = _number(
        "rad/s", "root mean square of the pitch rate while accelerating"
    )
    pitch_rate_peak: float = _number("rad/s", "greatest |pitch rate| while accelerating")
    energy: float = _number(
        "J", "electrical energy over c .. e, what comes back into the battery taken off"
    )
    cost_of_transport: float = _number(
        "1", "electrical energy / (m g |p_c - p_b|) from b, 1 s after the command to run, to c"
    )
    peak_torque: tuple[float, ...] = _joints("N m", "greatest |motor torque| over c .. e")
    peak_speed: tuple[float, ...] = _joints(
        "rad/s", "greatest |joint speed|, averaged over 10 ms, over c .. e"
    )
    torque_margin: tuple[float, ...] = _joints(
        "1",
        "least distance over c .. e of the motor torque from the drive's torque-speed curve at "
        "nominal bus voltage and that speed, as a share of the effort limit; 0 on the curve, "
        "negative beyond it, as where a motor gives more than its drive believes",
    )

    @property
    def success(self) -> bool:
        """The landing: upright 2 s later, and nothing but feet touched the ground."""
        return self.upright and not self.touched


FIGURES: Mapping[str, Figure] = {
    entry.name: Figure(name=entry.name, **entry.metadata)
    for entry in fields(JumpFigures)
    if entry.metadata
}
"""Every figure that is a number, by name."""
FLAGS = tuple(entry.name for entry in fields(JumpFigures) if not entry.metadata)
"""Those that are true or false."""


def series_of(capture: Capture) -> Series:
    """The trunk and the contacts up to the fall, if there is one."""
    end = fallen_at(capture)
    return Series(
        position=capture.position[:end],
        velocity=capture.velocity[:end],
        orientation=capture.orientation[:end],
        contact=capture.contact[:end],
        dt=capture.dt,
    )


def fallen_at(capture: Capture) -> int:
    """First sample at which the robot lies or leans too far; their number if it never does."""
    cosine = 1.0 - 2.0 * (capture.orientation[:, 1] ** 2 + capture.orientation[:, 2] ** 2)
    fallen = (cosine < FALLEN_COSINE) | (capture.position[:, 2] < FALLEN_HEIGHT)
    return int(np.argmax(fallen)) if fallen.any() else len(fallen)


def measure(
    capture: Capture,
    script: Script,
    robot: Robot,
    *,
    began: float,
    mass: float,
    rules: JumpRules | None = None,
) -> JumpFigures:
    """The figures of one run.

    Args:
        capture: What was seen.
        script: What was asked.
        robot: Whose drives the loads are compared with.
        began: When the policy took over, on the capture's clock [s].
        mass: Of the robot, for the cost of transport [kg].
        rules: Of the definitions.
    """
    rules = rules or JumpRules()
    series = series_of(capture)
    dt = series.dt
    told, on = (_sample(capture, began + t, dt) for t in (script.start, script.on))
    fell = len(series.position) < len(capture.time)
    jump = measure_jump(series, on, script.command, rules)
    if jump is None:
        return JumpFigures(told=False, fell=fell)
    main = answer(series, on, rules).main
    end = _end(series, on, main, rules)
    judged = (main.touchdown + series.steps(rules.upright_s)) if main else end
    figures: dict[str, Any] = {
        "told": True,
        "found": main is not None,
        "touched": bool(capture.other_contact[on : judged + 1].any()),
        "fell": fell,
        "upright": jump.upright,
        "height": jump.height,
        "apex_gain": jump.apex - rules.standing_height,
        "distance": jump.distance,
        "along": jump.along,
        "lift_off_velocity": jump.vertical,
        "horizontal_velocity": jump.horizontal,
        "delay": jump.delay,
        "duration": jump.duration,
        "flights": float(jump.flights),
        "high_flights": float(jump.high_flights),
        "energy": float(capture.electrical_power[on : end + 1].sum() * dt),
    }
    figures |= _rates(capture, told, on)
    figures |= _walk(capture, script, told + series.steps(SETTLE_S), on, mass=mass, dt=dt)
    figures |= _loads(capture, robot, on, end)
    if main is not None:
        figures |= _flight(capture, main, on, end)
    return JumpFigures(**figures)


def _sample(capture: Capture, time: float, dt: float) -> int:
    """First sample at or after a time."""
    return int(np.searchsorted(capture.time, time - 1e-3 * dt))


def _end(series: Series, on: int, main: Flight | None, rules: JumpRules) -> int:
    """Sample e, of those there are."""
    if main is None:
        end = on + series.steps(rules.search_s)
    else:
        end = main.touchdown + series.steps(rules.tail_s)
    return min(end, len(series.position) - 1)


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


def _walk(
    capture: Capture, script: Script, start: int, on: int, *, mass: float, dt: float
) -> dict[str, float]:
    """Speed and cost of transport of the steady run before the jump."""
    if start >= on:
        return {}
    travelled = float(np.hypot(*(capture.position[on, :2] - capture.position[start, :2])))
    work = float(capture.electrical_power[start:on].sum() * dt)
    figures = {"cost_of_transport": work / (mass * GRAVITY * travelled)} if travelled else {}
    forward, left = script.command[:2]
    asked = math.hypot(forward, left)
    if asked:
        direction = heading(capture.orientation[start:on]) + math.atan2(left, forward)
        velocity = capture.velocity[start:on]
        part = velocity[:, 0] * np.cos(direction) + velocity[:, 1] * np.sin(direction)
        figures["speed"] = float(part.mean())
    return figures


def _loads(capture: Capture, robot: Robot, on: int, end: int) -> dict[str, tuple[float, ...]]:
    """Peaks of each joint, and how near to its torque-speed curve they come."""
    # Links ring on their belts at 100 Hz and more; what the motors turn at is the average.
    half = max(1, round(0.5 * AVERAGE_S / capture.dt))
    late = np.minimum(np.arange(on, end + 1) + half, len(capture.time) - 1)
    early = np.maximum(np.arange(on, end + 1) - half, 0)
    turned = capture.joint_position[late] - capture.joint_position[early]
    speed = turned / (capture.time[late] - capture.time[early])[:, None]
    torque = capture.torque[on : end + 1]
    margins = []
    for i, joint in enumerate(robot.joints):
        limits = (joint.drive.stall_torque, joint.drive.no_load_speed, joint.drive.effort_limit)
        low, high = drive.torque_limits(speed[:, i], *limits)
        least = np.minimum(high - torque[:, i], torque[:, i] - low).min()
        margins.append(float(least) / joint.drive.effort_limit)
    return {
        "peak_torque": tuple(np.abs(torque).max(axis=0).tolist()),
        "peak_speed": tuple(np.abs(speed).max(axis=0).tolist()),
        "torque_margin": tuple(margins),
    }


def _flight(capture: Capture, main: Flight, on: int, end: int) -> dict[str, float]:
    """What only a jump has."""
    up, down = main.liftoff, main.touchdown
    z, plane = capture.position[:, 2], capture.position[:, :2]
    lowest = capture.foot_position[up:down, :, 2].min(axis=1) - FOOT_RADIUS
    quarter = len(lowest) // 4
    before = on + int(np.argmin(z[on : up + 1]))
    after = down + int(np.argmin(z[down : end + 1]))
    return {
        "rise": float(z[up:down].max() - z[up]),
        "ballistic": float(capture.velocity[up, 2] ** 2 / (2.0 * GRAVITY)),
        "clearance": float(lowest.max()),
        "clearance_half": float(lowest[quarter : len(lowest) - quarter].min()),
        "distance_minima": float(np.hypot(*(plane[after] - plane[before]))),
        "gap": gap(capture, main),
    }


def gap(capture: Capture, flight: Flight) -> float:
    """Widest gap across the way of travel into which no foot stepped (reading A16) [m].

    Hind-most first touch of a foot after the flight less front-most last stand of a foot before
    it, along the trunk's displacement. Negative if the feet overlap; NaN if a foot never stood
    before or never touches again, or the robot came down where it lifted off.

    Args:
        capture: What was seen.
        flight: The main flight.
    """
    up, down = flight.liftoff, flight.touchdown
    displacement = capture.position[down, :2] - capture.position[up, :2]
    length = float(np.hypot(*displacement))
    before, after = capture.contact[:up], capture.contact[down:]
    if length == 0.0 or not (before.any(axis=0).all() and after.any(axis=0).all()):
        return math.nan
    along = capture.foot_position[:, :, :2] @ (displacement / length)
    feet = np.arange(along.shape[1])
    left = along[up - 1 - before[::-1].argmax(axis=0), feet]
    met = along[down + after.argmax(axis=0), feet]
    return float(met.min() - left.max())
