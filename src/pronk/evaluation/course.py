"""A course: the robot runs at an edge, and an operator who sees it from outside has it jump.

    gap     the floor ends at the edge and goes on `size` further; between, it is 1 m down
    up      behind the edge the floor is `size` higher
    down    behind the edge the floor is `size` lower
    flat    no edge: for practice

Coordinates: s along the commanded direction, which the robot faces at the start; the edge is at
s = `edge`. The jump input rises when the trunk is `lead` before it (the operator's choice), stays
for `jump_s`, the velocity for `keep_s` longer; then the command is zero.

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
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pronk.errors import PronkError
from pronk.evaluation.jumps import JumpRules, cosine_of_tilt, jump_flights
from pronk.evaluation.metrics import FALLEN_COSINE, number, sample_at, series_of
from pronk.runtime.script import STILL, Commanded, Script, Velocity
from pronk.virtual.capture import Capture
from pronk.virtual.ground import Box, Ground

Array = NDArray[np.float64]
Kind = Literal["flat", "gap", "up", "down"]

DEPTH = 1.0
"""Of a gap [m]."""
BEHIND = 5.0
"""Floor behind the start [m]."""
BEYOND = 15.0
"""Floor behind the far edge [m]."""
WIDE = 8.0
"""Half-width of the course [m]."""

NOT_TRIGGERED = "never came to the place of the jump"
STEPPED_IN = "a foot went below the floor between the edges"
NON_FOOT_CONTACT = "something but a foot touched"
NOT_OVER = "not every foot came down behind the far edge"
FELL = "not upright 2 s later"


@dataclass(frozen=True, kw_only=True)
class Obstacle:
    """A gap or a step."""

    kind: Kind
    size: float = 0.0
    """Width of a gap, height of a step [m]."""

    def __post_init__(self) -> None:
        """Refuse a size that is not positive.

        Raises:
            PronkError: The kind and the size.
        """
        if self.kind != "flat" and not 0.0 < self.size < math.inf:
            raise PronkError(f"a {self.kind} of {self.size} m; its size must be positive.")

    @property
    def far(self) -> float:
        """From the edge to where the floor goes on [m]."""
        return self.size if self.kind == "gap" else 0.0

    def on(self, ground: Ground, command: Velocity, edge: float) -> Ground:
        """Put the obstacle on a ground, whose friction and stiffness stay.

        Args:
            ground: Without it.
            command: Its direction is that of the course; along x or along y.
            edge: Where the obstacle begins [m].
        """
        if self.kind == "flat":
            return replace(ground, floor=0.0, terrain=())
        before, after = (-BEHIND, edge), (edge + self.far, edge + self.far + BEYOND)
        floor = {"gap": -DEPTH, "up": 0.0, "down": -self.size}[self.kind]
        boxes = [] if self.kind == "up" else [_box(before, floor, 0.0, command)]
        if self.kind != "down":
            top = self.size if self.kind == "up" else 0.0
            boxes.append(_box(after, floor, top, command))
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
    """The command over time: run, and jump when the trunk is `lead` before the edge."""

    def __init__(
        self, script: Script, *, edge: float, lead: float, where: Callable[[], float]
    ) -> None:
        """Begin before the first tick.

        Args:
            script: The command and the times `stand_s`, `jump_s` and `keep_s`.
            edge: Where the obstacle begins, along the course [m].
            lead: From the trunk to it when the jump input rises [m].
            where: Returns where the trunk is now, along the course [m].
        """
        self._script, self._where, self._trigger_at = script, where, edge - lead
        self.triggered: float | None = None
        """When the jump input rose, since the policy took over [s]."""

    def __call__(self, t: float) -> Commanded:
        """Return the command at a time since the policy took over [s]."""
        script = self._script
        if t < script.stand_s:
            return STILL, False
        if self.triggered is None and self._where() >= self._trigger_at:
            self.triggered = t
        if self.triggered is None:
            return script.command, False
        since = t - self.triggered
        moving = since < script.jump_s + script.keep_s
        return (script.command if moving else STILL), since < script.jump_s


@dataclass(frozen=True, kw_only=True)
class CrossingFigures:
    """One run at an obstacle."""

    obstacle: str = "flat"
    """Its kind; `flat` for practice."""
    why: str = ""
    """Empty if it was crossed, else the first condition that was not met."""
    size: float = number("m", "width of the gap, height of the step")
    lead: float = number("m", "from the trunk to the edge when the jump input rises")
    take_off: float = number("m", "from the front-most last foothold before the flight to the edge")
    landing: float = number("m", "from the far edge to the hind-most first foothold behind it")
    reach: float = number("m", "from the trunk at the jump input to the front-most last foothold")
    speed: float = number("m/s", "along the course at the jump input")

    @property
    def success(self) -> bool:
        """The obstacle was crossed."""
        return not self.why


def lost(seen: Capture, obstacle: Obstacle, command: Velocity, edge: float) -> bool:
    """Whether a run has failed already: a sample leans too far, or a foot stepped in."""
    fallen = cosine_of_tilt(seen.orientation) < FALLEN_COSINE
    return bool(fallen.any() or _stepped_in(seen, obstacle, command, edge).any())


def judge(
    seen: Capture,
    obstacle: Obstacle,
    command: Velocity,
    *,
    edge: float,
    triggered: float | None,
    rules: JumpRules,
) -> CrossingFigures:
    """Decide whether an obstacle was crossed, and measure it.

    Args:
        seen: The recorded run.
        obstacle: What lay in the way.
        command: Forward, left [m/s].
        edge: Where it began, along the course [m].
        triggered: When the jump input rose, on the capture's clock [s]; None for never.
        rules: Of flights, and of an upright robot.
    """
    if triggered is None:
        return CrossingFigures(why=NOT_TRIGGERED)
    along, count = direction(command), len(seen.time)
    on = min(sample_at(seen, triggered), count - 1)
    feet, trunk = seen.foot_position[:, :, :2] @ along, seen.position[:, :2] @ along
    far = edge + obstacle.far
    behind = seen.contact & (feet >= far)
    first = np.where(behind[on:].any(axis=0), on + behind[on:].argmax(axis=0), count)
    landed = int(first.max())
    judged = landed + round(rules.upright_s / seen.dt)
    legs = np.arange(feet.shape[1])
    figures: dict[str, Any] = {"speed": float(seen.velocity[on, :2] @ along)}
    main = jump_flights(series_of(seen, whole=True), on, rules).main
    if main is not None:
        before = seen.contact[: main.liftoff]
        stood = feet[main.liftoff - 1 - before[::-1].argmax(axis=0), legs]
        front = float(np.where(before.any(axis=0), stood, -np.inf).max())
        figures["reach"] = front - float(trunk[on])
        if obstacle.kind != "flat":
            figures["take_off"] = edge - front
    if landed < count and obstacle.kind != "flat":
        figures["landing"] = float(feet[first, legs].min()) - far
    end, cosine = min(judged + 1, count), cosine_of_tilt(seen.orientation)
    upright = judged < count and cosine[judged] >= rules.upright_cosine
    if _stepped_in(seen, obstacle, command, edge)[:end].any():
        why = STEPPED_IN
    elif seen.other_contact[on:end].any():
        why = NON_FOOT_CONTACT
    elif landed >= count:
        why = NOT_OVER
    elif not upright or (cosine[:end] < FALLEN_COSINE).any():
        why = FELL
    elif min(trunk[judged], feet[judged].min()) < far:
        why = NOT_OVER
    else:
        why = ""
    return CrossingFigures(why=why, **figures)


def _stepped_in(
    seen: Capture, obstacle: Obstacle, command: Velocity, edge: float
) -> NDArray[np.bool_]:
    """Samples with the centre of a foot below the floor between the edges of a gap. (T,)."""
    if obstacle.kind != "gap":
        return np.zeros(len(seen.time), dtype=bool)
    feet = seen.foot_position[:, :, :2] @ direction(command)
    between = (feet > edge) & (feet < edge + obstacle.size)
    return np.asarray((between & (seen.foot_position[:, :, 2] < 0.0)).any(axis=1))
