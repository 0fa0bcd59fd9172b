"""The bars that a policy must clear, and whether it does.

Means are over robots; a figure that could not be measured does not pass.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping

from pronk.evaluation.criteria import Check
from pronk.evaluation.jumps import RISE
from pronk.evaluation.training_sim.result import Evaluation, JumpResult, WalkResult

SPEED_ERROR = 0.15
"""[m/s]"""
YAW_ERROR = 0.2
"""[rad/s]"""
FALLS = 0.005
STANDING_SPEED = 0.05
"""Of a robot that is told to stand, moving average [m/s]."""
WALKS = ("forward 2", "back 2", "left 1", "right 1")
"""Held to `SPEED_ERROR` and `FALLS`; those at 3 m/s are only reported."""
TURNS = ("yaw 2", "yaw -2")
STAND = "stand"

HEIGHT = 0.45
"""[m] The figure that the paper calls the physical limit."""
HEIGHT_STD = 0.03
"""[m]"""
DISTANCE = {
    "forward 1": 0.70,
    "forward 2": 1.10,
    "side -1": 0.65,
    "side +1": 0.65,
    "back 2": 1.10,
}
"""[m]"""
UPRIGHT = 0.99
SINGLE = 0.95
"""Share of the jump inputs that one high flight answers (see `pronk.evaluation.jumps`); the
flights of the
gait before and after do not count."""
LIFTOFF_VELOCITY = 2.5
"""Desired [m/s]."""
LIFTOFF_ERROR = 0.3
"""Of the mean lift-off velocity [m/s]."""
LIFTOFF_DELAY = 0.3
"""That 95 % of the jumps keep [s]."""
UNASKED_HEIGHT = RISE
"""Over standing height [m]."""

RMSE = 0.15
"""Of the estimated velocity, as a vector [m/s]."""
CONTACTS = 0.95
COST = 1.10
"""Growth of the speed error by the jump phases."""


def checks(evaluation: Evaluation) -> list[Check]:
    """Every bar that belongs to what was measured."""
    found = [check for walk in evaluation.walks for check in _walk(walk)]
    found += [check for jump in evaluation.jumps for check in _jump(jump)]
    found += _obedience(evaluation)
    estimator = evaluation.estimator
    if estimator is not None:
        rmse, right = estimator.rmse_vector, estimator.contacts_right
        found.append(Check(what="velocity RMSE", value=rmse, sense="<=", bar=RMSE, unit="m/s"))
        found.append(Check(what="contacts right", value=right, sense=">=", bar=CONTACTS))
    if evaluation.before:
        cost = cost_of_jumping(evaluation.before, evaluation.speed_errors())
        found.append(
            Check(what="speed error over that before jumping", value=cost, sense="<=", bar=COST)
        )
    return found


def cost_of_jumping(before: Mapping[str, float], after: Mapping[str, float]) -> float:
    """Mean speed error of `WALKS` after the jump phases over that before.

    Args:
        before: Mean speed error by walk, of the policy that only walks [m/s].
        after: The same of the policy that jumps.

    Returns:
        The ratio; NaN where one of them was not evaluated on a walk of `WALKS`.
    """
    sums = [math.fsum(errors.get(name, math.nan) for name in WALKS) for errors in (before, after)]
    return sums[1] / sums[0] if sums[0] else math.nan


def _walk(walk: WalkResult) -> Iterator[Check]:
    name = walk.name
    if name in WALKS:
        error = walk.speed_error.mean
        yield Check(
            what=f"{name}: speed error", value=error, sense="<=", bar=SPEED_ERROR, unit="m/s"
        )
        yield Check(what=f"{name}: falls", value=walk.falls, sense="<=", bar=FALLS)
    if name in TURNS:
        error = walk.yaw_error.mean
        yield Check(
            what=f"{name}: yaw rate error", value=error, sense="<=", bar=YAW_ERROR, unit="rad/s"
        )
    if name == STAND:
        speed = walk.speed_error_averaged.mean
        yield Check(what=f"{name}: speed", value=speed, sense="<=", bar=STANDING_SPEED, unit="m/s")


def _jump(jump: JumpResult) -> Iterator[Check]:
    name = f"jump {jump.name}"
    height, distance = jump.height, jump.distance.mean
    off = abs(jump.vertical.mean - LIFTOFF_VELOCITY)
    yield Check(what=f"{name}: height", value=height.mean, sense=">=", bar=HEIGHT, unit="m")
    yield Check(
        what=f"{name}: std of height", value=height.std, sense="<=", bar=HEIGHT_STD, unit="m"
    )
    if jump.name in DISTANCE:
        bar = DISTANCE[jump.name]
        yield Check(what=f"{name}: distance", value=distance, sense=">=", bar=bar, unit="m")
    yield Check(what=f"{name}: upright", value=jump.upright, sense=">=", bar=UPRIGHT)
    yield Check(what=f"{name}: one high flight", value=jump.single, sense=">=", bar=SINGLE)
    yield Check(
        what=f"{name}: lift-off velocity off {LIFTOFF_VELOCITY:g}",
        value=off,
        sense="<=",
        bar=LIFTOFF_ERROR,
        unit="m/s",
    )
    yield Check(
        what=f"{name}: lift-off after, 95th percentile",
        value=jump.delay.p95,
        sense="<=",
        bar=LIFTOFF_DELAY,
        unit="s",
    )


def _obedience(evaluation: Evaluation) -> Iterator[Check]:
    """Highest flight without a jump input, of any robot; none at all is height 0."""
    for what, results in (("walking", evaluation.walks), ("around jumps", evaluation.jumps)):
        if results:
            yield Check(
                what=f"flight without a jump input, {what}",
                value=max(_heights(results), default=0.0),
                sense="<=",
                bar=UNASKED_HEIGHT,
                unit="m",
            )


def _heights(results: Iterable[WalkResult | JumpResult]) -> Iterator[float]:
    return (r.unasked.highest for r in results if not math.isnan(r.unasked.highest))
