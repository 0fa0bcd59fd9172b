"""A plant that runs: commands arrive, the battery sags, samples of the capture are kept.

Time is counted in physics steps from the clock's zero. Steps are taken natively in blocks; Python
looks in where a state or a sample is due, or a command is heard.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from pronk.errors import HardwareError
from pronk.hardware.capture import Capture, Recorder
from pronk.hardware.machine import Command
from pronk.hardware.plant import Plant
from pronk.hardware.transport import Transport
from pronk.hardware.truth_parts import MachineTruth

Array = NDArray[np.float64]
Indices = NDArray[np.intp]


@dataclass(frozen=True, kw_only=True)
class Block:
    """Raw states of a plant at n instants."""

    qpos: Array
    """(n, nq)"""
    qvel: Array
    """(n, nv)"""
    torque: Array
    """Of the motors [N m]. (n, joints of the plant)"""
    voltage: Array
    """Of the bus [V]. (n,)"""


class Physics:
    """One run of a plant."""

    def __init__(
        self,
        plant: Plant,
        machine: MachineTruth,
        *,
        columns: Indices,
        offset: Array,
        first_step: int,
    ) -> None:
        """Begin with every joint and drive at zero; `data` is there to be set.

        Args:
            plant: Built with the physics step in its model.
            machine: Transport delay and battery.
            columns: Columns of the plant's joints in a command.
            offset: Reading of their encoders less the true angle [rad].
            first_step: Physics step to begin with, negative before the clock's zero.
        """
        self.plant = plant
        self.data = mujoco.MjData(plant.model)
        self.step = self._first = first_step
        self.recorder: Recorder | None = None
        """Keeps the samples of a capture, if there is to be one."""
        self._machine = machine
        self._columns, self._offset = columns, offset
        self._dt = float(plant.model.opt.timestep)
        self._voltage = machine.bus_voltage
        plant.set_bus_voltage(self._voltage)

    def place(self, pose: Array) -> None:
        """Put the joints, links and rotors alike, where a pose of the whole robot has them."""
        self.data.qpos[self.plant.rotor_qpos] = pose[self._columns]
        self.data.qpos[self.plant.link_qpos] = pose[self._columns]
        self.plant.set_clamps((), self.data.qpos, 0.0, 0.0)

    def hear(self, command: Command) -> None:
        """Let the drives act on a command, through encoders that may be off."""
        columns = self._columns
        target = np.asarray(command.position, dtype=float)[columns] - self._offset
        self.data.ctrl[self.plant.actuator] = target
        self.plant.set_gains(
            np.asarray(command.stiffness, dtype=float)[columns],
            np.asarray(command.damping, dtype=float)[columns],
        )

    def run(self, steps: list[int], transport: Transport) -> Block:
        """Go on to each of some physics steps, and look.

        Args:
            steps: Rising; those already past are looked at late.
            transport: Whence commands come.

        Raises:
            HardwareError: The numbers ran away.
        """
        plant, data = self.plant, self.data
        rows, voltage = np.empty((len(steps), plant.state_size)), np.empty(len(steps))
        qpos, qvel, act = plant.parts(rows)
        torque = np.empty((len(steps), len(plant.joints)))
        for row, step in enumerate(steps):
            if self.recorder is not None:
                while (due := self.recorder.next_step) <= step:
                    self._advance(due, transport)
                    self.recorder.record(data, self._voltage)
            self._advance(step, transport)
            plant.read(data, rows[row])
            torque[row] = plant.motor_torque(act[row])
            voltage[row] = self._voltage
            self._sag(torque[row], qvel[row].take(plant.rotor))
        self._check()
        return Block(qpos=qpos, qvel=qvel, torque=torque, voltage=voltage)

    def look(self) -> Capture:
        """One sample of a capture, of now."""
        recorder = Recorder(self.plant, self._dt, first_step=self.step)
        recorder.record(self.data, self._voltage)
        return recorder.capture()

    def _advance(self, to: int, transport: Transport) -> None:
        """Step up to (not including) a physics step, commands put in where they are heard."""
        while (heard := transport.take(to)) is not None:
            self._step_to(heard[0])
            self.hear(heard[1])
        self._step_to(to)

    def _step_to(self, step: int) -> None:
        if step > self.step:
            mujoco.mj_step(self.plant.model, self.data, step - self.step)
            self.step = step

    def _sag(self, torque: Array, speed: Array) -> None:
        """Let the bus voltage follow the power that the motors draw (or give back)."""
        plant, machine = self.plant, self._machine
        current = torque / plant.constant
        power = float(torque.dot(speed) + (current * current).dot(plant.resistance))
        sagged = machine.bus_voltage - machine.bus_resistance * power / self._voltage
        # A battery gives most at half its voltage; asked for more, it gives no more.
        self._voltage = max(sagged, 0.5 * machine.bus_voltage)
        plant.set_bus_voltage(self._voltage)

    def _check(self) -> None:
        """MuJoCo starts over, its time at 0, where numbers run away; say so instead."""
        if self.data.time < (self.step - self._first - 0.5) * self._dt:
            raise HardwareError(
                f"the virtual robot's physics ran away by {self.step * self._dt:.3f} s at a step "
                f"of {self._dt:g} s; look for an extreme number in the truth or in a command's "
                "gains."
            )
