"""Robots of MuJoCo Menagerie by name, through the package `mujoco-menagerie`.

The package has the names; it downloads a model at its first use and keeps it in its own cache.
"""

from __future__ import annotations

import difflib
from pathlib import Path

from pronk.errors import RobotError

MENAGERIE = "menagerie:"
"""Beginning of the name of a robot of MuJoCo Menagerie."""
_MOST_CLOSE_NAMES = 5


def menagerie_file(name: str) -> Path:
    """Return the MJCF of a robot of MuJoCo Menagerie, which is downloaded if need be.

    Args:
        name: `menagerie:NAME`, or `menagerie:NAME/MODEL` where a robot has several models.

    Raises:
        RobotError: The package is not installed, has no such robot or model, or cannot download it.
    """
    try:
        import mujoco_menagerie  # an optional package
    except ImportError:
        raise RobotError(
            f"{name}: the package mujoco-menagerie is not installed; install it with "
            "`pip install 'pronk[menagerie]'`."
        ) from None
    robot_name, _, entry_name = name.removeprefix(MENAGERIE).partition("/")
    names = mujoco_menagerie.names()
    if robot_name not in names:
        close_names = _close_names(robot_name, names)
        listed = f"close names are {', '.join(close_names)}" if close_names else "none is close"
        raise RobotError(
            f"{name}: MuJoCo Menagerie has no robot {robot_name!r}; {listed}; `mujoco-menagerie "
            f"names` lists all {len(names)}."
        )
    robot = mujoco_menagerie.get(robot_name)
    entry = entry_name or robot.default_model
    if entry not in robot.entry_names:
        raise RobotError(
            f"{name}: {robot_name} has no model {entry!r}; its models are "
            f"{', '.join(robot.entry_names)}."
        )
    try:
        file: Path = robot.xml(entry)
    except (mujoco_menagerie.MenagerieError, OSError) as error:
        reason = " ".join(str(error).split())
        raise RobotError(
            f"{name}: the model is not in the cache of mujoco-menagerie and cannot be downloaded "
            f"({reason}); run `mujoco-menagerie prefetch {robot_name}` where there is a network, "
            "or set MENAGERIE_ROOT to a checkout of mujoco_menagerie."
        ) from None
    return file


def _close_names(name: str, names: list[str]) -> list[str]:
    """Return the names that contain a name, then those that are spelled alike."""
    close_names = []
    for candidate in names:
        if name and name.lower() in candidate:
            close_names.append(candidate)
    for candidate in difflib.get_close_matches(name, names, n=_MOST_CLOSE_NAMES):
        if candidate not in close_names:
            close_names.append(candidate)
    return close_names[:_MOST_CLOSE_NAMES]
