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
OPTIMIZERS = ("optimizer_state_dict", "estimator_optimizer_state_dict")


def write(path: Path, state: Mapping[str, Any]) -> None:
    """Write a checkpoint, whole or not at all."""
    with written_whole(path) as aside:
        torch.save(dict(state), aside)


def read(path: Path, device: str = "cpu") -> dict[str, Any]:
    """Read a checkpoint of `pronk train` or mjlab's `train`; ArtefactError for any other file."""
    try:
        state = torch.load(path, map_location=device, weights_only=True)
    except FileNotFoundError:
        raise ArtefactError(f"{path}: no such file; expected a checkpoint, model_*.pt.") from None
    except Exception as error:  # a damaged file fails anywhere in the loader
        raise ArtefactError(
            f"{path}: not a checkpoint of pronk ({type(error).__name__}); expected a model_*.pt of "
            "`pronk train`."
        ) from error
    needed = (*NETWORKS, *OPTIMIZERS, "iter", "infos")
    missing = [key for key in needed if not isinstance(state, dict) or key not in state]
    if missing:
        raise ArtefactError(
            f"{path}: a checkpoint without {', '.join(missing)}; expected one of `pronk train`."
        )
    return state


def latest(folder: Path) -> Path | None:
    """The numbered checkpoint of the highest iteration in a folder; None if there is none."""
    return next(reversed(numbered(folder)), None)


def numbered(folder: Path) -> list[Path]:
    """All numbered checkpoints in a folder, `model_ITERATION.pt`, in order."""
    found = [path for path in folder.glob("model_*.pt") if re.fullmatch(r"model_\d+", path.stem)]
    return sorted(found, key=lambda path: int(path.stem.removeprefix("model_")))


def jumps(state: Mapping[str, Any]) -> bool:
    """Whether the actor of a checkpoint uses its jump input: whether it has weights but zero."""
    actor = state["actor_state_dict"]
    return any(bool(actor[name].any()) for name in actor if name.endswith(JUMP_WEIGHT))


def not_finite(tree: Any, name: str = "") -> str | None:
    """Path of the first tensor with a number that is not finite; None if there is none."""
    if isinstance(tree, Tensor):
        return None if bool(tree.isfinite().all()) else name
    inside: Any = ()
    if isinstance(tree, Mapping):
        inside = tree.items()
    elif isinstance(tree, (list, tuple)):
        inside = enumerate(tree)
    found = (not_finite(value, f"{name}/{key}" if name else str(key)) for key, value in inside)
    return next((path for path in found if path is not None), None)
