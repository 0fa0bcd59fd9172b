"""Robots as masks, whichever way mjlab names them."""

from __future__ import annotations

from typing import Any

import pytest

torch = pytest.importorskip("torch")

from pronk.jump.train.mdp.masks import overwrite, robot_mask

pytestmark = pytest.mark.train


@pytest.mark.parametrize(
    ("robots", "expected"),
    [
        (None, [True, True, True, True]),
        (slice(1, 3), [False, True, True, False]),
        (torch.tensor([3, 0]), [True, False, False, True]),
        (torch.tensor([], dtype=torch.long), [False, False, False, False]),
        (torch.tensor([False, True, False, False]), [False, True, False, False]),
    ],
)
def test_a_mask_has_the_robots_that_are_meant(robots: Any, expected: list[bool]) -> None:
    assert robot_mask(robots, 4, "cpu").tolist() == expected


def test_numbers_are_written_where_the_mask_is_and_into_the_same_memory() -> None:
    state = torch.zeros(3, 2)
    memory = state[:]
    overwrite(state, torch.tensor([True, False, True])[:, None], torch.tensor([1.0, 2.0]))
    assert memory.tolist() == [[1.0, 2.0], [0.0, 0.0], [1.0, 2.0]]
