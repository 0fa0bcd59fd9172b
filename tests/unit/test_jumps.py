"""Flight phases and figures of a jump, on motion whose figures are known in closed form."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

import seen_jump as case
from pronk.jump.trial.jumps import (
    FIGURES,
    JumpFigures,
    JumpRules,
    along,
    flights,
    heading,
    measure_jump,
    uncommanded_height,
)
from pronk.jump.virtual.capture import Capture
from pronk.policy.script import Script
from pronk.robots import load_robot
from pronk.robots.legged import legged
from seen_jump import SCRIPT, STANDING, G, changed, motion, seen_jump

ROBOT = load_robot("mini_cheetah")
RULES = JumpRules(standing_height=STANDING)

# --- Flights ------------------------------------------------------------------------------------

STEP = 0.005
"""Time between two samples [s]."""
Piece = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Height, vertical velocity, contact."""


def ground(samples: int, height: float = STANDING) -> Piece:
    return np.full(samples, height), np.zeros(samples), np.ones(samples, bool)


def hop(samples: int) -> Piece:
    """Ballistic flight between two samples on the ground, `samples` + 1 steps apart."""
    time = STEP * np.arange(1, samples + 1)
    speed = 0.5 * G * STEP * (samples + 1)
    height = STANDING + speed * time - 0.5 * G * time**2
    return height, speed - G * time, np.zeros(samples, bool)


def series(*pieces: Piece, forward: float = 0.0, left: float = 0.0, yaw: float = 0.0) -> Capture:
    """Pieces one after the other, at constant horizontal velocity and yaw."""
    height = np.concatenate([piece[0] for piece in pieces])
    vertical = np.concatenate([piece[1] for piece in pieces])
    contact = np.concatenate([piece[2] for piece in pieces])
    time = STEP * np.arange(len(height))
    turn = np.array([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)])
    forward_speed = np.full_like(height, forward)
    left_speed = np.full_like(height, left)
    return motion(
        time,
        position=np.column_stack([forward * time, left * time, height]),
        velocity=np.column_stack([forward_speed, left_speed, vertical]),
        orientation=np.tile(turn, (len(height), 1)),
        # One foot is enough.
        contact=contact[:, None] & np.array([True, False, False, False]),
    )


def jump_of(
    capture: Capture,
    on: int,
    rules: JumpRules = RULES,
    command: tuple[float, float, float] = (1.0, 0.0, 0.0),
) -> JumpFigures:
    """Figures of a run whose jump input rises at sample `on`."""
    script = Script(command=command, stand_s=0.0, run_s=on * STEP)
    return measure_jump(capture, script, ROBOT, began=0.0, rules=rules)


def test_distance_along_the_command_is_signed_and_turns_with_the_trunk() -> None:
    flown = 99 * STEP
    # The trunk looks along world y; commanded to the right, it flies along world x.
    capture = series(ground(100), hop(99), ground(500), forward=1.5, left=0.5, yaw=math.pi / 2)
    right = jump_of(capture, 80, command=(0.0, -1.0, 0.0))
    assert right.flight.along == pytest.approx(1.5 * flown)
    back = jump_of(capture, 80, command=(-2.0, 0.0, 0.0))
    assert back.flight.along == pytest.approx(-0.5 * flown)
    assert math.isnan(jump_of(capture, 80, command=(0.0, 0.0, 0.0)).flight.along)


LOW = (hop(40)[0] - 0.1, *hop(40)[1:])
"""A long flight with bent legs, under standing height."""


@pytest.mark.parametrize(
    ("pieces", "counts", "delay", "duration"),
    [
        ((hop(40), ground(20), hop(60)), (2, 2), 10 + 60, 60),  # the longer is the jump
        ((hop(40), ground(20), hop(40)), (2, 2), 10, 40),  # of equal ones the first
        ((hop(12), ground(12), hop(60)), (2, 1), 10 + 24, 60),
        ((LOW, ground(12), hop(36)), (2, 1), 10 + 52, 36),
    ],
)
def test_which_flight_is_the_jump(
    pieces: tuple[Piece, ...], counts: tuple[int, int], delay: int, duration: int
) -> None:
    figures = jump_of(series(ground(100), *pieces, ground(500)), 90)
    assert figures.found
    assert (figures.flights, figures.high_flights) == counts
    assert figures.flight.delay == pytest.approx(delay * STEP)
    assert figures.flight.duration == pytest.approx(duration * STEP)


@pytest.mark.parametrize(
    ("pieces", "flight_count"),
    [
        ((hop(2), ground(3), hop(2)), 0),  # chatter is no flight
        ((hop(12), ground(12), hop(12)), 2),  # a gait's flights rise 5 mm
    ],
)
def test_which_flights_are_no_jumps(pieces: tuple[Piece, ...], flight_count: int) -> None:
    figures = jump_of(series(ground(100), *pieces, ground(500)), 90)
    assert not figures.found
    assert (figures.flights, figures.high_flights) == (flight_count, 0)


@pytest.mark.parametrize(("excess", "count"), [(1e-4, 1), (-1e-4, 0)])
def test_a_high_flight_is_more_than_3_cm_over_standing_height(excess: float, count: int) -> None:
    height, vertical, contact = hop(12)
    lifted = height + (STANDING + 0.03 + excess - height.max())
    capture = series(ground(100), (lifted, vertical, contact), ground(500))
    assert jump_of(capture, 90).high_flights == count


def test_height_is_of_the_crouch_before_and_the_half_second_after() -> None:
    top = (0.5 * G * 102 * STEP) ** 2 / (2.0 * G)
    crouched = series(ground(90), ground(10, 0.2), hop(101), ground(500))
    assert jump_of(crouched, 80).height == pytest.approx(STANDING + top - 0.2)
    assert jump_of(crouched, 100).height == pytest.approx(top, abs=1e-9)
    for wait, low in ((100, 0.15), (101, STANDING)):
        capture = series(ground(100), hop(101), ground(wait), ground(1, 0.15), ground(500))
        assert jump_of(capture, 80).height == pytest.approx(STANDING + top - low, abs=1e-9)


def test_height_without_a_jump_is_that_of_the_search() -> None:
    for wait, height in ((300, 0.2), (301, 0.0)):
        figures = jump_of(series(ground(80 + wait), ground(1, 0.1)), 80)
        assert figures.height == pytest.approx(height)


def test_a_jump_lifts_off_within_the_search_time() -> None:
    capture = series(ground(150), hop(80), ground(700))
    assert jump_of(capture, 150).found
    assert not jump_of(capture, 151).found
    quick = replace(RULES, search_s=0.25)
    assert jump_of(capture, 100, quick).found
    assert not jump_of(capture, 99, quick).found
    assert not jump_of(series(ground(100), hop(80)), 90).found  # it has not ended


@pytest.mark.parametrize(
    ("tilt_deg", "wait", "upright"), [(29.0, 401, True), (31.0, 401, False), (0.0, 400, False)]
)
def test_upright_is_measured_two_seconds_after_touchdown(
    tilt_deg: float, wait: int, upright: bool
) -> None:
    capture = series(ground(100), hop(80), ground(wait))
    half = math.radians(tilt_deg) / 2
    roll = np.tile([math.cos(half), math.sin(half), 0.0, 0.0], (len(capture.time), 1))
    assert jump_of(replace(capture, orientation=roll), 90).upright is upright


def test_the_highest_flight_without_a_jump_input() -> None:
    first = hop(30)
    second = hop(60)
    late = hop(20)
    capture = series(ground(99), first, ground(50), second, ground(400), late, ground(10), hop(90))
    assert uncommanded_height(capture, None, RULES) == pytest.approx(second[0].max())
    on = 99 + 30 + 50
    assert uncommanded_height(capture, on, RULES) == pytest.approx(late[0].max())
    # The robot is set down in the first 100 samples.
    assert math.isnan(uncommanded_height(series(ground(99), first, ground(9)), None, RULES))
    assert uncommanded_height(series(ground(100), first, ground(9)), None, RULES) > STANDING


@given(hnp.arrays(bool, st.tuples(st.integers(0, 60), st.just(4))), st.integers(1, 5))
def test_flights_are_the_longest_stretches_without_contact(
    contact: np.ndarray, min_samples: int
) -> None:
    line = "".join("g" if feet.any() else "a" for feet in contact)
    expected = []
    begin = 0
    for stretch in line.split("g")[:-1]:
        if len(stretch) >= min_samples:
            expected.append((begin, begin + len(stretch)))
        begin += len(stretch) + 1
    phases = flights(contact, min_samples=min_samples)
    assert [(phase.liftoff, phase.touchdown) for phase in phases] == expected


@given(st.floats(-3.1, 3.1), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_heading_is_the_yaw_whatever_the_tilt(yaw: float, pitch: float, roll: float) -> None:
    turn = Rotation.from_euler("ZYX", [yaw, pitch, roll])
    quaternion = turn.as_quat(scalar_first=True)
    assert heading(quaternion) == pytest.approx(yaw, abs=1e-9)
    ahead = np.array([math.cos(yaw), math.sin(yaw)])
    assert along(2.0 * ahead, quaternion, (3.0, 0.0)) == pytest.approx(2.0)


# --- All figures ---------------------------------------------------------------------------------

UP = 2.0
"""Lift-off velocity [m/s]."""
FLIGHT = round(2.0 * UP / G, 3)
"""Time in the air [s]."""
RISE = UP**2 / (2.0 * G)
"""Rise of the flight [m]."""
ON = SCRIPT.on
OFF = SCRIPT.on + case.DELAY
DOWN = SCRIPT.on + case.DELAY + FLIGHT
"""Jump input, lift-off and touchdown [s]."""


def measured(capture: Capture) -> JumpFigures:
    return measure_jump(capture, SCRIPT, ROBOT, began=0.0, rules=RULES)


def between(begin: float, end: float) -> slice:
    """The samples between two times [s]."""
    return slice(round(begin / case.DT), round(end / case.DT))


def test_a_jump_by_hand() -> None:
    figures = measured(seen_jump(up=UP, speed=1.0))
    assert figures.standing
    assert figures.found
    assert figures.upright
    assert figures.success
    assert not figures.non_foot_contact
    assert not figures.fell
    assert (figures.flights, figures.high_flights) == (1.0, 1.0)
    height = case.Z_OFF + RISE - (STANDING - case.CROUCH)
    assert figures.height == pytest.approx(height, abs=1e-5)
    assert figures.approach.speed == pytest.approx(1.0, abs=1e-5)
    # 100 W from the input to .5 s after touchdown; 1 m/s.
    assert figures.loads.energy == pytest.approx(100.0 * (case.DELAY + FLIGHT + 0.5), abs=0.2)
    assert figures.approach.cost_of_transport == pytest.approx(100.0 / (12.0 * G), rel=1e-6)


def test_a_flight_by_hand() -> None:
    flight = measured(seen_jump(up=UP, speed=1.0)).flight
    assert flight.delay == pytest.approx(case.DELAY, abs=1e-5)
    assert flight.duration == pytest.approx(FLIGHT, abs=1e-5)
    assert flight.apex_gain == pytest.approx(case.Z_OFF + RISE - STANDING, abs=1e-5)
    assert flight.rise == pytest.approx(RISE, abs=1e-5)
    assert flight.ballistic == pytest.approx(RISE, abs=1e-5)
    assert flight.lift_off_velocity == pytest.approx(UP, abs=1e-5)
    assert flight.horizontal_velocity == pytest.approx(1.0, abs=1e-5)
    assert flight.distance == pytest.approx(FLIGHT, abs=1e-5)
    assert flight.along == pytest.approx(FLIGHT, abs=1e-5)
    # The feet are as wide apart as the hips: the rest of the distance is the gap (A16). Their last
    # stand is one sample before lift-off.
    gap = FLIGHT + case.DT - (case.FEET[0, 0] - case.FEET[2, 0])
    assert flight.gap == pytest.approx(gap, abs=1e-5)
    # The trunk is lowest .1 s after the jump input and .1 s after touchdown.
    assert flight.distance_minima == pytest.approx(case.DELAY - 0.1 + FLIGHT, abs=2e-3)
    assert flight.clearance == pytest.approx(RISE + case.TUCKED, abs=1e-4)
    # A quarter of the flight away from the apex: 3/4 of the rise, sin(pi / 4) of the tuck.
    clearance_half = 0.75 * RISE + math.sin(math.pi / 4.0) * case.TUCKED
    assert flight.clearance_half == pytest.approx(clearance_half, abs=2e-3)


def test_the_gap_is_between_footholds() -> None:
    capture = seen_jump(up=UP)
    gap = measured(capture).flight.gap
    # A front foot that has left the ground .3 s before: its foothold is .3 m further back.
    early = changed(capture, "contact", (between(OFF - 0.3, OFF), [0, 1]), False)
    # Then the hind feet's last stand, .42 m behind, is still further back.
    assert measured(early).flight.gap == pytest.approx(gap + 0.3, abs=2e-3)
    # A hind foot that comes down .05 m further back takes that off.
    foot = capture.foot_position[-1, 3, 0] - 0.05
    back = changed(capture, "foot_position", (between(DOWN, 8.0), 3, 0), foot)
    assert measured(back).flight.gap == pytest.approx(gap - 0.05)


def test_without_a_jump() -> None:
    capture = seen_jump()
    figures = measured(replace(capture, contact=np.ones_like(capture.contact)))
    assert figures.standing
    assert not figures.found
    assert not figures.success
    assert math.isnan(figures.flight.distance)
    assert math.isnan(figures.flight.gap)
    assert math.isnan(figures.flight.apex_gain)
    # Height is that of the 1.5 s after the input.
    height = case.Z_OFF + RISE - (STANDING - case.CROUCH)
    assert figures.height == pytest.approx(height, abs=1e-5)
    assert figures.flights == figures.high_flights == 0.0


def test_a_robot_that_fell_before_the_jump_has_no_figures() -> None:
    figures = measured(changed(seen_jump(), "position", (between(ON - 0.5, 9.0), 2), 0.05))
    assert not figures.standing
    assert figures.fell
    assert not figures.success
    for name, definition in FIGURES.items():
        if not definition.joints:
            assert math.isnan(definition.value(figures)), name


@pytest.mark.parametrize("after", [0.1, 1.9])
def test_a_robot_that_fell_after_the_jump_did_not_land(after: float) -> None:
    # Lying on its side: x of the quaternion is sin(45 degrees).
    side = np.array([math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0])
    figures = measured(changed(seen_jump(), "orientation", between(DOWN + after, 9.0), side))
    assert figures.found
    assert figures.fell
    assert not figures.upright
    assert not figures.success
    assert figures.flight.distance == pytest.approx(FLIGHT)


@pytest.mark.parametrize(
    ("time", "touches"),
    [(ON - 0.1, False), (ON + 0.01, True), (DOWN + 1.9, True), (DOWN + 2.1, False)],
)
def test_a_knee_on_the_ground_is_no_success(time: float, touches: bool) -> None:
    capture = changed(seen_jump(), "other_contact", between(time, time + 0.05), True)
    figures = measured(capture)
    assert figures.non_foot_contact is touches
    assert figures.success is not touches
    assert figures.upright


def touched(capture: Capture, time: float, parts: str, duration: float = 0.05) -> Capture:
    """The same with parts on the ground from a time on for a while [s]."""
    samples = between(time, time + duration)
    names = capture.other_parts.astype("<U40")
    names[samples] = parts
    touching = changed(capture, "other_contact", samples, True)
    return replace(touching, other_parts=names)


def pressed(capture: Capture, time: float, foot: int, press: float) -> Capture:
    """The same with a foot pressed in by a share of its radius from a time on for 0.1 s."""
    height = (1.0 - press) * case.BODY.foot_radius
    return changed(capture, "foot_position", (between(time, time + 0.1), foot, 2), height)


@pytest.mark.parametrize("after", [-0.5, 0.09, 1.9])
def test_the_first_touch_has_a_part_and_a_time_after_touchdown(after: float) -> None:
    time = round(DOWN + after, 3)
    # Before the jump input and more than 2 s after touchdown it does not count.
    capture = touched(seen_jump(), ON - 0.2, "trunk")
    capture = touched(capture, DOWN + 2.1, "trunk")
    assert measured(capture).touched_part == ""
    assert math.isnan(measured(capture).touch)
    # Only the first counts.
    capture = touched(capture, time + 0.06, "FL_thigh")
    capture = touched(capture, time, "HR_thigh+HL_thigh")
    figures = measured(capture)
    assert figures.non_foot_contact
    assert figures.touched_part == "HR_thigh+HL_thigh"
    assert figures.touch == pytest.approx(after, abs=1.5 * case.DT)


def test_a_touch_without_a_jump_has_a_part_and_no_time() -> None:
    standing = motion(seen_jump().time)
    figures = measured(touched(standing, ON + 0.3, "trunk"))
    assert not figures.found
    assert figures.touched_part == "trunk"
    assert math.isnan(figures.touch)


def test_a_touch_of_a_part_that_is_not_known_has_a_time() -> None:
    figures = measured(changed(seen_jump(), "other_contact", between(DOWN + 0.2, DOWN + 0.3), True))
    assert figures.non_foot_contact
    assert figures.touched_part == ""
    assert figures.touch == pytest.approx(0.2, abs=1.5 * case.DT)
    assert math.isnan(figures.touch_press)


@pytest.mark.parametrize(
    ("parts", "foot", "pressed_after", "press"),
    [
        # Feet are FR, FL, HR, HL; the touch is from 0.1 to 0.15 s after touchdown.
        ("HR_shank", 2, 0.1, 1.4),
        ("HR_shank", 2, 0.5, 0.0),  # another time
        ("HR_shank", 2, 0.12, 0.0),  # a part of the time
        ("HR_shank", 3, 0.1, 0.0),  # another leg
        ("HR_shank+HL_shank", 2, 0.1, 0.0),  # one of two legs
        ("HR_thigh", 2, 0.1, math.nan),
        ("HR_thigh+HR_shank", 2, 0.1, math.nan),
    ],
)
def test_the_press_of_a_foot_counts_while_its_own_shank_touches(
    parts: str, foot: int, pressed_after: float, press: float
) -> None:
    capture = pressed(seen_jump(), DOWN + pressed_after, foot, 1.4)
    figures = measured(touched(capture, DOWN + 0.1, parts))
    assert figures.foot_press == pytest.approx(1.4)
    assert figures.touch_press == pytest.approx(press, abs=1e-9, nan_ok=True)


def test_without_a_touch_there_is_no_press_of_one() -> None:
    figures = measured(pressed(seen_jump(), DOWN + 0.1, 2, 1.4))
    assert math.isnan(figures.touch_press)


@pytest.mark.parametrize(("time", "counts"), [(ON - 0.1, False), (ON + 0.01, True)])
def test_how_far_a_foot_is_pressed_in_is_a_share_of_its_radius(time: float, counts: bool) -> None:
    radius = legged(ROBOT.source).foot_radius
    capture = seen_jump()
    pressed = capture.foot_position.copy()
    pressed[between(time, time + 0.02), 2, 2] = -0.5 * radius
    figures = measured(replace(capture, foot_position=pressed))
    before = measured(capture).foot_press
    assert before < 1.0
    assert figures.foot_press == pytest.approx(1.5 if counts else before)


def test_rates_are_those_of_the_acceleration() -> None:
    capture = seen_jump()
    rates = np.outer(np.sin(2.0 * np.pi * 5.0 * capture.time), [3.0, -2.0, 0.0])
    rates[capture.time < SCRIPT.start] = 50.0
    rates[capture.time >= ON] = 50.0
    approach = measured(replace(capture, angular_velocity=rates)).approach
    assert approach.roll_rate_peak == pytest.approx(3.0, rel=1e-4)
    assert approach.roll_rate_rms == pytest.approx(3.0 / math.sqrt(2.0), rel=1e-3)
    assert approach.pitch_rate_peak == pytest.approx(2.0, rel=1e-4)
    assert approach.pitch_rate_rms == pytest.approx(2.0 / math.sqrt(2.0), rel=1e-3)


def test_loads_by_hand() -> None:
    capture = seen_jump()
    knee = ROBOT.joint_names.index("FR_knee")
    drive = ROBOT.joints[knee].drive
    # The knee turns at half its no-load speed and is pushed on at half of what it can give then.
    speed = 0.5 * drive.no_load_speed
    limit = min(drive.effort_limit, 0.5 * drive.stall_torque)
    turned = changed(capture, "joint_position", (slice(None), knee), speed * capture.time)
    loaded = changed(turned, "torque", (between(ON, DOWN), knee), 0.5 * limit)
    # What happens long before the input is of no interest.
    loaded = changed(loaded, "torque", (between(0.0, 1.0), 0), 100.0)
    loads = measured(loaded).loads
    assert loads.peak_speed[knee] == pytest.approx(speed)
    assert loads.peak_torque[knee] == pytest.approx(0.5 * limit)
    assert loads.torque_margin[knee] == pytest.approx(0.5 * limit / drive.effort_limit)
    assert loads.peak_torque[0] == loads.peak_speed[0] == 0.0
    assert loads.torque_margin[0] == pytest.approx(1.0)
    excess = -1.2 * ROBOT.joints[1].drive.effort_limit
    beyond = changed(capture, "torque", (between(ON, DOWN), 1), excess)
    assert measured(beyond).loads.torque_margin[1] == pytest.approx(-0.2)


def test_began_shifts_the_script() -> None:
    capture = seen_jump()
    later = replace(capture, time=capture.time + 3.0)
    figures = measured(capture)
    later_figures = measure_jump(later, SCRIPT, ROBOT, began=3.0, rules=RULES)
    for name, definition in FIGURES.items():
        expected = pytest.approx(definition.value(figures), nan_ok=True)
        assert definition.value(later_figures) == expected, name
