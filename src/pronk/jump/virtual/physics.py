"""Simulation of a plant: commands arrive, the battery sags, samples of the capture are kept.

Time is counted in physics steps from the clock's zero.
"""

from __future__ import annotations

import itertools
import math
from collections import deque

import mujoco
import numpy as np

from pronk.arrays import Array
from pronk.errors import HardwareError
from pronk.jump.virtual.capture import Capture, capture_of
from pronk.jump.virtual.plant import Plant
from pronk.jump.virtual.sim_params import MachineParams
from pronk.robots.machine import Command, damping_command

_LEAST_SHARE = -0.5  # bounds the bus voltage at twice the battery's, also where numbers run away


class Transport:
    """Commands under way, in order of arrival; damping follows one that expires.

    That is at `made + valid_for`, later by the delay, unless a newer command has replaced it.
    """

    def __init__(self, joints: int, delay_s: float, step_s: float) -> None:
        self._sinking = damping_command(joints)
        self._delay, self._step = delay_s, step_s
        self._under_way: deque[tuple[int, Command]] = deque()
        self._expiry = math.inf

    def put(self, command: Command, now: float) -> None:
        """Send a command at a time on the machine's clock [s]."""
        self._under_way.append((round((now + self._delay) / self._step), command))

    @property
    def soonest(self) -> float:
        """Physics step at which the next command takes effect; infinite without one."""
        return min(self._under_way[0][0], self._expiry) if self._under_way else self._expiry

    def take(self, before: int) -> tuple[int, Command] | None:
        """The next command that takes effect before a step, and when; None without one."""
        step = self._under_way[0][0] if self._under_way else before
        # At the same step the newer command wins: it is taken after the expiry.
        if self._expiry <= step and self._expiry < before:
            expired, self._expiry = int(self._expiry), math.inf
            return expired, self._sinking
        if step >= before:
            return None
        _, command = self._under_way.popleft()
        end = command.made + command.valid_for
        self._expiry = round((end + self._delay) / self._step) if math.isfinite(end) else math.inf
        return step, command


class Physics:
    """One run of a plant, with a capture of it."""

    def __init__(
        self,
        plant: Plant,
        machine: MachineParams,
        *,
        pose: Array,
        first_step: int,
        capture_rate_hz: float | None = None,
    ) -> None:
        """Begin with links and rotors in a pose of all joints [rad] and the drives off."""
        self.plant, self._machine = plant, machine
        self.data = mujoco.MjData(plant.model)
        self.step = self._first = first_step
        self._dt = float(plant.model.opt.timestep)
        self.capture_rate_hz = capture_rate_hz
        self._sampled: list[int] = []  # physics steps of the samples of the capture
        self._samples = [np.empty((0, plant.state_size))]  # raw states, block after block
        self.transport = Transport(len(pose), machine.command_delay_s, self._dt)
        self._voltage = machine.bus_voltage
        self._gains = b""
        self._qvel, self._act = self.data.qvel, self.data.act  # views
        plant.inverters[:] = self._voltage
        self.data.qpos[plant.rotor_qpos] = self.data.qpos[plant.link_qpos] = pose[plant.columns]
        plant.set_clamps((), self.data.qpos, 0.0, 0.0)

    def apply(self, command: Command) -> None:
        """Set the drives' targets, through encoders that may be off, and gains."""
        plant = self.plant
        position = np.asarray(command.position, dtype=float)[plant.columns]
        self.data.ctrl[plant.actuator] = position - plant.encoder_offset
        gains = np.asarray([command.stiffness, command.damping], dtype=float)
        # A policy repeats the same gains with every command.
        if (packed := gains.tobytes()) != self._gains:
            self._gains = packed
            plant.set_gains(*gains[:, plant.columns])

    def run(self, steps: list[int]) -> Array:
        """Advance over rising physics steps; return the raw states there, (n, state_size)."""
        plant, data, wanted = self.plant, self.data, set(steps)
        due = self._samples_due(steps[-1])
        # A sample and a state of the same step are read once.
        stops = sorted(steps + [step for step in due if step not in wanted])
        rows = np.empty((len(stops), plant.state_size))
        next_due = self.transport.soonest
        for stop, row in zip(stops, rows, strict=True):
            if next_due < stop:
                while arrived := self.transport.take(stop):
                    self._step_to(arrived[0])
                    self.apply(arrived[1])
                next_due = self.transport.soonest
            self._step_to(stop)
            plant.read(data, self._voltage, row)
            if stop in wanted:
                self._sag()
        # MuJoCo starts over, its time at 0, where numbers run away.
        if data.time < (self.step - self._first - 0.5) * self._dt:
            raise HardwareError(
                f"the virtual robot's physics ran away by {self.step * self._dt:.3f} s at a step "
                f"of {self._dt:g} s; look for an extreme number in its parameters or a command's "
                "gains."
            )
        if due:
            self._sampled += due
            self._samples.append(rows[np.searchsorted(stops, due)])
        return rows if len(stops) == len(steps) else rows[[stop in wanted for stop in stops]]

    def _samples_due(self, last: int) -> list[int]:
        """Physics steps of the samples still to be taken, up to and with one step."""
        due: list[int] = []
        if self.capture_rate_hz is not None:
            period = 1.0 / self.capture_rate_hz
            for number in itertools.count(len(self._sampled)):
                if (step := round(number * period / self._dt)) > last:
                    break
                due.append(step)
        return due

    def capture(self) -> Capture:
        """All samples."""
        times = self._dt * np.array(self._sampled, dtype=np.float64)
        return capture_of(self.plant, times, np.concatenate(self._samples))

    def snapshot(self) -> Capture:
        """One sample of a capture, of now."""
        row = np.empty((1, self.plant.state_size))
        self.plant.read(self.data, self._voltage, row[0])
        return capture_of(self.plant, np.array([self.step * self._dt]), row)

    def _step_to(self, step: int) -> None:
        if step > self.step:
            mujoco.mj_step(self.plant.model, self.data, step - self.step)
            self.step = step

    def _sag(self) -> None:
        """Update the bus voltage from the power P that the motors draw (or return).

        V = U - R P / V, with P taken as proportional to V^2 about the last V, as it is for drives
        at their voltage limit; with P constant the iteration would oscillate. Both have the same
        fixed point.
        """
        plant, machine = self.plant, self._machine
        torque, speed = plant.motor_torque(self._act), self._qvel.take(plant.rotor)
        current = torque / plant.constant
        power = float(torque.dot(speed) + (current * current).dot(plant.resistance))
        share = machine.bus_resistance * power / self._voltage**2
        sagged = machine.bus_voltage / (1.0 + max(share, _LEAST_SHARE))
        # A battery's power is largest at half its voltage.
        self._voltage = max(sagged, 0.5 * machine.bus_voltage)
        plant.inverters[:] = self._voltage
