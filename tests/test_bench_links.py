"""`pronk bench links`: the rule by hand, the parts of a round, and one small round by wire."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from hopper import write_hopper
from pronk.bench import links_round
from pronk.bench.links import Settings, run
from pronk.bench.links_clock import Clock, disturbance
from pronk.bench.links_result import ALL, Jump, LinksBench, difference
from pronk.bench.links_round import between
from pronk.bench.links_tables import tables
from pronk.bench.twin_apart import TwinApart
from pronk.commands.bench_links import links
from pronk.deploy.plan import Plan
from pronk.deploy.stance import Timing
from pronk.errors import ArtefactError, HardwareError, PronkError
from pronk.hardware.capture import Capture
from pronk.hardware.truth import load_truth
from pronk.hardware.virtual import VirtualRobot
from pronk.robots import load_robot
from pronk.trial.metrics import JumpFigures
from pronk.trial.protocol import Case, Script

ROBOT = load_robot("mini_cheetah")
CASES = ("forward 1", "back 2")
# Half the time of a round is standing up and sitting down. The hop is as high as with the shipped
# times (7.6 and 7.7 cm); much shorter ones make it another hop.
QUICK = Timing(damp_s=0.3, fold_s=0.5, rise_s=0.7, ramp_s=0.2, blend_s=0.2, halt_s=0.2, sit_s=0.5)


def jumps(link: str, case: str, heights: list[float], fault: str = "") -> list[Jump]:
    return [
        Jump(
            link=link,
            case=case,
            number=k,
            figures=JumpFigures(told=True, found=True, upright=True, height=h, distance=2.0 * h),
            fault=fault,
        )
        for k, h in enumerate(heights)
    ]


def bench(other: list[float]) -> LinksBench:
    rows = []
    for case in CASES:
        rows += jumps("twin", case, [0.30, 0.32, 0.34])
        rows += jumps("lcm", case, other)
    return LinksBench(
        policy="matched",
        sha256="00",
        links=("twin", "lcm"),
        cases=CASES,
        seed=0,
        jumps=tuple(rows),
        rounds=(),
        refused=(),
        seconds=1.0,
    )


def test_the_rule_by_hand() -> None:
    # Both spreads .02, n = 3 each: SE^2 = 2 * .0004 / 3 with 4 degrees, t = 2.776445.
    a, b = np.array([0.30, 0.32, 0.34]), np.array([0.33, 0.35, 0.37])
    value, half = difference([(a, b)])
    assert value == pytest.approx(-0.03)
    assert half == pytest.approx(2.776445 * math.sqrt(0.0008 / 3), rel=1e-6)
    # Two commands: the mean of the differences, SE / sqrt(2) and 8 degrees, t = 2.306004.
    value, half = difference([(a, b), (a, a)])
    assert value == pytest.approx(-0.015)
    assert half == pytest.approx(2.306004 * math.sqrt(0.0016 / 3) / 2.0, rel=1e-6)


def test_the_rule_is_welchs_test() -> None:
    from scipy.stats import ttest_ind

    rng = np.random.default_rng(0)
    a, b = rng.normal(0.3, 0.01, 5), rng.normal(0.31, 0.03, 9)
    value, half = difference([(a, b)])
    interval = ttest_ind(a, b, equal_var=False).confidence_interval(0.95)
    assert (value - half, value + half) == pytest.approx((interval.low, interval.high))


def test_links_that_are_alike_fall_outside_once_in_twenty() -> None:
    rng = np.random.default_rng(1)
    outside = 0
    for _ in range(2000):
        value, half = difference([(rng.normal(size=4), rng.normal(size=4))])
        outside += abs(value) > half
    # Welch's is a little careful at n = 4; three standard deviations of a binomial above.
    assert 50 < outside < 100 + 3 * math.sqrt(2000 * 0.05 * 0.95)


def test_one_jump_is_compared_with_nothing_and_no_scatter_forgives_nothing() -> None:
    one, two = np.array([0.3]), np.array([0.3, 0.3])
    assert all(map(math.isnan, difference([(one, two)])))
    assert all(map(math.isnan, difference([])))
    assert difference([(two, two)]) == (0.0, 0.0)


def test_within_and_the_bar() -> None:
    alike, apart = bench([0.31, 0.33, 0.35]), bench([0.40, 0.42, 0.44])
    assert [each.within for each in alike.differences("height")] == [True, True, True]
    assert (alike.outside, alike.passed) == (0, True)
    # Height and distance with two commands: four differences, of which one may fall outside.
    assert (len(apart.cells), apart.outside, apart.allowed, apart.passed) == (4, 4, 1, False)
    every = next(each for each in apart.differences("height") if each.case == ALL)
    assert every.n == (6, 6)
    assert every.value == pytest.approx(-0.10)
    # A link with nothing to show is not alike.
    none = replace(alike, jumps=tuple(jump for jump in alike.jumps if jump.link == "twin"))
    assert (none.outside, none.passed) == (4, False)
    json.dumps(apart.result(), default=list)
    titles = [str(table.title) for table in tables(apart)]
    assert len(titles) == 2
    assert "virtual" in titles[0]


def test_a_jump_with_a_fault_did_not_land() -> None:
    [well], [ill] = jumps("lcm", "x", [0.3]), jumps("lcm", "x", [0.3], fault="tilt")
    assert (well.landed, ill.landed) == (True, False)


def test_what_cannot_be_compared_is_refused() -> None:
    for given in ((), ("twin", "twin"), ("can",)):
        with pytest.raises(PronkError, match="link"):
            Settings(links=given)
    with pytest.raises(PronkError, match="0 jumps"):
        Settings(repeats=0)


def test_a_part_of_what_was_seen() -> None:
    robot = VirtualRobot(ROBOT, load_truth(), base="ground")
    robot.connect()
    robot.wait(0.3)
    seen: Capture = robot.capture()
    part = between(seen, 0.1, 0.2)
    assert part.time[0] == pytest.approx(0.1)
    assert len(part.time) == 100
    np.testing.assert_array_equal(part.torque, seen.torque[100:200])
    with pytest.raises(ArtefactError, match=r"nothing was seen from 5\.00 to 6\.00 s"):
        between(seen, 5.0, 6.0)


def test_what_was_late_is_found_and_nothing_else() -> None:
    ticks, steps = np.arange(0.0, 20.0, 0.002), np.arange(0.0, 20.0, 0.02)

    def late(**changes: object) -> str:
        given = {"ticks": ticks, "steps": steps, "hitches": ()} | changes
        return disturbance(5.0, 10.0, **given)  # type: ignore[arg-type]

    assert late() == ""
    assert late(ticks=ticks[(ticks < 7.0) | (ticks > 7.015)]).startswith("the servo paused for 1")
    assert late(ticks=ticks[(ticks < 12.0) | (ticks > 12.5)]) == ""
    assert late(steps=np.delete(steps, 300)) == "the policy paused for 40 ms"
    assert late(hitches=((7.0, 0.042, False),)) == "the virtual robot was 42 ms late"
    assert late(hitches=((4.9, 0.042, False), (10.1, 0.2, True))) == ""


def test_a_robot_that_stood_still_has_another_zero_from_then_on() -> None:
    clock = Clock(
        zero=100.5, hitches=((103.0, 0.05, False), (104.0, 0.2, True), (108.0, 0.3, True))
    )
    assert clock.zero_at(103.5) == pytest.approx(100.0)
    assert clock.zero_at(106.0) == pytest.approx(100.2)
    assert clock.zero_at(109.0) == pytest.approx(100.5)


def test_a_disturbed_jump_is_left_out() -> None:
    whole = bench([0.31, 0.33, 0.35])
    [odd] = jumps("lcm", CASES[0], [3.0])
    also = replace(whole, jumps=(*whole.jumps, replace(odd, disturbed="the servo paused")))
    assert also.disturbed == 1
    assert also.differences("height") == whole.differences("height")


def test_a_twin_that_cannot_begin_says_why(tmp_path: Path) -> None:
    words = ["twin", "mini_cheetah", "--link", "lcm", "--port", "7667"]
    with pytest.raises(HardwareError, match="was not ready: pronk: LCM port 7667"):
        TwinApart(words, tmp_path).__enter__()


@pytest.mark.live
@pytest.mark.slow
def test_a_jump_over_lcm_is_measured_as_the_trials(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("lcm")
    pytest.importorskip("onnxruntime")
    monkeypatch.setattr(links_round, "Plan", partial(Plan, timing=QUICK))
    monkeypatch.setattr(links_round, "PAUSE_S", 0.2)
    policy = write_hopper(tmp_path / "policy.onnx", strength=0.2)
    still = (0.0, 0.0, 0.0)
    settings = Settings(
        links=("trial", "lcm"),
        cases=(Case(name="still", command=still),),
        repeats=1,
        script=Script(command=still, stand_s=0.1, run_s=0.2, keep_s=0.1, stop_s=0.8),
    )
    found = run(policy, settings)
    # One during which this computer stood still is kept, left out, and jumped again.
    alone, wired = (jump for jump in found.jumps if not jump.disturbed)
    assert (alone.link, wired.link) == ("trial", "lcm")
    assert wired.fault == ""
    assert alone.figures.told
    assert wired.figures.told
    # The same legs throw the same body as high, but for how it had come to stand.
    assert alone.figures.height > 0.04
    assert wired.figures.height == pytest.approx(alone.figures.height, abs=0.03)
    assert found.rounds[-1]["state_to_command"]["n"] > 50
    assert found.result()["virtual"] is True


def test_the_command_refuses_before_anything_starts(tmp_path: Path) -> None:
    with pytest.raises(ArtefactError, match=r"none\.onnx"):
        links(tmp_path / "none.onnx", link=["dds"])
