"""What a run computes on: the GPUs of this host, or its processor.

Nothing here starts CUDA in this process: what is counted first and narrowed by
`CUDA_VISIBLE_DEVICES` afterwards would otherwise not be narrowed at all.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, Literal

from pronk.errors import PronkError

CHOICES = ("auto", "cpu", "cuda")
_NEEDED = ("torch", "mjlab", "rsl_rl")


def require_extra() -> None:
    """Refuse to train where the extra is not installed.

    Raises:
        PronkError: It names what is missing.
    """
    missing = [name for name in _NEEDED if find_spec(name) is None]
    if missing:
        raise PronkError(
            f"training needs {', '.join(missing)}, which this installation lacks; "
            'pip install "pronk[train]".'
        )


@dataclass(frozen=True, kw_only=True)
class Devices:
    """What a run computes on."""

    device: Literal["cpu", "cuda"]
    visible: tuple[str, ...] = ()
    """What `CUDA_VISIBLE_DEVICES` shall say, one entry a process; empty on the processor."""

    @property
    def count(self) -> int:
        """Number of processes."""
        return max(len(self.visible), 1)

    def claim(self) -> None:
        """Hide all other GPUs from this process and those it starts, before any uses CUDA."""
        if self.visible:
            os.environ["CUDA_VISIBLE_DEVICES"] = ",".join(self.visible)


def parse_gpu_ids(text: str) -> list[int] | Literal["all"]:
    """`0,1` or `all`, as it is typed.

    Raises:
        PronkError: Neither, or a GPU is named twice.
    """
    if text == "all":
        return "all"
    words = [word.strip() for word in text.split(",")]
    if not all(word.isdigit() for word in words) or len(set(words)) < len(words):
        raise PronkError(f"--gpu-ids {text!r}: expected different numbers, as in 0,1, or all.")
    return [int(word) for word in words]


def find_devices(requested: str = "auto", gpu_ids: str | None = None) -> Devices:
    """The GPUs or the processor to train on.

    Args:
        requested: One of `CHOICES`.
        gpu_ids: Which of the visible GPUs, as typed; the first alone if None. Nothing on `cpu`.

    Raises:
        PronkError: There is no such GPU.
    """
    if requested not in CHOICES:
        raise PronkError(f"device {requested!r}; expected one of {', '.join(CHOICES)}.")
    ids = None if gpu_ids is None else parse_gpu_ids(gpu_ids)
    if requested == "cpu":
        return Devices(device="cpu")
    found = visible_gpus()
    if not found:
        if requested == "cuda" or ids is not None:
            raise PronkError(
                "no GPU was found (PyTorch sees none; CUDA_VISIBLE_DEVICES is "
                f"{os.environ.get('CUDA_VISIBLE_DEVICES', 'not set')}); expected one with a CUDA "
                "driver, or --device cpu for a test."
            )
        return Devices(device="cpu")
    return Devices(device="cuda", visible=chosen(found, ids))


def chosen(found: Sequence[str], ids: Sequence[int] | Literal["all"] | None) -> tuple[str, ...]:
    """The GPUs that were requested.

    Args:
        found: What is visible, as `CUDA_VISIBLE_DEVICES` has it.
        ids: Positions in it; all of them; or None for the first.

    Raises:
        PronkError: A position is beyond the last.
    """
    if ids == "all":
        return tuple(found)
    wanted = [0] if ids is None else list(ids)
    if max(wanted) >= len(found):
        raise PronkError(
            f"--gpu-ids {','.join(map(str, wanted))}: this host shows {len(found)} GPU(s), "
            f"numbered 0 to {len(found) - 1}."
        )
    return tuple(found[i] for i in wanted)


def visible_gpus() -> tuple[str, ...]:
    """The GPUs that PyTorch may use, as `CUDA_VISIBLE_DEVICES` names them."""
    import torch

    count = torch.cuda.device_count()
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    if named is None:
        return tuple(str(i) for i in range(count))
    # The variable may name more than there are.
    return tuple(word.strip() for word in named.split(",") if word.strip())[:count]


def check_cuda_graphs(simulation: Any) -> str | None:
    """What to shout if the physics of a run on a GPU cannot be captured; None if all is well.

    Args:
        simulation: mjlab's `Simulation`, built on a GPU.
    """
    if simulation.use_cuda_graph:
        return None
    import warp as wp

    driver = wp.get_cuda_driver_version()
    version = "unknown" if driver is None else ".".join(str(part) for part in driver)
    return (
        "THIS GPU RUNS WITHOUT CUDA GRAPHS and will be about six times slower than it could be: "
        f"its driver supports CUDA {version} (12.4 or newer is needed) and memory pools are "
        f"{'on' if wp.is_mempool_enabled(simulation.wp_device) else 'off'} (they must be on)."
    )
