"""Simulated responses: what the joint of a measured response would have given in the simulator."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from pronk.arrays import ComplexArray
from pronk.identify.match.measured_joint import MeasuredJoint
from pronk.identify.simulators.simulator import JointRigs

T = TypeVar("T")


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

    @property
    def values(self) -> dict[str, float]:
        """What is simulated, without the delay."""
        names = ("stiffness", "damping", "armature", "frictionloss")
        return {n: value for n in names if (value := getattr(self, n)) is not None}


def responses(
    rigs: JointRigs, requests: Sequence[SimRequest], *, whole: bool = False
) -> list[ComplexArray]:
    """Simulate requests; those of one original joint share a rollout, equal ones a simulation.

    Armature and friction are given for all requests of one original joint, or for none. A response
    is of shape (inside,), or at all frequencies of its target, (f,), if `whole`; NaN where the
    simulation diverged.
    """
    out: list[ComplexArray] = [np.empty(0, dtype=np.complex128)] * len(requests)
    by_original: dict[str, list[int]] = {}
    for i, request in enumerate(requests):
        original = rigs.robot.joint(request.target.joint).original[0]
        by_original.setdefault(original, []).append(i)
    for indices in by_original.values():

        def same(i: int, j: int) -> bool:
            one, other = requests[i], requests[j]
            traces = one.target.trace, other.target.trace
            return one.values == other.values and traces[0].same_as(traces[1], rigs.robot)

        groups = grouped(indices, same)
        firsts = [requests[group[0]] for group in groups]
        values = {n: np.array([one.values[n] for one in firsts]) for n in firsts[0].values}
        goals = [requests[i].target for i in indices]
        steps = max(len(goal.trace.command) if whole else goal.steps for goal in goals)
        for part, position in rigs.run([one.target.trace for one in firsts], values, steps):
            for row, group in zip(position, groups[part], strict=True):
                for i in group:
                    goal, delay = requests[i].target, requests[i].delay
                    response = (goal.full_response if whole else goal.fit_response)(row)
                    if delay:
                        omega = goal.measured.omega if whole else goal.omega
                        response = response * np.exp(-1j * omega * delay)
                    out[i] = response
    return out


def grouped(items: Sequence[T], same: Callable[[T, T], bool]) -> list[list[T]]:
    """Gather items that are the same as the first of a group."""
    groups: list[list[T]] = []
    for item in items:
        group = next((group for group in groups if same(group[0], item)), None)
        if group is None:
            groups.append([item])
        else:
            group.append(item)
    return groups
