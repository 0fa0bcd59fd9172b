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
from pronk.jump.virtual.capture import TOGETHER, Capture
from pronk.jump.virtual.plant import Indices, legs_of
from pronk.policy.script import Script
from pronk.robots.legged import legged
from pronk.robots.motor import torque_limits
from pronk.robots.robot import RobotSpec

GRAVITY = 9.81
"""Acceleration of free fall [m/s^2]."""
RISE = 0.03
"""Height over standing height that the trunk exceeds in a jump, commanded or not [m]."""
FALLEN_COSINE = 0.34
"""Cosine of the tilt, 70 degrees, beyond which the robot has fallen, as in training [1]."""
FALLEN_HEIGHT = 0.08
"""Height of the trunk below which the robot has fallen, as in training [m]."""
AVERAGE_S = 0.01
"""Time over which joint speeds are averaged: links ring on their belts at 100 Hz and more [s]."""
SETTLE_S = 1.0
"""Time to reach the commanded speed, left out of the figures of the approach [s]."""
SYMBOLS = (
    "c: the jump input rises. l, d: lift-off and touchdown of the main flight, the longest in "
    "which the trunk rises more than 3 cm over standing. e: d + 0.5 s. p, z, v: position, height "
    "and velocity of the trunk's origin. f_i, r: centre and radius of a foot. u: direction of "
    "p_d - p_l in the plane."
)


@dataclass(frozen=True, kw_only=True)
class JumpRules:
    """Times and heights that the definitions use."""

    flight_s: float = 0.015
    """Shortest flight phase, three physics steps of training [s]."""
    long_s: float = 0.06
    """Shortest high flight; a ballistic hop of this length rises 4 mm [s]."""
    search_s: float = 1.5
    """Time after the jump input within which a jump lifts off [s]."""
    tail_s: float = 0.5
    """Time after touchdown that still belongs to the height [s]."""
    upright_s: float = 2.0
    """Time after touchdown at which the robot must be upright [s]."""
    tilt_deg: float = 30.0
    """Largest tilt of an upright robot [deg]."""
    grace_s: float = 0.5
    """Time after the start in which flights are not counted, as the robot is set down [s]."""
    standing_height: float
    """Height of the trunk in the default pose [m]."""
    rise: float = RISE
    """Height over standing height that a high flight exceeds [m]."""

    @classmethod
    def of(cls, robot: RobotSpec, **times: float) -> Self:
        """Return the rules with the standing height of a robot; `times` replace their defaults."""
        return cls(standing_height=legged(robot.source).standing_height, **times)

    @property
    def high(self) -> float:
        """Height of the trunk that a high flight exceeds [m]."""
        return self.standing_height + self.rise

    @property
    def upright_cosine(self) -> float:
        """Cosine of the largest tilt of an upright robot [1]."""
        return math.cos(math.radians(self.tilt_deg))


# ---- motion ----


def heading(orientation: Array) -> Array:
    """Return the yaw of unit quaternions [rad].

    It is atan2(2 (w z + x y), 1 - 2 (y^2 + z^2)).

    Args:
        orientation: Unit quaternions w, x, y, z. (..., 4)

    Returns:
        The yaw angles. (...,)
    """
    w, x, y, z = np.moveaxis(np.asarray(orientation), -1, 0)
    yaw: Array = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return yaw


def cosine_of_tilt(orientation: Array) -> Array:
    """Return the vertical part of the trunk's z axis, 1 - 2 (x^2 + y^2).

    Args:
        orientation: Unit quaternions w, x, y, z. (..., 4)

    Returns:
        The cosines. (...,)
    """
    x = orientation[..., 1]
    y = orientation[..., 2]
    cosine: Array = 1.0 - 2.0 * (x**2 + y**2)
    return cosine


def along(vector: Array, orientation: Array, command: Sequence[float]) -> Array:
    """Return the parts of horizontal vectors along the commanded direction.

    Args:
        vector: Vectors in the world; their first two parts count. (..., 2 or more)
        orientation: The trunk's, unit quaternions w, x, y, z. (..., 4)
        command: Forward and left velocity in the trunk's frame.

    Returns:
        The parts, in the unit of the vectors. (...,)
    """
    direction = heading(orientation) + math.atan2(command[1], command[0])
    part: Array = vector[..., 0] * np.cos(direction) + vector[..., 1] * np.sin(direction)
    return part


def steps(capture: Capture, seconds: float) -> int:
    """Return the number of samples in a time, to the nearest."""
    return round(seconds / capture.dt)


def sample_at(capture: Capture, time: float) -> int:
    """Return the first sample at or after a time on the capture's clock [s]."""
    return int(np.searchsorted(capture.time, time - 1e-3 * capture.dt))


def fallen_at(capture: Capture) -> int:
    """Return the first sample at which the robot has fallen; the sample count if it never has.

    A robot has fallen that lies or leans too far, or whose motion is not finite.
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
    """The flight phases of a capture, by whether they belong to one jump input."""

    commanded: tuple[Flight, ...]
    """Flights that lift off within the search time after the jump input."""
    high: tuple[Flight, ...]
    """High flights among the commanded ones."""
    uncommanded: tuple[Flight, ...]
    """All other flights."""

    @property
    def main(self) -> Flight | None:
        """The longest of the high flights; None if there was no jump."""
        return max(self.high, key=lambda flight: flight.samples, default=None)


def flights(contact: Mask, *, min_samples: int) -> tuple[Flight, ...]:
    """Return the flight phases of some length that have ended, in their order.

    Args:
        contact: Feet on the ground. (T, 4)
        min_samples: Shortest flight phase in samples.
    """
    airborne = ~np.asarray(contact, dtype=bool).any(axis=-1)
    edges = np.flatnonzero(np.diff(airborne.astype(np.int8), prepend=0)).tolist()
    phases = []
    # A flight that has not ended has an edge without a partner.
    for liftoff, touchdown in zip(edges[0::2], edges[1::2], strict=False):
        if touchdown - liftoff >= min_samples:
            phases.append(Flight(liftoff, touchdown))
    return tuple(phases)


def jump_flights(capture: Capture, on: int | None, rules: JumpRules, end: int) -> JumpFlights:
    """Sort the flight phases by whether they belong to a jump input.

    Args:
        capture: The recorded motion.
        on: First sample with the jump input; None without one.
        rules: Times and heights of the definitions.
        end: First sample that is left out.
    """
    height = capture.position[:, 2]
    latest = -1 if on is None else on + steps(capture, rules.search_s)
    commanded = []
    high = []
    uncommanded = []
    for flight in flights(capture.contact[:end], min_samples=steps(capture, rules.flight_s)):
        if on is None or not on <= flight.liftoff <= latest:
            uncommanded.append(flight)
            continue
        commanded.append(flight)
        top = height[flight.liftoff : flight.touchdown].max()
        if flight.samples >= steps(capture, rules.long_s) and top > rules.high:
            high.append(flight)
    return JumpFlights(tuple(commanded), tuple(high), tuple(uncommanded))


def uncommanded_height(capture: Capture, on: int | None, rules: JumpRules) -> float:
    """Return the highest trunk in a flight phase that belongs to no jump input [m].

    Args:
        capture: The recorded motion.
        on: First sample with the jump input; None for a robot that only walks.
        rules: Times and heights of the definitions.

    Returns:
        The height over the floor; NaN without such a flight.
    """
    highest = math.nan
    for flight in jump_flights(capture, on, rules, fallen_at(capture)).uncommanded:
        if flight.liftoff >= steps(capture, rules.grace_s):
            top = float(capture.position[flight.liftoff : flight.touchdown, 2].max())
            highest = top if math.isnan(highest) else max(highest, top)
    return highest


# ---- definitions of figures ----


@dataclass(frozen=True, kw_only=True)
class Figure:
    """What a figure of a run is, and where it stands among the run's figures."""

    name: str
    unit: str
    equation: str
    part: str = ""
    """Field of the figures that holds it; empty for one of the figures themselves."""
    joints: bool = False
    """It is one number for each joint."""

    @property
    def column(self) -> str:
        """Heading of its column in a table, unit included."""
        unit = self.unit.replace("/", "_per_").replace(" ", "_")
        return self.name if unit == "1" else f"{self.name}_{unit}"

    def value(self, figures: Any) -> Any:
        """Return this figure of one run: a number, or a tuple with one of each joint."""
        holder = getattr(figures, self.part) if self.part else figures
        return getattr(holder, self.name)


def figure(unit: str, equation: str) -> Any:
    """Declare a field that is a figure, by its unit and its equation; NaN if it does not exist."""
    return field(default=math.nan, metadata={"unit": unit, "equation": equation, "joints": False})


def joint_figure(unit: str, equation: str) -> Any:
    """Declare a field with a figure of each joint; empty if it does not exist."""
    return field(default=(), metadata={"unit": unit, "equation": equation, "joints": True})


@dataclass(frozen=True, kw_only=True)
class FlightFigures:
    """The main flight of a jump. All are NaN if there was no jump."""

    apex_gain: float = figure(
        "m", "max z over l .. d-1, less the height of the trunk in the default pose"
    )
    rise: float = figure("m", "max z over l .. d-1, less z_l")
    ballistic: float = figure("m", "v_z^2 / 2g with v_z at l: the rise of a ballistic flight")
    clearance: float = figure(
        "m",
        "max over l .. d-1 of min over the feet of (height of f_i - r): all feet are this high at "
        "once",
    )
    clearance_half: float = figure(
        "m",
        "min over the middle half of l .. d-1 of min over the feet of (height of f_i - r): no foot "
        "is lower for half of the flight",
    )
    # Paper E6, in reading A17.
    distance: float = figure("m", "|p_d - p_l| in the plane")
    along: float = figure("m", "(p_d - p_l) along the commanded direction, heading at l")
    # The other reading of A17.
    distance_minima: float = figure(
        "m", "|p_b - p_a| in the plane, z_a the least over c .. l and z_b the least over d .. e"
    )
    # Reading A16.
    gap: float = figure(
        "m",
        "min over the feet of f_i . u at its first contact from d on, less max over the feet of "
        "f_i . u at its last contact before l",
    )
    # Reading A6.
    lift_off_velocity: float = figure("m/s", "v_z at l")
    horizontal_velocity: float = figure("m/s", "|v_xy| at l")
    delay: float = figure("s", "time from c to l")
    duration: float = figure("s", "time from l to d")


@dataclass(frozen=True, kw_only=True)
class ApproachFigures:
    """The run before the jump input."""

    speed: float = figure(
        "m/s", "mean velocity along the command and the heading, from 1 s after it to c"
    )
    roll_rate_rms: float = figure("rad/s", "root mean square of the roll rate while accelerating")
    roll_rate_peak: float = figure("rad/s", "greatest |roll rate| while accelerating")
    pitch_rate_rms: float = figure("rad/s", "root mean square of the pitch rate while accelerating")
    pitch_rate_peak: float = figure("rad/s", "greatest |pitch rate| while accelerating")
    cost_of_transport: float = figure(
        "1", "electrical energy / (m g |p_c - p_b|) from b, 1 s after the command to run, to c"
    )


@dataclass(frozen=True, kw_only=True)
class LoadFigures:
    """Energy and loads of the drives, from the jump input to half a second after touchdown."""

    energy: float = figure(
        "J", "electrical energy over c .. e, what comes back into the battery taken off"
    )
    peak_torque: tuple[float, ...] = joint_figure("N m", "greatest |motor torque| over c .. e")
    peak_speed: tuple[float, ...] = joint_figure(
        "rad/s", "greatest |joint speed|, averaged over 10 ms, over c .. e"
    )
    torque_margin: tuple[float, ...] = joint_figure(
        "1",
        "least distance over c .. e of the motor torque from the drive's torque-speed curve at "
        "nominal bus voltage and that speed, as a share of the effort limit; 0 on the curve, "
        "negative beyond it, where a motor gives more than the model of its drive",
    )


@dataclass(frozen=True, kw_only=True)
class JumpFigures:
    """One jump. A figure that does not exist (no jump, no landing) is NaN."""

    standing: bool
    """The robot had not fallen when the jump input came."""
    found: bool = False
    """There was a jump."""
    non_foot_contact: bool = False
    """Something but a foot touched the ground, from c to 2 s after d."""
    touched_part: str = ""
    """Body of the robot's model that was the first of it, or several of one sample; empty if it is
    not known."""
    fell: bool = False
    """The robot fell, at any time of the run."""
    upright: bool = False
    """There was a jump, and 2 s after d the robot stood, tilted by 30 degrees at most."""
    # Paper E5.
    height: float = figure("m", "max z - min z over c .. e")
    flights: float = figure("1", "flight phases that lift off from c to c + 1.5 s")
    high_flights: float = figure("1", "those of them that are 60 ms or longer and high")
    foot_press: float = figure("1", "max over feet of (r - f_i,z) / r, from c to 2 s after d")
    touch: float = figure(
        "s", "time from d to the first touch of something but a foot; negative before d"
    )
    touch_press: float = figure(
        "1",
        "min over the shanks that touch, from c to 2 s after d, of (r - f_i,z) / r of their own "
        "foot at that time; none if another part touches as well",
    )
    flight: FlightFigures = field(default_factory=FlightFigures, metadata={"part": FlightFigures})
    approach: ApproachFigures = field(
        default_factory=ApproachFigures, metadata={"part": ApproachFigures}
    )
    loads: LoadFigures = field(default_factory=LoadFigures, metadata={"part": LoadFigures})

    @property
    def success(self) -> bool:
        """Whether it landed: upright 2 s later, and nothing but feet touched the ground."""
        return self.upright and not self.non_foot_contact

    @property
    def stood(self) -> bool:
        """Whether the robot stood when the policy was to start.

        One that its drives could not hold did not, and so it did not fall either.
        """
        return self.standing or self.fell


def figures_of(figures_class: type[Any]) -> dict[str, Figure]:
    """Return the figures of a dataclass, and of the parts it has, by name."""
    figures = {}
    for entry in fields(figures_class):
        if "part" in entry.metadata:
            for inner_entry in fields(entry.metadata["part"]):
                figures[inner_entry.name] = Figure(
                    name=inner_entry.name, part=entry.name, **inner_entry.metadata
                )
        elif entry.metadata:
            figures[entry.name] = Figure(name=entry.name, **entry.metadata)
    return figures


def flags_of(figures_class: type[Any]) -> list[str]:
    """Return the names of the fields of a dataclass of figures that are flags or texts."""
    return [entry.name for entry in fields(figures_class) if not entry.metadata]


FIGURES: Mapping[str, Figure] = figures_of(JumpFigures)


# ---- figures of a capture ----


def measure_jump(
    capture: Capture,
    script: Script,
    robot: RobotSpec,
    *,
    began: float,
    rules: JumpRules | None = None,
) -> JumpFigures:
    """Return the figures of one run.

    Args:
        capture: The recorded motion.
        script: The commands of the run.
        robot: The robot, for its mass, feet and drives.
        began: When the policy took over, on the capture's clock [s].
        rules: Times and heights of the definitions; those of the robot if None.
    """
    rules = rules or JumpRules.of(robot)
    body = legged(robot.source)
    run = sample_at(capture, began + script.start)
    on = sample_at(capture, began + script.on)
    count = fallen_at(capture)
    fell = count < len(capture.time)
    if on >= count:
        return JumpFigures(standing=False, fell=fell)
    phases = jump_flights(capture, on, rules, count)
    main = phases.main
    if main is None:
        end = min(on + steps(capture, rules.search_s), count - 1)
        settled = end
        flight = FlightFigures()
        upright = False
    else:
        end = min(main.touchdown + steps(capture, rules.tail_s), count - 1)
        settled = main.touchdown + steps(capture, rules.upright_s)
        flight = _measure_flight(capture, script, on, main, end, rules, body.foot_radius)
        upright = settled < count and bool(
            cosine_of_tilt(capture.orientation[settled]) >= rules.upright_cosine
        )
    touches = on + np.flatnonzero(capture.other_contact[on : settled + 1])
    touch = math.nan
    if main is not None and len(touches):
        touch = float(touches[0] - main.touchdown) * capture.dt
    lowest_foot = float(capture.foot_position[on : settled + 1, :, 2].min())
    return JumpFigures(
        standing=True,
        found=main is not None,
        non_foot_contact=len(touches) > 0,
        touched_part=str(capture.other_parts[touches[0]]) if len(touches) else "",
        fell=fell,
        upright=upright,
        height=float(np.ptp(capture.position[on : end + 1, 2])),
        flights=float(len(phases.commanded)),
        high_flights=float(len(phases.high)),
        foot_press=(body.foot_radius - lowest_foot) / body.foot_radius,
        touch=touch,
        touch_press=_measure_touch_press(capture, touches, robot),
        flight=flight,
        approach=_measure_approach(capture, script, run, on, mass=body.total_mass),
        loads=_measure_loads(capture, robot, on, end),
    )


def _measure_touch_press(capture: Capture, touches: Indices, robot: RobotSpec) -> float:
    """Return how far a foot was pressed in at least while its shank touched the ground [1].

    Args:
        capture: The recorded motion.
        touches: Samples in which anything but a foot touches the ground. (n,)
        robot: The robot.

    Returns:
        The least share of the foot's radius; NaN if nothing touched, another part than a shank
        did, or the parts are not known.
    """
    body = legged(robot.source)
    foot_of_shank = {}
    for foot, leg in enumerate(legs_of(robot)):
        if leg in body.shanks:
            foot_of_shank[body.shanks[leg]] = foot
    least = math.inf
    for sample in touches:
        for part in str(capture.other_parts[sample]).split(TOGETHER):
            if part not in foot_of_shank:
                return math.nan
            height = capture.foot_position[sample, foot_of_shank[part], 2]
            least = min(least, float(body.foot_radius - height) / body.foot_radius)
    return least if len(touches) else math.nan


def _measure_flight(
    capture: Capture,
    script: Script,
    on: int,
    main: Flight,
    end: int,
    rules: JumpRules,
    foot_radius: float,
) -> FlightFigures:
    """Return the figures of the main flight, samples `on` .. `end` being those of the jump."""
    liftoff, touchdown = main
    place = capture.position[:, :2]
    height = capture.position[:, 2]
    displacement = place[touchdown] - place[liftoff]
    vertical = float(capture.velocity[liftoff, 2])
    lowest_before = on + int(np.argmin(height[on : liftoff + 1]))
    lowest_after = touchdown + int(np.argmin(height[touchdown : end + 1]))
    apex = float(height[liftoff:touchdown].max())
    foot_height = capture.foot_position[liftoff:touchdown, :, 2].min(axis=1) - foot_radius
    quarter = len(foot_height) // 4
    middle_half = foot_height[quarter : len(foot_height) - quarter]
    along_command = math.nan
    if any(script.command[:2]):
        along_command = float(along(displacement, capture.orientation[liftoff], script.command))
    return FlightFigures(
        apex_gain=apex - rules.standing_height,
        rise=float(apex - height[liftoff]),
        ballistic=vertical**2 / (2.0 * GRAVITY),
        clearance=float(foot_height.max()),
        clearance_half=float(middle_half.min()),
        distance=float(np.hypot(*displacement)),
        along=along_command,
        distance_minima=float(np.hypot(*(place[lowest_after] - place[lowest_before]))),
        gap=_measure_gap(capture, main),
        lift_off_velocity=vertical,
        horizontal_velocity=float(np.hypot(*capture.velocity[liftoff, :2])),
        delay=(liftoff - on) * capture.dt,
        duration=main.samples * capture.dt,
    )


def _measure_gap(capture: Capture, flight: Flight) -> float:
    """Return the widest gap across the way of travel without a foothold [m].

    It is NaN if a foot never stood before or never touches again, or nothing was travelled.
    """
    liftoff, touchdown = flight
    displacement = capture.position[touchdown, :2] - capture.position[liftoff, :2]
    length = float(np.hypot(*displacement))
    before = capture.contact[:liftoff]
    after = capture.contact[touchdown:]
    if length == 0.0 or not (before.any(axis=0).all() and after.any(axis=0).all()):
        return math.nan
    travelled = capture.foot_position[:, :, :2] @ (displacement / length)
    feet = np.arange(travelled.shape[1])
    last_stance = liftoff - 1 - before[::-1].argmax(axis=0)
    first_stance = touchdown + after.argmax(axis=0)
    return float(travelled[first_stance, feet].min() - travelled[last_stance, feet].max())


def _measure_approach(
    capture: Capture, script: Script, run: int, on: int, *, mass: float
) -> ApproachFigures:
    """Return the figures of the run, from sample `run` with its command to `on` with the jump's.

    Rates in the trunk's frame count from the command on (paper R7), speed and energy once the robot
    has had time to reach the velocity.
    """
    roll_rms = pitch_rms = roll_peak = pitch_peak = math.nan
    rates = capture.angular_velocity[run:on, :2]
    if len(rates):
        roll_rms, pitch_rms = np.sqrt(np.mean(rates**2, axis=0)).tolist()
        roll_peak, pitch_peak = np.abs(rates).max(axis=0).tolist()
    speed = math.nan
    cost_of_transport = math.nan
    settled = run + steps(capture, SETTLE_S)
    if settled < on:
        travelled = float(np.hypot(*(capture.position[on, :2] - capture.position[settled, :2])))
        work = float(capture.electrical_power[settled:on].sum() * capture.dt)
        if travelled:
            cost_of_transport = work / (mass * GRAVITY * travelled)
        if any(script.command[:2]):
            orientation = capture.orientation[settled:on]
            speed = float(along(capture.velocity[settled:on], orientation, script.command).mean())
    return ApproachFigures(
        speed=speed,
        roll_rate_rms=roll_rms,
        roll_rate_peak=roll_peak,
        pitch_rate_rms=pitch_rms,
        pitch_rate_peak=pitch_peak,
        cost_of_transport=cost_of_transport,
    )


def _measure_loads(capture: Capture, robot: RobotSpec, on: int, end: int) -> LoadFigures:
    """Return energy, peaks of each joint, and how near to its torque-speed curve they come."""
    samples = np.arange(on, end + 1)
    half_window = max(1, round(0.5 * AVERAGE_S / capture.dt))
    late = np.minimum(samples + half_window, len(capture.time) - 1)
    early = np.maximum(samples - half_window, 0)
    turned = capture.joint_position[late] - capture.joint_position[early]
    speed = turned / (capture.time[late] - capture.time[early])[:, None]
    torque = capture.torque[on : end + 1]
    margins = []
    for index, joint in enumerate(robot.joints):
        drive = joint.drive
        low, high = torque_limits(
            speed[:, index], drive.stall_torque, drive.no_load_speed, drive.effort_limit
        )
        margin = np.minimum(high - torque[:, index], torque[:, index] - low).min()
        margins.append(float(margin) / drive.effort_limit)
    return LoadFigures(
        energy=float(capture.electrical_power[on : end + 1].sum() * capture.dt),
        peak_torque=tuple(np.abs(torque).max(axis=0).tolist()),
        peak_speed=tuple(np.abs(speed).max(axis=0).tolist()),
        torque_margin=tuple(margins),
    )
