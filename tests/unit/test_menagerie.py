"""Robots of MuJoCo Menagerie by name; a folder of the test stands for its checkout."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import pytest

from command_line import accepted, refused
from pronk.errors import RobotError
from pronk.identify.match.export.actuators import robot_of
from pronk.identify.match.gains import FittedValue, JointGains, MatchedGains, load_gains, save_gains
from pronk.identify.match.match import file_of_robot
from pronk.identify.simulators.info import SimulatorInfo
from pronk.robots import load_robot

mujoco_menagerie = pytest.importorskip("mujoco_menagerie", reason="needs pronk[menagerie]")

NAME = "menagerie:dynamixel_2r"
MODEL = """
<mujoco model="two_link">
  <compiler angle="radian"/>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" range="-1.5 1.5" armature="0.01"/>
      <geom type="capsule" size="0.02" fromto="0 0 0 0.2 0 0" mass="0.4"/>
      <body name="fore" pos="0.2 0 0">
        <joint name="elbow" axis="0 1 0" range="-1 2" armature="0.005"/>
        <geom type="capsule" size="0.02" fromto="0 0 0 0.2 0 0" mass="0.2"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position joint="shoulder" kp="20" kv="1" forcerange="-8 8"/>
    <position joint="elbow" kp="10" kv="0.5" forcerange="-4 4"/>
  </actuator>
</mujoco>
"""


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    robot = mujoco_menagerie.get(NAME.removeprefix("menagerie:"))
    folder = tmp_path / "checkout" / robot.name
    folder.mkdir(parents=True)
    (folder / robot.entry(robot.default_model).file).write_text(MODEL)
    monkeypatch.setenv("MENAGERIE_ROOT", str(folder.parent))
    return folder


def test_robot_is_that_of_its_model(checkout: Path) -> None:
    robot = load_robot(NAME)
    assert robot.joint_names == ("shoulder", "elbow")
    assert [joint.stiffness for joint in robot.joints] == [20.0, 10.0]
    assert [joint.drive.effort_limit for joint in robot.joints] == [8.0, 4.0]
    entry = mujoco_menagerie.get("dynamixel_2r").default_model
    assert load_robot(f"{NAME}/{entry}").joint_names == robot.joint_names
    # The name, not the place on this computer, is what other commands and computers take.
    assert load_robot(robot.source).joint_names == robot.joint_names


def test_commands_take_the_name(checkout: Path, tmp_path: Path) -> None:
    assert "elbow" in accepted("robot", "check", NAME)
    plan = accepted(
        "sweep", NAME, "--link", "sim", "--out", tmp_path, "--amplitude", "0.05", "--plan-only"
    )
    assert "elbow" in plan


def test_gains_keep_the_name(checkout: Path, tmp_path: Path) -> None:
    robot = load_robot(NAME)
    joint = JointGains(
        stiffness=FittedValue(value=9.0),
        damping=FittedValue(value=0.4),
        armature=FittedValue(value=0.005),
    )
    gains = MatchedGains(
        robot=robot.name, simulator=SimulatorInfo(), joints={"elbow": joint}, groups={}
    )
    path = tmp_path / "elsewhere" / "gains.yaml"
    save_gains(path, replace(gains, robot_path=file_of_robot(robot)))
    assert robot_of(load_gains(path)).joint_names == robot.joint_names


def test_wrong_names_are_refused_with_close_ones(checkout: Path) -> None:
    with pytest.raises(RobotError, match="unitree_go2"):
        load_robot("menagerie:go2")
    with pytest.raises(RobotError, match="franka_emika_panda"):
        load_robot("menagerie:franka_emica_panda")
    with pytest.raises(RobotError, match="scene"):
        load_robot("menagerie:unitree_go2/no_such_model")
    assert "no robot" in refused("robot", "check", "menagerie:")


def test_download_that_fails_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MENAGERIE_ROOT", raising=False)
    monkeypatch.setenv("MENAGERIE_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("MENAGERIE_BASE_URL", (tmp_path / "nowhere").as_uri())
    message = refused("robot", "check", NAME)
    assert "cannot be downloaded" in message
    assert "prefetch dynamixel_2r" in message


def test_package_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", None)
    with pytest.raises(RobotError, match=r"pronk\[menagerie\]"):
        load_robot(NAME)
