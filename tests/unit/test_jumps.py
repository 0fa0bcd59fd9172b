"""Flight phases and figures of a jump, on series whose figures are known in closed form."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from pronk.errors import PronkError
from pronk.evaluation.jumps import (
    JumpRules,
    Series,
    along,
    flights,
    heading,
    measure_jump,
    uncommanded_height,
)

DT = 0.005
G = 9.81
STAND = 0.3
RULES = JumpRules(standing_height=STAND)
ANY = replace(RULES, rise=1e-9)
"""Rules by which every long flight is a high one."""
COMMAND = (1.0, 0.0)


def ground(samples: int, height: float = STAND) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.full(samples, height), np.zeros(samples), np.ones(samples, bool)


def hop(samples: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ballistic flight between two samples on the ground, `samples` + 1 steps apart."""
    time = DT * np.arange(1, samples + 1)
    speed = 0.5 * G * DT * (samples + 1)
    return STAND + speed * time - 0.5 * G * time**2, speed - G * time, np.zeros(samples, bool)


def leap_height(samples: int) -> float:
    """Rise of `hop` at its highest sample; one lies at the apex if `samples` is odd."""
    return float(hop(samples)[0].max()) - STAND


def series(
    *pieces: tuple[np.ndarray, np.ndarray, np.ndarray],
    forward: float = 0.0,
    left: float = 0.0,
    yaw: float = 0.0,
) -> Series:
    z, vz, touching = (np.concatenate(part) for part in zip(*pieces, strict=True))
    time = DT * np.arange(len(z))
    turn = np.array([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)])
    return Series(
        position=np.column_stack([forward * time, left * time, z]),
        velocity=np.column_stack([np.full_like(z, forward), np.full_like(z, left), vz]),
        orientation=np.tile(turn, (len(z), 1)),
        # One foot is enough.
        contact=touching[:, None] & np.array([True, False, False, False]),
        dt=DT,
    )


def tilted(whole: Series, degrees: float) -> Series:
    half = math.radians(degrees) / 2
    roll = np.array([math.cos(half), math.sin(half), 0.0, 0.0])
    return replace(whole, orientation=np.tile(roll, (len(whole.position), 1)))


def jump_of(
    whole: Series,
    on: int,
    rules: JumpRules = RULES,
    command: tuple[float, float] = COMMAND,
) -> SimpleNamespace:
    figures, _ = measure_jump(whole, on, command, rules)
    return SimpleNamespace(**figures)


def test_a_ballistic_jump_has_the_figures_of_the_parabola() -> None:
    """101 steps in the air: v = g T / 2 = 2.477 m/s, apex v^2 / 2 g = .3128 m."""
    air, wait, on = 101, 200, 160
    flight = (air + 1) * DT
    speed = 0.5 * G * flight
    found = jump_of(series(ground(wait), hop(air), ground(500), forward=2.0), on)
    assert found.found
    assert (found.flights, found.high_flights) == (1, 1)
    assert found.height == pytest.approx(speed**2 / (2.0 * G), abs=1e-9)
    assert found.apex_gain == pytest.approx(speed**2 / (2.0 * G), abs=1e-9)
    assert found.delay == pytest.approx((wait - on) * DT)
    # Sampling cuts one step off the start.
    assert found.duration == pytest.approx(flight - DT)
    assert found.lift_off_velocity == pytest.approx(speed - G * DT)
    assert found.horizontal_velocity == pytest.approx(2.0)
    assert found.distance == pytest.approx(2.0 * (flight - DT))
    assert found.upright


def test_distance_along_the_command_is_signed_and_turns_with_the_trunk() -> None:
    air = 99
    flown = air * DT
    # The trunk looks along world y; commanded to the right, it flies along world x.
    whole = series(ground(100), hop(air), ground(500), forward=1.5, left=0.5, yaw=math.pi / 2)
    right = jump_of(whole, 80, command=(0.0, -1.0))
    back = jump_of(whole, 80, command=(-2.0, 0.0))
    assert right.along == pytest.approx(1.5 * flown)
    assert back.along == pytest.approx(-0.5 * flown)
    assert right.distance == pytest.approx(math.hypot(1.5, 0.5) * flown)
    assert math.isnan(jump_of(whole, 80, command=(0.0, 0.0)).along)


def test_two_hops_are_two_and_the_longer_is_the_jump() -> None:
    whole = series(ground(100), hop(40), ground(20), hop(60), ground(500), forward=1.0)
    found = jump_of(whole, 90)
    assert (found.flights, found.high_flights) == (2, 2)
    assert found.delay == pytest.approx((100 + 40 + 20 - 90) * DT)
    assert found.distance == pytest.approx(60 * DT)
    # Of equal ones it is the first.
    twice = series(ground(100), hop(40), ground(20), hop(40), ground(500))
    assert jump_of(twice, 90).delay == pytest.approx(10 * DT)


def test_chatter_is_no_flight_and_a_short_flight_no_jump() -> None:
    chatter = series(ground(100), hop(2), ground(3), hop(2), ground(500))
    height = pytest.approx(0.5 * G * (1.5 * DT) ** 2, abs=2e-4)
    assert vars(jump_of(chatter, 90, ANY)) == {
        "found": False,
        "flights": 0,
        "high_flights": 0,
        "height": height,
    }
    short = jump_of(series(ground(100), hop(3), ground(3), hop(11), ground(500)), 90, ANY)
    assert (short.flights, short.found) == (2, False)
    assert jump_of(series(ground(100), hop(12), ground(500)), 90, ANY).found


def test_a_flight_of_the_gait_is_no_jump() -> None:
    """A run rises (g / 2) (13 DT / 2)^2 = 5 mm over standing height in 60 ms; a jump far more."""
    run, leap = hop(12), hop(60)
    stride = (run, ground(12))
    running = jump_of(series(ground(100), *stride, *stride, *stride, ground(500)), 90)
    assert (running.flights, running.high_flights, running.found) == (3, 0, False)
    assert running.height == pytest.approx(leap_height(12), abs=1e-9)
    found = jump_of(series(ground(100), *stride, leap, ground(20), *stride, ground(500)), 90)
    assert (found.flights, found.high_flights) == (3, 1)
    assert found.delay == pytest.approx((100 + 24 - 90) * DT)
    # A long flight with bent legs, under standing height, is not the main one.
    low = (hop(40)[0] - 0.1, *hop(40)[1:])
    found = jump_of(series(ground(100), low, ground(12), hop(36), ground(500)), 90)
    assert (found.flights, found.high_flights) == (2, 1)
    assert found.duration == pytest.approx(36 * DT)


def test_a_high_flight_is_more_than_3_cm_over_standing_height() -> None:
    for excess, count in ((1e-4, 1), (-1e-4, 0)):
        z, vz, touching = hop(12)
        lifted = z + (STAND + 0.03 + excess - z.max()), vz, touching
        assert jump_of(series(ground(100), lifted, ground(500)), 90).high_flights == count


def test_height_takes_in_the_crouch_before_and_what_comes_soon_after() -> None:
    top = (0.5 * G * 102 * DT) ** 2 / (2.0 * G)
    crouch = ground(10, 0.2)
    before = series(ground(90), crouch, hop(101), ground(500))
    assert jump_of(before, 80).height == pytest.approx(STAND + top - 0.2)
    assert jump_of(before, 100).height == pytest.approx(top, abs=1e-9)
    # The tail is 100 samples after touchdown.
    inside = series(ground(100), hop(101), ground(100), ground(1, 0.15), ground(500))
    outside = series(ground(100), hop(101), ground(101), ground(1, 0.15), ground(500))
    assert jump_of(inside, 80).height == pytest.approx(STAND + top - 0.15)
    assert jump_of(outside, 80).height == pytest.approx(top, abs=1e-9)


def test_without_a_jump_height_is_that_of_the_search() -> None:
    last = ground(1, 0.1)
    inside = series(ground(80 + 300), last, ground(200))
    outside = series(ground(80 + 301), last, ground(200))
    assert jump_of(inside, 80).height == pytest.approx(0.2)
    assert jump_of(outside, 80).height == 0.0


def test_a_jump_lifts_off_within_the_search_time() -> None:
    whole = series(ground(150), hop(80), ground(700))
    assert jump_of(whole, 150).found
    assert not jump_of(whole, 151).found
    search = replace(RULES, search_s=0.25)
    assert jump_of(whole, 100, search).found
    assert not jump_of(whole, 99, search).found


def test_upright_is_judged_two_seconds_after_touchdown() -> None:
    whole = series(ground(100), hop(80), ground(401))
    assert jump_of(tilted(whole, 29.0), 90).upright
    assert not jump_of(tilted(whole, 31.0), 90).upright
    # A robot that falls one sample earlier has no such moment.
    assert not jump_of(series(ground(100), hop(80), ground(400)), 90).upright


def test_a_flight_that_has_not_ended_is_no_flight() -> None:
    assert not jump_of(series(ground(100), hop(80)), 90).found


def test_the_highest_flight_without_a_jump_input() -> None:
    first, second, late = hop(30), hop(60), hop(20)
    whole = series(ground(99), first, ground(50), second, ground(400), late, ground(10), hop(90))
    second_on = 99 + 30 + 50
    assert uncommanded_height(whole, None, RULES) == pytest.approx(second[0].max())
    assert uncommanded_height(whole, second_on, RULES) == pytest.approx(late[0].max())
    # The robot is set down in the first 100 samples.
    assert math.isnan(uncommanded_height(series(ground(99), first, ground(9)), None, RULES))
    assert uncommanded_height(series(ground(100), first, ground(9)), None, RULES) > STAND


@given(hnp.arrays(bool, st.tuples(st.integers(0, 60), st.just(4))), st.integers(1, 5))
def test_flights_are_the_longest_stretches_without_contact(contact: np.ndarray, least: int) -> None:
    airborne = [not feet.any() for feet in contact]
    expected, begin = [], None
    for k, flying in enumerate([*airborne, None]):
        if flying and begin is None:
            begin = k
        elif flying is False and begin is not None:
            if k - begin >= least:
                expected.append((begin, k))
            begin = None
    assert [(f.liftoff, f.touchdown) for f in flights(contact, least=least)] == expected


@given(st.floats(-3.1, 3.1), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_heading_is_the_yaw_whatever_the_tilt(yaw: float, pitch: float, roll: float) -> None:
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    quaternion = np.array(
        [
            cy * cp * cr + sy * sp * sr,
            cy * cp * sr - sy * sp * cr,
            cy * sp * cr + sy * cp * sr,
            sy * cp * cr - cy * sp * sr,
        ]
    )
    assert heading(quaternion) == pytest.approx(yaw, abs=1e-9)
    ahead = np.array([math.cos(yaw), math.sin(yaw)])
    assert along(2.0 * ahead, quaternion, (3.0, 0.0)) == pytest.approx(2.0)


def test_impossible_rules_and_series_are_refused() -> None:
    with pytest.raises(PronkError, match=r"JumpRules.tail_s"):
        JumpRules(tail_s=-1.0)
    with pytest.raises(PronkError, match=r"flight_s"):
        JumpRules(flight_s=0.1)
    whole = series(ground(10))
    with pytest.raises(PronkError, match=r"Series.contact"):
        replace(whole, contact=whole.contact[1:])
