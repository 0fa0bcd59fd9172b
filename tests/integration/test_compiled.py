"""`--compile`: the same numbers but for rounding, and nothing compiled twice as phases go on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")
from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks.registry import load_rl_cfg
from torch._inductor import config as inductor_config

import ppo_case
import training_env
from pronk.cli import main as cli
from pronk.jump.train.gains import training_gains
from pronk.jump.train.mdp.commands import motion_command
from pronk.jump.train.mdp.reward_manager import StackedRewardManager
from pronk.jump.train.mdp.step_graphs import StepGraphs
from pronk.jump.train.phases import PHASES, curriculum
from pronk.jump.train.provenance import RunFolder

pytestmark = [pytest.mark.train, pytest.mark.slow]

ROUNDING = 1e-5
"""Largest difference of results that should be alike but for rounding, of the order of 1."""
STEPS = 6
"""Policy steps in each phase."""
BEGINS_ANEW = (1, 4)
"""Robots whose episode ends in the middle of each phase."""
ROBOTS = 8
"""Robots of all tests: what is compiled for one of them need not be compiled for the next."""


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    """Batches this small lose more by waiting for each other's threads than they gain."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def plain_kernels() -> Iterator[None]:
    """Generate kernels without vector instructions, and compile them without processes beside this.

    What is traced and which kernels come of it stays; the C++ compiler has a fourth less to do.
    """
    with inductor_config.patch({"cpp.simdlen": 1, "compile_threads": 1}):
        yield


def rewards_of_all_phases(*, compiles: bool) -> list[Any]:
    """Step robots through all phases with jumps; returns the rewards of each step."""
    gains = training_gains("naive", training_env.ROBOT)
    env = ManagerBasedRlEnv(training_env.config(ROBOTS, gains), device="cpu")
    StackedRewardManager.install(env)
    command = motion_command(env)
    if compiles:
        StepGraphs(env)
    env.reset(seed=0)
    rewards: list[Any] = []
    generator = torch.Generator().manual_seed(1)
    for phase in PHASES.values():
        # All that is to be compiled is compiled in the first phase.
        is_strict = compiles and len(rewards) > 0
        with torch.inference_mode(), torch._dynamo.config.patch(error_on_recompile=is_strict):
            for step in range(STEPS):
                curriculum(env).apply(env, phase, step / STEPS)
                if step == STEPS // 2:
                    env.reset(env_ids=torch.tensor(BEGINS_ANEW))
                actions = torch.randn(ROBOTS, 12, generator=generator)
                _, reward, *_ = env.step(0.3 * actions)
                rewards.append(reward.clone())
                if phase.jump and step == STEPS // 2:
                    for robot, is_jumping in enumerate(command.state.mode.tolist()):
                        assert is_jumping == (robot not in BEGINS_ANEW)
                command.jump[:] = phase.jump and step > 0
    env.close()
    return rewards


def test_compiled_rewards_are_the_same_in_every_phase() -> None:
    """Weights, jump scales, lift-off kernel and step length change without compiling again."""
    plain = rewards_of_all_phases(compiles=False)
    fast = rewards_of_all_phases(compiles=True)
    for step, (expected, reward) in enumerate(zip(plain, fast, strict=True)):
        assert reward.tolist() == pytest.approx(expected.tolist(), abs=ROUNDING), step
    assert torch.stack(plain).std() > 0.01


def test_a_compiled_run_is_exported_and_says_so(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    arguments = ["walk", "--gains", "naive", "--phase", "walk=1", "--envs", str(ROBOTS)]
    arguments += ["--device", "cpu", "--compile", "--out", str(folder.path)]
    assert cli.run(["train", *arguments]) == 0
    record = folder.read()
    assert record["finished"]
    assert [session["compiled"] for session in record["sessions"]] == [True]
    assert (folder.path / "policy.onnx").is_file()


def updated(compile_mode: str | None) -> tuple[Any, dict[str, float]]:
    """Learn from one rollout of random observations, with a rate that follows the divergence.

    Sizes and settings are those of the run above, for which all of it is compiled already.
    """
    environment = training_env.nominal()
    torch.manual_seed(2)
    learning = asdict(load_rl_cfg("Pronk-Walk-MiniCheetah"))
    algorithm = ppo_case.build(
        compile_mode=compile_mode,
        robots=ROBOTS,
        steps=learning["num_steps_per_env"],
        environment=environment,
        hidden=learning["actor"]["hidden_dims"],
        **learning["algorithm"],
    )
    ppo_case.roll_out(algorithm)
    return algorithm, algorithm.update()


def test_a_compiled_update_is_that_of_rsl_rl() -> None:
    plain, plain_losses = updated(None)
    fast, fast_losses = updated("default")
    assert fast.is_compiled
    assert not plain.is_compiled
    for name in ("surrogate", "value", "entropy"):
        assert fast_losses[name] == pytest.approx(plain_losses[name], abs=ROUNDING), name
    assert fast.learning_rate == pytest.approx(plain.learning_rate)
    assert plain.learning_rate != 1e-3  # it was adapted
    # Adam divides by the size of a gradient: where it is all but zero, rounding is magnified.
    expected = torch.nn.utils.parameters_to_vector(plain._raw_critic.parameters())
    weights = torch.nn.utils.parameters_to_vector(fast._raw_critic.parameters())
    assert (weights - expected).abs().median() < ROUNDING
    # What was saved is read without --compile, and the other way round.
    plain.load(fast.save())
    assert isinstance(plain.learning_rate, float)


def test_a_configuration_that_is_not_known_is_left_as_it_is() -> None:
    algorithm = ppo_case.build(compile_mode="default", use_clipped_value_loss=True)
    assert not algorithm.is_compiled
    ppo_case.learn(algorithm)
