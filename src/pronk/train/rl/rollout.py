"""Rollouts: act, step, store; nothing in here waits for the device.

rsl_rl's own loop checks every step for NaN and copies finished episodes to the host, which stops
a GPU several times a step.
"""

from __future__ import annotations

from typing import Any

import torch

from pronk.train.runner.progress import Episodes

NON_FINITE = "non_finite"
"""The termination term that says whose physics went wrong."""


def roll_out(env: Any, algorithm: Any, observations: Any, steps: int, episodes: Episodes) -> Any:
    """Fill the algorithm's storage.

    Environments whose physics goes wrong are ended by their termination term and counted. If
    anything that is not finite is still observed, zeros are put in its place, and it is counted
    too: one robot must not stop the others.

    Args:
        env: mjlab's wrapper for rsl_rl.
        algorithm: rsl_rl's PPO.
        observations: What to begin with, a TensorDict.
        steps: Policy steps.
        episodes: Gathers the figures.

    Returns:
        The observations after the last step.
    """
    terminations = env.unwrapped.termination_manager
    ends = NON_FINITE in terminations.active_terms
    # Not inference mode: its tensors could not be written to outside of it, and those of the
    # environment outlive the rollout.
    with torch.no_grad():
        for _ in range(steps):
            observations, rewards, dones, extras = env.step(algorithm.act(observations))
            wrong = make_finite(observations)
            if ends:
                wrong |= terminations.get_term(NON_FINITE)
            algorithm.process_env_step(observations, rewards, dones, extras)
            episodes.step(rewards, dones, extras["log"], wrong)
    return observations


def make_finite(observations: Any) -> torch.Tensor:
    """Put zeros for what is not finite, in place.

    Args:
        observations: A TensorDict of N rows.

    Returns:
        The rows in which something was not. Bool, (N,).
    """
    groups = list(observations.values(True, True))
    wrong = ~torch.isfinite(sum(group.flatten(1).sum(dim=-1) for group in groups))
    for group in groups:
        group.nan_to_num_(nan=0.0, posinf=0.0, neginf=0.0)
    return wrong
