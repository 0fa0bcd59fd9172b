"""Versions of the packages that a training computes with, read without importing them."""

from __future__ import annotations

import platform
from importlib import metadata

from pronk.version import VERSION


def package_versions() -> dict[str, str]:
    """Return the versions of the packages that a run is computed with."""
    return {
        "python": platform.python_version(),
        "pronk": VERSION,
        "mjlab": metadata.version("mjlab"),
        "mujoco": metadata.version("mujoco"),
        "mujoco_warp": metadata.version("mujoco_warp"),
        "warp": metadata.version("warp-lang"),
        "torch": metadata.version("torch"),
        "rsl_rl": metadata.version("rsl-rl-lib"),
        "numpy": metadata.version("numpy"),
    }
