"""The figures of one walk, from what was seen of it.

With v the trunk's horizontal velocity and w its yaw rate, both in the trunk's frame, c and r what
the robot is told, and means over the samples from `SETTLE_S` after the command to its end (or to
the fall); `WALK_FIGURES` has every figure with its equation. A velocity averaged over the last half
second is without what a stride does, as in training's evaluation. The path of the cost of transport
is that of the averaged velocity, so that swaying counts for nothing; energy that comes back into
the battery is taken off.

A fall is that of `pronk.evaluation.metrics`: a trunk that leans by 70 degrees or lies on the
ground.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pronk.evaluation.jumps import JumpRules, unasked_height
from pronk.evaluation.metrics import GRAVITY, Figure, fallen_at, series_of
from pronk.runtime.script import Script
from pronk.virtual.capture import Capture

Array = NDArray[np.float64]

SETTLE_S = 2.0
"""Time to reach it, left out of the figures [s]."""
AVERAGE_S = 0.5
"""Window of the moving average [s]."""
NO_PATH = 0.5
"""A robot that came no further went nowhere: no cost of transport [m]."""


def _number(unit: str, says: str) -> Any:
    return field(default=math.nan, metadata={"unit": unit, "says": says})


@dataclass(frozen=True, kw_only=True)
class WalkFigures:
    """One walk. Every number's unit and equation is in `WALK_FIGURES`."""

    fell: bool
    """The robot fell before the command ended."""
    touched: bool
    """Something else than a foot touched the ground meanwhile."""

    lasted: float = _number("s", "time from the command to the fall, or to its end")
    speed_error: float = _number("m/s", "mean |v - c|")
    speed_error_averaged: float = _number("m/s", "mean |mean of v over the last 0.5 s - c|")
    yaw_error: float = _number("rad/s", "mean |w - r|")
    yaw_error_averaged: float = _number("rad/s", "mean |mean of w over the last 0.5 s - r|")
    forward: float = _number("m/s", "mean of v forward")
    left: float = _number("m/s", "mean of v to the left")
    yaw_rate: float = _number("rad/s", "mean of w")
    roll_rate_rms: float = _number("rad/s", "root mean square of the roll rate")
    pitch_rate_rms: float = _number("rad/s", "root mean square of the pitch rate")
    power: float = _number("W", "mean electrical power, what comes back taken off")
    cost_of_transport: float = _number(
        "1", "electrical energy / (m g path); no value where no speed is told"
    )
    unasked: float = _number(
        "m", "highest trunk over ground in a flight phase; no value without one"
    )


WALK_FIGURES: Mapping[str, Figure] = {
    entry.name: Figure(name=entry.name, **entry.metadata)
    for entry in fields(WalkFigures)
    if entry.metadata
}
"""Every figure that is a number, by name."""


def measure_walk(
    capture: Capture,
    script: Script,
    *,
    began: float,
    mass: float,
    rules: JumpRules | None = None,
) -> WalkFigures:
    """The figures of one walk.

    Args:
        capture: What was seen.
        script: What was asked, as `walk_script` gives it.
        began: When the policy took over, on the capture's clock [s].
        mass: Of the robot [kg].
        rules: What a flight phase is.
    """
    rules = rules or JumpRules()
    dt = capture.dt
    told, end = (
        min(int(np.searchsorted(capture.time, began + t - 1e-3 * dt)), len(capture.time))
        for t in (script.start, script.stop)
    )
    down = fallen_at(capture)
    fell, last = down < end, min(down, end)
    figures: dict[str, Any] = {
        "fell": fell,
        "touched": bool(capture.other_contact[told:last].any()),
        "lasted": max(0, last - told) * dt,
        "unasked": unasked_height(series_of(capture), None, rules),
    }
    first = told + round(SETTLE_S / dt)
    if first >= last:
        return WalkFigures(**figures)
    velocity = _velocity(capture)
    averaged = _averaged(velocity, round(AVERAGE_S / dt))[first:last]
    velocity = velocity[first:last]
    command = np.asarray(script.command)
    for name, values in (("", velocity), ("_averaged", averaged)):
        error = values - command
        figures[f"speed_error{name}"] = float(np.hypot(error[:, 0], error[:, 1]).mean())
        figures[f"yaw_error{name}"] = float(np.abs(error[:, 2]).mean())
    means = velocity.mean(axis=0).tolist()
    figures |= dict(zip(("forward", "left", "yaw_rate"), means, strict=True))
    rates = np.sqrt(np.mean(capture.angular_velocity[first:last, :2] ** 2, axis=0)).tolist()
    figures |= dict(zip(("roll_rate_rms", "pitch_rate_rms"), rates, strict=True))
    figures["power"] = float(capture.electrical_power[first:last].mean())
    path = float(np.hypot(averaged[:, 0], averaged[:, 1]).sum() * dt)
    if path > NO_PATH and any(script.command[:2]):
        work = figures["power"] * (last - first) * dt
        figures["cost_of_transport"] = work / (mass * GRAVITY * path)
    return WalkFigures(**figures)


def _velocity(capture: Capture) -> Array:
    """Forward, left and yaw rate in the trunk's frame [m/s, m/s, rad/s]. (T, 3)."""
    w, x, y, z = capture.orientation.T
    # The first two columns of the rotation of the trunk to the world: its x and its y axis.
    forward = np.stack(
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)], axis=1
    )
    left = np.stack(
        [2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)], axis=1
    )
    v = capture.velocity
    return np.stack(
        [(forward * v).sum(axis=1), (left * v).sum(axis=1), capture.angular_velocity[:, 2]], axis=1
    )


def _averaged(values: Array, count: int) -> Array:
    """Mean over the last `count` samples, of fewer at the beginning. (T, n)."""
    total = np.cumsum(values, axis=0)
    total[count:] -= total[:-count].copy()
    samples = np.minimum(np.arange(1, len(values) + 1), count)
    mean: Array = total / samples[:, None]
    return mean
