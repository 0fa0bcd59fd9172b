"""The state of a jump, from the command to the ground: the quantities that jump rewards pay for.

All are (N,), one for each robot, sampled once in a policy step (20 ms). A robot is airborne when no
foot touches the ground. It is in jump mode from the rising edge of the jump input until the input
is off, a foot is on the ground, and `settle_s` have passed.

Within one command only an improvement on the best so far is paid, so that many small hops earn no
more than one good jump: the paper's exp(-(v - 2.5)^2 / 2), paid at every lift-off, still pays a
third at 1 m/s and was seen to teach a row of hops. The paper's kernel has to be wide where jumping
is yet to be found; later a narrow one separates 2.2 from 2.5 m/s.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import torch
from torch import Tensor

from pronk.errors import PronkError


@dataclass(frozen=True, kw_only=True)
class JumpSettings:
    """Definition of a good jump. Not in the paper except for `liftoff_velocity`."""

    liftoff_velocity: float = 2.5
    """Desired vertical velocity of the trunk at lift-off [m/s] (paper, section IV)."""
    ready_s: float = 0.26
    """A lift-off so long after the command earns the full reward [s]; before, the square of the
    time's fraction of it: a push at once needs a power that batteries do not have. From the first
    jump on: policies that had learned to lift off after .10 s never waited."""
    prompt_s: float = 0.28
    """A lift-off up to so long after the command earns the full reward [s]."""
    late_s: float = 0.15
    """Beyond that the reward falls linearly to zero over this time [s]. With .25 s three of three
    policies came to lift off after .29 to .35 s; with .12 s and ready_s .26 four policies found the
    jump late or never."""
    overspeed_std: float = 0.3
    """Standard deviation of the kernel that lowers the reward of a jump by how much faster than
    commanded its running start was [m/s]. Without it policies ran at 2.2 to 2.5 m/s when 2 was
    commanded, and braked into height."""
    stride_velocity: float = 1.0
    """A lift-off slower than this is a stride, not a jump [m/s]."""
    settle_s: float = 0.3
    """Time on the ground after which jump mode ends [s]."""
    aim_std: float = 0.5
    """Standard deviation of the kernel on the horizontal velocity's error at lift-off [m/s]: a
    running robot has a tenth of a second to speed up, so a narrow kernel has no slope."""
    turn_std: float = 1.0
    """Standard deviation of the kernel on the trunk's roll and pitch rate at lift-off [rad/s]:
    nothing stops them in the air."""
    max_travel: float = 0.5
    """Height of a jump, from the lowest to the highest trunk, up to which it is rewarded [m]; the
    paper names .45 m as the physical limit."""
    crouch: float = 0.18
    """Lowest trunk from which the height counts [m]; knees are 8 cm over ground there. Without it a
    policy fell onto its shanks, to .12 m."""
    max_gap: float = 1.0
    """Gap up to which clearing it is rewarded [m]; the longest known of this size is .7 m."""
    fall: float = 9.0
    """Downward acceleration with which a countermovement begins [m/s^2]."""
    fall_s: float = 0.12
    """Duration of the fall [s]: 6.5 cm, and 2.5 more until the trunk is at rest."""
    similarity_std: float = 0.05
    """Standard deviation of the kernel that compares leg lengths with a countermovement's [m]."""

    def __post_init__(self) -> None:
        """Refuse values that are not positive, and times in the wrong order."""
        for name, value in asdict(self).items():
            if not value > 0.0:
                raise PronkError(f"JumpSettings.{name} is {value}; expected more than 0.")
        if not (self.ready_s <= self.prompt_s and self.fall_s < self.prompt_s):
            raise PronkError(
                f"JumpSettings has fall_s {self.fall_s}, ready_s {self.ready_s} and prompt_s "
                f"{self.prompt_s}; expected fall_s below and ready_s at most prompt_s."
            )

    @property
    def push(self) -> float:
        """Upward acceleration from the end of the fall to lift-off [m/s^2]."""
        return (self.liftoff_velocity + self.fall * self.fall_s) / (self.prompt_s - self.fall_s)

    def countermovement(self, since: Tensor) -> Tensor:
        """Compute leg lengths in a jump, less that of the default pose [m].

        The trunk falls with `fall` for `fall_s`; then its velocity rises evenly, by `push`, to
        `liftoff_velocity` at `prompt_s`. The feet stay in place. This takes about a third of the
        power of a push at once.

        Args:
            since: Time since the command [s]; any shape.
        """
        falls = since.clamp_max(self.fall_s)
        pushes = (since - self.fall_s).clamp_min(0.0)
        pushed = (-self.fall * self.fall_s + 0.5 * self.push * pushes) * pushes
        return pushed - 0.5 * self.fall * falls.square()


@dataclass(frozen=True, kw_only=True)
class JumpInputs:
    """What the jump state learns of N robots in one policy step."""

    command: Tensor
    """The jump input, bool. (N,)"""
    contact: Tensor
    """Whether each foot is on the ground, bool. (N, 4)"""
    height: Tensor
    """Height of the trunk over ground [m]. (N,)"""
    vertical: Tensor
    """Vertical velocity of the trunk [m/s]. (N,)"""
    velocity_error: Tensor
    """Distance of the trunk's horizontal velocity from the one rewarded [m/s]. (N,)"""
    turn: Tensor
    """Norm of the trunk's roll and pitch rate [rad/s]. (N,)"""
    along: Tensor
    """Part of the horizontal velocity in the commanded direction, at most the one rewarded [m/s].
    (N,)"""
    excess: Tensor
    """The same part without its upper limit, minus the commanded speed [m/s]. (N,)"""
    feet: Tensor
    """Horizontal positions of the feet in the world's frame [m]. (N, 4, 2)"""
    direction: Tensor
    """Unit vector of the commanded velocity in the world's frame, or zero. (N, 2)"""
    extension: Tensor
    """Length of each leg minus that in the default pose [m]. (N, 4)"""


class JumpState:
    """State of the jumps of N robots, and what changed in the last policy step."""

    def __init__(self, count: int, device: torch.device | str, settings: JumpSettings) -> None:
        """Begin without any jump.

        Args:
            count: Number of robots, N.
            device: Device of the state.
            settings: Definition of a good jump.
        """
        self.settings = settings
        self.liftoff_std: float | Tensor = 1.0
        """Standard deviation of the lift-off kernel [m/s], where it is a tensor (); a phase sets
        it by `set_liftoff_std`."""

        def zeros(*shape: int) -> Tensor:
            return torch.zeros(count, *shape, device=device)

        def false() -> Tensor:
            return torch.zeros(count, dtype=torch.bool, device=device)

        self.commanded = false()  # jump input at the last step
        self.airborne = false()
        self.mode = false()  # in jump mode
        self.settling = zeros()  # time in jump mode on the ground with the input off, to go [s]
        self.since = zeros()  # since the rising edge of the input; 0 outside jump mode [s]
        self.vertical = zeros()  # vertical velocity of the trunk at the last step [m/s]
        self.overspeed = zeros()  # speed above the command when the jump was commanded [m/s]
        # Factor, 0 to 1, on the rewards of the last lift-off, by its time and overspeed.
        self.reward_scale = zeros()

        # Of this command; a gain is the increase in the last step.
        self.best_score = zeros()  # of a lift-off
        self.score_gain = zeros()
        self.liftoffs = zeros()  # number of lift-offs that are no strides
        self.hop = zeros()  # 1 where the last step was a lift-off after the first
        self.first_liftoff = zeros()  # 1 where it was the first
        self.highest = zeros()  # trunk [m]
        self.lowest = zeros()  # trunk before the first lift-off, `crouch` or more [m]
        self.travel = zeros()  # `highest` minus `lowest`, at most `max_travel` [m]
        self.travel_gain = zeros()
        self.flight = zeros()  # ground covered in this flight, scaled, less overspeed [m]
        self.overspeed_distance = zeros()  # the part due to overspeed [m]
        self.best_flight = zeros()  # `flight` of the best flight [m]
        self.flight_gain = zeros()
        self.stance = zeros(4, 2)  # last position of each foot on the ground, world frame [m]
        self.best_gap = zeros()  # widest gap that a flight has cleared, scaled [m]
        self.gap_gain = zeros()
        # Of the legs' lengths to a countermovement's, 0 to 1; 0 from the first lift-off or
        # `prompt_s` on.
        self.similarity = zeros()

    def set_liftoff_std(self, std: float) -> None:
        """Set the standard deviation of the lift-off kernel [m/s]."""
        if isinstance(self.liftoff_std, Tensor):
            self.liftoff_std.fill_(std)
        else:
            self.liftoff_std = std

    def tensors(self) -> list[Tensor]:
        """Return all tensors of the state, always in the same order; the last one is `stance`."""
        return [
            self.commanded,
            self.airborne,
            self.mode,
            self.settling,
            self.since,
            self.vertical,
            self.overspeed,
            self.reward_scale,
            self.best_score,
            self.score_gain,
            self.liftoffs,
            self.hop,
            self.first_liftoff,
            self.highest,
            self.lowest,
            self.travel,
            self.travel_gain,
            self.flight,
            self.overspeed_distance,
            self.best_flight,
            self.flight_gain,
            self.best_gap,
            self.gap_gain,
            self.similarity,
            self.stance,
        ]

    def reset(self, robots: Tensor) -> None:
        """Clear the state of some robots, bool (N,)."""
        *values, stance = self.tensors()
        for value in values:
            value.masked_fill_(robots, 0)
        stance.masked_fill_(robots[:, None, None], 0.0)

    def advance(self, inputs: JumpInputs, dt: float | Tensor) -> None:
        """Advance by one policy step.

        Args:
            inputs: What was commanded and measured in it.
            dt: Its duration [s].
        """
        s = self.settings
        jump = inputs.command

        # Jump mode.
        airborne = ~inputs.contact.any(dim=-1)
        begins = jump & ~self.commanded
        keep = ~begins
        self.overspeed = torch.where(begins, inputs.excess.clamp_min(0.0), self.overspeed)
        on_the_ground = (self.settling - dt).clamp_min(0.0)
        self.settling = torch.where(airborne, self.settling, on_the_ground)
        self.settling = torch.where(jump, s.settle_s, self.settling)
        self.mode = self.settling > 0.0
        self.since = (self.since * keep + dt) * self.mode

        # Lift-off. Sampled every 20 ms, its velocity lies between the last two samples.
        speed = torch.maximum(inputs.vertical, self.vertical)
        liftoff = (airborne & ~self.airborne & self.mode).float()
        jumped = liftoff * (speed > s.stride_velocity)
        kernel = torch.exp((speed - s.liftoff_velocity).square() * (-0.5 / self.liftoff_std**2))
        late = torch.rsub(self.since, (s.prompt_s + s.late_s) / s.late_s, alpha=1.0 / s.late_s)
        early = (self.since / s.ready_s).square()
        slow_start = torch.exp(self.overspeed.square() * (-0.5 / s.overspeed_std**2))
        scale = torch.minimum(late, early).clamp(0.0, 1.0) * slow_start
        self.reward_scale = torch.where(liftoff > 0.0, scale, self.reward_scale * keep)
        # Half of the score is for the vertical velocity, half for that with direction and attitude.
        aim_error = (inputs.velocity_error / s.aim_std).square()
        aim_error = aim_error + (inputs.turn / s.turn_std).square()
        score = kernel * (0.5 + 0.5 * torch.exp(-0.5 * aim_error)) * self.reward_scale * liftoff
        score_before = self.best_score * keep
        self.best_score = torch.maximum(score_before, score)
        self.score_gain = self.best_score - score_before
        liftoffs_before = self.liftoffs * keep
        self.hop = jumped * (liftoffs_before > 0.0)
        self.first_liftoff = jumped - self.hop
        self.liftoffs = liftoffs_before + jumped

        # Countermovement, leg by leg: the trunk's velocity shows the action of one leg only with
        # three others' and later. With it nothing was learned in 170 iterations.
        is_prompt = self.mode & (self.liftoffs == 0.0) & (self.since <= s.prompt_s)
        length_error = inputs.extension - s.countermovement(self.since)[:, None]
        kernel = torch.exp(length_error.square() * (-0.5 / s.similarity_std**2))
        self.similarity = kernel.mean(dim=-1) * is_prompt

        # Height. A crouch counts: a battery's power is too low for a push over a short way.
        continues = self.mode & keep
        low = inputs.height.clamp_min(s.crouch)
        lowest = torch.where(continues, self.lowest, low)
        highest = torch.where(continues, self.highest, inputs.height)
        travel_before = self.travel * continues
        self.highest = torch.maximum(highest, inputs.height)
        self.lowest = torch.where(self.liftoffs > 0.0, lowest, torch.minimum(lowest, low))
        self.travel = (self.highest - self.lowest).clamp(0.0, s.max_travel)
        self.travel_gain = self.travel - travel_before

        # Distance.
        flies = airborne & self.airborne & self.mode
        covered = (inputs.along - self.overspeed) * self.reward_scale * dt
        self.flight = (self.flight + covered) * flies
        flight_before = self.best_flight * keep
        self.best_flight = torch.maximum(flight_before, self.flight)
        self.flight_gain = self.best_flight - flight_before

        # Gap. No foot stepped between the front-most that took off and the hind-most that lands
        # (A16).
        lands = self.airborne & ~airborne & self.mode
        # A product of matrices may be computed with TF32, in which a position 60 m from the world's
        # origin is rounded to 3 cm.
        direction = inputs.direction[:, None, :]
        taken_off_at = (self.stance * direction).sum(dim=-1).amax(dim=-1)
        landed_at = (inputs.feet * direction).sum(dim=-1).amin(dim=-1)
        gap = (landed_at - taken_off_at - self.overspeed_distance).clamp_max(s.max_gap)
        gap_before = self.best_gap * keep
        self.best_gap = torch.maximum(gap_before, gap * self.reward_scale * lands)
        self.gap_gain = self.best_gap - gap_before
        self.overspeed_distance = (self.overspeed_distance + self.overspeed * dt) * airborne
        self.stance = torch.where(inputs.contact[:, :, None], inputs.feet, self.stance)

        self.commanded = jump.clone()
        self.airborne = airborne
        self.vertical = inputs.vertical.clone()
