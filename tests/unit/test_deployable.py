"""Policies that were trained elsewhere as a deployment runs them, and what is refused before."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("onnxruntime")
pytest.importorskip("onnx")

from foreign_policy import POSE, UNITREE_ORDER, WIDTH, deploy_body, write_foreign
from pronk.deploy.links.realtime import Pace
from pronk.deploy.runtime.limits import Limits
from pronk.deploy.runtime.memory import Shared
from pronk.deploy.runtime.modes import Mode
from pronk.deploy.runtime.plan import Link, RunPlan
from pronk.deploy.runtime.policy_process import PolicyProcess, standing
from pronk.deploy.runtime.poses import RunTiming
from pronk.deploy.runtime.records import ACTIONS, put_state, state_dtype
from pronk.deploy.runtime.safety import SafetyFilter
from pronk.deploy.runtime.state_machine import OperatorRequest, StateMachine
from pronk.errors import ArtefactError
from pronk.policy.deploy_yaml import read_deploy_yaml
from pronk.policy.deployable import UNKNOWN_DELAY_S, open_policy
from pronk.policy.foreign import ForeignPolicy, load_foreign_network
from pronk.policy.observation import Measurement
from pronk.robots import load_robot

GO2 = load_robot("go2")


def random_weights() -> np.ndarray:
    weights: np.ndarray = 0.01 * np.random.default_rng(2).standard_normal((WIDTH, 12))
    return weights


def measured(seed: int) -> Measurement:
    rng = np.random.default_rng(seed)
    return Measurement(
        angular_velocity=rng.standard_normal(3),
        projected_gravity=np.array([0.0, 0.0, -1.0]),
        position=rng.standard_normal(12),
        velocity=rng.standard_normal(12),
    )


def ranges(**changes: Any) -> dict[str, Any]:
    stated: dict[str, Any] = {
        "lin_vel_x": [-1.0, 2.0],
        "lin_vel_y": [-0.5, 0.5],
        "ang_vel_z": [-1.5, 1.0],
    }
    stated.update(changes)
    stated = {name: value for name, value in stated.items() if value != "absent"}
    return {"base_velocity": {"ranges": stated}}


def test_it_acts_as_the_policy_it_wraps(tmp_path: Path) -> None:
    path, deploy_path = write_foreign(tmp_path, random_weights(), commands=ranges())
    deployed = open_policy(path, GO2, deploy_path)
    deploy = read_deploy_yaml(deploy_path)
    plain = ForeignPolicy(load_foreign_network(path, deploy), deploy)
    sibling = deployed.sibling()
    for seed in range(4):
        command = (0.3, -0.1, 0.2)
        target = deployed.step(measured(seed), command)
        np.testing.assert_array_equal(target, plain.step(measured(seed), command))
        sibling.step(measured(seed + 10), command)
        assert deployed.inference is not None
        # Actions are in the order of the robot's file, as the targets are.
        np.testing.assert_allclose(
            target, deployed.start_position + 0.25 * deployed.inference.action[0], atol=1e-6
        )
        assert np.isnan(deployed.inference.contact).all()
    assert deployed.rate_hz == pytest.approx(50.0)
    assert deployed.delay_range_s == UNKNOWN_DELAY_S
    expected = {"vx": (-1.0, 2.0), "vy": (-0.5, 0.5), "yaw_rate": (-1.5, 1.0)}
    assert dict(deployed.command_ranges) == expected
    with pytest.raises(ArtefactError):
        deployed.step(measured(0), (0.0, 0.0, 0.0), jump=True)


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({"commands": ranges(lin_vel_y="absent")}, "lin_vel_y"),
        ({"commands": ranges(ang_vel_z=[-math.inf, 1.0])}, "ang_vel_z"),
        ({"commands": None}, "lin_vel_x"),
        ({"stiffness": [120.0] * 12}, "stiffness"),
        ({"damping": [9.0] * 12}, "damping"),
        ({"step_dt": 0.1}, "step_dt"),
        ({"step_dt": 0.0005}, "step_dt"),
        # Hips where calves are: -1.5 rad is out of their range, and +0.1 out of a calf's.
        ({"joint_ids_map": [5, 4, 3, 2, 1, 0, 11, 10, 9, 8, 7, 6]}, "default_joint_pos"),
    ],
)
def test_what_must_not_run_on_a_robot_is_refused(
    changes: dict[str, Any], names: str, tmp_path: Path
) -> None:
    path, deploy_path = write_foreign(tmp_path, **changes)
    with pytest.raises(ArtefactError, match=names):
        open_policy(path, GO2, deploy_path)


def test_a_network_without_a_contract_names_the_way_out(tmp_path: Path) -> None:
    path, _ = write_foreign(tmp_path)
    with pytest.raises(ArtefactError, match="--deploy"):
        open_policy(path, GO2)


def test_the_drives_get_its_gains_only_with_its_targets(tmp_path: Path) -> None:
    stiffness = [25.0 + number for number in range(12)]
    _, deploy_path = write_foreign(tmp_path, stiffness=stiffness, damping=[0.8] * 12)
    link = Link(robot="go2")
    plan = RunPlan(link=link, policy=tmp_path / "policy.onnx", deploy_yaml=deploy_path)
    machine = StateMachine(GO2, RunTiming(check_s=0.0), policy_gains=plan.policy_gains())
    safety = SafetyFilter(limits=Limits.of(GO2))
    pose = np.array([joint.default_position for joint in GO2.joints])
    lying = np.array([joint.folded_position for joint in GO2.joints])
    machine.preflighted((), 0.0)
    machine.request(OperatorRequest.STAND)
    machine.step(1.0, lying, safety, None)
    assert machine.mode is Mode.STAND
    # From the drives' own gains to those of standing in the rise.
    own = machine.step(1.9, lying, safety, None).command
    assert own is not None
    np.testing.assert_allclose(own.stiffness, 20.0)
    standing_command = machine.step(10.0, pose, safety, None).command
    assert standing_command is not None
    np.testing.assert_allclose(standing_command.stiffness, 60.0)
    np.testing.assert_allclose(standing_command.damping, 5.0)
    machine.request(OperatorRequest.WALK)
    machine.step(11.0, pose, safety, None)
    assert machine.mode is Mode.POLICY
    action = np.zeros((), dtype=ACTIONS)
    action["mode_count"] = machine.mode_count
    action["position"] = pose
    action["valid_for"] = 0.05
    first = machine.step(11.02, pose, safety, action).command
    assert first is not None
    np.testing.assert_allclose(first.stiffness, 60.0)
    last = machine.step(12.0, pose, safety, action).command
    assert last is not None
    np.testing.assert_allclose(last.stiffness, stiffness)
    np.testing.assert_allclose(last.damping, 0.8)


def test_its_process_gives_its_targets_and_logs_what_it_has(tmp_path: Path) -> None:
    path, deploy_path = write_foreign(tmp_path, random_weights(), commands=ranges())
    shared = Shared()
    try:
        plan = RunPlan(link=Link(robot="go2"), policy=path, deploy_yaml=deploy_path)
        process = PolicyProcess(plan, shared, open_policy(path, GO2, deploy_path))
        record = np.zeros((), dtype=state_dtype(12))
        put_state(record, standing(process.policy.start_position))
        record["mode"] = Mode.POLICY
        record["mode_count"] = 4
        shared.state.write(record)
        process.step(Pace(50.0))
        action = shared.actions.read()
        assert action is not None
        expected = open_policy(path, GO2, deploy_path)
        still = replace(standing(expected.start_position), time=0.0)
        target = expected.step(
            Measurement(
                angular_velocity=still.gyro,
                projected_gravity=np.array([0.0, 0.0, -1.0]),
                position=still.position,
                velocity=still.velocity,
            ),
            (0.0, 0.0, 0.0),
        )
        np.testing.assert_allclose(action["position"], target)
        (step,) = shared.steps.take()
        assert np.isnan(step["observation"]).all()
        assert np.isfinite(step["action"]).all()
    finally:
        shared.close()


def test_the_pose_it_starts_in_is_that_of_the_file(tmp_path: Path) -> None:
    path, deploy_path = write_foreign(tmp_path)
    start = open_policy(path, GO2, deploy_path).start_position
    expected = np.empty(12)
    expected[list(UNITREE_ORDER)] = POSE
    np.testing.assert_allclose(start, expected)
    assert deploy_body()["step_dt"] == 0.02
