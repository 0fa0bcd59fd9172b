"""The safety filter: judges every command before it is sent, and keeps the fault that lasts.

The rules are applied in one order; the first that is met gives the reason:

1. `rules.apply_rules`: the states and the command of this tick against the limits. Without a fault
   it moves or holds the target where a limit asks for it.
2. `supervision.find_contradiction`: whether the states so far can all be true.
3. `persistence.find_persistent`: whether targets have been held or limited for too long.
4. `response.find_no_response`: whether joints follow their targets, and the trunk is up.

A fault damps for at least one second; a latched fault needs the operator's reset.
`reasons.REASONS` is the table of all reasons, with the text and the action of each.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pronk.arrays import Array
from pronk.deploy.runtime.limits import LAG_RATE_HZ, Limits
from pronk.deploy.runtime.persistence import TargetHistory, find_persistent
from pronk.deploy.runtime.reasons import Decision, FilterAction, Reason
from pronk.deploy.runtime.response import ResponseHistory, find_no_response
from pronk.deploy.runtime.rules import SafetyInput, apply_rules, tilt
from pronk.deploy.runtime.supervision import SensorHistory, find_contradiction
from pronk.robots.machine import Command, State

LEAST_DAMPING_S = 1.0
"""Shortest time that a fault damps [s]."""


class SafetyFilter:
    """The limits, and what lasts from one tick to the next.

    Times are on the clock of the states and commands that it is given: CLOCK_MONOTONIC in the
    servo, which converts those of the machine; the machine's own clock in a sweep that is simulated
    without a servo.
    """

    def __init__(self, *, limits: Limits, state_rate_hz: float = LAG_RATE_HZ) -> None:
        """Begin without a fault.

        Args:
            limits: Limits of the robot.
            state_rate_hz: States per second of the robot.
        """
        self.limits = limits
        self.state_rate_hz = state_rate_hz
        joints = len(limits.joints.names)
        self.reason = Reason.NONE
        """Reason of the fault that lasts."""
        self.since = 0.0
        """Time at which it began [s]."""
        self.sent_target: Array | None = None
        """Target sent a tick ago [rad], (joints,); None after damping."""
        self.sensors = SensorHistory(joints, state_rate_hz)
        """States since the last damping."""
        self.targets = TargetHistory(joints)
        """Targets since the last damping."""
        self.response = ResponseHistory(joints)
        """Response of the joints since the last damping."""
        self.on_feet = False
        """Whether the trunk should be up, as while a policy runs; the state machine sets it."""

    @property
    def level(self) -> FilterAction:
        """`DAMP` or `LATCH` while a fault lasts, else `PASS`."""
        return self.reason.level

    @property
    def faulted(self) -> bool:
        """Whether a fault lasts."""
        return self.reason is not Reason.NONE

    def fault(self, reason: Reason, t: float) -> None:
        """Begin a fault, or make one more severe; one that is at least as severe stays."""
        if reason.level > self.level:
            if not self.faulted:
                self.since = t
            self.reason = reason

    def release(self, t: float, *, acknowledged: bool = False) -> None:
        """End a fault that has lasted long enough; a latched one only if `acknowledged`."""
        over = self.faulted and t - self.since >= LEAST_DAMPING_S
        if over and (acknowledged or self.level is FilterAction.DAMP):
            self.reason = Reason.NONE
            self.sent_target = None

    def damped(self) -> Decision:
        """Note a tick without a target; the next one is limited to near the measured position."""
        self.sent_target = None
        self.sensors.begin()
        self.targets.begin()
        self.response.begin()
        return Decision(self.reason)

    def judge(
        self,
        states: Sequence[State],
        command: Command,
        t: float,
        *,
        dead_man: bool = True,
        limits: Limits | None = None,
    ) -> tuple[Command | None, Decision]:
        """Apply the rules to one command.

        Args:
            states: States since the tick before, at least one, the newest last; a fault in any of
                them counts.
            command: The command before the filter.
            t: Time of the tick [s].
            dead_man: Whether the dead-man button is held.
            limits: Limits of this tick in place of the robot's own.

        Returns:
            The command to send, None for damping; and why.
        """
        if limits is None:
            limits = self.limits
        result = apply_rules(self._input(states, command, t, dead_man), limits)
        # A fault in any of the states decides, the first of the most severe ones; the newest state
        # if there is none.
        is_fault = result.level >= int(FilterAction.DAMP)
        row = int(np.argmax(result.level)) if is_fault.any() else -1
        decision = Decision(Reason(int(result.reason[row])))
        if is_fault.any():
            detail = fault_detail(decision.reason, states[row], command, limits, t)
            decision = Decision(decision.reason, detail)
        elif not self.faulted:
            decision = self._judge_history(states, command, t, decision, limits)
        if self.faulted or decision.level >= FilterAction.DAMP:
            detail = "" if self.faulted else decision.detail
            self.fault(decision.reason, t)
            self.damped()
            return None, Decision(self.reason, detail)
        self.sent_target = result.target[-1]
        self.sensors.command(np.asarray(command.stiffness) * self.sent_target)
        return replace(command, position=self.sent_target), decision

    def _judge_history(
        self,
        states: Sequence[State],
        command: Command,
        t: float,
        decision: Decision,
        limits: Limits,
    ) -> Decision:
        """Apply the rules over several ticks; return their first fault, else `decision`."""
        for state in states:
            self.sensors.observe(state)
            contradiction = find_contradiction(self.sensors, limits)
            if contradiction is not None:
                return contradiction
        self.targets.observe(decision.reason, t, command, states[-1], limits)
        persistent = find_persistent(self.targets, limits)
        if persistent is not None:
            return persistent
        self.response.observe(t, command, states[-1], limits, on_feet=self.on_feet)
        missing = find_no_response(self.response, limits)
        return decision if missing is None else missing

    def _input(
        self, states: Sequence[State], command: Command, t: float, dead_man: bool
    ) -> SafetyInput:
        """Return the input of the rules; what has another shape becomes NaN."""
        n = len(self.limits.joints.names)
        newest = states[-1]
        position = _rows([state.position for state in states], n)
        gyro = _rows([state.gyro for state in states], 3)
        accelerometer = _rows([state.accelerometer for state in states], 3)
        lag = 0.0
        if command.state_sequence >= 0:
            lag = (newest.sequence - command.state_sequence) * LAG_RATE_HZ / self.state_rate_hz
        return SafetyInput(
            position=position,
            velocity=_rows([state.velocity for state in states], n),
            torque=_rows([state.torque for state in states], n),
            temperature=_rows([state.temperature for state in states], n),
            orientation=_rows([state.orientation for state in states], 4),
            imu=np.concatenate((gyro, accelerometer), axis=-1),
            state_age=t - newest.time,
            target=_rows([command.position], n),
            stiffness=_rows([command.stiffness], n),
            damping=_rows([command.damping], n),
            previous=position[-1:] if self.sent_target is None else self.sent_target[None],
            command_age=t - command.made,
            valid_for=float(command.valid_for),
            lag=lag,
            dead_man=dead_man,
        )


def _rows(rows: Sequence[object], count: int) -> Array:
    """Return rows of numbers, (rows, count); a row that is not `count` numbers is all NaN."""
    try:
        array = np.array(rows, dtype=float)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape == (len(rows), count):
        return array
    if len(rows) == 1 or all(row is None for row in rows):
        return np.full((len(rows), count), np.nan)
    return np.concatenate([_rows([row], count) for row in rows])


def fault_detail(reason: Reason, state: State, command: Command, limits: Limits, t: float) -> str:
    """Return the numbers behind a fault, where they add to its text; else "".

    Args:
        reason: The fault.
        state: The state in which it was found.
        command: The command before the filter.
        limits: Limits that apply.
        t: Time of the tick [s].
    """
    joints = limits.joints
    position = np.asarray(state.position)
    velocity = np.asarray(state.velocity)
    if reason is Reason.SPEED:
        i = int(np.argmax(np.abs(velocity) - joints.speed))
        return f"{joints.names[i]} {velocity[i]:.1f} of {joints.speed[i]:.1f} rad/s"
    if reason is Reason.OVERLOAD:
        i = int(np.nanargmax(np.abs(state.torque) - joints.measured_torque))
        return f"{joints.names[i]} {state.torque[i]:.1f} of {joints.torque[i]:.1f} N m"
    if reason is Reason.OVERRUN:
        i = int(np.argmax(np.maximum(joints.low - position, position - joints.high)))
        return (
            f"{joints.names[i]} {position[i]:.2f}, of {joints.low[i]:.2f} to "
            f"{joints.high[i]:.2f} rad"
        )
    if reason is Reason.FAR_TARGET:
        target = np.asarray(command.position)
        i = int(np.argmax(np.maximum(joints.low - target, target - joints.high)))
        return (
            f"{joints.names[i]} {target[i]:.2f}, of {joints.low[i]:.2f} to {joints.high[i]:.2f} rad"
        )
    if reason is Reason.TEMPERATURE and state.temperature is not None:
        i = int(np.nanargmax(state.temperature))
        hottest = limits.operating.temperature
        return f"{joints.names[i]} {state.temperature[i]:.0f} of {hottest:.0f} deg C"
    if reason is Reason.TILT:
        return f"{tilt(state.orientation):.2f} of {limits.operating.tilt:.2f} rad"
    if reason is Reason.EXPIRED:
        return f"{1e3 * (t - command.made):.0f} ms old"
    if reason in (Reason.NO_STATE, Reason.STATE_LOST):
        return f"{1e3 * (t - state.time):.0f} ms old"
    if reason is Reason.LAG:
        return f"{state.sequence - command.state_sequence} states"
    return ""
