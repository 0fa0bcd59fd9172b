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
from typing import Annotated, Any, Generic, TypeVar

import numpy as np
from msgspec import Meta

from pronk.errors import HardwareError
from pronk.jump.virtual.bounds import Bounded
from pronk.robots.machine import State

T = TypeVar("T")
_Span = Annotated[float, Meta(ge=0.0, le=1e9)]
_Probability = Annotated[float, Meta(ge=0.0, le=1.0)]

_UNITS = {"us": 1e6, "ms": 1e3, "s": 1.0, "": 1.0}  # how many make a second
# Of the gamma distribution of the jitter: few messages are on time, and some are very late.
_JITTER_SHAPE = 2.0


@dataclass(frozen=True, kw_only=True)
class ChannelFaults(Bounded):
    """One direction. Probabilities are per message."""

    delay: _Span = 0.0
    """[s]"""
    jitter: _Span = 0.0
    """Mean of what comes on top of the delay, gamma distributed of shape 2 [s]."""
    loss: _Probability = 0.0
    duplicate: _Probability = 0.0
    reorder: _Probability = 0.0
    """That a message waits for the next one and comes after it."""
    nan: _Probability = 0.0
    """That one number of a state is not a number. Has no meaning for commands."""
    flip: _Probability = 0.0
    """That one bit of a message is inverted."""


_JOINT = 3  # of a faulty encoder: the second leg's first, whose load changes least
_DITHER = 1e-4  # share of the live attitude in one that is stuck, so that it does not repeat
_Changes = Callable[[State, State], dict[str, Any]]


def _held(*names: str) -> _Changes:
    """Sources that repeat what they measured last."""
    return lambda last, state: {name: getattr(last, name) for name in names}


def _encoder(state: State, **readings: float) -> dict[str, Any]:
    changed = {name: getattr(state, name).copy() for name in readings}
    for name, value in readings.items():
        changed[name][_JOINT] = value
    return changed


def _stuck(last: State, state: State) -> dict[str, Any]:
    attitude = last.orientation + _DITHER * state.orientation
    return {"orientation": attitude / np.linalg.norm(attitude)}


def _swapped(*joints: int) -> _Changes:
    """The joints of these numbers, in place of those from 0 on."""

    def swapped(_last: State, state: State) -> dict[str, Any]:
        order = [*joints, *range(len(joints), len(state.position))]
        return {name: getattr(state, name)[order] for name in ("position", "velocity", "torque")}

    return swapped


SENSOR_FAULTS: dict[str, _Changes] = {
    "imu-repeats": _held("orientation", "gyro", "accelerometer"),
    "attitude-repeats": _held("orientation"),
    "gyro-repeats": _held("gyro"),
    "accelerometer-repeats": _held("accelerometer"),
    "positions-repeat": _held("position"),
    "velocities-repeat": _held("velocity"),
    "joints-repeat": _held("position", "velocity"),
    "attitude-stuck": _stuck,
    "gyro-zero": lambda last, state: {"gyro": np.zeros(3)},
    "velocities-zero": lambda last, state: {"velocity": np.zeros_like(state.velocity)},
    "encoder-jumps": lambda last, state: _encoder(state, position=state.position[_JOINT] + 1.0),
    "encoder-zero": lambda last, state: _encoder(state, position=0.0),
    "encoder-constant": lambda last, state: _encoder(
        state, position=last.position[_JOINT], velocity=last.velocity[_JOINT]
    ),
    "legs-swapped": _swapped(3, 4, 5, 0, 1, 2),
    "joints-swapped": _swapped(0, 2, 1),
}
"""What a faulty sensor makes of a state, from the last state before the fault and this one."""
SWAPPED = ("legs-swapped", "joints-swapped")
"""The first two legs, and the last two joints of the first: found as the robot stands up."""


@dataclass(frozen=True, kw_only=True)
class Faults:
    """Faults of a machine behind a link. Times on the machine's clock."""

    command: ChannelFaults = field(default_factory=ChannelFaults)
    """To the machine."""
    state: ChannelFaults = field(default_factory=ChannelFaults)
    """From the machine."""
    after: float = 0.0
    """When the faults of both directions begin [s]."""
    freeze: tuple[float, float] | None = None
    """When the values of the states stop changing, and for how long; their numbers and stamps go
    on [s]."""
    clock: tuple[float, float] | None = None
    """When the robot's own clock jumps, and by how much [s]."""
    rival: float | None = None
    """When another program begins to command the joints [s]."""
    sensor: tuple[str, float] | None = None
    """One of `SENSOR_FAULTS`, and when it begins [s]."""


def spoiled(fault: str, last: State, state: State) -> State:
    """A state as a sensor with one of `SENSOR_FAULTS` makes it; `last` is from before the fault."""
    return replace(state, **SENSOR_FAULTS[fault](last, state))


def parse_faults(text: str) -> Faults:
    """Read faults such as `loss=0.3,state.delay=5ms,freeze=3s:0.5s`; refuse unknown words.

    Fields of `ChannelFaults` are of both directions unless `command.` or `state.` stands before
    them; `after=T`, `rival=T`, `freeze=T:LENGTH`, `clock=T:STEP` and `sensor=T:FAULT`, a name of
    `SENSOR_FAULTS`, are of the machine. Numbers without a unit are in seconds.
    """
    channels: dict[str, dict[str, float]] = {"command": {}, "state": {}}
    whole: dict[str, Any] = {}
    known = [entry.name for entry in fields(ChannelFaults)]
    for word in filter(None, (part.strip() for part in text.split(","))):
        name, _, value = word.partition("=")
        channel, dot, bare = name.rpartition(".")
        if bare in known and (not dot or channel in channels):
            for each in (channel,) if dot else tuple(channels):
                channels[each][bare] = _number(word, value)
        elif name in ("after", "rival"):
            whole[name] = _number(word, value)
        elif name in ("freeze", "clock") and value.count(":") == 1:
            whole[name] = tuple(_number(word, part) for part in value.split(":"))
        elif name == "sensor" and value.partition(":")[2] in SENSOR_FAULTS:
            whole[name] = (value.partition(":")[2], _number(word, value.partition(":")[0]))
        else:
            raise HardwareError(
                f"fault {word!r} is unknown; expected {', '.join(known)} (both directions, or with "
                "command. or state. before it), after=T, rival=T, freeze=T:LENGTH, clock=T:STEP, "
                f"sensor=T:FAULT with FAULT one of {', '.join(SENSOR_FAULTS)}."
            )
    command, state = (ChannelFaults(**channels[name]) for name in ("command", "state"))
    return Faults(command=command, state=state, **whole)


def _number(word: str, text: str) -> float:
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
        self.counts: Counter[str] = Counter()  # messages that met each fault
        self._faults, self._after = faults, after
        self._rng, self._corrupting = (np.random.default_rng([seed, k]) for k in range(2))
        self._queue: list[tuple[float, int, T]] = []
        self._put = 0
        self._held: T | None = None

    def put(self, item: T, now: float) -> None:
        """Put a message in at a time [s]."""
        if now < self._after:
            self._push(item, now)
            return
        faults = self._faults
        lost, twice, swapped = self._rng.random(3) < (faults.loss, faults.duplicate, faults.reorder)
        late = self._rng.standard_gamma(_JITTER_SHAPE) / _JITTER_SHAPE * faults.jitter
        due = now + faults.delay + late
        if lost:
            self.counts["lost"] += 1
        elif swapped and self._held is None:
            self.counts["reordered"] += 1
            self._held = item
        else:
            self._push(item, due)
            if twice:
                self.counts["duplicated"] += 1
                self._push(item, due)
            if self._held is not None:
                self._push(self._held, due)
                self._held = None

    def due(self, now: float) -> list[T]:
        """Take out the messages due until `now` [s], in order."""
        out: list[T] = []
        while self._queue and self._queue[0][0] <= now:
            out.append(heapq.heappop(self._queue)[2])
        return out

    def strikes(self, kind: str, now: float) -> bool:
        """Whether a fault of this kind (`nan` or `flip`) strikes the present message."""
        chance: float = getattr(self._faults, kind)
        if chance == 0.0 or now < self._after:
            return False
        struck = bool(self._corrupting.random() < chance)
        self.counts[kind] += struck
        return struck

    def pick(self, below: int) -> int:
        """Draw a number from 0 to `below` - 1: which bit, which joint."""
        return int(self._corrupting.integers(below))

    def _push(self, item: T, due: float) -> None:
        heapq.heappush(self._queue, (due, self._put, item))
        self._put += 1


def flip_bit(data: bytes, bit: int) -> bytes:
    """Copy bytes with one bit inverted."""
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)
