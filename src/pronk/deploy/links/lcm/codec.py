"""LCM messages of the Mini Cheetah and of the walk-these-ways bridge to states and commands.

Layouts. `cheetah` is Cheetah-Software on the robot with MiniCheetahSpi_Controller, which reads
q_des, kp_joint and kd_joint of its commands. `wtw` is the bridge of walk-these-ways (Go1, and the
Go2 forks that kept its messages).

Joints. All three orders agree: legs FR FL HR HL (RR and RL in the stacks), then abad, hip, knee.
Signs: Cheetah-Software's are pronk's own. Unitree's hip pitch and knee axes point the other way
(thigh +0.8, calf -1.6 where pronk has -0.8, +1.6); the abduction axes are the same.

The knee's gains. Cheetah-Software converts the knee's angle, speed and torque by its extra ratio
6 / 9.33, but not its gains (`rt_spi.cpp`): a wire gain k acts as k / 0.6429^2 = 2.42 k at the
joint. Hence a command's knee gains are multiplied by 0.6429^2 on their way to the wire.

The wire has no checksum: a number that no motor or sensor of such a machine can give is refused.

Sources: the `lcm-types` of Cheetah-Software (MIT Biomimetics) and of walk-these-ways
(Improbable AI), both MIT licence; `lcmgen.c` for the fingerprint.
"""

from __future__ import annotations

import math
import re
import struct
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pronk.arrays import Array
from pronk.deploy.links.link import StateNumbering, unit_quaternion
from pronk.errors import HardwareError
from pronk.robots.machine import Command, RefusedError, State, TorqueKind, check_command

# --- Messages -----------------------------------------------------------------------------------

_KINDS = {"int8_t": ">i1", "int32_t": ">i4", "int64_t": ">i8", "float": ">f4", "double": ">f8"}
_WORD = (1 << 64) - 1


class Message:
    """A type of message: its fingerprint (8 bytes), then its fields, big-endian without padding.

    The fingerprint is a hash of the fields' names, types and lengths. Two stacks use the same names
    and channels for different layouts, so it alone identifies a message.
    """

    def __init__(self, name: str, channel: str, layout: str) -> None:
        """Read a layout in LCM's own language, `float q[12]; int64_t id`."""
        self.name, self.channel, self.layout = name, channel, layout
        columns: list[Any] = [("_fingerprint", ">u8")]
        value = 0x12345678
        for kind, field, count in re.findall(r"(\w+) (\w+)(?:\[(\d+)\])?", layout):
            columns.append((field, _KINDS[kind], (int(count),) if count else ()))
            # Texts with their lengths, the number of dimensions, and 0 for a constant one.
            dimensions = b"\1\0" + _text(count) if count else b"\0"
            for byte in _text(field) + _text(kind) + dimensions:
                signed = value - (1 << 64) if value >> 63 else value
                value = ((value << 8) ^ (signed >> 55)) + byte & _WORD
        self.fingerprint = (value << 1 | value >> 63) & _WORD
        self.dtype = np.dtype(columns)

    def encode(self, **values: ArrayLike) -> bytes:
        """Encode fields, by default 0; scalars fill arrays."""
        record = np.zeros((), self.dtype)
        record["_fingerprint"] = self.fingerprint
        for name, value in values.items():
            record[name] = value
        return record.tobytes()

    def decode(self, data: bytes) -> NDArray[np.void]:
        """Decode the fields of a message; RefusedError `fingerprint` or `length`."""
        found, size = int.from_bytes(data[:8], "big"), self.dtype.itemsize
        if len(data) < 8 or found != self.fingerprint:
            known = [f" ({other.name})" for other in MESSAGES if other.fingerprint == found]
            raise RefusedError(
                "fingerprint",
                f"a message has fingerprint {found:#018x}{''.join(known)}, expected "
                f"{self.fingerprint:#018x} ({self.name}); its sender uses another layout.",
            )
        if len(data) != size:
            raise RefusedError(
                "length",
                f"{self.name} is {len(data)} bytes long, expected {size}; it was cut or padded on "
                "the way.",
            )
        return np.frombuffer(data, self.dtype)[0]  # type: ignore[no-any-return]


def _text(text: str) -> bytes:
    return bytes([len(text)]) + text.encode()


# Name, channel and fields. Arrays of 12 are leg by leg (FR FL HR HL, or FR FL RR RL), abad, hip,
# knee (hip, thigh, calf in Unitree's signs); of 4, by leg. pronk's own: joints to hold, to the
# virtual robot; from it, joints held and the last request received.
_TABLE = """
cheetah.spi_data_t spi_data
    float q_abad[4]; float q_hip[4]; float q_knee[4];
    float qd_abad[4]; float qd_hip[4]; float qd_knee[4];
    int32_t flags[4]; int32_t spi_driver_status;
cheetah.leg_control_command_lcmt spi_debug_cmd
    float tau_ff[12]; float f_ff[12]; float q_des[12]; float qd_des[12]; float p_des[12];
    float v_des[12]; float kp_cartesian[12]; float kd_cartesian[12]; float kp_joint[12];
    float kd_joint[12];
cheetah.microstrain_lcmt microstrain
    float quat[4]; float rpy[3]; float omega[3]; float acc[3];
    int64_t good_packets; int64_t bad_packets;
cheetah.control_parameter_request_lcmt interface_request
    int8_t name[64]; int64_t requestNumber; int8_t value[64]; int8_t parameterKind;
    int8_t requestKind;
wtw.leg_control_data_lcmt leg_control_data
    float q[12]; float qd[12]; float p[12]; float v[12]; float tau_est[12];
    int64_t timestamp_us; int64_t id; int64_t robot_id;
wtw.pd_tau_targets_lcmt pd_plustau_targets
    double q_des[12]; double qd_des[12]; double tau_ff[12]; double kp[12]; double kd[12];
    int64_t timestamp_us; int64_t id; int64_t robot_id; double se_contactState[4];
wtw.state_estimator_lcmt state_estimator_data
    float p[3]; float vWorld[3]; float vBody[3]; float rpy[3]; float omegaBody[3];
    float omegaWorld[3]; float quat[4]; float contact_estimate[4]; float aBody[3];
    float aWorld[3]; int64_t timestamp_us; int64_t id; int64_t robot_id;
pronk.virtual_robot_lcmt pronk_bench
    int64_t request; int8_t clamped[12];
"""
MESSAGES = tuple(
    Message(*found) for found in re.findall(r"^(\S+) (\w+)\n((?: .*\n)+)", _TABLE, re.MULTILINE)
)
(
    SPI_DATA,
    LEG_CONTROL_COMMAND,
    MICROSTRAIN,
    CONTROL_PARAMETER,
    WTW_LEG_CONTROL_DATA,
    WTW_PD_TAU_TARGETS,
    WTW_STATE_ESTIMATOR,
    VIRTUAL_ROBOT,
) = MESSAGES
# Responses (control_parameter_respones_lcmt) and beacons have the fields of the requests.
RESPONSE_CHANNEL, BEACON_CHANNEL = "interface_response", "pronk_virtual"

# --- Layouts ------------------------------------------------------------------------------------

KNEE_RATIO = 0.6429
"""Motor to joint beyond the hips' 6:1, as `rt_spi.cpp` has it (6 / 9.33 = .6431)."""
JOINTS = 12


@dataclass(frozen=True, kw_only=True, eq=False)
class Layout:
    """Messages of a stack, and how their numbers become pronk's."""

    name: str
    command: Message
    joints: Message
    attitude: Message
    fields: dict[str, str]  # names on the wire
    numbered: bool  # commands and states carry `timestamp_us` and `id`
    signs: Array  # pronk's angles are signs times the wire's, shape (12,)
    gains: Array  # the wire's stiffness and damping per the joint's own [1], shape (12,)
    torque_kind: TorqueKind
    state_rate_hz: float = 500.0


_FIELDS = {"position": "q", "velocity": "qd", "torque": "tau_est", "orientation": "quat"}
CHEETAH = Layout(
    name="cheetah",
    command=LEG_CONTROL_COMMAND,
    joints=SPI_DATA,
    attitude=MICROSTRAIN,
    fields=_FIELDS
    | {"stiffness": "kp_joint", "damping": "kd_joint", "gyro": "omega", "accelerometer": "acc"},
    numbered=False,
    signs=np.ones(JOINTS),
    gains=np.tile([1.0, 1.0, KNEE_RATIO**2], 4),
    # spi_data_t carries none, and what leg_control_data_lcmt calls tau_est is computed from the
    # command on the host, on the knee wrongly.
    torque_kind="absent",
)
WTW = Layout(
    name="wtw",
    command=WTW_PD_TAU_TARGETS,
    joints=WTW_LEG_CONTROL_DATA,
    attitude=WTW_STATE_ESTIMATOR,
    fields=_FIELDS
    | {"stiffness": "kp", "damping": "kd", "gyro": "omegaBody", "accelerometer": "aBody"},
    numbered=True,
    signs=np.tile([1.0, -1.0, -1.0], 4),
    gains=np.ones(JOINTS),
    # Unitree's tauEst, which the motor board computes from its current.
    torque_kind="measured",
)
LAYOUTS = {"cheetah": CHEETAH, "spi": CHEETAH, "wtw": WTW}


def layout_of(name: str) -> Layout:
    """Look a layout up; HardwareError for an unknown name."""
    if name not in LAYOUTS:
        raise HardwareError(f"no LCM layout {name!r}; there are {', '.join(LAYOUTS)}.")
    return LAYOUTS[name]


# --- States and commands ------------------------------------------------------------------------

_SPI_JOINTS = ("abad", "hip", "knee")
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


def encode_command(layout: Layout, command: Command) -> bytes:
    """Encode a command; HardwareError for an impossible one."""
    check_command(command, JOINTS)
    fields: dict[str, Any] = {
        "q_des": command.position * layout.signs,
        layout.fields["stiffness"]: command.stiffness * layout.gains,
        layout.fields["damping"]: command.damping * layout.gains,
    }
    if layout.numbered:
        fields |= {"timestamp_us": round(command.made * 1e6), "id": command.sequence}
    return layout.command.encode(**fields)


def decode_command(layout: Layout, data: bytes) -> Command:
    """Decode a command.

    RefusedError as of `Message.decode`, or `not finite`, `out of range`, `feed-forward` (a target
    speed or torque, which a `Command` does not have).
    """
    message = layout.command
    fields = message.decode(data)
    wire = layout.fields | {"position": "q_des"}
    found = _decoded(message, fields, wire, "position", "stiffness", "damping")
    # Of Cheetah-Software's message the robot reads nothing else. The comparison is without the
    # warning that a conversion of a signalling NaN to bool gives.
    if layout is WTW and any((fields[name] != 0.0).any() for name in ("qd_des", "tau_ff")):
        raise RefusedError(
            "feed-forward",
            f"{message.name} commands a speed or a torque; only positions, stiffness and damping "
            "are understood.",
        )
    return Command(
        position=found["position"] * layout.signs,
        stiffness=found["stiffness"] / layout.gains,
        damping=found["damping"] / layout.gains,
        sequence=int(fields["id"]) if layout.numbered else 0,
        made=1e-6 * int(fields["timestamp_us"]) if layout.numbered else 0.0,
    )


def encode_state(layout: Layout, state: State) -> tuple[bytes, bytes]:
    """Encode a state as two messages: attitude, then joints, which complete a state."""
    w, x, y, z = state.orientation
    rpy = (
        math.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        math.asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0)),
        math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )
    attitude: dict[str, Any] = {"quat": state.orientation, "rpy": rpy}
    attitude |= {layout.fields[name]: getattr(state, name) for name in ("gyro", "accelerometer")}
    joints: dict[str, Any]
    joints = {"q": state.position * layout.signs, "qd": state.velocity * layout.signs}
    if layout.numbered:
        stamp = {"timestamp_us": round(1e6 * (state.robot_time or 0.0)), "id": state.sequence}
        attitude |= stamp
        joints |= {"tau_est": state.torque * layout.signs, **stamp}
    else:
        attitude["good_packets"] = state.sequence
        joints = {
            f"{kind}_{name}": values[k::3]
            for kind, values in joints.items()
            for k, name in enumerate(_SPI_JOINTS)
        }
    return layout.attitude.encode(**attitude), layout.joints.encode(**joints)


class StateDecoder(StateNumbering):
    """Makes states of the two messages; neither carries the bus voltage (NaN).

    `no attitude` counts joints without an attitude of the last 20 ms, which make no state.
    """

    def __init__(self, layout: Layout, counts: Counter[str]) -> None:
        super().__init__(counts, layout.state_rate_hz)
        self._layout = layout
        self._attitude: dict[str, Array] = {}
        self._attitude_came = -math.inf

    def attitude(self, data: bytes, now: float) -> None:
        """Take a message of the inertial unit that arrived at `now` [s].

        RefusedError as of `joints`, or `quaternion` (not of length 1).
        """
        message, wire = self._layout.attitude, self._layout.fields
        fields = message.decode(data)
        found = _decoded(message, fields, wire, "orientation", "gyro", "accelerometer")
        found["orientation"] = unit_quaternion(f"{message.name}.quat", found["orientation"])
        self._attitude, self._attitude_came = found, now

    def joints(self, data: bytes, now: float) -> State | None:
        """Take a message of the joints that arrived at `now` [s]: it completes a state.

        RefusedError as of `Message.decode`, or `not finite`, `out of range`.
        """
        layout = self._layout
        fields: Any = layout.joints.decode(data)
        stamp = number = 0
        if layout.numbered:
            stamp, number = int(fields["timestamp_us"]), int(fields["id"])
        else:
            # By joint, then leg, on the wire; by leg, then joint, here.
            fields = {"tau_est": np.zeros(JOINTS)} | {
                kind: np.array([fields[f"{kind}_{name}"] for name in _SPI_JOINTS]).T.ravel()
                for kind in ("q", "qd")
            }
        wire = layout.fields
        found = _decoded(layout.joints, fields, wire, "position", "velocity", "torque")
        if now - self._attitude_came > _OLDEST_ATTITUDE_S:
            self.counts["no attitude"] += 1
            return None
        values = {name: value * layout.signs for name, value in found.items()}
        values |= self._attitude
        # The bridge of walk-these-ways itself leaves stamp and number at 0.
        values |= {"bus_voltage": math.nan, "robot_time": 1e-6 * stamp if stamp else None}
        return self.number(values, number or None, now)


def _decoded(message: Message, fields: Any, wire: Mapping[str, str], *names: str) -> dict[str, Any]:
    """Numbers of a message by name, as float64; refuse what is not finite or not in its range."""
    out = {}
    for name in names:
        (low, high), values = _RANGES[name], fields[wire[name]]
        # Before the conversion, which warns of a signalling NaN; NaN is in no range.
        if ((values >= low) & (values <= high)).all():
            out[name] = np.asarray(values, dtype=np.float64)
        elif np.isfinite(values).all():
            raise RefusedError(
                "out of range",
                f"{name} of {message.name} lies between {values.min():g} and {values.max():g}, "
                f"expected {low:g} to {high:g}, which is all that the motors and sensors can do.",
            )
        else:
            raise RefusedError("not finite", f"a {name} of {message.name} is not a finite number.")
    return out


# --- Requests -----------------------------------------------------------------------------------

# Cheetah-Software's parameter `control_mode` chooses which of the robot's own controllers holds the
# joints. The virtual robot holds joints mechanically on request, and its beacon lists them.
MODES = {0: "", 1: "stand_up", 3: "balance_stand", 4: "locomotion", 6: "recovery_stand"}
"""`control_mode` (`FSM_State.h`); 0 is passive, the joints are free for others."""
_MODE = b"control_mode"
# ControlParameters.h: the value is a double. ControlParameterInterface.h: set a robot's parameter.
_DOUBLE, _SET = 1, 1


def mode_request(mode: int, number: int) -> bytes:
    """Encode the request of this number that sets `control_mode`; the same bytes confirm it."""
    # The robot copies memory here: little-endian, unlike everything else on this wire.
    value = struct.pack("<d", mode).ljust(64, b"\0")
    return CONTROL_PARAMETER.encode(
        name=np.frombuffer(_MODE.ljust(64, b"\0"), np.int8),
        requestNumber=number,
        value=np.frombuffer(value, np.int8),
        parameterKind=_DOUBLE,
        requestKind=_SET,
    )


def read_mode_request(data: bytes) -> str:
    """Name of the mode that a request sets, empty for passive; RefusedError for any other."""
    fields = CONTROL_PARAMETER.decode(data)
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
    return VIRTUAL_ROBOT.encode(request=number, clamped=[int(n in held) for n in names])


def read_clamp_message(names: tuple[str, ...], data: bytes) -> tuple[int, tuple[str, ...]]:
    """Number of the request, and the joints that are or shall be held."""
    fields = VIRTUAL_ROBOT.decode(data)
    flags = zip(names, fields["clamped"].tolist(), strict=True)
    return int(fields["request"]), tuple(name for name, held in flags if held)
