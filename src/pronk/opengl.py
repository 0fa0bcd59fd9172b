"""OpenGL for rendering, kept out of processes that do not render.

MuJoCo loads the OpenGL that MUJOCO_GL names, or GLFW where it names none, as it is imported: that
takes a third of the time of its import, and it cannot be imported where the named one is missing.
Only the rendering process needs one (`pronk.jump.trial.films.render`).
"""

from __future__ import annotations

import os

_MUJOCO_VARIABLE = "MUJOCO_GL"
_REQUESTED_VARIABLE = "PRONK_GL"
_NO_OPENGL = "disable"
"""MuJoCo's name for no OpenGL."""


def keep_opengl_out() -> None:
    """Keep OpenGL out of this process and its children.

    `requested_opengl` still returns what the user has chosen.
    """
    os.environ.setdefault(_REQUESTED_VARIABLE, os.environ.get(_MUJOCO_VARIABLE, ""))
    os.environ[_MUJOCO_VARIABLE] = _NO_OPENGL


def requested_opengl() -> str:
    """Return the value of MUJOCO_GL that the user has set, in small letters; empty if none."""
    value = os.environ.get(_MUJOCO_VARIABLE, "")
    return os.environ.get(_REQUESTED_VARIABLE, value).lower()
