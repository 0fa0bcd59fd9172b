"""The phases of training, as the environment has them."""

from __future__ import annotations

from typing import Any

import pytest

pytest.importorskip("mjlab")

import torch

import training_env
from pronk.errors import PronkError
from pronk.jump.train.mdp.commands import motion_command
from pronk.jump.train.phases import PHASES, TASKS, curriculum, phase_at
from pronk.jump.train.tasks.reward_weights import reward_weights
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
    assert term("jump_height").weight == pytest.approx(weight)
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
