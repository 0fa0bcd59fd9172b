"""The hand that leads a jump: geometry and forces by hand, and what led robots do."""

from __future__ import annotations

import math
from typing import Any

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")

import small_env  # noqa: E402
from pronk.robots.mini_cheetah import constants as c  # noqa: E402
from pronk.train.environment.commands import motion_command  # noqa: E402
from pronk.train.environment.guidance import guidance, leg_angles  # noqa: E402
from pronk.train.environment.jump import JumpSettings  # noqa: E402
from pronk.train.environment.motion import leg_length  # noqa: E402
from pronk.train.phases import enter_phase, phase  # noqa: E402

pytestmark = pytest.mark.train

DT = 0.02
SETTINGS = JumpSettings()
HARD = torch.full((12,), 1e9)
"""Drives that need no torque."""
NONE = torch.zeros(12)


@pytest.mark.parametrize("length", [0.12, 0.19, 0.28, 0.35, c.THIGH_LENGTH + c.SHANK_LENGTH])
def test_the_foot_is_below_the_hip(length: float) -> None:
    pitch, knee = (float(angle) for angle in leg_angles(torch.tensor(length, dtype=torch.float64)))
    across = c.THIGH_LENGTH * math.sin(pitch) + c.SHANK_LENGTH * math.sin(pitch + knee)
    down = c.THIGH_LENGTH * math.cos(pitch) + c.SHANK_LENGTH * math.cos(pitch + knee)
    assert (across, down) == pytest.approx((0.0, length), abs=1e-9)
    assert knee >= 0.0 >= pitch


def test_drives_that_need_no_torque_are_led_through_the_countermovement() -> None:
    added = guidance(SETTINGS, HARD, NONE, 12.0, DT)
    assert added.shape == (15, 12)
    assert not added[-1].any()
    knee = added[:-1, 2::3] + c.DEFAULT_POSITION["knee"]
    standing = float(leg_length(torch.tensor(c.DEFAULT_POSITION["knee"])))
    asked = SETTINGS.countermovement(DT * torch.arange(1, 15))
    for leg in range(4):
        assert (leg_length(knee[:, leg]) - standing).tolist() == pytest.approx(
            asked.tolist(), abs=1e-6
        )
    assert not added[:, ::3].any(), "hips do not roll"


def test_the_knee_does_the_work_that_lifts_a_quarter_of_the_robot() -> None:
    """Virtual work: torque times the knee's speed is force times the leg's."""
    stiff = torch.full((12,), 20.0)
    still = guidance(SETTINGS, HARD, NONE, 12.0, DT)
    torque = 20.0 * (guidance(SETTINGS, stiff, NONE, 12.0, DT) - still)[10]
    fast = guidance(SETTINGS, torch.ones(12), torch.ones(12), 12.0, DT)
    speed = (fast - guidance(SETTINGS, torch.ones(12), NONE, 12.0, DT))[10]
    # At .22 s, .1 s into a push of 3.58 m/s in .16 s.
    rate = 3.58 / 0.16
    force, lengthening = 3.0 * (rate + 9.81), -1.08 + 0.1 * rate
    assert float(torque[2] * speed[2]) == pytest.approx(force * lengthening, rel=1e-3)
    assert torque[1] == pytest.approx(0.0, abs=1e-5), "a force through the hip"
    assert float(torque[2]) < 0.0, "it straightens the knee"


def test_damping_is_made_up_for_and_each_drive_has_its_own() -> None:
    stiffness = torch.arange(10.0, 22.0)
    still = guidance(SETTINGS, stiffness, NONE, 12.0, DT)
    damped = guidance(SETTINGS, stiffness, torch.full((12,), 0.5), 12.0, DT)
    position = guidance(SETTINGS, HARD, NONE, 12.0, DT)
    # The slope between the steps before and after.
    rate = (position[5:7] - position[3:5]) / (2 * DT)
    assert ((damped - still) * stiffness / 0.5)[4].tolist() == pytest.approx(
        rate[0].tolist(), abs=0.15
    )
    assert ((still - position) * stiffness)[10, 2::3].std() < 1e-4, "knees push alike"


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


def test_nobody_is_led_without_a_command_nor_in_the_air() -> None:
    env = small_env.fresh(small_env.quiet())
    command, action = motion_command(env), env.action_manager.get_term("joint_position")
    enter_phase(env, phase("jump_a"))
    command.led, command.scripted = 0.5, True
    still = torch.zeros(small_env.ROBOTS, 12)
    env.step(still)
    assert not action.led.any()
    command.jump[:2] = True
    command.compute(0.0)
    table = command._guidance
    for step in range(14):
        assert torch.equal(action.led[:2], 0.5 * table[step].expand(2, 12)), step
        assert not action.led[2:].any()
        if step == 12:
            command.tracker.liftoffs[1] = 1.0
            command.compute(0.0)
            assert not action.led[1].any()
            command.tracker.liftoffs[1] = 0.0
        env.step(still)
    command.led = 0.0
    command.compute(0.0)
    assert action.led is None
