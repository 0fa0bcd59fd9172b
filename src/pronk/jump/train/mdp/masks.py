"""Robots as masks: tensors of one size, whichever robots are meant."""

from __future__ import annotations

import torch
from torch import Tensor


def robot_mask(robots: Tensor | slice | None, count: int, device: torch.device | str) -> Tensor:
    """Return which robots are meant, bool (N,).

    Args:
        robots: Their indices, a slice, a mask, which is returned as it is, or None for all.
        count: Number of all robots, N.
        device: Device of the mask.
    """
    if isinstance(robots, Tensor) and robots.dtype == torch.bool:
        return robots
    mask = torch.zeros(count, dtype=torch.bool, device=device)
    if robots is None:
        mask.fill_(True)
    elif isinstance(robots, Tensor):
        mask.index_fill_(0, robots, True)
    else:
        mask[robots] = True
    return mask


def overwrite(kept: Tensor, mask: Tensor, numbers: Tensor) -> None:
    """Write numbers where a mask is true, in the same memory, without waiting for the device.

    Args:
        kept: Tensor that is changed, for example (N, size).
        mask: Where, bool; of the shape of `kept` or one that broadcasts to it, as (N, 1) does.
        numbers: New numbers, of such a shape as well.
    """
    torch.where(mask, numbers, kept, out=kept)
