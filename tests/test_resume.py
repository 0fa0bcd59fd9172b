"""A resumed run is the same run: bit for bit on Warp's CPU device, also after kill -9."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("mjlab")

import mujoco
import torch
from mjlab.utils.os import get_checkpoint_path
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import small_run
from pronk.errors import ArtefactError, PronkError
from pronk.train.runner import checkpoint
from pronk.train.runner.state import (
    INTEGRATION,
    environment_state,
    random_state,
    restore_environment,
    restore_random,
)

pytestmark = [pytest.mark.train, pytest.mark.slow]

SHORT_S = 300.0
"""More than anything here takes on a busy machine [s]."""


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """`small_run.build` sets one thread; other tests get theirs back."""
    threads = torch.get_num_threads()
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A run of four iterations, never interrupted; saves after 2 and 4."""
    runner = small_run.build(tmp_path_factory.mktemp("whole"), seed=5)
    runner.learn(4, init_at_random_ep_len=True)
    return runner


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Another run: its robots, networks and commands were drawn from another seed."""
    return small_run.build(tmp_path_factory.mktemp("other"), seed=77)


def differences(a: Any, b: Any, name: str = "") -> list[str]:
    """Paths at which two trees differ in anything."""
    if type(a) is not type(b):
        return [name]
    if isinstance(a, dict):
        unshared = [f"{name}/{key}" for key in a.keys() ^ b.keys()]
        return unshared + [
            d for key in a.keys() & b.keys() for d in differences(a[key], b[key], f"{name}/{key}")
        ]
    if isinstance(a, (list, tuple)):
        if len(a) != len(b):
            return [name]
        pairs = enumerate(zip(a, b, strict=True))
        return [d for i, (x, y) in pairs for d in differences(x, y, f"{name}/{i}")]
    if isinstance(a, (torch.Tensor, np.ndarray)):
        return [] if np.array_equal(np.asarray(a), np.asarray(b), equal_nan=True) else [name]
    return [] if a == b or (a != a and b != b) else [name]


def test_the_resumed_run_is_the_uninterrupted_one(whole: Any, other: Any) -> None:
    other.load(checkpoint.numbered(whole.folder, 2))
    # mjlab's own `train --agent.resume` asks for this whenever it trains.
    other.learn(2, init_at_random_ep_len=True)
    ended, resumed = (checkpoint.load(checkpoint.numbered(r.folder, 4)) for r in (whole, other))
    # Weights, optimizers, statistics, estimator, environment, generators and counters at once.
    assert differences(ended.tree, resumed.tree) == []
    for name in ("iteration", "phase", "envs", "env_steps"):
        assert ended.about[name] == resumed.about[name]
    assert ended.about["env_steps"] == 4 * small_run.STEPS * small_run.ROBOTS
    assert whole.figures.keys() == other.figures.keys()
    learned = {key for key in whole.figures if not key.startswith("Perf/")}
    assert all(whole.figures[key] == other.figures[key] for key in learned)


def test_tensorboard_has_every_iteration(whole: Any) -> None:
    events = EventAccumulator(str(whole.folder)).Reload()
    for name in ("Train/mean_reward", "Train/non_finite", "Loss/estimator_contact"):
        assert [scalar.step for scalar in events.Scalars(name)][:4] == [1, 2, 3, 4]
    rewards = [scalar.value for scalar in events.Scalars("Train/mean_reward")]
    assert rewards[3] == pytest.approx(whole.figures["Train/mean_reward"])


def test_mjlab_finds_the_checkpoints(whole: Any) -> None:
    found = get_checkpoint_path(whole.folder.parent, whole.folder.name, "model_.*.pt")
    assert found == checkpoint.latest(whole.folder)


def test_something_was_learned_and_drawn_in_between(whole: Any) -> None:
    """So that equality above says something."""
    half, ended = (checkpoint.load(checkpoint.numbered(whole.folder, n)).tree for n in (2, 4))
    changed = differences(half, ended)
    weights = [
        f"/algorithm/actor_state_dict/{name}" for name, _ in whole.alg.actor.named_parameters()
    ]
    assert set(weights) <= set(changed)
    for part in (
        "/algorithm/actor_state_dict/obs_normalizer._mean",
        "/algorithm/estimator_optimizer_state_dict/state/0/exp_avg",
        "/ranks/0/random/torch",
        "/ranks/0/environment/physics/data/qpos",
        "/ranks/0/environment/observation_manager/_obs_buffer/measured",
        "/ranks/0/environment/counter/episode_length_buf",
    ):
        assert part in changed


def test_a_step_after_restoring_is_the_step_not_interrupted(whole: Any, other: Any) -> None:
    env, its = whole.env.unwrapped, other.env.unwrapped
    state, drawn = environment_state(env), random_state("cpu")
    actions = [torch.randn(small_run.ROBOTS, 12) for _ in range(25)]

    def steps(env: Any) -> list[Any]:
        restore_random(drawn, "cpu")
        made = []
        for action in actions:
            observations, reward, terminated, truncated, _ = env.step(action)
            ended = (terminated | truncated).clone()
            made.append([dict(observations), reward.clone(), ended, environment_state(env)])
        return made

    restore_environment(its, state)
    assert differences(environment_state(its), state) == []
    expected = steps(env)
    assert differences(steps(its), expected) == []
    assert any(bool(step[2].any()) for step in expected)  # over resets, too


def test_tensors_stay_where_they_are(whole: Any, other: Any) -> None:
    """CUDA graphs and fused drives go on reading the memory they were built with."""
    env = other.env.unwrapped
    drive = env.scene["robot"].actuators[0]
    tensors = {
        "drive": drive.stiffness,
        "counter": env.episode_length_buf,
        "mass": env.sim.model.body_mass[:],
        "position": env.sim.data.qpos[:],
    }
    before = {name: tensor.data_ptr() for name, tensor in tensors.items()}
    restore_environment(env, environment_state(whole.env.unwrapped))
    after = {
        "drive": drive.stiffness,
        "counter": env.episode_length_buf,
        "mass": env.sim.model.body_mass[:],
        "position": env.sim.data.qpos[:],
    }
    assert {name: tensor.data_ptr() for name, tensor in after.items()} == before
    assert torch.equal(drive.stiffness, whole.env.unwrapped.scene["robot"].actuators[0].stiffness)


def test_the_whole_integration_state_is_saved(whole: Any) -> None:
    """MuJoCo says how many numbers that is; a field it adds would be missed here."""
    sim = whole.env.unwrapped.sim
    state = environment_state(whole.env.unwrapped)
    saved = [
        state[f"physics/data/{name}"] for name in INTEGRATION if f"physics/data/{name}" in state
    ]
    size = mujoco.mj_stateSize(sim.mj_model, mujoco.mjtState.mjSTATE_INTEGRATION)
    assert sum(tensor[0].numel() for tensor in saved) == size


def test_refuses_the_state_of_another_environment(whole: Any) -> None:
    env = whole.env.unwrapped
    state = environment_state(env)
    length = "counter/episode_length_buf"
    with pytest.raises(ArtefactError, match="of 3 environments, this run has 16"):
        restore_environment(env, {**state, length: state[length][:3]})
    lost = "command_manager/_terms/motion/velocity"
    with pytest.raises(ArtefactError, match=f"lacks what this environment has \\({lost}"):
        restore_environment(env, {k: v for k, v in state.items() if k != lost})
    with pytest.raises(ArtefactError, match=r"holds what this environment lacks \(term/x"):
        restore_environment(env, {**state, "term/x": 1.0})
    with pytest.raises(ArtefactError, match=r"velocity is torch.float64 \(16, 3\)"):
        restore_environment(env, {**state, lost: state[lost].double()})


def test_playing_takes_the_actor_and_leaves_the_rest(whole: Any, other: Any) -> None:
    """As mjlab's `play` loads a checkpoint."""
    random = random_state("cpu")
    critic = other.alg.critic.state_dict()["mlp.0.weight"].clone()
    with torch.no_grad():
        for parameter in other.alg.actor.parameters():
            parameter.zero_()
    iteration = other.current_learning_iteration
    path = checkpoint.numbered(whole.folder, 2)
    other.load(str(path), load_cfg={"actor": True}, strict=True, map_location="cpu")
    actor = checkpoint.load(path).tree["algorithm"]["actor_state_dict"]
    assert differences(dict(other.alg.actor.state_dict()), actor) == []
    assert torch.equal(other.alg.critic.state_dict()["mlp.0.weight"], critic)
    assert other.current_learning_iteration == iteration
    assert differences(random_state("cpu"), random) == []


def test_refuses_networks_of_another_shape(whole: Any, tmp_path: Path) -> None:
    path = checkpoint.numbered(whole.folder, 4)
    found = checkpoint.load(path)
    actor = found.tree["algorithm"]["actor_state_dict"]
    actor["mlp.2.weight"] = torch.zeros(3, 3)
    odd = tmp_path / "odd.pt"
    checkpoint.save(odd, found)
    with pytest.raises(ArtefactError, match=r"odd.pt: its networks are not those of this run"):
        whole.load(odd)
    whole.load(path)


def test_a_signal_ends_the_run_after_the_iteration_with_a_checkpoint(whole: Any) -> None:
    whole.load(checkpoint.numbered(whole.folder, 4))
    handler = signal.getsignal(signal.SIGTERM)
    seen: list[int] = []

    def ask(runner: Any) -> None:
        seen.append(runner.current_learning_iteration)
        os.kill(os.getpid(), signal.SIGTERM)

    whole.learn(5, on_iteration=ask)
    assert seen == [5]
    assert whole.stopped == "SIGTERM"
    assert checkpoint.about(checkpoint.latest(whole.folder) or Path())["iteration"] == 5
    assert signal.getsignal(signal.SIGTERM) is handler


def test_physics_gone_wrong_stops_a_robot_not_the_run(whole: Any) -> None:
    whole.load(checkpoint.numbered(whole.folder, 4))
    counted = whole.non_finite
    velocity = whole.env.unwrapped.sim.data.qvel
    velocity[3, 7] = float("nan")
    velocity[11, 0] = float("inf")
    whole.learn(1)
    assert whole.non_finite == counted + 2
    assert whole.figures["Train/non_finite"] == counted + 2
    assert checkpoint.not_finite(whole.alg.save()) is None
    assert bool(torch.isfinite(velocity[:]).all())


def test_learning_that_diverges_ends_with_the_last_good_checkpoint_named(whole: Any) -> None:
    last = checkpoint.latest(whole.folder)
    whole.load(last)
    with torch.no_grad():
        whole.alg.critic.mlp[0].weight[0, 0] = float("nan")
    with pytest.raises(PronkError, match=r"critic_state_dict/mlp\.0\.weight is not finite"):
        whole.save(whole.folder / "model_900.pt")
    with pytest.raises(PronkError, match=f"learning diverged in iteration .*{last} is the last"):
        whole.learn(1)
    assert checkpoint.latest(whole.folder) == last
    whole.load(last)


def test_killed_while_it_writes_a_run_loses_one_save_interval(whole: Any, tmp_path: Path) -> None:
    program = [sys.executable, small_run.__file__, str(tmp_path)]
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen(program, stdout=log, stderr=log)
    try:
        # A name that begins with a dot is a checkpoint that is being written.
        finished, deadline = 0, time.monotonic() + SHORT_S
        while True:
            assert process.poll() is None, (tmp_path / "log").read_text()[-2000:]
            assert time.monotonic() < deadline
            last = checkpoint.latest(tmp_path)
            finished = int(last.stem.removeprefix("model_")) if last else 0
            if finished >= 2 and list(tmp_path.glob(".model_*")):
                break
            time.sleep(0.001)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    last = checkpoint.latest(tmp_path)
    assert last is not None
    found = checkpoint.load(last)
    assert found.about["iteration"] >= finished  # saved after every iteration: at most one is lost
    folder, whole.folder = whole.folder, tmp_path
    try:
        whole.load(last)
        whole.learn(1)
    finally:
        whole.folder = folder
    assert checkpoint.about(checkpoint.latest(tmp_path) or Path())["iteration"] == (
        found.about["iteration"] + 1
    )
    assert not list(tmp_path.glob(".model_*"))
