"""Several trainings at once on Warp's CPU device: interrupted, gone on with, one of them broken."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

pytest.importorskip("torch")
pytest.importorskip("mjlab")
from command_line import invoke
from pronk.jump.train.provenance import RunFolder
from pronk.jump.train.rl import checkpoint
from pronk.policy.runtime import load_policy
from pronk.signals import interrupt
from termination import terminated

pytestmark = pytest.mark.train

WORDS = (
    *("train", "walk", "--gains", "naive", "--seeds", "1-2", "--device", "cpu", "--jobs", "2"),
    *("--envs", "4", "--save-interval", "1", "--phase", "walk=6"),
)
"""So many iterations that neither is over when the other one, which may start seconds later on a
busy machine, has its first checkpoint."""


def test_interrupted_trainings_go_on_and_a_broken_one_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "runs"
    first = RunFolder(out / "trainings" / "naive" / "seed-1")
    second = RunFolder(out / "trainings" / "naive" / "seed-2")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")

    def both_have_checkpoints() -> bool:
        latest = checkpoint.latest_checkpoint
        return latest(first.path) is not None and latest(second.path) is not None

    with terminated(both_have_checkpoints, interrupt):
        stopped = invoke([*WORDS, "--out", out])
    assert stopped.exit_code == 130, stopped.output
    assert "next:" in stopped.output
    for folder in (first, second):
        assert folder.read()["sessions"][-1]["stopped"] == "SIGTERM"

    # The second one cannot go on; the first one can.
    second.checkpoint().write_bytes(b"no checkpoint")
    again = invoke([*WORDS, "--out", out])
    assert again.exit_code == 2, again.output
    assert "naive, seed 2: failed" in again.output
    assert "not a checkpoint" in again.output
    assert len(second.read()["sessions"]) == 1, "it did not begin"
    record = first.read()
    assert record["finished"]
    assert record["settings"]["seed"] == 1
    assert len(record["sessions"]) == 2
    policy = load_policy(first.path / "policy.onnx")
    summary = json.loads((out / "trainings.json").read_text())
    assert summary["schema"] == "pronk/trainings/1"
    (arm,) = summary["arms"]
    done, broken = arm["trainings"]
    assert (done["seed"], done["state"]) == (1, "done")
    assert done["policy_sha256"] == policy.sha256
    assert done["steps_per_second"] > 0.0
    assert (broken["seed"], broken["state"], broken["attempts"]) == (2, "failed", 2)
    assert arm["spread_over_seeds"]["seconds"]["n"] == 1
    assert arm["spread_over_seeds"]["steps_per_second"]["mean"] > 0.0
