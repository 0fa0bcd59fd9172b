"""Walks of the virtual robot: one velocity for a long time (paper R4), many times, measured.

With v the trunk's horizontal velocity and w its yaw rate, both in the trunk's frame, c and r the
commanded ones, and means over the samples from `SETTLE_S` after the command to its end (or to the
fall). A velocity averaged over the last half second is without what a stride does. The path of the
cost of transport is that of the averaged velocity, so that swaying counts for nothing; energy that
comes back into the battery is taken off.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pronk.jump.trial.jumps import (
    GRAVITY,
    JumpRules,
    fallen_at,
    figures_of,
    number,
    sample_at,
    uncommanded_height,
)
from pronk.jump.trial.protocol import Case, named
from pronk.jump.trial.results import Results, extra_kind
from pronk.jump.trial.trial import Plan, Setup, run_trial
from pronk.jump.virtual.capture import Capture
from pronk.policy.script import STILL, Script, Velocity
from pronk.robots.legged import legged
from pronk.robots.robot import RobotSpec

SETTLE_S = 2.0
"""Time to reach the velocity, left out of the figures [s]."""
AVERAGE_S = 0.5
"""Window of the moving average [s]."""
NO_PATH = 0.5
"""Shortest path that has a cost of transport [m]."""
WALK_S = 20.0
"""Length of a walk [s]."""
WALKS = named("forward 2", "back 2", "side +1", "side -1", "turn +2", "turn -2", "stand")
"""The paper's R4, turning at the ends of the trained range (C3), and standing."""


@dataclass(frozen=True, kw_only=True)
class WalkFigures:
    """One walk."""

    fell: bool
    """The robot fell before the command ended."""
    non_foot_contact: bool
    """Something but a foot touched the ground meanwhile."""

    lasted: float = number("s", "time from the command to the fall, or to its end")
    speed_error: float = number("m/s", "mean |v - c|")
    speed_error_averaged: float = number("m/s", "mean |mean of v over the last 0.5 s - c|")
    yaw_error: float = number("rad/s", "mean |w - r|")
    yaw_error_averaged: float = number("rad/s", "mean |mean of w over the last 0.5 s - r|")
    forward: float = number("m/s", "mean of v forward")
    left: float = number("m/s", "mean of v to the left")
    yaw_rate: float = number("rad/s", "mean of w")
    roll_rate_rms: float = number("rad/s", "root mean square of the roll rate")
    pitch_rate_rms: float = number("rad/s", "root mean square of the pitch rate")
    power: float = number("W", "mean electrical power, what comes back taken off")
    cost_of_transport: float = number(
        "1", "electrical energy / (m g path); no value where no speed is commanded"
    )
    uncommanded: float = number(
        "m", "highest trunk over ground in a flight phase; no value without one"
    )

    @property
    def success(self) -> bool:
        """The robot did not fall."""
        return not self.fell


WALK_FIGURES = figures_of(WalkFigures)


def measure_walk(
    capture: Capture,
    script: Script,
    robot: RobotSpec,
    *,
    began: float,
    rules: JumpRules | None = None,
    settle_s: float = SETTLE_S,
) -> WalkFigures:
    """Return the figures of one walk; arguments as of `pronk.jump.trial.jumps.measure`."""
    dt, down = capture.dt, fallen_at(capture)
    start, end = (
        min(sample_at(capture, began + t), len(capture.time)) for t in (script.start, script.stop)
    )
    first, last = start + round(settle_s / dt), min(down, end)
    figures: dict[str, Any] = {
        "fell": down < end,
        "non_foot_contact": bool(capture.other_contact[start:last].any()),
        "lasted": max(0, last - start) * dt,
        "uncommanded": uncommanded_height(capture, None, rules or JumpRules.of(robot)),
    }
    if first >= last:
        return WalkFigures(**figures)
    turns = Rotation.from_quat(capture.orientation[:last], scalar_first=True)
    own = turns.apply(capture.velocity[:last], inverse=True)
    own[:, 2] = capture.angular_velocity[:last, 2]
    total, window = np.cumsum(own, axis=0), round(AVERAGE_S / dt)
    total[window:] -= total[:-window].copy()
    counts = np.minimum(np.arange(1, last + 1), window)
    averaged = (total / counts[:, None])[first:]
    for name, values in (("", own[first:]), ("_averaged", averaged)):
        error = values - np.asarray(script.command)
        figures[f"speed_error{name}"] = float(np.hypot(error[:, 0], error[:, 1]).mean())
        figures[f"yaw_error{name}"] = float(np.abs(error[:, 2]).mean())
    means = own[first:].mean(axis=0).tolist()
    figures |= dict(zip(("forward", "left", "yaw_rate"), means, strict=True))
    rates = np.sqrt(np.mean(capture.angular_velocity[first:last, :2] ** 2, axis=0)).tolist()
    power = float(capture.electrical_power[first:last].mean())
    figures |= {"roll_rate_rms": rates[0], "pitch_rate_rms": rates[1], "power": power}
    path = float(np.hypot(averaged[:, 0], averaged[:, 1]).sum() * dt)
    if path > NO_PATH and any(script.command[:2]):
        weight = legged(robot.source).total_mass * GRAVITY
        figures["cost_of_transport"] = power * (last - first) * dt / (weight * path)
    return WalkFigures(**figures)


WALK = extra_kind("walk", figures=WalkFigures, measure=measure_walk, jump=False)


def walk_script(command: Velocity, *, seconds: float = WALK_S) -> Script:
    """Stand for a moment, then the velocity for `seconds`; no jump, no stop."""
    return Script(command=command, run_s=seconds, jump_s=0.0, keep_s=0.0, stop_s=0.0)


def add_walks(
    policies: Sequence[Path],
    setup: Setup,
    *,
    cases: tuple[Case, ...] = WALKS,
    runs: int = 20,
    seconds: float = WALK_S,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> Results:
    """Let policies walk on the virtual robot and write `walk.csv` and `walk.json`.

    Arguments and errors as of `run_trial`; `runs` walks of `seconds` with each of `cases`.
    """
    script = walk_script(STILL, seconds=seconds)
    plan = Plan(cases=cases, jumps=runs, seed=seed, script=script, spread_s=0.0)
    return run_trial(policies, plan, setup, kind=WALK, progress=progress)
