"""Seeded, repeatable faults of a link.

One number of each kind is drawn per message whether it is used or not, so that one fault more does
not change when the others strike.
"""

from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any, Generic, Literal, TypeVar

import numpy as np
from msgspec import Meta

from pronk.errors import HardwareError
from pronk.jump.virtual.bounds import Bounded
from pronk.robots.machine import State

T = TypeVar("T")
_Span = Annotated[float, Meta(ge=0.0, le=1e9)]
_Probability = Annotated[float, Meta(ge=0.0, le=1.0)]

_UNITS = {"us": 1e6, "ms": 1e3, "s": 1.0, "": 1.0}
"""How many of a unit make a second."""
_JITTER_SHAPE = 2.0
"""Shape of the gamma distribution of the jitter: few messages are on time, some are very late."""


@dataclass(frozen=True, kw_only=True)
class ChannelFaults(Bounded):
    """Faults of one direction. Probabilities are per message."""

    delay: _Span = 0.0
    """Time by which every message is late [s]."""
    jitter: _Span = 0.0
    """Mean of the time on top of the delay, gamma distributed of shape 2 [s]."""
    loss: _Probability = 0.0
    """Probability that a message is lost."""
    duplicate: _Probability = 0.0
    """Probability that a message comes twice."""
    reorder: _Probability = 0.0
    """Probability that a message waits for the next one and comes after it."""
    nan: _Probability = 0.0
    """Probability that one number of a state is not a number; without meaning for commands."""
    flip: _Probability = 0.0
    """Probability that one bit of a message is inverted."""


_FAULTY_JOINT = 3
"""Joint of a faulty encoder: the second leg's first, whose load changes least."""
_DRIFTING_JOINT = 2
"""Joint of an encoder that drifts: the first leg's knee."""
_DRIFT = 0.5
"""Its drift [rad/s]."""
_DITHER = 1e-4
"""Share of the live attitude in one that is stuck, so that it does not repeat."""

# Each makes a state of a faulty sensor from the last sound state before the fault and the state of
# now.


def _imu_repeats(sound: State, state: State) -> State:
    return replace(
        state,
        orientation=sound.orientation,
        gyro=sound.gyro,
        accelerometer=sound.accelerometer,
    )


def _attitude_repeats(sound: State, state: State) -> State:
    return replace(state, orientation=sound.orientation)


def _gyro_repeats(sound: State, state: State) -> State:
    return replace(state, gyro=sound.gyro)


def _accelerometer_repeats(sound: State, state: State) -> State:
    return replace(state, accelerometer=sound.accelerometer)


def _positions_repeat(sound: State, state: State) -> State:
    return replace(state, position=sound.position)


def _velocities_repeat(sound: State, state: State) -> State:
    return replace(state, velocity=sound.velocity)


def _joints_repeat(sound: State, state: State) -> State:
    return replace(state, position=sound.position, velocity=sound.velocity)


def _attitude_stuck(sound: State, state: State) -> State:
    attitude = sound.orientation + _DITHER * state.orientation
    return replace(state, orientation=attitude / np.linalg.norm(attitude))


def _gyro_zero(_sound: State, state: State) -> State:
    return replace(state, gyro=np.zeros(3))


def _velocities_zero(_sound: State, state: State) -> State:
    return replace(state, velocity=np.zeros_like(state.velocity))


def _encoder_jumps(_sound: State, state: State) -> State:
    position = state.position.copy()
    position[_FAULTY_JOINT] += 1.0
    return replace(state, position=position)


def _encoder_zero(_sound: State, state: State) -> State:
    position = state.position.copy()
    position[_FAULTY_JOINT] = 0.0
    return replace(state, position=position)


def _encoder_constant(sound: State, state: State) -> State:
    position = state.position.copy()
    position[_FAULTY_JOINT] = sound.position[_FAULTY_JOINT]
    velocity = state.velocity.copy()
    velocity[_FAULTY_JOINT] = sound.velocity[_FAULTY_JOINT]
    return replace(state, position=position, velocity=velocity)


def _encoder_drifts(sound: State, state: State) -> State:
    position = state.position.copy()
    position[_DRIFTING_JOINT] += _DRIFT * (state.time - sound.time)
    return replace(state, position=position)


def _encoder_drifts_with_velocity(sound: State, state: State) -> State:
    velocity = state.velocity.copy()
    velocity[_DRIFTING_JOINT] += _DRIFT
    return replace(_encoder_drifts(sound, state), velocity=velocity)


def _voltage_low(_sound: State, state: State) -> State:
    return replace(state, bus_voltage=6.0)


def _voltage_zero(_sound: State, state: State) -> State:
    return replace(state, bus_voltage=0.0)


def _legs_swapped(_sound: State, state: State) -> State:
    return _reordered(state, [3, 4, 5, 0, 1, 2])


def _joints_swapped(_sound: State, state: State) -> State:
    return _reordered(state, [0, 2, 1])


def _reordered(state: State, first_joints: list[int]) -> State:
    """Put the joints of these numbers in place of those from 0 on."""
    order = [*first_joints, *range(len(first_joints), len(state.position))]
    return replace(
        state,
        position=state.position[order],
        velocity=state.velocity[order],
        torque=state.torque[order],
    )


SENSOR_FAULTS: dict[str, Callable[[State, State], State]] = {
    "imu-repeats": _imu_repeats,
    "attitude-repeats": _attitude_repeats,
    "gyro-repeats": _gyro_repeats,
    "accelerometer-repeats": _accelerometer_repeats,
    "positions-repeat": _positions_repeat,
    "velocities-repeat": _velocities_repeat,
    "joints-repeat": _joints_repeat,
    "attitude-stuck": _attitude_stuck,
    "gyro-zero": _gyro_zero,
    "velocities-zero": _velocities_zero,
    "encoder-jumps": _encoder_jumps,
    "encoder-zero": _encoder_zero,
    "encoder-constant": _encoder_constant,
    "encoder-drifts": _encoder_drifts,
    "encoder-drifts-with-velocity": _encoder_drifts_with_velocity,
    "voltage-low": _voltage_low,
    "voltage-zero": _voltage_zero,
    "legs-swapped": _legs_swapped,
    "joints-swapped": _joints_swapped,
}
"""What a faulty sensor makes of a state, from the last state before the fault and this one."""
NO_VOLTAGE = ("voltage-low", "voltage-zero")
"""Faults of the bus voltage, which LCM does not carry."""
SWAPPED = ("legs-swapped", "joints-swapped")
"""The first two legs, and the last two joints of the first: found as the robot stands up."""


def _right(_begun: float, time: float) -> float:
    return time


def _stuck(begun: float, _time: float) -> float:
    return begun


def _thousand_times(begun: float, time: float) -> float:
    return begun + 1000.0 * (time - begun)


def _jumps(begun: float, time: float) -> float:
    return time + 10.0 * (1.0 - math.floor((time - begun) / 0.1) % 2)


CLOCKS: dict[str, Callable[[float, float], float]] = {
    "right": _right,
    "stuck": _stuck,
    "fast": _thousand_times,
    "jumps": _jumps,
}
"""The robot's own time [s] by the time at which the fault began and the true time: right, stuck,
1,000 times too fast, and forward and back by 10 s every 0.1 s."""


@dataclass(frozen=True, kw_only=True)
class Faults:
    """Faults of a machine behind a link. Times on the machine's clock."""

    command: ChannelFaults = field(default_factory=ChannelFaults)
    """Faults of commands, to the machine."""
    state: ChannelFaults = field(default_factory=ChannelFaults)
    """Faults of states, from the machine."""
    after: float = 0.0
    """Time when the faults of both directions begin [s]."""
    freeze: tuple[float, float] | None = None
    """Time when the values of the states stop changing, and for how long; their numbers and stamps
    go on [s]."""
    clock: tuple[float, float] | None = None
    """Time when the robot's own clock jumps, and by how much [s]."""
    rival: float | None = None
    """Time when another program begins to command the joints [s]."""
    sensor: tuple[str, float] | None = None
    """One of `SENSOR_FAULTS`, and the time when it begins [s]."""


def spoiled(fault: str, sound: State, state: State) -> State:
    """Make a state as a faulty sensor reports it.

    Args:
        fault: One of `SENSOR_FAULTS`.
        sound: The last state before the fault.
        state: The state of now.
    """
    return SENSOR_FAULTS[fault](sound, state)


def parse_faults(text: str) -> Faults:
    """Read faults such as `loss=0.3,state.delay=5ms,freeze=3s:0.5s`.

    Args:
        text: Words of the form NAME=VALUE, with commas between them. Fields of `ChannelFaults` are
            of both directions unless `command.` or `state.` stands before them; `after=T`,
            `rival=T`, `freeze=T:LENGTH`, `clock=T:STEP` and `sensor=T:FAULT`, a name of
            `SENSOR_FAULTS`, are of the machine. Numbers without a unit are in seconds.

    Raises:
        HardwareError: A word is unknown, or its value is no number.
        RobotError: A value is out of its bounds.
    """
    channel_names = [entry.name for entry in fields(ChannelFaults)]
    command: dict[str, float] = {}
    state: dict[str, float] = {}
    machine: dict[str, Any] = {}
    for part in text.split(","):
        word = part.strip()
        if not word:
            continue
        name, _, value = word.partition("=")
        channel, _, channel_name = name.rpartition(".")
        first, colon, second = value.partition(":")
        named_channel = channel in ("command", "state")
        if channel_name in channel_names and (named_channel or name == channel_name):
            number = _parse_number(word, value)
            if channel != "state":
                command[channel_name] = number
            if channel != "command":
                state[channel_name] = number
        elif name in ("after", "rival"):
            machine[name] = _parse_number(word, value)
        elif name in ("freeze", "clock") and colon and ":" not in second:
            machine[name] = (_parse_number(word, first), _parse_number(word, second))
        elif name == "sensor" and second in SENSOR_FAULTS:
            machine[name] = (second, _parse_number(word, first))
        else:
            raise HardwareError(
                f"fault {word!r} is unknown; expected {', '.join(channel_names)} (both directions, "
                "or with command. or state. before it), after=T, rival=T, freeze=T:LENGTH, "
                f"clock=T:STEP, sensor=T:FAULT with FAULT one of {', '.join(SENSOR_FAULTS)}."
            )
    return Faults(command=ChannelFaults(**command), state=ChannelFaults(**state), **machine)


def _parse_number(word: str, text: str) -> float:
    """Read a number with or without a unit of time; HardwareError names the word."""
    unit = next(unit for unit in _UNITS if text.endswith(unit))
    try:
        value = float(text.removesuffix(unit)) / _UNITS[unit]
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise HardwareError(f"fault {word!r}: expected a number, if a time also with s, ms or us.")
    return value


class FaultChannel(Generic[T]):
    """One direction of a link: what is put in comes out late, twice, in another order or never."""

    def __init__(self, faults: ChannelFaults, *, after: float, seed: int) -> None:
        """Begin empty; messages put in before `after` [s] pass unchanged."""
        self.counts: Counter[str] = Counter()
        """Number of messages that met each fault."""
        self._faults = faults
        self._after = after
        self._timing_random = np.random.default_rng([seed, 0])
        self._corruption_random = np.random.default_rng([seed, 1])
        # Time when a message is due, its number, and the message.
        self._queue: list[tuple[float, int, T]] = []
        self._queued = 0
        self._waiting: T | None = None  # for the next message, after which it comes

    def put(self, item: T, now: float) -> None:
        """Put a message in at a time [s]."""
        if now < self._after:
            self._push(item, now)
            return
        faults = self._faults
        loss_draw, duplicate_draw, reorder_draw = self._timing_random.random(3)
        jitter_draw = self._timing_random.standard_gamma(_JITTER_SHAPE) / _JITTER_SHAPE
        due = now + faults.delay + jitter_draw * faults.jitter
        if loss_draw < faults.loss:
            self.counts["lost"] += 1
        elif reorder_draw < faults.reorder and self._waiting is None:
            self.counts["reordered"] += 1
            self._waiting = item
        else:
            self._push(item, due)
            if duplicate_draw < faults.duplicate:
                self.counts["duplicated"] += 1
                self._push(item, due)
            if self._waiting is not None:
                self._push(self._waiting, due)
                self._waiting = None

    def due(self, now: float) -> list[T]:
        """Take out the messages due until `now` [s], in order."""
        items: list[T] = []
        while self._queue and self._queue[0][0] <= now:
            _, _, item = heapq.heappop(self._queue)
            items.append(item)
        return items

    def strikes(self, corruption: Literal["nan", "flip"], now: float) -> bool:
        """Draw whether a corruption strikes the present message, at a time [s]."""
        probability = self._faults.nan if corruption == "nan" else self._faults.flip
        if probability == 0.0 or now < self._after:
            return False
        struck = bool(self._corruption_random.random() < probability)
        self.counts[corruption] += int(struck)
        return struck

    def pick(self, below: int) -> int:
        """Draw a number from 0 to `below` - 1: which bit, which joint."""
        return int(self._corruption_random.integers(below))

    def _push(self, item: T, due: float) -> None:
        heapq.heappush(self._queue, (due, self._queued, item))
        self._queued += 1


def flip_bit(data: bytes, bit: int) -> bytes:
    """Copy bytes with one bit inverted."""
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)
