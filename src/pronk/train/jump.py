"""One jump, followed from the command to the ground: what the jump rewards are paid for.

All quantities are one per robot, shape (N,), seen once per policy step (20 ms). A robot is
airborne when no foot touches the ground. From the rising edge of the jump input a robot is in
jump mode until the input is off, it has ground under a foot, and `settle_s` have passed: what
goes up while the input is on comes down in jump mode too.

Within one command only the best so far is paid, so that many small hops earn no more than one
good jump (a row of hops is what exp(-(v - 2.5)^2 / 2), paid at every lift-off, was seen to teach:
at 1 m/s it still pays a third). The paper's kernel is wide, and has to be where jumping is yet to
be found; once it is, a narrow one tells 2.2 from 2.5 m/s.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pronk.errors import PronkError


@dataclass(frozen=True, kw_only=True)
class JumpSettings:
    """What a good jump is."""

    liftoff_velocity: float = 2.5
    """Desired vertical velocity of the trunk at lift-off [m/s] (paper, section IV)."""
    prompt_s: float = 0.28
    """A lift-off up to this long after the command is worth the full reward [s]."""
    late_s: float = 0.25
    """Beyond that its worth falls linearly to zero over this time [s]."""
    settle_s: float = 0.3
    """Time on the ground after which jump mode ends [s]."""
    aim_width: float = 0.5
    """Standard deviation of the kernel that asks where the jump goes [m/s]: a running robot has a
    tenth of a second to speed up, so a kernel as narrow as that of the lift-off says nothing."""
    stroke: float = 0.5
    """Height of a jump, from its lowest to its highest trunk, up to which it is rewarded [m]: the
    paper calls .45 m the physical limit. Beyond it a strong robot shall rather go far."""

    def __post_init__(self) -> None:
        """Refuse widths and times that are not positive."""
        for name in ("liftoff_velocity", "prompt_s", "late_s", "settle_s", "aim_width", "stroke"):
            if not getattr(self, name) > 0.0:
                raise PronkError(f"JumpSettings.{name} is {getattr(self, name)}, not positive.")


class JumpTracker:
    """State of the jumps of N robots, and what happened in the last step."""

    def __init__(
        self, count: int, device: torch.device | str, settings: JumpSettings, width: float
    ) -> None:
        self.settings = settings
        self.width = width
        """Standard deviation of the lift-off kernel [m/s]; a phase sets it."""

        def zeros() -> Tensor:
            return torch.zeros(count, device=device)

        def no() -> Tensor:
            return torch.zeros(count, dtype=torch.bool, device=device)

        self.commanded = no()
        """Jump input at the last step."""
        self.airborne = no()
        self.mode = no()
        """In jump mode."""
        self.settling = zeros()
        """Time left in jump mode once on the ground with the input off [s]."""
        self.since = zeros()
        """Time since the rising edge of the input [s]; does not run out of jump mode."""
        self.vertical = zeros()
        """Vertical velocity of the trunk at the last step [m/s]."""
        self.best = zeros()
        """Best lift-off score of this command."""
        self.highest = zeros()
        """Highest trunk of this command [m]."""
        self.lowest = zeros()
        """Lowest trunk of this command before its first lift-off [m]."""
        self.stroke = zeros()
        """Height of the jump so far: `highest` minus `lowest`, up to the one rewarded [m]."""
        self.liftoffs = zeros()
        """Number of lift-offs of this command."""
        self.gain = zeros()
        """Improvement of the lift-off score in the last step."""
        self.rise = zeros()
        """What `stroke` gained in the last step [m]."""
        self.flown = zeros()
        """Ground covered in the flight under way [m]."""
        self.farthest = zeros()
        """Ground covered in the longest flight of this command [m]."""
        self.reach = zeros()
        """New distance gained in the last step [m]."""
        self.hop = zeros()
        """1 where the last step was a lift-off after the first of its command."""

    def reset(self, env_ids: Tensor) -> None:
        """Forget everything of some robots.

        Args:
            env_ids: Which, shape (n,).
        """
        for value in vars(self).values():
            if isinstance(value, Tensor):
                value[env_ids] = 0

    def advance(
        self,
        *,
        jump: Tensor,
        contact: Tensor,
        height: Tensor,
        vertical: Tensor,
        miss: Tensor,
        along: Tensor,
        dt: float,
    ) -> None:
        """One policy step further.

        Args:
            jump: Jump input, bool, shape (N,).
            contact: Foot contacts, bool, shape (N, 4).
            height: Trunk over ground [m].
            vertical: Vertical velocity of the trunk [m/s].
            miss: Distance of its horizontal velocity from the one asked for [m/s].
            along: Part of its horizontal velocity in the direction asked for [m/s].
            dt: Duration of the step [s].
        """
        s = self.settings
        airborne = ~contact.any(dim=-1)
        begins = jump & ~self.commanded
        keep = ~begins
        self.settling = torch.where(
            jump,
            s.settle_s,
            torch.where(airborne, self.settling, (self.settling - dt).clamp_min(0.0)),
        )
        self.mode = self.settling > 0.0
        self.since = (self.since * keep + dt) * self.mode
        liftoff = (airborne & ~self.airborne & self.mode).float()

        # Sampled every 20 ms, the velocity at lift-off lies between the last two samples.
        speed = torch.maximum(vertical, self.vertical)
        deviation = (speed - s.liftoff_velocity).square()
        kernel = torch.exp(deviation * (-0.5 / self.width**2))
        prompt = torch.rsub(self.since, (s.prompt_s + s.late_s) / s.late_s, alpha=1.0 / s.late_s)
        # Half the worth is for going up, half for going where the command says as well.
        aim = torch.exp(miss.square() * (-0.5 / s.aim_width**2))
        score = kernel * (0.5 + 0.5 * aim) * prompt.clamp(0.0, 1.0) * liftoff
        best = self.best * keep
        self.best = torch.maximum(best, score)
        self.gain = self.best - best

        liftoffs = self.liftoffs * keep
        self.hop = liftoff * (liftoffs > 0.0)
        self.liftoffs = liftoffs + liftoff

        # A crouch counts: the way over which the legs push is what a battery's power is short of.
        goes_on = self.mode & keep
        highest = torch.where(goes_on, self.highest, height)
        lowest = torch.where(goes_on, self.lowest, height)
        stroke = self.stroke * goes_on
        self.highest = torch.maximum(highest, height)
        self.lowest = torch.where(self.liftoffs > 0.0, lowest, torch.minimum(lowest, height))
        self.stroke = (self.highest - self.lowest).clamp_max(s.stroke)
        self.rise = self.stroke - stroke

        stays = airborne & self.airborne & self.mode
        self.flown = (self.flown + along * dt) * stays
        farthest = self.farthest * keep
        self.farthest = torch.maximum(farthest, self.flown)
        self.reach = self.farthest - farthest

        self.commanded = jump.clone()
        self.airborne = airborne
        self.vertical = vertical.clone()
