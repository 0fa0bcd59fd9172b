"""Compilation of functions of tensors with `torch.compile`, for `pronk train --compile`.

On a GPU a policy step is bound by the number of operations; compiled, hundreds of them become a few
kernels. Results differ by rounding alone. What changes in training must be a tensor: a function is
compiled again for every other value of a number that it reads.

What is computed alike many times in an iteration is recorded as a CUDA graph, whose kernels are
launched together (`RecordedFunction`): the steps of learning and of the policy, and what
`pronk.jump.train.mdp.step_graphs` lists of the robots' step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any, ClassVar

import torch
from torch import Tensor

NO_TENSORS: Mapping[str, Tensor] = MappingProxyType({})
"""For functions without inputs."""
TensorFunction = Callable[[Mapping[str, Tensor]], tuple[Tensor, ...]]
"""A function of tensors by name."""


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


class DeviceGraph:
    """A CUDA graph: kernels on given memory, which are launched together."""

    @staticmethod
    def records(device: str) -> bool:
        """Return whether there are graphs on a device."""
        return device != "cpu"

    def __init__(self, device: str, stream: torch.cuda.Stream | None = None) -> None:
        """Prepare to record.

        Args:
            device: Device of the tensors.
            stream: Stream to record on, if the function names one; None for a new one.
        """
        self._stream = stream or torch.cuda.Stream(device)
        self._pool = torch.cuda.graph_pool_handle()
        self._graph: torch.cuda.CUDAGraph | None = None

    def record(self, function: Callable[[], tuple[Tensor, ...]]) -> tuple[Tensor, ...]:
        """Record a function; nothing is computed.

        Args:
            function: Launches kernels alone.

        Returns:
            What the function returns: tensors that `replay` fills.
        """
        graph = torch.cuda.CUDAGraph()
        self._stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._stream):
            # `torch.cuda.graph` would also empty PyTorch's cache of memory, in every iteration.
            graph.capture_begin(pool=self._pool)
            try:
                outputs = function()
            finally:
                graph.capture_end()
        torch.cuda.current_stream().wait_stream(self._stream)
        self._graph = graph
        return outputs

    def replay(self) -> None:
        """Compute what was recorded, on the memory of then."""
        assert self._graph is not None
        self._graph.replay()


class RecordedFunction:
    """A function of tensors that is recorded as a CUDA graph once an iteration, and replayed.

    Calls in an iteration differ in their tensors alone. Between iterations everything may change:
    weights of losses, learning rates, the state of an optimizer. So the function is recorded in
    each iteration. A recording uses the memory of the one before.
    """

    graph_type: ClassVar[type[DeviceGraph]] = DeviceGraph
    """What records and replays."""

    def __init__(
        self,
        function: TensorFunction,
        device: str,
        stream: torch.cuda.Stream | None = None,
    ) -> None:
        """Prepare to record a function.

        Args:
            function: Computes tensors from tensors by name. It must not wait for the device, and
                must keep on the device, in the same memory, what one call leaves to the next.
                Numbers may be drawn from PyTorch's generator of the device.
            device: Device of the tensors. On a CPU the function is called as it is.
            stream: Stream to record on, if the function names one; None for a new one.
        """
        self.records = self.graph_type.records(device)
        """Whether anything is recorded; on a CPU it is not."""
        self._function = function
        self._calls = 0
        self._inputs: dict[str, Tensor] = {}
        self._outputs: tuple[Tensor, ...] = ()
        if self.records:
            self._graph = self.graph_type(device, stream)

    def begin(self) -> None:
        """Begin an iteration: what was recorded is not replayed any more."""
        self._calls = 0
        self._inputs = {}

    def __call__(self, inputs: Mapping[str, Tensor] = NO_TENSORS) -> tuple[Tensor, ...]:
        """Compute the function.

        The first call of an iteration is computed as it is, since optimizers make their state in
        it, and functions are compiled; neither can be recorded. The second one is recorded.

        Args:
            inputs: Tensors by name. Those of other sizes than what was recorded are not replayed,
                but computed.

        Returns:
            What the function returns, as copies.
        """
        self._calls += 1
        if self._calls == 1 or not self.records:
            return self._function(inputs)
        if self._calls == 2:
            self._inputs = {name: tensor.clone() for name, tensor in inputs.items()}
            self._outputs = self._graph.record(lambda: self._function(self._inputs))
        for name, stored in self._inputs.items():
            if stored.shape != inputs[name].shape:
                return self._function(inputs)
            stored.copy_(inputs[name])
        self._graph.replay()
        return tuple(output.clone() for output in self._outputs)


Recorder = Callable[[TensorFunction], RecordedFunction]
"""What prepares a function to be recorded."""


def keep_in_place(kept: list[Tensor], new: list[Tensor]) -> None:
    """Copy new numbers into tensors that stay where they are, one for one."""
    for tensor, numbers in zip(kept, new, strict=True):
        tensor.copy_(numbers)
