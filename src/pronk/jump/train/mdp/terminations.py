"""When an episode ends: a fall, physics gone wrong, or time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv


def fell(env: ManagerBasedRlEnv, tilt_cosine: float, height: float) -> Tensor:
    """The trunk is below `height` [m], or leans so that the cosine is below `tilt_cosine`. (N,).

    The cosine is that of the angle between the trunk's z axis and the vertical.
    """
    qpos = env.sim.data.qpos
    # It is 1 - 2 (x^2 + y^2) of the quaternion (w, x, y, z).
    leaning = qpos[:, 4:6].square().sum(dim=-1) > (1.0 - tilt_cosine) / 2.0
    return leaning | (qpos[:, 2] < height)


def non_finite(env: ManagerBasedRlEnv, speed: float) -> Tensor:
    """State that is not finite, or a joint or trunk faster than `speed` [rad/s, m/s]. (N,).

    Ends the episode of this robot alone.
    """
    # A largest magnitude is NaN if one of them is, and NaN is no less than anything.
    fastest = torch.linalg.vector_norm(env.sim.data.qvel, ord=torch.inf, dim=-1)
    farthest = torch.linalg.vector_norm(env.sim.data.qpos, ord=torch.inf, dim=-1)
    return ~((fastest <= speed) & (farthest < torch.inf))


def time_out(env: ManagerBasedRlEnv, steps: int) -> Tensor:
    """The episode has `steps` policy steps, however long each took (D1 varies it). (N,)."""
    return env.episode_length_buf >= steps
