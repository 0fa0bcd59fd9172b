"""Small motions of the standing robot before its first step: do its sensors follow them?

At the end of the rise the trunk nods and leans: the front legs shorten and return, then the left
ones, while the hips sway. Two things are compared.

- The first joint of each leg must have swayed as its target did. Mirrored signs of the hips' rolls
  show here. Of the other joints the load changes more than the target, so they are not compared;
  the default pose of a mirrored one is out of range or contradicts the attitude.
- The feet stand on the ground, so the plane through them, by the angles of the legs, says how the
  trunk turned. The inertial unit must say the same. One that is turned about the vertical, or of
  which a sign is mirrored, agrees with itself and with gravity as long as the trunk is level, and
  shows only here. A robot that hangs with its feet in the air does not turn, and is not judged.
"""

from __future__ import annotations

import math

import numpy as np

from pronk.arrays import Array
from pronk.deploy.runtime.posture import LegKinematics, upward
from pronk.robots.machine import State

NOD_SHARE = 0.2
"""How far the legs of one half shorten, as a share of the way to the folded pose: the Mini Cheetah
leans by 0.12 and nods by 0.07 rad."""
SWAY = 0.08
"""Motion of the first joint of each leg to one side, then to the other [rad]."""
_LEAST_LEGS = 3
"""Feet that define a plane."""
_LEAST_FOLLOWED = 0.1
"""Least slope of the motion of a leg's first joint against its target's. A standing robot gives way
and lags: the least of starts of the Mini Cheetah without a fault is 0.35."""
_LEAST_TURN = 0.01
"""Root of the mean square of the turn by the legs from which the inertial unit is judged, in the
less turned direction [rad]."""
_LARGEST_ANGLE = math.radians(53.0)
"""Largest angle about the vertical between the turns by the inertial unit and those by the legs
[rad]; a unit that is mounted a quarter turn off has 90 degrees. The largest of 57 starts of the
Mini Cheetah without a fault is 11 degrees. How large the turns are does not count: legs that give
way and an attitude that wanders change that by more than half (docs/evidence/faults.md)."""
_LEAST_SHARE = 0.4
"""Largest turn by the inertial unit, as a share of that by the legs, of a robot whose feet hang in
the air: such a robot is not judged."""
_STEP_S = 0.008
"""Time between two samples [s]."""


def nod_poses(legs: LegKinematics, default: Array, folded: Array) -> list[Array]:
    """Return the poses of the small motions, from the default pose and back to it.

    Args:
        legs: Geometry of the legs.
        default: The default pose [rad], (joints,).
        folded: The folded pose [rad], (joints,).

    Returns:
        Four poses, every second one the default pose; none for a robot with too few legs.
    """
    if len(legs.feet) < _LEAST_LEGS:
        return []
    feet = legs.feet - legs.feet.mean(axis=0)
    halves = (feet[:, 0] > 0.0, feet[:, 1] > 0.0)
    first = legs.joints[0]
    # Which way each first joint turns moves its foot to the left.
    arms = legs.feet - legs.anchors[0]
    leftward = np.sign((legs.crosses[0] @ arms[:, :, None])[:, 1, 0])
    poses = []
    for shortened, direction in zip(halves, (1.0, -1.0), strict=True):
        pose = default.copy()
        for leg in np.flatnonzero(shortened):
            of_leg = legs.joints[:, leg]
            pose[of_leg] += NOD_SHARE * (folded - default)[of_leg]
        pose[first] += direction * SWAY * leftward
        poses += [pose, default]
    return poses


class NodCheck:
    """What was commanded and measured during the small motions."""

    def __init__(self, legs: LegKinematics, names: tuple[str, ...]) -> None:
        """Begin without a sample.

        Args:
            legs: Geometry of the legs.
            names: Names of the joints.
        """
        self._legs = legs
        self._names = names
        self._targets: list[Array] = []
        self._positions: list[Array] = []
        self._by_legs: list[Array] = []
        self._by_unit: list[Array] = []
        self._sampled = -np.inf

    def begin(self) -> None:
        """Forget the samples of an earlier rise."""
        self._targets = []
        self._positions = []
        self._by_legs = []
        self._by_unit = []
        self._sampled = -np.inf

    def observe(self, t: float, target: Array, position: Array, state: State | None) -> None:
        """Take a tick of the small motions.

        Args:
            t: Time of the tick [s].
            target: Targets of the joints [rad], (joints,).
            position: Measured positions [rad], (joints,).
            state: The newest state, of which attitude and positions are compared; None without one,
                and where the trunk is not free.
        """
        if t - self._sampled < _STEP_S:
            return
        self._sampled = t
        self._targets.append(target)
        self._positions.append(position)
        if state is not None:
            self._by_legs.append(self._legs.ground_upward(state.position)[:2])
            self._by_unit.append(upward(state.orientation)[:2])

    def contradiction(self) -> str:
        """Return what was not measured as commanded, with numbers; "" if all was.

        Of less than half of the sway too little is known to pass.
        """
        first = self._legs.joints[0]
        swayed = 0.0
        if self._targets:
            swayed = float(np.ptp(np.array(self._targets)[:, first], axis=0).min())
        if swayed < SWAY:
            return (
                f"only {swayed:.2f} rad of the sway of {2.0 * SWAY:g} rad were measured, in "
                f"{len(self._targets)} samples; request a reset and stand up again without a pause"
            )
        targets = _centred(self._targets)
        positions = _centred(self._positions)
        power = (targets * targets).mean(axis=0)
        slopes = (targets * positions).mean(axis=0) / np.maximum(power, 1e-12)
        i = int(first[np.argmin(slopes[first])])
        if slopes[i] < _LEAST_FOLLOWED:
            return (
                f"{self._names[i]} moved by {slopes[i]:.2f} of its target's motion; its sign is "
                "mirrored, or it is seized or without torque"
            )
        if len(self._by_legs) < 2:
            return ""
        by_legs = _centred(self._by_legs)
        by_unit = _centred(self._by_unit)
        moments = by_legs.T @ by_legs / len(by_legs)
        if np.sqrt(np.linalg.eigvalsh(moments)[0]) < _LEAST_TURN:
            return ""
        matrix = np.linalg.lstsq(by_legs, by_unit, rcond=None)[0].T
        if np.linalg.norm(matrix, 2) < _LEAST_SHARE:
            return ""
        if np.linalg.det(matrix) < 0.0:
            return (
                "the inertial unit does not turn as the trunk does by the legs: a sign of it seems "
                "to be mirrored, or not all feet stand on the ground"
            )
        # Of all rotations that of the polar decomposition is nearest to the matrix.
        angle = math.atan2(matrix[1, 0] - matrix[0, 1], np.trace(matrix))
        if abs(angle) > _LARGEST_ANGLE:
            return (
                f"the inertial unit seems to be mounted {math.degrees(angle):.0f} degrees off "
                "about the vertical, by the turns of the trunk that the legs tell, or not all feet "
                "stand on the ground"
            )
        return ""


def _centred(rows: list[Array]) -> Array:
    """Return rows less their mean."""
    array = np.array(rows)
    return np.asarray(array - array.mean(axis=0))
