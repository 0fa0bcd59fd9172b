"""Training gains and ranges of a joint group, from the matched gains of its joints.

The gain of a group is the median of its matched joints, with three significant digits, or with as
many as it takes to stay inside their intervals. Its range is uniform and symmetric, and rests on
the evidence: it covers every matched joint of the group with its 95 % interval, is `RANGE_FLOOR` of
the gain or more, and ends above zero. `range_notes` says where it is wider or narrower than the
evidence. A joint that is no match counts only where no joint of its group is one.

For the paper's robot, matched by the paper's method, the gains are on the paper's own lattice. The
paper trains with one pair of gains per joint group and a uniform range about it (Table I, D3, D4)
and does not state how it rounded from the matched joints to the group. pronk's reading
(`lattice_gains`):

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

import numpy as np
from scipy import special

from pronk.arrays import Array
from pronk.identify.match.gains import FittedValue, GroupGains, JointGains
from pronk.robots.model import bench_inertia
from pronk.robots.robot import RobotSpec

PAPER_ROBOT = "mini_cheetah"
"""The robot of the paper, whose training gains are on the lattice of its Table I."""
STIFFNESS_STEP = 0.5
"""Lattice of the paper's training stiffnesses: 20, 17.5, 21.5 N m/rad (Table I)."""
DAMPING_STEP = 0.05
"""Lattice of the paper's training dampings: 0.45, 0.4, 0.55 N m s/rad (Table I)."""
RANGE_FLOOR = 0.05
"""Smallest half-width of a range over its gain. So much may the stiffness change between
amplitudes without a flag (`result.SPREAD_MAX`); the paper's knees have 1 on 21.5."""
LOWEST_OF_EVIDENCE = 0.5
"""Lower end of a range over the lowest end of the joints' intervals, at least: a symmetric range
whose upper end is far away must not reach zero."""
LOWEST_OF_GAIN = 0.1
"""Lower end of a range over its gain, at least."""
DIGITS = 3
"""Significant digits of training gains and ranges."""
MOST_DIGITS = 9
"""Most significant digits of a gain whose interval is narrower than its digits."""
DIRECTIONS = 24
"""Points on the ellipse of each joint; the ellipse that encloses them misses less than 1 % of the
area between them."""
SMALLEST_DEVIATION = 1e-3
"""Smallest relative standard deviation of a gain, so that a single exact joint has an ellipse."""
SAME_RANGE = 0.02
"""Relative difference up to which a written range counts as that of `gain_and_range`: ranges are
rounded, and a translation scales them."""
SAME_GAIN = 1e-9
"""Relative difference up to which gains are the same: joints without an interval show no range."""
ROUNDING_SLACK = 1e-6
"""Share of a step by which a range may be too small: rounding of the last binary digit."""


def group_gains(
    robot: RobotSpec, joints: Mapping[str, JointGains], method: str = "time"
) -> dict[str, GroupGains]:
    """Compute training gains, ranges and ellipsoids of every group with a matched joint.

    Args:
        robot: The robot.
        joints: Matched gains by joint.
        method: Method of the match; `paper` for the paper's robot puts them on its lattice.

    Returns:
        Training gains by group, in the robot's order.

    Raises:
        RobotError: A joint is none of the robot's.
    """
    for name in joints:
        robot.joint(name)  # raises RobotError for an unknown joint
    groups = {}
    for group in robot.groups:
        members = trusted_joints([joint.name for joint in robot.group(group)], joints)
        if not members:
            continue
        matched = [joints[name] for name in members]
        if method == "paper" and robot.name == PAPER_ROBOT:
            groups[group] = lattice_gains(robot, members[0], matched)
        else:
            groups[group] = evidence_gains(matched)
    return groups


def trusted_joints(names: Sequence[str], joints: Mapping[str, JointGains]) -> list[str]:
    """Choose the joints of a group that its training gains come from.

    They are those that are a match; where none is, all that were fitted.

    Args:
        names: Names of the group's joints.
        joints: Matched gains by joint.
    """
    fitted = [name for name in names if name in joints]
    matched = [name for name in fitted if joints[name].matched]
    return matched or fitted


def evidence_gains(matched: Sequence[JointGains]) -> GroupGains:
    """Return training gains and ranges that rest on the values and intervals of some joints."""
    stiffness, stiffness_range = gain_and_range([gains.stiffness for gains in matched])
    damping, damping_range = gain_and_range([gains.damping for gains in matched])
    points = [interval_points(gains, floor=RANGE_FLOOR) for gains in matched]
    return _group(matched, (stiffness, damping), (stiffness_range, damping_range), points)


def gain_and_range(fitted: Sequence[FittedValue]) -> tuple[float, float]:
    """Compute the training gain of some joints and the half-width of its range.

    Args:
        fitted: The gain of each joint, with its intervals.

    Returns:
        Gain and half-width, in the unit of the gain.
    """
    low, high = _covering_interval(fitted)
    middle = rounded_inside(float(np.median([gain.value for gain in fitted])), low, high)
    half_width = max(high - middle, middle - low, RANGE_FLOOR * middle)
    lowest = max(LOWEST_OF_EVIDENCE * low, LOWEST_OF_GAIN * middle)
    return middle, _rounded_up(min(half_width, middle - lowest))


def rounded_inside(value: float, low: float, high: float) -> float:
    """Round a value to `DIGITS` significant digits, or to so many that it stays in an interval.

    Args:
        value: The value.
        low: Lower end of its interval.
        high: Upper end; the same as the lower one where no interval is known.

    Returns:
        The rounded value.
    """
    rounded = value
    for digits in range(DIGITS, MOST_DIGITS + 1):
        rounded = float(f"{value:.{digits}g}")
        if low <= rounded <= high or low == high:
            return rounded
    return rounded


def _rounded_up(value: float) -> float:
    """Round a number that is not negative to the next with `DIGITS` significant digits."""
    if value <= 0.0:
        return 0.0
    step = 10.0 ** (math.floor(math.log10(value)) - DIGITS + 1)
    return float(f"{_next_multiple(value, step):.{DIGITS}g}")


def range_notes(
    groups: Mapping[str, GroupGains],
    members: Mapping[str, Sequence[str]],
    joints: Mapping[str, JointGains],
) -> tuple[str, ...]:
    """Say which ranges are wider or narrower than what the joints show.

    Args:
        groups: Training gains by group. Of those on the paper's lattice nothing is said.
        members: Names of the joints of each group.
        joints: Matched gains by joint.

    Returns:
        At most one sentence on wider and one on narrower ranges.
    """
    wider = []
    narrower = []
    for group, gains in groups.items():
        trusted = trusted_joints(members[group], joints)
        stiffnesses = [joints[name].stiffness for name in trusted]
        dampings = [joints[name].damping for name in trusted]
        for name, written, fitted in (
            ("stiffness", gains.stiffness_range, stiffnesses),
            ("damping", gains.damping_range, dampings),
        ):
            if not fitted or not math.isclose(
                written, gain_and_range(fitted)[1], rel_tol=SAME_RANGE
            ):
                continue
            low, high = _covering_interval(fitted)
            middle, half_width = gain_and_range(fitted)
            reach = max(high - middle, middle - low)
            if reach > 1.01 * half_width:
                narrower.append(f"{name} of {group} ({low:.3g} to {high:.3g})")
            elif SAME_GAIN * middle < reach < RANGE_FLOOR * middle:
                wider.append(f"{name} of {group} ({100.0 * reach / middle:.2g} %)")
    notes = []
    if wider:
        notes.append(
            f"Ranges are {100.0 * RANGE_FLOOR:g} % of the gain where joints and intervals reach "
            f"less far: {', '.join(wider)}."
        )
    if narrower:
        notes.append(
            "Ranges are symmetric and stay above 0, so that they do not cover all joints and "
            f"intervals of {', '.join(narrower)}; use the gains of each joint, or match again."
        )
    return tuple(notes)


def lattice_gains(robot: RobotSpec, joint: str, matched: Sequence[JointGains]) -> GroupGains:
    """Return the training gains of a group on the paper's lattice.

    Args:
        robot: The paper's robot.
        joint: The first matched joint of the group, whose inertia counts.
        matched: Gains of the group's matched joints.
    """
    stiffness_low, stiffness_high = _covering_interval([gains.stiffness for gains in matched])
    damping_low, damping_high = _covering_interval([gains.damping for gains in matched])
    damping = _nearest_multiple(0.5 * (damping_low + damping_high), DAMPING_STEP)
    stiffness = _lattice_stiffness(robot, joint, matched, damping)
    stiffness_reach = max(stiffness_high - stiffness, stiffness - stiffness_low)
    damping_reach = max(damping_high - damping, damping - damping_low)
    ranges = (
        _next_multiple(stiffness_reach, STIFFNESS_STEP),
        _next_multiple(damping_reach, DAMPING_STEP),
    )
    points = [interval_points(gains) for gains in matched]
    return _group(matched, (stiffness, damping), ranges, points)


def _group(
    matched: Sequence[JointGains],
    gain_pair: tuple[float, float],
    ranges: tuple[float, float],
    points: Sequence[Array],
) -> GroupGains:
    """Return training gains with the mean friction of the joints and their ellipsoid."""
    center, shape = enclosing_ellipsoid(np.concatenate(points))
    stiffness_row, damping_row = shape.tolist()
    return GroupGains(
        stiffness=gain_pair[0],
        damping=gain_pair[1],
        stiffness_range=ranges[0],
        damping_range=ranges[1],
        frictionloss=float(np.mean([gains.frictionloss.value for gains in matched])),
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


def _lattice_stiffness(
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


def interval_points(gains: JointGains, level: float = 0.95, floor: float = 0.0) -> Array:
    """Compute points on the ellipse that holds a joint's true gains with some probability.

    Where no covariance is known, so that it is not finite, the gains are taken for exact.

    Args:
        gains: Matched gains of a joint.
        level: Probability that the true gains are inside.
        floor: Smallest half-width of the ellipse over each gain. Above 0 the ellipse is also as
            wide as the intervals of each gain, up to where it would reach zero.

    Returns:
        (stiffness, damping) of each point, shape (24, 2).
    """
    center = np.array([gains.stiffness.value, gains.damping.value])
    covariance = np.array(gains.covariance, dtype=np.float64)
    if not np.isfinite(covariance).all():
        covariance = np.zeros((2, 2))
    covariance = covariance + np.diag((SMALLEST_DEVIATION * center) ** 2)
    radius = np.sqrt(special.chdtri(2, 1.0 - level))
    if floor > 0.0:
        half_widths = radius * np.sqrt(np.diag(covariance))
        scales = np.ones(2)
        for index, gain in enumerate((gains.stiffness, gains.damping)):
            low, high = _covering_interval([gain])
            reach = max(high - gain.value, gain.value - low, floor * gain.value)
            reach = min(reach, (1.0 - LOWEST_OF_GAIN) * gain.value)
            scales[index] = reach / half_widths[index]
        covariance = covariance * np.outer(scales, scales)
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
