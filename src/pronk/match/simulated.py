"""Simulated responses: what the joint of a measured response would have given in the simulator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.match.measured_joint import MeasuredJoint
from pronk.simulators.simulator import JointRigs

ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True)
class SimRequest:
    """One simulation: the command of a measured response, with some parameters of the joint."""

    target: MeasuredJoint
    stiffness: float
    damping: float
    armature: float | None = None
    """[kg m^2]; None: the simulator's."""
    frictionloss: float | None = None
    """[N m]; None: the simulator's."""
    delay: float = 0.0
    """Delay of the command [s]."""


def responses(
    rigs: JointRigs, requests: Sequence[SimRequest], *, whole: bool = False
) -> list[ComplexArray]:
    """Simulate requests; those whose joints mirror one original joint share a rollout.

    Armature and friction are given for all requests of one original joint, or for none.

    Returns:
        One response a request, of shape (inside,), or at all frequencies of the target, (f,), if
        `whole`; NaN where a simulation diverged.
    """
    out: list[ComplexArray] = [np.empty(0, dtype=np.complex128)] * len(requests)
    by_original: dict[str, list[int]] = {}
    for i, request in enumerate(requests):
        original = rigs.robot.joint(request.target.joint).original[0]
        by_original.setdefault(original, []).append(i)
    for indices in by_original.values():
        group = [requests[i] for i in indices]
        values = {
            name: np.array([getattr(request, name) for request in group])
            for name in ("stiffness", "damping", "armature", "frictionloss")
            if getattr(group[0], name) is not None
        }
        steps = max(len(r.target.trace.command) if whole else r.target.steps for r in group)
        for part, position in rigs.run([request.target.trace for request in group], values, steps):
            for row, k in enumerate(range(part.start, part.stop)):
                goal, delay = group[k].target, group[k].delay
                read = goal.full_response if whole else goal.fit_response
                response = read(position[row])
                if delay:
                    omega = goal.measured.omega if whole else goal.omega
                    response = response * np.exp(-1j * omega * delay)
                out[indices[k]] = response
    return out
