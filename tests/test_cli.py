"""The command line: good input comes out as files and tables, bad input as one sentence."""

from __future__ import annotations

import io
import json
import os
import pickle
import re
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest

from pronk import cli
from pronk.errors import PronkError

COMMANDS = ("sweep", "response", "match", "predict", "export", "report", "bench", "demo")


def refused(capsys, *arguments: str | Path) -> str:
    """Run a command that must be refused; return its one sentence."""
    status = cli.run([str(a) for a in arguments])
    shown = capsys.readouterr()
    assert status == 2, shown
    lines = shown.err.strip().splitlines()
    said = [line for line in lines if line.startswith("pronk: ")]
    assert len(said) == 1, shown.err
    assert "Traceback" not in shown.err + shown.out
    assert said[0] == lines[-1], shown.err
    return said[0]


def accepted(capsys, *arguments: str | Path) -> str:
    status = cli.run([str(a) for a in arguments])
    shown = capsys.readouterr()
    assert status == 0, shown.err
    return shown.out


# --- The frame ----------------------------------------------------------------------------------


def test_help_names_every_command_and_is_fast():
    best = min(_timed_help() for _ in range(3))
    # Half a second on an idle machine; the others' share of it here is not pronk's doing.
    assert best < 1.5, f"{best:.2f} s"


def _timed_help() -> float:
    begin = time.process_time(), os.times().children_user + os.times().children_system
    done = subprocess.run(
        [sys.executable, "-m", "pronk.cli", "--help"], capture_output=True, text=True, check=True
    )
    for name in COMMANDS:
        assert re.search(rf"\b{name}\b", done.stdout), name
    now = os.times()
    return now.children_user + now.children_system - begin[1]


def test_help_loads_no_heavy_library():
    code = (
        "import sys, pronk.cli;"
        "print([m for m in ('numpy', 'scipy', 'matplotlib', 'mujoco', 'jinja2') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(capsys, command):
    shown = accepted(capsys, command, "--help")
    assert len(shown) > 200


@pytest.mark.parametrize("command", [c for c in COMMANDS if c != "bench"])
def test_every_command_takes_json(capsys, command):
    assert "--json" in accepted(capsys, command, "--help")


def test_misspelled_command_and_option_are_one_sentence(capsys):
    assert "mach" in refused(capsys, "mach")
    said = refused(capsys, "match", ".", "--robot", "mini_cheetah", "--grids", "3")
    assert "--grids" in said
    assert "pronk match --help" in said


def test_version(capsys):
    from pronk import __version__

    assert accepted(capsys, "--version").strip() == f"pronk {__version__}"


def test_a_defect_is_called_a_defect(capsys, monkeypatch):
    def broken(*_, **__):
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr(cli, "app", broken)
    assert cli.run(["report", "x"]) == 1
    shown = capsys.readouterr().err
    assert "This is a defect of pronk" in shown
    assert "Traceback" not in shown
    monkeypatch.setenv("PRONK_DEBUG", "1")
    assert cli.run(["report", "x"]) == 1
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("raised", "status"), [(PronkError("got this,\nexpected that."), 2), (KeyboardInterrupt(), 130)]
)
def test_exit_statuses(capsys, monkeypatch, raised, status):
    def stop(*_, **__):
        raise raised

    monkeypatch.setattr(cli, "app", stop)
    assert cli.run(["match"]) == status
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
