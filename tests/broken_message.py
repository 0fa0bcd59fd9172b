"""States for tests of links, and messages that are broken in the ways in which messages break."""

from __future__ import annotations

from typing import Any

import numpy as np

from pronk.deploy.bench.faults import flip_bit
from pronk.robots.machine import State


def some_state(**changes: Any) -> State:
    """A state of twelve joints with another number in every place, each exact in 32 bits."""
    values: dict[str, Any] = {
        "time": 1.0,
        "sequence": 7,
        "position": np.arange(12) / 16 - 0.25,
        "velocity": np.arange(12) / 8,
        "torque": np.arange(12) / 4,
        "gyro": np.array([0.25, -0.5, 1.0]),
        "accelerometer": np.array([0.5, 0.25, 9.75]),
        "bus_voltage": 24.5,
        "orientation": np.array([0.5, -0.5, 0.5, 0.5]),
        "robot_time": 12.5,
    }
    return State(**(values | changes))


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """A broken copy of a message: one flipped bit, a burst, cut, longer, shifted, or noise."""
    kind = rng.integers(6)
    changed = bytearray(data)
    if kind == 0:
        return flip_bit(data, int(rng.integers(8 * len(data))))
    if kind == 1:  # a burst
        at, size = int(rng.integers(len(data))), int(rng.integers(1, 64))
        changed[at : at + size] = rng.bytes(len(changed[at : at + size]))
    elif kind == 2:  # cut off
        del changed[int(rng.integers(len(data))) :]
    elif kind == 3:  # too long
        changed += rng.bytes(int(rng.integers(1, 64)))
    elif kind == 4:  # shifted
        at = int(rng.integers(len(data)))
        del changed[at : at + 1]
        changed += b"\0"
    else:  # nothing of it is left
        changed = bytearray(rng.bytes(len(data)))
    return bytes(changed)
