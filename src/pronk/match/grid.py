"""The paper's search: every gain pair of a 50 x 50 grid, compared by the magnitude (F7 to F11).

Readings, the paper being silent: the error is the mean over the estimator's frequencies inside
the joint's band of the squared difference of the gains in dB (what a Bode plot shows), every
frequency counting alike; gains of repeats are averaged (as complex responses) before the
comparison; phase is disregarded because a command delay turns it (F9); the armature stays as the
data sheet has it (S6).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pronk.match.measured_joint import MeasuredJoint
from pronk.robots.robot import Robot
from pronk.simulators.simulator import JointRig, JointRigs

Array = NDArray[np.float64]

DIVERGED_DB = 100.0
"""Error written for a simulation that diverged or did not move [dB]: beyond any response."""
_NEAR_DB = 0.2
"""Nodes this close to the best of a shared map are simulated for themselves [dB]; two sides of a
hip_roll differ by 0.03 dB around the best."""
_STRIDES = (7, 3, 1)
"""Every how many nodes the coarse search looks, from far to close."""


@dataclass(frozen=True, kw_only=True)
class GridSearch:
    """Error over the grid, and its best cell."""

    stiffness: Array
    """Axis [N m/rad], shape (a,)."""
    damping: Array
    """Axis [N m s/rad], shape (b,)."""
    error: Array
    """Mean squared error of the gain [dB^2], shape (a, b); NaN where it was not looked at."""

    @property
    def cell(self) -> tuple[int, int]:
        """Indices of the best node."""
        i, j = np.unravel_index(int(np.nanargmin(self.error)), self.error.shape)
        return int(i), int(j)

    @property
    def gains(self) -> tuple[float, float]:
        """Stiffness and damping of the best node."""
        i, j = self.cell
        return float(self.stiffness[i]), float(self.damping[j])

    @property
    def error_db(self) -> float:
        """Root mean square error at the best node [dB]."""
        return float(np.sqrt(np.nanmin(self.error)))

    @property
    def at_edge(self) -> bool:
        """True if the best node lies on the border: the optimum may lie beyond."""
        return any(k in (0, n - 1) for k, n in zip(self.cell, self.error.shape, strict=True))


def axes(robot: Robot, points: int = 50) -> tuple[Array, Array]:
    """Axes of the robot's grid (paper F7: 13 to 27 N m/rad and 0.1 to 0.7 N m s/rad, 50 each)."""
    return np.linspace(*robot.grid_stiffness, points), np.linspace(*robot.grid_damping, points)


def weights(goal: MeasuredJoint, weighting: Literal["none", "coherence"]) -> Array:
    """Weights of the frequencies inside the band, summing to one, shape (inside,)."""
    count = int(goal.fit_mask.sum())
    raw = np.ones(count) if weighting == "none" else goal.deviation_db() ** -2.0
    return np.asarray(raw / raw.sum())


def mean_square(goal: MeasuredJoint, simulated: NDArray[np.complex128], weight: Array) -> Array:
    """Weighted mean square of the gain error [dB^2], shape (...), for (..., inside)."""
    error = goal.error_db(simulated)
    error = np.where(np.isfinite(error), np.clip(error, -DIVERGED_DB, DIVERGED_DB), DIVERGED_DB)
    return np.asarray(error**2 @ weight)


def alike(targets: Sequence[MeasuredJoint], robot: Robot) -> list[list[MeasuredJoint]]:
    """Targets gathered by simulation: mirror-image joints excited alike share one."""
    groups: list[list[MeasuredJoint]] = []
    for goal in targets:
        for group in groups:
            if group[0].trace.same_as(goal.trace, robot):
                group.append(goal)
                break
        else:
            groups.append([goal])
    return groups


def errors(
    rig: JointRig,
    group: Sequence[MeasuredJoint],
    stiffness: Array,
    damping: Array,
    weighting: Literal["none", "coherence"] = "none",
    progress: Callable[[float], None] | None = None,
) -> Array:
    """Mean squared errors of several targets that share one simulation.

    Args:
        rig: The rig of the group's original joint.
        group: Targets whose questions are the same after mirroring.
        stiffness: [N m/rad], shape (b,).
        damping: [N m s/rad], shape (b,).
        weighting: Weights of the frequencies.
        progress: Called with the share done, 0 to 1.

    Returns:
        Mean squared error of the gain [dB^2], shape (group, b).
    """
    # One may rest longer than the others at the end.
    question = max(
        (g.trace for g in group if g.trace.same_as(group[0].trace, rig.robot)),
        key=lambda one: len(one.command),
    )
    command = question.mirrored(rig.robot)[2]
    steps = max(goal.steps for goal in group)
    command = np.pad(command, (0, max(0, steps - len(command))), mode="edge")
    weight = [weights(goal, weighting) for goal in group]
    out = np.empty((len(group), len(stiffness)))
    for part, position in rig.run([command[:steps]], [rig.pose(question)], stiffness, damping):
        for k, goal in enumerate(group):
            out[k, part] = mean_square(goal, goal.fit_response(position), weight[k])
        if progress is not None:
            progress(part.stop / len(stiffness))
    return out


def search(
    rig: JointRig,
    group: Sequence[MeasuredJoint],
    stiffness: Array,
    damping: Array,
    weighting: Literal["none", "coherence"] = "none",
    progress: Callable[[float], None] | None = None,
) -> list[GridSearch]:
    """Simulate the whole grid for targets that share one simulation; arguments as `errors`."""
    kp, kd = (axis.ravel() for axis in np.meshgrid(stiffness, damping, indexing="ij"))
    shape = (len(stiffness), len(damping))
    found = errors(rig, group, kp, kd, weighting, progress)
    return [
        GridSearch(stiffness=stiffness, damping=damping, error=row.reshape(shape)) for row in found
    ]


def search_all(
    simulator: JointRigs,
    targets: Sequence[MeasuredJoint],
    stiffness: Array,
    damping: Array,
    weighting: Literal["none", "coherence"] = "none",
    progress: Callable[[float], None] | None = None,
) -> list[GridSearch]:
    """The whole grid for any number of targets, each family of mirrored joints simulated once.

    Joints excited alike share a simulation. So do, nearly, joints excited the other way round
    (a left hip_roll moved to the same side as the right one): only gravity and the pose tell the
    sides apart. Their maps are read off the shared simulation, then every node within `_NEAR_DB`
    of the best is simulated for itself. Should any of those have been wrong by half of that, all
    nodes are.

    Args:
        simulator: The training simulator.
        targets: What to match.
        stiffness: Axis [N m/rad], shape (a,).
        damping: Axis [N m s/rad], shape (b,).
        weighting: Weights of the frequencies.
        progress: Called with the share done, 0 to 1.

    Returns:
        One search a target, in their order.
    """
    robot = simulator.robot
    families: list[list[list[MeasuredJoint]]] = []
    for group in alike(targets, robot):
        for family in families:
            if family[0][0].trace.same_as(group[0].trace, robot, sign=-1.0):
                family.append(group)
                break
        else:
            families.append([group])
    found: dict[int, GridSearch] = {}
    for k, family in enumerate(families):
        rig = simulator.rig(family[0][0].joint)

        def tell(share: float, k: int = k) -> None:
            if progress is not None:
                progress((k + share) / len(families))

        members = [goal for group in family for goal in group]
        maps = search(rig, members, stiffness, damping, weighting, tell)
        found |= {id(goal): one for goal, one in zip(members, maps, strict=True)}
        for group in family[1:]:
            looked = _look_again(rig, group, [found[id(goal)] for goal in group], weighting)
            found |= {id(goal): one for goal, one in zip(group, looked, strict=True)}
    return [found[id(goal)] for goal in targets]


def _look_again(
    rig: JointRig,
    group: Sequence[MeasuredJoint],
    shared: Sequence[GridSearch],
    weighting: Literal["none", "coherence"],
) -> list[GridSearch]:
    """Simulate a group's own command wherever its shared maps could be the best."""
    maps = np.array([one.error for one in shared])
    levels = np.sqrt(maps)
    near = (levels < levels.min(axis=(1, 2), keepdims=True) + _NEAR_DB).any(axis=0)
    first = shared[0]

    def look(nodes: NDArray[np.bool_]) -> None:
        i, j = np.nonzero(nodes)
        maps[:, i, j] = errors(rig, group, first.stiffness[i], first.damping[j], weighting)

    look(near)
    if np.abs(np.sqrt(maps) - levels).max() > 0.5 * _NEAR_DB:
        look(~near)
    return [replace(one, error=row) for one, row in zip(shared, maps, strict=True)]


def coarse_search(
    rig: JointRig,
    group: Sequence[MeasuredJoint],
    stiffness: Array,
    damping: Array,
    weighting: Literal["none", "coherence"] = "none",
) -> list[GridSearch]:
    """Look at every seventh node and the border, then ever closer around the best.

    Each stride looks around the best node so far until that no longer moves, so the search
    follows a narrow valley to its bottom. Enough to show that no node fits (paper F13) at a
    twentieth of the cost; nodes not looked at are NaN in the error map.
    """
    shape = (len(stiffness), len(damping))
    looked = np.zeros(shape, dtype=bool)
    maps = np.full((len(group), *shape), np.nan)

    def look(nodes: NDArray[np.bool_]) -> bool:
        i, j = np.nonzero(nodes & ~looked)
        if len(i):
            maps[:, i, j] = errors(rig, group, stiffness[i], damping[j], weighting)
        looked[i, j] = True
        return len(i) > 0

    first = np.zeros(shape, dtype=bool)
    first[np.ix_(*(np.unique([*range(0, n, _STRIDES[0]), n - 1]) for n in shape))] = True
    look(first)
    for reach, stride in pairwise(_STRIDES):
        while look(_around(maps, reach, stride)):
            pass
    return [GridSearch(stiffness=stiffness, damping=damping, error=row) for row in maps]


def _around(maps: Array, reach: int, stride: int) -> NDArray[np.bool_]:
    """Nodes every `stride` around the best of each map, closer than `reach`, shape (a, b)."""
    shape = maps.shape[1:]
    close = np.zeros(shape, dtype=bool)
    steps = np.arange(-(reach - 1) // stride * stride, reach, stride)
    for row in maps:
        best = np.unravel_index(int(np.nanargmin(row)), shape)
        near = [
            np.unique(np.clip(int(k) + steps, 0, n - 1)) for k, n in zip(best, shape, strict=True)
        ]
        close[np.ix_(*near)] = True
    return close
