"""Series of trainings: what a job is, which run is best, and what is kept of one."""

from __future__ import annotations

import json
import tarfile
from pathlib import Path
from typing import Any

import pytest

from tools_folder import load_tool


@pytest.fixture(scope="module")
def tool() -> Any:
    return load_tool("train_series")


def finished(out: Path, name: str, passed: int, source: str) -> None:
    """A run that passes so many of four bars in its trial."""
    run = out / name
    run.mkdir()
    checks = [{"passed": i < passed} for i in range(4)]
    (run / "trial.json").write_text(json.dumps({"checks": checks}))
    (run / "source").write_text(source)
    (run / "policy.onnx").write_bytes(b"network")
    (run / "model_50.pt").write_bytes(b"state")
    (out / f"{name}.tgz").write_bytes(b"")


def test_a_job(tool: Any) -> None:
    here = str(tool.ROOT / "src")
    assert tool.Job.parse("m1:1:matched") == tool.Job("m1", "1", "matched", here)
    assert tool.Job.parse("n:3:naive:/a:b") == tool.Job("n", "3", "naive", "/a:b")


@pytest.mark.parametrize("text", ["m1:1:neither", "m1:one:matched", ":1:matched"])
def test_what_is_no_job_is_refused(tool: Any, text: str) -> None:
    with pytest.raises(ValueError, match="expected NAME:SEED:matched or NAME:SEED:naive"):
        tool.Job.parse(text)


def test_the_best_passes_most_bars_of_its_trial(tool: Any, tmp_path: Path) -> None:
    finished(tmp_path, "a", 2, "/a")
    finished(tmp_path, "b", 3, "/b")
    finished(tmp_path, "c", 2, "/c")
    (tmp_path / "d.failed").write_text("out of memory")
    assert tool.best(tmp_path, ["a", "b", "c", "d"]) == "/b"
    assert tool.best(tmp_path, ["a", "c"]) == "/a", "the first of equals"
    said = (tmp_path / "best-of-a-b-c-d.txt").read_text()
    assert said == "b {'a': 2, 'b': 3, 'c': 2, 'd': 0}\n"


def test_a_run_under_way_is_waited_for(tool: Any, tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a.log").write_text("iteration 3")
    assert not tool.over(tmp_path, "a")
    (tmp_path / "a.failed").write_text("")
    assert tool.over(tmp_path, "a")


def test_policies_figures_and_curves_are_kept(tool: Any, tmp_path: Path) -> None:
    finished(tmp_path, "a", 3, "/a")
    tool.keep(tmp_path / "a", tmp_path / "kept.tgz")
    with tarfile.open(tmp_path / "kept.tgz") as archive:
        assert sorted(archive.getnames()) == ["a/policy.onnx", "a/source", "a/trial.json"]
    assert not (tmp_path / "kept.aside").exists()
