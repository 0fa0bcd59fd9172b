"""The table of the paper's parts: every label has its place, every file and link exists."""

from __future__ import annotations

import re
from pathlib import Path

import pronk

SRC = Path(pronk.__file__).parent
DOCS = SRC.parents[1] / "docs"
LABELS = {"S": 7, "M": 5, "F": 13, "N": 3, "C": 4, "P": 2, "D": 10, "E": 7, "R": 8, "L": 4, "A": 23}


def test_every_label_of_the_checklist_has_its_place() -> None:
    text = "".join(
        (DOCS / name).read_text(encoding="utf-8") for name in ("paper.md", "readings.md")
    )
    found = set(re.findall(r"\b([A-Z]\d+)\b", text))
    for letter, first, last in re.findall(r"\b([A-Z])(\d+) to [A-Z](\d+)\b", text):
        found |= {f"{letter}{i}" for i in range(int(first), int(last) + 1)}
    wanted = {f"{letter}{i}" for letter, count in LABELS.items() for i in range(1, count + 1)}
    assert not wanted - found


def test_every_file_that_the_paper_page_names_exists() -> None:
    text = (DOCS / "paper.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`((?:[a-z_]+/)*[a-z_]+\.py)", text))
    assert len(named) > 40
    assert not [name for name in named if not (SRC / name).exists()]
    links = re.findall(r"\]\(([^)#]+)\)", text)
    assert not [link for link in links if not (DOCS / link).exists()]
