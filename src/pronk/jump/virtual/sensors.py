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
from typing import NamedTuple

import numpy as np

from pronk.arrays import Array
from pronk.jump.virtual.plant import Plant, RawStates
from pronk.jump.virtual.sim_params import SimParams
from pronk.robots.machine import State
from pronk.robots.robot import RobotSpec

_GRAVITY = 9.81  # [m/s^2]
_TICKS_AHEAD = 512  # ticks of noise that are computed at once

# Row k: what Hamilton's product makes of part k of its left factor.
_FACTORS = np.array([[0, 1, 2, 3], [1, 0, 3, 2], [2, 3, 0, 1], [3, 2, 1, 0]])
_SIGNS = np.array([[1.0, 1, 1, 1], [-1, 1, -1, 1], [-1, 1, 1, -1], [-1, -1, 1, 1]])
# Axes behind and before each axis, in the circle x, y, z.
_NEXT_AXIS = np.array([1, 2, 0])
_PREVIOUS_AXIS = np.array([2, 0, 1])


def product(a: Array, b: Array) -> Array:
    """Return the rotations `b`, then `a`: Hamilton's product. (n, 4) each."""
    rotation: Array = np.add.reduce(a[:, :, None] * (b.take(_FACTORS, axis=1) * _SIGNS), axis=1)
    return rotation


def of_vector(rotation: Array) -> Array:
    """Return rotation vectors of any size as quaternions. (n, 3) [rad] to (n, 4)."""
    half = 0.5 * rotation
    # Never 0, so that sin(x) / x is 1 there.
    angle = np.sqrt((half * half).sum(axis=1, keepdims=True) + 1e-300)
    return np.concatenate([np.cos(angle), half * (np.sin(angle) / angle)], axis=1)


def about_z(yaw: Array) -> Array:
    """Return rotations about the vertical. (n,) [rad] to (n, 4)."""
    rotation = np.zeros((len(yaw), 4))
    rotation[:, 0] = np.cos(0.5 * yaw)
    rotation[:, 3] = np.sin(0.5 * yaw)
    return rotation


def turned_back(q: Array, v: Array) -> Array:
    """Return world vectors in the frames of bodies, R(q)^T v. (n, 4) and (n, 3) to (n, 3)."""
    w = q[:, :1]
    u = q[:, 1:]
    # v - 2 w (u x v) + 2 u x (u x v), since the inverse has -u.
    cross = _cross(u, v)
    turned: Array = v - 2.0 * (w * cross - _cross(u, cross))
    return turned


def _cross(a: Array, b: Array) -> Array:
    """Return the cross products of rows. (n, 3) each."""
    positive = a.take(_NEXT_AXIS, axis=1) * b.take(_PREVIOUS_AXIS, axis=1)
    negative = a.take(_PREVIOUS_AXIS, axis=1) * b.take(_NEXT_AXIS, axis=1)
    cross: Array = positive - negative
    return cross


def moving_force(velocity: Array, orientation: Array, period_s: float) -> Array:
    """Compute the mean reading of an accelerometer between instants.

    It is the change of the velocity less that by gravity, turned into the frame halfway.

    Args:
        velocity: Velocity of the body at the instants, world frame [m/s], (n + 1, 3).
        orientation: Rotation from the body to the world at the instants, (n + 1, 4).
        period_s: Time between the instants [s].

    Returns:
        The readings in the body's frame [m/s^2], (n, 3).
    """
    force = (velocity[1:] - velocity[:-1]) / period_s
    force[:, 2] += _GRAVITY
    # Not normalized: the mean of two orientations 0.02 rad apart is short of 1 by 1e-5.
    return turned_back(0.5 * (orientation[1:] + orientation[:-1]), force)


class Noise(NamedTuple):
    """Errors of the sensors at n ticks, for all joints of the robot."""

    jitter: Array
    """Offset of the instant of sampling from its tick [s]. (n,)"""
    stamp: Array
    """Error of the timestamp beyond that [s]. (n,)"""
    position: Array
    """Errors of the angles [rad]. (n, joints)"""
    velocity: Array
    """Errors of the speeds [rad/s]. (n, joints)"""
    torque: Array
    """Errors of the torques [N m]. (n, joints)"""
    gyro: Array
    """Error of the gyroscope with its bias [rad/s]. (n, 3)"""
    force: Array
    """Error of the accelerometer with its bias [m/s^2]. (n, 3)"""
    tilt: Array
    """Rotation of the attitude in the trunk's frame, quaternion. (n, 4)"""
    heading: Array
    """Rotation of the attitude about the vertical, quaternion. (n, 4)"""


class NoiseSource:
    """Noise of a seed, tick after tick."""

    def __init__(self, sim_params: SimParams, joints: int, *, rate_hz: float, seed: int) -> None:
        """Begin at the first tick.

        Args:
            sim_params: Sizes of the errors.
            joints: Number of joints of the robot.
            rate_hz: Rate of the ticks [Hz].
            seed: Seed of all draws.
        """
        machine = sim_params.machine
        attitude = sim_params.attitude
        self._machine = machine
        self._imu = sim_params.imu
        self._attitude = attitude
        self._joints = joints
        self._period = 1.0 / rate_hz
        self._rng = np.random.default_rng(seed)
        # A stream of its own: noise of the joints does not depend on the attitude's.
        self._attitude_rng = np.random.default_rng([seed, 1])
        self._yaw = self._attitude_rng.uniform(-math.pi, math.pi)
        # Slow noise of the joints, then of the attitude's three axes: the share of it that remains
        # after a tick, and the size of what is added.
        counts = [joints, 3]
        corner_hz = np.repeat([machine.position_noise_corner_hz, attitude.noise_corner_hz], counts)
        self._remaining = np.exp(-2.0 * math.pi * corner_hz * self._period)
        size = np.repeat([machine.position_noise, attitude.noise], counts)
        self._added = size * np.sqrt(1.0 - self._remaining**2)
        self._slow = np.zeros(joints + 3)
        self._drawn_ticks = 0
        self._table = self._draw(_TICKS_AHEAD)

    def take(self, count: int) -> Noise:
        """Return the noise of the next `count` ticks."""
        lacking = count - len(self._table.jitter)
        if lacking > 0:
            addition = self._draw(max(lacking, _TICKS_AHEAD))
            joined = [np.concatenate(parts) for parts in zip(self._table, addition, strict=True)]
            self._table = Noise(*joined)
        taken = Noise(*(part[:count] for part in self._table))
        self._table = Noise(*(part[count:] for part in self._table))
        return taken

    def _draw(self, n: int) -> Noise:
        """Draw the noise of `n` further ticks."""
        machine = self._machine
        imu = self._imu
        attitude = self._attitude
        joints = self._joints
        draws = self._rng.standard_normal((n, 3 * joints + 8))
        if self._drawn_ticks == 0:
            draws[0, -2:] = 0.0  # the clock starts with the first state
        mount = draws[:, :joints]
        speed = draws[:, joints : 2 * joints]
        current = draws[:, 2 * joints : 3 * joints]
        attitude_draws = self._attitude_rng.standard_normal((n, 3))
        slow: Array = self._added * np.concatenate([mount, attitude_draws], axis=1)
        previous = self._slow
        for row in slow:  # low-passed
            row += self._remaining * previous
            previous = row
        self._slow = previous.copy()
        ticks = np.arange(self._drawn_ticks, self._drawn_ticks + n) * self._period
        self._drawn_ticks += n
        yaw = np.asarray(self._yaw + attitude.yaw_drift * ticks, dtype=np.float64)
        # Clipped so that neither may ever put two states out of order.
        largest = 0.4 * self._period
        jitter = np.clip(machine.sampling_jitter_s * draws[:, -1], -largest, largest)
        stamp = np.clip(machine.timestamp_error_s * draws[:, -2], -largest / 8, largest / 8)
        return Noise(
            jitter=jitter,
            stamp=stamp,
            position=slow[:, :joints],
            velocity=machine.velocity_noise * speed,
            torque=machine.torque_noise * current,
            gyro=imu.gyro_noise * draws[:, -8:-5] + np.array(imu.gyro_bias),
            force=imu.accelerometer_noise * draws[:, -5:-2] + np.array(imu.accelerometer_bias),
            tilt=of_vector(slow[:, joints:] + np.array(attitude.bias)),
            heading=about_z(yaw),
        )


class Sensors:
    """Makes states of true values, with the noise of a seed."""

    def __init__(
        self, robot: RobotSpec, sim_params: SimParams, plant: Plant, *, rate_hz: float, seed: int
    ) -> None:
        """Begin at the first tick.

        Args:
            robot: The robot.
            sim_params: Errors of the sensors.
            plant: The plant whose states are measured.
            rate_hz: Rate of the states [Hz].
            seed: Seed of all noise.
        """
        self._machine = sim_params.machine
        self._plant = plant
        self._period = 1.0 / rate_hz
        self._is_free = len(plant.feet) > 0
        self._default = np.array([joint.default_position for joint in robot.joints])
        self._scale = np.array([sim_params.joints[name].torque_scale for name in plant.joints])
        gear_ratio = np.array([robot.joint(name).drive.gear_ratio for name in plant.joints])
        # Angle of a joint for each count of its encoder [rad].
        self._count = 2.0 * math.pi / 2.0**self._machine.encoder_bits / gear_ratio
        self._noise = NoiseSource(sim_params, len(robot.joints), rate_hz=rate_hz, seed=seed)
        self._trunk: Array | None = None  # its orientation and velocity at the last state
        self.sequence = 0
        """Sequence number of the next state."""

    def read(self, tick: Array, instant: Array, raw: RawStates) -> list[State]:
        """Make the states of n ticks; absent joints rest in their pose.

        Args:
            tick: Times of the ticks [s], (n,).
            instant: Times of the physics steps nearest to the measurements [s], (n,).
            raw: Raw states at these physics steps.
        """
        plant = self._plant
        machine = self._machine
        noise = self._noise.take(len(tick))
        stamp = tick + noise.jitter + noise.stamp
        # To first order from the physics step to the instant of sampling, at most half a step plus
        # the jitter away: 1e-5 rad of error at 500 rad/s^2.
        lateness = tick - machine.measurement_delay_s + noise.jitter - instant
        rotor_angle = raw.position.take(plant.rotor_qpos, axis=1)
        speed = raw.velocity.take(plant.rotor, axis=1)
        angle = rotor_angle + speed * lateness[:, None] + plant.encoder_offset
        vibrating_angle = angle + noise.position[:, plant.columns]
        position = np.rint(vibrating_angle / self._count) * self._count
        # First difference of the quantized angle over the drive's window.
        window = machine.velocity_window_s
        count_before = np.rint((angle - speed * window) / self._count)
        velocity = (np.rint(angle / self._count) - count_before) * self._count / window
        velocity += noise.velocity[:, plant.columns]
        torque = raw.torque / self._scale + noise.torque[:, plant.columns]
        true_orientation, rate, force = self._motion(raw)
        position = self._of_all_joints(position, self._default)
        velocity = self._of_all_joints(velocity, 0.0)
        torque = self._of_all_joints(torque, 0.0)
        gyro = rate + noise.gyro
        accelerometer = force + noise.force
        orientation = product(noise.heading, product(true_orientation, noise.tilt))
        times = stamp.tolist()
        voltages = raw.voltage.tolist()
        states = []
        for i in range(len(tick)):
            states.append(
                State(
                    time=times[i],
                    sequence=self.sequence + i,
                    position=position[i],
                    velocity=velocity[i],
                    torque=torque[i],
                    gyro=gyro[i],
                    accelerometer=accelerometer[i],
                    bus_voltage=voltages[i],
                    orientation=orientation[i],
                )
            )
        self.sequence += len(tick)
        return states

    def _motion(self, raw: RawStates) -> tuple[Array, Array, Array]:
        """Return orientation (n, 4), rate (n, 3) and specific force (n, 3) of the trunk."""
        if self._is_free:
            orientation = raw.position[:, 3:7]
            trunk = np.concatenate([orientation, raw.velocity[:, :3]], axis=1)
            before = trunk[:1] if self._trunk is None else self._trunk
            path = np.concatenate([before, trunk])
            self._trunk = trunk[-1:]
            force = moving_force(path[:, 4:], path[:, :4], self._period)
            return orientation, raw.velocity[:, 3:6], force
        stand = self._plant.stand
        tilt = np.zeros((len(raw.position), 3))
        rate = tilt
        if len(stand):
            tilt = raw.position[:, stand]
            rate = raw.velocity[:, stand]
        roll, pitch, _ = tilt.T  # small
        force = _GRAVITY * np.stack([-pitch, roll, np.ones_like(roll)], axis=1)
        return of_vector(tilt), rate, force

    def _of_all_joints(self, values: Array, absent: Array | float) -> Array:
        """Spread columns over all joints of the robot; absent joints get values of their own."""
        if len(self._plant.columns) == len(self._default):
            return values
        spread = np.empty((len(values), len(self._default)))
        spread[:] = absent
        spread[:, self._plant.columns] = values
        return spread
