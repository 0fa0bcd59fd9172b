"""Learning to do as one is shown, by supervision beside PPO.

Robots that are led through a jump (`pronk.train.mdp.demonstration`) are where that jump
goes, so what they are shown there is what a policy that jumps so would do: behaviour cloning
without its drift. It has steps of its own, as the estimator has. As a term of PPO's loss it was
held back by PPO's bound on how much a policy changes: what is shown is ten standard deviations
away, a bound of 0.01 nat an iteration lets a policy go half of one there, and after 25 iterations
it was led less than it had learned, and fell.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from pronk.train.rl.actor import EstimatorActor
from pronk.train.rl.symmetry import with_mirror_image

GROUP = "demonstration"
"""The group of observations that holds the actions shown, and whether any are."""


@dataclass(frozen=True, kw_only=True)
class Lesson:
    """What a policy shall do, row by row."""

    observations: TensorDict
    """Groups, (M, size) each."""
    actions: Tensor
    """(M, 12)"""
    shown: Tensor
    """Whether a row is one of those shown, bool. (M,)"""


@torch.no_grad()
def lesson(before: EstimatorActor, observations: TensorDict, *, least: int = 256) -> Lesson:
    """All rows of a rollout in which something was shown, and as many of walking, shuffled.

    In those a policy shall do what it did before it was shown anything: walking is not to be
    unlearned. Asked for what it did an iteration ago, it lost it bit by bit, since the weights of
    the jump input begin with zero and tell one from the other too late. All rows come with their
    mirror images.

    Args:
        before: The policy when it began to follow.
        observations: Groups of a rollout, (steps, robots, size) each.
        least: So many rows of walking at least, should little or nothing have been shown.
    """
    rows = observations.flatten(0, 1)
    shows = rows[GROUP][:, -1] > 0.5
    order = torch.randperm(len(shows), device=shows.device)
    # Told to jump, and shown nothing any more: nobody's lesson.
    walks = ~shows & (rows["jump"][:, 0] == 0.0)
    first, other = order[shows[order]], order[walks[order]]
    chosen = torch.cat([first, other[: max(len(first), least)]])
    chosen = chosen[torch.randperm(len(chosen), device=chosen.device)]
    taken, shown = rows[chosen], shows[chosen]
    asked = torch.where(shown[:, None], taken[GROUP][:, :-1], before(taken))
    both, actions = with_mirror_image(None, taken, asked)
    assert both is not None
    assert actions is not None
    return Lesson(observations=both, actions=actions, shown=shown.repeat(2))


def follow(
    actor: EstimatorActor,
    optimizer: torch.optim.Optimizer,
    given: Lesson,
    *,
    steps: int,
    reduce: Callable[[list[nn.Parameter]], None] | None = None,
    max_grad_norm: float = 1.0,
) -> float:
    """Go through a lesson once, a part of it in each step.

    Args:
        actor: Who learns.
        optimizer: Of the actor's `mlp`.
        given: What it shall do.
        steps: Number of steps.
        reduce: Averages the parameters' gradients over processes; None with one.
        max_grad_norm: Largest norm of the gradients.

    Returns:
        Mean squared distance from what was shown, before each step; 0 if nothing was.
    """
    parameters = list(actor.mlp.parameters())
    seen: list[Tensor] = []
    places = torch.randperm(len(given.actions), device=given.actions.device)
    for part in places.tensor_split(steps):
        square = (actor(given.observations[part]) - given.actions[part]).square().mean(dim=1)
        optimizer.zero_grad()
        square.mean().backward()
        if reduce is not None:
            reduce(parameters)
        nn.utils.clip_grad_norm_(parameters, max_grad_norm)
        optimizer.step()
        shown = given.shown[part]
        seen.append((square.detach() * shown).sum() / shown.sum().clamp_min(1))
    # PPO clips and reduces what gradients it finds in the actor: leave it none.
    optimizer.zero_grad()
    return float(torch.stack(seen).mean())
