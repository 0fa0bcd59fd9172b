"""Measure the jumps of many robots while they run, by the rules of `evaluation.jumps`.

Called at every physics step, on the device, without waiting for it: everything is a masked update
of tensors of shape (N,) or (N, 13). The definitions are those of `pronk.evaluation.jumps`; whether
a robot
touched is said as in `pronk.evaluation.metrics`.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pronk.evaluation.jumps import JumpRules, along, steps
from pronk.evaluation.training_sim.plan import NEVER

STATE = {"position": 3, "orientation": 4, "velocity": 3, "angular_velocity": 3}
"""The trunk: position [m], quaternion w x y z and velocity [m/s] in the world's frame, angular
velocity in its own [rad/s]. A free joint has them in this order."""
STATE_SIZE = sum(STATE.values())
_XY, _Z = slice(0, 2), 2
_ORIENTATION, _VELOCITY = slice(3, 7), slice(7, 10)


class FlightRecorder:
    """Running figures of the jumps of N robots."""

    def __init__(
        self, count: int, *, device: torch.device | str, rules: JumpRules, dt: float
    ) -> None:
        """Begin before the first sample; nobody is told to jump yet.

        Args:
            count: Robots.
            device: Where they are.
            rules: Of the definitions.
            dt: Time between samples [s].
        """
        self.rules, self.dt = rules, dt
        self.sample = 0
        """Number of the sample that comes next."""
        self._search = steps(rules.search_s, dt)
        self._least = steps(rules.flight_s, dt)
        self._long = steps(rules.long_s, dt)
        self._tail = steps(rules.tail_s, dt)
        self._upright = steps(rules.upright_s, dt)
        self._grace = steps(rules.grace_s, dt)

        def number(value: float, *width: int) -> Tensor:
            return torch.full((count, *width), value, device=device)

        def whole(value: int = 0) -> Tensor:
            return torch.full((count,), value, dtype=torch.int64, device=device)

        self._alive = torch.ones(count, dtype=torch.bool, device=device)
        self.on = whole(NEVER)
        """Sample at which each robot's jump input rises; `NEVER` while it has not."""
        # The flight under way, or the last one.
        self._run = whole()
        self._up = number(0.0, STATE_SIZE)
        self._up_at = whole()
        self._peak = number(0.0)
        # The main flight so far.
        self._main = whole()
        self._main_up = number(0.0, STATE_SIZE)
        self._main_up_at = whole()
        self._main_peak = number(0.0)
        self._main_down = number(0.0, 2)
        self._down_at = whole(-NEVER)
        self._cosine = number(-1.0)
        # All of the jump.
        self._flights = whole()
        self._long_flights = whole()
        self._high_flights = whole()
        self._top = number(-torch.inf)
        self._low = number(torch.inf)
        self._deadline = whole(NEVER)
        self._height = number(torch.nan)
        self._unasked = number(-torch.inf)
        # A robot that fell lies on the ground from then on.
        self._touched_at = whole(NEVER)
        self._fell_at = whole(NEVER)

    def tell(self, jump: Tensor, at: int) -> None:
        """Robots whose jump input is on at a sample to come; only its first rise counts.

        Args:
            jump: Bool, shape (N,).
            at: The sample.
        """
        rises = jump & (self.on == NEVER)
        self.on = torch.where(rises, at, self.on)
        self._deadline = torch.where(rises, at + self._search, self._deadline)

    def add(self, state: Tensor, airborne: Tensor, touching: Tensor, alive: Tensor) -> None:
        """One physics step further.

        Args:
            state: As `STATE` has it. (N, 13)
            airborne: No foot on the ground. Bool, shape (N,).
            touching: Anything but a foot on the ground. Bool, shape (N,).
            alive: Not fallen. Once false, or with a number that is not finite, a robot is out.
        """
        k = self.sample
        self.sample += 1
        stood = self._alive
        self._alive = stood & alive & torch.isfinite(state).all(dim=-1)
        self._fell_at = torch.where(stood & ~self._alive, k, self._fell_at)
        z = state[:, _Z]
        air, ground = self._alive & airborne, self._alive & ~airborne

        begins = air & (self._run == 0)
        self._up = torch.where(begins[:, None], state, self._up)
        self._up_at = torch.where(begins, k, self._up_at)
        top = torch.where(begins, z, torch.maximum(self._peak, z))
        self._peak = torch.where(air, top, self._peak)

        self._land(k, state, ground & (self._run >= self._least))
        self._run = torch.where(air, self._run + 1, torch.where(ground, 0, self._run))

        told = self._alive & (k >= self.on)
        first = told & touching & (self._touched_at == NEVER)
        self._touched_at = torch.where(first, k, self._touched_at)
        self._top = torch.where(told, torch.maximum(self._top, z), self._top)
        self._low = torch.where(told, torch.minimum(self._low, z), self._low)
        self._height = torch.where(
            told & (k <= self._deadline), self._top - self._low, self._height
        )
        x, y = state[:, 4], state[:, 5]
        due = self._alive & (self._down_at == k - self._upright)
        self._cosine = torch.where(due, 1.0 - 2.0 * (x * x + y * y), self._cosine)

    def _land(self, k: int, state: Tensor, lands: Tensor) -> None:
        """End the flights of robots that have ground under a foot again."""
        asked = (self._up_at >= self.on) & (self._up_at <= self.on + self._search)
        own = lands & asked
        long = own & (self._run >= self._long)
        self._flights += own
        self._long_flights += long
        high = long & (self._peak > self.rules.high)
        self._high_flights += high
        main = high & (self._run > self._main)
        self._main = torch.where(main, self._run, self._main)
        self._main_up = torch.where(main[:, None], self._up, self._main_up)
        self._main_up_at = torch.where(main, self._up_at, self._main_up_at)
        self._main_peak = torch.where(main, self._peak, self._main_peak)
        self._main_down = torch.where(main[:, None], state[:, _XY], self._main_down)
        self._down_at = torch.where(main, k, self._down_at)
        self._cosine = torch.where(main, -1.0, self._cosine)
        self._deadline = torch.where(main, k + self._tail, self._deadline)
        unasked = lands & ~asked & (self._up_at >= self._grace)
        highest = torch.maximum(self._unasked, self._peak)
        self._unasked = torch.where(unasked, highest, self._unasked)

    def figures(self, command: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
        """The fields of `jumps.Jump`, `touched`, and `unasked`, its `unasked_height`; each (N,).

        Args:
            command: Forward and left velocity command [m/s]. (N, 2)

        Returns:
            Numbers; NaN where a robot did not jump, `height` also where it fell before the
            command or had none. `upright` is 0 or 1, as is `touched`: anything but a foot on the
            ground from the command to `upright_s` after touchdown, without a jump for `search_s`.
            One that fell within that time after a jump lies there: it touched.
        """

        def plain(value: Tensor) -> NDArray[np.float64]:
            return value.double().cpu().numpy()

        found = plain(self._main) > 0
        up, displacement = plain(self._main_up), plain(self._main_down - self._main_up[:, _XY])
        velocity = up[:, _VELOCITY]
        jump = {
            "apex": plain(self._main_peak),
            "delay": plain(self._main_up_at - self.on) * self.dt,
            "duration": plain(self._main) * self.dt,
            "vertical": velocity[:, 2],
            "horizontal": np.hypot(velocity[:, 0], velocity[:, 1]),
            "distance": np.hypot(displacement[:, 0], displacement[:, 1]),
            "along": along(displacement, up[:, _ORIENTATION], command),
        }
        unasked = plain(self._unasked)
        jumped = self._main > 0
        judged = torch.where(jumped, self._down_at + self._upright, self.on + self._search)
        touched = (self._touched_at < NEVER) & (self._touched_at <= judged)
        touched |= jumped & (self._fell_at <= judged)
        return {name: np.where(found, value, np.nan) for name, value in jump.items()} | {
            "flights": plain(self._flights),
            "long_flights": plain(self._long_flights),
            "high_flights": plain(self._high_flights),
            "height": plain(self._height),
            "upright": (plain(self._cosine) >= self.rules.upright_cosine).astype(float),
            "touched": plain(touched),
            "unasked": np.where(np.isfinite(unasked), unasked, np.nan),
        }
