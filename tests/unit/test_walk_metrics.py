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
"""Time between two samples [s]."""
POWER = 120.0
"""Electrical power [W]."""
MASS = 12.0
"""Mass of the robot [kg]."""
COMMAND = (2.0, 0.0, 0.5)
START = 1.0
"""When the command begins [s]."""
SETTLED = round((START + SETTLE_S) / DT)
"""First sample that counts."""


def walked(
    forward: float = 1.8, left: float = 0.1, yaw_rate: float = 0.5, sway: float = 0.0
) -> Capture:
    """A trunk that moves at constant velocities in its own frame, and may sway sideways at 4 Hz."""
    time = np.arange(round(8.0 / DT)) * DT
    wave = np.sin(2.0 * np.pi * 4.0 * time)
    yaw = yaw_rate * time
    side = left + sway * wave
    velocity = np.zeros((len(time), 3))
    velocity[:, 0] = forward * np.cos(yaw) - side * np.sin(yaw)
    velocity[:, 1] = forward * np.sin(yaw) + side * np.cos(yaw)
    position = np.cumsum(velocity, axis=0) * DT
    position[:, 2] = STANDING
    orientation = np.zeros((len(time), 4))
    orientation[:, 0] = np.cos(yaw / 2)
    orientation[:, 3] = np.sin(yaw / 2)
    rates = np.zeros((len(time), 3))
    rates[:, 1] = 0.6 * wave
    rates[:, 2] = yaw_rate
    return motion(
        time,
        position=position,
        orientation=orientation,
        velocity=velocity,
        angular_velocity=rates,
        electrical_power=np.full(len(time), POWER),
    )


def measured(capture: Capture, command: tuple[float, float, float] = COMMAND) -> WalkFigures:
    script = replace(walk_script(command, seconds=6.0), stand_s=START)
    return measure_walk(capture, script, ROBOT, began=0.0)


def test_a_steady_walk_in_closed_form() -> None:
    figures = measured(walked())
    assert not figures.fell
    assert not figures.non_foot_contact
    assert figures.lasted == pytest.approx(6.0)
    error = math.hypot(0.2, 0.1)
    assert figures.speed_error == pytest.approx(error)
    assert figures.speed_error_averaged == pytest.approx(error)
    assert figures.yaw_error == pytest.approx(0.0)
    assert figures.forward == pytest.approx(1.8)
    assert figures.left == pytest.approx(0.1)
    assert figures.yaw_rate == pytest.approx(0.5)
    # Root mean square of a sine over whole periods.
    assert figures.pitch_rate_rms == pytest.approx(0.6 / math.sqrt(2.0))
    assert figures.roll_rate_rms == pytest.approx(0.0)
    assert figures.power == pytest.approx(POWER)
    cost = POWER / (MASS * 9.81 * math.hypot(1.8, 0.1))
    assert figures.cost_of_transport == pytest.approx(cost)
    assert math.isnan(figures.uncommanded)


def test_swaying_counts_for_nothing_once_averaged() -> None:
    steady = measured(walked(left=0.0))
    swaying = measured(walked(left=0.0, sway=0.5))
    # Half a second holds two whole periods.
    assert swaying.speed_error_averaged == pytest.approx(0.2, abs=1e-9)
    assert swaying.speed_error > 0.3
    assert swaying.cost_of_transport == pytest.approx(steady.cost_of_transport)


def test_only_the_time_after_settling_counts_until_the_fall() -> None:
    end = round((START + 4.0) / DT)
    capture = changed(walked(), "velocity", slice(0, SETTLED - 1), [9.0, 0.0, 0.0])
    capture = changed(capture, "position", (slice(end, None), 2), 0.05)
    capture = changed(capture, "velocity", slice(end, None), [9.0, 0.0, 0.0])
    figures = measured(capture)
    assert figures.fell
    assert figures.lasted == pytest.approx(4.0)
    assert figures.speed_error == pytest.approx(math.hypot(0.2, 0.1), rel=1e-6)


def test_a_robot_that_fell_before_it_settled_has_no_errors() -> None:
    figures = measured(changed(walked(), "position", (slice(SETTLED - 10, None), 2), 0.05))
    assert figures.fell
    assert math.isnan(figures.speed_error)


def test_a_fall_after_the_end_and_a_touch_before_the_command_do_not_count() -> None:
    late = slice(round(7.1 / DT), None)
    capture = changed(walked(), "position", (late, 2), 0.05)
    capture = changed(capture, "other_contact", slice(0, round(0.9 / DT)), True)
    figures = measured(capture)
    assert not figures.fell
    assert not figures.non_foot_contact


def test_a_touch_during_the_walk_counts() -> None:
    assert measured(changed(walked(), "other_contact", SETTLED, True)).non_foot_contact


def test_without_a_path_there_is_no_cost_of_transport() -> None:
    turning = measured(walked(forward=0.2, left=0.0), (0.0, 0.0, 0.5))
    assert math.isnan(turning.cost_of_transport)
    slow = measured(walked(forward=0.01, left=0.0), COMMAND)
    assert math.isnan(slow.cost_of_transport)
