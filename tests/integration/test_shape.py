"""Filtered commands: a real drive of the virtual robot that responds like a simulated joint."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.signal import tf2zpk

from command_line import accepted, refused
from pronk.deploy.bench.virtual_sweep import sweep_virtual
from pronk.identify.excitation.plan import make_plan
from pronk.identify.excitation.signals import Chirp
from pronk.identify.match.shape import Prefilter, Shaped
from pronk.jump.virtual.sim_params import load_sim_params
from pronk.robots import load_robot

ROBOT = load_robot("mini_cheetah")


def swept(out: Path, joint: str, amplitude: float) -> Path:
    plan = make_plan(ROBOT, [joint], Chirp(length_s=12.0), amplitudes=(amplitude,), repeats=2)
    sweep_virtual(plan, load_sim_params(None, ROBOT), out)
    return out


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return swept(tmp_path_factory.mktemp("sweep"), "FL_knee", 0.2)


def test_the_shaped_joint_responds_like_the_simulated_one(logs: Path, tmp_path: Path) -> None:
    out, figures = tmp_path / "shape.yaml", tmp_path / "figures.json"
    wanted = ("--like", "isaaclab-implicit", "--sim-gains", "knee=17,.4")
    accepted(
        *("shape", logs, "--robot", "mini_cheetah", *wanted, "--verify"),
        *("--out", out, "--json", figures),
    )
    found = json.loads(figures.read_text())["joints"]["FL_knee"]
    magnitude, error, late = found["measured_after"]
    assert magnitude < 0.5 * found["before_db"]
    assert error < 0.5 * found["before_error"]
    assert error == pytest.approx(found["after_error"], abs=0.02)
    assert late == pytest.approx(found["delay_s"], abs=1e-3)
    assert found["worst_case"]["torque_share"] < 1.0
    written = yaml.safe_load(out.read_text())["joints"]["FL_knee"]
    _, poles, _ = tf2zpk(written["numerator"], written["denominator"])
    assert np.abs(poles).max() < 1.0
    assert sum(written["numerator"]) == pytest.approx(sum(written["denominator"]))


def test_what_the_drive_cannot_do_is_refused(logs: Path, tmp_path: Path) -> None:
    small = swept(tmp_path / "small", "FR_knee", 0.04)
    for folder, options, words in (
        (logs, ("--sim-gains", "knee=60,.6"), "times the torque"),
        (logs, (), "--sim-gains"),
        (logs, ("--sim-gains", "hip_roll=17,.4"), "--sim-gains"),
        (logs, ("--sim-gains", "knee=17,.4", "--like", "isaac"), "isaaclab-newton"),
        (small, ("--sim-gains", "knee=400,.4"), "at most 25 %"),
    ):
        common = ("shape", folder, "--robot", "mini_cheetah", "--out", tmp_path / "shape.yaml")
        assert words in refused(*common, *options)
    assert not (tmp_path / "shape.yaml").exists()


def test_a_filter_keeps_the_pose_and_its_signal_ends_at_rest() -> None:
    numbers = dict.fromkeys(Prefilter.__dataclass_fields__, 0.0)
    one = Prefilter(
        **(numbers | {"numerator": (0.9, -0.5, 0.2), "denominator": (1.0, -0.7, 0.3)})  # type: ignore[arg-type]
    )
    assert one.apply(np.full(100, -0.8)) == pytest.approx(np.full(100, -0.8))
    assert one.response(np.zeros(1), 50.0)[0] == pytest.approx(1.0)
    signal = Shaped(prefilter=one, amplitude=0.1)
    samples, raw = signal.samples(50.0), signal.requested(50.0)
    assert len(samples) == len(raw) == len(signal.frequency(50.0))
    assert samples[0] == samples[-1] == 0.0
    assert np.abs(raw).max() == pytest.approx(0.1, rel=0.05)
    hz, tick = 2.0, np.arange(2000) / 50.0
    steady = one.apply(np.sin(2.0 * np.pi * hz * tick))[1000:]
    expected = one.response(np.array([2.0 * np.pi * hz]), 50.0)[0]
    assert np.abs(steady).max() == pytest.approx(abs(expected), rel=0.01)
