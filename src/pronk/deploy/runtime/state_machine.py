"""The state machine of the servo, and the paths on which the robot stands up and sits down.

    Idle -> Preflight -> Damp -> Stand -> Policy -> Halt -> Sit -> Damp
                      -> Sweep -> Damp
                                   any fault -> Fault (damped) -> Damp -> ...

It gives the desired command; the safety filter decides what is sent. Time, states and requests are
arguments.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pronk.arrays import Array
from pronk.deploy.runtime.ipc import Record
from pronk.deploy.runtime.modes import SILENT, Mode, OperatorRequest
from pronk.deploy.runtime.safety import FilterAction, Reason, SafetyFilter
from pronk.errors import RobotError
from pronk.robots.machine import Command
from pronk.robots.robot import RobotSpec

PREFLIGHT_S = 0.5
"""How long states are checked before anything is sent [s]."""
VALID_S = 0.05
"""How long a target of the servo's own may be repeated [s]."""
SWING = 0.15
"""Of each leg's last joint towards the default pose and back, to know that its encoder is its own
[rad]. In the folded pose on the ground it moves by 0.010 to 0.020, any other by 0.47 of that at
most, where the motions out and back are averaged: a robot that still sinks moves all of them."""
STRAY, STRAY_SHARE = 0.005, 1.4
"""Such a motion of another joint that is wrong: in rad, and as a share of that of the swung one."""
FIRST_ACTION_S = 0.2
"""In which the policy must give its first action [s]."""


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Times of standing up, starting the policy and sitting down [s]."""

    damp_s: float = 1.0
    """Least time in damping before the robot stands up; it sinks to the ground meanwhile."""
    fold_s: float = 1.0
    """From the measured pose to the folded pose."""
    check_s: float = 0.15
    """Of each half swing of a leg in the folded pose, before the first rise; 0 for no check."""
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


def last_joints(robot: RobotSpec) -> list[int]:
    """Number of each leg's last joint."""
    names = robot.joint_names
    return [max(i for i, n in enumerate(names) if n.startswith(f"{leg}_")) for leg in robot.legs]


def folded_pose(robot: RobotSpec) -> Array:
    """[rad], (joints,); RobotError if the robot file gives none."""
    pose = [joint.folded_position for joint in robot.joints]
    if any(position is None for position in pose):
        raise RobotError(
            f"{robot.name} has no folded pose, so it cannot stand up; give each of its joints a "
            "folded position."
        )
    return np.array(pose, dtype=float)


def stand_up(
    robot: RobotSpec, measured: Array, began: float, timing: Timing, *, swing: bool = False
) -> Path:
    """From the measured pose through the folded to the default pose, with growing stiffness.

    With `swing` each leg's last joint swings by `SWING` in the folded pose, one leg after another.
    """
    default = np.array([joint.default_position for joint in robot.joints])
    folded = folded_pose(robot)
    poses, seconds = [measured.copy(), folded], [timing.fold_s]
    for i in last_joints(robot) if swing else ():
        swung = folded.copy()
        swung[i] += math.copysign(SWING, default[i] - folded[i])
        poses += [swung, folded]
        seconds += [timing.check_s, timing.check_s]
    return Path(
        began=began,
        poses=(*poses, default),
        seconds=(*seconds, timing.rise_s),
        ramp_s=timing.ramp_s,
    )


class DesiredCommand(NamedTuple):
    """The command of a tick, before the safety filter."""

    command: Command | None = None
    """None: damp, or send nothing in a mode of `SILENT`."""
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
        self.notice = ""
        """Why the last request was not granted; empty if it was."""
        self.sweep: Callable[[float], Command | None] | None = None
        """The command of a sweep at a time [s]; None once the sweep is over."""
        self._kp = np.array([joint.stiffness for joint in robot.joints])
        self._kd = np.array([joint.damping for joint in robot.joints])
        self._path: Path | None = None
        self._last = last_joints(robot)
        self._known = timing.check_s == 0.0 or not self._last
        """Whether the encoders of the legs are known to be their own."""
        self._swings = np.full((3, len(self._last), len(robot.joints)), np.nan)
        """Positions before each leg's swing, at its largest, and after it [rad]."""
        self._blending: float | None = None
        self._first_entry = 0
        self._request = OperatorRequest.NONE

    @property
    def silent(self) -> bool:
        """Whether nothing is sent."""
        return self.mode in SILENT

    @property
    def quitting(self) -> bool:
        """Whether the operator has requested the end."""
        return self._request is OperatorRequest.QUIT

    def enter(self, mode: Mode, t: float) -> None:
        """Change the mode."""
        self.mode, self.since = mode, t
        self.entry += 1

    def preflighted(self, refusals: Sequence[str], t: float) -> None:
        """Leave the pre-flight checks: idle if there are refusals, else damp or begin the sweep."""
        go = Mode.DAMP if self.sweep is None else Mode.SWEEP
        self.enter(Mode.IDLE if refusals else go, t)

    def request(self, request: OperatorRequest) -> None:
        """Take a request; it is kept until it can be granted or another comes."""
        self._request = request

    def faulted(self, t: float) -> None:
        """Enter `FAULT`, because the filter damps; a fault ends a sweep."""
        if self.mode is not Mode.FAULT and not self.silent:
            if self.sweep is not None:
                self._request = OperatorRequest.QUIT
            elif not self.quitting:
                self._request = OperatorRequest.NONE
            self.enter(Mode.FAULT, t)

    def step(
        self,
        t: float,
        position: Array,
        safety: SafetyFilter,
        action: Record | None,
        objection: str = "",
    ) -> DesiredCommand:
        """Compute the desired command of one tick.

        `position` is measured, `action` the policy's newest, a record of `ACTIONS`; `objection`
        says why the policy may not start. May release a fault of the filter, or add one.
        """
        self._grant(t, position, safety, objection)
        if self.mode is Mode.SWEEP and self.sweep is not None:
            command = self.sweep(t)
            if command is not None:
                return DesiredCommand(command, stiffness=1.0)
            self._request = OperatorRequest.QUIT
            self.enter(Mode.DAMP, t)
        if self.mode is Mode.HALT and t - self.since >= self.timing.halt_s:
            self._sit(t, position)
        if self._path is not None and self.mode in (Mode.POLICY, Mode.HALT):
            return self._follow(t, self._path.target(t), action, safety)
        if self._path is not None and self.mode in (Mode.STAND, Mode.SIT):
            if self.mode is Mode.STAND and not self._known and self._swapped(t, position):
                safety.fault(Reason.SWAPPED, t)
                return DesiredCommand()
            if self.mode is Mode.STAND or not self._path.done(t):
                return self._pose(t, self._path.target(t), self._path.stiffness(t))
            self.enter(Mode.DAMP, t)
        return DesiredCommand()

    def _grant(self, t: float, position: Array, safety: SafetyFilter, objection: str) -> None:
        """Carry out the request as far as the mode allows."""
        request, mode = self._request, self.mode
        stand, reset = OperatorRequest.STAND, OperatorRequest.RESET
        risen = self._path is not None and self._path.done(t)
        self.notice = ""
        if request in (OperatorRequest.DAMP, OperatorRequest.QUIT):
            if mode not in (*SILENT, Mode.FAULT, Mode.DAMP):
                self.enter(Mode.DAMP, t)
        elif request is OperatorRequest.SIT and mode is Mode.POLICY:
            self.enter(Mode.HALT, t)
        elif request is OperatorRequest.SIT and mode is Mode.STAND:
            self._sit(t, position)
        elif request in (stand, reset) and mode is Mode.FAULT:
            safety.release(t, acknowledged=request is reset)
            if not safety.faulted:
                self.enter(Mode.DAMP, t)
            elif safety.level is FilterAction.LATCH and request is stand:
                self.notice = "the fault is latched; request a reset once its cause is gone"
                self._request = OperatorRequest.NONE
        elif request is stand and mode is Mode.DAMP:
            if t - self.since >= self.timing.damp_s:
                self._path = stand_up(self.robot, position, t, self.timing, swing=not self._known)
                self._swings[:] = np.nan
                self._request = OperatorRequest.NONE
                self.enter(Mode.STAND, t)
        elif request is OperatorRequest.WALK and mode is Mode.STAND and risen:
            self.notice, self._request = objection, OperatorRequest.NONE
            if not objection:
                self._blending = None
                self.enter(Mode.POLICY, t)
                self._first_entry = self.entry
        if self.mode is not mode and request not in (OperatorRequest.QUIT, stand):
            self._request = OperatorRequest.NONE

    def _sit(self, t: float, position: Array) -> None:
        poses = position.copy(), folded_pose(self.robot)
        self._path = Path(began=t, poses=poses, seconds=(self.timing.sit_s,))
        self.enter(Mode.SIT, t)

    def _swapped(self, t: float, position: Array) -> bool:
        """Note the position while legs swing; whether another joint than the swung one moved."""
        assert self._path is not None
        half = math.floor((t - self._path.began - self.timing.fold_s) / self.timing.check_s)
        leg, back = divmod(half, 2)
        if leg < 0:
            return False
        if leg < len(self._last):
            seen = self._swings[:, leg]
            seen[0] = np.where(np.isnan(seen[0]), position, seen[0])
            seen[1 + back] = position
            return False
        before, out, after = self._swings
        moved = np.abs(out - 0.5 * (before + after))
        own = moved[np.arange(len(moved)), self._last]
        wrong = (moved > np.maximum(STRAY, STRAY_SHARE * own[:, None])).any()
        self._known = not wrong
        return bool(wrong)

    def _pose(self, t: float, target: Array, share: float) -> DesiredCommand:
        command = Command(
            position=target, stiffness=share * self._kp, damping=self._kd, made=t, valid_for=VALID_S
        )
        return DesiredCommand(command, stiffness=share)

    def _follow(
        self, t: float, pose: Array, action: Record | None, safety: SafetyFilter
    ) -> DesiredCommand:
        """The policy's targets, blended in; the standing pose until the first of them."""
        # Halted before its first action, the policy may act for either mode.
        if self._blending is None and (action is None or action["entry"] < self._first_entry):
            if t - self.since > FIRST_ACTION_S:
                safety.fault(Reason.EXPIRED, t)
                return DesiredCommand()
            return self._pose(t, pose, 1.0)
        assert action is not None
        if self._blending is None:
            self._blending = t
        length = self.timing.blend_s
        share = minimum_jerk((t - self._blending) / length) if length > 0.0 else 1.0
        command = Command(
            position=pose + share * (action["position"] - pose),
            stiffness=self._kp,
            damping=self._kd,
            sequence=int(action["sequence"]),
            state_sequence=int(action["state_sequence"]),
            made=float(action["made"]),
            valid_for=float(action["valid_for"]),
        )
        return DesiredCommand(command, blend=share, stiffness=1.0)
