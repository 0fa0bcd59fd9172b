"""The measured vector of one robot, as training's observation manager builds it.

At a reset the first sample fills the whole history, and the actions before it are zero, as at the
beginning of an episode in training.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pronk.errors import ArtefactError
from pronk.policy.layout import ACTIONS, HISTORY, JOINTS, MEASURED

Floats = NDArray[np.float32]
_SIZES = {"angular_velocity": 3, "projected_gravity": 3, "position": JOINTS, "velocity": JOINTS}


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """One sample of the robot's sensors. Joints in the order of the contract."""

    angular_velocity: ArrayLike
    """Of the trunk, in its frame (x forward, y left, z up) [rad/s]. (3,)"""
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
        """Begin as after `reset`; positions are relative to `default_position` [rad]. (12,)."""
        self._default = np.asarray(default_position, np.float32)
        self.reset()

    def reset(self) -> None:
        """Begin anew: the next sample fills the history."""
        self._position: Floats | None = None
        self._velocity: Floats | None = None
        self._actions = np.zeros((ACTIONS, JOINTS), np.float32)

    def observe(self, measurement: Measurement, command: ArrayLike) -> Floats:
        """Add a sample; returns the measured vector, laid out as `layout.MEASURED`. (105,).

        The command is forward and left [m/s], yaw rate [rad/s], in the trunk's frame (3,). One that
        is not finite is refused by an ArtefactError, and nothing is added.
        """
        commanded = finite("the command", command, (3,))
        position = np.asarray(measurement.position, np.float32) - self._default
        self._position = _pushed(self._position, position)
        self._velocity = _pushed(self._velocity, np.asarray(measurement.velocity, np.float32))
        parts = {
            "angular_velocity": measurement.angular_velocity,
            "projected_gravity": measurement.projected_gravity,
            "joint_position": self._position,
            "joint_velocity": self._velocity,
            "action": self._actions,
            "command": commanded,
        }
        return np.concatenate([np.asarray(parts[name], np.float32).ravel() for name in MEASURED])

    def acted(self, action: Floats) -> None:
        """Add the network's action for the last observation. (12,)."""
        self._actions = np.concatenate([self._actions[1:], action[None]])


def _pushed(history: Floats | None, sample: Floats) -> Floats:
    if history is None:
        return np.tile(sample, (HISTORY, 1))
    return np.concatenate([history[1:], sample[None]])


def finite(what: str, value: ArrayLike, shape: tuple[int, ...]) -> Floats:
    """`value` as float32; an ArtefactError names it `what` if it is not finite or of that shape."""
    given = np.asarray(value)
    if given.shape != shape:
        raise ArtefactError(f"{what} has the shape {given.shape}; expected {shape}.")
    with np.errstate(over="ignore"):  # overflow gives infinity, which is refused
        array = given.astype(np.float32, copy=False)
        flat = array.ravel()
        # A finite sum of squares has finite parts; this is the fastest check.
        if math.isfinite(flat.dot(flat)):
            return array
    for index in np.argwhere(~np.isfinite(array)):
        where = ", ".join(map(str, index))
        raise ArtefactError(
            f"{what} is {array[tuple(index)]} at [{where}]; a policy reads finite numbers only."
        )
    return array
