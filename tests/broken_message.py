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
    damage = rng.integers(6)
    changed = bytearray(data)
    if damage == 0:
        return flip_bit(data, int(rng.integers(8 * len(data))))
    if damage == 1:  # a burst
        start = int(rng.integers(len(data)))
        stop = min(start + int(rng.integers(1, 64)), len(data))
        changed[start:stop] = rng.bytes(stop - start)
    elif damage == 2:  # cut off
        del changed[int(rng.integers(len(data))) :]
    elif damage == 3:  # too long
        changed += rng.bytes(int(rng.integers(1, 64)))
    elif damage == 4:  # shifted
        del changed[int(rng.integers(len(data)))]
        changed += b"\0"
    else:  # noise
        changed = bytearray(rng.bytes(len(data)))
    return bytes(changed)
