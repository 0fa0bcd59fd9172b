"""MatchedGains: the gains that make the simulated joint respond like the real one.

`gains.yaml` has the simulator that the gains hold for, a line per joint, a line per joint group.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from pronk.errors import ArtefactError
from pronk.files import converted, read_yaml, write_text
from pronk.identify.simulators.simulator import SimulatorInfo
from pronk.names import check_names

SCHEMA = "pronk/gains/1"
NAN = float("nan")
_BOUNDS = {
    **dict.fromkeys(("stiffness", "damping", "armature", "frictionloss"), (0.0, 1e6)),
    **dict.fromkeys(("stiffness_range", "damping_range"), (0.0, 1e6)),
    "stribeck": (0.0, 1.0),
    "delay_s": (0.0, 1.0),
}
"""Smallest and largest value that is read, in units of the fields; 1e6 is beyond any joint."""


@dataclass(frozen=True, kw_only=True)
class TorqueParameter:
    """One parameter of a joint's drive, by a torque channel."""

    value: float
    """NaN if the recordings leave it open."""
    ci95: tuple[float, float]
    """95 % interval by blocks of the recordings; NaN where they leave it open."""
    reason: str = ""
    """Why it is not identified; empty if it is."""

    @property
    def identified(self) -> bool:
        """True if the recordings identify it."""
        return not self.reason


@dataclass(frozen=True, kw_only=True)
class JointGains:
    """Matched gains of one joint."""

    stiffness: float
    """[N m/rad]"""
    damping: float
    """[N m s/rad]"""
    grid_stiffness: float = NAN
    """The paper's grid optimum [N m/rad]; NaN without a grid."""
    grid_damping: float = NAN
    """The paper's grid optimum [N m s/rad]; NaN without a grid."""
    stiffness_ci95: tuple[float, float] = (NAN, NAN)
    """95 % interval by the repeats alone."""
    damping_ci95: tuple[float, float] = (NAN, NAN)
    stiffness_total95: tuple[float, float] = (NAN, NAN)
    """95 % interval with the change between amplitudes and parts of the log; NaN if not known."""
    damping_total95: tuple[float, float] = (NAN, NAN)
    covariance: tuple[tuple[float, float], tuple[float, float]] = ((NAN, NAN), (NAN, NAN))
    """Of (stiffness, damping), repeats as the unit."""
    band_hz: tuple[float, float] = (NAN, NAN)
    error_db: float = NAN
    """Root mean square of the gain error in the band at the optimum [dB]."""
    naive_error_db: float = NAN
    """The same with the gains of the real drive put into the simulator."""
    coherence_min: float = NAN
    armature: float
    """[kg m^2]"""
    amplitude_spread: float = NAN
    """Largest relative change of stiffness between amplitudes; NaN with one amplitude."""
    frictionloss: float = NAN
    """Dry friction that goes with the gains [N m]; NaN: that of the robot's drive."""
    stribeck: float = 0.0
    """Share of it that motion takes away, at the Stribeck speed of the robot's drive."""
    delay_s: float = 0.0
    """Command delay that goes with the gains [s]."""
    torque: Mapping[str, TorqueParameter] = field(default_factory=dict)
    """The drive by a torque channel (mode drive): names of `match.torque.UNITS`."""
    flags: tuple[str, ...] = ()
    """Warnings, for instance `at the edge of the grid` or `no match`."""
    unchecked: tuple[str, ...] = ()
    """Errors that would leave no trace in the logs, for instance wrongly stated drive gains."""


@dataclass(frozen=True, kw_only=True)
class GroupGains:
    """What training uses for one joint group."""

    stiffness: float
    damping: float
    stiffness_range: float
    """Half-width of the uniform randomization about `stiffness` [N m/rad]."""
    damping_range: float
    """Half-width of the uniform randomization about `damping` [N m s/rad]."""
    frictionloss: float = NAN
    """Mean dry friction that goes with the gains [N m]; NaN: that of the robot's drives."""
    ellipsoid: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 0.0), (0.0, 0.0))
    """Shape matrix E of the joint ellipsoid: {x : (x - c)^T E^-1 (x - c) <= 1} covers the data."""
    ellipsoid_center: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class MatchedGains:
    """Matched gains of a robot, and what they rest on."""

    robot: str
    simulator: SimulatorInfo
    joints: Mapping[str, JointGains]
    groups: Mapping[str, GroupGains]
    logs: Mapping[str, str] = field(default_factory=dict)
    """File name to SHA-256 of every log that went in."""
    virtual: bool = False
    """True if any log came from pronk's virtual robot."""


class _Flow(dict[str, Any]):
    """A mapping written on one line."""


class _Dumper(yaml.SafeDumper):
    """SafeDumper for `_Flow`."""


_Dumper.add_representer(
    _Flow, lambda dumper, data: dumper.represent_mapping("tag:yaml.org,2002:map", data, True)
)


def _rounded(value: Any) -> Any:
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, (tuple, list)):
        return [_rounded(v) for v in value]
    if isinstance(value, Mapping):
        return {name: _line(one) for name, one in value.items()}
    return value


def _omitted(name: str, value: Any) -> bool:
    """True for empty text and tuples, and for optional parameters that are not used."""
    if value in ((), "", {}):
        return True
    if name in ("frictionloss", "stiffness_total95", "damping_total95"):
        return bool(np.isnan(value).any())
    return bool(name in ("delay_s", "stribeck") and value == 0.0)


def _line(data: object) -> _Flow:
    return _Flow({k: _rounded(v) for k, v in vars(data).items() if not _omitted(k, v)})


def save(path: Path, gains: MatchedGains) -> None:
    """Write `gains.yaml`, whole or not at all."""
    body: dict[str, Any] = {
        "schema": SCHEMA,
        "robot": gains.robot,
        "virtual": gains.virtual,
        "simulator": _line(gains.simulator),
        "joints": {name: _line(joint) for name, joint in gains.joints.items()},
        "groups": {name: _line(group) for name, group in gains.groups.items()},
        "logs": dict(gains.logs),
    }
    write_text(path, yaml.dump(body, Dumper=_Dumper, sort_keys=False, width=10_000))


def load(path: Path) -> MatchedGains:
    """Read `gains.yaml`.

    Raises:
        ArtefactError: Missing, not YAML, of another schema, with fields missing or misspelled, or
            with a name or a value that cannot be.
    """
    body = read_yaml(path, missing="`pronk match` writes one")
    if not isinstance(body, dict) or body.get("schema") != SCHEMA:
        got = body.get("schema") if isinstance(body, dict) else type(body).__name__
        raise ArtefactError(f"{path}: schema {got!r}; this pronk reads {SCHEMA!r}.")
    del body["schema"]
    gains = converted(body, MatchedGains, path)
    check_names((gains.robot, *gains.joints, *gains.groups), str(path), ArtefactError)
    for kind, entries in (("joints", gains.joints), ("groups", gains.groups)):
        for name, entry in entries.items():
            for key, (low, high) in _BOUNDS.items():
                value = getattr(entry, key, NAN)
                optional = key == "frictionloss" and np.isnan(value)
                if hasattr(entry, key) and not (optional or low <= value <= high):
                    raise ArtefactError(
                        f"{path}: {key} of {kind}.{name} is {value:g}; expected {low:g} to "
                        f"{high:g}."
                    )
    return gains
