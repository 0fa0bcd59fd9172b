"""The safety filter: between whoever decides and whoever writes to the robot.

A pure function. What is remembered from one tick to the next (the last target, a fault) goes in as
a `Memory` and comes out as another; the rules themselves are in `pronk.runtime.rules`.

A fault damps for a second at least. Afterwards nothing moves by itself: `released` forgets a fault,
and a latched one only on a person's word.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pronk.links.machine import Command, State
from pronk.runtime.limits import Limits
from pronk.runtime.reasons import Level, Reason
from pronk.runtime.rules import Asked, judge

Array = NDArray[np.float64]

LEAST_DAMPING_S = 1.0
"""Shortest time that a fault damps [s]."""


@dataclass(frozen=True, kw_only=True)
class Memory:
    """What the filter knows of the ticks before."""

    last: Array | None = None
    """The target sent a tick ago [rad], (joints,); None after damping."""
    level: Level = Level.PASS
    """`DAMP` or `LATCH` while a fault lasts."""
    reason: Reason = Reason.NONE
    """Of the fault that lasts."""
    since: float = 0.0
    """When it began [s]."""

    @property
    def faulted(self) -> bool:
        """Whether a fault lasts."""
        return self.level >= Level.DAMP


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """What the filter made of a command."""

    level: Level
    reason: Reason
    detail: str = ""
    """Which joint and which numbers, for a new fault."""

    @property
    def text(self) -> str:
        """One line."""
        return f"{self.reason.text} ({self.detail})" if self.detail else self.reason.text


def filtered(
    state: State,
    command: Command,
    memory: Memory,
    limits: Limits,
    t: float,
    *,
    held: bool = True,
) -> tuple[Command | None, Verdict, Memory]:
    """What may be sent of a command.

    Args:
        state: The newest.
        command: What is asked.
        memory: From the tick before.
        limits: The limits.
        t: Now, on the machine's clock [s].
        held: Whether the dead-man button is held.

    Returns:
        The command to send, None for damping; why; and the memory for the next tick.
    """
    n = len(limits.joints)
    position = _numbers(state.position, n)
    # Temperatures that are not measured are NaN, and NaN is not hot.
    temperature = _numbers(state.temperature, n)
    answers = command.state_sequence >= 0
    judged = judge(
        Asked(
            position=position,
            velocity=_numbers(state.velocity, n),
            orientation=_numbers(state.orientation, 4),
            gyro=_numbers(state.gyro, 3),
            temperature=temperature,
            state_age=np.asarray(t - state.time),
            target=_numbers(command.position, n),
            stiffness=_numbers(command.stiffness, n),
            damping=_numbers(command.damping, n),
            command_age=np.asarray(t - command.made),
            valid_for=np.asarray(command.valid_for, dtype=float),
            lag=np.asarray(state.sequence - command.state_sequence if answers else 0),
            last=position if memory.last is None else memory.last,
            held=np.asarray(held),
        ),
        limits,
    )
    level, reason = Level(int(judged.level)), Reason(int(judged.reason))
    if memory.faulted:
        # A fault can only become worse.
        if level is Level.LATCH and memory.level is Level.DAMP:
            memory = replace(memory, level=level, reason=reason)
        return None, Verdict(level=memory.level, reason=memory.reason), replace(memory, last=None)
    if level >= Level.DAMP:
        verdict = Verdict(
            level=level, reason=reason, detail=detail(reason, state, command, limits, t)
        )
        return None, verdict, Memory(level=level, reason=reason, since=t)
    sent = replace(command, position=judged.target)
    return sent, Verdict(level=level, reason=reason), Memory(last=judged.target)


def fault(memory: Memory, level: Level, reason: Reason, t: float) -> Memory:
    """The memory with a fault that somebody else found; one that lasts is kept if it is as bad."""
    if memory.level >= level:
        return memory
    return Memory(level=level, reason=reason, since=memory.since if memory.faulted else t)


def released(memory: Memory, t: float, *, mended: bool = False) -> Memory:
    """Forget a fault, if it may be forgotten.

    Args:
        memory: With or without a fault.
        t: Now [s].
        mended: A person's word that the cause is gone; a latched fault needs it.
    """
    if not memory.faulted or t - memory.since < LEAST_DAMPING_S:
        return memory
    return Memory() if mended or memory.level is Level.DAMP else memory


def detail(reason: Reason, state: State, command: Command, limits: Limits, t: float) -> str:
    """The numbers behind a fault, as far as they say more than its line."""
    q, v = np.asarray(state.position), np.asarray(state.velocity)
    if reason is Reason.SPEED:
        i = int(np.argmax(np.abs(v) - limits.speed))
        return f"{limits.joints[i]} {v[i]:.1f} of {limits.speed[i]:.1f} rad/s"
    if reason is Reason.OVERRUN:
        i = int(np.argmax(np.maximum(limits.low - q, q - limits.high)))
        return f"{limits.joints[i]} {q[i]:.2f}, of {limits.low[i]:.2f} to {limits.high[i]:.2f} rad"
    if reason is Reason.TEMPERATURE and state.temperature is not None:
        i = int(np.nanargmax(state.temperature))
        return f"{limits.joints[i]} {state.temperature[i]:.0f} of {limits.temperature:.0f} deg C"
    if reason is Reason.TILT:
        return f"{tilt(state.orientation):.2f} of {limits.tilt:.2f} rad"
    if reason is Reason.EXPIRED:
        return f"{1e3 * (t - command.made):.0f} ms old"
    if reason in (Reason.NO_STATE, Reason.STATE_LOST):
        return f"{1e3 * (t - state.time):.0f} ms old"
    if reason is Reason.LAG:
        return f"{state.sequence - command.state_sequence} states"
    return ""


def tilt(orientation: Array) -> float:
    """Angle of the trunk's z axis from the vertical [rad].

    Args:
        orientation: Trunk to world, quaternion w, x, y, z. (4,)
    """
    _, x, y, _ = np.asarray(orientation) / np.linalg.norm(orientation)
    return float(np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y), -1.0, 1.0)))


def _numbers(values: object, count: int) -> Array:
    """The values as numbers; all NaN if they are not `count` numbers."""
    try:
        array = np.asarray(values, dtype=float)
    except (TypeError, ValueError):
        return np.full(count, np.nan)
    return array if array.shape == (count,) else np.full(count, np.nan)
