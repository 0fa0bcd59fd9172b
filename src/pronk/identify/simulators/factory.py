"""The callable that makes a simulator of a robot, by path or by entry point.

It needs NumPy only, so that it also runs in another Python.
"""

from __future__ import annotations

import runpy
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from pronk.errors import PronkError
from pronk.plugins import load_entry_point
from pronk.robots.robot import RobotSpec

ENTRY_POINTS = "pronk.simulators"
"""Group of entry points in which installed packages offer simulators."""


def simulator_factory(choice: str) -> Callable[[RobotSpec], Any]:
    """Return the callable that a choice of a simulator names.

    Args:
        choice: `FILE.py:NAME`, or an entry point of the group `pronk.simulators`.

    Raises:
        PronkError: There is no such simulator, or its code cannot be loaded.
    """
    file, colon, name = choice.rpartition(":")
    if colon and file.endswith(".py"):
        return _from_file(choice, Path(file), name)
    installed = entry_points(group=ENTRY_POINTS)
    if choice not in installed.names:
        names = ["mujoco", *sorted(installed.names)]
        raise PronkError(
            f"simulator {choice!r}; expected FILE.py:NAME, as in "
            f"examples/my_simulator.py:Pendulum, or one of {', '.join(names)}."
        )
    make: Callable[[RobotSpec], Any] = load_entry_point(installed[choice])
    return make


def _from_file(choice: str, path: Path, name: str) -> Callable[[RobotSpec], Any]:
    """Run a Python file and return one of its members."""
    if not path.is_file():
        raise PronkError(f"simulator {choice}: there is no file {path}.")
    # The module is not called as its file, whose name may be that of the engine that it imports.
    module_name = f"simulator in {path.name}"
    try:
        members = runpy.run_path(str(path), run_name=module_name)
    except ModuleNotFoundError as error:
        raise PronkError(
            f"simulator {choice}: {path} needs the module {error.name}, which is not installed; "
            "install it, or name a Python that has it with --simulator-python."
        ) from error
    except Exception as error:  # Code of others may fail in any way.
        raise PronkError(
            f"simulator {choice}: {path} cannot be loaded ({type(error).__name__}: {error})."
        ) from error
    member = members.get(name)
    if callable(member):
        make: Callable[[RobotSpec], Any] = member
        return make
    classes = []
    for other in members.values():
        if isinstance(other, type) and other.__module__ == module_name:
            classes.append(other.__name__)
    raise PronkError(
        f"simulator {choice}: {path} has no {name!r} that can be called; its classes are "
        f"{', '.join(classes) or 'none'}."
    )
