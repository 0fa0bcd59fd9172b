"""A run resumes from its last checkpoint, also after kill -9."""

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

import torch
from mjlab.utils.os import get_checkpoint_path
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import small_run
from pronk.errors import ArtefactError, PronkError
from pronk.train.mdp.commands import motion_command
from pronk.train.runner import checkpoint

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
    if type(a) is not type(b) and not (isinstance(a, dict) and isinstance(b, dict)):
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


def test_a_resumed_run_has_networks_optimizers_and_counters(whole: Any, other: Any) -> None:
    path = checkpoint.numbered(whole.folder, 2)
    found = checkpoint.load(path)
    other.load(path)
    assert differences(other.alg.save(), found.tree["algorithm"]) == []
    assert float(other.alg.learning_rate) == found.tree["learning_rate"]
    assert motion_command(other.env.unwrapped).ranges.grown == found.tree["speed_ranges"]
    other.learn(2, init_at_random_ep_len=True)
    ended = checkpoint.load(checkpoint.numbered(other.folder, 4)).about
    assert ended["iteration"] == 4
    assert ended["env_steps"] == 4 * small_run.STEPS * small_run.ROBOTS


def test_tensorboard_has_every_iteration(whole: Any) -> None:
    events = EventAccumulator(str(whole.folder)).Reload()
    for name in ("Train/mean_reward", "Train/non_finite", "Loss/estimator_contact"):
        assert [scalar.step for scalar in events.Scalars(name)][:4] == [1, 2, 3, 4]
    rewards = [scalar.value for scalar in events.Scalars("Train/mean_reward")]
    assert rewards[3] == pytest.approx(whole.figures["Train/mean_reward"])


def test_mjlab_finds_the_checkpoints(whole: Any) -> None:
    found = get_checkpoint_path(whole.folder.parent, whole.folder.name, "model_.*.pt")
    assert found == checkpoint.latest(whole.folder)


def test_playing_takes_the_actor_and_leaves_the_rest(whole: Any, other: Any) -> None:
    """As mjlab's `play` loads a checkpoint."""
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
