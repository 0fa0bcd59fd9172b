"""The parameters of the virtual robot: what is refused, and with which words."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from pronk.errors import RobotError
from pronk.jump.virtual.plant import Plant
from pronk.jump.virtual.robot import VirtualRobot, hold_of
from pronk.jump.virtual.sim_params import SHIPPED, load_sim_params, parse_sim_params
from pronk.robots import load_robot
from pronk.robots.legged import legged
from sized_joint import SIZES, sized_robot

BODY: dict[str, Any] = yaml.safe_load(SHIPPED.read_text(encoding="utf-8"))
ROBOT = load_robot("mini_cheetah")


MISSING = object()
"""In place of a value: the entry is left out."""


def changed(path: str, value: Any) -> dict[str, Any]:
    """Return the shipped file with one entry replaced, or without it."""
    body = copy.deepcopy(BODY)
    keys = path.split(".")
    section = body
    for key in keys[:-1]:
        section = section[key]
    if value is MISSING:
        del section[keys[-1]]
    else:
        section[keys[-1]] = value
    return body


def test_shipped_parameters_are_plausible_and_differ_between_joints() -> None:
    sim_params = load_sim_params()
    sim_params.check_joints(ROBOT.joint_names)
    assert sim_params.robot == ROBOT.name
    for name, joint in sim_params.joints.items():
        assert 0.8 <= joint.link_inertia_scale <= 1.3, name
        assert 0.8 <= joint.torque_scale <= 1.45, name
        assert 0.0 <= joint.viscous <= 0.15, name
        # Between the two published figures (reading A11), less or more some per cent.
        assert 0.95 * 63e-6 <= joint.rotor_inertia <= 1.05 * 72e-6, name
        assert 0.0 < joint.coulomb < 0.25, name
    for name in ("coulomb", "link_inertia_scale", "belt_stiffness", "encoder_offset"):
        values = {getattr(joint, name) for joint in sim_params.joints.values()}
        assert len(values) > len(sim_params.joints) // 2, name


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("joints.FR_knee.link_inertia_scale", -1),
        ("joints.FR_knee.rotor_inertia", 0),
        ("joints.HL_hip_roll.viscous", float("nan")),
        ("joints.HL_hip_roll.coulomb", "much"),
        ("joints.HL_hip_roll.coulomb", True),
        ("joints.HL_hip_roll.coulomb", 9.0),
        ("joints.HL_hip_roll", 3),
        ("joints", {}),
        ("machine.encoder_bits", 14.5),
        ("imu.gyro_bias", [0.0, 1.0]),
        ("imu", MISSING),
        ("machine.gyro_bias", [0.0, 0.0, 0.0]),
        ("machine.bus_voltage", -24),
        ("machine.bus_voltage", None),
        ("machine.command_delay", 0.002),
        ("ground.friction", "ice"),
        ("ground.terrain", []),
        ("trunk.inertia_scale", [1, -1, 1]),
        ("attitude.noise", float("nan")),
        ("robot", 7),
        ("colour", "red"),
        ("schema", "pronk/gains/1"),
        ("joints.FR_knee.coulomb", MISSING),
    ],
)
def test_impossible_fields_are_named(path: str, value: Any) -> None:
    with pytest.raises(RobotError, match=path.split(".")[-1]) as caught:
        parse_sim_params(changed(path, value), "my.yaml")
    assert str(caught.value).startswith("my.yaml: ")
    assert "\n" not in str(caught.value)


def test_the_virtual_go2_has_hidden_parameters_of_its_own() -> None:
    go2 = load_robot("go2")
    params = load_sim_params(None, go2)
    assert params.robot == "go2"
    params.check_joints(go2.joint_names)
    for joint in go2.joints:
        hidden = params.joints[joint.name]
        assert 0.9 <= hidden.torque_scale <= 1.1, joint.name
        assert hidden.torque_scale != 1.0, joint.name
        assert 0.0 < hidden.load_friction < 0.1, joint.name
        assert hidden.rotor_inertia == pytest.approx(joint.drive.rotor_inertia, rel=0.15)
        assert hidden.rotor_inertia != joint.drive.rotor_inertia, joint.name
        assert hidden.coulomb != joint.drive.frictionloss, joint.name
    # A command and its state pass the network and the robot's computer at 500 Hz.
    assert params.machine.command_delay_s + params.machine.measurement_delay_s >= 0.002
    # Another model that has this name is no Go2.
    arm = replace(load_robot("so101"), name="go2")
    assert set(load_sim_params(None, arm).joints) == set(arm.joint_names)


@pytest.mark.parametrize("name", ["mini_cheetah", "go2"])
def test_a_foot_that_carries_twice_the_weight_is_not_pressed_in_beyond_its_centre(
    name: str,
) -> None:
    robot = load_robot(name)
    body = legged(robot.source)
    ground = load_sim_params(None, robot).ground
    assert ground.stiffness * body.foot_radius > 2.0 * body.total_mass * 9.81


def test_friction_grows_with_the_load() -> None:
    go2 = load_robot("go2")
    shipped = load_sim_params(None, go2)
    torques = {}
    for share in (0.0, 0.3):
        joints = {}
        for name, joint in shipped.joints.items():
            joints[name] = replace(joint, load_friction=share, encoder_offset=0.0)
        machine = VirtualRobot(go2, replace(shipped, joints=joints), legs=("FR",))
        machine.connect()
        hold = hold_of(go2)
        position = np.array(hold.position)
        spans = []
        # A slow way up and down: half of the difference in torque at one angle is the friction.
        for tick in range(800):
            phase = 2.0 * np.pi * tick / 400.0
            position[1] = hold.position[1] + 0.3 * np.sin(phase)
            machine.send(replace(hold, position=position.copy()))
            machine.wait(machine.now() + 0.01)
            if tick >= 400:
                spans.append((machine.latest().position[1], machine.latest().torque[1], phase))
        up = [torque for angle, torque, phase in spans if np.cos(phase) > 0.9]
        down = [torque for angle, torque, phase in spans if np.cos(phase) < -0.9]
        torques[share] = 0.5 * (np.mean(up) - np.mean(down)), abs(np.mean(up + down))
    friction, load = torques[0.0]
    assert torques[0.3][0] - friction == pytest.approx(0.3 * load, rel=0.35)


def test_an_older_schema_is_refused_with_what_changed() -> None:
    with pytest.raises(RobotError, match="section `imu`"):
        parse_sim_params(changed("schema", "pronk/sim_params/1"), "my.yaml")


def test_other_joints_are_refused() -> None:
    sim_params = load_sim_params()
    joints = dict(sim_params.joints)
    knee = joints.pop("HR_knee")
    with pytest.raises(RobotError, match=r"joints\.HR_knee"):
        Plant(ROBOT, replace(sim_params, joints=joints), ("FR",), 0.25e-3)
    joints["HR_knee"] = knee
    joints["tail"] = knee
    with pytest.raises(RobotError, match=r"joints\.tail"):
        Plant(ROBOT, replace(sim_params, joints=joints), ("FR",), 0.25e-3)


def test_belts_too_stiff_for_the_step_are_refused() -> None:
    sim_params = load_sim_params()
    joints = dict(sim_params.joints)
    joints["FR_hip_roll"] = replace(joints["FR_hip_roll"], belt_stiffness=9e4)
    stiff = replace(sim_params, joints=joints)
    with pytest.raises(RobotError, match="belt_stiffness"):
        Plant(ROBOT, stiff, ("FR",), 0.25e-3)
    Plant(ROBOT, stiff, ("FR",), 0.025e-3)


def test_files_are_read_or_refused(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    with pytest.raises(RobotError, match=r"mine\.yaml"):
        load_sim_params(path)
    for text in ("joints: [unclosed", ""):
        path.write_text(text)
        with pytest.raises(RobotError, match=r"mine\.yaml"):
            load_sim_params(path)
    path.write_text(yaml.safe_dump(changed("machine.bus_voltage", 22.0)))
    shipped = load_sim_params()
    machine = replace(shipped.machine, bus_voltage=22.0)
    assert load_sim_params(path) == replace(shipped, machine=machine)


def test_trunk_attitude_and_ground_may_be_left_out() -> None:
    required = ("schema", "robot", "machine", "imu", "fixture", "joints")
    body = {name: BODY[name] for name in required}
    sim_params = parse_sim_params(body | {"trunk": {"mass_offset": 1}}, "my.yaml")
    assert sim_params.trunk.mass_offset == 1.0
    assert sim_params.attitude.noise == 0.0


def test_the_measured_speed_of_a_slow_joint_resolves_its_limit(tmp_path: Path) -> None:
    """A sweep ends where a measured speed exceeds the no-load speed, noise included."""
    robot = sized_robot(SIZES["knee without armature"], tmp_path)
    joints = []
    for joint in robot.joints:
        joints.append(replace(joint, drive=replace(joint.drive, no_load_speed=1.0)))
    robot = replace(robot, joints=tuple(joints))
    machine = VirtualRobot(robot, load_sim_params(None, robot))
    machine.connect()
    speeds = np.array([state.velocity for state in machine.wait(1.0)])
    assert np.std(speeds, axis=0).max() < 0.01
    assert np.abs(speeds).max() < 0.05
