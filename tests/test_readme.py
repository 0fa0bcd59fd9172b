"""The README's Python example runs as it stands, and its commands exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from pronk.match import gains

README = (Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8")


def test_the_example_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    assert len([line for line in code.splitlines() if line.strip()]) <= 20
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "README.md", "exec"), {})
    found = gains.load(tmp_path / "gains.yaml")
    assert found.virtual
    # What the virtual robot hides: the paper's Table I, FR knee.
    assert found.joints["FR_knee"].stiffness == pytest.approx(21.8, abs=2 * 14 / 49)
    assert found.joints["FR_knee"].damping == pytest.approx(0.541, abs=2 * 0.6 / 49)
    assert "FR_knee" in capsys.readouterr().out


def test_every_command_named_is_a_command() -> None:
    from pronk.cli.main import app

    known = {command.name for command in app.registered_commands} | {
        group.name for group in app.registered_groups
    }
    lines = re.findall(r"^pronk ([a-z]+)", README, flags=re.MULTILINE)
    inline = re.findall(r"`pronk ([a-z]+)", README)
    assert lines
    assert inline
    assert {*lines, *inline} <= known
