"""What a tree of objects remembers: every tensor, array, number and random generator in it.

A training environment is a tree of managers, terms, entities, actuators, buffers and sensors, and
any of them may remember something: the command in force and its time left, the last actions, the
frames of a history, the lag of a delay, the gains that a drive drew. The tree is walked, and what
is found gets the path it was found under as its name; a term that begins to remember something is
found without being told.

Restoring writes tensors in place, because captured CUDA graphs and the views of fused actuators
hold on to their memory.
"""

from __future__ import annotations

import enum
import random
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import FrozenInstanceError, dataclass
from functools import partial
from operator import setitem
from typing import Any

import numpy as np
import torch
from mjlab.entity.entity import EntityIndexing
from mjlab.envs import ManagerBasedRlEnv
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.scene import Scene
from mjlab.sim import Simulation
from mjlab.sim.sim_data import TorchArray, WarpBridge

from pronk.errors import ArtefactError

_FOLLOWS = {"_cached_data", "_cache_valid", "_cache", "data_view", "_data_view"}
"""Attributes that follow from the rest: mjlab's caches and its views of sensor data."""
_ELSEWHERE = (
    ManagerBasedRlEnv,
    Simulation,
    Scene,
    WarpBridge,
    TorchArray,
    EntityIndexing,
    SceneEntityCfg,
    enum.Enum,
)
"""What the walk does not enter: ways back to the root, the physics, indices fixed at building."""
_LIBRARIES = {"torch", "numpy", "warp", "mujoco", "mujoco_warp", *sys.stdlib_module_names}
"""Objects of these packages hold nothing that can be saved by walking through them."""
_OTHER_GENERATORS = (random.Random, np.random.Generator, np.random.RandomState)


@dataclass(frozen=True)
class Memory:
    """One thing remembered, and how to put something else in its place."""

    value: Any
    replace: Callable[[Any], None]

    def copy(self) -> Any:
        """What to save of it: numbers as they are, of a random generator its state."""
        value = self.value
        if isinstance(value, torch.Generator):
            return value.get_state()
        if isinstance(value, torch.Tensor):
            return value.detach().clone()
        return value.copy() if isinstance(value, np.ndarray) else value


def walk(
    name: str,
    value: Any,
    seen: dict[int, Any],
    *,
    skip: Iterable[str] = (),
    replace: Callable[[Any], None] | None = None,
) -> Iterator[tuple[str, Memory]]:
    """Everything that a value and what it refers to remember.

    Mappings, sequences and objects are entered once, under the first path that leads there.

    Args:
        name: Path of the value.
        value: Where to begin.
        seen: What was entered before, by id; grows.
        skip: Attributes of the value itself that are left out.
        replace: Puts another value in the place of this one; not needed where it is entered.

    Yields:
        Path, and what lies there: a tensor, an array, a random generator of torch, a number, None
        or a tuple of such.

    Raises:
        TypeError: A random generator other than torch's is found.
    """
    if isinstance(value, _ELSEWHERE):
        return
    if isinstance(value, _OTHER_GENERATORS):
        raise TypeError(f"{name} is a {type(value).__name__}; draw with torch, which can be saved.")
    if _is_leaf(value):
        yield name, Memory(value, replace or partial(_refuse, name))
        return
    if id(value) in seen:
        return
    seen[id(value)] = value  # kept alive, and so its id its own
    for key, entry, put in _inside(name, value):
        if key not in skip:
            yield from walk(f"{name}/{key}", entry, seen, replace=put)


def _inside(name: str, value: Any) -> Iterator[tuple[str, Any, Callable[[Any], None]]]:
    """Entries of a mapping or sequence, attributes of an object, and how to replace each."""
    if isinstance(value, dict):
        for key, entry in list(value.items()):
            name = key if isinstance(key, str) else repr(key)
            yield name, entry, partial(setitem, value, key)
    elif isinstance(value, (list, deque)):
        for i, entry in enumerate(value):
            yield str(i), entry, partial(setitem, value, i)
    elif isinstance(value, tuple):
        for i, entry in enumerate(value):
            yield str(i), entry, partial(_refuse, f"{name}/{i}")
    elif _package(value) not in _LIBRARIES and hasattr(value, "__dict__"):
        for attribute, entry in list(vars(value).items()):
            if attribute not in _FOLLOWS:
                yield attribute, entry, partial(setattr, value, attribute)


def _package(value: Any) -> str:
    return type(value).__module__.partition(".")[0]


def _is_leaf(value: Any) -> bool:
    return isinstance(value, (torch.Tensor, np.ndarray, torch.Generator)) or _is_plain(value)


def _is_plain(value: Any) -> bool:
    """A number, None, or a tuple of such: replaced, not written to."""
    if isinstance(value, tuple):
        return type(value) is tuple and all(_is_plain(entry) for entry in value)
    return value is None or isinstance(value, (bool, int, float))


def _refuse(name: str, _: Any) -> None:
    raise ArtefactError(f"{name} differs from the checkpoint's, and cannot be changed once built.")


# --- Restoring -----------------------------------------------------------------------------------


def put_back(
    find: Callable[[], Mapping[str, Memory]], state: Mapping[str, Any], device: str | torch.device
) -> None:
    """Make what is remembered what it was.

    Args:
        find: Walks the tree.
        state: Path to what `Memory.copy` gave.
        device: Where tensors go that have no place yet.

    Raises:
        ArtefactError: Paths, shapes or types differ, or something that is fixed.
    """
    found = find()
    check_same(state, found)
    for name, there in found.items():
        _put(name, there, state[name], device)
    # Two paths may lead to one tensor, where the state has two values: then each gets its own.
    for name, there in find().items():
        if isinstance(there.value, torch.Tensor) and not _equal(there.value, state[name]):
            there.replace(state[name].to(there.value.device, copy=True))


def check_same(wanted: Iterable[str], found: Iterable[str]) -> None:
    """Refuse a state that does not have the same paths.

    Args:
        wanted: Of the checkpoint.
        found: Here.

    Raises:
        ArtefactError: They differ; the message names some.
    """
    wanted, found = set(wanted), set(found)
    lost, new = sorted(wanted - found), sorted(found - wanted)
    if lost or new:
        names = ", ".join((lost or new)[:3]) + (", ..." if len(lost or new) > 3 else "")
        what = "holds what this environment lacks" if lost else "lacks what this environment has"
        raise ArtefactError(
            f"the checkpoint {what} ({names}); it is of another task or of another version of "
            "pronk or mjlab: resume with those, or load the networks alone."
        )


def check_alike(name: str, here: torch.Tensor, saved: torch.Tensor) -> None:
    """Refuse a tensor of another shape or type.

    Raises:
        ArtefactError: It is.
    """
    if here.shape != saved.shape or here.dtype != saved.dtype:
        raise ArtefactError(
            f"{name} is {saved.dtype} {tuple(saved.shape)} in the checkpoint and {here.dtype} "
            f"{tuple(here.shape)} here; the configurations differ."
        )


def _put(name: str, there: Memory, value: Any, device: str | torch.device) -> None:
    old = there.value
    if isinstance(old, torch.Generator):
        old.set_state(value.cpu())
    elif isinstance(old, torch.Tensor) and isinstance(value, torch.Tensor):
        check_alike(name, old, value)
        if old.is_inference():  # may not be written to here; nothing that lasts is one
            there.replace(value.to(old.device, copy=True))
        elif not _equal(old, value):
            old.copy_(value)
    elif isinstance(value, torch.Tensor):
        there.replace(value.to(device, copy=True))
    elif isinstance(value, np.ndarray):
        there.replace(value.copy())
    elif type(old) is not type(value) or old != value:
        try:
            there.replace(value)
        except FrozenInstanceError:
            raise ArtefactError(
                f"{name} was {value} when the checkpoint was written and is {old}; the "
                "configurations differ."
            ) from None


def _equal(a: torch.Tensor, b: torch.Tensor) -> bool:
    return np.array_equal(a.cpu().numpy(), b.cpu().numpy(), equal_nan=True)
