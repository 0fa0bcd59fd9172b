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
    faster than commanded [m/s]. Paid for its height alone, speed is braked away for it: policies
    came to
    run at 2.2 to 2.5 m/s when commanded 2."""
    leap: float = 1.0
    """A lift-off slower than this is a stride: no hop, and not the end of the crouch [m/s]."""
    settle_s: float = 0.3
    """Time on the ground after which jump mode ends [s]."""
    aim_width: float = 0.5
    """Standard deviation of the kernel that asks where the jump goes [m/s]: a running robot has a
    tenth of a second to speed up, so a kernel as narrow as that of the lift-off says nothing."""
    turn_width: float = 1.0
    """Standard deviation of the kernel that asks the trunk not to turn as it leaves the ground
    [rad/s]: nothing stops that in the air, and at 2 m/s policies came down with the nose .3 rad low
    after .4 s, one fore foot first and early."""
    stroke: float = 0.5
    """Height of a jump, from its lowest to its highest trunk, up to which it is rewarded [m]: the
    paper calls .45 m the physical limit. Beyond it a strong robot shall rather go far."""
    crouch: float = 0.18
    """Lowest trunk from which a stroke counts [m]: knees are 8 cm over ground there. Without it a
    policy fell with folded legs to 0.12 m, onto its shanks, and lost a quarter of its speed."""
    gap: float = 1.0
    """Gap up to which clearing it is rewarded [m]; the longest known of this size is .7 m."""
    fall: float = 9.0
    """Acceleration downwards with which a countermovement begins [m/s^2]: all but free fall."""
    fall_s: float = 0.12
    """How long it falls [s]; 6.5 cm, and 2.5 more until it is at rest."""
    likeness_width: float = 0.05
    """Standard deviation of the kernel that compares legs' lengths with a countermovement's [m]."""

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
        if not self.fall_s < self.prompt_s:
            raise PronkError(
                f"JumpSettings has fall_s {self.fall_s}, but prompt_s {self.prompt_s}; the fall "
                "must be over before."
            )

    @property
    def push(self) -> float:
        """Acceleration upwards from the end of the fall to lift-off [m/s^2]."""
        return (self.liftoff_velocity + self.fall * self.fall_s) / (self.prompt_s - self.fall_s)

    def countermovement(self, since: Tensor) -> Tensor:
        """How much longer than in the default pose a leg is in a jump that falls and pushes [m].

        The trunk goes down with `fall` for `fall_s`, then its velocity rises evenly, by `push`, to
        `liftoff_velocity` at `prompt_s`, and the feet stay where they are: over the way that is
        left to the push it takes about a third of the power of a jump at once.

        Args:
            since: Time since the command [s]; any shape.
        """
        falls = since.clamp_max(self.fall_s)
        pushes = (since - self.fall_s).clamp_min(0.0)
        pushed = (-self.fall * self.fall_s + 0.5 * self.push * pushes) * pushes
        return pushed - 0.5 * self.fall * falls.square()


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
        self.lead = zeros()
        """How much faster than commanded it went when this command came [m/s]."""
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
        self.likeness = zeros()
        """How alike the legs' lengths are to a countermovement's, 0 to 1; 0 from the first lift-off
        or `prompt_s` on."""
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
        turn: Tensor,
        along: Tensor,
        excess: Tensor,
        feet: Tensor,
        direction: Tensor,
        stretch: Tensor,
        dt: float,
    ) -> None:
        """One policy step further.

        Args:
            jump: Jump input, bool, shape (N,).
            contact: Foot contacts, bool, shape (N, 4).
            height: Trunk over ground [m].
            vertical: Vertical velocity of the trunk [m/s].
            miss: Distance of its horizontal velocity from the one commanded [m/s].
            turn: Roll and pitch rate of the trunk together [rad/s].
            along: Part of its horizontal velocity in the direction commanded [m/s].
            excess: How much more it is than the velocity command [m/s].
            feet: Horizontal positions of the feet, world frame [m], shape (N, 4, 2).
            direction: Unit vector of where it is commanded to go, world frame, or zero, shape (N,
            2).
            stretch: How much longer each leg is than in the default pose [m], shape (N, 4).
            dt: Duration of the step [s].
        """
        s = self.settings
        airborne = ~contact.any(dim=-1)
        begins = jump & ~self.commanded
        keep = ~begins
        # Paid for as well, it taught to run at 2.3 m/s when commanded 2, a jump might come.
        self.lead = torch.where(begins, excess.clamp_min(0.0), self.lead)
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
        # Half the worth is for going up, half for going where the command says, and level, as well.
        off_aim = (miss / s.aim_width).square() + (turn / s.turn_width).square()
        aim = torch.exp(-0.5 * off_aim)
        ready = (self.since / s.ready_s).square()
        calm = torch.exp(self.lead.square() * (-0.5 / s.haste**2))
        worth = torch.minimum(prompt, ready).clamp(0.0, 1.0) * calm
        self.worth = torch.where(liftoff > 0.0, worth, self.worth * keep)
        score = kernel * (0.5 + 0.5 * aim) * self.worth * liftoff
        best = self.best * keep
        self.best = torch.maximum(best, score)
        self.gain = self.best - best

        liftoffs = self.liftoffs * keep
        self.hop = leap * (liftoffs > 0.0)
        self.liftoffs = liftoffs + leap
        before = self.mode & (self.liftoffs == 0.0) & (self.since <= s.prompt_s)
        # Leg by leg: what one of them does shows in its own length at once, in the trunk's velocity
        # together with three others and later. Of that nothing was learned in 170 iterations.
        off = (stretch - s.countermovement(self.since)[:, None]).square()
        self.likeness = torch.exp(off * (-0.5 / s.likeness_width**2)).mean(dim=-1) * before

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
        self.flown = (self.flown + (along - self.lead) * self.worth * dt) * stays
        farthest = self.farthest * keep
        self.farthest = torch.maximum(farthest, self.flown)
        self.reach = self.farthest - farthest

        # No foot stepped between the front-most that left and the hind-most that comes (A16).
        lands = self.airborne & ~airborne & self.mode
        left = (self.stood @ direction[:, :, None]).amax(dim=(1, 2))
        comes = (feet @ direction[:, :, None]).amin(dim=(1, 2))
        widest = self.widest * keep
        cleared = (comes - left - self.brought).clamp_max(s.gap) * self.worth * lands
        self.brought = (self.brought + self.lead * dt) * airborne
        self.widest = torch.maximum(widest, cleared)
        self.gap = self.widest - widest
        self.stood = torch.where(contact[:, :, None], feet, self.stood)

        self.commanded = jump.clone()
        self.airborne = airborne
        self.vertical = vertical.clone()
