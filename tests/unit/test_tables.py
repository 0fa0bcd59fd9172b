"""Tables of results: the text of their cells."""

from __future__ import annotations

import math

import pytest

from pronk.tables import Cell, Column, Table


@pytest.mark.parametrize(
    ("cell", "expected"),
    [
        ("knee", "knee"),
        (12, "12"),
        (1.234, "1.23"),
        (math.nan, "-"),
        (None, "-"),
        ((1.0, 2.5), "1.00 to 2.50"),
        ((2.0, 2.0), "held"),
        ((math.nan, math.nan), "held"),
    ],
)
def test_a_cell_is_written_with_the_digits_of_its_column(cell: Cell, expected: str) -> None:
    assert Column(heading="stiffness", unit="N m/rad", digits=2).text(cell) == expected


def test_a_row_has_one_cell_for_each_column() -> None:
    columns = (Column(heading="joint"), Column(heading="stiffness", unit="N m/rad"))
    with pytest.raises(ValueError, match="1 cells"):
        Table(title="Gains", columns=columns, rows=(("knee",),))


def test_the_heading_names_the_unit() -> None:
    assert Column(heading="stiffness", unit="N m/rad").title == "stiffness [N m/rad]"
    assert Column(heading="jumps").title == "jumps"
