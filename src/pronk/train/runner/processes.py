"""What the processes of one run, one for each GPU, tell each other.

Every process must call these alike. With one process they cost nothing.
"""

from __future__ import annotations

from typing import Any

import torch


def in_any(flag: bool, *, size: int, device: torch.device | str) -> bool:
    """Whether the flag is up in any process.

    Args:
        flag: That of this process.
        size: Number of processes.
        device: What this process computes on.
    """
    if size == 1:
        return flag
    raised = torch.tensor(float(flag), device=device)
    torch.distributed.all_reduce(raised, op=torch.distributed.ReduceOp.MAX)
    return bool(raised.item())


def gathered(mine: Any, *, size: int, rank: int) -> list[Any]:
    """What every process has, by rank, in the first one; in the others an empty list.

    Args:
        mine: What this process has; tensors are taken to the CPU.
        size: Number of processes.
        rank: This process.
    """
    if size == 1:
        return [mine]
    everyone: list[Any] | None = [None] * size if rank == 0 else None
    torch.distributed.gather_object(_on_cpu(mine), everyone, dst=0)
    return everyone or []


def _on_cpu(node: Any) -> Any:
    if isinstance(node, torch.Tensor):
        return node.cpu()
    return {key: _on_cpu(value) for key, value in node.items()} if isinstance(node, dict) else node
