"""The figures of a jump, on jumps whose figures are known in closed form."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pronk.evaluation.jumps import FIGURES, JumpFigures, JumpRules, measure
from pronk.robots import load_robot
from pronk.virtual.capture import Capture
from seen_jump import (
    CROUCH,
    DELAY,
    DT,
    FEET,
    SCRIPT,
    STANDING,
    TUCKED,
    Z_OFF,
    G,
    changed,
    seen_jump,
)

ROBOT = load_robot("mini_cheetah")
RULES = JumpRules(standing_height=STANDING)
UP = 2.0
FLIGHT = round(2.0 * UP / G, 3)
ON, OFF, DOWN = SCRIPT.on, SCRIPT.on + DELAY, SCRIPT.on + DELAY + FLIGHT


def figures(capture: Capture, **changes: Any) -> JumpFigures:
    kept: dict[str, Any] = {"began": 0.0, "mass": 12.0, "rules": RULES}
    return measure(capture, SCRIPT, ROBOT, **(kept | changes))


def at(*times: float) -> slice:
    return slice(*(round(t / DT) for t in times))


def test_a_ballistic_jump_by_hand() -> None:
    found = figures(seen_jump(up=UP, speed=1.0))
    apex = Z_OFF + UP**2 / (2.0 * G)
    flags = ("standing", "found", "upright", "success", "non_foot_contact", "fell")
    assert [getattr(found, name) for name in flags] == [True] * 4 + [False] * 2
    assert found.delay == pytest.approx(DELAY)
    assert found.duration == pytest.approx(FLIGHT)
    assert found.height == pytest.approx(apex - (STANDING - CROUCH), abs=1e-5)
    assert found.apex_gain == pytest.approx(apex - STANDING, abs=1e-5)
    assert found.rise == pytest.approx(UP**2 / (2.0 * G), abs=1e-5)
    assert found.ballistic == pytest.approx(UP**2 / (2.0 * G))
    assert found.lift_off_velocity == pytest.approx(UP)
    assert found.horizontal_velocity == pytest.approx(1.0)
    assert found.distance == pytest.approx(FLIGHT)
    assert found.along == pytest.approx(FLIGHT)
    # The trunk is lowest .1 s after the jump input and .1 s after touchdown.
    assert found.distance_minima == pytest.approx(DELAY - 0.1 + FLIGHT, abs=2e-3)
    # The feet are as wide apart as the hips: what is left of the distance is the gap (A16). Their
    # last stand is one sample before lift-off.
    assert found.gap == pytest.approx(FLIGHT + DT - (FEET[0, 0] - FEET[2, 0]))
    assert found.flights == found.high_flights == 1.0
    assert found.speed == pytest.approx(1.0)


def test_clearance_by_hand() -> None:
    found = figures(seen_jump(up=UP))
    rise = UP**2 / (2.0 * G)
    assert found.clearance == pytest.approx(rise + TUCKED, abs=1e-4)
    # A quarter of the flight away from the apex: 3/4 of the rise, sin(pi / 4) of the tuck.
    expected = 0.75 * rise + math.sin(math.pi / 4.0) * TUCKED
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
    assert found.height == pytest.approx(Z_OFF + UP**2 / (2.0 * G) - (STANDING - CROUCH), abs=1e-5)
    assert found.flights == found.high_flights == 0.0


def test_a_fall_before_the_jump_input() -> None:
    found = figures(changed(seen_jump(), "position", (at(ON - 0.5, 9.0), 2), 0.05))
    assert (found.standing, found.fell, found.success) == (False, True, False)
    assert all(
        math.isnan(getattr(found, name)) for name, each in FIGURES.items() if not each.joints
    )


@pytest.mark.parametrize("after", [0.1, 1.9])
def test_a_fall_after_landing_is_no_success(after: float) -> None:
    # Lying on its side: x of the quaternion is sin(45 degrees).
    seen = seen_jump()
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
    time = seen.time
    rates = np.zeros((len(time), 3))
    wave = np.sin(2.0 * np.pi * 5.0 * time)
    rates[:, 0], rates[:, 1] = 3.0 * wave, -2.0 * wave
    rates[time < SCRIPT.start] = rates[time >= ON] = 50.0
    found = figures(replace(seen, angular_velocity=rates))
    assert found.roll_rate_peak == pytest.approx(3.0, rel=1e-4)
    assert found.roll_rate_rms == pytest.approx(3.0 / math.sqrt(2.0), rel=1e-3)
    assert found.pitch_rate_peak == pytest.approx(2.0, rel=1e-4)
    assert found.pitch_rate_rms == pytest.approx(2.0 / math.sqrt(2.0), rel=1e-3)


def test_energy_and_cost_of_transport_by_hand() -> None:
    found = figures(seen_jump())
    # 100 W from the input to .5 s after touchdown; 1 m/s.
    assert found.energy == pytest.approx(100.0 * (DELAY + FLIGHT + 0.5), abs=0.2)
    assert found.cost_of_transport == pytest.approx(100.0 / (12.0 * G), rel=1e-6)
    assert figures(seen_jump(), mass=24.0).cost_of_transport == pytest.approx(
        0.5 * found.cost_of_transport
    )


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
    later = replace(seen, time=seen.time + 3.0)
    ours, theirs = figures(later, began=3.0), figures(seen)
    for name, figure in FIGURES.items():
        assert getattr(ours, name) == pytest.approx(getattr(theirs, name), nan_ok=True), figure
