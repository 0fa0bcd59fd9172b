"""`pronk drift`: verdicts of two matches, their coverage, exit statuses, refusals."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from chirp_logs import chirp_log
from command_line import invoke, refused
from log_files import write_mcap
from pronk.exit_status import ExitStatus
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match.drift import compare_gains, compare_values
from pronk.identify.match.gains import (
    FittedValue,
    GroupGains,
    JointGains,
    MatchedGains,
    save_gains,
)
from pronk.identify.match.match import match
from pronk.identify.simulators.info import SimulatorInfo
from pronk.robots import load_robot

PENDULUM = Path(__file__).resolve().parents[2] / "examples" / "pendulum"
STIFFNESS = 17.0
DAMPING = 0.4


def estimate(value: float, half_width: float) -> FittedValue:
    ends = (value - half_width, value + half_width)
    return FittedValue(value=value, repeat95=ends, total95=ends)


def joint(stiffness: FittedValue, damping: FittedValue, **more: object) -> JointGains:
    fields = {"armature": FittedValue(value=0.006), **more}
    return JointGains(stiffness=stiffness, damping=damping, **fields)  # type: ignore[arg-type]


def robot_gains(**joints: JointGains) -> MatchedGains:
    group = GroupGains(stiffness=17.0, damping=0.4, stiffness_range=1.0, damping_range=0.1)
    return MatchedGains(
        robot="rig",
        simulator=SimulatorInfo(profile="mjlab", version="3"),
        joints=joints,
        groups={"all": group},
    )


def test_two_estimates_of_one_value_are_outside_in_5_percent_or_fewer() -> None:
    """Intervals of Student's t over few repeats, as those of a match; unequal numbers and noise."""
    rng = np.random.default_rng(1)
    for old_repeats, new_repeats, noise in ((2, 2, 1.0), (3, 3, 1.0), (3, 6, 3.0), (20, 4, 0.3)):
        outside = 0
        for _ in range(4000):
            estimates = []
            for repeats, deviation in ((old_repeats, 1.0), (new_repeats, noise)):
                draws = 20.0 + deviation * rng.standard_normal(repeats)
                half = stats.t.ppf(0.975, repeats - 1) * draws.std(ddof=1) / math.sqrt(repeats)
                estimates.append(estimate(float(draws.mean()), float(half)))
            _, verdict = compare_values(*estimates, matters=2.0)
            outside += verdict == "outside"
        # 5 %, and three deviations of the count.
        assert outside / 4000 <= 0.05 + 3.0 * math.sqrt(0.05 * 0.95 / 4000)


@pytest.mark.parametrize("change", [0.2, -0.2])
def test_a_change_of_20_percent_is_outside_or_not_resolved(change: float) -> None:
    """Whatever the width of the intervals; a change that matters is 10 %."""
    rng = np.random.default_rng(2)
    for relative_width in (0.001, 0.02, 0.05, 0.0707, 0.08, 0.2, 1.0):
        half = 20.0 * relative_width
        within = 0
        for _ in range(2000):
            old = estimate(20.0 + half / 1.96 * rng.standard_normal(), half)
            new = estimate(20.0 * (1.0 + change) + half / 1.96 * rng.standard_normal(), half)
            _, verdict = compare_values(old, new, matters=2.0)
            within += verdict == "within"
        assert within / 2000 <= 0.025 + 3.0 * math.sqrt(0.025 / 2000)


def test_the_ends_that_face_each_other_count() -> None:
    old = FittedValue(value=10.0, total95=(9.9, 13.0))
    new = FittedValue(value=12.0, total95=(9.0, 12.1))
    # Up: +3 of the old one and -3 of the new one; down: -0.1 and +0.1.
    interval, verdict = compare_values(old, new, matters=5.0)
    assert interval == pytest.approx(math.hypot(3.0, 3.0))
    assert verdict == "within"
    interval, verdict = compare_values(new, old, matters=5.0)
    assert interval == pytest.approx(math.hypot(3.0, 3.0))
    back = FittedValue(value=9.0, total95=(5.0, 9.1))
    interval, verdict = compare_values(old, back, matters=5.0)
    assert interval == pytest.approx(math.hypot(0.1, 0.1))
    assert verdict == "outside"


def test_what_cannot_be_compared_is_not_resolved() -> None:
    sure = joint(estimate(20.0, 0.2), estimate(0.5, 0.005))
    held = joint(FittedValue(value=20.0), estimate(0.5, 0.005))
    unmatched = replace(sure, matched=False, reasons=("the base moved",))
    other_model = replace(sure, armature=FittedValue(value=0.009))
    old = robot_gains(a=sure, b=sure, c=sure, d=sure, gone=sure)
    new = robot_gains(a=sure, b=held, c=unmatched, d=other_model, fresh=sure)
    drift = compare_gains(old, new)
    verdicts: dict[str, list[str]] = {}
    for parameter in drift.parameters:
        verdicts.setdefault(parameter.joint, []).append(parameter.verdict)
    unresolved = ["not resolved", "not resolved"]
    assert verdicts == {
        "a": ["within", "within"],
        "b": ["not resolved", "within"],
        "c": unresolved,
        "d": unresolved,
    }
    assert "the base moved" in next(p.reason for p in drift.parameters if p.joint == "c")
    assert drift.only_old == ("gone",)
    assert drift.only_new == ("fresh",)
    assert not drift.outside


def test_friction_and_delay_are_compared_where_both_are_fitted() -> None:
    sure = joint(
        estimate(20.0, 0.2),
        estimate(0.5, 0.005),
        frictionloss=estimate(0.2, 0.02),
        delay_s=estimate(0.005, 0.0002),
    )
    worn = replace(sure, frictionloss=estimate(0.5, 0.02))
    parameters = compare_gains(robot_gains(a=sure), robot_gains(a=worn)).parameters
    assert {drift.parameter: drift.verdict for drift in parameters} == {
        "stiffness": "within",
        "damping": "within",
        "frictionloss": "outside",
        "delay": "within",
    }


def test_exit_statuses_and_figures(tmp_path: Path) -> None:
    files = {
        "sure": joint(estimate(20.0, 0.2), estimate(0.5, 0.005)),
        "weak": joint(estimate(16.0, 0.2), estimate(0.5, 0.005)),
        "vague": joint(estimate(20.0, 5.0), estimate(0.5, 0.005)),
    }
    for name, gains in files.items():
        save_gains(tmp_path / f"{name}.yaml", robot_gains(knee=gains))
    expected = {
        "sure": ExitStatus.DONE,
        "weak": ExitStatus.DRIFTED,
        "vague": ExitStatus.NOT_RESOLVED,
    }
    for name, status in expected.items():
        out = tmp_path / f"{name}.json"
        words = ["drift", tmp_path / "sure.yaml", tmp_path / f"{name}.yaml", "--json", out]
        command = invoke(words)
        assert command.exit_code == status, command.output
        figures = json.loads(out.read_text())
        stiffness = figures["parameters"][0]
        assert stiffness["joint"] == "knee"
        assert stiffness["change"] == pytest.approx(files[name].stiffness.value - 20.0)
    command = invoke(["drift", tmp_path / "sure.yaml", tmp_path / "vague.yaml", "--matters", "0.3"])
    assert command.exit_code == ExitStatus.DONE
    assert max(map(len, command.stdout.splitlines())) <= 120


def test_gains_that_are_not_of_one_joint_are_refused(tmp_path: Path) -> None:
    sure = joint(estimate(20.0, 0.2), estimate(0.5, 0.005))
    gains = robot_gains(knee=sure)
    other_law = replace(gains, simulator=replace(gains.simulator, law="implicit", iterations=4))
    other_step = replace(gains, simulator=replace(gains.simulator, timestep_s=0.002))
    save_gains(tmp_path / "old.yaml", gains)
    for name, later, word in (
        ("robot", replace(gains, robot="other"), "robots"),
        ("law", other_law, "simulators"),
        ("step", other_step, "simulators"),
        ("joints", robot_gains(hip=sure), "no joint"),
    ):
        save_gains(tmp_path / f"{name}.yaml", later)
        words = ("drift", tmp_path / "old.yaml", tmp_path / f"{name}.yaml")
        assert word in refused(*words)
    words = ("drift", tmp_path / "old.yaml", tmp_path / "old.yaml")
    assert "--matters" in refused(*words, "--matters", "0")
    assert "--robot" in refused(*words, "--robot", "go2")
    assert "no such file" in refused("drift", tmp_path / "none.yaml", tmp_path / "old.yaml")
    alone = refused("drift", tmp_path / "old.yaml")
    assert "old.yaml" in alone
    assert "later match" in alone


def test_simulated_pairs_of_sweeps(tmp_path: Path) -> None:
    """The same joint with other noise is not outside; one changed by 20 % never is within."""
    robot = load_robot(PENDULUM)
    (name,) = robot.joint_names

    def sweep(stiffness: float, damping: float, seed: int) -> JointLog:
        return chirp_log(
            robot, name, (stiffness, damping), repeats=2, noise_rad=1e-3, seed=seed, threads=1
        )

    earlier = match([sweep(STIFFNESS, DAMPING, 0)], robot).gains
    for seed in (1, 2):
        again = match([sweep(STIFFNESS, DAMPING, seed)], robot).gains
        assert not compare_gains(earlier, again).outside
    save_gains(tmp_path / "old.yaml", earlier)
    write_mcap(tmp_path / "fresh.mcap", sweep(0.8 * STIFFNESS, 1.2 * DAMPING, 3))
    words = ["drift", tmp_path / "old.yaml", tmp_path / "fresh.mcap", "--robot", PENDULUM]
    out = tmp_path / "new.yaml"
    command = invoke([*words, "--out", out, "--json", tmp_path / "drift.json"])
    assert command.exit_code in (ExitStatus.DRIFTED, ExitStatus.NOT_RESOLVED), command.output
    figures = json.loads((tmp_path / "drift.json").read_text())
    for parameter in figures["parameters"]:
        if parameter["parameter"] in ("stiffness", "damping"):
            assert parameter["verdict"] in ("outside", "not resolved")
    assert out.exists()
