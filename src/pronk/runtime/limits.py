"""What a command may never ask of a robot, as numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from pronk.actuator.model import winding_loss
from pronk.errors import RobotError
from pronk.robots.robot import Robot

Array = NDArray[np.float64]

_ARRAYS = ("low", "high", "speed", "torque", "stall", "no_load", "loss")


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Of one robot. Arrays have the shape (joints,), in file order."""

    joints: tuple[str, ...]
    low: Array
    """Mechanical [rad]."""
    high: Array
    """Mechanical [rad]."""
    speed: Array
    """Fastest that a joint may be seen to turn [rad/s]."""
    torque: Array
    """Largest that a command may ask for [N m]."""
    stall: Array
    """Torque at standstill with the nominal bus voltage across the winding [N m]."""
    no_load: Array
    """Speed at which nothing is left of it [rad/s]."""
    loss: Array
    """Winding loss of each joint, per square of its torque [W / (N m)^2]."""
    stiffness: float = 100.0
    """Largest that a command may set; five times what any legged robot of this size runs
    [N m/rad]."""
    damping: float = 5.0
    """Largest that a command may set: the largest that the drives can encode (their protocol's
    range is 0 to 5) [N m s/rad]."""
    margin: float = 0.05
    """Kept between targets and the mechanical limits [rad]."""
    overrun: float = 0.1
    """A joint this far beyond its mechanical limit is a fault: an encoder that slipped [rad]."""
    horizon_s: float = 0.02
    """One policy step: a joint that would leave its limits in it is not driven further out [s]."""
    change: float = 1.0
    """Largest change of a target from one tick of the servo to the next [rad]. The largest steps
    of a jumping policy, 1.9 rad, arrive one tick late."""
    power_w: float = 5000.0
    """Largest bus power that a command may ask for, of what the drives can give at their speeds:
    winding losses counted, nothing recovered [W]. Twelve standing drives at their effort limits
    would take 4.4 kW."""
    tilt: float = 0.8
    """Largest angle of the trunk's z axis from the vertical [rad]; infinite for a hung robot."""
    temperature: float = 80.0
    """Of any motor, where it is measured [deg C]."""
    hold_s: float = 0.02
    """With a state older than this nothing new is asked [s]."""
    damp_s: float = 0.05
    """With a state older than this the joints are damped [s]."""
    latch_s: float = 0.1
    """With a state older than this they stay so until a person says otherwise [s]."""
    future_s: float = 0.005
    """A state or command stamped this far ahead is of another clock [s]."""
    expiry_s: float = 0.05
    """Longest that any command is repeated, whatever it says of itself [s]."""
    lag: int = 30
    """Most states between the newest and the one that a command answers: three policy steps at
    500 Hz."""

    def __post_init__(self) -> None:
        """Refuse limits that limit nothing.

        Raises:
            RobotError: One sentence that names the field.
        """
        for name in _ARRAYS:
            values = getattr(self, name)
            if np.shape(values) != (len(self.joints),) or not np.isfinite(values).all():
                raise RobotError(
                    f"Limits.{name} is {values}; expected {len(self.joints)} finite numbers."
                )
        if not (self.high - self.low > 2.0 * self.margin).all():
            raise RobotError("Limits.margin leaves no room between low and high; make it smaller.")
        for field in fields(self)[1 + len(_ARRAYS) :]:
            value = getattr(self, field.name)
            if not value > 0 or (math.isinf(value) and field.name != "tilt"):
                raise RobotError(f"Limits.{field.name} is {value}; it must be positive.")
        if not self.hold_s <= self.damp_s <= self.latch_s:
            raise RobotError(
                f"ages {self.hold_s}, {self.damp_s}, {self.latch_s} s to hold, damp and latch; "
                "they must not fall."
            )

    @classmethod
    def of(cls, robot: Robot, **changed: float) -> Limits:
        """The robot's own: ranges, effort limits, speeds a fifth above the no-load speed (impacts).

        Args:
            robot: The robot.
            changed: Other values for the scalar fields.
        """
        drives = [joint.drive for joint in robot.joints]
        loss = [
            winding_loss(
                1.0,
                gear_ratio=drive.gear_ratio,
                torque_constant=drive.torque_constant,
                stall_torque=drive.stall_torque,
                bus_voltage=drive.bus_voltage,
            )
            for drive in drives
        ]
        return cls(
            joints=robot.joint_names,
            low=np.array([joint.range[0] for joint in robot.joints]),
            high=np.array([joint.range[1] for joint in robot.joints]),
            speed=np.array([1.2 * drive.no_load_speed for drive in drives]),
            torque=np.array([drive.effort_limit for drive in drives]),
            stall=np.array([drive.stall_torque for drive in drives]),
            no_load=np.array([drive.no_load_speed for drive in drives]),
            loss=np.array(loss, dtype=float),
            **changed,  # type: ignore[arg-type]
        )
