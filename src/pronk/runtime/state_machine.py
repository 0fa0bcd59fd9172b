"""The state machine of the servo, and the paths on which the robot stands up and sits down.

    Idle -> Preflight -> Damp -> Stand -> Policy -> Halt -> Sit -> Damp
                                   any fault -> Fault (damped) -> Damp -> ...

It gives the desired command; the safety filter decides what is sent. Time, states and requests are
arguments.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.errors import RobotError
from pronk.links.machine import Command, State
from pronk.robots.robot import RobotSpec
from pronk.runtime.ipc import Mode, OperatorRequest, PolicyAction
from pronk.runtime.safety import FilterAction, FilterState, Reason, released

Array = NDArray[np.float64]

PREFLIGHT_S = 0.5
"""How long states are checked before anything is sent [s]."""
VALID_S = 0.05
"""How long a target while standing up or sitting down may be repeated [s]."""
FIRST_ACTION_S = 0.2
"""In which the policy must give its first action [s]."""

_SILENT = (Mode.IDLE, Mode.PREFLIGHT, Mode.ENDED)


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Times of standing up, starting the policy and sitting down [s]."""

    damp_s: float = 1.0
    """Least time in damping before the robot stands up; it sinks to the ground meanwhile."""
    fold_s: float = 1.0
    """From the measured pose to the folded pose."""
    rise_s: float = 1.5
    """From there to the default pose."""
    ramp_s: float = 0.5
    """In which the stiffness grows from none to that of the robot's drives."""
    blend_s: float = 0.4
    """In which the policy's targets replace the pose; 0 as in training."""
    halt_s: float = 1.0
    """With a zero command before the robot sits down."""
    sit_s: float = 1.5
    """From the measured pose to the folded pose."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 <= value < math.inf:
                raise RobotError(f"Timing.{name} is {value}; it must be finite, not negative.")


def minimum_jerk(share: float) -> float:
    """Share of a minimum-jerk path at a share of its time: `10 s^3 - 15 s^4 + 6 s^5`.

    Flash and Hogan, 1985. `share` is clipped to 0 to 1.
    """
    s = min(max(share, 0.0), 1.0)
    return s * s * s * (10.0 + s * (6.0 * s - 15.0))


@dataclass(frozen=True, kw_only=True)
class Path:
    """Minimum-jerk joint targets through poses, at rest at each, with a growing stiffness."""

    began: float
    """[s]"""
    poses: tuple[Array, ...]
    """Joint positions, the measured ones first [rad]. Each (joints,)."""
    seconds: tuple[float, ...]
    """From each pose to the next [s]."""
    ramp_s: float = 0.0
    """In which the stiffness grows [s]."""

    def target(self, t: float) -> Array:
        """Joint targets at a time [rad]. (joints,)."""
        left = t - self.began
        for start, goal, seconds in zip(self.poses, self.poses[1:], self.seconds, strict=False):
            if left < seconds:
                return start + (goal - start) * minimum_jerk(left / seconds)
            left -= seconds
        return self.poses[-1]

    def stiffness(self, t: float) -> float:
        """Share of the drives' stiffness at a time, 0 to 1."""
        return minimum_jerk((t - self.began) / self.ramp_s) if self.ramp_s > 0.0 else 1.0

    def done(self, t: float) -> bool:
        """Whether the target has reached the last pose."""
        return t >= self.began + sum(self.seconds)


def default_pose(robot: RobotSpec) -> Array:
    """[rad], (joints,)."""
    return np.array([joint.default_position for joint in robot.joints])


def folded_pose(robot: RobotSpec) -> Array:
    """[rad], (joints,).

    Raises:
        RobotError: The robot file gives none.
    """
    pose = [joint.folded_position for joint in robot.joints]
    if any(position is None for position in pose):
        raise RobotError(
            f"{robot.name} has no folded pose, so it cannot stand up; give each of its joints a "
            "folded position."
        )
    return np.array(pose, dtype=float)


def stand_up(robot: RobotSpec, measured: Array, began: float, timing: Timing) -> Path:
    """From the measured pose through the folded to the default pose, with growing stiffness."""
    return Path(
        began=began,
        poses=(measured.copy(), folded_pose(robot), default_pose(robot)),
        seconds=(timing.fold_s, timing.rise_s),
        ramp_s=timing.ramp_s,
    )


def sit_down(robot: RobotSpec, measured: Array, began: float, timing: Timing) -> Path:
    """From the measured pose to the folded pose."""
    return Path(began=began, poses=(measured.copy(), folded_pose(robot)), seconds=(timing.sit_s,))


@dataclass(frozen=True, kw_only=True)
class DesiredCommand:
    """The command of a tick, before the safety filter."""

    command: Command | None
    """None: damp, or send nothing if `silent`."""
    silent: bool = False
    blend: float = 0.0
    """Share of the policy in the targets."""
    stiffness: float = 0.0
    """Share of the drives' own stiffness."""


class StateMachine:
    """The modes of one run, a policy's or a sweep's."""

    def __init__(self, robot: RobotSpec, timing: Timing) -> None:
        """Begin idle."""
        self.robot = robot
        self.timing = timing
        self.mode = Mode.IDLE
        self.entry = 0
        """Number of mode changes."""
        self.since = 0.0
        """Time of the last one [s]."""
        self.refusals: tuple[str, ...] = ()
        """Of the pre-flight checks."""
        self.notice = ""
        """Why the last request was not granted; empty if it was."""
        self.controller: Callable[[float, State], DesiredCommand | None] | None = None
        """Of a sweep: the command at a time [s]; None once the sweep is over."""
        self._kp = np.array([joint.stiffness for joint in robot.joints])
        self._kd = np.array([joint.damping for joint in robot.joints])
        self._path: Path | None = None
        self._blending: float | None = None
        self._first_entry = 0
        self._request = OperatorRequest.NONE

    def enter(self, mode: Mode, t: float) -> None:
        """Change the mode."""
        self.mode, self.since = mode, t
        self.entry += 1

    def preflighted(self, refusals: Sequence[str], t: float) -> None:
        """Leave the pre-flight checks: idle if there are refusals, else damp or begin the sweep."""
        self.refusals = tuple(refusals)
        go = Mode.DAMP if self.controller is None else Mode.SWEEP
        self.enter(Mode.IDLE if refusals else go, t)

    def request(self, request: OperatorRequest) -> None:
        """Take a request; it is kept until it can be granted or another comes."""
        self._request = request

    def quitting(self) -> bool:
        """Whether the operator has requested the end."""
        return self._request is OperatorRequest.QUIT

    def faulted(self, t: float) -> None:
        """Enter `FAULT`, because the filter damps; a fault ends a sweep."""
        if self.mode is not Mode.FAULT and self.mode not in _SILENT:
            if self.controller is not None:
                self._request = OperatorRequest.QUIT
            elif self._request is not OperatorRequest.QUIT:
                self._request = OperatorRequest.NONE
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
        """Compute the desired command of one tick.

        `objection` says why the policy may not start. Returns the command, and the filter's memory
        with a fault released or added.
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
        if self.mode is Mode.HALT and t - self.since >= self.timing.halt_s:
            self._sit(t, state)
        if self._path is None:
            return DesiredCommand(command=None), memory
        if self.mode in (Mode.POLICY, Mode.HALT):
            return self._follow(t, self._path.target(t), action, memory)
        if self.mode is Mode.SIT and self._path.done(t):
            self.enter(Mode.DAMP, t)
        if self.mode in (Mode.STAND, Mode.SIT):
            share = self._path.stiffness(t)
            return self._pose(t, self._path.target(t), share), memory
        return DesiredCommand(command=None), memory

    def _grant(self, t: float, state: State, memory: FilterState, objection: str) -> FilterState:
        """Carry out the request as far as the mode allows."""
        request, mode = self._request, self.mode
        stand, reset = OperatorRequest.STAND, OperatorRequest.RESET
        self.notice = ""
        if request in (OperatorRequest.DAMP, OperatorRequest.QUIT):
            if mode not in (*_SILENT, Mode.FAULT, Mode.DAMP):
                self.enter(Mode.DAMP, t)
        elif request is OperatorRequest.SIT and mode is Mode.POLICY:
            self.enter(Mode.HALT, t)
        elif request is OperatorRequest.SIT and mode is Mode.STAND:
            self._sit(t, state)
        elif request in (stand, reset) and mode is Mode.FAULT:
            memory = released(memory, t, acknowledged=request is reset)
            if not memory.faulted:
                self.enter(Mode.DAMP, t)
            elif memory.level is FilterAction.LATCH and request is stand:
                self.notice = "the fault is latched; request a reset once its cause is gone"
                self._request = OperatorRequest.NONE
        elif request is stand and mode is Mode.DAMP:
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
                self._first_entry = self.entry
        if self.mode is not mode and request not in (OperatorRequest.QUIT, stand):
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
        self, t: float, pose: Array, action: PolicyAction | None, memory: FilterState
    ) -> tuple[DesiredCommand, FilterState]:
        """The policy's targets, blended in; the standing pose until the first of them."""
        # Halted before its first action, the policy may act for either mode.
        if self._blending is None and (action is None or action.entry < self._first_entry):
            if t - self.since > FIRST_ACTION_S:
                late = FilterState(level=FilterAction.LATCH, reason=Reason.EXPIRED, since=t)
                return DesiredCommand(command=None), late
            return self._pose(t, pose, 1.0), memory
        assert action is not None
        if self._blending is None:
            self._blending = t
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
