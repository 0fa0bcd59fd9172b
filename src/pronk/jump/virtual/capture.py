"""Motion capture and contacts of the virtual robot, without noise.

A sample is of one instant; a foot is in contact if its sphere overlaps the ground, as in training.
The world is z up; feet are FR, FL, HR, HL.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, get_type_hints

import mujoco
import numpy as np
from numpy.typing import NDArray

from pronk.arrays import Array
from pronk.errors import ArtefactError
from pronk.files import save_arrays, stored_arrays
from pronk.jump.virtual.plant import Plant

Mask = NDArray[np.bool_]

SCHEMA = "pronk/capture/1"


@dataclass(frozen=True, kw_only=True)
class Capture:
    """T samples at a constant rate. Annotations hold the shapes after T."""

    time: Annotated[Array, ()]  # on the machine's clock [s]
    position: Annotated[Array, (3,)]  # origin of the trunk's frame, in the world [m]
    orientation: Annotated[Array, (4,)]  # trunk to world, unit quaternions w, x, y, z
    velocity: Annotated[Array, (3,)]  # of the trunk's origin, in the world [m/s]
    angular_velocity: Annotated[Array, (3,)]  # of the trunk, in its own frame [rad/s]
    foot_position: Annotated[Array, (4, 3)]  # centres of the foot spheres, in the world [m]
    contact: Annotated[Mask, (4,)]  # feet on the ground
    other_contact: Annotated[Mask, ()]  # anything but a foot touches the ground
    joint_position: Annotated[Array, (12,)]  # of the links, in file order [rad]
    joint_velocity: Annotated[Array, (12,)]  # of the links [rad/s]
    torque: Annotated[Array, (12,)]  # of the motors through their gears, without friction [N m]
    electrical_power: Annotated[Array, ()]  # battery to motors, negative where returned [W]
    bus_voltage: Annotated[Array, ()]  # [V]

    def __post_init__(self) -> None:
        """Refuse arrays of wrong shapes."""
        for name, rest in _SHAPES.items():
            found, expected = np.shape(getattr(self, name)), (len(self.time), *rest)
            if found != expected:
                raise ArtefactError(f"Capture.{name} has shape {found}; expected {expected}.")

    @property
    def dt(self) -> float:
        """Time between samples [s]; NaN for fewer than two."""
        if len(self.time) < 2:
            return math.nan
        return float(self.time[-1] - self.time[0]) / (len(self.time) - 1)


_SHAPES = {
    name: hint.__metadata__[0]
    for name, hint in get_type_hints(Capture, include_extras=True).items()
}


def save(path: Path, capture: Capture) -> None:
    """Write a capture to an `.npz`, whole or not at all."""
    save_arrays(path, {"schema": SCHEMA}, {name: getattr(capture, name) for name in _SHAPES})


def load(path: Path) -> Capture:
    """Read a capture; refuse a missing or damaged file and another schema."""
    with stored_arrays(path, SCHEMA, what="a capture", writer="pronk trial") as (_, stored):
        return Capture(**{name: stored[name] for name in _SHAPES})


def capture_of(plant: Plant, time: Array, rows: Array) -> Capture:
    """Make a capture of times [s] (T,) and raw states (T, state_size)."""
    raw = plant.unpack(rows)
    place, speed = raw.position, raw.velocity
    orientation = place[:, 3:7]
    feet, contact, other = _contacts(plant, place)
    current = raw.torque / plant.constant
    heat = current * current * plant.resistance
    return Capture(
        time=time,
        position=place[:, :3].copy(),
        orientation=orientation / np.sqrt((orientation * orientation).sum(axis=1, keepdims=True)),
        velocity=speed[:, :3].copy(),
        angular_velocity=speed[:, 3:6].copy(),
        foot_position=feet,
        contact=contact,
        other_contact=other,
        joint_position=place[:, plant.link_qpos],
        joint_velocity=speed[:, plant.link],
        torque=raw.torque,
        electrical_power=(raw.torque * speed[:, plant.rotor] + heat).sum(axis=-1),
        bus_voltage=raw.voltage.copy(),
    )


def _contacts(plant: Plant, place: Array) -> tuple[Array, Mask, Mask]:
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
    # The ground is one geom of a pair; the other is a foot or not.
    foot = np.full(model.ngeom, none)
    foot[plant.feet] = np.arange(none)
    touched = np.zeros((len(place), none + 1), dtype=bool)
    touched[samples, foot[np.concatenate(pairs)].min(axis=1)] = True
    return feet, touched[:, :none], touched[:, none]
