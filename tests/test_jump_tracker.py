"""The jump tracker: scripted jumps, and an account of it in plain Python."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pronk.errors import PronkError

torch = pytest.importorskip("torch")

from pronk.train.jump import JumpSettings, JumpTracker  # noqa: E402

pytestmark = pytest.mark.train

DT = 1 / 64
"""A power of two, so that times add up exactly."""
SETTINGS = JumpSettings(
    liftoff_velocity=2.5, prompt_s=16 * DT, late_s=16 * DT, settle_s=8 * DT, stroke=0.5
)
EVENTS = ("gain", "rise", "reach", "hop")
TRACES = (*EVENTS, "mode", "since", "best", "stroke", "farthest", "liftoffs", "airborne")


@dataclass(frozen=True)
class Step:
    """What one robot is told and does in a step."""

    jump: bool = False
    air: bool = False
    height: float = 0.3
    speed: float = 0.0
    miss: float = 0.0
    along: float = 0.0


def script(jump: str, air: str, speed: dict[int, float] | None = None) -> list[Step]:
    """Strings of 0 and 1, one sign a step; vertical speeds of some steps."""
    speed = speed or {}
    return [
        Step(jump=j == "1", air=a == "1", speed=speed.get(i, 0.0))
        for i, (j, a) in enumerate(zip(jump, air, strict=True))
    ]


def play(
    robots: list[list[Step]],
    *,
    width: float = 1.0,
    tracker: JumpTracker | None = None,
) -> dict[str, list[list[float]]]:
    """Every trace of every robot: name to robots to steps."""
    tracker = tracker or JumpTracker(len(robots), "cpu", SETTINGS, width)
    traces: dict[str, list[list[float]]] = {name: [[] for _ in robots] for name in TRACES}
    for steps in zip(*robots, strict=True):
        foot = torch.tensor([[not step.air, False, False, False] for step in steps])
        tracker.advance(
            jump=torch.tensor([step.jump for step in steps]),
            contact=foot,
            height=torch.tensor([step.height for step in steps]),
            vertical=torch.tensor([step.speed for step in steps]),
            miss=torch.tensor([step.miss for step in steps]),
            along=torch.tensor([step.along for step in steps]),
            dt=DT,
        )
        for name in TRACES:
            for trace, value in zip(traces[name], getattr(tracker, name).tolist(), strict=True):
                trace.append(float(value))
    return traces


def alone(steps: list[Step], **how: Any) -> dict[str, list[float]]:
    """The traces of a single robot."""
    return {name: trace[0] for name, trace in play([steps], **how).items()}


# --- Scripted -------------------------------------------------------------------------------------


def test_one_jump_by_hand() -> None:
    """Told in step 2, in the air from step 5 to 7, down in step 8."""
    seen = alone(script("0011110000", "0000011100", {4: 2.0, 5: 1.75, 6: 1.0}))
    assert seen["mode"] == [0, 0, 1, 1, 1, 1, 1, 1, 1, 1]
    assert seen["since"] == [0, 0, *(i * DT for i in range(1, 9))]
    assert seen["liftoffs"] == [0, 0, 0, 0, 0, 1, 1, 1, 1, 1]
    # The faster of the samples before and after lift-off, 2.0: exp(-(2.0 - 2.5)^2 / 2).
    assert seen["gain"] == pytest.approx([0] * 5 + [math.exp(-0.125)] + [0] * 4)
    assert seen["best"] == pytest.approx([0] * 5 + [math.exp(-0.125)] * 5)
    assert seen["hop"] == [0] * 10


@pytest.mark.parametrize(
    ("speed", "width", "worth"),
    [(2.5, 1.0, 1.0), (1.5, 1.0, 0.606531), (3.5, 1.0, 0.606531), (2.1, 0.4, 0.606531)],
)
def test_kernel_of_the_lift_off_velocity(speed: float, width: float, worth: float) -> None:
    """exp(-(v - 2.5)^2 / (2 width^2)): one width off is worth exp(-1/2)."""
    seen = alone(script("0111", "0001", {3: speed}), width=width)
    assert seen["gain"] == pytest.approx([0, 0, 0, worth], rel=1e-5)


@pytest.mark.parametrize(
    ("miss", "width", "worth"), [(0.0, 0.3, 1.0), (0.3, 0.3, 0.803265), (1.0, 0.1, 0.5)]
)
def test_half_the_worth_is_for_going_where_the_command_says(
    miss: float, width: float, worth: float
) -> None:
    """1/2 + exp(-miss^2 / (2 width^2)) / 2: one width off costs half of 1 - exp(-1/2)."""
    before = script("011", "000")
    liftoff = Step(jump=True, air=True, speed=2.5, miss=miss)
    tracker = JumpTracker(1, "cpu", replace(SETTINGS, aim_width=width), 0.7)
    seen = alone([*before, liftoff], tracker=tracker)
    assert seen["gain"][-1] == pytest.approx(worth, rel=1e-5)


@pytest.mark.parametrize(
    ("steps", "worth"), [(1, 1.0), (16, 1.0), (20, 0.75), (24, 0.5), (32, 0.0), (40, 0.0)]
)
def test_late_jumps_are_worth_less(steps: int, worth: float) -> None:
    """In full until 16 steps after the command, nothing from 32 on, a line between.

    The step in which the command came is the first.
    """
    told, waits = "0" + "1" * steps, "0" + "0" * (steps - 1) + "1"
    seen = alone(script(told, waits, {steps: 2.5}))
    assert seen["since"][-1] == steps * DT
    assert seen["gain"][-1] == pytest.approx(worth)
    assert seen["liftoffs"][-1] == 1


def test_many_small_hops_earn_no_more_than_the_best() -> None:
    speed = {2: 1.0, 5: 1.5, 8: 1.25, 11: 1.5}
    seen = alone(script("1" * 13, "0010010010010", speed))
    best = math.exp(-0.5)
    first = math.exp(-1.125)
    gain = [0.0] * 13
    gain[2], gain[5] = first, best - first
    assert seen["gain"] == pytest.approx(gain)
    assert sum(seen["gain"]) == pytest.approx(best)
    assert [i for i, hop in enumerate(seen["hop"]) if hop] == [5, 8, 11]


def test_a_micro_hop_before_the_jump_costs_nothing_but_the_hop() -> None:
    seen = alone(script("1" * 8, "00100011", {2: 0.1, 6: 2.5}))
    jump = alone(script("1" * 8, "00000011", {6: 2.5}))
    assert sum(seen["gain"]) == pytest.approx(sum(jump["gain"]))
    assert (sum(seen["hop"]), sum(jump["hop"])) == (1, 0)


def test_each_command_is_paid_anew() -> None:
    jump = {2: 2.5, 7: 2.5}
    seen = alone(script("1110111111", "0010000100", jump))
    assert [i for i, gain in enumerate(seen["gain"]) if gain] == [2, 7]
    assert seen["hop"] == [0] * 10
    assert seen["liftoffs"] == [0, 0, 1, 1, 0, 0, 0, 1, 1, 1]
    assert seen["since"][3:6] == [4 * DT, DT, 2 * DT]


def test_without_a_command_nothing_is_paid() -> None:
    seen = alone(script("0" * 8, "00110100", {2: 2.5, 5: 2.5}))
    assert all(not any(seen[name]) for name in (*EVENTS, "mode", "since", "best", "liftoffs"))
    assert seen["airborne"] == [0, 0, 1, 1, 0, 1, 0, 0]


def test_in_the_air_already_when_the_command_comes() -> None:
    """That flight is nobody's jump; the next one is the first."""
    seen = alone(script("00111111", "01110010", {6: 2.5}))
    assert [i for i, gain in enumerate(seen["gain"]) if gain] == [6]
    assert not any(seen["hop"])


def test_mode_ends_once_the_robot_stood_long_enough() -> None:
    """settle_s of 8 steps: the input is off from step 4 on, the ground is back in step 10."""
    flight = "0000" + "0" + "11111" + "0" * 12
    seen = alone(script("0011" + "0" * 18, flight))
    # Step 4 stands with the input off: one of the eight. Seven more from step 10 on.
    assert seen["mode"] == [0, 0] + [1] * 14 + [0] * 6
    assert seen["since"][16:] == [0] * 6


def test_input_that_goes_off_in_the_air() -> None:
    """The whole of settle_s runs after touchdown."""
    seen = alone(script("0" + "111" + "0" * 14, "0001111" + "0" * 11))
    assert seen["mode"] == [0] + [1] * 13 + [0] * 4


def test_mode_stays_in_the_air_and_under_the_command() -> None:
    assert alone(script("1" + "0" * 40, "0" + "1" * 40))["mode"] == [1] * 41
    assert alone(script("1" * 40, "0" * 40))["mode"] == [1] * 40


def test_a_lift_off_before_the_mode_ends_is_paid() -> None:
    """Input off in step 2, lift-off in step 6: still of this command."""
    seen = alone(script("0100000", "0000001", {6: 2.5}))
    assert seen["gain"][-1] == pytest.approx(1.0)


def test_rise_is_the_way_from_the_lowest_to_the_highest_trunk() -> None:
    heights = [0.3, 0.25, 0.2, 0.28, 0.5, 0.4, 0.6, 0.9, 1.0, 0.3]
    jump = [False, *[True] * 9]
    seen = alone([Step(jump=j, height=h) for j, h in zip(jump, heights, strict=True)])
    # The command comes at .25, the crouch adds .05; .5 is as much as is paid.
    assert seen["rise"] == pytest.approx([0, 0, 0.05, 0.03, 0.22, 0, 0.1, 0.1, 0, 0], abs=1e-6)
    assert seen["stroke"] == pytest.approx(
        [0, 0, 0.05, 0.08, 0.3, 0.3, 0.4, 0.5, 0.5, 0.5], abs=1e-6
    )


def test_a_deep_landing_is_no_crouch() -> None:
    """Lift-off in step 2: what is lower after it was not pushed from."""
    heights = [0.3, 0.25, 0.4, 0.5, 0.1, 0.3]
    air = [False, False, True, True, False, False]
    steps = [Step(jump=True, air=a, height=h) for a, h in zip(air, heights, strict=True)]
    assert alone(steps)["rise"] == pytest.approx([0, 0.05, 0.1, 0.1, 0, 0], abs=1e-6)


def test_reach_is_the_ground_covered_in_the_longest_flight() -> None:
    """Steps 2 to 4 and 6 to 9 in the air; the first of each is its lift-off."""
    steps = [
        Step(jump=True, air=a == "1", along=v)
        for a, v in zip("00111011110", [4, 4, 4, 2, 1, 4, 4, 2, 2, 1, 4], strict=True)
    ]
    seen = alone(steps)
    expected = [0, 0, 0, 2, 1, 0, 0, 0, 1, 1, 0]
    assert seen["reach"] == pytest.approx([DT * value for value in expected])
    assert seen["farthest"][-1] == pytest.approx(5 * DT)


def test_flying_backwards_reaches_nothing() -> None:
    steps = [Step(jump=True, air=i > 1, along=-1.0) for i in range(6)]
    assert alone(steps)["reach"] == [0] * 6


def test_flights_without_a_command_reach_nothing() -> None:
    assert alone([Step(air=True, along=3.0)] * 6)["reach"] == [0] * 6


def test_the_next_command_begins_at_its_own_height() -> None:
    heights = [0.3, 0.6, 0.3, 0.3, 0.4]
    jump = [True, True, False, True, True]
    seen = alone([Step(jump=j, height=h) for j, h in zip(jump, heights, strict=True)])
    assert seen["rise"] == pytest.approx([0, 0.3, 0, 0, 0.1], abs=1e-6)


def test_reset_forgets_one_robot_and_no_other() -> None:
    begun = script("0111111", "0000100", {4: 2.0})
    goes_on = script("1110", "0010", {2: 2.5})
    tracker = JumpTracker(2, "cpu", SETTINGS, 1.0)
    play([begun, begun], tracker=tracker)
    tracker.reset(torch.tensor([1]))
    after = play([goes_on, goes_on], tracker=tracker)
    whole, anew = alone(begun + goes_on), alone(goes_on)
    for name in TRACES:
        assert after[name][0] == whole[name][len(begun) :]
        assert after[name][1] == anew[name]


@pytest.mark.parametrize("name", ["liftoff_velocity", "prompt_s", "late_s", "settle_s", "stroke"])
def test_settings_that_are_none_are_refused(name: str) -> None:
    with pytest.raises(PronkError, match=rf"JumpSettings\.{name} is 0\.0, not positive"):
        JumpSettings(**{name: 0.0})


# --- Any script -----------------------------------------------------------------------------------


@dataclass
class Account:
    """The same in plain Python, one robot, written from the docstrings."""

    settings: JumpSettings
    width: float
    told: bool = False
    was_up: bool = False
    settled: int | None = None
    """Steps on the ground with the input off; None out of jump mode."""
    age: int = 0
    speed: float = 0.0
    scores: list[float] = field(default_factory=list)
    highest: float = 0.0
    lowest: float = 0.0
    stroke: float = 0.0
    flown: float = 0.0
    farthest: float = 0.0

    def step(self, now: Step) -> dict[str, float]:
        s = self.settings
        new = now.jump and not self.told
        if new:
            self.age, self.scores, self.farthest = 0, [], 0.0
        if now.jump:
            self.settled = 0
        elif self.settled is not None and not now.air:
            self.settled += 1
            if self.settled * DT == s.settle_s:
                self.settled = None
        mode = self.settled is not None
        self.age = self.age + 1 if mode else 0
        paid = {"gain": 0.0, "hop": 0.0, "rise": 0.0, "reach": 0.0, "mode": float(mode)}
        if mode and now.air and not self.was_up:
            off = (max(self.speed, now.speed) - s.liftoff_velocity) / self.width
            late = min(max((self.age * DT - s.prompt_s) / s.late_s, 0.0), 1.0)
            score = math.exp(-(off**2) / 2) * (1.0 - late)
            paid["gain"] = max(score - max(self.scores, default=0.0), 0.0)
            paid["hop"] = float(len(self.scores) > 0)
            self.scores.append(score)
        if not mode or new:
            self.highest = self.lowest = now.height
            self.stroke = 0.0
        self.highest = max(self.highest, now.height)
        if not self.scores:
            self.lowest = min(self.lowest, now.height)
        stroke = min(self.highest - self.lowest, s.stroke)
        paid["rise"], self.stroke = stroke - self.stroke, stroke
        self.flown = self.flown + now.along * DT if mode and now.air and self.was_up else 0.0
        if self.flown > self.farthest:
            paid["reach"], self.farthest = self.flown - self.farthest, self.flown
        self.told, self.was_up, self.speed = now.jump, now.air, now.speed
        return paid


def stretches(values: st.SearchStrategy[bool]) -> st.SearchStrategy[list[bool]]:
    """Runs of 0 and 1 of 1 to 20 steps, 60 steps in all."""
    runs = st.lists(st.tuples(values, st.integers(1, 20)), min_size=12, max_size=12)
    return runs.map(lambda found: [v for v, n in found for _ in range(n)]).filter(
        lambda found: len(found) >= 60
    )


@st.composite
def scripts(draw: st.DrawFn) -> list[Step]:
    jump, air = draw(stretches(st.booleans())), draw(stretches(st.booleans()))
    height = draw(
        st.lists(st.integers(0, 56).map(lambda i: i / 64 + 0.125), min_size=60, max_size=60)
    )
    speed = draw(st.lists(st.integers(-96, 128).map(lambda i: i / 32), min_size=60, max_size=60))
    along = draw(st.lists(st.integers(-32, 128).map(lambda i: i / 32), min_size=60, max_size=60))
    return [
        Step(jump=j, air=a, height=h, speed=v, along=u)
        for j, a, h, v, u in zip(jump, air, height, speed, along, strict=False)
    ]


@settings(max_examples=50)
@given(steps=scripts(), width=st.sampled_from([0.4, 1.0]))
def test_any_script_is_paid_as_accounted(steps: list[Step], width: float) -> None:
    seen = alone(steps, width=width)
    account = Account(SETTINGS, width)
    for i, step in enumerate(steps):
        for name, value in account.step(step).items():
            assert seen[name][i] == pytest.approx(value, abs=1e-5), (name, i)


@settings(max_examples=50)
@given(steps=scripts())
def test_no_script_is_paid_more_than_one_good_jump_a_command(steps: list[Step]) -> None:
    seen = alone(steps)
    edges = [i for i, now in enumerate(steps) if now.jump and not (i and steps[i - 1].jump)]
    for begin, end in itertools.pairwise([*edges, len(steps)]):
        gain, rise, reach, hop = (seen[name][begin:end] for name in EVENTS)
        assert min(*gain, 0.0) == 0.0
        assert sum(gain) == pytest.approx(max(seen["best"][begin:end]), abs=1e-5)
        assert sum(gain) <= 1.0 + 1e-5
        assert min(*rise, 0.0) == 0.0
        assert sum(rise) <= SETTINGS.stroke + 1e-5
        assert min(*reach, 0.0) == 0.0
        assert sum(reach) == pytest.approx(max(seen["farthest"][begin:end]), abs=1e-5)
        assert sum(hop) == max(max(seen["liftoffs"][begin:end]) - 1, 0)


@settings(max_examples=20)
@given(robots=st.lists(scripts(), min_size=2, max_size=3))
def test_robots_know_nothing_of_each_other(robots: list[list[Step]]) -> None:
    length = min(len(steps) for steps in robots)
    robots = [steps[:length] for steps in robots]
    together = play(robots)
    for i, steps in enumerate(robots):
        apart = alone(steps)
        for name in TRACES:
            assert together[name][i] == pytest.approx(apart[name], abs=1e-6)
