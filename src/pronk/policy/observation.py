"""The observation vector of a policy, number by number, and its history.

The measured part is one vector with a short history, so that actor and estimator read the same
measurement with the same noise. The jump input is separate: phase 1 has none, phase 2 adds it at
the end (paper N3).

    measured   angular velocity 3, projected gravity 3, position 3 x 12, velocity 3 x 12,
               previous actions 2 x 12, command 3                                     = 105
    jump       0 or 1                                                                 =   1

Histories run from old to new: t-0.04, t-0.02, t (positions and velocities); t-0.04, t-0.02
(actions). The estimator reads all but the command (102, with the jump input 103: paper N1, reading
A19); the actor reads the estimate (7), then the current samples (45): 52, with the jump input 53
(paper N2, reading A19 of one previous action).

Vectors are in the trunk's frame (x forward, y left, z up); gravity is a unit vector, positions are
relative to the default pose, actions as the network gave them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pronk.errors import ArtefactError

Floats = NDArray[np.float32]

JOINTS = 12
HISTORY = 3
"""Samples of position and velocity."""
ACTIONS = 2
"""Samples of previous actions."""

MEASURED = {
    "angular_velocity": range(3),
    "projected_gravity": range(3, 6),
    "joint_position": range(6, 42),
    "joint_velocity": range(42, 78),
    "action": range(78, 102),
    "command": range(102, 105),
}
"""The parts of the measured vector, in order: their positions in it."""
MEASURED_SIZE = MEASURED["command"].stop

ACTOR_INDICES: tuple[int, ...] = (
    *MEASURED["angular_velocity"],
    *MEASURED["projected_gravity"],
    *MEASURED["command"],
    *MEASURED["joint_position"][-JOINTS:],
    *MEASURED["joint_velocity"][-JOINTS:],
    *MEASURED["action"][-JOINTS:],
)
"""Part of the measured vector that the actor reads, behind the estimate."""

ESTIMATOR_INDICES: tuple[int, ...] = tuple(range(MEASURED["command"].start))
"""Part of the measured vector that the estimator reads."""

ESTIMATE = {"contact": 4, "linear_velocity": 3}
"""Outputs of the estimator: contact probability per foot (FR, FL, HR, HL), trunk velocity in the
trunk's frame [m/s]. The actor reads it in this order, in front of its own part."""

ESTIMATE_SIZE = sum(ESTIMATE.values())

_SIZES = {"angular_velocity": 3, "projected_gravity": 3, "position": JOINTS, "velocity": JOINTS}


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """One sample of the robot's sensors. Joints in the order of the contract."""

    angular_velocity: ArrayLike
    """Of the trunk, in its frame [rad/s]. (3,)"""
    projected_gravity: ArrayLike
    """Unit vector of gravity in the trunk's frame: (0, 0, -1) when level. (3,)"""
    position: ArrayLike
    """Joint positions, absolute [rad]. (12,)"""
    velocity: ArrayLike
    """Joint velocities [rad/s]. (12,)"""

    def __post_init__(self) -> None:
        """Raise `ArtefactError` for a part of another size or not finite."""
        for name, size in _SIZES.items():
            finite(f"the measured {name}", getattr(self, name), (size,))


class History:
    """The last samples of one robot, oldest first, and the measured vector made of them."""

    def __init__(self, default_position: ArrayLike) -> None:
        self._default = np.asarray(default_position, np.float32)
        self.reset()

    def reset(self) -> None:
        """Begin anew: the next sample fills the history, past actions are zero."""
        self._position: Floats | None = None
        self._velocity: Floats | None = None
        self._actions = np.zeros((ACTIONS, JOINTS), np.float32)

    def observe(self, measurement: Measurement, command: ArrayLike) -> Floats:
        """Add a sample and return the measured vector, laid out as `MEASURED`, shape (105,).

        Args:
            measurement: The sensors now.
            command: Forward and left [m/s], yaw rate [rad/s], shape (3,).

        Raises:
            ArtefactError: The command is not finite; nothing is added then.
        """
        commanded = finite("the command", command, (3,))
        position = np.asarray(measurement.position, np.float32) - self._default
        self._position = _pushed(self._position, position)
        self._velocity = _pushed(self._velocity, np.asarray(measurement.velocity, np.float32))
        # In the order of `MEASURED`.
        parts = (
            measurement.angular_velocity,
            measurement.projected_gravity,
            self._position,
            self._velocity,
            self._actions,
            commanded,
        )
        return np.concatenate([np.asarray(part, np.float32).ravel() for part in parts])

    def acted(self, action: Floats) -> None:
        """Add the network's action for the latest observation, shape (12,)."""
        self._actions = np.concatenate([self._actions[1:], action[None]])


def _pushed(history: Floats | None, sample: Floats) -> Floats:
    """Return a history without its oldest sample and with a new one, shape (3, 12)."""
    if history is None:
        return np.tile(sample, (HISTORY, 1))
    return np.concatenate([history[1:], sample[None]])


def finite(what: str, value: ArrayLike, shape: tuple[int, ...]) -> Floats:
    """Return a value as float32.

    Args:
        what: Name of the value, for the message.
        value: Numbers of any type.
        shape: The shape that is expected.

    Raises:
        ArtefactError: The value has another shape, or a number of it is not finite as float32.
    """
    numbers = np.asarray(value)
    if numbers.shape != shape:
        raise ArtefactError(f"{what} has the shape {numbers.shape}; expected {shape}.")
    with np.errstate(over="ignore"):  # Overflow gives infinity, which is refused.
        array = numbers.astype(np.float32, copy=False)
        flat = array.ravel()
        # A finite sum of squares has finite parts; this is the fastest check.
        if math.isfinite(flat.dot(flat)):
            return array
    for index in np.argwhere(~np.isfinite(array)):
        place = ", ".join(map(str, index))
        raise ArtefactError(
            f"{what} is {array[tuple(index)]} at [{place}]; a policy reads finite numbers only."
        )
    return array
