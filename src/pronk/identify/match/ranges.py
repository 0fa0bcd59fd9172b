"""Training gains and ranges of a joint group, from the matched gains of its joints.

The paper trains with one pair of gains per joint group and a uniform range about it (Table I, D3,
D4) and does not state how it rounded from the matched joints to the group. pronk's rule:

1. Damping is the middle of the joints' intervals, rounded to 0.05 N m s/rad.
2. Stiffness keeps the joint's impedance. Rounding the damping changes |stiffness + j omega
   damping|; the stiffness is the value on the 0.5 N m/rad lattice that puts the mean square of
   it back at the joint's characteristic frequency omega = damping / (2 inertia), the half-width
   of its resonance (zeta omega_n), with the inertia of the bench model, armature included.
3. The range is the smallest multiple of the lattice that covers every joint's 95 % interval.

From the paper's own matched gains this gives its training gains in all three groups. The
undamped, damped and resonance frequencies and those of -3 dB, -45 and -90 degrees in step 2 do
not, and neither do mean, median or mid-range of the stiffness: the rule was chosen because it
does.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy import stats

from pronk.arrays import Array
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match.gains import FittedValue, GroupGains, JointGains, MatchedGains
from pronk.identify.simulators.info import SimulatorInfo
from pronk.robots.model import bench_inertia
from pronk.robots.robot import RobotSpec

STIFFNESS_STEP = 0.5
"""Lattice of the paper's training stiffnesses: 20, 17.5, 21.5 N m/rad (Table I)."""
DAMPING_STEP = 0.05
"""Lattice of the paper's training dampings: 0.45, 0.4, 0.55 N m s/rad (Table I)."""
DIRECTIONS = 24
"""Points on the ellipse of each joint; the ellipse that encloses them misses less than 1 % of the
area between them."""
SMALLEST_DEVIATION = 1e-3
"""Smallest relative standard deviation of a gain, so that a single exact joint has an ellipse."""
ROUNDING_SLACK = 1e-6
"""Share of a step by which a range may be too small: rounding of the last binary digit."""


def group_gains(robot: RobotSpec, joints: Mapping[str, JointGains]) -> dict[str, GroupGains]:
    """Compute training gains, ranges and ellipsoids of every group with a matched joint.

    Args:
        robot: The robot.
        joints: Matched gains by joint.

    Returns:
        Training gains by group, in the robot's order.

    Raises:
        RobotError: A joint is none of the robot's.
    """
    for name in joints:
        robot.joint(name)  # raises RobotError for an unknown joint
    groups = {}
    for group in robot.groups:
        members = [joint.name for joint in robot.group(group) if joint.name in joints]
        if members:
            matched = [joints[name] for name in members]
            groups[group] = _training_gains(robot, members[0], matched)
    return groups


def matched_gains(
    robot: RobotSpec,
    joints: Mapping[str, JointGains],
    logs: Sequence[JointLog],
    simulator: SimulatorInfo,
) -> MatchedGains:
    """Put matched joints, their groups, the logs and the simulator together.

    Args:
        robot: The robot.
        joints: Matched gains by joint.
        logs: Logs that the joints were matched with.
        simulator: Simulator that the gains hold for.

    Returns:
        What `save_gains` writes.
    """
    hashes = {}
    for log in logs:
        hashes[Path(log.source or "log").name] = log.origin.sha256
    return MatchedGains(
        robot=robot.name,
        simulator=simulator,
        joints=joints,
        groups=group_gains(robot, joints),
        logs=hashes,
        virtual=any(log.virtual for log in logs),
    )


def _training_gains(robot: RobotSpec, joint: str, matched: Sequence[JointGains]) -> GroupGains:
    """Return the training gains of a group whose first matched joint is `joint`."""
    stiffnesses = []
    dampings = []
    frictions = []
    point_sets = []
    for gains in matched:
        stiffnesses.append(gains.stiffness)
        dampings.append(gains.damping)
        frictions.append(gains.frictionloss.value)
        point_sets.append(interval_points(gains))
    stiffness_low, stiffness_high = _covering_interval(stiffnesses)
    damping_low, damping_high = _covering_interval(dampings)
    damping = _nearest_multiple(0.5 * (damping_low + damping_high), DAMPING_STEP)
    stiffness = _training_stiffness(robot, joint, matched, damping)
    stiffness_reach = max(stiffness_high - stiffness, stiffness - stiffness_low)
    damping_reach = max(damping_high - damping, damping - damping_low)

    center, shape = enclosing_ellipsoid(np.concatenate(point_sets))
    stiffness_row, damping_row = shape.tolist()
    return GroupGains(
        stiffness=stiffness,
        damping=damping,
        stiffness_range=_next_multiple(stiffness_reach, STIFFNESS_STEP),
        damping_range=_next_multiple(damping_reach, DAMPING_STEP),
        frictionloss=float(np.mean(frictions)),
        ellipsoid=(tuple(stiffness_row), tuple(damping_row)),
        ellipsoid_center=(float(center[0]), float(center[1])),
    )


def _covering_interval(fitted: Sequence[FittedValue]) -> tuple[float, float]:
    """Return the smallest interval with all values and all of their known intervals."""
    ends = []
    for parameter in fitted:
        ends.append(parameter.value)
        for low, high in (parameter.repeat95, parameter.total95):
            if math.isfinite(low) and math.isfinite(high):
                ends.append(low)
                ends.append(high)
    return min(ends), max(ends)


def _training_stiffness(
    robot: RobotSpec, joint: str, matched: Sequence[JointGains], damping: float
) -> float:
    """Return the stiffness that keeps the impedance of a group at its rounded damping (step 2).

    With omega the characteristic frequency, `stiffness^2 + (omega damping)^2` of the group equals
    the mean of it over the joints.
    """
    pairs = np.array([(gains.stiffness.value, gains.damping.value) for gains in matched])
    stiffnesses = pairs[:, 0]
    dampings = pairs[:, 1]
    inertia, _ = bench_inertia(robot, robot.joint(joint).original[0])
    omega = float(dampings.mean()) / (2.0 * inertia)
    square = np.mean(stiffnesses**2) + omega**2 * (np.mean(dampings**2) - damping**2)
    stiffness = math.sqrt(max(float(square), 0.0))
    # A damping far off the lattice must not carry the stiffness away from the joints.
    lowest = float(stiffnesses.min()) - STIFFNESS_STEP
    highest = float(stiffnesses.max()) + STIFFNESS_STEP
    stiffness = min(max(stiffness, lowest), highest)
    return _nearest_multiple(stiffness, STIFFNESS_STEP)


def _nearest_multiple(value: float, step: float) -> float:
    """Return the nearest multiple of a step, at least one step."""
    count = max(round(value / step), 1)
    return round(count * step, 9)


def _next_multiple(value: float, step: float) -> float:
    """Return the next multiple of a step that is not smaller than a value, at least one step."""
    count = max(math.ceil(value / step - ROUNDING_SLACK), 1)
    return round(count * step, 9)


def interval_points(gains: JointGains, level: float = 0.95) -> Array:
    """Compute points on the ellipse that holds a joint's true gains with some probability.

    Where no covariance is known, so that it is not finite, the gains are taken for exact.

    Args:
        gains: Matched gains of a joint.
        level: Probability that the true gains are inside.

    Returns:
        (stiffness, damping) of each point, shape (24, 2).
    """
    center = np.array([gains.stiffness.value, gains.damping.value])
    covariance = np.array(gains.covariance, dtype=np.float64)
    if not np.isfinite(covariance).all():
        covariance = np.zeros((2, 2))
    covariance = covariance + np.diag((SMALLEST_DEVIATION * center) ** 2)
    radius = np.sqrt(stats.chi2.ppf(level, 2))
    angle = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return np.asarray(center + radius * (np.linalg.cholesky(covariance) @ circle).T)


def enclosing_ellipsoid(
    points: Array, *, tolerance: float = 1e-4, rounds: int = 2000
) -> tuple[Array, Array]:
    """Compute the ellipsoid of least volume that covers some points.

    Khachiyan's algorithm (Todd and Yildirim, *On Khachiyan's algorithm for the computation of
    minimum-volume enclosing ellipsoids*, 2007), then scaled so that every point is inside.

    Args:
        points: Points, shape (n, d).
        tolerance: Relative excess of volume at which the search ends.
        rounds: Largest number of steps of the search.

    Returns:
        Centre c, shape (d,), and shape matrix E, shape (d, d), of
        `{x : (x - c)^T E^-1 (x - c) <= 1}`.
    """
    count, dimension = points.shape
    # The ellipsoid moves and scales with the points; about their middle little is rounded away.
    scaled = (points - points.mean(axis=0)) / points.std(axis=0)
    lifted = np.vstack([scaled.T, np.ones(count)])
    weights = np.full(count, 1.0 / count)
    # Products of the inverse spread of the lifted points with them, kept up to date.
    solved = np.linalg.solve((lifted * weights) @ lifted.T, lifted)
    distance = np.einsum("ij,ij->j", lifted, solved)
    for _ in range(rounds):
        farthest = int(distance.argmax())
        excess = distance[farthest] / (dimension + 1.0) - 1.0
        if excess < tolerance:
            break
        step = (distance[farthest] - dimension - 1.0) / (
            (dimension + 1.0) * (distance[farthest] - 1.0)
        )
        weights *= 1.0 - step
        weights[farthest] += step
        # Sherman and Morrison: the spread became (1 - step) spread + step farthest farthest^T.
        along = lifted[:, farthest] @ solved
        share = step / (1.0 - step + step * distance[farthest])
        distance = (distance - share * along**2) / (1.0 - step)
        solved = (solved - share * solved[:, farthest, None] * along) / (1.0 - step)
    center = points.T @ weights
    offsets = points - center
    shape = dimension * (offsets.T * weights) @ offsets
    reach = np.einsum("ij,ji->i", offsets, np.linalg.solve(shape, offsets.T)).max()
    return np.asarray(center), np.asarray(shape * max(reach, 1.0))
