"""Which laws explain the runs: each is fitted with few simulations, the best ones with more.

The law with the smallest residual is the answer, with those that explain the motion as well.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pronk.arrays import Array
from pronk.identify.simulators.probe.law_fit import (
    PARAMETERS,
    LawFit,
    ProbeRuns,
    fit_law,
    simulate_law,
)
from pronk.identify.simulators.probe.result import ActingLaw
from pronk.robots.drive_law import DriveLaw

_USUAL_SCALES = (1.0, 2.0, 180.0 / math.pi, math.pi / 180.0)
"""Factors on both gains that have a usual cause."""
_ITERATIONS = (1, 2, 3, 4, 6, 8, 10, 12, 16, 20, 32)
"""Iterations of law implicit that are tried."""
_STALE_STEPS = (1, 2, 3, 4)
"""Ages of the position in the torque that are tried [steps]."""
_SCREENING_EVALUATIONS = 20
"""Simulations of the runs with which a law is tried."""
_FINAL_EVALUATIONS = 60
"""Simulations of the runs with which one of the best laws is fitted."""
_FAR = 30.0
"""A law whose residual is so many times another's is not followed further: iterations change the
residual by less."""
CLEAR = 0.7
"""The best law is clear if its residual is less than this share of the next one's."""
_NO_DAMPING = 1e-3
"""Damping that acts over the one that is set below which there is none."""
_SAME_RESIDUAL = 1e-7
"""Residual below which laws differ by rounding alone."""
_NEAR_RESIDUAL = 0.05
"""Residual of a law below which the kind of its friction may be all that is wrong."""
EXACT_RESIDUAL = 1e-6
"""Residual of a law that is certainly right: no other is tried."""


def best_laws(
    runs: ProbeRuns, delay: int, stated: DriveLaw, armature_settable: bool
) -> list[LawFit]:
    """Fit the laws that may be right, and return the fits, the best one first.

    Args:
        runs: The runs.
        delay: Whole steps of delay.
        stated: Law that the simulator states.
        armature_settable: True if the armature was changed in one run.
    """
    fixed = [] if armature_settable else ["applied"]
    candidates = _as_set(runs, delay, stated, fixed)
    if candidates[-1].residual < EXACT_RESIDUAL:
        # These two move alike where no damping acts.
        soft = candidates[-1].law.soft_friction
        for law in (DriveLaw(), DriveLaw(kind="implicit_damping")):
            acting_law = ActingLaw(drive=law, soft_friction=soft)
            if not acting_law.moves_as(candidates[-1].law):
                candidates.append(_screened_law(runs, acting_law, None, delay, fixed))
    else:
        candidates += _screened(runs, delay, fixed)
    candidates = _best_of_each_law(candidates)
    # The stated law too, which is the answer where others explain the motion no better.
    tried = candidates[:3]
    plain_laws = [stated, DriveLaw(), DriveLaw(kind="implicit_damping")]
    for candidate in candidates[3:]:
        if any(candidate.law.moves_as(ActingLaw(drive=drive)) for drive in plain_laws):
            tried.append(candidate)
    finals: list[LawFit] = []
    for candidate in tried:
        is_stated = candidate.law.moves_as(ActingLaw(drive=stated))
        is_far = finals and candidate.residual > _FAR * max(finals[0].residual, _SAME_RESIDUAL)
        # Where no damping acts, explicit and implicit damping are the same.
        undamped = len(finals) > 0 and finals[0].value("damping") < _NO_DAMPING
        is_plain = any(candidate.law.moves_as(ActingLaw(drive=drive)) for drive in plain_laws)
        if is_far and not is_stated and not (undamped and is_plain):
            continue
        if finals and runs.exhausted:
            break
        fit = fit_law(runs, candidate.law, candidate.theta, fixed, _FINAL_EVALUATIONS)
        if is_far:
            # Whether the stated law explains the motion with the values of the best one.
            other_fit = fit_law(runs, fit.law, finals[0].theta, fixed, _FINAL_EVALUATIONS)
            fit = min(fit, other_fit, key=lambda law_fit: law_fit.residual)
        # A factor on one of the gains must explain more than none.
        plain_start = fit.theta.copy()
        plain_start[PARAMETERS.index("damping")] = 1.0
        plain_fit = fit_law(
            runs, candidate.law, plain_start, [*fixed, "damping"], _FINAL_EVALUATIONS
        )
        if fit.residual >= plain_fit.residual / 3.0 - 1e-6:
            finals.append(plain_fit)
        else:
            finals.append(fit)
        finals.sort(key=lambda final: final.residual)
    for index, fit in enumerate(finals):
        is_stated = fit.law.moves_as(ActingLaw(drive=stated))
        if is_stated and fit.law in alike_laws(finals):
            finals.insert(0, finals.pop(index))
            break
    return finals


def _best_of_each_law(fits: Sequence[LawFit]) -> list[LawFit]:
    """Return the best fit of each law, the best law first; the stated one was fitted twice."""
    best: dict[ActingLaw, LawFit] = {}
    for fit in sorted(fits, key=lambda law_fit: law_fit.residual):
        best.setdefault(fit.law, fit)
    return list(best.values())


def alike_laws(ranking: Sequence[LawFit]) -> tuple[ActingLaw, ...]:
    """Return the laws but the first that explain the motion as well as the best one."""
    least_residual = min(fit.residual for fit in ranking)
    laws: list[ActingLaw] = []
    for fit in ranking[1:]:
        as_well = fit.residual < max(least_residual / CLEAR, _SAME_RESIDUAL)
        if as_well and not any(fit.law.moves_as(law) for law in (ranking[0].law, *laws)):
            laws.append(fit.law)
    return tuple(laws)


def _as_set(runs: ProbeRuns, delay: int, stated: DriveLaw, fixed: Sequence[str]) -> list[LawFit]:
    """Fit the stated law from what is set, with soft friction too where it leaves something."""
    fits: list[LawFit] = []
    start = runs.set_values.copy()
    start[PARAMETERS.index("delay")] = delay
    for soft in (False, True):
        law = ActingLaw(drive=stated, soft_friction=soft)
        fits.append(fit_law(runs, law, start, fixed, _SCREENING_EVALUATIONS))
        if not EXACT_RESIDUAL < fits[-1].residual < _NEAR_RESIDUAL:
            break
    return fits


def _screened(runs: ProbeRuns, delay: int, fixed: Sequence[str]) -> list[LawFit]:
    """Fit the laws to the runs with few simulations, the quick ones first.

    The fits end with a law that leaves nothing, or with the last step.
    """
    explicit = DriveLaw()
    implicit_damping = DriveLaw(kind="implicit_damping")
    fits: list[LawFit] = []
    for soft in (False, True):
        if soft:
            # Whether friction is soft shows where there is some.
            best = min(fits, key=lambda fit: fit.residual)
            if best.value("friction") <= 0.002 * runs.torque or best.residual < 1e-5:
                break
        quick = [ActingLaw(drive=explicit), ActingLaw(drive=implicit_damping)]
        quick.append(ActingLaw(drive=implicit_damping, beside_explicit=True))
        ages = _STALE_STEPS[:1] if soft else _STALE_STEPS
        for age in ages:
            quick.append(ActingLaw(drive=explicit, stale_position=age))
            quick.append(ActingLaw(drive=explicit, stale_position=age, stale_speed=age))
        quick.append(ActingLaw(drive=implicit_damping, stale_position=1))
        for law in quick:
            if fits and runs.exhausted:
                return fits
            start = _hard_friction_start(fits, law) if soft else None
            fits.append(_screened_law(runs, replace(law, soft_friction=soft), start, delay, fixed))
        if min(fit.residual for fit in fits) < EXACT_RESIDUAL:
            return fits
        for beside in (False, True):
            _screen_iterations(runs, fits, (beside, soft), delay, fixed)
            if min(fit.residual for fit in fits) < EXACT_RESIDUAL:
                return fits
    return fits


def _hard_friction_start(fits: Sequence[LawFit], law: ActingLaw) -> Array | None:
    """Return the parameters of a law as it was fitted without soft friction, None if it was not.

    Those of other laws are no start: beside an explicit torque inertia, friction and gravity are
    twice what they are without it.
    """
    for fit in fits:
        if fit.law == replace(law, soft_friction=False):
            return fit.theta
    return None


def _screen_iterations(
    runs: ProbeRuns,
    fits: list[LawFit],
    variant: tuple[bool, bool],
    delay: int,
    fixed: Sequence[str],
) -> None:
    """Fit law implicit with few, then more iterations, and add the fits to `fits`.

    Args:
        runs: The runs.
        fits: Fits of other laws.
        variant: True if an explicit torque acts beside it, and if friction is soft.
        delay: Whole steps of delay.
        fixed: Names of parameters that are not fitted.
    """
    beside, soft = variant
    by_iterations: dict[int, LawFit] = {}

    def fit_iterations(iterations: int, neighbour: LawFit | None) -> LawFit:
        law = ActingLaw(
            drive=DriveLaw(kind="implicit", iterations=iterations),
            beside_explicit=beside,
            soft_friction=soft,
        )
        start = _hard_friction_start(fits, law) if soft else None
        if start is None and neighbour is not None:
            start = neighbour.theta
        fit = _screened_law(runs, law, start, delay, fixed)
        fits.append(fit)
        by_iterations[iterations] = fit
        return fit

    previous: LawFit | None = None
    rises = 0
    for iterations in _ITERATIONS:
        if runs.exhausted:
            return
        fit = fit_iterations(iterations, previous)
        # The residual has one minimum over the iterations.
        if previous is not None and fit.residual > previous.residual:
            rises += 1
        else:
            rises = 0
        least_residual = min(other.residual for other in fits)
        if rises == 2 or (iterations >= 4 and fit.residual > _FAR * least_residual):
            break
        if least_residual < EXACT_RESIDUAL:
            return
        previous = fit
    # Numbers between those of the list: 5 beside 4 and 6.
    best = min(by_iterations, key=lambda iterations: by_iterations[iterations].residual)
    least_residual = min(other.residual for other in fits)
    if by_iterations[best].residual > least_residual:
        return
    for iterations in range(max(best - 2, 1), best + 3):
        if iterations not in by_iterations and not runs.exhausted:
            fit_iterations(iterations, by_iterations[best])


def _screened_law(
    runs: ProbeRuns, law: ActingLaw, start: Array | None, delay: int, fixed: Sequence[str]
) -> LawFit:
    """Fit a law with few simulations, from the best point of a grid where no start is given."""
    if start is None:
        starts = []
        for scale in _USUAL_SCALES:
            for inertia_factor in np.geomspace(1.0, 500.0, 18):
                inertia = runs.inertia * inertia_factor / scale
                starts.append([1.0, inertia, 0.0, 0.0, delay, 1.0 / scale, 1.0 / scale])
        with np.errstate(all="ignore"):
            difference = simulate_law(runs, law, np.array(starts)) - runs.position
            square = np.mean(difference**2, axis=(1, 2))
        best = np.nan_to_num(square, nan=np.inf).argmin()
        start = np.array(starts[best])
    return fit_law(runs, law, start, fixed, _SCREENING_EVALUATIONS)


def gain_scale(runs: ProbeRuns, fit: LawFit, armature_settable: bool) -> float:
    """Return the factor on both gains with which armature and gravity act as they are set.

    A factor with a usual cause is taken unless another one explains both.
    """
    applied = fit.value("applied")
    gravity = fit.value("gravity")
    shares = []
    if armature_settable:
        shares.append(applied)
    if runs.gravity_shows:
        shares.append(gravity)

    def misfit(scale: float) -> float:
        total = 1e-3 * abs(math.log(scale))
        for share in shares:
            total += min(abs(scale * share - 1.0), 1.0)
        return total

    best = min(_USUAL_SCALES, key=misfit)
    least_misfit = misfit(best)
    for share in shares:
        if share > 0.01 and misfit(1.0 / share) + 0.1 < least_misfit:
            best = 1.0 / share
            least_misfit = misfit(best) + 0.1
    return best
