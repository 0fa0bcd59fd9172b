"""Records of a deployment as tests write them."""

from __future__ import annotations

from typing import Any

import numpy as np


def set_fields(record: np.ndarray | np.void, **values: Any) -> None:
    """Set fields of a record."""
    for name, value in values.items():
        record[name] = value
