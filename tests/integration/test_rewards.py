"""Every reward against a number worked out by hand, the sum of all, and the paper's weights."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import pytest

pytest.importorskip("mjlab")

import numpy as np
import torch
from mjlab.managers.reward_manager import RewardManager
from torch import Tensor

import training_env
from pronk.jump.train.mdp import commands
from pronk.jump.train.mdp.commands import motion_command
from pronk.jump.train.mdp.motion import JointMotion, LegMotion, StepMotion, TrunkMotion
from pronk.jump.train.mdp.reward_manager import StackedRewardManager
from pronk.jump.train.tasks.reward_weights import candidate_terms, reward_weights
from training_env import N

pytestmark = pytest.mark.train

STANDING = 0.298970  # .209 cos(.8) + .195 cos(.8) + .0175
KNEE = 0.153358  # .195 cos(.8) + .0175
JUMPER = 1
"""The robot in jump mode; all others are not."""
ROWS = reward_weights()
"""Terms of a task without a recipe."""
TERMS = {**ROWS, **candidate_terms()}
"""All terms, also those that only a recipe gives a weight."""


@pytest.fixture
def env(monkeypatch: pytest.MonkeyPatch) -> Any:
    built = training_env.fresh(training_env.nominal(), scripted=True)
    monkeypatch.setattr(motion_command(built).cfg, "jump_speed_added", 0.35)
    built.action_manager.process_action(torch.zeros(N, 12))
    return built


def v(*values: float) -> Tensor:
    return torch.tensor(values)


def at(values: dict[int, float]) -> Tensor:
    """Return twelve zeros but for some."""
    return torch.tensor([values.get(i, 0.0) for i in range(12)])


def feet(*rows: tuple[float, float, float]) -> Tensor:
    """Return vectors of some feet, and zeros of the others."""
    zeros = [(0.0, 0.0, 0.0)] * (4 - len(rows))
    return torch.tensor([*rows, *zeros])


STILL = {
    "velocity": torch.zeros(12),
    "torque": torch.zeros(12),
    "torque_change": torch.zeros(12),
    "height": torch.tensor(STANDING),
    "velocity_world": torch.zeros(3),
    "velocity_heading": torch.zeros(2),
    "angular_velocity": torch.zeros(3),
    "gravity": v(0.0, 0.0, -1.0),
    "heading": v(1.0, 0.0),
    "contact": torch.ones(4, dtype=torch.bool),
    "force": torch.full((4,), 30.0),
    "foot_position": torch.zeros(4, 2),
    "foot_height": torch.zeros(4),
    "foot_velocity": torch.zeros(4, 3),
    "foot_velocity_change": torch.zeros(4, 3),
    "knee_height": torch.full((4,), KNEE),
    "leg_length": torch.full((4,), 0.28),
    "non_foot_contacts": torch.zeros(()),
}
"""Motion of a robot that stands still."""


def motion_of(position: Tensor, fields: dict[str, Tensor]) -> StepMotion:
    """Let all robots stand still with joints at `position`, but for some fields of one robot."""
    robot = {"position": position, **STILL, **fields}
    robots = {}
    for name, value in robot.items():
        robots[name] = value.expand(N, *value.shape).clone()
    return StepMotion(
        joints=JointMotion(
            position=robots["position"],
            velocity=robots["velocity"],
            torque=robots["torque"],
            torque_change=robots["torque_change"],
        ),
        trunk=TrunkMotion(
            height=robots["height"],
            velocity_world=robots["velocity_world"],
            velocity_heading=robots["velocity_heading"],
            angular_velocity=robots["angular_velocity"],
            gravity=robots["gravity"],
            heading=robots["heading"],
        ),
        legs=LegMotion(
            contact=robots["contact"],
            force=robots["force"],
            foot_position=robots["foot_position"],
            foot_height=robots["foot_height"],
            foot_velocity=robots["foot_velocity"],
            foot_velocity_change=robots["foot_velocity_change"],
            knee_height=robots["knee_height"],
            length=robots["leg_length"],
        ),
        non_foot_contacts=robots["non_foot_contacts"],
    )


def pretend(env: Any, fields: dict[str, Tensor] | None = None) -> Any:
    """Let all robots stand still in the default pose, but for some fields of their motion.

    `fields` are of one robot; `command` among them is the velocity command, `offset` is added to
    the default joint positions.
    """
    fields = dict(fields or {})
    command = motion_command(env)
    position = command.default_position[0] + fields.pop("offset", torch.zeros(12))
    command.velocity[:] = fields.pop("command", torch.zeros(3))
    motion = motion_of(position, fields)
    env.common_step_counter += 1
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(commands, "measure_motion", lambda *_: motion)
        assert command.motion is motion
    command.state.mode = torch.arange(N) == JUMPER
    return command


def value(env: Any, name: str) -> Tensor:
    """Compute a term of all robots."""
    term = TERMS[name]
    return term.func(env, **term.params)


STRAY = {"foot_height": v(0.10, 0.12, 0.14, 0.04)}
AIR = torch.zeros(4, dtype=torch.bool)
SLIDES = feet((0.3, 0.4, 2.0), (0.2, 0.0, 0.0), (1.0, 1.0, 0.0))
SWINGS = feet((0.15, 0.2, 7.0), (0.0, -4.0, 1.0))
CASES: list[tuple[str, float, float | None, dict[str, Tensor]]] = [
    # |(1 - .7, .5 - .1)|^2 = .25. In jump mode (1, .5) becomes .35 m/s faster: its length is
    # sqrt(1.25), so times 1 + .35 / 1.118034 = 1.313050: errors .613050 and .556525.
    (
        "tracking_linear",
        math.exp(-0.25 / 0.25),
        math.exp(-(0.613050**2 + 0.556525**2) / 0.25),
        {"command": v(1.0, 0.5, 0.0), "velocity_heading": v(0.7, 0.1)},
    ),
    # Below 1 m/s .35 m/s in proportion: -.4 becomes -.54.
    (
        "tracking_linear",
        1.0,
        math.exp(-(0.14**2) / 0.25),
        {"command": v(0.0, -0.4, 2.0), "velocity_heading": v(0.0, -0.4)},
    ),
    (
        "tracking_angular",
        math.exp(-(0.3**2) / 0.25),
        None,
        {"command": v(1.0, 0.0, -1.0), "angular_velocity": v(5.0, 5.0, -0.7)},
    ),
    # The same with wide kernels: (1.2, .9) is 1.5 m/s, in jump mode 1.85.
    ("approach_linear", math.exp(-2.25 / 4), math.exp(-3.4225 / 4), {"command": v(1.2, 0.9, 0.0)}),
    ("approach_angular", math.exp(-4.0 / 4), None, {"command": v(1.0, 0.0, -2.0)}),
    # .3^2 + .1^2; standing eight times that.
    ("posture", 0.1, None, {"command": v(0.5, 0.0, 0.0), "offset": at({0: 0.3, 8: 0.1})}),
    ("posture", 0.8, 0.1, {"offset": at({0: 0.3, 8: -0.1})}),
    ("vertical_velocity", 0.36, None, {"velocity_world": v(2.0, 1.0, -0.6)}),
    ("smoothness", 3.0**2 + 4.0**2, None, {"torque_change": at({2: 3.0, 11: -4.0})}),
    # A roll of .3 rad.
    ("orientation", math.sin(0.3) ** 2, None, {"gravity": v(0, -math.sin(0.3), -math.cos(0.3))}),
    ("collision", 3.0, None, {"non_foot_contacts": torch.tensor(3.0)}),
    # 17 N m/rad * -1.2 rad = -20.4 N m, 3.4 over the hip's 17. The knee: -17 * .5 - .4 * 50 =
    # -28.5 of its 17 * 9.33 / 6 = 26.435, 2.065 over. Hip pitch has 8.5.
    (
        "torque_limits",
        3.4 + 2.065,
        None,
        {"offset": at({0: 1.2, 4: -0.5, 5: 0.5}), "velocity": at({5: 50.0})},
    ),
    # Hip roll 1.7 of 1.6; hip pitch -.8 - 2.0 of -2.6; knee 1.6 + 1.3 of 2.6.
    ("position_limits", 0.1 + 0.2 + 0.3, None, {"offset": at({0: 1.7, 4: -2.0, 8: 1.3})}),
    # sqrt(.3^2 + .4^2 + 1.2^2).
    ("foot_acceleration", 1.3, None, {"foot_velocity_change": feet((0.3, 0, 0), (0, -0.4, 1.2))}),
    # (.09 - .05)^2 sqrt(.25) + (.09 - .10)^2 sqrt(4) = .0008 + .0002.
    (
        "foot_clearance",
        0.001,
        None,
        {"foot_height": v(0.05, 0.10, 0.0, 0.0), "foot_velocity": SWINGS},
    ),
    ("torque", 5.0**2 + 12.0**2, None, {"torque": at({1: 5.0, 5: -12.0})}),
    # Mean 25; deviations -25, -15, 5, 35: variance (625 + 225 + 25 + 1225) / 4 = 525.
    ("dense_jump", 0.0, math.sqrt(525.0), {"force": v(0.0, 10.0, 30.0, 60.0)}),
    ("roll_pitch_rate", 0.25 + 1.44, None, {"angular_velocity": v(0.5, -1.2, 3.0)}),
    # .3^2 + .4^2 + .2^2; the third foot slides faster but is in the air.
    ("slip", 0.29, None, {"foot_velocity": SLIDES, "contact": v(1, 1, 0, 1) > 0}),
    ("trunk_height", 0.05**2, None, {"height": torch.tensor(STANDING + 0.05)}),
    ("trunk_height", 0.0, None, {"height": torch.tensor(0.2)}),
    ("crouch", 0.03**2, None, {"height": torch.tensor(STANDING - 0.05)}),
    ("crouch", 0.0, None, {"height": torch.tensor(STANDING - 0.01)}),
    # Of .06 m half, all, a quarter and twice; 2 cm below the floor.
    ("knees", 0.5 + 0.0 + 0.75 + 0.0, None, {"knee_height": v(0.03, 0.06, 0.015, 0.12)}),
    ("knees", 4.0 / 3.0, None, {"knee_height": v(KNEE, KNEE, KNEE, -0.02)}),
    # Mean .10, lowest .04, in the air, as the jump comes down; not on the way up.
    ("stray_foot", 0.0, 0.06, {**STRAY, "velocity_world": v(2.0, 0.0, -0.1), "contact": AIR}),
    ("stray_foot", 0.0, 0.0, {**STRAY, "velocity_world": v(2.0, 0.0, 0.1), "contact": AIR}),
    ("stray_foot", 0.0, 0.0, {**STRAY, "velocity_world": v(2.0, 0.0, -0.1)}),
]


@pytest.mark.parametrize(("name", "walking", "jumping", "fields"), CASES)
def test_term_by_hand(
    env: Any, name: str, walking: float, jumping: float | None, fields: dict[str, Tensor]
) -> None:
    """None: the same in jump mode, times the term's factor there."""
    pretend(env, fields)
    expected = torch.full((N,), walking)
    scale = TERMS[name].params.get("jump_scale", 1.0)
    expected[JUMPER] = scale * (walking if jumping is None else jumping)
    torch.testing.assert_close(value(env, name), expected, rtol=1e-4, atol=1e-5)


EVENTS = {
    "sparse_jump": "score_gain",
    "jump_height": "travel_gain",
    "flight_distance": "flight_gain",
    "clearance_gap": "gap_gain",
    "hop": "hop",
}
"""Quantity of the jump's state that each event pays for."""


@pytest.mark.parametrize("decimation", [2, 6])
@pytest.mark.parametrize("name", EVENTS)
def test_events_earn_their_weight_once(
    env: Any, monkeypatch: pytest.MonkeyPatch, name: str, decimation: int
) -> None:
    """However long the policy step is (D1)."""
    command = pretend(env)
    env.cfg.decimation = decimation
    monkeypatch.setattr(command.state, EVENTS[name], torch.arange(N) / 4)
    earned = value(env, name) * env.step_dt
    assert earned.tolist() == pytest.approx([i / 4 for i in range(N)])


@pytest.mark.parametrize("decimation", [2, 6])
def test_the_lift_off_and_height_by_speed_are_paid_once(
    env: Any, monkeypatch: pytest.MonkeyPatch, decimation: int
) -> None:
    """1.2 m/s of commanded 1 (rewarded up to 1.35 in jump mode), 1.25 of 2.5 m/s upwards."""
    fields = {"velocity_heading": v(1.2, 0.5), "velocity_world": v(1.2, 0.5, 1.25)}
    command = pretend(env, {"command": v(1.0, 0.0, 0.0), **fields})
    env.cfg.decimation = decimation

    def earned(name: str) -> list[float]:
        return (value(env, name) * env.step_dt).tolist()

    assert not any(earned("liftoff_angle"))
    lifts = torch.tensor([0.0, 1.0] + [0.0] * (N - 2))
    monkeypatch.setattr(command.state, "first_liftoff", lifts)
    monkeypatch.setattr(command.state, "reward_scale", torch.full((N,), 0.5))
    monkeypatch.setattr(command.state, "travel_gain", torch.full((N,), 0.3))
    angle = math.atan2(1.25, 1.2) - math.atan2(2.0, 1.35)
    share = math.hypot(1.25, 1.2) / math.hypot(2.0, 1.35)
    expected = 0.5 * math.exp(-0.5 * (angle / 0.15) ** 2) * share
    assert earned("liftoff_angle") == pytest.approx([0.0, expected] + [0.0] * (N - 2), rel=1e-4)
    # Half way to 2 m/s forwards: 1 - .6 / 2.
    assert earned("height_by_speed") == pytest.approx([0.3 * 0.7] * N)


def test_the_size_of_jumps_backwards_earns_a_share(
    env: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A share of 0.4 at 2 m/s backwards and beyond, half of the way to it at 1 m/s."""
    velocities = torch.zeros(N, 3)
    velocities[:4, 0] = torch.tensor([-1.0, -2.0, -3.0, 1.0])
    command = pretend(env, {"command": velocities})
    for gain in ("travel_gain", "flight_gain", "gap_gain"):
        monkeypatch.setattr(command.state, gain, torch.full((N,), 0.5))
    monkeypatch.setattr(command.cfg, "backward_share", 0.4)
    share = torch.ones(N)
    share[:3] = torch.tensor([0.7, 0.4, 0.4])
    for name in ("jump_height", "flight_distance", "clearance_gap"):
        earned = value(env, name) * env.step_dt
        assert earned.tolist() == pytest.approx((0.5 * share).tolist()), name


def test_the_length_of_jumps_to_the_sides_earns_a_share(
    env: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A share of 0.4 straight to a side, of 0.64 at 3 parts to the side and 4 forwards."""
    velocities = torch.zeros(N, 3)
    velocities[1] = torch.tensor([0.0, 1.0, 0.0])
    velocities[2] = torch.tensor([0.0, -0.5, 0.0])
    velocities[3] = torch.tensor([0.8, 0.6, 1.0])
    velocities[4] = torch.tensor([2.0, 0.0, 0.0])
    command = pretend(env, {"command": velocities})
    for gain in ("travel_gain", "flight_gain", "gap_gain"):
        monkeypatch.setattr(command.state, gain, torch.full((N,), 0.5))
    monkeypatch.setattr(command.cfg, "sideways_share", 0.4)
    share = torch.ones(N)
    share[1:4] = torch.tensor([0.4, 0.4, 0.64])
    for name in ("flight_distance", "clearance_gap"):
        earned = value(env, name) * env.step_dt
        assert earned.tolist() == pytest.approx((0.5 * share).tolist()), name
    assert (value(env, "jump_height") * env.step_dt).tolist() == pytest.approx([0.5] * N)


def test_a_fall_is_an_event_and_a_time_out_is_none(env: Any) -> None:
    env.sim.data.qpos[2, 2:7] = v(0.3, 0.0, 1.0, 0.0, 0.0)
    env.episode_length_buf[5] = 10**6
    env.termination_manager.compute()
    pretend(env)
    assert (value(env, "termination") * env.step_dt).tolist() == [0, 0, 1, 0, 0, 0, 0, 0]
    motion_command(env).state.mode[2] = True
    pretend(env)
    env.sim.data.qpos[JUMPER] = env.sim.data.qpos[2]
    env.termination_manager.compute()
    assert float(value(env, "termination")[JUMPER] * env.step_dt) == 5.0


def test_landing_after_a_jump(env: Any) -> None:
    """5 cm too low: on the ground, in jump mode and after a lift-off."""
    low = ROWS["landing"].params["height"] - 0.05
    command = pretend(env, {"height": torch.tensor(low)})
    assert not value(env, "landing").any(), "a crouch"
    command.state.liftoffs = torch.ones(N)
    expected = [0.0] * N
    expected[JUMPER] = 0.05
    assert value(env, "landing").tolist() == pytest.approx(expected)
    command.state.airborne = torch.ones(N, dtype=torch.bool)
    assert not value(env, "landing").any()


def test_terms_of_actions_and_of_similarity(env: Any) -> None:
    command = pretend(env)
    command.state.similarity = torch.full((N,), 0.5)
    assert value(env, "countermovement").tolist() == [0.5] * N
    env.action_manager.process_action(torch.full((N, 12), 0.5))
    second_action = torch.full((N, 12), 0.5)
    second_action[0, 3] = -0.5
    second_action[JUMPER, :2] = v(1.0, 0.25)
    env.action_manager.process_action(second_action)
    assert value(env, "action_rate").tolist() == pytest.approx([1.0, 0.3125 / 4] + [0.0] * 6)
    # Targets are .35 * 4 = 1.4 rad off: 17 * 1.4 = 23.8 N m, 6.8 over the hip's.
    env.action_manager.process_action(at({3: 4.0}).expand(N, 12))
    assert float(value(env, "torque_limits")[0]) == pytest.approx(6.8, rel=1e-5)


def change_one_robot(motion: StepMotion, robot: int) -> None:
    """Change everything in the motion of one robot."""
    parts = [motion.joints, motion.trunk, motion.legs]
    tensors = [motion.non_foot_contacts]
    for part in parts:
        tensors += [getattr(part, field.name) for field in dataclasses.fields(part)]
    for tensor in tensors:
        if tensor.dtype == torch.bool:
            tensor[robot] = ~tensor[robot]
        else:
            tensor[robot] += 2.0


def test_every_term_is_tested_and_of_one_robot_each(env: Any) -> None:
    tested = {case[0] for case in CASES} | set(EVENTS)
    tested |= {"termination", "landing", "countermovement", "action_rate"}
    tested |= {"liftoff_angle", "height_by_speed"}
    assert tested == set(TERMS)
    command = pretend(env, {"command": v(1.0, 0.0, 0.0)})
    before = {name: value(env, name).clone() for name in TERMS}
    change_one_robot(command.motion, 2)
    other_robots = torch.arange(N) != 2
    for name, value_before in before.items():
        assert value(env, name).shape == (N,)
        assert torch.equal(value(env, name)[other_robots], value_before[other_robots]), name


@pytest.mark.parametrize("by_dt", [True, False])
def test_the_stacked_sum_is_that_of_mjlab(
    env: Any, monkeypatch: pytest.MonkeyPatch, by_dt: bool
) -> None:
    """Step by step, with jumps, a fall and physics gone wrong; and in the log of episodes."""
    plain = RewardManager(env.cfg.rewards, env, scale_by_dt=by_dt)
    stacked = StackedRewardManager(env.cfg.rewards, env, scale_by_dt=by_dt)
    monkeypatch.setattr(env, "reward_manager", plain)
    compute_plain = plain.compute
    plain_rewards = []
    stacked_rewards = []

    def compute_with_both(dt: float) -> Tensor:
        plain_rewards.append(compute_plain(dt).clone())
        stacked_rewards.append(stacked.compute(dt).clone())
        return plain_rewards[-1]

    monkeypatch.setattr(plain, "compute", compute_with_both)
    for step in range(12):
        for manager in (plain, stacked):  # as a phase would
            manager.get_term_cfg("sparse_jump").weight = 8.0 + step
            manager.get_term_cfg("collision").params["jump_scale"] = 1.0 + step
        motion_command(env).jump[::2] = step > 2
        if step == 8:
            env.sim.data.qpos[3, 2:7] = v(0.3, 0.0, 1.0, 0.0, 0.0)
            env.sim.data.qvel[5] = math.nan
        env.step(2.0 * torch.rand(N, 12) - 1.0)
    expected = torch.stack(plain_rewards)
    assert torch.isfinite(expected).all()
    assert expected.abs().min() > 0.0
    torch.testing.assert_close(torch.stack(stacked_rewards), expected, rtol=1e-5, atol=1e-5)
    for robot in range(N):
        plain_terms = dict(plain.get_active_iterable_terms(robot))
        stacked_terms = dict(stacked.get_active_iterable_terms(robot))
        assert list(stacked_terms) == list(plain_terms) == list(ROWS)
        for name, rate in plain_terms.items():
            np.testing.assert_allclose(stacked_terms[name], rate, 1e-5, 1e-6)
    # mjlab's manager has logged two robots' episodes as they ended.
    robots = torch.tensor([1, 4])
    plain_log = {name: float(mean) for name, mean in plain.reset(robots).items()}
    stacked_log = {name: float(mean) for name, mean in stacked.reset(robots).items()}
    assert stacked_log == pytest.approx(plain_log, rel=1e-5, abs=1e-7)
    assert not any(stacked.reset(robots).values())


def test_the_stacked_manager_is_installed_once(env: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(env, "reward_manager", RewardManager(env.cfg.rewards, env))
    StackedRewardManager.install(env)
    installed = env.reward_manager
    assert isinstance(installed, StackedRewardManager)
    StackedRewardManager.install(env)
    assert env.reward_manager is installed
