"""The virtual robot as a machine of its own: real time, a wire, and its faults.

The drives' PD runs inside physics at 4 kHz.
"""

from __future__ import annotations

import gc
import math
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Literal

from msgspec import Meta

from pronk.deploy.bench.faults import CLOCKS, FaultChannel, Faults, flip_bit, spoiled
from pronk.deploy.links.realtime import Histogram, sleep_until
from pronk.errors import HardwareError
from pronk.jump.virtual.bounds import Bounded
from pronk.robots.machine import Command, Machine, RefusedError, State, damping_command
from pronk.robots.robot import RobotSpec

Corrupt = Callable[[bytes], bytes]

TICK_S = 0.5e-3
"""Period of polling the wire: commands act on the machine at a multiple of this [s]."""
_CONTEND_S = 0.01
"""Time between two commands of the rival, and of the robot's own controller [s]."""
_SLIP_S = 0.1
"""Lateness beyond which the machine's clock is put back instead of catching up [s]."""
_BROKEN_FIELDS = ("position", "velocity", "gyro", "accelerometer", "orientation")


class ServerTransport(ABC):
    """The robot's end of a link. Everything is non-blocking and called from one thread.

    Whatever arrives, `poll` never raises: a message that is not a possible command is refused and
    counted under its reason.
    """

    def __init__(self, robot: RobotSpec, mode: str, modes: Sequence[str]) -> None:
        """Begin with a mode of the robot's own controller, one of `modes`."""
        if mode not in modes:
            names = ", ".join(name for name in modes if name)
            raise HardwareError(f"mode {mode!r}; expected one of {names}, or none for released.")
        self.counts: Counter[str] = Counter()
        """`commands`, `states`, and one `refused: REASON` for each reason to refuse."""
        self.mode = mode
        """Name of the robot's own controller that holds the drives; "" when released."""
        self.clamps: tuple[str, ...] = ()
        """Joints to hold mechanically, requested over the wire."""
        self.corrupt_in: Corrupt = bytes
        """Applied to the bytes of commands before any check."""
        self.corrupt_out: Corrupt = bytes
        """Applied to the bytes of states with their checksum."""
        self._joint_names = robot.joint_names

    @abstractmethod
    def poll(self) -> list[Command]:
        """Commands that arrived since the last poll, oldest first."""

    @abstractmethod
    def publish(self, state: State) -> None:
        """Put a state on the wire."""

    @abstractmethod
    def contend(self, command: Command) -> None:
        """Put a command on the wire as another writer would; `poll` meets it like any other."""

    @abstractmethod
    def close(self) -> None:
        """Leave the wire."""

    @contextmanager
    def refusing(self) -> Iterator[None]:
        """Count a message that is refused in the block."""
        try:
            yield
        except RefusedError as error:
            self.counts[f"refused: {error.reason}"] += 1


@dataclass(frozen=True, kw_only=True)
class Watchdog(Bounded):
    """What the drives do when commands stop."""

    silence: Literal["hold", "zero", "damp"] = "hold"
    """`hold`: go on with the last command for ever (the bridge of walk-these-ways, spi_debug_cmd);
    `zero`: no torque (the motors' own time-out); `damp`: damping."""
    silence_after: Annotated[float, Meta(gt=0.0)] = 0.1
    """Time without a command after which they do it [s]."""


class RobotServer:
    """A connected virtual robot behind a wire."""

    def __init__(
        self,
        machine: Machine,
        wire: ServerTransport,
        *,
        hold: Command,
        faults: Faults | None = None,
        watchdog: Watchdog | None = None,
        seed: int = 0,
    ) -> None:
        """Serve a machine on a wire.

        Args:
            machine: The virtual robot, connected.
            wire: The robot's end of the wire.
            hold: Command of a rival and of the robot's own controller.
            faults: Faults; none if None.
            watchdog: What the drives do when commands stop; the usual if None.
            seed: Seed of the faults.
        """
        self.counts: Counter[str] = Counter()
        """`commands applied`, `silences`, `slips`, `clamps refused`, `commands of others`."""
        self._machine = machine
        self._wire = wire
        self._hold = hold
        self._faults = Faults() if faults is None else faults
        self._watchdog = Watchdog() if watchdog is None else watchdog
        after = self._faults.after
        self._commands = FaultChannel[Command](self._faults.command, after=after, seed=2 * seed)
        self._states = FaultChannel[State](self._faults.state, after=after, seed=2 * seed + 1)
        self._now = machine.now()
        self._last_command = math.inf
        self._contended = -math.inf
        self._clamps: tuple[str, ...] = ()
        self._frozen: State | None = None
        self._sound: State | None = None  # the last state before a sensor's fault
        self._sensor = self._faults.sensor
        self._clock_fault = "right"
        self.damped_s: float | None = None
        """Time from the beginning of a sensor's fault to the first damping, None before it [s]."""
        self._slipped_s = 0.0
        self._cpu_start_s = time.process_time()
        self._lateness = Histogram()
        wire.corrupt_in = partial(self._flip, self._commands)
        wire.corrupt_out = partial(self._flip, self._states)

    def step(self, until: float) -> None:
        """Advance to `until` on the machine's clock [s]. Takes no wall time."""
        self._now = until
        for command in self._wire.poll():
            self._commands.put(command, until)
        for command in self._commands.due(until):
            self._last_command = until
            self._machine.send(command)
            self.counts["commands applied"] += 1
            fault_start = math.inf
            if self._sensor is not None:
                _, fault_start = self._sensor
            if self.damped_s is None and until >= fault_start and not command.stiffness.any():
                self.damped_s = until - fault_start
        silent = until - self._last_command > self._watchdog.silence_after
        if silent and self._watchdog.silence != "hold":
            self.counts["silences"] += 1
            self._last_command = math.inf
            damping = 1.0 if self._watchdog.silence == "damp" else 0.0
            self._machine.send(damping_command(len(self._hold.position), damping))
        if self._wire.clamps != self._clamps:
            try:
                self._machine.clamp(self._wire.clamps)
            except HardwareError:
                # On the ground nothing holds the body; the wire then goes on saying what is held.
                self.counts["clamps refused"] += 1
                self._wire.clamps = self._clamps
            self._clamps = self._wire.clamps
        self._contend(until)
        for state in self._machine.wait(until):
            self._states.put(self._reported(state), until)
        for state in self._states.due(until):
            self._wire.publish(state)

    def spoil(self, fault: str | None) -> None:
        """Begin a fault of `SENSOR_FAULTS` now, or end it; "" notes the time of another fault.

        `FAULT@CLOCK` begins one of `CLOCKS` with it.
        """
        name, _, clock = (fault or "").partition("@")
        self._sensor = None if fault is None else (name, self._now)
        self._clock_fault = clock or "right"
        self.damped_s = None

    def run(self, stop: Callable[[], bool]) -> None:
        """Run in real time until `stop()` is true, at most one tick after that."""
        # What was built until now lives as long as the server; the collector need not walk it.
        gc.freeze()
        start = time.monotonic() - self._machine.now()
        self._cpu_start_s = time.process_time()
        ticks = round(self._machine.now() / TICK_S)
        while not stop():
            ticks += 1
            sleep_until(start + ticks * TICK_S)
            late = time.monotonic() - start - ticks * TICK_S
            if late > _SLIP_S:
                self.counts["slips"] += 1
                self._slipped_s += late
                start += late
            self._lateness.add(late)
            self.step(ticks * TICK_S)

    def figures(self) -> dict[str, object]:
        """Counts of server, wire and faults, lateness of ticks, and share of one core."""
        cpu_s = time.process_time() - self._cpu_start_s
        return {
            "virtual": True,
            "duration_s": self._now,
            "server": dict(self.counts),
            "wire": dict(self._wire.counts),
            "command_faults": dict(self._commands.counts),
            "state_faults": dict(self._states.counts),
            "slipped_s": self._slipped_s,
            "damped_s": self.damped_s,
            "cpu_share": cpu_s / max(self._now, TICK_S),
            "lateness": self._lateness.figures(),
        }

    def _contend(self, now: float) -> None:
        """Command the joints as a rival or the robot's own controller, when it is due."""
        rival = self._faults.rival is not None and now >= self._faults.rival
        if (rival or self._wire.mode) and now - self._contended >= _CONTEND_S:
            self._contended = now
            self.counts["commands of others"] += 1
            self._wire.contend(self._hold)

    def _reported(self, state: State) -> State:
        """Make the state that goes out: the measured one, unless a fault is due."""
        now = self._now
        robot_time = state.time if state.robot_time is None else state.robot_time
        if self._faults.clock is not None:
            jump_time, jump = self._faults.clock
            if now >= jump_time:
                robot_time += jump
        frozen = False
        if self._faults.freeze is not None:
            freeze_start, freeze_length = self._faults.freeze
            frozen = freeze_start <= now < freeze_start + freeze_length
        if not frozen:
            self._frozen = None
        elif self._frozen is None:
            self._frozen = state
        else:
            state = replace(self._frozen, time=state.time, sequence=state.sequence)
        fault = ""
        if self._sensor is not None:
            fault, fault_start = self._sensor
            if now < fault_start:
                fault = ""
        if not fault:
            self._sound = state
        else:
            state = spoiled(fault, self._sound or state, state)
        if self._states.strikes("nan", now):
            name = _BROKEN_FIELDS[self._states.pick(len(_BROKEN_FIELDS))]
            values = getattr(state, name).copy()
            values[self._states.pick(len(values))] = math.nan
            state = replace(state, **{name: values})
        if self._sensor is not None and now >= self._sensor[1]:
            robot_time = CLOCKS[self._clock_fault](self._sensor[1], robot_time)
        return replace(state, robot_time=robot_time)

    def _flip(self, channel: FaultChannel[Command] | FaultChannel[State], data: bytes) -> bytes:
        """Invert one bit of a message of a channel, when such a fault strikes."""
        if data and channel.strikes("flip", self._now):
            return flip_bit(data, channel.pick(8 * len(data)))
        return data
