"""A figure and the bar that it must clear."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

Sense = Literal["<=", ">="]


@dataclass(frozen=True, kw_only=True)
class Check:
    """One figure and its bar."""

    what: str
    value: float
    sense: Sense
    bar: float
    unit: str = ""

    @property
    def passed(self) -> bool:
        """Whether the figure clears the bar; NaN does not."""
        return self.value <= self.bar if self.sense == "<=" else self.value >= self.bar

    def row(self) -> dict[str, Any]:
        """As JSON has it."""
        return {**asdict(self), "passed": self.passed}
