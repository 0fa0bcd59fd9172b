"""What the robots are told: ranges, their growth, shares, intervals, and who is left alone."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import binom, kstest

pytest.importorskip("mjlab")
pytestmark = pytest.mark.train

import torch

import small_env
from pronk.train.mdp.commands import MotionCommand, motion_command
from pronk.train.phases import enter_phase, phase

Array = NDArray[np.float64]
N = small_env.ROBOTS
DT = 0.02
LIMITS = np.array([3.0, 1.0, 2.0])  # C1 to C3
EVERYBODY = torch.arange(N)


@pytest.fixture(scope="module")
def built() -> Any:
    return small_env.quiet()


@pytest.fixture
def env(built: Any) -> Iterator[Any]:
    small_env.fresh(built)
    # In jump mode or not is what the tests say, not what the robots did.
    yield built
    motion_command(built).tracker.reset(EVERYBODY)


@pytest.fixture
def command(env: Any) -> MotionCommand:
    return motion_command(env)


def drawn(command: MotionCommand, rounds: int = 1000) -> Array:
    """Velocity commands of many episodes' beginnings. (rounds * N, 3)"""
    found = []
    for _ in range(rounds):
        command.reset(EVERYBODY)
        found.append(command.velocity.clone())
    return np.float64(torch.cat(found).numpy())


def assert_share(count: int, of: int, share: float) -> None:
    """A count that a share explains, but for one time in ten thousand."""
    low, high = binom.interval(1.0 - 1e-4, of, share)
    assert low <= count <= high


# --- Velocity -------------------------------------------------------------------------------------


def test_velocities_are_uniform_over_the_full_ranges(env: Any, command: MotionCommand) -> None:
    command.ranges.grown.fill_(1e6)
    velocity = drawn(command)
    moves = velocity != 0.0
    whole = velocity[moves.all(axis=1)]
    assert len(whole) > 1000
    for axis, limit in enumerate(LIMITS):
        assert kstest(whole[:, axis], "uniform", args=(-limit, 2 * limit)).pvalue > 1e-3
    correlation = np.corrcoef(whole, rowvar=False)
    assert np.abs(correlation[np.triu_indices(3, 1)]).max() < 4.0 / math.sqrt(len(whole))
    for axis, limit in enumerate(LIMITS):
        single = velocity[(moves.sum(axis=1) == 1) & moves[:, axis], axis]
        assert kstest(single, "uniform", args=(-limit, 2 * limit)).pvalue > 1e-3


def test_shares_of_standing_and_of_one_axis(env: Any, command: MotionCommand) -> None:
    """10 of 100 stand, 40 move along one axis, each as often; the rest along all."""
    moves = drawn(command) != 0.0
    axes, total = moves.sum(axis=1), len(moves)
    assert_share((axes == 0).sum(), total, 0.1)
    assert_share((axes == 1).sum(), total, 0.4)
    assert_share((axes == 3).sum(), total, 0.5)
    assert not (axes == 2).any()
    for axis in range(3):
        assert_share((moves[:, axis] & (axes == 1)).sum(), total, 0.4 / 3)


def test_velocities_are_held_two_to_six_seconds(command: MotionCommand) -> None:
    seen = []
    for _ in range(6000):
        command.compute(DT)
        seen.append(command.velocity.clone())
    changed = (np.diff(torch.stack(seen).numpy(), axis=0) != 0.0).any(axis=2)
    spans = np.concatenate([np.diff(np.flatnonzero(robot)) * DT for robot in changed.T])
    assert len(spans) > 150
    assert spans.min() >= 2.0 - 1e-6
    # A zero that follows a zero is no change: only then does one seem to be held longer.
    assert (spans > 6.0 + DT).mean() < 0.05
    assert abs(np.median(spans) - 4.0) < 0.5


def test_time_passes_in_proportion_to_the_step(command: MotionCommand) -> None:
    """Also where each robot has a time of its own: robots just reset begin with full clocks."""
    before = command.time_left.clone()
    passed = torch.tensor([DT] * (N - 1) + [0.0])
    command.compute(passed)
    torch.testing.assert_close(command.time_left, before - passed)


# --- Jump -----------------------------------------------------------------------------------------


def watch(command: MotionCommand, steps: int) -> Array:
    """The jump input of every robot in many steps. (steps, N)"""
    seen = []
    for _ in range(steps):
        command.compute(DT)
        seen.append(command.jump.clone())
    return np.int64(torch.stack(seen).numpy())


def test_nobody_is_told_to_jump_in_phase_1(command: MotionCommand) -> None:
    assert not watch(command, 500).any()


@pytest.mark.parametrize("name", ["jump_a", "jump_b"])
def test_half_of_the_robots_jump_in_phase_2(env: Any, command: MotionCommand, name: str) -> None:
    """Always the same half: the others keep walking as in phase 1."""
    enter_phase(env, phase(name))
    for _ in range(2):
        command.reset(EVERYBODY)
        jumps = watch(command, 250).any(axis=0)
        assert (jumps == (command._rank < 0.5).numpy()).all()
        assert (jumps == command.jumper.numpy()).all()
    assert abs(jumps.sum() - N // 2) <= 1


def test_half_of_any_number_of_robots_is_half() -> None:
    """The share of the golden ratio's multiples below 1/2 is that in every stretch of robots."""
    for count in (16, 1000, 4096, 16384):
        rank = (torch.arange(count) * 0.6180339887) % 1.0
        assert abs(int((rank < 0.5).sum()) - count / 2) <= 2


def test_the_time_until_a_jump_input_changes_is_known(env: Any, command: MotionCommand) -> None:
    enter_phase(env, phase("jump_a"))
    command.reset(EVERYBODY)
    changes = 0
    for _ in range(250):
        left, before = command.jump_left.clone(), command.jump.clone()
        command.compute(DT)
        changed = command.jump != before
        changes += int(changed.sum())
        assert torch.equal(changed, command.jumper & (left <= DT))
    assert changes > N, "half of them, on and off, more than once"
    assert not command.jump_left[~command.jumper].any()


def test_walking_again_ends_all_jumps(env: Any, command: MotionCommand) -> None:
    enter_phase(env, phase("jump_a"))
    while not command.jump.any():
        command.compute(DT)
    enter_phase(env, phase("walk"))
    assert not watch(command, 100).any()


def test_jump_input_is_held_for_a_random_interval(env: Any, command: MotionCommand) -> None:
    """C4: on and off for times drawn from their ranges, to the length of a step."""
    enter_phase(env, phase("jump_a"))
    command.reset(EVERYBODY)
    seen = watch(command, 6000)
    on, off = [], []
    for jump in seen.T[seen.any(axis=0)]:
        edges = np.flatnonzero(np.diff(jump, prepend=0))
        first = (edges[0] + 1) * DT
        assert command.cfg.jump_off_s[0] - 1e-5 <= first <= command.cfg.jump_off_s[1] + DT
        for begin, end in itertools.pairwise(edges):
            (on if jump[begin] else off).append((end - begin) * DT)
    for spans, (low, high) in ((on, command.cfg.jump_on_s), (off, command.cfg.jump_off_s)):
        assert len(spans) > 100
        assert min(spans) >= low - 1e-5
        assert max(spans) <= high + DT + 1e-5
        assert kstest(spans, "uniform", args=(low, high - low + DT)).statistic < 0.15
        assert max(spans) - min(spans) > 0.85 * (high - low)


# --- Who is left alone ----------------------------------------------------------------------------


def state(command: MotionCommand) -> dict[str, torch.Tensor]:
    """A copy of all that a robot has of commands."""
    own = {name: v for name, v in vars(command).items() if isinstance(v, torch.Tensor)}
    own |= {f"tracker.{n}": v for n, v in vars(command.tracker).items() if torch.is_tensor(v)}
    return {name: v.clone() for name, v in own.items() if v.shape[:1] == (N,)}


def begin_jumps(env: Any) -> None:
    """Put everybody somewhere in a jump."""
    enter_phase(env, phase("jump_a"))
    command = motion_command(env)
    command.jump[:] = True
    for _ in range(3):
        env.step(torch.rand(N, 12) - 0.5)
        command.jump[:] = True


def test_reset_of_one_robot_does_not_disturb_another(env: Any, command: MotionCommand) -> None:
    begin_jumps(env)
    before = state(command)
    command.reset(torch.tensor([3]))
    after = state(command)
    others = EVERYBODY != 3
    for name in before:
        assert torch.equal(after[name][others], before[name][others]), name
    assert before["tracker.mode"].all()
    assert not command.jump[3]
    for name in before:
        if name.startswith("tracker."):
            assert not after[name][3].any(), name
    assert after["velocity"][3].tolist() != before["velocity"][3].tolist()
    assert 2.0 <= after["time_left"][3] <= 6.0


def test_reset_of_one_robot_through_the_environment(env: Any, command: MotionCommand) -> None:
    begin_jumps(env)
    before = state(command)
    env.reset(env_ids=torch.tensor([5]))
    after = state(command)
    for name in before:
        assert torch.equal(after[name][EVERYBODY != 5], before[name][EVERYBODY != 5]), name
    assert not after["tracker.mode"][5]


def test_a_robot_whose_episode_ends_begins_with_a_full_clock(
    env: Any, command: MotionCommand
) -> None:
    env.sim.data.qpos[2, 2:7] = torch.tensor([0.1, 0.0, 1.0, 0.0, 0.0])  # lies on its back
    before = command.time_left.clone()
    env.step(torch.zeros(N, 12))
    assert env.reset_terminated.tolist() == [i == 2 for i in range(N)]
    assert 2.0 <= float(command.time_left[2]) <= 6.0
    others = EVERYBODY != 2
    torch.testing.assert_close(command.time_left[others], before[others] - DT)


def test_scripted_commands_are_the_callers(env: Any, command: MotionCommand) -> None:
    enter_phase(env, phase("jump_a"))
    command.scripted = True
    velocity, jump = command.velocity, command.jump
    velocity[:] = torch.rand(N, 3)
    jump[:] = EVERYBODY % 2 == 0
    told = velocity.clone()
    env.episode_length_buf[1] = 10**6  # an episode that ends must not change them either
    for _ in range(3):
        env.step(torch.zeros(N, 12))
    for _ in range(400):
        command.compute(DT)
    command.reset(EVERYBODY)
    assert command.velocity is velocity
    assert command.jump is jump
    assert torch.equal(velocity, told)
    assert jump.tolist() == [i % 2 == 0 for i in range(N)]
    assert not command.tracker.mode.any(), "jumps under way are forgotten all the same"


# --- What is rewarded -----------------------------------------------------------------------------


def test_target_in_jump_mode_is_a_leap(
    command: MotionCommand, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here .35 m/s more, in proportion below 1 m/s; never another direction."""
    monkeypatch.setattr(command.cfg, "leap", 0.35)
    command.velocity[:4] = torch.tensor(
        [[2.0, 0.0, 1.0], [-1.2, 0.9, 0.0], [0.0, -0.5, 0.0], [0.0, 0.0, 1.0]]
    )
    command.tracker.mode[:] = False
    assert torch.equal(command.target, command.velocity[:, :2])
    command.tracker.mode[:] = True
    # 2 + .35; (-1.2, .9) of length 1.5 to length 1.85; -.5 * 1.35.
    leap = command.target[:4].tolist()
    assert leap[0] == pytest.approx([2.35, 0.0])
    assert leap[1] == pytest.approx([-1.48, 1.11])
    assert leap[2] == pytest.approx([0.0, -0.675])
    assert leap[3] == [0.0, 0.0]
    # Who was told to jump while .5 m/s too fast is asked for that on top: -.5 becomes -1.175.
    monkeypatch.setattr(command.tracker, "lead", torch.full((N,), 0.5))
    leap = command.target[:4].tolist()
    assert leap[0] == pytest.approx([2.85, 0.0])
    assert leap[1] == pytest.approx([-1.88, 1.41])
    assert leap[2] == pytest.approx([0.0, -1.175])
    assert leap[3] == [0.0, 0.0]


def test_standing_is_no_velocity_and_no_jump(command: MotionCommand) -> None:
    command.velocity[:] = 0.0
    command.velocity[1, 2] = 0.5
    command.velocity[2, 0] = -0.2
    command.tracker.mode[:] = EVERYBODY == 3
    assert command.standing[:5].tolist() == [True, False, False, False, True]


def turn(env: Any, *, yaw: float, pitch: float = 0.0) -> None:
    """Set all robots up to look there, nose down by `pitch` [rad]."""
    half = torch.tensor([yaw, pitch]) / 2.0
    (cy, cp), (sy, sp) = half.cos().tolist(), half.sin().tolist()
    # Yaw about z, then pitch about the turned y.
    env.sim.data.qpos[:, 3:7] = torch.tensor([cy * cp, -sy * sp, cy * sp, sy * cp])


@pytest.mark.parametrize(
    ("yaw", "asked", "way"),
    [
        (0.0, (2.0, 0.0, 0.0), (1.0, 0.0)),
        (0.0, (0.0, -0.5, 0.0), (0.0, -1.0)),
        # Looking to the left ahead is +y, and left is -x.
        (90.0, (0.5, 0.0, 1.0), (0.0, 1.0)),
        (90.0, (0.0, 1.0, 0.0), (-1.0, 0.0)),
        (90.0, (0.6, 0.8, 0.0), (-0.8, 0.6)),
        (180.0, (3.0, 0.0, 0.0), (-1.0, 0.0)),
        (-60.0, (-1.0, 0.0, 0.0), (-0.5, 0.866025)),
        (90.0, (0.0, 0.0, 2.0), (0.0, 0.0)),
        (90.0, (0.0, 0.0, 0.0), (0.0, 0.0)),
    ],
)
@pytest.mark.parametrize("pitch", [0.0, 50.0])
def test_way_in_the_world_of_a_robot_that_looks_elsewhere(
    env: Any,
    command: MotionCommand,
    monkeypatch: pytest.MonkeyPatch,
    yaw: float,
    pitch: float,
    asked: tuple[float, float, float],
    way: tuple[float, float],
) -> None:
    """As the tracker is told it, whatever the nose does."""
    told: dict[str, torch.Tensor] = {}
    monkeypatch.setattr(command.tracker, "advance", lambda **given: told.update(given))
    monkeypatch.setattr(command, "_motion_step", -1)
    turn(env, yaw=math.radians(yaw), pitch=math.radians(pitch))
    command.velocity[:] = torch.tensor(asked)
    motion = command.motion
    np.testing.assert_allclose(told["direction"], [way] * N, atol=1e-5)
    assert told["feet"] is motion.foot_position


@pytest.mark.parametrize(
    ("asked", "goes", "jumps", "along", "excess", "miss"),
    [
        # A leap of .25 asks for 2.25 m/s: no more is paid, a metre a second is too much already.
        ((2.0, 0.0), (3.0, 1.0), True, 2.25, 1.0, math.hypot(0.75, 1.0)),
        ((2.0, 0.0), (3.0, 1.0), False, 2.0, 1.0, math.hypot(1.0, 1.0)),
        ((0.0, -0.5), (1.0, -0.4), True, 0.4, -0.1, math.hypot(1.0, 0.225)),
        ((-1.0, 0.0), (0.5, 0.0), True, -0.5, -1.5, 1.75),
        ((0.0, 0.0), (1.0, 1.0), True, 0.0, 0.0, math.sqrt(2.0)),
    ],
)
def test_what_the_tracker_is_told_of_speed(
    env: Any,
    command: MotionCommand,
    monkeypatch: pytest.MonkeyPatch,
    asked: tuple[float, float],
    goes: tuple[float, float],
    jumps: bool,
    along: float,
    excess: float,
    miss: float,
) -> None:
    """Looking along x; turning is nobody's way."""
    told: dict[str, torch.Tensor] = {}
    monkeypatch.setattr(command.tracker, "advance", lambda **given: told.update(given))
    monkeypatch.setattr(command, "_motion_step", -1)
    monkeypatch.setattr(command.cfg, "leap", 0.25)
    command.tracker.mode[:] = jumps
    turn(env, yaw=0.0)
    env.sim.data.qvel[:, :2] = torch.tensor(goes)
    command.velocity[:] = torch.tensor((*asked, 1.5))
    _ = command.motion
    found = [told[name].tolist() for name in ("along", "excess", "miss")]
    np.testing.assert_allclose(found, [[along] * N, [excess] * N, [miss] * N], atol=1e-5)


@pytest.mark.parametrize("forward", [1.0, -0.4, -2.0])
@pytest.mark.parametrize("pitch", [-0.3, 0.3])
def test_going_up_is_no_way(
    env: Any,
    command: MotionCommand,
    monkeypatch: pytest.MonkeyPatch,
    forward: float,
    pitch: float,
) -> None:
    """A trunk that pitches moves ahead as far as it does."""
    told: dict[str, torch.Tensor] = {}
    monkeypatch.setattr(command.tracker, "advance", lambda **given: told.update(given))
    monkeypatch.setattr(command, "_motion_step", -1)
    turn(env, yaw=0.0, pitch=pitch)
    env.sim.data.qvel[:, :3] = torch.tensor([1.0, 0.0, 2.5])
    command.velocity[:] = torch.tensor([forward, 0.0, 0.0])
    _ = command.motion
    along = 1.0 if forward > 0.0 else -1.0
    np.testing.assert_allclose(told["along"], [along] * N, atol=1e-5)


def test_a_robot_set_down_beyond_a_gap_has_cleared_it(env: Any, command: MotionCommand) -> None:
    """Carried by 0.8 m to where it looks, to +y: what its feet left between them, once."""
    command.scripted = True
    qpos, qvel = env.sim.data.qpos, env.sim.data.qvel
    # From the middle of its own patch of floor, which is not the world's.
    qpos[:, :2] = env.scene.env_origins[:, :2]
    turn(env, yaw=math.pi / 2)
    qpos[:, 2], qpos[:, 7:] = 0.3, command.default_position
    qvel[:] = 0.0
    forward = EVERYBODY < 3
    command.velocity[forward] = torch.tensor([1.0, 0.0, 0.0])
    command.velocity[3] = torch.tensor([-1.0, 0.0, 0.0])
    command.velocity[4] = torch.tensor([0.0, 1.0, 0.0])
    command.velocity[5:] = 0.0
    command.jump[:] = EVERYBODY != 2

    def step() -> torch.Tensor:
        env.step(torch.zeros(N, 12))
        return command.tracker.gap.clone()

    for _ in range(12):  # so that it is not hasty
        assert not step().any()
    left = command.motion.foot_position.clone()
    assert command.motion.contact.all()
    qpos[:, 1] += 0.8
    qpos[:, 2] += 0.3
    qvel[:, 2] = 2.0
    assert not step().any()
    assert command.tracker.airborne.all()
    qpos[:, 2] -= 0.35
    qvel[:, 2] = 0.0
    gap = step()
    assert command.motion.contact.any(dim=1).all()
    # Hind feet came to y of about .8 - .19, fore feet had left .19.
    lands = command.motion.foot_position[..., 1].amin(dim=1) - left[..., 1].amax(dim=1)
    told = EVERYBODY < 2
    torch.testing.assert_close(gap[told], lands[told], rtol=0.0, atol=1e-5)
    assert ((gap[told] > 0.3) & (gap[told] < 0.5)).all()
    assert not gap[~told].any(), "not told to jump, told to go elsewhere, or nowhere"
    assert not step().any()
