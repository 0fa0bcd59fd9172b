"""The figures of a walk in closed form."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from hopper import ROBOT
from pronk.jump.trial.walk import SETTLE_S, WalkFigures, measure_walk, walk_script
from pronk.jump.virtual.capture import Capture
from seen_jump import STANDING, changed, motion

DT = 0.002
POWER, MASS = 120.0, 12.0
COMMAND = (2.0, 0.0, 0.5)


def walked(
    forward: float = 1.8, left: float = 0.1, yaw_rate: float = 0.5, sway: float = 0.0
) -> Capture:
    """A trunk that moves at constant velocities in its own frame, and may sway sideways at 4 Hz."""
    time = np.arange(round(8.0 / DT)) * DT
    yaw = yaw_rate * time
    side = left + sway * np.sin(2.0 * np.pi * 4.0 * time)
    cos, sin, still = np.cos(yaw), np.sin(yaw), np.zeros(len(time))
    velocity = np.column_stack([forward * cos - side * sin, forward * sin + side * cos, still])
    position = np.cumsum(velocity, axis=0) * DT
    position[:, 2] = STANDING
    orientation = np.zeros((len(time), 4))
    orientation[:, 0], orientation[:, 3] = np.cos(yaw / 2), np.sin(yaw / 2)
    rates = np.zeros((len(time), 3))
    rates[:, 2] = yaw_rate
    rates[:, 1] = 0.6 * np.sin(2.0 * np.pi * 4.0 * time)
    return motion(
        time,
        position=position,
        orientation=orientation,
        velocity=velocity,
        angular_velocity=rates,
        electrical_power=np.full(len(time), POWER),
    )


def measured(seen: Capture, command: tuple[float, float, float] = COMMAND) -> WalkFigures:
    script = replace(walk_script(command, seconds=6.0), stand_s=1.0)
    return measure_walk(seen, script, ROBOT, began=0.0)


def test_a_steady_walk_in_closed_form() -> None:
    found = measured(walked())
    assert (found.fell, found.non_foot_contact) == (False, False)
    error = math.hypot(0.2, 0.1)
    expected = {
        "lasted": 6.0,
        "speed_error": error,
        "speed_error_averaged": error,
        "yaw_error": 0.0,
        "forward": 1.8,
        "left": 0.1,
        "yaw_rate": 0.5,
        # Root mean square of a sine over whole periods.
        "pitch_rate_rms": 0.6 / math.sqrt(2.0),
        "roll_rate_rms": 0.0,
        "power": POWER,
        "cost_of_transport": POWER / (MASS * 9.81 * math.hypot(1.8, 0.1)),
    }
    assert {name: getattr(found, name) for name in expected} == pytest.approx(expected)
    assert math.isnan(found.uncommanded)


def test_swaying_counts_for_nothing_once_averaged() -> None:
    still, swaying = measured(walked(left=0.0)), measured(walked(left=0.0, sway=0.5))
    # Half a second holds two whole periods.
    assert swaying.speed_error_averaged == pytest.approx(0.2, abs=1e-9)
    assert swaying.speed_error > 0.3
    assert swaying.cost_of_transport == pytest.approx(still.cost_of_transport)


def test_only_the_time_after_settling_counts_until_the_fall() -> None:
    start = 1.0
    begin, end = round((start + SETTLE_S) / DT), round((start + 4.0) / DT)
    wild = changed(walked(), "velocity", slice(0, begin - 1), [9.0, 0.0, 0.0])
    fallen = changed(wild, "position", (slice(end, None), 2), 0.05)
    wilder = changed(fallen, "velocity", slice(end, None), [9.0, 0.0, 0.0])
    found = measured(wilder)
    assert found.fell
    assert found.lasted == pytest.approx(4.0)
    assert found.speed_error == pytest.approx(math.hypot(0.2, 0.1), rel=1e-6)
    # Down before it settled: nothing but how long it lasted.
    early = measured(changed(walked(), "position", (slice(begin - 10, None), 2), 0.05))
    assert early.fell
    assert math.isnan(early.speed_error)
    # A fall after the end is no fall of the walk, a touch before the command none of it.
    late = changed(walked(), "position", (slice(round(7.1 / DT), None), 2), 0.05)
    late = changed(late, "other_contact", slice(0, round(0.9 / DT)), True)
    assert (measured(late).fell, measured(late).non_foot_contact) == (False, False)
    assert measured(changed(walked(), "other_contact", begin, True)).non_foot_contact


def test_without_a_path_there_is_no_cost_of_transport() -> None:
    spot, slow = walked(forward=0.2, left=0.0), walked(forward=0.01, left=0.0)
    for seen, command in ((spot, (0.0, 0.0, 0.5)), (slow, COMMAND)):
        assert math.isnan(measured(seen, command).cost_of_transport)
