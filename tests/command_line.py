"""Run a command line in this process and keep what it prints."""

from __future__ import annotations

import contextlib
import io
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pronk.cli.main import run


@dataclass(frozen=True)
class FinishedCommand:
    exit_code: int
    stdout: str
    stderr: str

    @property
    def output(self) -> str:
        return self.stdout + self.stderr


def invoke(words: Sequence[str | Path], typed: str = "") -> FinishedCommand:
    """Run `pronk` with some words; `typed` is what a person types."""
    stdout = io.StringIO()
    stderr = io.StringIO()
    stdin = sys.stdin
    sys.stdin = io.StringIO(typed)
    try:
        with contextlib.redirect_stdout(stdout), contextlib.redirect_stderr(stderr):
            status = run([str(word) for word in words])
    finally:
        sys.stdin = stdin
    return FinishedCommand(status, stdout.getvalue(), stderr.getvalue())


def accepted(*words: str | Path) -> str:
    """Return the standard output of a command that succeeds."""
    command = invoke(words)
    assert command.exit_code == 0, command.stderr
    return command.stdout


def refused(*words: str | Path) -> str:
    """Return the one sentence of a command that is refused, on the last line of standard error."""
    command = invoke(words)
    assert command.exit_code == 2, command.output
    lines = command.stderr.strip().splitlines()
    sentences = [line for line in lines if line.startswith("pronk: ")]
    assert sentences == lines[-1:], command.stderr
    assert "Traceback" not in command.output
    return sentences[0]
