"""Motion capture and contacts of the virtual robot, without noise.

A sample is of one instant; a foot is in contact if its sphere overlaps the ground, as in training.
The world is z up; feet are FR, FL, HR, HL.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import mujoco
import numpy as np
from numpy.typing import NDArray

from pronk.arrays import Array
from pronk.errors import ArtefactError
from pronk.files import save_arrays, stored_arrays
from pronk.jump.virtual.plant import Indices, Plant

Mask = NDArray[np.bool_]
Names = NDArray[np.str_]

SCHEMA = "pronk/capture/1"
TOGETHER = "+"
"""What stands between the names of parts that touch the ground at the same instant."""


@dataclass(frozen=True, kw_only=True)
class Capture:
    """T samples at a constant rate. Annotations hold the shapes after T."""

    time: Annotated[Array, ()]
    """Times on the machine's clock [s]."""
    position: Annotated[Array, (3,)]
    """Origin of the trunk's frame, in the world [m]."""
    orientation: Annotated[Array, (4,)]
    """Rotation from the trunk to the world, unit quaternions w, x, y, z."""
    velocity: Annotated[Array, (3,)]
    """Velocity of the trunk's origin, in the world [m/s]."""
    angular_velocity: Annotated[Array, (3,)]
    """Angular velocity of the trunk, in its own frame [rad/s]."""
    foot_position: Annotated[Array, (4, 3)]
    """Centres of the foot spheres, in the world [m]."""
    contact: Annotated[Mask, (4,)]
    """Whether each foot is on the ground."""
    other_contact: Annotated[Mask, ()]
    """Whether anything but a foot touches the ground."""
    other_parts: Annotated[Names, ()]
    """Bodies of the robot's model that touch the ground with anything but a foot, in the order of
    the model with `TOGETHER` between them; empty without such a contact or where it is not known
    which they are."""
    joint_position: Annotated[Array, (12,)]
    """Angles of the links, in file order [rad]."""
    joint_velocity: Annotated[Array, (12,)]
    """Speeds of the links [rad/s]."""
    torque: Annotated[Array, (12,)]
    """Torques of the motors through their gears, without friction [N m]."""
    electrical_power: Annotated[Array, ()]
    """Power from the battery to the motors, negative where it is returned [W]."""
    bus_voltage: Annotated[Array, ()]
    """Voltage of the bus [V]."""

    def __post_init__(self) -> None:
        """Refuse arrays of wrong shapes."""
        for name, shape_of_sample in _SHAPES.items():
            shape = np.shape(getattr(self, name))
            expected = (len(self.time), *shape_of_sample)
            if shape != expected:
                raise ArtefactError(f"Capture.{name} has shape {shape}; expected {expected}.")

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
"""Shape of one sample of each field."""
_PARTS = "other_parts"
"""The field that captures of an earlier pronk do not have."""


def save_capture(path: Path, capture: Capture) -> None:
    """Write a capture to an `.npz`, whole or not at all."""
    arrays = {name: getattr(capture, name) for name in _SHAPES}
    save_arrays(path, {"schema": SCHEMA}, arrays)


def load_capture(path: Path) -> Capture:
    """Read a capture; in one of an earlier pronk, `other_parts` are not known.

    Raises:
        ArtefactError: The file is missing, damaged or of another schema.
    """
    with stored_arrays(path, SCHEMA, what="a capture", writer="pronk trial") as (_, arrays):
        fields = {name: arrays[name] for name in _SHAPES if name != _PARTS}
        if _PARTS in arrays:
            fields[_PARTS] = arrays[_PARTS]
        else:
            fields[_PARTS] = np.full(len(fields["time"]), "")
        return Capture(**fields)


def capture_of(plant: Plant, time: Array, rows: Array) -> Capture:
    """Make a capture of raw states.

    Args:
        plant: The plant, on the ground.
        time: Times of the samples [s], (T,).
        rows: Raw states, (T, state_size).
    """
    states = plant.unpack(rows)
    qpos = states.position
    qvel = states.velocity
    orientation = qpos[:, 3:7]
    foot_position, foot_contact, other_parts = _contacts(plant, qpos)
    current = states.torque / plant.constant
    heat = current * current * plant.resistance
    return Capture(
        time=time,
        position=qpos[:, :3].copy(),
        orientation=orientation / np.sqrt((orientation * orientation).sum(axis=1, keepdims=True)),
        velocity=qvel[:, :3].copy(),
        angular_velocity=qvel[:, 3:6].copy(),
        foot_position=foot_position,
        contact=foot_contact,
        other_contact=other_parts != "",
        other_parts=other_parts,
        joint_position=qpos[:, plant.link_qpos],
        joint_velocity=qvel[:, plant.link],
        torque=states.torque,
        electrical_power=(states.torque * qvel[:, plant.rotor] + heat).sum(axis=-1),
        bus_voltage=states.voltage.copy(),
    )


def _contacts(plant: Plant, positions: Array) -> tuple[Array, Mask, Names]:
    """Find the contacts of a plant on the ground.

    Args:
        plant: The plant.
        positions: Its qpos at T instants, (T, nq).

    Returns:
        Feet in the world [m], (T, 4, 3), whether they touch the ground, (T, 4), and what else
        does, (T,), as of `Capture.other_parts`.
    """
    model = plant.model
    data = plant.scratch
    qpos = data.qpos
    geom_positions = data.geom_xpos
    foot_count = len(plant.feet)
    foot_position = np.empty((len(positions), foot_count, 3))
    samples: list[int] = []  # number of the sample of each contact
    geom_pairs = [np.empty((0, 2), dtype=np.intp)]  # the two geoms of each contact
    for sample, position in enumerate(positions):
        qpos[:] = position
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        geom_positions.take(plant.feet, axis=0, out=foot_position[sample], mode="clip")
        if data.ncon:
            geom_pairs.append(data.contact.geom.copy())
            samples += [sample] * data.ncon
    # The ground is one geom of a pair; the other is a foot or not, whose number is `foot_count`.
    foot_of_geom = np.full(model.ngeom, foot_count)
    foot_of_geom[plant.feet] = np.arange(foot_count)
    pairs = np.concatenate(geom_pairs)
    feet_touching = foot_of_geom[pairs].min(axis=1)
    touched = np.zeros((len(positions), foot_count + 1), dtype=bool)
    touched[samples, feet_touching] = True
    other_parts = np.full(len(positions), "")
    is_other = feet_touching == foot_count
    if is_other.any():
        # The ground belongs to the world, which is body 0.
        bodies = model.geom_bodyid[pairs[is_other]].max(axis=1)
        other_parts = _part_names(model, len(positions), np.array(samples)[is_other], bodies)
    return foot_position, touched[:, :foot_count], other_parts


def _part_names(model: Any, count: int, samples: Indices, bodies: Indices) -> Names:
    """Name the bodies that touch the ground in each of `count` samples.

    Args:
        model: The mujoco.MjModel.
        count: Number of samples.
        samples: Sample of each contact, (n,).
        bodies: Body of each contact, (n,).
    """
    bodies_of_sample: dict[int, set[int]] = {}
    for sample, body in zip(samples.tolist(), bodies.tolist(), strict=True):
        bodies_of_sample.setdefault(sample, set()).add(body)
    text_of_bodies: dict[frozenset[int], str] = {}  # Few combinations occur.
    texts = [""] * count
    for sample, sample_bodies in bodies_of_sample.items():
        key = frozenset(sample_bodies)
        if key not in text_of_bodies:
            names = [model.body(body).name or f"body {body}" for body in sorted(key)]
            text_of_bodies[key] = TOGETHER.join(names)
        texts[sample] = text_of_bodies[key]
    return np.array(texts)
