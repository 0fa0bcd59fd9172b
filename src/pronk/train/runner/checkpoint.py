"""Checkpoints: the complete state of a training run in one file, written whole or not at all.

A checkpoint is an uncompressed `.npz`, whatever its name ends with: arrays, and a JSON header that
says how they nest and holds what is no array. Nothing in it is ever unpickled, so a checkpoint
from a stranger can do no more than be refused.

A process may be killed at any moment: the file is written aside, forced to the disk and renamed,
so that a name that exists is always a complete checkpoint.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pronk.files import stored_arrays, written_whole

SCHEMA = "pronk/checkpoint/1"
_WRITER = "pronk train"
_NUMBERED = re.compile(r"model_(\d+)\.pt")
_UNFINISHED = ".model_*.pt.*"
"""What a process that was killed while writing leaves behind."""


@dataclass(frozen=True, kw_only=True)
class Checkpoint:
    """A training run at the end of an iteration."""

    about: Mapping[str, Any]
    """What it is, in numbers and words that JSON can hold: iteration, phase, versions, ..."""
    tree: Mapping[str, Any] = field(repr=False)
    """Nested mappings, lists and tuples of tensors, arrays, numbers, text and None."""


def numbered(folder: Path, iteration: int) -> Path:
    """Where the checkpoint after so many iterations lies, by the name that mjlab's tools expect."""
    return folder / f"model_{iteration}.pt"


def latest(folder: Path) -> Path | None:
    """The numbered checkpoint of the highest iteration; None if there is none."""
    found = _numbered(folder)
    return found[-1] if found else None


def save(path: Path, checkpoint: Checkpoint) -> None:
    """Write a checkpoint, whole or not at all; it is on the disk when this returns.

    Raises:
        TypeError: The tree holds something that is neither number, text, tensor nor array.
    """
    arrays: dict[str, Any] = {}
    header = {
        "schema": SCHEMA,
        "about": dict(checkpoint.about),
        "tree": _flatten("tree", checkpoint.tree, arrays),
    }
    with written_whole(path) as aside, aside.open("wb") as file:
        np.savez(file, header=np.array(json.dumps(header)), **arrays)
        file.flush()
        os.fsync(file.fileno())
    _sync_folder(path.parent)


def load(path: Path) -> Checkpoint:
    """Read a checkpoint; its tensors are on the CPU.

    Raises:
        ArtefactError: Missing, damaged, or not a checkpoint of this pronk.
    """
    with stored_arrays(path, SCHEMA, what="a checkpoint", writer=_WRITER) as (header, arrays):
        tree = _unflatten(header["tree"], arrays)
        return Checkpoint(about=header["about"], tree=tree)


def about(path: Path) -> dict[str, Any]:
    """What a checkpoint says about itself, without reading its arrays.

    Raises:
        ArtefactError: Missing, damaged, or not a checkpoint of this pronk.
    """
    with stored_arrays(path, SCHEMA, what="a checkpoint", writer=_WRITER) as (header, _):
        return dict(header["about"])


def prune(folder: Path, keep: int) -> None:
    """Delete all numbered checkpoints but the last `keep`, and what killed writers left behind.

    Checkpoints under other names stay.
    """
    for path in (*_numbered(folder)[:-keep], *folder.glob(_UNFINISHED)):
        path.unlink(missing_ok=True)


def not_finite(tree: Any, name: str = "") -> str | None:
    """Path of the first tensor with a number that is not finite; None if there is none.

    Args:
        tree: Nested mappings, lists and tuples.
        name: Path of the tree itself.
    """
    if isinstance(tree, Mapping):
        inside = list(tree.items())
    elif isinstance(tree, (list, tuple)):
        inside = list(enumerate(tree))
    elif hasattr(tree, "isfinite"):
        return None if bool(tree.isfinite().all()) else name
    else:
        return None
    found = (not_finite(value, f"{name}/{key}" if name else str(key)) for key, value in inside)
    return next((path for path in found if path is not None), None)


def _numbered(folder: Path) -> list[Path]:
    matches = [(_NUMBERED.fullmatch(path.name), path) for path in folder.glob("model_*.pt")]
    found = [(int(match[1]), path) for match, path in matches if match]
    return [path for _, path in sorted(found)]


def _sync_folder(folder: Path) -> None:
    """Force a rename to the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


# --- Nesting -------------------------------------------------------------------------------------
# In the header a node is what JSON holds as it is (null, true, numbers, text) or a list: a word
# that says what follows, and that.


def _flatten(name: str, node: Any, arrays: dict[str, Any]) -> Any:
    """The node as JSON; tensors and arrays go to `arrays`, by number. `name` is its path."""
    if node is None or isinstance(node, (bool, int, float, str)):
        return node
    if isinstance(node, Mapping):
        inside = []
        for key, value in node.items():
            if not isinstance(key, (str, int)):
                raise TypeError(f"{name} has the key {key!r}; keys must be text or whole numbers.")
            inside.append([key, _flatten(f"{name}/{key}", value, arrays)])
        return ["mapping", inside]
    if isinstance(node, (list, tuple)):
        entries = [_flatten(f"{name}/{i}", value, arrays) for i, value in enumerate(node)]
        return ["tuple" if isinstance(node, tuple) else "list", entries]
    kind = "array"
    if hasattr(node, "detach"):
        kind, node = "tensor", node.detach().cpu().numpy()
    if not isinstance(node, (np.ndarray, np.generic)) or node.dtype.hasobject:
        raise TypeError(f"{name} is a {type(node).__name__}, which a checkpoint cannot hold.")
    number = str(len(arrays))
    arrays[number] = node
    return [kind, number]


def _unflatten(node: Any, arrays: Mapping[str, Any]) -> Any:
    if not isinstance(node, list):
        return node
    kind, inside = node
    if kind == "mapping":
        return {key: _unflatten(value, arrays) for key, value in inside}
    if kind in ("list", "tuple"):
        entries = [_unflatten(value, arrays) for value in inside]
        return tuple(entries) if kind == "tuple" else entries
    if kind not in ("array", "tensor"):
        raise ValueError(f"unknown node {kind!r}")
    array = arrays[inside]
    if kind == "array":
        return array
    import torch

    return torch.from_numpy(array)
