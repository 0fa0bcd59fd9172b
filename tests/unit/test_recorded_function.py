"""Steps of learning that are recorded on a GPU take the same steps as without a recording."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest

torch = pytest.importorskip("torch")

from pronk.jump.train.compiled import RecordedFunction
from traced_graph import TracedGraph

pytestmark = pytest.mark.train

DEVICES = [
    "cpu",
    pytest.param(
        "cuda:0",
        marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU of NVIDIA"),
    ),
]


class Learner:
    """A network, Adam with a rate on the device, and a weight of the loss that Python holds."""

    def __init__(self, device: str) -> None:
        torch.manual_seed(0)
        self.network = torch.nn.Sequential(
            torch.nn.Linear(6, 16), torch.nn.ELU(), torch.nn.Linear(16, 2)
        ).to(device)
        self.optimizer = torch.optim.Adam(self.network.parameters(), lr=1e-2)
        self.weight = 1.0
        for group in self.optimizer.param_groups:
            group["capturable"] = device != "cpu"

    def step(self, batch: Mapping[str, Any]) -> tuple[Any, ...]:
        loss = self.weight * (self.network(batch["x"]) - batch["y"]).square().mean()
        self.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimizer.step()
        return (loss.detach(),)


@pytest.mark.parametrize("device", DEVICES)
def test_recorded_steps_are_those_without_a_recording(device: str) -> None:
    """In several updates, with what changes between them and a mini-batch that is shorter."""
    plain = Learner(device)
    fast = Learner(device)
    recorded = RecordedFunction(fast.step, device)
    assert recorded.records == (device != "cpu")
    generator = torch.Generator().manual_seed(1)
    for update, (weight, rate) in enumerate([(1.0, 1e-2), (3.0, 1e-3), (0.5, 3e-2)]):
        recorded.begin()
        for learner in (plain, fast):
            learner.weight = weight
            learner.optimizer.param_groups[0]["lr"] = rate
        for rows in (32, 32, 32, 20, 32):
            batch = {
                "x": torch.randn(rows, 6, generator=generator).to(device),
                "y": torch.randn(rows, 2, generator=generator).to(device),
            }
            (expected,) = plain.step(batch)
            (loss,) = recorded(batch)
            torch.testing.assert_close(loss, expected, rtol=1e-5, atol=1e-6)
        if update == 1:
            # A phase may reset the optimizer's moments.
            for learner in (plain, fast):
                learner.optimizer.state.clear()
    weights = torch.nn.utils.parameters_to_vector(fast.network.parameters())
    expected = torch.nn.utils.parameters_to_vector(plain.network.parameters())
    torch.testing.assert_close(weights, expected, rtol=1e-5, atol=1e-6)


def test_a_trace_refuses_memory_that_was_freed() -> None:
    """A CUDA graph would write to whatever has that memory then."""
    owner = {"numbers": torch.zeros(3)}
    graph = TracedGraph("cpu")
    graph.record(lambda: (owner["numbers"].add_(1.0),))
    graph.replay()
    assert owner["numbers"].tolist() == [1.0, 1.0, 1.0]
    owner["numbers"] = torch.zeros(3)
    with pytest.raises(AssertionError, match="freed"):
        graph.replay()
