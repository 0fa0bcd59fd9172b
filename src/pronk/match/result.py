"""MatchResult: everything a match found, for the page and for whoever wants to look again.

`gains.yaml` holds what training needs; `match.npz` beside it holds the error maps and the
responses that the page draws. No pickle.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pronk.files import load_artefact, save_artefact
from pronk.match.gains import MatchedGains
from pronk.response.response import FrequencyResponse

SCHEMA = "pronk/match/2"

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, kw_only=True)
class JointMatch:
    """How one joint was matched. Responses share the frequencies of `responses[0]`."""

    joint: str
    responses: tuple[FrequencyResponse, ...]
    """Measured, one per amplitude; the first (largest amplitude) is the one matched."""
    grid_stiffness: Array
    """Axis of the grid [N m/rad], shape (a,)."""
    grid_damping: Array
    """Axis of the grid [N m s/rad], shape (b,)."""
    grid_error: Array
    """Mean squared magnitude error in the band [dB^2], shape (a, b)."""
    stiffness: float
    damping: float
    covariance: Array
    """Of (stiffness, damping), shape (2, 2)."""
    band_hz: tuple[float, float]
    matched: ComplexArray
    """Simulated response with the matched gains, shape (f,)."""
    naive: ComplexArray
    """Simulated response with the real drive's gains put into the simulator, shape (f,)."""
    error_db: float
    naive_error_db: float
    zero_armature_error_db: float = float("nan")
    """Smallest error over the same grid with no rotor inertia (paper F13)."""
    zero_armature: ComplexArray | None = None
    """Simulated response at that point of the grid, shape (f,)."""
    repeat_gains: Array = field(default_factory=lambda: np.empty((0, 2)))
    """(stiffness, damping) of each repeat fitted by itself, shape (repeats, 2)."""
    amplitude_gains: Array = field(default_factory=lambda: np.empty((0, 3)))
    """(amplitude, stiffness, damping) of each amplitude fitted by itself, shape (m, 3)."""
    flags: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class MatchResult:
    """A whole match: the gains and what they rest on."""

    gains: MatchedGains
    joints: Mapping[str, JointMatch]
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Wall time of each stage [s]."""
    grid_steps_per_second: float = float("nan")
    """Physics steps per second of the grid search, both cores together."""


@dataclass(frozen=True, kw_only=True)
class _Stored:
    """A match without its gains, which have a file of their own."""

    joints: Mapping[str, JointMatch]
    seconds: Mapping[str, float]
    grid_steps_per_second: float


def save(path: Path, result: MatchResult) -> None:
    """Write `match.npz`; the gains themselves are written by `pronk.match.gains.save`."""
    stored = _Stored(
        joints=result.joints,
        seconds=result.seconds,
        grid_steps_per_second=result.grid_steps_per_second,
    )
    save_artefact(path, stored, SCHEMA)


def load(path: Path, gains: MatchedGains) -> MatchResult:
    """Read what `save` wrote, to go with the gains beside it.

    Raises:
        ArtefactError: Missing, damaged or of another schema.
    """
    stored = load_artefact(path, _Stored, SCHEMA, what="a match file", writer="pronk match")
    return MatchResult(gains=gains, **vars(stored))
