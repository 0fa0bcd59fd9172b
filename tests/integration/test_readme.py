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
LABELS = {"S": 7, "M": 5, "F": 13, "N": 3, "C": 4, "P": 2, "D": 10, "E": 7, "R": 8, "L": 4, "A": 23}
"""Items of the paper and readings of its unclear places, by their first letter."""


def test_the_example_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    monkeypatch.chdir(tmp_path)
    shutil.copytree(ROOT / "policies", "policies")
    # Two repeats give intervals, and a replay needs one excitation.
    sweep = ("sweep", "mini_cheetah", "--joints", "FR_knee", "--out")
    accepted(*sweep, "logs", "--repeats", "2")
    once = ("--repeats", "1", "--amplitude", ".25")
    accepted(*sweep, "fresh", "--signal", "log-chirp", "--seed", "1", *once)
    names: dict[str, Any] = {}
    exec(compile(code, "README.md", "exec"), names)
    knee = names["result"].gains.joints["FR_knee"]
    # The paper's Table I, from which the virtual robot's hidden parameters derive; two grid cells.
    assert knee.stiffness.value == pytest.approx(21.8, abs=2 * 14 / 49)
    assert knee.damping.value == pytest.approx(0.541, abs=2 * 0.6 / 49)
    (replay,) = names["replay"].joints
    assert replay.rmse_matched < 0.5 * replay.rmse_naive


def test_every_command_of_the_documentation_exists() -> None:
    pages = [README, *(page.read_text(encoding="utf-8") for page in (ROOT / "docs").glob("*.md"))]
    fenced = "\n".join(re.findall(r"```sh\n(.*?)```", "\n".join(pages), flags=re.DOTALL))
    named = {
        *re.findall(r"^pronk ([a-z]+)", fenced, flags=re.MULTILINE),
        *(name for page in pages for name in re.findall(r"`pronk ([a-z]+)", page)),
    }
    assert named <= {*COMMANDS, "robot"}
    assert set(COMMANDS) - {"demo"} <= named


@pytest.mark.parametrize("page", [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))])
def test_every_file_that_a_page_names_exists(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    named = re.findall(r"`((?:\w+/)+[\w.]+\.(?:py|yaml))`", text)
    missing = [n for n in named if not any((ROOT / at / n).exists() for at in ("", "src/pronk"))]
    links = re.findall(r"\]\(([^)#:]+)\)", text)
    missing += [link for link in links if not (page.parent / link).exists()]
    assert not missing


def test_the_readme_is_at_most_900_words() -> None:
    assert len(README.split()) <= 900


def test_the_tables_of_robots_and_formats_are_up_to_date() -> None:
    script = [sys.executable, str(ROOT / "scripts" / "readme_tables.py"), "--check"]
    assert subprocess.run(script, check=False).returncode == 0


def test_every_label_of_the_checklist_has_its_place() -> None:
    text = "".join(
        (ROOT / "docs" / name).read_text("utf-8") for name in ("paper.md", "readings.md")
    )
    found = set(re.findall(r"\b([A-Z]\d+)\b", text))
    for letter, first, last in re.findall(r"\b([A-Z])(\d+) to [A-Z](\d+)\b", text):
        found |= {f"{letter}{i}" for i in range(int(first), int(last) + 1)}
    wanted = {f"{letter}{i}" for letter, count in LABELS.items() for i in range(1, count + 1)}
    assert not wanted - found
