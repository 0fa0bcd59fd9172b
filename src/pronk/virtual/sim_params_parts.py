"""The parts of a set of parameters: a joint, what the joints share, the trunk, the attitude filter.

Everything of a joint is in joint coordinates (through the gear) unless its name says motor.
Vectors are in the trunk's frame: x forward, y left, z up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from pronk.errors import RobotError
from pronk.virtual.bounds import Bounds, check_bounds

_INF = math.inf


@dataclass(frozen=True, kw_only=True)
class JointParams:
    """One joint of the virtual robot."""

    torque_scale: float
    """Torque that the motor gives per torque that its drive believes to give [1]."""
    link_inertia_scale: float
    """Mass and inertia of the link this joint moves, relative to the model's [1]."""
    rotor_inertia: float
    """Inertia of the rotor about its own axis, motor side [kg m^2]."""
    belt_stiffness: float
    """Between rotor (reflected) and link [N m/rad]."""
    belt_damping: float
    """Between rotor (reflected) and link [N m s/rad]."""
    coulomb: float
    """Dry friction of the rotor while it slips [N m]."""
    breakaway: float
    """Dry friction at the onset of slip; the Stribeck peak, not below `coulomb` [N m]."""
    stribeck_speed: float
    """Speed at which the peak has fallen to 1/e of its height over `coulomb` [rad/s]."""
    presliding_stiffness: float
    """Of the bristles before slip, LuGre sigma_0 [N m/rad]."""
    presliding_damping: float
    """Of the bristles, LuGre sigma_1 [N m s/rad]."""
    viscous: float
    """Viscous friction of the rotor [N m s/rad]."""
    encoder_offset: float
    """Reading minus true angle; the drive closes its loop on the reading [rad]."""

    def __post_init__(self) -> None:
        """Refuse a joint that cannot exist.

        Raises:
            RobotError: A value is out of its physical bounds.
        """
        check_bounds(self, _JOINT_BOUNDS)
        if self.breakaway < self.coulomb:
            raise RobotError(
                f"breakaway is {self.breakaway:g}, below coulomb = {self.coulomb:g}; "
                "friction at the onset of slip is never below that while slipping."
            )


@dataclass(frozen=True, kw_only=True)
class MachineParams:
    """What the joints share: timing, supply, sensors, the stand."""

    command_delay_s: float
    """From sending a command to the drives acting on it [s]."""
    measurement_delay_s: float
    """From the instant a state was measured to its timestamp [s]."""
    sampling_jitter_s: float
    """Standard deviation of the sampling instant about its tick; the timestamps tell it [s]."""
    timestamp_error_s: float
    """Standard deviation of the timestamp about the sampling instant plus delay [s]."""
    drive_lag_s: float
    """Time constant from what a drive asks for to what its motor gives: sampling, averaging of
    the speed, current loop [s]."""
    bus_voltage: float
    """Open-circuit voltage of the battery [V]."""
    bus_resistance: float
    """Of battery and wiring [ohm]."""
    encoder_bits: int
    """Of the absolute encoder on each rotor, motor side [bit per revolution]."""
    velocity_window_s: float
    """Span over which a drive differentiates its encoder [s]."""
    velocity_noise: float
    """White, standard deviation [rad/s]."""
    position_noise: float
    """Coloured (vibration of the encoder mount), standard deviation [rad]."""
    position_noise_corner_hz: float
    """Corner of the first-order low-pass that colours it [Hz]."""
    torque_noise: float
    """White, of the current measurement as torque, standard deviation [N m]."""
    gyro_noise: float
    """White, standard deviation per sample [rad/s]."""
    gyro_bias: tuple[float, float, float]
    """[rad/s]"""
    accelerometer_noise: float
    """White, standard deviation per sample [m/s^2]."""
    accelerometer_bias: tuple[float, float, float]
    """[m/s^2]"""
    clamp_stiffness: float
    """Of the fixture that holds a clamped link; no fixture is rigid [N m/rad]."""
    clamp_damping: float
    """[N m s/rad]"""
    stand_stiffness: float
    """Of the stand under the body, about each axis; .inf is rigid [N m/rad]."""
    stand_damping: float
    """[N m s/rad]; of no effect with a rigid stand."""

    def __post_init__(self) -> None:
        """Refuse a machine that cannot exist.

        Raises:
            RobotError: A value is out of its physical bounds.
        """
        check_bounds(self, _MACHINE_BOUNDS)


@dataclass(frozen=True, kw_only=True)
class TrunkParams:
    """How the trunk differs from the model's; of no effect on the bench."""

    mass_offset: float = 0.0
    """Added to the trunk's mass; its inertia grows alike [kg]."""
    com_offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Added to its centre of mass [m]."""
    inertia_scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """Its principal moments (about x, y, z) relative to the model's, beyond `mass_offset` [1].
    Together they must still be those of a body: the largest not above the sum of the others."""

    def __post_init__(self) -> None:
        """Refuse a trunk that cannot exist.

        Raises:
            RobotError: A value is out of its physical bounds.
        """
        check_bounds(self, _TRUNK_BOUNDS)


@dataclass(frozen=True, kw_only=True)
class AttitudeParams:
    """How far the machine's own attitude filter is off."""

    bias: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Constant part, as a small rotation about the trunk's axes [rad]."""
    noise: float = 0.0
    """Slowly varying part about each axis, standard deviation [rad]."""
    noise_corner_hz: float = 0.3
    """Corner of the first-order low-pass that colours it [Hz]."""
    yaw_drift: float = 0.0
    """Rate at which the heading, which nothing corrects, runs away [rad/s]."""

    def __post_init__(self) -> None:
        """Refuse a filter that cannot exist.

        Raises:
            RobotError: A value is out of its physical bounds.
        """
        check_bounds(self, _ATTITUDE_BOUNDS)


_JOINT_BOUNDS: Bounds = {
    # A body or a motor cannot be nothing; tenfold is a slip of the pen, not a machine.
    "torque_scale": (0.1, 10.0),
    "link_inertia_scale": (0.1, 10.0),
    "rotor_inertia": (1e-9, 1.0),
    "belt_stiffness": (1.0, 1e5),
    "belt_damping": (0.0, 100.0),
    "coulomb": (0.0, 100.0),
    "breakaway": (0.0, 100.0),
    "stribeck_speed": (1e-6, 100.0),
    "presliding_stiffness": (1e-3, 1e6),
    "presliding_damping": (0.0, 100.0),
    "viscous": (0.0, 100.0),
    "encoder_offset": (-0.1, 0.1),
}
_MACHINE_BOUNDS: Bounds = {
    "command_delay_s": (0.0, 0.5),
    "measurement_delay_s": (0.0, 0.5),
    "sampling_jitter_s": (0.0, 1e-3),
    "timestamp_error_s": (0.0, 1e-3),
    "drive_lag_s": (1e-6, 0.1),
    "bus_voltage": (1.0, 1e3),
    "bus_resistance": (0.0, 10.0),
    "encoder_bits": (4, 32),
    "velocity_window_s": (1e-6, 0.1),
    "velocity_noise": (0.0, 10.0),
    "position_noise": (0.0, 0.1),
    "position_noise_corner_hz": (0.1, 1e5),
    "torque_noise": (0.0, 10.0),
    "gyro_noise": (0.0, 10.0),
    "gyro_bias": (-1.0, 1.0),
    "accelerometer_noise": (0.0, 10.0),
    "accelerometer_bias": (-5.0, 5.0),
    "clamp_stiffness": (1.0, 1e5),
    "clamp_damping": (0.0, 1e3),
    "stand_stiffness": (100.0, _INF),
    "stand_damping": (0.0, 1e3),
}
_TRUNK_BOUNDS: Bounds = {
    "mass_offset": (-50.0, 50.0),
    "com_offset": (-0.2, 0.2),
    "inertia_scale": (0.1, 10.0),
}
_ATTITUDE_BOUNDS: Bounds = {
    "bias": (-0.5, 0.5),
    "noise": (0.0, 0.5),
    "noise_corner_hz": (1e-3, 1e3),
    "yaw_drift": (-1.0, 1.0),
}
