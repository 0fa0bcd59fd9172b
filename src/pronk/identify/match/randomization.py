"""From the gains of single joints to what training draws from: one pair and one range a group.

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

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy import stats

from pronk.arrays import Array
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match.gains import GroupGains, JointGains, MatchedGains
from pronk.identify.match.identifiability import bench_inertia
from pronk.identify.simulators.simulator import SimulatorInfo
from pronk.robots.robot import RobotSpec

STIFFNESS_STEP = 0.5
"""Lattice of the paper's training stiffnesses: 20, 17.5, 21.5 N m/rad (Table I)."""
DAMPING_STEP = 0.05
"""Lattice of the paper's training dampings: 0.45, 0.4, 0.55 N m s/rad (Table I)."""
_DIRECTIONS = 24
"""Points on each joint's own ellipse; the enclosing one misses less than 1 % between them."""
_FLOOR = 1e-3
"""Smallest relative standard deviation, so that a single exact joint still has an ellipse."""
_SLACK = 1e-6
"""A range that is too small by rounding of the last binary digit still covers."""


def group_gains(robot: RobotSpec, joints: Mapping[str, JointGains]) -> dict[str, GroupGains]:
    """Training gains, ranges and joint ellipsoids of every group with a matched joint."""
    for name in joints:
        robot.joint(name)
    out = {}
    for name in robot.groups:
        group = {j.name: joints[j.name] for j in robot.group(name) if j.name in joints}
        if not group:
            continue
        stiffness, damping = centre = _centre(robot, group)
        low, high = _bounds(group.values()).T
        needed = np.maximum(high - centre, centre - low).tolist()
        middle, shape = enclosing(np.concatenate([interval_points(g) for g in group.values()]))
        (a, b), (c, d) = shape.tolist()
        out[name] = GroupGains(
            stiffness=stiffness,
            damping=damping,
            stiffness_range=_up(needed[0], STIFFNESS_STEP),
            damping_range=_up(needed[1], DAMPING_STEP),
            frictionloss=float(np.mean([gains.frictionloss for gains in group.values()])),
            ellipsoid=((a, b), (c, d)),
            ellipsoid_center=tuple(middle.tolist()),
        )
    return out


def matched_gains(
    robot: RobotSpec,
    joints: Mapping[str, JointGains],
    logs: Sequence[JointLog],
    info: SimulatorInfo,
) -> MatchedGains:
    """The artefact of matched joints, the logs and the simulator that they hold for."""
    return MatchedGains(
        robot=robot.name,
        simulator=info,
        joints=joints,
        groups=group_gains(robot, joints),
        logs={Path(log.source or "log").name: log.sha256 for log in logs},
        virtual=any(log.virtual for log in logs),
    )


def _characteristic_frequency(robot: RobotSpec, joint_name: str, damping: float) -> float:
    """Half-width of a joint's resonance, `damping / (2 inertia)` [rad/s], armature included."""
    inertia, _ = bench_inertia(robot, robot.joint(joint_name).original[0])
    return damping / (2.0 * inertia)


def _bounds(joints: Collection[JointGains]) -> Array:
    """Interval of stiffness and of damping that covers all joints and their known intervals."""
    out = []
    for name in ("stiffness", "damping"):
        ends = [getattr(one, name) for one in joints]
        for one in joints:
            for interval in (getattr(one, f"{name}_ci95"), getattr(one, f"{name}_total95")):
                ends += interval if np.isfinite(interval).all() else ()
        out.append((min(ends), max(ends)))
    return np.array(out)


def _centre(robot: RobotSpec, group: Mapping[str, JointGains]) -> tuple[float, float]:
    """Training stiffness and damping of a group (steps 1 and 2)."""
    damping = _nearest(float(_bounds(group.values())[1].mean()), DAMPING_STEP)
    stiffnesses = np.array([gains.stiffness for gains in group.values()])
    dampings = np.array([gains.damping for gains in group.values()])
    omega = _characteristic_frequency(robot, next(iter(group)), float(dampings.mean()))
    square = np.mean(stiffnesses**2) + omega**2 * (np.mean(dampings**2) - damping**2)
    # A damping far off the lattice must not carry the stiffness away from the joints.
    least, most = stiffnesses.min() - STIFFNESS_STEP, stiffnesses.max() + STIFFNESS_STEP
    kept = float(np.clip(np.sqrt(max(float(square), 0.0)), least, most))
    return _nearest(kept, STIFFNESS_STEP), damping


def _nearest(value: float, step: float) -> float:
    """Nearest multiple of a step, at least one step, free of binary dust."""
    return round(max(round(value / step), 1) * step, 9)


def _up(value: float, step: float) -> float:
    """Next multiple of a step that is not smaller, at least one step."""
    return round(max(int(np.ceil(value / step - _SLACK)), 1) * step, 9)


def interval_points(gains: JointGains, level: float = 0.95) -> Array:
    """Points on the ellipse that holds a joint's true gains with probability `level`, (24, 2).

    Where the covariance is not finite, as without repeats, the gains are taken for exact.
    """
    centre = np.array([gains.stiffness, gains.damping])
    covariance = np.array(gains.covariance, dtype=np.float64)
    if not np.isfinite(covariance).all():
        covariance = np.zeros((2, 2))
    covariance = covariance + np.diag((_FLOOR * centre) ** 2)
    radius = np.sqrt(stats.chi2.ppf(level, 2))
    angle = 2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    circle = np.stack([np.cos(angle), np.sin(angle)])
    return np.asarray(centre + radius * (np.linalg.cholesky(covariance) @ circle).T)


def enclosing(points: Array, *, tolerance: float = 1e-4, rounds: int = 2000) -> tuple[Array, Array]:
    """Minimum-volume ellipsoid that covers points of shape (n, d).

    Khachiyan's algorithm (Todd and Yildirim, *On Khachiyan's algorithm for the computation of
    minimum-volume enclosing ellipsoids*, 2007) up to a relative excess of volume, then scaled so
    that every point is inside. Returns centre c, shape (d,), and shape matrix E, shape (d, d), of
    `{x : (x - c)^T E^-1 (x - c) <= 1}`.
    """
    n, d = points.shape
    # The ellipsoid moves and scales with the points; about their middle little is rounded away.
    scaled = (points - points.mean(axis=0)) / points.std(axis=0)
    lifted = np.vstack([scaled.T, np.ones(n)])
    weights = np.full(n, 1.0 / n)
    # Of the spread of the lifted points: products of its inverse with them, kept up to date.
    solved = np.linalg.solve((lifted * weights) @ lifted.T, lifted)
    distance = np.einsum("ij,ij->j", lifted, solved)
    for _ in range(rounds):
        worst = int(distance.argmax())
        excess = distance[worst] / (d + 1.0) - 1.0
        if excess < tolerance:
            break
        step = (distance[worst] - d - 1.0) / ((d + 1.0) * (distance[worst] - 1.0))
        weights *= 1.0 - step
        weights[worst] += step
        # Sherman and Morrison: the spread became (1 - step) spread + step worst worst^T.
        along = lifted[:, worst] @ solved
        share = step / (1.0 - step + step * distance[worst])
        distance = (distance - share * along**2) / (1.0 - step)
        solved = (solved - share * solved[:, worst, None] * along) / (1.0 - step)
    centre = points.T @ weights
    about = points - centre
    shape = d * (about.T * weights) @ about
    reach = np.einsum("ij,ji->i", about, np.linalg.solve(shape, about.T)).max()
    return np.asarray(centre), np.asarray(shape * max(reach, 1.0))
