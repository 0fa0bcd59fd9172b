"""A robot from files alone: sweep on the virtual robot, match, predict, export."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

import pronk.robots
from command_line import accepted, refused
from pronk.identify.logs.options import ReadOptions
from pronk.identify.logs.readers import read_log
from pronk.identify.match.gains import load_gains
from pronk.identify.match.match import match
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

LINK = """
  <link name="{child}">
    <inertial><origin xyz="0 0 -0.1"/><mass value="{mass}"/>
      <inertia ixx="0.01" iyy="0.01" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
  </link>
  <joint name="{name}" type="revolute">
    <parent link="{parent}"/><child link="{child}"/><origin xyz="0 0 -0.3"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="{effort}" velocity="10"/>
    <dynamics damping="0.05" friction="0.1"/>
  </joint>
"""
SHOULDER = {"name": "shoulder", "parent": "base", "child": "upper", "mass": 1.0, "effort": 40}
ELBOW = {"name": "elbow", "parent": "upper", "child": "lower", "mass": 0.5, "effort": 20}
LINKS = LINK.format(**SHOULDER) + LINK.format(**ELBOW)
ARM = f'<robot name="arm"><link name="base"/>{LINKS}</robot>'


def model_of(model: str, folder: Path) -> Path:
    """Write a model file as a user has it."""
    path = folder / ("arm.urdf" if model == "arm" else f"{model}.xml")
    cheetah = Path(pronk.robots.__file__).parent / "mini_cheetah" / "mini_cheetah.xml"
    texts = {"arm": ARM, "pendulum": PENDULUM, "cheetah": cheetah.read_text()}
    path.write_text(texts[model])
    return path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "joint"), [("pendulum", "swing"), ("arm", "elbow"), ("cheetah", "FR_knee")]
)
def test_sweep_match_predict_export(model: str, joint: str, tmp_path: Path) -> None:
    robot = tmp_path / "robot.yaml"
    gains = tmp_path / "gains.yaml"
    logs = tmp_path / "logs"
    matched = tmp_path / "matched.xml"
    sweep = ("--amplitude", "0.15", "--repeats", "1", "--joints", joint)
    accepted("robot", "new", model_of(model, tmp_path))
    accepted("robot", "check", robot)
    accepted("sweep", robot, "--out", logs, *sweep)
    # A magnitude alone cannot tell from its gains that the knee sticks at this amplitude, and takes
    # half a minute for the arm.
    method = ("paper", "--no-zero-armature") if model == "pendulum" else ("time",)
    accepted("match", logs, "--robot", robot, "--out", gains, "--method", *method)
    accepted("predict", logs, "--robot", robot, "--gains", gains)
    accepted("export", gains, "--robot", robot, "--to", "mjcf", "--out", matched)
    # The virtual robot gives a tenth more torque than its drive computes.
    stiffness = load_gains(gains).joints[joint].stiffness.value
    share = stiffness / load_robot(robot).joint(joint).stiffness
    assert 0.7 < share < 1.6


@pytest.mark.parametrize("model", ["pendulum", "arm", "cheetah"])
def test_bare_model_is_a_robot(model: str, tmp_path: Path) -> None:
    bare = load_robot(model_of(model, tmp_path))
    for joint in bare.joints:
        assert joint.name in joint.chain
        assert joint.stiffness > 0.0
    if model == "cheetah":
        assert bare.joint_names == load_robot("mini_cheetah").joint_names


def test_new_robot_does_not_replace_a_file(tmp_path: Path) -> None:
    words = ["robot", "new", model_of("pendulum", tmp_path)]
    accepted(*words)
    refused(*words)
    accepted(*words, "--overwrite")


@pytest.mark.parametrize("name", pronk.robots.ROBOT_NAMES)
def test_shipped_robots_pass_the_check(name: str) -> None:
    assert "nothing is inconsistent" in accepted("robot", "check", name)


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


def test_gains_of_held_joints_are_those_that_were_on_the_drives(tmp_path: Path) -> None:
    example = Path(__file__).resolve().parents[2] / "examples" / "csv_to_isaaclab"
    shutil.copytree(example, tmp_path / "leg")
    text = (tmp_path / "leg" / "robot.yaml").read_text(encoding="utf-8")
    soft = text.replace(
        "knee: {drive: motor, stiffness: 25.0, damping: 0.6",
        "knee: {drive: motor, servo: none, stiffness: 3.0, damping: 0.1",
    )
    (tmp_path / "leg" / "soft.yaml").write_text(soft, encoding="utf-8")
    columns = {"time": "t_ms"}
    for joint in ("hip", "knee"):
        columns[f"command.{joint}"] = f"{joint}_des"
        columns[f"position.{joint}"] = f"{joint}_act"
    options = ReadOptions(unit="deg", time_unit="ms", columns=columns)
    gains = {"hip": (30.0, 0.8), "knee": (25.0, 0.6)}
    stiffness = {}
    flags = {}
    for name, drive_gains in (("robot", gains), ("soft", gains), ("assumed", "default")):
        file = "robot" if name == "robot" else "soft"
        robot = load_robot(tmp_path / "leg" / f"{file}.yaml")
        log = read_log(tmp_path / "leg" / "chirp.csv", robot=robot, options=options)
        result = match([log], robot, drive_gains=drive_gains)
        stiffness[name] = result.gains.joints["hip"].stiffness.value
        flags[name] = " ".join(result.flags.get("hip", ()))
    # The gains that are stated count, whatever the file assumes of the knee.
    assert stiffness["soft"] == pytest.approx(stiffness["robot"], rel=1e-6)
    assert "held joints" not in flags["robot"] + flags["soft"]
    assert stiffness["assumed"] != pytest.approx(stiffness["robot"], rel=0.02)
    assert flags["assumed"].startswith("held joints: the gains of knee")
