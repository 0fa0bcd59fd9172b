"""The folder of a run and its provenance: versions, settings, hashes, device, times.

params/env.yaml, params/agent.yaml   every setting, as mjlab writes them
provenance.json                      settings, sessions, figures of each phase
gains.yaml                           copy of the gains, where the run has a file of gains
model_*.pt, PHASE.pt                 checkpoints
events.out.*                         TensorBoard
train.log                            what mjlab, Warp and rsl_rl print
walk.onnx, policy.onnx               the policy after phase 1 and the last one
"""

from __future__ import annotations

import fcntl
import json
import os
import shlex
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pronk
from pronk.errors import ArtefactError, PronkError
from pronk.files import write_text
from pronk.jump.train.rl import checkpoint
from pronk.jump.train.rl.export import versions

SCHEMA = "pronk/run/2"


@dataclass(frozen=True)
class RunFolder:
    """Paths of one run."""

    path: Path

    @property
    def provenance(self) -> Path:
        """The file that `read` reads."""
        return self.path / "provenance.json"

    @property
    def gains(self) -> Path:
        """The copy of the file of gains."""
        return self.path / "gains.yaml"

    def checkpoint(self) -> Path:
        """The last numbered checkpoint; ArtefactError if there is none."""
        found = checkpoint.latest(self.path)
        if found is None:
            raise ArtefactError(
                f"{self.path}: no checkpoints in it; expected the folder of a run, a checkpoint, "
                "or an exported policy.onnx."
            )
        return found

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from training in this folder inside the block."""
        handle = os.open(self.path, os.O_RDONLY)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            os.close(handle)
            raise PronkError(
                f"--out {self.path}: another process is training in it; wait for it, or give "
                "another folder."
            ) from None
        try:
            yield
        finally:
            os.close(handle)

    def check_fresh(self) -> None:
        """Refuse a folder that already holds something, or a file."""
        if self.path.is_file():
            raise PronkError(f"--out {self.path}: is a file; expected a folder, new or empty.")
        inside = sorted(p.name for p in self.path.iterdir()) if self.path.is_dir() else []
        if inside:
            names = ", ".join(inside[:3]) + (", ..." if len(inside) > 3 else "")
            raise PronkError(
                f"--out {self.path}: is not empty ({names}); give --resume to continue the run in "
                "it, or another folder."
            )

    def read(self) -> dict[str, Any]:
        """The provenance; ArtefactError if there is none or it is damaged or of another schema."""
        path = self.provenance
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise ArtefactError(
                f"{self.path} holds no run (no {path.name}); leave --resume out to begin one."
            ) from None
        except (OSError, ValueError, RecursionError) as error:
            text = f"{path}: cannot be read as JSON ({type(error).__name__})."
            raise ArtefactError(text) from error
        schema = found.get("schema") if isinstance(found, dict) else type(found).__name__
        if schema != SCHEMA:
            raise ArtefactError(f"{path}: schema {schema!r}; this pronk reads {SCHEMA!r}.")
        return found

    @contextmanager
    def changed(self) -> Iterator[dict[str, Any]]:
        """Read the provenance, let the block change it, and write it."""
        found = self.read()
        yield found
        self.write(found)

    def write(self, provenance: dict[str, Any]) -> None:
        """Write the provenance, whole or not at all."""
        write_text(self.provenance, json.dumps(provenance, indent=2, allow_nan=False) + "\n")


def new_session() -> dict[str, Any]:
    """One start of a run: now, by this command, with what is installed."""
    return {
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "start": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": None,
        "stopped": "",
        "device": None,
        "build_s": None,
        "versions": versions(),
        "git": git_state(),
    }


def changed_versions(provenance: dict[str, Any]) -> list[str]:
    """Packages in other versions than when the run was last started, as text."""
    last = provenance["sessions"][-1]["versions"]
    return [
        f"{name} was {last.get(name)} and is {version}"
        for name, version in versions().items()
        if last.get(name) != version
    ]


def git_state() -> dict[str, Any] | None:
    """Commit of pronk's sources and whether they were changed since; None outside git.

    An installed pronk may lie inside another repository; then that is not its commit.
    """

    def git(*words: str) -> str:
        command = ["git", "-C", str(Path(pronk.__file__).parent), *words]
        found = subprocess.run(command, capture_output=True, text=True, timeout=20, check=True)
        return found.stdout.strip()

    try:
        git("ls-files", "--error-unmatch", "__init__.py")
        commit, changed = git("rev-parse", "HEAD"), git("status", "--porcelain", "--", ".")
        return {"commit": commit, "changed": bool(changed)}
    except (OSError, subprocess.SubprocessError):
        return None
