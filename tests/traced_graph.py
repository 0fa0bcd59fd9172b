"""Recording on a CPU: what a CUDA graph does, without one.

Operations are traced once, on the memory of then, and run again on that memory when the graph is
replayed. Python does not run again. Operations that a CUDA graph refuses, since they wait for the
device or copy a number to it, are refused. As a CUDA graph does, a trace keeps nothing alive but
what it made itself; a replay on memory that was freed since is refused.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.multiprocessing.reductions import StorageWeakRef
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten, tree_map

Operation = tuple[Any, tuple[Any, ...], dict[str, Any], list[Any]]
"""An operation of PyTorch, its arguments, options and results."""
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
        self._trace: list[Operation] = []
        self._borrowed: list[tuple[str, StorageWeakRef]] = []

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
        self._trace, self._borrowed = tracer.finish()
        return outputs

    @torch.no_grad()
    def replay(self) -> None:
        """Run the operations on the memory of the recording; gradients are among them."""
        for name, storage in self._borrowed:
            assert not storage.expired(), f"{name} is replayed on memory that was freed"
        for operation, arguments, options, outputs in self._trace:
            results, _ = tree_flatten(operation(*arguments, **options))
            for output, result in zip(outputs, results, strict=True):
                if isinstance(output, Tensor) and not _shares_memory(output, result):
                    output.copy_(result)


class _Tracer(TorchDispatchMode):
    """Notes operations, and what tensors were before they were overwritten."""

    def __init__(self) -> None:
        super().__init__()
        self.trace: list[Operation] = []
        self.overwritten: list[tuple[Tensor, Tensor]] = []
        self._numbers: list[Tensor] = []
        self._new_tensors: list[Tensor] = []

    def finish(self) -> tuple[list[Operation], list[tuple[str, StorageWeakRef]]]:
        """Return the trace, which keeps nothing alive that it did not allocate.

        Returns:
            The operations, with bare memory in the place of tensors from outside, and of each
            storage from outside the first operation on it and a weak reference.
        """
        own_storages = set()
        for tensor in [*self._new_tensors, *self._numbers]:
            own_storages.add(tensor.untyped_storage().data_ptr())
        borrowed: dict[int, tuple[str, StorageWeakRef]] = {}
        name = ""

        def borrow(argument: Any) -> Any:
            if not isinstance(argument, Tensor) or argument.numel() == 0:
                return argument
            storage = argument.untyped_storage()
            address = storage.data_ptr()
            if address in own_storages:
                return argument
            if address not in borrowed:
                borrowed[address] = (name, StorageWeakRef(storage))
            return _bare(argument)

        trace: list[Operation] = []
        for operation, arguments, options, outputs in self.trace:
            name = operation._schema.name
            trace.append((operation, *tree_map(borrow, (arguments, options, outputs))))
        return trace, list(borrowed.values())

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
        before = {x.untyped_storage().data_ptr() for x in arguments if isinstance(x, Tensor)}
        for output in outputs:
            if isinstance(output, Tensor) and output.untyped_storage().data_ptr() not in before:
                self._new_tensors.append(output)
        self.trace.append((func, args, options, outputs))
        return results


def _bare(tensor: Tensor) -> Tensor:
    """Return a tensor on the same memory that does not keep it alive."""
    storage = tensor.untyped_storage()
    memory = (ctypes.c_byte * storage.nbytes()).from_address(storage.data_ptr())
    numbers = torch.frombuffer(memory, dtype=tensor.dtype)
    return torch.as_strided(numbers, tensor.size(), tensor.stride(), tensor.storage_offset())


def _shares_memory(first: Tensor, second: Tensor) -> bool:
    return first.untyped_storage().data_ptr() == second.untyped_storage().data_ptr()
