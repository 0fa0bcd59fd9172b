"""When an episode ends: a fall, physics gone wrong, or time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


def fell(env: ManagerBasedRlEnv, tilt_cosine: float, height: float) -> Tensor:
    """The trunk leans too far or lies on the ground. Bool, (N,).

    Args:
        env: The environment.
        tilt_cosine: Least cosine of the angle between the trunk's z axis and the vertical.
        height: Least height of the trunk [m].
    """
    qpos = env.sim.data.qpos
    cosine = 1.0 - 2.0 * (qpos[:, 4].square() + qpos[:, 5].square())
    return (cosine < tilt_cosine) | (qpos[:, 2] < height)


def non_finite(env: ManagerBasedRlEnv, speed: float) -> Tensor:
    """State that is not finite, or faster than anything this robot can do. Bool, (N,).

    Ends this robot's episode and nobody else's; the runner counts them.

    Args:
        env: The environment.
        speed: Largest believable velocity, joint or trunk [rad/s, m/s].
    """
    qpos, qvel = env.sim.data.qpos, env.sim.data.qvel
    fastest = torch.nan_to_num(qvel.abs(), nan=torch.inf).amax(dim=-1)
    return (fastest > speed) | ~torch.isfinite(qpos.sum(dim=-1))


def time_out(env: ManagerBasedRlEnv, steps: int) -> Tensor:
    """A fixed number of policy steps, however long each takes (D1 varies it). Bool, (N,).

    Args:
        env: The environment.
        steps: Policy steps in an episode.
    """
    return env.episode_length_buf >= steps
