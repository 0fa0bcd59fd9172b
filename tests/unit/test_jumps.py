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
from scipy.spatial.transform import Rotation

from pronk.evaluation.jumps import (
    JumpRules,
    Series,
    along,
    flights,
    heading,
    measure_jump,
    uncommanded_height,
)

DT, G, STAND = 0.005, 9.81, 0.3
RULES = JumpRules(standing_height=STAND)
COMMAND = (1.0, 0.0)
Piece = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Height, vertical velocity, contact."""


def ground(samples: int, height: float = STAND) -> Piece:
    return np.full(samples, height), np.zeros(samples), np.ones(samples, bool)


def hop(samples: int) -> Piece:
    """Ballistic flight between two samples on the ground, `samples` + 1 steps apart."""
    time = DT * np.arange(1, samples + 1)
    speed = 0.5 * G * DT * (samples + 1)
    return STAND + speed * time - 0.5 * G * time**2, speed - G * time, np.zeros(samples, bool)


def series(*pieces: Piece, forward: float = 0.0, left: float = 0.0, yaw: float = 0.0) -> Series:
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


def jump_of(
    whole: Series, on: int, rules: JumpRules = RULES, command: tuple[float, float] = COMMAND
) -> SimpleNamespace:
    return SimpleNamespace(**measure_jump(whole, on, command, rules)[0])


def test_a_ballistic_jump_has_the_figures_of_the_parabola() -> None:
    """101 steps in the air: v = g T / 2 = 2.477 m/s, apex v^2 / 2 g = .3128 m."""
    air, wait, on = 101, 200, 160
    flight = (air + 1) * DT
    speed = 0.5 * G * flight
    found = jump_of(series(ground(wait), hop(air), ground(500), forward=2.0), on)
    assert found.found
    assert found.upright
    assert (found.flights, found.high_flights) == (1, 1)
    assert found.height == pytest.approx(speed**2 / (2.0 * G), abs=1e-9)
    assert found.apex_gain == pytest.approx(speed**2 / (2.0 * G), abs=1e-9)
    assert found.delay == pytest.approx((wait - on) * DT)
    # Sampling cuts one step off the start.
    assert found.duration == pytest.approx(flight - DT)
    assert found.lift_off_velocity == pytest.approx(speed - G * DT)
    assert found.horizontal_velocity == pytest.approx(2.0)
    assert found.distance == pytest.approx(2.0 * (flight - DT))


def test_distance_along_the_command_is_signed_and_turns_with_the_trunk() -> None:
    flown = 99 * DT
    # The trunk looks along world y; commanded to the right, it flies along world x.
    whole = series(ground(100), hop(99), ground(500), forward=1.5, left=0.5, yaw=math.pi / 2)
    assert jump_of(whole, 80, command=(0.0, -1.0)).along == pytest.approx(1.5 * flown)
    assert jump_of(whole, 80, command=(-2.0, 0.0)).along == pytest.approx(-0.5 * flown)
    assert math.isnan(jump_of(whole, 80, command=(0.0, 0.0)).along)


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
        assert (found.delay, found.duration) == pytest.approx((delay * DT, duration * DT))


@pytest.mark.parametrize(("excess", "count"), [(1e-4, 1), (-1e-4, 0)])
def test_a_high_flight_is_more_than_3_cm_over_standing_height(excess: float, count: int) -> None:
    z, vz, touching = hop(12)
    lifted = z + (STAND + 0.03 + excess - z.max()), vz, touching
    assert jump_of(series(ground(100), lifted, ground(500)), 90).high_flights == count


def test_height_is_of_the_crouch_before_and_the_half_second_after() -> None:
    top = (0.5 * G * 102 * DT) ** 2 / (2.0 * G)
    before = series(ground(90), ground(10, 0.2), hop(101), ground(500))
    assert jump_of(before, 80).height == pytest.approx(STAND + top - 0.2)
    assert jump_of(before, 100).height == pytest.approx(top, abs=1e-9)
    for wait, low in ((100, 0.15), (101, STAND)):
        whole = series(ground(100), hop(101), ground(wait), ground(1, 0.15), ground(500))
        assert jump_of(whole, 80).height == pytest.approx(STAND + top - low, abs=1e-9)
    # Without a jump it is of the search.
    for wait, height in ((300, 0.2), (301, 0.0)):
        assert jump_of(series(ground(80 + wait), ground(1, 0.1)), 80).height == pytest.approx(
            height
        )


def test_a_jump_lifts_off_within_the_search_time() -> None:
    whole = series(ground(150), hop(80), ground(700))
    search = replace(RULES, search_s=0.25)
    found = [jump_of(whole, *each).found for each in ((150,), (151,), (100, search), (99, search))]
    assert found == [True, False, True, False]
    assert not jump_of(series(ground(100), hop(80)), 90).found  # it has not ended


def test_upright_is_measured_two_seconds_after_touchdown() -> None:
    whole = series(ground(100), hop(80), ground(401))
    for degrees in (29.0, 31.0):
        half = math.radians(degrees) / 2
        roll = np.tile([math.cos(half), math.sin(half), 0.0, 0.0], (len(whole.position), 1))
        assert jump_of(replace(whole, orientation=roll), 90).upright == (degrees < 30.0)
    # A robot that falls one sample earlier has no such moment.
    assert not jump_of(series(ground(100), hop(80), ground(400)), 90).upright


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
