"""What a tree of objects remembers, found by walking and put back in place."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")

from pronk.errors import ArtefactError
from pronk.train.runner.memory import Memory, put_back, walk

pytestmark = pytest.mark.train


@dataclass(frozen=True)
class Fixed:
    gain: float = 17.0


class Term:
    """Remembers in every way that is known."""

    def __init__(self, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        self.value = torch.rand(3, generator=generator)
        self.view = self.value[1:]
        self.generator = generator
        self.array = np.full(2, float(seed))
        self.count = seed
        self.range = (-1.0, float(seed))
        self.history = deque([torch.zeros(1), torch.full((1,), float(seed))])
        self.named: dict[Any, Any] = {"a": torch.tensor(seed), 3: None}
        self.parts = (Fixed(), torch.full((2,), float(seed)))
        self.late: torch.Tensor | None = None
        self._cached_data = torch.rand(1)
        self.itself = self
        self.words = "not remembered"


@dataclass
class Tree:
    term: Term
    twice: Any = field(default=None)


def find(tree: Any) -> dict[str, Memory]:
    return dict(walk("tree", tree, {}))


def saved(tree: Any) -> dict[str, Any]:
    return {name: memory.copy() for name, memory in find(tree).items()}


def test_everything_is_found_once_under_its_path() -> None:
    term = Term(5)
    assert find(Tree(term, twice=term)).keys() == {
        "tree/term/value",
        "tree/term/view",
        "tree/term/generator",
        "tree/term/array",
        "tree/term/count",
        "tree/term/range",
        "tree/term/history/0",
        "tree/term/history/1",
        "tree/term/named/a",
        "tree/term/named/3",
        "tree/term/parts/0/gain",
        "tree/term/parts/1",
        "tree/term/late",
    }


def test_all_is_put_back_where_it_was() -> None:
    first, second = Tree(Term(5)), Tree(Term(6))
    first.term.late = torch.ones(2)
    first.term.named[3] = 2.5
    state = saved(first)
    drawn = torch.rand(4, generator=first.term.generator)
    place = second.term.value.data_ptr()
    put_back(partial(find, second), state, "cpu")
    term = second.term
    assert term.value.data_ptr() == place
    assert torch.equal(term.value, first.term.value)
    assert torch.equal(term.view, term.value[1:])
    assert term.view.data_ptr() == term.value[1:].data_ptr()
    assert torch.equal(torch.rand(4, generator=term.generator), drawn)
    assert term.array.tolist() == [5.0, 5.0]
    assert (term.count, term.range) == (5, (-1.0, 5.0))
    assert [float(entry) for entry in term.history] == [0.0, 5.0]
    assert (int(term.named["a"]), term.named[3]) == (5, 2.5)
    assert term.parts[1].tolist() == [5.0, 5.0]
    assert term.late is not None
    assert term.late.tolist() == [1.0, 1.0]


def test_a_saved_state_does_not_follow_what_happens_later() -> None:
    tree = Tree(Term(5))
    state = saved(tree)
    tree.term.value.zero_()
    tree.term.array[:] = 0.0
    assert state["tree/term/value"].abs().sum() > 0.0
    assert state["tree/term/array"].tolist() == [5.0, 5.0]


def test_what_shared_memory_at_first_and_no_more_is_told_apart() -> None:
    start = torch.zeros(2)
    state = saved({"before": torch.tensor([1.0, 2.0]), "now": torch.tensor([3.0, 4.0])})
    tree = {"before": start, "now": start}
    put_back(partial(find, tree), state, "cpu")
    assert tree["before"].tolist() == [1.0, 2.0]
    assert tree["now"].tolist() == [3.0, 4.0]


def test_what_is_fixed_must_agree() -> None:
    state = saved([Fixed(), ("text", 2.0)])
    put_back(partial(find, [Fixed(), ("text", 2.0)]), state, "cpu")
    with pytest.raises(ArtefactError, match=r"tree/0/gain was 17.0 .* and is 20.0"):
        put_back(partial(find, [Fixed(20.0), ("text", 2.0)]), state, "cpu")
    with pytest.raises(ArtefactError, match="tree/1/1 differs from the checkpoint's"):
        put_back(partial(find, [Fixed(), ("text", 3.0)]), state, "cpu")


def test_a_generator_that_cannot_be_saved_is_refused() -> None:
    with pytest.raises(TypeError, match="tree/draws is a Generator; draw with torch"):
        find({"draws": np.random.default_rng(1)})
