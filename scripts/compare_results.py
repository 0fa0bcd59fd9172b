"""Compare results of two commits: gains.yaml, grid.json and trials.csv, number by number.

    python scripts/compare_results.py OLD NEW [--tolerance 1e-6]

OLD and NEW are two files of the same kind. Prints the largest relative difference of each field
that differs, and exits with 1 if one exceeds the tolerance. Times and speeds are left out.
"""

from __future__ import annotations

import csv
import json
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
    """Yield each field that both have and its relative difference; texts are skipped."""
    if isinstance(old, dict) and isinstance(new, dict):
        for name in old.keys() & new.keys():
            yield from differences(old[name], new[name], str(name))
    elif isinstance(old, list) and isinstance(new, list):
        for one, other in zip(old, new, strict=True):
            yield from differences(one, other, field)
    elif old != new:
        try:
            a, b = float(old), float(new)
        except (TypeError, ValueError):
            return
        yield field, abs(a - b) / max(abs(a), 1e-9)


def main() -> None:
    """Compare two files."""
    old, new = (load(Path(path)) for path in sys.argv[1:3])
    tolerance = float(sys.argv[4]) if "--tolerance" in sys.argv else 1e-6
    worst: dict[str, float] = {}
    for field, size in differences(old, new):
        if not field.endswith(TIMES):
            worst[field] = max(worst.get(field, 0.0), size)
    for field, size in sorted(worst.items()):
        print(f"{field:50} {size:.1e}")
    sys.exit(any(size > tolerance for size in worst.values()))


if __name__ == "__main__":
    main()
