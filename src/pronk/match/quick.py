"""The grid by the quick way: linearized everywhere, simulated where it matters.

1. The closed form (`linear.py`) over the whole grid gives a first cell.
2. Gauss-Newton with the simulator goes from there to the optimum off the grid.
3. The simulated value and slope there correct the closed form (manifold space
   mapping: Bandler et al., *Space mapping: the state of the art*, IEEE Trans. MTT 52(1), 2004),
   and the corrected map is searched again. Its best few nodes are simulated, and the simulator
   decides between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pronk.errors import PronkError
from pronk.match.grid import GridSearch, mean_square, weights
from pronk.match.measured_joint import DB, MeasuredJoint, SimRequest, responses
from pronk.match.refine import Fit, refine
from pronk.simulators.linear import Plant, plant
from pronk.simulators.mujoco import JointTestRig
from pronk.simulators.simulator import JointRigs

Array = NDArray[np.float64]

_VERIFIED = 3
"""Nodes of the corrected map that are simulated."""
_STEP = 1e-3
"""Step of the closed form's derivative in the logarithm of a gain."""


@dataclass(frozen=True, kw_only=True)
class QuickSearch:
    """What the quick way found for one joint."""

    grid: GridSearch
    """Corrected map; the nodes around its best are simulated."""
    fit: Fit
    """Optimum off the grid, found and verified by simulation."""


def quick_search(
    simulator: JointRigs,
    targets: Sequence[MeasuredJoint],
    stiffness: Array,
    damping: Array,
    *,
    weighting: Literal["none", "coherence"] = "none",
    use_phase: bool = False,
) -> list[QuickSearch]:
    """Best node and optimum of each target.

    Args:
        simulator: The training simulator.
        targets: What to match.
        stiffness: Axis [N m/rad], shape (a,).
        damping: Axis [N m s/rad], shape (b,).
        weighting: Weights of the frequencies in the grid error.
        use_phase: Let the optimum off the grid see the phase.
    """
    kp, kd = (axis.ravel() for axis in np.meshgrid(stiffness, damping, indexing="ij"))
    shape = (len(stiffness), len(damping))
    plants = [_plant(simulator, goal) for goal in targets]
    weight = [weights(goal, weighting) for goal in targets]
    logs = [
        np.log(np.abs(p.response(kp, kd, amplitude=goal.trace.amplitude)))
        for p, goal in zip(plants, targets, strict=True)
    ]
    first = [
        int(np.argmin(mean_square(goal, np.exp(log).astype(np.complex128), w)))
        for goal, log, w in zip(targets, logs, weight, strict=True)
    ]
    start = [(float(kp[k]), float(kd[k])) for k in first]
    fits = refine(simulator, targets, start, use_phase=use_phase)
    maps, requests = [], []
    for goal, p, log, w, fit in zip(targets, plants, logs, weight, fits, strict=True):
        corrected = log + _correction(p, fit, kp, kd)
        maps.append(mean_square(goal, np.exp(corrected).astype(np.complex128), w))
        requests += [SimRequest(goal, kp[k], kd[k]) for k in np.argsort(maps[-1])[:_VERIFIED]]
    simulated = responses(simulator, requests)
    found = []
    for i, (goal, w, fit) in enumerate(zip(targets, weight, fits, strict=True)):
        best = np.argsort(maps[i])[:_VERIFIED]
        mine = simulated[_VERIFIED * i : _VERIFIED * (i + 1)]
        verified = [float(mean_square(goal, response, w)) for response in mine]
        # The simulator decides among them; no node without a simulation may win.
        floor = min(verified)
        maps[i] = np.maximum(maps[i], floor * (1.0 + 1e-9))
        maps[i][best] = verified
        grid = GridSearch(stiffness=stiffness, damping=damping, error=maps[i].reshape(shape))
        found.append(QuickSearch(grid=grid, fit=fit))
    return found


def _plant(simulator: JointRigs, goal: MeasuredJoint) -> Plant:
    rig = simulator.rig(goal.joint)
    if not isinstance(rig, JointTestRig):
        raise PronkError(
            f"the quick search linearizes MuJoCo; with simulator {simulator.info.engine} search "
            "the grid."
        )
    return plant(rig, rig.pose(goal.trace), goal.omega)


def _correction(linear: Plant, fit: Fit, stiffness: Array, damping: Array) -> Array:
    """Log gain of the simulator over that of the closed form, to first order, shape (b, f)."""
    amplitude = fit.target.trace.amplitude
    at = np.array([fit.stiffness, fit.damping])
    near = at * np.exp(_STEP * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    closed = np.log(np.abs(linear.response(near[:, 0], near[:, 1], amplitude=amplitude)))
    count = closed.shape[1]
    slope = fit.jacobian[:count, :2] / DB - (closed[1:] - closed[0]).T / _STEP
    value = np.log(np.abs(fit.simulated)) - closed[0]
    away = np.log(np.column_stack([stiffness, damping])) - np.log(at)
    return np.asarray(value + away @ slope.T)
