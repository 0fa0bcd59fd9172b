"""Versions of the packages that a training computes with, and the hash of pronk's own sources."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

from pronk.version import VERSION


def package_versions() -> dict[str, str]:
    """Return the versions of the packages that a run is computed with, without importing them."""
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


def sources_sha256(folders: Sequence[str] = (".",), suffixes: Sequence[str] = (".py",)) -> str:
    """Return the hash of sources of this pronk: of the names and contents of its files.

    Args:
        folders: Folders of the package pronk whose files count, with those below them.
        suffixes: Endings of the names of these files.
    """
    package = Path(__file__).parents[2]
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted((package / folder).rglob("*")):
            if path.suffix in suffixes and path.is_file():
                digest.update(path.relative_to(package).as_posix().encode())
                digest.update(path.read_bytes())
    return digest.hexdigest()
