"""Tables in terminals of several widths: no line is longer, and nothing of a table is lost."""

from __future__ import annotations

import io
import os
import pty
import re
import shutil
import struct
import subprocess
import sys
import termios
from contextlib import redirect_stdout
from dataclasses import replace
from fcntl import ioctl
from pathlib import Path

import pytest

import report_cases
from documented_commands import ROOT
from pronk.cli import console
from pronk.jump.trial import tables
from pronk.tables import Column, Table

WIDTHS = (48, 80, 132)
RUN_ALL = """
import sys
from pronk.cli.main import run
statuses = [run(line.split()) for line in sys.argv[1:]]
sys.exit(max(statuses))
"""
"""Program that runs several command lines, so that Python starts once."""


def in_terminal(width: int, lines: list[str], folder: Path) -> str:
    """Run command lines in a terminal of a width; return what stands on it."""
    leader, follower = pty.openpty()
    ioctl(follower, termios.TIOCSWINSZ, struct.pack("HHHH", 40, width, 0, 0))
    environment = {**os.environ, "TERM": "xterm", "NO_COLOR": "1"}
    environment.pop("COLUMNS", None)
    with subprocess.Popen(
        [sys.executable, "-c", RUN_ALL, *lines],
        stdin=follower,
        stdout=follower,
        stderr=subprocess.DEVNULL,
        cwd=folder,
        env=environment,
    ) as process:
        os.close(follower)
        pieces = []
        while True:
            try:
                piece = os.read(leader, 65536)
            except OSError:  # Linux says so that the last program has left the terminal.
                break
            if not piece:
                break
            pieces.append(piece)
        os.close(leader)
    assert process.returncode == 0
    text = b"".join(pieces).decode().replace("\r\n", "\n")
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text)


def test_commands_fit_terminals(tmp_path: Path) -> None:
    lines = [
        "profiles --wide",
        "robot check mini_cheetah --wide",
        "log inspect chirp.csv --robot robot.yaml --yes",
        "response chirp.csv --robot robot.yaml --wide --no-plots",
    ]
    words = []
    for width in WIDTHS:
        folder = tmp_path / str(width)
        folder.mkdir()
        for name in ("chirp.csv", "leg.urdf", "robot.yaml"):
            shutil.copy(ROOT / "examples" / "csv_to_isaaclab" / name, folder / name)
        printed = in_terminal(width, lines, folder)
        for line in printed.splitlines():
            # What is copied, a command or a path, stays in one piece.
            if not line.startswith(("  pronk ", "wrote ")):
                assert len(line) <= width or " " not in line.strip(), line
        words.append(set(printed.replace("─", " ").split()))
    for other in words[1:]:
        assert other == words[0]


def long_tables() -> list[Table]:
    """Return tables of a trial with many commands, and one with long words."""
    folder_of_words = Table(
        title="A title of more words than the narrowest of the terminals has room for",
        columns=tuple(Column(heading=f"column {number}", unit="N m s/rad") for number in range(9)),
        rows=(("a_name_without_any_space_in_it", *range(8)), ("short", *("a b c" * 9,) * 8)),
        notes=("A note.",),
    )
    walks = report_cases.walks()
    return [
        folder_of_words,
        tables.walk_table(walks, walks.policy_names[0]),
        tables.crossing_table(report_cases.crossings()),
    ]


def text_of(table: Table, width: int, monkeypatch: pytest.MonkeyPatch, *, wide: bool) -> str:
    """Return a table, without its notes, as it is printed in so many columns."""
    monkeypatch.setenv("COLUMNS", str(width))
    text = io.StringIO()
    with redirect_stdout(text):
        console.show(replace(table, notes=()), wide=wide)
    return text.getvalue()


@pytest.mark.parametrize("wide", [False, True])
def test_tables_of_any_width_are_whole(
    wide: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trial = report_cases.write_trial(tmp_path)
    for table in [*tables.trial_tables(trial), *long_tables()]:
        whole = text_of(table, 2000, monkeypatch, wide=wide)
        for width in WIDTHS:
            printed = text_of(table, width, monkeypatch, wide=wide)
            for line in printed.splitlines():
                assert len(line.rstrip()) <= width, (table.title, line)
            assert set(printed.replace("─", " ").split()) == set(whole.replace("─", " ").split())


def test_wide_shows_what_is_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trial = report_cases.write_trial(tmp_path, cases=report_cases.CASES[:1])
    narrow = ""
    wide = ""
    for table in tables.trial_tables(trial):
        narrow += text_of(table, 80, monkeypatch, wide=False)
        wide += text_of(table, 80, monkeypatch, wide=True)
    assert set(narrow.replace("─", "").split()) < set(wide.replace("─", "").split())
    for joint in trial.joint_names:
        assert joint in wide
