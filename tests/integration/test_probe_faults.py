"""`pronk probe` on simulators of many laws, each with one fault or a defect of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from command_line import refused
from pronk.arrays import Array
from pronk.cli.probe import acting_table
from pronk.errors import PronkError
from pronk.identify.simulators.info import SimulatorInfo
from pronk.identify.simulators.probe.probe import probe_joint
from pronk.identify.simulators.probe.result import Probe
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec

INERTIA = 0.003
"""Inertia of the link [kg m^2]."""
WEIGHT = 0.1962
"""Torque of its weight where it is level [N m]."""
MODEL = """
<mujoco model="bar"><worldbody><body name="link">
  <joint name="swing" axis="0 1 0"/>
  <inertial pos="0 0 -0.1" mass="0.2" diaginertia=".001 .001 .001"/>
</body></worldbody></mujoco>
"""
ROBOT = """
schema: pronk/robot/1
name: bar
model: bar.xml
drives:
  motor: {effort_limit: 20, stall_torque: 20, no_load_speed: 60, armature: 0.0063,
    frictionloss: 0.05, viscous_damping: 0.02}
groups:
  swing: {drive: motor, stiffness: 17, damping: 0.4, band_hz: [1, 15]}
poses:
  default: {swing: 0.2}
"""
LAWS = {
    "E": ("explicit", 1),
    "IF": ("implicit_damping", 1),
    "I1": ("implicit", 1),
    "I5": ("implicit", 5),
}
FEW_STEPS = 100_000
"""Integration steps of the fits to motion that no law explains, which take all that they have."""


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> RobotSpec:
    folder = tmp_path_factory.mktemp("bar")
    (folder / "bar.xml").write_text(MODEL)
    (folder / "robot.yaml").write_text(ROBOT)
    return load_robot(str(folder / "robot.yaml"))


@dataclass(frozen=True, kw_only=True)
class Truth:
    """How the simulator moves the joint."""

    law: str = "E"
    stated: str = ""
    """Law that it states; `law` if empty."""
    stiffness_factor: float = 1.0
    damping_factor: float = 1.0
    armature_floor: float = 0.0
    viscous: float = 0.02
    friction: float = 0.05
    delay_steps: float = 0.0
    stale_position: int = 0
    stale_speed: int = 0
    torque_limit: float = np.inf
    command_limit: float = np.inf


class Bar:
    """A simulator of one joint."""

    def __init__(self, robot: RobotSpec, truth: Truth) -> None:
        kind, iterations = LAWS[truth.stated or truth.law]
        self.truth = truth
        self.joints = robot.joint_names
        self.parameters = frozenset({"stiffness", "damping", "armature", "frictionloss"})
        self.armature = robot.joint("swing").drive.armature
        self.info = SimulatorInfo(
            engine="bar", timestep_s=0.005, decimation=4, law=kind, iterations=iterations
        )

    def rollout(
        self, command: Array, values: Mapping[str, Array], *, locked: Sequence[str] = ()
    ) -> Array:
        """See `Simulator.rollout`."""
        truth = self.truth
        kind, iterations = LAWS[truth.law]
        h = self.info.timestep_s / iterations
        kp = truth.stiffness_factor * values["stiffness"][:, 0]
        kd = truth.damping_factor * values["damping"][:, 0]
        armature = np.full(len(kp), self.armature)
        if "armature" in values:
            armature = values["armature"][:, 0]
        inertia = INERTIA + np.maximum(armature, truth.armature_floor)
        limited = np.clip(command[..., 0], -truth.command_limit, truth.command_limit)
        steps = np.arange(command.shape[1])
        share = truth.delay_steps % 1.0
        whole = int(truth.delay_steps)
        target = (1.0 - share) * limited[:, np.maximum(steps - whole, 0)]
        target = target + share * limited[:, np.maximum(steps - whole - 1, 0)]
        q = command[:, 0, 0].copy()
        v = np.zeros(len(kp))
        positions = np.empty(command.shape)
        speeds = np.empty(command.shape)
        for step in steps:
            positions[:, step, 0] = q
            speeds[:, step, 0] = v
            read_position = positions[:, max(step - truth.stale_position, 0), 0]
            read_speed = speeds[:, max(step - truth.stale_speed, 0), 0]
            for _ in range(iterations):
                if kind == "explicit":
                    torque = kp * (target[:, step] - read_position) - kd * read_speed
                    mass = inertia
                elif kind == "implicit_damping":
                    torque = kp * (target[:, step] - read_position) - kd * v
                    mass = inertia + h * kd
                else:
                    torque = kp * (target[:, step] - q - h * v) - kd * v
                    mass = inertia + h * kd + h * h * kp
                torque = np.clip(torque, -truth.torque_limit, truth.torque_limit)
                mass = mass + h * truth.viscous
                v = v + h * (torque - truth.viscous * v - WEIGHT * np.sin(q)) / mass
                v = np.sign(v) * np.maximum(np.abs(v) - h * truth.friction / mass, 0.0)
                q = q + h * v
        return positions


def probed(robot: RobotSpec, **changes: Any) -> Probe:
    return probe_joint(Bar(robot, Truth(**changes)), robot)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize(
    ("changes", "faults"),
    [
        ({}, set()),
        ({"delay_steps": 1.0}, {"delay"}),
        ({"delay_steps": 2.8}, {"delay"}),
        ({"viscous": 0.1}, {"passive"}),
        ({"friction": 0.2}, {"friction"}),
        ({"stiffness_factor": 2.0, "damping_factor": 2.0}, {"twice"}),
        ({"armature_floor": 0.02}, {"ignored"}),
        ({"damping_factor": 1.5}, {"damping"}),
    ],
)
def test_each_fault_of_each_law_is_named_and_no_other(
    law: str, changes: dict[str, Any], faults: set[str], robot: RobotSpec
) -> None:
    probe = probed(robot, law=law, **changes)
    assert set(probe.faults) == faults
    assert probe.law.drive.label == law
    assert probe.delay_s == pytest.approx(0.005 * changes.get("delay_steps", 0.0), abs=1e-4)
    if "armature_floor" in changes:
        assert probe.armature == pytest.approx(0.02, rel=0.02)
    if "viscous" in changes:
        assert probe.viscous_damping == pytest.approx(0.1, rel=0.05)


def test_gains_per_degree_are_named(robot: RobotSpec) -> None:
    scale = float(np.pi / 180.0)
    probe = probed(robot, stiffness_factor=scale, damping_factor=scale, friction=0.0)
    assert "degrees" in probe.faults


@pytest.mark.parametrize("law", ["E", "IF"])
def test_an_old_position_is_named_as_such(law: str, robot: RobotSpec) -> None:
    probe = probed(robot, law=law, stale_position=1)
    assert set(probe.faults) == {"stale"}
    assert probe.law.stale_position == 1
    assert probe.law.stale_speed == 0
    assert probe.law.drive.label == law
    # The gains are those that are set: the age is no damping.
    assert probe.gains.damping_factor == pytest.approx(1.0, rel=1e-3)
    # Stiffness times a step.
    assert "0.085" in probe.faults["stale"]


def test_an_old_state_is_named_as_such(robot: RobotSpec) -> None:
    probe = probed(robot, stale_position=1, stale_speed=1)
    assert probe.law.stale_position == 1
    assert probe.law.stale_speed == 1
    assert set(probe.faults) == {"stale"}


@pytest.mark.parametrize("torque_limit", [0.8, 2.0, 4.0, 12.0])
@pytest.mark.parametrize("delay_steps", [0.0, 0.4, 1.9])
def test_a_clipped_torque_is_named_with_its_limit(
    torque_limit: float, delay_steps: float, robot: RobotSpec
) -> None:
    probe = probed(robot, torque_limit=torque_limit, delay_steps=delay_steps)
    assert "clipped" in probe.faults
    assert probe.law.clip == pytest.approx(torque_limit, rel=0.1)
    assert probe.law.drive.label == "E"
    assert probe.gains.stiffness_factor == pytest.approx(1.0, rel=0.02)


@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_the_limit_of_the_robots_file_is_no_fault(factor: float, robot: RobotSpec) -> None:
    probe = probed(robot, torque_limit=20.0, stiffness_factor=factor, damping_factor=factor)
    assert "clipped" not in probe.faults


def test_a_clipped_command_is_not_taken_for_a_torque(robot: RobotSpec) -> None:
    probe = probed(robot, command_limit=0.5)
    assert "command" in probe.faults["clipped"]
    assert "torque" not in probe.faults["clipped"]


@pytest.mark.parametrize("law", ["E", "IF"])
def test_without_damping_no_law_is_claimed_that_moves_alike(law: str, robot: RobotSpec) -> None:
    """Explicit and implicit damping are the same where there is none."""
    for stated in ("E", "IF"):
        probe = probed(robot, law=law, stated=stated, damping_factor=0.0, viscous=0.05)
        assert "law" not in probe.faults
        assert probe.gains.damping_factor == pytest.approx(0.0, abs=1e-3)
        assert probe.law.drive.label == stated
        assert {other.drive.label for other in probe.alike} == {"E", "IF"} - {stated}


@pytest.mark.parametrize(
    "defect",
    [
        "nothing moves",
        "no number",
        "raises",
        "other shape",
        "random walk",
    ],
)
def test_no_simulator_breaks_the_probe(defect: str, robot: RobotSpec) -> None:
    generator = np.random.default_rng(3)

    class Defective(Bar):
        def rollout(
            self, command: Array, values: Mapping[str, Array], *, locked: Sequence[str] = ()
        ) -> Array:
            if defect == "raises":
                raise KeyError("swing")
            if defect == "nothing moves":
                return np.zeros(command.shape)
            if defect == "no number":
                return np.full(command.shape, np.nan)
            if defect == "random walk":
                return 0.02 * np.cumsum(generator.standard_normal(command.shape), axis=1)
            return np.zeros(command.shape[:2])

    simulator = Defective(robot, Truth())
    if defect == "random walk":
        try:
            probe = probe_joint(simulator, robot, most_steps=FEW_STEPS)
        except PronkError:
            return
        assert "residual" in probe.faults
        assert "law" not in probe.faults
        return
    with pytest.raises(PronkError):
        probe_joint(simulator, robot)


def test_the_command_names_an_exception_of_the_simulator(tmp_path: Path) -> None:
    (tmp_path / "bar.xml").write_text(MODEL)
    (tmp_path / "robot.yaml").write_text(ROBOT)
    module = tmp_path / "broken.py"
    module.write_text(
        "from pronk.identify.simulators.info import SimulatorInfo\n"
        "class Broken:\n"
        "    def __init__(self, robot):\n"
        "        self.info = SimulatorInfo(engine='broken')\n"
        "        self.joints = robot.joint_names\n"
        "        self.parameters = frozenset({'stiffness', 'damping'})\n"
        "    def rollout(self, command, values, *, locked=()):\n"
        "        return 1 / 0\n"
    )
    error = refused("probe", f"{module}:Broken", "--robot", tmp_path / "robot.yaml")
    assert "ZeroDivisionError" in error


def test_a_search_that_ends_early_names_no_fault(robot: RobotSpec) -> None:
    """With few integration steps not all laws are fitted, and a wrong one may be the best."""
    simulator = Bar(robot, Truth(law="I5", stated="E", friction=0.2))
    probe = probe_joint(simulator, robot, most_steps=10_000)
    assert not probe.complete
    assert "incomplete" in probe.faults
    assert not {"law", "stiffness", "damping", "armature"} & set(probe.faults)


def test_a_law_that_is_none_of_them_is_said_to_be_so(robot: RobotSpec) -> None:
    """Positions that are not in proportion to the motion follow none of the laws."""

    class Odd(Bar):
        def rollout(
            self, command: Array, values: Mapping[str, Array], *, locked: Sequence[str] = ()
        ) -> Array:
            positions = super().rollout(command, values, locked=locked)
            moved = positions - command[:, :1]
            return command[:, :1] + np.round(6.0 * moved * np.abs(moved), 2)

    simulator = Odd(robot, Truth())
    probe = probe_joint(simulator, robot, most_steps=FEW_STEPS)
    assert "residual" in probe.faults
    assert not {"law", "stiffness", "damping", "armature"} & set(probe.faults)
    # Nor are values of the law printed that explains the motion least badly.
    table = acting_table(probe, robot.joint("swing"), simulator.info)
    acting = {str(row[0]): row[2] for row in table.rows}
    assert acting.pop("law") in ("none of the laws", "not found")
    assert acting.pop("hold [steps]") == 1
    assert set(acting.values()) == {None}
