"""What a motion-capture rig and force plates would see of the virtual robot, without noise.

Positions, orientations and contacts of a sample are of one instant: a foot is in contact if its
sphere overlaps the ground there, as in training. Everything is in SI units; the world is z up;
feet and legs are in the order FR, FL, HR, HL.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from pronk.errors import ArtefactError
from pronk.files import save_arrays, stored_arrays
from pronk.hardware.plant import Plant
from pronk.hardware.quaternion import normalized

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

SCHEMA = "pronk/capture/1"
_SHAPES: dict[str, tuple[int, ...]] = {
    "time": (),
    "position": (3,),
    "orientation": (4,),
    "velocity": (3,),
    "angular_velocity": (3,),
    "foot_position": (4, 3),
    "contact": (4,),
    "other_contact": (),
    "joint_position": (12,),
    "joint_velocity": (12,),
    "torque": (12,),
    "electrical_power": (),
    "bus_voltage": (),
}


@dataclass(frozen=True, kw_only=True)
class Capture:
    """T samples at a constant rate."""

    time: Array
    """On the machine's clock [s]. (T,)"""
    position: Array
    """Origin of the trunk's frame, in the world [m]. (T, 3)"""
    orientation: Array
    """Trunk to world, unit quaternions w, x, y, z. (T, 4)"""
    velocity: Array
    """Of the trunk's origin, in the world [m/s]. (T, 3)"""
    angular_velocity: Array
    """Of the trunk, in its own frame [rad/s]. (T, 3)"""
    foot_position: Array
    """Centres of the foot spheres, in the world [m]. (T, 4, 3)"""
    contact: Mask
    """Feet on the ground. (T, 4)"""
    other_contact: Mask
    """Anything but a foot touches the ground. (T,)"""
    joint_position: Array
    """Of the links, in file order [rad]. (T, 12)"""
    joint_velocity: Array
    """Of the links [rad/s]. (T, 12)"""
    torque: Array
    """Of the motors through their gears, without friction [N m]. (T, 12)"""
    electrical_power: Array
    """From the battery into the motors; negative where they give it back [W]. (T,)"""
    bus_voltage: Array
    """[V]. (T,)"""

    def __post_init__(self) -> None:
        """Refuse arrays that do not belong together.

        Raises:
            ArtefactError: A shape is not the one that is said.
        """
        for name, rest in _SHAPES.items():
            shape = np.shape(getattr(self, name))
            if shape != (len(self.time), *rest):
                raise ArtefactError(
                    f"Capture.{name} has shape {shape}; expected {(len(self.time), *rest)}."
                )

    @property
    def dt(self) -> float:
        """Time between samples [s]; NaN for fewer than two."""
        if len(self.time) < 2:
            return float("nan")
        return float(self.time[-1] - self.time[0]) / (len(self.time) - 1)


def save(path: Path, capture: Capture) -> None:
    """Write a capture to an `.npz`, whole or not at all."""
    save_arrays(path, {"schema": SCHEMA}, {name: getattr(capture, name) for name in _SHAPES})


def load(path: Path) -> Capture:
    """Read what `save` wrote.

    Raises:
        ArtefactError: Missing, damaged, or of another schema.
    """
    with stored_arrays(path, SCHEMA, what="a capture", writer="pronk trial") as (_, stored):
        return Capture(**{part.name: stored[part.name] for part in fields(Capture)})


class Recorder:
    """Keeps raw states of a plant while it runs, in arrays that grow by doubling."""

    def __init__(self, plant: Plant, period_s: float, *, first_step: int = 0) -> None:
        """Begin empty.

        Args:
            plant: On the ground.
            period_s: Between samples [s].
            first_step: Physics step of the first sample, counted from the clock's zero.
        """
        self._plant = plant
        self._step_s = float(plant.model.opt.timestep)
        self._period = period_s
        self._first = first_step
        self._rows = np.empty((1024, plant.state_size + 1))
        self._count = 0

        self.next_step = first_step
        """Physics step of the next sample."""

    def record(self, data: Any, voltage: float) -> None:
        """Keep the present state of a mujoco.MjData as the next sample."""
        if self._count == len(self._rows):
            self._rows = np.concatenate([self._rows, np.empty_like(self._rows)])
        row = self._rows[self._count]
        self._plant.read(data, row[:-1])
        row[-1] = voltage
        self._count += 1
        self.next_step = self._step_of(self._count)

    def _step_of(self, sample: int) -> int:
        return self._first + round(sample * self._period / self._step_s)

    def capture(self, since: float = -math.inf) -> Capture:
        """What was seen at and after a time.

        Args:
            since: [s]
        """
        steps = [self._step_of(sample) for sample in range(self._count)]
        times = np.array(steps, dtype=float) * self._step_s
        first = int(np.searchsorted(times, since - 0.5 * self._step_s))
        return seen(self._plant, times[first:], self._rows[first : self._count])


def seen(plant: Plant, time: Array, rows: Array) -> Capture:
    """Turn raw states into a capture.

    Args:
        plant: On the ground.
        time: [s]. (T,)
        rows: Raw states of the plant and bus voltages. (T, state_size + 1)
    """
    model = plant.model
    place, speed, act = plant.parts(rows[:, :-1])
    torque = plant.motor_torque(act)
    data = mujoco.MjData(model)
    feet = np.empty((len(time), len(plant.feet), 3))
    contact = np.zeros((len(time), len(plant.feet)), dtype=bool)
    other = np.zeros(len(time), dtype=bool)
    leg = {int(geom): index for index, geom in enumerate(plant.feet)}
    where, touching = data.geom_xpos, data.contact
    for k in range(len(rows)):
        data.qpos = place[k]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        feet[k] = where[plant.feet]
        for pair in touching.geom[: data.ncon].tolist() if data.ncon else ():
            # The ground is one of the two; what touches it, the other.
            index = leg.get(pair[0], leg.get(pair[1]))
            if index is None:
                other[k] = True
            else:
                contact[k, index] = True
    return Capture(
        time=time,
        position=place[:, :3].copy(),
        orientation=normalized(place[:, 3:7]),
        velocity=speed[:, :3].copy(),
        angular_velocity=speed[:, 3:6].copy(),
        foot_position=feet,
        contact=contact,
        other_contact=other,
        joint_position=place[:, plant.link_qpos],
        joint_velocity=speed[:, plant.link],
        torque=torque,
        electrical_power=plant.electrical_power(torque, speed[:, plant.rotor]),
        bus_voltage=rows[:, -1].copy(),
    )
