"""The source stays readable: rates of packed statements, vague names, introspection."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from scripts import plain_code

ROOT = Path(__file__).resolve().parents[2]
SOURCE = ROOT / "src"
LAZY_TOP_LEVEL = "src/pronk/__init__.py"
"""The one module that may import names when they are first used."""


@pytest.mark.parametrize("folder", ["src", "tests"])
def test_rates_are_at_the_bars_or_below(folder: str) -> None:
    total = plain_code.count(ROOT / folder)
    rates = total.rates()
    above = {name: rates[name] for name, bar in plain_code.BARS.items() if rates[name] > bar}
    assert not above
    assert total.vague_percent() <= plain_code.VAGUE_NAMES_BAR


def test_no_field_is_read_or_set_by_a_computed_name() -> None:
    places = []
    for place in plain_code.introspection(SOURCE):
        if LAZY_TOP_LEVEL not in place:
            places.append(place)
    assert not places


def test_public_names_have_one_meaning() -> None:
    assert not plain_code.repeated_names(SOURCE)


def test_dataclasses_have_few_fields() -> None:
    assert not plain_code.large_dataclasses(SOURCE)


def test_the_counts_are_those_of_a_small_module(tmp_path: Path) -> None:
    path = tmp_path / "module.py"
    path.write_text(
        '"""Docstring.\n\nOf three lines."""\n'
        "\n"
        "# A comment.\n"
        "a, b = 1, 2\n"
        "found = [x for x in [y for y in range(3)]]\n"
        "if (n := len(found)) > 2:\n"
        "    print(n)\n"
    )
    total = plain_code.count(path)
    assert total.code_lines == 4
    assert total.comprehensions == 2
    assert total.nested_comprehensions == 1
    assert total.packed_assignments == 1
    assert total.assignment_expressions == 1
    assert total.vague_names == 1
    assert total.names == 6  # a, b, found, x, y, n


def test_the_script_prints_a_row_for_each_path() -> None:
    script = [sys.executable, str(ROOT / "scripts" / "plain_code.py"), "src/pronk/policy"]
    process = subprocess.run(script, cwd=ROOT, capture_output=True, text=True, check=True)
    assert "src/pronk/policy" in process.stdout
