"""What an evaluation found, as data and as JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Self

import numpy as np
import orjson
from numpy.typing import ArrayLike

from pronk.errors import ArtefactError
from pronk.files import write_text

SCHEMA = "pronk/evaluation/1"


@dataclass(frozen=True, kw_only=True)
class Spread:
    """A figure over many robots; unknown values are left out. NaN where there are none."""

    mean: float
    std: float
    """Over the robots, with n - 1; NaN for one."""
    p05: float
    """A twentieth of the robots are below."""
    p95: float
    """A twentieth of the robots are above."""
    n: int
    """Robots that have the figure."""

    @classmethod
    def of(cls, values: ArrayLike) -> Self:
        """Sum up one value a robot."""
        known = np.asarray(values, dtype=float)
        known = known[np.isfinite(known)]
        if not len(known):
            return cls(mean=math.nan, std=math.nan, p05=math.nan, p95=math.nan, n=0)
        low, high = np.percentile(known, [5.0, 95.0])
        return cls(
            mean=float(known.mean()),
            std=float(known.std(ddof=1)) if len(known) > 1 else math.nan,
            p05=float(low),
            p95=float(high),
            n=len(known),
        )


@dataclass(frozen=True, kw_only=True)
class Unasked:
    """Flight phases without a jump input (see `jumps.unasked_height`)."""

    share: float
    """Of the robots, with one or more."""
    highest: float
    """Highest trunk in any of them, over standing height; NaN if there was none [m]."""
    too_high: float
    """Share of the robots with one that is higher than the bar."""


@dataclass(frozen=True, kw_only=True)
class WalkResult:
    """One velocity command; errors as in `evaluation.walk`, one value a robot."""

    name: str
    command: tuple[float, float, float]
    robots: int
    falls: float
    """Share of the robots that fell before the end."""
    non_finite: float
    """Share of the robots whose physics went wrong; they count among the falls."""
    speed_error: Spread
    """[m/s]"""
    yaw_error: Spread
    """[rad/s]"""
    speed_error_averaged: Spread
    """[m/s]"""
    yaw_error_averaged: Spread
    """[rad/s]"""
    velocity: tuple[float, float, float]
    """Mean over robots and time: forward, left [m/s], yaw rate [rad/s]."""
    drift: Spread
    """From the end of settling to the end [m]."""
    unasked: Unasked


@dataclass(frozen=True, kw_only=True)
class JumpResult:
    """One jump command; figures as in `pronk.evaluation.jumps`, one value a robot."""

    name: str
    command: tuple[float, float, float]
    robots: int
    told: int
    """Robots that had not fallen when the jump input came."""
    found: float
    """Share of the robots that jumped."""
    upright: float
    """Share of the robots that jumped and were upright afterwards: the success rate."""
    non_finite: float
    """Share of the robots whose physics went wrong."""
    single: float
    """Share of those told that made exactly one high flight."""
    height: Spread
    apex: Spread
    """Over standing height [m]."""
    distance: Spread
    along: Spread
    vertical: Spread
    horizontal: Spread
    delay: Spread
    duration: Spread
    flights: Spread
    """Flight phases for each jump input, those of the gait among them."""
    long_flights: Spread
    high_flights: Spread
    """What is counted as jumps."""
    unasked: Unasked
    touched: float = math.nan
    """Share of the robots of which anything but a foot touched the ground from the jump input to
    2 s after touchdown, as a trial counts it; NaN in files older than this figure."""
    waited: float = math.nan
    """Longest time from asking for a jump to the jump input [s] (`pronk.policy.stride`); NaN in
    files older than this figure."""


@dataclass(frozen=True, kw_only=True)
class EstimatorResult:
    """The estimator over all walks, stillness included."""

    rmse: tuple[float, float, float]
    """Root mean square error of the velocity by axis, trunk's frame [m/s]."""
    rmse_vector: float
    """Root of the mean squared length of the error [m/s]."""
    contacts_right: float
    """Share of feet and policy steps."""


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """The whole of it, and what it rests on."""

    walks: tuple[WalkResult, ...]
    jumps: tuple[JumpResult, ...]
    estimator: EstimatorResult | None
    """None if the policy's estimate could not be seen, or nobody walked."""
    plan: Mapping[str, Any]
    """Times, counts and the seed: `asdict` of the plan."""
    seconds: float
    """Wall time [s]."""
    about: Mapping[str, Any] = field(default_factory=dict)
    """The policy, gains, randomization, device and versions."""
    before: Mapping[str, float] = field(default_factory=dict)
    """Speed errors of the policy before the jump phases, by walk [m/s]; empty if not compared."""

    def speed_errors(self) -> dict[str, float]:
        """Mean speed error by walk [m/s]."""
        return {walk.name: walk.speed_error.mean for walk in self.walks}


def save(path: Path, evaluation: Evaluation, checks: list[dict[str, Any]]) -> None:
    """Write it as JSON, whole or not at all; NaN becomes null.

    Args:
        path: Where to.
        evaluation: What was found.
        checks: The bars, as `pronk.evaluation.criteria.Check.row` gives them.
    """
    body = {"schema": SCHEMA, "checks": checks, **asdict(evaluation)}
    text = orjson.dumps(body, option=orjson.OPT_INDENT_2 | orjson.OPT_SERIALIZE_NUMPY).decode()
    write_text(path, text + "\n")


def load(path: Path) -> Evaluation:
    """Read what `save` wrote.

    Raises:
        ArtefactError: Missing, damaged or of another schema.
    """
    try:
        body = orjson.loads(path.read_bytes())
    except FileNotFoundError:
        raise ArtefactError(f"{path}: no such file; `pronk evaluate` writes one.") from None
    except (OSError, orjson.JSONDecodeError) as error:
        raise ArtefactError(f"{path}: cannot be read as JSON ({type(error).__name__}).") from error
    schema = body.get("schema") if isinstance(body, dict) else type(body).__name__
    if schema != SCHEMA:
        raise ArtefactError(f"{path}: schema {schema!r}; this pronk reads {SCHEMA!r}.")
    try:
        values = {f.name: body[f.name] for f in fields(Evaluation)}
        estimator = values["estimator"]
        values["walks"] = tuple(_read(WalkResult, walk) for walk in values["walks"])
        values["jumps"] = tuple(_read(JumpResult, jump) for jump in values["jumps"])
        values["estimator"] = None if estimator is None else _read(EstimatorResult, estimator)
        values["before"] = {name: _number(error) for name, error in values["before"].items()}
        return Evaluation(**values)
    except (KeyError, TypeError, AttributeError) as error:
        raise ArtefactError(f"{path}: not a whole evaluation ({error}).") from None


_NESTED: dict[str, type[Any]] = {"Spread": Spread, "Unasked": Unasked}


def _read(kind: type[Any], entry: Mapping[str, Any]) -> Any:
    """A result from its JSON: null is NaN, lists are tuples.

    A figure that older files do not have keeps its default.
    """
    values: dict[str, Any] = {}
    for f in fields(kind):
        if f.name not in entry and f.default is not MISSING:
            continue
        value = entry[f.name]
        if f.type in _NESTED:
            value = _read(_NESTED[str(f.type)], value)
        elif isinstance(value, list):
            value = tuple(_number(v) for v in value)
        else:
            value = _number(value)
        values[f.name] = value
    return kind(**values)


def _number(value: Any) -> Any:
    return math.nan if value is None else value
