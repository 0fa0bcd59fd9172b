"""Where a policy comes from: what was installed, requested and measured, beside every run.

`provenance.json` is for people and for the tables; nothing is computed from it. A run that was
interrupted and resumed has one entry in `sessions` for each time it was started.
"""

from __future__ import annotations

import json
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import pronk
from pronk.errors import ArtefactError
from pronk.files import write_text
from pronk.train.runner.settings import TrainSettings

SCHEMA = "pronk/run/1"

_DISTRIBUTIONS = {
    "mjlab": "mjlab",
    "mujoco": "mujoco",
    "mujoco_warp": "mujoco-warp",
    "warp": "warp-lang",
    "torch": "torch",
    "rsl_rl": "rsl-rl-lib",
    "numpy": "numpy",
}


def versions() -> dict[str, str | None]:
    """Versions of what a run is computed with; None where it is not installed."""
    found: dict[str, str | None] = {
        "python": platform.python_version(),
        "pronk": pronk.__version__,
    }
    for name, distribution in _DISTRIBUTIONS.items():
        try:
            found[name] = metadata.version(distribution)
        except metadata.PackageNotFoundError:
            found[name] = None
    return found


def git_state() -> dict[str, Any] | None:
    """Commit of pronk's own sources and whether they were changed since; None outside git.

    An installed pronk may lie inside somebody else's repository; then that is not its commit.
    """
    package = Path(pronk.__file__).parent
    if _git(package, "ls-files", "--error-unmatch", "__init__.py") is None:
        return None
    commit = _git(package, "rev-parse", "HEAD")
    changed = _git(package, "status", "--porcelain", "--", ".")
    return None if commit is None else {"commit": commit, "changed": bool(changed)}


def _git(folder: Path, *words: str) -> str | None:
    """What git says; None if it fails or is not there."""
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *words],
            capture_output=True,
            text=True,
            timeout=20,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def device_facts(device: str, gpus: int) -> dict[str, Any]:
    """What computes: the GPU's name and driver, or the processor's.

    Args:
        device: `cpu` or `cuda`.
        gpus: How many GPUs.
    """
    if device == "cpu":
        return {"device": "cpu", "name": _processor(), "cores": os.cpu_count()}
    import torch
    import warp as wp

    driver = wp.get_cuda_driver_version()
    return {
        "device": "cuda",
        "name": torch.cuda.get_device_name(0),
        "count": gpus,
        "cuda": torch.version.cuda,
        "driver_cuda": None if driver is None else ".".join(str(part) for part in driver),
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def now() -> str:
    """The time, UTC, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def command_line() -> str:
    """What was typed."""
    return shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])


def begin(settings: TrainSettings, *, gains: Mapping[str, Any]) -> dict[str, Any]:
    """Provenance of a run that is yet to be started.

    Args:
        settings: What is trained.
        gains: Name, file, hash, and whether they rest on the virtual robot.
    """
    return {
        "schema": SCHEMA,
        "task": settings.task,
        "seeds": [settings.seed + rank for rank in range(settings.gpus)],
        "gains": dict(gains),
        "settings": asdict(settings),
        "phases": {},
        "finished": False,
        "sessions": [],
    }


def session() -> dict[str, Any]:
    """One start of a run: now, by this command, with what is installed."""
    return {
        "command": command_line(),
        "start": now(),
        "end": None,
        "seconds": None,
        "stopped": "",
        "device": None,
        "build_s": None,
        "kernel_compile_s": None,
        "versions": versions(),
        "git": git_state(),
    }


def write(path: Path, provenance: Mapping[str, Any]) -> None:
    """Write it, whole or not at all."""
    write_text(path, json.dumps(provenance, indent=2, allow_nan=False) + "\n")


@contextmanager
def changed(path: Path) -> Iterator[dict[str, Any]]:
    """Read it, let the block change it, and write it; a block that raises changes nothing."""
    found = read(path)
    yield found
    write(path, found)


def read(path: Path) -> dict[str, Any]:
    """Read it.

    Raises:
        ArtefactError: Missing, damaged or of another schema.
    """
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ArtefactError(f"{path}: no such file; `pronk train` writes one.") from None
    except (OSError, ValueError) as error:
        raise ArtefactError(f"{path}: cannot be read as JSON ({type(error).__name__}).") from error
    if not isinstance(found, dict) or found.get("schema") != SCHEMA:
        got = found.get("schema") if isinstance(found, dict) else type(found).__name__
        raise ArtefactError(f"{path}: schema {got!r}; this pronk reads {SCHEMA!r}.")
    return found


def changed_versions(provenance: Mapping[str, Any]) -> list[str]:
    """What is installed in another version than when the run was last started, as text."""
    last = provenance["sessions"][-1]["versions"]
    return [
        f"{name} was {last.get(name)} and is {version}"
        for name, version in versions().items()
        if last.get(name) != version
    ]
