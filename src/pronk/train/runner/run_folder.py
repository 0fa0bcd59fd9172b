"""The folder of one training run: what lies where in it, and whether it may be written to.

config.yaml        every setting, resolved: phases, rewards, randomization, networks, PPO
provenance.json    versions, seeds, device, times (`pronk.train.runner.provenance`)
gains.yaml         copy of the gains, where the run has a file of gains
checkpoints/       complete states, to resume from
events.out.*       TensorBoard
train.log          what mjlab, Warp and rsl_rl print
walk.onnx          the policy after phase 1, policy.onnx the last one
"""

from __future__ import annotations

import dataclasses
import fcntl
import functools
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from pronk.errors import ArtefactError, PronkError
from pronk.files import write_text
from pronk.train.runner.settings import TrainSettings

SCHEMA = "pronk/train-config/1"


@dataclass(frozen=True)
class RunFolder:
    """Paths of one run."""

    path: Path

    @property
    def config(self) -> Path:
        """Every setting, resolved."""
        return self.path / "config.yaml"

    @property
    def provenance(self) -> Path:
        """Where it comes from."""
        return self.path / "provenance.json"

    @property
    def gains(self) -> Path:
        """Copy of the file of gains."""
        return self.path / "gains.yaml"

    @property
    def checkpoints(self) -> Path:
        """Folder of complete states."""
        return self.path / "checkpoints"

    def last_of(self, phase: str) -> Path:
        """The complete state at the end of a phase."""
        return self.checkpoints / f"{phase}.pt"

    @property
    def log(self) -> Path:
        """What the libraries print."""
        return self.path / "train.log"

    @property
    def walk(self) -> Path:
        """The exported policy after phase 1 of a run that goes on to jump."""
        return self.path / "walk.onnx"

    @property
    def policy(self) -> Path:
        """The exported policy at the end."""
        return self.path / "policy.onnx"

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes from training in this folder inside the block.

        Raises:
            PronkError: One is at it.
        """
        handle = os.open(self.path, os.O_RDONLY)
        try:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise PronkError(
                    f"--out {self.path}: another process is training in it; wait for it, or give "
                    "another folder."
                ) from None
            yield
        finally:
            os.close(handle)

    def check_fresh(self) -> None:
        """Refuse a folder that already holds something.

        Raises:
            PronkError: It does, or it is a file.
        """
        if self.path.is_file():
            raise PronkError(f"--out {self.path}: is a file; expected a folder, new or empty.")
        inside = sorted(p.name for p in self.path.iterdir()) if self.path.is_dir() else []
        if inside:
            what = ", ".join(inside[:3]) + (", ..." if len(inside) > 3 else "")
            raise PronkError(
                f"--out {self.path}: is not empty ({what}); give --resume to continue the run in "
                "it, or another folder."
            )

    def settings(self) -> TrainSettings:
        """The settings of the run in this folder.

        Raises:
            ArtefactError: There is no run, or its `config.yaml` is damaged or of another schema.
        """
        try:
            body = yaml.safe_load(self.config.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise ArtefactError(
                f"--resume: {self.path} holds no run (no {self.config.name}); leave --resume out "
                "to begin one."
            ) from None
        except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
            raise ArtefactError(
                f"{self.config}: cannot be read as YAML ({type(error).__name__})."
            ) from error
        if not isinstance(body, dict) or body.get("schema") != SCHEMA:
            got = body.get("schema") if isinstance(body, dict) else type(body).__name__
            raise ArtefactError(f"{self.config}: schema {got!r}; this pronk reads {SCHEMA!r}.")
        try:
            return TrainSettings(**body["settings"])
        except (KeyError, TypeError) as error:
            fields = ", ".join(TrainSettings.__dataclass_fields__)
            raise ArtefactError(
                f"{self.config}: settings: {error}; the fields are {fields}."
            ) from None

    def write_config(self, settings: TrainSettings, resolved: Mapping[str, Any]) -> None:
        """Write `config.yaml`, whole or not at all.

        Args:
            settings: What is trained.
            resolved: What follows from it: configurations of the environment and of learning.
        """
        body = {"schema": SCHEMA, "settings": plain(settings), **plain(resolved)}
        text = yaml.safe_dump(body, sort_keys=False, default_flow_style=None, width=100)
        write_text(self.config, text)


def plain(value: Any) -> Any:
    """Configuration as what YAML can hold: functions and classes by name, no objects.

    Args:
        value: Dataclasses, mappings, sequences, numbers, text, functions, tensors, arrays.
    """
    if value is None:
        return None
    for kind in (bool, int, float, str):
        # Made anew, since a safe dump refuses subclasses: enumerations, numpy's numbers.
        if isinstance(value, kind):
            return kind(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {_key(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain(entry) for entry in value]
    if isinstance(value, functools.partial):
        return {"partial": plain(value.func), "args": plain(value.args), **plain(value.keywords)}
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, slice):
        return str(value)
    name = getattr(value, "__qualname__", None)
    if name is not None:
        return f"{value.__module__}:{name}"
    if isinstance(value, Path):
        return str(value)
    kind = type(value)
    return f"{kind.__module__}:{kind.__qualname__}"


def _key(key: Any) -> Any:
    return key if isinstance(key, (bool, int, float, str)) else str(plain(key))
