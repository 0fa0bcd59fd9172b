"""Every reward against a number worked out by hand, and the table against the paper's."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import pytest

pytest.importorskip("mjlab")
pytestmark = pytest.mark.train

import torch
from torch import Tensor

import small_env
from pronk.errors import PronkError
from pronk.train.mdp.commands import MotionCommand, motion_command
from pronk.train.mdp.motion import Motion
from pronk.train.mdp.reward_sum import reward_sum
from pronk.train.mdp.reward_table import (
    PAPER_UNIT,
    ROWS,
    JumpWeights,
    with_jump_weights,
)
from pronk.train.phases import Phase, enter_phase, phase

N = small_env.ROBOTS
STANDING = 0.298970  # .209 cos(.8) + .195 cos(.8) + .0175
KNEE = 0.153358  # .195 cos(.8) + .0175
WALKS, JUMPS = 0, 1
"""A robot out of jump mode and one in it; all others are as the first."""


@pytest.fixture(scope="module")
def built() -> Any:
    return small_env.quiet()


@pytest.fixture
def env(built: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    small_env.fresh(built)
    motion_command(built).scripted = True
    monkeypatch.setattr(motion_command(built).cfg, "leap", 0.35)
    return built


def vector(*values: float) -> Tensor:
    return torch.tensor(values)


def at(size: int, **values: float) -> Tensor:
    """A vector of zeros but for `_3=0.5`: index and value."""
    made = torch.zeros(size)
    for name, value in values.items():
        made[int(name[1:])] = value
    return made


def feet(*rows: tuple[float, float, float]) -> Tensor:
    """Vectors of some feet, zeros of the rest."""
    made = torch.zeros(4, 3)
    made[: len(rows)] = torch.tensor(rows)
    return made


def pretend(env: Any, **fields: Tensor) -> MotionCommand:
    """All robots stand still in the default pose, but for `fields`, each of one robot.

    Fields are those of `Motion`; also `velocity_command`, and `joint_position`: that added to the
    default pose.
    """
    command = motion_command(env)

    def every(value: Tensor) -> Tensor:
        return value.expand(N, *value.shape).clone()

    still = {
        "position": command.default_position.clone(),
        "velocity": torch.zeros(N, 12),
        "height": torch.full((N,), STANDING),
        "velocity_world": torch.zeros(N, 3),
        "velocity_heading": torch.zeros(N, 2),
        "angular_velocity": torch.zeros(N, 3),
        "gravity": every(vector(0.0, 0.0, -1.0)),
        "heading": every(torch.tensor([1.0, 0.0])),
        "contact": torch.ones(N, 4, dtype=torch.bool),
        "force": torch.full((N, 4), 30.0),
        "foot_position": torch.zeros(N, 4, 2),
        "foot_height": torch.zeros(N, 4),
        "knee_height": torch.full((N, 4), KNEE),
        "leg_length": torch.full((N, 4), 0.28),
        "foot_velocity": torch.zeros(N, 4, 3),
        "foot_velocity_change": torch.zeros(N, 4, 3),
        "touching": torch.zeros(N),
        "torque": torch.zeros(N, 12),
        "torque_change": torch.zeros(N, 12),
    }
    command.velocity[:] = fields.pop("velocity_command", torch.zeros(3))
    still["position"] += fields.pop("joint_position", torch.zeros(12))
    command._motion = Motion(**still | {name: every(value) for name, value in fields.items()})
    command._motion_step = env.common_step_counter
    command.tracker.mode[:] = torch.arange(N) == JUMPS
    return command


def paid(env: Any, name: str) -> Tensor:
    """Weighted rate that a term pays to every robot."""
    table = reward_sum(env)
    table(env, None)
    return table.values[list(table.rows).index(name)]


# --- The terms ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """What the robots do, and what a term makes of it, without and within jump mode."""

    name: str
    walking: float
    jumping: float
    motion: dict[str, Tensor]


def same(name: str, value: float, **motion: Tensor) -> Case:
    return Case(name, value, value, motion)


WIDE = {name: ROWS[name].arguments["variance"] for name in ("approach_linear", "approach_angular")}
STANDS = ROWS["posture"].arguments["standing"]
CASES = [
    # |(1 - .7, .5 - .1)|^2 = .25. In jump mode (1, .5) is asked .35 m/s faster: its length is
    # sqrt(1.25), so times 1 + .35 / 1.118034 = 1.313050: errors .613050 and .556525.
    Case(
        "tracking_linear",
        math.exp(-0.25 / 0.25),
        math.exp(-(0.613050**2 + 0.556525**2) / 0.25),
        {"velocity_command": vector(1.0, 0.5, 0.0), "velocity_heading": torch.tensor([0.7, 0.1])},
    ),
    # Below 1 m/s .35 m/s in proportion: -.4 becomes -.54.
    Case(
        "tracking_linear",
        1.0,
        math.exp(-(0.14**2) / 0.25),
        {"velocity_command": vector(0.0, -0.4, 2.0), "velocity_heading": torch.tensor([0.0, -0.4])},
    ),
    same(
        "tracking_angular",
        math.exp(-(0.3**2) / 0.25),
        velocity_command=vector(1.0, 0.0, -1.0),
        angular_velocity=vector(5.0, 5.0, -0.7),
    ),
    # The same with wider kernels: (1.2, .9) is 1.5 m/s, in jump mode 1.85.
    Case(
        "approach_linear",
        math.exp(-2.25 / WIDE["approach_linear"]),
        math.exp(-3.4225 / WIDE["approach_linear"]),
        {"velocity_command": vector(1.2, 0.9, 0.0)},
    ),
    same(
        "approach_angular",
        math.exp(-4.0 / WIDE["approach_angular"]),
        velocity_command=vector(1.0, 0.0, -2.0),
    ),
    # Walking: .3^2 + .1^2. Standing some times that; who jumps does not stand.
    same("posture", 0.1, velocity_command=vector(0.5, 0, 0), joint_position=at(12, _0=0.3, _8=0.1)),
    Case("posture", 0.1 * STANDS, 0.1, {"joint_position": at(12, _0=0.3, _8=-0.1)}),
    same("vertical_velocity", 0.36, velocity_world=vector(2.0, 1.0, -0.6)),
    same("smoothness", 3.0**2 + 4.0**2, torque_change=at(12, _2=3.0, _11=-4.0)),
    # A roll of .3 rad: g = (0, -sin .3, -cos .3).
    same("orientation", math.sin(0.3) ** 2, gravity=vector(0.0, -math.sin(0.3), -math.cos(0.3))),
    same("collision", 3.0, touching=torch.tensor(3.0)),
    # 17 N m/rad * -1.2 rad = -20.4 N m, 3.4 over the hip's 17. The knee asks -17 * .5 - .4 * 50 =
    # -28.5 of its 17 * 9.33 / 6 = 26.435, 2.065 over. Hip pitch asks 8.5.
    same(
        "torque_limits",
        3.4 + 2.065,
        joint_position=at(12, _0=1.2, _4=-0.5, _5=0.5),
        velocity=at(12, _5=50.0),
    ),
    # Hip roll 1.7 of 1.6; hip pitch -.8 - 2.0 of -2.6; knee 1.6 + 1.3 of 2.6.
    same("position_limits", 0.1 + 0.2 + 0.3, joint_position=at(12, _0=1.7, _4=-2.0, _8=1.3)),
    same(
        "foot_acceleration",
        math.sqrt(0.3**2 + 0.4**2 + 1.2**2),
        foot_velocity_change=feet((0.3, 0.0, 0.0), (0.0, -0.4, 1.2)),
    ),
    # (.09 - .05)^2 sqrt(.25) + (.09 - .10)^2 sqrt(4) = .0008 + .0002; z is no part of the speed.
    same(
        "foot_clearance",
        0.001,
        foot_height=vector(0.05, 0.10, 0.0, 0.0),
        foot_velocity=feet((0.15, 0.2, 7.0), (0.0, -4.0, 1.0)),
    ),
    same("torque", 5.0**2 + 12.0**2, torque=at(12, _1=5.0, _5=-12.0)),
    # Mean 25; deviations -25, -15, 5, 35: variance (625 + 225 + 25 + 1225) / 4 = 525.
    same("dense_jump", math.sqrt(525.0), force=vector(0.0, 10.0, 30.0, 60.0)),
    same("roll_pitch_rate", 0.25 + 1.44, angular_velocity=vector(0.5, -1.2, 3.0)),
    # Foot 2 slides as fast but is in the air.
    same(
        "slip",
        0.09 + 0.16 + 0.04,
        foot_velocity=feet((0.3, 0.4, 2.0), (0.2, 0.0, 0.0), (1.0, 1.0, 0.0)),
        contact=torch.tensor([True, True, False, True]),
    ),
    same("trunk_height", 0.05**2, height=torch.tensor(STANDING + 0.05)),
    same("trunk_height", 0.0, height=torch.tensor(0.2)),
    same("crouch", 0.03**2, height=torch.tensor(STANDING - 0.05)),
    same("crouch", 0.0, height=torch.tensor(STANDING - 0.01)),
    # Of .06 m half, all, a quarter and twice.
    same("knees", 0.5 + 0.0 + 0.75 + 0.0, knee_height=vector(0.03, 0.06, 0.015, 0.12)),
    # Sunk into the floor, 2 cm.
    same("knees", 4.0 / 3.0, knee_height=vector(KNEE, KNEE, KNEE, -0.02)),
    same("knees", 0.0),
]


def test_every_term_has_a_case() -> None:
    own = {"termination", "sparse_jump", "rise", "reach", "gap", "hop", "action_rate"}
    own |= {"stray_foot", "landing", "countermovement"}
    assert {case.name for case in CASES} | own == set(ROWS)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_term_by_hand(env: Any, case: Case) -> None:
    """The value, with weight 1, and with the weights of the mode."""
    command = pretend(env, **dict(case.motion))
    env.action_manager.process_action(torch.zeros(N, 12))
    row = ROWS[case.name]
    value = row.term(command, **row.arguments)
    expected = torch.full((N,), case.walking)
    expected[JUMPS] = case.jumping
    torch.testing.assert_close(value, expected, rtol=1e-4, atol=1e-5)
    reward_sum(env).set_rows({**ROWS, case.name: replace(row, walk=3.0, jump=-5.0)})
    weight = torch.full((N,), 3.0)
    weight[JUMPS] = -5.0
    torch.testing.assert_close(paid(env, case.name), weight * value)


@pytest.mark.parametrize("robot", range(3))
def test_terms_are_of_one_robot_each(env: Any, robot: int) -> None:
    """What one robot does is nothing to the others."""
    command = pretend(env, velocity_command=vector(1.0, 0.0, 0.0))
    before = {name: row.term(command, **row.arguments) for name, row in ROWS.items()}
    motion = command.motion
    for name in vars(motion):
        value = getattr(motion, name)[robot]
        value[...] = ~value if value.dtype == torch.bool else value + 2.0
    others = torch.arange(N) != robot
    for name, row in ROWS.items():
        after = row.term(command, **row.arguments)
        assert after.shape == (N,)
        assert torch.equal(after[others], before[name][others]), name


def test_a_foot_strays_as_a_jump_comes_down(env: Any) -> None:
    """Mean .10, lowest .04: .06 m. On the ground a leg may hang as it likes, so may a trot's."""
    feet, down = vector(0.10, 0.12, 0.14, 0.04), vector(2.0, 0.0, -0.1)
    command = pretend(env, foot_height=feet, velocity_world=down)
    command.tracker.airborne[:] = False
    command.tracker.airborne[[WALKS, JUMPS]] = True
    value = ROWS["stray_foot"].term(command)
    assert value.tolist() == pytest.approx([0.06 if i == JUMPS else 0.0 for i in range(N)])
    # Who leaps with the fore legs first has the hind ones below as it goes up.
    command.motion.velocity_world[:, 2] = 0.1
    assert not ROWS["stray_foot"].term(command).any()


def test_a_deep_landing_costs_who_has_jumped(env: Any) -> None:
    """5 cm below the floor of landings: on the ground, in jump mode and after a lift-off."""
    floor = ROWS["landing"].arguments["height"]
    command = pretend(env, height=torch.tensor(floor - 0.05))
    tracker = command.tracker
    tracker.airborne[:] = False
    tracker.liftoffs[:] = 0.0
    assert not ROWS["landing"].term(command, height=floor).any(), "that is a crouch"
    tracker.liftoffs[[WALKS, JUMPS]] = 1.0
    value = ROWS["landing"].term(command, height=floor)
    assert value.tolist() == pytest.approx([0.05 if i == JUMPS else 0.0 for i in range(N)])
    tracker.airborne[JUMPS] = True
    assert not ROWS["landing"].term(command, height=floor).any()
    tracker.airborne[JUMPS] = False
    command.motion.height[:] = floor + 0.01
    assert not ROWS["landing"].term(command, height=floor).any()


def test_likeness_to_a_countermovement_is_paid_as_a_rate(env: Any) -> None:
    command = pretend(env)
    command.tracker.likeness[:] = 0.5
    assert ROWS["countermovement"].term(command).tolist() == [0.5] * N
    weighed = replace(ROWS["countermovement"], jump=6.0)
    reward_sum(env).set_rows({**ROWS, "countermovement": weighed})
    value = paid(env, "countermovement").tolist()
    assert value == pytest.approx([3.0 if i == JUMPS else 0.0 for i in range(N)])


def test_action_rate_by_hand(env: Any) -> None:
    command = pretend(env)
    env.action_manager.process_action(torch.full((N, 12), 0.5))
    second = torch.full((N, 12), 0.5)
    second[WALKS, 3], second[JUMPS, :2] = -0.5, torch.tensor([1.0, 0.25])
    env.action_manager.process_action(second)
    value = ROWS["action_rate"].term(command)
    assert value.tolist() == pytest.approx([1.0, 0.25 + 0.0625] + [0.0] * (N - 2))


def test_targets_are_what_the_torque_is_asked_for(env: Any) -> None:
    """An action of 4 asks .35 * 4 = 1.4 rad more: 17 * 1.4 = 23.8 N m, 6.8 over the hip's."""
    command = pretend(env)
    env.action_manager.process_action(at(12, _3=4.0).expand(N, 12))
    assert ROWS["torque_limits"].term(command).tolist() == pytest.approx([6.8] * N, rel=1e-5)


# --- Events ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("decimation", [2, 3, 4, 5, 6])
@pytest.mark.parametrize(
    ("name", "event", "worth"),
    [
        ("sparse_jump", "gain", 4.0),
        ("rise", "rise", 10.0),
        ("reach", "reach", 6.0),
        ("gap", "gap", 7.0),
        ("hop", "hop", -0.5),
    ],
)
def test_an_event_is_worth_its_weight_once(
    env: Any, name: str, event: str, worth: float, decimation: int
) -> None:
    """However long the policy step was (D1), and in jump mode only."""
    command = pretend(env)
    env.cfg.decimation = decimation
    weights = JumpWeights(
        dense=0.0,
        sparse=4.0,
        width=1.0,
        rise=10.0,
        reach=6.0,
        gap=7.0,
        countermovement=2.0,
        hop=0.5,
        collision=5.0,
        knees=3.0,
        landing=0.0,
    )
    enter_phase(env, Phase(name="made up", iterations=1, jump=True, weights=weights))
    getattr(command.tracker, event)[:] = 0.0
    env.reward_manager.compute(dt=env.step_dt)
    without = env.reward_manager._reward_buf.clone()
    getattr(command.tracker, event)[:] = 0.25
    env.reward_manager.compute(dt=env.step_dt)
    change = env.reward_manager._reward_buf - without
    expected = torch.zeros(N)
    expected[JUMPS] = 0.25 * worth
    torch.testing.assert_close(change, expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("decimation", [2, 6])
def test_a_fall_costs_its_weight_once(env: Any, decimation: int) -> None:
    env.cfg.decimation = decimation
    heavy = replace(ROWS["termination"], walk=-3.0, jump=-7.0)
    reward_sum(env).set_rows({**ROWS, "termination": heavy})
    qpos = env.sim.data.qpos
    qpos[2, 3:7] = vector(0.0, 1.0, 0.0, 0.0)  # on its back
    qpos[2, 2] = 0.3
    env.episode_length_buf[5] = 10**6  # time is over, which is no fall
    env.step(torch.zeros(N, 12))
    table = reward_sum(env)
    cost = table.values[list(table.rows).index("termination")] * env.step_dt
    assert cost.tolist() == pytest.approx([-3.0 if i == 2 else 0.0 for i in range(N)])


@pytest.mark.parametrize("decimation", [2, 6])
def test_rates_are_paid_by_the_second(env: Any, decimation: int) -> None:
    pretend(env, velocity_world=vector(0.0, 0.0, 0.5))
    alone = replace(ROWS["vertical_velocity"], walk=-3.0, jump=2.0)
    nothing = {name: replace(row, walk=0.0, jump=0.0) for name, row in ROWS.items()}
    reward_sum(env).set_rows({**nothing, "vertical_velocity": alone})
    env.cfg.decimation = decimation
    paid = env.reward_manager.compute(dt=env.step_dt)
    expected = torch.full((N,), -3.0 * 0.25 * decimation * 0.005)
    expected[JUMPS] = 2.0 * 0.25 * decimation * 0.005
    torch.testing.assert_close(paid, expected)


# --- The sum --------------------------------------------------------------------------------------


def test_reward_of_a_step_is_the_sum_of_the_rows(env: Any) -> None:
    enter_phase(env, phase("jump_b"))
    motion_command(env).jump[::2] = True
    for _ in range(3):
        _, reward, *_ = env.step(torch.rand(N, 12) - 0.5)
    command, table = motion_command(env), reward_sum(env)
    assert command.tracker.mode.tolist() == [True, False] * (N // 2)
    expected = torch.zeros(N)
    for row in table.rows.values():
        weight = torch.where(command.tracker.mode, row.jump, row.walk)
        expected += weight * row.term(command, **row.arguments) * env.step_dt
    torch.testing.assert_close(reward, expected, rtol=1e-5, atol=1e-6)


def test_rewards_of_an_episode_are_logged(env: Any) -> None:
    """Mean over the robots that end of what each term paid, per second of a full episode."""
    earned = torch.zeros(N)
    for _ in range(3):
        env.step(torch.zeros(N, 12))
        earned += paid_now(env, "tracking_linear") * env.step_dt
    env.reset(env_ids=torch.tensor([1, 4]))
    logged = env.extras["log"]["Episode_Reward/tracking_linear"]
    assert float(logged) == pytest.approx(float(earned[[1, 4]].mean()) / 20.0, rel=1e-5)
    assert {f"Episode_Reward/{name}" for name in ROWS} <= set(env.extras["log"])
    env.step(torch.zeros(N, 12))
    again = paid_now(env, "tracking_linear") * env.step_dt
    env.reset(env_ids=torch.tensor([4]))
    logged = env.extras["log"]["Episode_Reward/tracking_linear"]
    assert float(logged) == pytest.approx(float(again[4]) / 20.0, rel=1e-5)


def paid_now(env: Any, name: str) -> Tensor:
    """What the last step paid."""
    table = reward_sum(env)
    return table.values[list(table.rows).index(name)].clone()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_reward_is_a_number_whatever_physics_gives(env: Any, bad: float) -> None:
    command = pretend(env)
    usual = reward_sum(env)(env, None).clone()
    for name in ("velocity", "torque", "torque_change", "velocity_heading", "force", "foot_height"):
        getattr(command.motion, name)[3] = bad
    command.motion.knee_height[3] = command.tracker.gap[3] = bad
    after = reward_sum(env)(env, None)
    assert torch.isfinite(after).all()
    others = torch.arange(N) != 3
    assert torch.equal(after[others], usual[others])


# --- The table ------------------------------------------------------------------------------------

PAPER: dict[str, tuple[float, float]] = {
    "posture": (-5.0, 0.0),
    "vertical_velocity": (-50.0, 0.0),
    "smoothness": (-0.2, -0.2),
    "orientation": (-20.0, -120.0),
    "collision": (-50.0, -50.0),
    "torque_limits": (-900.0, -900.0),
    "position_limits": (-150.0, -150.0),
    "foot_acceleration": (-0.5, -0.5),
    "foot_clearance": (-250.0, -250.0),
    "torque": (-0.08, -0.08),
    "tracking_linear": (45.0, 45.0),
    "tracking_angular": (30.0, 30.0),
}
"""The paper's table, walk and jump; its termination is an event."""
IN_WALKING_ALONE = {"foot_clearance"}
"""Terms that have the paper's weight, but none in jump mode."""
CHANGED = {"smoothness", "torque_limits", "torque", "tracking_angular", "collision", "orientation"}
"""Terms with another weight, for the reason that stands beside it."""


@pytest.mark.parametrize("name", sorted(PAPER.keys() - CHANGED))
def test_weight_is_the_papers(name: str) -> None:
    row, (walk, jump) = ROWS[name], PAPER[name]
    assert row.walk * PAPER_UNIT == pytest.approx(walk)
    assert row.jump * PAPER_UNIT == pytest.approx(0.0 if name in IN_WALKING_ALONE else jump)


@pytest.mark.parametrize("name", ["smoothness", "torque_limits", "torque"])
def test_weight_is_a_small_part_of_the_papers(name: str) -> None:
    row, (walk, jump) = ROWS[name], PAPER[name]
    for ours, paper in ((row.walk, walk), (row.jump, jump)):
        assert 0.0 < ours * PAPER_UNIT / paper <= 0.1 + 1e-9


def test_weights_of_events_and_of_our_own_terms() -> None:
    # The paper's -500 for a step of 20 ms is -10 of its units once; ours costs no less.
    paper = -500 * 0.02 / PAPER_UNIT
    assert ROWS["termination"].jump <= ROWS["termination"].walk <= paper
    assert ROWS["tracking_angular"].walk * PAPER_UNIT >= PAPER["tracking_angular"][0]
    assert ROWS["collision"].walk * PAPER_UNIT <= PAPER["collision"][0]
    assert ROWS["collision"].jump * PAPER_UNIT <= PAPER["collision"][1]
    assert ROWS["orientation"].walk * PAPER_UNIT == pytest.approx(PAPER["orientation"][0])
    assert PAPER["orientation"][1] <= ROWS["orientation"].jump * PAPER_UNIT < 0.0
    for name in (
        "dense_jump",
        "sparse_jump",
        "rise",
        "reach",
        "gap",
        "countermovement",
        "hop",
        "landing",
    ):
        assert (ROWS[name].walk, ROWS[name].jump) == (0.0, 0.0), "phase 1 knows no jump"
    for name in ("action_rate", "roll_pitch_rate", "slip", "trunk_height", "crouch", "knees"):
        assert ROWS[name].walk < 0.0
        assert ROWS[name].walk <= ROWS[name].jump <= 0.0


def test_arguments_of_the_papers_terms() -> None:
    arguments = {name: dict(row.arguments) for name, row in ROWS.items() if row.arguments}
    assert arguments["tracking_linear"] == arguments["tracking_angular"] == {"variance": 0.25}
    assert arguments["foot_clearance"] == {"height": 0.09}
    assert arguments["posture"]["standing"] >= 1.0
    assert arguments["trunk_height"]["height"] == pytest.approx(STANDING, abs=1e-5)
    assert arguments["crouch"]["height"] == pytest.approx(STANDING - 0.02, abs=1e-5)


def test_a_knee_costs_before_its_skin_is_on_the_ground(env: Any) -> None:
    """And nothing in a crouch from which the tracker counts the stroke."""
    skin = max(
        float(env.sim.mj_model.geom(f"robot/{leg}_{link}_collision").size[0])
        for leg in ("FR", "FL", "HR", "HL")
        for link in ("thigh", "shank")
    )
    floor = ROWS["knees"].arguments["height"]
    assert floor > 2.0 * skin > 0.0
    # With a foot under its hip the knee is as high as the shank's share of the leg.
    crouch = motion_command(env).tracker.settings.crouch
    knee = (crouch - 0.0175) * 0.195 / (0.209 + 0.195) + 0.0175
    assert knee > floor


def test_jump_weights_go_into_the_column_of_jump_mode() -> None:
    weights = JumpWeights(
        dense=0.1,
        sparse=2.0,
        width=0.5,
        rise=3.0,
        reach=1.5,
        gap=0.75,
        countermovement=5.0,
        hop=0.25,
        collision=9.0,
        knees=4.0,
        landing=7.0,
    )
    rows = with_jump_weights(ROWS, weights)
    changed = {"dense_jump": -0.1, "sparse_jump": 2.0, "rise": 3.0, "reach": 1.5}
    changed |= {
        "gap": 0.75,
        "countermovement": 5.0,
        "hop": -0.25,
        "collision": -9.0,
        "knees": -4.0,
        "landing": -7.0,
    }
    assert {name: rows[name].jump for name in changed} == changed
    assert {name: rows[name].walk for name in changed} == {
        name: ROWS[name].walk for name in changed
    }
    assert {name: row for name, row in rows.items() if name not in changed} == {
        name: row for name, row in ROWS.items() if name not in changed
    }
    assert list(rows) == list(ROWS), "order is that of the living table"
    rest = {name: row for name, row in ROWS.items() if name not in ("hop", "gap")}
    with pytest.raises(PronkError, match=r"the reward table has no gap, hop\."):
        with_jump_weights(rest, weights)
