"""The evaluation: recorders on the device against the definitions, bars, and a run in mjlab."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pronk.errors import ArtefactError, PronkError
from pronk.evaluation.criteria import Check
from pronk.evaluation.jumps import Jump, JumpRules, Series, answer, measure, unasked_height
from pronk.evaluation.training_sim import bars as evaluate_bars
from pronk.evaluation.training_sim import result as evaluate_result
from pronk.evaluation.training_sim.bars import checks, cost_of_jumping
from pronk.evaluation.training_sim.plan import JUMPS, NEVER, WALKS, Case, Plan
from pronk.evaluation.training_sim.result import (
    EstimatorResult,
    Evaluation,
    JumpResult,
    Spread,
    Unasked,
    WalkResult,
)
from pronk.policy.stride import MOST_S

DT = 0.005


def spread(mean: float, std: float = 0.01) -> Spread:
    return Spread(mean=mean, std=std, p05=mean, p95=mean, n=10)


NO_FLIGHT = Unasked(share=0.0, highest=math.nan, too_high=0.0)


def walk(name: str, **changes: Any) -> WalkResult:
    good = WalkResult(
        name=name,
        command=(2.0, 0.0, 0.0),
        robots=10,
        falls=0.0,
        non_finite=0.0,
        speed_error=spread(0.1),
        yaw_error=spread(0.1),
        speed_error_averaged=spread(0.04),
        yaw_error_averaged=spread(0.05),
        velocity=(2.0, 0.0, 0.0),
        drift=spread(0.1),
        unasked=NO_FLIGHT,
    )
    return replace(good, **changes)


def jump(name: str, **changes: Any) -> JumpResult:
    good = JumpResult(
        name=name,
        command=(2.0, 0.0, 0.0),
        robots=10,
        told=10,
        found=1.0,
        upright=1.0,
        non_finite=0.0,
        single=1.0,
        height=spread(0.5),
        apex=spread(0.3),
        distance=spread(1.2),
        along=spread(1.2),
        vertical=spread(2.4),
        horizontal=spread(2.0),
        delay=spread(0.2),
        duration=spread(0.5),
        flights=spread(1.0),
        long_flights=spread(2.4),
        high_flights=spread(1.0),
        unasked=NO_FLIGHT,
    )
    return replace(good, **changes)


def evaluation(**changes: Any) -> Evaluation:
    whole = Evaluation(
        walks=tuple(walk(case.name) for case in WALKS),
        jumps=tuple(jump(case.name) for case in JUMPS),
        estimator=EstimatorResult(rmse=(0.1, 0.1, 0.0), rmse_vector=0.14, contacts_right=0.96),
        plan={"robots": 10, "seed": 3},
        seconds=1.0,
        about={"policy": {"file": "policy.onnx"}, "randomization": "full"},
        before={},
    )
    return replace(whole, **changes)


def failed(whole: Evaluation) -> list[str]:
    return [check.what for check in checks(whole) if not check.passed]


# --- Bars ----------------------------------------------------------------------------------------


def test_a_good_policy_clears_every_bar() -> None:
    found = checks(evaluation(before={case.name: 0.1 for case in WALKS}))
    assert [check.what for check in found if not check.passed] == []
    # 4 walks of two bars, 2 turns, stillness; 5 jumps of seven; 2 of obedience; 2; the cost.
    assert len(found) == 8 + 2 + 1 + 5 * 7 + 2 + 2 + 1


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"speed_error": spread(0.151)}, "forward 2: speed error"),
        ({"speed_error": spread(math.nan)}, "forward 2: speed error"),
        ({"falls": 0.0051}, "forward 2: falls"),
    ],
)
def test_a_bad_walk_fails_its_bar_and_no_other(changes: dict[str, Any], what: str) -> None:
    walks = tuple(walk(c.name, **(changes if c.name == "forward 2" else {})) for c in WALKS)
    assert failed(evaluation(walks=walks)) == [what]


def test_what_is_only_reported_fails_nothing() -> None:
    bad = {"speed_error": spread(9.0), "falls": 1.0}
    walks = tuple(walk(c.name, **(bad if c.name.endswith("3") else {})) for c in WALKS)
    assert failed(evaluation(walks=walks)) == []


@pytest.mark.parametrize(
    ("changes", "what"),
    [
        ({"height": spread(0.449)}, "height"),
        ({"height": spread(0.5, 0.031)}, "std of height"),
        ({"height": spread(0.5, math.nan)}, "std of height"),
        ({"distance": spread(0.69)}, "distance"),
        ({"upright": 0.989}, "upright"),
        ({"single": 0.94}, "one high flight"),
        ({"vertical": spread(2.81)}, "lift-off velocity off 2.5"),
        ({"vertical": spread(2.19)}, "lift-off velocity off 2.5"),
        ({"delay": replace(spread(0.2), p95=0.31)}, "lift-off after, 95th percentile"),
    ],
)
def test_a_bad_jump_fails_its_bar_and_no_other(changes: dict[str, Any], what: str) -> None:
    jumps = tuple(jump(c.name, **(changes if c.name == "forward 1" else {})) for c in JUMPS)
    assert failed(evaluation(jumps=jumps)) == [f"jump forward 1: {what}"]


def test_one_robot_that_hops_unasked_fails_obedience() -> None:
    hop = Unasked(share=0.1, highest=0.031, too_high=0.1)
    walks = (walk("forward 2"), walk("stand", unasked=hop))
    assert failed(evaluation(walks=walks)) == ["flight without a jump input, walking"]
    low = Unasked(share=1.0, highest=-0.02, too_high=0.0)
    assert failed(evaluation(walks=(walk("stand", unasked=low),))) == []


def test_the_cost_of_jumping_is_the_growth_of_the_mean_error() -> None:
    before = dict.fromkeys(evaluate_bars.WALKS, 0.1)
    after = {**before, "forward 2": 0.14, "forward 3": 7.0}
    assert cost_of_jumping(before, after) == pytest.approx(1.1)
    assert math.isnan(cost_of_jumping({}, after))
    slower = evaluation(before=dict.fromkeys(evaluate_bars.WALKS, 0.09))
    assert failed(slower) == ["speed error over that before jumping"]


def test_a_check_says_what_json_needs() -> None:
    row = Check(what="height", value=0.5, sense=">=", bar=0.45, unit="m").row()
    assert row == {
        "what": "height", "value": 0.5, "sense": ">=", "bar": 0.45, "unit": "m", "passed": True,
    }  # fmt: skip


# --- The file ------------------------------------------------------------------------------------


def test_an_evaluation_comes_back_from_its_file(tmp_path: Path) -> None:
    path = tmp_path / "evaluation.json"
    whole = evaluation(before={"forward 2": 0.1})
    evaluate_result.save(path, whole, [check.row() for check in checks(whole)])
    body = json.loads(path.read_text())
    assert body["schema"] == "pronk/evaluation/1"
    assert body["checks"][0]["passed"] is True
    # NaN is not JSON.
    assert body["walks"][0]["unasked"]["highest"] is None
    assert repr(evaluate_result.load(path)) == repr(whole)
    assert evaluate_result.load(path).speed_errors()["back 2"] == 0.1


def test_a_file_from_before_touches_were_counted_is_read(tmp_path: Path) -> None:
    path = tmp_path / "evaluation.json"
    whole = evaluation(jumps=(jump("back 2", touched=0.7, waited=0.1),))
    evaluate_result.save(path, whole, [])
    assert evaluate_result.load(path).jumps[0].touched == 0.7
    assert evaluate_result.load(path).jumps[0].waited == 0.1
    body = json.loads(path.read_text())
    del body["jumps"][0]["touched"]
    path.write_text(json.dumps(body))
    assert math.isnan(evaluate_result.load(path).jumps[0].touched)
    # What was always there has to be there.
    del body["jumps"][0]["upright"]
    path.write_text(json.dumps(body))
    with pytest.raises(ArtefactError, match="not a whole evaluation \\('upright'\\)"):
        evaluate_result.load(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "no such file; `pronk evaluate` writes one"),
        ("{", "cannot be read as JSON"),
        ("[]", "schema 'list'; this pronk reads 'pronk/evaluation/1'"),
        ('{"schema": "pronk/evaluation/1", "walks": []}', "not a whole evaluation"),
    ],
)
def test_a_damaged_file_is_refused(tmp_path: Path, text: str | None, message: str) -> None:
    path = tmp_path / "evaluation.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(ArtefactError, match=message):
        evaluate_result.load(path)


def test_a_spread_leaves_out_what_is_unknown() -> None:
    known = Spread.of([1.0, math.nan, 3.0])
    assert (known.mean, known.n) == (2.0, 2)
    assert known.std == pytest.approx(math.sqrt(2.0))
    assert (known.p05, known.p95) == (pytest.approx(1.1), pytest.approx(2.9))
    assert math.isnan(Spread.of([math.nan]).mean)
    assert math.isnan(Spread.of([1.0]).std)


# --- The plan ------------------------------------------------------------------------------------


def test_every_robot_has_its_command_and_its_times() -> None:
    plan = Plan(robots=200, seed=4)
    assert plan.size == 14 * 200
    commands = plan.commands()
    assert commands[0].tolist() == [2.0, 0.0, 0.0]
    assert commands[plan.walkers - 1].tolist() == [0.0, 0.0, 0.0]
    assert commands[-1].tolist() == [-2.0, 0.0, 0.0]
    times = plan.times(DT)
    walking = {name: set(values[: plan.walkers].tolist()) for name, values in times.items()}
    assert walking == {"start": {0}, "stop": {NEVER}, "on": {NEVER}, "off": {NEVER}}
    on = times["on"][plan.walkers :] * DT
    # 1 s of standing, 2.5 s of running, up to half a second more, evenly.
    assert 3.5 <= on.min() < 3.51
    assert 3.99 < on.max() <= 4.0
    assert on.mean() == pytest.approx(3.75, abs=0.02)
    assert np.array_equal(times["off"] - times["on"], np.r_[[0] * plan.walkers, [100] * 1000])
    assert set((times["stop"] - times["off"])[plan.walkers :]) == {100}
    assert set(times["start"][plan.walkers :]) == {200}
    assert np.array_equal(on, plan.times(DT)["on"][plan.walkers :] * DT)
    assert not np.array_equal(on, replace(plan, seed=5).times(DT)["on"][plan.walkers :] * DT)
    assert plan.seconds == 20.0
    assert replace(plan, walks=()).seconds == pytest.approx(4.0 + MOST_S + 1.5 + 1.0 + 2.0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"robots": 0}, "0 robots for each command; expected 1 or more"),
        ({"walks": (), "jumps": ()}, "neither walks nor jumps"),
        ({"walk_s": 0.0}, "Plan.walk_s is 0.0; it must be positive"),
        ({"keep_s": -1.0}, "Plan.keep_s is -1.0; it must not be negative"),
        ({"settle_s": 20.0}, "settling must hold the average and end before the walk"),
        ({"average_s": 2.5}, "settling must hold the average and end before the walk"),
    ],
)
def test_an_impossible_plan_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(PronkError, match=message):
        Plan(**changes)


# --- Recorders on the device ---------------------------------------------------------------------


def random_turns(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Quaternions, most of them nearly upright."""
    turns = rng.normal(size=(*shape, 4)) * np.array([1.0, 0.2, 0.2, 1.0])
    return turns / np.linalg.norm(turns, axis=-1, keepdims=True)


@pytest.mark.train
def test_jumps_on_the_device_are_those_of_the_definitions() -> None:
    """Three hundred robots that do what they like, against `measure` on the series of each."""
    torch = pytest.importorskip("torch")
    from pronk.evaluation.training_sim.flight import FlightRecorder

    rng = np.random.default_rng(8)
    count, length = 300, 360
    rules = JumpRules(
        flight_s=0.015,
        long_s=0.04,
        search_s=0.5,
        tail_s=0.1,
        upright_s=0.3,
        grace_s=0.2,
        # Of heights that walk at random about zero, some are over it and some not.
        standing_height=0.02,
        rise=0.03,
    )
    state = np.zeros((length, count, 13), np.float32)
    state[..., 0:3] = rng.normal(size=(length, count, 3)).cumsum(axis=0) * 0.02
    state[..., 3:7] = random_turns(rng, length, count)
    state[..., 7:13] = rng.normal(size=(length, count, 6))
    # Contacts that stay for a while: from one flight of a few steps to one without end.
    stay = rng.uniform(0.7, 0.97, size=count)
    airborne = np.zeros((length, count), bool)
    for k in range(1, length):
        airborne[k] = airborne[k - 1] ^ (rng.random(count) > stay)
    on = rng.integers(0, 300, size=count)
    on[::10] = NEVER
    end = np.where(rng.random(count) < 0.3, rng.integers(1, length, size=count), length)
    touching = rng.random((length, count)) < 0.003
    broken = np.flatnonzero(end < length)[::2]
    state[end[broken], broken, rng.integers(0, 13, size=len(broken))] = math.nan
    command = rng.normal(size=(count, 2))

    recorder = FlightRecorder(count, device="cpu", rules=rules, dt=DT)
    told = torch.tensor(on)
    for k in range(length):
        # The input may go on and off; its first rise counts.
        recorder.tell((k >= told) & ((k - told) % 7 < 4), k)
        alive = torch.tensor((k < end) | np.isin(np.arange(count), broken))
        contacts = (torch.tensor(airborne[k]), torch.tensor(touching[k]))
        recorder.add(torch.tensor(state[k]), *contacts, alive)
    got = recorder.figures(command)

    seen = {"touched": 0, "jumped": 0, "hopped": 0, "both": 0, "ran": 0, "upright": 0, "nothing": 0}
    for i in range(count):
        life = slice(0, end[i])
        whole = Series(
            position=state[life, i, 0:3].astype(float),
            velocity=state[life, i, 7:10].astype(float),
            orientation=state[life, i, 3:7].astype(float),
            contact=np.repeat(~airborne[life, i, None], 4, axis=1),
            dt=DT,
        )
        told_at = None if on[i] == NEVER else int(on[i])
        expected = None if told_at is None else measure(whole, told_at, command[i], rules)
        unasked = unasked_height(whole, told_at, rules)
        assert got["unasked"][i] == pytest.approx(unasked, abs=1e-6, nan_ok=True)
        if expected is None:
            expected = Jump(flights=0, long_flights=0, high_flights=0, height=math.nan)
            seen["nothing"] += 1
        for name, value in vars(expected).items():
            assert got[name][i] == pytest.approx(float(value), abs=1e-5, nan_ok=True), (i, name)
        touched = False
        if told_at is not None:
            main = answer(whole, told_at, rules).main
            # What fell lies there; without a jump the fall ends the window.
            lies = np.r_[touching[life, i], np.full(length - end[i], main is not None)]
            judged = main.touchdown + 60 if main else told_at + 100
            touched = bool(lies[told_at : judged + 1].any())
        assert got["touched"][i] == touched, i
        seen["touched"] += touched
        seen["jumped"] += expected.found
        seen["hopped"] += expected.high_flights > 2
        seen["both"] += expected.long_flights > expected.high_flights > 0
        seen["ran"] += expected.long_flights > 0 and not expected.found
        seen["upright"] += expected.upright
    assert min(seen.values()) > 15, seen


@dataclass(frozen=True, kw_only=True)
class Life:
    """One robot that is told to jump at sample 20, and whether it touched until it was judged."""

    flights: tuple[tuple[int, int], ...] = ((40, 60),)
    """First samples in the air and on the ground again."""
    touches: int = NEVER
    """The one sample with something else than a foot on the ground."""
    falls: int = NEVER
    """From here on it lies on its side."""
    touched: bool


LIVES = {
    "on its feet all the time": Life(touched=False),
    "before the command": Life(touches=19, touched=False),
    "with the command": Life(touches=20, touched=True),
    "in the air": Life(touches=50, touched=True),
    ".3 s after touchdown": Life(touches=120, touched=True),
    "later": Life(touches=121, touched=False),
    "before a late touchdown": Life(flights=((78, 108),), touches=100, touched=True),
    "after the longer of two": Life(flights=((40, 60), (75, 105)), touches=130, touched=True),
    "after the shorter of two": Life(flights=((40, 60), (75, 90)), touches=130, touched=False),
    "without a jump, .3 s after the command": Life(flights=(), touches=80, touched=True),
    "without a jump, later": Life(flights=(), touches=81, touched=False),
    "fell after the jump": Life(falls=100, touched=True),
    "fell later": Life(falls=121, touched=False),
    "fell in the air": Life(falls=50, touched=False),
    "fell before the command": Life(falls=10, touches=30, touched=False),
}


@pytest.mark.train
def test_what_touches_is_counted_as_a_trial_counts_it() -> None:
    """Each life by hand, on the device, and as a capture of the virtual robot."""
    torch = pytest.importorskip("torch")
    from pronk.evaluation.metrics import measure as measure_capture
    from pronk.evaluation.training_sim.flight import FlightRecorder
    from pronk.robots import load_robot
    from pronk.runtime.script import Script
    from pronk.virtual.capture import Capture

    rules = JumpRules(search_s=0.3, tail_s=0.1, upright_s=0.3)
    length, count = 200, len(LIVES)
    state = np.zeros((length, count, 13), np.float32)
    state[..., 2], state[..., 3] = rules.standing_height, 1.0
    airborne, touching, lies = (np.zeros((length, count), bool) for _ in range(3))
    for i, life in enumerate(LIVES.values()):
        for up, down in life.flights:
            airborne[up:down, i], state[up:down, i, 2] = True, rules.high + 0.01
        touching[life.touches : life.touches + 1, i] = True
        lies[life.falls :, i] = True
    state[lies, 3:7] = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)

    # One more, that walks: nobody tells it to jump, and its knees are on the ground.
    walker = np.arange(count + 1) == count
    whole = np.pad(state, ((0, 0), (0, 1), (0, 0)), mode="edge")
    recorder = FlightRecorder(count + 1, device="cpu", rules=rules, dt=DT)
    for k in range(length):
        recorder.tell(torch.tensor(~walker & (k >= 20)), k)
        recorder.add(
            torch.tensor(whole[k]),
            torch.tensor(np.r_[airborne[k], False]),
            torch.tensor(np.r_[touching[k], True]),
            torch.tensor(np.r_[~lies[k], True]),
        )
    got = recorder.figures(np.tile([1.0, 0.0], (count + 1, 1)))["touched"]

    script = Script(command=(1.0, 0.0, 0.0), stand_s=0.05, run_s=0.05)
    none = np.zeros((length, 12))
    for i, (name, life) in enumerate(LIVES.items()):
        capture = Capture(
            time=DT * np.arange(length),
            position=state[:, i, 0:3].astype(float),
            orientation=state[:, i, 3:7].astype(float),
            velocity=none[:, :3],
            angular_velocity=none[:, :3],
            foot_position=none.reshape(length, 4, 3),
            contact=np.repeat(~airborne[:, i, None], 4, axis=1),
            other_contact=touching[:, i] | lies[:, i],
            joint_position=none,
            joint_velocity=none,
            torque=none,
            electrical_power=none[:, 0],
            bus_voltage=none[:, 0],
        )
        trial = measure_capture(
            capture, script, load_robot("mini_cheetah"), began=0.0, mass=12.0, rules=rules
        )
        assert (trial.touched, got[i]) == (life.touched, life.touched), name
    assert got[count] == 0.0


@pytest.mark.train
def test_a_stride_is_in_the_raw_error_and_not_in_the_averaged() -> None:
    """Velocity = command + (.1, 0) + .3 sin: averaged .1, raw the mean of |.1 + .3 sin|."""
    torch = pytest.importorskip("torch")
    from pronk.evaluation.training_sim.walk import SpeedRecorder

    count, settle, end, average = 3, 150, 550, 100
    command = torch.tensor([[2.0, 0.0, 0.0]] * count)
    recorder = SpeedRecorder(command, settle=settle, end=end, average=average)
    # Each robot looks elsewhere; velocities are given in the world's frame.
    yaw = np.array([0.0, 1.0, -2.5])
    errors = []
    for k in range(600):
        swing = 0.3 * math.sin(2.0 * math.pi * k / 50.0) if k < end else 50.0
        forward = 2.1 + swing if k >= 40 else 0.0
        state = np.zeros((count, 13), np.float32)
        state[:, 0] = 2.1 * DT * k
        state[:, 3], state[:, 6] = np.cos(yaw / 2), np.sin(yaw / 2)
        state[:, 7], state[:, 8] = forward * np.cos(yaw), forward * np.sin(yaw)
        state[:, 12] = 0.25
        if settle <= k < end:
            errors.append(abs(0.1 + swing))
        # The last robot falls half way; what it does then is lost.
        alive = torch.tensor([True, True, k < 350])
        if k >= 350:
            state[2] = math.nan if k == 360 else 9.0
        recorder.add(torch.tensor(state), alive)
    got = recorder.figures()
    assert got["speed_error"] == pytest.approx(
        [np.mean(errors), np.mean(errors), np.mean(errors[:200])], abs=1e-5
    )
    assert got["speed_error_averaged"] == pytest.approx([0.1] * 3, abs=1e-5)
    assert got["yaw_error"] == pytest.approx([0.25] * 3, abs=1e-6)
    assert got["yaw_error_averaged"] == pytest.approx([0.25] * 3, abs=1e-6)
    assert got["velocity"] == pytest.approx(np.array([[2.1, 0.0, 0.25]] * 3), abs=1e-5)
    assert got["drift"] == pytest.approx(2.1 * DT * np.array([399, 399, 199]), abs=1e-4)


@pytest.mark.train
def test_a_robot_that_never_settled_has_no_error() -> None:
    torch = pytest.importorskip("torch")
    from pronk.evaluation.training_sim.walk import SpeedRecorder

    recorder = SpeedRecorder(torch.zeros(1, 3), settle=2, end=5, average=2)
    for _ in range(5):
        recorder.add(torch.ones(1, 13), torch.tensor([False]))
    assert all(np.isnan(values).all() for values in recorder.figures().values())


@pytest.mark.train
def test_the_estimator_is_judged_on_robots_that_stand() -> None:
    torch = pytest.importorskip("torch")
    from pronk.evaluation.training_sim.walk import EstimatorRecorder

    recorder = EstimatorRecorder(2, "cpu")
    target = torch.tensor([[1.0, 0.0, 1.0, 0.0, 2.0, 0.0, 0.1]] * 2)
    probability = torch.tensor([[0.9, 0.1, 0.4, 0.6]] * 2)
    for error, alive in ((0.3, [True, True]), (0.1, [True, False])):
        velocity = target[:, 4:] + torch.tensor([error, 0.0, -2.0 * error])
        recorder.add((probability, velocity), target, torch.tensor(alive))
    got = recorder.sums()
    assert got["count"].tolist() == [2.0, 1.0]
    assert got["right"].tolist() == [1.0, 0.5]
    expected = [[0.09 + 0.01, 0.0, 4 * 0.10], [0.09, 0.0, 0.36]]
    assert got["squares"] == pytest.approx(np.array(expected), abs=1e-6)


# --- A run in mjlab ------------------------------------------------------------------------------

DROP = 0.3
"""Height that robots are let fall from [m]."""
SHORT = Plan(
    robots=2,
    seed=7,
    walks=(
        Case(name="forward 2", command=(2.0, 0.0, 0.0)),
        Case(name="stand", command=(0.0, 0.0, 0.0)),
    ),
    jumps=(Case(name="side +1", command=(0.0, 1.0, 0.0)),),
    walk_s=1.5,
    settle_s=0.8,
    stand_s=0.6,
    run_s=0.2,
    spread_s=0.2,
    jump_s=0.4,
    keep_s=0.1,
    # No grace: the fall at the start is a flight that nobody asked for.
    rules=JumpRules(search_s=0.2, tail_s=0.1, upright_s=0.2, grace_s=0.001),
)
BIAS = 0.1
"""Error of the estimate, forward [m/s]."""


@dataclass
class Seen:
    """A run, and what a second pair of eyes saw of it."""

    evaluation: Evaluation
    state: np.ndarray
    airborne: np.ndarray
    touching: np.ndarray
    alive: np.ndarray
    looks: list[tuple[int, np.ndarray, np.ndarray]]
    """Sample, command and jump input each time the policy looked."""
    shares: list[float]


@pytest.fixture(scope="module")
def seen() -> Seen:
    """Six robots fall .3 m onto their feet; policy steps of 2 to 6 physics steps; one lies down."""
    torch = pytest.importorskip("torch")
    pytest.importorskip("mjlab")
    from mjlab.envs import ManagerBasedRlEnv

    from pronk.evaluation.training_sim.evaluate import evaluate_policy, evaluation_cfg
    from pronk.evaluation.training_sim.run import TERM
    from pronk.train.mdp.randomization import Randomization
    from pronk.train.tasks import env_cfg

    cfg = env_cfg(randomization=replace(Randomization.none(), decimation=(-2, 2)))
    cfg.events["start"].params = dict.fromkeys(("place", "speed", "heading", "joints"), 0.0)
    state = cfg.scene.entities["robot"].init_state
    state.pos = (0.0, 0.0, state.pos[2] + DROP)
    env = ManagerBasedRlEnv(evaluation_cfg(cfg, SHORT), device="cpu")
    ear = env.metrics_manager.cfg[TERM].func
    states, airborne, touching, looks, shares = [], [], [], [], []

    def watch(state: Any, flying: Any, limbs: Any, alive: Any) -> None:
        states.append((state.numpy().copy(), alive.numpy().copy()))
        airborne.append(flying.numpy().copy())
        touching.append(limbs.numpy().copy())

    def policy(obs: Any) -> Any:
        if not looks:
            flights = ear.listener.__self__.flights
            add = flights.add
            flights.add = lambda *sample: (watch(*sample), add(*sample))
        jump = obs["jump"][:, 0].numpy().copy()
        looks.append((len(states), obs["measured"][:, -3:].numpy().copy(), jump))
        actions = torch.zeros(SHORT.size, 12)
        if len(states) > 60:
            actions[5] = torch.tensor([2.0, 2.0, -4.0, 2.0, 0.0, 0.0] * 2)
        return actions

    def estimate(obs: Any) -> Any:
        truth = obs["target"].clone()
        truth[:, 4] += BIAS
        return truth[:, :4], truth[:, 4:]

    found = evaluate_policy(policy, env, SHORT, estimate=estimate, progress=shares.append)
    env.close()
    return Seen(
        evaluation=found,
        state=np.stack([state for state, _ in states]),
        airborne=np.stack(airborne),
        touching=np.stack(touching),
        alive=np.stack([alive for _, alive in states]),
        looks=looks,
        shares=shares,
    )


@pytest.mark.train
def test_contacts_belong_to_the_positions_they_are_paired_with(seen: Seen) -> None:
    """The feet meet the ground when the trunk is at standing height: 12 mm a sample by then."""
    z = seen.state[:, 0, 2]
    landing = int(np.argmin(seen.airborne[:, 0]))
    samples = np.arange(landing)
    fall = SHORT.rules.standing_height + DROP - 0.5 * 9.81 * DT**2 * samples * (samples + 1)
    assert z[:landing] == pytest.approx(fall, abs=1e-4)
    assert z[landing - 1] - z[landing] == pytest.approx(0.012, abs=1e-3)
    assert z[landing] <= SHORT.rules.standing_height < z[landing - 1]


@pytest.mark.train
def test_what_touches_is_of_the_same_moment(seen: Seen) -> None:
    """Fallen .3 m and held by soft drives alone they sink onto their knees, feet first."""
    first = seen.touching[:, :5].argmax(axis=0)
    landing = seen.airborne[:, :5].argmin(axis=0)
    assert np.all((first > landing) & (first < landing + 40))
    assert seen.state[first, range(5), 2].max() < SHORT.rules.standing_height - 0.05


@pytest.mark.train
def test_the_policy_sees_the_command_of_the_moment(seen: Seen) -> None:
    commands, times = SHORT.commands(), SHORT.times(DT)
    samples = [sample for sample, _, _ in seen.looks]
    assert {2, 3, 4, 5, 6} == set(np.diff(samples))
    for sample, command, _ in seen.looks:
        moving = (times["start"] <= sample) & (sample < times["stop"])
        assert np.array_equal(command, np.where(moving[:, None], commands, 0.0))
    # The jump input comes within the longest wait after it is asked for, and stays as long.
    now = np.array(samples)[:, None]
    asked = (times["on"] <= now) & (now < times["off"])
    jumps = np.array([jump > 0.0 for _, _, jump in seen.looks])
    for robot in np.flatnonzero(asked.any(axis=0)):
        wait = int(jumps[:, robot].argmax() - asked[:, robot].argmax())
        assert 0 <= wait <= round(MOST_S / 0.02)
        assert jumps[:, robot].sum() == asked[:, robot].sum() - wait
    assert not jumps[~asked].any()


@pytest.mark.train
def test_a_run_says_what_the_definitions_say(seen: Seen) -> None:
    found, rules = seen.evaluation, SHORT.rules
    first = {i: next(s for s, _, jump in seen.looks if jump[i]) for i in (4, 5)}
    results = (*found.walks, *found.jumps)
    for i in range(SHORT.size):
        end = int(np.argmin(seen.alive[:, i])) if not seen.alive[-1, i] else len(seen.alive)
        whole = Series(
            position=seen.state[:end, i, 0:3].astype(float),
            velocity=seen.state[:end, i, 7:10].astype(float),
            orientation=seen.state[:end, i, 3:7].astype(float),
            contact=np.repeat(~seen.airborne[:end, i, None], 4, axis=1),
            dt=DT,
        )
        assert unasked_height(whole, first.get(i), rules) == pytest.approx(
            SHORT.rules.standing_height + DROP, abs=2e-3
        )
        if i == 4:
            jump = measure(whole, first[i], SHORT.commands()[i], rules)
            assert jump is not None
            assert found.jumps[0].height.mean == pytest.approx(jump.height, abs=1e-5)
            assert found.jumps[0].height.mean > 1e-4
            # It did not jump; the other one fell before it was told.
            knees = seen.touching[first[i] : first[i] + 41, i].any()
            assert found.jumps[0].touched == knees / 2
    assert [r.unasked.share for r in results] == [1.0, 1.0, 1.0]
    assert [r.unasked.highest for r in results] == pytest.approx([DROP] * 3, abs=2e-3)
    stood = found.walks[1]
    assert (stood.falls, found.walks[0].falls) == (0.0, 0.0)
    # 0.8 to 1.5 s.
    walked = seen.state[160:300, :4]
    turns = Rotation.from_quat(np.roll(walked[..., 3:7].reshape(-1, 4), -1, axis=-1))
    velocity = turns.inv().apply(walked[..., 7:10].reshape(-1, 3))[:, :2].reshape(140, 4, 2)
    errors = np.linalg.norm(velocity - SHORT.commands()[:4, :2], axis=-1).mean(axis=0)
    assert errors.min() > 0.01
    assert found.walks[0].speed_error.mean == pytest.approx(errors[:2].mean(), abs=1e-5)
    assert stood.speed_error.mean == pytest.approx(errors[2:].mean(), abs=1e-5)
    assert (found.walks[0].speed_error.n, found.jumps[0].robots) == (2, 2)


@pytest.mark.train
def test_a_robot_that_lies_down_is_out(seen: Seen) -> None:
    jump = seen.evaluation.jumps[0]
    assert seen.alive[:, :5].all()
    assert not seen.alive[-1, 5]
    # It lay down before the command.
    assert np.argmin(seen.alive[:, 5]) < SHORT.times(DT)["on"][5]
    assert (jump.told, jump.height.n, jump.found, jump.upright) == (1, 1, 0.0, 0.0)


@pytest.mark.train
def test_the_estimate_is_compared_with_the_truth(seen: Seen) -> None:
    estimator = seen.evaluation.estimator
    assert estimator is not None
    assert estimator.rmse == pytest.approx((BIAS, 0.0, 0.0), abs=1e-6)
    assert estimator.rmse_vector == pytest.approx(BIAS, abs=1e-6)
    assert estimator.contacts_right == 1.0


@pytest.mark.train
def test_progress_rises_to_one(seen: Seen) -> None:
    assert seen.shares[0] == 0.0
    assert seen.shares[-1] == 1.0
    assert np.all(np.diff(seen.shares) > 0.0)


@pytest.mark.train
def test_a_run_is_written_and_shown(
    seen: Seen, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from pronk.cli.evaluate import show
    from pronk.evaluation.training_sim.evaluate import write

    path = tmp_path / "evaluation.json"
    write(path, seen.evaluation)
    found = evaluate_result.load(path)
    assert repr(found.walks) == repr(seen.evaluation.walks)
    assert found.plan["rules"]["search_s"] == 0.2
    show(found)
    said = capsys.readouterr().out
    assert "forward 2: speed error" in said
    assert "jump side +1: distance" in said
    assert "touched: anything but a foot on the ground" in said
    assert "velocity RMSE 0.100 m/s" in said


@pytest.mark.train
def test_an_environment_of_training_is_refused() -> None:
    pytest.importorskip("mjlab")
    from types import SimpleNamespace

    from pronk.evaluation.training_sim.evaluate import evaluate_policy

    plain = SimpleNamespace(metrics_manager=SimpleNamespace(cfg=None), num_envs=6)
    with pytest.raises(PronkError, match="6 robots and no evaluation term; this plan needs one"):
        evaluate_policy(lambda obs: obs, SimpleNamespace(unwrapped=plain), SHORT)


# --- Who is evaluated ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    """The folder of a run with one checkpoint of random weights, and its actor."""
    torch = pytest.importorskip("torch")
    pytest.importorskip("mjlab")
    from pronk.evaluation.training_sim.subject import blank_actor
    from pronk.train.runner import checkpoint
    from pronk.train.runner.run_folder import RunFolder

    torch.manual_seed(5)
    actor = blank_actor(jump=True)
    folder = RunFolder(tmp_path_factory.mktemp("run"))
    about = {"phase": "jump_b", "gains": "matched", "gains_sha256": "ab" * 32}
    tree = {"algorithm": {"actor_state_dict": actor.state_dict()}}
    path = checkpoint.numbered(folder.checkpoints, 7)
    checkpoint.save(path, checkpoint.Checkpoint(about=about, tree=tree))
    return folder.path, actor


@pytest.mark.train
def test_a_run_is_evaluated_by_its_last_checkpoint(trained: tuple[Path, Any]) -> None:
    torch = pytest.importorskip("torch")
    from tensordict import TensorDict

    from pronk.evaluation.training_sim.subject import load_subject
    from pronk.robots import load_robot
    from pronk.train.gains import training_gains

    folder, actor = trained
    subject = load_subject(folder, "cpu")
    obs = TensorDict({"measured": torch.randn(5, 105), "jump": torch.ones(5, 1)}, [5])
    with torch.no_grad():
        assert torch.equal(subject.act(obs), actor(obs))
        assert subject.estimate is not None
        assert torch.equal(subject.estimate(obs)[1], actor.estimate(obs)[1])
    assert subject.jump
    assert subject.about["phase"] == "jump_b"
    naive = training_gains("naive", load_robot("mini_cheetah"))
    assert not subject.knows(naive)
    matched = replace(naive, name="matched", sha256="ab" * 32)
    assert subject.knows(matched)
    assert not subject.knows(replace(matched, sha256="cd" * 32))


@pytest.mark.train
def test_what_is_no_policy_is_refused(trained: tuple[Path, Any], tmp_path: Path) -> None:
    pytest.importorskip("mjlab")
    from pronk.evaluation.training_sim.subject import load_subject
    from pronk.train.runner import checkpoint

    with pytest.raises(ArtefactError, match="no checkpoints in it; expected the folder of a run"):
        load_subject(tmp_path, "cpu")
    with pytest.raises(ArtefactError, match="no such file"):
        load_subject(tmp_path / "policy.onnx", "cpu")
    with pytest.raises(ArtefactError, match="no such file"):
        load_subject(tmp_path / "model_3.pt", "cpu")
    found = checkpoint.load(trained[0] / "checkpoints" / "model_7.pt")
    walking = tmp_path / "model_1.pt"
    about = {**found.about, "phase": "walk"}
    checkpoint.save(walking, checkpoint.Checkpoint(about=about, tree=found.tree))
    with pytest.raises(ArtefactError, match="its actor is not that of this pronk"):
        load_subject(walking, "cpu")


@pytest.mark.train
def test_an_exported_policy_does_what_its_checkpoint_does(
    trained: tuple[Path, Any], tmp_path: Path
) -> None:
    torch = pytest.importorskip("torch")
    pytest.importorskip("onnxruntime")
    from tensordict import TensorDict

    from pronk.evaluation.training_sim.subject import load_subject
    from pronk.robots import load_robot
    from pronk.train.gains import training_gains
    from pronk.train.rl.export import contract_for, export_policy

    robot = load_robot("mini_cheetah")
    gains = training_gains("naive", robot)
    contract = contract_for(
        robot,
        gains,
        action_scale=0.35,
        delay_steps=(0, 1),
        command_limits=(3.0, 1.0, 2.0),
        lift_off_velocity=2.5,
        provenance={},
    )
    path = tmp_path / "policy.onnx"
    export_policy(trained[1], contract, path)
    subject, original = load_subject(path, "cpu"), load_subject(trained[0], "cpu")
    assert subject.jump
    assert subject.knows(gains)
    assert subject.estimate is not None
    assert original.estimate is not None
    # More robots than cores, fewer robots than cores, and each answer to its own question.
    for count in (33, 1):
        for _ in range(2):
            groups = {"measured": torch.randn(count, 105), "jump": torch.ones(count, 1)}
            obs = TensorDict(groups, [count])
            with torch.no_grad():
                assert torch.allclose(subject.act(obs), original.act(obs), atol=1e-5)
                for got, expected in zip(
                    subject.estimate(obs), original.estimate(obs), strict=True
                ):
                    assert torch.allclose(got, expected, atol=1e-5)


# --- The command ---------------------------------------------------------------------------------


@pytest.mark.train
def test_a_run_is_evaluated_with_everything_drawn(trained: tuple[Path, Any]) -> None:
    pytest.importorskip("mjlab")
    from pronk.cli.evaluate import run
    from pronk.evaluation.training_sim.subject import load_subject
    from pronk.robots import load_robot
    from pronk.train.gains import training_gains

    plan = replace(SHORT, robots=1, walk_s=1.0, jumps=())
    gains = training_gains("naive", load_robot("mini_cheetah"))
    before = {"forward 2": 0.1}
    found = run(load_subject(trained[0], "cpu"), gains, plan, "cpu", "full", before)
    assert [walk.name for walk in found.walks] == ["forward 2", "stand"]
    assert found.jumps == ()
    assert found.before == before
    assert found.about["randomization"] == "full"
    assert found.about["policy"]["phase"] == "jump_b"
    assert found.about["gains"] == {"name": "naive", "sha256": "", "virtual": False}
    assert found.about["device"]["device"] == "cpu"
    assert found.about["versions"]["mjlab"]


@pytest.mark.train
def test_one_robot_is_measured_many_times_with_noise_alone() -> None:
    pytest.importorskip("mjlab")
    from pronk.cli.evaluate import Drawn
    from pronk.evaluation.training_sim.run import RANDOMIZATIONS
    from pronk.robots import load_robot
    from pronk.train.gains import training_gains
    from pronk.train.mdp.randomization import delay_steps, events, noise

    assert {drawn.value for drawn in Drawn} == set(RANDOMIZATIONS)
    full, alone, none = (RANDOMIZATIONS[name] for name in ("full", "noise", "none"))
    robot = load_robot("mini_cheetah")
    gains = training_gains("naive", robot)
    assert noise(alone) == noise(full)
    assert delay_steps(robot, gains, alone) == delay_steps(robot, gains, full)
    # Of all that can be drawn, bodies, gains and pushes are not.
    assert list(events(robot, gains, alone)) == ["decimation"]
    assert events(robot, gains, none) == {}


@pytest.mark.train
def test_a_policy_that_cannot_jump_is_not_asked_to(
    trained: tuple[Path, Any], tmp_path: Path
) -> None:
    pytest.importorskip("mjlab")
    from pronk.cli.evaluate import What, evaluate
    from pronk.evaluation.training_sim.subject import blank_actor
    from pronk.train.runner import checkpoint

    path = tmp_path / "model_1.pt"
    tree = {"algorithm": {"actor_state_dict": blank_actor(jump=False).state_dict()}}
    checkpoint.save(path, checkpoint.Checkpoint(about={"phase": "walk"}, tree=tree))
    with pytest.raises(PronkError, match="without the jump input; evaluate it with --what walk"):
        evaluate(path, "naive", tmp_path / "evaluation.json", what=What.JUMP)
    with pytest.raises(PronkError, match=r"expected a name that ends in \.json"):
        evaluate(path, "naive", tmp_path / "evaluation.yaml")
