"""What sensors add to what is true, drawn ahead of time.

Noise is drawn one row per tick and computed for many ticks at once, so the control loop only takes
slices; the numbers of a tick do not depend on how ticks are taken.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.virtual.quaternion import about_z, of_vector
from pronk.virtual.sim_params import SimParams

Array = NDArray[np.float64]

_AHEAD = 512
"""Ticks that are computed at once."""


@dataclass(frozen=True, kw_only=True)
class Noise:
    """Errors of the sensors at n ticks; joints are all of the robot's."""

    jitter: Array
    """Of the instant of sampling about its tick [s]. (n,)"""
    stamp: Array
    """Of the timestamp beyond that [s]. (n,)"""
    position: Array
    """[rad]. (n, joints)"""
    velocity: Array
    """[rad/s]. (n, joints)"""
    torque: Array
    """[N m]. (n, joints)"""
    gyro: Array
    """With its bias [rad/s]. (n, 3)"""
    force: Array
    """With its bias [m/s^2]. (n, 3)"""
    tilt: Array
    """Rotation of the attitude in the trunk's frame, w, x, y, z. (n, 4)"""
    heading: Array
    """Rotation of the attitude about the vertical. (n, 4)"""


class NoiseSource:
    """Noise, tick after tick."""

    def __init__(self, sim_params: SimParams, joints: int, *, rate_hz: float, seed: int) -> None:
        """Start anew.

        Args:
            sim_params: How large everything is.
            joints: Of the robot.
            rate_hz: Ticks per second.
            seed: Of all noise.
        """
        self._machine, self._filter = sim_params.machine, sim_params.attitude
        self._joints = joints
        self._period = 1.0 / rate_hz
        self._rng = np.random.default_rng(seed)
        # A stream of its own: what the joints say does not depend on the attitude.
        self._attitude_rng = np.random.default_rng([seed, 1])
        self._yaw = self._attitude_rng.uniform(-math.pi, math.pi)
        # What is left of the slow noise after a tick, and how large what is added is.
        machine, off, each = sim_params.machine, sim_params.attitude, [joints, 3]
        corner = np.repeat([machine.position_noise_corner_hz, off.noise_corner_hz], each)
        self._keep = np.exp(-2.0 * math.pi * corner * self._period)
        size = np.repeat([machine.position_noise, off.noise], each)
        self._fresh = size * np.sqrt(1.0 - self._keep**2)
        self._last = np.zeros(joints + 3)
        self._drawn = 0
        # Columns side by side, so that a slice of rows is a slice of everything.
        widths = (1, 1, joints, joints, joints, 3, 3, 4, 4)
        ends = np.cumsum(widths).tolist()
        self._parts = [slice(end - width, end) for end, width in zip(ends, widths, strict=True)]
        self._table = np.empty((0, ends[-1]))
        self._next = 0

    def take(self, count: int) -> Noise:
        """The noise of the next `count` ticks."""
        if self._next + count > len(self._table):
            left = self._table[self._next :]
            self._table = np.concatenate([left, self._draw(max(count - len(left), _AHEAD))])
            self._next = 0
        rows = self._table[self._next : self._next + count]
        self._next += count
        jitter, stamp, position, velocity, torque, gyro, force, tilt, heading = (
            rows[:, part] for part in self._parts
        )
        return Noise(
            jitter=jitter[:, 0],
            stamp=stamp[:, 0],
            position=position,
            velocity=velocity,
            torque=torque,
            gyro=gyro,
            force=force,
            tilt=tilt,
            heading=heading,
        )

    def _draw(self, n: int) -> Array:
        """Rows of the table for the next n ticks."""
        machine, off, joints = self._machine, self._filter, self._joints
        draws = self._rng.standard_normal((n, 3 * joints + 8))
        if self._drawn == 0:
            draws[0, -2:] = 0.0  # the clock starts with the first state
        mount, fast, current = (draws[:, k * joints : (k + 1) * joints] for k in range(3))
        # Clipped so that neither may ever put two states out of order.
        most = 0.4 * self._period
        jitter = np.clip(machine.sampling_jitter_s * draws[:, -1], -most, most)
        stamp = np.clip(machine.timestamp_error_s * draws[:, -2], -most / 8, most / 8)
        normals = self._attitude_rng.standard_normal((n, 3))
        slow = self._low_passed(np.concatenate([mount, normals], axis=1))
        shake, wander = slow[:, :joints], slow[:, joints:]
        ticks = np.arange(self._drawn, self._drawn + n) * self._period
        self._drawn += n
        return np.concatenate(
            [
                jitter[:, None],
                stamp[:, None],
                shake,
                machine.velocity_noise * fast,
                machine.torque_noise * current,
                machine.gyro_noise * draws[:, -8:-5] + np.array(machine.gyro_bias),
                machine.accelerometer_noise * draws[:, -5:-2]
                + np.array(machine.accelerometer_bias),
                of_vector(wander + np.array(off.bias)),
                about_z(np.asarray(self._yaw + off.yaw_drift * ticks, dtype=np.float64)),
            ],
            axis=1,
        )

    def _low_passed(self, normals: Array) -> Array:
        """First-order low-passed noise, of the mounts and of the attitude, that goes on."""
        slow: Array = self._fresh * normals
        last = self._last
        for row in slow:
            row += self._keep * last
            last = row
        self._last = last.copy()
        return slow
