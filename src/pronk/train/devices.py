"""Devices of a run: the GPUs of this host, or its CPU; and the compilation of their kernels.

`find_devices` does not start CUDA: `CUDA_VISIBLE_DEVICES` has no effect afterwards.
"""

from __future__ import annotations

import contextlib
import os
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Literal

from pronk.errors import PronkError

_NEEDED = ("torch", "mjlab", "rsl_rl")
_MODULES = (
    "smooth",
    "sensor",
    "passive",
    "derivative",
    "solver",
    "forward",
    "support",
    "constraint",
)
"""Of MuJoCo Warp, launched in every step of every model, the longest to compile first."""


def require_extra() -> None:
    """Refuse to train where the extra is not installed, with a PronkError."""
    missing = [name for name in _NEEDED if find_spec(name) is None]
    if missing:
        raise PronkError(
            f"training needs {', '.join(missing)}, which this installation lacks; "
            'pip install "pronk[train]".'
        )


@dataclass(frozen=True, kw_only=True)
class Devices:
    """Devices to compute on."""

    device: Literal["cpu", "cuda"]
    visible: tuple[str, ...] = ()
    """Entries of `CUDA_VISIBLE_DEVICES`, one a process; empty on the CPU."""

    @property
    def count(self) -> int:
        """Number of processes."""
        return max(len(self.visible), 1)

    def claim(self) -> None:
        """Hide all other GPUs from this process and its children, before any uses CUDA."""
        os.environ["CUDA_VISIBLE_DEVICES"] = ",".join(self.visible)


def parse_gpu_ids(text: str) -> list[int] | Literal["all"]:
    """Read `0,1` or `all`; PronkError if it is neither or names a GPU twice."""
    if text == "all":
        return "all"
    words = [word.strip() for word in text.split(",")]
    if not all(word.isdigit() for word in words) or len(set(words)) < len(words):
        raise PronkError(f"--gpu-ids {text!r}: expected different numbers, as in 0,1, or all.")
    return [int(word) for word in words]


def find_devices(requested: str = "auto", gpu_ids: str | None = None) -> Devices:
    """The GPUs or the CPU to compute on.

    Args:
        requested: `auto`, `cpu` or `cuda`.
        gpu_ids: Numbers of the visible GPUs, as in `0,1`, or `all`; the first alone if None.

    Raises:
        PronkError: There is no such GPU.
    """
    if requested not in ("auto", "cpu", "cuda"):
        raise PronkError(f"device {requested!r}; expected one of auto, cpu, cuda.")
    ids = None if gpu_ids is None else parse_gpu_ids(gpu_ids)
    if requested == "cpu":
        if ids is not None:
            raise PronkError(f"--gpu-ids {gpu_ids} goes with a GPU; leave it or --device cpu out.")
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
    numbers = range(len(found)) if ids == "all" else [0] if ids is None else ids
    if max(numbers) >= len(found):
        raise PronkError(
            f"--gpu-ids {gpu_ids}: this host has {len(found)} visible GPU(s), numbered 0 to "
            f"{len(found) - 1}."
        )
    return Devices(device="cuda", visible=tuple(found[i] for i in numbers))


def visible_gpus() -> tuple[str, ...]:
    """The GPUs that PyTorch may use, as `CUDA_VISIBLE_DEVICES` names them."""
    import torch

    count = torch.cuda.device_count()
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    if named is None:
        return tuple(str(i) for i in range(count))
    # The variable may name more than there are.
    return tuple(word.strip() for word in named.split(",") if word.strip())[:count]


def device_facts(device: str, count: int = 1) -> dict[str, Any]:
    """Name of the device, and of a GPU its driver.

    Args:
        device: `cpu` or `cuda`.
        count: Number of GPUs.
    """
    if device == "cpu":
        return {"device": "cpu", "name": _processor(), "cores": os.cpu_count()}
    import torch

    return {
        "device": "cuda",
        "name": torch.cuda.get_device_name(0),
        "count": count,
        "cuda": torch.version.cuda,
    }


def _processor() -> str:
    with contextlib.suppress(OSError), open("/proc/cpuinfo", encoding="utf-8") as file:  # noqa: PTH123
        for line in file:
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    import platform

    return platform.processor() or platform.machine()


def compile_kernels(device: str) -> None:
    """Compile the largest modules of MuJoCo Warp, as many at once as there are cores.

    Warp compiles a module when one of its kernels is launched first, one after another; on a fresh
    machine that is most of the minute before training.
    """
    import warp as wp

    modules = []
    for name in _MODULES:
        # Another version of MuJoCo Warp may have no such module.
        with contextlib.suppress(ImportError):
            import_module(f"mujoco_warp._src.{name}")
            modules.append(wp.get_module(f"mujoco_warp._src.{name}"))
    wp.force_load(device=device, modules=modules, max_workers=os.cpu_count() or 1)


def check_cuda_graphs(simulation: Any) -> str | None:
    """A warning if mjlab's simulation on a GPU runs without CUDA graphs; None if all is well."""
    if simulation.use_cuda_graph:
        return None
    import warp as wp

    driver = wp.get_cuda_driver_version()
    version = "unknown" if driver is None else ".".join(str(part) for part in driver)
    return (
        "this GPU runs without CUDA graphs and is about six times slower than it could be: its "
        f"driver supports CUDA {version} (12.4 or newer is needed) and memory pools are "
        f"{'on' if wp.is_mempool_enabled(simulation.wp_device) else 'off'} (they must be on)."
    )
