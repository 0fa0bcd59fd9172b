"""What the servo tells the operator: mode, faults, refusals, and all else that happens."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np


@dataclass(frozen=True, kw_only=True)
class Notice:
    """Something that the servo tells the operator."""

    time: float
    """CLOCK_MONOTONIC [s]."""
    kind: str
    """`mode`, `fault`, `refused`, `notice`, `lost`, `system` or `robot`."""
    text: str
    level: int
    """A `Level`."""

    @classmethod
    def of(cls, record: np.void) -> Self:
        """The notice in a record of `pronk.runtime.records.EVENT`."""
        return cls(
            time=float(record["time"]),
            kind=bytes(record["kind"]).decode("ascii"),
            text=bytes(record["text"]).decode("ascii"),
            level=int(record["level"]),
        )
