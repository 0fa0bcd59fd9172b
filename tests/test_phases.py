"""The phases: what the paper says of them, and that a living environment enters them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from pronk.errors import PronkError

pytest.importorskip("mjlab")
pytestmark = pytest.mark.train

import small_env
from pronk.train.mdp.commands import NAME, motion_command
from pronk.train.mdp.reward_sum import NAME as TABLE
from pronk.train.mdp.reward_sum import reward_sum
from pronk.train.mdp.reward_table import ROWS
from pronk.train.phases import (
    PHASES,
    Phase,
    configure_phase,
    enter_phase,
    phase,
    with_iterations,
)
from pronk.train.runner.settings import PHASES_OF
from pronk.train.tasks import env_cfg


@pytest.fixture(scope="module")
def env() -> Any:
    return small_env.quiet()


def test_phases_are_the_papers() -> None:
    """P1 and P2: walk; jump with a strong hint; jump with a tenth of it."""
    walk, strong, weak = PHASES
    assert [p.jump for p in PHASES] == [False, True, True]
    assert [p.jump_fraction for p in PHASES] == [0.0, 0.5, 0.5]
    assert (walk.weights.dense, walk.weights.sparse) == (0.0, 0.0)
    rest = walk.weights
    assert (rest.rise, rest.reach, rest.gap, rest.countermovement, rest.hop) == (0.0,) * 5
    assert strong.weights.countermovement == weak.weights.countermovement > 0.0
    assert weak.weights.dense == pytest.approx(strong.weights.dense / 10)
    assert weak.weights.sparse == strong.weights.sparse > 0.0
    assert strong.weights.width == 1.0, "the paper's expression"
    assert weak.weights.width < strong.weights.width
    assert weak.final is not None
    assert weak.final.width < weak.weights.width
    assert weak.final.countermovement == 0.0, "a hint is for who has yet to find out"
    assert weak.weights.collision == strong.weights.collision == rest.collision, (
        "nobody is taught to fear what is yet to be found"
    )
    assert weak.final.collision > weak.weights.collision
    assert weak.final.knees > weak.weights.knees
    assert weak.final.landing > weak.weights.landing == strong.weights.landing == 0.0
    assert (walk.final, strong.final) == (None, None)


def test_tasks_are_made_of_phases() -> None:
    assert PHASES_OF["all"] == tuple(p.name for p in PHASES)
    assert {name for names in PHASES_OF.values() for name in names} == {p.name for p in PHASES}


def test_phase_by_name() -> None:
    assert [phase(p.name) for p in PHASES] == list(PHASES)
    with pytest.raises(PronkError, match="no phase 'fly'; the phases are walk, jump_a, jump_b"):
        phase("fly")


def test_other_numbers_of_iterations() -> None:
    changed = with_iterations({"jump_a": 7})
    assert [p.iterations for p in changed] == [PHASES[0].iterations, 7, PHASES[2].iterations]
    assert [p.weights for p in changed] == [p.weights for p in PHASES]
    assert with_iterations({}) == PHASES
    with pytest.raises(PronkError, match="no phase 'trot'"):
        with_iterations({"trot": 3})
    with pytest.raises(PronkError, match="phase walk has 0 iterations; 1 or more"):
        with_iterations({"walk": 0})


# --- How much the network explores ----------------------------------------------------------------


def of_noise(*noise: float) -> Phase:
    first, last = noise
    return Phase(name="made up", iterations=3, jump=True, noise=(first, last))


@pytest.mark.parametrize(
    ("noise", "done", "largest"),
    [
        ((0.8, 0.2), 0.0, 0.8),
        # .8 / 4^(1/4); .8 / 4^(1/16); .8 / 4^(9/16).
        ((0.8, 0.2), 0.5, 0.565685),
        ((0.8, 0.2), 0.25, 0.733603),
        ((0.8, 0.2), 0.75, 0.366802),
        ((0.8, 0.2), 1.0, 0.2),
        ((0.1, 0.9), 0.5, 0.173205),
        ((0.3, 0.3), 0.7, 0.3),
    ],
)
def test_largest_noise_changes_slowly_at_first(
    noise: tuple[float, float], done: float, largest: float
) -> None:
    assert of_noise(*noise).largest_noise(done) == pytest.approx(largest, rel=1e-5)


def test_a_phase_without_noise_of_its_own_has_no_limit() -> None:
    free = Phase(name="made up", iterations=3, jump=True)
    assert [free.largest_noise(done) for done in (0.0, 0.5, 1.0)] == [math.inf] * 3


def test_weights_go_evenly_to_their_final_ones() -> None:
    first = PHASES[2].weights
    last = replace(first, width=0.1, rise=6.0, collision=45.0)
    made = Phase(name="made up", iterations=4, jump=True, weights=first, final=last)
    assert made.weights_at(0.0) == first
    assert made.weights_at(1.0) == last
    middle = made.weights_at(0.25)
    assert middle.width == pytest.approx(0.75 * first.width + 0.025)
    assert middle.rise == pytest.approx(0.75 * first.rise + 1.5)
    assert middle.collision == pytest.approx(0.75 * first.collision + 11.25)
    assert replace(middle, width=0, rise=0, collision=0) == replace(
        first, width=0, rise=0, collision=0
    )
    assert PHASES[1].weights_at(0.5) == PHASES[1].weights


def test_a_hand_lets_go_from_phase_to_phase() -> None:
    walk, strong, weak = PHASES
    assert [walk.led_at(done) for done in (0.0, 0.5, 1.0)] == [0.0] * 3
    assert strong.led_at(0.0) == 1.0
    assert strong.led_at(1.0) == pytest.approx(weak.led_at(0.0))
    assert weak.led_at(1.0) == 0.0, "a policy jumps by itself in the end"
    made = Phase(name="made up", iterations=4, jump=True, led=(0.8, 0.4))
    assert [made.led_at(done) for done in (0.0, 0.25, 1.0)] == pytest.approx([0.8, 0.625, 0.4])


@pytest.mark.parametrize("led", [(-0.1, 0.0), (0.5, 1.1), (math.nan, 0.0)])
def test_a_hand_that_leads_by_less_than_nothing_or_more_than_all_is_refused(
    led: tuple[float, float],
) -> None:
    with pytest.raises(PronkError, match=r"phase made up leads by .*; both must be 0 to 1"):
        Phase(name="made up", iterations=3, jump=True, led=led)


@pytest.mark.parametrize("noise", [(0.0, 0.2), (0.6, 0.0), (-0.6, 0.2), (0.6, -0.2)])
def test_a_phase_of_no_noise_is_refused(noise: tuple[float, float]) -> None:
    with pytest.raises(PronkError, match=r"phase made up has noise .*; both must be positive"):
        of_noise(*noise)


def test_noise_is_limited_in_jump_phases_and_ends_small() -> None:
    """What was found is then done alike every time."""
    walk, strong, last = PHASES
    assert walk.noise is None
    assert strong.largest_noise(0.0) == strong.largest_noise(1.0) == last.largest_noise(0.0)
    limits = [last.largest_noise(i / 10) for i in range(11)]
    assert limits == sorted(limits, reverse=True)
    assert limits[0] <= 1.0, "the network begins with 1"
    assert limits[10] <= 0.5 * limits[0]


# --- In an environment ----------------------------------------------------------------------------


def settled(phase: Phase, done: float = 0.0) -> dict[str, tuple[float, float]]:
    """Weights that a phase should have, from its own numbers."""
    w = phase.weights_at(done)
    jump = {
        "dense_jump": -w.dense,
        "sparse_jump": w.sparse,
        "rise": w.rise,
        "reach": w.reach,
        "gap": w.gap,
        "countermovement": w.countermovement,
        "hop": -w.hop,
        "collision": -w.collision,
        "knees": -w.knees,
        "landing": -w.landing,
    }
    return {name: (row.walk, jump.get(name, row.jump)) for name, row in ROWS.items()}


def test_a_phase_is_the_same_configured_or_entered(env: Any) -> None:
    for entered in (*PHASES, *reversed(PHASES)):  # onwards and back again
        enter_phase(env, entered)
        cfg = env_cfg(num_envs=2)
        configure_phase(cfg, entered)
        command = motion_command(env)
        configured = cfg.commands[NAME]
        assert command.cfg.jump_fraction == configured.jump_fraction == entered.jump_fraction
        assert command.tracker.width == configured.width == entered.weights.width
        for rows in (reward_sum(env).rows, cfg.rewards[TABLE].params["rows"]):
            found = {name: (row.walk, row.jump) for name, row in rows.items()}
            assert found == settled(entered)


def test_a_phase_is_entered_where_it_has_come_to(env: Any) -> None:
    last = PHASES[2]
    for done in (0.5, 1.0, 0.0):
        enter_phase(env, last, done)
        found = {name: (row.walk, row.jump) for name, row in reward_sum(env).rows.items()}
        assert found == settled(last, done)
        assert motion_command(env).tracker.width == last.weights_at(done).width
    assert settled(last, 0.5) != settled(last, 0.0)


def test_environment_of_a_phase_begins_in_it() -> None:
    for begun in PHASES:
        rows = env_cfg(phase=begun, num_envs=2).rewards[TABLE].params["rows"]
        assert {name: (row.walk, row.jump) for name, row in rows.items()} == settled(begun)
