"""The state machine: what the servo does next, and what it asks for.

    Idle -> Preflight -> Damp -> Stand -> Policy -> Halt -> Sit -> Damp
                                   any fault -> Fault (damped) -> Damp -> ...

The machine decides what is *asked*; the safety filter decides what is sent. It takes time, states
and wishes as arguments and has no clock of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.links.machine import Command, State
from pronk.robots.robot import Robot
from pronk.runtime.reasons import Level, Reason
from pronk.runtime.records import Mode, Wish
from pronk.runtime.safety import Memory, released
from pronk.runtime.trajectories import Path, Timing, minimum_jerk, sit_down, stand_up

Array = NDArray[np.float64]

PREFLIGHT_S = 0.5
"""How long states are looked at before anything is sent [s]."""
VALID_S = 0.05
"""How long a target on the way up or down may be repeated [s]; there is a new one every tick."""
FIRST_ORDER_S = 0.2
"""In which the policy must give its first order once it is its turn [s]."""

_SILENT = (Mode.IDLE, Mode.PREFLIGHT, Mode.ENDED)


@dataclass(frozen=True, kw_only=True)
class Order:
    """Joint targets of the policy, on the servo's clock."""

    sequence: int
    state_sequence: int
    state_time: float
    made: float
    valid_for: float
    entry: int
    """Of the mode that it was made for."""
    position: Array


@dataclass(frozen=True, kw_only=True)
class Intent:
    """What a tick asks for."""

    command: Command | None
    """None: damp, or nothing at all if `silent`."""
    silent: bool = False
    blend: float = 0.0
    """Share of the policy in the targets."""
    stiffness: float = 0.0
    """Share of the drives' own stiffness."""


class Director:
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
        """Why the last wish was not granted; empty if it was."""
        self._kp = np.array([joint.stiffness for joint in robot.joints])
        self._kd = np.array([joint.damping for joint in robot.joints])
        self._path: Path | None = None
        self._blending: float | None = None
        self._took_over = 0
        """Entry with which the policy took over."""
        self._wish = Wish.NONE

    def enter(self, mode: Mode, t: float) -> None:
        """Change the mode."""
        self.mode, self.since = mode, t
        self.entry += 1

    def preflighted(self, refusals: Sequence[str], t: float) -> None:
        """What the pre-flight checks found: nothing, and the joints are damped; or back to idle."""
        self.refusals = tuple(refusals)
        self.enter(Mode.IDLE if refusals else Mode.DAMP, t)

    def wish(self, wish: Wish) -> None:
        """Take a wish; it waits until it can be granted or another comes."""
        self._wish = wish

    def quitting(self) -> bool:
        """Whether the operator wants to leave."""
        return self._wish is Wish.QUIT

    def faulted(self, t: float) -> None:
        """The filter damps: so does the mode."""
        if self.mode is not Mode.FAULT and self.mode not in _SILENT:
            self._wish = Wish.QUIT if self._wish is Wish.QUIT else Wish.NONE
            self.enter(Mode.FAULT, t)

    def step(
        self,
        t: float,
        state: State,
        memory: Memory,
        order: Order | None,
        *,
        objection: str = "",
    ) -> tuple[Intent, Memory]:
        """One tick.

        Args:
            t: Now [s].
            state: The newest.
            memory: The filter's; a fault in it is released where a wish and the time allow it.
            order: The policy's newest.
            objection: Why the policy may not take over, from what was measured while standing;
                empty if it may.

        Returns:
            What to ask for, and the filter's memory, its fault released or another found.
        """
        memory = self._grant(t, state, memory, objection)
        if self.mode in _SILENT:
            return Intent(command=None, silent=True), memory
        if self.mode is Mode.STAND and self._path is not None:
            share = self._path.stiffness(t)
            return self._pose(t, self._path.target(t), share), memory
        if self.mode in (Mode.POLICY, Mode.HALT) and self._path is not None:
            if self.mode is Mode.HALT and t - self.since >= self.timing.halt_s:
                self._sit(t, state)
            else:
                return self._follow(t, order, memory)
        if self.mode is Mode.SIT and self._path is not None:
            if not self._path.done(t):
                return self._pose(t, self._path.target(t), 1.0), memory
            self.enter(Mode.DAMP, t)
        return Intent(command=None), memory

    def _grant(self, t: float, state: State, memory: Memory, objection: str) -> Memory:
        """Let the wish have its way as far as it may."""
        wish, mode = self._wish, self.mode
        self.notice = ""
        if wish in (Wish.DAMP, Wish.QUIT) and mode not in (*_SILENT, Mode.FAULT, Mode.DAMP):
            self.enter(Mode.DAMP, t)
        elif wish is Wish.SIT and mode is Mode.POLICY:
            self.enter(Mode.HALT, t)
        elif wish is Wish.SIT and mode is Mode.STAND:
            self._sit(t, state)
        elif wish in (Wish.STAND, Wish.RESET) and mode is Mode.FAULT:
            memory = released(memory, t, mended=wish is Wish.RESET)
            if not memory.faulted:
                self.enter(Mode.DAMP, t)
            elif memory.level is Level.LATCH and wish is Wish.STAND:
                self.notice = "the fault is latched; say that it is mended (reset) first"
                self._wish = Wish.NONE
        elif wish is Wish.STAND and mode is Mode.DAMP:
            if t - self.since >= self.timing.damp_s:
                self._path = stand_up(self.robot, state.position, t, self.timing)
                self._wish = Wish.NONE
                self.enter(Mode.STAND, t)
        elif wish is Wish.WALK and mode is Mode.STAND and self._stands(t):
            self._wish = Wish.NONE
            if objection:
                self.notice = objection
            else:
                self._blending = None
                self.enter(Mode.POLICY, t)
                self._took_over = self.entry
        if self.mode is not mode and wish not in (Wish.QUIT, Wish.STAND):
            self._wish = Wish.NONE
        return memory

    def _stands(self, t: float) -> bool:
        return self._path is not None and self._path.done(t)

    def _sit(self, t: float, state: State) -> None:
        self._path = sit_down(self.robot, state.position, t, self.timing)
        self.enter(Mode.SIT, t)

    def _pose(self, t: float, target: Array, share: float) -> Intent:
        command = Command(
            position=target, stiffness=share * self._kp, damping=self._kd, made=t, valid_for=VALID_S
        )
        return Intent(command=command, stiffness=share)

    def _follow(self, t: float, order: Order | None, memory: Memory) -> tuple[Intent, Memory]:
        """The policy's targets, blended in; the standing pose until the first of them."""
        assert self._path is not None
        pose = self._path.target(t)
        if self._blending is None:
            # Told to halt before it has answered, it may answer as before or as told.
            if order is None or order.entry < self._took_over:
                if t - self.since > FIRST_ORDER_S:
                    late = Memory(level=Level.LATCH, reason=Reason.EXPIRED, since=t)
                    return Intent(command=None), late
                return self._pose(t, pose, 1.0), memory
            self._blending = t
        assert order is not None
        length = self.timing.blend_s
        share = minimum_jerk((t - self._blending) / length) if length > 0.0 else 1.0
        command = Command(
            position=pose + share * (order.position - pose),
            stiffness=self._kp,
            damping=self._kd,
            sequence=order.sequence,
            state_sequence=order.state_sequence,
            made=order.made,
            valid_for=order.valid_for,
        )
        return Intent(command=command, blend=share, stiffness=1.0), memory
