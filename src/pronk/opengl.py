"""OpenGL for rendering, kept out of processes that do not render.

MuJoCo loads the OpenGL that MUJOCO_GL names as it is imported, and cannot be imported where that is
missing. Only the rendering process needs one (`pronk.jump.trial.films.render`).
"""

from __future__ import annotations

import os

_MUJOCO = "MUJOCO_GL"
_REQUESTED = "PRONK_GL"
_NONE = "disable"  # MuJoCo's name for no OpenGL


def keep_out() -> None:
    """Keep OpenGL out of this process and its children; `requested` still returns the choice."""
    if chosen := os.environ.get(_MUJOCO):
        os.environ.setdefault(_REQUESTED, chosen)
        os.environ[_MUJOCO] = _NONE


def requested() -> str:
    """The value of MUJOCO_GL that the user has set, in small letters; empty if none."""
    return os.environ.get(_REQUESTED, os.environ.get(_MUJOCO, "")).lower()
