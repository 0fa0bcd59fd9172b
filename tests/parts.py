"""Where a vector that is made of named parts has each of them."""

from __future__ import annotations

from collections.abc import Mapping


def where(sizes: Mapping[str, int], name: str) -> slice:
    """The stretch of a part, by the parts' sizes in order."""
    start = sum(list(sizes.values())[: list(sizes).index(name)])
    return slice(start, start + sizes[name])
