"""A run of the evaluation in mjlab, and the policies that it takes."""

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("mjlab")
pytestmark = pytest.mark.train

import torch
from mjlab.envs import ManagerBasedRlEnv
from tensordict import TensorDict

from pronk.errors import ArtefactError, PronkError
from pronk.jump.train.gains import TrainingGains, training_gains
from pronk.jump.train.phases import TASKS
from pronk.jump.train.provenance import RunFolder, new_record
from pronk.jump.train.recipe import Recipe, apply_recipe, load_recipe, task_numbers
from pronk.jump.train.rl import checkpoint
from pronk.jump.train.rl.export import contract_for, export_policy
from pronk.jump.train.settings import DrawSettings, TrainSettings
from pronk.jump.train.tasks import load_task
from pronk.jump.trial.jumps import JumpRules, measure_jump
from pronk.jump.trial.protocol import Case
from pronk.jump.trial.training_sim import adapter
from pronk.jump.trial.training_sim.evaluation import NEVER, EvaluationPlan
from pronk.jump.trial.training_sim.run import TERM, evaluate_policy
from pronk.policy.contract import Contract
from pronk.policy.script import STILL, Script
from pronk.robots import load_robot

DT = 0.005
DROP = 0.3
"""Height of the fall at the start [m]."""
ROBOT = load_robot("mini_cheetah")
SHORT = EvaluationPlan(
    robot=ROBOT,
    robots=2,
    seed=7,
    walks=(Case(name="forward 2", command=(2.0, 0.0, 0.0)), Case(name="stand", command=STILL)),
    jumps=(Case(name="side +1", command=(0.0, 1.0, 0.0)),),
    walk_s=1.5,
    settle_s=0.8,
    script=Script(command=STILL, stand_s=0.6, run_s=0.2, jump_s=0.4, keep_s=0.1),
    spread_s=0.2,
    # No grace: the fall at the start is a flight without a jump input.
    rules=JumpRules.of(ROBOT, search_s=0.2, tail_s=0.1, upright_s=0.2, grace_s=0.001),
)
BIAS = 0.1
"""Error of the estimate, forward [m/s]."""


@pytest.fixture(scope="module")
def observed() -> SimpleNamespace:
    """Six robots fall 0.3 m onto their feet; steps of 2 to 6 samples; one lies down."""
    task = load_task("mini_cheetah")
    cfg = task.env_cfg(task.robot, training_gains("naive", task.robot), iterations=TASKS["all"])
    decimation = cfg.events["decimation"]
    cfg.events["reset"].params = dict.fromkeys(("place", "speed", "heading", "joints"), 0.0)
    state = cfg.scene.entities["robot"].init_state
    state.pos = (0.0, 0.0, state.pos[2] + DROP)
    cfg = adapter.evaluation_cfg(cfg, SHORT, "none")
    cfg.events["decimation"] = decimation
    env = ManagerBasedRlEnv(cfg, device="cpu")
    listener = env.metrics_manager.cfg[TERM].func
    runs: list[Any] = []
    reads: list[Any] = []
    shares: list[float] = []

    def policy(obs: Any) -> Any:
        runs[:] = [listener.listener.__self__]
        jump = obs["jump"][:, 0].numpy().copy()
        reads.append((runs[0].sample, obs["measured"][:, -3:].numpy().copy(), jump))
        actions = torch.zeros(SHORT.size, 12)
        if runs[0].sample > 60:
            actions[5] = torch.tensor([2.0, 2.0, -4.0, 2.0, 0.0, 0.0] * 2)
        return actions

    def estimate(obs: Any) -> Any:
        target = obs["estimator_target"].clone()
        target[:, 4] += BIAS
        return target[:, :4], target[:, 4:]

    evaluation = evaluate_policy(policy, env, SHORT, estimate=estimate, progress=shares.append)
    env.close()
    captures: list[Any] = []
    for command in range(3):
        captures += runs[0].captures(command)
    return SimpleNamespace(
        evaluation=evaluation,
        reads=reads,
        shares=shares,
        captures=captures,
        fell_at=runs[0].fell_at.numpy(),
    )


def test_contacts_belong_to_the_positions_they_are_paired_with(observed: SimpleNamespace) -> None:
    """The feet meet the ground when the trunk is at standing height: 12 mm a sample by then."""
    z = observed.captures[0].position[:, 2]
    landing = int(np.argmax(observed.captures[0].contact.any(axis=-1)))
    samples = np.arange(landing)
    fall = SHORT.jump_rules.standing_height + DROP - 0.5 * 9.81 * DT**2 * samples * (samples + 1)
    assert z[:landing] == pytest.approx(fall, abs=1e-4)
    assert z[landing - 1] - z[landing] == pytest.approx(0.012, abs=1e-3)
    assert z[landing] <= SHORT.jump_rules.standing_height < z[landing - 1]
    # Held by soft drives alone the robots sink onto their knees, feet first.
    for capture in observed.captures[:5]:
        feet_land = capture.contact.any(axis=-1).argmax()
        knees_land = capture.other_contact.argmax()
        assert feet_land < knees_land < feet_land + 40


def test_the_policy_reads_the_command_of_the_moment(observed: SimpleNamespace) -> None:
    commands = SHORT.commands()
    times = SHORT.times(DT)
    assert {2, 3, 4, 5, 6} == set(np.diff([sample for sample, _, _ in observed.reads]))
    for sample, command, jump in observed.reads:
        moving = (times["start"] <= sample) & (sample < times["stop"])
        assert np.array_equal(command, np.where(moving[:, None], commands, 0.0))
        assert np.array_equal(jump > 0.0, (times["on"] <= sample) & (sample < times["off"]))


def test_figures_are_those_of_the_recorded_motion(observed: SimpleNamespace) -> None:
    evaluation = observed.evaluation
    for result in (*evaluation.walks, *evaluation.jumps):
        assert result["uncommanded"].n == 2
        assert result["uncommanded"].maximum == pytest.approx(DROP, abs=2e-3)
    # The standing one of the two jumping robots.
    on = next(sample for sample, _, jump in observed.reads if jump[4])
    standing = observed.captures[4]
    script = replace(SHORT.script, command=(0.0, 1.0, 0.0), run_s=on * DT - SHORT.script.start)
    figures = measure_jump(standing, script, ROBOT, began=0.0, rules=SHORT.rules)
    (jump,) = evaluation.jumps
    assert jump["height"].mean == pytest.approx(figures.height)
    assert jump["non_foot_contact"].mean == standing.other_contact[on : on + 41].any() / 2
    # Walks from 0.8 to 1.5 s.
    errors = []
    for capture, command in zip(observed.captures[:4], SHORT.commands(), strict=False):
        turns = Rotation.from_quat(capture.orientation[160:], scalar_first=True)
        velocity = turns.inv().apply(capture.velocity[160:])
        errors.append(np.linalg.norm(velocity[:, :2] - command[:2], axis=-1).mean())
    for walk, expected in zip(
        evaluation.walks, np.reshape(errors, (2, 2)).mean(axis=1), strict=True
    ):
        assert walk["speed_error"].mean == pytest.approx(expected, abs=1e-5)
        assert walk["fell"].mean == 0.0


def test_a_robot_that_lies_down_is_out(observed: SimpleNamespace) -> None:
    (jump,) = observed.evaluation.jumps
    assert (observed.fell_at[:5] == NEVER).all()
    assert observed.fell_at[5] < SHORT.times(DT)["on"][5]
    assert jump["standing"].mean == 0.5
    assert jump["height"].n == 1
    assert jump["found"].mean == 0.0
    assert jump["upright"].mean == 0.0


def test_the_estimate_is_compared_with_the_target(observed: SimpleNamespace) -> None:
    estimator = observed.evaluation.estimator
    expected = {"forward": BIAS, "left": 0.0, "up": 0.0, "velocity": BIAS, "contacts_right": 1.0}
    assert estimator == pytest.approx(expected, abs=1e-6)
    assert (observed.shares[0], observed.shares[-1]) == (0.0, 1.0)
    assert np.all(np.diff(observed.shares) > 0.0)


def test_an_environment_of_training_is_refused() -> None:
    plain = SimpleNamespace(metrics_manager=SimpleNamespace(cfg=None), num_envs=6)
    with pytest.raises(PronkError, match="evaluation_cfg"):
        evaluate_policy(lambda obs: obs, SimpleNamespace(unwrapped=plain), SHORT)


# --- The policy under evaluation ----------------------------------------------------------------


def write_record(
    folder: RunFolder,
    gains: TrainingGains,
    draws: DrawSettings | None = None,
    recipe: Recipe | None = None,
) -> None:
    """Write the record of a run."""
    settings = TrainSettings(task="all", out=folder.path, gains="gains.yaml")
    if draws is not None:
        settings = replace(settings, draws=draws)
    cfg = load_task("mini_cheetah").env_cfg(ROBOT, gains, iterations=TASKS["all"])
    if recipe is not None:
        apply_recipe(cfg, recipe)
    folder.write(new_record(settings.completed(), gains, task=task_numbers(cfg), recipe=recipe))


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    """The folder of a run with one checkpoint of random weights, and its actor."""
    torch.manual_seed(5)
    actor = adapter.blank_actor()
    torch.nn.init.normal_(actor.mlp[0].jump_weight)
    folder = RunFolder(tmp_path_factory.mktemp("run"))
    naive = training_gains("naive", ROBOT)
    write_record(folder, replace(naive, name="matched", sha256="ab" * 32))
    state: dict[str, Any] = {"iter": 7, "infos": {}}
    for key in (*checkpoint.NETWORKS, *checkpoint.OPTIMIZERS):
        state[key] = {}
    state["actor_state_dict"] = actor.state_dict()
    checkpoint.write_checkpoint(folder.path / "model_7.pt", state)
    return folder.path, actor


def test_a_run_is_evaluated_by_its_last_checkpoint(trained: tuple[Path, Any]) -> None:
    folder, actor = trained
    subject = adapter.load_evaluated_policy(folder, "cpu")
    obs = TensorDict({"measured": torch.randn(5, 105), "jump": torch.ones(5, 1)}, [5])
    with torch.no_grad():
        assert torch.equal(subject.act(obs), actor(obs))
        assert torch.equal(subject.estimate(obs)[1], actor.estimate(obs)[1])
    assert subject.jump
    assert subject.about["iteration"] == 7
    naive = training_gains("naive", ROBOT)
    assert not subject.knows(naive)
    matched = replace(naive, name="matched", sha256="ab" * 32)
    assert subject.knows(matched)
    assert not subject.knows(replace(matched, sha256="cd" * 32))


def test_other_files_are_refused(trained: tuple[Path, Any], tmp_path: Path) -> None:
    state = checkpoint.read_checkpoint(trained[0] / "model_7.pt")
    del state["actor_state_dict"]["mlp.0.bias"]
    checkpoint.write_checkpoint(tmp_path / "model_4.pt", state)
    (tmp_path / "model_3.pt").write_bytes(b"PK not a checkpoint")
    (tmp_path / "empty").mkdir()
    for name, words in (
        ("empty", "no checkpoints"),
        ("policy.onnx", "no such file"),
        ("model_2.pt", "no such file"),
        ("model_3.pt", "not a checkpoint"),
        ("model_4.pt", "its actor is not that"),
    ):
        with pytest.raises(ArtefactError, match=words):
            adapter.load_evaluated_policy(tmp_path / name, "cpu")


def naive_contract(provenance: dict[str, Any]) -> Contract:
    """Return the contract of a policy with jump input, trained with the nominal gains."""
    gains = training_gains("naive", ROBOT)
    cfg = load_task("mini_cheetah").env_cfg(ROBOT, gains, iterations=TASKS["all"])
    return contract_for(cfg, jump=True, provenance=provenance)


def test_an_exported_policy_does_what_its_checkpoint_does(
    trained: tuple[Path, Any], tmp_path: Path
) -> None:
    pytest.importorskip("onnxruntime")
    path = tmp_path / "policy.onnx"
    export_policy(trained[1], naive_contract({}), path)
    exported = adapter.load_evaluated_policy(path, "cpu")
    original = adapter.load_evaluated_policy(trained[0], "cpu")
    assert exported.jump
    assert exported.knows(training_gains("naive", ROBOT))
    # More robots than cores, fewer robots than cores, each with its own output.
    for count in (33, 1):
        for _ in range(2):
            groups = {"measured": torch.randn(count, 105), "jump": torch.ones(count, 1)}
            obs = TensorDict(groups, [count])
            with torch.no_grad():
                actions = exported.act(obs)
                contact, velocity = exported.estimate(obs)
                expected_actions = original.act(obs)
                expected_contact, expected_velocity = original.estimate(obs)
            assert torch.allclose(actions, expected_actions, atol=1e-5)
            assert torch.allclose(contact, expected_contact, atol=1e-5)
            assert torch.allclose(velocity, expected_velocity, atol=1e-5)


def test_a_policy_is_evaluated_with_the_drives_that_it_was_trained_with(
    trained: tuple[Path, Any], tmp_path: Path
) -> None:
    """By joint, with drives down to 0.7 of their torque, whether checkpoint or exported."""
    pytest.importorskip("onnxruntime")
    file = Path(__file__).parents[2] / "examples" / "studies" / "match_worth" / "gains"
    gains = training_gains(file / "shipped.yaml", ROBOT, by_joint=True)
    folder = RunFolder(tmp_path / "run")
    folder.path.mkdir()
    write_record(folder, gains, draws=DrawSettings(by_joint=True, weakest_drive=0.7))
    shutil.copyfile(trained[0] / "model_7.pt", folder.path / "model_7.pt")
    cfg = load_task("mini_cheetah").env_cfg(ROBOT, gains, iterations=TASKS["all"])
    provenance = {"by_joint": True, "weakest_drive": 0.7}
    contract = contract_for(cfg, jump=True, provenance=provenance)
    export_policy(trained[1], contract, tmp_path / "policy.onnx")
    for path in (folder.path, tmp_path / "policy.onnx"):
        policy = adapter.load_evaluated_policy(path, "cpu")
        assert policy.knows(gains)
        assert (policy.draws.by_joint, policy.draws.weakest_drive) == (True, 0.7)
    plan = replace(SHORT, robots=1, walk_s=0.9, jumps=())
    evaluation = adapter.run_evaluation(policy, gains, plan, device="cpu")
    assert evaluation.about["by_joint"] is True
    assert adapter.load_evaluated_policy(trained[0], "cpu").draws.by_joint is False
    # A policy of which nothing is recorded is evaluated by group.
    (tmp_path / "alone").mkdir()
    shutil.copyfile(trained[0] / "model_7.pt", tmp_path / "alone" / "model_7.pt")
    assert adapter.load_evaluated_policy(tmp_path / "alone", "cpu").draws.by_joint is None


def test_a_policy_is_evaluated_with_the_actions_contacts_and_rotors_of_its_recipe(
    trained: tuple[Path, Any], tmp_path: Path
) -> None:
    """Whether checkpoint or exported; the task's own scale of the actions is another one."""
    pytest.importorskip("onnxruntime")
    gains = training_gains("naive", ROBOT)
    recipe = tmp_path / "recipe.yaml"
    numbers = (
        "{action_scale: 0.42, contact_damping: 0.5, decimation_spread: 1, rotor_frequency: 40}"
    )
    recipe.write_text(f"schema: pronk/recipe/1\ntask: {numbers}\n")
    folder = RunFolder(tmp_path / "run")
    folder.path.mkdir()
    write_record(folder, gains, recipe=load_recipe(recipe))
    shutil.copyfile(trained[0] / "model_7.pt", folder.path / "model_7.pt")
    cfg = load_task("mini_cheetah").env_cfg(ROBOT, gains, iterations=TASKS["all"])
    apply_recipe(cfg, load_recipe(recipe))
    drawn = {"contact_damping": 0.5, "decimation_spread": 1.0, "rotor_frequency": 40.0}
    contract = contract_for(cfg, jump=True, provenance=drawn)
    export_policy(trained[1], contract, tmp_path / "policy.onnx")
    plan = replace(SHORT, robots=1, walk_s=0.9, jumps=())
    for path in (folder.path, tmp_path / "policy.onnx"):
        policy = adapter.load_evaluated_policy(path, "cpu")
        assert policy.task_numbers == {"action_scale": 0.42, **drawn}
    assert adapter.run_evaluation(policy, gains, plan, device="cpu").about["action_scale"] == 0.42
    plain = adapter.load_evaluated_policy(trained[0], "cpu")
    evaluation = adapter.run_evaluation(plain, gains, plan, device="cpu")
    assert evaluation.about["action_scale"] == 0.35


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("rotor_frequency", -40.5),
        ("rotor_frequency", "soft"),
        ("contact_damping", 1.5),
        ("decimation_spread", 0.5),
    ],
)
def test_impossible_numbers_that_a_policy_records_are_refused(
    trained: tuple[Path, Any], tmp_path: Path, name: str, value: object
) -> None:
    pytest.importorskip("onnxruntime")
    path = tmp_path / "policy.onnx"
    export_policy(trained[1], naive_contract({name: value}), path)
    with pytest.raises(ArtefactError, match=f"policy.onnx.*{name}.*{value}"):
        adapter.load_evaluated_policy(path, "cpu")


def test_numbers_that_the_task_of_the_robot_cannot_have_name_the_policy(
    trained: tuple[Path, Any], tmp_path: Path
) -> None:
    """A policy step of four physics steps cannot have seven fewer."""
    pytest.importorskip("onnxruntime")
    path = tmp_path / "policy.onnx"
    export_policy(trained[1], naive_contract({"decimation_spread": 7.0}), path)
    policy = adapter.load_evaluated_policy(path, "cpu")
    with pytest.raises(ArtefactError, match=r"policy\.onnx.*4 physics steps.*3 at most"):
        adapter.run_evaluation(policy, training_gains("naive", ROBOT), SHORT, device="cpu")


def test_scales_that_differ_by_joint_are_refused(trained: tuple[Path, Any], tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    contract = naive_contract({})
    scales = (0.3, *contract.action_scale[1:])
    path = tmp_path / "policy.onnx"
    export_policy(trained[1], msgspec.structs.replace(contract, action_scale=scales), path)
    with pytest.raises(ArtefactError, match=r"action_scale is 0\.3, 0\.35"):
        adapter.load_evaluated_policy(path, "cpu")


def test_the_shipped_policy_acts_for_thousands_of_robots(tmp_path: Path) -> None:
    """As many as `pronk evaluate` has by default, whose layers do not fit in memory at once."""
    pytest.importorskip("onnxruntime")
    shipped = Path(__file__).parents[2] / "policies" / "matched" / "policy.onnx"
    policy = adapter.load_evaluated_policy(shipped, "cpu")
    count = 14_000
    torch.manual_seed(3)
    measured = torch.randn(count, 105)
    jump = torch.randint(2, (count, 1)).float()
    obs = TensorDict({"measured": measured, "jump": jump}, [count])
    contact, velocity = policy.estimate(obs)
    actions = policy.act(obs)
    assert (contact.shape, velocity.shape, actions.shape) == ((count, 4), (count, 3), (count, 12))
    for begin in (0, 6_999, count - 5):
        part = slice(begin, begin + 5)
        few = TensorDict({"measured": measured[part], "jump": jump[part]}, [5])
        assert torch.equal(policy.act(few), actions[part])
        assert torch.equal(policy.estimate(few)[1], velocity[part])


def test_more_robots_than_memory_holds_are_refused(trained: tuple[Path, Any]) -> None:
    policy = adapter.load_evaluated_policy(trained[0], "cpu")
    gains = training_gains("naive", ROBOT)
    plan = replace(SHORT, robots=10**9)
    if not math.isfinite(adapter.available_memory()):
        pytest.skip("the free memory of this host is not known")
    with pytest.raises(PronkError, match="--robots 1000000000") as refusal:
        adapter.run_evaluation(policy, gains, plan, device="cpu")
    fitting = int(str(refusal.value).split("--robots ")[-1].split()[0])
    assert replace(plan, robots=fitting).memory_bytes(DT) <= 2.0 * adapter.available_memory()


def test_the_free_memory_of_linux_is_read(tmp_path: Path) -> None:
    file = tmp_path / "meminfo"
    file.write_text("MemTotal:  900 kB\nMemFree:  7 kB\nMemAvailable:   512 kB\n")
    assert adapter.available_memory(file) == 512 * 1024
    assert math.isinf(adapter.available_memory(tmp_path / "none"))


# --- The command ---------------------------------------------------------------------------------


def test_a_run_is_evaluated_with_everything_drawn(trained: tuple[Path, Any]) -> None:
    plan = replace(SHORT, robots=1, walk_s=1.0, jumps=())
    gains = training_gains("naive", ROBOT)
    before = {"forward 2": 0.1}
    policy = adapter.load_evaluated_policy(trained[0], "cpu")
    evaluation = adapter.run_evaluation(policy, gains, plan, device="cpu", before=before)
    assert [walk.name for walk in evaluation.walks] == ["forward 2", "stand"]
    assert evaluation.jumps == ()
    assert evaluation.before == before
    about = evaluation.about
    assert about["randomization"] == "full"
    assert about["gains"] == {"name": "naive", "sha256": "", "virtual": False}
    assert about["policy"]["iteration"] == 7
    assert about["by_joint"] is False
    assert about["device"]["device"] == "cpu"
    assert about["versions"]["mjlab"]
