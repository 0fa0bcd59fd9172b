"""When an episode ends: a fall, physics gone wrong, or time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


def fell(env: ManagerBasedRlEnv, tilt_cosine: float, height: float) -> Tensor:
    """Find robots whose trunk is low or leans.

    Args:
        env: The environment.
        tilt_cosine: Smallest cosine of the angle between the trunk's z axis and the vertical.
        height: Smallest height of the trunk [m].

    Returns:
        Bool, (N,).
    """
    qpos = env.sim.data.qpos
    # It is 1 - 2 (x^2 + y^2) of the quaternion (w, x, y, z).
    leaning = qpos[:, 4:6].square().sum(dim=-1) > (1.0 - tilt_cosine) / 2.0
    return leaning | (qpos[:, 2] < height)


def non_finite(env: ManagerBasedRlEnv, speed: float) -> Tensor:
    """Find robots whose physics went wrong; the episode of such a robot alone ends.

    Args:
        env: The environment.
        speed: Largest speed of joints and trunk [rad/s, m/s].

    Returns:
        Where the state is not finite or something is faster, bool, (N,).
    """
    # A largest magnitude is NaN if one of them is, and NaN is no less than anything.
    fastest = torch.linalg.vector_norm(env.sim.data.qvel, ord=torch.inf, dim=-1)
    farthest = torch.linalg.vector_norm(env.sim.data.qpos, ord=torch.inf, dim=-1)
    return ~((fastest <= speed) & (farthest < torch.inf))


def time_out(env: ManagerBasedRlEnv, steps: int) -> Tensor:
    """Find robots whose episode has `steps` policy steps, however long each took (D1 varies it)."""
    return env.episode_length_buf >= steps
