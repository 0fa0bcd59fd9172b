"""The parameters of the virtual robot: what is refused, and with which words."""

from __future__ import annotations

import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from pronk.errors import RobotError
from pronk.robots import load_robot
from pronk.virtual.plant import build_plant
from pronk.virtual.sim_params import SHIPPED, load_sim_params, parse_sim_params

BODY: dict[str, Any] = yaml.safe_load(SHIPPED.read_text(encoding="utf-8"))
ROBOT = load_robot("mini_cheetah")


def changed(*path: str, value: Any) -> dict[str, Any]:
    body = copy.deepcopy(BODY)
    entry = body
    for key in path[:-1]:
        entry = entry[key]
    entry[path[-1]] = value
    return body


def test_the_shipped_file_is_of_the_mini_cheetah_and_plausible() -> None:
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


def test_no_two_joints_are_alike() -> None:
    joints = list(load_sim_params().joints.values())
    for name in ("coulomb", "link_inertia_scale", "belt_stiffness", "encoder_offset"):
        values = [getattr(joint, name) for joint in joints]
        assert len(set(values)) > len(joints) // 2, name


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (("joints", "FR_knee", "link_inertia_scale"), -1, "FR_knee.link_inertia_scale is -1"),
        (("joints", "FR_knee", "link_inertia_scale"), 0.0, "expected a number >= 0.1"),
        (("joints", "FR_knee", "rotor_inertia"), 0, "FR_knee.rotor_inertia is 0"),
        (("joints", "HL_hip_roll", "viscous"), float("nan"), "HL_hip_roll.viscous is nan"),
        (("joints", "HL_hip_roll", "coulomb"), "much", "coulomb is 'much'; expected a number"),
        (("joints", "HL_hip_roll", "coulomb"), True, "coulomb is True; expected a number"),
        (("joints", "HL_hip_roll", "coulomb"), 9.0, "below coulomb = 9"),
        (("joints", "HL_hip_roll"), 3, "joints.HL_hip_roll is 3; expected a mapping"),
        (("joints",), {}, "`$.joints`"),
        (("machine", "encoder_bits"), 14.5, "encoder_bits is 14.5; expected a whole number"),
        (("machine", "gyro_bias"), [0.0, 1.0], "gyro_bias is [0.0, 1.0]"),
        (("machine", "bus_voltage"), -24, "machine.bus_voltage is -24"),
        (("machine", "command_delay"), 0.002, "machine.command_delay is unknown; the fields are"),
        (("ground", "friction"), "ice", "ground.friction is 'ice'"),
        (("ground", "terrain"), [], "ground.terrain is unknown; the fields are friction"),
        (("trunk",), {"inertia_scale": [1, -1, 1]}, "trunk.inertia_scale is [1, -1, 1]"),
        (("attitude", "noise"), float("nan"), "attitude.noise is nan"),
        (("robot",), 7, "`$.robot`"),
        (("colour",), "red", "`colour`"),
        (("schema",), "pronk/gains/1", "this pronk reads 'pronk/sim_params/1'"),
    ],
)
def test_impossible_is_refused_in_one_sentence_naming_the_field(
    path: tuple[str, ...], value: Any, words: str
) -> None:
    with pytest.raises(RobotError) as caught:
        parse_sim_params(changed(*path, value=value), "my.yaml")
    message = str(caught.value)
    assert words in message
    assert message.startswith("my.yaml: ")
    assert "\n" not in message


@pytest.mark.parametrize("path", [("machine", "bus_voltage"), ("joints", "FR_knee", "coulomb")])
def test_missing_field_is_named(path: tuple[str, ...]) -> None:
    body = copy.deepcopy(BODY)
    entry = body
    for key in path[:-1]:
        entry = entry[key]
    del entry[path[-1]]
    with pytest.raises(RobotError, match=rf"{'.'.join(path)} is missing"):
        parse_sim_params(body, "my.yaml")


def test_missing_and_foreign_joints_are_named() -> None:
    sim_params = load_sim_params()
    short = replace(
        sim_params, joints={k: v for k, v in sim_params.joints.items() if k != "HR_knee"}
    )
    with pytest.raises(RobotError, match=r"joints\.HR_knee is missing"):
        build_plant(ROBOT, short, ("FR",), 0.25e-3)
    foreign = replace(
        sim_params, joints={**sim_params.joints, "tail": sim_params.joints["HR_knee"]}
    )
    with pytest.raises(RobotError, match=r"joints\.tail is not a joint of mini_cheetah"):
        build_plant(ROBOT, foreign, ("FR",), 0.25e-3)


def test_belt_too_stiff_for_the_step_is_refused_with_the_stiffest_that_fits() -> None:
    sim_params = load_sim_params()
    stiff = replace(sim_params.joints["FR_hip_roll"], belt_stiffness=9e4)
    broken = replace(sim_params, joints={**sim_params.joints, "FR_hip_roll": stiff})
    with pytest.raises(RobotError, match=r"FR_hip_roll\.belt_stiffness is 90000; .* at most"):
        build_plant(ROBOT, broken, ("FR",), 0.25e-3)
    build_plant(ROBOT, broken, ("FR",), 0.025e-3)


def test_files_that_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RobotError, match="no such sim_params file"):
        load_sim_params(tmp_path / "none.yaml")
    bad = tmp_path / "bad.yaml"
    bad.write_text("joints: [unclosed")
    with pytest.raises(RobotError, match="cannot be read as YAML"):
        load_sim_params(bad)
    bad.write_text("")
    with pytest.raises(RobotError, match="schema 'NoneType'"):
        load_sim_params(str(bad))


def test_a_file_of_ones_own_replaces_the_shipped_one(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(yaml.safe_dump(changed("machine", "bus_voltage", value=22.0)))
    assert load_sim_params(path) == replace(
        load_sim_params(), machine=replace(load_sim_params().machine, bus_voltage=22.0)
    )


def test_parts_for_the_ground_may_be_left_out_of_a_file() -> None:
    body = {name: BODY[name] for name in ("schema", "robot", "machine", "joints")}
    sim_params = parse_sim_params(body | {"trunk": {"mass_offset": 1}}, "my.yaml")
    assert sim_params.trunk.mass_offset == 1.0
    assert sim_params.attitude.noise == 0.0
