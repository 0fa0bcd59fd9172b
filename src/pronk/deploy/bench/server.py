"""The virtual robot as a machine of its own: real time, a wire, and its faults.

The drives' PD runs inside physics at 4 kHz.
"""

from __future__ import annotations

import gc
import math
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Literal

from msgspec import Meta

from pronk.deploy.bench.faults import FaultChannel, Faults, flip_bit, spoiled
from pronk.deploy.links.realtime import Histogram, sleep_until
from pronk.errors import HardwareError
from pronk.jump.virtual.bounds import Bounded
from pronk.robots.machine import Command, Machine, RefusedError, State, damping_command
from pronk.robots.robot import RobotSpec

Corrupt = Callable[[bytes], bytes]

TICK_S = 0.5e-3  # period of polling the wire: commands act on the machine at a multiple of this
_CONTEND_S = 0.01  # between two commands of the rival and of the robot's own controller
_SLIP_S = 0.1  # lateness beyond which the machine's clock is put back instead of catching up
_BROKEN_FIELDS = ("position", "velocity", "gyro", "accelerometer", "orientation")


class ServerTransport(ABC):
    """The robot's end of a link. Everything is non-blocking and called from one thread.

    Whatever arrives, `poll` never raises: a message that is not a possible command is refused and
    counted under its reason.
    """

    def __init__(self, robot: RobotSpec, mode: str, modes: Iterable[str]) -> None:
        """Begin with a mode of the robot's own controller, one of `modes`."""
        if mode not in (modes := tuple(modes)):
            raise HardwareError(
                f"mode {mode!r}; expected one of {', '.join(filter(None, modes))}, or none for "
                "released."
            )
        # `commands`, `states`, and one `refused: REASON` for each reason to refuse.
        self.counts: Counter[str] = Counter()
        self.mode = mode  # the robot's own controller that holds the drives; "" when released
        self.clamps: tuple[str, ...] = ()  # joints to hold mechanically, requested over the wire
        # Applied to the bytes of commands before any check, and of states with their checksum.
        self.corrupt_in: Corrupt = bytes
        self.corrupt_out: Corrupt = bytes
        self._names = robot.joint_names

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
    """Go on with the last command for ever (the bridge of walk-these-ways, spi_debug_cmd), no
    torque (the motors' own time-out), or damping."""
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
        """`hold` is commanded by a rival and the robot's own controller; `seed` is of faults."""
        self.counts: Counter[str] = Counter()  # `commands applied`, `silences`, `slips` and others
        self._machine, self._wire, self._hold = machine, wire, hold
        self._faults = known = faults or Faults()
        self._watchdog = watchdog or Watchdog()
        self._commands = FaultChannel[Command](known.command, after=known.after, seed=2 * seed)
        self._states = FaultChannel[State](known.state, after=known.after, seed=2 * seed + 1)
        self._now = machine.now()
        self._last_command = math.inf
        self._contended = -math.inf
        self._clamps: tuple[str, ...] = ()
        self._frozen: State | None = None
        self._sound: State | None = None  # the last state before a sensor's fault
        self._sensor = known.sensor
        # From the begin of a sensor's fault to the first damping; None before that [s].
        self.damped_s: float | None = None
        self._slipped, self._worked = 0.0, time.process_time()
        self._late = Histogram()
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
            began = math.inf if self._sensor is None else self._sensor[1]
            if self.damped_s is None and until >= began and not command.stiffness.any():
                self.damped_s = until - began
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
        """Begin a fault of `SENSOR_FAULTS` now, or end it; "" notes the time of another fault."""
        self._sensor = None if fault is None else (fault, self._now)
        self.damped_s = None

    def run(self, stop: Callable[[], bool]) -> None:
        """Run in real time until `stop()` is true, at most one tick after that."""
        # What was built until now lives as long as the server; the collector need not walk it.
        gc.freeze()
        start = time.monotonic() - self._machine.now()
        self._worked = time.process_time()
        ticks = round(self._machine.now() / TICK_S)
        while not stop():
            ticks += 1
            sleep_until(start + ticks * TICK_S)
            late = time.monotonic() - start - ticks * TICK_S
            if late > _SLIP_S:
                self.counts["slips"] += 1
                self._slipped += late
                start += late
            self._late.add(late)
            self.step(ticks * TICK_S)

    def figures(self) -> dict[str, object]:
        """Counts of server, wire and faults, lateness of ticks, and share of one core."""
        return {
            "virtual": True,
            "duration_s": self._now,
            "server": dict(self.counts),
            "wire": dict(self._wire.counts),
            "command_faults": dict(self._commands.counts),
            "state_faults": dict(self._states.counts),
            "slipped_s": self._slipped,
            "damped_s": self.damped_s,
            "cpu_share": (time.process_time() - self._worked) / max(self._now, TICK_S),
            "lateness": self._late.figures(),
        }

    def _contend(self, now: float) -> None:
        rival = self._faults.rival is not None and now >= self._faults.rival
        if (rival or self._wire.mode) and now - self._contended >= _CONTEND_S:
            self._contended = now
            self.counts["commands of others"] += 1
            self._wire.contend(self._hold)

    def _reported(self, state: State) -> State:
        """The state as it goes out: the measured one, unless a fault is due."""
        now, faults = self._now, self._faults
        stamp = state.time if state.robot_time is None else state.robot_time
        if faults.clock is not None and now >= faults.clock[0]:
            stamp += faults.clock[1]
        if faults.freeze is not None and faults.freeze[0] <= now < sum(faults.freeze):
            self._frozen = self._frozen or state
            state = replace(self._frozen, time=state.time, sequence=state.sequence)
        else:
            self._frozen = None
        if self._sensor is None or not self._sensor[0] or now < self._sensor[1]:
            self._sound = state
        else:
            state = spoiled(self._sensor[0], self._sound or state, state)
        if self._states.strikes("nan", now):
            name = _BROKEN_FIELDS[self._states.pick(len(_BROKEN_FIELDS))]
            values = getattr(state, name).copy()
            values[self._states.pick(len(values))] = math.nan
            state = replace(state, **{name: values})
        return replace(state, robot_time=stamp)

    def _flip(self, channel: FaultChannel[Command] | FaultChannel[State], data: bytes) -> bytes:
        struck = bool(data) and channel.strikes("flip", self._now)
        return flip_bit(data, channel.pick(8 * len(data))) if struck else data
