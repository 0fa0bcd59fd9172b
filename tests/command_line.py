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
class Done:
    exit_code: int
    stdout: str
    stderr: str

    @property
    def output(self) -> str:
        return self.stdout + self.stderr


def invoke(words: Sequence[str | Path], given: str = "") -> Done:
    out, err = io.StringIO(), io.StringIO()
    before, sys.stdin = sys.stdin, io.StringIO(given)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            status = run([str(word) for word in words])
    finally:
        sys.stdin = before
    return Done(status, out.getvalue(), err.getvalue())


def accepted(*words: str | Path) -> str:
    """Standard output of a command that succeeds."""
    done = invoke(words)
    assert done.exit_code == 0, done.stderr
    return done.stdout


def refused(*words: str | Path) -> str:
    """The one sentence of a command that is refused, on the last line of standard error."""
    done = invoke(words)
    assert done.exit_code == 2, done.output
    lines = done.stderr.strip().splitlines()
    sentences = [line for line in lines if line.startswith("pronk: ")]
    assert sentences == lines[-1:], done.stderr
    assert "Traceback" not in done.output
    return sentences[0]
