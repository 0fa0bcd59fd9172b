"""What speaks against a match, in words: the flags of `gains.yaml` and of the page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from pronk.match.grid import GridSearch
from pronk.match.measured_joint import MeasuredJoint
from pronk.match.refine import Fit
from pronk.match.result import ZERO_ARMATURE, amplitude_spread
from pronk.match.settings import MatchSettings
from pronk.match.uncertainty import measurement_error_db
from pronk.response.response import FrequencyResponse

NO_MATCH_DB = 1.0
"""Error in the band above which the best gains are no match [dB]: twice the 0.5 dB that a match
of a good log stays below."""
NO_MATCH_INTERVALS = 3.0
"""A noisy log may miss by more: so many half-widths of the measured gain's own interval."""
NO_ARMATURE_RATIO = 5.0
"""Error without rotor inertia, over the matched one, from which on it is no match (F13)."""


def warnings(
    goal: MeasuredJoint, fit: Fit, grid: GridSearch, settings: MatchSettings
) -> Iterator[str]:
    """What speaks against the optimum."""
    limit = no_match_db(fit, settings)
    if not fit.error_db <= limit:
        yield (
            f"no match: the best gains miss the measured response by {fit.error_db:.2g} dB RMS, "
            f"more than {limit:.2g} dB; the model lacks something that the robot has"
        )
    if grid.at_edge:
        yield (
            f"at the edge of the grid ({grid.gains[0]:.3g} N m/rad, {grid.gains[1]:.3g} N m s/rad)"
        )
    if not fit.settled:
        yield "the refinement did not settle; take the gains of the grid"
    if not goal.trace.policy_held:
        yield "the command does not change at the policy's rate; each physics step holds its own"


def no_match_db(fit: Fit, settings: MatchSettings) -> float:
    """Error in the band above which gains are no match [dB]."""
    return max(NO_MATCH_DB, NO_MATCH_INTERVALS * measurement_error_db(fit, level=settings.level))


def missing(goal: MeasuredJoint, band: NDArray[np.bool_]) -> Iterator[str]:
    """Frequencies of the band that the fit did not look at."""
    left, whole = int(band.sum()) - int(goal.fit_mask.sum()), int(band.sum())
    if left:
        yield f"{left} of {whole} frequencies left out for low coherence"


def armature_flags(fit: Fit, zero_db: float, settings: MatchSettings) -> Iterator[str]:
    """What the search without rotor inertia says (F13)."""
    if not np.isfinite(zero_db):
        return
    ratio = zero_db / max(fit.error_db, 1e-6)
    if ratio >= NO_ARMATURE_RATIO and zero_db > no_match_db(fit, settings):
        verdict = "no match, the best node misses"
    else:
        # A light rotor on a heavy link: other gains make up for it.
        verdict = "not ruled out by this joint, its best node misses"
    yield f"{ZERO_ARMATURE}{verdict} by {zero_db:.2g} dB RMS, {ratio:.3g} times the match"


SPREAD_MAX = 0.05
"""Relative change of stiffness between amplitudes that is worth a flag; the paper's own
randomization is 2 N m/rad on 20 (D3), twice that."""


def amplitude_gains(fits: Sequence[Fit]) -> NDArray[np.float64]:
    """(amplitude, stiffness, damping) of each amplitude fitted by itself, shape (m, 3)."""
    return np.array(
        [(fit.target.measured.amplitude, fit.stiffness, fit.damping) for fit in fits]
    ).reshape(-1, 3)


def amplitude_flags(gains: NDArray[np.float64]) -> tuple[str, ...]:
    """What to tell the user of the spread."""
    spread = amplitude_spread(gains)
    if not spread > SPREAD_MAX:
        return ()
    largest, smallest = gains[:, 0].max(), gains[:, 0].min()
    return (
        f"friction: stiffness changes by {100.0 * spread:.0f} % between {smallest:.3g} and "
        f"{largest:.3g} rad; give the simulator the joint's dry friction, or match at the "
        "amplitude that the policy will use",
    )


def command_delay(
    measured: FrequencyResponse,
    matched: NDArray[np.complex128],
    band_hz: tuple[float, float],
    *,
    coherence_min: float = 0.8,
) -> float:
    """Delay of the measured response behind the matched one [s], never negative.

    The magnitude gives the gains (paper F9); phase = -omega * delay, a straight line through zero.

    Least squares through zero over the joint's band: every frequency with enough coherence counts
    alike. Zero where none has.
    """
    band = measured.band(*band_hz, coherence_min)
    if not band.any():
        return 0.0
    omega = measured.omega[band]
    lag = -np.unwrap(np.angle(measured.response[band] / matched[band]))
    return max(0.0, float(omega @ lag / (omega @ omega)))
