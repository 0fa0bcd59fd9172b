"""Commands: ranges, fractions, intervals, and what the jump state receives of the motion."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest, kstest

pytest.importorskip("mjlab")

import torch
from torch import Tensor

import training_env
from pronk.jump.train.mdp.commands import MotionCommand, motion_command
from pronk.jump.train.mdp.jump import JumpInputs
from pronk.jump.train.mdp.speed_ranges import STEPS
from training_env import N

pytestmark = pytest.mark.train

DT = 0.02
LIMITS = np.array([3.0, 1.0, 2.0])  # C1 to C3
ALL = torch.arange(N)
Vector = tuple[float, ...]
Patch = pytest.MonkeyPatch


@pytest.fixture
def env() -> Any:
    return training_env.fresh(training_env.nominal())


@pytest.fixture
def command(env: Any) -> MotionCommand:
    return motion_command(env)


def test_velocities_are_uniform_in_the_given_fractions(command: MotionCommand) -> None:
    """10 of 100 stand, 40 move along one axis, each as often; the others along all.

    The present ranges are half way from .35 to the whole.
    """
    command.ranges.grown.fill_(STEPS / 2)
    draws = []
    for _ in range(1000):
        command.reset(ALL)
        draws.append(command.velocity.clone())
    velocity = np.float64(torch.cat(draws).numpy())
    moves = velocity != 0.0
    axes = moves.sum(axis=1)
    total = len(moves)
    fractions = [(axes == 0, 0.1), (axes == 1, 0.4), (axes == 3, 0.5)]
    for axis in range(3):
        fractions.append((moves[:, axis] & (axes == 1), 0.4 / 3))
    for rows, fraction in fractions:
        assert binomtest(int(rows.sum()), total, fraction).pvalue > 1e-4
    assert not (axes == 2).any()
    for axis, limit in enumerate(0.675 * LIMITS):
        for rows in (axes == 3, (axes == 1) & moves[:, axis]):
            test = kstest(velocity[rows, axis], "uniform", args=(-limit, 2 * limit))
            assert test.pvalue > 1e-3
    along_all_axes = velocity[axes == 3]
    correlation = np.corrcoef(along_all_axes, rowvar=False)[np.triu_indices(3, 1)]
    assert np.abs(correlation).max() < 4.0 / math.sqrt(len(along_all_axes))


@pytest.mark.parametrize("scripted", [False, True])
def test_ranges_follow_the_tracking_unless_scripted(env: Any, scripted: bool) -> None:
    """All robots are commanded to stand, and stand."""
    command = motion_command(env)
    command.scripted = scripted
    for _ in range(5):
        command.velocity.zero_()
        env.step(torch.zeros(N, 12))
    assert (float(command.ranges.tracking) > 0.02) is not scripted


def test_velocities_last_two_to_six_seconds(command: MotionCommand) -> None:
    command.reset(ALL)
    passed = torch.tensor([DT] * (N - 1) + [0.0])
    before = command.time_left.clone()
    assert ((before >= 2.0) & (before <= 6.0)).all()
    command.compute(passed)
    torch.testing.assert_close(command.time_left, before - passed)
    spans = []
    for _ in range(6000):
        before = command.time_left.clone()
        command.compute(DT)
        after = command.time_left
        spans += after[after > before].tolist()
    assert len(spans) > 150
    assert kstest(spans, "uniform", args=(2.0, 4.0)).pvalue > 1e-3


def test_jump_inputs_have_random_intervals_and_known_times() -> None:
    """C4: half of the robots, always the same; on and off for times from their ranges."""
    env = training_env.fresh(training_env.nominal(), "jump_a")
    command = motion_command(env)
    command.reset(ALL)
    jumper = command.jumper.clone()
    assert abs(int(jumper.sum()) - N // 2) <= 1
    seen = []
    for _ in range(6000):
        time_to_change = command.jump_left.clone()
        before = command.jump.clone()
        command.compute(DT)
        assert torch.equal(command.jump != before, jumper & (time_to_change <= DT))
        assert not command.jump_left[~jumper].any()
        seen.append(command.jump.clone())
    jump = np.int64(torch.stack(seen).numpy())
    assert (jump.any(axis=0) == jumper.numpy()).all()
    on_spans = []
    off_spans = []
    for robot in jump.T[jumper.numpy()]:
        for begin, end in itertools.pairwise(np.flatnonzero(np.diff(robot, prepend=0))):
            span = (end - begin) * DT
            if robot[begin]:
                on_spans.append(span)
            else:
                off_spans.append(span)
    check_spans(on_spans, command.cfg.jump_on_s)
    check_spans(off_spans, command.cfg.jump_off_s)


def check_spans(spans: list[float], limits: tuple[float, float]) -> None:
    """Require that times in whole steps are uniform between limits [s]."""
    low, high = limits
    assert len(spans) > 100
    assert low - 1e-5 <= min(spans)
    assert max(spans) <= high + DT + 1e-5
    assert kstest(spans, "uniform", args=(low, high - low + DT)).statistic < 0.15


def tensors(command: MotionCommand) -> dict[str, Tensor]:
    """Copy all that the command term holds of each robot."""
    copies = {
        "velocity": command.velocity.clone(),
        "jump": command.jump.clone(),
        "time_left": command.time_left.clone(),
    }
    for name, value in vars(command.state).items():
        if torch.is_tensor(value):
            copies[f"state.{name}"] = value.clone()
    return copies


@pytest.mark.parametrize("through_env", [False, True])
def test_reset_affects_one_robot_alone(through_env: bool) -> None:
    env = training_env.fresh(training_env.nominal(), "jump_a")
    command = motion_command(env)
    for _ in range(3):
        command.jump[:] = True
        env.step(torch.rand(N, 12) - 0.5)
    command.jump[:] = True
    before = tensors(command)
    assert before["state.mode"].all()
    ids = torch.tensor([3])
    if through_env:
        env.reset(env_ids=ids)
    else:
        command.reset(ids)
    after = tensors(command)
    for name in before:
        assert torch.equal(after[name][ALL != 3], before[name][ALL != 3]), name
        assert not (name.startswith("state.") and after[name][3].any()), name
    assert not command.jump[3]
    assert 2.0 <= float(command.time_left[3]) <= 6.0


def test_scripted_commands_are_set_by_the_caller_alone() -> None:
    env = training_env.fresh(training_env.nominal(), "jump_a", scripted=True)
    command = motion_command(env)
    velocity = command.velocity
    jump = command.jump
    velocity[:] = torch.rand(N, 3)
    jump[:] = ALL % 2 == 0
    set_velocity = velocity.clone()
    env.episode_length_buf[1] = 10**6  # an episode that ends has no effect either
    for _ in range(3):
        env.step(torch.zeros(N, 12))
    for _ in range(400):
        command.compute(DT)
    command.reset(ALL)
    assert command.velocity is velocity
    assert command.jump is jump
    assert torch.equal(velocity, set_velocity)
    assert jump.tolist() == [i % 2 == 0 for i in range(N)]
    assert not command.state.mode.any(), "jumps under way are cleared all the same"


@pytest.mark.parametrize(
    ("velocity", "overspeed", "target"),
    [
        # .35 m/s more, in proportion below 1 m/s, in the same direction.
        ((2.0, 0.0, 1.0), 0.0, (2.35, 0.0)),
        ((0.0, -0.5, 0.0), 0.0, (0.0, -0.675)),
        ((0.0, 0.0, 1.0), 0.0, (0.0, 0.0)),
        # The overspeed at the command is added.
        ((-1.2, 0.9, 0.0), 0.5, (-1.88, 1.41)),
    ],
)
def test_target_velocity_in_jump_mode(
    command: MotionCommand, monkeypatch: Patch, velocity: Vector, overspeed: float, target: Vector
) -> None:
    monkeypatch.setattr(command.cfg, "jump_speed_added", 0.35)
    command.velocity[:] = torch.tensor(velocity)
    command.state.overspeed = torch.full((N,), overspeed)
    command.state.mode = ALL == 1
    assert command.target[0].tolist() == pytest.approx(list(velocity[:2]))
    assert command.target[1].tolist() == pytest.approx(list(target))
    assert not command.standing.any()
    command.velocity.zero_()
    assert command.standing.tolist() == [i != 1 for i in range(N)]


def received(
    env: Any, monkeypatch: Patch, yaw: float, pitch: float, velocity: Vector
) -> JumpInputs:
    """What the jump state receives of robots with that attitude [deg] and velocity [m/s]."""
    command = motion_command(env)
    received_inputs: list[JumpInputs] = []

    def advance(inputs: JumpInputs, dt: float) -> None:
        received_inputs.append(inputs)

    monkeypatch.setattr(command.state, "advance", advance)
    attitude = Rotation.from_euler("ZY", (yaw, pitch), degrees=True)
    env.sim.data.qpos[:, 3:7] = torch.tensor(attitude.as_quat(scalar_first=True))
    env.sim.data.qvel[:, :3] = torch.tensor(velocity)
    env.common_step_counter += 1
    assert command.motion is command.motion
    return received_inputs[0]


@pytest.mark.parametrize("pitch", [0.0, 50.0])
@pytest.mark.parametrize(
    ("yaw", "velocity", "direction"),
    [
        (0.0, (2.0, 0.0, 0.0), (1.0, 0.0)),
        (90.0, (0.5, 0.0, 1.0), (0.0, 1.0)),
        (90.0, (0.6, 0.8, 0.0), (-0.8, 0.6)),
        (-60.0, (-1.0, 0.0, 0.0), (-0.5, 0.866025)),
        (90.0, (0.0, 0.0, 2.0), (0.0, 0.0)),
    ],
)
def test_direction_of_a_jump_in_the_world(
    env: Any, monkeypatch: Patch, yaw: float, pitch: float, velocity: Vector, direction: Vector
) -> None:
    motion_command(env).velocity[:] = torch.tensor(velocity)
    inputs = received(env, monkeypatch, yaw, pitch, (0.0, 0.0, 0.0))
    np.testing.assert_allclose(inputs.direction, [direction] * N, atol=1e-5)
    assert inputs.feet is motion_command(env).motion.legs.foot_position


@pytest.mark.parametrize(
    ("commanded", "moves", "pitch", "jumps", "expected"),
    [
        # With .25 added the target is 2.25 m/s, and `along` goes up to it.
        ((2.0, 0.0), (3.0, 1.0, 0.0), 0.0, True, (2.25, 1.0, math.hypot(0.75, 1.0))),
        ((2.0, 0.0), (3.0, 1.0, 0.0), 0.0, False, (2.0, 1.0, math.hypot(1.0, 1.0))),
        ((0.0, -0.5), (1.0, -0.4, 0.0), 0.0, True, (0.4, -0.1, math.hypot(1.0, 0.225))),
        ((-1.0, 0.0), (0.5, 0.0, 0.0), 0.0, True, (-0.5, -1.5, 1.75)),
        ((0.0, 0.0), (1.0, 1.0, 0.0), 0.0, True, (0.0, 0.0, math.sqrt(2.0))),
        # Upward motion of a pitched trunk is no forward motion.
        ((1.0, 0.0), (1.0, 0.0, 2.5), 17.0, False, (1.0, 0.0, 0.0)),
        ((-2.0, 0.0), (1.0, 0.0, 2.5), -17.0, False, (-1.0, -3.0, 3.0)),
    ],
)
def test_speed_along_the_command(
    env: Any,
    monkeypatch: Patch,
    commanded: Vector,
    moves: Vector,
    pitch: float,
    jumps: bool,
    expected: Vector,
) -> None:
    command = motion_command(env)
    monkeypatch.setattr(command.cfg, "jump_speed_added", 0.25)
    command.state.mode[:] = jumps
    command.velocity[:] = torch.tensor((*commanded, 1.5))
    inputs = received(env, monkeypatch, 0.0, pitch, moves)
    speeds = torch.stack([inputs.along, inputs.excess, inputs.velocity_error], dim=1)
    np.testing.assert_allclose(speeds, [expected] * N, atol=1e-5)
