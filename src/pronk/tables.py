"""Tables of results, for the terminal, the pages and `--json` alike."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

Cell = str | int | float | tuple[float, float] | None
"""Text, a number, an interval as (lower, upper), or None where nothing was measured."""

NOT_MEASURED = "-"
"""Text of a cell without a finite number."""
HELD = "held"
"""Text of the interval of a value that was held and not fitted."""


@dataclass(frozen=True, kw_only=True)
class Column:
    """Heading of a column, and how its numbers are written."""

    heading: str
    unit: str = ""
    """Unit, written in brackets behind the heading; empty for text and counts."""
    digits: int = 3
    """Digits behind the decimal point."""
    is_detail: bool = False
    """True for a column that a terminal shows with --wide alone."""

    @property
    def title(self) -> str:
        """Heading with the unit, for instance `stiffness [N m/rad]`."""
        return f"{self.heading} [{self.unit}]" if self.unit else self.heading

    def text(self, cell: Cell) -> str:
        """Return the text of a cell.

        An interval of NaN, or without width, belongs to a value that was held and says so.
        """
        if cell is None:
            return NOT_MEASURED
        if isinstance(cell, str | int):
            return str(cell)
        if isinstance(cell, tuple):
            lower, upper = cell
            if lower == upper or math.isnan(lower) or math.isnan(upper):
                return HELD
            return f"{number(lower, self.digits)} to {number(upper, self.digits)}"
        return number(cell, self.digits)


@dataclass(frozen=True, kw_only=True)
class Table:
    """Rows of cells under headings."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    notes: tuple[str, ...] = ()
    """Sentences below the table."""
    is_detail: bool = False
    """True for a table that a terminal shows with --wide alone."""

    def __post_init__(self) -> None:
        """Refuse rows that do not have one cell for each column."""
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(
                    f"table {self.title!r}: a row has {len(row)} cells; expected "
                    f"{len(self.columns)}, one for each column."
                )

    def without_details(self) -> Table:
        """Return the table without the columns that are details."""
        kept = [index for index, column in enumerate(self.columns) if not column.is_detail]
        return self.with_columns(kept)

    def with_columns(self, indices: Sequence[int]) -> Table:
        """Return the table with these of its columns alone, in this order."""
        rows = []
        for row in self.rows:
            rows.append(tuple(row[index] for index in indices))
        columns = tuple(self.columns[index] for index in indices)
        return replace(self, columns=columns, rows=tuple(rows))

    def text_rows(self) -> list[list[str]]:
        """Return the cells as text, row by row."""
        text_rows = []
        for row in self.rows:
            text_row = []
            for column, cell in zip(self.columns, row, strict=True):
                text_row.append(column.text(cell))
            text_rows.append(text_row)
        return text_rows


def number(value: float, digits: int = 3) -> str:
    """Format a number; a dash where it is not finite."""
    return f"{value:.{digits}f}" if math.isfinite(value) else NOT_MEASURED


def counted(count: float, noun: str, plural: str = "") -> str:
    """Return a number with its noun, in the singular for 1 alone, as in "1 robot" and "2 robots".

    Args:
        count: The number.
        noun: The noun in the singular.
        plural: Its plural; with an s at the end if left out.
    """
    if count == 1:
        return f"1 {noun}"
    text = f"{count:,}" if isinstance(count, int) else f"{count:g}"
    return f"{text} {plural or noun + 's'}"


def percent(share: float) -> str:
    """Format a share between 0 and 1 in percent."""
    return number(100.0 * share, 1)
