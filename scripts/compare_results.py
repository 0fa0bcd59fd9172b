"""Compare results of two commits: gains.yaml, grid.json and trials.csv, number by number.

    python scripts/compare_results.py OLD NEW [--tolerance 1e-6]

OLD and NEW are two files of the same kind. Prints the largest relative difference of each field
that differs, and exits with 1 if one exceeds the tolerance. A field, row or number that only one
file has differs by `inf`. Texts, times and speeds are left out.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

TIMES = ("_s", "seconds", "per_second", "ratio", "memory_mb")


def load(path: Path) -> Any:
    """Read a YAML, JSON or CSV file."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".csv":
        return list(csv.DictReader(text.splitlines()))
    return json.loads(text) if path.suffix == ".json" else yaml.safe_load(text)


def differences(old: Any, new: Any, field: str = "") -> Iterator[tuple[str, float]]:
    """Yield each field that differs and its relative difference."""
    if isinstance(old, dict) and isinstance(new, dict):
        for name in old.keys() ^ new.keys():
            yield str(name), math.inf
        for name in old.keys() & new.keys():
            yield from differences(old[name], new[name], str(name))
    elif isinstance(old, list) and isinstance(new, list):
        if len(old) != len(new):
            yield field, math.inf
        for one, other in zip(old, new, strict=False):
            yield from differences(one, other, field)
    elif old != new:
        size = relative(old, new)
        if size > 0.0:
            yield field, size


def relative(old: Any, new: Any) -> float:
    """Return the relative difference of two values; 0 for two texts or two missing numbers."""
    a, b = number(old), number(new)
    if a is None and b is None:
        return 0.0
    if a is None or b is None:
        return math.inf
    if math.isnan(a) and math.isnan(b):
        return 0.0
    size = abs(a - b) / max(abs(a), 1e-9)
    return math.inf if math.isnan(size) else size


def number(value: Any) -> float | None:
    """Return a number, NaN where it is missing in the file, None for anything else."""
    if value is None or value == "":
        return math.nan
    try:
        return float(value)
    except (TypeError, ValueError):
        return None


def main() -> None:
    """Compare two files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("old", type=Path)
    parser.add_argument("new", type=Path)
    parser.add_argument("--tolerance", type=float, default=1e-6)
    given = parser.parse_args()
    worst: dict[str, float] = {}
    for field, size in differences(load(given.old), load(given.new)):
        if not field.endswith(TIMES):
            worst[field] = max(worst.get(field, 0.0), size)
    for field, size in sorted(worst.items()):
        print(f"{field:50} {size:.1e}")
    sys.exit(any(size > given.tolerance for size in worst.values()))


if __name__ == "__main__":
    main()
