"""A policy as `pronk deploy` runs it, whoever trained it.

A policy of `pronk train` says all that is needed in its contract. One that was trained elsewhere
says it in Unitree's `deploy.yaml`; what that file leaves open, the delay of training, is unknown.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike

from pronk.arrays import Array
from pronk.errors import ArtefactError
from pronk.files import sha256
from pronk.policy.contract import COMMANDS, check
from pronk.policy.deploy_yaml import RANGE_NAMES, DeployFile, read_deploy_yaml
from pronk.policy.foreign import (
    ForeignPolicy,
    deploy_problems,
    load_foreign_network,
    poses_out_of_range,
)
from pronk.policy.observation import ESTIMATE, Measurement
from pronk.policy.runtime import Inference, load_policy, read_network
from pronk.robots.robot import RobotSpec

UNKNOWN_DELAY_S = (0.0, math.inf)
"""Range of the delay of a policy that does not say which delays it was trained for [s]."""
_SLOWEST_STEP_S = 0.025
"""Longest time between two actions: the servo lets an action expire after 50 ms [s]."""
_FASTEST_STEP_S = 0.002
"""Shortest time between two actions: one state of the robot [s]."""


class DeployablePolicy(Protocol):
    """What the process of a policy needs of it. Joints are in the order of the robot's file."""

    network_s: float
    """Time that the network took for the latest step [s]; NaN before the first."""
    inference: Inference | None
    """Outputs of the latest step; None before the first."""

    @property
    def rate_hz(self) -> float:
        """Steps per second [Hz]."""

    @property
    def start_position(self) -> Array:
        """Joint positions in which it starts [rad], (joints,)."""

    @property
    def command_ranges(self) -> Mapping[str, tuple[float, float]]:
        """Least and greatest command, by the names in `contract.COMMANDS`."""

    @property
    def jumps(self) -> bool:
        """Whether it has a jump input."""

    @property
    def delay_range_s(self) -> tuple[float, float]:
        """Delays that it was trained for [s]; `UNKNOWN_DELAY_S` if it does not say."""

    @property
    def logs_observation(self) -> bool:
        """Whether its observation is laid out as `pronk.policy.observation` says."""

    def provenance(self) -> dict[str, Any]:
        """Return what a log says of it."""

    def sibling(self) -> Self:
        """Return the same network with a history of its own."""

    def reset(self) -> None:
        """Begin anew."""

    def step(self, measurement: Measurement, command: ArrayLike, jump: bool = False) -> Array:
        """Do one step and return joint position targets [rad], (joints,)."""


class ForeignDeployment:
    """A policy that was trained elsewhere, as `pronk deploy` runs it."""

    jumps = False
    delay_range_s = UNKNOWN_DELAY_S
    logs_observation = False

    def __init__(self, policy: ForeignPolicy, provenance: Mapping[str, Any]) -> None:
        """Wrap a policy.

        Args:
            policy: The policy.
            provenance: What a log says of it.
        """
        self._policy = policy
        self._provenance = dict(provenance)
        self.network_s = math.nan
        self.inference: Inference | None = None

    @property
    def rate_hz(self) -> float:
        """Steps per second [Hz]."""
        return 1.0 / self._policy.deploy.step_s

    @property
    def start_position(self) -> Array:
        """Targets at action zero [rad], (joints,)."""
        return self._policy.start_position

    @property
    def command_ranges(self) -> Mapping[str, tuple[float, float]]:
        """Least and greatest command of `deploy.yaml`, by the names in `contract.COMMANDS`."""
        stated = self._policy.deploy.command_ranges
        ranges = {}
        for name, stated_name in zip(COMMANDS, RANGE_NAMES, strict=True):
            ranges[name] = stated[stated_name]
        return ranges

    def provenance(self) -> dict[str, Any]:
        """Return what a log says of it."""
        return dict(self._provenance)

    def sibling(self) -> Self:
        """Return the same network with a history of its own."""
        policy = ForeignPolicy(self._policy.network, self._policy.deploy)
        return type(self)(policy, self._provenance)

    def reset(self) -> None:
        """Begin anew: the next measurement fills the histories, the past action is zero."""
        self._policy.reset()
        self.inference = None

    def step(self, measurement: Measurement, command: ArrayLike, jump: bool = False) -> Array:
        """Do one step and return joint position targets [rad], (joints,).

        Args:
            measurement: The sensors now.
            command: Forward and left [m/s], yaw rate [rad/s].
            jump: Must be false: these policies have no jump input.

        Raises:
            ArtefactError: The network returned a number that is not finite, or `jump` is true.
        """
        if jump:
            raise ArtefactError("a policy by deploy.yaml has no jump input.")
        begin = time.monotonic()
        target = self._policy.step(measurement, command)
        self.network_s = time.monotonic() - begin
        unknown = {}
        for name, size in ESTIMATE.items():
            unknown[name] = np.full((1, size), np.nan, np.float32)
        action = self._policy.action.astype(np.float32)[None]
        self.inference = Inference(action=action, **unknown)
        return target


def open_policy(path: Path, robot: RobotSpec, deploy: Path | None = None) -> DeployablePolicy:
    """Open a policy that a robot is to run, and check that it fits.

    Args:
        path: The ONNX file.
        robot: The robot.
        deploy: Unitree's `deploy.yaml` of a policy that was trained elsewhere; None for a policy of
            `pronk train`.

    Raises:
        ArtefactError: A file is missing or damaged, or the policy is not for this robot.
        PronkError: ONNX Runtime is not installed.
    """
    if deploy is None:
        policy = load_policy(path)
        check(policy.contract, robot)
        return policy
    deploy_file = read_deploy_yaml(deploy)
    _check_deploy(deploy_file, robot, deploy)
    foreign = ForeignPolicy(load_foreign_network(path, deploy_file), deploy_file)
    provenance = {
        "sha256": hashlib.sha256(read_network(path)).hexdigest(),
        "deploy": {"file": str(deploy), "sha256": sha256(deploy)},
        "gains": "deploy.yaml's",
        "delay_range_s": None,
        "jump": False,
        "stiffness": list(deploy_file.stiffness),
        "damping": list(deploy_file.damping),
    }
    return ForeignDeployment(foreign, provenance)


def _check_deploy(deploy: DeployFile, robot: RobotSpec, path: Path) -> None:
    """Refuse a `deploy.yaml` that must not be run on a robot: ArtefactError."""
    deploy_problems(deploy, robot)  # raises for another number of joints
    for problem in poses_out_of_range(deploy, robot):
        raise ArtefactError(f"{path}: {problem}; `pronk policy check` names the order that fits.")
    for name in RANGE_NAMES:
        if name not in deploy.command_ranges:
            raise ArtefactError(
                f"{path}: commands.base_velocity.ranges has no {name}, so that a stick has no "
                f"scale; write the ranges that the policy was trained for: {', '.join(RANGE_NAMES)}"
                "."
            )
        low, high = deploy.command_ranges[name]
        if not (math.isfinite(low) and math.isfinite(high)):
            raise ArtefactError(
                f"{path}: commands.base_velocity.ranges.{name} is {low:g} to {high:g}; expected "
                "two finite numbers."
            )
    if not _FASTEST_STEP_S <= deploy.step_s <= _SLOWEST_STEP_S:
        raise ArtefactError(
            f"{path}: step_dt is {deploy.step_s:g} s; `pronk deploy` runs policies of "
            f"{_FASTEST_STEP_S:g} to {_SLOWEST_STEP_S:g} s, because an action expires after 50 ms."
        )
    gains = (
        ("stiffness", deploy.stiffness, robot.limits.stiffness),
        ("damping", deploy.damping, robot.limits.damping),
    )
    for name, values, limit in gains:
        if max(values) > limit:
            raise ArtefactError(
                f"{path}: {name} is up to {max(values):g}; the limit of {robot.name} is {limit:g} "
                "(limits in its robot.yaml)."
            )
