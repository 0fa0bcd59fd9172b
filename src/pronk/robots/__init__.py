"""What a robot is: joints, drives, limits, poses and its MuJoCo model.

A robot is a folder with `robot.yaml` and the MJCF or URDF that it names.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from importlib.metadata import entry_points
from pathlib import Path

from pronk.errors import RobotError
from pronk.plugins import load_entry_point
from pronk.robots.robot import Drive, Joint, RobotSpec

ROBOT_NAMES: tuple[str, ...] = ("mini_cheetah", "go2", "so101")
"""The robots that pronk brings."""
_FILES = (".yaml", ".yml")
_MODELS = (".xml", ".mjcf", ".urdf")


def load_robot(name: str | Path) -> RobotSpec:
    """Load a robot; a RobotError says that there is none, or what is inconsistent in its files.

    Args:
        name: A shipped robot, a path to a `robot.yaml` or its folder, to an MJCF or a URDF, or an
            entry point of the group `pronk.robots` (a function that returns such a path).
    """
    path, shipped = Path(name), str(name) in ROBOT_NAMES
    if shipped:
        path = Path(__file__).parent / str(name) / "robot.yaml"
    elif not path.exists():
        known = entry_points(group="pronk.robots")
        if str(name) not in known.names:
            raise RobotError(
                f"there is no robot {str(name)!r}; the robots are {', '.join(ROBOT_NAMES)}, or "
                "give the path of a robot.yaml, an MJCF or a URDF."
            )
        path = Path(load_entry_point(known[str(name)])())
    if path.is_dir():
        path = path / "robot.yaml"
    if path.suffix not in _FILES + _MODELS:
        raise RobotError(f"{path}: expected a robot.yaml, or a model ending in .xml or .urdf.")
    try:
        robot = _load(path.resolve(), path.stat().st_mtime_ns)
    except OSError:
        raise RobotError(f"{path}: no such file.") from None
    return replace(robot, source=str(name) if shipped else str(path.resolve()))


@lru_cache
def _load(path: Path, _changed: int) -> RobotSpec:
    from pronk.robots.bare import file_of_model
    from pronk.robots.load import make_robot, read_model, read_robot

    if path.suffix in _MODELS:
        return make_robot(file_of_model(path), read_model(path), str(path))
    return read_robot(path)


__all__ = ["ROBOT_NAMES", "Drive", "Joint", "RobotSpec", "load_robot"]
