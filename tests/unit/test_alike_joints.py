"""Joints of a bare model that share a group in the file of `pronk robot new`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from command_line import accepted, invoke
from pronk.robots import load_robot
from pronk.robots.quadruped import PAGE, quadruped_problems
from pronk.robots.robot import RobotSpec
from quadruped_model import ANYMAL, SPOT, write_quadruped

NAMES = {
    "LF": (ANYMAL, ("HAA", "HFE", "KFE")),
    "fl": (SPOT, ("hx", "hy", "kn")),
}
"""Legs and joints under the names of two makers, by the first leg."""


def servos(legs: dict[str, tuple[float, float]], joints: tuple[str, str, str]) -> str:
    """Write a position servo for each joint."""
    elements = ""
    for leg in legs:
        for joint, kp in zip(joints, (120.0, 130.0, 140.0), strict=True):
            name = f"{leg}_{joint}"
            elements += f'<position joint="{name}" kp="{kp}" kv="3" forcerange="-80 80"/>\n'
    return f"<actuator>{elements}</actuator>"


def written(
    tmp_path: Path, first: str = "LF", *, change: Callable[[str], str] = str, moving: str = ""
) -> tuple[RobotSpec, RobotSpec, str]:
    """Write the robot.yaml of a quadruped in its crouch.

    Args:
        tmp_path: Folder of the test.
        first: First leg of the names.
        change: What is changed in the model.
        moving: Elements of its `actuator`; empty for position servos of the same gains.

    Returns:
        The robot of the file, that of the bare model, and the file.
    """
    legs, joints = NAMES[first]
    folder = write_quadruped(tmp_path / "robot", legs, joints).parent
    path = folder / "model.xml"
    crouch = " ".join(["0 0.5 -1.0"] * len(legs))
    keyframe = f'<keyframe><key name="home" qpos="0 0 0.6 1 0 0 0 {crouch}"/></keyframe>'
    ending = f"{moving or servos(legs, joints)}{keyframe}</mujoco>"
    path.write_text(change(path.read_text().replace("</mujoco>", ending)))
    accepted("robot", "new", path, "--overwrite")
    file = folder / "robot.yaml"
    return load_robot(file), load_robot(path), file.read_text()


@pytest.mark.parametrize("first", NAMES)
def test_the_joints_of_four_legs_share_three_groups(first: str, tmp_path: Path) -> None:
    """All numbers are as those that the bare model has for each joint."""
    robot, bare, text = written(tmp_path, first)
    legs, joints = NAMES[first]
    assert robot.legs == tuple(legs)
    assert robot.groups == joints
    assert robot.joint_names == bare.joint_names
    for joint in robot.joints:
        bare_joint = bare.joint(joint.name)
        assert joint.group == joint.name.removeprefix(f"{joint.name.partition('_')[0]}_")
        assert bare_joint.group == joint.name
        assert (joint.stiffness, joint.damping) == (bare_joint.stiffness, bare_joint.damping)
        assert joint.drive == bare_joint.drive
        assert joint.default_position == bare_joint.default_position
    assert text.count("stiffness:") == len(joints)


def test_a_model_with_all_names_needs_nothing_more_to_be_trained(tmp_path: Path) -> None:
    robot, _, _ = written(tmp_path)
    assert quadruped_problems(robot) == []
    assert "not ready" not in invoke(("robot", "check", robot.source)).output


def test_a_quadruped_without_the_names_is_told_what_training_needs(tmp_path: Path) -> None:
    robot, _, _ = written(tmp_path, change=lambda text: text.replace('"LF_foot"', '"LF_sole"'))
    checked = invoke(("robot", "check", robot.source)).output
    assert "LF_foot" in checked
    assert PAGE in checked


def test_joints_that_the_model_tells_apart_are_not_put_together(tmp_path: Path) -> None:
    """One knee with a stiffer servo: every knee is a group of its own, the others share theirs."""
    robot, bare, _ = written(
        tmp_path, change=lambda text: text.replace('"RH_KFE" kp="140.0"', '"RH_KFE" kp="141.0"')
    )
    assert set(robot.groups) == {"HAA", "HFE", "LF_KFE", "LH_KFE", "RF_KFE", "RH_KFE"}
    assert robot.joint("RH_KFE").stiffness == bare.joint("RH_KFE").stiffness == 141.0
    assert robot.joint("LF_KFE").stiffness == 140.0
    assert robot.legs == tuple(ANYMAL)


def test_a_joint_that_is_held_is_in_no_group(tmp_path: Path) -> None:
    """The pattern of a group would match it, so that the others of its place have their own."""
    robot, _, _ = written(
        tmp_path,
        change=lambda text: text.replace(
            '<position joint="RH_KFE" kp="140.0" kv="3" forcerange="-80 80"/>', ""
        ),
    )
    assert "RH_KFE" in robot.held_joints
    assert {"LF_KFE", "LH_KFE", "RF_KFE"} < set(robot.groups)
    assert robot.joint("LF_HFE").group == "HFE"


def test_assumed_numbers_that_differ_by_gravity_are_the_largest(tmp_path: Path) -> None:
    """Without actuators gains are assumed; a hip is heavier than the other three."""
    robot, bare, text = written(
        tmp_path,
        moving="<actuator/>",
        change=lambda text: text.replace('size="0.05" mass="2.8"', 'size="0.05" mass="2.9"', 1),
    )
    assert robot.groups == ("HAA", "HFE", "KFE")
    for joint in robot.joints:
        alike = [member for member in bare.joints if member.name.endswith(joint.group)]
        assert joint.stiffness == max(member.stiffness for member in alike)
    assert "assumed ones" in text


def test_joints_in_different_poses_share_a_group(tmp_path: Path) -> None:
    """One knee whose zero is at its stop is moved away from it, which is no other drive."""
    robot, bare, _ = written(
        tmp_path,
        change=lambda text: text.replace(
            'name="RH_KFE" axis="0 1 0" range="-2.6 0.6"',
            'name="RH_KFE" axis="0 1 0" range="-2.6 -0.9"',
        ),
    )
    assert robot.groups == ("HAA", "HFE", "KFE")
    positions = {joint.name: joint.default_position for joint in robot.joints}
    assert positions["LF_KFE"] == -1.0 > positions["RH_KFE"]
    assert positions["RH_KFE"] == bare.joint("RH_KFE").default_position


def test_left_and_right_share_groups_and_are_no_legs_of_a_quadruped(tmp_path: Path) -> None:
    path = tmp_path / "arms.xml"
    arms = ""
    servo = ""
    for side, y in (("left", 0.2), ("right", -0.2)):
        arms += (
            f'<body name="{side}" pos="0 {y} 1"><joint name="{side}_elbow" axis="0 1 0" '
            'range="-1 1" armature="0.01" frictionloss="0.1"/>'
            '<geom type="sphere" size="0.05" pos="0 0 -0.2" mass="1"/></body>'
        )
        servo += f'<position joint="{side}_elbow" kp="40" kv="2" forcerange="-9 9"/>'
    path.write_text(
        f"<mujoco><compiler autolimits='true'/><worldbody>{arms}</worldbody>"
        f"<actuator>{servo}</actuator></mujoco>"
    )
    accepted("robot", "new", path)
    robot = load_robot(tmp_path / "robot.yaml")
    assert robot.groups == ("elbow",)
    assert robot.legs == ()
    assert robot.joint_names == ("left_elbow", "right_elbow")
