"""README and docs: the Python example runs, commands, files and links exist, labels are there."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from command_line import accepted
from pronk.cli.main import COMMANDS

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
LABELS = {"S": 7, "M": 5, "F": 13, "N": 3, "C": 4, "P": 2, "D": 10, "E": 7, "R": 8, "L": 4, "A": 23}
"""Items of the paper and readings of its unclear places, by their first letter."""


def test_the_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (DOCS / "python.md").read_text(encoding="utf-8")
    code = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)[0]
    monkeypatch.chdir(tmp_path)
    shutil.copytree(ROOT / "policies", "policies")
    # Two repeats give intervals, and a replay needs one excitation.
    sweep = ("sweep", "mini_cheetah", "--joints", "FR_knee", "--amplitude", ".25", "--out")
    accepted(*sweep, "logs", "--repeats", "2")
    accepted(*sweep, "fresh", "--signal", "log-chirp", "--seed", "1", "--repeats", "1")
    names: dict[str, Any] = {}
    exec(compile(code, "python.md", "exec"), names)
    knee = names["result"].gains.joints["FR_knee"]
    # The paper's Table I, from which the virtual robot's hidden parameters derive; two grid cells.
    assert knee.stiffness.value == pytest.approx(21.8, abs=2 * 14 / 49)
    assert knee.damping.value == pytest.approx(0.541, abs=2 * 0.6 / 49)
    (replay,) = names["replay"].joints
    assert replay.rmse_matched < 0.5 * replay.rmse_nominal


def test_every_command_of_the_documentation_exists() -> None:
    text = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    fenced = "\n".join(re.findall(r"```sh\n(.*?)```", text, flags=re.DOTALL))
    documented = set(re.findall(r"^pronk ([a-z]+)", fenced, flags=re.MULTILINE))
    documented |= set(re.findall(r"`pronk ([a-z]+)", text))
    assert documented <= set(COMMANDS)
    assert set(COMMANDS) - {"demo"} <= documented


def test_the_page_of_commands_lists_those_of_the_help() -> None:
    table = (DOCS / "commands.md").read_text(encoding="utf-8")
    listed = re.findall(r"^\| `pronk ([a-z]+)", table, flags=re.MULTILINE)
    # A command with several forms has a row each.
    assert list(dict.fromkeys(listed)) == list(COMMANDS)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_file_that_a_page_names_exists(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    missing = []
    for name in re.findall(r"`((?:\w+/)+[\w.]+\.(?:py|yaml))`", text):
        if not (ROOT / name).exists() and not (ROOT / "src" / "pronk" / name).exists():
            missing.append(name)
    for link in re.findall(r"\]\(([^)#:]+)\)", text):
        if not (page.parent / link).exists():
            missing.append(link)
    assert not missing


def test_the_tables_of_robots_and_formats_are_up_to_date() -> None:
    script = [sys.executable, str(ROOT / "scripts" / "readme_tables.py"), "--check"]
    assert subprocess.run(script, check=False).returncode == 0


def test_every_label_of_the_checklist_has_its_place() -> None:
    text = ""
    for name in ("paper.md", "readings.md"):
        text += (DOCS / "evidence" / name).read_text(encoding="utf-8")
    labels = set(re.findall(r"\b([A-Z]\d+)\b", text))
    for letter, first, final in re.findall(r"\b([A-Z])(\d+) to [A-Z](\d+)\b", text):
        labels |= {f"{letter}{number}" for number in range(int(first), int(final) + 1)}
    missing = []
    for letter, count in LABELS.items():
        for number in range(1, count + 1):
            if f"{letter}{number}" not in labels:
                missing.append(f"{letter}{number}")
    assert not missing
