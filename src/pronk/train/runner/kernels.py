"""Compiling the simulator's kernels: side by side where they are known, and what it took.

Warp compiles a module when one of its kernels is launched first, so on a fresh machine most of the
minute before training goes into eight modules of MuJoCo Warp, one after another on one core. They
are the same for every model; what depends on the model is generated while it is set up, and
compiles then.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import time
from importlib import import_module

import warp as wp

MODULES = tuple(
    f"mujoco_warp._src.{name}"
    for name in (
        "smooth",
        "sensor",
        "passive",
        "derivative",
        "solver",
        "forward",
        "support",
        "constraint",
    )
)
"""Launched in every step of every model, the longest to compile first."""
_COMPILED = re.compile(r"took ([\d.]+) ms\s+\(compiled\)")
"""What Warp prints for each module that was not in its cache."""


def compile_ahead(device: str) -> float:
    """Compile `MODULES`, as many at once as there are cores.

    Another version of MuJoCo Warp may have no such module; it is then left out, and compiles when
    it is needed.

    Args:
        device: `cpu`, or `cuda:0` and so on.

    Returns:
        Time that passed [s]; 0 if Warp's cache had them all.
    """
    found = []
    for name in MODULES:
        with contextlib.suppress(ImportError):
            import_module(name)
            found.append(wp.get_module(name))
    begin = time.perf_counter()
    # Printed times that passed side by side would be taken for a sum.
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        wp.force_load(device=device, modules=found, max_workers=os.cpu_count() or 1)
    return time.perf_counter() - begin if _COMPILED.search(printed.getvalue()) else 0.0


def kernel_seconds(printed: str) -> float:
    """Time that kernels were compiled for, by Warp's own account; those in its cache cost none [s].

    Args:
        printed: What Warp wrote to standard output.
    """
    return sum(float(ms) for ms in _COMPILED.findall(printed)) / 1000.0
