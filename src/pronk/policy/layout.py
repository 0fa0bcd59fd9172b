"""The observation vector of a policy, number by number.

The measured part is one vector with a short history, so that actor and estimator read the same
measurement with the same noise. The jump input is separate: phase 1 has none, phase 2 adds it at
the end (paper N3).

    measured   angular velocity 3, projected gravity 3, position 3 x 12, velocity 3 x 12,
               previous actions 2 x 12, command 3                                     = 105
    jump       0 or 1                                                                 =   1

Histories run from old to new: t-0.04, t-0.02, t (positions and velocities); t-0.04, t-0.02
(actions). The estimator reads all but the command (102, with the jump input 103: paper N1, reading
A19); the actor reads the estimate (7), then the current samples (45): 52, with the jump input 53
(paper N2, reading A19 of one previous action).

Frames and units: angular velocity [rad/s] and gravity (unit vector) in the trunk's frame (x
forward, y left, z up), position [rad] relative to the default pose, velocity [rad/s], actions as
the network gave them, command (vx, vy [m/s], yaw rate [rad/s]) in the trunk's frame.
"""

from __future__ import annotations

from dataclasses import dataclass

JOINTS = 12
HISTORY = 3
"""Samples of position and velocity."""
ACTIONS = 2
"""Samples of previous actions."""


@dataclass(frozen=True)
class Part:
    """A named slice of the measured vector."""

    name: str
    start: int
    size: int

    @property
    def indices(self) -> range:
        """Its positions in the vector."""
        return range(self.start, self.start + self.size)


def _parts(sizes: dict[str, int]) -> dict[str, Part]:
    parts, start = {}, 0
    for name, size in sizes.items():
        parts[name] = Part(name, start, size)
        start += size
    return parts


MEASURED = _parts(
    {
        "angular_velocity": 3,
        "projected_gravity": 3,
        "joint_position": HISTORY * JOINTS,
        "joint_velocity": HISTORY * JOINTS,
        "action": ACTIONS * JOINTS,
        "command": 3,
    }
)
"""The parts of the measured vector, in order."""

MEASURED_SIZE = sum(part.size for part in MEASURED.values())

_newest = {name: MEASURED[name].indices[-JOINTS:] for name in ("joint_position", "joint_velocity")}

ACTOR_INDICES: tuple[int, ...] = (
    *MEASURED["angular_velocity"].indices,
    *MEASURED["projected_gravity"].indices,
    *MEASURED["command"].indices,
    *_newest["joint_position"],
    *_newest["joint_velocity"],
    *MEASURED["action"].indices[-JOINTS:],
)
"""Part of the measured vector that the actor reads, behind the estimate."""

ESTIMATOR_INDICES: tuple[int, ...] = tuple(range(MEASURED["command"].start))
"""Part of the measured vector that the estimator reads."""

ESTIMATE = {"contact": 4, "linear_velocity": 3}
"""Outputs of the estimator: contact probability per foot (FR, FL, HR, HL), trunk velocity in the
trunk's frame [m/s]. The actor reads it in this order, in front of its own part."""

ESTIMATE_SIZE = sum(ESTIMATE.values())
ACTOR_SIZE = ESTIMATE_SIZE + len(ACTOR_INDICES)
ESTIMATOR_SIZE = len(ESTIMATOR_INDICES)
