"""The phases of training, as the environment has them."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("mjlab")

import torch

import training_env
from pronk.errors import PronkError
from pronk.jump.train.mdp.actions import joint_position_action
from pronk.jump.train.mdp.commands import motion_command
from pronk.jump.train.mdp.guidance import foot_sweep
from pronk.jump.train.mdp.jump import JumpSettings
from pronk.jump.train.mdp.motion import standing_leg
from pronk.jump.train.phases import PHASES, TASKS, curriculum, phase_at
from pronk.jump.train.tasks.reward_weights import reward_weights
from pronk.robots.legged import legged
from training_env import N

pytestmark = pytest.mark.train


@pytest.fixture
def env() -> Any:
    return training_env.fresh(training_env.nominal())


@pytest.mark.parametrize(
    ("task", "iteration", "expected"),
    [
        ("jump", 0, ("walk", 0.0)),
        ("jump", 299, ("walk", 299 / 300)),
        ("jump", 300, ("jump_a", 0.0)),
        ("jump", 800, ("jump_b", 0.5)),
        ("jump", 5000, ("jump_b", 1.0)),
        ("walk", 300, ("walk", 1.0)),
        ("together", 0, ("jump_a", 0.0)),
        ("together", 520, ("jump_b", 0.0)),
        ("together", 1079, ("jump_b", 559 / 560)),
    ],
)
def test_phase_of_an_iteration(task: str, iteration: int, expected: tuple[str, float]) -> None:
    assert phase_at(TASKS[task], iteration) == expected
    with pytest.raises(PronkError, match="0 iterations"):
        phase_at(dict.fromkeys(PHASES, 0), iteration)


@pytest.mark.parametrize(
    ("name", "done", "weight", "scale", "std", "guidance", "noise"),
    [
        ("walk", 0.0, 0.0, 1.0, 1.0, 0.0, float("inf")),
        # .7 + .3 / 4; the guidance falls fast at first.
        ("jump_a", 0.5, 16.0, 1.0, 1.0, 0.775, 0.65),
        ("jump_b", 0.0, 16.0, 1.0, 0.8, 0.7, 0.65),
        # Exponentially in the square: .65 (.2 / .65)^(1/4).
        ("jump_b", 0.5, 13.0, 5.0, 0.525, 0.175, 0.484109),
        ("jump_b", 1.0, 10.0, 9.0, 0.25, 0.0, 0.2),
    ],
)
def test_values_of_a_phase_by_hand(
    env: Any,
    name: str,
    done: float,
    weight: float,
    scale: float,
    std: float,
    guidance: float,
    noise: float,
) -> None:
    """Nothing is left of the phase that was applied before."""
    curriculum(env).apply(env, PHASES["jump_b"], 0.75)
    curriculum(env).apply(env, PHASES[name], done)
    term = env.reward_manager.get_term_cfg
    command = motion_command(env)
    assert term("height_by_speed").weight == pytest.approx(weight)
    assert term("posture").weight == reward_weights()["posture"].weight
    assert term("collision").params["jump_scale"] == pytest.approx(scale)
    assert command.state.liftoff_std == pytest.approx(std)
    assert command.guidance_scale == pytest.approx(guidance)
    assert command.cfg.jump_fraction == (0.0 if name == "walk" else 0.5)
    assert PHASES[name].largest_noise(done) == pytest.approx(noise, rel=1e-5)


@pytest.mark.parametrize("name", PHASES)
def test_the_step_counter_sets_the_phase_and_jump_inputs_are_zero_while_walking(name: str) -> None:
    env = training_env.fresh(training_env.nominal(), name)
    env.reset(env_ids=torch.tensor([0]))
    log = {key: float(value) for key, value in env.extras["log"].items()}
    assert log["Curriculum/phases/phase"] == list(PHASES).index(name)
    assert log["Curriculum/phases/done"] == pytest.approx(0.0, abs=0.01)
    motion_command(env)._jump_left.fill_(3 * env.step_dt)
    jumps_seen = False
    critic_sees_jumps = False
    for _ in range(20):
        groups = env.step(0.2 * torch.rand(N, 12))[0]
        jumps_seen = jumps_seen or bool(groups["jump"].any())
        critic_sees_jumps = critic_sees_jumps or bool(groups["critic_jump"].any())
    assert jumps_seen == (name != "walk")
    assert critic_sees_jumps == (name != "walk")


def test_guidance_is_added_to_the_targets_of_a_commanded_jump() -> None:
    """The offsets run from the step of the command to `prompt_s`, scaled, then end."""
    env = training_env.fresh(training_env.nominal(), "jump_a", scripted=True)
    command = motion_command(env)
    command.jump[:4] = True
    begun = []
    for _ in range(18):
        env.step(torch.zeros(N, 12))
        offsets = command.position_target - command.default_position
        assert not offsets[4:].any()
        begun.append(bool(offsets[0].any()))
    assert sum(begun) <= round(command.cfg.settings.prompt_s / env.step_dt)
    assert (begun[1], begun[-1]) == (True, False)
    curriculum(env).apply(env, PHASES["jump_a"], 1.0)
    command.compute(0.0)
    assert command.guidance_scale == pytest.approx(0.7)


def test_swept_feet_stand_still_on_the_ground(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 2 m/s the foot of the guided leg moves backwards by 2 m/s, below the hip at mid-push."""
    body = legged("mini_cheetah")
    settings = JumpSettings()
    dt = 0.001
    offsets = foot_sweep(body, settings, dt).double()
    steps = round(settings.prompt_s / dt)
    assert offsets.shape == (steps + 1, 12)
    assert not offsets[-1].any()
    # A swept leg is the guided one, turned about its hip; the turn is at 1 m/s.
    time = dt * torch.arange(1, steps + 1, dtype=torch.float64)
    length = standing_leg(body) + settings.countermovement(time)
    pitches = offsets[:-1, [1, 4, 7, 10]]
    assert torch.equal(pitches, pitches[:, :1].expand(-1, 4)), "all legs alike"
    assert not offsets[:, [0, 2, 3, 5, 6, 8, 9, 11]].any()
    ahead = length * torch.tan(pitches[:, 0])
    pushes = time > settings.fall_s
    speed = ahead[pushes].diff() / dt
    torch.testing.assert_close(speed, torch.full_like(speed, -1.0), rtol=0.0, atol=1e-3)
    middle = settings.fall_s + 0.5 * (settings.prompt_s - settings.fall_s)
    assert float(ahead[round(middle / dt) - 1]) == pytest.approx(0.0, abs=2e-3)
    env = training_env.fresh(training_env.nominal(), "jump_a", scripted=True)
    command = motion_command(env)
    command.jump[:2] = True
    command.velocity[0, 0] = 2.0
    action = joint_position_action(env)
    monkeypatch.setattr(command.cfg, "guidance_sweep", 0.0)
    command.compute(0.0)
    plain = action.guidance.clone()
    assert torch.equal(plain[0], plain[1]), "blind to the command"
    monkeypatch.setattr(command.cfg, "guidance_sweep", 0.5)
    command.compute(0.0)
    added = action.guidance - plain
    first = foot_sweep(body, settings, env.step_dt)[0]
    torch.testing.assert_close(added[0], command.guidance_scale * 0.5 * 2.0 * first)
    assert not added[1].any()
