"""Sensors of the virtual robot: states from true values.

Encoders are on the rotors, quantized by their bits divided by the gear ratio; their mounts vibrate
slowly (coloured noise). Speed is the drive's own first difference of the quantized angle. Torque is
current times the constant that the drive assumes. The accelerometer gives the mean since the last
state, as a unit that integrates does. The attitude filter has a constant error, a slowly varying
one, and an arbitrary heading. Timestamps jitter.

Reading the same ticks in other blocks gives the same numbers. Quaternions are rows w, x, y, z;
their algebra is written out here, for a general library is slow on the few rows of a block.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from pronk.arrays import Array
from pronk.jump.virtual.plant import Plant, RawStates
from pronk.jump.virtual.sim_params import SimParams
from pronk.robots.machine import State
from pronk.robots.robot import RobotSpec

_GRAVITY = 9.81
_AHEAD = 512  # ticks of noise that are computed at once

# Row k: what Hamilton's product makes of part k of its left factor.
_FACTORS = np.array([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]])
_SIGNS = np.array([[1.0, 1, 1, 1], [-1, 1, -1, 1], [-1, 1, 1, -1], [-1, -1, 1, 1]])
_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])


def product(a: Array, b: Array) -> Array:
    """The rotations `b`, then `a`: Hamilton's product. (n, 4) each."""
    both: Array = np.add.reduce(a[:, :, None] * (b.take(_FACTORS, axis=1) * _SIGNS), axis=1)
    return both


def of_vector(rotation: Array) -> Array:
    """Rotation vectors of any size as quaternions. (n, 3) [rad] to (n, 4)."""
    half = 0.5 * rotation
    # Never 0, so that sin(x) / x is 1 there.
    angle = np.sqrt((half * half).sum(axis=1, keepdims=True) + 1e-300)
    return np.concatenate([np.cos(angle), half * (np.sin(angle) / angle)], axis=1)


def about_z(yaw: Array) -> Array:
    """Rotations about the vertical. (n,) [rad] to (n, 4)."""
    turn = np.zeros((len(yaw), 4))
    turn[:, 0], turn[:, 3] = np.cos(0.5 * yaw), np.sin(0.5 * yaw)
    return turn


def turned_back(q: Array, v: Array) -> Array:
    """World vectors in the frames of bodies, R(q)^T v. (n, 4) and (n, 3) to (n, 3)."""
    w, u = q[:, :1], q[:, 1:]
    # v - 2 w (u x v) + 2 u x (u x v), since the inverse has -u.
    cross = _cross(u, v)
    turned: Array = v - 2.0 * (w * cross - _cross(u, cross))
    return turned


def _cross(a: Array, b: Array) -> Array:
    ahead = a.take(_NEXT, axis=1) * b.take(_LAST, axis=1)
    across: Array = ahead - a.take(_LAST, axis=1) * b.take(_NEXT, axis=1)
    return across


def moving_force(velocity: Array, orientation: Array, period_s: float) -> Array:
    """Mean reading of an accelerometer between instants, in the body's frame (n, 3) [m/s^2].

    The change of `velocity` (world frame, (n + 1, 3) [m/s]) less that by gravity, turned into the
    frame halfway; `orientation` is body to world, (n + 1, 4).
    """
    force = (velocity[1:] - velocity[:-1]) / period_s
    force[:, 2] += _GRAVITY
    # Not normalized: the mean of two orientations 0.02 rad apart is short of 1 by 1e-5.
    return turned_back(0.5 * (orientation[1:] + orientation[:-1]), force)


class Noise(NamedTuple):
    """Errors of the sensors at n ticks, for all joints of the robot."""

    jitter: Array  # of the instant of sampling about its tick [s], (n,)
    stamp: Array  # of the timestamp beyond that [s], (n,)
    position: Array  # [rad], (n, joints)
    velocity: Array  # [rad/s], (n, joints)
    torque: Array  # [N m], (n, joints)
    gyro: Array  # with its bias [rad/s], (n, 3)
    force: Array  # with its bias [m/s^2], (n, 3)
    tilt: Array  # rotation of the attitude in the trunk's frame, quaternion, (n, 4)
    heading: Array  # rotation of the attitude about the vertical, quaternion, (n, 4)


class NoiseSource:
    """Noise of a seed, tick after tick."""

    def __init__(self, sim_params: SimParams, joints: int, *, rate_hz: float, seed: int) -> None:
        self._machine, self._filter = machine, off = sim_params.machine, sim_params.attitude
        self._joints, self._period = joints, 1.0 / rate_hz
        self._rng = np.random.default_rng(seed)
        # A stream of its own: noise of the joints does not depend on the attitude's.
        self._attitude_rng = np.random.default_rng([seed, 1])
        self._yaw = self._attitude_rng.uniform(-math.pi, math.pi)
        # Share of the slow noise that is left after a tick, and size of what is added.
        each = [joints, 3]
        corner = np.repeat([machine.position_noise_corner_hz, off.noise_corner_hz], each)
        self._keep = np.exp(-2.0 * math.pi * corner * self._period)
        size = np.repeat([machine.position_noise, off.noise], each)
        self._fresh = size * np.sqrt(1.0 - self._keep**2)
        self._last = np.zeros(joints + 3)
        self._drawn = 0
        self._table = self._draw(_AHEAD)

    def take(self, count: int) -> Noise:
        """The noise of the next `count` ticks."""
        if (lacking := count - len(self._table.jitter)) > 0:
            more = self._draw(max(lacking, _AHEAD))
            self._table = Noise(*map(np.concatenate, zip(self._table, more, strict=True)))
        taken = Noise(*(part[:count] for part in self._table))
        self._table = Noise(*(part[count:] for part in self._table))
        return taken

    def _draw(self, n: int) -> Noise:
        machine, off, joints = self._machine, self._filter, self._joints
        draws = self._rng.standard_normal((n, 3 * joints + 8))
        if self._drawn == 0:
            draws[0, -2:] = 0.0  # the clock starts with the first state
        mount, fast, current = (draws[:, k * joints : (k + 1) * joints] for k in range(3))
        # Clipped so that neither may ever put two states out of order.
        most = 0.4 * self._period
        normals = self._attitude_rng.standard_normal((n, 3))
        slow: Array = self._fresh * np.concatenate([mount, normals], axis=1)
        last = self._last
        for row in slow:  # low-passed
            row += self._keep * last
            last = row
        self._last = last.copy()
        ticks = np.arange(self._drawn, self._drawn + n) * self._period
        self._drawn += n
        return Noise(
            jitter=np.clip(machine.sampling_jitter_s * draws[:, -1], -most, most),
            stamp=np.clip(machine.timestamp_error_s * draws[:, -2], -most / 8, most / 8),
            position=slow[:, :joints],
            velocity=machine.velocity_noise * fast,
            torque=machine.torque_noise * current,
            gyro=machine.gyro_noise * draws[:, -8:-5] + np.array(machine.gyro_bias),
            force=machine.accelerometer_noise * draws[:, -5:-2]
            + np.array(machine.accelerometer_bias),
            tilt=of_vector(slow[:, joints:] + np.array(off.bias)),
            heading=about_z(np.asarray(self._yaw + off.yaw_drift * ticks, dtype=np.float64)),
        )


class Sensors:
    """Makes states of true values, with the noise of a seed."""

    def __init__(
        self, robot: RobotSpec, sim_params: SimParams, plant: Plant, *, rate_hz: float, seed: int
    ) -> None:
        self._machine, self._plant = sim_params.machine, plant
        self._period, self._free = 1.0 / rate_hz, len(plant.feet) > 0
        self._default = np.array([joint.default_position for joint in robot.joints])
        self._scale = np.array([sim_params.joints[name].torque_scale for name in plant.joints])
        gears = np.array([robot.joint(name).drive.gear_ratio for name in plant.joints])
        self._count = 2.0 * math.pi / 2.0**self._machine.encoder_bits / gears
        self._noise = NoiseSource(sim_params, len(robot.joints), rate_hz=rate_hz, seed=seed)
        self._trunk: Array | None = None  # its orientation and velocity at the last state
        self.sequence = 0  # of the next state

    def read(self, tick: Array, instant: Array, raw: RawStates) -> list[State]:
        """Make the states of n ticks [s]; absent joints rest in their pose.

        `instant` and `raw` are of the physics steps nearest to the measurements [s].
        """
        plant, noise = self._plant, self._noise.take(len(tick))
        stamp = tick + noise.jitter + noise.stamp
        # To first order from the physics step to the instant of sampling, at most half a step plus
        # the jitter away: 1e-5 rad of error at 500 rad/s^2.
        late = tick - self._machine.measurement_delay_s + noise.jitter - instant
        true = raw.position.take(plant.rotor_qpos, axis=1)
        speed = raw.velocity.take(plant.rotor, axis=1)
        angle = true + speed * late[:, None] + plant.encoder_offset
        shaken = angle + noise.position[:, plant.columns]
        position = np.rint(shaken / self._count) * self._count
        # First difference of the quantized angle over the drive's window.
        window = self._machine.velocity_window_s
        before = np.rint((angle - speed * window) / self._count)
        velocity = (np.rint(angle / self._count) - before) * self._count / window
        velocity += noise.velocity[:, plant.columns]
        torque = raw.torque / self._scale + noise.torque[:, plant.columns]
        true_orientation, rate, force = self._motion(raw)
        first, self.sequence = self.sequence, self.sequence + len(tick)
        columns: dict[str, Any] = {
            "time": stamp.tolist(),
            "sequence": range(first, self.sequence),
            "position": self._spread(position, self._default),
            "velocity": self._spread(velocity, 0.0),
            "torque": self._spread(torque, 0.0),
            "gyro": rate + noise.gyro,
            "accelerometer": force + noise.force,
            "bus_voltage": raw.voltage.tolist(),
            "orientation": product(noise.heading, product(true_orientation, noise.tilt)),
        }
        rows = zip(*columns.values(), strict=True)
        return [State(**dict(zip(columns, row, strict=True))) for row in rows]

    def _motion(self, raw: RawStates) -> tuple[Array, Array, Array]:
        """Orientation (n, 4), rate (n, 3) and specific force (n, 3) of the trunk."""
        if self._free:
            orientation = raw.position[:, 3:7]
            now = np.concatenate([orientation, raw.velocity[:, :3]], axis=1)
            path = np.concatenate([now[:1] if self._trunk is None else self._trunk, now])
            self._trunk = now[-1:]
            force = moving_force(path[:, 4:], path[:, :4], self._period)
            return orientation, raw.velocity[:, 3:6], force
        tilt = rate = np.zeros((len(raw.position), 3))
        if len(stand := self._plant.stand):
            tilt, rate = raw.position[:, stand], raw.velocity[:, stand]
        roll, pitch, _ = tilt.T  # small
        force = _GRAVITY * np.stack([-pitch, roll, np.ones_like(roll)], axis=1)
        return of_vector(tilt), rate, force

    def _spread(self, values: Array, absent: Array | float) -> Array:
        """Columns of all joints, those that are absent with a value of their own."""
        if len(self._plant.columns) == len(self._default):
            return values
        whole = np.empty((len(values), len(self._default)))
        whole[:] = absent
        whole[:, self._plant.columns] = values
        return whole
