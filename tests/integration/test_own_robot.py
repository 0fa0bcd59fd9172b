"""A robot from files alone: sweep on the virtual robot, match, predict, export."""

from __future__ import annotations

from pathlib import Path

import pytest

import pronk.robots
from command_line import accepted, refused
from pronk.match.gains import load
from pronk.robots import load_robot

PENDULUM = """
<mujoco model="pendulum">
  <worldbody>
    <body name="rod" pos="0 0 1">
      <joint name="swing" axis="0 1 0" range="-120 120" armature="0.02" frictionloss="0.1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="0.5"/>
    </body>
  </worldbody>
</mujoco>
"""

ARM = """
<robot name="arm">
  <link name="base"/>
  <link name="upper">
    <inertial><origin xyz="0 0 -0.15"/><mass value="1.0"/>
      <inertia ixx="0.01" iyy="0.01" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <link name="lower">
    <inertial><origin xyz="0 0 -0.1"/><mass value="0.5"/>
      <inertia ixx="0.004" iyy="0.004" izz="0.0005" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="shoulder" type="revolute">
    <parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="40" velocity="10"/>
    <dynamics damping="0.05" friction="0.2"/>
  </joint>
  <joint name="elbow" type="revolute">
    <parent link="upper"/><child link="lower"/><origin xyz="0 0 -0.3"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="20" velocity="10"/>
    <dynamics damping="0.02" friction="0.1"/>
  </joint>
</robot>
"""


def model_of(kind: str, folder: Path) -> Path:
    """Write a model file as a user has it."""
    path = folder / ("arm.urdf" if kind == "arm" else f"{kind}.xml")
    cheetah = Path(pronk.robots.__file__).parent / "mini_cheetah" / "mini_cheetah.xml"
    texts = {"arm": ARM, "pendulum": PENDULUM, "cheetah": cheetah.read_text()}
    path.write_text(texts[kind])
    return path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "joint"), [("pendulum", "swing"), ("arm", "elbow"), ("cheetah", "FR_knee")]
)
def test_sweep_match_predict_export(kind: str, joint: str, tmp_path: Path) -> None:
    robot, gains, logs = tmp_path / "robot.yaml", tmp_path / "gains.yaml", tmp_path / "logs"
    once, of = ("--amplitude", "0.15", "--repeats", "1", "--joints", joint), ("--robot", robot)
    accepted("robot", "new", model_of(kind, tmp_path))
    accepted("robot", "check", robot)
    accepted("sweep", robot, "--out", logs, *once)
    accepted("match", logs, *of, "--out", gains, "--method", "paper")
    accepted("predict", logs, *of, "--gains", gains)
    accepted("export", gains, *of, "--to", "mjcf", "--out", tmp_path / "matched.xml")
    # The virtual robot gives a tenth more torque than its drive computes.
    share = load(gains).joints[joint].stiffness / load_robot(robot).joint(joint).stiffness
    assert 0.7 < share < 1.6


@pytest.mark.parametrize("kind", ["pendulum", "arm", "cheetah"])
def test_bare_model_is_a_robot(kind: str, tmp_path: Path) -> None:
    bare = load_robot(model_of(kind, tmp_path))
    assert all(one.name in one.chain and one.stiffness > 0.0 for one in bare.joints)
    if kind == "cheetah":
        assert bare.joint_names == load_robot("mini_cheetah").joint_names


def test_new_robot_does_not_replace_a_file(tmp_path: Path) -> None:
    words = ["robot", "new", model_of("pendulum", tmp_path)]
    accepted(*words)
    refused(*words)
    accepted(*words, "--overwrite")


@pytest.mark.parametrize("name", pronk.robots.ROBOT_NAMES)
def test_shipped_robots_pass_the_check(name: str) -> None:
    accepted("robot", "check", name)


def test_installed_robot_is_found_by_its_entry_point(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model_of("pendulum", tmp_path)
    package = tmp_path / "site"
    info = package / "my_robots-1.0.dist-info"
    info.mkdir(parents=True)
    function = f"def pendulum(): return {str(tmp_path / 'pendulum.xml')!r}"
    (package / "my_robots.py").write_text(function)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my_robots\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[pronk.robots]\nmy_pendulum = my_robots:pendulum\n")
    monkeypatch.syspath_prepend(str(package))
    assert load_robot("my_pendulum").joint_names == ("swing",)
