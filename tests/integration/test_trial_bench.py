"""The bench of the trial: the bare loop is the very same run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks import trial as bench
from hopper import ROBOT, write_hopper
from pronk.errors import PronkError
from pronk.evaluation.protocol import Case
from pronk.evaluation.trial import Job, Plan, load_subjects, plan_jobs, run_job
from pronk.runtime.script import STILL, Script
from pronk.virtual.sim_params import load_sim_params

SCRIPT = Script(command=STILL, stand_s=0.1, run_s=0.1, jump_s=0.14, keep_s=0.0, stop_s=0.4)


@pytest.fixture
def job(tmp_path: Path) -> Job:
    pytest.importorskip("onnxruntime")
    subjects = load_subjects([write_hopper(tmp_path / "policy.onnx")], ROBOT)
    plan = Plan(cases=(Case(name="spot", command=STILL),), jumps=1, script=SCRIPT, spread_s=0.0)
    [(_, job)] = plan_jobs(subjects, plan, robot=ROBOT, sim_params=load_sim_params(), out=tmp_path)
    return replace(job, keep=None)


def test_the_tape_replays_the_run_to_the_last_bit(job: Job) -> None:
    taped = bench.tape(job)
    # Settling, and the script; the last command's tick ends it.
    seconds = job.start.settle_s + SCRIPT.seconds
    assert taped.steps * taped.timestep_s == pytest.approx(seconds, abs=0.03)
    assert taped.replay() > 0.0
    # A tape that was meddled with is found out.
    steps, control, motors = taped.blocks[-1]
    taped.blocks[-1] = (steps - 1, control, motors)
    with pytest.raises(PronkError, match="another state"):
        taped.replay()


def test_taping_changes_nothing(job: Job) -> None:
    before = run_job(job).figures
    bench.tape(job)
    after = run_job(job).figures
    assert repr(before) == repr(after)


def test_ratios_are_of_neighbouring_runs() -> None:
    found = bench.TrialBench(
        policy="matched",
        sha256="0" * 64,
        case=bench.CASE,
        simulated_s=10.0,
        steps=40_000,
        timestep_s=0.25e-3,
        trial_s=(2.0, 4.0, 2.5),
        bare_s=(1.0, 2.8, 2.0),
    )
    assert found.ratios == pytest.approx((0.5, 0.7, 0.8))
    assert found.ratio == pytest.approx(0.7)
    assert found.speed == pytest.approx(4.0)
    assert found.bare_speed == pytest.approx(5.0)
    assert found.passed
    assert not replace(found, bare_s=(1.0, 1.0, 1.0)).passed
    figures = found.figures()
    assert figures["bar"] == bench.BAR
    assert np.isclose(figures["ratio"], 0.7)
