"""What speaks against a match, in words: the flags of `gains.yaml` and of the page."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pronk.match.grid import GridSearch
from pronk.match.interval import measurement_error_db
from pronk.match.measured_joint import MeasuredJoint
from pronk.match.refine import Fit
from pronk.match.settings import MatchSettings

NO_MATCH_DB = 1.0
"""Error in the band above which the best gains are no match [dB]: twice the 0.5 dB that a match
of a good log stays below."""
NO_MATCH_INTERVALS = 3.0
"""A noisy log may miss by more: so many half-widths of the measured gain's own interval."""
NO_ARMATURE_RATIO = 5.0
"""Error without rotor inertia, over the matched one, from which on it is no match (F13)."""


def doubts(
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
    yield f"zero armature: {verdict} by {zero_db:.2g} dB RMS, {ratio:.3g} times the match"
