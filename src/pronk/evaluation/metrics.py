"""The figures of one jump of the virtual robot, from its capture.

`pronk.evaluation.jumps` defines flights and the figures of the trunk; here are those of feet,
joints and energy, too. In short, with samples k of the capture:

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
from pronk.evaluation.jumps import (
    GRAVITY,
    Flight,
    JumpRules,
    Series,
    cosine_of_tilt,
    heading,
    measure_jump,
)
from pronk.robots.legged import legged
from pronk.robots.robot import Robot
from pronk.runtime.script import Script
from pronk.virtual.capture import Capture

BODY = legged("mini_cheetah")

Array = NDArray[np.float64]

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
    "W": "_W",
}
"""How a unit is spelled in the name of a column."""


def number(unit: str, says: str) -> Any:
    """Declare a figure that is a number: its unit and its equation."""
    return field(default=math.nan, metadata={"unit": unit, "says": says})


def _joints(unit: str, says: str) -> Any:
    return field(default=(), metadata={"unit": unit, "says": says, "joints": True})


@dataclass(frozen=True, kw_only=True)
class JumpFigures:
    """One jump. Every number's unit and equation is in `FIGURES`."""

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
    ballistic: float = number("m", "v_z^2 / 2g with v_z at l: what a stone would rise")
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
        return self.upright and not self.non_foot_contact


def figures_of(kind: type[Any]) -> dict[str, Figure]:
    """Return every figure that is a number, by name, of a dataclass of figures."""
    return {
        entry.name: Figure(name=entry.name, **entry.metadata)
        for entry in fields(kind)
        if entry.metadata
    }


FIGURES: Mapping[str, Figure] = figures_of(JumpFigures)


def series_of(capture: Capture, *, whole: bool = False) -> Series:
    """Return the trunk and the contacts, up to the fall unless `whole`."""
    end = len(capture.time) if whole else fallen_at(capture)
    return Series(
        position=capture.position[:end],
        velocity=capture.velocity[:end],
        orientation=capture.orientation[:end],
        contact=capture.contact[:end],
        dt=capture.dt,
    )


def fallen_at(capture: Capture) -> int:
    """First sample at which the robot lies or leans too far; the sample count if it never does."""
    cosine = cosine_of_tilt(capture.orientation)
    fallen = (cosine < FALLEN_COSINE) | (capture.position[:, 2] < FALLEN_HEIGHT)
    return int(np.argmax(fallen)) if fallen.any() else len(fallen)


def sample_at(capture: Capture, time: float) -> int:
    """First sample at or after a time on the capture's clock [s]."""
    return int(np.searchsorted(capture.time, time - 1e-3 * capture.dt))


def measure(
    capture: Capture,
    script: Script,
    robot: Robot,
    *,
    began: float,
    mass: float,
    rules: JumpRules | None = None,
) -> JumpFigures:
    """Return the figures of one run.

    Args:
        capture: The recorded run.
        script: What was commanded.
        robot: Its drives' limits give the torque margin.
        began: When the policy took over, on the capture's clock [s].
        mass: Of the robot, for the cost of transport [kg].
        rules: Of the definitions.
    """
    rules = rules or JumpRules()
    series = series_of(capture)
    run, on = (sample_at(capture, began + t) for t in (script.start, script.on))
    fell = len(series.position) < len(capture.time)
    if on >= len(series.position):
        return JumpFigures(standing=False, fell=fell)
    figures, main = measure_jump(series, on, script.command, rules)
    seconds = rules.search_s if main is None else rules.tail_s
    last = (on if main is None else main.touchdown) + series.steps(seconds)
    end = min(last, len(series.position) - 1)
    judged = (main.touchdown + series.steps(rules.upright_s)) if main else end
    figures |= {
        "non_foot_contact": bool(capture.other_contact[on : judged + 1].any()),
        "energy": float(capture.electrical_power[on : end + 1].sum() * capture.dt),
    }
    figures |= _rates(capture, run, on)
    figures |= _run(capture, script, run + series.steps(SETTLE_S), on, mass=mass)
    figures |= _loads(capture, robot, on, end)
    if main is not None:
        low = (
            capture.foot_position[main.liftoff : main.touchdown, :, 2].min(axis=1)
            - BODY.foot_radius
        )
        quarter = len(low) // 4
        figures |= {
            "clearance": float(low.max()),
            "clearance_half": float(low[quarter : len(low) - quarter].min()),
            "gap": gap(capture, main),
        }
    return JumpFigures(standing=True, fell=fell, **figures)


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
    forward, left = script.command[:2]
    speed = math.hypot(forward, left)
    if speed:
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


def gap(capture: Capture, flight: Flight) -> float:
    """Return the widest gap across the way of travel without a foothold (reading A16) [m].

    Hind-most first touch of a foot after the flight less front-most last stand of a foot before
    it, along the trunk's displacement. Negative if the feet overlap; NaN if a foot never stood
    before or never touches again, or the robot came down where it lifted off.

    Args:
        capture: The recorded run.
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
