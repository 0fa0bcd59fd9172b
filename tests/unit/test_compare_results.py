"""The script that compares results: NaN, missing fields and other lengths are differences."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "compare_results.py"


@pytest.mark.parametrize(
    ("old", "new", "differ"),
    [
        ({"a": 1.0, "text": "x", "grid_s": 1.0}, {"a": 1.0 + 1e-9, "text": "y", "grid_s": 2.0}, 0),
        ({"a": 1.0}, {"a": 1.1}, 1),
        ({"a": 1.0}, {"a": float("nan")}, 1),
        ({"a": None}, {"a": 2.0}, 1),
        ({"a": None}, {"a": float("nan")}, 0),
        ({"a": 1.0}, {"a": 1.0, "b": 1.0}, 1),
        ({"a": [1.0, 2.0]}, {"a": [1.0]}, 1),
        ({"a": {"b": 1.0}}, {"a": 1.0}, 1),
    ],
)
def test_differences(tmp_path: Path, old: Any, new: Any, differ: int) -> None:
    files = [tmp_path / "old.json", tmp_path / "new.json"]
    for path, body in zip(files, (old, new), strict=True):
        path.write_text(json.dumps(body))
    assert subprocess.run([sys.executable, SCRIPT, *files], check=False).returncode == differ
