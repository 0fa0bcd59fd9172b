"""What a deployment's log says, as numbers: modes, delays, what the filter did, how joints kept up.

Everything is computed from the log's ticks and steps, exactly; the figures at its end, which a cut
log lacks, are not needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import orjson
from numpy.typing import NDArray

from pronk.logs.mcap_stream import DamagedError, records
from pronk.runtime.ipc import Mode
from pronk.runtime.log import DeployLog
from pronk.runtime.safety import FilterAction, Reason

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FLYING = (Mode.POLICY, Mode.HALT)
"""Modes in which the policy decides."""
_STATES = "/deploy/state"
_MOVED = 1e-9
"""Smaller changes of a target are rounding [rad]."""


@dataclass(frozen=True, kw_only=True)
class Stretch:
    """A time in one mode."""

    mode: Mode
    begin: float
    """Since the first tick [s]."""
    seconds: float


@dataclass(frozen=True, kw_only=True)
class Spread:
    """How long something took [s]; NaN where there are too few for a quantile."""

    n: int
    p50: float
    p95: float
    p99: float
    p99_9: float
    largest: float


@dataclass(frozen=True, kw_only=True)
class Intervention:
    """What the filter did for one reason."""

    reason: Reason
    level: FilterAction
    ticks: int
    largest: float
    """Farthest that it moved a target [rad]; NaN while damped."""
    joint: str
    """Whose target it moved most often; empty while damped."""


@dataclass(frozen=True, kw_only=True)
class Tracking:
    """One joint while the policy decided; NaN where there was no such time."""

    joint: str
    error: float
    """RMS of target less position [rad]; the target that was in force."""
    largest: float
    """Largest of it [rad]."""
    standing: float
    """RMS on the way up and standing [rad]."""
    torque: float
    """RMS as the robot tells it [N m]; NaN where it tells none."""
    torque_largest: float
    """[N m]"""
    speed_largest: float
    """[rad/s]"""


def seconds(log: DeployLog, time: Array | float) -> Array:
    """Times on the log's clock as times since its first tick [s]."""
    return np.asarray(np.asarray(time, dtype=float) - log.time[0])


def period(log: DeployLog) -> float:
    """Between two ticks [s]."""
    steps = np.diff(log.time)
    return float(np.median(steps)) if len(steps) else 0.0


def flying(log: DeployLog) -> Mask:
    """Ticks in which the policy decided. (T,)."""
    return np.asarray(np.isin(log.mode, FLYING))


def until_fault(log: DeployLog) -> int:
    """Number of ticks up to the first that damped for a fault, that one included."""
    bad = log.level >= FilterAction.DAMP
    return int(bad.argmax()) + 1 if bad.any() else len(bad)


def stretches(log: DeployLog) -> tuple[Stretch, ...]:
    """The modes one after the other."""
    edges = [0, *(np.flatnonzero(np.diff(log.mode)) + 1)]
    t = np.append(seconds(log, log.time), seconds(log, log.time[-1]) + period(log))
    return tuple(
        Stretch(mode=Mode(int(log.mode[a])), begin=float(t[a]), seconds=float(t[b] - t[a]))
        for a, b in zip(edges, [*edges[1:], len(log.time)], strict=True)
    )


def spread(values: Array) -> Spread:
    """Quantiles of times: the value that the given share does not exceed.

    A quantile is given where at least one value lies beyond it: the 99.9 % of fewer than a thousand
    are NaN.

    Args:
        values: [s]; those that are not finite do not count.
    """
    found = np.sort(values[np.isfinite(values)])
    n = len(found)

    def quantile(share: float) -> float:
        if n * (1.0 - share) < 1.0 - 1e-9:
            return float("nan")
        return float(found[int(np.ceil(share * n - 1e-9)) - 1])

    return Spread(
        n=n,
        p50=quantile(0.5),
        p95=quantile(0.95),
        p99=quantile(0.99),
        p99_9=quantile(0.999),
        largest=float(found[-1]) if n else float("nan"),
    )


def missed(log: DeployLog) -> int:
    """Ticks that were left out because their time had passed."""
    return int((np.diff(log.tick) - 1).sum())


def tilt(log: DeployLog) -> Array:
    """Angle of the trunk's z axis from the vertical [rad]; NaN without an attitude. (T,)."""
    size = np.linalg.norm(log.orientation, axis=1)
    x, y = log.orientation[:, 1], log.orientation[:, 2]
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.arccos(np.clip(1.0 - 2.0 * (x * x + y * y) / size**2, -1.0, 1.0)))


def interventions(log: DeployLog) -> tuple[Intervention, ...]:
    """What the filter did, by level and reason; the mildest first."""
    found = []
    with np.errstate(invalid="ignore"):
        moved = np.abs(log.sent - log.desired)
    for level in list(FilterAction)[1:]:
        for reason in Reason:
            there = (log.level == level) & (log.reason == reason)
            if not there.any():
                continue
            of = moved[there]
            known = bool(np.isfinite(of).any()) and level < FilterAction.DAMP
            often = (of > _MOVED).sum(axis=0)
            found.append(
                Intervention(
                    reason=reason,
                    level=level,
                    ticks=int(there.sum()),
                    largest=float(np.nanmax(of)) if known else float("nan"),
                    joint=log.joints[int(often.argmax())] if known and often.any() else "",
                )
            )
    return tuple(found)


def in_force(log: DeployLog) -> Array:
    """The target that the drives had when each tick's state was measured [rad]. (T, joints).

    The one of the tick before; NaN for the first tick and after a damped one.
    """
    return np.vstack([np.full((1, log.sent.shape[1]), np.nan), log.sent[:-1]])


def tracking(log: DeployLog) -> tuple[Tracking, ...]:
    """How each joint followed its targets."""
    error = in_force(log) - log.position
    up, live = log.mode == Mode.STAND, flying(log)
    torque = log.torque if log.torque.any() else np.full_like(log.torque, np.nan)
    return tuple(
        Tracking(
            joint=joint,
            error=_rms(error[live, i]),
            largest=_largest(error[live, i]),
            standing=_rms(error[up, i]),
            torque=_rms(torque[live, i]),
            torque_largest=_largest(torque[live, i]),
            speed_largest=_largest(log.velocity[live, i]),
        )
        for i, joint in enumerate(log.joints)
    )


def temperatures(path: Path) -> tuple[Array, Array] | None:
    """When [s, the log's clock], and of the motors [deg C], (N,) and (N, joints); None without.

    Read from the file itself; only its first state is looked at where none is measured.
    """
    time: list[float] = []
    values: list[list[float | None]] = []
    try:
        with path.open("rb") as file:
            for batch in records(file, path.stat().st_size):
                for record in batch:
                    if record.topic != _STATES:
                        continue
                    row = orjson.loads(record.data)
                    if not time and all(value is None for value in row["temperature"]):
                        return None
                    time.append(row["t"])
                    values.append(row["temperature"])
    except DamagedError:
        pass  # what came before counts, as it does for the rest of the page
    return (np.array(time), np.array(values, dtype=float)) if time else None


def _rms(values: Array) -> float:
    found = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(found**2))) if len(found) else float("nan")


def _largest(values: Array) -> float:
    found = np.abs(values[np.isfinite(values)])
    return float(found.max()) if len(found) else float("nan")
