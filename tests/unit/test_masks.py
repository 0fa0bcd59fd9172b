"""Robots as masks, whichever way mjlab names them."""

from __future__ import annotations

from typing import Any

import pytest

torch = pytest.importorskip("torch")

from pronk.jump.train.mdp.masks import robot_mask

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
