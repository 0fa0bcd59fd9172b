"""Doing as one is shown, beside PPO."""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("rsl_rl")

from pronk.train.rl.following import follow, lesson
from pronk.train.rl.symmetry import with_mirror_image
from small_ppo import ROBOTS, STEPS, build, observe, one_thread, roll_out, same, weights  # noqa: F401

pytestmark = [pytest.mark.train, pytest.mark.usefixtures("one_thread")]


def play(jump: int | None = None, rows: int = ROBOTS) -> Any:
    """Who is told to jump is shown the same, which is its own mirror image."""
    seen = observe(rows)
    if jump is not None:
        seen["jump"][:] = jump
    seen["demonstration"][:, :12] = torch.tensor([0.0, 1.5, -2.0] * 4)
    seen["demonstration"][:, 12:] = seen["jump"]
    return seen


def test_a_lesson_has_what_is_shown_and_as_much_of_what_is_done() -> None:
    actor = build(jump=True).get_policy()
    rollout = torch.stack([play() for _ in range(STEPS)])
    rollout["jump"][:] = 0.0
    rollout["demonstration"][..., 12] = 0.0
    rollout["demonstration"][1, :20, 12] = 1.0
    rollout["jump"][1] = 1.0  # whoever is not shown anything has landed
    given = lesson(actor, rollout, least=1)
    assert given.actions.shape == (80, 12)
    assert given.shown.sum() == 40
    asked = given.actions[:40]
    shown = given.shown[:40]
    walks = given.observations["jump"][:40][~shown]
    assert not walks.any()
    assert torch.equal(asked[shown], torch.tensor([0.0, 1.5, -2.0] * 4).expand(20, 12))
    with torch.no_grad():
        does = actor(given.observations[:40])
    assert torch.allclose(asked[~shown], does[~shown], atol=1e-6)
    _, both = with_mirror_image(None, None, asked)
    assert both is not None
    assert torch.equal(given.actions, both)
    # Of a rollout in which nothing is shown, a part of what is done.
    rollout["demonstration"][..., 12] = 0.0
    given = lesson(actor, rollout, least=10)
    assert (given.actions.shape, int(given.shown.sum())) == ((20, 12), 0)
    optimizer = torch.optim.Adam(actor.mlp.parameters(), lr=1e-3)
    assert follow(actor, optimizer, given, steps=2) == 0.0


def test_who_follows_does_as_shown_and_what_it_did_where_nothing_is() -> None:
    torch.manual_seed(0)
    algorithm = build(jump=True, hidden=(64, 64), following_steps=16)
    actor = algorithm.get_policy()
    before = deepcopy(actor)
    told, walks = play(1, 256), play(0, 256)
    with torch.no_grad():
        first = actor(walks)
    optimizer = torch.optim.Adam(actor.mlp.parameters(), lr=3e-3)
    distances = []
    for _ in range(30):
        rollout = torch.stack([play() for _ in range(STEPS)])
        distances.append(follow(actor, optimizer, lesson(before, rollout), steps=8))
    with torch.no_grad():
        jumps, stays = actor(told), actor(walks)
    assert distances[-1] < 0.2 * distances[0]
    far = (jumps - told["demonstration"][:, :12]).square().mean()
    assert far < 0.2 * distances[0]
    assert (stays - first).square().mean() < 0.1


def test_ppo_follows_at_the_rate_it_is_given() -> None:
    found = []
    for rate in (0.0, 1e-9, 1e-3):
        torch.manual_seed(0)
        algorithm = build(jump=True)
        algorithm.following_rate = rate
        roll_out(algorithm, play)
        losses = algorithm.update()
        assert ("following" in losses) == (rate > 0.0)
        found.append(torch.nn.utils.parameters_to_vector(algorithm.get_policy().mlp.parameters()))
    none, hardly, more = found
    assert torch.allclose(none, hardly, atol=1e-6)
    assert not torch.allclose(none, more, atol=1e-4)


def test_who_it_was_before_and_the_optimizer_are_part_of_the_state() -> None:
    torch.manual_seed(0)
    algorithm = build(jump=True)
    assert "before_state_dict" not in algorithm.save()
    algorithm.following_rate = 1e-3
    first = weights(algorithm.get_policy().mlp)
    for _ in range(2):
        roll_out(algorithm, play)
        algorithm.update()
    other = build(jump=True)
    other.load(algorithm.save())
    assert other.follows
    assert same(weights(other.before), weights(algorithm.before))
    assert not same(weights(other.before.mlp), weights(algorithm.get_policy().mlp))
    assert not same(weights(other.before.mlp), first), "PPO's first update comes before"
    states = [a.following_optimizer.state_dict()["state"] for a in (algorithm, other)]
    assert len(states[0]) == len(list(algorithm.get_policy().mlp.parameters()))
    for key, moments in states[0].items():
        assert all(torch.equal(value, states[1][key][name]) for name, value in moments.items())
