"""What is true of the body that carries the inertial unit: on its stand, and free.

The unit sits at the origin of the trunk's frame, its axes along those of the trunk.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.virtual.plant import Plant
from pronk.virtual.quaternion import of_vector, turned_back

Array = NDArray[np.float64]

_GRAVITY = 9.81


@dataclass(frozen=True, kw_only=True)
class Motion:
    """Of the trunk, at n instants."""

    orientation: Array
    """Trunk to world, quaternions w, x, y, z. (n, 4)"""
    rate: Array
    """Angular velocity in the trunk's frame [rad/s]. (n, 3)"""
    force: Array
    """Specific force in the trunk's frame, its mean since the instant before [m/s^2]. (n, 3)"""


class StandingBody:
    """A body on the bench, still or on a stand that gives a little."""

    def __init__(self, plant: Plant) -> None:
        """Of a plant on the bench."""
        self._stand = plant.stand
        self._still: Motion | None = None
        """Of a rigid stand, as many instants as were last asked for."""

    def motion(self, qpos: Array, qvel: Array) -> Motion:
        """The motion at instants, from the plant's positions (n, nq) and velocities (n, nv)."""
        if len(self._stand):
            tilt = qpos[:, self._stand]
            rate = qvel[:, self._stand]
            return Motion(orientation=of_vector(tilt), rate=rate, force=resting_force(tilt))
        if self._still is None or len(self._still.rate) != len(qpos):
            tilt = np.zeros((len(qpos), 3))
            self._still = Motion(orientation=of_vector(tilt), rate=tilt, force=resting_force(tilt))
        return self._still


class FreeBody:
    """A body that moves freely. Keeps the last instant between blocks."""

    def __init__(self, period_s: float) -> None:
        """Begin at rest.

        Args:
            period_s: Between instants [s].
        """
        self._period = period_s
        self._last: Array | None = None

    def motion(self, qpos: Array, qvel: Array) -> Motion:
        """The motion at instants, from positions (n, nq) and velocities (n, nv), trunk first."""
        orientation, velocity = qpos[:, 3:7], qvel[:, :3]
        now = np.concatenate([orientation, velocity], axis=1)
        path = np.concatenate([now[:1] if self._last is None else self._last, now])
        self._last = now[-1:]
        force = moving_force(path[:, 4:], path[:, :4], self._period)
        return Motion(orientation=orientation, rate=qvel[:, 3:6], force=force)


def resting_force(tilt: Array) -> Array:
    """What an accelerometer at rest reads in the frame of a body with a small tilt [m/s^2].

    Args:
        tilt: Roll, pitch and yaw of the body [rad], shape (n, 3).
    """
    roll, pitch = tilt[:, 0], tilt[:, 1]
    return _GRAVITY * np.stack([-pitch, roll, np.ones_like(roll)], axis=1)


def moving_force(velocity: Array, orientation: Array, period_s: float) -> Array:
    """What an accelerometer reads on average between instants, in the body's frame [m/s^2].

    The change of velocity and what gravity would have made of it, turned into the frame halfway;
    a unit that integrates inside, as good ones do, gives this mean.

    Args:
        velocity: World frame [m/s], shape (n + 1, 3).
        orientation: Body to world, unit quaternions w, x, y, z, shape (n + 1, 4).
        period_s: Between instants [s].

    Returns:
        Shape (n, 3).
    """
    force = (velocity[1:] - velocity[:-1]) / period_s
    force[:, 2] += _GRAVITY
    # Not normalized: the mean of two orientations 0.02 rad apart is short of 1 by 1e-5.
    return turned_back(0.5 * (orientation[1:] + orientation[:-1]), force)
