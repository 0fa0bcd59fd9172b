"""The optimizers on CPU and GPU: one state for both."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")

from pronk.train.rl import adam
from pronk.train.runner import checkpoint
from pronk.train.runner.checkpoint import Checkpoint
from small_ppo import build, one_thread, roll_out, same, weights  # noqa: F401

pytestmark = [pytest.mark.train, pytest.mark.usefixtures("one_thread")]

NEEDS_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")


def network(seed: int = 0) -> Any:
    torch.manual_seed(seed)
    return torch.nn.Linear(5, 3)


def step(optimizer: Any, module: Any, seed: int) -> None:
    torch.manual_seed(seed)
    for parameter in module.parameters():
        parameter.grad = torch.randn_like(parameter)
    optimizer.step()


def plain(module: Any) -> Any:
    return adam.on_device(torch.optim.Adam, module.parameters(), lr=0.01)


def fused(module: Any) -> Any:
    """As on a GPU, whose kernel the CPU has too."""
    made = plain(module)
    made.param_groups[0]["fused"] = True
    return made


@pytest.mark.parametrize(("before", "after"), [(plain, fused), (fused, plain), (fused, fused)])
def test_state_goes_from_kernel_to_kernel(before: Any, after: Any) -> None:
    first, second = network(), network(1)
    optimizer, other = before(first), after(second)
    optimizer.param_groups[0]["lr"] = 0.02
    for seed in range(3):
        step(optimizer, first, seed)
    own = {key: other.param_groups[0][key] for key in ("fused", "foreach")}
    second.load_state_dict(first.state_dict())
    other.load_state_dict(copy.deepcopy(optimizer.state_dict()))
    assert {key: other.param_groups[0][key] for key in own} == own
    assert other.param_groups[0]["lr"] == 0.02
    for seed in range(3, 6):
        step(optimizer, first, seed)
        step(other, second, seed)
    torch.testing.assert_close(second.state_dict(), first.state_dict())
    counts = [float(state["step"]) for state in other.state.values()]
    assert counts == [6.0, 6.0]


def test_a_state_is_not_changed_by_loading_it() -> None:
    module = network()
    optimizer = fused(module)
    step(optimizer, module, 0)
    state = optimizer.state_dict()
    plain(network()).load_state_dict(state)
    assert state["param_groups"][0]["fused"] is True


def test_other_optimizers_are_made_as_they_are() -> None:
    made = adam.on_device(torch.optim.SGD, network().parameters(), lr=0.5)
    assert isinstance(made, torch.optim.SGD)
    assert made.param_groups[0]["lr"] == 0.5


@NEEDS_GPU
@pytest.mark.parametrize(("source", "target"), [("cpu", "cuda"), ("cuda", "cpu")])
def test_a_checkpoint_goes_from_device_to_device(source: str, target: str, tmp_path: Path) -> None:
    first, second = build(jump=True, device=source), build(jump=True, device=target)
    roll_out(first)
    first.update()
    path = tmp_path / "model.pt"
    checkpoint.save(path, Checkpoint(about={}, tree=first.save()))
    second.load(dict(checkpoint.load(path).tree))
    assert same(
        {name: value.cpu() for name, value in weights(first.get_policy()).items()},
        {name: value.cpu() for name, value in weights(second.get_policy()).items()},
    )
    for optimizer in (second.optimizer, second.estimator_optimizer):
        (group,) = optimizer.param_groups
        assert bool(group["fused"]) == (target == "cuda")
        steps = {state["step"].device.type for state in optimizer.state.values()}
        assert steps == {target}
    roll_out(second)
    second.update()
