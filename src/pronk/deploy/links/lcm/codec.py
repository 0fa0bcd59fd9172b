"""States and commands to LCM messages and back.

Layouts. `cheetah` is Cheetah-Software on the robot with MiniCheetahSpi_Controller, which reads
q_des, kp_joint and kd_joint of its commands. `wtw` is the bridge of walk-these-ways (Go1, and the
Go2 forks that kept its messages).

Joints. All three orders agree: legs FR FL HR HL (RR and RL in the stacks), then abad, hip, knee.
Signs: Cheetah-Software's are those of pronk's Mini Cheetah. Unitree's hip pitch and knee axes point
the other way (thigh +0.8, calf -1.6 where that has -0.8, +1.6), as those of pronk's Go2 do; the
abduction axes are the same. `layout_for` reads the axes of a robot from its model.

The knee's gains. Cheetah-Software converts the knee's angle, speed and torque by its extra ratio
6 / 9.33, but not its gains (`rt_spi.cpp`): a wire gain k acts as k / 0.6429^2 = 2.42 k at the
joint. Hence a command's knee gains are multiplied by 0.6429^2 on their way to the wire.

The wire has no checksum: a number that no motor or sensor of such a machine can give is refused.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pronk.arrays import Array
from pronk.deploy.links.lcm.layouts import JOINT_COUNT, LcmLayout
from pronk.deploy.links.lcm.messages import CONTROL_PARAMETER, VIRTUAL_ROBOT, LcmMessage
from pronk.deploy.links.numbering import StateNumbering, unit_quaternion
from pronk.robots.machine import Command, RefusedError, State, check_command

_RANGES = {
    # What the motors' CAN messages can carry, motor firmware of bgkatz [rad, N m/rad, N m s/rad].
    "position": (-12.5, 12.5),
    "stiffness": (0.0, 500.0),
    "damping": (0.0, 5.0),
    # 65 rad/s is the fastest that they can carry, ten times 17 N m is more than any motor of this
    # size gives, 2000 deg/s and 16 g are the ranges of inertial units [rad/s, N m, rad/s, m/s^2].
    "velocity": (-65.0, 65.0),
    "torque": (-170.0, 170.0),
    "gyro": (-35.0, 35.0),
    "accelerometer": (-160.0, 160.0),
    "orientation": (-2.0, 2.0),
}
_OLDEST_ATTITUDE_S = 0.02
"""Age above which an attitude completes no state [s]."""
_MICROSECONDS_PER_S = 1e6


def encode_lcm_command(layout: LcmLayout, command: Command) -> bytes:
    """Encode a command; HardwareError for an impossible one."""
    check_command(command, JOINT_COUNT)
    values: dict[str, ArrayLike] = {
        "q_des": command.position * layout.signs,
        layout.stiffness_field: command.stiffness * layout.gain_ratios,
        layout.damping_field: command.damping * layout.gain_ratios,
    }
    if layout.numbered:
        values["timestamp_us"] = round(command.made * _MICROSECONDS_PER_S)
        values["id"] = command.sequence
    return layout.command.encode(values)


def decode_lcm_command(layout: LcmLayout, data: bytes) -> Command:
    """Decode a command.

    Args:
        layout: Messages of the stack.
        data: The message.

    Raises:
        RefusedError: As of `LcmMessage.decode`, or `not finite`, `out of range`, `feed-forward` (a
            target speed or torque, which a `Command` does not have).
    """
    message = layout.command
    fields = message.decode(data)
    position = _checked(message, "position", fields["q_des"])
    stiffness = _checked(message, "stiffness", fields[layout.stiffness_field])
    damping = _checked(message, "damping", fields[layout.damping_field])
    if layout.obeys_feed_forward:
        # Compared without the warning that a conversion of a signalling NaN to bool gives.
        speed_commanded = (fields["qd_des"] != 0.0).any()
        torque_commanded = (fields["tau_ff"] != 0.0).any()
        if speed_commanded or torque_commanded:
            raise RefusedError(
                "feed-forward",
                f"{message.name} commands a speed or a torque; only positions, stiffness and "
                "damping are understood.",
            )
    sequence = 0
    made_s = 0.0
    if layout.numbered:
        sequence = int(fields["id"])
        made_s = int(fields["timestamp_us"]) * 1e-6
    return Command(
        position=position * layout.signs,
        stiffness=stiffness / layout.gain_ratios,
        damping=damping / layout.gain_ratios,
        sequence=sequence,
        made=made_s,
    )


def encode_lcm_state(layout: LcmLayout, state: State) -> tuple[bytes, bytes]:
    """Encode a state as two messages: attitude, then joints, which complete a state."""
    attitude: dict[str, ArrayLike] = {
        "quat": state.orientation,
        "rpy": _roll_pitch_yaw(state.orientation),
        layout.gyro_field: state.gyro,
        layout.accelerometer_field: state.accelerometer,
    }
    position = state.position * layout.signs
    velocity = state.velocity * layout.signs
    joints: dict[str, ArrayLike]
    if layout.numbered:
        timestamp_us = round(_MICROSECONDS_PER_S * (state.robot_time or 0.0))
        attitude["timestamp_us"] = timestamp_us
        attitude["id"] = state.sequence
        joints = {
            "q": position,
            "qd": velocity,
            "tau_est": state.torque * layout.signs,
            "timestamp_us": timestamp_us,
            "id": state.sequence,
        }
    else:
        attitude["good_packets"] = state.sequence
        joints = {
            "q_abad": position[0::3],
            "q_hip": position[1::3],
            "q_knee": position[2::3],
            "qd_abad": velocity[0::3],
            "qd_hip": velocity[1::3],
            "qd_knee": velocity[2::3],
        }
    return layout.attitude.encode(attitude), layout.joints.encode(joints)


class LcmStateDecoder(StateNumbering):
    """Makes states of the two messages; neither carries the bus voltage (NaN).

    `no attitude` counts joints without an attitude of the last 20 ms, which make no state.
    """

    def __init__(self, layout: LcmLayout, counts: Counter[str]) -> None:
        """Begin without an attitude; `counts` gets what is dropped."""
        super().__init__(counts, layout.state_rate_hz)
        self._layout = layout
        self._orientation = np.zeros(4)
        self._gyro = np.zeros(3)
        self._accelerometer = np.zeros(3)
        self._attitude_arrived = -math.inf

    def attitude(self, data: bytes, now: float) -> None:
        """Take a message of the inertial unit that arrived at `now` [s].

        RefusedError as of `joints`, or `quaternion` (not of length 1).
        """
        message = self._layout.attitude
        fields = message.decode(data)
        orientation = _checked(message, "orientation", fields["quat"])
        gyro = _checked(message, "gyro", fields[self._layout.gyro_field])
        accelerometer = _checked(message, "accelerometer", fields[self._layout.accelerometer_field])
        self._orientation = unit_quaternion(f"{message.name}.quat", orientation)
        self._gyro = gyro
        self._accelerometer = accelerometer
        self._attitude_arrived = now

    def joints(self, data: bytes, now: float) -> State | None:
        """Take a message of the joints that arrived at `now` [s]: it completes a state.

        RefusedError as of `LcmMessage.decode`, or `not finite`, `out of range`.
        """
        layout = self._layout
        message = layout.joints
        fields = message.decode(data)
        timestamp_us = 0
        number = 0
        if layout.numbered:
            timestamp_us = int(fields["timestamp_us"])
            number = int(fields["id"])
            position = _checked(message, "position", fields["q"])
            velocity = _checked(message, "velocity", fields["qd"])
            torque = _checked(message, "torque", fields["tau_est"])
        else:
            wire_position = _by_leg(fields["q_abad"], fields["q_hip"], fields["q_knee"])
            wire_velocity = _by_leg(fields["qd_abad"], fields["qd_hip"], fields["qd_knee"])
            position = _checked(message, "position", wire_position)
            velocity = _checked(message, "velocity", wire_velocity)
            torque = np.zeros(JOINT_COUNT)
        if now - self._attitude_arrived > _OLDEST_ATTITUDE_S:
            self.counts["no attitude"] += 1
            return None
        measurement = State(
            time=now,
            sequence=0,
            position=position * layout.signs,
            velocity=velocity * layout.signs,
            torque=torque * layout.signs,
            gyro=self._gyro,
            accelerometer=self._accelerometer,
            bus_voltage=math.nan,
            orientation=self._orientation,
            # The bridge of walk-these-ways itself leaves stamp and number at 0.
            robot_time=1e-6 * timestamp_us if timestamp_us else None,
        )
        return self.number(measurement, number or None)


def _checked(message: LcmMessage, quantity: str, values: NDArray[Any]) -> Array:
    """Convert values to float64; refuse what is not finite or not in the quantity's range."""
    low, high = _RANGES[quantity]
    # Before the conversion, which warns of a signalling NaN; NaN is in no range.
    if ((values >= low) & (values <= high)).all():
        return np.asarray(values, dtype=np.float64)
    if np.isfinite(values).all():
        raise RefusedError(
            "out of range",
            f"{quantity} of {message.name} lies between {values.min():g} and {values.max():g}, "
            f"expected {low:g} to {high:g}, which is all that the motors and sensors can do.",
        )
    raise RefusedError("not finite", f"a {quantity} of {message.name} is not a finite number.")


def _by_leg(abad: NDArray[Any], hip: NDArray[Any], knee: NDArray[Any]) -> NDArray[Any]:
    """Order values by leg, then joint, from arrays of one joint of each leg."""
    return np.array([abad, hip, knee]).T.ravel()


def _roll_pitch_yaw(orientation: Array) -> tuple[float, float, float]:
    """Angles of a unit quaternion w, x, y, z about x, y, z, applied in the order z, y, x [rad]."""
    w, x, y, z = orientation
    roll = math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0))
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return roll, pitch, yaw


# --- Requests -----------------------------------------------------------------------------------

# Cheetah-Software's parameter `control_mode` chooses which of the robot's own controllers holds the
# joints. The virtual robot clamps joints mechanically on request, and its beacon lists them.
CONTROL_MODES = {0: "", 1: "stand_up", 3: "balance_stand", 4: "locomotion", 6: "recovery_stand"}
"""`control_mode` (`FSM_State.h`); 0 is passive, the joints are free for others."""
_CONTROL_MODE = b"control_mode"
_DOUBLE = 1
"""`parameterKind` of a double (`ControlParameters.h`)."""
_SET_ROBOT_PARAMETER = 1
"""`requestKind` that sets a parameter of the robot (`ControlParameterInterface.h`)."""


def encode_mode_request(mode: int, number: int) -> bytes:
    """Encode the request of this number that sets `control_mode`; the same bytes confirm it."""
    # The robot copies memory here: little-endian, unlike everything else on this wire.
    value = struct.pack("<d", mode).ljust(64, b"\0")
    return CONTROL_PARAMETER.encode(
        {
            "name": np.frombuffer(_CONTROL_MODE.ljust(64, b"\0"), np.int8),
            "requestNumber": number,
            "value": np.frombuffer(value, np.int8),
            "parameterKind": _DOUBLE,
            "requestKind": _SET_ROBOT_PARAMETER,
        }
    )


def decode_mode_request(data: bytes) -> str:
    """Name of the mode that a request sets, empty for passive; RefusedError for any other."""
    fields = CONTROL_PARAMETER.decode(data)
    name = fields["name"].tobytes().split(b"\0")[0]
    (value,) = struct.unpack_from("<d", fields["value"].tobytes())
    sets_control_mode = (
        name == _CONTROL_MODE
        and int(fields["parameterKind"]) == _DOUBLE
        and int(fields["requestKind"]) == _SET_ROBOT_PARAMETER
    )
    if not sets_control_mode or value not in CONTROL_MODES:
        raise RefusedError(
            "parameter",
            f"a request sets {name!r} to {value}; only {_CONTROL_MODE.decode()} can be set here, "
            f"to one of {', '.join(map(str, CONTROL_MODES))}.",
        )
    return CONTROL_MODES[int(value)]


def encode_clamps(joint_names: tuple[str, ...], clamped: tuple[str, ...], request: int) -> bytes:
    """Encode a request for clamps, or the beacon.

    Args:
        joint_names: All joints of the robot.
        clamped: Joints to clamp, or clamped.
        request: Number of the request, or of the last one received.
    """
    flags = [int(name in clamped) for name in joint_names]
    return VIRTUAL_ROBOT.encode({"request": request, "clamped": flags})


def decode_clamps(joint_names: tuple[str, ...], data: bytes) -> tuple[int, tuple[str, ...]]:
    """Decode the number of a request, and the joints that are or shall be clamped."""
    fields = VIRTUAL_ROBOT.decode(data)
    clamped = []
    for name, flag in zip(joint_names, fields["clamped"], strict=True):
        if flag:
            clamped.append(name)
    return int(fields["request"]), tuple(clamped)
