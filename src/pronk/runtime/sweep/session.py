"""One recording: commands at the ticks of the policy, states in between, and their log."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pronk.errors import HardwareError
from pronk.excitation.plan import POSE_RAMP_S, SweepPlan
from pronk.links.machine import Command, Machine, State
from pronk.robots.robot import Robot
from pronk.runtime.sweep.limits import Limits
from pronk.runtime.sweep.log_subprocess import Log
from pronk.runtime.sweep.servo import Servo

Array = NDArray[np.float64]

_SOFT_SPEED = 0.5
"""Fastest mean speed on the way to the pose [rad/s]."""
_AT_POSE = 0.15
"""Farthest a joint may rest from its command before it is clamped or asked [rad]: a leg that sags
so far under its own weight, or hangs on something, is not the one that was planned for."""
_STIFFEN_S = 1.0
"""Time in which a machine in real time takes hold of its joints [s]."""


class Session:
    """Sends commands at ticks and logs the states in between."""

    def __init__(
        self, machine: Machine, robot: Robot, plan: SweepPlan, servo: Servo | None = None
    ) -> None:
        """Begin on a machine that is connected.

        Args:
            machine: The machine.
            robot: Names and limits of its joints.
            plan: Rates, gains and pose.
            servo: For a machine in real time; None for one whose clock waits for whoever asks.
        """
        self.machine = machine
        self.plan = plan
        self.tick = 1.0 / plan.rate_hz
        self.target = machine.latest().position.copy()
        self._strict = Limits.of(robot, machine.torque_kind)
        self.limits = self._strict.from_where_it_lies(self.target)
        self._torque_absent = machine.torque_kind == "absent"
        self._servo = servo
        self._stiffness = 1.0 if servo is None else 0.0
        self._start = machine.latest().time if servo is None else machine.now()
        self._ticks = 0
        self._sent: list[tuple[float, Array, float, int]] = []
        self._waiting: list[State] = []
        self._half = 0.0
        self._writer: Log | None = None
        self._columns: NDArray[np.intp] = np.arange(len(robot.joints))

    @property
    def now(self) -> float:
        """The present tick on the machine's clock, counted so that rounding never adds up [s]."""
        return self._start + self._ticks * self.tick

    def log_to(self, writer: Log, columns: Sequence[int]) -> None:
        """Log what follows."""
        self._writer = writer
        self._columns = np.array(columns, dtype=np.intp)
        self._waiting.clear()

    def hold(self, target: Array, frequency: float = np.nan, segment: int = -1) -> None:
        """One tick: put a command into force, wait, log."""
        self.target = target
        command = Command(
            position=target,
            stiffness=self.plan.stiffness * self._stiffness,
            damping=self.plan.damping,
        )
        begun = self.now
        sent = (self.machine.now(), target, frequency, segment)
        self._sent = [*self._sent[-3:], sent]
        self._ticks += 1
        known = len(self._waiting)
        if self._servo is not None:
            self._servo.hold(
                *(self.machine, command, self.limits, self._waiting), start=begun, end=self.now
            )
        else:
            self._wait_for(command, begun)
        states = self._waiting[known:]
        if len(states) > 1:
            self._half = 0.5 * (states[-1].time - states[0].time) / (len(states) - 1)
        self._write(self.machine.now())

    def _wait_for(self, command: Command, begun: float) -> None:
        """One tick on a machine whose clock waits."""
        self.machine.send(command)
        states = self.machine.wait(self.now)
        if not states:
            raise HardwareError(
                f"{self.machine.robot} sent no state between {begun:.3f} and {self.now:.3f} s; "
                "check the link and that the machine's program runs."
            )
        self._waiting += states
        for state in states:
            self.limits.check(state)

    def _write(self, until: float) -> None:
        """Log the waiting states whose command is known: those before the next tick.

        A state that the machine measured at a tick carries the command that goes out at that
        tick. Its timestamp jitters about the tick, so states less than half their own spacing
        before it count as at it: the command is logged at the nearest state, not at the next.
        """
        if self._writer is None:
            self._waiting.clear()
            return
        edge = until - self._half
        for state in self._waiting:
            # What is not a number has ended the sweep already, and no log could be read with it.
            if state.time >= edge or not np.isfinite([state.position, state.velocity]).all():
                continue
            _, command, frequency, segment = next(
                (s for s in reversed(self._sent) if s[0] - self._half <= state.time), self._sent[0]
            )
            self._writer.sample(
                state.time,
                command[self._columns],
                state.position[self._columns],
                state.velocity[self._columns],
                None if self._torque_absent else state.torque[self._columns],
                frequency,
                segment,
            )
        self._waiting = [state for state in self._waiting if state.time >= edge]

    def finish(self) -> None:
        """Log what is still waiting."""
        if self._sent:
            self._write(np.inf)

    def rest(self, seconds: float) -> None:
        """Hold the last command."""
        for _ in range(round(seconds / self.tick)):
            self.hold(self.target)

    def move_softly(self, goal: Array) -> None:
        """Half a cosine from where the joints are commanded to be to the goal."""
        start = self.target
        seconds = max(POSE_RAMP_S, float(np.abs(goal - start).max()) / _SOFT_SPEED)
        ticks = round(seconds / self.tick)
        for k in range(1, ticks + 1):
            self.hold(start + (goal - start) * 0.5 * (1.0 - np.cos(np.pi * k / ticks)))

    def take_hold(self) -> None:
        """Stiffen joints that are free, where they are. Only in real time: others begin held."""
        ticks = round(_STIFFEN_S / self.tick)
        for k in range(1, ticks + 1 if self._stiffness < 1.0 else 1):
            self._stiffness = k / ticks
            self.hold(self.target)

    def clamp(self, joints: tuple[str, ...]) -> None:
        """Have joints fixed mechanically; in real time they are held while a person does it.

        Raises:
            HardwareError: The machine cannot, or a state breached a limit meanwhile.
        """
        if self._servo is None:
            self.machine.clamp(joints)
            return
        failed: list[BaseException] = []

        def ask() -> None:
            try:
                self.machine.clamp(joints)
            except BaseException as error:
                failed.append(error)

        asking = threading.Thread(target=ask, name="pronk sweep clamps", daemon=True)
        asking.start()
        while asking.is_alive():
            self.hold(self.target)
        if failed:
            raise failed[0]

    def check_at_pose(self, goal: Array) -> None:
        """Refuse to go on from elsewhere; from here on the joints stay within their ranges.

        Raises:
            HardwareError: A joint rests far from its command.
        """
        away = np.abs(self.machine.latest().position - goal)
        i = int(np.argmax(away))
        if not away[i] <= _AT_POSE:
            raise HardwareError(
                f"{self.limits.names[i]} rests {away[i]:.3f} rad from its pose, expected at most "
                f"{_AT_POSE:g} rad; free the joint, check its drive, or raise the gains."
            )
        self.limits = self._strict
