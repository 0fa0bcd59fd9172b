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
from pronk.virtual.imu_motion import Motion
from pronk.virtual.noise import NoiseSource
from pronk.virtual.quaternion import product
from pronk.virtual.sim_params import SimParams

Array = NDArray[np.float64]


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
        """Start the noise anew.

        Args:
            robot: Names, gears and default pose.
            sim_params: Noise, delays, encoders, attitude filter.
            joints: The joints that are present, in file order.
            rate_hz: States per second.
            seed: Of all noise.
        """
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
