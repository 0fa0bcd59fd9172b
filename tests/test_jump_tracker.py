"""The jump tracker: scripted jumps, and an account of it in plain Python."""

from __future__ import annotations

import itertools
import math
import random
from dataclasses import dataclass, field, fields, replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pronk.errors import PronkError
from pronk.robots.legged import legged

BODY = legged("mini_cheetah")

torch = pytest.importorskip("torch")

from pronk.train.mdp.jump import JumpSettings, JumpTracker

pytestmark = pytest.mark.train

DT = 1 / 64
"""A power of two, so that times add up exactly."""
SETTINGS = JumpSettings(
    liftoff_velocity=2.5,
    ready_s=DT,
    prompt_s=16 * DT,
    late_s=16 * DT,
    leap=0.5,
    settle_s=8 * DT,
    stroke=0.5,
    crouch=0.1875,
    gap=0.75,
    fall=8.0,
    fall_s=8 * DT,
    likeness_width=0.0625,
    haste=1e6,
)
"""Not even the first step after the command is hasty, and no running start too fast."""
WAITS = replace(SETTINGS, ready_s=8 * DT)
CALM = replace(WAITS, haste=0.5)
EVENTS = ("gain", "rise", "reach", "gap", "hop")
TRACES = (
    *EVENTS,
    *("mode", "since", "best", "lowest", "stroke", "lead", "farthest", "widest", "likeness"),
    *("liftoffs", "airborne"),
)

Feet = tuple[tuple[float, float], ...]
STANCE: Feet = ((0.25, -0.125), (0.25, 0.125), (-0.25, -0.125), (-0.25, 0.125))
"""Feet of a robot at the origin that looks along x: FR, FL, HR, HL."""
ALL_FOUR = (True, True, True, True)


@dataclass(frozen=True)
class Step:
    """What one robot is told and does in a step."""

    jump: bool = False
    air: bool = False
    height: float = 0.3
    speed: float = 0.0
    miss: float = 0.0
    turn: float = 0.0
    along: float = 0.0
    excess: float = 0.0
    ground: tuple[bool, ...] = (True, False, False, False)
    """Which feet touch it, if not in the air."""
    feet: Feet = STANCE
    way: tuple[float, float] = (0.0, 0.0)
    stretch: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)

    @property
    def contact(self) -> list[bool]:
        return [touches and not self.air for touches in self.ground]


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
    asked: JumpSettings = SETTINGS,
    tracker: JumpTracker | None = None,
) -> dict[str, list[list[float]]]:
    """Every trace of every robot: name to robots to steps."""
    tracker = tracker or JumpTracker(len(robots), "cpu", asked, width)
    traces: dict[str, list[list[float]]] = {name: [[] for _ in robots] for name in TRACES}
    for steps in zip(*robots, strict=True):
        tracker.advance(
            jump=torch.tensor([step.jump for step in steps]),
            contact=torch.tensor([step.contact for step in steps]),
            height=torch.tensor([step.height for step in steps]),
            vertical=torch.tensor([step.speed for step in steps]),
            miss=torch.tensor([step.miss for step in steps]),
            turn=torch.tensor([step.turn for step in steps]),
            along=torch.tensor([step.along for step in steps]),
            excess=torch.tensor([step.excess for step in steps]),
            feet=torch.tensor([step.feet for step in steps]),
            direction=torch.tensor([step.way for step in steps]),
            stretch=torch.tensor([step.stretch for step in steps]),
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
    [
        (2.5, 1.0, 1.0),
        (1.5, 1.0, 0.606531),
        (3.5, 1.0, 0.606531),
        (2.1, 0.4, 0.606531),
        (0.5, 1.0, 0.135335),  # of a stride, too
    ],
)
def test_kernel_of_the_lift_off_velocity(speed: float, width: float, worth: float) -> None:
    """exp(-(v - 2.5)^2 / (2 width^2)): one width off is worth exp(-1/2)."""
    seen = alone(script("0111", "0001", {3: speed}), width=width)
    assert seen["gain"] == pytest.approx([0, 0, 0, worth], rel=1e-5)


@pytest.mark.parametrize(
    ("miss", "turn", "width", "worth"),
    [
        (0.0, 0.0, 0.3, 1.0),
        (0.3, 0.0, 0.3, 0.803265),
        (0.0, 0.8, 0.3, 0.803265),
        (0.3, 0.8, 0.3, 0.683940),
        (1.0, 0.0, 0.1, 0.5),
    ],
)
def test_half_the_worth_is_for_going_where_the_command_says_and_level(
    miss: float, turn: float, width: float, worth: float
) -> None:
    """1/2 + exp(-(miss / width)^2 / 2 - (turn / .8)^2 / 2) / 2.

    One width off costs half of 1 - exp(-1/2), two half of 1 - exp(-1).
    """
    before = script("011", "000")
    liftoff = Step(jump=True, air=True, speed=2.5, miss=miss, turn=turn)
    asked = replace(SETTINGS, aim_width=width, turn_width=0.8)
    seen = alone([*before, liftoff], width=0.7, asked=asked)
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


@pytest.mark.parametrize(
    ("steps", "worth"),
    [(1, 1 / 64), (2, 1 / 16), (4, 0.25), (6, 0.5625), (8, 1.0), (16, 1.0), (20, 0.75), (32, 0.0)],
)
def test_hasty_jumps_are_worth_less(steps: int, worth: float) -> None:
    """In full from 8 steps after the command on, before by the square of the time; then late."""
    told, waits = "0" + "1" * steps, "0" + "0" * (steps - 1) + "1"
    seen = alone(script(told, waits, {steps: 2.5}), asked=WAITS)
    assert seen["gain"][-1] == pytest.approx(worth)
    assert seen["liftoffs"][-1] == 1, "hasty or not, it is a jump"


def test_who_was_hasty_is_paid_for_the_jump_after_it() -> None:
    """Lift-offs 3 and 10 steps after the command: 9/64, and the rest."""
    seen = alone(script("1" * 10, "0010000001", {2: 2.5, 9: 2.5}), asked=WAITS)
    assert seen["gain"] == pytest.approx([0.0, 0.0, 9 / 64, *[0.0] * 6, 55 / 64])
    assert [i for i, hop in enumerate(seen["hop"]) if hop] == [9]


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


@pytest.mark.parametrize(("speed", "hops"), [(0.1, 0), (0.5, 0), (0.625, 1)])
def test_a_small_hop_before_the_jump_costs_nothing_but_the_hop(speed: float, hops: int) -> None:
    """A stride, which is slower than .5 m/s, not even that."""
    seen = alone(script("1" * 8, "00100011", {2: speed, 6: 2.5}))
    jump = alone(script("1" * 8, "00000011", {6: 2.5}))
    assert sum(seen["gain"]) == pytest.approx(sum(jump["gain"]))
    assert (sum(seen["hop"]), sum(jump["hop"])) == (hops, 0)
    assert (seen["liftoffs"][-1], jump["liftoffs"][-1]) == (1 + hops, 1)


def test_strides_after_the_jump_are_no_hops() -> None:
    """As fast as a leap in the step before lift-off only is fast enough: steps 2, 5 and 8."""
    seen = alone(script("1" * 10, "0010010010", {2: 2.5, 5: 0.25, 7: 0.75, 8: -1.0}))
    assert [i for i, hop in enumerate(seen["hop"]) if hop] == [8]
    assert seen["liftoffs"] == [0, 0, 1, 1, 1, 1, 1, 1, 2, 2]


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
    steps = [Step(jump=True, air=a, height=h, speed=2.0) for a, h in zip(air, heights, strict=True)]
    assert alone(steps)["rise"] == pytest.approx([0, 0.05, 0.1, 0.1, 0, 0], abs=1e-6)


def test_a_stride_does_not_end_the_crouch() -> None:
    """Step 1 is in the air of a stride: the crouch of step 3 is still pushed from."""
    heights = [0.3, 0.3, 0.3, 0.2, 0.4, 0.2]
    air = [False, True, False, False, True, False]
    steps = [
        Step(jump=True, air=a, height=h, speed=v)
        for a, h, v in zip(air, heights, [0, 0.25, 0, 0, 2, 0], strict=True)
    ]
    seen = alone(steps)
    assert seen["lowest"] == pytest.approx([0.3, 0.3, 0.3, 0.2, 0.2, 0.2])
    assert seen["rise"] == pytest.approx([0, 0, 0, 0.1, 0.1, 0], abs=1e-6)


def test_nobody_is_paid_for_a_crouch_below_the_floor_of_it() -> None:
    """From .1 as from .1875: a push off the shanks is no longer way."""
    heights = [0.25, 0.1, 0.125, 0.25, 0.5]
    seen = alone([Step(jump=True, height=h) for h in heights])
    assert seen["lowest"] == [0.25, *[0.1875] * 4]
    assert seen["rise"] == pytest.approx([0, 0.0625, 0, 0, 0.25], abs=1e-6)


def test_who_lies_when_the_command_comes_has_way_from_the_floor_of_the_crouch_on() -> None:
    """And owes nothing for what is below."""
    heights = [0.1, 0.1, 0.15, 0.25, 0.3]
    jump = [False, *[True] * 4]
    seen = alone([Step(jump=j, height=h) for j, h in zip(jump, heights, strict=True)])
    assert seen["lowest"] == [0.1875] * 5
    assert seen["rise"] == pytest.approx([0, 0, 0, 0.0625, 0.05], abs=1e-6)


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


def test_a_running_start_above_the_command_is_not_paid() -> None:
    """Half a metre a second too fast as the command comes: 3.5 m/s of 4. Later haste is a leap."""
    air = [Step(jump=True, air=i > 1, along=4.0, excess=1.0) for i in range(5)]
    too_fast, slow = [Step(jump=True, excess=0.5), *air], [Step(jump=True, excess=-0.5), *air]
    assert alone(too_fast)["farthest"][-1] == pytest.approx(2 * 3.5 * DT)
    assert alone(slow)["farthest"][-1] == pytest.approx(2 * 4.0 * DT)
    again = [*slow, Step(), *[Step()] * 8, *too_fast]
    assert alone(again)["lead"] == [0.0] * 15 + [0.5] * 6


@pytest.mark.parametrize(("steps", "worth"), [(2, 0.0625), (4, 0.25), (8, 1.0), (20, 0.75)])
def test_what_a_hasty_jump_covers_is_worth_as_little_as_its_lift_off(
    steps: int, worth: float
) -> None:
    """It lifts off in that step after the command, flies for three and lands half a metre on."""
    stands = Step(jump=True, ground=ALL_FOUR, way=(1.0, 0.0))
    flies = replace(stands, air=True, speed=2.5, along=2.0)
    lands = replace(stands, feet=moved(1.0, 0.0))
    seen = alone([*[stands] * (steps - 1), flies, flies, flies, lands], asked=WAITS)
    assert sum(seen["gain"]) == pytest.approx(worth)
    assert sum(seen["reach"]) == pytest.approx(worth * 2 * 2.0 * DT)
    assert sum(seen["gap"]) == pytest.approx(worth * 0.5)


def test_the_flight_that_a_command_finds_under_way_covers_nothing() -> None:
    """Whatever the jump before it was worth."""
    jump = [Step(jump=True), *[Step(jump=True, air=True, speed=2.5, along=2.0)] * 3]
    seen = alone([*jump, Step(), Step(air=True, along=2.0), *jump[2:]])
    assert sum(seen["reach"][:4]) > 0.0
    assert not any(seen["reach"][4:])


def test_flying_backwards_reaches_nothing() -> None:
    steps = [Step(jump=True, air=i > 1, along=-1.0) for i in range(6)]
    assert alone(steps)["reach"] == [0] * 6


def test_flights_without_a_command_reach_nothing() -> None:
    assert alone([Step(air=True, along=3.0)] * 6)["reach"] == [0] * 6


def leap_over(*places: Feet, way: tuple[float, float] = (1.0, 0.0)) -> list[Step]:
    """Stands two steps at every place, and flies two steps to the next.

    So it lands in steps 4, 8, 12, ... In the air all feet are far ahead, which clears nothing.
    """
    stands = Step(jump=True, ground=ALL_FOUR, way=way)
    flies = replace(stands, air=True, speed=2.0, feet=moved(50.0 * way[0], 50.0 * way[1]))
    flights = [[flies, flies, *[replace(stands, feet=place)] * 2] for place in places]
    return [step for flight in flights for step in flight][2:]


def moved(x: float, y: float, feet: Feet = STANCE) -> Feet:
    return tuple((a + x, b + y) for a, b in feet)


def landing(steps: list[Step], **how: Any) -> dict[int, float]:
    """Steps in which a gap was paid, and how much."""
    return {i: gap for i, gap in enumerate(alone(steps, **how)["gap"]) if gap}


@pytest.mark.parametrize(
    ("way", "to", "gap"),
    [
        # Fore feet left at .25, hind feet come to -.25 + .75.
        ((1.0, 0.0), (0.75, 0.0), 0.25),
        # To the right: right feet left at -.125, left feet come to .125 - .5.
        ((0.0, -1.0), (0.0, -0.5), 0.25),
        # What it goes to the side of the way is no gap, in it or out of it.
        ((1.0, 0.0), (0.75, 3.0), 0.25),
        # FL left at .6 .25 + .8 .125 = .25, HR comes to -.25 + .6 .5 + .8 .5 = .45.
        ((0.6, 0.8), (0.5, 0.5), 0.2),
        # Hind feet come down where fore feet left, or before it, or backwards.
        ((1.0, 0.0), (0.5, 0.0), 0.0),
        ((1.0, 0.0), (0.25, 0.0), 0.0),
        ((1.0, 0.0), (-2.0, 0.0), 0.0),
        # Nobody is told to go anywhere.
        ((0.0, 0.0), (0.75, 0.0), 0.0),
    ],
)
def test_gap_by_hand(way: tuple[float, float], to: tuple[float, float], gap: float) -> None:
    """From the front-most foot that left to the hind-most that comes."""
    seen = alone(leap_over(STANCE, moved(*to), way=way))
    assert seen["gap"] == pytest.approx([0, 0, 0, 0, gap, 0], abs=1e-6)
    assert seen["widest"] == pytest.approx([0, 0, 0, 0, gap, gap], abs=1e-6)


def test_gap_is_between_where_feet_stood_last_and_all_that_come() -> None:
    """FR lifts first, at .25, and HL last, where it had stepped to: .375.

    FR lands first, at 1.25; HR is then in the air yet, at .75.
    """

    def at(fr: float, fl: float, hr: float, hl: float) -> Feet:
        return ((fr, 0.0), (fl, 0.0), (hr, 0.0), (hl, 0.0))

    steps = [
        Step(ground=ALL_FOUR, feet=at(0.25, 0.125, -0.25, -0.25)),
        Step(ground=(False, True, False, True), feet=at(0.5, 0.125, 0.0, 0.375)),
        Step(ground=(False, False, False, True), feet=at(0.625, 0.5, 0.25, 0.375)),
        Step(air=True, feet=at(1.0, 0.75, 0.5, 0.5)),
        Step(feet=at(1.25, 1.0, 0.75, 0.875)),
        Step(ground=ALL_FOUR, feet=at(1.25, 1.0, 1.0, 1.0)),
    ]
    steps = [replace(step, jump=True, speed=2.0, way=(1.0, 0.0)) for step in steps]
    assert landing(steps) == pytest.approx({4: 0.75 - 0.375})


def test_gap_is_paid_up_to_the_widest_that_is_asked_for() -> None:
    # 2.0 - .5 clears 1.5 m.
    steps = leap_over(STANCE, moved(2.0, 0.0))
    assert landing(steps) == pytest.approx({4: 0.75})
    assert landing(steps, asked=replace(SETTINGS, gap=1.25)) == pytest.approx({4: 1.25})
    assert landing(steps, asked=replace(SETTINGS, gap=5.0)) == pytest.approx({4: 1.5})


def test_gap_is_of_the_best_flight_of_a_command() -> None:
    """.25, .125 and .375 m: the third is paid for what it is better."""
    steps = leap_over(STANCE, moved(0.75, 0.0), moved(1.375, 0.0), moved(2.25, 0.0))
    assert landing(steps) == pytest.approx({4: 0.25, 12: 0.125})
    anew = [replace(step, jump=i != 5) for i, step in enumerate(steps)]
    assert landing(anew) == pytest.approx({4: 0.25, 8: 0.125, 12: 0.25})


def test_nobody_without_a_command_clears_a_gap() -> None:
    steps = leap_over(STANCE, moved(0.75, 0.0))
    assert landing([replace(step, jump=False) for step in steps]) == {}
    # The command is over, but the flight is still of it.
    assert landing([replace(step, jump=i < 3) for i, step in enumerate(steps)]) == {4: 0.25}


def test_a_running_start_above_the_command_clears_no_gap() -> None:
    """Half a metre a second too fast, two steps in the air."""
    steps = leap_over(STANCE, moved(0.75, 0.0))
    fast = [replace(steps[0], excess=0.5), *steps[1:]]
    assert landing(fast) == pytest.approx({4: 0.25 - 2 * 0.5 * DT})


def test_a_running_start_above_the_command_takes_worth_from_a_jump() -> None:
    """By a kernel of what it is too fast as the command comes; slower, or faster later, by none."""
    told, waits = "1" * 9, "0" * 8 + "1"
    for excess, worth in ((0.5, math.exp(-0.5)), (1.0, math.exp(-2.0)), (-1.0, 1.0), (0.0, 1.0)):
        first, *others = script(told, waits, {8: 2.5})
        steps = [replace(first, excess=excess), *(replace(step, excess=0.7) for step in others)]
        assert alone(steps, asked=CALM)["gain"][-1] == pytest.approx(worth)


def test_a_countermovement_falls_brakes_and_pushes() -> None:
    """8 m/s^2 down for 1/8 s, 1/16 m; then 3.5 m/s up in 1/8 s: at rest after 2/7 of that."""
    times = [0.0, 0.0625, 0.125, 0.125 + 0.125 * 2 / 7, 0.25]
    rests = 0.0625 + 0.5 * 1.0 * 0.125 * 2 / 7
    rises = 0.5 * 2.5 * 0.125 * 5 / 7
    asked = SETTINGS.countermovement(torch.tensor(times))
    expected = [0.0, -0.015625, -0.0625, -rests, rises - rests]
    assert asked.tolist() == pytest.approx(expected, abs=1e-6)


def test_legs_of_a_countermovement_lie_within_what_a_leg_can_do() -> None:
    """Between a trunk on its knees and a straight leg."""
    asked = JumpSettings().countermovement(torch.linspace(0.0, JumpSettings().prompt_s, 100))
    standing = BODY.standing_height - BODY.foot_radius
    assert float(asked.min()) + standing + BODY.foot_radius == pytest.approx(0.2, abs=0.01)
    assert 0.3 < float(asked[-1]) + standing < 0.95 * (BODY.thigh_length + BODY.shank_length)


def test_likeness_is_paid_from_the_command_to_the_first_leap() -> None:
    """Told in step 2. A stride (in the air at 4, 5) goes on, the leap at 7 ends it."""
    asked = [-4 * (DT * i) ** 2 for i in range(1, 7)]
    legs = {i + 2: (way,) * 4 for i, way in enumerate(asked)}
    legs[4] = (asked[2] - 0.0625,) * 4
    legs[6] = (asked[4] + 0.0625, asked[4] - 0.125, asked[4], asked[4])
    told = [
        replace(step, stretch=legs.get(i, step.stretch))
        for i, step in enumerate(script("0011111111", "0000110110", {6: 2.0, 7: 2.0}))
    ]
    two = (math.exp(-0.5) + math.exp(-2.0) + 2.0) / 4.0
    expected = [0, 0, 1, 1, math.exp(-0.5), 1, two, 0, 0, 0]
    assert alone(told)["likeness"] == pytest.approx(expected, abs=1e-6)
    # Who never leaps is paid up to `prompt_s`, and again from the next command on.
    waits = alone(script("1" * 20 + "000000000" + "1", "0" * 30))["likeness"]
    assert all(value > 0.0 for value in waits[:16])
    assert waits[16:29] == [0] * 13
    assert waits[29] == waits[0]


def test_the_next_command_begins_at_its_own_height() -> None:
    heights = [0.3, 0.6, 0.3, 0.3, 0.4]
    jump = [True, True, False, True, True]
    seen = alone([Step(jump=j, height=h) for j, h in zip(jump, heights, strict=True)])
    assert seen["rise"] == pytest.approx([0, 0.3, 0, 0, 0.1], abs=1e-6)


def test_reset_forgets_one_robot_and_no_other() -> None:
    begun = [replace(step, ground=ALL_FOUR) for step in script("0111111", "0000100", {4: 2.0})]
    # One foot alone touches before this flight: the others stand where they are remembered.
    goes_on = [
        replace(step, way=(1.0, 0.0), feet=((-1.0, 0.0),) * 4 if i < 2 else moved(0.375, 0.0))
        for i, step in enumerate(script("11111", "00110", {2: 2.5}))
    ]
    tracker = JumpTracker(2, "cpu", SETTINGS, 1.0)
    play([begun, begun], tracker=tracker)
    tracker.reset(torch.tensor([1]))
    after = play([goes_on, goes_on], tracker=tracker)
    whole, anew = alone(begun + goes_on), alone(goes_on)
    assert (max(whole["gap"]), max(anew["gap"])) == (0.0, 0.125)
    for name in TRACES:
        assert after[name][0] == whole[name][len(begun) :]
        assert after[name][1] == anew[name]


@pytest.mark.parametrize("value", [0.0, -0.1, math.nan])
@pytest.mark.parametrize("name", [entry.name for entry in fields(JumpSettings)])
def test_settings_that_are_none_are_refused(name: str, value: float) -> None:
    with pytest.raises(PronkError, match=rf"JumpSettings\.{name} is {value}, not positive"):
        JumpSettings(**{name: value})


def test_times_in_another_order_are_refused() -> None:
    said = "ready_s 0.4 and prompt_s 0.3; they must be in this order"
    with pytest.raises(PronkError, match=said):
        JumpSettings(ready_s=0.4, prompt_s=0.3)


def test_a_fall_that_goes_on_beyond_the_lift_off_is_refused() -> None:
    with pytest.raises(PronkError, match=r"fall_s 0\.3, but prompt_s 0\.28; the fall must be over"):
        JumpSettings(fall_s=0.3)


def test_who_is_ready_may_be_prompt_at_once() -> None:
    asked = JumpSettings(ready_s=8 * DT, prompt_s=8 * DT, late_s=16 * DT)
    for steps, worth in ((4, 0.25), (8, 1.0), (12, 0.75)):
        told, waits = "1" * steps, "0" * (steps - 1) + "1"
        seen = alone(script(told, waits, {steps - 1: 2.5}), asked=asked)
        assert seen["gain"][-1] == pytest.approx(worth)


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
    worth: float = 0.0
    leaps: int = 0
    highest: float = 0.0
    lowest: float = 0.0
    stroke: float = 0.0
    lead: float = 0.0
    flown: float = 0.0
    farthest: float = 0.0
    stood: list[tuple[float, float]] = field(default_factory=lambda: [(0.0, 0.0)] * 4)
    widest: float = 0.0
    brought: float = 0.0

    def step(self, now: Step) -> dict[str, float]:
        s = self.settings
        new = now.jump and not self.told
        if new:
            self.age, self.scores, self.leaps, self.farthest, self.widest = 0, [], 0, 0.0, 0.0
            self.lead, self.worth = max(now.excess, 0.0), 0.0
        if now.jump:
            self.settled = 0
        elif self.settled is not None and not now.air:
            self.settled += 1
            if self.settled * DT == s.settle_s:
                self.settled = None
        mode = self.settled is not None
        self.age = self.age + 1 if mode else 0
        paid = dict.fromkeys(EVENTS, 0.0) | {"mode": float(mode)}
        if mode and now.air and not self.was_up:
            speed = max(self.speed, now.speed)
            off = (speed - s.liftoff_velocity) / self.width
            self.worth = self.timely(self.age * DT) * math.exp(-((self.lead / s.haste) ** 2) / 2)
            score = math.exp(-(off**2) / 2) * self.worth
            paid["gain"] = max(score - max(self.scores, default=0.0), 0.0)
            self.scores.append(score)
            if speed > s.leap:
                paid["hop"] = float(self.leaps > 0)
                self.leaps += 1
        paid["likeness"] = 0.0
        if mode and not self.leaps and self.age * DT <= s.prompt_s:
            asked = self.sinking(self.age * DT)
            offs = [(length - asked) / s.likeness_width for length in now.stretch]
            paid["likeness"] = sum(math.exp(-(off**2) / 2) for off in offs) / 4
        low = max(now.height, s.crouch)
        if not mode or new:
            self.highest, self.lowest, self.stroke = now.height, low, 0.0
        self.highest = max(self.highest, now.height)
        if not self.leaps:
            self.lowest = min(self.lowest, low)
        stroke = max(min(self.highest - self.lowest, s.stroke), 0.0)
        paid["rise"], self.stroke = stroke - self.stroke, stroke
        gone = (now.along - self.lead) * self.worth * DT
        self.flown = self.flown + gone if mode and now.air and self.was_up else 0.0
        if self.flown > self.farthest:
            paid["reach"], self.farthest = self.flown - self.farthest, self.flown
        if mode and self.was_up and not now.air:
            along = [
                [x * now.way[0] + y * now.way[1] for x, y in f] for f in (self.stood, now.feet)
            ]
            gap = min(min(along[1]) - max(along[0]) - self.brought, s.gap) * self.worth
            if gap > self.widest:
                paid["gap"], self.widest = gap - self.widest, gap
        self.brought = self.brought + self.lead * DT if now.air else 0.0
        for i, touches in enumerate(now.contact):
            if touches:
                self.stood[i] = now.feet[i]
        self.told, self.was_up, self.speed = now.jump, now.air, now.speed
        return paid

    def sinking(self, age: float) -> float:
        """How much longer legs are in a countermovement at that time: its speed, summed up."""
        s, steps = self.settings, 1000
        total = 0.0
        for i in range(steps):
            at = (i + 0.5) / steps * age
            part = (at - s.fall_s) / (s.prompt_s - s.fall_s)
            pushes = (1.0 - part) * -s.fall * s.fall_s + part * s.liftoff_velocity
            total += (-s.fall * at if at <= s.fall_s else pushes) * age / steps
        return total

    def timely(self, age: float) -> float:
        """What a lift-off at that time after the command is worth."""
        s = self.settings
        if age >= s.prompt_s + s.late_s:
            return 0.0
        return min(1.0, (age / s.ready_s) ** 2, 1.0 - (age - s.prompt_s) / s.late_s)


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
    excess = draw(st.lists(st.integers(-16, 32).map(lambda i: i / 32), min_size=60, max_size=60))
    legs = st.tuples(*[st.integers(-16, 8).map(lambda i: i / 128)] * 4)
    stretch = draw(st.lists(legs, min_size=60, max_size=60))
    way = draw(st.sampled_from([(0.0, 0.0), (1.0, 0.0), (0.0, -1.0), (-0.6, 0.8)]))
    feet = wander(random.Random(draw(st.integers(0, 2**32 - 1))), way)
    return [
        Step(
            jump=j,
            air=a,
            height=h,
            speed=v,
            along=u,
            excess=e,
            ground=ground,
            feet=points,
            way=way,
            stretch=lengths,
        )
        for j, a, h, v, u, e, (ground, points), lengths in zip(
            jump, air, height, speed, along, excess, feet, stretch, strict=False
        )
    ]


def wander(draw: random.Random, way: tuple[float, float]) -> list[tuple[tuple[bool, ...], Feet]]:
    """Sixty steps of which feet touch, if any do, and where they are: on the whole further."""
    steps, x, y = [], 0.0, 0.0
    for _ in range(60):
        far = draw.uniform(-0.25, 0.75)
        x, y = x + far * way[0], y + far * way[1]
        touches = draw.randrange(1, 16)
        off = [(draw.uniform(-0.25, 0.25), draw.uniform(-0.25, 0.25)) for _ in range(4)]
        feet = tuple((x + a, y + b) for a, b in off)
        steps.append((tuple(bool(touches >> i & 1) for i in range(4)), feet))
    return steps


@settings(max_examples=50)
@given(
    steps=scripts(),
    width=st.sampled_from([0.4, 1.0]),
    asked=st.sampled_from([SETTINGS, WAITS, CALM]),
)
def test_any_script_is_paid_as_accounted(
    steps: list[Step], width: float, asked: JumpSettings
) -> None:
    seen = alone(steps, width=width, asked=asked)
    account = Account(asked, width)
    for i, step in enumerate(steps):
        for name, value in account.step(step).items():
            assert seen[name][i] == pytest.approx(value, abs=1e-5), (name, i)


@settings(max_examples=50)
@given(steps=scripts())
def test_no_script_is_paid_more_than_one_good_jump_a_command(steps: list[Step]) -> None:
    seen = alone(steps)
    edges = [i for i, now in enumerate(steps) if now.jump and not (i and steps[i - 1].jump)]
    for begin, end in itertools.pairwise([*edges, len(steps)]):
        gain, rise, reach, gap, hop = (seen[name][begin:end] for name in EVENTS)
        assert min(*gain, 0.0) == 0.0
        assert sum(gain) == pytest.approx(max(seen["best"][begin:end]), abs=1e-5)
        assert sum(gain) <= 1.0 + 1e-5
        assert min(*rise, 0.0) == 0.0
        assert sum(rise) <= SETTINGS.stroke + 1e-5
        assert min(*reach, 0.0) == 0.0
        assert sum(reach) == pytest.approx(max(seen["farthest"][begin:end]), abs=1e-5)
        assert min(*gap, 0.0) == 0.0
        assert sum(gap) == pytest.approx(max(seen["widest"][begin:end]), abs=1e-5)
        assert sum(gap) <= SETTINGS.gap + 1e-5
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
