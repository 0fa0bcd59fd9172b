"""The state of a jump: trajectories by hand, and properties of any trajectory."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from random import Random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pronk.errors import PronkError
from pronk.robots.legged import legged

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")

from pronk.jump.train.mdp.jump import JumpInputs, JumpSettings, JumpState

pytestmark = pytest.mark.train

DT = 1 / 64
"""A power of two, so that times add up exactly."""
SETTINGS = JumpSettings(
    liftoff_velocity=2.5,
    ready_s=DT,
    prompt_s=16 * DT,
    late_s=16 * DT,
    stride_velocity=0.5,
    settle_s=8 * DT,
    max_travel=0.5,
    crouch=0.1875,
    max_gap=0.75,
    fall=8.0,
    fall_s=8 * DT,
    similarity_std=0.0625,
    overspeed_std=1e6,
)
"""Even a lift-off in the first step earns everything, after a running start of any speed."""
PATIENT = replace(SETTINGS, ready_s=8 * DT)
GAINS = ("score_gain", "travel_gain", "flight_gain", "gap_gain")
TRACES = (
    *GAINS,
    "hop",
    "mode",
    "since",
    "best_score",
    "lowest",
    "travel",
    "overspeed",
    "best_flight",
    "best_gap",
    "similarity",
    "liftoffs",
    "airborne",
)
"""Quantities of the state that are recorded."""

Trace = list[float]
Feet = tuple[tuple[float, float], ...]
STANCE: Feet = ((0.25, -0.125), (0.25, 0.125), (-0.25, -0.125), (-0.25, 0.125))
"""Feet of a robot at the origin that faces along x: FR, FL, HR, HL."""
ALL = (True,) * 4


@dataclass(frozen=True)
class Step:
    """Command and motion of one robot in a step."""

    jump: bool = False
    air: bool = False
    height: float = 0.3
    vertical: float = 0.0
    velocity_error: float = 0.0
    turn: float = 0.0
    along: float = 0.0
    excess: float = 0.0
    ground: tuple[bool, ...] = (True, False, False, False)
    """Feet on the ground, unless the robot is in the air."""
    feet: Feet = STANCE
    direction: tuple[float, float] = (0.0, 0.0)
    extension: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)

    @property
    def contact(self) -> tuple[bool, ...]:
        """Feet that touch the ground."""
        return (False,) * 4 if self.air else self.ground


def script(jump: str, air: str, vertical: dict[int, float] | None = None) -> list[Step]:
    """Make steps of strings of 0 and 1, one sign a step, and the vertical velocity of some."""
    velocities = vertical or {}
    steps = []
    for i in range(len(jump)):
        velocity = velocities.get(i, 0.0)
        steps.append(Step(jump=jump[i] == "1", air=air[i] == "1", vertical=velocity))
    return steps


def with_values(steps: list[Step], name: str, values: Sequence[float]) -> list[Step]:
    """Give every step a value of its own."""
    changed = []
    for step, value in zip(steps, values, strict=True):
        changed.append(replace(step, **{name: value}))
    return changed


def tensor_of(steps: list[Step], name: str) -> Any:
    """Put a quantity of the steps of several robots together."""
    return torch.tensor([getattr(step, name) for step in steps])


def inputs_of(steps: list[Step]) -> JumpInputs:
    """Put the steps of several robots together."""
    return JumpInputs(
        command=tensor_of(steps, "jump"),
        contact=tensor_of(steps, "contact"),
        height=tensor_of(steps, "height"),
        vertical=tensor_of(steps, "vertical"),
        velocity_error=tensor_of(steps, "velocity_error"),
        turn=tensor_of(steps, "turn"),
        along=tensor_of(steps, "along"),
        excess=tensor_of(steps, "excess"),
        feet=tensor_of(steps, "feet"),
        direction=tensor_of(steps, "direction"),
        extension=tensor_of(steps, "extension"),
    )


def play(robots: list[list[Step]], state: JumpState) -> list[dict[str, Trace]]:
    """Advance through all steps; returns the traces of every robot."""
    traces: list[dict[str, Trace]] = []
    for _ in robots:
        traces.append({name: [] for name in TRACES})
    for number in range(len(robots[0])):
        state.advance(inputs_of([steps[number] for steps in robots]), DT)
        for name in TRACES:
            values = getattr(state, name).tolist()
            for robot_traces, value in zip(traces, values, strict=True):
                robot_traces[name].append(float(value))
    return traces


def alone(
    steps: list[Step], jump_settings: JumpSettings = SETTINGS, std: float = 1.0
) -> dict[str, Trace]:
    """Return the traces of a single robot."""
    state = JumpState(1, "cpu", jump_settings)
    state.liftoff_std = std
    return play([steps], state)[0]


def at(trace: Trace) -> list[int]:
    """Return the steps in which a trace is not zero."""
    return np.flatnonzero(trace).tolist()


# --- Mode and time -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("jump", "air", "mode"),
    [
        # settle_s is 8 steps: step 4 stands with the input off, and seven more from step 10 on.
        ("0011" + "0" * 18, "00000" + "11111" + "0" * 12, [0, 0] + [1] * 14 + [0] * 6),
        ("0111" + "0" * 14, "0001111" + "0" * 11, [0] + [1] * 13 + [0] * 4),
        ("1" + "0" * 40, "0" + "1" * 40, [1] * 41),
        ("1" * 40, "0" * 40, [1] * 40),
        ("0" * 8, "00110100", [0] * 8),
    ],
)
def test_jump_mode_ends_after_settling_on_the_ground(jump: str, air: str, mode: Any) -> None:
    traces = alone(script(jump, air))
    before = jump.find("1") - 1
    assert traces["mode"] == mode
    since = []
    for i, in_mode in enumerate(mode):
        since.append(DT * (i - before) if in_mode else 0.0)
    assert traces["since"] == since


@pytest.mark.parametrize(
    ("jump", "air", "vertical", "gains", "hops"),
    [
        # In the air already when the command comes: the next lift-off is the first.
        ("00111111", "01110010", {6: 2.5}, [6], []),
        # A lift-off after the input went off belongs to the command.
        ("0100000", "0000001", {6: 2.5}, [6], []),
        # Each command is rewarded anew.
        ("1110111111", "0010000100", {2: 2.5, 7: 2.5}, [2, 7], []),
        # A second lift-off of the same velocity improves nothing, and is a hop.
        ("1" * 10, "0010000100", {2: 2.5, 7: 2.5}, [2], [7]),
        # Without a command nothing is rewarded.
        ("0" * 8, "00110100", {2: 2.5, 5: 2.5}, [], []),
        # Strides are no hops; fast in the sample before lift-off is fast enough.
        ("1" * 10, "0010010010", {2: 2.5, 5: 0.25, 7: 0.75, 8: -1.0}, [2], [8]),
    ],
)
def test_liftoffs_of_a_command(
    jump: str, air: str, vertical: dict[int, float], gains: list[int], hops: list[int]
) -> None:
    traces = alone(with_values(script(jump, air, vertical), "along", [3.0] * len(jump)))
    assert at(traces["score_gain"]) == gains
    assert at(traces["hop"]) == hops
    if "1" not in jump:
        for name in (*GAINS, "liftoffs", "similarity"):
            assert not any(traces[name])


# --- Score ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("motion", "changes", "std", "score"),
    [
        # exp(-(v - 2.5)^2 / (2 std^2)): one standard deviation off earns exp(-1/2).
        ({"vertical": 2.5}, {}, 1.0, 1.0),
        ({"vertical": 1.5}, {}, 1.0, 0.606531),
        ({"vertical": 3.5}, {}, 1.0, 0.606531),
        ({"vertical": 2.1}, {}, 0.4, 0.606531),
        ({"vertical": 0.5}, {}, 1.0, 0.135335),
        # 1/2 + exp(-(error / aim_std)^2 / 2 - (turn / turn_std)^2 / 2) / 2.
        ({"velocity_error": 0.3}, {"aim_std": 0.3}, 1.0, 0.803265),
        ({"turn": 0.8}, {"turn_std": 0.8}, 1.0, 0.803265),
        ({"velocity_error": 0.3, "turn": 0.8}, {"aim_std": 0.3, "turn_std": 0.8}, 0.7, 0.683940),
        ({"velocity_error": 1.0}, {"aim_std": 0.1}, 0.7, 0.5),
    ],
)
def test_score_of_a_liftoff(motion: Any, changes: Any, std: float, score: float) -> None:
    liftoff = replace(Step(jump=True, air=True, vertical=2.5), **motion)
    traces = alone([*script("011", "000"), liftoff], replace(SETTINGS, **changes), std)
    assert traces["score_gain"] == pytest.approx([0, 0, 0, score], rel=1e-5)


@pytest.mark.parametrize(
    ("ready", "steps", "scale"),
    [
        # Late: in full until 16 steps after the command, then a line to zero after 32.
        (1, 1, 1.0),
        (1, 16, 1.0),
        (1, 20, 0.75),
        (1, 24, 0.5),
        (1, 40, 0.0),
        # Early: the square of the time's fraction of ready_s.
        (8, 1, 1 / 64),
        (8, 4, 0.25),
        (8, 6, 0.5625),
        (8, 8, 1.0),
        (16, 8, 0.25),
        (16, 16, 1.0),
        (16, 24, 0.5),
        (16, 32, 0.0),
    ],
)
def test_reward_scale_by_the_time_of_liftoff(ready: int, steps: int, scale: float) -> None:
    """The scale holds for the score, the flight and the gap alike; it stays a jump."""
    stands = Step(jump=True, ground=ALL, direction=(1.0, 0.0))
    flies = replace(stands, air=True, vertical=2.5, along=2.0)
    lands = replace(stands, feet=moved(1.0, 0.0))
    trajectory = [Step(), *[stands] * (steps - 1), flies, flies, flies, lands]
    traces = alone(trajectory, replace(SETTINGS, ready_s=ready * DT))
    assert traces["liftoffs"][-1] == 1
    assert sum(traces["score_gain"]) == pytest.approx(scale)
    assert sum(traces["flight_gain"]) == pytest.approx(scale * 2 * 2.0 * DT)
    # All four stood from the second step on; with one step the robot had not stood at all.
    if steps > 1:
        assert sum(traces["gap_gain"]) == pytest.approx(scale * 0.5)


def test_only_an_improvement_on_the_best_is_rewarded() -> None:
    # The faster of the samples before and after lift-off counts.
    vertical = {2: 1.0, 4: 1.5, 5: 1.25, 8: 1.25, 11: 1.5}
    traces = alone(script("1" * 13, "0010010010010", vertical))
    first_score = math.exp(-1.125)
    best_score = math.exp(-0.5)
    expected = [0.0] * 13
    expected[2] = first_score
    expected[5] = best_score - first_score
    assert traces["score_gain"] == pytest.approx(expected)
    assert at(traces["hop"]) == [5, 8, 11]
    # Too early, 3 of 8 steps, then on time: 9/64 and the rest.
    traces = alone(script("1" * 10, "0010000001", {2: 2.5, 9: 2.5}), PATIENT)
    assert traces["score_gain"] == pytest.approx([0, 0, 9 / 64, *[0] * 6, 55 / 64])


@pytest.mark.parametrize(
    ("excess", "scale"), [(0.5, math.exp(-0.5)), (1.0, math.exp(-2.0)), (-1.0, 1.0), (0.0, 1.0)]
)
def test_overspeed_at_the_command_lowers_the_reward(excess: float, scale: float) -> None:
    """By a kernel of the excess in the step of the command; later excess has no effect."""
    steps = script("1" * 9, "0" * 8 + "1", {8: 2.5})
    steps = with_values(steps, "excess", [excess, *[0.7] * 8])
    traces = alone(steps, replace(PATIENT, overspeed_std=0.5))
    assert traces["score_gain"][-1] == pytest.approx(scale)
    assert traces["overspeed"] == [max(excess, 0.0)] * 9


# --- Height, flight, gap -------------------------------------------------------------------------


RISE = [0.3, 0.25, 0.2, 0.28, 0.5, 0.4, 0.6, 0.9, 1.0, 0.3]
DEEP = [0.3, 0.25, 0.4, 0.5, 0.1, 0.3]


@pytest.mark.parametrize(
    ("jump", "air", "vertical", "heights", "gains"),
    [
        # From the lowest trunk before to the highest after; up to max_travel.
        ("0111111111", "0" * 10, {}, RISE, [0, 0, 0.05, 0.03, 0.22, 0, 0.1, 0.1, 0, 0]),
        # A deep landing after the lift-off in step 2 is no crouch; after a stride it is.
        ("1" * 6, "001100", {2: 2.0, 3: 2.0}, DEEP, [0, 0.05, 0.1, 0.1, 0, 0]),
        ("1" * 6, "010010", {1: 0.25, 4: 2.0}, [*[0.3] * 3, 0.2, 0.4, 0.2], [0, 0, 0, 0.1, 0.1, 0]),
        # Below `crouch`, .1875, the height does not count.
        ("11111", "00000", {}, [0.25, 0.1, 0.125, 0.25, 0.5], [0, 0.0625, 0, 0, 0.25]),
        ("01111", "00000", {}, [0.1, 0.1, 0.15, 0.25, 0.3], [0, 0, 0, 0.0625, 0.05]),
        # The next command begins at its own height.
        ("11011", "00000", {}, [0.3, 0.6, 0.3, 0.3, 0.4], [0, 0.3, 0, 0, 0.1]),
    ],
)
def test_travel_gain(jump: str, air: str, vertical: Any, heights: Any, gains: list[float]) -> None:
    traces = alone(with_values(script(jump, air, vertical), "height", heights))
    assert traces["travel_gain"] == pytest.approx(gains, abs=1e-6)


@pytest.mark.parametrize(
    ("jump", "air", "along", "excess", "gains"),
    [
        # Two flights; the first step of each is its lift-off. The longer is rewarded once.
        ("1" * 11, "00111011110", "44421442214", 0.0, [0, 0, 0, 2, 1, 0, 0, 0, 1, 1, 0]),
        # A running start half a metre a second too fast is subtracted.
        ("1" * 6, "001110", "444444", 0.5, [0, 0, 0, 3.5, 3.5, 0]),
        ("1" * 6, "001110", "444444", -0.5, [0, 0, 0, 4, 4, 0]),
        # A flight that was under way when the command came.
        ("001111", "011110", "444444", 0.0, [0, 0, 0, 0, 0, 0]),
        ("0" * 6, "011110", "444444", 0.0, [0, 0, 0, 0, 0, 0]),
    ],
)
def test_flight_gain(jump: str, air: str, along: str, excess: float, gains: list[float]) -> None:
    speeds = [float(sign) for sign in along]
    steps = with_values(script(jump, air), "excess", [excess] * len(along))
    traces = alone(with_values(steps, "along", speeds))
    assert traces["flight_gain"] == pytest.approx((DT * np.array(gains)).tolist())
    if excess == 0.0:
        backwards = np.negative(speeds).tolist()
        assert alone(with_values(steps, "along", backwards))["flight_gain"] == [0.0] * len(along)


def moved(x: float, y: float) -> Feet:
    """Move all feet of a standing robot."""
    feet = []
    for foot_x, foot_y in STANCE:
        feet.append((foot_x + x, foot_y + y))
    return tuple(feet)


def jumps(*places: Feet, direction: tuple[float, float] = (1.0, 0.0)) -> list[Step]:
    """Stand for two steps at every place, and fly for two steps to the next.

    Landings are in steps 4, 8, 12, ... In the air all feet are far ahead, which clears nothing.
    """
    stands = Step(jump=True, ground=ALL, direction=direction)
    far_ahead = moved(50.0 * direction[0], 50.0 * direction[1])
    flies = replace(stands, air=True, vertical=2.0, feet=far_ahead)
    steps: list[Step] = []
    for place in places:
        if steps:
            steps += [flies, flies]
        steps += [replace(stands, feet=place)] * 2
    return steps


@pytest.mark.parametrize(
    ("direction", "to", "gap"),
    [
        # Fore feet left at .25, hind feet come to -.25 + .75.
        ((1.0, 0.0), (0.75, 0.0), 0.25),
        # To the right: right feet left at -.125, left feet come to .125 - .5.
        ((0.0, -1.0), (0.0, -0.5), 0.25),
        # Motion across the direction has no effect.
        ((1.0, 0.0), (0.75, 3.0), 0.25),
        # FL left at .6 .25 + .8 .125 = .25, HR comes to -.25 + .6 .5 + .8 .5 = .45.
        ((0.6, 0.8), (0.5, 0.5), 0.2),
        # 2.0 - .5 clears 1.5 m, of which max_gap counts.
        ((1.0, 0.0), (2.0, 0.0), 0.75),
        # Hind feet come down where fore feet left, or behind; no direction.
        ((1.0, 0.0), (0.5, 0.0), 0.0),
        ((1.0, 0.0), (-2.0, 0.0), 0.0),
        ((0.0, 0.0), (0.75, 0.0), 0.0),
    ],
)
def test_gap_gain(direction: tuple[float, float], to: tuple[float, float], gap: float) -> None:
    """From the front-most foot that took off to the hind-most that lands."""
    traces = alone(jumps(STANCE, moved(*to), direction=direction))
    assert traces["gap_gain"] == pytest.approx([0, 0, 0, 0, gap, 0], abs=1e-6)
    assert traces["best_gap"] == pytest.approx([0, 0, 0, 0, gap, gap], abs=1e-6)


def test_gap_of_several_flights_and_commands() -> None:
    """.25, .125 and .375 m: the third earns what it is wider than the first."""
    steps = jumps(STANCE, moved(0.75, 0.0), moved(1.375, 0.0), moved(2.25, 0.0))
    expected = [0.0] * len(steps)
    expected[4] = 0.25
    expected[12] = 0.125
    assert alone(steps)["gap_gain"] == pytest.approx(expected)
    # A second command begins in step 6.
    commanded_twice = list(steps)
    commanded_twice[5] = replace(steps[5], jump=False)
    expected[8] = 0.125
    expected[12] = 0.25
    assert alone(commanded_twice)["gap_gain"] == pytest.approx(expected)
    uncommanded = with_values(steps, "jump", [False] * len(steps))
    assert not any(alone(uncommanded)["gap_gain"])
    # Two steps in the air, half a metre a second too fast at the command.
    fast = [replace(steps[0], excess=0.5), *steps[1:6]]
    expected = [0.0, 0.0, 0.0, 0.0, 0.25 - 2 * 0.5 * DT, 0.0]
    assert alone(fast)["gap_gain"] == pytest.approx(expected)


def test_gap_is_between_last_stances_and_all_feet_at_landing() -> None:
    """FR lifts first, at .25, and HL last, where it had stepped to: .375.

    FR lands first, at 1.25; HR is then still in the air, at .75.
    """
    contact_and_x = [
        (ALL, (0.25, 0.125, -0.25, -0.25)),
        ((False, True, False, True), (0.5, 0.125, 0.0, 0.375)),
        ((False, False, False, True), (0.625, 0.5, 0.25, 0.375)),
        ((False,) * 4, (1.0, 0.75, 0.5, 0.5)),
        ((True, False, False, False), (1.25, 1.0, 0.75, 0.875)),
        (ALL, (1.25, 1.0, 1.0, 1.0)),
    ]
    jump = Step(jump=True, vertical=2.0, direction=(1.0, 0.0))
    steps = []
    for ground, x in contact_and_x:
        feet = tuple((foot_x, 0.0) for foot_x in x)
        steps.append(replace(jump, ground=ground, feet=feet))
    assert alone(steps)["gap_gain"] == pytest.approx([0, 0, 0, 0, 0.75 - 0.375, 0])


# --- Countermovement -----------------------------------------------------------------------------


def test_a_countermovement_falls_brakes_and_pushes() -> None:
    """8 m/s^2 down for 1/8 s, 1/16 m; then 3.5 m/s up in 1/8 s: at rest after 2/7 of that."""
    times = [0.0, 0.0625, 0.125, 0.125 + 0.125 * 2 / 7, 0.25]
    lowest = -0.0625 - 0.5 * 1.0 * 0.125 * 2 / 7
    rise = 0.5 * 2.5 * 0.125 * 5 / 7
    lengths = SETTINGS.countermovement(torch.tensor(times))
    expected = [0.0, -0.015625, -0.0625, lowest, lowest + rise]
    assert lengths.tolist() == pytest.approx(expected, abs=1e-6)
    # The usual one is within reach of a leg: from a trunk at .2 m to less than a straight leg.
    body = legged("mini_cheetah")
    usual = JumpSettings()
    lengths = usual.countermovement(torch.linspace(0.0, usual.prompt_s, 100))
    assert float(lengths.min()) + body.standing_height == pytest.approx(0.2, abs=0.01)
    length = float(lengths[-1]) + body.standing_height - body.foot_radius
    assert 0.3 < length < 0.95 * (body.thigh_length + body.shank_length)


def test_similarity_from_the_command_to_the_first_jump() -> None:
    """Commanded in step 2. A stride (in the air at 4, 5) goes on, the jump at 7 ends it."""
    way = (-4 * (DT * np.arange(1, 7)) ** 2).tolist()
    steps = script("0011111111", "0000110110", {6: 2.0, 7: 2.0})
    for i, length in enumerate(way):
        steps[i + 2] = replace(steps[i + 2], extension=(length,) * 4)
    steps[4] = replace(steps[4], extension=(way[2] - 0.0625,) * 4)
    legs = (way[4] + 0.0625, way[4] - 0.125, way[4], way[4])
    steps[6] = replace(steps[6], extension=legs)
    similarity_of_legs = (math.exp(-0.5) + math.exp(-2.0) + 2.0) / 4.0
    expected = [0, 0, 1, 1, math.exp(-0.5), 1, similarity_of_legs, 0, 0, 0]
    assert alone(steps)["similarity"] == pytest.approx(expected, abs=1e-6)
    # Without a jump it lasts until prompt_s, and begins again with the next command.
    waits = alone(script("1" * 20 + "000000000" + "1", "0" * 30))["similarity"]
    assert np.all(np.array(waits[:16]) > 0.0)
    assert waits[16:29] == [0] * 13
    assert waits[29] == waits[0]


# --- Any trajectory ------------------------------------------------------------------------------


def any_steps(seed: int) -> list[Step]:
    """Make 60 steps in which command and flight go on and off and all else is random."""
    random = Random(seed)
    direction = random.choice([(0.0, 0.0), (1.0, 0.0), (0.0, -1.0), (-0.6, 0.8)])
    steps = []
    x = 0.0
    y = 0.0
    jump = False
    air = False
    for _ in range(60):
        jump = jump ^ (random.random() < 0.1)
        air = air ^ (random.random() < 0.2)
        distance = random.uniform(-0.25, 0.75)
        x += distance * direction[0]
        y += distance * direction[1]
        contact = random.randrange(1, 16)
        ground = []
        feet = []
        extension = []
        for foot in range(4):
            ground.append(bool(contact >> foot & 1))
            feet.append((x + random.uniform(-0.25, 0.25), y + 0.1 * foot))
            extension.append(random.uniform(-0.125, 0.0625))
        steps.append(
            Step(
                jump=jump,
                air=air,
                height=random.uniform(0.125, 1.0),
                vertical=random.uniform(-3.0, 4.0),
                velocity_error=random.uniform(0.0, 1.0),
                turn=random.uniform(0.0, 2.0),
                along=random.uniform(-1.0, 4.0),
                excess=random.uniform(-0.5, 1.0),
                ground=tuple(ground),
                feet=tuple(feet),
                direction=direction,
                extension=tuple(extension),
            )
        )
    return steps


def commands_in(steps: list[Step]) -> list[tuple[int, int]]:
    """Return the first step of every command, and the step behind its last."""
    first_steps = []
    for i, step in enumerate(steps):
        if step.jump and (i == 0 or not steps[i - 1].jump):
            first_steps.append(i)
    return list(itertools.pairwise([*first_steps, len(steps)]))


@settings(max_examples=50)
@given(seed=st.integers(0), tried=st.sampled_from([SETTINGS, PATIENT, JumpSettings()]))
def test_a_command_earns_at_most_one_good_jump(seed: int, tried: JumpSettings) -> None:
    steps = any_steps(seed)
    traces = alone(steps, tried)
    for begin, end in commands_in(steps):
        part = {name: trace[begin:end] for name, trace in traces.items()}
        for name in GAINS:
            assert min(part[name]) >= 0.0
        assert sum(part["score_gain"]) <= 1.0 + 1e-5
        assert sum(part["travel_gain"]) <= tried.max_travel + 1e-5
        assert sum(part["gap_gain"]) <= tried.max_gap + 1e-5
        assert sum(part["score_gain"]) == pytest.approx(max(part["best_score"]), abs=1e-5)
        assert sum(part["flight_gain"]) == pytest.approx(max(part["best_flight"]), abs=1e-5)
        assert sum(part["gap_gain"]) == pytest.approx(max(part["best_gap"]), abs=1e-5)
        assert sum(part["hop"]) == max(max(part["liftoffs"]) - 1, 0)


@settings(max_examples=20)
@given(seed=st.integers(0))
def test_robots_are_independent_and_reset_alone(seed: int) -> None:
    """The second one begins anew half way."""
    robots = [any_steps(seed + i) for i in range(3)]
    state = JumpState(3, "cpu", SETTINGS)
    first_steps = []
    later_steps = []
    for steps in robots:
        first_steps.append(steps[:30])
        later_steps.append(steps[30:])
    first_halves = play(first_steps, state)
    state.reset(torch.tensor([False, True, False]))
    second_halves = play(later_steps, state)
    for i, steps in enumerate(robots):
        if i == 1:
            first_half = alone(steps[:30])
            second_half = alone(steps[30:])
            expected = {name: first_half[name] + second_half[name] for name in TRACES}
        else:
            expected = alone(steps)
        for name in TRACES:
            trace = first_halves[i][name] + second_halves[i][name]
            assert trace == pytest.approx(expected[name], abs=1e-6)


@pytest.mark.parametrize("value", [0.0, -0.1, math.nan])
@pytest.mark.parametrize("name", [field.name for field in fields(JumpSettings)])
def test_settings_that_are_not_positive_are_refused(name: str, value: float) -> None:
    with pytest.raises(PronkError, match=name):
        JumpSettings(**{name: value})


def test_settings_in_the_wrong_order_are_refused() -> None:
    with pytest.raises(PronkError, match="ready_s"):
        JumpSettings(ready_s=0.4, prompt_s=0.3)
    with pytest.raises(PronkError, match="fall_s"):
        JumpSettings(fall_s=0.3)
