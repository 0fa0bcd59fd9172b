"""The state machine of the servo: from mode and request to the desired command of a tick.

    mode        left when                                              for
    IDLE        (the servo enters PREFLIGHT)                           PREFLIGHT
    PREFLIGHT   the states were checked                                DAMP, SWEEP or IDLE
    DAMP        STAND is requested, after `RunTiming.damp_s`           STAND
    STAND       WALK is requested, once the time to rise has passed    POLICY
                SIT is requested                                       SIT
    POLICY      SIT is requested                                       HALT
    HALT        `RunTiming.halt_s` has passed                          SIT
    SIT         `RunTiming.sit_s` has passed                           DAMP
    SWEEP       the sweep is over                                      DAMP
    FAULT       RESET or STAND is requested and the fault is over      DAMP
    any driven  DAMP or QUIT is requested                              DAMP
    any driven  the safety filter damps                                FAULT

Rising and sitting down end by time: the measured pose is not compared with the path. The state
machine gives the desired command; the safety filter decides what is sent. Time, states and requests
are arguments.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pronk.arrays import Array
from pronk.deploy.runtime.modes import POLICY_MODES, SILENT, Mode, OperatorRequest
from pronk.deploy.runtime.nod_check import NodCheck, nod_poses
from pronk.deploy.runtime.poses import (
    PosePath,
    RunTiming,
    folded_pose,
    last_joints,
    minimum_jerk,
    stand_up,
)
from pronk.deploy.runtime.posture import leg_kinematics
from pronk.deploy.runtime.reasons import FilterAction, Reason
from pronk.deploy.runtime.records import Record
from pronk.deploy.runtime.safety import SafetyFilter
from pronk.robots.machine import Command
from pronk.robots.robot import RobotSpec

PREFLIGHT_S = 0.5
"""Time for which states are checked before anything is sent [s]."""
VALID_S = 0.05
"""Time for which a target of the servo's own may be repeated [s]."""
FIRST_ACTION_S = 0.2
"""Time in which the policy must give its first action [s]."""
STRAY = 0.005
"""Motion of another joint than the swung one that is a fault [rad]."""
STRAY_SHARE = 1.4
"""Motion of another joint that is a fault, as a share of that of the swung one."""

SWUNG_SHARE = 2.0 / 3.0
"""Share of the time of a half swing from which a position counts as that at its end: the target has
moved by 0.79 of the swing."""


def mixed(values: Array, others: Array, share: float) -> Array:
    """Return the mean of two arrays, with a share of the second; the first itself at 0."""
    mean: Array = values + share * (others - values)
    return mean


class DesiredCommand(NamedTuple):
    """The command of a tick, before the safety filter."""

    command: Command | None = None
    """Command; None to damp, or to send nothing in a mode of `SILENT`."""
    blend: float = 0.0
    """Share of the policy in the targets."""
    stiffness: float = 0.0
    """Share of the drives' own stiffness."""


class SwingCheck:
    """Whether the encoders of the legs are their own.

    In the folded pose each leg's last joint swings, one leg after another. The motion of every
    joint is the difference of its position at the largest swing and the mean of those before and
    after. If another joint moves by more than `STRAY` and by more than `STRAY_SHARE` of the swung
    one, encoders are swapped. If a half swing has no tick near its end, as in a pause, the check is
    not passed.
    """

    def __init__(self, robot: RobotSpec, timing: RunTiming) -> None:
        """Begin without a position."""
        self._timing = timing
        self._swing_s = robot.limits.stand.swing_s
        self._swung = last_joints(robot)
        self.needed = timing.check_s > 0.0 and len(self._swung) > 0
        """Whether the check is still to be passed."""
        self._positions = np.full((3, len(self._swung), len(robot.joints)), np.nan)
        """Positions before each leg's swing, at its largest, and after it [rad]."""

    def begin(self) -> None:
        """Forget the positions of an earlier rise."""
        self._positions[:] = np.nan

    def fault_found(self, t: float, began: float, position: Array) -> Reason:
        """Note the position while legs swing; after it, return the fault, or `NONE` if it passed.

        Args:
            t: Time [s].
            began: Time at which the robot began to stand up [s].
            position: Measured joint positions [rad], (joints,).
        """
        swung_s = t - began - self._timing.fold_s
        half_swings = math.floor(swung_s / self._swing_s)
        leg, back = divmod(half_swings, 2)
        if leg < 0:
            return Reason.NONE
        if leg < len(self._swung):
            of_leg = self._positions[:, leg]
            of_leg[0] = np.where(np.isnan(of_leg[0]), position, of_leg[0])
            if swung_s / self._swing_s - half_swings >= SWUNG_SHARE:
                of_leg[1 + back] = position
            return Reason.NONE
        if np.isnan(self._positions).any():
            return Reason.INTERRUPTED
        before, largest, after = self._positions
        motion = np.abs(largest - 0.5 * (before + after))
        swung_motion = motion[np.arange(len(motion)), self._swung]
        swapped = bool((motion > np.maximum(STRAY, STRAY_SHARE * swung_motion[:, None])).any())
        self.needed = swapped
        return Reason.SWAPPED if swapped else Reason.NONE


class StateMachine:
    """The modes of one run, a policy's or a sweep's."""

    def __init__(
        self,
        robot: RobotSpec,
        timing: RunTiming,
        *,
        sweeps: bool = False,
        policy_gains: tuple[Array, Array] | None = None,
    ) -> None:
        """Begin idle.

        Args:
            robot: The robot.
            timing: Times of standing up, starting the policy and sitting down.
            sweeps: Whether the run is a sweep's.
            policy_gains: Stiffness [N m/rad] and damping [N m s/rad] of the drives under the
                policy, (joints,) each; those of the robot's file if None.
        """
        self.robot = robot
        self.timing = timing
        self.sweeps = sweeps
        self.mode = Mode.IDLE
        self.mode_count = 0
        """Number of mode changes so far."""
        self.since = 0.0
        """Time of the last one [s]."""
        self.notice = ""
        """Why the last request was not granted; empty if it was."""
        self._stiffness = np.array([joint.stiffness for joint in robot.joints])
        self._damping = np.array([joint.damping for joint in robot.joints])
        stand = robot.limits.stand
        self._stand_stiffness = self._stiffness
        self._stand_damping = self._damping
        if stand.stiffness is not None:
            self._stand_stiffness = np.full(len(robot.joints), stand.stiffness)
        if stand.damping is not None:
            self._stand_damping = np.full(len(robot.joints), stand.damping)
        self._policy_stiffness = self._stiffness
        self._policy_damping = self._damping
        if policy_gains is not None:
            self._policy_stiffness, self._policy_damping = policy_gains
        self._path: PosePath | None = None
        self._swing_check = SwingCheck(robot, timing)
        self._nods: list[Array] = []
        """Poses of the small motions after the first rise; none once they are passed."""
        self._nod_check: NodCheck | None = None
        legs = leg_kinematics(robot) if self._swing_check.needed else None
        if legs is not None:
            default = np.array([joint.default_position for joint in robot.joints])
            self._nods = nod_poses(legs, default, folded_pose(robot))
            self._nod_check = NodCheck(legs, robot.joint_names)
        self._blending_since: float | None = None
        """Time of the policy's first action in this run of it [s]; None before it."""
        self._policy_mode_count = 0
        """`mode_count` with which POLICY was entered last; an action with a smaller one is not
        followed."""
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
        self.mode = mode
        self.since = t
        self.mode_count += 1

    def preflighted(self, refusals: Sequence[str], t: float) -> None:
        """Leave the pre-flight checks: idle if there are refusals, else damp or begin the sweep."""
        if refusals:
            self.enter(Mode.IDLE, t)
        elif self.sweeps:
            self.enter(Mode.SWEEP, t)
        else:
            self.enter(Mode.DAMP, t)

    def request(self, request: OperatorRequest) -> None:
        """Take a request; it is kept until it can be granted or another comes.

        None comes after that to quit: a robot that is to be left must not stand up again.
        """
        if not self.quitting:
            self._request = request

    def faulted(self, t: float) -> None:
        """Enter `FAULT`, because the filter damps; a fault ends a sweep."""
        if self.mode is Mode.FAULT or self.silent:
            return
        if self.sweeps:
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
        """Grant the request and return the desired command of one tick.

        Args:
            t: Time of the tick [s].
            position: Measured joint positions [rad], (joints,).
            safety: The filter, of which a fault may be released, or to which one may be added.
            action: Newest action of the policy, a record of `ACTIONS`.
            objection: Why the policy may not start; empty if it may.
        """
        self.grant(t, position, safety, objection)
        return self.desired(t, position, safety, action)

    def grant(self, t: float, position: Array, safety: SafetyFilter, objection: str = "") -> None:
        """Carry out the request as far as the mode allows; arguments as of `step`."""
        request = self._request
        mode = self.mode
        self.notice = ""
        if request in (OperatorRequest.DAMP, OperatorRequest.QUIT):
            if mode not in (*SILENT, Mode.FAULT, Mode.DAMP):
                self.enter(Mode.DAMP, t)
        elif request is OperatorRequest.SIT and mode is Mode.POLICY:
            self.enter(Mode.HALT, t)
        elif request is OperatorRequest.SIT and mode is Mode.STAND:
            self._sit(t, position)
        elif request in (OperatorRequest.STAND, OperatorRequest.RESET) and mode is Mode.FAULT:
            safety.release(t, acknowledged=request is OperatorRequest.RESET)
            if not safety.faulted:
                self.enter(Mode.DAMP, t)
            elif safety.level is FilterAction.LATCH and request is OperatorRequest.STAND:
                self.notice = "the fault is latched; request a reset once its cause is gone"
                self._request = OperatorRequest.NONE
        elif request is OperatorRequest.STAND and mode is Mode.DAMP:
            if t - self.since >= self.timing.damp_s:
                self._path = stand_up(
                    self.robot,
                    position,
                    t,
                    self.timing,
                    swing=self._swing_check.needed,
                    nods=self._nods,
                )
                self._swing_check.begin()
                if self._nod_check is not None:
                    self._nod_check.begin()
                self._request = OperatorRequest.NONE
                self.enter(Mode.STAND, t)
        elif request is OperatorRequest.WALK and mode is Mode.STAND and self._rise_is_over(t):
            self.notice = objection
            self._request = OperatorRequest.NONE
            if not objection:
                self._blending_since = None
                self.enter(Mode.POLICY, t)
                self._policy_mode_count = self.mode_count
        # A granted request is over; that to quit lasts, and that to stand until the robot does.
        if self.mode is not mode and request not in (OperatorRequest.QUIT, OperatorRequest.STAND):
            self._request = OperatorRequest.NONE

    def desired(
        self, t: float, position: Array, safety: SafetyFilter, action: Record | None
    ) -> DesiredCommand:
        """Return the desired command of the mode, but of a sweep; arguments as of `step`."""
        if self.mode is Mode.HALT and t - self.since >= self.timing.halt_s:
            self._sit(t, position)
        safety.on_feet = self.mode in POLICY_MODES
        path = self._path
        if path is None:
            return DesiredCommand()
        if self.mode in POLICY_MODES:
            return self._follow_policy(t, path.target(t), action, safety)
        if self.mode is Mode.STAND:
            if self._swing_check.needed:
                reason = self._swing_check.fault_found(t, path.began, position)
                if reason is not Reason.NONE:
                    safety.fault(reason, t)
                    return DesiredCommand()
            if self._nods and self._finds_contradiction(t, path, position, safety):
                safety.fault(Reason.ORIENTATION, t)
                return DesiredCommand()
            return self._pose(t, path.target(t), path.stiffness(t), path.standing_share(t))
        if self.mode is Mode.SIT:
            if not path.done(t):
                return self._pose(t, path.target(t), path.stiffness(t), path.standing_share(t))
            self.enter(Mode.DAMP, t)
        return DesiredCommand()

    def _finds_contradiction(
        self, t: float, path: PosePath, position: Array, safety: SafetyFilter
    ) -> bool:
        """Note a tick of the small motions; after them, whether sensors contradict them."""
        assert self._nod_check is not None
        nods_end = path.began + sum(path.seconds) - self.timing.rest_s
        if t < nods_end - len(self._nods) * self.timing.check_s:
            return False
        if t < nods_end:
            state = safety.sensors.newest if safety.limits.trunk_is_free else None
            self._nod_check.observe(t, path.target(t), position, state)
            return False
        self.notice = self._nod_check.contradiction()
        if not self.notice:
            self._nods = []
        return bool(self.notice)

    def follow_sweep(self, t: float, command: Command | None) -> DesiredCommand:
        """Return the desired command of a sweep; None as its command ends the run."""
        if command is not None:
            return DesiredCommand(command, stiffness=1.0)
        self._request = OperatorRequest.QUIT
        self.enter(Mode.DAMP, t)
        return DesiredCommand()

    def _rise_is_over(self, t: float) -> bool:
        """Whether the path to the default pose is over, and the small motions after it are judged.

        The measured pose is not compared with the path.
        """
        return self._path is not None and self._path.done(t) and not self._nods

    def _sit(self, t: float, position: Array) -> None:
        """Begin to sit down from the measured pose."""
        self._path = PosePath(
            began=t,
            poses=(position.copy(), folded_pose(self.robot)),
            seconds=(self.timing.sit_s,),
        )
        self.enter(Mode.SIT, t)

    def _pose(self, t: float, target: Array, share: float, standing_share: float) -> DesiredCommand:
        """Return the command of a pose.

        Args:
            t: Time of the tick [s].
            target: The pose [rad], (joints,).
            share: Share of the stiffness, 0 to 1.
            standing_share: Share of the gains of standing in the gains; the drives' are the rest.
        """
        command = Command(
            position=target,
            stiffness=share * mixed(self._stiffness, self._stand_stiffness, standing_share),
            damping=mixed(self._damping, self._stand_damping, standing_share),
            made=t,
            valid_for=VALID_S,
        )
        return DesiredCommand(command, stiffness=share)

    def _follow_policy(
        self, t: float, pose: Array, action: Record | None, safety: SafetyFilter
    ) -> DesiredCommand:
        """Return the policy's targets, blended in; the standing pose until the first of them.

        The gains go over to those of the policy with its targets.
        """
        if self._blending_since is None:
            # Halted before its first action, the policy may act for either mode.
            if action is None or action["mode_count"] < self._policy_mode_count:
                if t - self.since > FIRST_ACTION_S:
                    safety.fault(Reason.EXPIRED, t)
                    return DesiredCommand()
                return self._pose(t, pose, 1.0, 1.0)
            self._blending_since = t
        assert action is not None
        share = 1.0
        if self.timing.blend_s > 0.0:
            share = minimum_jerk((t - self._blending_since) / self.timing.blend_s)
        command = Command(
            position=pose + share * (action["position"] - pose),
            stiffness=mixed(self._stand_stiffness, self._policy_stiffness, share),
            damping=mixed(self._stand_damping, self._policy_damping, share),
            sequence=int(action["sequence"]),
            state_sequence=int(action["state_sequence"]),
            made=float(action["made"]),
            valid_for=float(action["valid_for"]),
        )
        return DesiredCommand(command, blend=share, stiffness=1.0)
