"""Sweeps: excite each joint with its signals and log the response, under the safety filter.

Commands change at the policy's rate on the machine's own clock; every measured state is logged with
the command in force. `record_sweep` (`pronk.deploy.runtime.sweep_recorder`) runs a sweep on a
machine whose clock waits (the virtual robot in this process), the servo on a machine in real time.
In both, every command passes the safety filter, and whatever happens, the joints are left damped
and the log stays readable.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from pronk.arrays import Array
from pronk.deploy.runtime.limits import AgeLimits, Limits
from pronk.deploy.runtime.records import TEXT_SIZE, Record, SampleKind, sample_dtype
from pronk.deploy.runtime.state_machine import VALID_S
from pronk.errors import HardwareError
from pronk.identify.excitation.plan import POSE_RAMP_S, PlannedExcitation, SweepPlan
from pronk.names import file_name
from pronk.robots.machine import Command, Machine, State, TorqueKind

_SAG = 0.05
"""Distance beyond its first position that a joint may have on the way to its pose [rad]."""
_SOFT_SPEED = 0.5
"""Fastest mean speed on the way to the pose [rad/s]."""
_AT_POSE = 0.15
"""Farthest that a joint may rest from its command before it is clamped or excited [rad]; the plan
does not hold for a leg that sags farther or is blocked."""
_STIFFEN_S = 1.0
"""Time in which stiffness grows on a machine in real time [s]."""
_PROGRESS_TICKS = 25
"""Ticks between two reports of progress."""
STALE_S = 0.1
"""Age of the newest state that ends a sweep [s]."""


@dataclass(frozen=True, kw_only=True)
class SweepTask:
    """A plan and the place of its logs: one MCAP file for each excited joint."""

    plan: SweepPlan
    """Excitations of the sweep."""
    out_dir: Path
    """Folder of the logs."""
    joints: tuple[str, ...] | None = None
    """Joints of the plan to record, so that several processes can share one; None for all."""
    overwrite: bool = False
    """Whether logs that exist are replaced."""
    metadata: Mapping[str, str] = field(default_factory=dict)
    """Entries added to the logs' own, for instance the link."""

    @property
    def excited(self) -> list[str]:
        """Excited joints, one log each."""
        if self.joints is None:
            return list(self.plan.joints)
        return [name for name in self.plan.joints if name in self.joints]

    @property
    def paths(self) -> list[Path]:
        """Paths of the logs."""
        return [self.out_dir / f"{file_name(name)}.mcap" for name in self.excited]

    def excitations(self, joint: str) -> list[PlannedExcitation]:
        """Return the excitations of one joint's log."""
        return [excitation for excitation in self.plan.excitations if excitation.joint == joint]

    def check(self) -> None:
        """Refuse a task that cannot be carried out, before anything moves.

        Raises:
            PronkError: The plan could exceed a limit, a joint is unknown or not excited, or a log
                exists.
        """
        for name in self.joints or ():
            self.plan.robot.joint(name)
        if not self.excited:
            raise HardwareError(
                f"the plan excites {', '.join(self.plan.joints)}, none of "
                f"{', '.join(self.joints or ())}."
            )
        for path in self.paths:
            if path.exists() and not self.overwrite:
                raise HardwareError(
                    f"{path} exists; give another folder, remove it, or overwrite it."
                )
        self.plan.check()

    def limits(self, torque_kind: TorqueKind) -> Limits:
        """Return the limits of the filter: ranges, speeds and efforts without tolerance.

        The plan's worst case keeps within the ranges, the no-load speeds and the effort limits, so
        the filter changes no command of a valid plan; margin and horizon are zero. The trunk is
        fixed, so its tilt is not limited. A torque that is measured must keep within the effort
        limits too.
        """
        limits = Limits.of(self.plan.robot)
        measured_torque = np.full_like(limits.joints.torque, np.inf)
        if torque_kind == "measured":
            measured_torque = limits.joints.torque
        operating = limits.operating
        return replace(
            limits,
            joints=replace(
                limits.joints, speed=limits.joints.no_load, measured_torque=measured_torque
            ),
            operating=replace(
                operating,
                tilt=math.inf,
                margin=1e-6,
                target_reach=0.0,
                overrun=1e-9,
                horizon_s=1e-6,
                stiffness=max(operating.stiffness, float(self.plan.stiffness.max())),
                damping=max(operating.damping, float(self.plan.damping.max())),
            ),
            ages=AgeLimits(hold_s=STALE_S, damp_s=STALE_S, latch_s=STALE_S),
        )


class SweepStep(NamedTuple):
    """The command of one tick."""

    target: Array
    """Joint targets [rad], (joints,)."""
    stiffness: float = 1.0
    """Share of the plan's stiffness."""
    frequency: float = math.nan
    """Instantaneous frequency of the signal [Hz]."""
    segment: int = -1
    """Number of the excitation in its log; -1 between."""


class SentTarget(NamedTuple):
    """A target that the filter let through."""

    time: float
    """Time on the machine's clock [s]."""
    target: Array
    """Joint targets [rad], (joints,)."""
    frequency: float
    """Instantaneous frequency of the signal [Hz]."""
    segment: int
    """Number of the excitation in its log; -1 between."""


class SweepController:
    """The commands of a sweep, tick by tick, and the log of the response.

    For each joint: free all clamps, move softly to the pose, clamp what the excitation needs,
    excite, rest. The other joints are held at the pose with the plan's gains, and all joints of the
    same leg are logged.
    """

    def __init__(
        self,
        task: SweepTask,
        machine: Machine,
        limits: Limits,
        sink: Callable[[Record], object],
        *,
        state: State,
        start: float,
        real_time: bool,
    ) -> None:
        """Begin on a connected machine.

        Args:
            task: What is excited, and where the logs are.
            machine: The machine.
            limits: Limits of the sweep.
            sink: Takes the records of the logs (`sample_dtype`).
            state: A measured state.
            start: Time of the first tick on the clock of the states [s].
            real_time: Whether the machine's clock does not wait: the joints are stiffened first,
                and held while the operator clamps others.
        """
        self.task = task
        self.plan = task.plan
        self.machine = machine
        self.limits = _widened(limits, state.position, Limits.of(task.plan.robot).joints.speed)
        """Limits that apply at this tick: widened to where the joints are at first until they are
        at the pose."""
        self.progress = 0.0
        """Share of the sweep that is done, 0 to 1."""
        self.complete: list[Path] = []
        """Logs that were written to their end."""
        self._strict_limits = limits
        self._sink = sink
        self._real_time = real_time
        self._state = state
        self._start = start
        self._tick = 1.0 / self.plan.rate_hz
        self._ticks = 0
        self._pose = self.plan.pose
        self._dtype = sample_dtype(len(state.position))
        self._step = SweepStep(state.position.copy(), stiffness=0.0 if real_time else 1.0)
        self._steps = self._sequence()
        self._logging = False
        self._sent: deque[SentTarget] = deque(maxlen=16)
        self._waiting: list[State] = []
        """States whose command is not known yet."""
        self._recent: list[State] = []
        """States since the last tick."""
        self._half_spacing = 0.0
        """Half the time between two states [s]."""

    @property
    def now(self) -> float:
        """The next tick on the clock of the states, counted so that rounding never adds up [s]."""
        return self._start + self._ticks * self._tick

    def command(self, t: float, states: Sequence[State], slack: float = 0.0) -> Command | None:
        """Return the command at a time, a new one once the next tick is due.

        Args:
            t: Time on the clock of the states [s].
            states: States measured since the last call, oldest first.
            slack: How long before it is due a tick may begin [s].

        Returns:
            The command; None once all excitations are over.

        Raises:
            HardwareError: A joint is far from its pose or could not be clamped.
        """
        self._waiting += states
        self._recent += states
        if states:
            self._state = states[-1]
        if t >= self.now - slack:
            if len(self._recent) > 1:
                seconds = self._recent[-1].time - self._recent[0].time
                self._half_spacing = 0.5 * seconds / (len(self._recent) - 1)
            self._recent.clear()
            self._log(t)
            # After a pause the rest of the sweep comes later, by whole ticks: commands that make up
            # for the pause would be faster than the worst case of the plan, and show no clock.
            missed_ticks = math.floor((t - self.now) / self._tick + 0.5)
            self._start += max(missed_ticks, 0) * self._tick
            step = next(self._steps, None)
            if step is None:
                return None
            self._step = step
            self._ticks += 1
        return Command(
            position=self._step.target,
            stiffness=self.plan.stiffness * self._step.stiffness,
            damping=self.plan.damping,
            made=t,
            valid_for=VALID_S,
        )

    def sent(self, t: float, position: Array) -> None:
        """Note the target that the filter let through at a time [s]."""
        step = self._step
        if self._sent:
            newest = self._sent[-1]
            same_frequency = newest.frequency == step.frequency
            if math.isnan(newest.frequency) and math.isnan(step.frequency):
                same_frequency = True
            same_segment = newest.segment == step.segment
            if same_frequency and same_segment and np.array_equal(newest.target, position):
                return
        self._sent.append(SentTarget(t, position, step.frequency, step.segment))

    def end(self, reason: str) -> None:
        """Log what is waiting and end an open log; `reason` is empty if the log is complete."""
        if self._logging:
            self._log(np.inf)
            self._put(SampleKind.END, text=reason)
        self._logging = False

    def _put(
        self, sample_kind: SampleKind, *, number: int = 0, time: float = 0.0, text: str = ""
    ) -> None:
        """Put a record that is not a sample."""
        record = np.zeros(1, dtype=self._dtype)
        record["virtual"] = self.machine.virtual
        record["kind"] = sample_kind
        record["number"] = number
        record["time"] = time
        record["text"] = text.encode("ascii", "replace")[:TEXT_SIZE]
        self._sink(record[0])

    def _log(self, until: float) -> None:
        """Log the waiting states whose command is known: those before the next tick.

        A state measured at a tick carries the command that goes out at that tick. Its timestamp
        jitters about the tick, so states less than half their own spacing before it count as at it:
        the command is logged at the nearest state, not at the next.
        """
        edge = until - self._half_spacing
        waiting = self._waiting if self._logging else []
        states = [state for state in waiting if state.time < edge]
        self._waiting = [state for state in waiting if state.time >= edge]
        if not states:
            return
        records = np.zeros(len(states), dtype=self._dtype)
        records["time"] = [state.time for state in states]
        records["position"] = [state.position for state in states]
        records["velocity"] = [state.velocity for state in states]
        records["torque"] = [state.torque for state in states]
        # A number that is not finite ends the sweep, and would make the log unreadable.
        is_finite = np.isfinite(records["position"]) & np.isfinite(records["velocity"])
        for record, loggable in zip(records, is_finite.all(axis=1), strict=True):
            command = self._command_at(float(record["time"]))
            record["command"] = command.target
            record["frequency"] = command.frequency
            record["number"] = command.segment
            if loggable:
                self._sink(record)

    def _command_at(self, t: float) -> SentTarget:
        """Return the newest command that was sent before a time [s], else the oldest."""
        for command in reversed(self._sent):
            if command.time - self._half_spacing <= t:
                return command
        return self._sent[0]

    # --- the sequence -----------------------------------------------------------------------------

    def _sequence(self) -> Iterator[SweepStep]:
        """Yield the steps of the whole sweep."""
        ticks = round(_STIFFEN_S / self._tick) if self._real_time else 0
        for k in range(1, ticks + 1):
            yield SweepStep(self._step.target, stiffness=k / ticks)
        task = self.task
        plan = self.plan
        all_seconds = 0.0
        for joint in task.excited:
            for excitation in task.excitations(joint):
                all_seconds += plan.seconds(excitation)
        done_s = 0.0
        for index, joint in enumerate(task.excited):
            excitations = task.excitations(joint)
            self._waiting.clear()
            self._put(SampleKind.OPEN, number=index, text=self.machine.torque_kind)
            self._logging = True
            yield from self._clamp(())
            yield from self._move(self._pose)
            yield from self._rest()
            self._check_at_pose()
            yield from self._clamp(excitations[0].clamped)
            yield from self._rest()
            for number, excitation in enumerate(excitations):
                for k, step in enumerate(self._excite(number, excitation)):
                    if k % _PROGRESS_TICKS == 0:
                        self.progress = min((done_s + k * self._tick) / all_seconds, 1.0)
                    yield step
                done_s += plan.seconds(excitation)
            yield from self._clamp(())
            self.end("")
            self.progress = done_s / all_seconds
            self.complete.append(task.paths[index])

    def _rest(self, segment: int = -1) -> Iterator[SweepStep]:
        """Yield the steps of a rest at the pose."""
        for _ in range(round(self.plan.settle_s / self._tick)):
            yield SweepStep(self._pose, segment=segment)

    def _move(self, goal: Array) -> Iterator[SweepStep]:
        """Yield half a cosine from the present target to the goal."""
        start = self._step.target
        seconds = max(POSE_RAMP_S, float(np.abs(goal - start).max()) / _SOFT_SPEED)
        ticks = round(seconds / self._tick)
        for k in range(1, ticks + 1):
            yield SweepStep(start + (goal - start) * (0.5 * (1.0 - np.cos(np.pi * k / ticks))))

    def _clamp(self, joints: tuple[str, ...]) -> Iterator[SweepStep]:
        """Clamp joints; in real time yield steps that hold them meanwhile."""
        if not self._real_time:
            self.machine.clamp(joints)
            return
        failures: list[BaseException] = []

        def clamp() -> None:
            try:
                self.machine.clamp(joints)
            except BaseException as error:
                failures.append(error)

        thread = threading.Thread(target=clamp, name="pronk sweep clamps", daemon=True)
        thread.start()
        while thread.is_alive():
            yield SweepStep(self._step.target)
        if failures:
            raise failures[0]

    def _check_at_pose(self) -> None:
        """Refuse to go on from another pose; from here on the strict limits hold."""
        distance = np.abs(self._state.position - self._pose)
        i = int(np.argmax(distance))
        if not distance[i] <= _AT_POSE:
            raise HardwareError(
                f"{self._strict_limits.joints.names[i]} rests {distance[i]:.3f} rad from its pose, "
                f"expected at most {_AT_POSE:g} rad; free the joint, check its drive, or raise the "
                "gains."
            )
        self.limits = self._strict_limits

    def _excite(self, number: int, excitation: PlannedExcitation) -> Iterator[SweepStep]:
        """Yield the steps of one excitation and of the rest after it."""
        rate = self.plan.rate_hz
        column = self.plan.robot.joint_names.index(excitation.joint)
        frequency = excitation.signal.frequency(rate)
        # An excitation begins one tick after the last one's rest, so that no sample is in both.
        yield SweepStep(self._pose)
        self._put(SampleKind.SEGMENT, number=number, time=self.now)
        for k, offset in enumerate(excitation.offsets(rate)):
            target = self._pose.copy()
            target[column] += offset
            yield SweepStep(target, frequency=float(frequency[k]), segment=number)
        yield from self._rest(segment=number)


def _widened(limits: Limits, position: Array, speed: Array) -> Limits:
    """Return limits for the way to the pose.

    A joint that hangs below its command starts with a step when it is told to stay where it is,
    which the worst case of the plan does not have.

    Args:
        limits: Limits of the excitations.
        position: Measured joint positions, which the ranges hold, and a little more [rad].
        speed: Largest measured speed of the robot at all times [rad/s], (joints,).
    """
    low = limits.joints.low
    high = limits.joints.high
    joints = replace(
        limits.joints,
        low=np.where(position < low, position - _SAG, low),
        high=np.where(position > high, position + _SAG, high),
        speed=speed,
    )
    return replace(limits, joints=joints)
