"""What a motion-capture rig and force plates would record of the virtual robot, without noise.

Positions, orientations and contacts of a sample are of one instant: a foot is in contact if its
sphere overlaps the ground there, as in training. Everything is in SI units; the world is z up;
feet and legs are in the order FR, FL, HR, HL.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, fields
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from pronk.errors import ArtefactError
from pronk.files import save_arrays, stored_arrays
from pronk.virtual.plant import Plant

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
        """Refuse arrays of wrong shapes."""
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
    """Read a capture; refuse a missing or damaged file and another schema."""
    with stored_arrays(path, SCHEMA, what="a capture", writer="pronk trial") as (_, stored):
        return Capture(**{part.name: stored[part.name] for part in fields(Capture)})


class Recorder:
    """Keeps raw states of a plant while it runs, block after block as they come."""

    def __init__(self, plant: Plant, period_s: float) -> None:
        """Begin empty, for a plant on the ground; the first sample is due at the clock's zero."""
        self._plant, self._period = plant, period_s
        self._step_s = float(plant.model.opt.timestep)
        self._rows: list[Array] = []
        self._voltage: list[Array] = []
        self._begins = [0]
        """Number of the first sample of each block, and of the next one."""

    def due(self, last: int) -> list[int]:
        """Physics steps of the samples that are still to be taken, up to and with one step."""
        first = self._begins[-1]
        # One more than there can be, for the rounding of steps.
        most = math.floor((last + 0.5) * self._step_s / self._period) + 2
        return [step for step in self._steps(first, max(first, most)).tolist() if step <= last]

    def keep(self, rows: Array, voltage: Array) -> None:
        """Keep the raw states (n, state_size) and bus voltages (n,) [V] of the due steps."""
        if len(rows):
            self._rows.append(rows)
            self._voltage.append(voltage)
            self._begins.append(self._begins[-1] + len(rows))

    def _steps(self, first: int, end: int) -> NDArray[np.intp]:
        """Physics steps of samples `first` to `end` - 1."""
        steps = np.arange(first, end) * self._period / self._step_s
        return np.asarray(np.rint(steps), dtype=np.intp)

    def capture(self, since: float = -math.inf) -> Capture:
        """Samples at and after a time [s]."""
        times = self._step_s * self._steps(0, self._begins[-1]).astype(np.float64)
        first = int(np.searchsorted(times, since - 0.5 * self._step_s))
        # From the block that holds the first sample.
        block = max(bisect_right(self._begins, first) - 1, 0)
        skipped = first - self._begins[block]
        none = np.empty((0, self._plant.state_size))
        rows: Array = np.concatenate([none, *self._rows[block:]])
        voltage: Array = np.concatenate([none[:, 0], *self._voltage[block:]])
        return seen(self._plant, times[first:], rows[skipped:], voltage[skipped:])


def seen(plant: Plant, time: Array, rows: Array, voltage: Array) -> Capture:
    """Turn times [s] (T,), raw states (T, state_size) and bus voltages [V] (T,) into a capture."""
    place, speed, act = plant.parts(rows)
    torque, turn = plant.motor_torque(act), place[:, 3:7]
    feet, contact, other = _touch(plant, place)
    return Capture(
        time=time,
        position=place[:, :3].copy(),
        orientation=turn / np.sqrt((turn * turn).sum(axis=1, keepdims=True)),
        velocity=speed[:, :3].copy(),
        angular_velocity=speed[:, 3:6].copy(),
        foot_position=feet,
        contact=contact,
        other_contact=other,
        joint_position=place[:, plant.link_qpos],
        joint_velocity=speed[:, plant.link],
        torque=torque,
        electrical_power=plant.electrical_power(torque, speed[:, plant.rotor]),
        bus_voltage=voltage.copy(),
    )


def _touch(plant: Plant, place: Array) -> tuple[Array, Mask, Mask]:
    """Feet (T, 4, 3), whether they touch (T, 4), and whether anything else does (T,).

    Of a plant on the ground at positions (T, nq).
    """
    model, data = plant.model, plant.aside
    qpos, where, none = data.qpos, data.geom_xpos, len(plant.feet)
    feet = np.empty((len(place), none, 3))
    samples, pairs = [], [np.empty((0, 2), dtype=np.intp)]
    for k, (row, there) in enumerate(zip(place, feet, strict=True)):
        qpos[:] = row
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        where.take(plant.feet, axis=0, out=there, mode="clip")
        if data.ncon:
            pairs.append(data.contact.geom.copy())
            samples += [k] * data.ncon
    # The ground is one of two; what touches it is the other, a foot or none.
    foot = np.full(model.ngeom, none)
    foot[plant.feet] = np.arange(none)
    touched = np.zeros((len(place), none + 1), dtype=bool)
    touched[samples, foot[np.concatenate(pairs)].min(axis=1)] = True
    return feet, touched[:, :none], touched[:, none]
