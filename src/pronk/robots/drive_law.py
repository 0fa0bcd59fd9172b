"""The drive law: how an engine applies stiffness and damping of a joint over a physics step.

With inertia `J`, other torques `g`, command `u`, position `q`, velocity `v` and the step `h` the
velocity changes by

    explicit            h (kp (u - q) - kd v + g) / J
    implicit_damping    h (kp (u - q) - kd v + g) / (J + h kd)
    implicit            h (kp (u - q - h v) - kd v + g) / (J + h kd + h^2 kp)

and then `q += h v`. Law `implicit` does so N times a step, with `h` the N-th part of it (the
position iterations of PhysX). It is `implicit_damping` of damping `kd + h kp`, because
`q + h v` is the position that the old velocity leads to.

Passive damping `b` of a joint is implicit in most engines: `-b v` is in `g`, and `h b` beside `J`.
Where it is explicit, `-b v` is in `g` alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from pronk.errors import PronkError

Value = TypeVar("Value", float, NDArray[np.float64])
LAWS = ("explicit", "implicit_damping", "implicit")
"""Values of `DriveLaw.kind`."""


@dataclass(frozen=True, kw_only=True)
class DriveLaw:
    """Drive law of a simulator."""

    kind: Literal["explicit", "implicit_damping", "implicit"] = "explicit"
    """Which of the three laws above it is."""
    iterations: int = 1
    """Parts of a physics step that law `implicit` computes one after the other."""
    passive_damping: Literal["implicit", "explicit"] = "implicit"
    """How the joints' own damping acts; explicit with law `explicit` alone."""

    def __post_init__(self) -> None:
        """Refuse an unknown law, and iterations or passive damping that it does not have."""
        if self.kind not in LAWS:
            raise PronkError(f"drive law {self.kind!r}; expected one of {', '.join(LAWS)}.")
        if self.iterations < 1 or (self.iterations > 1 and self.kind != "implicit"):
            raise PronkError(
                f"drive law {self.kind} with {self.iterations} iterations; expected 1, or 1 or "
                "more of law implicit."
            )
        passive = ("implicit", "explicit") if self.kind == "explicit" else ("implicit",)
        if self.passive_damping not in passive:
            raise PronkError(
                f"drive law {self.kind} with passive_damping {self.passive_damping!r}; expected "
                f"{' or '.join(passive)}."
            )

    @property
    def label(self) -> str:
        """Short name: E, IF, or I with the number of iterations."""
        if self.kind == "explicit":
            return "E"
        if self.kind == "implicit_damping":
            return "IF"
        return f"I{self.iterations}"

    def substep(self, timestep: float) -> float:
        """Return the step of the integration within a physics step [s]."""
        return timestep / self.iterations

    def damping(self, stiffness: Value, damping: Value, substep: float) -> Value:
        """Return the damping that gives this law where only damping is implicit [N m s/rad].

        Args:
            stiffness: Stiffness of the drive [N m/rad].
            damping: Damping of the drive [N m s/rad].
            substep: Step of the integration [s].
        """
        if self.kind == "implicit":
            return damping + substep * stiffness
        return damping


EXPLICIT = DriveLaw()
"""A torque computed before the step: mjlab's DcMotorActuator."""
