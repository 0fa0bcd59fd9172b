"""The virtual robot: a stand-in for hardware on the bench, and it says so (`virtual` is True).

Physics runs natively in blocks between the ticks of the log; Python only reads the raw state at a
tick, lets the battery sag, and turns each block of raw states into what sensors would have said.

The physics step is 0.25 ms, and that has converged: the Bode gain of a hip and of a knee differs
by less than 0.01 dB from that at 25 us (40 kHz, the rate of the robot's own drives, S4) over 0.1
to 15 Hz (`tests/test_virtual.py` holds it under 0.05 dB).
"""

from __future__ import annotations

import math
from collections import deque
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from pronk.errors import HardwareError
from pronk.hardware.machine import Command, State
from pronk.hardware.plant import build_plant, legs_of
from pronk.hardware.truth import Truth
from pronk.robots.robot import Robot

Array = NDArray[np.float64]

TIMESTEP_S = 0.25e-3
"""Physics step; see the module's docstring for why it suffices."""
_SETTLE_S = 2.0
"""Time before the clock starts, in which the legs settle into their drives' hold."""
_GRAVITY = 9.81
_SPIN_DAMPING = 1.0
"""Damping of `damp` [N m s/rad]: a leg sinks from its pose in about a second."""


class VirtualRobot:
    """A robot of `robot`'s structure and `truth`'s imperfections. Implements `Machine`.

    The clock starts at 0 when connected, with every drive holding the default pose at the robot's
    own gains. Same truth and seed, same calls: same numbers, however `wait` is cut into pieces.
    """

    virtual = True

    def __init__(
        self,
        robot: Robot,
        truth: Truth,
        *,
        seed: int = 0,
        base: Literal["bench"] = "bench",
        log_rate_hz: float = 500.0,
        legs: tuple[str, ...] | None = None,
        timestep_s: float = TIMESTEP_S,
    ) -> None:
        """Build the plant.

        Args:
            robot: Structure, masses, drives.
            truth: In what the machine differs.
            seed: Of all noise.
            base: `bench`: the body is fixed to its stand.
            log_rate_hz: States per second.
            legs: Legs to simulate; None for all. On a rigid bench legs do not feel each other, but
                for the sag of their common battery; joints of absent legs report their default
                position and no speed.
            timestep_s: Physics step.

        Raises:
            RobotError: The truth is not of this robot.
            HardwareError: A leg is unknown, or a rate impossible.
        """
        if base != "bench":
            raise HardwareError(f"base {base!r}; the virtual robot knows 'bench'.")
        known = legs_of(robot)
        for leg in legs or ():
            if leg not in known:
                raise HardwareError(f"{robot.name} has no leg {leg!r}; it has {', '.join(known)}.")
        if legs is not None and not legs:
            raise HardwareError(f"no legs; name at least one of {', '.join(known)}, or None.")
        if not 0.0 < timestep_s * log_rate_hz <= 1.0:
            raise HardwareError(
                f"log_rate_hz is {log_rate_hz:g}; expected above 0 and at most one state per "
                f"physics step ({1.0 / timestep_s:g} Hz)."
            )
        self.robot = robot.name
        self._robot = robot
        self._truth = truth.machine
        self._seed = seed
        self._rate = log_rate_hz
        self._dt = timestep_s
        self._plant = build_plant(robot, truth, legs or known, timestep_s)
        self._model = self._plant.model
        # Columns of the present joints in file order, and their true parameters.
        names = robot.joint_names
        self._columns = np.array([names.index(name) for name in self._plant.joints], dtype=np.intp)
        present = [truth.joints[name] for name in self._plant.joints]
        self._offset = np.array([joint.encoder_offset for joint in present])
        self._scale = np.array([joint.torque_scale for joint in present])
        gears = np.array([robot.joint(name).drive.gear_ratio for name in self._plant.joints])
        self._count = 2.0 * math.pi / 2.0**truth.machine.encoder_bits / gears
        self._default = np.array([joint.default_position for joint in robot.joints])
        self._open = False

    @property
    def joints(self) -> tuple[str, ...]:
        """Joints that are simulated, in file order."""
        return self._plant.joints

    def connect(self) -> None:
        """Start the clock, the drives holding the default pose."""
        robot, plant = self._robot, self._plant
        self._rng = np.random.default_rng(self._seed)
        self._data = mujoco.MjData(self._model)
        # Views, alive with the data.
        self._qpos, self._qvel, self._act = self._data.qpos, self._data.qvel, self._data.act
        self._data.qpos[plant.rotor] = self._data.qpos[plant.link] = self._default[self._columns]
        plant.set_clamps((), self._qpos, 0.0, 0.0)
        self._voltage = self._truth.bus_voltage
        plant.set_bus_voltage(self._voltage)
        self._apply(
            Command(
                position=self._default,
                stiffness=np.array([joint.stiffness for joint in robot.joints]),
                damping=np.array([joint.damping for joint in robot.joints]),
            )
        )
        self._pending: deque[tuple[int, Command]] = deque()
        self._mount = np.zeros(len(robot.joints))  # state of the coloured position noise
        self._now = 0.0
        self._sequence = 0
        # Physics steps are counted from the clock's zero; settling happens before it.
        self._step = -round(_SETTLE_S / self._dt)
        self._open = True
        self._latest = self._run(1)[0]

    def latest(self) -> State:
        """The newest state, without waiting."""
        self._check_open()
        return self._latest

    def wait(self, until: float) -> list[State]:
        """Let time pass to `until` on the machine's clock; return the states met on the way.

        Args:
            until: [s]. A time already past returns no states.
        """
        self._check_open()
        if not math.isfinite(until):
            raise HardwareError(f"wait until {until}; expected a finite time [s].")
        if until <= self._now:
            return []
        self._now = until
        # States with nominal times up to `until`; the slack forgives binary fractions.
        count = math.floor(until * self._rate + 1e-6) + 1 - self._sequence
        states = self._run(count) if count > 0 else []
        if states:
            self._latest = states[-1]
        return states

    def send(self, command: Command) -> None:
        """Put a command into force, after the transport delay.

        Raises:
            HardwareError: Wrong shape, not finite, or a negative gain.
        """
        self._check_open()
        shape = (len(self._robot.joints),)
        for name in ("position", "stiffness", "damping"):
            values = getattr(command, name)
            if np.shape(values) != shape or not np.isfinite(values).all():
                raise HardwareError(
                    f"command.{name} has shape {np.shape(values)} or is not finite; "
                    f"expected {shape} finite numbers, one per joint."
                )
            if name != "position" and (np.asarray(values) < 0.0).any():
                raise HardwareError(f"command.{name} is negative; the drives accept 0 or more.")
        self._enqueue(command)

    def clamp(self, joints: tuple[str, ...]) -> None:
        """Fix links where they are; () frees all.

        Raises:
            HardwareError: A joint is unknown.
        """
        self._check_open()
        for name in joints:
            if name not in self._robot.joint_names:
                raise HardwareError(
                    f"{self.robot} has no joint {name!r} to clamp; "
                    f"it has {', '.join(self._robot.joint_names)}."
                )
        self._plant.set_clamps(
            joints, self._qpos, self._truth.clamp_stiffness, self._truth.clamp_damping
        )

    def damp(self) -> None:
        """Let the joints sink softly: no stiffness, some damping."""
        self._check_open()
        zeros = np.zeros(len(self._robot.joints))
        self._enqueue(Command(position=self._default, stiffness=zeros, damping=zeros + _SPIN_DAMPING))

    def close(self) -> None:
        """Damp and close; closing twice does no harm."""
        if self._open:
            self.damp()
            self._open = False

    def _check_open(self) -> None:
        if not self._open:
            raise HardwareError("the virtual robot is not connected; call connect() first.")

    def _enqueue(self, command: Command) -> None:
        """Note when the drives will hear a command; kept in order of arrival."""
        arrival = round((self._now + self._truth.command_delay_s) / self._dt)
        self._pending.append((arrival, command))

    def _apply(self, command: Command) -> None:
        """Let the drives hear a command, through encoders that may be off."""
        columns = self._columns
        target = np.asarray(command.position, dtype=float)[columns] - self._offset
        self._data.ctrl[self._plant.actuator] = target
        self._plant.set_gains(
            np.asarray(command.stiffness, dtype=float)[columns],
            np.asarray(command.damping, dtype=float)[columns],
        )

    def _advance(self, to: int) -> None:
        """Step physics up to (not including) step number `to`, commands put in where due."""
        while self._pending and self._pending[0][0] < to:
            due, command = self._pending.popleft()
            if due > self._step:
                mujoco.mj_step(self._model, self._data, due - self._step)
                self._step = due
            self._apply(command)
        if to > self._step:
            mujoco.mj_step(self._model, self._data, to - self._step)
            self._step = to

    def _sag(self, torque: Array, speed: Array) -> None:
        """Let the bus voltage follow the power that the motors draw (or give back)."""
        plant = self._plant
        current = torque / plant.constant
        power = float(torque @ speed + (current * current) @ plant.resistance)
        self._voltage = self._truth.bus_voltage - self._truth.bus_resistance * power / self._voltage
        plant.set_bus_voltage(self._voltage)

    def _run(self, count: int) -> list[State]:
        """Advance over the next `count` ticks and return what the sensors say of them."""
        plant, truth = self._plant, self._truth
        total = len(self._robot.joints)
        # One row of normals per tick, so that the cutting of `wait` does not change the noise.
        draws = self._rng.standard_normal((count, 3 * total + 8))
        if self._sequence == 0:
            draws[0, -2:] = 0.0  # the clock starts with the first state
        ticks = np.arange(self._sequence, self._sequence + count) / self._rate
        jitter = np.clip(draws[:, -1] * truth.sampling_jitter_s, -0.4 / self._rate, 0.4 / self._rate)
        steps = np.rint((ticks - truth.measurement_delay_s) / self._dt).astype(int)
        width = len(plant.joints)
        q, v, torque = (np.empty((count, width)) for _ in range(3))
        stand = np.zeros((count, 6))
        voltage = np.empty(count)
        for row in range(count):
            self._advance(int(steps[row]))
            q[row] = self._qpos[plant.rotor]
            v[row] = self._qvel[plant.rotor]
            torque[row] = plant.motor_torque(self._act)
            voltage[row] = self._voltage
            self._sag(torque[row], v[row])
            if len(plant.stand):
                stand[row, :3] = self._qpos[plant.stand]
                stand[row, 3:] = self._qvel[plant.stand]
        sampled = ticks - truth.measurement_delay_s + jitter
        # To first order from the physics step to the instant of sampling, at most half a step plus
        # the jitter away: 1e-6 rad of error at 500 rad/s^2.
        q += v * (sampled - steps * self._dt)[:, None]
        stamps = sampled + truth.measurement_delay_s
        stamps += np.clip(
            draws[:, -2] * truth.timestamp_error_s, -0.05 / self._rate, 0.05 / self._rate
        )
        position = np.tile(self._default, (count, 1))
        position[:, self._columns] = self._encoder(q + self._offset, draws[:, :total])
        velocity = np.zeros((count, total))
        velocity[:, self._columns] = (
            self._difference(q + self._offset, v)
            + truth.velocity_noise * draws[:, total : 2 * total][:, self._columns]
        )
        reported = np.zeros((count, total))
        reported[:, self._columns] = (
            torque / self._scale
            + truth.torque_noise * draws[:, 2 * total : 3 * total][:, self._columns]
        )
        gyro, accelerometer = self._inertial(stand, draws[:, 3 * total : 3 * total + 6])
        states = [
            State(
                time=float(stamps[row]),
                sequence=self._sequence + row,
                position=position[row],
                velocity=velocity[row],
                torque=reported[row],
                gyro=gyro[row],
                accelerometer=accelerometer[row],
                bus_voltage=float(voltage[row]),
            )
            for row in range(count)
        ]
        self._sequence += count
        return states

    def _encoder(self, angle: Array, normals: Array) -> Array:
        """Readings: vibration of the mount, then the grid of the encoder, shape (n, present)."""
        keep = math.exp(-2.0 * math.pi * self._truth.position_noise_corner_hz / self._rate)
        fresh = self._truth.position_noise * math.sqrt(1.0 - keep**2) * normals
        mount = np.empty_like(fresh)
        for row in range(len(fresh)):
            self._mount = keep * self._mount + fresh[row]
            mount[row] = self._mount
        shaken = angle + mount[:, self._columns]
        return np.asarray(np.rint(shaken / self._count) * self._count)

    def _difference(self, angle: Array, speed: Array) -> Array:
        """First difference of the encoder's grid over the drive's window [rad/s]."""
        window = self._truth.velocity_window_s
        now = np.rint(angle / self._count)
        before = np.rint((angle - speed * window) / self._count)
        return np.asarray((now - before) * self._count / window)

    def _inertial(self, stand: Array, normals: Array) -> tuple[Array, Array]:
        """Gyro [rad/s] and accelerometer [m/s^2] of a body that at most rocks on its stand."""
        truth = self._truth
        roll, pitch = stand[:, 0], stand[:, 1]
        # Specific force at rest is -gravity; in the frame of the body, to first order in its tilt.
        force = _GRAVITY * np.stack([-pitch, roll, np.ones_like(roll)], axis=1)
        gyro = stand[:, 3:] + np.array(truth.gyro_bias) + truth.gyro_noise * normals[:, :3]
        force += np.array(truth.accelerometer_bias) + truth.accelerometer_noise * normals[:, 3:]
        return gyro, force
