"""Recipes: their files, what they change in a task, and what they refuse."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mjlab")

import training_env
from command_line import refused
from pronk.errors import PronkError
from pronk.jump.train.gains import training_gains
from pronk.jump.train.mdp.commands import NAME as COMMAND
from pronk.jump.train.phases import PHASES, TASKS, changed_phases
from pronk.jump.train.recipe import (
    SCHEMA,
    apply_recipe,
    load_recipe,
    load_recipes,
    task_numbers,
)
from pronk.jump.train.settings import DrawSettings, TrainSettings
from pronk.jump.train.tasks import load_task
from pronk.jump.train.tasks.jump_env_cfg import (
    set_contact_damping,
    set_decimation_spread,
    set_rotor_frequency,
)
from pronk.jump.train.tasks.reward_weights import candidate_terms, reward_weights
from training_env import ROBOT, config

pytestmark = pytest.mark.train

RECIPES = sorted((Path(__file__).parents[2] / "examples" / "recipes").glob("*.yaml"))


def written(folder: Path, text: str) -> Path:
    path = folder / "recipe.yaml"
    path.write_text(f"schema: {SCHEMA}\n{text}\n")
    return path


def task(text: str, folder: Path) -> Any:
    """The environment's configuration with a recipe."""
    cfg = config(8, training_gains("naive", ROBOT))
    apply_recipe(cfg, load_recipe(written(folder, text)))
    return cfg


def phases_of(cfg: Any) -> Any:
    return changed_phases(cfg.curriculum["phases"].params["changes"])


def test_a_number_holds_in_all_phases_and_zero_removes(tmp_path: Path) -> None:
    cfg = task("rewards: {posture: -0.5, stray_foot: 0, crouch: 0.0}", tmp_path)
    assert set(cfg.rewards) == set(reward_weights()) - {"stray_foot", "crouch"}
    for phase in phases_of(cfg).values():
        assert phase.weights["posture"] == (-0.5, -0.5)


def test_a_phase_that_is_named_changes_alone(tmp_path: Path) -> None:
    text = "rewards: {sparse_jump: {jump_b: [16, 4]}, landing: {jump_b: -7}}\n"
    text += "jump_scales: {knees: {jump_b: [1, 3]}, orientation: 1.5}"
    phases = phases_of(task(text, tmp_path))
    assert phases["jump_b"].weights["sparse_jump"] == (16.0, 4.0)
    assert phases["jump_a"].weights["sparse_jump"] == PHASES["jump_a"].weights["sparse_jump"]
    assert phases["jump_b"].weights["landing"] == (-7.0, -7.0)
    assert phases["jump_b"].jump_scales["knees"] == (1.0, 3.0)
    assert phases["jump_b"].jump_scales["collision"] == PHASES["jump_b"].jump_scales["collision"]
    assert phases["walk"].jump_scales["orientation"] == (1.5, 1.5)
    assert phases["walk"].weights == {}


def test_a_candidate_is_added_only_where_it_has_a_weight(tmp_path: Path) -> None:
    assert not set(candidate_terms()) & set(reward_weights())
    cfg = task("rewards: {clearance_gap: {jump_a: 4}, slip: 0}", tmp_path)
    assert set(cfg.rewards) - set(reward_weights()) == {"clearance_gap"}
    assert cfg.rewards["clearance_gap"].weight == 0.0, "the phase gives it its weight"


def test_the_scale_of_the_actions_is_changed(tmp_path: Path) -> None:
    before = config(8, training_gains("naive", ROBOT)).actions["joint_position"].scale
    cfg = task("task: {action_scale: 0.42}", tmp_path)
    assert cfg.actions["joint_position"].scale == 0.42 != before


@pytest.mark.parametrize(
    ("name", "drawn", "nothing", "event", "parameter"),
    [
        ("contact_damping", 0.6, 1.0, "contact", "least"),
        ("rotor_frequency", 60.0, 0.0, "rotors", "lowest_hz"),
        ("decimation_spread", 1.0, 0.0, "decimation", "added"),
    ],
)
def test_contact_rotors_and_policy_steps_are_drawn_otherwise_or_not(
    tmp_path: Path, name: str, drawn: float, nothing: float, event: str, parameter: str
) -> None:
    default = task_numbers(config(8, training_gains("naive", ROBOT)))
    assert default[name] not in (drawn, nothing)
    cfg = task(f"task: {{{name}: {drawn}}}", tmp_path)
    expected = (-drawn, drawn) if parameter == "added" else drawn
    assert cfg.events[event].params[parameter] == expected
    assert task_numbers(cfg) == {**default, name: drawn}
    cfg = task(f"task: {{{name}: {nothing}}}", tmp_path)
    assert event not in cfg.events
    assert task_numbers(cfg) == {**default, name: nothing}


@pytest.mark.parametrize(("decimation", "spread"), [(1, 0), (2, 1), (3, 2), (8, 2)])
def test_a_policy_step_keeps_a_physics_step(decimation: int, spread: int) -> None:
    robot_task = load_task("mini_cheetah")
    robot = replace(robot_task.robot, decimation=decimation)
    gains = training_gains("naive", ROBOT)
    cfg = robot_task.env_cfg(robot, gains, iterations=dict.fromkeys(PHASES, 10), num_envs=8)
    assert task_numbers(cfg)["decimation_spread"] == spread
    assert cfg.decimation - spread >= 1


def test_an_event_of_somebody_else_with_such_a_name_stays() -> None:
    cfg = config(8, training_gains("naive", ROBOT))
    cfg.events["contact"] = cfg.events["friction"]
    cfg.events["rotors"] = cfg.events["base_mass"]
    cfg.events["decimation"] = cfg.events["push"]
    numbers = task_numbers(cfg)
    assert (numbers["contact_damping"], numbers["rotor_frequency"]) == (1.0, 0.0)
    assert numbers["decimation_spread"] == 0.0
    set_contact_damping(cfg, 1.0)
    set_decimation_spread(cfg, 0)
    set_rotor_frequency(cfg, 0.0)
    assert cfg.events["decimation"] is cfg.events["push"]
    assert cfg.events["contact"] is cfg.events["friction"]
    assert cfg.events["rotors"] is cfg.events["base_mass"]


def test_rotors_without_inertia_are_refused(tmp_path: Path) -> None:
    cfg = config(8, training_gains("naive", ROBOT))
    path = tmp_path / "recipe.yaml"
    path.write_text("schema: pronk/recipe/1\ntask: {rotor_frequency: 40}\n")
    knees = cfg.scene.entities["robot"].articulation.actuators[2]
    knees.armature = 0.0
    set_rotor_frequency(cfg, 0.0)
    with pytest.raises(PronkError, match=r"FR_knee.* is 0") as refusal:
        apply_recipe(cfg, load_recipe(path))
    assert str(path) in str(refusal.value)
    assert "rotor_inertia" in str(refusal.value)
    assert "rotors" not in cfg.events


def test_the_definition_of_a_jump_is_changed(tmp_path: Path) -> None:
    text = "jump: {liftoff_velocity: 2.2, late_s: 0.2, speed_added: 0.9, guidance_sweep: 1,"
    text += " backward_share: 0.5, sideways_share: 0.25}"
    command = task(text, tmp_path).commands[COMMAND]
    assert (command.settings.liftoff_velocity, command.settings.late_s) == (2.2, 0.2)
    assert (command.jump_speed_added, command.guidance_sweep) == (0.9, 1.0)
    assert (command.backward_share, command.sideways_share) == (0.5, 0.25)
    assert command.settings.ready_s == 0.26


def test_the_direction_of_a_lift_off_is_changed(tmp_path: Path) -> None:
    before = task("jump: {late_s: 0.2}", tmp_path).rewards["liftoff_angle"].params
    after = task("jump: {angle_vertical: 1.6}", tmp_path).rewards["liftoff_angle"].params
    assert after == {**before, "vertical": 1.6}
    assert before["vertical"] != 1.6


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("rewards: {speed: 3}", "'speed'|tracking_linear|clearance_gap"),
        ("jump_scales: {speed: 3}", "'speed'|tracking_linear"),
        ("jump_scales: {sparse_jump: 3}", "'sparse_jump'|no jump_scale|orientation"),
        ("rewards: {posture: {run: 3}}", "'run'|walk, jump_a, jump_b"),
        ("rewards: {posture: {walk: [1, 2, 3]}}", "rewards"),
        ("rewards: {posture: fast}", "rewards"),
        ("rewards: {posture: .nan}", "finite"),
        ("weights: {posture: 1}", "weights|rewards, jump_scales, jump and task"),
        ("jump: {height: 3}", "'height'|late_s|speed_added|guidance_sweep"),
        ("jump: {late_s: 0}", "late_s"),
        ("jump: {ready_s: 3}", "ready_s"),
        ("jump: {backward_share: 1.5}", "backward_share|from 0 to 1"),
        ("jump: {sideways_share: -0.5}", "sideways_share|from 0 to 1"),
        ("jump: {angle_vertical: 0}", "angle_vertical|more than 0"),
        ("rewards: {liftoff_angle: 0}\njump: {angle_vertical: 1.6}", "angle_vertical|removed"),
        ("task: {scale: 3}", "'scale'|action_scale|contact_damping"),
        ("task: {action_scale: 0}", "action_scale|more than 0"),
        ("task: {contact_damping: 0}", "contact_damping|more than 0"),
        ("task: {contact_damping: 1.5}", "contact_damping|up to 1"),
        ("task: {rotor_frequency: -40}", "rotor_frequency|10 Hz or more"),
        ("task: {decimation_spread: 0.5}", "decimation_spread|whole number"),
        ("task: {decimation_spread: -1}", "decimation_spread|whole number"),
        ("task: {decimation_spread: .inf}", "decimation_spread|finite"),
        ("task: {decimation_spread: 4}", "decimation_spread|3 at most"),
        ("task: {rotor_frequency: .inf}", "rotor_frequency|finite"),
        ("task: {rotor_frequency: 4}", "rotor_frequency|10 Hz or more"),
    ],
)
def test_what_there_is_not_is_refused_with_what_there_is(
    tmp_path: Path, text: str, words: str
) -> None:
    with pytest.raises(PronkError) as refusal:
        task(text, tmp_path)
    for word in (*words.split("|"), "recipe.yaml"):
        assert word in str(refusal.value), word


@pytest.mark.parametrize(
    ("good", "faulty", "words"),
    [
        ("rewards: {posture: -1}", "rewards: {speed: 3}", "'speed'|tracking_linear"),
        ("jump_scales: {knees: 2}", "jump_scales: {sparse_jump: 3}", "'sparse_jump'|no jump_scale"),
        ("jump: {late_s: 0.2}", "jump: {height: 3}", "'height'|late_s"),
        ("jump: {late_s: 0.2}", "jump: {late_s: 0}", "late_s"),
        ("jump: {speed_added: 0.2}", "jump: {ready_s: 3}", "ready_s"),
    ],
)
def test_the_layer_that_does_not_apply_is_named(
    tmp_path: Path, good: str, faulty: str, words: str
) -> None:
    paths = []
    for name, text in (("first", good), ("faulty", faulty), ("last", "rewards: {hop: 0}")):
        paths.append(tmp_path / f"{name}.yaml")
        paths[-1].write_text(f"schema: {SCHEMA}\n{text}\n")
    with pytest.raises(PronkError) as refusal:
        apply_recipe(config(8, training_gains("naive", ROBOT)), load_recipes(paths))
    assert str(refusal.value).startswith(str(paths[1]))
    for word in words.split("|"):
        assert word in str(refusal.value), word


def test_a_number_that_a_later_layer_mends_is_no_fault(tmp_path: Path) -> None:
    first = written(tmp_path, "jump: {late_s: 0}")
    second = tmp_path / "second.yaml"
    second.write_text(f"schema: {SCHEMA}\njump: {{late_s: 0.2}}\n")
    cfg = config(8, training_gains("naive", ROBOT))
    apply_recipe(cfg, load_recipes([first, second]))
    assert cfg.commands[COMMAND].settings.late_s == 0.2


def test_the_command_refuses_before_anything_is_written(tmp_path: Path) -> None:
    out = tmp_path / "run"
    bad = written(tmp_path, "rewards: {speed: 3}")
    words = ("train", "walk", "--gains", "naive", "--out", out, "--recipe")
    assert "'speed'" in refused(*words, bad)
    assert "no such file" in refused(*words, tmp_path / "none.yaml")
    bad.write_text("schema: pronk/gains/1")
    assert SCHEMA in refused(*words, bad)
    assert not out.exists()


def test_the_plan_of_a_study_refuses_a_recipe_that_does_not_apply(tmp_path: Path) -> None:
    bad = written(tmp_path, "rewards: {speed: 3}")
    study = tmp_path / "study.yaml"
    arm = f'{{gains: naive, options: "--recipe {bad.name}"}}'  # relative to the study
    study.write_text(f"schema: pronk/study/1\ntitle: speeds\narms: {{faster: {arm}}}\n")
    text = refused("study", study, "--plan")
    assert "'speed'" in text
    assert "arms.faster" in text


def test_a_recipe_is_part_of_a_run(tmp_path: Path) -> None:
    path = written(tmp_path, "rewards: {slip: 0}")
    first = TrainSettings(task="all", out=tmp_path, gains="naive", recipe=(path,))
    stored = first.completed().stored_values()
    again = TrainSettings(task="all", out=tmp_path, resume=True).resumed(stored)
    assert again.recipe == (path,)
    other = TrainSettings(task="all", out=tmp_path, resume=True, recipe=(Path("other.yaml"),))
    with pytest.raises(PronkError, match="leave it out"):
        other.resumed(stored)
    by_joint = TrainSettings(
        task="all", out=tmp_path, resume=True, draws=DrawSettings(by_joint=True)
    )
    with pytest.raises(PronkError, match="--by-joint"):
        by_joint.resumed(stored)
    # A run of an earlier version has no such entries.
    for name in ("recipe", "by_joint", "weakest_drive"):
        del stored[name]
    assert TrainSettings(task="all", out=tmp_path, resume=True).resumed(stored).recipe == ()


def task_with(robot_name: str, layers: list[Path]) -> Any:
    """Return the configuration of a robot's task, changed by a recipe."""
    robot_task = load_task(robot_name)
    gains = training_gains("naive", robot_task.robot)
    cfg = robot_task.env_cfg(
        robot_task.robot, gains, iterations=dict.fromkeys(PHASES, 10), num_envs=8
    )
    if layers:
        apply_recipe(cfg, load_recipes(layers))
    return cfg


def settings_of(cfg: Any) -> str:
    """Return all that a recipe may change of a task."""
    phases = PHASES
    if "changes" in cfg.curriculum["phases"].params:
        phases = phases_of(cfg)
    rewards = []
    for phase in phases.values():
        for name, term in cfg.rewards.items():
            weight = phase.weights.get(name, (term.weight, term.weight))
            rewards.append((name, weight, term.params, phase.jump_scales.get(name)))
    drawn = [cfg.events.get(name) for name in ("contact", "decimation", "rotors")]
    return repr((rewards, cfg.commands, cfg.actions, drawn))


MOST_TERMS = 20
"""Number of reward terms that a task and a shipped recipe may have in a phase."""
DEFAULT_LAYERS = ("forward", "contact", "rotors", "walk_speed")
"""Recipes that the default consists of."""
MORE_TERMS = {"go2": 21, "thirty_terms": 30}
"""The same of the Go2's recipe, which pays for the gap beside the distance, and of that with the
terms that the default has left out."""


def test_the_default_consists_of_recipes_that_were_measured() -> None:
    """Each of its layers changes nothing, and with all of them the former default becomes it."""
    folder = Path(__file__).parents[2] / "examples" / "recipes"
    layers = [folder / f"{name}.yaml" for name in DEFAULT_LAYERS]
    default = task_with("mini_cheetah", [])
    for layer in layers:
        assert settings_of(task_with("mini_cheetah", [layer])) == settings_of(default)
    former = folder / "former_default.yaml"
    assert settings_of(task_with("mini_cheetah", [former])) != settings_of(default)
    assert settings_of(task_with("mini_cheetah", [former, *layers])) == settings_of(default)
    assert len(default.rewards) == MOST_TERMS


def test_the_recipe_of_the_go2_is_as_its_policies_were_trained() -> None:
    """The former default changes nothing in it."""
    folder = Path(__file__).parents[2] / "examples" / "recipes"
    go2 = folder / "go2.yaml"
    expected = settings_of(task_with("go2", [folder / "former_default.yaml", go2]))
    assert settings_of(task_with("go2", [go2])) == expected


@pytest.mark.parametrize("path", RECIPES, ids=lambda path: path.stem)
def test_the_shipped_recipes_apply(path: Path) -> None:
    """Each changes the task of a robot, and says in its comments what for."""
    changed_robots = []
    for robot_name in ("mini_cheetah", "go2"):
        cfg = task_with(robot_name, [path])
        if settings_of(cfg) != settings_of(task_with(robot_name, [])):
            changed_robots.append(robot_name)
        for phase in phases_of(cfg).values():
            weights = {name: (term.weight,) for name, term in cfg.rewards.items()}
            weights |= {name: span for name, span in phase.weights.items() if name in weights}
            terms = sum(1 for span in weights.values() if any(span))
            assert terms <= MORE_TERMS.get(path.stem, MOST_TERMS)
    if path.stem in DEFAULT_LAYERS:
        assert "mini_cheetah" not in changed_robots
    else:
        assert changed_robots
    assert path.read_text().startswith("# ")


def test_an_environment_has_the_weights_of_its_recipe(tmp_path: Path) -> None:
    """Step by step through the phases, with a term that was added."""
    from mjlab.envs import ManagerBasedRlEnv

    from pronk.jump.train.phases import STEPS_PER_ITERATION, curriculum

    text = "rewards: {clearance_gap: {jump_b: [4, 8]}, posture: -0.5, crouch: 0}\n"
    cfg = task(text + "jump_scales: {approach_linear: {jump_a: 2}}", tmp_path)
    cfg.curriculum["phases"].params.update(TASKS["all"])
    cfg.scene.num_envs = 2
    env = ManagerBasedRlEnv(cfg, device="cpu")
    for iteration, expected in ((0, 0.0), (300, 0.0), (520, 4.0), (800, 6.0)):
        env.common_step_counter = iteration * STEPS_PER_ITERATION
        env.curriculum_manager.compute()
        assert env.reward_manager.get_term_cfg("clearance_gap").weight == pytest.approx(expected)
        assert env.reward_manager.get_term_cfg("posture").weight == -0.5
        # A term without a factor of its own has that of a phase in this phase alone.
        scale = env.reward_manager.get_term_cfg("approach_linear").params.get("jump_scale", 1.0)
        assert scale == (2.0 if 300 <= iteration < 520 else 1.0)
        assert curriculum(env).total == 1080
    assert "crouch" not in env.reward_manager.active_terms
    env.step(training_env.torch.zeros(2, 12))
