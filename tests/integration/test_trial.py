"""A whole trial with a constructed policy: what is drawn, run, kept and refused."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from command_line import invoke
from hopper import ROBOT, write_hopper
from pronk.errors import ArtefactError, PronkError
from pronk.files import sha256
from pronk.jump.trial.jumps import measure_jump
from pronk.jump.trial.protocol import PAPER_COMMANDS, Case, parse_case
from pronk.jump.trial.results import TrialResults, load_results
from pronk.jump.trial.trial import (
    TrialPlan,
    TrialSetup,
    draw_run,
    load_subjects,
    prepare_folder,
    run_trial,
    setup_of,
)
from pronk.jump.virtual import capture
from pronk.jump.virtual.sim_params import SHIPPED, load_sim_params
from pronk.policy.script import STILL, Script
from pronk.processes import in_processes

pytest.importorskip("onnxruntime")

# A hop on the spot takes half a second; then it is watched for two.
SCRIPT = Script(command=STILL, stand_s=0.1, run_s=0.1, jump_s=0.14, keep_s=0.0, stop_s=2.4)
CASE = Case(name="forward 1", command=(1.0, 0.0, 0.0))
PLAN = TrialPlan(cases=(CASE,), jumps=1, script=SCRIPT, spread_s=0.1)
SIM_PARAMS = load_sim_params()


@pytest.fixture(scope="module")
def hopper(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_hopper(tmp_path_factory.mktemp("hopper") / "policy.onnx")


@pytest.fixture(scope="module")
def weak(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Trained with nominal gains; it jumps half as hard."""
    path = tmp_path_factory.mktemp("weak") / "policy.onnx"
    gains = {"stiffness": (17.0,) * 12, "damping": (0.4,) * 12}
    return write_hopper(path, 0.5, gains="naive", gains_sha256="", **gains)


def go(policies: list[Path], out: Path, **changes: Any) -> TrialResults:
    progress = changes.pop("progress", None)
    setup = TrialSetup(robot=ROBOT, sim_params=SIM_PARAMS, out=out, **changes)
    return run_trial(policies, PLAN, setup, progress=progress)


# --- What is drawn ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["mini_cheetah", "go2"])
def test_a_trial_names_the_shipped_parameters(name: str, tmp_path: Path) -> None:
    setup = setup_of(tmp_path / "policy.onnx", tmp_path, robot=name)
    assert setup.about["file"] == "shipped with pronk"
    assert setup.about["sha256"]
    assert setup.sim_params.robot == name


def test_every_jump_has_a_start_of_its_own() -> None:
    plan = TrialPlan(spread_s=0.5)
    runs = []
    for case in plan.cases:
        for number in range(30):
            runs.append(draw_run(plan, case, number, ROBOT))
    assert len({(run.start.yaw, run.start.joint_offset) for run in runs}) == len(runs)
    assert len({run.seed for run in runs}) == len(runs)
    # Whole policy steps, from none to all 25 of them.
    later = {round((run.script.run_s - 2.5) * 50, 6) for run in runs}
    assert {0, 25} <= later <= set(range(26))
    offsets = np.array([run.start.joint_offset for run in runs])
    assert offsets.min() == pytest.approx(-0.05, abs=0.01)
    assert offsets.max() == pytest.approx(0.05, abs=0.01)


def test_draws_depend_on_seed_command_and_number_alone() -> None:
    case = PAPER_COMMANDS[3]
    run = draw_run(TrialPlan(jumps=30), case, 1, ROBOT)
    few = TrialPlan(cases=(case,), jumps=2)
    assert draw_run(few, case, 1, ROBOT) == run
    assert draw_run(replace(few, seed=1), case, 1, ROBOT) != run


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"jumps": 0}, "0 jumps"),
        ({"seed": -1}, "seed -1"),
        ({"cases": ()}, "none"),
        ({"cases": PAPER_COMMANDS[:1] * 2}, "forward 1, forward 1"),
    ],
)
def test_impossible_plans_are_refused(changes: Any, message: str) -> None:
    with pytest.raises(PronkError, match=message):
        TrialPlan(**changes)


# --- Running ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def tried(hopper: Path, weak: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a trial of both, in one process."""
    out = tmp_path_factory.mktemp("tried")
    shares: list[float] = []
    go([hopper, weak], out, progress=shares.append, about={"sha256": "ab"})
    assert shares == pytest.approx([0.5, 1.0])
    return out


def test_the_number_of_processes_changes_no_digit(
    tried: Path, hopper: Path, weak: Path, tmp_path: Path
) -> None:
    go([hopper, weak], tmp_path, processes=2, about={"sha256": "ab"})
    assert (tmp_path / "trials.csv").read_bytes() == (tried / "trials.csv").read_bytes()
    summary = json.loads((tried / "summary.json").read_text())
    summary_of_two = json.loads((tmp_path / "summary.json").read_text())
    assert summary.pop("timing")["processes"] == 1
    assert summary_of_two.pop("timing")["processes"] == 2
    assert summary == summary_of_two


def test_a_trial_keeps_what_it_ran(tried: Path, hopper: Path) -> None:
    trial = load_results(tried)
    subject = trial.subjects[0]
    assert subject.name == "matched"
    assert subject.sha256 == sha256(hopper)
    assert subject.contract["gains_sha256"] == "0f" * 32
    assert trial.virtual
    assert trial.sim_params == {"sha256": "ab"}
    assert trial.mass == pytest.approx(12.0)
    assert trial.versions["mujoco"]
    # The hop is real, and half as hard is a lower one.
    strong = trial.cell("matched", CASE.name).figures["height"].mean
    half = trial.cell("naive", CASE.name).figures["height"].mean
    assert half < strong
    assert 0.2 < strong < 0.5
    # What is kept measures the same again.
    kept = sorted(path.name for path in (tried / "captures").iterdir())
    assert kept == ["matched_forward_1_000.npz", "naive_forward_1_000.npz"]
    for row in trial.rows:
        seen = capture.load_capture(tried / row.capture)
        again = measure_jump(seen, row.script, ROBOT, began=row.began)
        assert repr(again) == repr(row.figures)
    jump = trial.rows[0].figures
    assert jump.found
    # The trunk rises about as far as its lift-off velocity takes it.
    assert jump.flight.rise == pytest.approx(jump.flight.ballistic, abs=0.03)
    assert jump.flight.lift_off_velocity > 1.0
    assert jump.loads.peak_torque[2] > 15.0


def test_processes_keep_the_order_and_pass_errors_on() -> None:
    assert in_processes(abs, [-3, 2, -1]) == [3, 2, 1]
    with pytest.raises(PronkError, match="0 processes"):
        in_processes(abs, [1], processes=0)
    with pytest.raises(PronkError, match="-1,x"):
        in_processes(parse_case, ["1,0", "-1,x"], processes=2)


def test_processes_end_though_an_idle_one_was_stopped(tmp_path: Path) -> None:
    number = tmp_path / "pid"
    begun = tmp_path / "begun"
    commands = [
        f"echo $PPID > {number}; until [ -e {begun} ]; do sleep 0.05; done",
        f"touch {begun}; sleep 1; kill -STOP $(cat {number})",
    ]
    code = (
        "import os; from pronk.processes import in_processes; "
        f"assert in_processes(os.system, {commands!r}, processes=2) == [0, 0]"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120.0)


# --- What is refused before the first step ------------------------------------------------------


def test_policies_are_named_apart(hopper: Path, weak: Path, tmp_path: Path) -> None:
    matched, naive = load_subjects([hopper, weak], ROBOT)
    assert (matched.name, naive.name) == ("matched", "naive")
    other_file = write_hopper(tmp_path / "other.onnx", 0.7)
    policy, other = load_subjects([hopper, other_file], ROBOT)
    assert (policy.name, other.name) == ("policy", "other")
    with pytest.raises(PronkError, match="twice"):
        load_subjects([hopper, hopper], ROBOT)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"joint_names": tuple(reversed(ROBOT.joint_names))}, "joint_names"),
        ({"jump": False}, "walk only"),
        (None, "not a network"),
    ],
)
def test_a_policy_that_does_not_fit_is_refused(
    changes: dict[str, Any] | None, message: str, tmp_path: Path
) -> None:
    path = tmp_path / "policy.onnx"
    if changes is None:
        path.write_bytes(b"not a network")
    else:
        write_hopper(path, **changes)
    with pytest.raises(ArtefactError, match=message) as refusal:
        go([path], tmp_path / "out")
    assert str(path) in str(refusal.value)
    assert not (tmp_path / "out").exists()


def test_only_a_trial_is_overwritten(tmp_path: Path) -> None:
    prepare_folder(tmp_path / "new")
    assert (tmp_path / "new").is_dir()
    (tmp_path / "file").write_text("mine")
    for out, overwrite, message in (
        (tmp_path / "file", False, "a file"),
        (tmp_path, False, "not empty"),
        (tmp_path, True, "no trial"),
        (tmp_path / "file" / "below", False, "cannot be written to"),
    ):
        with pytest.raises(PronkError, match=message):
            prepare_folder(out, overwrite=overwrite)
    assert (tmp_path / "file").read_text() == "mine"
    old = tmp_path / "old"
    for name in ("trials.csv", "summary.json", "captures/a.npz", "videos/a.gif", "notes.txt"):
        (old / name).parent.mkdir(exist_ok=True, parents=True)
        (old / name).write_text("old")
    prepare_folder(old, overwrite=True)
    assert sorted(path.name for path in old.rglob("*")) == ["captures", "notes.txt", "videos"]


# --- The command --------------------------------------------------------------------------------


def test_the_command_writes_tables_page_and_figures(hopper: Path, tmp_path: Path) -> None:
    out = tmp_path / "trial"
    figures = tmp_path / "figures.json"
    words = ["trial", hopper, "--out", out, "--commands=0,-1", "--jumps", "1", "--processes", "1"]
    done = invoke([*words, "--no-video", "--definitions", "--json", figures])
    assert done.exit_code == 0, done.stderr
    for text in ("side -1", "paper, matched", "Definitions", str(out)):
        assert text in done.stdout
    body = json.loads(figures.read_text())
    assert body["virtual"] is True
    assert [cell["case"] for cell in body["cells"]] == ["side -1"]
    assert load_results(out).sim_params["file"] == "shipped with pronk"
    assert "Jumps beside those of the paper" in (out / "report.html").read_text(encoding="utf-8")
    assert not (out / "videos").exists()


def test_impossible_parameters_are_refused_before_the_first_step(
    hopper: Path, tmp_path: Path
) -> None:
    body = yaml.safe_load(SHIPPED.read_text(encoding="utf-8"))
    body["joints"]["FR_knee"]["rotor_inertia"] = -1.0
    params = tmp_path / "sim_params.yaml"
    params.write_text(yaml.safe_dump(body))
    for path, named in ((params, "rotor_inertia"), (tmp_path / "other.yaml", "other.yaml")):
        done = invoke(["trial", hopper, "--out", tmp_path / "out", "--sim-params", path])
        assert done.exit_code == 2
        assert named in done.stderr
    assert not (tmp_path / "out").exists()
