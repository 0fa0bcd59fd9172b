"""Pages of the documentation are short, in the site, and have figures that are up to date."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
LONGEST = 900
"""Words of a page, evidence apart: what a reader takes in within five minutes."""
LONGEST_README = 500


def words(path: Path) -> int:
    """Return how many words a page has."""
    return len(path.read_text(encoding="utf-8").split())


@pytest.mark.parametrize("page", sorted(DOCS.glob("*.md")), ids=lambda page: page.name)
def test_a_page_for_users_is_short(page: Path) -> None:
    assert words(page) <= LONGEST


def test_the_readme_is_short() -> None:
    assert words(ROOT / "README.md") <= LONGEST_README


def test_every_page_is_in_the_site() -> None:
    settings = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    listed = set(re.findall(r"[\w/-]+\.md", yaml.safe_dump(settings["nav"])))
    pages = {str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md")}
    assert listed == pages


def test_every_figure_is_drawn_by_a_script() -> None:
    drawn = set()
    for script in (ROOT / "scripts").glob("*.py"):
        drawn |= set(re.findall(r"[\w-]+\.(?:svg|png|gif)", script.read_text(encoding="utf-8")))
    stored = {path.name for path in DOCS.rglob("*") if path.suffix in (".svg", ".png", ".gif")}
    assert stored <= drawn


def test_the_figures_of_the_concepts_are_up_to_date() -> None:
    script = [sys.executable, str(ROOT / "scripts" / "docs_figures.py"), "--check"]
    finished = subprocess.run(script, check=False, capture_output=True, text=True)
    assert finished.returncode == 0, finished.stdout
