"""Tables of results: the text of their cells."""

from __future__ import annotations

import math

import pytest

from pronk.tables import Cell, Column, Table, counted


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


@pytest.mark.parametrize("count", [1, 1.0])
def test_one_alone_has_the_singular(count: float) -> None:
    assert counted(count, "policy", "policies") == "1 policy"


@pytest.mark.parametrize(
    ("count", "text"),
    [(0, "0 robots"), (2, "2 robots"), (1.5, "1.5 robots"), (4096, "4,096 robots")],
)
def test_every_other_number_has_the_plural(count: float, text: str) -> None:
    assert counted(count, "robot") == text
