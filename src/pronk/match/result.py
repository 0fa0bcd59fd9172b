"""MatchResult: everything a match found, for the page and for whoever wants to look again.

`gains.yaml` holds what training needs; `match.npz` beside it holds the error maps and the
responses that the page draws. No pickle.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pronk.files import save_arrays, stored_arrays
from pronk.match.gains import MatchedGains
from pronk.response.response import FrequencyResponse, packed, unpacked

SCHEMA = "pronk/match/1"

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


_MATCH_ARRAYS = (
    "grid_stiffness",
    "grid_damping",
    "grid_error",
    "covariance",
    "matched",
    "naive",
    "repeat_gains",
    "amplitude_gains",
)
_MATCH_SCALARS = (
    "joint",
    "stiffness",
    "damping",
    "error_db",
    "naive_error_db",
    "zero_armature_error_db",
)


def save(path: Path, result: MatchResult) -> None:
    """Write `match.npz`; the gains themselves are written by `pronk.match.gains.save`."""
    entries = []
    arrays: dict[str, Any] = {}
    for i, joint in enumerate(result.joints.values()):
        arrays |= {f"{i}/{name}": np.asarray(getattr(joint, name)) for name in _MATCH_ARRAYS}
        if joint.zero_armature is not None:
            arrays[f"{i}/zero_armature"] = joint.zero_armature
        responses = []
        for k, response in enumerate(joint.responses):
            scalars, parts = packed(response, f"{i}/{k}")
            responses.append(scalars)
            arrays |= parts
        entries.append(
            {
                **{name: getattr(joint, name) for name in _MATCH_SCALARS},
                "band_hz": joint.band_hz,
                "flags": joint.flags,
                "responses": responses,
            }
        )
    header = {
        "schema": SCHEMA,
        "joints": entries,
        "seconds": dict(result.seconds),
        "grid_steps_per_second": result.grid_steps_per_second,
    }
    save_arrays(path, header, arrays)


def load(path: Path, gains: MatchedGains) -> MatchResult:
    """Read what `save` wrote, to go with the gains beside it.

    Raises:
        ArtefactError: Missing, damaged or of another schema.
    """
    with stored_arrays(path, SCHEMA, what="a match file", writer="pronk match") as (header, arrays):
        return MatchResult(
            gains=gains,
            joints={
                entry["joint"]: JointMatch(
                    **{name: entry[name] for name in _MATCH_SCALARS},
                    **{name: arrays[f"{i}/{name}"] for name in _MATCH_ARRAYS},
                    band_hz=tuple(entry["band_hz"]),
                    flags=tuple(entry["flags"]),
                    responses=tuple(
                        unpacked(scalars, arrays, f"{i}/{k}")
                        for k, scalars in enumerate(entry["responses"])
                    ),
                    zero_armature=arrays.get(f"{i}/zero_armature"),
                )
                for i, entry in enumerate(header["joints"])
            },
            seconds=header["seconds"],
            grid_steps_per_second=header["grid_steps_per_second"],
        )
