"""How long targets may be held or limited: rules of the safety filter over several ticks.

One tick that holds the last target, or limits it by torque, is no fault; a second of them is. The
rules are functions at the end of this module, in the order in which they are applied.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from pronk.arrays import Array
from pronk.deploy.runtime.limits import Limits
from pronk.deploy.runtime.reasons import Decision, Reason
from pronk.robots.machine import Command, State

_HELD_WINDOW_S = 1.0
"""Time within which held targets are counted [s]."""


class TargetHistory:
    """How long targets have been held, or limited by torque."""

    def __init__(self, joints: int) -> None:
        """Begin without a tick; `joints` of the robot."""
        self.held_s = 0.0
        """At a tick that holds: time for which targets were held within the last second [s]."""
        self.clipped_s = 0.0
        """Time for which targets have been limited by torque without a break [s]."""
        self.blocked_s = np.zeros(joints)
        """Time for which the target of each joint has been limited in one direction without its
        moving [s], (joints,)."""
        self._zeros = np.zeros(joints)
        self._held_ticks: deque[tuple[float, float]] = deque()
        """Time of ticks that held within the last second, and time since the tick before [s]."""
        self._judged: float | None = None
        """Time of the last tick [s]; None after damping."""
        self._direction: Array = self._zeros
        """Direction in which each joint's target is limited by torque, or 0."""
        self._anchor: Array = self._zeros
        """Position from which each of these joints has not moved [rad]."""

    def begin(self) -> None:
        """Begin anew with the next tick; held targets of the last second still count."""
        self._judged = None
        self._forget_limited()

    def observe(
        self, reason: Reason, t: float, command: Command, state: State, limits: Limits
    ) -> None:
        """Take a tick.

        Args:
            reason: Why the filter held or moved the target, if it did.
            t: Time of the tick [s].
            command: The command before the filter.
            state: The newest state.
            limits: Limits that apply.
        """
        seconds = 0.0 if self._judged is None else t - self._judged
        self._judged = t
        while self._held_ticks and self._held_ticks[0][0] < t - _HELD_WINDOW_S:
            self._held_ticks.popleft()
        self.held_s = 0.0
        if reason is Reason.OLD_STATE:
            self._held_ticks.append((t, seconds))
            self.held_s = sum(held_seconds for _, held_seconds in self._held_ticks)
        if reason is not Reason.TORQUE:
            self._forget_limited()
            return
        self.clipped_s += seconds
        position = state.position
        error = command.position - position
        torque = command.stiffness * error - command.damping * state.velocity
        is_limited = np.abs(torque) > limits.joints.torque
        direction = np.where(is_limited, np.sign(torque), 0.0)
        has_moved = np.abs(position - self._anchor) > limits.blocked.motion
        begins = (direction != self._direction) | (direction == 0.0) | has_moved
        self._direction = direction
        self._anchor = np.where(begins, position, self._anchor)
        self.blocked_s = np.where(begins, 0.0, self.blocked_s + seconds)

    def _forget_limited(self) -> None:
        """Note that no target is limited by torque."""
        self.clipped_s = 0.0
        self.blocked_s = self._zeros
        self._direction = self._zeros


# --- The rules ------------------------------------------------------------------------------------
#
# Each rule returns the numbers behind a fault, or "" if there is none. False alarms were counted as
# in `pronk.deploy.runtime.supervision`, over 10.02 h and 8,665 jumps.

TargetRule = Callable[[TargetHistory, Limits], str]


def held_too_long(history: TargetHistory, limits: Limits) -> str:
    """Find targets that are held for too much of a second because states are old.

    Rule: the ticks that held within the last second are longer than `held_s`, 100 ms, in sum. False
    alarms: none in 10.02 h.
    """
    if history.held_s > limits.ages.held_s:
        return f"{1e3 * history.held_s:.0f} ms"
    return ""


def blocked_joint(history: TargetHistory, limits: Limits) -> str:
    """Find a joint that is pushed and does not move.

    Rule: `|stiffness (target - position) - damping velocity|` has been beyond the effort limit in
    one direction for more than `blocked_s`, 0.2 s, while the joint moved by less than `motion`,
    0.05 rad. Largest: 0.100 s (0.146 s in ten other hours). False alarms: none in 10.02 h.
    """
    i = int(np.argmax(history.blocked_s))
    if history.blocked_s[i] > limits.blocked.blocked_s:
        milliseconds = 1e3 * history.blocked_s[i]
        return f"{limits.joints.names[i]}, for {milliseconds:.0f} ms without moving"
    return ""


def clipped_too_long(history: TargetHistory, limits: Limits) -> str:
    """Find targets that are limited by torque for too long.

    Rule: some target has been limited by torque in every tick for more than `clipped_s`, 0.3 s.
    Largest: 0.180 s. False alarms: none in 10.02 h.
    """
    if history.clipped_s > limits.blocked.clipped_s:
        return f"{1e3 * history.clipped_s:.0f} ms"
    return ""


TARGET_RULES: tuple[tuple[Reason, TargetRule], ...] = (
    (Reason.HELD, held_too_long),
    (Reason.CLIPPED, blocked_joint),
    (Reason.CLIPPED, clipped_too_long),
)
"""Rules over several ticks, in their order."""


def find_persistent(history: TargetHistory, limits: Limits) -> Decision | None:
    """Return the fault of the first rule that is met; None if no target was held too long."""
    for reason, rule in TARGET_RULES:
        detail = rule(history, limits)
        if detail:
            return Decision(reason, detail)
    return None
