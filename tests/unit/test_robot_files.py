"""The files that a robot is read from, and the key that follows what they say."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import mujoco
import pytest

import pronk.robots
from pronk.robots import ROBOT_NAMES, load_robot
from pronk.robots.robot_files import model_files, robot_files, robot_key

SHIPPED = Path(pronk.robots.__file__).parent
MODEL = """
<mujoco model="leg">
  <compiler meshdir="parts" {options}/>
  <include file="feet.xml"/>
  <!-- <include file="old.xml"/> -->
  <asset><mesh name="shank" file="{mesh}"/></asset>
  <worldbody>
    <body name="thigh">
      <joint name="hip" axis="0 1 0"/>
      <geom type="box" size="0.1 0.1 0.1"/>
      <body name="shank"><joint name="knee" axis="0 1 0"/><geom type="mesh" mesh="shank"/></body>
    </body>
  </worldbody>
</mujoco>
"""
FEET = '<mujocoinclude><asset><mesh name="foot" file="foot.obj"/></asset></mujocoinclude>'
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def copied_cheetah(folder: Path) -> Path:
    """Copy the files of the Mini Cheetah to a folder; return its robot.yaml."""
    shutil.copytree(SHIPPED / "mini_cheetah", folder)
    return folder / "robot.yaml"


def write_model(folder: Path, mesh: str = "shank.obj", options: str = "") -> Path:
    """Write a model that includes another and has meshes; return its file."""
    (folder / "parts").mkdir(parents=True)
    (folder / "leg.xml").write_text(MODEL.format(mesh=mesh, options=options))
    (folder / "feet.xml").write_text(FEET)
    (folder / "old.xml").write_text("no longer part of it")
    for name in ("shank.obj", "foot.obj", "unused.obj"):
        (folder / "parts" / name).write_text(TETRAHEDRON)
    return folder / "leg.xml"


@pytest.mark.parametrize(
    ("mesh", "options"), [("shank.obj", ""), ("/far/away/shank.obj", 'strippath="true"')]
)
def test_a_model_copied_by_its_files_alone_compiles(
    tmp_path: Path, mesh: str, options: str
) -> None:
    path = write_model(tmp_path / "model", mesh, options)
    files = model_files(path)
    copy = tmp_path / "copy"
    for file in files:
        target = copy / file.relative_to(path.parent)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, target)
    names = {file.name for file in files}
    assert names == {"leg.xml", "feet.xml", "shank.obj", "foot.obj"}
    model = mujoco.MjModel.from_xml_path(str(copy / "leg.xml"))
    expected = mujoco.MjModel.from_xml_path(str(path))
    assert model.nmesh == 2
    assert (model.body_mass == expected.body_mass).all()


def test_the_meshes_of_a_urdf_are_found_through_its_package(tmp_path: Path) -> None:
    folder = tmp_path / "my_robot"
    (folder / "meshes").mkdir(parents=True)
    (folder / "meshes" / "base.stl").write_bytes(b"")
    urdf = folder / "urdf" / "robot.urdf"
    urdf.parent.mkdir()
    geometry = '<geometry><mesh filename="package://my_robot/meshes/base.stl"/></geometry>'
    urdf.write_text(
        f'<robot name="r"><link name="base"><collision>{geometry}</collision></link></robot>'
    )
    assert model_files(urdf) == (urdf, folder / "meshes" / "base.stl")


@pytest.mark.parametrize("name", ROBOT_NAMES)
def test_a_shipped_robot_is_its_name_in_keys(name: str) -> None:
    assert robot_key(load_robot(name)) == name
    suffixes = [path.suffix for path in robot_files(name)]
    assert suffixes == [".yaml", ".xml"]


def test_the_key_of_a_robot_of_files_is_their_content(tmp_path: Path) -> None:
    first = load_robot(copied_cheetah(tmp_path / "first"))
    moved = load_robot(copied_cheetah(tmp_path / "moved"))
    assert robot_key(first) == robot_key(moved) != first.name
    noted = copied_cheetah(tmp_path / "noted")
    noted.write_text(f"# My robot.\n{noted.read_text()}")
    assert robot_key(load_robot(noted)) == robot_key(first)


@pytest.mark.parametrize(
    ("file", "old", "new"),
    [
        ("robot.yaml", "stiffness: 17.0", "stiffness: 18.0"),
        ("mini_cheetah.xml", 'mass="6.607999999999999"', 'mass="6.6080001"'),
    ],
)
def test_a_changed_robot_of_the_same_name_has_another_key(
    tmp_path: Path, file: str, old: str, new: str
) -> None:
    path = copied_cheetah(tmp_path / "robot")
    changed = copied_cheetah(tmp_path / "changed")
    text = (changed.parent / file).read_text()
    assert old in text
    (changed.parent / file).write_text(text.replace(old, new))
    robot = load_robot(path)
    other = load_robot(changed)
    assert other.name == robot.name
    assert robot_key(other) != robot_key(robot)


def test_a_robot_whose_model_is_built_by_a_function_has_a_key_of_its_own(tmp_path: Path) -> None:
    robot = load_robot(copied_cheetah(tmp_path / "robot"))

    def build() -> mujoco.MjSpec:
        return robot.build_spec()

    built = replace(robot, build_spec=build)
    assert robot_key(built) != robot_key(replace(built, base_body="FR_hip"))
