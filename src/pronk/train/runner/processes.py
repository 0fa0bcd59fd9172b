"""What the processes of one run, one for each GPU, tell each other.

Every process must call these alike. With one process they cost nothing.
"""

from __future__ import annotations

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
