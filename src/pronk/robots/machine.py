"""The interface to a machine, real or virtual.

Times are the machine's own monotonic clock in seconds. Joints are in file order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np

from pronk.arrays import Array
from pronk.errors import HardwareError

TorqueKind = Literal["measured", "computed", "absent"]


class RefusedError(HardwareError):
    """A message that cannot be used; `reason` is the label under which it is counted."""

    def __init__(self, reason: str, sentence: str) -> None:
        super().__init__(sentence)
        self.reason = reason


@dataclass(frozen=True, kw_only=True)
class State:
    """Measurement of all sensors at one instant. Arrays of joints have shape (joints,)."""

    time: float  # measured timestamp [s]
    sequence: int  # counts states from 0; a jump means states were lost
    position: Array  # [rad]
    velocity: Array  # [rad/s]
    torque: Array  # as the drives report it [N m]
    gyro: Array  # angular velocity of the trunk in its own frame [rad/s], shape (3,)
    accelerometer: Array  # specific force of the trunk in its own frame [m/s^2], shape (3,)
    bus_voltage: float  # [V]; NaN where the wire carries none
    # Trunk to world by the machine's own attitude filter, unit quaternion w, x, y, z. Its yaw has
    # an arbitrary zero.
    orientation: Array = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0]))
    robot_time: float | None = None  # the robot's own [s]; None where the wire carries none
    temperature: Array | None = None  # of the motors [deg C]; None where the wire carries none
    remote: bytes = b""  # of the robot's wireless remote, as on the wire; empty where it has none


@dataclass(frozen=True, kw_only=True)
class Command:
    """Targets of the drives until the next command or until it expires; arrays (joints,)."""

    position: Array  # [rad]
    stiffness: Array  # [N m/rad]
    damping: Array  # [N m s/rad]; the target velocity is zero (reading A9)
    sequence: int = 0  # counts commands; the number on the wire, where there is one
    state_sequence: int = -1  # `State.sequence` of the state it was computed from; -1 for none
    made: float = 0.0  # when it was computed, on the machine's clock [s]
    valid_for: float = math.inf  # time after `made` at which it expires and damping follows [s]


def damping_command(joints: int, damping: float = 1.0) -> Command:
    """A command without stiffness. At 1 N m s/rad a Mini Cheetah sinks in about 1 s."""
    zeros = np.zeros(joints)
    return Command(position=zeros, stiffness=zeros, damping=zeros + damping)


def check_command(command: Command, joints: int) -> None:
    """Raise HardwareError for a wrong shape, NaN, infinity, negative gain or impossible time."""
    for name in ("position", "stiffness", "damping"):
        values = np.asarray(getattr(command, name))
        if values.shape != (joints,) or not np.isfinite(values).all():
            raise HardwareError(
                f"command.{name} has shape {values.shape} or is not finite; "
                f"expected {(joints,)} finite numbers, one per joint."
            )
        if name != "position" and values.min() < 0.0:
            raise HardwareError(f"command.{name} is negative; the drives accept 0 or more.")
    if not math.isfinite(command.made) or not command.valid_for > 0.0:
        raise HardwareError(
            f"command.made is {command.made} and command.valid_for {command.valid_for}; expected a "
            "finite time [s] and a positive one, which may be infinite."
        )


class Machine(Protocol):
    """A robot that takes commands and reports states. Every link implements this."""

    robot: str
    virtual: bool
    torque_kind: TorqueKind
    """`State.torque` is measured, computed from the command, or absent (zeros)."""
    state_rate_hz: float

    def now(self) -> float:
        """The machine's clock [s]."""

    def connect(self) -> None:
        """Open the link; raise HardwareError unless the machine is ready to move."""

    def latest(self) -> State:
        """The newest state, without waiting."""

    def wait(self, until: float) -> list[State]:
        """Let time pass to `until` [s] on its clock; return the states since the last call."""

    def send(self, command: Command) -> None:
        """Put a command into force."""

    def clamp(self, joints: tuple[str, ...]) -> None:
        """Fix joints mechanically where they are; () frees all. HardwareError if impossible."""

    def damp(self) -> None:
        """Damp the joints without stiffness."""

    def close(self) -> None:
        """Damp and close the link."""
