"""Off the grid: Gauss-Newton on the gain in dB, with the simulator itself as the model.

Each round simulates every joint at its point and at one small step along each gain, all joints
together in one rollout per original joint, so a round costs a fraction of a second. Frequencies
are weighted by their coherence. The unknowns are the logarithms of the gains:
positive, and alike in scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pronk.match.measured_joint import DB, MeasuredJoint, SimRequest, responses
from pronk.simulators.simulator import JointRigs

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

_STEP = 0.02
"""Step of the finite differences in the logarithm of a gain: far above the chatter of dry
friction, small against the curvature of the error."""
_LONGEST = 0.3
"""Longest step of one round in the logarithm of a gain."""
_SETTLED = 3e-4
"""A joint whose next step is shorter is done: 0.03 % of a gain."""
_ROUNDS = 12
"""Three or four are usual; joints that are done drop out."""


@dataclass(frozen=True, kw_only=True)
class Fit:
    """One joint's gains off the grid, and what the interval needs to know of them."""

    target: MeasuredJoint
    stiffness: float
    damping: float
    delay_s: float
    """Command delay beyond the simulator's [s]; NaN if the phase was disregarded."""
    simulated: ComplexArray
    """Response at the optimum, shape (inside,)."""
    jacobian: Array
    """Change of the residual per unit of log stiffness, log damping (and delay), shape (m, p)."""
    weight: Array
    """Weight of each residual [1/dB^2], shape (m,)."""
    residual: Array
    """Simulated less measured [dB], gain first and then, if used, phase, shape (m,)."""
    settled: bool
    """False if the rounds ran out."""

    @property
    def error_db(self) -> float:
        """Root mean square of the gain error in the band, frequencies counting alike [dB]."""
        return float(np.sqrt(np.mean(self.target.error_db(self.simulated) ** 2)))

    def influence(self) -> Array:
        """Linear map from a change of the measured dB to one of the log gains, shape (2, m).

        `(J^T W J)^-1 J^T W`, the rows of stiffness and damping.
        """
        weighted = self.jacobian.T * self.weight
        return np.asarray(np.linalg.solve(weighted @ self.jacobian, weighted)[:2])


def residual_db(
    goal: MeasuredJoint, simulated: ComplexArray, measured: ComplexArray, use_phase: bool
) -> Array:
    """Simulated over measured response in dB, gain and then (if used) phase.

    A radian of phase counts as a neper of gain, 8.69 dB: noise turns a response as much as it
    stretches it.

    Args:
        goal: Whose frequencies these are.
        simulated: Shape (..., inside).
        measured: Shape (..., inside).
        use_phase: Append the phase.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.log(np.asarray(simulated / measured, dtype=np.complex128))
    if not use_phase:
        return np.asarray(DB * ratio.real)
    turn = np.unwrap(ratio.imag, axis=-1)
    return np.concatenate([DB * ratio.real, DB * turn], axis=-1)


@dataclass
class _State:
    """Where one joint is, between rounds."""

    x: Array
    cost: float = np.inf
    best: Array | None = None
    step: Array | None = None
    fit: Fit | None = None
    done: bool = False


def refine(
    simulator: JointRigs,
    targets: Sequence[MeasuredJoint],
    start: Sequence[tuple[float, float]],
    *,
    use_phase: bool = False,
) -> list[Fit]:
    """Gains that minimize the weighted squared error, one pair a target.

    Args:
        simulator: The training simulator.
        targets: What to match.
        start: (stiffness, damping) to start from, one a target.
        use_phase: Fit gain and phase, with a free delay.
    """
    states = [_State(x=np.log(np.asarray(pair, dtype=np.float64))) for pair in start]
    offsets = np.array([[0.0, 0.0], [_STEP, 0.0], [0.0, _STEP]])
    for _ in range(_ROUNDS):
        active = [i for i, state in enumerate(states) if not state.done]
        if not active:
            break
        requests = [
            SimRequest(targets[i], *np.exp(states[i].x + offset))
            for i in active
            for offset in offsets
        ]
        simulated = responses(simulator, requests)
        for k, i in enumerate(active):
            _round(states[i], targets[i], np.array(simulated[3 * k : 3 * k + 3]), use_phase)
    fits = [state.fit for state in states]
    return [fit for fit in fits if fit is not None]


def _round(state: _State, goal: MeasuredJoint, simulated: ComplexArray, use_phase: bool) -> None:
    """Judge the last step by its simulation and take the next."""
    measured = goal.measured.response[goal.fit_mask]
    rows = residual_db(goal, simulated, measured, use_phase)
    weight = goal.deviation_db() ** -2.0
    if use_phase:
        weight = np.concatenate([weight, weight])
    jacobian = (rows[1:] - rows[0]).T / _STEP
    delay = 0.0
    residual = rows[0]
    if use_phase:
        # The phase of a delay: -omega * delay; in milliseconds, alike in scale to the others.
        turn = np.concatenate([np.zeros(len(goal.omega)), -DB * goal.omega * 1e-3])
        jacobian = np.column_stack([jacobian, turn])
        delay = float(-(turn * weight) @ residual / ((turn * weight) @ turn))
        residual = residual + turn * delay
    cost = float(weight @ residual**2)
    if not np.isfinite(cost) or not cost <= state.cost * (1.0 + 1e-9):
        # Worse (or diverged): go back half the way, at most to where it came from.
        if state.step is None or state.best is None or np.abs(state.step).max() < _SETTLED:
            # A step too short to matter no longer helps: this is the optimum.
            state.done = True
            if state.fit is not None:
                state.fit = replace(state.fit, settled=True)
            return
        state.step = state.step / 2.0
        state.x = state.best + state.step
        return
    weighted = jacobian.T * weight
    step = -np.linalg.lstsq(weighted @ jacobian, weighted @ residual, rcond=None)[0][:2]
    step = np.clip(step, -_LONGEST, _LONGEST)
    settled = bool(np.abs(step).max() < _SETTLED)
    state.cost, state.best, state.step = cost, state.x, step
    state.fit = Fit(
        target=goal,
        stiffness=float(np.exp(state.x[0])),
        damping=float(np.exp(state.x[1])),
        delay_s=delay * 1e-3 if use_phase else float("nan"),
        simulated=simulated[0],
        jacobian=jacobian,
        weight=weight,
        residual=residual,
        settled=settled,
    )
    state.done = settled
    state.x = state.x + step
