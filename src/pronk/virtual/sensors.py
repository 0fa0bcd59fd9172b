"""What the sensors of the virtual robot say of what is true.

Encoders sit on the rotors and have the grid of their bits seen through the gear; their mounts
shake slowly (coloured noise). Speed is the drive's own first difference of that grid. Torque is
current times the constant that the drive believes. The accelerometer gives the mean over the time
since the last state, as a unit that integrates inside does. The attitude filter is off by a
constant, by something that wanders, and by a heading that starts anywhere. Timestamps jitter.

A block of ticks is read at once; reading the same ticks in other blocks gives the same numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.links.machine import State
from pronk.robots.robot import Robot
from pronk.virtual.plant import Plant
from pronk.virtual.quaternion import about_z, of_vector, product, turned_back
from pronk.virtual.sim_params import SimParams

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
        """Of a rigid stand, for as many instants as last time."""

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
        """Begin at rest, with a period between instants [s]."""
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
    """Reading of an accelerometer at rest at small tilts (roll, pitch, yaw) (n, 3) [rad, m/s^2]."""
    roll, pitch = tilt[:, 0], tilt[:, 1]
    return _GRAVITY * np.stack([-pitch, roll, np.ones_like(roll)], axis=1)


def moving_force(velocity: Array, orientation: Array, period_s: float) -> Array:
    """Mean reading of an accelerometer between instants, in the body's frame (n, 3) [m/s^2].

    The change of velocity less that by gravity, turned into the frame halfway; a unit that
    integrates inside, as good ones do, gives this mean.

    Args:
        velocity: World frame [m/s], shape (n + 1, 3).
        orientation: Body to world, unit quaternions w, x, y, z, shape (n + 1, 4).
        period_s: Between instants [s].
    """
    force = (velocity[1:] - velocity[:-1]) / period_s
    force[:, 2] += _GRAVITY
    # Not normalized: the mean of two orientations 0.02 rad apart is short of 1 by 1e-5.
    return turned_back(0.5 * (orientation[1:] + orientation[:-1]), force)


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
        """Start the noise of all `joints` anew, at a rate [Hz], from a seed."""
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


@dataclass(frozen=True, kw_only=True)
class Raw:
    """True values at the physics steps nearest to a block of ticks. Joints: those present."""

    tick: Array
    """Nominal instants of the states on the machine's clock [s], shape (n,)."""
    instant: Array
    """Instants of the physics steps on the same clock [s], shape (n,)."""
    angle: Array
    """Of the rotors [rad], shape (n, present)."""
    speed: Array
    """Of the rotors [rad/s], shape (n, present)."""
    torque: Array
    """Of the motors, without friction [N m], shape (n, present)."""
    voltage: Array
    """Of the bus [V], shape (n,)."""
    motion: Motion
    """Of the trunk."""


class Sensors:
    """Turns true values into states."""

    def __init__(
        self,
        robot: Robot,
        sim_params: SimParams,
        joints: tuple[str, ...],
        *,
        rate_hz: float,
        seed: int,
    ) -> None:
        """Start anew, with the noise of a seed, for the joints that are present, in file order."""
        self._machine = machine = sim_params.machine
        names = robot.joint_names
        self._columns = np.array([names.index(name) for name in joints], dtype=np.intp)
        self._default = np.array([joint.default_position for joint in robot.joints])
        self._offset = np.array([sim_params.joints[name].encoder_offset for name in joints])
        self._scale = np.array([sim_params.joints[name].torque_scale for name in joints])
        gears = np.array([robot.joint(name).drive.gear_ratio for name in joints])
        self._count = 2.0 * math.pi / 2.0**machine.encoder_bits / gears
        self._noise = NoiseSource(sim_params, len(names), rate_hz=rate_hz, seed=seed)
        self._sequence = 0

    @property
    def sequence(self) -> int:
        """Number of the next state."""
        return self._sequence

    def read(self, raw: Raw) -> list[State]:
        """The states of a block of ticks, joints that are absent at rest in the default pose."""
        noise, total = self._noise.take(len(raw.tick)), len(self._default)
        stamp = raw.tick + noise.jitter + noise.stamp
        # To first order from the physics step to the instant of sampling, at most half a step plus
        # the jitter away: 1e-5 rad of error at 500 rad/s^2.
        late = raw.tick - self._machine.measurement_delay_s + noise.jitter - raw.instant
        angle = raw.angle + raw.speed * late[:, None] + self._offset
        shaken = angle + self._present(noise.position)
        position = np.rint(shaken / self._count) * self._count
        velocity = self._difference(angle, raw.speed)
        velocity += self._present(noise.velocity)
        torque = raw.torque / self._scale + self._present(noise.torque)
        if len(self._columns) < total:
            position = self._spread(position, self._default)
            velocity, torque = self._spread(velocity, 0.0), self._spread(torque, 0.0)
        gyro, force = raw.motion.rate + noise.gyro, raw.motion.force + noise.force
        orientation = product(noise.heading, product(raw.motion.orientation, noise.tilt))
        rows = (position, velocity, torque, gyro, force, orientation)
        states = [
            State(
                time=time,
                sequence=sequence,
                position=q,
                velocity=v,
                torque=t,
                gyro=rate,
                accelerometer=acceleration,
                bus_voltage=voltage,
                orientation=quaternion,
            )
            for sequence, (time, voltage, q, v, t, rate, acceleration, quaternion) in enumerate(
                zip(stamp.tolist(), raw.voltage.tolist(), *rows, strict=True), self._sequence
            )
        ]
        self._sequence += len(states)
        return states

    def _present(self, values: Array) -> Array:
        """Columns of the joints that are present."""
        return values if len(self._columns) == values.shape[1] else values[:, self._columns]

    def _spread(self, values: Array, absent: Array | float) -> Array:
        """Columns of all joints, those that are absent with a value of their own."""
        whole = np.empty((len(values), len(self._default)))
        whole[:] = absent
        whole[:, self._columns] = values
        return whole

    def _difference(self, angle: Array, speed: Array) -> Array:
        """First difference of the encoder's grid over the drive's window [rad/s]."""
        window = self._machine.velocity_window_s
        now = np.rint(angle / self._count)
        before = np.rint((angle - speed * window) / self._count)
        return np.asarray((now - before) * self._count / window)
