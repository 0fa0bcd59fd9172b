"""Limits of the safety filter: those of a robot, and those that hold for any robot.

`Limits.of` takes the ranges, drives and operating limits of a robot's file. The other groups have
the values that were measured with the virtual Mini Cheetah: 10.02 h of walking, running and 8,665
jumps without a false alarm (`python -m benchmarks supervision`, docs/evidence/hardware.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from pronk.arrays import Array
from pronk.deploy.runtime.posture import LegKinematics, leg_kinematics
from pronk.errors import RobotError
from pronk.robots.limits import OperatingLimits
from pronk.robots.motor import winding_loss
from pronk.robots.robot import RobotSpec

VOLTAGE_SHARE = 0.55
"""Least bus voltage of a robot whose file states none, as a share of the nominal: lithium cells at
2.5 V, below which they are damaged, of a nominal 3.6 to 4 V still give 0.63 to 0.69. Take-offs pull
it lower for some milliseconds."""


FULL_CELL = 4.2 / 3.6
"""Voltage of a full lithium cell over the nominal one, with which no-load speeds are stated."""
IMPACT = 1.2
"""Share of the no-load speed to which impacts drive a joint."""
SPEED_SHARE = FULL_CELL * IMPACT
"""Largest measured speed of a joint as a share of its no-load speed at nominal voltage. With 1.2
alone, 18.8 rad/s, four of 242 jumps of a virtual Go2 at 27 to 31 V ended in damping: its knees
reach 19.6 rad/s at touchdown (docs/evidence/go2.md)."""


def _require_positive(group: str, numbers: Mapping[str, float]) -> None:
    """Raise a RobotError for a limit that is not positive and finite."""
    for name, number in numbers.items():
        if not 0.0 < number < math.inf:
            raise RobotError(f"{group}.{name} is {number}; it must be positive and finite.")


@dataclass(frozen=True, kw_only=True)
class JointLimits:
    """Limits and constants of the joints. Arrays have the shape (joints,), in file order."""

    names: tuple[str, ...]
    """Names of the joints."""
    low: Array
    """Lower mechanical limit [rad]."""
    high: Array
    """Upper mechanical limit [rad]."""
    speed: Array
    """Largest measured speed [rad/s]."""
    torque: Array
    """Largest commanded torque [N m]."""
    measured_torque: Array
    """Largest measured torque [N m]; infinite where it is not checked: a policy's landings exceed
    the commanded one for some milliseconds."""
    stall: Array
    """Torque at standstill with the nominal bus voltage across the winding [N m]."""
    no_load: Array
    """Speed at which that torque is zero [rad/s]."""
    loss: Array
    """Winding loss per square of the joint's torque [W / (N m)^2]."""
    felt: Array
    """Change of the commanded torque that a joint shows by a bit at least [N m]."""

    def __post_init__(self) -> None:
        """Refuse arrays of another shape, and numbers that are not finite."""
        arrays = {
            "low": self.low,
            "high": self.high,
            "speed": self.speed,
            "torque": self.torque,
            "stall": self.stall,
            "no_load": self.no_load,
            "loss": self.loss,
            "felt": self.felt,
        }
        count = len(self.names)
        for name, values in arrays.items():
            if np.shape(values) != (count,) or not np.isfinite(values).all():
                raise RobotError(f"JointLimits.{name} is {values}; expected {count} numbers.")


@dataclass(frozen=True, kw_only=True)
class AgeLimits:
    """How old states and commands may be."""

    hold_s: float = 0.02
    """Age of the state above which the last target is held [s]."""
    damp_s: float = 0.05
    """Age of the state above which a command is a fault, `NO_STATE`, that damps the joints [s]."""
    latch_s: float = 0.1
    """Age of the state above which a command is a latched fault, `STATE_LOST`, instead [s].

    While `NO_STATE` damps there is no command to judge, so a state that grows old tick by tick does
    not reach this limit. It is met if the age passes from less than `damp_s` to more than this
    between two ticks, or when the robot is stood up again before states come.
    """
    future_s: float = 0.005
    """A state or command stamped farther ahead than this is of another clock [s]."""
    held_s: float = 0.1
    """Longest time that targets are held in any second [s]."""
    expiry_s: float = 0.05
    """Longest time that any command is repeated, whatever its own validity [s]."""
    lag: float = 30.0
    """Largest number of states, at `LAG_RATE_HZ`, between the newest one and the one that a command
    was computed from: three policy steps."""

    def __post_init__(self) -> None:
        """Refuse limits that limit nothing, and ages that fall from hold to latch."""
        _require_positive(
            "AgeLimits",
            {
                "hold_s": self.hold_s,
                "damp_s": self.damp_s,
                "latch_s": self.latch_s,
                "future_s": self.future_s,
                "held_s": self.held_s,
                "expiry_s": self.expiry_s,
                "lag": self.lag,
            },
        )
        if not self.hold_s <= self.damp_s <= self.latch_s:
            raise RobotError(
                f"ages {self.hold_s}, {self.damp_s}, {self.latch_s} s to hold, damp and latch; "
                "they must not fall."
            )


LAG_RATE_HZ = 500.0
"""States per second of which `AgeLimits.lag` counts."""


@dataclass(frozen=True, kw_only=True)
class BlockedLimits:
    """How long targets may be limited by torque."""

    clipped_s: float = 0.3
    """Longest time that targets are limited by torque without a break [s]: 1.7 times the longest
    of a jumping policy (0.180 s in 2,538 jumps)."""
    blocked_s: float = 0.2
    """Longest time that the target of one joint is limited, in one direction, without its moving by
    `motion` [s]. One take-off of 8,677 jumps took 0.146 s, all others 0.086 s at most; in 8,665
    other jumps it was 0.100 s at most."""
    motion: float = 0.05
    """Motion that counts [rad]; most jumps limit a joint for 0.12 s, in which it moves by 0.7."""

    def __post_init__(self) -> None:
        """Refuse limits that limit nothing."""
        _require_positive(
            "BlockedLimits",
            {"clipped_s": self.clipped_s, "blocked_s": self.blocked_s, "motion": self.motion},
        )


@dataclass(frozen=True, kw_only=True)
class ResponseLimits:
    """How little joints may respond to their targets; `pronk.deploy.runtime.response`."""

    push_share: float = 0.45
    """Commanded torque that a joint must follow, as a share of its effort limit."""
    pushed_s: float = 0.35
    """Longest time for which a joint is pushed so without following [s]: 1.4 times the longest of
    3.0 h and 2,538 jumps of the virtual Mini Cheetah, 0.25."""
    far: float = 0.8
    """Motion of a target in 0.4 s that a joint must follow [rad]."""
    still: float = 0.01
    """Least motion of the joint then [rad]; the least measured, in 0.25 s, is 0.033."""
    low_s: float = 0.12
    """Longest time for which the trunk may be collapsed [s]. In the crouch of one of 361 jumps a
    Go2's was for more than 0.06 s (docs/evidence/go2.md)."""

    def __post_init__(self) -> None:
        """Refuse limits that limit nothing."""
        _require_positive(
            "ResponseLimits",
            {
                "push_share": self.push_share,
                "pushed_s": self.pushed_s,
                "far": self.far,
                "still": self.still,
                "low_s": self.low_s,
            },
        )


@dataclass(frozen=True, kw_only=True)
class SensorLimits:
    """How far the sensors may contradict each other; `pronk.deploy.runtime.supervision`."""

    repeat_s: float = 0.04
    """Longest time that attitude, gyro or accelerometer may repeat: an attitude of LCM may be 20 ms
    old. Also the time from which a constant position or velocity counts [s]."""
    attitude: float = 0.06
    """Largest difference of attitude and integral of the gyro [rad]; 1.6 times the largest of
    10.02 h, 0.037."""
    turned: float = 0.03
    """Integral of the gyro from which the attitude must have moved too [rad]."""
    stuck_share: float = 0.25
    """Least path of the attitude, as a share of the integral of the gyro; the least measured is
    0.86."""
    upright: float = 0.5
    """Largest angle between the mean specific force and the attitude's vertical [rad]; 1.9 times
    the largest of 10.02 h, 0.26."""
    encoder: float = 0.18
    """Largest difference of position and integral of velocity [rad]; the largest is 0.01, with 30 %
    of the states lost too."""
    moved: float = 0.005
    """Largest range of the integral of velocity at a constant position, or the reverse [rad]: three
    steps of an encoder of 12 bits."""
    drift: float = 0.035
    """Largest difference of position and integral of velocity over half a second, of states that
    arrived on time [rad]; 2.5 times the largest of 3.0 h, 0.0141."""
    others_moved: float = 0.05
    """Largest sum of the displacements of other joints while one is constant for `repeat_s` [rad];
    the largest measured is 0.003, with encoders of 12 bits without noise."""
    clock_s: float = 0.2
    """Largest difference of the robot's clock and the times of arrival over a second [s]."""
    restarts: int = 4
    """Largest number of times in a row that the comparison of states begins anew."""

    def __post_init__(self) -> None:
        """Refuse limits that limit nothing."""
        _require_positive(
            "SensorLimits",
            {
                "repeat_s": self.repeat_s,
                "attitude": self.attitude,
                "turned": self.turned,
                "stuck_share": self.stuck_share,
                "upright": self.upright,
                "encoder": self.encoder,
                "moved": self.moved,
                "drift": self.drift,
                "others_moved": self.others_moved,
                "clock_s": self.clock_s,
                "restarts": self.restarts,
            },
        )


@dataclass(frozen=True, kw_only=True)
class Limits:
    """All limits of the safety filter for one robot."""

    joints: JointLimits
    """Limits and constants of the joints."""
    operating: OperatingLimits = field(default_factory=OperatingLimits)
    """Limits of commands and measurements from the robot's file."""
    ages: AgeLimits = field(default_factory=AgeLimits)
    """Ages of states and commands."""
    blocked: BlockedLimits = field(default_factory=BlockedLimits)
    """Times for which targets may be limited by torque."""
    sensors: SensorLimits = field(default_factory=SensorLimits)
    """Contradictions of the sensors."""
    response: ResponseLimits = field(default_factory=ResponseLimits)
    """How joints respond to their targets."""
    legs: LegKinematics | None = None
    """Geometry of the legs; None for a robot whose height is not judged."""

    def __post_init__(self) -> None:
        """Refuse a margin that leaves no target."""
        span = self.joints.high - self.joints.low
        if not (span > 2.0 * self.operating.margin).all():
            raise RobotError(
                f"OperatingLimits.margin is {self.operating.margin}, which leaves nothing between "
                "the mechanical limits of a joint; make it smaller."
            )

    @property
    def trunk_is_free(self) -> bool:
        """Whether the trunk can move; a hung robot has no limit of its tilt."""
        return math.isfinite(self.operating.tilt)

    @property
    def collapsed(self) -> float:
        """Height of the trunk over its lowest foot below which it has collapsed [m]."""
        return 0.0 if self.legs is None else self.legs.collapsed

    @cached_property
    def far_targets(self) -> tuple[Array, Array]:
        """Lowest and highest targets that are no fault [rad], (joints,) each."""
        beyond = self.operating.far_target
        return self.joints.low - beyond, self.joints.high + beyond

    @cached_property
    def push(self) -> Array:
        """Commanded torque that each joint must follow [N m], (joints,).

        A leg that carries half of the weight needs its length of a shank times that without moving.
        """
        least = 0.0
        if self.legs is not None:
            least = 0.5 * self.legs.weight * self.legs.shank
        return np.maximum(self.response.push_share * self.joints.torque, least)

    @cached_property
    def measured(self) -> tuple[Array, Array]:
        """Least and largest position, velocity, torque and temperature, (4 joints,) each."""
        joints = self.joints
        hottest = np.full_like(joints.low, self.operating.temperature)
        coldest = np.full_like(joints.low, -np.inf)
        smallest = (
            joints.low - self.operating.overrun,
            -joints.speed,
            -joints.measured_torque,
            coldest,
        )
        largest = (
            joints.high + self.operating.overrun,
            joints.speed,
            joints.measured_torque,
            hottest,
        )
        return np.concatenate(smallest), np.concatenate(largest)

    @cached_property
    def gains(self) -> Array:
        """Largest stiffness and damping of a command, (2 joints,)."""
        return np.repeat([self.operating.stiffness, self.operating.damping], len(self.joints.names))

    @classmethod
    def of(cls, robot: RobotSpec) -> Limits:
        """Return the limits of a robot: its ranges, effort limits and operating limits.

        Speeds are `SPEED_SHARE` of the no-load speed. Measured torques are not checked.
        """
        low = []
        high = []
        no_load = []
        torque = []
        stall = []
        loss = []
        felt = []
        for joint in robot.joints:
            drive = joint.drive
            low.append(joint.range[0])
            high.append(joint.range[1])
            no_load.append(drive.no_load_speed)
            torque.append(drive.effort_limit)
            stall.append(drive.stall_torque)
            loss.append(
                winding_loss(
                    1.0,
                    gear_ratio=drive.gear_ratio,
                    torque_constant=drive.torque_constant,
                    stall_torque=drive.stall_torque,
                    bus_voltage=drive.bus_voltage,
                )
            )
            # From one direction of slip to the other dry friction takes up twice its size; that
            # again for a drive whose friction is twice the nominal.
            felt.append(0.05 * drive.effort_limit + 4.0 * drive.frictionloss)
        joints = JointLimits(
            names=robot.joint_names,
            low=np.array(low, dtype=float),
            high=np.array(high, dtype=float),
            speed=SPEED_SHARE * np.array(no_load),
            torque=np.array(torque),
            measured_torque=np.full(len(torque), np.inf),
            stall=np.array(stall),
            no_load=np.array(no_load),
            loss=np.array(loss, dtype=float),
            felt=np.array(felt),
        )
        operating = robot.limits
        if operating.bus_voltage == 0.0:
            nominal = max(joint.drive.bus_voltage for joint in robot.joints)
            operating = replace(operating, bus_voltage=VOLTAGE_SHARE * nominal)
        return cls(joints=joints, operating=operating, legs=leg_kinematics(robot))
