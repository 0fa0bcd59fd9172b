"""A policy runs the virtual robot: its measurements, commands and times."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hopper import DEFAULT, ROBOT, STRAIGHT, write_hopper
from pronk.errors import ArtefactError, HardwareError
from pronk.links.machine import Command, State
from pronk.policy.runtime import Policy, load_policy
from pronk.runtime.rollout import (
    Tick,
    check_standing,
    projected_gravity,
    run_policy,
    ticks,
)
from pronk.runtime.script import STILL, Script
from pronk.virtual.ground import Start
from pronk.virtual.robot import VirtualRobot
from pronk.virtual.sim_params import load_sim_params

pytest.importorskip("onnxruntime")

HOP = Script(command=(1.0, 0.5, -0.5), stand_s=0.1, run_s=0.1, jump_s=0.1, keep_s=0.0, stop_s=0.1)


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Policy:
    return load_policy(write_hopper(tmp_path_factory.mktemp("hopper") / "policy.onnx"))


class Tapped(VirtualRobot):
    """A virtual robot that remembers what it was sent, and when."""

    def connect(self) -> None:
        super().connect()
        self.sent: list[tuple[float, Command]] = []

    def send(self, command: Command) -> None:
        self.sent.append((self.now(), command))
        super().send(command)


def standing(seed: int = 0) -> Tapped:
    machine = Tapped(ROBOT, load_sim_params(), seed=seed, base="ground", start=Start(yaw=0.5))
    machine.connect()
    return machine


def state(**changes: object) -> State:
    kept = State(
        time=0.0,
        sequence=0,
        position=DEFAULT,
        velocity=np.zeros(12),
        torque=np.zeros(12),
        gyro=np.array([0.1, 0.2, 0.3]),
        accelerometer=np.zeros(3),
        bus_voltage=24.0,
    )
    return replace(kept, **changes)  # type: ignore[arg-type]


def test_gravity_is_that_of_the_rotation() -> None:
    rng = np.random.default_rng(0)
    for rotation in Rotation.random(50, rng=rng):
        expected = rotation.inv().apply([0.0, 0.0, -1.0])
        assert projected_gravity(rotation.as_quat(scalar_first=True)) == pytest.approx(expected)


def test_commands_are_sent_on_time_with_the_drives_own_gains(policy: Policy) -> None:
    machine = standing()
    flown = run_policy(machine, policy, ROBOT, HOP.commanded, seconds=HOP.seconds)
    count = round(HOP.seconds * 50)
    assert len(machine.sent) == len(flown.time) == count == 20
    for k, (now, command) in enumerate(machine.sent):
        assert now == command.made == pytest.approx(k / 50)
        assert command.sequence == k
        assert command.state_sequence == flown.state_sequence[k] == 10 * k  # 500 states a second
        assert command.stiffness == pytest.approx(17.0)
        assert command.damping == pytest.approx(0.4)
        assert command.position == pytest.approx(flown.target[k])
    assert machine.now() == pytest.approx(HOP.seconds)


def test_the_record_is_what_happened(policy: Policy) -> None:
    flown = run_policy(standing(), policy, ROBOT, HOP.commanded, seconds=HOP.seconds)
    assert flown.began == 0.0
    assert flown.time == pytest.approx(np.arange(20) / 50)
    assert np.flatnonzero(flown.jump).tolist() == [10, 11, 12, 13, 14]
    assert flown.command[:5] == pytest.approx(0.0)
    assert flown.command[5:15] == pytest.approx(np.tile(HOP.command, (10, 1)))
    expected = DEFAULT + flown.jump[:, None] * STRAIGHT
    assert flown.target == pytest.approx(expected, abs=1e-6)
    assert flown.action == pytest.approx((flown.target - DEFAULT) / 0.5, abs=1e-6)
    assert flown.contact == pytest.approx(1.0)
    assert flown.linear_velocity == pytest.approx(0.0)
    assert np.linalg.norm(flown.projected_gravity, axis=1) == pytest.approx(1.0)
    # A robot that is thrown up moves its knees.
    assert np.abs(flown.velocity[13]).max() > 5.0


def test_a_repeat_is_the_same_to_the_last_digit(policy: Policy) -> None:
    one, two = (
        run_policy(standing(7), policy, ROBOT, HOP.commanded, seconds=0.3) for _ in range(2)
    )
    other = run_policy(standing(8), policy, ROBOT, HOP.commanded, seconds=0.3)
    assert np.array_equal(one.position, two.position)
    assert not np.array_equal(one.position, other.position)


def test_a_caller_reads_every_tick_and_can_stop(policy: Policy) -> None:
    seen: list[Tick] = []
    flown = run_policy(
        standing(), policy, ROBOT, lambda t: (STILL, False), seconds=0.1, watch=seen.append
    )
    assert [tick.since for tick in seen] == pytest.approx(flown.time)
    machine = standing()
    for tick in ticks(machine, policy, ROBOT, lambda t: (STILL, False)):
        if tick.since > 0.09:
            break
    assert len(machine.sent) == 6
    assert machine.now() == pytest.approx(0.1)


def test_a_clock_that_runs_ahead_loses_ticks_and_no_time(policy: Policy) -> None:
    machine = standing()
    commanded: list[float] = []

    def slow(t: float) -> tuple[tuple[float, float, float], bool]:
        commanded.append(t)
        if len(commanded) == 2:
            machine.wait(machine.now() + 0.05)  # one decision takes 2.5 ticks
        return STILL, False

    run_policy(machine, policy, ROBOT, slow, seconds=0.2)
    assert commanded == pytest.approx([0.0, 0.02, 0.08, 0.1, 0.12, 0.14, 0.16, 0.18])


def test_a_policy_of_another_robot_sends_nothing(tmp_path: Path) -> None:
    names = (*ROBOT.joint_names[1:], ROBOT.joint_names[0])
    other = load_policy(write_hopper(tmp_path / "other.onnx", joint_names=names))
    machine = standing()
    with pytest.raises(ArtefactError, match="joint_names"):
        run_policy(machine, other, ROBOT, HOP.commanded, seconds=1.0)
    assert machine.sent == []


def test_who_does_not_stand_is_not_flown() -> None:
    check_standing(ROBOT, state())
    bent = DEFAULT.copy()
    bent[2] += 0.6
    with pytest.raises(HardwareError, match=r"^FR_knee is at 2\.\d+ rad; .*\.$"):
        check_standing(ROBOT, state(position=bent))
    lying = Rotation.from_euler("x", 90.0, degrees=True).as_quat(scalar_first=True)
    with pytest.raises(HardwareError, match="tilted by 90 degrees"):
        check_standing(ROBOT, state(orientation=lying))
    with pytest.raises(HardwareError, match="nan rad"):
        check_standing(ROBOT, state(position=np.full(12, np.nan)))
