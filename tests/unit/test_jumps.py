"""Flight phases and figures of a jump, on motion whose figures are known in closed form."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

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
    measure,
    uncommanded_height,
)
from pronk.jump.virtual.capture import Capture
from pronk.policy.script import Script
from pronk.robots import load_robot
from seen_jump import SCRIPT, STANDING, G, changed, motion, seen_jump

ROBOT = load_robot("mini_cheetah")
RULES = JumpRules(standing_height=STANDING)

# --- Flights ------------------------------------------------------------------------------------

STEP, STAND = 0.005, STANDING
Piece = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Height, vertical velocity, contact."""


def ground(samples: int, height: float = STAND) -> Piece:
    return np.full(samples, height), np.zeros(samples), np.ones(samples, bool)


def hop(samples: int) -> Piece:
    """Ballistic flight between two samples on the ground, `samples` + 1 steps apart."""
    time = STEP * np.arange(1, samples + 1)
    speed = 0.5 * G * STEP * (samples + 1)
    return STAND + speed * time - 0.5 * G * time**2, speed - G * time, np.zeros(samples, bool)


def series(*pieces: Piece, forward: float = 0.0, left: float = 0.0, yaw: float = 0.0) -> Capture:
    z, vz, touching = (np.concatenate(part) for part in zip(*pieces, strict=True))
    time = STEP * np.arange(len(z))
    turn = np.array([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)])
    return motion(
        time,
        position=np.column_stack([forward * time, left * time, z]),
        velocity=np.column_stack([np.full_like(z, forward), np.full_like(z, left), vz]),
        orientation=np.tile(turn, (len(z), 1)),
        # One foot is enough.
        contact=touching[:, None] & np.array([True, False, False, False]),
    )


def jump_of(
    whole: Capture,
    on: int,
    rules: JumpRules = RULES,
    command: tuple[float, float, float] = (1.0, 0.0, 0.0),
) -> JumpFigures:
    script = Script(command=command, stand_s=0.0, run_s=on * STEP)
    return measure(whole, script, ROBOT, began=0.0, rules=rules)


def test_distance_along_the_command_is_signed_and_turns_with_the_trunk() -> None:
    flown = 99 * STEP
    # The trunk looks along world y; commanded to the right, it flies along world x.
    whole = series(ground(100), hop(99), ground(500), forward=1.5, left=0.5, yaw=math.pi / 2)
    assert jump_of(whole, 80, command=(0.0, -1.0, 0.0)).along == pytest.approx(1.5 * flown)
    assert jump_of(whole, 80, command=(-2.0, 0.0, 0.0)).along == pytest.approx(-0.5 * flown)
    assert math.isnan(jump_of(whole, 80, command=(0.0, 0.0, 0.0)).along)


LOW = (hop(40)[0] - 0.1, *hop(40)[1:])
"""A long flight with bent legs, under standing height."""


@pytest.mark.parametrize(
    ("pieces", "counts", "delay", "duration"),
    [
        ((hop(40), ground(20), hop(60)), (2, 2), 10 + 60, 60),  # the longer is the jump
        ((hop(40), ground(20), hop(40)), (2, 2), 10, 40),  # of equal ones the first
        ((hop(2), ground(3), hop(2)), (0, 0), None, None),  # chatter is no flight
        ((hop(12), ground(12), hop(12)), (2, 0), None, None),  # a gait's flights rise 5 mm
        ((hop(12), ground(12), hop(60)), (2, 1), 10 + 24, 60),
        ((LOW, ground(12), hop(36)), (2, 1), 10 + 52, 36),
    ],
)
def test_which_flights_are_jumps(
    pieces: tuple[Piece, ...], counts: tuple[int, int], delay: int | None, duration: int | None
) -> None:
    found = jump_of(series(ground(100), *pieces, ground(500)), 90)
    assert (found.flights, found.high_flights) == counts
    assert found.found == (delay is not None)
    if delay is not None and duration is not None:
        assert (found.delay, found.duration) == pytest.approx((delay * STEP, duration * STEP))


@pytest.mark.parametrize(("excess", "count"), [(1e-4, 1), (-1e-4, 0)])
def test_a_high_flight_is_more_than_3_cm_over_standing_height(excess: float, count: int) -> None:
    z, vz, touching = hop(12)
    lifted = z + (STAND + 0.03 + excess - z.max()), vz, touching
    assert jump_of(series(ground(100), lifted, ground(500)), 90).high_flights == count


def test_height_is_of_the_crouch_before_and_the_half_second_after() -> None:
    top = (0.5 * G * 102 * STEP) ** 2 / (2.0 * G)
    before = series(ground(90), ground(10, 0.2), hop(101), ground(500))
    assert jump_of(before, 80).height == pytest.approx(STAND + top - 0.2)
    assert jump_of(before, 100).height == pytest.approx(top, abs=1e-9)
    for wait, low in ((100, 0.15), (101, STAND)):
        whole = series(ground(100), hop(101), ground(wait), ground(1, 0.15), ground(500))
        assert jump_of(whole, 80).height == pytest.approx(STAND + top - low, abs=1e-9)
    # Without a jump it is of the search.
    for wait, height in ((300, 0.2), (301, 0.0)):
        found = jump_of(series(ground(80 + wait), ground(1, 0.1)), 80)
        assert found.height == pytest.approx(height)


def test_a_jump_lifts_off_within_the_search_time() -> None:
    whole = series(ground(150), hop(80), ground(700))
    search = replace(RULES, search_s=0.25)
    found = [jump_of(whole, *each).found for each in ((150,), (151,), (100, search), (99, search))]
    assert found == [True, False, True, False]
    assert not jump_of(series(ground(100), hop(80)), 90).found  # it has not ended


def test_upright_is_measured_two_seconds_after_touchdown() -> None:
    for degrees, wait, upright in ((29.0, 401, True), (31.0, 401, False), (0.0, 400, False)):
        whole, half = series(ground(100), hop(80), ground(wait)), math.radians(degrees) / 2
        roll = np.tile([math.cos(half), math.sin(half), 0.0, 0.0], (len(whole.time), 1))
        assert jump_of(replace(whole, orientation=roll), 90).upright is upright


def test_the_highest_flight_without_a_jump_input() -> None:
    first, second, late = hop(30), hop(60), hop(20)
    whole = series(ground(99), first, ground(50), second, ground(400), late, ground(10), hop(90))
    assert uncommanded_height(whole, None, RULES) == pytest.approx(second[0].max())
    assert uncommanded_height(whole, 99 + 30 + 50, RULES) == pytest.approx(late[0].max())
    # The robot is set down in the first 100 samples.
    assert math.isnan(uncommanded_height(series(ground(99), first, ground(9)), None, RULES))
    assert uncommanded_height(series(ground(100), first, ground(9)), None, RULES) > STAND


@given(hnp.arrays(bool, st.tuples(st.integers(0, 60), st.just(4))), st.integers(1, 5))
def test_flights_are_the_longest_stretches_without_contact(contact: np.ndarray, least: int) -> None:
    line = "".join("g" if feet.any() else "a" for feet in contact)
    expected, begin = [], 0
    for stretch in line.split("g")[:-1]:
        if len(stretch) >= least:
            expected.append((begin, begin + len(stretch)))
        begin += len(stretch) + 1
    assert [(f.liftoff, f.touchdown) for f in flights(contact, least=least)] == expected


@given(st.floats(-3.1, 3.1), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_heading_is_the_yaw_whatever_the_tilt(yaw: float, pitch: float, roll: float) -> None:
    x, y, z, w = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_quat()
    quaternion = np.array([w, x, y, z])
    assert heading(quaternion) == pytest.approx(yaw, abs=1e-9)
    ahead = np.array([math.cos(yaw), math.sin(yaw)])
    assert along(2.0 * ahead, quaternion, (3.0, 0.0)) == pytest.approx(2.0)


# --- All figures ---------------------------------------------------------------------------------

UP = 2.0
FLIGHT = round(2.0 * UP / G, 3)
ON, OFF, DOWN = SCRIPT.on, SCRIPT.on + case.DELAY, SCRIPT.on + case.DELAY + FLIGHT


def figures(capture: Capture, **changes: Any) -> JumpFigures:
    kept: dict[str, Any] = {"began": 0.0, "rules": RULES}
    return measure(capture, SCRIPT, ROBOT, **(kept | changes))


def at(*times: float) -> slice:
    return slice(*(round(t / case.DT) for t in times))


def test_a_jump_by_hand() -> None:
    found = figures(seen_jump(up=UP, speed=1.0))
    rise = UP**2 / (2.0 * G)
    flags = ("standing", "found", "upright", "success", "non_foot_contact", "fell")
    assert [getattr(found, name) for name in flags] == [True] * 4 + [False] * 2
    expected = {
        "delay": case.DELAY,
        "duration": FLIGHT,
        "height": case.Z_OFF + rise - (STANDING - case.CROUCH),
        "apex_gain": case.Z_OFF + rise - STANDING,
        "rise": rise,
        "ballistic": rise,
        "lift_off_velocity": UP,
        "horizontal_velocity": 1.0,
        "distance": FLIGHT,
        "along": FLIGHT,
        # The feet are as wide apart as the hips: what is left of the distance is the gap (A16).
        # Their last stand is one sample before lift-off.
        "gap": FLIGHT + case.DT - (case.FEET[0, 0] - case.FEET[2, 0]),
        "flights": 1.0,
        "high_flights": 1.0,
        "speed": 1.0,
    }
    assert {name: getattr(found, name) for name in expected} == pytest.approx(expected, abs=1e-5)
    # The trunk is lowest .1 s after the jump input and .1 s after touchdown.
    assert found.distance_minima == pytest.approx(case.DELAY - 0.1 + FLIGHT, abs=2e-3)
    # 100 W from the input to .5 s after touchdown; 1 m/s.
    assert found.energy == pytest.approx(100.0 * (case.DELAY + FLIGHT + 0.5), abs=0.2)
    assert found.cost_of_transport == pytest.approx(100.0 / (12.0 * G), rel=1e-6)
    assert found.clearance == pytest.approx(rise + case.TUCKED, abs=1e-4)
    # A quarter of the flight away from the apex: 3/4 of the rise, sin(pi / 4) of the tuck.
    expected = 0.75 * rise + math.sin(math.pi / 4.0) * case.TUCKED
    assert found.clearance_half == pytest.approx(expected, abs=2e-3)


def test_the_gap_is_between_footholds() -> None:
    seen = seen_jump(up=UP)
    before = figures(seen).gap
    # A front foot that has left the ground .3 s before: its foothold is .3 m further back.
    early = changed(seen, "contact", (at(OFF - 0.3, OFF), [0, 1]), False)
    # Then the hind feet's last stand, .42 m behind, is still further back.
    assert figures(early).gap == pytest.approx(before + 0.3, abs=2e-3)
    # A hind foot that comes down .05 m further back takes that off.
    foot = seen.foot_position[-1, 3, 0] - 0.05
    back = changed(seen, "foot_position", (at(DOWN, 8.0), 3, 0), foot)
    assert figures(back).gap == pytest.approx(before - 0.05)


def test_without_a_jump() -> None:
    seen = seen_jump()
    found = figures(replace(seen, contact=np.ones_like(seen.contact)))
    assert (found.standing, found.found, found.success) == (True, False, False)
    assert all(math.isnan(each) for each in (found.distance, found.gap, found.apex_gain))
    # Height is that of the 1.5 s after the input.
    assert found.height == pytest.approx(
        case.Z_OFF + UP**2 / (2.0 * G) - (STANDING - case.CROUCH), abs=1e-5
    )
    assert found.flights == found.high_flights == 0.0


def test_falls() -> None:
    seen = seen_jump()
    early = figures(changed(seen, "position", (at(ON - 0.5, 9.0), 2), 0.05))
    assert (early.standing, early.fell, early.success) == (False, True, False)
    numbers = (name for name, each in FIGURES.items() if not each.joints)
    assert all(math.isnan(getattr(early, name)) for name in numbers)
    for after in (0.1, 1.9):  # lying on its side: x of the quaternion is sin(45 degrees)
        side = np.array([math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0])
        found = figures(changed(seen, "orientation", at(DOWN + after, 9.0), side))
        flags = (found.found, found.fell, found.upright, found.success)
        assert flags == (True, True, False, False)
        assert found.distance == pytest.approx(FLIGHT)


@pytest.mark.parametrize(
    ("when", "touches"),
    [(ON - 0.1, False), (ON + 0.01, True), (DOWN + 1.9, True), (DOWN + 2.1, False)],
)
def test_a_knee_on_the_ground_is_no_success(when: float, touches: bool) -> None:
    found = figures(changed(seen_jump(), "other_contact", at(when, when + 0.05), True))
    assert found.non_foot_contact is touches
    assert found.success is not touches
    assert found.upright


def test_rates_are_those_of_the_acceleration() -> None:
    seen = seen_jump()
    rates = np.outer(np.sin(2.0 * np.pi * 5.0 * seen.time), [3.0, -2.0, 0.0])
    rates[seen.time < SCRIPT.start] = rates[seen.time >= ON] = 50.0
    found = figures(replace(seen, angular_velocity=rates))
    for axis, peak in (("roll", 3.0), ("pitch", 2.0)):
        assert getattr(found, f"{axis}_rate_peak") == pytest.approx(peak, rel=1e-4)
        assert getattr(found, f"{axis}_rate_rms") == pytest.approx(peak / math.sqrt(2.0), rel=1e-3)


def test_loads_by_hand() -> None:
    seen = seen_jump()
    knee = ROBOT.joint_names.index("FR_knee")
    drive = ROBOT.joints[knee].drive
    # The knee turns at half its no-load speed and is pushed on at half of what it can give then.
    speed = 0.5 * drive.no_load_speed
    limit = min(drive.effort_limit, 0.5 * drive.stall_torque)
    turned = changed(seen, "joint_position", (slice(None), knee), speed * seen.time)
    loaded = changed(turned, "torque", (at(ON, DOWN), knee), 0.5 * limit)
    # What happens long before the input is of no interest.
    loaded = changed(loaded, "torque", (at(0.0, 1.0), 0), 100.0)
    found = figures(loaded)
    assert found.peak_speed[knee] == pytest.approx(speed)
    assert found.peak_torque[knee] == pytest.approx(0.5 * limit)
    assert found.torque_margin[knee] == pytest.approx(0.5 * limit / drive.effort_limit)
    assert found.peak_torque[0] == found.peak_speed[0] == 0.0
    assert found.torque_margin[0] == pytest.approx(1.0)
    beyond = changed(seen, "torque", (at(ON, DOWN), 1), -1.2 * ROBOT.joints[1].drive.effort_limit)
    assert figures(beyond).torque_margin[1] == pytest.approx(-0.2)


def test_began_shifts_the_script() -> None:
    seen = seen_jump()
    ours, theirs = figures(replace(seen, time=seen.time + 3.0), began=3.0), figures(seen)
    for name in FIGURES:
        assert getattr(ours, name) == pytest.approx(getattr(theirs, name), nan_ok=True), name
