"""The virtual robot: a stand-in for hardware on the bench, and it says so (`virtual` is True).

Physics runs natively in blocks between the ticks of the log; Python only reads the raw state at a
tick, lets the battery sag, and turns each block of raw states into what sensors would have said.

The physics step is 0.25 ms, and that has converged: the Bode gains of hip_roll, hip_pitch and knee
differ by 0.004, 0.003 and 0.002 dB at most from those at 25 us (40 kHz, the rate of the robot's own
drives, S4) over 0.1 to 15 Hz, thanks to the second-order corrections that `plant.py` explains
(without them, 0.13 dB). A test holds it under 0.05 dB.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from pronk.errors import HardwareError
from pronk.hardware.machine import Command, State, TorqueKind
from pronk.hardware.plant import build_plant, legs_of
from pronk.hardware.sensors import Raw, Sensors
from pronk.hardware.truth import Truth
from pronk.robots.robot import Robot

Array = NDArray[np.float64]

TIMESTEP_S = 0.25e-3
"""Physics step; see the module's docstring for why it suffices."""
_SETTLE_S = 2.0
"""Time before the clock starts, in which the legs settle into their drives' hold."""
_SINK_DAMPING = 1.0
"""Damping of `damp` [N m s/rad]: a leg sinks from its pose in about a second."""


class VirtualRobot:
    """A robot of `robot`'s structure and `truth`'s imperfections. Implements `Machine`.

    The clock starts at 0 when connected, with every drive holding the default pose at the robot's
    own gains. Same truth and seed, same calls: same numbers, however `wait` is cut into pieces.
    """

    virtual = True
    torque_kind: TorqueKind = "measured"

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
        # Columns of the present joints in file order, and their truth.
        names = robot.joint_names
        self._columns = np.array([names.index(name) for name in self._plant.joints], dtype=np.intp)
        self._present = {name: truth.joints[name] for name in self._plant.joints}
        self._offset = np.array([joint.encoder_offset for joint in self._present.values()])
        self._default = np.array([joint.default_position for joint in robot.joints])
        self._open = False

    @property
    def joints(self) -> tuple[str, ...]:
        """Joints that are simulated, in file order."""
        return self._plant.joints

    def connect(self) -> None:
        """Start the clock, the drives holding the default pose."""
        robot, plant = self._robot, self._plant
        self._sensors = Sensors(
            robot, self._truth, self._present, rate_hz=self._rate, seed=self._seed
        )
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
        self._now = 0.0
        # Physics steps are counted from the clock's zero; settling happens before it.
        self._step = -round(_SETTLE_S / self._dt)
        self._open = True
        self._latest = self._run(1)[0]

    def now(self) -> float:
        """The machine's clock [s]."""
        self._check_open()
        return self._now

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
        count = math.floor(until * self._rate + 1e-6) + 1 - self._sensors.sequence
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
        self._enqueue(
            Command(position=self._default, stiffness=zeros, damping=zeros + _SINK_DAMPING)
        )

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
        plant, first = self._plant, self._sensors.sequence
        ticks = np.arange(first, first + count) / self._rate
        # What a state says was measured some time before its timestamp.
        steps = np.rint((ticks - self._truth.measurement_delay_s) / self._dt).astype(int)
        q, v, torque = (np.empty((count, len(plant.joints))) for _ in range(3))
        tilt, tilt_rate = np.zeros((count, 3)), np.zeros((count, 3))
        voltage = np.empty(count)
        for row in range(count):
            self._advance(int(steps[row]))
            q[row] = self._qpos[plant.rotor]
            v[row] = self._qvel[plant.rotor]
            torque[row] = plant.motor_torque(self._act)
            voltage[row] = self._voltage
            self._sag(torque[row], v[row])
            if len(plant.stand):
                tilt[row] = self._qpos[plant.stand]
                tilt_rate[row] = self._qvel[plant.stand]
        return self._sensors.read(
            Raw(ticks, steps * self._dt, q, v, torque, voltage, tilt, tilt_rate)
        )
