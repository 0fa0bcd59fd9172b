"""What the training task reads of a quadruped, and robots that it would read wrongly."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import pronk.robots
from command_line import accepted, refused
from pronk.errors import RobotError
from pronk.jump.virtual.plant import legs_of
from pronk.robots import load_robot
from pronk.robots.legged import legged, opposite_legs
from pronk.robots.quadruped import quadruped_problems, require_quadruped
from quadruped_model import ANYMAL, SPOT, write_quadruped

GO2 = Path(pronk.robots.__file__).parent / "go2"
EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "trainable_quadruped.py"
Edit = Callable[[str], str]


def same(text: str) -> str:
    """Leave a file as it is."""
    return text


def replaced(old: str, new: str) -> Edit:
    """Return an edit that replaces what a pattern matches, which has to be there."""

    def edit(text: str) -> str:
        changed, count = re.subn(old, new, text)
        assert count
        return changed

    return edit


def go2_in(folder: Path, model: Edit = same, robot: Edit = same) -> Path:
    """Write the Go2 with a changed model or a changed robot.yaml to a folder; return the latter.

    Its mirror symmetry is left out, which `load_robot` verifies by itself.
    """
    folder.mkdir()
    shutil.copy(GO2 / "env_cfgs.py", folder)
    (folder / "go2.xml").write_text(model((GO2 / "go2.xml").read_text()))
    text = (GO2 / "robot.yaml").read_text()
    text = re.sub(r"symmetry:\n(  .*\n)+", "", text)
    path = folder / "robot.yaml"
    path.write_text(robot(text))
    return path


def renamed_knee(text: str) -> str:
    """Give the knee of the Go2 that is called FL_tibia a group of its own."""
    group = "  FL_tibia: {drive: knee, stiffness: 20.0, damping: 0.5, band_hz: [0.1, 15.0]}\n"
    text = replaced(r"(?m)^poses:", group + "\nposes:")(text)
    return replaced("knee: (-[0-9.]+)}", r"knee: \1, FL_tibia: \1}")(text)


def without_folded(text: str) -> str:
    """Leave out the pose from which the robot rises."""
    return replaced(r"(?m)^  folded:.*\n", "")(text)


@pytest.mark.parametrize("name", ["mini_cheetah", "go2"])
def test_shipped_quadrupeds_can_be_trained(name: str) -> None:
    assert quadruped_problems(load_robot(name)) == []


@pytest.mark.parametrize(
    ("legs", "opposite"),
    [
        (ANYMAL, {"LF": "RF", "LH": "RH", "RF": "LF", "RH": "LH"}),
        (SPOT, {"fl": "fr", "fr": "fl", "hl": "hr", "hr": "hl"}),
        (
            {"one": (0.3, 0.2), "two": (-0.3, -0.2), "three": (0.3, -0.2), "four": (-0.3, 0.2)},
            {"one": "three", "two": "four", "three": "one", "four": "two"},
        ),
        (
            {
                "front_left": (0.3, 0.2),
                "front_right": (0.3, -0.2),
                "rear_left": (-0.3, 0.2),
                "rear_right": (-0.3, -0.2),
            },
            {
                "front_left": "front_right",
                "front_right": "front_left",
                "rear_left": "rear_right",
                "rear_right": "rear_left",
            },
        ),
    ],
)
def test_sides_are_those_of_the_hips(
    legs: dict[str, tuple[float, float]], opposite: dict[str, str], tmp_path: Path
) -> None:
    """Whatever the legs are called, and in whatever order the model has them."""
    path = write_quadruped(tmp_path / "robot", legs)
    robot = load_robot(path)
    assert quadruped_problems(robot) == []
    assert legged(path).opposite == opposite
    assert legs_of(robot) == tuple(legs)


@pytest.mark.parametrize(
    ("legs", "joints"),
    [
        (ANYMAL, ("HAA", "HFE", "KFE")),
        (SPOT, ("hx", "hy", "kn")),
        (SPOT, ("hip_joint", "thigh_joint", "calf_joint")),
    ],
)
def test_joints_are_called_as_their_maker_calls_them(
    legs: dict[str, tuple[float, float]], joints: tuple[str, str, str], tmp_path: Path
) -> None:
    usual = legged(write_quadruped(tmp_path / "usual", legs))
    path = write_quadruped(tmp_path / "robot", legs, joints)
    assert quadruped_problems(load_robot(path)) == []
    body = legged(path)
    assert body.leg_joints == joints
    assert body.forward == usual.forward
    assert body.standing_height == usual.standing_height


def test_joints_of_a_leg_in_another_order_are_refused(tmp_path: Path) -> None:
    """Groups of one joint each, as in a fresh robot.yaml, and a thigh before its hip."""
    path = write_quadruped(tmp_path / "robot")
    text = path.read_text()
    groups = "".join(f"  {leg}_knee: {{drive: drive}}\n" for leg in ANYMAL)
    text = text.replace('  knee: {joints: "*_knee", drive: drive}\n', groups)
    angles = ", ".join(f"{leg}_knee: -1.0" for leg in ANYMAL)
    path.write_text(text.replace("knee: -1.0", angles))
    (problem,) = quadruped_problems(load_robot(path))
    assert "LH_knee" in problem
    assert "*_hip_roll" in problem
    assert "groups" in problem
    swapped = write_quadruped(tmp_path / "swapped")
    model = swapped.with_name("model.xml")
    words = model.read_text().replace('"LH_knee"', '"x"').replace('"LH_hip_pitch"', '"LH_knee"')
    model.write_text(words.replace('"x"', '"LH_hip_pitch"'))
    (problem,) = quadruped_problems(load_robot(swapped))
    assert "LH_knee, LH_hip_pitch" in problem


def test_sides_of_a_model_of_others() -> None:
    """Unitree's A1 as PyBullet has it, whose joints are FR_hip_joint and so on."""
    pybullet_data = pytest.importorskip("pybullet_data")
    robot = load_robot(Path(pybullet_data.getDataPath()) / "a1" / "a1.urdf")
    robot = replace(robot, legs=("FR", "FL", "RR", "RL"))
    opposite = opposite_legs(robot, robot.build_spec().compile())
    assert opposite == {"FR": "FL", "FL": "FR", "RR": "RL", "RL": "RR"}


def test_the_example_makes_a_urdf_trainable(tmp_path: Path) -> None:
    pybullet_data = pytest.importorskip("pybullet_data")
    model = Path(pybullet_data.getDataPath()) / "a1" / "a1.urdf"
    legs = ("--legs", "FR", "FL", "RR", "RL")
    pose = ("--pose", "0", "0.8", "-1.6")
    folder = tmp_path / "robot"
    subprocess.run([sys.executable, EXAMPLE, model, folder, *legs, *pose], check=True)
    robot = load_robot(folder)
    assert quadruped_problems(robot) == []
    urdf = load_robot(model).build_spec().compile()
    mass = float(urdf.body_mass.sum())
    assert legged(folder).total_mass == pytest.approx(mass)


@pytest.mark.parametrize(
    "legs",
    [
        {"LF": (0.36, 0.2), "RF": (0.36, -0.2), "LH": (-0.36, 0.2), "RH": (-0.36, 0.3)},
        {"LF": (0.36, 0.2), "RF": (0.36, -0.2), "LH": (-0.36, 0.2), "RH": (-0.3, -0.2)},
        # The front is where the model's x axis does not point.
        {"LF": (-0.36, -0.2), "RF": (-0.36, 0.2), "LH": (0.36, -0.2), "RH": (0.36, 0.2)},
    ],
)
def test_legs_in_wrong_places_are_named(
    legs: dict[str, tuple[float, float]], tmp_path: Path
) -> None:
    problems = quadruped_problems(load_robot(write_quadruped(tmp_path / "robot", legs)))
    assert any("hips are" in problem and "RH at x" in problem for problem in problems)


@pytest.mark.parametrize(
    ("model", "robot", "named"),
    [
        (same, replaced(r"(?m)^legs:.*$", ""), ["legs: [FR, FL, RR, RL]"]),
        (same, replaced(r"(?m)^legs:.*$", "legs: [FL, FR, RL, RR]"), ["FR, FL, RR, RL"]),
        (same, replaced(r"(?m)^legs:.*$", "legs: [FR, FL, RR]"), ["four"]),
        (replaced("FL_knee", "FL_tibia"), renamed_knee, ["FL_tibia", "FL_knee"]),
        (replaced(r"<geom name=\"F._foot_collision.*\n", ""), same, ["FR_foot_", "FL_foot_"]),
        (replaced(r"<site name=\"RL_foot.*\n", ""), same, ["site RL_foot"]),
        (replaced(r"<freejoint[^>]*>", ""), same, ["<freejoint/>"]),
        (replaced(r'(<site name="RL_foot" pos="-0.002 0 )-0.213', r"\1-0.1"), same, ["RL_foot"]),
        (
            replaced(r'(FR_shank_collision" .* fromto=")0 0 -0.02', r"\g<1>0.05 0 -0.02"),
            same,
            ["FR_shank_collision", "capsule"],
        ),
        (
            replaced(r"(<freejoint[^>]*>)", r'\1<geom name="guard" size=".1" mass="0"/>'),
            same,
            ["guard", "contype"],
        ),
        (
            replaced(r'(trunk_collision" class="collision")', r'\1 contype="0" conaffinity="0"'),
            same,
            ["trunk_collision", "floor"],
        ),
        (
            replaced(r'(FR_foot_collision" class="collision")', r'\1 contype="1"'),
            same,
            ["FR_foot_collision", "parts of the robot"],
        ),
        (replaced(r'(FL_hip_roll"[^>]*axis=")1 0 0', r"\1-1 0 0"), same, ["hip_roll", "FL"]),
        (replaced(r'(_hip_pitch"[^>]*axis=")0 1 0', r"\g<1>1 0 0"), same, ["y axis"]),
        (
            same,
            replaced("hip_roll: 0.0, hip_pitch: 0.9", "hip_roll: 0.2, hip_pitch: 0.9"),
            ["-0.2"],
        ),
        (same, replaced("hip_pitch: 0.9, knee: -1.8", "hip_pitch: 0.0, knee: -1.3"), ["tips over"]),
    ],
)
def test_a_robot_that_would_be_read_wrongly_is_refused(
    model: Edit, robot: Edit, named: list[str], tmp_path: Path
) -> None:
    path = go2_in(tmp_path / "robot", model, robot)
    spec = load_robot(path)
    with pytest.raises(RobotError) as refusal:
        require_quadruped(spec)
    for name in [*named, str(path)]:
        assert name in str(refusal.value)


def test_all_missing_parts_are_named_at_once(tmp_path: Path) -> None:
    model = replaced(r"<(geom|site) name=\"R._(thigh_collision|foot)\".*\n", "")
    text = " ".join(quadruped_problems(load_robot(go2_in(tmp_path / "robot", model))))
    for name in ("RR_foot", "RL_foot", "RR_thigh_collision", "RL_thigh_collision"):
        assert name in text


def test_the_sign_of_the_axes_is_free(tmp_path: Path) -> None:
    """The Go2 with pitch and knee axes to the right, as the Mini Cheetah's."""
    model = replaced(r'axis="0 1 0" range="(\S+) (\S+)"', r'axis="0 -1 0" range="-3.6 3.6"')
    robot = replaced("hip_pitch: 0.9, knee: -1.8", "hip_pitch: -0.9, knee: 1.8")
    robot_file = go2_in(tmp_path / "robot", model, lambda text: robot(without_folded(text)))
    assert quadruped_problems(load_robot(robot_file)) == []
    assert legged(robot_file).forward == -legged("go2").forward
    assert legged(robot_file).standing_height == pytest.approx(legged("go2").standing_height)


@pytest.mark.train
def test_training_refuses_such_a_robot_before_it_builds_it(tmp_path: Path) -> None:
    pytest.importorskip("mjlab")
    robot = go2_in(tmp_path / "robot", replaced("_thigh_collision", "_thigh_cover"))
    out = tmp_path / "run"
    words = ("--gains", "naive", "--envs", "2", "--device", "cpu", "--out", out)
    said = refused("train", "all", "--robot", robot, *words)
    assert "FR_thigh_collision" in said
    assert "train-your-robot.md" in said


def test_check_names_what_training_needs(tmp_path: Path) -> None:
    bare = go2_in(tmp_path / "robot", replaced(r"<site name=\"RL_foot.*\n", ""))
    assert "RL_foot" in accepted("robot", "check", bare)
    assert "train" not in accepted("robot", "check", "go2")


@pytest.mark.parametrize("height", ["0 0 0", "0 0 0.7"])
def test_the_standing_height_is_that_of_the_feet(height: str, tmp_path: Path) -> None:
    """Wherever a file has its base: at the origin, as a URDF, or above the floor."""
    model = replaced(r'(<body name="trunk" pos=)"[^"]*"', rf'\1"{height}"')
    body = legged(go2_in(tmp_path / "robot", model))
    assert body.standing_height == pytest.approx(legged("go2").standing_height, abs=1e-9)
