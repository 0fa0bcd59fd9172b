"""Robots: joints, drives, limits, poses and the MuJoCo model of each.

A robot is a folder with `robot.yaml` and the MJCF or URDF that it names.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import NamedTuple

from pronk.errors import RobotError
from pronk.plugins import load_entry_point
from pronk.robots.menagerie import MENAGERIE, menagerie_file
from pronk.robots.robot import Drive, Joint, RobotSpec

ROBOT_NAMES: tuple[str, ...] = ("mini_cheetah", "go2", "so101")
"""The robots that pronk brings."""
ROBOT_SUFFIXES = (".yaml", ".yml")
"""Endings of robot files."""
MODEL_SUFFIXES = (".xml", ".mjcf", ".urdf")
"""Endings of models."""


def load_robot(name: str | Path) -> RobotSpec:
    """Load a robot.

    Args:
        name: A shipped robot (`mini_cheetah`, `go2`, `so101`); a path to a `robot.yaml` or its
            folder, to an MJCF or a URDF; `menagerie:NAME`, a robot of MuJoCo Menagerie through the
            package `mujoco-menagerie`; or an entry point of the group `pronk.robots`, a function
            that returns such a path.

    Returns:
        The robot: its joints, drives, gains and poses, and a recipe for its MuJoCo model.

    Raises:
        RobotError: There is no such robot, or its files are inconsistent; the message says where.

    Examples:
        >>> import pronk
        >>> robot = pronk.load_robot("mini_cheetah")
        >>> robot.joint("FR_knee").drive.effort_limit
    """
    version = robot_version(name)
    named = str(name) in ROBOT_NAMES or str(name).startswith(MENAGERIE)
    return replace(_read(*version), source=str(name) if named else str(version.path))


class RobotVersion(NamedTuple):
    """The file of a robot as it is now: the key of what was read of the robot."""

    path: Path
    """The whole path of the robot.yaml or the model."""
    modified_ns: int
    """Time of its last modification [ns]."""
    model_modified_ns: int
    """Time of the last modification of the model [ns]; 0 for one that is missing."""


def robot_version(name: str | Path) -> RobotVersion:
    """Return the file of a robot as it is now; see `load_robot`."""
    path = robot_file_path(name)
    try:
        modified_ns = path.stat().st_mtime_ns
    except OSError:
        raise RobotError(f"{path}: no such file.") from None
    whole_path = path.resolve()
    model_modified_ns = 0
    with suppress(OSError):  # a model that is missing is named as the robot is read
        model_modified_ns = _model_file(whole_path, modified_ns).stat().st_mtime_ns
    return RobotVersion(whole_path, modified_ns, model_modified_ns)


def robot_file_path(name: str | Path) -> Path:
    """Return the robot.yaml or the model of a robot; see `load_robot`."""
    if str(name) in ROBOT_NAMES:
        return Path(__file__).parent / str(name) / "robot.yaml"
    if str(name).startswith(MENAGERIE):
        return menagerie_file(str(name))
    path = Path(name)
    if not path.exists():
        installed = entry_points(group="pronk.robots")
        if str(name) not in installed.names:
            raise RobotError(
                f"there is no robot {str(name)!r}; the robots are {', '.join(ROBOT_NAMES)}, or "
                f"give the path of a robot.yaml, an MJCF or a URDF, or {MENAGERIE}NAME for a robot "
                "of MuJoCo Menagerie."
            )
        path = Path(load_entry_point(installed[str(name)])())
    if path.is_dir():
        path = path / "robot.yaml"
    if path.suffix not in ROBOT_SUFFIXES + MODEL_SUFFIXES:
        raise RobotError(f"{path}: expected a robot.yaml, or a model ending in .xml or .urdf.")
    return path


@lru_cache
def _model_file(path: Path, _modified_ns: int) -> Path:
    """Return the model that a robot file names; a model itself."""
    from pronk.robots.load import read_robot_file

    if path.suffix in MODEL_SUFFIXES:
        return path
    return path.parent / read_robot_file(path).model


@lru_cache
def _read(path: Path, _modified_ns: int, _model_modified_ns: int) -> RobotSpec:
    """Read a robot once for each time of the last modification of its file and of its model."""
    from pronk.robots.bare import file_of_model
    from pronk.robots.load import make_robot, read_robot
    from pronk.robots.source_model import read_source

    if path.suffix in MODEL_SUFFIXES:
        return make_robot(file_of_model(path), read_source(path), str(path))
    return read_robot(path)


__all__ = ["ROBOT_NAMES", "Drive", "Joint", "RobotSpec", "load_robot", "robot_file_path"]
