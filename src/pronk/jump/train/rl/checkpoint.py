"""Checkpoints: networks, optimizers and counters of a run in one file, written whole or not at all.

The files have the layout and the names of mjlab's (`model_ITERATION.pt`, by `torch.save`), with the
phase and the speed ranges beside its step counter. They are read with PyTorch's restricted loader,
which builds tensors and plain containers only and runs no code of the file.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pronk.errors import ArtefactError
from pronk.files import written_whole
from pronk.jump.train.rl.networks import JUMP_WEIGHT

NETWORKS = ("actor_state_dict", "critic_state_dict")
"""Entries of a checkpoint with the networks."""
OPTIMIZERS = ("optimizer_state_dict", "estimator_optimizer_state_dict")
"""Entries of a checkpoint with the optimizers."""


def write_checkpoint(path: Path, state: Mapping[str, Any]) -> None:
    """Write a checkpoint, whole or not at all."""
    with written_whole(path) as temporary_path:
        torch.save(dict(state), temporary_path)


def read_checkpoint(path: Path, device: str = "cpu") -> dict[str, Any]:
    """Read a checkpoint of `pronk train` or mjlab's `train`.

    Args:
        path: The file.
        device: Device of the tensors.

    Raises:
        ArtefactError: Any other file.
    """
    try:
        state = torch.load(path, map_location=device, weights_only=True)
    except FileNotFoundError:
        raise ArtefactError(f"{path}: no such file; expected a checkpoint, model_*.pt.") from None
    except Exception as error:  # a damaged file fails anywhere in the loader
        raise ArtefactError(
            f"{path}: not a checkpoint of pronk ({type(error).__name__}); expected a model_*.pt of "
            "`pronk train`."
        ) from error
    missing = []
    for key in (*NETWORKS, *OPTIMIZERS, "iter", "infos"):
        if not isinstance(state, dict) or key not in state:
            missing.append(key)
    if missing:
        raise ArtefactError(
            f"{path}: a checkpoint without {', '.join(missing)}; expected one of `pronk train`."
        )
    return state


def latest_checkpoint(folder: Path) -> Path | None:
    """Return the numbered checkpoint of the highest iteration in a folder; None without one."""
    paths = numbered_checkpoints(folder)
    return paths[-1] if paths else None


def numbered_checkpoints(folder: Path) -> list[Path]:
    """Return all numbered checkpoints in a folder, `model_ITERATION.pt`, in order."""
    paths = [path for path in folder.glob("model_*.pt") if re.fullmatch(r"model_\d+", path.stem)]
    return sorted(paths, key=_iteration)


def _iteration(path: Path) -> int:
    """Return the iteration in the name of a numbered checkpoint."""
    return int(path.stem.removeprefix("model_"))


def uses_jump_input(state: Mapping[str, Any]) -> bool:
    """Return whether the actor of a checkpoint uses its jump input: its weights are not zero."""
    for name, weight in state["actor_state_dict"].items():
        if name.endswith(JUMP_WEIGHT) and bool(weight.any()):
            return True
    return False


def not_finite(tree: Any, name: str = "") -> str | None:
    """Find a number that is not finite in nested mappings and sequences of tensors.

    Args:
        tree: The mappings, sequences and tensors; anything else counts as finite.
        name: Path of `tree` in what contains it.

    Returns:
        Path of the first tensor with such a number; None if there is none.
    """
    if isinstance(tree, Tensor):
        return None if bool(tree.isfinite().all()) else name
    entries: Any = ()
    if isinstance(tree, Mapping):
        entries = tree.items()
    elif isinstance(tree, list | tuple):
        entries = enumerate(tree)
    for key, value in entries:
        path = not_finite(value, f"{name}/{key}" if name else str(key))
        if path is not None:
            return path
    return None
