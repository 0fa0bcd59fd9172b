"""What the sensors of the virtual robot say of what is true.

Encoders sit on the rotors and have the grid of their bits seen through the gear; their mounts
shake slowly (coloured noise). Speed is the drive's own first difference of that grid. Torque is
current times the constant that the drive believes. Timestamps jitter.

A block of ticks is read at once. Noise is drawn one row per tick, so that reading the same ticks
in other blocks gives the same numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.hardware.machine import State
from pronk.hardware.truth import JointTruth, MachineTruth
from pronk.robots.robot import Robot

Array = NDArray[np.float64]

_GRAVITY = 9.81


@dataclass(frozen=True)
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
    tilt: Array
    """Roll, pitch and yaw of the body on its stand [rad], shape (n, 3)."""
    tilt_rate: Array
    """[rad/s], shape (n, 3)"""


class Sensors:
    """Turns true values into states. Keeps the state of the noise between blocks."""

    def __init__(
        self,
        robot: Robot,
        machine: MachineTruth,
        joints: dict[str, JointTruth],
        *,
        rate_hz: float,
        seed: int,
    ) -> None:
        """Start the noise anew.

        Args:
            robot: Names, gears and default pose.
            machine: Noise, delays, encoders.
            joints: The joints that are present, in file order.
            rate_hz: States per second.
            seed: Of all noise.
        """
        self._machine = machine
        self._period = 1.0 / rate_hz
        self._rng = np.random.default_rng(seed)
        names = robot.joint_names
        self._columns = np.array([names.index(name) for name in joints], dtype=np.intp)
        self._default = np.array([joint.default_position for joint in robot.joints])
        self._offset = np.array([joint.encoder_offset for joint in joints.values()])
        self._scale = np.array([joint.torque_scale for joint in joints.values()])
        gears = np.array([robot.joint(name).drive.gear_ratio for name in joints])
        self._count = 2.0 * math.pi / 2.0**machine.encoder_bits / gears
        self._mount = np.zeros(len(names))
        self._sequence = 0

    @property
    def sequence(self) -> int:
        """Number of the next state."""
        return self._sequence

    def read(self, raw: Raw) -> list[State]:
        """The states of a block of ticks, joints that are absent at rest in the default pose."""
        machine, n, total = self._machine, len(raw.tick), len(self._default)
        draws = self._rng.standard_normal((n, 3 * total + 8))
        mount, fast, current = (draws[:, k * total : (k + 1) * total] for k in range(3))
        if self._sequence == 0:
            draws[0, -2:] = 0.0  # the clock starts with the first state
        # Clipped so that neither may ever put two states out of order.
        most = 0.4 * self._period
        jitter = np.clip(machine.sampling_jitter_s * draws[:, -1], -most, most)
        stamp = raw.tick + jitter
        stamp += np.clip(machine.timestamp_error_s * draws[:, -2], -most / 8, most / 8)
        # To first order from the physics step to the instant of sampling, at most half a step plus
        # the jitter away: 1e-5 rad of error at 500 rad/s^2.
        late = raw.tick - machine.measurement_delay_s + jitter - raw.instant
        angle = raw.angle + raw.speed * late[:, None] + self._offset
        shaken = angle + self._shake(mount)[:, self._columns]
        position = np.tile(self._default, (n, 1))
        position[:, self._columns] = np.rint(shaken / self._count) * self._count
        velocity, torque = np.zeros((n, total)), np.zeros((n, total))
        velocity[:, self._columns] = (
            self._difference(angle, raw.speed) + machine.velocity_noise * fast[:, self._columns]
        )
        torque[:, self._columns] = (
            raw.torque / self._scale + machine.torque_noise * current[:, self._columns]
        )
        gyro = raw.tilt_rate + np.array(machine.gyro_bias)
        gyro += machine.gyro_noise * draws[:, -8:-5]
        force = specific_force(raw.tilt) + np.array(machine.accelerometer_bias)
        force += machine.accelerometer_noise * draws[:, -5:-2]
        states = [
            State(
                time=float(stamp[row]),
                sequence=self._sequence + row,
                position=position[row],
                velocity=velocity[row],
                torque=torque[row],
                gyro=gyro[row],
                accelerometer=force[row],
                bus_voltage=float(raw.voltage[row]),
            )
            for row in range(n)
        ]
        self._sequence += n
        return states

    def _shake(self, normals: Array) -> Array:
        """First-order low-passed noise of the encoders' mounts [rad], shape (n, joints)."""
        corner = self._machine.position_noise_corner_hz
        keep = math.exp(-2.0 * math.pi * corner * self._period)
        fresh = self._machine.position_noise * math.sqrt(1.0 - keep**2) * normals
        shaken = np.empty_like(fresh)
        for row in range(len(fresh)):
            self._mount = keep * self._mount + fresh[row]
            shaken[row] = self._mount
        return shaken

    def _difference(self, angle: Array, speed: Array) -> Array:
        """First difference of the encoder's grid over the drive's window [rad/s]."""
        window = self._machine.velocity_window_s
        now = np.rint(angle / self._count)
        before = np.rint((angle - speed * window) / self._count)
        return np.asarray((now - before) * self._count / window)


def specific_force(tilt: Array) -> Array:
    """What an accelerometer at rest reads in the frame of a body with a small tilt [m/s^2].

    Args:
        tilt: Roll, pitch and yaw of the body [rad], shape (n, 3).
    """
    roll, pitch = tilt[:, 0], tilt[:, 1]
    return _GRAVITY * np.stack([-pitch, roll, np.ones_like(roll)], axis=1)
