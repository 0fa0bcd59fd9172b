"""The hand that leads a jump: its geometry by hand, and what led robots do."""

from __future__ import annotations

import math
from typing import Any

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")

import small_env  # noqa: E402
from pronk.robots.mini_cheetah import constants as c  # noqa: E402
from pronk.train.environment.commands import motion_command  # noqa: E402
from pronk.train.environment.guidance import KICK, guidance, leg_angles  # noqa: E402
from pronk.train.environment.jump import JumpSettings  # noqa: E402
from pronk.train.environment.motion import leg_length  # noqa: E402
from pronk.train.phases import enter_phase, phase  # noqa: E402

pytestmark = pytest.mark.train

DT = 0.005
"""Of a physics step [s]."""
SETTINGS = JumpSettings()
STIFF = torch.full((12,), 20.0)
NONE = torch.zeros(12)


@pytest.mark.parametrize("length", [0.12, 0.19, 0.28, 0.35, c.THIGH_LENGTH + c.SHANK_LENGTH])
def test_the_foot_is_below_the_hip(length: float) -> None:
    pitch, knee = (float(angle) for angle in leg_angles(torch.tensor(length, dtype=torch.float64)))
    across = c.THIGH_LENGTH * math.sin(pitch) + c.SHANK_LENGTH * math.sin(pitch + knee)
    down = c.THIGH_LENGTH * math.cos(pitch) + c.SHANK_LENGTH * math.cos(pitch + knee)
    assert (across, down) == pytest.approx((0.0, length), abs=1e-9)
    assert knee >= 0.0 >= pitch


def test_legs_are_led_through_a_countermovement_that_falls_less_long() -> None:
    added = guidance(SETTINGS, STIFF, NONE, DT)
    assert added.shape == (57, 12)
    assert not added[-1].any()
    time = [DT * i for i in range(1, 57)]
    late = [t for t in time if t > 0.23 + 1e-9]
    assert len(late) == 10
    knee = added[:-1, 2::3] + c.DEFAULT_POSITION["knee"]
    knee[-len(late) :] += KICK
    # .09 s with 9 m/s^2, then from -.81 to 2.5 m/s in .19 s; a straight leg at last.
    push = (2.5 + 0.81) / 0.19
    asked = [
        -4.5 * t**2
        if t <= 0.09
        else -4.5 * 0.09**2 - 0.81 * (t - 0.09) + push * (t - 0.09) ** 2 / 2
        for t in time
    ]
    standing = float(leg_length(torch.tensor(c.DEFAULT_POSITION["knee"])))
    longest = c.THIGH_LENGTH + c.SHANK_LENGTH - standing
    for leg in range(4):
        found = (leg_length(knee[:, leg]) - standing).tolist()
        assert found == pytest.approx([min(length, longest) for length in asked], abs=1e-6)
    assert not added[:, ::3].any(), "hips do not roll"


def test_damping_is_made_up_for_and_each_drive_has_its_own() -> None:
    stiffness = torch.arange(10.0, 22.0)
    position = guidance(SETTINGS, stiffness, NONE, DT)
    damped = guidance(SETTINGS, stiffness, torch.full((12,), 0.5), DT)
    # The slope between the rows before and after.
    rate = (position[37] - position[35]) / (2 * DT)
    made_up = ((damped - position) * stiffness / 0.5)[36]
    assert made_up.tolist() == pytest.approx(rate.tolist(), abs=0.05)
    assert float(rate.abs().max()) > 3.0


def flights(env: Any, led: float, steps: int = 150) -> int:
    """Leaps of robots that do nothing of their own."""
    command = motion_command(env)
    enter_phase(env, phase("jump_a"))
    command.led = led
    leaps = 0
    for _ in range(steps):
        env.step(torch.zeros(small_env.ROBOTS, 12))
        command.velocity[:] = 0.0
        leaps += int((command.tracker.liftoffs > 0.0).sum())
    return leaps


def test_robots_that_are_led_leave_the_ground_and_others_do_not() -> None:
    env = small_env.fresh(small_env.quiet())
    assert flights(env, 0.0) == 0
    assert flights(env, 1.0) > 10


def test_each_step_is_led_to_where_it_ends_however_long_it_is() -> None:
    """Seen with policy steps of 10 to 30 ms (D1): rows were once counted in steps of the last."""
    env = small_env.fresh(small_env.quiet())
    command, action = motion_command(env), env.action_manager.get_term("joint_position")
    enter_phase(env, phase("jump_a"))
    command.led, command.scripted = 0.5, True
    still = torch.zeros(small_env.ROBOTS, 12)
    env.step(still)
    assert not action.led.any(), "nobody is told to jump"
    command.jump[:2] = True
    table, passed = command._guidance, 0
    for decimation in (4, 2, 6, 3, 5, 6, 2, 4, 6, 5, 6, 6, 4):
        env.cfg.decimation = decimation
        command.compute(0.0)
        # Row i is for i + 1 physics steps after the command, and the last is zero.
        row = min(passed + decimation - 1, 55) if passed < 56 else 56
        assert torch.equal(action.led[:2], 0.5 * table[row].expand(2, 12)), passed
        assert not action.led[2:].any()
        if passed == 32:
            command.tracker.liftoffs[1] = 1.0
            command.compute(0.0)
            assert not action.led[1].any(), "it is in the air"
            assert action.led[0].any()
            command.tracker.liftoffs[1] = 0.0
        env.step(still)
        passed += decimation
    assert passed == 59
    command.led = 0.0
    command.compute(0.0)
    assert action.led is None
