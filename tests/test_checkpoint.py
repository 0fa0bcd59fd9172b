"""Checkpoint files: whole or not there, exact, and never a program."""

from __future__ import annotations

import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from pronk.errors import ArtefactError
from pronk.train.runner import checkpoint
from pronk.train.runner.checkpoint import Checkpoint

ABOUT = {"iteration": 12, "phase": "walk", "versions": {"pronk": "0.1.0", "torch": None}}
TREE: dict[str, Any] = {
    "weights": {"mlp.0.weight": np.arange(6, dtype=np.float32).reshape(2, 3)},
    "random": np.arange(5, dtype=np.uint8),
}

ARRAYS = hnp.arrays(
    dtype=st.sampled_from([np.float32, np.float64, np.int64, np.uint8, np.bool_]),
    shape=hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=3),
)
LEAVES = st.none() | st.booleans() | st.integers() | st.floats() | st.text() | ARRAYS
KEYS = st.text(max_size=5) | st.sampled_from(["header", "file", "a/b", "..", "0"])


def nests(inside: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    lists = st.lists(inside, max_size=3)
    whole = st.integers(0, 99)
    named = st.dictionaries(KEYS, inside, max_size=3)
    return lists | lists.map(tuple) | named | st.dictionaries(whole, inside, max_size=3)


TREES = st.dictionaries(KEYS, st.recursive(LEAVES, nests, max_leaves=8), max_size=4)


def same(a: Any, b: Any) -> bool:
    """Equal in type, nesting and every bit of value (NaN equals NaN)."""
    if type(a) is not type(b):
        return False
    if isinstance(a, dict):
        return list(a) == list(b) and all(same(a[key], b[key]) for key in a)
    if isinstance(a, (list, tuple)):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and np.array_equal(a, b, equal_nan=True)
    return bool(a == b or (a != a and b != b))


@given(tree=TREES)
def test_every_tree_comes_back_as_it_was(
    tree: dict[str, Any], tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("tree") / "model_1.pt"
    checkpoint.save(path, Checkpoint(about=ABOUT, tree=tree))
    assert same(checkpoint.load(path).tree, tree)


def test_says_what_it_is(tmp_path: Path) -> None:
    path = tmp_path / "model_12.pt"
    checkpoint.save(path, Checkpoint(about=ABOUT, tree=TREE))
    assert checkpoint.about(path) == ABOUT
    assert checkpoint.load(path).about == ABOUT


@pytest.mark.train
def test_an_optimizer_goes_on_from_it(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")

    def parts() -> tuple[Any, Any]:
        torch.manual_seed(3)
        layer = torch.nn.Linear(4, 2)
        return layer, torch.optim.Adam(layer.parameters(), lr=0.1)

    def step(layer: Any, optimizer: Any) -> None:
        optimizer.zero_grad()
        layer(torch.ones(3, 4)).square().sum().backward()
        optimizer.step()

    layer, optimizer = parts()
    step(layer, optimizer)
    tree = {"layer": layer.state_dict(), "optimizer": optimizer.state_dict()}
    checkpoint.save(tmp_path / "a.pt", Checkpoint(about=ABOUT, tree=tree))
    step(layer, optimizer)
    other, its_optimizer = parts()
    found = checkpoint.load(tmp_path / "a.pt").tree
    other.load_state_dict(found["layer"])
    its_optimizer.load_state_dict(found["optimizer"])
    step(other, its_optimizer)
    assert torch.equal(other.weight, layer.weight)
    assert torch.equal(other.bias, layer.bias)


@pytest.mark.train
def test_tells_where_a_number_is_not_finite() -> None:
    torch = pytest.importorskip("torch")
    good = {"count": torch.tensor(3), "weights": [torch.zeros(2), {"lr": 0.1}]}
    assert checkpoint.not_finite(good) is None
    bad = {**good, "optimizer": {"state": {0: {"exp_avg": torch.tensor([0.0, float("inf")])}}}}
    assert checkpoint.not_finite(bad) == "optimizer/state/0/exp_avg"


@pytest.mark.parametrize("value", [object(), {1, 2}, np.array([None]), b"bytes"])
def test_refuses_what_it_cannot_hold_and_leaves_the_old_file(tmp_path: Path, value: Any) -> None:
    path = tmp_path / "model_1.pt"
    checkpoint.save(path, Checkpoint(about=ABOUT, tree=TREE))
    with pytest.raises(TypeError, match="tree/deep/odd"):
        checkpoint.save(path, Checkpoint(about=ABOUT, tree={"deep": {"odd": value}}))
    assert same(checkpoint.load(path).tree, TREE)
    assert [p.name for p in tmp_path.iterdir()] == ["model_1.pt"]


def test_a_cut_file_is_refused_wherever_it_was_cut(tmp_path: Path) -> None:
    path = tmp_path / "model_1.pt"
    checkpoint.save(path, Checkpoint(about=ABOUT, tree=TREE))
    whole = path.read_bytes()
    for length in range(0, len(whole), 37):
        path.write_bytes(whole[:length])
        with pytest.raises(ArtefactError, match="not a checkpoint"):
            checkpoint.load(path)


def test_a_changed_number_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / "model_1.pt"
    checkpoint.save(path, Checkpoint(about=ABOUT, tree=TREE))
    whole = bytearray(path.read_bytes())
    at = whole.find(np.arange(6, dtype=np.float32).tobytes())
    whole[at + 5] ^= 1
    path.write_bytes(bytes(whole))
    with pytest.raises(ArtefactError, match="not a checkpoint"):
        checkpoint.load(path)


class Program:
    """Unpickled, it would make a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return Path.touch, (self.path,)


def test_a_pickle_is_never_run(tmp_path: Path) -> None:
    ran, path = tmp_path / "ran", tmp_path / "model_1.pt"
    program = pickle.dumps(Program(ran))
    # As torch.save lays files out, as numpy lays out arrays of objects, and bare.
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", program)
    foreign = [path.read_bytes(), program]
    with path.open("wb") as file:
        np.savez(file, header=np.array([Program(ran)], dtype=object))
    foreign.append(path.read_bytes())
    for content in foreign:
        path.write_bytes(content)
        with pytest.raises(ArtefactError, match="not a checkpoint"):
            checkpoint.load(path)
    assert not ran.exists()


def test_missing_and_of_another_schema(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "model_1.pt"
    with pytest.raises(ArtefactError, match="no such file; `pronk train` writes one"):
        checkpoint.load(path)
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "SCHEMA", "pronk/checkpoint/0")
        checkpoint.save(path, Checkpoint(about=ABOUT, tree=TREE))
    with pytest.raises(ArtefactError, match="'pronk/checkpoint/0'; this pronk reads"):
        checkpoint.load(path)


def test_latest_goes_by_number_and_prune_keeps_the_last(tmp_path: Path) -> None:
    assert checkpoint.latest(tmp_path) is None
    for iteration in (8, 9, 10, 100):
        checkpoint.save(
            checkpoint.numbered(tmp_path, iteration), Checkpoint(about=ABOUT, tree=TREE)
        )
    others = {"walk.pt", "model_best.pt", "policy.onnx"}
    unfinished = ".model_101.pt.k3j2.pt"  # left by a writer that was killed
    for name in (*others, unfinished):
        (tmp_path / name).write_bytes(b"")
    assert checkpoint.latest(tmp_path) == tmp_path / "model_100.pt"
    checkpoint.prune(tmp_path, keep=2)
    assert {p.name for p in tmp_path.iterdir()} == {"model_10.pt", "model_100.pt", *others}
