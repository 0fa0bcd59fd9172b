"""What a replay of a log gave: the artefact between `pronk predict` and the page.

One `*.prediction.npz` a log, plain arrays and a JSON header, no pickle.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pronk.files import load_artefact, save_artefact

SCHEMA = "pronk/prediction/2"

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class JointPrediction:
    """One joint's response to a log, measured and simulated, at the log's timestamps."""

    joint: str
    time: Array
    """Instants at which the joint was excited, all segments in a row [s], shape (n,)."""
    command: Array
    """Position command in force [rad], shape (n,)."""
    measured: Array
    """[rad], shape (n,)."""
    naive: Array
    """Simulated with the gains of the real drive [rad], shape (n,)."""
    naive_delayed: Array
    """The same with the delay that goes with the matched gains [rad], shape (n,): what the gains
    alone are worth."""
    matched: Array
    """Simulated with the matched gains and their delay [rad], shape (n,)."""
    signal: str = "unknown"
    """Kind of the signal that was replayed."""
    unit: str = "rad"

    @property
    def rmse_naive(self) -> float:
        """Root mean square of naive less measured [rad]."""
        return rmse(self.naive, self.measured)

    @property
    def rmse_naive_delayed(self) -> float:
        """Root mean square of naive with the delay less measured [rad]."""
        return rmse(self.naive_delayed, self.measured)

    @property
    def rmse_matched(self) -> float:
        """Root mean square of matched less measured [rad]."""
        return rmse(self.matched, self.measured)

    @property
    def r2_naive(self) -> float:
        """Share of the measured variance that the naive simulation explains."""
        return r2(self.naive, self.measured)

    @property
    def r2_matched(self) -> float:
        """Share of the measured variance that the matched simulation explains."""
        return r2(self.matched, self.measured)


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """All joints of one log."""

    joints: tuple[JointPrediction, ...]
    source: str
    virtual: bool
    excluded: Mapping[str, str] = field(default_factory=dict)
    """Joints that moved and were not predicted, and why."""


def rmse(simulated: Array, measured: Array) -> float:
    """Root mean square difference."""
    return float(np.sqrt(np.mean((simulated - measured) ** 2)))


def r2(simulated: Array, measured: Array) -> float:
    """One less the share of the measured variance that is left over; NaN for a still joint."""
    spread = float(np.var(measured))
    if spread == 0.0:
        return float("nan")
    return float(1.0 - np.mean((simulated - measured) ** 2) / spread)


def save(path: Path, prediction: Prediction) -> None:
    """Write a prediction, whole or not at all."""
    save_artefact(path, prediction, SCHEMA)


def load(path: Path) -> Prediction:
    """Read what `save` wrote.

    Raises:
        ArtefactError: Missing, damaged or of another schema.
    """
    return load_artefact(path, Prediction, SCHEMA, what="a prediction", writer="pronk predict LOG")
