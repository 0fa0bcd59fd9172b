"""Robots from models that others made: what is left out, what is held, and the numbers read."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

import pronk.robots
from command_line import accepted, invoke, refused
from pronk.deploy.runtime.limits import Limits
from pronk.errors import RobotError
from pronk.robots import load_robot
from pronk.robots.bare import describe_model, yaml_of_model
from pronk.robots.model import bench_inertia, bench_spec, free_spec
from pronk.robots.source_model import MAX_DEPTH
from quadruped_model import write_quadruped

LEG = """
  <body name="{name}" pos="0 {side} 0">
    <joint name="{name}_knee" axis="0 1 0" range="-1.5 1.2" ref="0.1"/>
    <inertial pos="0.02 0 -0.15" mass="0.7" diaginertia="2e-3 2e-3 1e-3"/>
    <geom name="{name}_shank" type="sphere" size="0.03"/>
    <site name="{name}_foot" pos="0 0 -0.2"/>
    {inside}
  </body>
"""
SCENE = """
<mujoco model="scene">
  <compiler angle="radian"/>
  <default><joint type="hinge" armature="0.015" frictionloss="0.08"/></default>
  {assets}
  <worldbody>
    <body name="trunk" pos="0 0 1">
      <freejoint/>
      <inertial pos="0 0 0" mass="6" diaginertia="0.1 0.1 0.1"/>
      {legs}
    </body>
    {world}
  </worldbody>
  {relations}
</mujoco>
"""


def scene(*, assets: str = "", world: str = "", relations: str = "", inside: str = "") -> str:
    """Write two legs on a floating trunk, with other elements of a scene."""
    legs = LEG.format(name="near", side=0.1, inside="") + LEG.format(
        name="far", side=-0.1, inside=inside
    )
    return SCENE.format(assets=assets, world=world, relations=relations, legs=legs)


ELEMENTS = {
    "plain": {},
    "floor": {
        "assets": '<asset><texture name="t" type="2d" builtin="checker" width="8" height="8"/>'
        '<material name="m" texture="t"/></asset>',
        "world": '<geom type="plane" size="5 5 .1" material="m"/>',
    },
    "material of a class": {
        "assets": '<default><default class="painted"><geom material="m"/></default></default>'
        '<asset><material name="m" rgba="1 0 0 1"/></asset>',
        "inside": '<geom class="painted" size=".01"/><site name="s" material="m"/>',
    },
    "mesh": {
        "assets": '<asset><mesh name="m" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/></asset>',
        "inside": '<geom type="mesh" mesh="m" mass="0"/><geom type="capsule" mesh="m"/>',
    },
    "height field": {
        "assets": '<asset><hfield name="h" nrow="3" ncol="3" size="1 1 .1 .1"/></asset>',
        "world": '<geom type="hfield" hfield="h"/>',
    },
    "tracking light": {"world": '<light mode="targetbody" target="far"/>'},
    "camera": {"world": '<camera name="c" mode="targetbody" target="far"/>'},
    "camera on a leg": {"inside": '<camera name="c"/><light/>'},
    "tuple": {
        "relations": '<custom><tuple name="x"><element objtype="geom" objname="far_shank"/></tuple>'
        '<numeric name="n" data="1"/><text name="w" data="a"/></custom>'
    },
    "keyframe": {"relations": '<keyframe><key qpos="0 0 1 1 0 0 0 .3 .3"/></keyframe>'},
    "exclude": {"relations": '<contact><exclude body1="near" body2="far"/></contact>'},
    "pair": {"relations": '<contact><pair geom1="near_shank" geom2="far_shank"/></contact>'},
    "connect": {
        "relations": '<equality><connect body1="far" body2="trunk" anchor="0 0 0"/></equality>'
    },
    "connect of sites": {
        "relations": '<equality><connect site1="far_foot" site2="near_foot"/></equality>'
    },
    "weld": {"relations": '<equality><weld body1="far" body2="trunk"/></equality>'},
    "coupled joints": {
        "relations": '<equality><joint joint1="far_knee" joint2="near_knee"/></equality>'
    },
    "fixed tendon": {
        "relations": '<tendon><fixed name="t"><joint joint="far_knee" coef="1"/></fixed></tendon>'
        '<equality><tendon tendon1="t"/></equality><sensor><tendonpos tendon="t"/></sensor>'
    },
    "spatial tendon": {
        "relations": '<tendon><spatial><site site="far_foot"/><site site="near_foot"/></spatial>'
        "</tendon>"
    },
    "sensors": {
        "relations": '<sensor><jointpos joint="far_knee"/><touch site="far_foot"/>'
        '<framepos objtype="body" objname="far"/><force site="far_foot"/></sensor>'
    },
    "mocap": {"world": '<body name="target" mocap="true"><geom size=".1"/></body>'},
    "free cube": {
        "world": '<body name="cube" pos="1 0 1"><freejoint/><geom type="box" size=".1 .1 .1"/>'
        "</body>"
    },
    "ball joint": {
        "inside": '<body name="tail"><joint name="tail" type="ball"/><geom size=".02"/></body>'
    },
    "replicate": {
        "inside": '<replicate count="3" offset=".01 0 0"><geom size=".001"/></replicate>',
    },
    "frame": {"world": '<frame euler="0 0 1"><body name="post"><geom size=".1"/></body></frame>'},
    "sizes": {"assets": '<size njmax="4500" nconmax="900" nstack="3000000" nuserdata="5"/>'},
    "unnamed": {"world": "<body><geom size='.1'/></body>"},
    "flexible": {
        "world": '<flexcomp name="f" type="grid" count="3 3 1" spacing=".1 .1 .1" pos="2 0 0" '
        'radius=".01" mass=".1" dim="2"/>'
    },
}


@pytest.mark.parametrize("element", ELEMENTS)
def test_what_refers_to_a_removed_leg_goes_with_it(element: str, tmp_path: Path) -> None:
    """The near knee has the inertia, gravity and range that MuJoCo computes for it."""
    path = tmp_path / "scene.xml"
    path.write_text(scene(**ELEMENTS[element]))
    original = mujoco.MjModel.from_xml_path(str(path))
    accepted("robot", "new", path)
    robot = load_robot(tmp_path / "robot.yaml")
    assert set(robot.joint_names) == {"near_knee", "far_knee"}
    accepted("robot", "check", tmp_path / "robot.yaml")

    joint = robot.joint("near_knee")
    hinge = original.joint("near_knee")
    assert joint.range == tuple(hinge.range)
    data = mujoco.MjData(original)
    data.joint("near_knee").qpos[:] = joint.default_position
    mujoco.mj_forward(original, data)
    mass = np.zeros((original.nv, original.nv))
    mujoco.mj_fullM(original, data, mass)
    dof = hinge.dofadr[0]
    model = bench_spec(robot, "near_knee").compile()
    assert model.nv == 1
    assert bench_inertia(robot, "near_knee")[0] == pytest.approx(mass[dof, dof], rel=1e-9)
    held = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, held, model.key("default").id)
    mujoco.mj_forward(model, held)
    assert held.qfrc_bias[0] == pytest.approx(data.qfrc_bias[dof], rel=1e-9)


CHAIN = """
<mujoco model="chain">
  <compiler angle="radian"/>
  <default><joint armature="0.02" frictionloss="0.1"/></default>
  <worldbody>
    <body name="cart" pos="0 0 0.5">
      <joint name="x" type="slide" axis="1 0 0" range="-1 1" limited="true"/>
      <joint name="lift" type="slide" axis="0 0 1" range="0 0.6" limited="true"/>
      <inertial pos="0 0 0" mass="20" diaginertia="1 1 1"/>
      <body name="upper" pos="0.1 0 0.2" euler="0.3 0 0.2">
        <joint name="shoulder" axis="0 1 0" range="-2 2" limited="true" pos="0.01 0 0"/>
        <joint name="twist" axis="0 0 1" range="-2 2" limited="true" pos="0 0.02 0" ref="0.2"/>
        <inertial pos="0.05 0 0.15" mass="1.5" diaginertia="0.01 0.01 0.002"/>
        <body name="hand" pos="0 0 0.3">
          <joint name="wrist" axis="1 0 0" range="-2 2" limited="true"/>
          <inertial pos="0 0.01 0.05" mass="0.5" diaginertia="1e-3 1e-3 1e-3"/>
          <body name="finger" pos="0 0.03 0.1">
            <joint name="finger" type="slide" axis="0 1 0" range="0 0.05" limited="true"/>
            <inertial pos="0 0 0.02" mass="0.2" diaginertia="1e-5 1e-5 1e-5"/>
          </body>
          <body name="cup" pos="0 0 0.15">
            <joint name="cup" type="ball" pos="0 0.01 0"/>
            <inertial pos="0 0.02 0.03" mass="0.3" diaginertia="2e-4 2e-4 1e-4"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position joint="shoulder" kp="90" kv="3" forcerange="-40 40"/>
    <position joint="twist" kp="60" kv="2" forcerange="-30 30"/>
    <position joint="wrist" kp="30" kv="1" forcerange="-15 15"/>
    <position joint="lift" kp="5000" forcerange="-300 300"/>
    <position joint="finger" kp="200" forcerange="-20 20"/>
  </actuator>
  <keyframe>
    <key name="home" qpos="0.3 0.4 0.5 -0.6 0.7 0.03 0.9 0.3 -0.2 0.1"/>
  </keyframe>
</mujoco>
"""


def test_slides_and_ball_joints_are_held_at_the_pose(tmp_path: Path) -> None:
    """Mass matrix and gravity of the hinges are those of the whole model at its keyframe."""
    path = tmp_path / "chain.xml"
    path.write_text(CHAIN)
    accepted("robot", "new", path)
    text = (tmp_path / "robot.yaml").read_text()
    robot = load_robot(tmp_path / "robot.yaml")
    names = ("shoulder", "twist", "wrist")
    assert robot.joint_names == names
    assert set(robot.held_joints) == {"x", "lift", "finger", "cup"}
    assert yaml.safe_load(text)["held"]["finger"] == pytest.approx(0.03)
    assert "300 N" in text
    checked = invoke(("robot", "check", tmp_path / "robot.yaml")).stdout
    assert "finger" in checked

    original = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(original)
    mujoco.mj_resetDataKeyframe(original, data, 0)
    mujoco.mj_forward(original, data)
    whole = np.zeros((original.nv, original.nv))
    mujoco.mj_fullM(original, data, whole)
    dofs = [int(original.joint(name).dofadr[0]) for name in names]
    model = free_spec(robot).compile()
    state = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, state, model.key("default").id)
    mujoco.mj_forward(model, state)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, state, mass)
    np.testing.assert_allclose(mass, whole[np.ix_(dofs, dofs)], rtol=1e-3, atol=1e-9)
    np.testing.assert_allclose(state.qfrc_bias, data.qfrc_bias[dofs], rtol=1e-3, atol=1e-9)


def test_a_hinge_that_is_held_stands_where_the_model_has_it(tmp_path: Path) -> None:
    """Holding a hinge before or after another of the same body gives the same poses."""
    path = tmp_path / "chain.xml"
    path.write_text(CHAIN)
    text = yaml_of_model(path)
    original = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(original)
    mujoco.mj_resetDataKeyframe(original, data, 0)
    mujoco.mj_kinematics(original, data)
    for name, angle in (("shoulder", 0.5), ("twist", -0.6)):
        content = yaml.safe_load(text)
        content["held"][name] = angle
        for section in ("groups", "drives"):
            del content[section][name]
        (tmp_path / "robot.yaml").write_text(yaml.safe_dump(content))
        robot = load_robot(tmp_path / "robot.yaml")
        assert name in robot.held_joints
        model = free_spec(robot).compile()
        state = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, state, model.key("default").id)
        mujoco.mj_kinematics(model, state)
        np.testing.assert_allclose(state.body("cup").xpos, data.body("cup").xpos, atol=1e-9)
        np.testing.assert_allclose(state.body("finger").xmat, data.body("finger").xmat, atol=1e-9)


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({"lift": 3.0}, "lift"),
        ({"elbow": 0.0}, "elbow"),
        ({"cup": 0.1}, "cup"),
        ({"cup": [0.0, 0.0, 0.0, 0.0]}, "cup"),
    ],
)
def test_a_held_position_that_cannot_be_is_refused(
    entry: dict[str, object], words: str, tmp_path: Path
) -> None:
    path = tmp_path / "chain.xml"
    path.write_text(CHAIN)
    content = yaml.safe_load(yaml_of_model(path))
    content["held"].update(entry)
    (tmp_path / "robot.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(RobotError, match=words):
        load_robot(tmp_path / "robot.yaml")


ACTUATED = """
<mujoco model="actuated">
  <compiler angle="radian"/>
  <worldbody>
    <body name="link" pos="0 0 1">
      <joint name="j" axis="0 1 0" range="-1 1" limited="true" armature="0.03" damping="0.07"
             frictionloss="0.2" {joint}/>
      <inertial pos="0 0 -0.2" mass="1.3" diaginertia="2e-3 2e-3 2e-3"/>
      <body name="tip" pos="0 0 -0.4">
        <joint name="spring" axis="0 1 0" stiffness="4"/>
        <inertial pos="0 0 -0.05" mass="0.2" diaginertia="1e-4 1e-4 1e-4"/>
      </body>
    </body>
  </worldbody>
  {tendon}
  <actuator>{actuators}</actuator>
</mujoco>
"""
TENDON = '<tendon><fixed name="t"><joint joint="j" coef="3"/></fixed></tendon>'


@pytest.mark.parametrize(
    ("actuators", "joint", "expected"),
    [
        # servo, stiffness, damping, effort limit; None where it is assumed.
        (
            '<position joint="j" kp="70" kv="1.5" forcerange="-11 11"/>',
            "",
            ("position", 70.0, 1.5, 11.0),
        ),
        (
            '<position joint="j" kp="7" kv="0.1" gear="6" forcerange="-2 2" ctrlrange="-6 6"/>',
            "",
            ("position", 252.0, 3.6, 12.0),
        ),
        ('<position joint="j" kp="70"/>', "", ("position", 70.0, 0.0, None)),
        ('<position joint="j" kp="70"/>', 'actuatorfrcrange="-9 9"', ("position", 70.0, 0.0, 9.0)),
        (
            '<position joint="j" kp="70" forcerange="-8 8"/><damper joint="j" kv="0.9" '
            'ctrlrange="0 1"/>',
            "",
            ("position", 70.0, 0.9, 8.0),
        ),
        ('<intvelocity joint="j" kp="50" actrange="-1 1"/>', "", ("position", 50.0, 0.0, None)),
        ('<motor joint="j" gear="20" ctrlrange="-0.5 0.5"/>', "", ("motor", None, None, 10.0)),
        (
            '<general joint="j" gainprm="5" gear="3" ctrlrange="-1 1"/>',
            "",
            ("motor", None, None, 15.0),
        ),
        ('<motor joint="j" gear="20"/>', "", ("motor", None, None, None)),
        (
            '<general joint="j" biastype="affine" gainprm="45" biasprm="0 -60 -2" '
            'forcerange="-7 7"/>',
            "",
            ("position", 60.0, 2.0, 7.0),
        ),
        (
            '<position tendon="t" kp="10" kv="0.2" forcerange="-4 4"/>',
            "",
            ("position", 90.0, 1.8, 12.0),
        ),
    ],
)
def test_numbers_of_actuators_are_those_that_mujoco_computes_at_the_joint(
    actuators: str,
    joint: str,
    expected: tuple[str, float | None, float | None, float | None],
    tmp_path: Path,
) -> None:
    path = tmp_path / "actuated.xml"
    path.write_text(ACTUATED.format(actuators=actuators, joint=joint, tendon=TENDON))
    accepted("robot", "new", path)
    robot = load_robot(tmp_path / "robot.yaml")
    text = (tmp_path / "robot.yaml").read_text()
    assert robot.joint_names == ("j",)
    assert robot.held_joints == ("spring",)
    read = robot.joint("j")
    servo, stiffness, damping, effort_limit = expected
    assert read.servo == servo
    remarks = describe_model(path).remarks
    numbers = {
        "stiffness": (read.stiffness, stiffness),
        "damping": (read.damping, damping),
        "effort_limit": (read.drive.effort_limit, effort_limit),
    }
    for number, (value, true_value) in numbers.items():
        mark = remarks["j", number].mark
        assert (mark == "CHECK") == (true_value is None)
        if true_value is not None:
            assert value == pytest.approx(true_value, rel=1e-9)
        line = next(line for line in text.splitlines() if f" {number}:" in line)
        assert f"# {mark}" in line
    if effort_limit is None:
        assert read.drive.effort_limit >= read.stiffness
    assert (read.drive.armature, read.drive.viscous_damping) == (0.03, 0.07)
    done = invoke(("robot", "check", tmp_path / "robot.yaml"))
    assert "nothing is inconsistent" not in done.stdout
    # The last line counts the lines of the file and the warnings as they stand above.
    counts = [int(count) for count in re.findall(r"\d+", done.stdout.splitlines()[-1])]
    marks = sum("# CHECK" in line for line in text.splitlines())
    warnings = len(done.stderr.splitlines())
    assert sum(counts) == marks + warnings - (marks > 0)
    assert marks == 0 or marks in counts


VELOCITY = '<velocity joint="j" kv="4" gear="2" ctrlrange="-9 9"/>'


def test_a_velocity_servo_has_no_stiffness_so_that_its_joint_is_held(tmp_path: Path) -> None:
    """No number is invented for it; a joint beside it can be swept, and it can be given gains."""
    path = tmp_path / "actuated.xml"
    actuators = VELOCITY + '<position joint="spring" kp="5" kv="0.1" forcerange="-3 3"/>'
    path.write_text(ACTUATED.format(actuators=actuators, joint="", tendon=""))
    said = accepted("robot", "new", path)
    robot = load_robot(tmp_path / "robot.yaml")
    assert robot.joint_names == ("spring",)
    assert robot.held_joints == ("j",)
    assert "j" in said
    held_line = next(
        line for line in (tmp_path / "robot.yaml").read_text().splitlines() if line[:5] == "  j: "
    )
    assert "velocity servo" in held_line
    assert " 16 N m s/rad" in held_line
    sweep = ("sweep", tmp_path / "robot.yaml", "--repeats", "1", "--plan-only")
    out = ("--out", tmp_path / "logs")
    sentence = refused(*sweep, "--joints", "j", *out)
    assert "velocity servo" in sentence
    assert "stiffness" in sentence
    accepted(*sweep, "--joints", "spring", "--amplitude", "0.02", *out)


def test_a_model_of_velocity_servos_alone_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "actuated.xml"
    path.write_text(ACTUATED.format(actuators=VELOCITY, joint="", tendon=""))
    sentence = refused("robot", "new", path)
    assert "position servo" in sentence
    assert not (tmp_path / "robot.yaml").exists()


def test_stiffness_is_the_derivative_of_the_torque_of_the_actuators(tmp_path: Path) -> None:
    """By MuJoCo's own forces, at two positions and two speeds."""
    actuators = (
        '<position joint="j" kp="7" kv="0.3" gear="5"/><position joint="j" kp="3" kv="0.1"/>'
    )
    path = tmp_path / "actuated.xml"
    path.write_text(ACTUATED.format(actuators=actuators, joint="", tendon=""))
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    torques = {}
    for position, speed in ((0.0, 0.0), (0.1, 0.0), (0.0, 1.0)):
        data.joint("j").qpos[:] = position
        data.joint("j").qvel[:] = speed
        mujoco.mj_forward(model, data)
        torques[position, speed] = data.joint("j").qfrc_actuator[0]
    joint = load_robot(path).joint("j")
    assert joint.stiffness == pytest.approx(-(torques[0.1, 0.0] - torques[0.0, 0.0]) / 0.1)
    assert joint.damping == pytest.approx(-(torques[0.0, 1.0] - torques[0.0, 0.0]))


@pytest.mark.parametrize("pose", [-0.7, -3e-13, 0.0, 2.0, 2.4])
def test_a_pose_at_a_stop_is_moved_and_named(pose: float, tmp_path: Path) -> None:
    path = tmp_path / "knee.xml"
    path.write_text(
        "<mujoco><compiler angle='radian'/><worldbody><body><joint name='knee' axis='0 1 0' "
        "range='-3e-13 2.4' limited='true' armature='.01' frictionloss='.1'/>"
        "<inertial pos='0 0 -.1' mass='1' diaginertia='.01 .01 .01'/></body></worldbody>"
        f"<actuator><position joint='knee' kp='30' kv='1' forcerange='-20 20'/></actuator>"
        f"<keyframe><key qpos='{pose}'/></keyframe></mujoco>"
    )
    accepted("robot", "new", path)
    file = tmp_path / "robot.yaml"
    joint = load_robot(file).joint("knee")
    low, high = joint.range
    assert low + 0.3 < joint.default_position < high - 0.3
    content = yaml.safe_load(file.read_text())
    for position, is_named in ((0.0, True), (2.4, True), (1.0, False)):
        content["poses"]["default"]["knee"] = position
        file.write_text(yaml.safe_dump(content))
        assert ("end of its range" in invoke(("robot", "check", file)).stderr) == is_named


def test_ranges_in_rad_that_are_read_in_degrees_are_named(tmp_path: Path) -> None:
    """MuJoCo reads an MJCF in degrees unless it says otherwise, as many that are in rad do not."""
    shutil.copytree(Path(pronk.robots.__file__).parent / "go2", tmp_path / "go2")
    model = tmp_path / "go2" / "go2.xml"
    text = model.read_text()
    model.write_text(text.replace('<compiler angle="radian"/>', ""))
    assert model.read_text() != text
    with pytest.raises(RobotError, match='<compiler angle="radian"/>'):
        load_robot(tmp_path / "go2")
    said = invoke(("robot", "new", model, "--overwrite")).stderr
    assert '<compiler angle="radian"/>' in said
    model.write_text(text)
    assert "radian" not in invoke(("robot", "new", model, "--overwrite")).stderr


@pytest.mark.parametrize(
    ("geom", "inertial", "is_named"),
    [
        ("", "", True),
        (' density="700"', "", False),
        (' mass="0.4"', "", False),
        ("", '<inertial pos="0 0 -.1" mass="1" diaginertia=".01 .01 .01"/>', False),
    ],
)
def test_masses_that_mujoco_assumes_are_named(
    geom: str, inertial: str, is_named: bool, tmp_path: Path
) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(
        '<mujoco><worldbody><body name="rod"><joint name="j" axis="0 1 0" range="-90 90"/>'
        f'{inertial}<geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02"{geom}/></body>'
        "</worldbody></mujoco>"
    )
    said = invoke(("robot", "check", path)).stderr
    assert ("rod 0.411 kg" in said) == is_named


LINKS = """
<?xml version="1.0"?>
<robot name="arm" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <material name="grey"><color rgba=".5 .5 .5 1"/></material>
  <material name="grey"><color rgba=".5 .5 .5 1"/></material>
  <link name="base">
    <inertial><mass value="3"/>
      <inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="package://arm/base.dae"/></geometry>
      <material name="grey"/><material name="other"/></visual>
    <collision name="c"><geometry><mesh filename="package://arm/base.stl"/></geometry></collision>
  </link>
  <link name="lower">
    <inertial><origin xyz="0 0 -0.2"/><mass value="0.8"/>
      <inertia ixx="{inertia}" iyy="0.004" izz="0.004" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><mesh filename="http://nowhere/x.stl"/></geometry></visual>
    <collision name="c"><geometry><sphere radius="0.02"/></geometry></collision>
  </link>
  <link name="camera">
    <inertial><mass value="0.01"/>
      <inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial>
    <sensor/>
  </link>
  <link name="optical_frame"/>
  <link name="follower">
    <inertial><mass value="0.1"/>
      <inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="elbow" type="revolute"><parent link="base"/><child link="lower"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="2" effort="{effort}" velocity="{speed}"/></joint>
  <joint name="f1" type="fixed"><parent link="lower"/><child link="camera"/></joint>
  <joint name="f2" type="fixed"><parent link="camera"/><child link="optical_frame"/></joint>
  <joint name="finger" type="revolute"><parent link="lower"/><child link="follower"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/>
    <mimic joint="elbow"/></joint>
  <gazebo reference="camera"><sensor type="depth"/></gazebo>
  <transmission name="t"/>
</robot>
"""


def urdf(folder: Path, *, inertia: float = 0.004, effort: float = 9.0, speed: float = 3.1) -> Path:
    path = folder / "arm.urdf"
    path.write_text(LINKS.format(inertia=inertia, effort=effort, speed=speed))
    return path


@pytest.mark.parametrize("inertia", [1e308, 1e200, 1e12])
def test_a_joint_that_no_robot_can_have_is_refused(inertia: float, tmp_path: Path) -> None:
    path = urdf(tmp_path, inertia=inertia)
    path.write_text(path.read_text().replace('="0.004"', f'="{inertia}"'))
    error = refused("robot", "new", path)
    assert "elbow" in error
    assert "units" in error
    assert not (tmp_path / "robot.yaml").exists()


def test_a_urdf_needs_no_meshes_and_its_limits_are_used(tmp_path: Path) -> None:
    accepted("robot", "new", urdf(tmp_path))
    file = tmp_path / "robot.yaml"
    robot = load_robot(file)
    joint = robot.joint("elbow")
    assert robot.held_joints == ("finger",)
    assert joint.range == (-1.0, 2.0)
    assert joint.drive.effort_limit == 9.0
    assert joint.drive.no_load_speed == 3.1
    # The lower link about its end, the camera at the axis, and the finger, turning twice as far.
    inertia = 0.004 + 0.8 * 0.2**2 + 0.4 * 0.01 * 0.01**2 + 2.0**2 * 1e-4
    assert bench_inertia(robot, "elbow")[0] == pytest.approx(inertia, rel=1e-4)
    content = yaml.safe_load(file.read_text())
    content["drives"]["elbow"]["effort_limit"] = 20.0
    content["drives"]["elbow"]["no_load_speed"] = 1.0
    file.write_text(yaml.safe_dump(content))
    problems = invoke(("robot", "check", file)).stderr
    assert "effort limit of elbow" in problems
    assert "speed of elbow" in problems


def test_joints_with_the_same_finding_share_a_line(tmp_path: Path) -> None:
    """Each finding is one line, with the names of its joints and the numbers of each."""
    path = write_quadruped(tmp_path / "robot")
    text = path.read_text()
    text = text.replace("armature: 0.1", "armature: 0.0").replace(
        "stall_torque: 160", "stall_torque: 50"
    )
    path.write_text(text)
    lines = invoke(("robot", "check", path)).stderr.splitlines()
    for word in ("armature", "stall torque"):
        (line,) = [line for line in lines if word in line]
        for joint in load_robot(path).joint_names:
            assert line.count(joint) == 1
    assert line.count("50 N m") == 12


def test_an_inertia_that_no_body_has_is_replaced_and_named(tmp_path: Path) -> None:
    for inertia in (0.05, -0.004):
        path = urdf(tmp_path, inertia=inertia)
        description = describe_model(path)
        assert any("lower" in note for note in description.notes)
    assert "elbow" in description.file.groups


def test_a_urdf_without_effort_gets_an_assumed_one(tmp_path: Path) -> None:
    path = urdf(tmp_path, effort=0.0, speed=0.0)
    remarks = describe_model(path).remarks
    assert remarks["elbow", "effort_limit"].mark == "CHECK"
    assert remarks["elbow", "no_load_speed"].mark == "CHECK"
    assert load_robot(path).joint("elbow").drive.effort_limit > 0.0


def test_the_effort_limit_is_compared_with_stiffness_and_gravity(tmp_path: Path) -> None:
    for actuator, words in (
        ('<position joint="j" kp="900" kv="3" forcerange="-3 3"/>', "stiffness of j"),
        ('<position joint="j" kp="2" kv="0.1" forcerange="-0.3 0.3"/>', "gravity"),
    ):
        path = tmp_path / "actuated.xml"
        text = ACTUATED.format(actuators=actuator, joint="", tendon="")
        path.write_text(text.replace('pos="0 0 -0.2"', 'pos="0.3 0 0"'))
        assert words in invoke(("robot", "check", path)).stderr


@pytest.mark.parametrize(
    "text",
    [
        "<mujoco><worldbody>" + "<body>" * 20_000 + "</body>" * 20_000 + "</worldbody></mujoco>",
        "<mujoco><default>"
        + "<default>" * (MAX_DEPTH + 9)
        + "</default>" * (MAX_DEPTH + 9)
        + "</default></mujoco>",
        "<mujoco><worldbody><replicate count='100000'><replicate count='100000'>"
        "<body><geom size='.1'/></body></replicate></replicate></worldbody></mujoco>",
        "<mujoco><asset><texture type='2d' name='t' builtin='flat' width='1000000' "
        "height='1000000'/></asset></mujoco>",
        "<mujoco><asset><hfield name='h' nrow='100000' ncol='100000' size='1 1 1 1'/></asset>"
        "</mujoco>",
        "<mujoco><worldbody><flexcomp name='f' type='grid' count='5000 5000 50' "
        "spacing='1 1 1'/></worldbody></mujoco>",
        "<mujoco><include file='robot.xml'/></mujoco>",
        "<mujoco><asset><model name='m' file='robot.xml'/></asset><worldbody>"
        "<attach model='m' prefix='a'/></worldbody></mujoco>",
        "<mujoco><size nuser_body='1000000000'/><worldbody><body><joint/><geom size='.1'/></body>"
        "</worldbody></mujoco>",
        "<mujoco><asset><mesh name='m' builtin='supersphere' params='100000 1 1'/></asset>"
        "<worldbody><body><joint/><geom type='mesh' mesh='m'/></body></worldbody></mujoco>",
        "<mujoco><option timestep='nan'/><worldbody><body><joint/><geom size='nan'/></body>"
        "</worldbody></mujoco>",
        "<mujoco",
        "",
        "<robot/>",
        "<robot name='r'><link/><joint/></robot>",
        "<mujoco><worldbody><body><joint/><inertial mass='-1' pos='0 0 0'/></body></worldbody>"
        "</mujoco>",
    ],
)
def test_a_model_that_cannot_be_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "robot.xml"
    path.write_text(text)
    refused("robot", "new", path)
    assert [file.name for file in tmp_path.iterdir()] == ["robot.xml"]


def test_limits_that_are_not_stated_leave_room_for_the_gains_and_the_smallest_range(
    tmp_path: Path,
) -> None:
    path = tmp_path / "big.xml"
    actuators = '<position joint="j" kp="900" kv="60" forcerange="-500 500"/>'
    text = ACTUATED.format(actuators=actuators, joint="", tendon="")
    path.write_text(text.replace('range="-1 1"', 'range="-0.03 0.04"'))
    robot = load_robot(path)
    limits = Limits.of(robot)
    joint = robot.joint("j")
    assert (limits.gains > [joint.stiffness, joint.damping]).all()
    assert 2.0 * limits.operating.margin < 0.07
    assert limits.operating.power_w >= 500.0 * joint.drive.no_load_speed
    accepted("robot", "new", path)
    file = tmp_path / "robot.yaml"
    file.write_text(file.read_text() + "limits: {stiffness: 950.0, margin: 0.01}\n")
    stated = load_robot(file).limits
    assert (stated.stiffness, stated.margin) == (950.0, 0.01)


def test_a_pipe_in_place_of_a_mesh_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.stl")
    path = tmp_path / "robot.xml"
    path.write_text(
        "<mujoco><asset><mesh name='m' file='pipe.stl'/></asset><worldbody><body><joint/>"
        "<geom type='mesh' mesh='m'/></body></worldbody></mujoco>"
    )
    refused("robot", "new", path)


REACHING = """
<mujoco>
  <compiler angle="radian"/>
  <default><joint axis="0 1 0" limited="true" armature="0.02" frictionloss="0.1"/></default>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" range="-0.5 1.6" stiffness="{spring}"/>
      <inertial pos="0.2 0 0" mass="2" diaginertia="0.01 0.01 0.01"/>
      <body name="lower" pos="0.4 0 0">
        <joint name="elbow" range="-2 2"/>
        <inertial pos="0.2 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
        <body name="tip" pos="0.4 0 0">
          <joint name="lock" range="0 0.015"/>
          <inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor joint="shoulder" ctrlrange="-9 9"/><motor joint="elbow" ctrlrange="-9 9"/>
    <motor joint="lock" ctrlrange="-9 9"/>
  </actuator>
</mujoco>
"""


def test_the_pose_is_one_that_the_drives_can_hold(tmp_path: Path) -> None:
    """Stretched out, gravity asks for 10.8 N m of a shoulder with 9; hanging, for little."""
    path = tmp_path / "arm.xml"
    path.write_text(REACHING.format(spring=0))
    accepted("robot", "new", path)
    robot = load_robot(tmp_path / "robot.yaml")
    assert robot.held_joints == ("lock",)
    model = free_spec(robot).compile()
    state = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, state, model.key("default").id)
    mujoco.mj_forward(model, state)
    for joint in robot.joints:
        gravity = abs(state.qfrc_bias[model.joint(joint.name).dofadr[0]])
        assert gravity <= 0.5 * joint.drive.effort_limit
        assert gravity <= 0.2 * joint.stiffness
        low, high = joint.range
        assert low + 0.3 < joint.default_position < high - 0.3


def test_assumed_gains_are_stiffer_than_a_spring_of_the_joint(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(REACHING.format(spring=30).replace('"-9 9"', '"-90 90"'))
    assert load_robot(path).joint("shoulder").stiffness >= 60.0


FINGER = """
<mujoco>
  <compiler angle="radian"/>
  <option gravity="0 0 0"/>
  <worldbody>
    <body name="base">
      <geom type="sphere" size="0.02" mass="1"/>
      <body name="proximal">
        <joint name="bend" axis="0 1 0" range="-1 1" armature="{armature}" damping="0.02"
          frictionloss="0.01"/>
        <inertial pos="0.03 0 0" mass="0.2" diaginertia="2e-4 2e-4 2e-4"/>
        <body name="distal" pos="0.06 0 0">
          <joint name="tip" axis="0 1 0" damping="0.04" frictionloss="0.02"/>
          <inertial pos="0.02 0 0" mass="0.1" diaginertia="5e-5 5e-5 5e-5"/>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="cable"{spring}><joint joint="bend" coef="1"/><joint joint="tip" coef="{coef}"/>
    </fixed>
  </tendon>
  {relations}
  <actuator><position joint="bend" kp="5" kv="0.2" forcerange="-5 5"/></actuator>
</mujoco>
"""
COUPLINGS = {
    "joint": '<equality><joint joint1="tip" joint2="bend" polycoef="0 0.5 0 0 0"/></equality>',
    "tendon": '<equality><tendon tendon1="cable"/></equality>',
}


def finger(folder: Path, relations: str, *, spring: str = "", armature: float = 1e-3) -> Path:
    path = folder / "finger.xml"
    path.write_text(FINGER.format(relations=relations, spring=spring, armature=armature, coef="-2"))
    return path


@pytest.mark.parametrize("kind", COUPLINGS)
def test_what_follows_a_hinge_is_reflected_to_it(kind: str, tmp_path: Path) -> None:
    """By the acceleration that MuJoCo itself gives the coupled finger, and by the ratio."""
    path = finger(tmp_path, COUPLINGS[kind])
    accepted("robot", "new", path)
    robot = load_robot(tmp_path / "robot.yaml")
    assert robot.held_joints == ("tip",)
    model = mujoco.MjModel.from_xml_path(str(path))
    model.eq_solref[:] = (2e-3, 1.0)
    model.eq_solimp[:, :2] = 0.9999
    model.dof_damping[:] = 0.0
    model.dof_frictionloss[:] = 0.0
    data = mujoco.MjData(model)
    data.qfrc_applied[0] = 1e-3
    mujoco.mj_forward(model, data)
    assert data.qacc[1] == pytest.approx(0.5 * data.qacc[0], rel=0.01)
    inertia, _ = bench_inertia(robot, "bend")
    assert inertia == pytest.approx(1e-3 / data.qacc[0], rel=0.01)
    drive = robot.joint("bend").drive
    assert drive.viscous_damping == pytest.approx(0.02 + 0.25 * 0.04)
    assert drive.frictionloss == pytest.approx(0.01 + 0.5 * 0.02)
    text = (tmp_path / "robot.yaml").read_text()
    assert any("tip" in line and "bend" in line for line in text.splitlines() if "CHECK" in line)


def test_a_mimic_of_a_urdf_is_reflected_to_its_leader(tmp_path: Path) -> None:
    """The finger of the arm turns with the elbow, by two radians for one."""
    path = urdf(tmp_path)
    robot = load_robot(str(path))
    lower = 0.004 + 0.8 * 0.2**2 + 0.4 * 0.01 * 0.01**2
    assert bench_inertia(robot, "elbow")[0] == pytest.approx(lower + 4.0 * 1e-4, rel=1e-4)
    text = path.read_text().replace('<mimic joint="elbow"/>', '<mimic joint="elbow" {}/>')
    path.write_text(text.format('multiplier="-1"'))
    description = describe_model(path)
    # The finger keeps its direction; it adds nothing, and no armature takes away what it has.
    assert description.file.drives["elbow"].armature == 0.0


@pytest.mark.parametrize(
    ("spring", "word"),
    [
        (' stiffness="3"', "3 N m/rad"),
        (' damping="0.1"', "damp"),
        (' frictionloss="0.1"', "friction"),
        (' limited="true" range="-1 1"', "limits"),
        ("", ""),
    ],
)
def test_what_tendons_do_to_a_driven_hinge_is_said(spring: str, word: str, tmp_path: Path) -> None:
    notes = describe_model(finger(tmp_path, "", spring=spring)).notes
    about_tendons = [note for note in notes if "tendon" in note]
    assert len(about_tendons) == (1 if word else 0)
    for note in about_tendons:
        assert word in note
        assert "bend" in note


def test_a_coupling_of_two_drives_is_said(tmp_path: Path) -> None:
    path = finger(tmp_path, COUPLINGS["tendon"])
    second = '<position joint="tip" kp="5" kv="0.2" forcerange="-5 5"/></actuator>'
    path.write_text(path.read_text().replace("</actuator>", second))
    description = describe_model(path)
    assert set(description.file.drives) == {"bend", "tip"}
    assert description.file.drives["bend"].armature == pytest.approx(1e-3)
    assert any("bend" in note and "drives" in note for note in description.notes)


def test_servos_whose_control_is_no_angle_are_named(tmp_path: Path) -> None:
    servo = (
        '<general joint="j" biastype="affine" gainprm="{gain}" biasprm="{force} -60 -2" '
        'forcerange="-7 7"/>'
    )
    text = ACTUATED.format(actuators=servo, joint="", tendon="")
    path = tmp_path / "actuated.xml"
    for gain, force, is_named in ((60, 0, False), (45, 0, True), (60, 0.75, True)):
        path.write_text(text.replace("{gain}", str(gain)).replace("{force}", str(force)))
        notes = describe_model(path).notes
        assert any("no angles" in note for note in notes) == is_named


@pytest.mark.parametrize(
    ("joint", "word"), [("shut", "range"), ("loose", "actuator"), ("lift", "slide")]
)
def test_why_a_joint_is_held_is_said_when_it_is_asked_for(
    joint: str, word: str, tmp_path: Path
) -> None:
    path = tmp_path / "held.xml"
    body = ""
    for name, attributes in (
        ("bend", 'range="-1 1"'),
        ("shut", 'range="-0.005 0.005"'),
        ("loose", 'range="-1 1"'),
        ("lift", 'type="slide" range="0 1"'),
    ):
        body = (
            f'<body name="{name} link"><joint name="{name}" axis="0 1 0" {attributes}/>'
            f'<inertial pos=".1 0 0" mass="1" diaginertia=".01 .01 .01"/>{body}</body>'
        )
    servos = ""
    for name in ("bend", "shut", "lift"):
        servos += f'<position joint="{name}" kp="50" kv="1" forcerange="-90 90"/>'
    path.write_text(
        '<mujoco><compiler angle="radian" autolimits="true"/><option gravity="0 0 0"/>'
        f"<worldbody>{body}</worldbody><actuator>{servos}</actuator></mujoco>"
    )
    robot = load_robot(str(path))
    assert robot.joint_names == ("bend",)
    with pytest.raises(RobotError, match=word):
        robot.joint(joint)
