"""The folder of a run and its provenance: versions, settings, hashes, device, times.

params/env.yaml, params/agent.yaml   every setting, as mjlab writes them
provenance.json                      settings, sessions, figures of each phase
gains.yaml                           copy of the gains, where the run has a file of gains
recipe.yaml                          copy of the recipe, where the run has one; of several, merged
model_*.pt, PHASE.pt                 checkpoints
events.out.*                         TensorBoard
train.log                            what mjlab, Warp and rsl_rl print
progress.json                        how far it is, with rate and reward of the last iteration
walk.onnx, policy.onnx               the policy after phase 1 and the last one
"""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from pronk.errors import ArtefactError, PronkError
from pronk.files import write_text
from pronk.jump.train.rl import checkpoint
from pronk.jump.train.settings import StoredSettings, TrainSettings
from pronk.jump.train.versions import package_versions
from pronk.robots import ROBOT_NAMES

if TYPE_CHECKING:
    from pronk.jump.train.gains import TrainingGains
    from pronk.jump.train.recipe import Recipe

SCHEMA = "pronk/run/2"


class StoredGains(msgspec.Struct, kw_only=True):
    """Types of what is recorded of the gains."""

    name: str
    file: str | None
    sha256: str
    virtual: bool
    unmatched: dict[str, list[str]] = {}


class StoredRecipe(msgspec.Struct, kw_only=True):
    """Types of what is read of a recipe's record."""

    sha256: str
    task: dict[str, float] = {}


class StoredSession(msgspec.Struct, kw_only=True):
    """Types of what is read of a session's record."""

    versions: dict[str, str | None]


class StoredRun(msgspec.Struct, kw_only=True):
    """Types of what is read of a run's record; it may hold more."""

    settings: StoredSettings
    gains: StoredGains
    start_sha256: str
    phases: dict[str, Any]
    finished: bool
    sessions: list[StoredSession]
    recipe: StoredRecipe | None = None
    task: dict[str, float] = {}


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

    @property
    def recipe(self) -> Path:
        """The copy of the recipe, or what several were merged to."""
        return self.path / "recipe.yaml"

    def robot(self, name: str) -> str:
        """Return the name or the path of the run's robot as this process can load it.

        A run that is part of a study reads a copy of a robot.yaml in the folder of the study, to
        which the path is relative.

        Args:
            name: The robot among the settings of the run.
        """
        if name in ROBOT_NAMES or Path(name).exists():
            return name
        for parent in self.path.resolve().parents:
            if (parent / name).is_file():
                return str(parent / name)
        return name

    def checkpoint(self) -> Path:
        """Return the last numbered checkpoint; ArtefactError if there is none."""
        path = checkpoint.latest_checkpoint(self.path)
        if path is None:
            raise ArtefactError(
                f"{self.path}: no checkpoints in it; expected the folder of a run, a checkpoint, "
                "or an exported policy.onnx."
            )
        return path

    def check_fresh(self) -> None:
        """Refuse a folder that already holds something, or a file."""
        if self.path.is_file():
            raise PronkError(f"--out {self.path}: is a file; expected a folder, new or empty.")
        if not self.path.is_dir():
            return
        names = sorted(path.name for path in self.path.iterdir())
        if names:
            listed = ", ".join(names[:3])
            if len(names) > 3:
                listed += ", ..."
            raise PronkError(
                f"--out {self.path}: is not empty ({listed}); give --resume to continue the run in "
                "it, or another folder."
            )

    def read(self) -> dict[str, Any]:
        """Read the provenance.

        Raises:
            ArtefactError: There is none, or it is damaged or of another schema.
        """
        path = self.provenance
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise ArtefactError(
                f"{self.path} holds no run (no {path.name}); leave --resume out to begin one."
            ) from None
        except (OSError, ValueError, RecursionError) as error:
            text = f"{path}: cannot be read as JSON ({type(error).__name__})."
            raise ArtefactError(text) from error
        schema = record.get("schema") if isinstance(record, dict) else type(record).__name__
        if schema != SCHEMA:
            raise ArtefactError(f"{path}: schema {schema!r}; this pronk reads {SCHEMA!r}.")
        try:
            msgspec.convert(record, StoredRun)
        except msgspec.ValidationError as error:
            raise ArtefactError(
                f"{path}: {error}; it was changed since pronk wrote it: put it back, or begin a "
                "new run."
            ) from None
        return record

    def write(self, record: dict[str, Any]) -> None:
        """Write the provenance, whole or not at all."""
        write_text(self.provenance, json.dumps(record, indent=2, allow_nan=False) + "\n")


def new_record(
    settings: TrainSettings,
    gains: TrainingGains,
    *,
    task: Mapping[str, float],
    recipe: Recipe | None = None,
    start_sha256: str = "",
) -> dict[str, Any]:
    """Describe a run that has not begun.

    Args:
        settings: Its completed settings.
        gains: What it trains with.
        task: Numbers of the task that a recipe may change (`recipe.task_numbers`).
        recipe: The recipe, if there is one.
        start_sha256: Hash of the checkpoint that it begins with; empty if it begins with none.
    """
    gains_file = settings.gains_file
    return {
        "schema": SCHEMA,
        "settings": settings.stored_values(),
        "gains": {
            "name": gains.name,
            "file": None if gains_file is None else gains_file.name,
            "sha256": gains.sha256,
            "virtual": gains.virtual,
            "unmatched": dict(gains.unmatched),
        },
        "recipe": None if recipe is None else recipe.record(),
        "task": dict(task),
        "start_sha256": start_sha256,
        "phases": {},
        "finished": False,
        "sessions": [],
    }


def new_session() -> dict[str, Any]:
    """Describe one start of a run: now, by this command, with what is installed."""
    return {
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "start": datetime.now(UTC).isoformat(timespec="seconds"),
        "seconds": None,
        "stopped": "",
        "device": None,
        "versions": package_versions(),
        "git": git_state(),
    }


def changed_versions(record: dict[str, Any]) -> list[str]:
    """List packages in other versions than when the run was last started, as text."""
    if not record["sessions"]:
        # The run was killed before its first session began.
        return []
    versions_before = record["sessions"][-1]["versions"]
    changes = []
    for name, version in package_versions().items():
        version_before = versions_before.get(name)
        if version_before != version:
            changes.append(f"{name} was {version_before} and is {version}")
    return changes


def git_state() -> dict[str, Any] | None:
    """Return the commit of pronk's sources and whether they were changed since; None outside git.

    An installed pronk may lie inside another repository; then that is not its commit.
    """
    folder = str(Path(__file__).parents[2])  # of the package pronk

    def git(*words: str) -> str:
        process = subprocess.run(
            ["git", "-C", folder, *words], capture_output=True, text=True, timeout=20, check=True
        )
        return process.stdout.strip()

    try:
        git("ls-files", "--error-unmatch", "__init__.py")
        commit = git("rev-parse", "HEAD")
        changed_files = git("status", "--porcelain", "--", ".")
    except (OSError, subprocess.SubprocessError):
        return None
    return {"commit": commit, "changed": changed_files != ""}
