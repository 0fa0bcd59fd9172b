"""The state machine: what the servo does next, and what it asks for.

    Idle -> Preflight -> Damp -> Stand -> Policy -> Halt -> Sit -> Damp
                                   any fault -> Fault (damped) -> Damp -> ...

The machine decides the desired command; the safety filter what is sent. It takes time, states
and requests as arguments and has no clock of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.links.machine import Command, State
from pronk.robots.robot import Robot
from pronk.runtime.ipc import Mode, OperatorRequest, PolicyAction
from pronk.runtime.safety import FilterAction, FilterState, Reason, released
from pronk.runtime.trajectories import Path, Timing, minimum_jerk, sit_down, stand_up

Array = NDArray[np.float64]

PREFLIGHT_S = 0.5
"""How long states are looked at before anything is sent [s]."""
VALID_S = 0.05
"""How long a target on the way up or down may be repeated [s]; there is a new one every tick."""
FIRST_ACTION_S = 0.2
"""In which the policy must give its first action once it is its turn [s]."""

_SILENT = (Mode.IDLE, Mode.PREFLIGHT, Mode.ENDED)


@dataclass(frozen=True, kw_only=True)
class DesiredCommand:
    """What a tick asks for."""

    command: Command | None
    """None: damp, or nothing at all if `silent`."""
    silent: bool = False
    blend: float = 0.0
    """Share of the policy in the targets."""
    stiffness: float = 0.0
    """Share of the drives' own stiffness."""


class StateMachine:
    """One robot's way through the modes."""

    def __init__(self, robot: Robot, timing: Timing) -> None:
        """Begin idle."""
        self.robot = robot
        self.timing = timing
        self.mode = Mode.IDLE
        self.entry = 0
        """How often the mode has changed."""
        self.since = 0.0
        """When it changed last [s]."""
        self.refusals: tuple[str, ...] = ()
        """Why nothing may move, from the pre-flight checks."""
        self.notice = ""
        """Why the last request was not granted; empty if it was."""
        self._kp = np.array([joint.stiffness for joint in robot.joints])
        self._kd = np.array([joint.damping for joint in robot.joints])
        self._path: Path | None = None
        self._blending: float | None = None
        self.controller: Callable[[float, State], DesiredCommand | None] | None = None
        """Of a sweep: what it requests at a time; None once it is over."""
        self._took_over = 0
        """Entry with which the policy took over."""
        self._request = OperatorRequest.NONE

    def enter(self, mode: Mode, t: float) -> None:
        """Change the mode."""
        self.mode, self.since = mode, t
        self.entry += 1

    def preflighted(self, refusals: Sequence[str], t: float) -> None:
        """What the pre-flight checks found: nothing, and the joints are damped; or back to idle."""
        self.refusals = tuple(refusals)
        if self.controller is None:
            self.enter(Mode.IDLE if refusals else Mode.DAMP, t)
        else:
            self._request = OperatorRequest.QUIT if refusals else self._request
            self.enter(Mode.IDLE if refusals else Mode.SWEEP, t)

    def request(self, request: OperatorRequest) -> None:
        """Take a request; it waits until it can be granted or another comes."""
        self._request = request

    def quitting(self) -> bool:
        """Whether the operator wants to leave."""
        return self._request is OperatorRequest.QUIT

    def faulted(self, t: float) -> None:
        """The filter damps: so does the mode."""
        if self.mode is not Mode.FAULT and self.mode not in _SILENT:
            self._request = (
                OperatorRequest.QUIT
                if self._request is OperatorRequest.QUIT
                else OperatorRequest.NONE
            )
            if self.controller is not None:
                self._request = OperatorRequest.QUIT
            self.enter(Mode.FAULT, t)

    def step(
        self,
        t: float,
        state: State,
        memory: FilterState,
        action: PolicyAction | None,
        *,
        objection: str = "",
    ) -> tuple[DesiredCommand, FilterState]:
        """One tick.

        Args:
            t: Now [s].
            state: The newest.
            memory: The filter's; a fault in it is released where a request and the time allow it.
            action: The policy's newest.
            objection: Why the policy may not take over, from what was measured while standing;
                empty if it may.

        Returns:
            What to ask for, and the filter's memory, its fault released or another found.
        """
        memory = self._grant(t, state, memory, objection)
        if self.mode in _SILENT:
            return DesiredCommand(command=None, silent=True), memory
        if self.mode is Mode.SWEEP and self.controller is not None:
            desired = self.controller(t, state)
            if desired is not None:
                return desired, memory
            self._request = OperatorRequest.QUIT
            self.enter(Mode.DAMP, t)
        if self.mode is Mode.STAND and self._path is not None:
            share = self._path.stiffness(t)
            return self._pose(t, self._path.target(t), share), memory
        if self.mode in (Mode.POLICY, Mode.HALT) and self._path is not None:
            if self.mode is Mode.HALT and t - self.since >= self.timing.halt_s:
                self._sit(t, state)
            else:
                return self._follow(t, action, memory)
        if self.mode is Mode.SIT and self._path is not None:
            if not self._path.done(t):
                return self._pose(t, self._path.target(t), 1.0), memory
            self.enter(Mode.DAMP, t)
        return DesiredCommand(command=None), memory

    def _grant(self, t: float, state: State, memory: FilterState, objection: str) -> FilterState:
        """Let the request have its way as far as it may."""
        request, mode = self._request, self.mode
        self.notice = ""
        if request in (OperatorRequest.DAMP, OperatorRequest.QUIT) and mode not in (
            *_SILENT,
            Mode.FAULT,
            Mode.DAMP,
        ):
            self.enter(Mode.DAMP, t)
        elif request is OperatorRequest.SIT and mode is Mode.POLICY:
            self.enter(Mode.HALT, t)
        elif request is OperatorRequest.SIT and mode is Mode.STAND:
            self._sit(t, state)
        elif request in (OperatorRequest.STAND, OperatorRequest.RESET) and mode is Mode.FAULT:
            memory = released(memory, t, mended=request is OperatorRequest.RESET)
            if not memory.faulted:
                self.enter(Mode.DAMP, t)
            elif memory.level is FilterAction.LATCH and request is OperatorRequest.STAND:
                self.notice = "the fault is latched; say that it is mended (reset) first"
                self._request = OperatorRequest.NONE
        elif request is OperatorRequest.STAND and mode is Mode.DAMP:
            if t - self.since >= self.timing.damp_s:
                self._path = stand_up(self.robot, state.position, t, self.timing)
                self._request = OperatorRequest.NONE
                self.enter(Mode.STAND, t)
        elif request is OperatorRequest.WALK and mode is Mode.STAND and self._stands(t):
            self._request = OperatorRequest.NONE
            if objection:
                self.notice = objection
            else:
                self._blending = None
                self.enter(Mode.POLICY, t)
                self._took_over = self.entry
        if self.mode is not mode and request not in (OperatorRequest.QUIT, OperatorRequest.STAND):
            self._request = OperatorRequest.NONE
        return memory

    def _stands(self, t: float) -> bool:
        return self._path is not None and self._path.done(t)

    def _sit(self, t: float, state: State) -> None:
        self._path = sit_down(self.robot, state.position, t, self.timing)
        self.enter(Mode.SIT, t)

    def _pose(self, t: float, target: Array, share: float) -> DesiredCommand:
        command = Command(
            position=target, stiffness=share * self._kp, damping=self._kd, made=t, valid_for=VALID_S
        )
        return DesiredCommand(command=command, stiffness=share)

    def _follow(
        self, t: float, action: PolicyAction | None, memory: FilterState
    ) -> tuple[DesiredCommand, FilterState]:
        """The policy's targets, blended in; the standing pose until the first of them."""
        assert self._path is not None
        pose = self._path.target(t)
        if self._blending is None:
            # Halted before its first action, the policy may act for either mode.
            if action is None or action.entry < self._took_over:
                if t - self.since > FIRST_ACTION_S:
                    late = FilterState(level=FilterAction.LATCH, reason=Reason.EXPIRED, since=t)
                    return DesiredCommand(command=None), late
                return self._pose(t, pose, 1.0), memory
            self._blending = t
        assert action is not None
        length = self.timing.blend_s
        share = minimum_jerk((t - self._blending) / length) if length > 0.0 else 1.0
        command = Command(
            position=pose + share * (action.position - pose),
            stiffness=self._kp,
            damping=self._kd,
            sequence=action.sequence,
            state_sequence=action.state_sequence,
            made=action.made,
            valid_for=action.valid_for,
        )
        return DesiredCommand(command=command, blend=share, stiffness=1.0), memory
