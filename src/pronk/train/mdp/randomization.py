"""What differs from robot to robot, and from moment to moment, in training (paper D1 to D10).

What a real robot has once, a simulated robot has once: friction of its feet, gains, shank lengths
and trunk mass are drawn when the environments are built and kept (`draws`). The command delay is
drawn per episode (`actions`), the length of the policy's step per step, noise per observation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, Self

from mjlab.envs.mdp import push_by_setting_velocity
from mjlab.managers.event_manager import EventTermCfg
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.utils.noise import UniformNoiseCfg
from torch import Tensor, empty_like

from pronk.errors import PronkError
from pronk.robots.robot import RobotSpec
from pronk.train.gains import TrainingGains
from pronk.train.mdp.draws import (
    ENTITY,
    FEET,
    FOOT_SITES,
    SHANKS,
    Range,
    Shape,
    draw_base_mass,
    draw_decimation,
    draw_friction,
    draw_gains,
    draw_shank_length,
    draw_supply,
)


@dataclass(frozen=True, kw_only=True)
class Randomization:
    """Ranges of what is drawn. All draws are uniform."""

    decimation: tuple[int, int] = (-2, 2)
    """Physics steps added to each policy step, one draw for all robots (D1, reading A1)."""
    friction: Range | None = (0.05, 3.0)
    """Sliding friction of a robot's feet on the floor (D2); None leaves the model's."""
    gains: Shape | Literal["off"] = "box"
    """Stiffness and damping of every joint, drawn independently (D3, D4): uniform in the box
    nominal +- range, or uniform in the ellipse that covers the matched joints, of the group."""
    shank_length: Range | None = (0.18, 0.20)
    """Knee axis to foot centre, every leg its own [m] (D5); None leaves the model's."""
    base_mass: Range = (-0.4, 1.6)
    """Mass added to the trunk [kg], its inertia scaled alike (D6)."""
    bus_voltage: Range | None = (22.2, 25.2)
    """Voltage of a robot's battery at no load [V]: six lithium cells, 3.7 V (their nominal, and all
    but empty) to 4.2 V (full). Not in the paper; None holds the rated voltage whatever is drawn."""
    bus_resistance: Range = (0.03, 0.1)
    """Of battery and wires [ohm]: six cells of 5 to 12 milliohm, the rest plugs and wires. A jump
    draws a kilowatt and more, which costs 7 V at most. Not in the paper."""
    delay: int = 1
    """Half-width of the command delay about the matched one [physics steps], drawn per episode
    and never below 0. Not in the paper."""
    position_noise: float = 0.05
    """Half-width of the noise of measured joint positions [rad] (D7)."""
    velocity_noise: float = 0.5
    """Half-width of the noise of measured joint velocities [rad/s] (D8)."""
    angular_velocity_noise: float = 0.2
    """Half-width of the noise of the measured angular velocity [rad/s] (D9)."""
    gravity_noise: float = 0.05
    """Half-width of the noise of projected gravity (D10)."""
    push_interval_s: Range = (5.0, 10.0)
    """Time between pushes of a robot [s]. The paper has none; these are mild."""
    push_velocity: float = 0.3
    """Half-width of what a push adds to the trunk's velocity along world x and y [m/s]."""
    push_yaw_rate: float = 0.3
    """Half-width of what a push adds to the yaw rate [rad/s]."""

    def __post_init__(self) -> None:
        """Refuse impossible ranges.

        Raises:
            PronkError: A range falls, or reaches where physics does not.
        """
        for name in (
            "decimation",
            "friction",
            "shank_length",
            "base_mass",
            "bus_voltage",
            "bus_resistance",
            "push_interval_s",
        ):
            span = getattr(self, name)
            if span is not None and not span[0] <= span[1]:
                raise PronkError(f"{name} {span[0]} to {span[1]}; a range must not fall.")
        for name in ("friction", "shank_length", "bus_voltage", "push_interval_s"):
            span = getattr(self, name)
            if span is not None and not span[0] > 0.0:
                raise PronkError(f"{name} begins at {span[0]}; it must be positive.")
        if not self.bus_resistance[0] >= 0.0:
            raise PronkError(
                f"bus_resistance begins at {self.bus_resistance[0]}; it must not be negative."
            )
        for name in ("delay", *_NOISES.values(), "push_velocity", "push_yaw_rate"):
            if not getattr(self, name) >= 0.0:
                raise PronkError(f"{name} is {getattr(self, name)}; it must not be negative.")
        if self.gains not in ("box", "ellipsoid", "off"):
            raise PronkError(f"gains are drawn {self.gains!r}; choose box, ellipsoid or off.")

    @classmethod
    def paper(cls) -> Self:
        """What the paper draws, and the delay and the pushes it does not have."""
        return cls()

    @classmethod
    def none(cls) -> Self:
        """Nothing drawn: the nominal robot, undisturbed, with exact measurements."""
        return cls(
            decimation=(0, 0),
            friction=None,
            gains="off",
            shank_length=None,
            base_mass=(0.0, 0.0),
            bus_voltage=None,
            bus_resistance=(0.0, 0.0),
            delay=0,
            position_noise=0.0,
            velocity_noise=0.0,
            angular_velocity_noise=0.0,
            gravity_noise=0.0,
            push_velocity=0.0,
            push_yaw_rate=0.0,
        )


class UniformNoise(UniformNoiseCfg):
    """mjlab's, drawn in place: two operations where it takes five, twenty times a step."""

    def apply(self, data: Tensor) -> Tensor:
        """Add noise to a measurement of any shape."""
        return empty_like(data).uniform_(self.n_min, self.n_max).add_(data)


_NOISES = {
    "position": "position_noise",
    "velocity": "velocity_noise",
    "angular_velocity": "angular_velocity_noise",
    "gravity": "gravity_noise",
}


def noise(randomization: Randomization) -> dict[str, UniformNoiseCfg | None]:
    """Noise by measurement: position, velocity, angular_velocity, gravity; None where none."""
    half = {name: getattr(randomization, field) for name, field in _NOISES.items()}
    return {
        name: UniformNoise(n_min=-width, n_max=width) if width > 0.0 else None
        for name, width in half.items()
    }


def delay_steps(
    robot: RobotSpec, gains: TrainingGains, randomization: Randomization
) -> tuple[int, int]:
    """Smallest and largest command delay, for `pronk.train.mdp.actions` [physics steps]."""
    centre = round(gains.delay_s / robot.timestep_s)
    return max(0, centre - randomization.delay), centre + randomization.delay


def events(
    robot: RobotSpec, gains: TrainingGains, randomization: Randomization
) -> dict[str, EventTermCfg]:
    """Event terms of mjlab for all draws but delay and noise.

    They set no state of the robot at a reset.

    Args:
        robot: The robot, in the scene under the name `robot`.
        gains: Nominals and ranges of the gains.
        randomization: What is drawn.

    Raises:
        PronkError: A policy step could have no physics step, or the gains have no ellipsoid.
    """
    r = randomization
    terms: dict[str, EventTermCfg] = {}
    if r.friction is not None:
        terms["friction"] = _startup(draw_friction, span=r.friction, feet=_geoms(FEET))
    if r.gains != "off":
        if r.gains == "ellipsoid":
            _check_ellipsoids(gains)
        ranges = {joint.name: gains.groups[joint.group] for joint in robot.joints}
        terms["gains"] = _startup(draw_gains, ranges=ranges, shape=r.gains)
    if r.shank_length is not None:
        terms["shank_length"] = _startup(
            draw_shank_length,
            span=r.shank_length,
            feet=_geoms(FEET),
            shanks=_geoms(SHANKS),
            sites=SceneEntityCfg(ENTITY, site_names=FOOT_SITES),
        )
    if r.base_mass != (0.0, 0.0):
        base = SceneEntityCfg(ENTITY, body_names=robot.base_body)
        terms["base_mass"] = _startup(draw_base_mass, span=r.base_mass, base=base)
    if r.bus_voltage is not None:
        terms["supply"] = _startup(
            draw_supply,
            voltage=r.bus_voltage,
            resistance=r.bus_resistance,
            rated=robot.joints[0].drive.bus_voltage,
        )
    if r.decimation != (0, 0):
        if robot.decimation + r.decimation[0] < 1:
            raise PronkError(
                f"decimation {robot.decimation} with {r.decimation[0]} added leaves a policy step "
                "without a physics step; it must leave 1 or more."
            )
        params = {"nominal": robot.decimation, "span": r.decimation}
        terms["decimation"] = EventTermCfg(func=draw_decimation, mode="step", params=params)
    if r.push_velocity > 0.0 or r.push_yaw_rate > 0.0:
        width = {"x": r.push_velocity, "y": r.push_velocity, "yaw": r.push_yaw_rate}
        terms["push"] = EventTermCfg(
            func=push_by_setting_velocity,
            mode="interval",
            interval_range_s=r.push_interval_s,
            params={"velocity_range": {axis: (-half, half) for axis, half in width.items()}},
        )
    return terms


def _startup(func: Any, **params: Any) -> EventTermCfg:
    return EventTermCfg(func=func, mode="startup", params=params)


def _geoms(pattern: str) -> SceneEntityCfg:
    return SceneEntityCfg(ENTITY, geom_names=pattern)


def _check_ellipsoids(gains: TrainingGains) -> None:
    for group, g in gains.groups.items():
        (a, b), (c, d) = g.ellipsoid
        if not (a > 0.0 and a * d - b * c > 0.0):
            raise PronkError(
                f"{gains.name} gains have no ellipsoid for {group}; draw gains in the box, or "
                "use a gains.yaml whose joints differ."
            )
        reach = (g.ellipsoid_center[0] - math.sqrt(a), g.ellipsoid_center[1] - math.sqrt(d))
        if not min(reach) > 0.0:
            raise PronkError(
                f"the ellipsoid of {group} reaches down to stiffness {reach[0]:g} and damping "
                f"{reach[1]:g}; both must stay above zero: draw gains in the box."
            )
