"""Adam as the device does it fastest.

On a GPU the fused kernel steps all parameters at once; PyTorch's default launches a dozen kernels
a step and lets the host work out every parameter's bias correction.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from torch import nn
from torch.optim import Adam, Optimizer

_KERNEL = ("fused", "foreach")
"""What a parameter group says of the way it is stepped, not of the steps."""


def on_device(kind: type[Optimizer], parameters: Iterable[nn.Parameter], *, lr: float) -> Optimizer:
    """An optimizer; if it is Adam on a GPU, the fused one.

    Its state may come from any device: the fused kernel counts its steps in the device's memory
    and the others on the host, and the state to be loaded also says by which kernel it was made.
    The optimizer stays with its own.

    Args:
        kind: Its class.
        parameters: All on one device.
        lr: Learning rate.
    """
    parameters = list(parameters)
    fused = issubclass(kind, Adam) and parameters[0].is_cuda
    options: dict[str, Any] = {"lr": lr, "fused": True} if fused else {"lr": lr}
    optimizer = kind(parameters, **options)
    optimizer.register_load_state_dict_pre_hook(_with_own_kernel)
    return optimizer


def _with_own_kernel(optimizer: Optimizer, state: dict[str, Any]) -> dict[str, Any]:
    groups = [
        {**theirs, **{key: ours[key] for key in _KERNEL if key in ours}}
        for theirs, ours in zip(state["param_groups"], optimizer.param_groups, strict=True)
    ]
    return {**state, "param_groups": groups}
