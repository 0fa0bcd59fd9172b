"""The benchmarks: known gains are found, paired figures add up, small runs work."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import count, islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pronk
from benchmarks import (
    grid,
    known,
    latency,
    match,
    random_robots,
    runner,
    sensor_faults,
    train,
    trial,
)
from benchmarks.peers import Estimate, Replay, fit_cma, fit_sysid
from benchmarks.random_robots import HELD_OUT, Recorded, Steps, draw
from benchmarks.time_fit import fit_plain, recordings
from chirp_logs import chirp_log
from hopper import ROBOT as HOPPER
from hopper import write_hopper
from pronk.errors import LogError, PronkError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.simulators.load import joint_rigs
from pronk.jump.trial.protocol import Case
from pronk.jump.trial.trial import (
    TrialJob,
    TrialPlan,
    TrialSetup,
    load_subjects,
    plan_jobs,
    run_job,
)
from pronk.jump.virtual.sim_params import load_sim_params
from pronk.policy.script import STILL, Script
from pronk.robots import load_robot
from tests.synthetic_log import coloured_noise

ROBOT = load_robot("mini_cheetah")
QUIET = known.Scenario(name="quiet", words="no noise", noise_rad=0.0)
PEER: dict[str, Any] = {"bounds": ((13.0, 27.0), (0.1, 0.7)), "start": (17.0, 0.4)}
SHORT: dict[str, Any] = {"repeats": 2, "length_s": 8.0}
POLICY = Path(pronk.__file__).parents[2] / "policies" / "matched" / "policy.onnx"


def test_rows_are_kept_in_order_as_they_come(tmp_path: Path) -> None:
    out = tmp_path / "rows.jsonl"
    assert runner.rows_in(out) == []
    rows = runner.rows_of((partial(list, ({"k": k},)) for k in count()), 2, out)
    first = list(islice(rows, 5))
    rows.close()  # type: ignore[attr-defined]
    assert [row["k"] for row in first] == [0, 1, 2, 3, 4]
    assert runner.rows_in(out) == first


def test_the_page_of_faults_names_what_is_late_or_not_found() -> None:
    common = {"robot": "go2", "link": "dds", "run": 0, "reason": "ENCODER"}
    times = {"gyro-zero": (0.04, 0.05), "encoder-zero": (0.04, 0.3), "encoder-jumps": (math.nan,)}
    rows = [{**common, "fault": k, "time_s": t} for k, each in times.items() for t in each]
    text = sensor_faults.faults_section(rows, "command")
    assert "`gyro-zero` | 45 (50), n = 2 |" in text
    late = text.split("Longer than")[1]
    assert "`encoder-zero` (go2, dds): 1 of 2 later, 0 not found" in late
    assert "`encoder-jumps` (go2, dds): 0 of 1 later, 1 not found" in late
    assert "`gyro-zero` (" not in late


def test_a_section_of_a_page_is_replaced_and_the_rest_is_kept(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("# A\n\n<!-- b -->\n\nold\n\n<!-- end of b -->\n\nby hand\n", encoding="utf-8")
    runner.write_section(page, "b", "new")
    runner.write_section(page, "b", "newer")
    assert page.read_text() == "# A\n\n<!-- b -->\n\nnewer\n\n<!-- end of b -->\n\nby hand\n"
    with pytest.raises(PronkError, match="no section"):
        runner.write_section(page, "c", "new")


def ignore(_stage: str, _share: float) -> None: ...


def test_blocks_take_turns_and_ratios_are_of_neighbours() -> None:
    order: list[str] = []

    def block(name: str) -> float:
        order.append(name)
        return float(len(order))

    times = runner.in_turn([partial(block, "a"), partial(block, "b")], 3)
    assert order == [*"abbaab"]
    assert times == [[1.0, 4.0, 5.0], [2.0, 3.0, 6.0]]
    # A machine that halves its speed after the first turn changes no ratio.
    ratio = runner.paired_ratio((300.0, 150.0, 160.0), (200.0, 100.0, 100.0))
    assert ratio == pytest.approx((1.5, 1.5, 1.6))


@pytest.fixture(scope="module")
def quiet() -> JointLog:
    return known.known_log(ROBOT, QUIET, np.random.default_rng(0), **SHORT)


def test_noise_has_its_variance_and_corner_from_the_first_sample_on() -> None:
    rng, rate = np.random.default_rng(3), {"corner_hz": 2.0, "rate_hz": 200.0}
    noise = coloured_noise(rng, (400_000,), deviation=3e-3, **rate)
    assert noise.std() == pytest.approx(3e-3, rel=0.03)
    one_step = np.corrcoef(noise[1:], noise[:-1])[0, 1]
    assert one_step == pytest.approx(math.exp(-2.0 * math.pi * 2.0 / 200.0), abs=3e-3)
    starts = coloured_noise(rng, (2000, 2), deviation=1.0, **rate)[:, 0]
    assert starts.std() == pytest.approx(1.0, rel=0.08)


@pytest.mark.parametrize(("spread", "same"), [(0.0, True), (0.03, False)])
def test_gains_vary_from_repeat_to_repeat(spread: float, same: bool) -> None:
    scenario = replace(QUIET, gain_spread=spread)
    log = known.known_log(ROBOT, scenario, np.random.default_rng(5), **SHORT)
    one, two = (log.cut(segment).position for segment in log.segments)
    assert np.array_equal(one, two) == same


@pytest.mark.parametrize(
    ("fit", "tolerance"),
    [
        (lambda log: fit_sysid(log, known.JOINT, ROBOT, **PEER), 1e-3),
        (lambda log: fit_cma(log, known.JOINT, ROBOT, population=12, **PEER), 1e-3),
        (lambda log: known.fit_pronk(log, robot=ROBOT, grid_points=20), 1e-2),
    ],
)
def test_every_tool_finds_the_known_gains_without_noise(
    fit: Callable[[JointLog], Estimate], tolerance: float, quiet: JointLog
) -> None:
    found = fit(quiet)
    assert (found.stiffness, found.damping) == pytest.approx(known.KNOWN, rel=tolerance)


def test_peers_find_a_delay_of_whole_steps() -> None:
    late = replace(QUIET, delay_s=0.010)
    log = known.known_log(ROBOT, late, np.random.default_rng(0), **SHORT)
    for found in (
        fit_sysid(log, known.JOINT, ROBOT, delay_bounds_s=(0.0, 0.04), **PEER),
        fit_cma(log, known.JOINT, ROBOT, delay_steps=8, population=16, **PEER),
    ):
        assert found.delay_s == pytest.approx(0.010, abs=3e-4)
        assert found.stiffness == pytest.approx(known.KNOWN[0], rel=0.01)


def test_a_replay_needs_equal_repeats_at_the_physics_step(quiet: JointLog) -> None:
    other = quiet.command.copy()
    other[len(other) // 2 :] += 0.1
    for changes in ({"time": quiet.time * 1.001}, {"command": other}, {"segments": ()}):
        with pytest.raises(LogError):
            Replay(replace(quiet, **changes), known.JOINT, ROBOT)


def test_a_row_is_the_mean_and_the_coverage_of_its_estimates() -> None:
    kp, kd = known.KNOWN
    around, beside = (((kp + a, kp + b), (kd * 0.9, kd * 1.1)) for a, b in ((-0.5, 0.5), (1, 2)))
    estimates = [
        Estimate(stiffness=1.05 * kp, damping=kd, interval=around, seconds=1.0),
        Estimate(stiffness=kp, damping=0.9 * kd, interval=beside, seconds=3.0),
    ]
    row = known.summary("s", "t", estimates)
    assert row["bias"] == pytest.approx((2.5, -5.0))
    assert row["sd"][0] == pytest.approx(5.0 / math.sqrt(2.0))
    assert (row["covered"], row["intervals"], row["seconds"]) == (3, 4, 2.0)
    assert row["half_width"][0] == pytest.approx(50.0 / kp)
    assert math.isnan(row["delay_ms"])


@pytest.mark.parametrize("package", ["cma", "colorama"])
def test_a_missing_peer_is_named(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [n for n in sys.modules if n == "cma" or n.startswith("mujoco.sysid")]:
        monkeypatch.delitem(sys.modules, name)
    if hasattr(sys.modules["mujoco"], "sysid"):
        monkeypatch.delattr(sys.modules["mujoco"], "sysid")
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(PronkError, match=package):
        known.run(1, 0, ignore)


def test_a_delay_softens_only_fits_in_the_time_domain() -> None:
    scenarios = (replace(known.SCENARIOS[1], noise_rad=1e-3),)
    rows = known.run(1, 4, ignore, scenarios=scenarios, repeats=2, length_s=4.0)
    bias = {one["tool"]: one["bias"][0] for one in rows}
    assert abs(bias["pronk"]) < 2.0
    assert bias["mujoco.sysid"] < -10.0
    assert bias["CMA-ES as PACE"] == pytest.approx(bias["mujoco.sysid"], abs=0.5)
    tools = [row[1] for row in known.make_table(rows, "").rows]
    assert tools == list(bias)
    with pytest.raises(PronkError, match="0 trials"):
        known.run(0, 0, ignore)


def test_the_grid_search_is_refined_to_the_known_gains() -> None:
    found = grid.run(ignore, points=8, length_s=8.0, joints=["FR_knee", "FL_knee"])
    assert (found["pairs"], found["simulations"]) == (64, 1)
    for row in found["joints"]:
        assert row.refined == pytest.approx(row.known, rel=5e-3)
    assert found["ratio"] > 0.0


def test_limits_hold_for_the_warm_loop_on_an_idle_computer() -> None:
    def figures(late: float, network: float) -> dict[str, dict[str, float]]:
        return {"lateness": {"p99_ms": late}, "network": {"p99_ms": network}}

    rows = {}
    for case in latency.CASES:
        warm = figures(0.9 + case.hogs, 0.25 - 0.1 * case.real_time)
        ways = dict.fromkeys(latency.WAYS, figures(7.0, 7.0)) | {latency.WAYS[-1]: warm}
        rows[case.name] = {"ways": ways}
    assert [check.passed for check in latency.checks(rows)] == [True, False, True, True]
    with pytest.raises(PronkError):
        latency.run(POLICY, 0.1, ignore)


@pytest.fixture
def job(tmp_path: Path) -> TrialJob:
    pytest.importorskip("onnxruntime")
    script = Script(command=STILL, stand_s=0.1, run_s=0.1, jump_s=0.14, keep_s=0.0, stop_s=0.4)
    subjects = load_subjects([write_hopper(tmp_path / "policy.onnx")], HOPPER)
    plan = TrialPlan(
        cases=(Case(name="spot", command=STILL),), jumps=1, script=script, spread_s=0.0
    )
    setup = TrialSetup(robot=HOPPER, sim_params=load_sim_params(), out=tmp_path)
    [job] = plan_jobs(subjects, plan, setup)
    return replace(job, row=replace(job.row, capture=""))


def test_the_bare_loop_repeats_the_trial_to_the_last_bit(job: TrialJob) -> None:
    before = repr(run_job(job))
    recording = trial.Recording(job)
    assert repr(run_job(job)) == before
    assert recording.replay() > 0.0
    block = recording.blocks[-1]
    recording.blocks[-1] = replace(block, steps=block.steps - 1)
    with pytest.raises(PronkError, match="another state"):
        recording.replay()


@pytest.mark.parametrize("wrong", [{"envs": ()}, {"envs": (0,)}, {"steps": 0}, {"repeats": 0}])
def test_impossible_numbers_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(PronkError):
        train.run(**wrong)
    with pytest.raises(PronkError):
        train.train(envs="16,many")


@pytest.mark.train
@pytest.mark.slow
def test_a_small_training_benchmark(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("mjlab")
    import mjlab.tasks  # noqa: F401 - registers mjlab's own
    from mjlab.tasks.registry import load_env_cfg, load_rl_cfg, register_mjlab_task

    from pronk.jump.train.rl.runner import PronkRunner

    name, task = "Pronk-Bench-Small", "Pronk-Jump-MiniCheetah"
    learning, env_cfg = load_rl_cfg(task), load_env_cfg(task)
    learning.actor.hidden_dims = learning.critic.hidden_dims = (8,)
    learning.algorithm.num_learning_epochs = 1
    learning.num_steps_per_env = 8
    env_cfg.curriculum["phases"].params["steps_per_iteration"] = 8
    register_mjlab_task(name, env_cfg, env_cfg, learning, PronkRunner)
    with pytest.raises(PronkError, match="no task 'Cartwheel'"):
        train.run(envs=(2,), device="cpu", tasks=("Cartwheel", "Cartwheel"))
    lines: list[str] = []
    found = train.run(lines.append, envs=(4,), steps=4, repeats=1, device="cpu", tasks=(name, name))
    for one in found["pairs"][0]:
        assert (one["task"], one["envs"], one["horizon"]) == (name, 4, 8)
        assert min(*one["stepping"], *one["training"]) > 0.0
        assert 2.0 <= one["physics_per_step"] <= 6.0
    assert len(lines) == 3
    assert "WITHOUT CUDA graphs" in " ".join(train.rate_table(found).notes)
    json.dumps(found)
    assert capsys.readouterr().out == ""


# --- match: random virtual robots ---

JOINT, KNOWN, DELAY = "FR_knee", (21.8, 0.541), 0.007


def synthetic(*amplitudes: float) -> JointLog:
    """A log of the training simulator with the gains `KNOWN` and a delay."""
    return chirp_log(ROBOT, JOINT, KNOWN, amplitudes, repeats=2, delay_s=DELAY, threads=1)


def test_robots_are_the_same_for_the_same_seed_and_within_their_ranges() -> None:
    assert draw(27, 3) == draw(27, 3)
    assert draw(27, 3) != draw(27, 4)
    assert draw(27, 3) != draw(28, 3)
    shipped = load_sim_params()

    def within(value: float, name: str) -> bool:
        low, high = getattr(random_robots, name)
        return bool(low <= value <= high)

    for drawn in (draw(27, number) for number in range(20)):
        assert within(drawn.machine.command_delay_s, "DELAY_S")
        assert within(drawn.machine.encoder_bits, "ENCODER_BITS")
        for name, joint in drawn.joints.items():
            own = shipped.joints[name]
            assert within(joint.coulomb / own.coulomb, "FRICTION")
            assert within(joint.belt_stiffness / own.belt_stiffness, "BELT")
            assert within(joint.torque_scale, "TORQUE")


def test_steps_begin_and_end_at_rest_and_are_all_different() -> None:
    offsets = Steps(amplitude=0.1, hold_s=0.5, steps=20).samples(ROBOT.policy_rate_hz)
    assert np.abs(offsets).max() == pytest.approx(0.1)
    assert offsets[0] == offsets[-1] == 0.0
    assert len(np.unique(offsets)) == 21


def test_the_plain_fit_finds_gains_and_delay_of_the_training_simulator() -> None:
    log = synthetic(0.25, 0.125)
    with joint_rigs("mujoco", ROBOT, threads=1) as rigs:
        found = fit_plain(rigs, log, JOINT)
        nominal = fit_plain(rigs, log, JOINT, ("delay",))
    assert (found["stiffness"], found["damping"]) == pytest.approx(KNOWN, rel=2e-3)
    assert found["delay"] == pytest.approx(DELAY, abs=2e-4)
    assert (nominal["stiffness"], nominal["damping"]) == (17.0, 0.4)
    groups = recordings(log, JOINT, ROBOT)
    assert [one.positions.shape[0] for one in groups] == [2, 2]


def test_a_method_is_judged_on_signals_that_it_did_not_see() -> None:
    logs = Recorded(
        joint=JOINT,
        sweep=synthetic(0.25, 0.125),
        held_out=synthetic(0.1, 0.15, 0.2),
        exact=synthetic(0.18),
    )

    def refuse(*_: object) -> match.Found:
        raise PronkError("no match")

    known = match.methods()
    chosen = {name: known[name] for name in (match.NOMINAL, match.PLAIN)} | {"none": refuse}
    with joint_rigs("mujoco", ROBOT, threads=1) as rigs:
        rows = [{"robot": 0} | row for row in match.compare(rigs, logs, chosen)]
    nominal, plain, none = match.summary(rows)
    assert nominal["below"] == 0
    assert nominal["median"] == pytest.approx(1.0)
    # What is left of the error is that of the interpolation between 5 ms steps.
    assert plain["below"] == plain["joints"] == 1
    assert plain["median"] < 0.1
    assert plain["moving"] == plain["over_plain"] == pytest.approx(1.0)
    assert nominal["moving"] > 10.0
    assert all(row["moving"][s] <= row["rmse"][s] for row in rows[:2] for s in HELD_OUT)
    assert np.abs(plain["bias"]).max() < 0.3
    assert (none["joints"], none["refused"]) == (0, 1)
    assert math.isnan(none["median"])
    assert rows[2]["refused"] == "no match"


def test_coverage_counts_the_gains_of_the_noise_free_sweep() -> None:
    rmse = dict.fromkeys(HELD_OUT, 1.0)
    row: dict[str, Any] = {
        **{"robot": 0, "joint": JOINT, "seconds": 1.0, "rmse": rmse, "moving": rmse},
        "method": match.PRONK,
        "values": {"stiffness": 20.0, "damping": 0.5},
        "exact": {"stiffness": 20.5, "damping": 0.55},
        "repeat": {"stiffness": (19.0, 21.0), "damping": (0.49, 0.51)},
        "total": {"stiffness": (19.0, 21.0), "damping": (0.40, 0.60)},
    }
    (one,) = match.summary([row])
    assert (one["repeat"]["covered"], one["repeat"]["intervals"]) == (1, 2)
    assert (one["total"]["covered"], one["total"]["intervals"]) == (2, 2)
    assert one["bias"] == pytest.approx([100 * (20 / 20.5 - 1), 100 * (0.5 / 0.55 - 1)])


def test_a_joint_is_judged_on_the_signals_that_excite_it() -> None:
    rows = [
        {"robot": 0, "joint": joint, "method": method, "seconds": 1.0, "rmse": rmse, "moving": rmse}
        for method, factor in ((match.NOMINAL, 4.0), (match.PLAIN, 2.0), (match.PRONK, 1.0))
        for joint, rmse in (("a", {"steps": factor, "sweep": factor**2}), ("b", {"steps": factor}))
    ]
    *_, pronk = match.summary(rows)
    assert pronk["signals"] == pytest.approx({"steps": 1 / 4, "sweep": 1 / 16})
    assert pronk["median"] == pytest.approx(np.median([1 / 8, 1 / 4]))
    assert pronk["over_plain"] == pytest.approx((1 / 2 * 1 / 4 * 1 / 2) ** (1 / 3))


def test_an_impossible_run_is_refused() -> None:
    with pytest.raises(PronkError, match="0 robots"):
        next(match.run(0, 0, lambda _stage, _share: None))


def test_no_benchmark_needs_the_requested_opengl() -> None:
    """MuJoCo itself cannot be imported with an unknown or a missing one."""
    environment = {**os.environ, "MUJOCO_GL": "nonsense"}
    environment.pop("PRONK_GL", None)
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks", "grid", "--help"],
        capture_output=True,
        text=True,
        check=False,
        env=environment,
        cwd=Path(__file__).parents[2],
    )
    assert done.returncode == 0, done.stderr
    assert "grid" in done.stdout
