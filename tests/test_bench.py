"""`pronk bench match`: the known truth is known, the peers are used well, the table adds up."""

from __future__ import annotations

import io
import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from benchmarks.known_truth import (
    JOINT,
    SCENARIOS,
    KnownTruth,
    Scenario,
    Truth,
    coloured_noise,
    delayed,
)
from benchmarks.match import BenchResult, fit_pronk, run, table
from benchmarks.peers import Estimate, fit_cma, fit_sysid
from benchmarks.replay import Replay
from benchmarks.result import row
from pronk.errors import LogError, PronkError
from pronk.logs.joint_log import JointLog
from pronk.robots import load_robot
from pronk.robots.robot import Robot

QUIET = Scenario(name="quiet", words="no noise", noise_rad=0.0)
BOUNDS = ((13.0, 27.0), (0.1, 0.7))
START = (17.0, 0.4)
SHORT = {"repeats": 2, "length_s": 8.0}


@pytest.fixture(scope="module")
def robot() -> Robot:
    return load_robot("mini_cheetah")


@pytest.fixture(scope="module")
def quiet(robot: Robot) -> JointLog:
    return KnownTruth(robot, QUIET, **SHORT).log(np.random.default_rng(0))


def test_noise_has_the_variance_and_the_corner_it_says() -> None:
    rng = np.random.default_rng(3)
    noise = coloured_noise(rng, 400_000, deviation=3e-3, corner_hz=2.0, rate_hz=200.0)
    assert noise.std() == pytest.approx(3e-3, rel=0.03)
    one_step = np.corrcoef(noise[1:], noise[:-1])[0, 1]
    assert one_step == pytest.approx(math.exp(-2.0 * math.pi * 2.0 / 200.0), abs=3e-3)
    # Stationary from the first sample on.
    starts = [
        coloured_noise(rng, 2, deviation=1.0, corner_hz=2.0, rate_hz=200.0)[0] for _ in range(2000)
    ]
    assert np.std(starts) == pytest.approx(1.0, rel=0.08)


def test_delay_is_exact_in_whole_steps_and_smooth_between() -> None:
    time = np.arange(400) * 0.005
    wave = np.where(time > 0.5, np.sin(2.0 * np.pi * 2.0 * (time - 0.5)) ** 3, 0.0)
    whole = delayed(wave, 0.010, 0.005)
    assert np.allclose(whole[2:], wave[:-2], atol=1e-12)
    later = time - 0.007
    expected = np.where(later > 0.5, np.sin(2.0 * np.pi * 2.0 * (later - 0.5)) ** 3, 0.0)
    assert np.abs(delayed(wave, 0.007, 0.005) - expected).max() < 1e-3


def test_a_log_is_reproducible_and_its_trouble_is_the_one_named(robot: Robot) -> None:
    noisy = KnownTruth(robot, SCENARIOS[0], **SHORT)
    first, again = (noisy.log(np.random.default_rng(5)) for _ in range(2))
    assert np.array_equal(first.position, again.position)
    assert len(first.segments) == 2
    assert first.segments[0].clamped == robot.joint(JOINT).clamped
    assert float(np.ptp(first.command)) == pytest.approx(0.5, rel=0.05)
    wandering = Scenario(name="repeats", words="", noise_rad=0.0, gain_spread=0.03)
    log = KnownTruth(robot, wandering, **SHORT).log(np.random.default_rng(1))
    one, two = (log.cut(segment).position for segment in log.segments)
    assert np.abs(one - two).max() > 1e-3
    quiet = KnownTruth(robot, QUIET, **SHORT).log(np.random.default_rng(1))
    one, two = (quiet.cut(segment).position for segment in quiet.segments)
    assert np.array_equal(one, two)


def test_impossible_scenarios_are_refused() -> None:
    with pytest.raises(PronkError, match=r"delay_s is -0\.001"):
        Scenario(name="x", words="", delay_s=-1e-3)
    with pytest.raises(PronkError, match="corner"):
        Scenario(name="x", words="", noise_corner_hz=0.0)


def test_sysid_finds_the_truth_without_noise(robot: Robot, quiet: JointLog) -> None:
    found = fit_sysid(quiet, JOINT, robot, bounds=BOUNDS, start=START)
    assert found.stiffness == pytest.approx(Truth().stiffness, rel=1e-3)
    assert found.damping == pytest.approx(Truth().damping, rel=1e-3)
    assert found.interval is not None
    assert found.delay_s is None


def test_cma_finds_the_truth_without_noise(robot: Robot, quiet: JointLog) -> None:
    found = fit_cma(quiet, JOINT, robot, bounds=BOUNDS, start=START, population=12)
    assert found.stiffness == pytest.approx(Truth().stiffness, rel=1e-3)
    assert found.damping == pytest.approx(Truth().damping, rel=1e-3)
    assert found.interval is None


def test_pronk_finds_the_truth_without_noise(robot: Robot, quiet: JointLog) -> None:
    found = fit_pronk(quiet, robot=robot, method="quick", threads=2)
    assert found.stiffness == pytest.approx(Truth().stiffness, rel=5e-3)
    assert found.damping == pytest.approx(Truth().damping, rel=1e-2)


def test_peers_with_their_delay_find_a_delay_of_whole_steps(robot: Robot) -> None:
    late = KnownTruth(robot, replace(QUIET, delay_s=0.010), **SHORT)
    log = late.log(np.random.default_rng(0))
    found = fit_sysid(log, JOINT, robot, bounds=BOUNDS, start=START, delay_bounds_s=(0.0, 0.04))
    assert found.delay_s == pytest.approx(0.010, abs=3e-4)
    assert found.stiffness == pytest.approx(Truth().stiffness, rel=0.01)
    stepped = fit_cma(log, JOINT, robot, bounds=BOUNDS, start=START, delay_steps=8, population=16)
    assert stepped.delay_s == pytest.approx(0.010)
    assert stepped.stiffness == pytest.approx(Truth().stiffness, rel=0.01)


def test_replay_refuses_what_it_cannot_replay(robot: Robot, quiet: JointLog) -> None:
    jittered = replace(quiet, time=quiet.time * 1.001)
    with pytest.raises(LogError, match="physics step"):
        Replay.of(jittered, JOINT, robot)
    other = quiet.command.copy()
    other[len(other) // 2 :] += 0.1
    with pytest.raises(LogError, match="differ"):
        Replay.of(replace(quiet, command=other), JOINT, robot)
    with pytest.raises(LogError, match="no segment"):
        Replay.of(replace(quiet, segments=()), JOINT, robot)


def test_a_row_adds_up() -> None:
    truth = Truth(stiffness=20.0, damping=0.5)
    estimates = [
        Estimate(stiffness=21.0, damping=0.5, interval=((20.5, 21.5), (0.45, 0.55)), seconds=1.0),
        Estimate(stiffness=20.0, damping=0.45, interval=((19.0, 21.0), (0.40, 0.50)), seconds=3.0),
    ]
    one = row("s", "t", "f", estimates, truth)
    assert one.stiffness_bias == pytest.approx(2.5)
    assert one.stiffness_sd == pytest.approx(5.0 / math.sqrt(2.0))
    assert one.damping_bias == pytest.approx(-5.0)
    assert (one.covered, one.intervals) == (3, 4)
    assert one.stiffness_half_width == pytest.approx(100.0 * 0.75 / 20.0)
    assert one.seconds == pytest.approx(2.0)
    assert math.isnan(one.delay_ms)


@pytest.mark.parametrize("package", ["cma", "colorama"])
def test_a_missing_peer_is_one_sentence(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [n for n in sys.modules if n == "cma" or n.startswith("mujoco.sysid")]:
        monkeypatch.delitem(sys.modules, name)
    if hasattr(sys.modules["mujoco"], "sysid"):
        monkeypatch.delattr(sys.modules["mujoco"], "sysid")
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(PronkError, match=r"pip install pronk\[bench\]") as caught:
        run(1)
    assert package in str(caught.value)


def test_the_whole_bench_small(tmp_path: Path) -> None:
    scenarios = (replace(SCENARIOS[1], noise_rad=1e-3),)
    told: list[float] = []
    result = run(
        1, 4, lambda _, share: told.append(share), scenarios=scenarios, full_grid=False, **SHORT
    )
    assert isinstance(result, BenchResult)
    assert told == sorted(told)
    assert told[-1] == 1.0
    rows = {one.tool: one for one in result.rows}
    # The magnitude does not see the delay; a fit in time that ignores it takes it for softness.
    assert abs(rows["pronk"].stiffness_bias) < 2.0
    assert rows["mujoco.sysid"].stiffness_bias < -10.0
    assert rows["CMA-ES as PACE"].stiffness_bias == pytest.approx(
        rows["mujoco.sysid"].stiffness_bias, abs=0.5
    )
    assert rows["CMA-ES as PACE"].intervals == 0
    stored = json.loads(result.to_json(tmp_path / "bench.json"))
    assert json.loads((tmp_path / "bench.json").read_text()) == stored
    assert stored["rows"][0]["stiffness_sd"] is None
    console = Console(width=140, file=io.StringIO(), record=True)
    console.print(table(result))
    shown = console.export_text()
    for name in rows:
        assert name in shown
    assert "no intervals" in shown


def test_no_trials_is_refused() -> None:
    with pytest.raises(PronkError, match="0 trials"):
        run(0)
