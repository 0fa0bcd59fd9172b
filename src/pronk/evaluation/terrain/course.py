"""A course: a robot runs at an edge, and someone who sees it from outside has it jump.

    gap     the floor ends at the edge and goes on `size` further; between, it is 1 m down
    up      behind the edge the floor is `size` higher
    down    behind the edge the floor is `size` lower
    flat    no edge: for practice

Coordinates: s along the commanded direction, in which the robot is set down facing; the edge is at
s = `edge`. The jump input rises when the trunk is `lead` before it (the operator's choice), stays
for `jump_s`, the velocity for `keep_s` longer, then the robot is told to stop.

Crossed means all of this, from the jump input to 2 s after the landing:

    no foot's centre was below floor level between the edges of a gap;
    nothing but feet touched anything;
    landing: every foot has touched ground behind the far edge;
    2 s later trunk and feet are behind the far edge, and the trunk leans 30 degrees at most,
    never having leant 70 degrees.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pronk.errors import PronkError
from pronk.evaluation.jumps import JumpRules, flights
from pronk.evaluation.metrics import FALLEN_COSINE
from pronk.runtime.script import STILL, Commanded, Script, Velocity
from pronk.virtual.capture import Capture
from pronk.virtual.ground import Box, Ground

Array = NDArray[np.float64]
Kind = Literal["flat", "gap", "up", "down"]

DEPTH = 1.0
"""Of a gap [m]."""
BEHIND = 5.0
"""Floor behind the place where the robot is set down [m]."""
BEYOND = 15.0
"""Floor behind the far edge [m]."""
WIDE = 8.0
"""Half-width of the course [m]."""


@dataclass(frozen=True, kw_only=True)
class Obstacle:
    """What lies in the way."""

    kind: Kind
    size: float = 0.0
    """Width of a gap, height of a step [m]."""

    def __post_init__(self) -> None:
        """Refuse what is no obstacle.

        Raises:
            PronkError: The size is not positive.
        """
        if self.kind != "flat" and not 0.0 < self.size < math.inf:
            raise PronkError(f"a {self.kind} of {self.size} m; its size must be positive.")

    @property
    def far(self) -> float:
        """From the edge to where the floor goes on [m]."""
        return self.size if self.kind == "gap" else 0.0

    @property
    def rise(self) -> float:
        """Height of the floor behind it [m]."""
        return {"up": self.size, "down": -self.size}.get(self.kind, 0.0)

    def on(self, ground: Ground, command: Velocity, edge: float) -> Ground:
        """A ground with this obstacle on it.

        Args:
            ground: Friction and stiffness are kept.
            command: Its direction is that of the course; along x or along y.
            edge: Where it begins [m].
        """
        if self.kind == "flat":
            return replace(ground, floor=0.0, terrain=())
        before, after = (-BEHIND, edge), (edge + self.far, edge + self.far + BEYOND)
        floor = {"gap": -DEPTH, "up": 0.0, "down": -self.size}[self.kind]
        boxes = [] if self.kind == "up" else [_box(before, floor, 0.0, command)]
        if self.kind != "down":
            boxes.append(_box(after, floor, self.rise, command))
        return replace(ground, floor=floor, terrain=tuple(boxes))


def direction(command: Velocity) -> Array:
    """Unit vector of a command in the plane. (2,).

    Raises:
        PronkError: It points neither forward or back nor to a side.
    """
    forward, left, _ = command
    if bool(forward) == bool(left):
        raise PronkError(
            f"command {command} on a course; expected one straight forward, back or to a side."
        )
    return np.array([np.sign(forward), np.sign(left)])


def _box(span: tuple[float, float], low: float, high: float, command: Velocity) -> Box:
    """A block between two heights, from one place of the course to another."""
    along = direction(command)
    middle, half = 0.5 * (span[0] + span[1]), 0.5 * (span[1] - span[0])
    x, y = middle * along
    across = np.where(along != 0.0, half, WIDE)
    return Box(
        center=(float(x), float(y), 0.5 * (low + high)),
        half_size=(float(across[0]), float(across[1]), 0.5 * (high - low)),
    )


class Operator:
    """What is asked: run, and jump when the trunk is `lead` before the edge."""

    def __init__(
        self, script: Script, *, edge: float, lead: float, where: Callable[[], float]
    ) -> None:
        """Begin before the first tick.

        Args:
            script: The command and the times `stand_s`, `jump_s` and `keep_s`.
            edge: Where the obstacle begins, along the course [m].
            lead: From the trunk to it when the jump input shall rise [m].
            where: Says where the trunk is now, along the course [m].
        """
        self._script = script
        self._trigger_at = edge - lead
        self._where = where
        self.triggered: float | None = None
        """When the jump input rose, since the policy took over [s]."""

    def __call__(self, t: float) -> Commanded:
        """What is asked at a time since the policy took over [s]."""
        script = self._script
        if t < script.stand_s:
            return STILL, False
        if self.triggered is None and self._where() >= self._trigger_at:
            self.triggered = t
        if self.triggered is None:
            return script.command, False
        since = t - self.triggered
        if since < script.jump_s:
            return script.command, True
        return (script.command if since < script.jump_s + script.keep_s else STILL), False


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What became of one run at an obstacle."""

    why: str
    """Empty if it was crossed, else the first condition that was not met."""
    take_off: float = math.nan
    """From the front-most last stand of a foot before the flight to the edge [m]."""
    landing: float = math.nan
    """From the far edge to the hind-most first touch of a foot behind it [m]."""
    reach: float = math.nan
    """From the trunk when the jump input rose to that front-most last stand [m]."""
    speed: float = math.nan
    """Along the course when the jump input rose [m/s]."""

    @property
    def crossed(self) -> bool:
        """All conditions were met."""
        return not self.why


NOT_TRIGGERED = "never came to the place of the jump"
STEPPED_IN = "a foot went below the floor between the edges"
TOUCHED = "something else than a foot touched"
NOT_OVER = "not every foot came down behind the far edge"
FELL = "not upright 2 s later"


def lost(seen: Capture, obstacle: Obstacle, command: Velocity, edge: float) -> bool:
    """Whether it is already certain that a run fails: any sample leans too far or stepped in."""
    return bool(_leant(seen).any() or _stepped_in(seen, obstacle, command, edge).any())


def judge(
    seen: Capture,
    obstacle: Obstacle,
    command: Velocity,
    *,
    edge: float,
    triggered: float | None,
    rules: JumpRules,
) -> Verdict:
    """Whether an obstacle was crossed.

    Args:
        seen: What was seen, from outside.
        obstacle: What lay in the way.
        command: Forward, left [m/s].
        edge: Where it began, along the course [m].
        triggered: When the jump input rose, on the capture's clock [s]; None for never.
        rules: Of flights, and of how an upright robot stands.
    """
    if triggered is None:
        return Verdict(why=NOT_TRIGGERED)
    along, dt = direction(command), seen.dt
    on = min(int(np.searchsorted(seen.time, triggered - 1e-3 * dt)), len(seen.time) - 1)
    feet, trunk = seen.foot_position[:, :, :2] @ along, seen.position[:, :2] @ along
    far = edge + obstacle.far
    behind = seen.contact & (feet >= far)
    first = np.where(behind[on:].any(axis=0), on + behind[on:].argmax(axis=0), len(seen.time))
    landed = int(first.max())
    judged = landed + round(rules.upright_s / dt)
    legs = np.arange(feet.shape[1])
    figures = {"speed": float(seen.velocity[on, :2] @ along)}
    up = _lift_off(seen, on, rules)
    if up is not None:
        before = seen.contact[:up]
        stood = feet[up - 1 - before[::-1].argmax(axis=0), legs]
        front = float(np.where(before.any(axis=0), stood, -np.inf).max())
        figures["reach"] = front - float(trunk[on])
        if obstacle.kind != "flat":
            figures["take_off"] = edge - front
    if landed < len(seen.time) and obstacle.kind != "flat":
        figures["landing"] = float(feet[first, legs].min()) - far
    end, cosine = min(judged + 1, len(seen.time)), _cosine(seen)
    if _stepped_in(seen, obstacle, command, edge)[:end].any():
        why = STEPPED_IN
    elif seen.other_contact[on:end].any():
        why = TOUCHED
    elif landed >= len(seen.time):
        why = NOT_OVER
    elif (
        judged >= len(seen.time)
        or _leant(seen)[:end].any()
        or cosine[judged] < rules.upright_cosine
    ):
        why = FELL
    elif min(trunk[judged], feet[judged].min()) < far:
        why = NOT_OVER
    else:
        why = ""
    return Verdict(why=why, **figures)


def _cosine(seen: Capture) -> Array:
    """Of the tilt. (T,)."""
    cosine: Array = 1.0 - 2.0 * (seen.orientation[:, 1] ** 2 + seen.orientation[:, 2] ** 2)
    return cosine


def _leant(seen: Capture) -> NDArray[np.bool_]:
    """Samples in which the trunk leans as one that has fallen. (T,)."""
    return np.asarray(_cosine(seen) < FALLEN_COSINE)


def _stepped_in(
    seen: Capture, obstacle: Obstacle, command: Velocity, edge: float
) -> NDArray[np.bool_]:
    """Samples with the centre of a foot below the floor between the edges of a gap. (T,)."""
    if obstacle.kind != "gap":
        return np.zeros(len(seen.time), dtype=bool)
    feet = seen.foot_position[:, :, :2] @ direction(command)
    between = (feet > edge) & (feet < edge + obstacle.size)
    return np.asarray((between & (seen.foot_position[:, :, 2] < 0.0)).any(axis=1))


def _lift_off(seen: Capture, on: int, rules: JumpRules) -> int | None:
    """First sample of the longest high flight after the jump input; None without one.

    As `pronk.evaluation.jumps` has it, but for the floor behind the edge, which may have another
    height.
    """
    z, least = seen.position[:, 2], round(rules.long_s / seen.dt)
    last = on + round(rules.search_s / seen.dt)
    high = [
        flight
        for flight in flights(seen.contact, least=least)
        if on <= flight.liftoff <= last and z[flight.liftoff : flight.touchdown].max() > rules.high
    ]
    return max(high, key=lambda flight: flight.samples).liftoff if high else None
