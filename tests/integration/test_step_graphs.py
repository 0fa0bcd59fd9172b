"""What is recorded of a step gives the numbers that it gives without a recording."""

from __future__ import annotations

import math
import statistics
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")
from mjlab.envs import ManagerBasedRlEnv
from mjlab.managers import RewardTermCfg, TerminationTermCfg
from tensordict import TensorDict

import training_env
from pronk.jump.train import compiled
from pronk.jump.train.mdp import commands, reward_manager
from pronk.jump.train.mdp.commands import motion_command
from pronk.jump.train.mdp.reward_manager import StackedRewardManager
from pronk.jump.train.mdp.step_graphs import StepGraphs
from pronk.jump.train.phases import PHASES, curriculum
from pronk.jump.train.tasks.jump_env_cfg import draw_weak_drives
from pronk.jump.trial.training_sim.adapter import load_evaluated_policy
from traced_graph import TracedGraph

pytestmark = pytest.mark.train

ROBOTS = 16
MANY = 1024
"""Robots on a GPU, where a fifth of their scatter is seen in a mean."""
STEPS = {"walk": 12, "jump_a": 12, "jump_b": 60}
"""Policy steps in each phase, in iterations of twelve; a jump takes most of the last phase."""
POLICY = Path(__file__).parents[2] / "policies" / "matched" / "policy.onnx"


def rollout(
    *, device: str, records: bool, robots: int = ROBOTS, ends_in_every_step: bool = False
) -> list[dict[str, Any]]:
    """Step robots through all phases, with jumps, pushes, falls and empty batteries.

    Episodes of ten in sixteen robots end early; the others jump as the policy does. Without
    `ends_in_every_step` no episode ends in some steps, and no number is drawn for its start.
    """
    cfg = training_env.config(robots, training_env.MATCHED)
    draw_weak_drives(cfg, 0.7)
    cfg.events["push"].params["interval_s"] = (0.05, 0.2)
    cfg.commands["motion"].resampling_time_range = (0.1, 0.3)
    cfg.commands["motion"].jump_off_s = (0.05, 0.2)
    cfg.curriculum["phases"].params["steps_per_iteration"] = 10**9  # phases are set below
    env = ManagerBasedRlEnv(cfg, device=device)
    StackedRewardManager.install(env)
    graphs = StepGraphs(env) if records else None
    obs, _ = env.reset(seed=0)
    policy = load_evaluated_policy(POLICY, device)
    history = []
    for phase, steps in STEPS.items():
        with torch.inference_mode():
            for step in range(steps):
                if step % 12 == 0:
                    curriculum(env).apply(env, PHASES[phase], step / steps)
                    if graphs is not None:
                        graphs.begin()
                if step % 4 < 2:  # in the first two steps of an iteration, too
                    ended = step % ROBOTS // 2
                    for robot in range(ended, ended + 3):
                        env.episode_length_buf[robot::ROBOTS] = 10**6  # episodes end
                    env.sim.data.qpos[2::ROBOTS, 4] = 1.0  # these robots lie on their sides
                elif ends_in_every_step:
                    env.episode_length_buf[0::ROBOTS] = 10**6
                actions = policy.act(TensorDict(obs, batch_size=[robots]))
                obs, reward, terminated, _, extras = env.step(actions)
                history.append(
                    {
                        **{name: group.clone() for name, group in obs.items()},
                        "reward": reward.clone(),
                        "terminated": terminated.clone(),
                        "torque": env.sim.data.ctrl[:].clone(),
                        "mode": motion_command(env).state.mode.clone(),
                        "lift-offs": motion_command(env).state.liftoffs.clone(),
                        **{name: torch.as_tensor(x) for name, x in extras["log"].items()},
                    }
                )
    env.close()
    return history


def test_a_recorded_step_is_the_step_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    """With graphs that are traced on the CPU, where what is drawn is the same in any order."""
    expected = rollout(device="cpu", records=False)
    monkeypatch.setattr(compiled.RecordedFunction, "graph_type", TracedGraph)
    for module in (commands, reward_manager):
        monkeypatch.setattr(module, "compiled_step", lambda function: function)
    recorded = rollout(device="cpu", records=True)
    for step, (before, after) in enumerate(zip(expected, recorded, strict=True)):
        assert before.keys() == after.keys()
        for name, value in before.items():
            error = (after[name].double() - value.double()).abs().max()
            assert error <= 1e-5 * (1.0 + value.double().abs().max()), (step, name)
    assert max(float(step["terminated"].sum()) for step in expected) >= 1.0
    assert max(float(step["mode"].float().mean()) for step in expected) > 0.1
    assert max(float(step["lift-offs"].max()) for step in expected) >= 1.0


def steps_so_far(env: ManagerBasedRlEnv) -> Any:
    """A reward of somebody else's, of a number that Python counts."""
    return torch.full((ROBOTS,), float(env.common_step_counter), device=env.device)


def never(env: ManagerBasedRlEnv) -> Any:
    """A termination of somebody else's."""
    return torch.zeros(ROBOTS, dtype=torch.bool, device=env.device)


def test_terms_of_somebody_else_are_computed_in_every_step(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A recording would go on with the number of the step in which it was made."""
    monkeypatch.setattr(compiled.RecordedFunction, "graph_type", TracedGraph)
    for module in (commands, reward_manager):
        monkeypatch.setattr(module, "compiled_step", lambda function: function)
    cfg = training_env.config(ROBOTS, training_env.MATCHED)
    cfg.rewards["steps"] = RewardTermCfg(func=steps_so_far, weight=2.0)
    cfg.terminations["never"] = TerminationTermCfg(func=never)
    env = ManagerBasedRlEnv(cfg, device="cpu")
    StackedRewardManager.install(env)
    graphs = StepGraphs(env)
    assert graphs.left_out == ["rewards (steps)", "terminations (never)"]
    env.reset(seed=0)
    graphs.begin()
    with torch.inference_mode():
        for step in range(1, 6):
            env.step(torch.zeros(ROBOTS, 12))
            rewards = dict(env.reward_manager.get_active_iterable_terms(0))
            assert rewards["steps"] == [2.0 * step]
    env.close()


class NoGraph(compiled.DeviceGraph):
    """Records nothing."""

    @staticmethod
    def records(device: str) -> bool:
        return False


def standard_error(plain: Any, recorded: Any) -> float:
    """Return the standard error of the difference of two means over robots, the largest of all."""
    squares = (plain.var(dim=0) + recorded.var(dim=0)) / len(plain)
    return float(squares.max().sqrt())


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU of NVIDIA")
@pytest.mark.parametrize("is_compiled", [True, False])
def test_cuda_graphs_give_the_same_step(
    monkeypatch: pytest.MonkeyPatch, *, is_compiled: bool
) -> None:
    """Against steps that are only compiled, and steps as they are.

    Physics rounds otherwise in each run on a GPU, which grows where feet slip: some robots differ,
    most do not, and means over robots differ by less than robots scatter, as do means of the log
    over the steps. Episodes end in every step: in one in which a robot falls in one run alone, that
    run alone would draw a new start, and all noise after it would differ.
    """
    size: dict[str, Any] = {"robots": MANY, "ends_in_every_step": True}
    recorded_steps = rollout(device="cuda:0", records=True, **size)
    monkeypatch.setattr(compiled.RecordedFunction, "graph_type", NoGraph)
    plain_steps = rollout(device="cuda:0", records=is_compiled, **size)
    logs: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for step, (before, after) in enumerate(zip(plain_steps, recorded_steps, strict=True)):
        if is_compiled:
            assert before.keys() == after.keys()
        for name, measured in before.items():
            if measured.ndim == 0:
                # A mean over the few robots whose episodes end; one that slips changes it.
                if name in after:
                    logs[name].append((float(measured), float(after[name])))
                continue
            plain = measured.double()
            recorded = after[name].double()
            tolerance = 1e-3 * (1.0 + plain.abs().mean())
            assert (recorded - plain).abs().median() <= tolerance, (step, name)
            difference = (recorded.mean(dim=0) - plain.mean(dim=0)).abs().max()
            tolerance += 5.0 * standard_error(plain, recorded)
            assert difference <= tolerance, (step, name)
    assert logs
    for name, pairs in logs.items():
        differences = [recorded - plain for plain, recorded in pairs]
        mean_size = statistics.mean(abs(plain) for plain, _ in pairs)
        error = statistics.stdev(differences) / math.sqrt(len(differences))
        assert abs(statistics.mean(differences)) <= 0.02 * mean_size + 5.0 * error + 1e-6, name
    assert max(float(step["lift-offs"].max()) for step in plain_steps) >= 1.0


def test_all_tensors_of_jumps_and_motion_are_kept() -> None:
    """What is copied for recordings is all that there is."""
    env = training_env.nominal()
    command = motion_command(env)
    motion = command.motion
    for part in (motion.joints, motion.trunk, motion.legs, command.state):
        kept = command.state.tensors() if part is command.state else motion.tensors()
        for name, value in vars(part).items():
            if isinstance(value, torch.Tensor):
                assert any(value is tensor for tensor in kept), name
