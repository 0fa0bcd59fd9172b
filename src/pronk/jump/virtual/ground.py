"""The ground under a virtual robot, and how the robot is set down on it.

Contact of a foot. A foot of rubber on a floor is a one-sided spring and damper with Coulomb
friction: pressed in by r at a speed v it exerts

    f = stiffness r + damping v - added_mass a,    f >= 0,    |friction force| <= friction f.

The last term is due to MuJoCo's soft constraints. A constraint there has an inverse inertia A, an
impedance d between 0 and 1, and a reference acceleration -(b/d) v - (k/d) r, which it approaches
with the regularization R = A (1 - d) / d. Hence, in newtons,

    stiffness = k / (A (1 - d)),  damping = b / (A (1 - d)),  added_mass = d / (A (1 - d)),

solved here for k and b at d = 1/2: the added mass is then that of the foot itself (0.17 kg), and
the static spring is exactly `stiffness`. Training's contact differs: a reference of 20 ms and an
impedance of .9 and more, at a step of 5 ms.

Two properties of MuJoCo's friction remain. A sticking foot creeps, by 1 / (impratio damping) = 0.02
mm/s per newton; and a sliding one is pressed more, by some 20 N per m/s of slip, as long as it
stays pressed in. The friction force is `friction` times the normal force at every instant.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any

import mujoco
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from pronk.arrays import Array
from pronk.errors import RobotError
from pronk.jump.virtual.bounds import Bounded

_Place = Annotated[float, Meta(ge=-1e6, le=1e6)]
_Size = Annotated[float, Meta(gt=0.0, le=1e6)]
_Span = Annotated[float, Meta(ge=0.0, le=1e6)]

# Impedance d, and ratio of the impedances along and across the ground.
_IMPEDANCE = 0.5
_IMPRATIO = 1000.0
# Largest angular frequency of the contact times the step; the symplectic step is stable below 2.
_STABLE = 0.5
_COLOUR = (0.55, 0.58, 0.62, 1.0)


@dataclass(frozen=True, kw_only=True)
class Box(Bounded):
    """A fixed block, its faces along the axes of the world."""

    center: tuple[_Place, _Place, _Place]
    """Centre in the world [m]."""
    half_size: tuple[_Size, _Size, _Size]
    """Half of its edges [m]."""


@dataclass(frozen=True, kw_only=True)
class Ground(Bounded):
    """A floor, blocks on it, and their contact with feet."""

    friction: Annotated[float, Meta(ge=1e-3, le=10.0)] = 0.8
    """Coulomb coefficient between foot and ground [1]."""
    stiffness: Annotated[float, Meta(ge=100.0, le=1e7)] = 30e3
    """Stiffness of a foot pressed into the ground [N/m]."""
    damping: Annotated[float, Meta(ge=0.0, le=1e5)] = 60.0
    """Damping of a foot pressed into the ground [N s/m]."""
    floor: Annotated[float, Meta(ge=-100.0, le=100.0)] = 0.0
    """Height of the endless floor, also between blocks [m]."""
    terrain: tuple[Box, ...] = ()
    """Blocks on the floor."""

    def height(self, x: float, y: float) -> float:
        """Return the height of the ground at a place [m]."""
        height = self.floor
        for box in self.terrain:
            is_inside_x = abs(x - box.center[0]) <= box.half_size[0]
            is_inside_y = abs(y - box.center[1]) <= box.half_size[1]
            if is_inside_x and is_inside_y:
                height = max(height, box.center[2] + box.half_size[2])
        return height

    def add_to(self, spec: Any) -> None:
        """Put floor and blocks, which touch everything, into a mujoco.MjSpec."""
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = _IMPRATIO
        floor = spec.worldbody.add_geom(
            name="floor",
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            size=(0.0, 0.0, 1.0),
            pos=(0.0, 0.0, self.floor),
        )
        geoms = [floor]
        for index, box in enumerate(self.terrain):
            block = spec.worldbody.add_geom(
                name=f"block_{index}",
                type=mujoco.mjtGeom.mjGEOM_BOX,
                size=box.half_size,
                pos=box.center,
            )
            geoms.append(block)
        for geom in geoms:
            geom.contype = 1
            geom.conaffinity = 1
            geom.condim = 3
            geom.rgba = _COLOUR
            geom.friction = (self.friction, 0.0, 0.0)

    def set_down(self, model: Any, data: Any, feet: NDArray[np.intp], start: Start) -> None:
        """Put a robot with a free trunk down, its joints being in place.

        Args:
            model: The mujoco.MjModel.
            data: The mujoco.MjData.
            feet: Geoms of the feet.
            start: Where and how it is set down.
        """
        half_yaw = 0.5 * start.yaw
        data.qpos[:3] = (*start.position, 0.0)
        data.qpos[3:7] = (math.cos(half_yaw), 0.0, 0.0, math.sin(half_yaw))
        mujoco.mj_kinematics(model, data)
        clearances = []
        for foot in feet:
            x, y, z = data.geom_xpos[foot]
            clearances.append(z - model.geom_size[foot, 0] - self.height(x, y))
        data.qpos[2] = start.drop - min(clearances)

    def set_contact(self, model: Any, geoms: NDArray[np.intp]) -> None:
        """Give the feet spring, damper and friction; refuse a spring too stiff to step."""
        d = _IMPEDANCE
        timestep = model.opt.timestep
        for geom in geoms:
            mobility = float(model.body_invweight0[model.geom_bodyid[geom], 0])
            k = (1.0 - d) * mobility * self.stiffness
            b = (1.0 - d) * mobility * self.damping
            # The step sees the reference's frequency, sqrt(k / d), and its decay, b / d.
            fastest = max(math.sqrt(k / d), b / d)
            if fastest * timestep > _STABLE:
                raise RobotError(
                    f"ground.stiffness is {self.stiffness:g} and ground.damping "
                    f"{self.damping:g}; at a physics step of {timestep:g} s contacts "
                    f"may not be faster than {_STABLE / timestep:.3g} rad/s, this one "
                    f"is {fastest:.3g} rad/s; take less of both, or a smaller step."
                )
            model.geom_solref[geom] = (-k, -b)
            model.geom_solimp[geom] = (d, d, 1e-3, 0.5, 2.0)
            model.geom_friction[geom] = (self.friction, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Start(Bounded):
    """How a robot is set down, its drives holding `default pose + joint_offset`."""

    position: tuple[_Place, _Place] = (0.0, 0.0)
    """Place of the trunk over the ground [m]."""
    yaw: _Place = 0.0
    """Heading, positive to the left [rad]."""
    joint_offset: tuple[_Place, ...] | None = None
    """Joint angles from the default pose, until the first command, in file order [rad]; None is
    zeros."""
    drop: _Span = 0.0
    """Height of the lowest foot over the ground when the robot is released [m]."""
    settle_s: _Span = 1.5
    """Time before the clock starts [s]."""

    def offset(self, joints: int) -> Array:
        """Return the joint offset as an array [rad]."""
        offset = np.zeros(joints) if self.joint_offset is None else np.array(self.joint_offset)
        if offset.shape != (joints,):
            raise RobotError(
                f"Start.joint_offset has {len(offset)} numbers; expected {joints}, one per joint."
            )
        return offset
