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

import numpy as np

from pronk.arrays import Array, Mask
from pronk.errors import PronkError
from pronk.identify.match.measured_joint import DB, MeasuredJoint
from pronk.identify.match.response_fit import Fit, refine
from pronk.identify.match.simulated import SimRequest, grouped, responses
from pronk.identify.simulators.linear import LinearJoint, linearize
from pronk.identify.simulators.mujoco import MujocoSimulator
from pronk.identify.simulators.simulator import JointRigs
from pronk.robots.robot import RobotSpec

Progress = Callable[[float], None]

DIVERGED_DB = 100.0
"""Error written for a simulation that diverged or did not move [dB]: beyond any response."""
_NEAR_DB = 0.2
"""Nodes this close to the best of a shared map are simulated for themselves [dB]; two sides of a
hip_roll differ by 0.03 dB around the best."""
_STRIDES = (7, 3, 1)
"""Every how many nodes the coarse search looks, from far to close."""
_VERIFIED = 3
"""Nodes of the corrected map that are simulated."""
_CLOSE_DB = 0.006
"""Nodes of a map corrected by a value alone that are this close to its best may be better [dB]; in
96 maps (twelve joints, eight drive laws) the best node was within 0.0013 dB."""
_IMPLICIT = 2.0
"""Gains of implicit drive laws over those of the explicit law that answer alike, at most: 1.9 at a
knee of the Mini Cheetah at 10 ms."""


@dataclass(frozen=True, kw_only=True)
class GridSearch:
    """Error over the grid, and its best cell."""

    stiffness: Array
    """Axis [N m/rad], shape (a,)."""
    damping: Array
    """Axis [N m s/rad], shape (b,)."""
    error: Array
    """Mean squared error of the gain [dB^2], shape (a, b); NaN where it was not simulated."""

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


def axes(robot: RobotSpec, points: int = 50) -> tuple[Array, Array]:
    """Axes of the robot's grid (paper F7: 13 to 27 N m/rad and 0.1 to 0.7 N m s/rad, 50 each).

    Those of implicit drive laws reach `_IMPLICIT` times as far.
    """
    reach = 1.0 if robot.law.kind == "explicit" else _IMPLICIT
    (a, b), (c, d) = robot.grid_stiffness, robot.grid_damping
    return np.linspace(a, reach * b, points), np.linspace(c, reach * d, points)


def mean_square(error: Array) -> Array:
    """Mean square of gain errors [dB^2], shape (...), of shape (..., inside) [dB]."""
    error = np.where(np.isfinite(error), np.clip(error, -DIVERGED_DB, DIVERGED_DB), DIVERGED_DB)
    count = error.shape[-1]
    return np.asarray(error**2 @ np.full(count, 1.0 / count))


def alike(targets: Sequence[MeasuredJoint], robot: RobotSpec) -> list[list[MeasuredJoint]]:
    """Targets gathered by simulation: mirror-image joints excited alike share one."""
    return grouped(targets, lambda one, other: one.trace.same_as(other.trace, robot))


def errors(
    rigs: JointRigs,
    group: Sequence[MeasuredJoint],
    stiffness: Array,
    damping: Array,
    progress: Progress = lambda share: None,
    armature: float | None = None,
) -> Array:
    """Mean squared errors of targets that share one simulation [dB^2], shape (group, b).

    The commands of the `group` are the same after mirroring; gains [N m/rad], [N m s/rad] have
    shape (b,), the `armature` [kg m^2] is the drive's if None.
    """
    # One may rest longer than the others at the end.
    longest = max(
        (g.trace for g in group if g.trace.same_as(group[0].trace, rigs.robot)),
        key=lambda one: len(one.command),
    )
    values = {"stiffness": stiffness, "damping": damping}
    if armature is not None:
        values["armature"] = np.full(len(stiffness), armature)
    out = np.empty((len(group), len(stiffness)))
    for part, position in rigs.run([longest], values, max(goal.steps for goal in group)):
        for k, goal in enumerate(group):
            out[k, part] = mean_square(goal.error_db(goal.fit_response(position)))
        progress(part.stop / len(stiffness))
    return out


def search(
    rigs: JointRigs,
    group: Sequence[MeasuredJoint],
    stiffness: Array,
    damping: Array,
    progress: Progress = lambda share: None,
) -> list[GridSearch]:
    """Simulate the whole grid for targets that share one simulation; arguments as `errors`."""
    kp, kd = (axis.ravel() for axis in np.meshgrid(stiffness, damping, indexing="ij"))
    found = errors(rigs, group, kp, kd, progress).reshape(-1, len(stiffness), len(damping))
    return [GridSearch(stiffness=stiffness, damping=damping, error=row) for row in found]


def search_all(
    rigs: JointRigs,
    targets: Sequence[MeasuredJoint],
    stiffness: Array,
    damping: Array,
    progress: Progress = lambda share: None,
) -> list[GridSearch]:
    """The whole grid for any number of targets, each family of mirrored joints simulated once.

    Joints excited alike share a simulation. So do, nearly, joints excited the other way round
    (a left hip_roll moved to the same side as the right one): only gravity and the pose distinguish
    the sides. Their maps are read off the shared simulation, then every node within `_NEAR_DB`
    of the best is simulated for itself. Should any of those have been wrong by half of that, all
    nodes are.
    """
    families = grouped(
        alike(targets, rigs.robot),
        lambda one, other: one[0].trace.same_as(other[0].trace, rigs.robot, sign=-1.0),
    )
    found: dict[int, GridSearch] = {}
    for k, family in enumerate(families):

        def report(share: float, k: int = k) -> None:
            progress((k + share) / len(families))

        members = [goal for group in family for goal in group]
        maps = search(rigs, members, stiffness, damping, report)
        found |= zip(map(id, members), maps, strict=True)
        for group in family[1:]:
            done = _simulate_near(rigs, group, [found[id(goal)] for goal in group])
            found |= zip(map(id, group), done, strict=True)
    return [found[id(goal)] for goal in targets]


def _simulate_near(
    rigs: JointRigs, group: Sequence[MeasuredJoint], shared: Sequence[GridSearch]
) -> list[GridSearch]:
    """Simulate a group's own command wherever its shared maps could be the best."""
    maps = np.array([one.error for one in shared])
    levels = np.sqrt(maps)
    near = (levels < levels.min(axis=(1, 2), keepdims=True) + _NEAR_DB).any(axis=0)
    for nodes in (near, ~near):
        i, j = np.nonzero(nodes)
        maps[:, i, j] = errors(rigs, group, shared[0].stiffness[i], shared[0].damping[j])
        if np.abs(np.sqrt(maps) - levels).max() <= 0.5 * _NEAR_DB:
            break
    return [replace(one, error=row) for one, row in zip(shared, maps, strict=True)]


def coarse_search(
    rigs: JointRigs,
    group: Sequence[MeasuredJoint],
    stiffness: Array,
    damping: Array,
    armature: float | None = None,
) -> list[GridSearch]:
    """Simulate every seventh node and the border, then ever closer around the best.

    Each stride goes around the best node so far until that no longer moves, so the search
    follows a narrow valley to its bottom. Enough to show that no node fits (paper F13) at a
    twentieth of the cost; nodes not simulated are NaN in the error map.
    """
    shape = (len(stiffness), len(damping))
    done = np.zeros(shape, dtype=bool)
    maps = np.full((len(group), *shape), np.nan)

    def simulate(nodes: Mask) -> bool:
        i, j = np.nonzero(nodes & ~done)
        if len(i):
            maps[:, i, j] = errors(rigs, group, stiffness[i], damping[j], armature=armature)
        done[i, j] = True
        return len(i) > 0

    first = np.zeros(shape, dtype=bool)
    first[np.ix_(*(np.unique([*range(0, n, _STRIDES[0]), n - 1]) for n in shape))] = True
    simulate(first)
    for reach, stride in pairwise(_STRIDES):
        while simulate(_around(maps, reach, stride)):
            pass
    return [GridSearch(stiffness=stiffness, damping=damping, error=row) for row in maps]


def _around(maps: Array, reach: int, stride: int) -> Mask:
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


def quick_search(
    rigs: JointRigs,
    targets: Sequence[MeasuredJoint],
    stiffness: Array,
    damping: Array,
    *,
    exact: bool = True,
    corrections: Sequence[Array] = (),
) -> tuple[list[GridSearch], list[Fit]]:
    """Search the grid linearized everywhere and simulated where it matters, with MuJoCo alone.

    1. The closed form (`pronk.identify.simulators.linear`) over the whole grid gives a first cell.
    2. Gauss-Newton with the simulator goes from there to the optimum off the grid; not `exact`
       with the slope of the closed form (see `refine`).
    3. The simulated value and slope there correct the closed form (manifold space mapping: Bandler
       et al., *Space mapping: the state of the art*, IEEE Trans. MTT 52(1), 2004), and the
       corrected map is searched again. Its best few nodes are simulated, and the simulator decides
       between them.

    With `corrections` of the closed form (log gain, shape (inside,) of each target), as another
    framework has them, 1. ends at the optimum of the corrected closed form, 2. is not exact, and
    3. simulates only nodes that may be the best: two simulations are enough for most joints.

    Returns the corrected map, simulated around its best node, and the optimum off the grid of each
    target.
    """
    if not isinstance(rigs, MujocoSimulator):
        raise PronkError(
            f"the quick search linearizes MuJoCo; with simulator {rigs.info.engine} search "
            "the grid."
        )
    kp, kd = (axis.ravel() for axis in np.meshgrid(stiffness, damping, indexing="ij"))
    known = corrections or [np.zeros(len(goal.omega)) for goal in targets]
    plants = [linearized(rigs, goal) for goal in targets]
    logs, first = [], []
    for goal, linear, correction in zip(targets, plants, known, strict=True):
        logs.append(np.log(np.abs(linear.response(kp, kd, amplitude=goal.trace.amplitude))))
        best = int(np.argmin(_map(goal, logs[-1] + correction)))
        first.append((float(kp[best]), float(kd[best])))
    if corrections:
        first = [fit.gains for fit in refine(rigs, targets, first, plants, corrections)]
    fits = refine(rigs, targets, first, plants)
    if exact and not corrections:
        fits = refine(rigs, targets, [fit.gains for fit in fits])
    maps, nodes, requests = [], [], []
    for goal, p, log, fit in zip(targets, plants, logs, fits, strict=True):
        maps.append(_map(goal, log + _correction(p, fit, kp, kd)))
        count = _VERIFIED
        if corrections:
            levels = np.sqrt(maps[-1])
            count = int((levels < levels.min() + _CLOSE_DB).sum())
        nodes.append(np.argsort(maps[-1])[: count if count > 1 else 0])
        requests += [SimRequest(goal, kp[k], kd[k]) for k in nodes[-1]]
    simulated = iter(responses(rigs, requests))
    grids = []
    for goal, error, mine in zip(targets, maps, nodes, strict=True):
        if len(mine):
            verified = [float(mean_square(goal.error_db(next(simulated)))) for _ in mine]
            # The simulator decides among them; no node without a simulation may win.
            error = np.maximum(error, min(verified) * (1.0 + 1e-9))
            error[mine] = verified
        error = error.reshape(len(stiffness), len(damping))
        grids.append(GridSearch(stiffness=stiffness, damping=damping, error=error))
    return grids, fits


def linearized(rigs: MujocoSimulator, goal: MeasuredJoint) -> LinearJoint:
    """The joint of a measured response in closed form, at the frequencies of the fit."""
    return linearize(rigs.rig(goal.joint), goal.trace.excitation(rigs.robot)[0], goal.omega)


def _map(goal: MeasuredJoint, log: Array) -> Array:
    """Mean squared errors of log gains, shapes (b, inside) to (b,) [dB^2]."""
    return mean_square(DB * (log - np.log(np.abs(goal.measured.response[goal.fit_mask]))))


def _correction(linear: LinearJoint, fit: Fit, stiffness: Array, damping: Array) -> Array:
    """Log gain of the simulator over that of the closed form, to first order, shape (b, f)."""
    goal = fit.target
    amplitude = goal.trace.amplitude
    closed = np.log(np.abs(linear.response(*fit.gains, amplitude=amplitude)))[0]
    simulated = fit.solution.jacobian * goal.deviation_db()[:, None] / DB
    slope = simulated - linear.slope(*fit.gains, amplitude=amplitude)
    measured = np.log(np.abs(goal.measured.response[goal.fit_mask]))
    value = fit.gain_db / DB + measured - closed
    away = np.log(np.column_stack([stiffness, damping])) - np.log(fit.gains)
    return np.asarray(value + away @ slope.T)
