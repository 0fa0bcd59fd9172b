"""How the joints respond to their targets: rules of the safety filter over several ticks.

A joint that is seized, or whose motor gives no torque, can report positions and speeds that are all
true. It shows only in what it does not do. The rules are functions at the end of this module, in
the order in which they are applied; those of a free trunk alone, because links on a stand may be
clamped.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from pronk.arrays import Array
from pronk.deploy.runtime.limits import Limits
from pronk.deploy.runtime.reasons import Decision, Reason
from pronk.robots.machine import Command, State

_STEP_S = 0.01
"""Time between two ticks that count [s]."""
_LAG_S = 0.06
"""Time from a target to a motion that follows it, on the way there and back and in the drive, at
most [s]."""
SEIZED_S = 0.4
"""Time for which a seized joint does not move [s]."""
_SAMPLES = round((SEIZED_S + _LAG_S) / _STEP_S) + 1
_LAG_SAMPLES = round(_LAG_S / _STEP_S)
_LONGEST_STEP_S = 0.05
"""Time between two ticks beyond which nothing is known of the time between [s]."""


class ResponseHistory:
    """Targets and positions of the last ticks, and for how long joints were pushed in vain."""

    def __init__(self, joints: int) -> None:
        """Begin without a tick; `joints` of the robot."""
        self.pushed_s = np.zeros(joints)
        """Time for which the commanded torque of each joint has been beyond `ResponseLimits.push`
        in one direction without the joint's moving that way [s], (joints,)."""
        self.target_range = np.zeros(joints)
        """Range of the target of each joint, of those from the begin of `SEIZED_S` until 60 ms ago
        [rad], (joints,): whatever the lag up to 60 ms, they acted within `SEIZED_S`."""
        self.torque_range = np.zeros(joints)
        """Range of stiffness times target of the same targets [N m], (joints,)."""
        self.motion = np.full(joints, np.inf)
        """Range of the position of each joint over `SEIZED_S` [rad], (joints,)."""
        self.trunk_height = np.inf
        """Height of the trunk over its lowest foot [m]; infinite where it is not judged."""
        self.low_s = 0.0
        """Time for which the trunk has been lower than `LegKinematics.collapsed` [s]."""
        self._zeros = np.zeros(joints)
        self._direction: Array = self._zeros
        self._worst: Array = self._zeros
        self._judged: float | None = None
        self._targets: deque[Array] = deque(maxlen=_SAMPLES)
        self._torques: deque[Array] = deque(maxlen=_SAMPLES)
        self._positions: deque[Array] = deque(maxlen=_SAMPLES)

    def begin(self) -> None:
        """Begin anew with the next tick."""
        n = len(self._zeros)
        self.pushed_s = self._zeros
        self.motion = np.full(n, np.inf)
        self.target_range = self._zeros
        self.torque_range = self._zeros
        self.trunk_height = np.inf
        self.low_s = 0.0
        self._direction = self._zeros
        self._judged = None
        self._targets.clear()
        self._torques.clear()
        self._positions.clear()

    def observe(
        self, t: float, command: Command, state: State, limits: Limits, *, on_feet: bool
    ) -> None:
        """Take a tick; of those within 10 ms only the first counts.

        Args:
            t: Time of the tick [s].
            command: The command before the filter.
            state: The newest state.
            limits: Limits that apply.
            on_feet: Whether the trunk should be up, as while a policy runs.
        """
        if self._judged is not None and 0.0 <= t - self._judged < _STEP_S - 1e-6:
            return
        seconds = 0.0 if self._judged is None else t - self._judged
        if not 0.0 <= seconds <= _LONGEST_STEP_S:
            self.begin()
            seconds = 0.0
        self._judged = t
        position = state.position
        torque = (
            command.stiffness * (command.position - position) - command.damping * state.velocity
        )
        direction = np.where(np.abs(torque) > limits.push, np.sign(torque), 0.0)
        begins = (direction != self._direction) | (direction == 0.0)
        # The position farthest from where the joint is pushed.
        self._worst = np.where(
            begins, position, direction * np.minimum(direction * self._worst, direction * position)
        )
        moved = direction * (position - self._worst) > limits.blocked.motion
        self._worst = np.where(moved, position, self._worst)
        self._direction = direction
        self.pushed_s = np.where(begins | moved, 0.0, self.pushed_s + seconds)
        self._sample(command, position)
        self._measure_height(state, limits, on_feet)
        self.low_s = self.low_s + seconds if self.trunk_height < limits.collapsed else 0.0

    def _sample(self, command: Command, position: Array) -> None:
        """Keep a sample, and update the ranges."""
        self._targets.append(np.asarray(command.position))
        self._torques.append(np.asarray(command.stiffness * command.position))
        self._positions.append(position)
        if len(self._positions) < _SAMPLES:
            return
        targets = np.array(self._targets)[_LAG_SAMPLES:-_LAG_SAMPLES]
        torques = np.array(self._torques)[_LAG_SAMPLES:-_LAG_SAMPLES]
        positions = np.array(self._positions)[_LAG_SAMPLES:]
        self.target_range = targets.max(axis=0) - targets.min(axis=0)
        self.torque_range = torques.max(axis=0) - torques.min(axis=0)
        self.motion = positions.max(axis=0) - positions.min(axis=0)

    def _measure_height(self, state: State, limits: Limits, on_feet: bool) -> None:
        """Update the height of the trunk; infinite where it should not be up."""
        self.trunk_height = np.inf
        if on_feet and limits.legs is not None:
            self.trunk_height = limits.legs.height(state.position, state.orientation)


# --- The rules ------------------------------------------------------------------------------------
#
# Each rule returns the numbers behind a fault, or "" if there is none.

ResponseRule = Callable[[ResponseHistory, Limits], str]


def collapsed_trunk(history: ResponseHistory, limits: Limits) -> str:
    """Find a trunk that is down although a policy runs.

    Rule: the height of the trunk over its lowest foot, by the angles of the legs and the attitude,
    is below `LegKinematics.collapsed`, the folded pose and a tenth of the way up from it, for more
    than `low_s`, 120 ms. Measured is the height over the foot that reaches down farthest, so a
    trunk in the air does not count as low. Lowest of walks and jumps: 0.22 of the way.
    """
    if history.low_s > limits.response.low_s:
        return f"{history.trunk_height:.2f} m, of {limits.collapsed:.2f} m at least"
    return ""


def pushed_in_vain(history: ResponseHistory, limits: Limits) -> str:
    """Find a joint that does not go where it is pushed.

    Rule: the commanded torque has been beyond `Limits.push` in one direction for more than
    `pushed_s`, 0.35 s, in which the joint did not move that way by `BlockedLimits.motion`, 0.05
    rad, from where it was farthest off. `push` is 0.45 of the effort limit, and no less than what a
    leg needs that carries half of the weight at the length of a shank. A landing takes 0.25 s at
    most.
    """
    i = int(np.argmax(history.pushed_s))
    if history.pushed_s[i] > limits.response.pushed_s:
        milliseconds = 1e3 * history.pushed_s[i]
        return f"{limits.joints.names[i]}, pushed for {milliseconds:.0f} ms without following"
    return ""


def seized_joint(history: ResponseHistory, limits: Limits) -> str:
    """Find a joint that stands still while its target moves far.

    Rule: over 0.4 s the position stayed within `still`, 0.01 rad, while the target, from the begin
    of this time until 60 ms before its end, moved over more than `far`, 0.8 rad, and stiffness
    times target over more than 0.45 of the effort limit. Targets before do not count: a Go2 that
    stops follows the last of them within 40 ms, and then stands still. Least motion of walks and
    jumps in 0.25 s while targets moved as far: 0.033 rad.
    """
    response = limits.response
    far = (history.target_range > response.far) & (
        history.torque_range > response.push_share * limits.joints.torque
    )
    seized = far & (history.motion < response.still)
    if seized.any():
        i = int(np.argmax(seized))
        return (
            f"{limits.joints.names[i]} moved by {history.motion[i]:.3f} rad while its target "
            f"moved by {history.target_range[i]:.2f} rad"
        )
    return ""


RESPONSE_RULES: tuple[tuple[Reason, ResponseRule], ...] = (
    (Reason.COLLAPSED, collapsed_trunk),
    (Reason.TRACKING, seized_joint),
    (Reason.TRACKING, pushed_in_vain),
)
"""Rules of the response, in their order."""


def find_no_response(history: ResponseHistory, limits: Limits) -> Decision | None:
    """Return the fault of the first rule that is met; None if all joints respond."""
    if not limits.trunk_is_free:
        return None
    for reason, rule in RESPONSE_RULES:
        detail = rule(history, limits)
        if detail:
            return Decision(reason, detail)
    return None
