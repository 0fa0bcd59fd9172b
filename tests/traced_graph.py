"""Recording on a CPU: what a CUDA graph does, without one.

Operations are traced once, on the memory of then, and run again on that memory when the graph is
replayed. Python does not run again. Operations that a CUDA graph refuses, since they wait for the
device or copy a number to it, are refused.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten

REFUSED = {
    "aten::_local_scalar_dense",
    "aten::nonzero",
    "aten::masked_select",
    "aten::is_nonzero",
    "aten::equal",
}
"""Operations that wait for the device."""
TAKES_NUMBERS = {"aten::fill_", "aten::detach", "aten::detach_"}
"""Operations that take a number from Python's memory without a copy of it."""


class TracedGraph:
    """Stands in for `DeviceGraph` on a CPU."""

    @staticmethod
    def records(device: str) -> bool:
        """Return True: whatever the device, it is recorded."""
        return True

    def __init__(self, device: str, stream: Any = None) -> None:
        self._trace: list[tuple[Any, tuple[Any, ...], dict[str, Any], list[Any]]] = []

    def record(self, function: Callable[[], tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
        """Trace a function, and undo what it did."""
        tracer = _Tracer()
        generator_state = torch.get_rng_state()
        with tracer:
            outputs = function()
        torch.set_rng_state(generator_state)
        with torch.no_grad():
            for tensor, before in reversed(tracer.overwritten):
                tensor.copy_(before)
        self._trace = tracer.trace
        return outputs

    @torch.no_grad()
    def replay(self) -> None:
        """Run the operations on the memory of the recording; gradients are among them."""
        for operation, arguments, options, outputs in self._trace:
            results, _ = tree_flatten(operation(*arguments, **options))
            for output, result in zip(outputs, results, strict=True):
                if isinstance(output, Tensor) and not _shares_memory(output, result):
                    output.copy_(result)


class _Tracer(TorchDispatchMode):
    """Notes operations, and what tensors were before they were overwritten."""

    def __init__(self) -> None:
        super().__init__()
        self.trace: list[tuple[Any, tuple[Any, ...], dict[str, Any], list[Any]]] = []
        self.overwritten: list[tuple[Tensor, Tensor]] = []
        self._numbers: list[Tensor] = []

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        options = kwargs or {}
        name = func._schema.name
        assert name not in REFUSED, f"{name} cannot be recorded"
        arguments, _ = tree_flatten((args, options))
        if name == "aten::lift_fresh":
            self._numbers.append(args[0])
            return args[0]
        masks = [x for x in arguments if isinstance(x, Tensor) and x.dtype == torch.bool]
        for argument in arguments:
            is_number = any(argument is number for number in self._numbers)
            fills = name in TAKES_NUMBERS or (name == "aten::index_put_" and len(masks) == 1)
            assert not is_number or fills, f"{name} copies a number of Python's"
        if name == "aten::index":
            assert not any(mask is not args[0] for mask in masks), f"{name} with a mask waits"
        if name == "aten::index_put_" and masks:
            # With a number in Python's memory it is a fill, which does not wait.
            is_fill = any(args[2] is number for number in self._numbers)
            assert is_fill, f"{name} with a mask waits"
        for place, argument in enumerate(func._schema.arguments):
            if argument.alias_info is not None and argument.alias_info.is_write:
                target = options.get(argument.name, args[place] if place < len(args) else None)
                if isinstance(target, Tensor):
                    self.overwritten.append((target, target.clone()))
        results = func(*args, **options)
        outputs, _ = tree_flatten(results)
        self.trace.append((func, args, options, outputs))
        return results


def _shares_memory(one: Tensor, other: Tensor) -> bool:
    return one.untyped_storage().data_ptr() == other.untyped_storage().data_ptr()
