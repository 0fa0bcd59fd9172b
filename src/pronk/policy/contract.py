"""The contract of a policy: all that is needed to run its network.

It is JSON in the entry `pronk.contract` of the metadata of `policy.onnx`; in ONNX Runtime
`json.loads(session.get_modelmeta().custom_metadata_map["pronk.contract"])`.
"""

from __future__ import annotations

import math
import re
from typing import Any

import msgspec
import numpy as np

from pronk.errors import ArtefactError, RobotError
from pronk.names import check_names
from pronk.policy.observation import ACTIONS, HISTORY, MEASURED
from pronk.robots import robot_file_path
from pronk.robots.robot import RobotSpec

SCHEMA = "pronk/policy/1"
METADATA_KEY = "pronk.contract"
GAINS = ("matched", "naive")
"""Where the gains of training came from: `gains.yaml`, or the nominal gains of the real drive."""
COMMANDS = ("vx", "vy", "yaw_rate")
"""The command in order: forward and left [m/s], about the trunk's z [rad/s]."""

_MAX_MAGNITUDES = {
    "default_position": 10.0,
    "action_scale": 10.0,
    "stiffness": 1e4,
    "damping": 1e3,
    "policy_rate_hz": 1e3,
    "timestep_s": 0.1,
    "decimation": 1e3,
    "delay_range_s": 0.5,
    "command_ranges": 20.0,
    "lift_off_velocity": 10.0,
}
"""Largest magnitude of each field, in its unit; all beyond what legged robots do."""

_UNITS = {
    "angular_velocity": "rad/s",
    "projected_gravity": "1",
    "joint_position": "rad",
    "joint_velocity": "rad/s",
    "action": "1",
    "command": "m/s, m/s, rad/s",
}


class ObservationPart(msgspec.Struct, frozen=True, kw_only=True):
    """A named slice of the input "measured"; the slices follow each other in order."""

    name: str
    size: int
    """Numbers in it, all samples together."""
    times_s: tuple[float, ...]
    """Sample times relative to now [s], oldest first as in the vector; of an action, the time of
    the observation that it followed."""
    unit: str


def measured_layout(policy_rate_hz: float) -> tuple[ObservationPart, ...]:
    """Return the layout that this pronk trains and runs with (see `pronk.policy.observation`).

    Joint positions are relative to the default position, actions are outputs of the network, and
    vectors are in the trunk's frame (x forward, y left, z up).
    """
    sample_times_s = tuple((step - HISTORY + 1) / policy_rate_hz for step in range(HISTORY))
    action_times_s = tuple((step - ACTIONS) / policy_rate_hz for step in range(ACTIONS))
    times_s = {
        "joint_position": sample_times_s,
        "joint_velocity": sample_times_s,
        "action": action_times_s,
    }
    parts = []
    for name, indices in MEASURED.items():
        part = ObservationPart(
            name=name, size=len(indices), times_s=times_s.get(name, (0.0,)), unit=_UNITS[name]
        )
        parts.append(part)
    return tuple(parts)


class Contract(
    msgspec.Struct,
    frozen=True,
    kw_only=True,
    forbid_unknown_fields=True,
    tag_field="schema",
    tag=SCHEMA,
):
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
    """Hex SHA-256 of the `gains.yaml` that the gains come from; empty for naive gains, also where
    their ranges and delay come from a file (`ranges_sha256` of `provenance`)."""
    virtual: bool
    """True if the `gains.yaml` of gains or ranges rests on pronk's virtual robot."""
    observation: tuple[ObservationPart, ...]
    policy_rate_hz: float
    timestep_s: float
    """Physics step of training [s]."""
    decimation: int
    """Physics steps per policy step."""
    delay_range_s: tuple[float, float]
    """Command delays trained for [s]."""
    command_ranges: dict[str, tuple[float, float]]
    """Smallest and largest command trained for, by the names in `COMMANDS`."""
    jump: bool
    """True if the network has the input "jump"."""
    lift_off_velocity: float | None
    """Upward velocity of the trunk at lift-off that was trained for [m/s]; None without jump."""
    provenance: dict[str, Any] = {}
    """Phases, iterations, seed and run of its training."""
    versions: dict[str, str] = {}
    """Package to version at training."""

    def __post_init__(self) -> None:
        """Refuse contradictions; the ArtefactError names the field."""
        check_names((self.robot, *self.joint_names), "the contract", ArtefactError)
        self._check_magnitudes()
        self._check_joints()
        _demand(self.gains in GAINS, "gains", self.gains, " or ".join(GAINS))
        is_hash = re.fullmatch("[0-9a-f]{64}", self.gains_sha256) is not None
        may_be_empty = self.gains == "naive" and not self.gains_sha256
        _demand(
            is_hash or may_be_empty,
            "gains_sha256",
            self.gains_sha256,
            "64 hex digits, or empty for naive gains that rest on no file",
        )
        period_s = self.timestep_s * self.decimation
        _demand(
            period_s > 0.0 and math.isclose(period_s * self.policy_rate_hz, 1.0, rel_tol=1e-9),
            "policy_rate_hz",
            self.policy_rate_hz,
            f"that of {self.decimation} physics steps of {self.timestep_s} s",
        )
        commands = tuple(self.command_ranges)
        _demand(commands == COMMANDS, "command_ranges", commands, f"of {', '.join(COMMANDS)}")
        for name, (lower, upper) in self.command_ranges.items():
            _demand_order(f"command_ranges of {name}", lower, upper)
        _demand_order("delay_range_s", *self.delay_range_s)
        _demand(
            self.jump == (self.lift_off_velocity is not None),
            "lift_off_velocity",
            self.lift_off_velocity,
            "a number for a policy that jumps and null for one that does not",
        )

    def _check_magnitudes(self) -> None:
        """Refuse numbers that are not finite or beyond what legged robots do."""
        for name, limit in _MAX_MAGNITUDES.items():
            value = getattr(self, name)
            if value is None:
                continue
            if isinstance(value, dict):
                value = tuple(value.values())
            within = bool((np.abs(np.ravel(value)) <= limit).all())
            _demand(within, name, value, f"finite and within {limit:g} of 0")

    def _check_joints(self) -> None:
        """Refuse another number of values than of joints, and values of an impossible sign."""
        count = len(self.joint_names)
        for name in ("default_position", "action_scale", "stiffness", "damping"):
            values = getattr(self, name)
            _demand(len(values) == count, name, values, f"one number for each of {count} joints")
        for name in ("action_scale", "stiffness"):
            values = getattr(self, name)
            _demand(all(value > 0.0 for value in values), name, values, "positive")
        for name in ("delay_range_s", "damping"):
            values = getattr(self, name)
            _demand(all(value >= 0.0 for value in values), name, values, "not negative")


def to_json(contract: Contract) -> str:
    """Return the contract as JSON, `schema` first."""
    return msgspec.json.encode(contract).decode()


def from_json(text: str, *, source: object) -> Contract:
    """Read what `to_json` wrote; errors begin with `source`."""
    try:
        body = msgspec.json.decode(text)
        # A field of older files: the jump input had to wait for a moment of the stride.
        if isinstance(body, dict) and body.pop("waits_for_stride", False) is not False:
            raise ArtefactError(
                "the policy waits for a moment of its stride before it jumps (waits_for_stride), "
                "which this pronk does not do; train it again."
            )
        return msgspec.convert(body, Contract)
    except ArtefactError as error:
        raise ArtefactError(f"{source}: {error}") from None
    except (msgspec.MsgspecError, RecursionError) as error:
        raise ArtefactError(
            f"{source}: not a contract of schema {SCHEMA!r}, which this pronk reads: {error}."
        ) from None


def policy_robot_name(contract: Contract) -> str:
    """Return the robot of a policy by its name, as `load_robot` takes it.

    Args:
        contract: That of the policy.

    Raises:
        ArtefactError: No robot has that name here, as that of a user who has its files.
    """
    try:
        robot_file_path(contract.robot)
    except RobotError:
        raise ArtefactError(
            f"the policy is for the robot {contract.robot!r}, which pronk does not bring: say "
            "where its files are, as in --robot my_robot/robot.yaml."
        ) from None
    return contract.robot


def check(contract: Contract, robot: RobotSpec, *, gains_sha256: str | None = None) -> None:
    """Refuse a policy that is not for this robot.

    Args:
        contract: That of the policy.
        robot: The robot that the policy is to run.
        gains_sha256: Hash of the `gains.yaml` that the policy must be trained with, if any.

    Raises:
        ArtefactError: A field of the contract contradicts the robot; the message names it.
    """
    expected_values = {
        "robot": robot.name,
        "joint_names": robot.joint_names,
        "policy_rate_hz": robot.policy_rate_hz,
        "timestep_s": robot.timestep_s,
        "decimation": robot.decimation,
    }
    for field, expected in expected_values.items():
        value = getattr(contract, field)
        _demand(
            value == expected, field, value, f"{expected!r}, as {robot.source or robot.name} has it"
        )
    for joint, position in zip(robot.joints, contract.default_position, strict=True):
        lower, upper = joint.range
        _demand(
            lower <= position <= upper,
            f"default_position of {joint.name}",
            position,
            f"within the joint's limits, {lower} to {upper} rad",
        )
    if contract.gains == "naive":
        _check_nominal_gains("stiffness", contract, contract.stiffness, robot)
        _check_nominal_gains("damping", contract, contract.damping, robot)
    if gains_sha256 is not None:
        _demand(
            contract.gains_sha256 == gains_sha256,
            "gains_sha256",
            contract.gains_sha256,
            f"{gains_sha256!r}, that of the given gains",
        )


def _check_nominal_gains(
    name: str, contract: Contract, values: tuple[float, ...], robot: RobotSpec
) -> None:
    """Refuse nominal gains of another drive; matched ones may differ from joint to joint."""
    gains = dict(zip(contract.joint_names, values, strict=True))
    for joint in robot.joints:
        expected = joint.stiffness if name == "stiffness" else joint.damping
        value = gains[joint.name]
        same = math.isclose(value, expected, rel_tol=1e-6)
        _demand(same, f"{name} of {joint.name}", value, f"{expected:g}, that of the drive")


def _demand_order(name: str, lower: float, upper: float) -> None:
    """Refuse a range whose ends are not finite or not in order."""
    _demand(lower <= upper, name, (lower, upper), "finite, the smaller number first")


def _demand(met: bool, name: str, value: object, expected: str) -> None:
    """Raise an ArtefactError unless a condition on a field is met."""
    if not met:
        raise ArtefactError(f"the contract's {name} is {value!r}; it must be {expected}.")
