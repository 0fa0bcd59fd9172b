"""LCM messages to states and commands, and back, without a socket.

Layouts. `cheetah` is Cheetah-Software on the robot with MiniCheetahSpi_Controller: states are
spi_data_t and microstrain_lcmt, commands are leg_control_command_lcmt on spi_debug_cmd, of which
the robot reads q_des, kp_joint and kd_joint. `wtw` is the bridge of walk-these-ways (Go1, and the
Go2 forks that kept its messages): states are leg_control_data_lcmt and state_estimator_lcmt,
commands are pd_tau_targets_lcmt.

Joints. All three orders agree: legs FR FL HR HL (RR and RL in the stacks), then abad, hip, knee.
Signs: Cheetah-Software's are pronk's own. Unitree's hip pitch and knee axes point the other way
(thigh +0.8, calf -1.6 where pronk has -0.8, +1.6); the abduction axes are the same.

The knee's gains. Cheetah-Software converts the knee's angle, speed and torque by its extra ratio
6 / 9.33, but not its gains (`rt_spi.cpp`): a wire gain k acts as k / 0.6429^2 = 2.42 k at the
joint. Hence a command's knee gains are multiplied by 0.6429^2 on their way to the wire.

The wire has no checksum: a number that no motor or sensor of such a machine can give is refused.

Cheetah-Software's parameter `control_mode` chooses which of the robot's own controllers holds the
joints. The virtual robot holds joints mechanically on request, and its beacon lists them.
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pronk.errors import HardwareError
from pronk.links.lcm import messages
from pronk.links.lcm.messages import Message
from pronk.links.machine import Command, RefusedError, State, TorqueKind, check_command

Array = NDArray[np.float64]

KNEE_RATIO = 0.6429
"""Motor to joint beyond the hips' 6:1, as `rt_spi.cpp` has it (6 / 9.33 = .6431)."""
# What the motors' CAN messages can carry, motor firmware of bgkatz [rad, N m/rad, N m s/rad].
_MOST_POSITION, _MOST_STIFFNESS, _MOST_DAMPING = 12.5, 500.0, 5.0
# Beyond what any such machine can do or measure: 65 rad/s is the fastest that a motor's CAN
# message can carry, ten times 17 N m is more than any motor of this size gives, 2000 deg/s and
# 16 g are the ranges of inertial units [rad/s, N m, rad/s, m/s^2].
_MOST_SPEED, _MOST_TORQUE, _MOST_TURN, _MOST_FORCE = 65.0, 170.0, 35.0, 160.0
_JOINTS = 12
_SPI_JOINTS = ("abad", "hip", "knee")

# Where parameters are set and confirmed (`HardwareBridge.cpp`).
REQUEST_CHANNEL, RESPONSE_CHANNEL = "interface_request", "interface_response"
# Requests for clamps to the virtual robot, and its beacon.
BENCH_CHANNEL, BEACON_CHANNEL = "pronk_bench", "pronk_virtual"
MODES = {0: "", 1: "stand_up", 3: "balance_stand", 4: "locomotion", 6: "recovery_stand"}
"""`control_mode` (`FSM_State.h`); 0 is passive, the joints are free for others."""
_MODE = b"control_mode"
# ControlParameters.h: the value is a double. ControlParameterInterface.h: set a robot's parameter.
_DOUBLE, _SET = 1, 1

_OLDEST_ATTITUDE_S = 0.02
_NUMBER_JUMP = 1000
"""A count this far from the last is that of a robot that was started again, or a broken one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Layout:
    """Messages, their channels and fields, and how their numbers become pronk's."""

    name: str
    command: Message
    command_channel: str
    gain_fields: tuple[str, str]
    """Of stiffness and damping in a command."""
    joints: Message
    joints_channel: str
    attitude: Message
    attitude_channel: str
    imu_fields: tuple[str, str]
    """Of angular velocity and specific force."""
    numbered: bool
    """Commands and states carry `timestamp_us` and `id`."""
    signs: Array
    """pronk's angles are signs times the wire's, shape (12,)."""
    gains: Array
    """The wire's stiffness and damping per the joint's own [1], shape (12,)."""
    torque_kind: TorqueKind
    state_rate_hz: float = 500.0


CHEETAH = Layout(
    name="cheetah",
    command=messages.LEG_CONTROL_COMMAND,
    command_channel="spi_debug_cmd",
    gain_fields=("kp_joint", "kd_joint"),
    joints=messages.SPI_DATA,
    joints_channel="spi_data",
    attitude=messages.MICROSTRAIN,
    attitude_channel="microstrain",
    imu_fields=("omega", "acc"),
    numbered=False,
    signs=np.ones(_JOINTS),
    gains=np.tile([1.0, 1.0, KNEE_RATIO**2], 4),
    # spi_data_t carries none, and what leg_control_data_lcmt calls tau_est is computed from the
    # command on the host, on the knee wrongly.
    torque_kind="absent",
)
WTW = Layout(
    name="wtw",
    command=messages.WTW_PD_TAU_TARGETS,
    command_channel="pd_plustau_targets",
    gain_fields=("kp", "kd"),
    joints=messages.WTW_LEG_CONTROL_DATA,
    joints_channel="leg_control_data",
    attitude=messages.WTW_STATE_ESTIMATOR,
    attitude_channel="state_estimator_data",
    imu_fields=("omegaBody", "aBody"),
    numbered=True,
    signs=np.tile([1.0, -1.0, -1.0], 4),
    gains=np.ones(_JOINTS),
    # Unitree's tauEst, which the motor board computes from its current.
    torque_kind="measured",
)
LAYOUTS = {"cheetah": CHEETAH, "spi": CHEETAH, "wtw": WTW}
"""By name; `spi` is another name of `cheetah`."""


def layout_of(name: str) -> Layout:
    """Look a layout up; refuse a name that there is not."""
    if name not in LAYOUTS:
        raise HardwareError(f"no LCM layout {name!r}; there are {', '.join(LAYOUTS)}.")
    return LAYOUTS[name]


def encode_command(layout: Layout, command: Command) -> bytes:
    """Encode a command; refuse one that is not for twelve joints or that no drive could follow."""
    check_command(command, _JOINTS)
    stiffness, damping = layout.gain_fields
    fields: dict[str, Any] = {
        "q_des": command.position * layout.signs,
        stiffness: command.stiffness * layout.gains,
        damping: command.damping * layout.gains,
    }
    if layout.numbered:
        fields |= {"timestamp_us": round(command.made * 1e6), "id": command.sequence}
    return layout.command.encode(**fields)


def decode_command(layout: Layout, data: bytes) -> Command:
    """Decode a command.

    Raises:
        RefusedError: `fingerprint`, `length`, `not finite`, `out of range`, or `feed-forward` (a
            target speed or torque, which a `Command` does not have).
    """
    message = layout.command
    fields = message.decode(data)
    kp, kd = layout.gain_fields
    position = _within(message, fields, "q_des", _MOST_POSITION)
    stiffness = _within(message, fields, kp, _MOST_STIFFNESS, low=0.0)
    damping = _within(message, fields, kd, _MOST_DAMPING, low=0.0)
    # Of Cheetah-Software's message the robot reads nothing else.
    if layout is WTW and (np.any(fields["qd_des"]) or np.any(fields["tau_ff"])):
        raise RefusedError(
            "feed-forward",
            f"{message.name} commands a speed or a torque; only positions, stiffness and damping "
            "are understood.",
        )
    return Command(
        position=position * layout.signs,
        stiffness=stiffness / layout.gains,
        damping=damping / layout.gains,
        sequence=int(fields["id"]) if layout.numbered else 0,
        made=1e-6 * int(fields["timestamp_us"]) if layout.numbered else 0.0,
    )


def encode_state(layout: Layout, state: State) -> tuple[tuple[str, bytes], tuple[str, bytes]]:
    """Encode a state as two (channel, bytes): attitude, then joints, which complete a state."""
    position, velocity = state.position * layout.signs, state.velocity * layout.signs
    turn, force = layout.imu_fields
    attitude: dict[str, Any] = {"quat": state.orientation, "rpy": roll_pitch_yaw(state.orientation)}
    attitude |= {turn: state.gyro, force: state.accelerometer}
    joints: dict[str, Any]
    if layout.numbered:
        stamp = {"timestamp_us": round(1e6 * (state.robot_time or 0.0)), "id": state.sequence}
        attitude |= stamp
        joints = {"q": position, "qd": velocity, "tau_est": state.torque * layout.signs, **stamp}
    else:
        attitude |= {"good_packets": state.sequence}
        joints = {f"q_{name}": position[k::3] for k, name in enumerate(_SPI_JOINTS)}
        joints |= {f"qd_{name}": velocity[k::3] for k, name in enumerate(_SPI_JOINTS)}
    return (
        (layout.attitude_channel, layout.attitude.encode(**attitude)),
        (layout.joints_channel, layout.joints.encode(**joints)),
    )


def decode_joints(layout: Layout, data: bytes) -> tuple[dict[str, Any], int | None]:
    """Decode fields of a `State`, and the robot's own count or None where it is not filled.

    Raises:
        RefusedError: `fingerprint`, `length`, `not finite` or `out of range`.
    """
    message = layout.joints
    fields: Any = message.decode(data)
    torque, stamp, number = np.zeros(_JOINTS), 0, 0
    if layout.numbered:
        torque = _within(message, fields, "tau_est", _MOST_TORQUE)
        stamp, number = int(fields["timestamp_us"]), int(fields["id"])
    else:
        # By joint, then leg, on the wire; by leg, then joint, here.
        fields = {
            kind: np.array([fields[f"{kind}_{name}"] for name in _SPI_JOINTS]).T.ravel()
            for kind in ("q", "qd")
        }
    state = {
        "position": _within(message, fields, "q", _MOST_POSITION) * layout.signs,
        "velocity": _within(message, fields, "qd", _MOST_SPEED) * layout.signs,
        "torque": torque * layout.signs,
        # The bridge of walk-these-ways itself leaves both at 0.
        "robot_time": 1e-6 * stamp if stamp else None,
    }
    return state, number or None


def decode_attitude(layout: Layout, data: bytes) -> dict[str, Array]:
    """Decode the trunk's part of a state: its fields `orientation`, `gyro` and `accelerometer`.

    Raises:
        RefusedError: `fingerprint`, `length`, `not finite`, `out of range`, or `quaternion` (not of
            length 1).
    """
    message = layout.attitude
    fields = message.decode(data)
    orientation = _within(message, fields, "quat", 2.0)
    length = float(np.sqrt(orientation @ orientation))
    if not abs(length - 1.0) <= 0.02:
        raise RefusedError(
            "quaternion",
            f"{message.name}.quat has length {length:.3f}, expected 1 within .02; the inertial "
            "unit is not running, or the order of the numbers is another.",
        )
    turn, force = layout.imu_fields
    return {
        "orientation": orientation / length,
        "gyro": _within(message, fields, turn, _MOST_TURN),
        "accelerometer": _within(message, fields, force, _MOST_FORCE),
    }


class StateDecoder:
    """Numbers the states that messages make.

    No state is made, and the reason counted, of joints without a young attitude (`no attitude`); of
    values that repeat to the last bit, as no live sensor's do (`repeated`); of a count that went
    backwards (`out of order`). A refused message raises RefusedError. Neither layout carries the
    bus voltage: NaN.
    """

    def __init__(self, layout: Layout, counts: Counter[str]) -> None:
        self.counts = counts
        self._layout = layout
        self._attitude: dict[str, Any] = {}
        self._attitude_came = -float("inf")
        self._values = b""
        self._number: int | None = None
        self._sequence = -1

    def attitude(self, data: bytes, now: float) -> None:
        """Take a message of the inertial unit that arrived at `now` [s]."""
        self._attitude = decode_attitude(self._layout, data)
        self._attitude_came = now

    def joints(self, data: bytes, now: float) -> State | None:
        """Take a message of the joints that arrived at `now` [s]: it completes a state."""
        joints, number = decode_joints(self._layout, data)
        if now - self._attitude_came > _OLDEST_ATTITUDE_S:
            self.counts["no attitude"] += 1
            return None
        passed = 1
        if number is not None and self._number is not None:
            passed = number - self._number
            if -_NUMBER_JUMP < passed <= 0:
                self.counts["out of order"] += 1
                return None
        self._number = number
        attitude = self._attitude
        parts = (joints["position"], joints["velocity"], *list(attitude.values())[1:])
        values = b"".join(part.tobytes() for part in parts)
        if values == self._values:
            self.counts["repeated"] += 1
            return None
        self._values = values
        # Where the robot counts, what it counted and did not arrive is missing here too.
        self._sequence += passed if 0 < passed < _NUMBER_JUMP else 1
        voltage = float("nan")
        return State(time=now, sequence=self._sequence, bus_voltage=voltage, **joints, **attitude)


def roll_pitch_yaw(orientation: Array) -> Array:
    """Angles about x, then y, then z of the world, of a unit quaternion w, x, y, z [rad]."""
    w, x, y, z = orientation
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return np.array([roll, pitch, yaw])


def mode_request(mode: int, number: int) -> bytes:
    """Encode the request of this number that sets `control_mode`; the same bytes confirm it."""
    # The robot copies memory here: little-endian, unlike everything else on this wire.
    value = struct.pack("<d", mode).ljust(64, b"\0")
    return messages.CONTROL_PARAMETER.encode(
        name=list(_MODE.ljust(64, b"\0")),
        requestNumber=number,
        value=list(memoryview(value).cast("b")),
        parameterKind=_DOUBLE,
        requestKind=_SET,
    )


def read_mode_request(data: bytes) -> str:
    """Name of the mode that a request sets; empty for passive.

    Raises:
        RefusedError: `fingerprint`, `length`, or `parameter` (not `control_mode`, or no mode).
    """
    fields = messages.CONTROL_PARAMETER.decode(data)
    name = fields["name"].tobytes().split(b"\0")[0]
    kinds = (int(fields["parameterKind"]), int(fields["requestKind"]))
    (value,) = struct.unpack_from("<d", fields["value"].tobytes())
    if name != _MODE or kinds != (_DOUBLE, _SET) or value not in MODES:
        raise RefusedError(
            "parameter",
            f"a request sets {name!r} to {value}; only {_MODE.decode()} can be set here, to one "
            f"of {', '.join(map(str, MODES))}.",
        )
    return MODES[int(value)]


def clamp_message(names: tuple[str, ...], held: tuple[str, ...], number: int) -> bytes:
    """Encode a request for clamps, or the beacon: joints to hold, or held, of all `names`."""
    return messages.VIRTUAL_ROBOT.encode(request=number, clamped=[int(n in held) for n in names])


def read_clamp_message(names: tuple[str, ...], data: bytes) -> tuple[int, tuple[str, ...]]:
    """Number of the request, and the joints that are or shall be held."""
    fields = messages.VIRTUAL_ROBOT.decode(data)
    flags = zip(names, fields["clamped"].tolist(), strict=True)
    return int(fields["request"]), tuple(name for name, held in flags if held)


def _within(
    message: Message, fields: Any, name: str, most: float, low: float | None = None
) -> Array:
    """Convert a field to float64; refuse what is not finite or not in `low` (or -most) to most."""
    values: NDArray[Any] = fields[name]
    low = -most if low is None else low
    # Before the conversion, which warns of a signalling NaN; NaN is within nothing.
    if ((values >= low) & (values <= most)).all():
        return np.asarray(values, dtype=np.float64)
    if not np.isfinite(values).all():
        raise RefusedError(
            "not finite", f"{message.name}.{name} holds a number that is not finite."
        )
    raise RefusedError(
        "out of range",
        f"{message.name}.{name} lies between {values.min():g} and {values.max():g}, expected "
        f"{low:g} to {most:g}, which is all that the motors and sensors can do.",
    )
