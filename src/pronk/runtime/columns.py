"""Messages of one topic as columns of numbers, taken in chunk by chunk.

A log is long and its text is ten times as large as its numbers: so each chunk's text is parsed,
copied into arrays and forgotten before the next one is read.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import orjson
from numpy.typing import DTypeLike, NDArray

_FIRST = 1024
"""Rows that a column has room for at first."""
_GROWTH = 1.5


@dataclass(frozen=True, kw_only=True)
class Field:
    """Where a column's numbers come from."""

    topic: str
    key: str
    """Of the messages' objects."""
    shape: tuple[int, ...] = ()
    """Of one message's value."""
    dtype: DTypeLike = np.float64


class Column:
    """Rows of numbers, with room for more."""

    def __init__(self, shape: tuple[int, ...], dtype: DTypeLike) -> None:
        """Begin without rows."""
        # Pages that are never written to cost no memory.
        self._room: NDArray[Any] = np.empty((_FIRST, *shape), dtype)
        self.count = 0
        """Rows so far."""

    def extend(self, rows: Sequence[Any]) -> None:
        """Add rows; None among numbers becomes NaN.

        Raises:
            TypeError: Something is no number.
            ValueError: Something is no number, or a row has another shape.
        """
        new = np.array(rows, dtype=self._room.dtype)
        if new.shape[1:] != self._room.shape[1:]:
            raise ValueError(f"rows of the shape {new.shape[1:]}")
        end = self.count + len(new)
        if end > len(self._room):
            more = np.empty((max(end, int(_GROWTH * len(self._room))), *new.shape[1:]), new.dtype)
            more[: self.count] = self.rows(self.count)
            self._room = more
        self._room[self.count : end] = new
        self.count = end

    def rows(self, most: int) -> NDArray[Any]:
        """The first rows, `most` of them or as many as there are, where they lie."""
        return self._room[: min(most, self.count)]


class Columns:
    """Columns of several topics; messages of which nothing is wanted are counted, not parsed."""

    def __init__(self, fields: Mapping[str, Field], wanted: Collection[str]) -> None:
        """Begin without rows.

        Args:
            fields: Name of a column to where it comes from.
            wanted: Those to fill; the others stay without rows.
        """
        self._columns = {name: Column(of.shape, of.dtype) for name, of in fields.items()}
        self._of: dict[str, list[tuple[str, Column]]] = {}
        for name in wanted:
            of = fields[name]
            self._of.setdefault(of.topic, []).append((of.key, self._columns[name]))
        self.counts: dict[str, int] = {}
        """Messages of each topic so far."""

    def take(self, chunk: Mapping[str, Sequence[bytes]]) -> None:
        """Take in the messages of a chunk, JSON, by topic.

        Raises:
            KeyError: A message lacks a field.
            TypeError: A field is no number.
            ValueError: A field is no number or has another shape, or a message is no JSON.
        """
        for topic, messages in chunk.items():
            self.counts[topic] = self.counts.get(topic, 0) + len(messages)
            wanted = self._of.get(topic)
            if wanted is None or not messages:
                continue
            # One parse for all of them: four times faster than one by one.
            rows = orjson.loads(b"[" + b",".join(messages) + b"]")
            for key, column in wanted:
                column.extend([row[key] for row in rows])

    def arrays(self, counts: Mapping[str, int]) -> dict[str, NDArray[Any]]:
        """The columns by name.

        Args:
            counts: Column to how many of its rows at most.
        """
        return {name: column.rows(counts[name]) for name, column in self._columns.items()}
