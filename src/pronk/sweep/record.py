"""Ask the machine what the plan says, and write down what it answers, as it answers.

Commands go out at the ticks of the policy on the machine's own clock; every state the machine
measures is logged with the command in force. Whatever goes wrong, the joints are left damped and
the log of what happened until then stays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pronk.errors import HardwareError
from pronk.hardware.machine import Command, Machine, State
from pronk.robots.robot import Robot
from pronk.sweep.log import Segment
from pronk.sweep.mcap_log import LogHeader, McapLogWriter
from pronk.sweep.plan import POSE_RAMP_S, Ask, SweepPlan

Array = NDArray[np.float64]

Progress = Callable[[float, str], None]
"""Called with the share that is done, 0 to 1, and what is being done."""

_SOFT_SPEED = 0.5
"""Fastest mean speed on the way to the pose [rad/s]."""
_AT_POSE = 0.15
"""Farthest a joint may rest from its command before it is clamped or asked [rad]: a leg that sags
so far under its own weight, or hangs on something, is not the one that was planned for."""
_PROGRESS_TICKS = 25
"""Ticks between two reports of progress."""


@dataclass(frozen=True)
class Limits:
    """What no measured state may exceed. All arrays of shape (joints,), robot's order."""

    names: tuple[str, ...]
    low: Array
    """[rad]"""
    high: Array
    """[rad]"""
    speed: Array
    """[rad/s]"""
    torque: Array
    """[N m]"""

    @classmethod
    def of(cls, robot: Robot) -> Limits:
        """The robot's own: ranges, no-load speeds, effort limits."""
        return cls(
            names=robot.joint_names,
            low=np.array([joint.range[0] for joint in robot.joints]),
            high=np.array([joint.range[1] for joint in robot.joints]),
            speed=np.array([joint.drive.no_load_speed for joint in robot.joints]),
            torque=np.array([joint.drive.effort_limit for joint in robot.joints]),
        )

    def check(self, state: State) -> None:
        """Stop at the first breach.

        Raises:
            HardwareError: Names the joint, the value and the limit.
        """
        q, v, tau = state.position, state.velocity, state.torque
        # NaN compares false, so ask for what is right rather than for what is wrong.
        fine = (
            (q >= self.low)
            & (q <= self.high)
            & (np.abs(v) <= self.speed)
            & (np.abs(tau) <= self.torque)
        )
        if fine.all():
            return
        i = int(np.argmin(fine))
        for value, low, high, unit in (
            (q[i], self.low[i], self.high[i], "rad"),
            (v[i], -self.speed[i], self.speed[i], "rad/s"),
            (tau[i], -self.torque[i], self.torque[i], "N m"),
        ):
            if not low <= value <= high:
                raise HardwareError(
                    f"{self.names[i]} is at {value:.3f} {unit} at t = {state.time:.3f} s, outside "
                    f"{low:.3f} to {high:.3f} {unit}; the joints were damped."
                )


class _Session:
    """Sends commands at ticks and logs the states in between."""

    def __init__(self, machine: Machine, robot: Robot, plan: SweepPlan) -> None:
        self.machine = machine
        self.plan = plan
        self.limits = Limits.of(robot)
        self.tick = 1.0 / plan.rate_hz
        self._start = machine.latest().time
        self._ticks = 0
        self.target = machine.latest().position.copy()
        self._sent: list[tuple[float, Array, float, int]] = []
        self._waiting: list[State] = []
        self._half = 0.0
        self._writer: McapLogWriter | None = None
        self._columns: NDArray[np.intp] = np.arange(len(robot.joints))

    @property
    def now(self) -> float:
        """The present tick on the machine's clock, counted so that rounding never adds up [s]."""
        return self._start + self._ticks * self.tick

    def log_to(self, writer: McapLogWriter, columns: Sequence[int]) -> None:
        """Log what follows."""
        self._writer = writer
        self._columns = np.array(columns, dtype=np.intp)
        self._waiting.clear()

    def hold(self, target: Array, frequency: float = np.nan, segment: int = -1) -> None:
        """One tick: put a command into force, wait, log."""
        self.target = target
        self.machine.send(
            Command(position=target, stiffness=self.plan.stiffness, damping=self.plan.damping)
        )
        self._sent = [*self._sent[-3:], (self.now, target[self._columns], frequency, segment)]
        self._ticks += 1
        states = self.machine.wait(self.now)
        if not states:
            raise HardwareError(
                f"{self.machine.robot} sent no state between {self.now - self.tick:.3f} and "
                f"{self.now:.3f} s; check the link and that the machine's program runs."
            )
        if len(states) > 1:
            self._half = 0.5 * (states[-1].time - states[0].time) / (len(states) - 1)
        self._waiting += states
        self._write(self.now)
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
            if state.time >= edge:
                continue
            _, command, frequency, segment = next(
                (s for s in reversed(self._sent) if s[0] - self._half <= state.time), self._sent[0]
            )
            self._writer.sample(
                state.time,
                command,
                state.position[self._columns],
                state.velocity[self._columns],
                state.torque[self._columns],
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

    def check_at_pose(self, goal: Array) -> None:
        """Refuse to go on from elsewhere.

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


def record(
    machine: Machine,
    robot: Robot,
    plan: SweepPlan,
    out_dir: Path,
    *,
    progress: Progress | None = None,
    prefix: str = "",
    joints: Sequence[str] | None = None,
    overwrite: bool = False,
) -> list[Path]:
    """Carry out a plan; one MCAP file per joint, `<prefix><joint>.mcap`.

    The plan is checked first. The link is opened here and closed again. For each joint: free all
    clamps, move softly to the pose, clamp what the question wants clamped, ask, rest. The joints
    that are not asked are held at the pose with the plan's gains, and all joints of the same leg
    are logged, so that the log can answer who else moved.

    Args:
        machine: The machine; not connected.
        robot: The robot.
        plan: What to ask.
        out_dir: Folder for the logs; made if it is missing.
        progress: Called about twice a second of machine time.
        prefix: Begins the name of every file.
        joints: Record only the questions to these joints of the plan, so that several processes
            can share a plan.
        overwrite: Replace logs that are already there.

    Returns:
        The files, in the order written.

    Raises:
        PlanError: The plan could exceed a limit.
        RobotError: A joint is unknown.
        HardwareError: A log is in the way, the machine does not answer, or a limit was breached.
            The joints are then damped, and the log up to that moment is whole and says why.
    """
    if machine.robot != robot.name or plan.robot.name != robot.name:
        raise HardwareError(
            f"the machine is {machine.robot!r}, the plan is for {plan.robot.name!r} and the robot "
            f"is {robot.name!r}; all three must be the same."
        )
    for name in joints or ():
        robot.joint(name)
    sets = [names for names in plan.sets if joints is None or set(names) & set(joints)]
    if not sets:
        raise HardwareError(
            f"the plan asks {', '.join(plan.joints)}, none of {', '.join(joints or ())}."
        )
    paths = [out_dir / f"{prefix}{_file_name(names)}.mcap" for names in sets]
    for path in paths:
        if path.exists() and not overwrite:
            raise HardwareError(
                f"{path} is already there; give another folder, remove it, or ask to overwrite it."
            )
    plan.check()
    total = sum(plan.ask_duration_s(ask) for ask in plan.asks if ask.joints in sets)
    done = 0.0
    machine.connect()
    try:
        session = _Session(machine, robot, plan)
        for names, path in zip(sets, paths, strict=True):
            asks = [ask for ask in plan.asks if ask.joints == names]
            done = _record_set(session, robot, path, asks, progress, done, total)
    finally:
        # Every way out, the interrupt key included, leaves the joints damped.
        machine.damp()
        machine.close()
    return paths


def _record_set(
    session: _Session,
    robot: Robot,
    path: Path,
    asks: Sequence[Ask],
    progress: Progress | None,
    done: float,
    total: float,
) -> float:
    """Ask everything that goes into one file; returns the seconds done."""
    plan, machine = session.plan, session.machine
    logged = logged_joints(robot, asks[0].joints)
    columns = [robot.joint_names.index(name) for name in logged]
    header = LogHeader(
        robot=robot.name,
        joints=logged,
        stiffness=plan.stiffness[columns].tolist(),
        damping=plan.damping[columns].tolist(),
        pose=plan.pose[columns].tolist(),
        units=("rad",) * len(logged),
        virtual=machine.virtual,
        metadata={"command_rate_hz": f"{plan.rate_hz:g}", "asked": ", ".join(asks[0].joints)},
    )
    with McapLogWriter(path, header) as writer:
        session.log_to(writer, columns)
        try:
            machine.clamp(())
            session.move_softly(plan.pose)
            session.rest(plan.settle_s)
            session.check_at_pose(plan.pose)
            machine.clamp(asks[0].clamped)
            session.rest(plan.settle_s)
            for ask in asks:
                _ask(session, writer, ask, progress, done, total)
                done += plan.ask_duration_s(ask)
            machine.clamp(())
        except BaseException:
            # Damp before the file is finished: the joints come first.
            machine.damp()
            raise
        finally:
            session.finish()
    if progress:
        progress(done / total, f"wrote {path.name}")
    return done


def _ask(
    session: _Session,
    writer: McapLogWriter,
    ask: Ask,
    progress: Progress | None,
    done: float,
    total: float,
) -> None:
    """One question and the rest after it."""
    plan = session.plan
    names = plan.robot.joint_names
    asked = [names.index(name) for name in ask.joints]
    offsets, frequency = ask.offsets(plan.rate_hz), ask.frequency(plan.rate_hz)
    first = ask.signals[0]
    bands = [signal.band_hz for signal in ask.signals]
    # A question begins one tick after the last one's rest, so that no sample is in both.
    session.hold(plan.pose)
    number = writer.segment(
        Segment(
            kind=first.kind,
            joints=ask.joints,
            start=session.now,
            stop=session.now + plan.ask_duration_s(ask) - session.tick / 2.0,
            amplitude=ask.amplitude,
            repeat=ask.repeat,
            band_hz=(min(low for low, _ in bands), max(high for _, high in bands)),
            period_s=first.period_s,
            clamped=ask.clamped,
        )
    )
    words = f"{', '.join(ask.joints)}: {ask.amplitude:g} rad, repeat {ask.repeat + 1}"
    for k, offset in enumerate(offsets):
        target = plan.pose.copy()
        target[asked] += offset
        session.hold(target, float(frequency[k]), number)
        if progress and k % _PROGRESS_TICKS == 0:
            progress(min((done + k * session.tick) / total, 1.0), words)
    for _ in range(round(plan.settle_s / session.tick)):
        session.hold(plan.pose, np.nan, number)


def logged_joints(robot: Robot, asked: Sequence[str]) -> tuple[str, ...]:
    """Joints that can move with the asked ones, or are clamped for them: their leg, file order."""
    wanted: set[str] = set()
    for name in asked:
        joint = robot.joint(name)
        wanted |= {name, *joint.chain, *joint.clamped}
    return tuple(name for name in robot.joint_names if name in wanted)


def _file_name(joints: Sequence[str]) -> str:
    return joints[0] if len(joints) == 1 else f"together_{joints[0]}_and_{len(joints) - 1}_more"
