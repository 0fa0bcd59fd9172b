"""How well velocities are kept and estimated, measured on the device while robots walk.

With v the trunk's horizontal velocity and w its yaw rate, both in the trunk's frame, c and r what
the robot is told, and means over the physics steps from `settle` to `end` at which it stands:

    speed error             mean |v - c|
    yaw error               mean |w - r|
    the same, averaged      with the mean of v (of w) over the last `average` samples, which takes
                            out what a stride does
    drift                   |xy(last) - xy(settle)|
    velocity error (estimator)   mean over policy steps of (v_est - v_true)^2, by axis
    contacts right               share of feet and policy steps at which (p > .5) is the truth

A robot that falls counts with what it did before; from then on it is out.
"""

from __future__ import annotations

import numpy as np
import torch
from mjlab.utils.lab_api.math import quat_apply_inverse
from numpy.typing import NDArray
from torch import Tensor

from pronk.policy.layout import ESTIMATE

FIGURES = ("speed_error", "yaw_error", "speed_error_averaged", "yaw_error_averaged")
_ERRORS = len(FIGURES)


class SpeedRecorder:
    """Running sums of the velocities of N robots."""

    def __init__(self, command: Tensor, *, settle: int, end: int, average: int) -> None:
        """Begin before the first sample.

        Args:
            command: Forward, left [m/s], yaw rate [rad/s]. (N, 3)
            settle: First sample that counts.
            end: First that no longer counts.
            average: Samples in the moving average; at most `settle`.
        """
        self._command = command
        self._settle, self._end = settle, end
        self._sample = 0
        self._last = torch.zeros(average, *command.shape, device=command.device)
        self._sums = torch.zeros(len(command), _ERRORS + 3, device=command.device)
        self._count = torch.zeros(len(command), device=command.device)
        self._from = torch.zeros(len(command), 2, device=command.device)
        self._to = torch.zeros_like(self._from)

    def add(self, state: Tensor, alive: Tensor) -> None:
        """One physics step further.

        Args:
            state: As `evaluation.flight.STATE` has it. (N, 13)
            alive: Not fallen. Bool, shape (N,).
        """
        k = self._sample
        self._sample += 1
        if k >= self._end:
            return
        velocity = quat_apply_inverse(state[:, 3:7], state[:, 7:10])
        measured = torch.cat([velocity[:, :2], state[:, 12:13]], dim=-1)
        self._last[k % len(self._last)] = measured
        if k < self._settle:
            return
        position = state[:, :2]
        if k == self._settle:
            self._from.copy_(position)
            self._to.copy_(position)
        counts = alive & torch.isfinite(measured).all(dim=-1)
        errors = [_errors(v - self._command) for v in (measured, self._last.mean(dim=0))]
        new = torch.cat([*errors, measured], dim=-1)
        self._sums += torch.where(counts[:, None], new, 0.0)
        self._count += counts
        self._to = torch.where(counts[:, None], position, self._to)

    def figures(self) -> dict[str, NDArray[np.float64]]:
        """By name: those of `FIGURES` and `drift` of shape (N,), mean `velocity` of (N, 3).

        A robot that fell before `settle` has NaN.
        """
        count = self._count[:, None]
        means = (self._sums / torch.where(count > 0, count, torch.nan)).double().cpu().numpy()
        drift = torch.linalg.vector_norm(self._to - self._from, dim=-1).double().cpu().numpy()
        figures = dict(zip(FIGURES, means.T, strict=False))
        figures["velocity"] = means[:, _ERRORS:]
        figures["drift"] = np.where(np.isnan(means[:, 0]), np.nan, drift)
        return figures


def _errors(error: Tensor) -> Tensor:
    """Speed and yaw rate error. (N, 2)."""
    speed = torch.linalg.vector_norm(error[:, :2], dim=-1, keepdim=True)
    return torch.cat([speed, error[:, 2:].abs()], dim=-1)


class EstimatorRecorder:
    """Running sums of the estimator's errors on N robots."""

    def __init__(self, count: int, device: torch.device | str) -> None:
        """Begin before the first policy step."""
        self._squares = torch.zeros(count, ESTIMATE["linear_velocity"], device=device)
        self._right = torch.zeros(count, device=device)
        self._count = torch.zeros(count, device=device)

    def add(self, estimate: tuple[Tensor, Tensor], target: Tensor, alive: Tensor) -> None:
        """One policy step further.

        Args:
            estimate: Contact probabilities (N, 4), velocity in the trunk's frame [m/s] (N, 3).
            target: The truth, contacts (0 or 1) first. (N, 7)
            alive: Not fallen. Bool, shape (N,).
        """
        contact, velocity = torch.split(target, list(ESTIMATE.values()), dim=-1)
        squares = (estimate[1] - velocity).square()
        right = ((estimate[0] > 0.5) == (contact > 0.5)).float().mean(dim=-1)
        counts = alive & torch.isfinite(squares).all(dim=-1)
        self._squares += torch.where(counts[:, None], squares, 0.0)
        self._right += torch.where(counts, right, 0.0)
        self._count += counts

    def sums(self) -> dict[str, NDArray[np.float64]]:
        """`squares` (N, 3) [m^2/s^2], `right` (N,) and the `count` (N,) of policy steps."""
        return {
            "squares": self._squares.double().cpu().numpy(),
            "right": self._right.double().cpu().numpy(),
            "count": self._count.double().cpu().numpy(),
        }
