"""`pronk train` and `mjlab train` on Warp's CPU device: 8 robots, an iteration or two a phase."""

from __future__ import annotations

import shutil
import statistics
import subprocess
import sys
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")
import yaml
from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl import RslRlVecEnvWrapper
from mjlab.scripts import train as mjlab_train
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg

from pronk.cli import main as cli
from pronk.files import sha256
from pronk.jump.train.phases import PHASES, TASKS
from pronk.jump.train.provenance import RunFolder
from pronk.jump.train.recipe import load_recipe
from pronk.jump.train.rl import checkpoint
from pronk.jump.train.rl.runner import PronkRunner, mean_log
from pronk.policy.runtime import load_policy
from termination import terminated

pytestmark = [pytest.mark.train, pytest.mark.slow]
of_one_run = pytest.mark.xdist_group("run")
"""Mark of the tests that share `finished_run`: one process has them all."""

GAINS = Path(__file__).parents[2] / "policies" / "gains.yaml"
SMALL = ("--envs", "8", "--device", "cpu", "--save-interval", "1")
ALL = ("all", "--gains", str(GAINS), *SMALL)
ITERATIONS = {"walk": 2, "jump_a": 1, "jump_b": 1}
SHORT = ("--phase", "walk=2", "--phase", "jump_a=1", "--phase", "jump_b=1")


@pytest.fixture(autouse=True)
def one_thread() -> Any:
    """Batches this small lose more by waiting for each other's threads than they gain."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def train(*arguments: str | Path) -> int:
    """Run `pronk train`; returns its exit status."""
    return cli.run(["train", *[str(argument) for argument in arguments]])


@pytest.fixture(scope="module")
def finished_run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A run through all phases."""
    torch.set_num_threads(1)
    folder = RunFolder(tmp_path_factory.mktemp("train") / "all")
    assert train(*ALL, *SHORT, "--out", folder.path) == 0
    return folder


@of_one_run
def test_a_run_writes_policies_checkpoints_and_provenance(finished_run: RunFolder) -> None:
    walk = load_policy(finished_run.path / "walk.onnx").contract
    jump = load_policy(finished_run.path / "policy.onnx").contract
    assert not walk.jump
    assert jump.jump
    assert walk.provenance["phases"] == {"walk": 2}
    assert jump.provenance["phases"] == ITERATIONS
    assert jump.gains_sha256 == walk.gains_sha256 != ""
    record = finished_run.read()
    assert record["finished"]
    assert record["gains"]["virtual"]
    for name, iterations in ITERATIONS.items():
        phase = record["phases"][name]
        assert phase["iterations"] == iterations
        assert phase["env_steps"] == iterations * 24 * 8
        assert phase.get("onnx_difference", 0.0) < 1e-5
        assert (
            name in checkpoint.read_checkpoint(finished_run.path / f"{name}.pt")["infos"]["phases"]
        )
    assert not checkpoint.uses_jump_input(checkpoint.read_checkpoint(finished_run.path / "walk.pt"))
    assert checkpoint.latest_checkpoint(finished_run.path) == finished_run.path / "model_3.pt"
    assert len(checkpoint.numbered_checkpoints(finished_run.path)) == 3
    assert (finished_run.gains).read_bytes() == GAINS.read_bytes()
    assert record["sessions"][0]["versions"]["torch"] == torch.__version__
    assert any(finished_run.path.glob("events.out.*"))


def test_layers_of_a_recipe_train_as_the_merged_file_does(tmp_path: Path) -> None:
    """The run keeps one file, whose hash is in the policy, and which trains the same again."""
    first = tmp_path / "first.yaml"
    second = tmp_path / "second.yaml"
    first.write_text("schema: pronk/recipe/1\nrewards: {posture: -9, slip: 0}\n")
    second.write_text("schema: pronk/recipe/1\nrewards: {posture: {walk: [-2, -1]}}\n")
    words = ("walk", "--gains", "naive", *SMALL, "--phase", "walk=1")
    merged = RunFolder(tmp_path / "merged")
    assert train(*words, "--recipe", first, "--recipe", second, "--out", merged.path) == 0
    record = merged.read()
    assert [layer["file"] for layer in record["recipe"]["layers"]] == [first.name, second.name]
    assert record["recipe"]["weights"]["posture"]["walk"] == [-2.0, -1.0]
    assert record["recipe"]["weights"]["posture"]["jump_a"] == [-9.0, -9.0]
    digest = sha256(merged.recipe)
    assert load_policy(merged.path / "policy.onnx").contract.provenance["recipe_sha256"] == digest
    assert record["recipe"]["sha256"] == digest
    assert train("walk", "--resume", "--out", merged.path) == 0
    assert train("walk", "--resume", "--out", merged.path, "--recipe", second) == 2
    again = RunFolder(tmp_path / "again")
    assert train(*words, "--recipe", merged.recipe, "--out", again.path) == 0
    assert again.recipe.read_bytes() == merged.recipe.read_bytes()
    assert again.read()["recipe"] == record["recipe"]
    states = [checkpoint.read_checkpoint(run.path / "walk.pt") for run in (merged, again)]
    weights = [state["actor_state_dict"] for state in states]
    for name, tensor in weights[0].items():
        assert torch.equal(tensor, weights[1][name]), name
    # Without the second layer it is another training.
    other = RunFolder(tmp_path / "other")
    assert train(*words, "--recipe", first, "--out", other.path) == 0
    assert other.recipe.read_bytes() == first.read_bytes()
    assert other.read()["recipe"]["sha256"] == sha256(first)
    changed = checkpoint.read_checkpoint(other.path / "walk.pt")["actor_state_dict"]
    assert any(not torch.equal(tensor, weights[0][name]) for name, tensor in changed.items())


@of_one_run
def test_a_finished_run_is_not_trained_again(finished_run: RunFolder, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(finished_run.path, copy)
    assert train("all", "--resume", "--out", copy) == 0
    assert len(RunFolder(copy).read()["sessions"]) == 1
    assert train("all", "--resume", "--out", copy, "--seed", "7") == 2
    assert train(*ALL, *SHORT, "--out", copy) == 2


def test_a_stopped_run_is_resumed_from_its_checkpoint(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    words = ("walk", "--gains", "naive", *SMALL, "--phase", "walk=3", "--out", folder.path)
    with terminated(lambda: bool(checkpoint.numbered_checkpoints(folder.path))):
        assert train(*words) == 130
    stopped = folder.read()
    assert not stopped["finished"]
    assert stopped["sessions"][0]["stopped"] == "SIGTERM"
    assert 1 <= checkpoint.read_checkpoint(folder.checkpoint())["iter"] + 1 < 3
    # One that began with joints measured on links, as of runs that have not recorded it.
    folder.write({name: entry for name, entry in stopped.items() if name != "task"})
    assert train("walk", "--resume", "--out", folder.path) == 2
    folder.write(stopped)
    assert train("walk", "--resume", "--out", folder.path) == 0
    record = folder.read()
    assert record["finished"]
    assert record["phases"]["walk"]["iterations"] == 3
    state = checkpoint.read_checkpoint(folder.path / "walk.pt")
    assert state["iter"] == 2
    assert state["infos"]["env_state"]["common_step_counter"] == 3 * 24
    assert not load_policy(folder.path / "policy.onnx").contract.jump


def test_a_run_that_ends_before_its_first_checkpoint_says_why(tmp_path: Path) -> None:
    """As one whose processes are killed before they have written what stopped them."""
    folder = RunFolder(tmp_path / "run")
    words = ("train", "walk", "--gains", "naive", *SMALL, "--phase", "walk=6", "--out", folder.path)
    process = subprocess.Popen(
        [sys.executable, "-m", "pronk", *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    while process.poll() is None:
        if folder.provenance.is_file() and folder.read()["sessions"]:
            break
        time.sleep(0.05)
    process.terminate()
    output, _ = process.communicate()
    assert process.returncode == 130, output
    assert checkpoint.latest_checkpoint(folder.path) is None
    (session,) = folder.read()["sessions"]
    assert session["stopped"] == "SIGTERM"


@of_one_run
def test_a_jump_begins_with_a_walking_policy(finished_run: RunFolder, tmp_path: Path) -> None:
    out = tmp_path / "jump"
    words = ("jump", "--gains", "naive", "--ranges-from", GAINS, *SMALL, "--out", out)
    phases = ("--phase", "jump_a=1", "--phase", "jump_b=1")
    assert train(*words, *phases, "--init-checkpoint", finished_run.path / "policy.onnx") == 2
    assert train(*words, *phases, "--init-checkpoint", finished_run.path / "jump_b.pt") == 2
    assert not out.exists()
    assert train(*words, *phases, "--init-checkpoint", finished_run.path) == 0
    record = RunFolder(out).read()
    assert set(record["phases"]) == {"jump_a", "jump_b"}
    first = checkpoint.read_checkpoint(out / "jump_a.pt")
    assert first["iter"] == TASKS["jump"]["walk"]
    contract = load_policy(out / "policy.onnx").contract
    assert (contract.gains, contract.gains_sha256) == ("naive", "")
    assert contract.provenance["start_sha256"] == record["start_sha256"] != ""


@of_one_run
def test_a_jump_does_not_begin_with_a_policy_of_other_actions(
    finished_run: RunFolder, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The walking policy has the task's 0.35 rad, or by its record 0.42, with which it was begun.

    Runs of earlier versions recorded a scale in their recipe alone.
    """
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text("schema: pronk/recipe/1\ntask: {action_scale: 0.42}\n")
    start = RunFolder(tmp_path / "start")
    start.path.mkdir()
    shutil.copyfile(finished_run.path / "walk.pt", start.path / "walk.pt")
    record = finished_run.read()
    start.write(record | {"task": {"action_scale": 0.42}})
    earlier = RunFolder(tmp_path / "earlier")
    shutil.copytree(start.path, earlier.path)
    del record["task"]
    earlier.write(record | {"recipe": load_recipe(recipe).record()})
    out = tmp_path / "jump"
    words = ("jump", "--gains", "naive", *SMALL, "--out", out, "--init-checkpoint")
    assert train(*words, finished_run.path, "--recipe", recipe) == 2
    assert train(*words, start.path) == 2
    assert train(*words, start.path / "walk.pt") == 2
    assert train(*words, earlier.path) == 2
    said = capsys.readouterr().err
    assert "0.35 rad there and 0.42 rad here" in said
    assert said.count("0.42 rad there and 0.35 rad here") == 3
    assert not out.exists()


@of_one_run
def test_mjlab_trains_every_phase_of_the_registered_task(
    finished_run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the phase settings of `pronk train`, and rewards that its command line has changed."""
    words = [
        "train",
        "Pronk-Jump-MiniCheetah",
        "--agent.max-iterations=4",
        "--env.curriculum.phases.params.walk=2",
        "--env.curriculum.phases.params.jump-a=1",
        "--env.curriculum.phases.params.jump-b=1",
        "--env.scene.num-envs=8",
        "--env.rewards.posture.weight=-0.5",
        "--env.rewards.posture.params.jump-scale=0.25",
    ]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    monkeypatch.setattr(sys, "argv", words)
    mjlab_train.main()
    (folder,) = (tmp_path / "logs" / "rsl_rl" / "pronk_jump").iterdir()
    assert load_policy(folder / "policy.onnx").contract.provenance["phases"] == ITERATIONS
    mjlab_env = env_settings(folder)
    pronk_env = env_settings(finished_run.path)
    assert mjlab_env["curriculum"] == pronk_env["curriculum"]
    changed_reward = mjlab_env["rewards"].pop("posture")
    del pronk_env["rewards"]["posture"]
    assert changed_reward["weight"] == "-0.5"
    assert changed_reward["params"]["jump_scale"] == "0.25"
    assert mjlab_env["rewards"] == pronk_env["rewards"]
    for name in PHASES:
        mjlab_state = checkpoint.read_checkpoint(folder / f"{name}.pt")
        pronk_state = checkpoint.read_checkpoint(finished_run.path / f"{name}.pt")
        assert mjlab_state["infos"]["env_state"] == pronk_state["infos"]["env_state"]
        for state in (mjlab_state, pronk_state):
            (group,) = state["estimator_optimizer_state_dict"]["param_groups"]
            assert group["lr"] == PHASES[name].estimator_rate


def env_settings(folder: Path) -> Any:
    """Read the settings of a run's environment."""
    return yaml.load((folder / "params" / "env.yaml").read_text(), yaml.BaseLoader)


def test_the_reward_rises(tmp_path: Path) -> None:
    """16 robots, a small network, phase walk, 20 iterations: +0.39 to 0.68 with four seeds."""
    cfg = load_env_cfg("Pronk-Walk-MiniCheetah")
    cfg.scene.num_envs = 16
    cfg.seed = 1
    learning = load_rl_cfg("Pronk-Walk-MiniCheetah")
    learning.seed = 1
    learning.actor.hidden_dims = (64, 64)
    learning.critic.hidden_dims = (64, 64)
    env = RslRlVecEnvWrapper(ManagerBasedRlEnv(cfg, device="cpu"))
    runner = PronkRunner(env, asdict(learning), str(tmp_path), "cpu")
    runner.learn(4, init_at_random_ep_len=True)
    first_reward = statistics.mean(runner.logger.rewbuffer)
    runner.learn(16)
    assert statistics.mean(runner.logger.rewbuffer) > first_reward + 0.3
    env.close()


def test_the_log_of_a_rollout_is_the_mean_over_the_steps_that_have_it() -> None:
    logs = [
        {"reward": torch.tensor(1.0), "falls": 3},
        {},
        {"reward": torch.tensor(4.0), "falls": 0, "time_outs": torch.tensor(2)},
    ]
    means = {name: float(mean) for name, mean in mean_log(logs).items()}
    assert means == {"reward": 2.5, "falls": 1.5, "time_outs": 2.0}
    assert mean_log([{}, {}]) == {}


def test_the_first_iteration_has_the_weights_of_its_phase(tmp_path: Path) -> None:
    """The runner replaces mjlab's reward manager, whose weights were those of the phase."""
    cfg = load_env_cfg("Pronk-Jump-MiniCheetah")
    cfg.scene.num_envs = 2
    cfg.curriculum["phases"].params.update(TASKS["together"])
    learning = load_rl_cfg("Pronk-Jump-MiniCheetah")
    env = RslRlVecEnvWrapper(ManagerBasedRlEnv(cfg, device="cpu"))
    PronkRunner(env, asdict(learning), str(tmp_path), "cpu")
    env.unwrapped.curriculum_manager.compute()  # as at the beginning of an iteration
    weights = {}
    for name in PHASES["jump_a"].weights:
        weights[name] = (env.unwrapped.reward_manager.get_term_cfg(name).weight,) * 2
    assert weights == PHASES["jump_a"].weights
    env.close()
