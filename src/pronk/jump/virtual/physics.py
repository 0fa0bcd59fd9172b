"""Simulation of a plant: commands arrive, the battery sags, samples of the capture are kept.

Time is counted in physics steps from the clock's zero.
"""

from __future__ import annotations

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

_SMALLEST_SHARE = -0.5  # bounds the bus voltage at twice the battery's, also where numbers run away


class CommandQueue:
    """Commands under way, in order of arrival; damping follows a command that expires.

    A command expires at `made + valid_for`, later by the delay, unless a newer one has replaced it.
    """

    def __init__(self, joints: int, delay_s: float, step_s: float) -> None:
        """Begin without commands.

        Args:
            joints: Number of joints.
            delay_s: Time from sending a command to its effect [s].
            step_s: Duration of a physics step [s].
        """
        self._damping = damping_command(joints)
        self._delay = delay_s
        self._step = step_s
        self._under_way: deque[tuple[int, Command]] = deque()
        self._expiry = math.inf

    def put(self, command: Command, now: float) -> None:
        """Send a command at a time on the machine's clock [s]."""
        self._under_way.append((round((now + self._delay) / self._step), command))

    @property
    def soonest(self) -> float:
        """Physics step at which the next command takes effect; infinite without one."""
        if not self._under_way:
            return self._expiry
        return min(self._under_way[0][0], self._expiry)

    def take(self, before: int) -> tuple[int, Command] | None:
        """Return the next command that takes effect before a step, and when; None without one."""
        arrival = self._under_way[0][0] if self._under_way else before
        # At the same step the newer command wins: it is taken after the expiry.
        if self._expiry <= arrival and self._expiry < before:
            expired_at = int(self._expiry)
            self._expiry = math.inf
            return expired_at, self._damping
        if arrival >= before:
            return None
        _, command = self._under_way.popleft()
        end = command.made + command.valid_for
        self._expiry = math.inf
        if math.isfinite(end):
            self._expiry = round((end + self._delay) / self._step)
        return arrival, command


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
        """Begin with the drives off.

        Args:
            plant: The plant.
            machine: Timing and supply.
            pose: Angles of all joints of the robot, for links and rotors [rad].
            first_step: Physics step at which the run begins.
            capture_rate_hz: Rate of the capture [Hz]; None for none.
        """
        self.plant = plant
        self._machine = machine
        self.data = mujoco.MjData(plant.model)
        self.step = first_step
        self._first_step = first_step
        self._dt = float(plant.model.opt.timestep)
        self.capture_rate_hz = capture_rate_hz
        self._sampled: list[int] = []  # physics steps of the samples of the capture
        self._samples = [np.empty((0, plant.state_size))]  # raw states, block after block
        self.commands = CommandQueue(len(pose), machine.command_delay_s, self._dt)
        self._voltage = machine.bus_voltage
        self._gains = b""
        # Views of the data.
        self._qvel = self.data.qvel
        self._act = self.data.act
        plant.inverters[:] = self._voltage
        plant_pose = pose[plant.columns]
        self.data.qpos[plant.rotor_qpos] = plant_pose
        self.data.qpos[plant.link_qpos] = plant_pose
        plant.set_clamps((), self.data.qpos, 0.0, 0.0)

    def apply(self, command: Command) -> None:
        """Set the drives' targets, through encoders that may be off, and gains."""
        plant = self.plant
        position = np.asarray(command.position, dtype=float)[plant.columns]
        self.data.ctrl[plant.actuator] = position - plant.encoder_offset
        gains = np.asarray([command.stiffness, command.damping], dtype=float)
        # A policy repeats the same gains with every command.
        packed_gains = gains.tobytes()
        if packed_gains != self._gains:
            self._gains = packed_gains
            stiffness, damping = gains[:, plant.columns]
            plant.set_gains(stiffness, damping)

    def run(self, steps: list[int]) -> Array:
        """Advance over rising physics steps.

        Args:
            steps: Physics steps whose states are returned.

        Returns:
            The raw states there, (n, state_size).

        Raises:
            HardwareError: The physics ran away.
        """
        plant = self.plant
        data = self.data
        state_steps = set(steps)
        sample_steps = self._samples_due(steps[-1])
        # A sample and a state of the same step are read once.
        stops = sorted(state_steps.union(sample_steps))
        rows = np.empty((len(stops), plant.state_size))
        next_command = self.commands.soonest
        for stop, row in zip(stops, rows, strict=True):
            if next_command < stop:
                arrival = self.commands.take(stop)
                while arrival is not None:
                    step, command = arrival
                    self._step_to(step)
                    self.apply(command)
                    arrival = self.commands.take(stop)
                next_command = self.commands.soonest
            self._step_to(stop)
            plant.read(data, self._voltage, row)
            if stop in state_steps:
                self._sag()
        # MuJoCo starts over, its time at 0, where numbers run away.
        if data.time < (self.step - self._first_step - 0.5) * self._dt:
            raise HardwareError(
                f"the virtual robot's physics ran away by {self.step * self._dt:.3f} s at a step "
                f"of {self._dt:g} s; look for an extreme number in its parameters or a command's "
                "gains."
            )
        if sample_steps:
            self._sampled += sample_steps
            self._samples.append(rows[np.searchsorted(stops, sample_steps)])
        if len(stops) == len(steps):
            return rows
        return rows[np.searchsorted(stops, steps)]

    def _samples_due(self, end: int) -> list[int]:
        """Return the physics steps of the samples still to be taken, up to and with one step."""
        due: list[int] = []
        if self.capture_rate_hz is None:
            return due
        period = 1.0 / self.capture_rate_hz
        number = len(self._sampled)
        step = round(number * period / self._dt)
        while step <= end:
            due.append(step)
            number += 1
            step = round(number * period / self._dt)
        return due

    def capture(self) -> Capture:
        """Return all samples."""
        times = self._dt * np.array(self._sampled, dtype=np.float64)
        return capture_of(self.plant, times, np.concatenate(self._samples))

    def snapshot(self) -> Capture:
        """Return one sample of a capture, of now."""
        row = np.empty((1, self.plant.state_size))
        self.plant.read(self.data, self._voltage, row[0])
        return capture_of(self.plant, np.array([self.step * self._dt]), row)

    def _step_to(self, step: int) -> None:
        """Advance to a physics step, if it is not reached yet."""
        if step > self.step:
            mujoco.mj_step(self.plant.model, self.data, step - self.step)
            self.step = step

    def _sag(self) -> None:
        """Update the bus voltage from the power P that the motors draw (or return).

        V = U - R P / V, with P taken as proportional to V^2 about the last V, as it is for drives
        at their voltage limit; with P constant the iteration would oscillate. Both have the same
        fixed point.
        """
        plant = self.plant
        machine = self._machine
        torque = plant.motor_torque(self._act)
        speed = self._qvel.take(plant.rotor)
        current = torque / plant.constant
        power = float(torque.dot(speed) + (current * current).dot(plant.resistance))
        share = machine.bus_resistance * power / self._voltage**2
        new_voltage = machine.bus_voltage / (1.0 + max(share, _SMALLEST_SHARE))
        # A battery's power is largest at half its voltage.
        self._voltage = max(new_voltage, 0.5 * machine.bus_voltage)
        plant.inverters[:] = self._voltage
        if plant.has_load_friction:
            plant.set_load(torque)
