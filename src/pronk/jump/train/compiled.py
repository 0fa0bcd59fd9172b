"""Compilation of functions of tensors with `torch.compile`, for `pronk train --compile`.

On a GPU a policy step is bound by the number of operations; compiled, hundreds of them become a few
kernels. Results differ by rounding alone. What changes in training must be a tensor: a function is
compiled again for every other value of a number that it reads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function of tensors with sizes that stay; it is compiled when first called."""
    return torch.compile(function, dynamic=False, fullgraph=True)


@contextmanager
def ordinary_tensors() -> Iterator[None]:
    """Compute without gradients, but not in PyTorch's inference mode, inside the block.

    Rollouts are in that mode, whose tensors are of another kind. State that is computed outside of
    it stays of the kind that it begins with, so that one compilation serves for all steps.
    """
    with torch.inference_mode(False), torch.no_grad():
        yield


def compiled_step(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function without gradients that is called while robots are stepped."""
    fast_function = compiled(function)

    def call(*arguments: Any) -> Any:
        with ordinary_tensors():
            return fast_function(*arguments)

    return call


def prepare(device: str) -> None:
    """Prepare PyTorch for compiling on a device.

    mjlab allows TF32 by an interface with which PyTorch 2.9 and later refuse to compile for a GPU;
    this one sets the same precision.
    """
    if device != "cpu":
        torch.set_float32_matmul_precision("high")
