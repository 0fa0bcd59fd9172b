"""Paths on which a robot stands up and sits down."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pronk.arrays import Array
from pronk.errors import RobotError
from pronk.robots.robot import RobotSpec


@dataclass(frozen=True, kw_only=True)
class RunTiming:
    """Times of standing up, starting the policy and sitting down."""

    damp_s: float = 1.0
    """Least time in damping before the robot stands up; it sinks to the ground meanwhile [s]."""
    fold_s: float = 1.0
    """Time from the measured pose to the folded pose [s]."""
    check_s: float = 0.15
    """Time of each small motion in the default pose after the first rise; 0 for no check, and no
    swing of the legs before it either [s]."""
    rest_s: float = 1.2
    """Time in the default pose after the small motions, until the trunk is still: the Mini Cheetah
    on the virtual ground moves by up to 2.5 cm in the first second, by 1.5 mm afterwards [s]."""
    rise_s: float = 1.5
    """Time from the folded pose to the default pose [s]."""
    ramp_s: float = 0.5
    """Time in which the stiffness grows from none to that of the robot's drives [s]."""
    blend_s: float = 0.4
    """Time in which the policy's targets replace the pose; 0 as in training [s]."""
    halt_s: float = 1.0
    """Time with a zero command before the robot sits down [s]."""
    sit_s: float = 1.5
    """Time from the measured pose to the folded pose when the robot sits down [s]."""

    def __post_init__(self) -> None:
        """Refuse times that are negative or not finite."""
        times = {
            "damp_s": self.damp_s,
            "fold_s": self.fold_s,
            "check_s": self.check_s,
            "rest_s": self.rest_s,
            "rise_s": self.rise_s,
            "ramp_s": self.ramp_s,
            "blend_s": self.blend_s,
            "halt_s": self.halt_s,
            "sit_s": self.sit_s,
        }
        for name, seconds in times.items():
            if not 0.0 <= seconds < math.inf:
                raise RobotError(f"RunTiming.{name} is {seconds}; it must be finite, not negative.")


def minimum_jerk(share: float) -> float:
    """Return the share of a minimum-jerk path at a share of its time: `10 s^3 - 15 s^4 + 6 s^5`.

    Flash and Hogan, 1985. `share` is clipped to 0 to 1.
    """
    s = min(max(share, 0.0), 1.0)
    return s * s * s * (10.0 + s * (6.0 * s - 15.0))


@dataclass(frozen=True, kw_only=True)
class PosePath:
    """Minimum-jerk joint targets through poses, at rest at each, with a growing stiffness."""

    began: float
    """Time at the first pose [s]."""
    poses: tuple[Array, ...]
    """Joint positions, the measured ones first [rad], each (joints,)."""
    seconds: tuple[float, ...]
    """Times from each pose to the next [s]."""
    ramp_s: float = 0.0
    """Time in which the stiffness grows [s]."""
    rises: range = range(0)
    """Parts of the way in which the gains go over from those of the drives to those of standing;
    none for the gains of standing on the whole way."""

    def target(self, t: float) -> Array:
        """Return the joint targets at a time [rad], (joints,)."""
        remaining = t - self.began
        for index, seconds in enumerate(self.seconds):
            if remaining < seconds:
                start = self.poses[index]
                goal = self.poses[index + 1]
                return start + (goal - start) * minimum_jerk(remaining / seconds)
            remaining -= seconds
        return self.poses[-1]

    def stiffness(self, t: float) -> float:
        """Return the share of the drives' stiffness at a time, 0 to 1."""
        return minimum_jerk((t - self.began) / self.ramp_s) if self.ramp_s > 0.0 else 1.0

    def standing_share(self, t: float) -> float:
        """Return the share of the gains of standing at a time, 0 to 1; the drives' are the rest."""
        if not self.rises:
            return 1.0
        rise_began = self.began + sum(self.seconds[: self.rises.start])
        rise_s = sum(self.seconds[self.rises.start : self.rises.stop])
        return minimum_jerk((t - rise_began) / rise_s) if rise_s > 0.0 else float(t >= rise_began)

    def done(self, t: float) -> bool:
        """Whether the target has reached the last pose."""
        return t >= self.began + sum(self.seconds)


def last_joints(robot: RobotSpec) -> list[int]:
    """Return the number of each leg's last joint."""
    numbers = []
    for leg in robot.legs:
        of_leg = [i for i, name in enumerate(robot.joint_names) if name.startswith(f"{leg}_")]
        numbers.append(max(of_leg))
    return numbers


def folded_pose(robot: RobotSpec) -> Array:
    """Return the folded pose [rad], (joints,); RobotError if the robot file gives none."""
    pose = []
    for joint in robot.joints:
        if joint.folded_position is None:
            raise RobotError(
                f"{robot.name} has no folded pose, so it cannot stand up; give each of its joints "
                "a folded position."
            )
        pose.append(joint.folded_position)
    return np.array(pose, dtype=float)


def stand_up(
    robot: RobotSpec,
    measured: Array,
    began: float,
    timing: RunTiming,
    *,
    swing: bool = False,
    nods: Sequence[Array] = (),
) -> PosePath:
    """Plan the way from the measured pose through the folded to the default pose.

    Args:
        robot: The robot.
        measured: Measured joint positions [rad], (joints,).
        began: Time at the measured pose [s].
        timing: Times of the way.
        swing: Whether each leg's last joint swings by `StandingUp.swing` in the folded pose, one
            leg after another.
        nods: Poses of small motions after the default pose, the last of them the default pose
            again, `RunTiming.check_s` apart [rad], each (joints,); `RunTiming.rest_s` follows.
    """
    default = np.array([joint.default_position for joint in robot.joints])
    folded = folded_pose(robot)
    poses = [measured.copy(), folded]
    seconds = [timing.fold_s]
    if swing:
        for i in last_joints(robot):
            swung = folded.copy()
            swung[i] += math.copysign(robot.limits.stand.swing, default[i] - folded[i])
            poses += [swung, folded]
            seconds += [robot.limits.stand.swing_s, robot.limits.stand.swing_s]
    poses.append(default)
    seconds.append(timing.rise_s)
    rise = len(seconds) - 1
    for pose in nods:
        poses.append(pose)
        seconds.append(timing.check_s)
    if nods:
        poses.append(default)
        seconds.append(timing.rest_s)
    return PosePath(
        began=began,
        poses=tuple(poses),
        seconds=tuple(seconds),
        ramp_s=timing.ramp_s,
        rises=range(rise, rise + 1),
    )
