"""What the paper published about its jumps (arXiv 2404.15096, Table III)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

Pair = tuple[float, float]
"""Mean and standard deviation."""


@dataclass(frozen=True, kw_only=True)
class PaperCell:
    """One row of the paper's Table III: mean and standard deviation of five jumps [m]."""

    height: Mapping[str, Pair]
    """By gains: `naive`, `matched`."""
    distance: Mapping[str, Pair]


TABLE_III: Mapping[str, PaperCell] = {
    "forward 1": PaperCell(
        height={"naive": (0.332, 0.008), "matched": (0.318, 0.014)},
        distance={"naive": (0.690, 0.076), "matched": (0.597, 0.042)},
    ),
    "forward 2": PaperCell(
        height={"naive": (0.246, 0.022), "matched": (0.244, 0.013)},
        distance={"naive": (0.944, 0.030), "matched": (0.969, 0.026)},
    ),
    "side -1": PaperCell(
        height={"naive": (0.304, 0.061), "matched": (0.374, 0.016)},
        distance={"naive": (0.636, 0.092), "matched": (0.587, 0.054)},
    ),
    "side +1": PaperCell(
        height={"naive": (0.249, 0.041), "matched": (0.366, 0.052)},
        distance={"naive": (0.701, 0.183), "matched": (0.542, 0.051)},
    ),
    "back 2": PaperCell(
        height={"naive": (0.346, 0.031), "matched": (0.381, 0.015)},
        distance={"naive": (0.944, 0.030), "matched": (0.932, 0.025)},
    ),
}
"""arXiv 2404.15096, Table III: for comparison, never fitted to. Its naive distance with `back 2` is
that with `forward 2`, digit by digit: most likely a slip of the pen (reading A4)."""

PAPER_RATIOS = {"height": 1.48, "distance": 2.08}
"""Ratio of the mean standard deviations, naive over matched, as Table III gives it; the text says
2.30 for the distance (reading A4)."""


def in_paper_order(names: Iterable[str]) -> list[str]:
    """Sort names of policies as the columns of Table III: `naive` first, others as they came."""
    return sorted(names, key=lambda name: name != "naive")
