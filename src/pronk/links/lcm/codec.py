"""Bytes to states and commands, and back: pure functions, no sockets.

The wire has no checksum. What can be told from the bytes is refused: another fingerprint, another
length, a number that is not finite, or one that no motor or sensor of such a machine can mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pronk.errors import HardwareError
from pronk.links.lcm import types
from pronk.links.lcm.layout import Layout
from pronk.links.lcm.message import Message, RefusedError
from pronk.links.machine import Command, State

Array = NDArray[np.float64]

# What the motors' CAN messages can carry, motor firmware of bgkatz [rad, N m/rad, N m s/rad].
_MOST_POSITION, _MOST_STIFFNESS, _MOST_DAMPING = 12.5, 500.0, 5.0
# Beyond what any such machine can do or measure: 65 rad/s is the fastest that a motor's CAN
# message can carry, ten times 17 N m is more than any motor of this size gives, 2000 deg/s and
# 16 g are the ranges of inertial units [rad/s, N m, rad/s, m/s^2].
_MOST_SPEED, _MOST_TORQUE, _MOST_TURN, _MOST_FORCE = 65.0, 170.0, 35.0, 160.0
_JOINTS = 12


@dataclass(frozen=True, kw_only=True)
class Joints:
    """What a message of the joints says, in pronk's order and signs."""

    position: Array
    """[rad], shape (12,)."""
    velocity: Array
    """[rad/s], shape (12,)."""
    torque: Array
    """[N m], shape (12,); zeros where the layout has none."""
    robot_time: float | None
    """The robot's own stamp [s]; None where it is not filled."""
    number: int | None
    """The robot's own count; None where it is not filled."""


@dataclass(frozen=True, kw_only=True)
class Attitude:
    """What a message of the inertial unit says."""

    orientation: Array
    """Trunk to world, w, x, y, z, shape (4,)."""
    gyro: Array
    """Angular velocity in the trunk's frame [rad/s], shape (3,)."""
    accelerometer: Array
    """Specific force in the trunk's frame, +9.81 along z at rest [m/s^2], shape (3,)."""


def encode_command(layout: Layout, command: Command) -> bytes:
    """The message that puts a command into force.

    Raises:
        HardwareError: A field has another shape than (12,).
    """
    for name in ("position", "stiffness", "damping"):
        if np.shape(getattr(command, name)) != (_JOINTS,):
            raise HardwareError(
                f"command.{name} has shape {np.shape(getattr(command, name))}, expected "
                f"({_JOINTS},): the messages of {layout.name} are for twelve joints."
            )
    position = command.position * layout.signs
    stiffness, damping = command.stiffness * layout.gains, command.damping * layout.gains
    if layout.command is types.LEG_CONTROL_COMMAND:
        return layout.command.encode(q_des=position, kp_joint=stiffness, kd_joint=damping)
    return layout.command.encode(
        q_des=position,
        kp=stiffness,
        kd=damping,
        timestamp_us=round(command.made * 1e6),
        id=command.sequence,
    )


def decode_command(layout: Layout, data: bytes) -> Command:
    """The command that a message asks for.

    Raises:
        RefusedError: `fingerprint`, `length`, `not finite`, `out of range`, or `feed-forward` (a
            target speed or torque, which a `Command` does not have).
    """
    fields = layout.command.decode(data)
    cheetah = layout.command is types.LEG_CONTROL_COMMAND
    message = layout.command
    position = _within(message, "q_des", fields["q_des"], -_MOST_POSITION, _MOST_POSITION)
    names = ("kp_joint", "kd_joint") if cheetah else ("kp", "kd")
    stiffness = _within(message, names[0], fields[names[0]], 0.0, _MOST_STIFFNESS)
    damping = _within(message, names[1], fields[names[1]], 0.0, _MOST_DAMPING)
    if not cheetah and (np.any(fields["qd_des"]) or np.any(fields["tau_ff"])):
        raise RefusedError(
            "feed-forward",
            f"{layout.command.name} asks for a speed or a torque; only positions, stiffness and "
            "damping are understood.",
        )
    return Command(
        position=position * layout.signs,
        stiffness=stiffness / layout.gains,
        damping=damping / layout.gains,
        sequence=0 if cheetah else int(fields["id"]),
        made=0.0 if cheetah else 1e-6 * int(fields["timestamp_us"]),
    )


def encode_state(layout: Layout, state: State) -> tuple[tuple[str, bytes], tuple[str, bytes]]:
    """The two messages of a state as (channel, bytes): the attitude first, then the joints.

    In this order, because the joints' message is the one that completes a state.
    """
    position, velocity = state.position * layout.signs, state.velocity * layout.signs
    attitude: dict[str, Any] = {"quat": state.orientation, "rpy": roll_pitch_yaw(state.orientation)}
    joints: dict[str, Any]
    if layout.joints is types.SPI_DATA:
        attitude |= {"omega": state.gyro, "acc": state.accelerometer}
        attitude |= {"good_packets": state.sequence}
        joints = {f"q_{name}": position[k::3] for k, name in enumerate(_SPI_JOINTS)}
        joints |= {f"qd_{name}": velocity[k::3] for k, name in enumerate(_SPI_JOINTS)}
    else:
        stamp = {
            "timestamp_us": round(1e6 * (state.robot_time or 0.0)),
            "id": state.sequence,
        }
        attitude |= {"omegaBody": state.gyro, "aBody": state.accelerometer, **stamp}
        joints = {"q": position, "qd": velocity, "tau_est": state.torque * layout.signs, **stamp}
    return (
        (layout.attitude_channel, layout.attitude.encode(**attitude)),
        (layout.joints_channel, layout.joints.encode(**joints)),
    )


_SPI_JOINTS = ("abad", "hip", "knee")


def decode_joints(layout: Layout, data: bytes) -> Joints:
    """The joints of a state.

    Raises:
        RefusedError: `fingerprint`, `length`, `not finite` or `out of range`.
    """
    fields, message = layout.joints.decode(data), layout.joints
    if message is types.SPI_DATA:
        # By joint, then leg, on the wire; by leg, then joint, here.
        q, qd = (
            np.array([fields[f"{kind}_{name}"] for name in _SPI_JOINTS]).T.ravel()
            for kind in ("q", "qd")
        )
        torque, stamp, number = np.zeros(_JOINTS), 0, 0
    else:
        q, qd = fields["q"], fields["qd"]
        torque = layout.signs * _within(
            message, "tau_est", fields["tau_est"], -_MOST_TORQUE, _MOST_TORQUE
        )
        stamp, number = int(fields["timestamp_us"]), int(fields["id"])
    position = _within(message, "q", q, -_MOST_POSITION, _MOST_POSITION)
    velocity = _within(message, "qd", qd, -_MOST_SPEED, _MOST_SPEED)
    return Joints(
        position=position * layout.signs,
        velocity=velocity * layout.signs,
        torque=torque,
        # The bridge of walk-these-ways itself leaves both at 0.
        robot_time=1e-6 * stamp if stamp else None,
        number=number or None,
    )


def decode_attitude(layout: Layout, data: bytes) -> Attitude:
    """The trunk's part of a state.

    Raises:
        RefusedError: `fingerprint`, `length`, `not finite`, `out of range`, or `quaternion` (not of
            length 1).
    """
    fields, message = layout.attitude.decode(data), layout.attitude
    cheetah = message is types.MICROSTRAIN
    orientation = _within(message, "quat", fields["quat"], -2.0, 2.0)
    length = float(np.sqrt(orientation @ orientation))
    if not abs(length - 1.0) <= 0.02:
        raise RefusedError(
            "quaternion",
            f"{message.name}.quat has length {length:.3f}, expected 1 within .02; the inertial "
            "unit is not running, or the order of the numbers is another.",
        )
    names = ("omega", "acc") if cheetah else ("omegaBody", "aBody")
    gyro = _within(message, names[0], fields[names[0]], -_MOST_TURN, _MOST_TURN)
    force = _within(message, names[1], fields[names[1]], -_MOST_FORCE, _MOST_FORCE)
    return Attitude(orientation=orientation / length, gyro=gyro, accelerometer=force)


def state_of(joints: Joints, attitude: Attitude, *, time: float, sequence: int) -> State:
    """A state from its two halves.

    Args:
        joints: The newest.
        attitude: The newest before it.
        time: When the joints' message arrived, on the local clock [s].
        sequence: Local count.

    Returns:
        The state; its bus voltage is NaN, for neither layout carries it.
    """
    return State(
        time=time,
        sequence=sequence,
        position=joints.position,
        velocity=joints.velocity,
        torque=joints.torque,
        gyro=attitude.gyro,
        accelerometer=attitude.accelerometer,
        bus_voltage=float("nan"),
        orientation=attitude.orientation,
        robot_time=joints.robot_time,
    )


def roll_pitch_yaw(orientation: Array) -> Array:
    """Angles about x, then y, then z of the world, of a unit quaternion w, x, y, z [rad]."""
    w, x, y, z = orientation
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return np.array([roll, pitch, yaw])


def _within(message: Message, name: str, values: NDArray[Any], low: float, high: float) -> Array:
    """The numbers of a field as float64, if they are what a machine can mean.

    Raises:
        RefusedError: `not finite` or `out of range`.
    """
    # Before the conversion, which warns of a signalling NaN; NaN is within nothing.
    if ((values >= low) & (values <= high)).all():
        return np.asarray(values, dtype=np.float64)
    if not np.isfinite(values).all():
        raise RefusedError(
            "not finite", f"{message.name}.{name} holds a number that is not finite."
        )
    raise RefusedError(
        "out of range",
        f"{message.name}.{name} lies between {values.min():g} and {values.max():g}, expected "
        f"{low:g} to {high:g}, which is all that the motors and sensors can do.",
    )
