"""The notebooks run from top to bottom, and say what is true."""

from __future__ import annotations

import io
import json
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import pytest

NOTEBOOKS = Path(__file__).resolve().parents[2] / "examples" / "notebooks"


def run(path: Path) -> tuple[dict[str, Any], str]:
    """Run the code of a notebook; return its names and what it printed."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    names: dict[str, Any] = {}
    printed = io.StringIO()
    with redirect_stdout(printed):
        for cell in cells:
            if cell["cell_type"] == "code":
                exec(compile("".join(cell["source"]), path.name, "exec"), names)
    return names, printed.getvalue()


def test_a_log_becomes_gains(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(NOTEBOOKS)
    names, printed = run(NOTEBOOKS / "log_to_gains.ipynb")
    # The truth in the drive law of Isaac Lab's implicit actuator (examples/csv_to_isaaclab).
    hip = names["result"].gains.joints["hip"]
    assert hip.stiffness.value == pytest.approx(27.4, rel=0.03)
    assert hip.damping.value == pytest.approx(0.717, rel=0.04)
    assert "ImplicitActuatorCfg" in printed


def test_the_match_matters(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(NOTEBOOKS)
    names, _ = run(NOTEBOOKS / "where_the_match_matters.ipynb")
    for replay in names["prediction"].joints:
        assert replay.rmse_matched < 0.5 * replay.rmse_nominal_delayed
