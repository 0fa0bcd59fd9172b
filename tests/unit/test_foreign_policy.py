"""Policies of others: what deploy.yaml says of an observation, and what `policy check` finds."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from command_line import invoke
from foreign_policy import (
    HISTORY,
    ISAACLAB_ORDER,
    POSE,
    TERMS,
    UNITREE_ORDER,
    WIDTH,
    deploy_body,
    newest,
    write_foreign,
)
from pronk.arrays import Array
from pronk.errors import ArtefactError
from pronk.exit_status import ExitStatus
from pronk.policy.deploy_yaml import DeployFile, read_deploy_yaml
from pronk.policy.foreign import ForeignPolicy
from pronk.policy.observation import Measurement
from pronk.robots import load_robot

pytest.importorskip("onnxruntime")
pytest.importorskip("onnx")

GO2 = load_robot("go2")
STILL = ("--robot", "go2", "--command", "0,0,0", "--seconds", "3")


def read(folder: Path, **changes: Any) -> DeployFile:
    path = folder / "deploy.yaml"
    path.write_text(yaml.safe_dump(deploy_body(**changes), sort_keys=False))
    return read_deploy_yaml(path)


def measured(number: int) -> Measurement:
    """Return a measurement whose numbers all differ, in the order of the robot's file."""
    shift = 10.0 * number
    return Measurement(
        angular_velocity=np.array([0.1, 0.2, 0.3]) + number,
        projected_gravity=np.array([0.1, -0.2, -0.97]),
        position=np.arange(12) + shift,
        velocity=np.arange(12) + 20.0 + shift,
    )


def observed(deploy: DeployFile, steps: int, action: Array | None = None) -> list[Array]:
    """Return the observations of some steps of a policy that returns one action always."""
    rows: list[Array] = []

    def network(observation: Array) -> Array:
        rows.append(observation)
        return np.zeros(12) if action is None else action

    policy = ForeignPolicy(network, deploy)
    for number in range(steps):
        policy.step(measured(number), (0.5, -0.25, 1.0))
    return rows


def test_an_observation_has_term_after_term_with_the_oldest_sample_first(tmp_path: Path) -> None:
    deploy = read(tmp_path)
    rows = observed(deploy, 3)
    assert rows[0].shape == (WIDTH,)
    # The first measurement fills the histories.
    assert rows[0][:15] == pytest.approx([0.1, 0.2, 0.3] * HISTORY)
    assert rows[2][:15] == pytest.approx(
        [0.1, 0.2, 0.3, 0.1, 0.2, 0.3, 0.1, 0.2, 0.3, 1.1, 1.2, 1.3, 2.1, 2.2, 2.3]
    )
    assert rows[2][30:33] == pytest.approx([0.5, -0.25, 1.0])
    # Joints in the order of the network, relative to its pose.
    place = newest("joint_pos_rel", 0)
    expected = np.array(UNITREE_ORDER) + 20.0 - np.array(POSE)
    assert rows[2][place : place + 12] == pytest.approx(expected)
    place = newest("joint_vel_rel", 0)
    assert rows[2][place : place + 12] == pytest.approx(np.array(UNITREE_ORDER) + 40.0)


def test_histories_can_have_another_order(tmp_path: Path) -> None:
    deploy = read(tmp_path)
    reversed_rows = observed(replace(deploy, newest_first=True), 2)
    assert reversed_rows[1][:6] == pytest.approx([1.1, 1.2, 1.3, 0.1, 0.2, 0.3])
    observations = {"use_gym_history": True, **deploy_body()["observations"]}
    by_sample = read(tmp_path, observations=observations)
    row = observed(by_sample, 2)[1]
    one_sample = sum(TERMS.values())
    assert row[-one_sample : -one_sample + 3] == pytest.approx([1.1, 1.2, 1.3])
    assert row[:3] == pytest.approx([0.1, 0.2, 0.3])
    assert row.shape == (WIDTH,)


def test_values_are_clipped_then_scaled(tmp_path: Path) -> None:
    body = deploy_body()
    term = {"scale": [0.5] * 3, "clip": [-0.15, 0.15], "history_length": 1}
    body["observations"]["base_ang_vel"] = term
    row = observed(read(tmp_path, **body), 1)[0]
    assert row[:3] == pytest.approx([0.05, 0.075, 0.075])
    term["scale_first"] = True
    row = observed(read(tmp_path, **body), 1)[0]
    assert row[:3] == pytest.approx([0.05, 0.1, 0.15])


def test_actions_become_targets_in_the_order_of_the_robot(tmp_path: Path) -> None:
    body = deploy_body()
    body["actions"]["JointPositionAction"]["clip"] = [[-1.6, 1.0]] * 12
    deploy = read(tmp_path, **body)
    action = np.linspace(-1.0, 1.0, 12)
    rows: list[Array] = []

    def network(observation: Array) -> Array:
        rows.append(observation)
        return action

    policy = ForeignPolicy(network, deploy)
    target = policy.step(measured(0), (0.0, 0.0, 0.0))
    policy.step(measured(1), (0.0, 0.0, 0.0))
    expected = np.clip(np.array(POSE) + 0.25 * action, -1.6, 1.0)
    for number, place in enumerate(UNITREE_ORDER):
        assert target[place] == pytest.approx(expected[number])
    # The observed action is the network's own.
    place = newest("last_action", 0)
    assert rows[1][place : place + 12] == pytest.approx(action)
    assert GO2.joint_names[UNITREE_ORDER[0]] == "FL_hip_roll"
    assert GO2.joints[UNITREE_ORDER[0]].own_name == "FL_hip_joint"


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"joint_ids_map": [0] * 12}, "joint_ids_map"),
        ({"step_dt": 0.0}, "step_dt"),
        ({"stiffness": [60.0] * 11}, "stiffness"),
        ({"damping": [-1.0] * 12}, "damping"),
        ({"default_joint_pos": [float("nan")] * 12}, "default_joint_pos"),
        ({"actions": {"JointVelocityAction": {}}}, "JointPositionAction"),
        ({"observations": {}}, "no term"),
        ({"observations": {"base_lin_vel": {"scale": [1.0] * 3}}}, "base_lin_vel"),
        ({"observations": {"base_ang_vel": {"scale": [1.0] * 4}}}, "scale"),
        ({"observations": {"base_ang_vel": {"clip": [1, -1]}}}, "smaller"),
        ({"observations": {"base_ang_vel": {"history_length": -1}}}, "history_length"),
        ({"observations": "all"}, "observations"),
    ],
)
def test_what_cannot_be_run_is_refused(tmp_path: Path, changes: dict[str, Any], word: str) -> None:
    with pytest.raises(ArtefactError, match=word):
        read(tmp_path, **changes)


def check(folder: Path, *words: str, **changes: Any) -> tuple[int, dict[str, Any], str]:
    """Write a policy, check it standing still, and return status, figures and output."""
    weights = changes.pop("weights", None)
    policy, deploy = write_foreign(folder, weights, **changes)
    report = folder / "report.json"
    done = invoke(["policy", "check", policy, "--deploy", deploy, *STILL, *words, "--json", report])
    figures = json.loads(report.read_text()) if report.exists() else {}
    return done.exit_code, figures, done.output


def test_a_standing_policy_is_fine(tmp_path: Path) -> None:
    status, figures, output = check(tmp_path)
    assert status == ExitStatus.DONE, output
    assert figures["virtual"] is True
    assert figures["run"]["fell_s"] is None
    assert figures["run"]["velocity"] == pytest.approx([0.0, 0.0, 0.0], abs=0.05)
    # Gains other than those of the robot's file are said, once for all joints.
    assert len(figures["problems"]) == 1
    assert "60" in figures["problems"][0]


def test_a_wrong_order_of_the_joints_is_named(tmp_path: Path) -> None:
    pose = [POSE[UNITREE_ORDER.index(place)] for place in ISAACLAB_ORDER]
    actions = deploy_body()["actions"]
    actions["JointPositionAction"]["offset"] = pose
    status, figures, output = check(
        tmp_path, joint_ids_map=list(range(12)), default_joint_pos=pose, actions=actions
    )
    assert status == ExitStatus.POLICY_FELL, output
    assert any("outside its range" in problem for problem in figures["problems"])
    assert figures["remedies"]
    assert all("joint_ids_map joint after joint" in text for text in figures["remedies"]), output


def test_a_wrong_sign_of_gravity_is_named(tmp_path: Path) -> None:
    # Hips that yield where the trunk leans: with the other sign they hold against it.
    weights = np.zeros((WIDTH, 12))
    for leg in range(4):
        weights[newest("projected_gravity", 1), 3 * leg] = 8.0
    status, figures, output = check(tmp_path, weights=weights)
    assert status == ExitStatus.POLICY_FELL, output
    assert "gravity with the other sign" in figures["remedies"]
    fallen = [tried["change"] for tried in figures["tried"] if tried["fell_s"] is not None]
    assert set(fallen).isdisjoint(figures["remedies"])


def test_a_policy_that_no_single_change_helps_is_said_to_be_so(tmp_path: Path) -> None:
    # Legs stretched out to one side: no order of joints, sign or scale stands on them.
    actions = deploy_body()["actions"]
    actions["JointPositionAction"]["offset"] = [0.9, 3.0, -0.9] * 4
    status, figures, output = check(
        tmp_path, actions=actions, default_joint_pos=[0.9, 3.0, -0.9] * 4
    )
    assert status == ExitStatus.POLICY_FELL, output
    assert figures["remedies"] == []


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"weights": np.zeros((WIDTH + 3 * HISTORY, 12))}, "base_lin_vel"),
        ({"weights": np.zeros((sum(TERMS.values()), 12))}, "history_length of 1"),
        ({"weights": np.zeros((WIDTH, 11))}, "11"),
        ({"extra_inputs": 2}, "recurrent"),
    ],
)
def test_networks_that_do_not_fit_are_refused_without_a_file(
    tmp_path: Path, changes: dict[str, Any], word: str
) -> None:
    status, figures, output = check(tmp_path, **changes)
    assert status == ExitStatus.REFUSED
    assert word in output
    assert figures == {}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["deploy.yaml", "policy.onnx"]


def test_other_robots_and_missing_files_are_refused(tmp_path: Path) -> None:
    policy, deploy = write_foreign(tmp_path)
    for words, word in (
        (["--deploy", deploy, "--robot", "so101"], "joints"),
        (["--deploy", tmp_path / "no.yaml", "--robot", "go2"], "no such file"),
        (["--deploy", policy, "--robot", "go2"], "policy.onnx"),
        (["--deploy", deploy, "--robot", "go2", "--seconds", "0"], "--seconds"),
        (["--deploy", deploy, "--robot", "go2", "--command", "fast"], "command"),
    ):
        done = invoke(["policy", "check", policy, *words])
        assert done.exit_code == ExitStatus.REFUSED, words
        assert word in done.stderr
        assert "Traceback" not in done.output
