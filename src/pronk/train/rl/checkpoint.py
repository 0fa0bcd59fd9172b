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
from pronk.train.rl.networks import JUMP_WEIGHT

NETWORKS = ("actor_state_dict", "critic_state_dict")
OPTIMIZERS = ("optimizer_state_dict", "estimator_optimizer_state_dict")
_JUMP_SIZES = {"actor": 1, "critic": 12, "estimator": 1}


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
    found = numbered(folder)
    return found[-1] if found else None


def numbered(folder: Path) -> list[Path]:
    """All numbered checkpoints in a folder, `model_ITERATION.pt`, in order."""
    found = [path for path in folder.glob("model_*.pt") if re.fullmatch(r"model_\d+", path.stem)]
    return sorted(found, key=lambda path: int(path.stem.removeprefix("model_")))


def not_finite(tree: Any, name: str = "") -> str | None:
    """Path of the first tensor with a number that is not finite; None if there is none."""
    if isinstance(tree, Mapping):
        inside = list(tree.items())
    elif isinstance(tree, (list, tuple)):
        inside = list(enumerate(tree))
    elif isinstance(tree, Tensor):
        return None if bool(tree.isfinite().all()) else name
    else:
        return None
    found = (not_finite(value, f"{name}/{key}" if name else str(key)) for key, value in inside)
    return next((path for path in found if path is not None), None)


# --- Widening ------------------------------------------------------------------------------------


def jumps(state: Mapping[str, Any]) -> bool:
    """Whether the actor of a checkpoint uses its jump input: whether it has weights but zero."""
    actor = state["actor_state_dict"]
    return any(bool(actor[name].any()) for name in actor if name.endswith(JUMP_WEIGHT))


def widen_checkpoint(state: Mapping[str, Any]) -> dict[str, Any]:
    """Add the jump inputs, with zero weights, to the checkpoint of a policy that has none.

    The networks keep their function bit for bit, whatever the new inputs are (Net2Net, paper N3),
    and Adam keeps moments and step counts of every weight that was there; the new ones have none. A
    checkpoint that has the inputs is returned as it is. Nothing given is changed.
    """
    networks = {key.removesuffix("_state_dict"): state[key] for key in NETWORKS}
    if any(name.endswith(JUMP_WEIGHT) for network in networks.values() for name in network):
        return dict(state)
    wide = dict(state)
    # The parameters in the order of each optimizer, by name.
    order: dict[str, list[str]] = {key: [] for key in OPTIMIZERS}
    for network, weights in networks.items():
        added: dict[str, Tensor] = {}
        wide[f"{network}_state_dict"] = added
        for name, value in weights.items():
            part = "estimator" if name.startswith("estimator.") else network
            if not name.startswith("obs_normalizer."):
                order[OPTIMIZERS[part == "estimator"]].append(name)
            added[name] = value.clone()
            if name.endswith("mlp.0.weight"):
                jump = name.removesuffix("weight") + JUMP_WEIGHT
                added[jump] = value.new_zeros(len(value), _JUMP_SIZES[part])
    for key, names in order.items():
        wide[key] = _widen_optimizer(state[key], names)
    return wide


def _widen_optimizer(narrow: Mapping[str, Any], names: list[str]) -> dict[str, Any]:
    """Number the parameters as an optimizer with the jump inputs does.

    `JumpLinear` registers weight, bias, jump_weight in this order.
    """
    (group,) = narrow["param_groups"]
    if len(group["params"]) != len(names):
        raise ArtefactError(
            f"the optimizer's state is of {len(group['params'])} parameters; expected those of the "
            f"networks without the jump inputs, {len(names)}."
        )
    moments, count = {}, 0
    for name, index in zip(names, group["params"], strict=True):
        if index in narrow["state"]:
            moments[count] = dict(narrow["state"][index])
        count += 2 if name.endswith("mlp.0.bias") else 1
    return {"state": moments, "param_groups": [{**group, "params": list(range(count))}]}
