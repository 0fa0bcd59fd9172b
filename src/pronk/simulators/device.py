"""Where the grid is simulated: on the processor, or on a GPU."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from pronk.errors import PronkError
from pronk.simulators.mujoco import Bench

DEVICES = ("cpu", "cuda", "warp-cpu")
"""`cpu`: `mujoco.rollout` on its threads, in double precision. `cuda`: MuJoCo Warp on the GPU, in
single precision. `warp-cpu`: MuJoCo Warp on the processor, slow, to see what precision does."""


def bench_on(device: str) -> Callable[..., Bench]:
    """What builds a bench on a device; call it as `Bench`.

    Args:
        device: One of `DEVICES`.

    Raises:
        PronkError: The device is unknown, MuJoCo Warp is not installed, or there is no GPU.
    """
    if device not in DEVICES:
        raise PronkError(f"device {device!r}; expected one of {', '.join(DEVICES)}.")
    if device == "cpu":
        return Bench
    try:
        from pronk.simulators.warp import WarpBench, find_device
    except ModuleNotFoundError as error:
        raise PronkError(
            f'device "{device}" needs MuJoCo Warp, and {error.name} is not installed; '
            'pip install "pronk[train]", or use device "cpu".'
        ) from error
    find_device(device)
    return partial(WarpBench, device=device)
