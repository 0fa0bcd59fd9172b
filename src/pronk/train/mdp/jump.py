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
    """A lift-off up to this long after the command is worth the full reward [s], and so are the
    ground and the gap that its flight covers."""
    ready_s: float = 0.26
    """From so long after the command on it is worth all; before, the square of the time's part of
    it [s]: a push at once takes a power that batteries do not have. It has to be so from the first
    jump on: policies that had learned to jump after .10 s never waited, whatever they were paid.
    """
    late_s: float = 0.15
    """Beyond that its worth falls linearly to zero over this time [s]. Over .25 s three of three
    policies came to lift off after .29 to .35 s: a deeper fall, a higher jump, and not as far. With
    .12 s from .26 s on, four policies found the jump late or, one of them, never."""
    haste: float = 0.3
    """Standard deviation of the kernel that takes worth from a jump for what its running start was
    faster than told [m/s]. Paid for its height alone, speed is braked away for it: policies came to
    run at 2.2 to 2.5 m/s when told 2."""
    sloth: float = 0.5
    """The same for what it was slower [m/s]: slow jumps are easier to land, and policies came to
    run at 1.1 m/s when told 2, and at 2.6 when told 3."""
    leap: float = 1.0
    """A lift-off slower than this is a stride: no hop, and not the end of the crouch [m/s]."""
    settle_s: float = 0.3
    """Time on the ground after which jump mode ends [s]."""
    aim_width: float = 0.5
    """Standard deviation of the kernel that asks where the jump goes [m/s]: a running robot has a
    tenth of a second to speed up, so a kernel as narrow as that of the lift-off says nothing."""
    stroke: float = 0.5
    """Height of a jump, from its lowest to its highest trunk, up to which it is rewarded [m]: the
    paper calls .45 m the physical limit. Beyond it a strong robot shall rather go far."""
    crouch: float = 0.18
    """Lowest trunk from which a stroke counts [m]: knees are 8 cm over ground there. Without it a
    policy fell with folded legs to 0.12 m, onto its shanks, and lost a quarter of its speed."""
    gap: float = 1.0
    """Gap up to which clearing it is rewarded [m]; the longest known of this size is .7 m."""

    def __post_init__(self) -> None:
        """Refuse what is not positive."""
        for name in vars(self):
            if not getattr(self, name) > 0.0:
                raise PronkError(f"JumpSettings.{name} is {getattr(self, name)}, not positive.")
        if not self.ready_s <= self.prompt_s:
            raise PronkError(
                f"JumpSettings has ready_s {self.ready_s} and prompt_s {self.prompt_s}; they must "
                "be in this order."
            )


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
        """Lowest trunk of this command before its first lift-off, `crouch` or more [m]."""
        self.stroke = zeros()
        """Height of the jump so far: `highest` minus `lowest`, up to the one rewarded [m]."""
        self.liftoffs = zeros()
        """Number of lift-offs of this command that are no strides."""
        self.gain = zeros()
        """Improvement of the lift-off score in the last step."""
        self.rise = zeros()
        """What `stroke` gained in the last step [m]."""
        self.pace = zeros()
        """How much faster than told it went when this command came; slower: below zero [m/s]."""
        self.worth = zeros()
        """What the time of the last lift-off makes of all that its flight is paid for."""
        self.flown = zeros()
        """What the ground covered in the flight under way is worth, but for the part that `lead`
        brought [m]."""
        self.brought = zeros()
        """That part [m]."""
        self.farthest = zeros()
        """The same of the best flight of this command [m]."""
        self.reach = zeros()
        """New distance gained in the last step [m]."""
        self.stood = torch.zeros(count, 4, 2, device=device)
        """Where each foot stood last, world frame [m]. (N, 4, 2)"""
        self.widest = zeros()
        """Worth of the widest gap that a flight of this command has cleared [m]."""
        self.gap = zeros()
        """What `widest` gained in the last step [m]."""
        self.hop = zeros()
        """1 where the last step was a lift-off after the first of its command."""

    @property
    def lead(self) -> Tensor:
        """How much faster than told it went when this command came, if it did [m/s]."""
        return self.pace.clamp_min(0.0)

    @property
    def landed(self) -> Tensor:
        """On the ground again after a lift-off of this command. Bool, (N,)."""
        return (self.liftoffs > 0.0) & ~self.airborne

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
        excess: Tensor,
        feet: Tensor,
        direction: Tensor,
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
            excess: How much more it is than the velocity command [m/s].
            feet: Horizontal positions of the feet, world frame [m], shape (N, 4, 2).
            direction: Unit vector of where it is asked to go, world frame, or zero, shape (N, 2).
            dt: Duration of the step [s].
        """
        s = self.settings
        airborne = ~contact.any(dim=-1)
        begins = jump & ~self.commanded
        keep = ~begins
        # Paid for as well, it taught to run at 2.3 m/s when told 2, a jump might come.
        self.pace = torch.where(begins, excess, self.pace)
        lead = self.lead
        self.settling = torch.where(
            jump,
            s.settle_s,
            torch.where(airborne, self.settling, (self.settling - dt).clamp_min(0.0)),
        )
        self.mode = self.settling > 0.0
        self.since = (self.since * keep + dt) * self.mode
        # Sampled every 20 ms, the velocity at lift-off lies between the last two samples.
        speed = torch.maximum(vertical, self.vertical)
        liftoff = (airborne & ~self.airborne & self.mode).float()
        leap = liftoff * (speed > s.leap)
        deviation = (speed - s.liftoff_velocity).square()
        kernel = torch.exp(deviation * (-0.5 / self.width**2))
        prompt = torch.rsub(self.since, (s.prompt_s + s.late_s) / s.late_s, alpha=1.0 / s.late_s)
        # Half the worth is for going up, half for going where the command says as well.
        aim = torch.exp(miss.square() * (-0.5 / s.aim_width**2))
        ready = (self.since / s.ready_s).square()
        off_pace = lead / s.haste + (self.pace - lead) / s.sloth
        worth = torch.minimum(prompt, ready).clamp(0.0, 1.0) * torch.exp(-0.5 * off_pace.square())
        self.worth = torch.where(liftoff > 0.0, worth, self.worth * keep)
        score = kernel * (0.5 + 0.5 * aim) * self.worth * liftoff
        best = self.best * keep
        self.best = torch.maximum(best, score)
        self.gain = self.best - best

        liftoffs = self.liftoffs * keep
        self.hop = leap * (liftoffs > 0.0)
        self.liftoffs = liftoffs + leap

        # A crouch counts: the way over which the legs push is what a battery's power is short of.
        goes_on = self.mode & keep
        highest = torch.where(goes_on, self.highest, height)
        low = height.clamp_min(s.crouch)
        lowest = torch.where(goes_on, self.lowest, low)
        stroke = self.stroke * goes_on
        self.highest = torch.maximum(highest, height)
        self.lowest = torch.where(self.liftoffs > 0.0, lowest, torch.minimum(lowest, low))
        self.stroke = (self.highest - self.lowest).clamp(0.0, s.stroke)
        self.rise = self.stroke - stroke

        stays = airborne & self.airborne & self.mode
        self.flown = (self.flown + (along - lead) * self.worth * dt) * stays
        farthest = self.farthest * keep
        self.farthest = torch.maximum(farthest, self.flown)
        self.reach = self.farthest - farthest

        # No foot stepped between the front-most that left and the hind-most that comes (A16).
        lands = self.airborne & ~airborne & self.mode
        left = (self.stood @ direction[:, :, None]).amax(dim=(1, 2))
        comes = (feet @ direction[:, :, None]).amin(dim=(1, 2))
        widest = self.widest * keep
        cleared = (comes - left - self.brought).clamp_max(s.gap) * self.worth * lands
        self.brought = (self.brought + lead * dt) * airborne
        self.widest = torch.maximum(widest, cleared)
        self.gap = self.widest - widest
        self.stood = torch.where(contact[:, :, None], feet, self.stood)

        self.commanded = jump.clone()
        self.airborne = airborne
        self.vertical = vertical.clone()
