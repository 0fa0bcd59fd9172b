"""Sweeps: excite each joint with its signals and log the response, under the safety filter.

Commands change at the policy's rate on the machine's own clock; every measured state is logged with
the command in force. `record` runs a sweep on a machine whose clock waits (the virtual robot in
this process), the servo on a machine in real time. In both, every command passes the safety filter,
and whatever happens, the joints are left damped and the log stays readable.
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
from pronk.deploy.runtime.ipc import TEXT, Record, SampleKind, Shared, sample_dtype
from pronk.deploy.runtime.safety import Limits, SafetyFilter
from pronk.deploy.runtime.state_machine import VALID_S
from pronk.errors import HardwareError
from pronk.identify.excitation.plan import POSE_RAMP_S, PlannedExcitation, SweepPlan
from pronk.identify.logs.mcap_log import LogHeader, McapLogWriter, reason_of
from pronk.identify.logs.segment import Segment
from pronk.names import file_name
from pronk.robots.machine import Command, Machine, State, TorqueKind

_SAG = 0.05
"""How much farther out than at first a joint may be on the way to its pose [rad]."""
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
    """A plan and where its logs go: one MCAP file for each excited joint."""

    plan: SweepPlan
    out_dir: Path
    joints: tuple[str, ...] | None = None
    """Record only these joints of the plan, so that several processes can share one."""
    overwrite: bool = False
    """Replace logs that exist."""
    metadata: Mapping[str, str] = field(default_factory=dict)
    """Added to the logs' own, for instance the link."""

    @property
    def excited(self) -> list[str]:
        """Joints, one log each."""
        return [name for name in self.plan.joints if self.joints is None or name in self.joints]

    @property
    def paths(self) -> list[Path]:
        """Of the logs."""
        return [self.out_dir / f"{file_name(name)}.mcap" for name in self.excited]

    def excitations(self, joint: str) -> list[PlannedExcitation]:
        """Excitations of one joint's log."""
        return [each for each in self.plan.excitations if each.joint == joint]

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

    def limits(self, torque_kind: TorqueKind, **changed: float) -> Limits:
        """Limits of the filter: ranges, no-load speeds and effort limits without tolerance.

        The plan's worst case keeps within them, so the filter changes no command of a valid plan;
        margin and horizon are zero. The trunk is fixed, so its tilt is not limited. A torque that
        is measured must keep within the effort limits too. `changed` gives other scalar values.
        """
        robot = self.plan.robot
        scalars = dict.fromkeys(("hold_s", "damp_s", "latch_s"), STALE_S) | {
            "tilt": np.inf,
            "margin": 1e-6,
            "overrun": 1e-9,
            "horizon_s": 1e-6,
            "stiffness": max(100.0, float(self.plan.stiffness.max())),
            "damping": max(5.0, float(self.plan.damping.max())),
            "measured_torque": 1.0 if torque_kind == "measured" else np.inf,
        }
        limits = Limits.of(robot, **(scalars | changed))
        return replace(limits, speed=np.array([j.drive.no_load_speed for j in robot.joints]))


class SweepLogs:
    """Writes the logs of a task from its records (`sample_dtype`)."""

    def __init__(self, task: SweepTask) -> None:
        self.task = task
        self._writer: McapLogWriter | None = None
        self._joint = ""
        self._columns: list[int] = []
        self._torque = True

    def drain(self, shared: Shared) -> None:
        """Write everything that waits; events are not logged."""
        for record in shared.samples.take():
            self.write(record)
        shared.events.take()

    def write(self, record: Record) -> None:
        """Write one record."""
        kind, time, number = int(record["kind"]), float(record["time"]), int(record["number"])
        writer, columns = self._writer, self._columns
        if kind == SampleKind.OPEN:
            self._open(number, bool(record["virtual"]), bytes(record["text"]).decode("ascii"))
        elif writer is None:
            return
        elif kind == SampleKind.SEGMENT:
            writer.segment(self._segment(number, time))
        elif kind == SampleKind.END:
            self.end(bytes(record["text"]).decode("ascii"))
        else:
            command, position, velocity = (
                record[name][columns] for name in ("command", "position", "velocity")
            )
            torque = record["torque"][columns] if self._torque else None
            frequency = float(record["frequency"])
            writer.sample(time, command, position, velocity, torque, frequency, number)

    def _open(self, index: int, virtual: bool, torque_kind: str) -> None:
        plan, self._joint = self.task.plan, self.task.excited[index]
        self._torque = torque_kind != "absent"
        # Joints that can move with the excited one or are clamped: its leg.
        joint = plan.robot.joint(self._joint)
        logged = {joint.name, *joint.chain, *joint.clamped}
        names = tuple(name for name in plan.robot.joint_names if name in logged)
        self._columns = columns = [plan.robot.joint_names.index(name) for name in names]
        rate = f"{plan.rate_hz:g}"
        header = LogHeader(
            robot=plan.robot.name,
            joints=names,
            stiffness=plan.stiffness[columns].tolist(),
            damping=plan.damping[columns].tolist(),
            pose=plan.pose[columns].tolist(),
            units=("rad",) * len(names),
            virtual=virtual,
            metadata={"command_rate_hz": rate, "excited": self._joint, "torque": torque_kind}
            | dict(self.task.metadata),
        )
        self._writer = McapLogWriter(self.task.paths[index], header)

    def _segment(self, number: int, start: float) -> Segment:
        """An excitation of the open log; `start` on the machine's clock [s]."""
        plan, excitation = self.task.plan, self.task.excitations(self._joint)[number]
        signal = excitation.signal
        return Segment(
            kind=signal.kind,
            joints=(excitation.joint,),
            start=start,
            stop=start + plan.seconds(excitation) - 1.0 / plan.rate_hz / 2.0,
            amplitude=signal.amplitude,
            repeat=excitation.repeat,
            band_hz=signal.band_hz,
            period_s=signal.period_s,
            clamped=excitation.clamped,
        )

    def end(self, reason: str) -> None:
        """End the log, complete if there is no reason; ending twice has no effect."""
        if self._writer is not None:
            self._writer.end(complete=not reason, reason=reason)
            self._writer = None

    def flush(self) -> None:
        """Hand what was written to the operating system."""
        if self._writer is not None:
            self._writer.flush()


class SweepStep(NamedTuple):
    """The command of one tick."""

    target: Array
    """[rad] (joints,)"""
    stiffness: float = 1.0
    """Share of the plan's stiffness."""
    frequency: float = math.nan
    """Instantaneous, of the signal [Hz]."""
    segment: int = -1
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
        safety: SafetyFilter,
        sink: Callable[[Record], object],
        *,
        state: State,
        start: float,
        real_time: bool,
        progress: Callable[[float], None] = lambda share: None,
        written: Callable[[str], None] = lambda name: None,
    ) -> None:
        """Begin on a connected machine at `start` on its clock [s], from a measured `state`.

        Until the joints are at the pose, the limits of `safety` are widened to where they are at
        first. In `real_time` the joints are stiffened first, and held while the operator clamps
        others. `sink` takes records of `sample_dtype`, `progress` the share done, 0 to 1, and
        `written` the name of each complete log.
        """
        self.task, self.plan, self.machine, self.safety = task, task.plan, machine, safety
        self._sink, self._progress, self._written = sink, progress, written
        self._real_time, self._state, self._start = real_time, state, start
        self._tick, self._ticks, self._pose = 1.0 / self.plan.rate_hz, 0, self.plan.pose
        self._strict = safety.limits
        q, low, high = state.position, self._strict.low, self._strict.high
        safety.limits = replace(
            self._strict,
            low=np.where(q < low, q - _SAG, low),
            high=np.where(q > high, q + _SAG, high),
        )
        self._dtype = sample_dtype(len(q))
        self._step = SweepStep(q.copy(), stiffness=0.0 if real_time else 1.0)
        self._steps = self._sequence()
        self._logging = False
        self._sent: deque[tuple[float, Array, float, int]] = deque(maxlen=16)
        self._waiting: list[State] = []
        self._recent: list[State] = []
        self._half = 0.0
        """Half the spacing of the states [s]."""

    @property
    def now(self) -> float:
        """The next tick on the machine's clock, counted so that rounding never adds up [s]."""
        return self._start + self._ticks * self._tick

    def command(self, t: float, states: Sequence[State], slack: float = 0.0) -> Command | None:
        """The command at `t` [s], a new one once the next tick is due; None once all are over.

        `states` were measured since the last call, oldest first.

        Raises:
            HardwareError: A joint is far from its pose or could not be clamped.
        """
        self._waiting += states
        self._recent += states
        if states:
            self._state = states[-1]
        if t >= self.now - slack:
            if len(self._recent) > 1:
                first, last = self._recent[0].time, self._recent[-1].time
                self._half = 0.5 * (last - first) / (len(self._recent) - 1)
            self._recent.clear()
            self._log(t)
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
        """Note what the filter let through at `t` [s]."""
        entry = (t, position, self._step.frequency, self._step.segment)
        last = self._sent[-1] if self._sent else None
        if last is None or last[2:] != entry[2:] or not np.array_equal(last[1], position):
            self._sent.append(entry)

    def end(self, reason: str) -> None:
        """Log what is waiting and end an open log; `reason` is empty if the log is complete."""
        if self._logging:
            self._log(np.inf)
            self._put(SampleKind.END, text=reason)
        self._logging = False

    def _put(self, kind: SampleKind, *, number: int = 0, time: float = 0.0, text: str = "") -> None:
        record = np.zeros(1, dtype=self._dtype)
        record["virtual"] = self.machine.virtual
        record["kind"], record["number"], record["time"] = kind, number, time
        record["text"] = text.encode("ascii", "replace")[:TEXT]
        self._sink(record[0])

    def _log(self, until: float) -> None:
        """Log the waiting states whose command is known: those before the next tick.

        A state measured at a tick carries the command that goes out at that tick. Its timestamp
        jitters about the tick, so states less than half their own spacing before it count as at it:
        the command is logged at the nearest state, not at the next.
        """
        edge, waiting = until - self._half, self._waiting if self._logging else []
        states = [state for state in waiting if state.time < edge]
        self._waiting = [state for state in waiting if state.time >= edge]
        if not states:
            return
        records = np.zeros(len(states), dtype=self._dtype)
        for name in ("time", "position", "velocity", "torque"):
            records[name] = [getattr(state, name) for state in states]
        # A number that is not finite ends the sweep, and would make the log unreadable.
        fine = np.isfinite(records["position"]) & np.isfinite(records["velocity"])
        for record, loggable in zip(records, fine.all(axis=1), strict=True):
            _, record["command"], record["frequency"], record["number"] = next(
                (s for s in reversed(self._sent) if s[0] - self._half <= record["time"]),
                self._sent[0],
            )
            if loggable:
                self._sink(record)

    # --- the sequence -----------------------------------------------------------------------------

    def _sequence(self) -> Iterator[SweepStep]:
        ticks = round(_STIFFEN_S / self._tick) if self._real_time else 0
        for k in range(1, ticks + 1):
            yield SweepStep(self._step.target, stiffness=k / ticks)
        task, plan = self.task, self.plan
        all_excitations = [each for name in task.excited for each in task.excitations(name)]
        whole, done = sum(plan.seconds(each) for each in all_excitations), 0.0
        for index, (joint, path) in enumerate(zip(task.excited, task.paths, strict=True)):
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
                        self._progress(min((done + k * self._tick) / whole, 1.0))
                    yield step
                done += plan.seconds(excitation)
            yield from self._clamp(())
            self.end("")
            self._progress(done / whole)
            self._written(path.name)

    def _rest(self, segment: int = -1) -> Iterator[SweepStep]:
        for _ in range(round(self.plan.settle_s / self._tick)):
            yield SweepStep(self._pose, segment=segment)

    def _move(self, goal: Array) -> Iterator[SweepStep]:
        """Half a cosine from the present target to the goal."""
        start = self._step.target
        seconds = max(POSE_RAMP_S, float(np.abs(goal - start).max()) / _SOFT_SPEED)
        ticks = round(seconds / self._tick)
        for k in range(1, ticks + 1):
            yield SweepStep(start + (goal - start) * (0.5 * (1.0 - np.cos(np.pi * k / ticks))))

    def _clamp(self, joints: tuple[str, ...]) -> Iterator[SweepStep]:
        """Clamp joints; in real time they are held meanwhile."""
        if not self._real_time:
            self.machine.clamp(joints)
            return
        failed: list[BaseException] = []

        def clamp() -> None:
            try:
                self.machine.clamp(joints)
            except BaseException as error:
                failed.append(error)

        thread = threading.Thread(target=clamp, name="pronk sweep clamps", daemon=True)
        thread.start()
        while thread.is_alive():
            yield SweepStep(self._step.target)
        if failed:
            raise failed[0]

    def _check_at_pose(self) -> None:
        """Refuse to go on from another pose; from here on the strict limits hold."""
        away = np.abs(self._state.position - self._pose)
        i = int(np.argmax(away))
        if not away[i] <= _AT_POSE:
            raise HardwareError(
                f"{self._strict.joints[i]} rests {away[i]:.3f} rad from its pose, expected at most "
                f"{_AT_POSE:g} rad; free the joint, check its drive, or raise the gains."
            )
        self.safety.limits = self._strict

    def _excite(self, number: int, excitation: PlannedExcitation) -> Iterator[SweepStep]:
        """One excitation and the rest after it."""
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


def record(
    machine: Machine, task: SweepTask, progress: Callable[[float], None] = lambda share: None
) -> list[Path]:
    """Carry out a sweep on a machine whose clock waits; the link is opened here and closed again.

    `progress` is called about twice a second of machine time. Returns the logs, in order.

    Raises:
        PronkError: As of `SweepTask.check`; or no states come, or the filter stopped the sweep. The
            joints are then damped, and the log up to then is readable and has the reason.
    """
    if machine.robot != task.plan.robot.name:
        raise HardwareError(
            f"the machine is {machine.robot!r} and the plan is for {task.plan.robot.name!r}; both "
            "must be the same."
        )
    task.check()
    machine.connect()
    try:
        states = [machine.latest()]
        safety = SafetyFilter(
            limits=task.limits(machine.torque_kind), state_rate_hz=machine.state_rate_hz
        )
        controller = SweepController(
            task,
            machine,
            safety,
            SweepLogs(task).write,
            state=states[0],
            start=states[0].time,
            real_time=False,
            progress=progress,
        )
        try:
            while True:
                t = machine.now()
                command = controller.command(t, states, slack=np.inf)
                if command is None:
                    break
                sent, decision = safety.judge(states, command, t)
                if sent is None:
                    raise HardwareError(f"{decision.text}; the joints were damped.")
                machine.send(sent)
                controller.sent(t, sent.position)
                states = machine.wait(controller.now)
                if not states:
                    raise HardwareError(
                        f"{machine.robot} sent no state between {t:.3f} and {controller.now:.3f} "
                        "s; check the link and that the machine's program runs."
                    )
        except BaseException as error:
            # Damp before the file is finished: the joints come first.
            machine.damp()
            controller.end(reason_of(error))
            raise
    finally:
        # In every case, the interrupt key included, the joints are damped.
        machine.damp()
        machine.close()
    return task.paths
