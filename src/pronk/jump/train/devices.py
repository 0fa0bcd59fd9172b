"""Devices of a run: the GPUs of this host, or its CPU; and the compilation of their kernels.

`find_devices` does not start CUDA: `CUDA_VISIBLE_DEVICES` has no effect afterwards.
"""

from __future__ import annotations

import contextlib
import os
import platform
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pronk.errors import PronkError

KERNEL_MODULES = (
    "smooth",
    "sensor",
    "passive",
    "derivative",
    "solver",
    "forward",
    "support",
    "constraint",
)
"""Modules of MuJoCo Warp that are launched in every step of every model, the longest to compile
first."""


def require_extra() -> None:
    """Refuse to train where the extra is not installed, with a PronkError."""
    missing = [name for name in ("torch", "mjlab", "rsl_rl") if find_spec(name) is None]
    if missing:
        raise PronkError(
            f"training needs {', '.join(missing)}, which this installation lacks; "
            'pip install "pronk[train]".'
        )


def parse_gpu_ids(gpu_ids: str, option: str) -> tuple[str, ...]:
    """Read which GPUs an option names; returns their numbers, or `all` alone.

    Args:
        gpu_ids: Numbers with commas between them, or `all`.
        option: The option, for the message.

    Raises:
        PronkError: It is neither, or a number is given twice.
    """
    words = tuple(word.strip() for word in gpu_ids.split(","))
    if words == ("all",):
        return words
    are_numbers = all(word.isdigit() for word in words)
    are_different = len(set(words)) == len(words)
    if not (are_numbers and are_different):
        raise PronkError(f"{option} {gpu_ids!r}: expected different numbers, as in 0,1, or all.")
    return words


def find_devices(
    requested: str = "auto", gpu_ids: str | None = None, option: str = "--gpu-ids"
) -> tuple[str, ...]:
    """Find the GPUs to compute on, one a process.

    Args:
        requested: `auto`, `cpu` or `cuda`.
        gpu_ids: Numbers of the visible GPUs, as in `0,1`, or `all`; None for the first alone.
        option: The option that named them, for the messages.

    Returns:
        The GPUs as `CUDA_VISIBLE_DEVICES` names them; empty for the CPU.

    Raises:
        PronkError: There is no such GPU.
    """
    words: tuple[str, ...] = ()
    if gpu_ids is not None:
        words = parse_gpu_ids(gpu_ids, option)
    if requested == "cpu":
        if words:
            raise PronkError(f"{option} {gpu_ids} goes with a GPU; leave it or --device cpu out.")
        return ()
    gpus = visible_gpus()
    if not gpus:
        if requested == "cuda" or words:
            raise PronkError(
                "no GPU was found (PyTorch sees none; CUDA_VISIBLE_DEVICES is "
                f"{os.environ.get('CUDA_VISIBLE_DEVICES', 'not set')}); expected one with a CUDA "
                "driver, or --device cpu for a test."
            )
        return ()
    if words == ("all",):
        return gpus
    if not words:
        return (gpus[0],)
    chosen_gpus = []
    for word in words:
        if int(word) >= len(gpus):
            raise PronkError(
                f"{option} {gpu_ids}: this host has {len(gpus)} visible GPU(s), numbered 0 to "
                f"{len(gpus) - 1}."
            )
        chosen_gpus.append(gpus[int(word)])
    return tuple(chosen_gpus)


def visible_gpus() -> tuple[str, ...]:
    """Return the GPUs that PyTorch may use, as `CUDA_VISIBLE_DEVICES` names them."""
    import torch

    count = torch.cuda.device_count()
    stated = os.environ.get("CUDA_VISIBLE_DEVICES")
    if stated is None:
        return tuple(str(number) for number in range(count))
    gpus = [name.strip() for name in stated.split(",") if name.strip()]
    # The variable may name more than there are.
    return tuple(gpus[:count])


def device_facts(device: str, count: int = 1) -> dict[str, Any]:
    """Describe a device for a record.

    Args:
        device: `cpu` or `cuda`.
        count: Number of GPUs.

    Returns:
        Its kind and name; of GPUs their number and CUDA's version, of a CPU the number of cores.
    """
    if device == "cuda":
        import torch

        name = torch.cuda.get_device_name(0)
        return {"device": "cuda", "name": name, "count": count, "cuda": torch.version.cuda}
    name = platform.processor() or platform.machine()
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                name = line.partition(":")[2].strip()
                break
    return {"device": "cpu", "name": name, "cores": os.cpu_count()}


def compile_kernels(device: str) -> None:
    """Compile the largest modules of MuJoCo Warp, as many at once as there are cores.

    Warp compiles a module when one of its kernels is launched first, one after another; on a fresh
    machine that is most of the minute before training.
    """
    import warp as wp

    modules = []
    for name in KERNEL_MODULES:
        # Another version of MuJoCo Warp may have no such module.
        with contextlib.suppress(ImportError):
            import_module(f"mujoco_warp._src.{name}")
            modules.append(wp.get_module(f"mujoco_warp._src.{name}"))
    wp.force_load(device=device, modules=modules, max_workers=os.cpu_count() or 1)


def check_cuda_graphs(simulation: Any, device: str) -> str | None:
    """Return a warning if mjlab's simulation runs on a GPU without CUDA graphs."""
    if device == "cpu" or simulation.use_cuda_graph:
        return None
    import warp as wp

    driver = wp.get_cuda_driver_version()
    version = "unknown" if driver is None else ".".join(str(part) for part in driver)
    memory_pools = "on" if wp.is_mempool_enabled(simulation.wp_device) else "off"
    return (
        "this GPU runs without CUDA graphs and is about six times slower than it could be: its "
        f"driver supports CUDA {version} (12.4 or newer is needed) and memory pools are "
        f"{memory_pools} (they must be on)."
    )
