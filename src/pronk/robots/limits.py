"""Operating limits of a robot: the section `limits` of its `robot.yaml`."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pronk.errors import RobotError


@dataclass(frozen=True, kw_only=True)
class StandingUp:
    """How a robot stands up and sits down, apart from its poses."""

    stiffness: float | None = None
    """Stiffness of all joints from the rise on, until a policy acts, and while it sits down
    [N m/rad]; None for that of the drives, which carries a light robot."""
    damping: float | None = None
    """Damping of all joints with it [N m s/rad]; None for that of the drives."""
    swing: float = 0.15
    """Swing of each leg's last joint in the folded pose towards the default pose and back, to know
    that its encoder is its own [rad]. At 0.15 that of a Mini Cheetah on the ground moves by 0.01 to
    0.02, and any other by 0.47 of that at most, where the motions out and back are averaged: a
    robot that still sinks moves all of them."""
    swing_s: float = 0.15
    """Time of each half of such a swing [s]."""

    def __post_init__(self) -> None:
        """Refuse numbers that are not positive and finite."""
        numbers = {
            "stiffness": self.stiffness,
            "damping": self.damping,
            "swing": self.swing,
            "swing_s": self.swing_s,
        }
        for name, number in numbers.items():
            if number is not None and not 0.0 < number < math.inf:
                raise RobotError(f"StandingUp.{name} is {number}; it must be positive and finite.")


@dataclass(frozen=True, kw_only=True)
class OperatingLimits:
    """Limits of the commands to a robot and of its measurements, for the safety filter.

    The defaults hold for a legged robot of the size of a Mini Cheetah; ranges, speeds and torques
    are those of the joints and drives.
    """

    stiffness: float = 100.0
    """Largest stiffness of a command [N m/rad]."""
    damping: float = 5.0
    """Largest damping of a command [N m s/rad]."""
    margin: float = 0.05
    """Distance that targets keep inwards from both mechanical limits [rad], positive:
    `low + margin <= target <= high - margin`, apart from `target_reach`."""
    horizon_s: float = 0.02
    """Time for which the motion of a joint is extrapolated [s], positive. A joint with
    `position + velocity horizon_s > high - margin` is not driven further up: its target is at most
    its position; below `low + margin`, the target is at least its position."""
    change: float = 1.0
    """Largest change of a target from one tick of the servo to the next, in either direction [rad],
    positive: `|target - target sent a tick ago| <= change`."""
    power_w: float = 5000.0
    """Largest bus power of a command [W], computed from the torques that the drives can give at
    their speeds, with winding losses and without recovery."""
    overrun: float = 0.15
    """Distance beyond a mechanical limit from which a measured position is a fault [rad]."""
    tilt: float = 0.8
    """Largest angle of the trunk's z axis from the vertical [rad]; infinite for a hung robot."""
    temperature: float = 80.0
    """Largest temperature of a motor, where it is measured [deg C]."""
    target_reach: float = 0.0
    """Distance by which targets may lie beyond that, 0 or more [rad]. Drives whose stiffness times
    the distance to a stop is below their torque cannot give that torque otherwise. A joint that
    comes near its stop is still not driven further, by `horizon_s`."""
    far_target: float = 1.0
    """Distance beyond a mechanical limit from which a target is a fault [rad]; nearer ones are
    moved back."""
    bus_voltage: float = 0.0
    """Least bus voltage, where the link carries it [V]; 0 for a share of the drives' nominal."""
    stand: StandingUp = StandingUp()
    """How it stands up and sits down, within these limits."""

    def __post_init__(self) -> None:
        """Refuse limits that limit nothing."""
        numbers = {
            "stiffness": self.stiffness,
            "damping": self.damping,
            "margin": self.margin,
            "horizon_s": self.horizon_s,
            "change": self.change,
            "power_w": self.power_w,
            "overrun": self.overrun,
            "temperature": self.temperature,
            "far_target": self.far_target,
        }
        for name, number in numbers.items():
            if not 0.0 < number < math.inf:
                raise RobotError(
                    f"OperatingLimits.{name} is {number}; it must be positive and finite."
                )
        if not 0.0 <= self.target_reach < self.far_target:
            raise RobotError(
                f"OperatingLimits.target_reach is {self.target_reach}; it must be 0 or more, and "
                f"less than far_target, {self.far_target}."
            )
        if not 0.0 <= self.bus_voltage < math.inf:
            raise RobotError(
                f"OperatingLimits.bus_voltage is {self.bus_voltage}; it must be finite and not "
                "negative."
            )
        if (self.stand.stiffness or 0.0) > self.stiffness:
            raise RobotError(
                f"StandingUp.stiffness is {self.stand.stiffness:g}; the limit is {self.stiffness:g}"
                "."
            )
        if (self.stand.damping or 0.0) > self.damping:
            raise RobotError(
                f"StandingUp.damping is {self.stand.damping:g}; the limit is {self.damping:g}."
            )
        if not self.tilt > 0.0:
            raise RobotError(f"OperatingLimits.tilt is {self.tilt}; it must be positive.")
