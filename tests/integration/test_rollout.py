"""A policy runs the virtual robot: its measurements, commands and times."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hopper import DEFAULT, ROBOT, STRAIGHT, write_hopper
from pronk.errors import ArtefactError, HardwareError
from pronk.jump.virtual.ground import Start
from pronk.jump.virtual.robot import VirtualRobot
from pronk.jump.virtual.sim_params import load_sim_params
from pronk.policy.rollout import check_standing, projected_gravity, ticks
from pronk.policy.runtime import Policy, load_policy
from pronk.policy.script import STILL, Script
from pronk.robots.machine import Command

pytest.importorskip("onnxruntime")

HOP = Script(command=(1.0, 0.5, -0.5), stand_s=0.1, run_s=0.1, jump_s=0.1, keep_s=0.0, stop_s=0.1)


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Policy:
    return load_policy(write_hopper(tmp_path_factory.mktemp("hopper") / "policy.onnx"))


class RecordedRobot(VirtualRobot):
    """A virtual robot that remembers what it was sent, and when."""

    def connect(self) -> None:
        super().connect()
        self.sent: list[tuple[float, Command]] = []

    def send(self, command: Command) -> None:
        self.sent.append((self.now(), command))
        super().send(command)


def standing() -> RecordedRobot:
    machine = RecordedRobot(ROBOT, load_sim_params(), base="ground", start=Start(yaw=0.5))
    machine.connect()
    return machine


def test_gravity_is_that_of_the_rotation() -> None:
    for rotation in Rotation.random(50, rng=np.random.default_rng(0)):
        expected = rotation.inv().apply([0.0, 0.0, -1.0])
        assert projected_gravity(rotation.as_quat(scalar_first=True)) == pytest.approx(expected)


def run(machine: VirtualRobot, policy: Policy) -> list[Any]:
    """Time, state and outputs of the network of each tick."""
    steps = ticks(machine, policy, ROBOT, HOP.commanded, seconds=HOP.seconds)
    return [(since, machine.latest(), policy.inference) for since in steps]


def test_commands_are_sent_on_time_with_the_gains_of_the_drives(policy: Policy) -> None:
    machine = standing()
    taken = run(machine, policy)
    assert len(machine.sent) == len(taken) == round(HOP.seconds * 50) == 20
    pairs = zip(machine.sent, taken, strict=True)
    for k, ((now, command), (since, state, outputs)) in enumerate(pairs):
        assert now == command.made == since == pytest.approx(k / 50)
        assert command.sequence == k
        assert command.state_sequence == state.sequence == 10 * k  # 500 states a second
        assert command.stiffness == pytest.approx(17.0)
        assert command.damping == pytest.approx(0.4)
        jump = 10 <= k < 15
        assert command.position == pytest.approx(DEFAULT + jump * STRAIGHT, abs=1e-6)
        assert outputs.action[0] == pytest.approx((command.position - DEFAULT) / 0.5, abs=1e-6)
        assert outputs.contact[0] == pytest.approx(1.0)
        assert outputs.linear_velocity[0] == pytest.approx(0.0)
        # A robot that is thrown up moves its knees.
        assert k != 13 or np.abs(state.velocity).max() > 5.0
    assert machine.now() == pytest.approx(HOP.seconds)


def test_a_clock_that_runs_ahead_loses_ticks_and_no_time(policy: Policy) -> None:
    machine = standing()
    commanded: list[float] = []

    def slow(t: float) -> tuple[tuple[float, float, float], bool]:
        commanded.append(t)
        if len(commanded) == 2:
            machine.wait(machine.now() + 0.05)  # one step takes 2.5 ticks
        return STILL, False

    list(ticks(machine, policy, ROBOT, slow, seconds=0.2))
    assert commanded == pytest.approx([0.0, 0.02, 0.08, 0.1, 0.12, 0.14, 0.16, 0.18])


def test_a_policy_of_another_robot_sends_nothing(tmp_path: Path) -> None:
    names = (*ROBOT.joint_names[1:], ROBOT.joint_names[0])
    other = load_policy(write_hopper(tmp_path / "other.onnx", joint_names=names))
    machine = standing()
    with pytest.raises(ArtefactError, match="joint_names"):
        run(machine, other)
    assert machine.sent == []


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"position": DEFAULT + 0.6 * np.eye(12)[2]}, "FR_knee"),
        ({"position": np.full(12, np.nan)}, "nan"),
        ({"orientation": np.sqrt([0.5, 0.5, 0.0, 0.0])}, "90 degrees"),
    ],
)
def test_a_robot_that_does_not_stand_is_refused(changes: dict[str, Any], message: str) -> None:
    state = standing().latest()
    check_standing(ROBOT, state)
    with pytest.raises(HardwareError, match=message):
        check_standing(ROBOT, replace(state, **changes))
