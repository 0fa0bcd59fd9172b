"""The contract of a policy: all that a stranger needs to run it, beside the network.

A network is numbers in, numbers out. Which joint is the third one, what a zero action means, how
old the samples of a history are, with which gains the drive must follow: the contract says it,
and it travels in the metadata of `policy.onnx` (see `pronk.policy.contract_json`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from pronk.errors import ArtefactError
from pronk.policy.layout import ACTIONS, HISTORY, MEASURED
from pronk.robots.robot import Robot

GAINS = ("matched", "naive")
"""Where the gains of training came from: `gains.yaml`, or the numbers set on the real drive."""
COMMANDS = ("vx", "vy", "yaw_rate")
"""The command in order: forward and left [m/s], about the trunk's z [rad/s]."""

_UNITS = {
    "angular_velocity": "rad/s",
    "projected_gravity": "1",
    "joint_position": "rad",
    "joint_velocity": "rad/s",
    "action": "1",
    "command": "m/s, m/s, rad/s",
}


@dataclass(frozen=True, kw_only=True)
class ObservationPart:
    """A named stretch of the input "measured"; the stretches follow each other in order."""

    name: str
    size: int
    """Numbers in it, all samples together."""
    times_s: tuple[float, ...]
    """Sample times relative to now [s], as they stand in the vector: oldest first. An action's
    time is that of the observation it answered."""
    unit: str


def measured_layout(policy_rate_hz: float) -> tuple[ObservationPart, ...]:
    """The layout that this pronk trains and runs with (see `pronk.policy.layout`).

    Joint positions are relative to the default position, actions as the network gave them, and
    vectors in the trunk's frame (x forward, y left, z up).
    """
    now = (0.0,)
    times = {
        "joint_position": tuple(-i / policy_rate_hz for i in range(HISTORY - 1, 0, -1)) + now,
        "joint_velocity": tuple(-i / policy_rate_hz for i in range(HISTORY - 1, 0, -1)) + now,
        "action": tuple(-i / policy_rate_hz for i in range(ACTIONS, 0, -1)),
    }
    return tuple(
        ObservationPart(name=name, size=part.size, times_s=times.get(name, now), unit=_UNITS[name])
        for name, part in MEASURED.items()
    )


@dataclass(frozen=True, kw_only=True)
class Contract:
    """What a policy was trained for. Per-joint tuples are in the order of `joint_names`."""

    robot: str
    joint_names: tuple[str, ...]
    default_position: tuple[float, ...]
    """Joint position target at action zero, and the zero of the observed positions [rad]."""
    action_scale: tuple[float, ...]
    """Target is `default_position + action_scale * action` [rad]."""
    stiffness: tuple[float, ...]
    """Nominal in training [N m/rad]."""
    damping: tuple[float, ...]
    """Nominal in training [N m s/rad]."""
    gains: str
    """`matched` or `naive`."""
    gains_sha256: str
    """Hex SHA-256 of the `gains.yaml` that nominals or, with naive gains, ranges and delay come
    from; empty without one."""
    virtual: bool
    """True if that file rests on pronk's virtual robot."""
    observation: tuple[ObservationPart, ...]
    policy_rate_hz: float
    timestep_s: float
    """Physics step of training [s]."""
    decimation: int
    """Physics steps per policy step."""
    delay_range_s: tuple[float, float]
    """Command delays trained for [s]."""
    command_ranges: Mapping[str, tuple[float, float]]
    """Smallest and largest command trained for, by the names in `COMMANDS`."""
    jump: bool
    """True if the network has the input "jump"."""
    lift_off_velocity: float | None
    """Upward velocity of the trunk wanted at lift-off [m/s]; None for a policy without jump."""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """Phases, iterations, seed, run: how it came about."""
    versions: Mapping[str, str] = field(default_factory=dict)
    """Package to version at training."""

    def __post_init__(self) -> None:
        """Refuse what contradicts itself.

        Raises:
            ArtefactError: One sentence that names the field.
        """
        n = len(self.joint_names)
        for name in ("default_position", "action_scale", "stiffness", "damping"):
            values = getattr(self, name)
            _demand(len(values) == n, name, values, f"one number for each of the {n} joints")
            _demand(all(map(math.isfinite, values)), name, values, "finite")
        for name in ("action_scale", "stiffness"):
            values = getattr(self, name)
            _demand(min(values, default=1.0) > 0.0, name, values, "positive")
        _demand(min(self.damping, default=0.0) >= 0.0, "damping", self.damping, "not negative")
        _demand(self.gains in GAINS, "gains", self.gains, " or ".join(GAINS))
        hashed = re.fullmatch("[0-9a-f]{64}", self.gains_sha256) is not None
        _demand(
            hashed or (self.gains == "naive" and not self.gains_sha256),
            "gains_sha256",
            self.gains_sha256,
            "64 hex digits, or empty for naive gains that rest on no file",
        )
        step = self.timestep_s * self.decimation
        _demand(
            step > 0.0 and math.isclose(step * self.policy_rate_hz, 1.0, rel_tol=1e-9),
            "policy_rate_hz",
            self.policy_rate_hz,
            f"that of {self.decimation} physics steps of {self.timestep_s} s",
        )
        commands = tuple(self.command_ranges)
        _demand(commands == COMMANDS, "command_ranges", commands, f"of {', '.join(COMMANDS)}")
        ranges = {f"command_ranges of {k}": v for k, v in self.command_ranges.items()}
        for name, (low, high) in {**ranges, "delay_range_s": self.delay_range_s}.items():
            rising = math.isfinite(low) and math.isfinite(high) and low <= high
            _demand(rising, name, (low, high), "finite, the smaller number first")
        _demand(
            self.jump == (self.lift_off_velocity is not None),
            "lift_off_velocity",
            self.lift_off_velocity,
            "a number for a policy that jumps and null for one that does not",
        )


def check(contract: Contract, robot: Robot, *, gains_sha256: str | None = None) -> None:
    """Refuse a policy that is not for this robot.

    Args:
        contract: What the policy was trained for.
        robot: What it shall run on.
        gains_sha256: Of the `gains.yaml` in hand, if the policy must be trained with that one.

    Raises:
        ArtefactError: One sentence that names the field.
    """
    _equal("robot", contract.robot, robot.name)
    _equal("joint_names", contract.joint_names, robot.joint_names)
    _equal("policy_rate_hz", contract.policy_rate_hz, robot.policy_rate_hz)
    _equal("timestep_s", contract.timestep_s, robot.timestep_s)
    _equal("decimation", contract.decimation, robot.decimation)
    for joint, position in zip(robot.joints, contract.default_position, strict=True):
        low, high = joint.range
        _demand(
            low <= position <= high,
            f"default_position of {joint.name}",
            position,
            f"within the joint's limits, {low} to {high} rad",
        )
    for name in ("stiffness", "damping"):
        got = dict(zip(contract.joint_names, getattr(contract, name), strict=True))
        for joint in robot.joints:
            # Training gains are per group; naive ones are those set on the real drive.
            naive = contract.gains == "naive"
            want = getattr(joint, name) if naive else got[robot.group(joint.group)[0].name]
            _demand(
                math.isclose(got[joint.name], want, rel_tol=1e-6),
                f"{name} of {joint.name}",
                got[joint.name],
                f"{want:g}, {'that of the drive' if naive else f'as in all of {joint.group}'}",
            )
    if gains_sha256 is not None:
        _demand(
            contract.gains_sha256 == gains_sha256,
            "gains_sha256",
            contract.gains_sha256,
            f"{gains_sha256!r}, that of the gains in hand",
        )


def _demand(met: bool, name: str, got: object, expected: str) -> None:
    if not met:
        raise ArtefactError(f"the contract's {name} is {got!r}; it must be {expected}.")


def _equal(name: str, got: object, expected: object) -> None:
    _demand(got == expected, name, got, f"{expected!r}, as the robot has it")
