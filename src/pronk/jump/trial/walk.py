"""Walks of the virtual robot: one velocity for a long time, many times, measured (paper R4).

With v the trunk's horizontal velocity and w its yaw rate, both in the trunk's frame, c and r the
commanded ones, and means over the samples from `SETTLE_S` after the command to its end (or to the
fall). A velocity averaged over the last half second is without what a stride does. The path of the
cost of transport is that of the averaged velocity, so that swaying counts for nothing; energy that
comes back into the battery is taken off.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pronk.arrays import Array
from pronk.jump.trial.jumps import (
    GRAVITY,
    JumpRules,
    fallen_at,
    figure,
    figures_of,
    sample_at,
    uncommanded_height,
)
from pronk.jump.trial.protocol import Case, named
from pronk.jump.trial.results import TrialResults, study_kind
from pronk.jump.trial.trial import TrialPlan, TrialSetup, run_trial
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
"""The paper's walks (R4), turning at the ends of the trained range (C3), and standing."""
ROBOT_WALKS: Mapping[str, tuple[Case, ...]] = {
    "go2": named("forward 2", "back 2", "side +0.8", "side -0.8", "turn +2", "turn -2", "stand"),
}
"""Walks of robots with other ranges."""


@dataclass(frozen=True, kw_only=True)
class WalkFigures:
    """One walk."""

    fell: bool
    """The robot fell before the command ended."""
    non_foot_contact: bool
    """Something but a foot touched the ground meanwhile."""

    lasted: float = figure("s", "time from the command to the fall, or to its end")
    speed_error: float = figure("m/s", "mean |v - c|")
    speed_error_averaged: float = figure("m/s", "mean |mean of v over the last 0.5 s - c|")
    yaw_error: float = figure("rad/s", "mean |w - r|")
    yaw_error_averaged: float = figure("rad/s", "mean |mean of w over the last 0.5 s - r|")
    forward: float = figure("m/s", "mean of v forward")
    left: float = figure("m/s", "mean of v to the left")
    yaw_rate: float = figure("rad/s", "mean of w")
    roll_rate_rms: float = figure("rad/s", "root mean square of the roll rate")
    pitch_rate_rms: float = figure("rad/s", "root mean square of the pitch rate")
    power: float = figure("W", "mean electrical power, what comes back taken off")
    cost_of_transport: float = figure(
        "1", "electrical energy / (m g path); no value where no speed is commanded"
    )
    uncommanded: float = figure(
        "m", "highest trunk over ground in a flight phase; no value without one"
    )

    @property
    def standing(self) -> bool:
        """Whether there was a walk to measure, which is always so."""
        return True

    @property
    def found(self) -> bool:
        """Whether there was a walk to measure, which is always so."""
        return True

    @property
    def success(self) -> bool:
        """Whether the robot did not fall."""
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
    """Return the figures of one walk.

    Args:
        capture: The recorded motion.
        script: The command of the walk.
        robot: The robot, for its mass.
        began: When the policy took over, on the capture's clock [s].
        rules: Times and heights by which a flight counts; those of the robot if None.
        settle_s: Time to reach the velocity, left out of the figures [s].
    """
    dt = capture.dt
    count = len(capture.time)
    down = fallen_at(capture)
    start = min(sample_at(capture, began + script.start), count)
    end = min(sample_at(capture, began + script.stop), count)
    first = start + round(settle_s / dt)
    stop = min(down, end)
    fell = down < end
    non_foot_contact = bool(capture.other_contact[start:stop].any())
    lasted = max(0, stop - start) * dt
    uncommanded = uncommanded_height(capture, None, rules or JumpRules.of(robot))
    if first >= stop:
        return WalkFigures(
            fell=fell, non_foot_contact=non_foot_contact, lasted=lasted, uncommanded=uncommanded
        )
    # Forward and left velocity and yaw rate, in the trunk's frame.
    turns = Rotation.from_quat(capture.orientation[:stop], scalar_first=True)
    motion = turns.apply(capture.velocity[:stop], inverse=True)
    motion[:, 2] = capture.angular_velocity[:stop, 2]
    averaged = _moving_average(motion, round(AVERAGE_S / dt))[first:]
    motion = motion[first:]
    error = motion - np.asarray(script.command)
    averaged_error = averaged - np.asarray(script.command)
    forward, sideways, yaw_rate = motion.mean(axis=0).tolist()
    rates = capture.angular_velocity[first:stop, :2]
    roll_rate_rms, pitch_rate_rms = np.sqrt(np.mean(rates**2, axis=0)).tolist()
    power = float(capture.electrical_power[first:stop].mean())
    path = float(np.hypot(averaged[:, 0], averaged[:, 1]).sum() * dt)
    cost_of_transport = math.nan
    if path > NO_PATH and any(script.command[:2]):
        weight = legged(robot.source).total_mass * GRAVITY
        cost_of_transport = power * (stop - first) * dt / (weight * path)
    return WalkFigures(
        fell=fell,
        non_foot_contact=non_foot_contact,
        lasted=lasted,
        speed_error=float(np.hypot(error[:, 0], error[:, 1]).mean()),
        speed_error_averaged=float(np.hypot(averaged_error[:, 0], averaged_error[:, 1]).mean()),
        yaw_error=float(np.abs(error[:, 2]).mean()),
        yaw_error_averaged=float(np.abs(averaged_error[:, 2]).mean()),
        forward=forward,
        left=sideways,
        yaw_rate=yaw_rate,
        roll_rate_rms=roll_rate_rms,
        pitch_rate_rms=pitch_rate_rms,
        power=power,
        cost_of_transport=cost_of_transport,
        uncommanded=uncommanded,
    )


def _moving_average(values: Array, window: int) -> Array:
    """Return means over the last `window` samples, fewer at the beginning. (T, n)."""
    total = np.cumsum(values, axis=0)
    total[window:] -= total[:-window].copy()
    counts = np.minimum(np.arange(1, len(values) + 1), window)
    averaged: Array = total / counts[:, None]
    return averaged


WALK = study_kind("walk", WalkFigures, measure_walk, jump=False)


def walk_script(command: Velocity, *, seconds: float = WALK_S) -> Script:
    """Return a script that stands for a moment, then has the velocity; no jump, no stop."""
    return Script(command=command, run_s=seconds, jump_s=0.0, keep_s=0.0, stop_s=0.0)


def add_walks(
    policies: Sequence[Path],
    setup: TrialSetup,
    *,
    cases: tuple[Case, ...] | None = None,
    runs: int = 20,
    seconds: float = WALK_S,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> TrialResults:
    """Let policies walk on the virtual robot and write `walk.csv` and `walk.json`.

    Args:
        policies: Files of the policies.
        setup: What the walks are on.
        cases: Velocities; None for those of the robot.
        runs: Number of walks with each velocity.
        seconds: Length of each walk [s].
        seed: Seed of all draws.
        progress: Called with the share of the walks that are done, 0 to 1.

    Raises:
        PronkError: A policy or parameter is impossible; nothing was run then.
    """
    if cases is None:
        cases = ROBOT_WALKS.get(setup.robot.name, WALKS)
    script = walk_script(STILL, seconds=seconds)
    plan = TrialPlan(cases=cases, jumps=runs, seed=seed, script=script, spread_s=0.0)
    return run_trial(policies, plan, setup, run_kind=WALK, progress=progress)
