"""Rigid-body inertia: mirroring, and parts joined into one body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.errors import RobotError

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Inertia:
    """Mass, centre of mass and rotational inertia of a rigid body, in the frame of that body."""

    mass: float
    """[kg]"""
    com: tuple[float, float, float]
    """Centre of mass [m]."""
    products: tuple[float, float, float, float, float, float]
    """Inertia about the centre of mass: xx, yy, zz, xy, xz, yz [kg m^2]."""

    def __post_init__(self) -> None:
        """Refuse what no distribution of mass could have.

        Raises:
            RobotError: Mass is not positive, or a principal moment exceeds the sum of the others.
        """
        if not self.mass > 0.0:
            raise RobotError(f"Inertia.mass is {self.mass}; it must be positive.")
        if self.triangle_margin() < 0.0:
            moments = ", ".join(f"{m:.4g}" for m in np.linalg.eigvalsh(self.matrix()))
            raise RobotError(
                f"principal moments {moments} kg m^2 break the triangle inequality: the largest "
                "must not exceed the sum of the others; reduce the products of inertia."
            )

    def matrix(self) -> Array:
        """Inertia about the centre of mass [kg m^2], shape (3, 3)."""
        xx, yy, zz, xy, xz, yz = self.products
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])

    def triangle_margin(self) -> float:
        """Sum of the smaller two principal moments less the largest [kg m^2]; must not be < 0."""
        small, middle, large = np.linalg.eigvalsh(self.matrix())
        return float(small + middle - large)

    def mirrored(self) -> Inertia:
        """The body's mirror image about the x-z plane: y changes sign, so do xy and yz."""
        x, y, z = self.com
        xx, yy, zz, xy, xz, yz = self.products
        return Inertia(mass=self.mass, com=(x, -y, z), products=(xx, yy, zz, -xy, xz, -yz))


def joined(parts: Sequence[Inertia]) -> Inertia:
    """Several bodies, given in one frame, welded into one (parallel-axis theorem)."""
    mass = sum(part.mass for part in parts)
    com = np.sum([part.mass * np.array(part.com) for part in parts], axis=0) / mass
    total = np.zeros((3, 3))
    for part in parts:
        arm = np.array(part.com) - com
        total += part.matrix() + part.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    x, y, z = (float(v) for v in com)
    xx, yy, zz, xy, xz, yz = (
        float(total[i, j]) for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    )
    return Inertia(mass=mass, com=(x, y, z), products=(xx, yy, zz, xy, xz, yz))
