"""MatchResult: everything a match found.

`gains.yaml` holds what training needs, `match.npz` beside it the error maps and responses.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from pronk.arrays import Array, ComplexArray
from pronk.files import load_artefact, save_artefact
from pronk.identify.match.gains import (
    NAN,
    UNKNOWN,
    FittedValue,
    JointGains,
    MatchedGains,
    MatchQuality,
    TorqueParameter,
)
from pronk.identify.match.uncertainty import Estimate
from pronk.identify.response.response import FrequencyResponse

SCHEMA = "pronk/match/3"
ZERO_ARMATURE = "zero armature: "
"""Beginning of the flag on the search without rotor inertia; it is no flag on the gains."""
NOT_BETTER = "not better: "
"""Beginning of the flag on a match that is no better there than less fitting."""
_NOT_BETTER = 1.02
"""Error kept aside over that of the best of the others from which on a match is not better: where
the model's friction is right all fits are equal but for noise."""
_OTHERS = {
    "nominal": "the nominal gains",
    "nominal_delayed": "the nominal gains with the best delay",
    "plain": "a plain fit of stiffness, damping and delay",
}
HELD_OUT = (*_OTHERS, "matched")
"""Drives whose errors on what was kept aside are compared."""


@dataclass(frozen=True, kw_only=True)
class JointFit:
    """How one joint was matched; what has no text here is as of `JointGains`.

    Responses share the frequencies of `responses[0]`.
    """

    joint: str
    responses: tuple[FrequencyResponse, ...] = ()
    """Measured, one per amplitude; the first (largest amplitude) is the one matched. Empty where
    several joints moved together and none could be estimated."""
    stiffness: float
    damping: float
    armature: float = NAN
    frictionloss: float = NAN
    stribeck: float = 0.0
    delay_s: float = 0.0
    ci95: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """95 % interval of each fitted parameter by the repeats alone."""
    total95: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """The same with what the model does not explain: the change between amplitudes and between
    parts of the log."""
    held_out: Mapping[str, float] = field(default_factory=dict)
    """RMSE [rad] of `HELD_OUT` on what was kept aside, each octave counting alike."""
    covariance: Array
    """Of (stiffness, damping), shape (2, 2)."""
    held: tuple[str, ...] = ()
    """Parameters that were to be fitted but are held, because the logs do not identify them."""
    band_hz: tuple[float, float] = (NAN, NAN)
    error_db: float = NAN
    naive_error_db: float = NAN
    coherence_min: float = NAN
    matched: ComplexArray = field(default_factory=lambda: np.empty(0, dtype=np.complex128))
    """Simulated response with the matched gains, shape (f,)."""
    naive: ComplexArray = field(default_factory=lambda: np.empty(0, dtype=np.complex128))
    """Simulated response with the real drive's gains put into the simulator, shape (f,)."""
    grid_stiffness: Array = field(default_factory=lambda: np.empty(0))
    """Axis of the grid [N m/rad], shape (a,); empty where no grid was searched."""
    grid_damping: Array = field(default_factory=lambda: np.empty(0))
    """Axis of the grid [N m s/rad], shape (b,)."""
    grid_error: Array = field(default_factory=lambda: np.empty((0, 0)))
    """Mean squared magnitude error in the band [dB^2], shape (a, b)."""
    zero_armature_error_db: float = NAN
    """Smallest error over the same grid with no rotor inertia (paper F13)."""
    zero_armature: ComplexArray | None = None
    """Simulated response at that point of the grid, shape (f,)."""
    repeat_gains: Array = field(default_factory=lambda: np.empty((0, 2)))
    """(stiffness, damping) of each repeat fitted by itself, shape (repeats, 2)."""
    amplitude_gains: Array = field(default_factory=lambda: np.empty((0, 3)))
    """(amplitude, stiffness, damping) of each amplitude fitted by itself, shape (m, 3)."""
    rmse: float = NAN
    """Simulated less recorded position where several joints moved together [rad]."""
    published_rmse: float = NAN
    """The same with the robot's published parameters [rad]."""
    torque: Mapping[str, TorqueParameter] = field(default_factory=dict)
    flags: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Refuse arrays of contradictory shapes."""
        axes = len(self.grid_stiffness), len(self.grid_damping)
        for name, shape in (
            ("covariance", (2, 2)),
            ("repeat_gains", (len(self.repeat_gains), 2)),
            ("amplitude_gains", (len(self.amplitude_gains), 3)),
            ("grid_error", axes),
        ):
            if (found := np.shape(getattr(self, name))) != shape:
                raise ValueError(f"{name} of {self.joint} has shape {found}; expected {shape}")

    @classmethod
    def of(cls, joint: str, found: Estimate, **more: Any) -> JointFit:
        """A fit with the parameters and intervals of an estimate; `more` are the other fields."""
        names = ("stiffness", "damping", "armature", "frictionloss")
        more |= {name: found.values[name] for name in names}
        return cls(
            joint=joint,
            stribeck=found.values.get("stribeck", 0.0),
            delay_s=max(found.values["delay"], 0.0),
            ci95=found.ci95,
            covariance=found.covariance,
            repeat_gains=found.repeat_gains,
            **more,
        )

    def gains(self) -> JointGains:
        """Return the part of the fit that training needs."""
        stiffness_row, damping_row = self.covariance.tolist()
        flags = [flag for flag in self.flags if not flag.startswith(ZERO_ARMATURE)]
        return JointGains(
            stiffness=self._fitted("stiffness", self.stiffness),
            damping=self._fitted("damping", self.damping),
            armature=self._fitted("armature", self.armature),
            frictionloss=self._fitted("frictionloss", self.frictionloss),
            stribeck=self._fitted("stribeck", self.stribeck),
            delay_s=self._fitted("delay", self.delay_s),
            covariance=(tuple(stiffness_row), tuple(damping_row)),
            quality=MatchQuality(
                band_hz=self.band_hz,
                error_db=self.error_db,
                nominal_error_db=self.naive_error_db,
                coherence_min=self.coherence_min,
                amplitude_spread=amplitude_spread(self.amplitude_gains),
            ),
            torque=self.torque,
            flags=tuple(flags),
        )

    def _fitted(self, name: str, value: float) -> FittedValue:
        """Return a parameter with its intervals."""
        return FittedValue(
            value=value,
            repeat95=self.ci95.get(name, UNKNOWN),
            total95=self.total95.get(name, UNKNOWN),
        )


@dataclass(frozen=True, kw_only=True)
class MatchDetails:
    """What matched gains rest on."""

    joints: Mapping[str, JointFit]
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Wall time of each stage [s]."""
    grid_steps_per_second: float = NAN
    """Physics steps per second of the grid search, both cores together."""
    excluded: Mapping[str, str] = field(default_factory=dict)
    """Joints that moved and were not matched, and why."""


@dataclass(frozen=True, kw_only=True)
class MatchResult(MatchDetails):
    """A whole match."""

    gains: MatchedGains


def save(path: Path, result: MatchResult) -> None:
    """Write `match.npz`; `pronk.identify.match.gains.save_gains` writes the gains."""
    details = {f.name: getattr(result, f.name) for f in fields(MatchDetails)}
    save_artefact(path, MatchDetails(**details), SCHEMA)


def load(path: Path, gains: MatchedGains) -> MatchResult:
    """Read what `save` wrote, to go with the gains beside it; ArtefactError for another file."""
    found = load_artefact(path, MatchDetails, SCHEMA, what="a match file", writer="pronk match")
    return MatchResult(gains=gains, **vars(found))


def amplitude_spread(gains: Array) -> float:
    """Largest relative change of stiffness from the first amplitude; NaN with one amplitude.

    Rows of `gains` are (amplitude, stiffness, damping), the matched amplitude first.
    """
    if len(gains) < 2:
        return NAN
    return float(np.abs(gains[1:, 1] / gains[0, 1] - 1.0).max())


def held_out_flags(errors: Mapping[str, float]) -> tuple[str, ...]:
    """Flag a match that is no better on what was kept aside than with less or no fitting."""
    if not errors:
        return ()
    best = min(_OTHERS, key=errors.__getitem__)
    if errors["matched"] <= _NOT_BETTER * errors[best]:
        return ()
    return (
        f"{NOT_BETTER}on what was kept aside it misses by {1e3 * errors['matched']:.2f} mrad, "
        f"{_OTHERS[best]} by {1e3 * errors[best]:.2f} mrad; use those, or record more amplitudes",
    )
