"""How policies and the paper look in every figure of a trial."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from pronk.report import style

PAPER_WORDS = "paper, hardware"
"""What the paper's figures are called beside ours."""
_NAMED = {"naive": (style.NAIVE, "D"), "matched": (style.MATCHED, "o")}
_OTHERS = (("#009E73", "s"), ("#56B4E9", "^"), ("#E69F00", "v"), ("#7a5195", "P"))


@dataclass(frozen=True, kw_only=True)
class Look:
    """Colour and mark of one policy."""

    name: str
    colour: str
    marker: str

    @property
    def marks(self) -> dict[str, Any]:
        """For single jumps: filled, without an edge, so that many may overlap."""
        return {
            "linestyle": "none",
            "marker": self.marker,
            "markersize": 4.5,
            "color": self.colour,
            "alpha": 0.45,
            "markeredgewidth": 0.0,
        }

    def key(self, words: str | None = None) -> Line2D:
        """Its entry in a legend."""
        return Line2D(
            [],
            [],
            linestyle="none",
            marker=self.marker,
            color=self.colour,
            markersize=6.0,
            label=words or f"{self.name}, virtual robot",
        )


def looks(policies: Sequence[str]) -> dict[str, Look]:
    """A look for each policy: `naive` and `matched` always the same, others by their place.

    Args:
        policies: Their names; what follows a comma (`naive, body 1`) does not change the look.
    """
    found, spare = {}, iter(_OTHERS * (1 + len(policies) // len(_OTHERS)))
    for name in policies:
        base = name.split(",")[0]
        colour, marker = _NAMED[base] if base in _NAMED else next(spare)
        found[name] = Look(name=name, colour=colour, marker=marker)
    return found


def offsets(count: int, width: float = 0.5) -> list[float]:
    """Places of `count` things beside each other about zero, `width` from first to last."""
    if count == 1:
        return [0.0]
    return [width * (i / (count - 1) - 0.5) for i in range(count)]


def paper_key(*, policies: Sequence[str]) -> list[Line2D]:
    """Entries of a legend for the paper's marks of these of its two policies."""
    return [
        Line2D(
            [],
            [],
            linestyle="none",
            marker=_NAMED[name][1],
            markerfacecolor="white",
            markeredgecolor=style.PAPER,
            markeredgewidth=1.4,
            markersize=6.5,
            label=f"{PAPER_WORDS}, {name}",
        )
        for name in policies
    ]


def paper_mark(
    axes: Axes,
    x: float,
    y: float,
    *,
    policy: str,
    xerr: float | None = None,
    yerr: float | None = None,
) -> None:
    """Mean and standard deviation as the paper has them: an open mark of its own colour."""
    axes.errorbar(
        x,
        y,
        xerr=xerr,
        yerr=yerr,
        marker=_NAMED[policy][1],
        markersize=6.5,
        markerfacecolor="white",
        markeredgecolor=style.PAPER,
        markeredgewidth=1.4,
        ecolor=style.PAPER,
        elinewidth=1.4,
        capsize=3.0,
        linestyle="none",
        zorder=3,
    )
