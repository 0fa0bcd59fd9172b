"""Unitree's messages over DDS to states and commands: IDL types, byte images, checksum.

Layouts: `unitree_go` and `unitree_api` of unitree_sdk2, every type final, members in wire order.
Joint quantities are at the joint, in rad, rad/s and N m; x is forwards, y left, z up; quaternions
are w, x, y, z.

The same message has two images. In the memory of a C compiler a struct is aligned to its largest
member and padded to a multiple of it; the checksum is taken over that image. On the wire (CDR
version 1, little-endian) each number is aligned to its own size and nothing else is padded. They
differ in one place, before the first motor:

    LowCmd    812 bytes in C,  808 on the wire after 4 of header
    LowState 1180 bytes in C, 1176 on the wire after 4 of header

pronk works on the C image as a NumPy record and moves bytes between the two: microseconds, where
the general serializer of cyclonedds takes a hundred or more.

Checksum: CRC-32 with polynomial 0x04C11DB7, start 0xFFFFFFFF, not reflected, nothing added at the
end, over the little-endian 32-bit words of the C image but the last, each most significant bit
first. That is zlib's CRC-32 but for the order of bits and the last inversion.

Joints. Slots 0 to 11 are FR, FL, RR, RL, each hip, thigh, calf: pronk's own order, FR FL HR HL,
each hip_roll, hip_pitch, knee; slots 12 to 19 drive nothing. On a Go2 the hip turns about +x, thigh
and calf about +y, all zero with the leg straight down. The Mini Cheetah's hip_pitch and knee turn
about -y, with the same zeros, so behind these messages (which only its virtual robot has)

    hip = hip_roll,  thigh = -hip_pitch,  calf = -knee

and likewise for speeds and torques; gains are the same. Trunk frame and quaternion agree.

A `Command` with no stiffness goes out as PosStopF, one with no damping as VelStopF, which is how
Unitree's drives are made to leave that part out.
"""

from __future__ import annotations

import math
import re
import zlib
from collections import Counter
from functools import cache
from typing import Any, NamedTuple, get_type_hints

import numpy as np
from numpy.lib.recfunctions import repack_fields
from numpy.typing import NDArray

from pronk.arrays import Array
from pronk.deploy.links.link import StateNumbering, unit_quaternion
from pronk.errors import HardwareError
from pronk.robots.machine import Command, RefusedError, State, check_command
from pronk.robots.robot import RobotSpec

try:
    from cyclonedds.idl import make_idl_struct, types
except ImportError:
    raise HardwareError(
        "the DDS link needs the package cyclonedds, which is not installed; "
        "install it with: pip install 'pronk[hardware]'."
    ) from None

# --- Messages -----------------------------------------------------------------------------------

# A motor gives tau + kp (q - q_now) + kd (dq - dq_now); its mode is 1 (servo) or 0 (off). tick is
# the robot's clock in ms. The code of a response is 0 when done.
_IDL = """
unitree_go MotorCmd
    uint8 mode; float32 q; float32 dq; float32 tau; float32 kp; float32 kd; uint32 reserve[3];
unitree_go BmsCmd
    uint8 off; uint8 reserve[3];
unitree_go LowCmd
    uint8 head[2]; uint8 level_flag; uint8 frame_reserve; uint32 sn[2]; uint32 version[2];
    uint16 bandwidth; MotorCmd motor_cmd[20]; BmsCmd bms_cmd; uint8 wireless_remote[40];
    uint8 led[12]; uint8 fan[2]; uint8 gpio; uint32 reserve; uint32 crc;
unitree_go IMUState
    float32 quaternion[4]; float32 gyroscope[3]; float32 accelerometer[3]; float32 rpy[3];
    uint8 temperature;
unitree_go MotorState
    uint8 mode; float32 q; float32 dq; float32 ddq; float32 tau_est; float32 q_raw;
    float32 dq_raw; float32 ddq_raw; uint8 temperature; uint32 lost; uint32 reserve[2];
unitree_go BmsState
    uint8 version_high; uint8 version_low; uint8 status; uint8 soc; int32 current; uint16 cycle;
    uint8 bq_ntc[2]; uint8 mcu_ntc[2]; uint16 cell_vol[15];
unitree_go LowState
    uint8 head[2]; uint8 level_flag; uint8 frame_reserve; uint32 sn[2]; uint32 version[2];
    uint16 bandwidth; IMUState imu_state; MotorState motor_state[20]; BmsState bms_state;
    int16 foot_force[4]; int16 foot_force_est[4]; uint32 tick; uint8 wireless_remote[40];
    uint8 bit_flag; float32 adc_reel; uint8 temperature_ntc1; uint8 temperature_ntc2;
    float32 power_v; float32 power_a; uint16 fan_frequency[4]; uint32 reserve; uint32 crc;
unitree_api RequestIdentity
    int64 id; int64 api_id;
unitree_api RequestLease
    int64 id;
unitree_api RequestPolicy
    int32 priority; bool noreply;
unitree_api RequestHeader
    RequestIdentity identity; RequestLease lease; RequestPolicy policy;
unitree_api Request
    RequestHeader header; string parameter; uint8 binary[];
unitree_api ResponseStatus
    int32 code;
unitree_api ResponseHeader
    RequestIdentity identity; ResponseStatus status;
unitree_api Response
    ResponseHeader header; string data; uint8 binary[];
"""
_types: dict[str, Any] = {"string": str, "bool": bool}
for _module, _name, _members in re.findall(r"^(\w+) (\w+)\n((?: .*\n)+)", _IDL, re.MULTILINE):
    _made = {}
    for _kind, _member, _array, _count in re.findall(r"(\w+) (\w+)(\[(\d*)\])?;", _members):
        _part = _types.get(_kind) or getattr(types, _kind)
        if _array:
            _part = types.array[_part, int(_count)] if _count else types.sequence[_part]
        _made[_member] = _part
    _types[_name] = make_idl_struct(_name, f"{_module}.msg.dds_.{_name}_", _made)
LowCmd, LowState = _types["LowCmd"], _types["LowState"]
Request, Response = _types["Request"], _types["Response"]
RequestIdentity, RequestHeader = _types["RequestIdentity"], _types["RequestHeader"]
RequestLease, RequestPolicy = _types["RequestLease"], _types["RequestPolicy"]
ResponseHeader, ResponseStatus = _types["ResponseHeader"], _types["ResponseStatus"]

# --- Bytes --------------------------------------------------------------------------------------

HEADER = b"\x00\x01\x00\x00"
"""Of a serialized message: CDR version 1, little-endian, no options."""
_READABLE = (b"\x00\x01", b"\x00\x07")
"""Little-endian CDR of versions 1 and 2, which differ only for members of 8 bytes."""
_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
# Place of the first motor's mode on the wire, right after the member before it, and in the C image.
_FIRST_MOTOR = {LowCmd: (22, 24), LowState: (77, 80)}


@cache
def record(message: Any) -> np.dtype[Any]:
    """The C image of an IDL type of fixed size (numbers, arrays, structs) as a NumPy record."""

    def of(member: Any) -> np.dtype[Any]:
        if hasattr(member, "__idl__"):
            hints = get_type_hints(member, include_extras=True)
            return np.dtype([(name, of(hint)) for name, hint in hints.items()], align=True)
        kind = member.__metadata__[-1]
        if isinstance(kind, str):  # a number by its name, such as uint8
            return np.dtype(kind)
        return np.dtype((of(kind.subtype), (kind.length,)))

    return of(message).newbyteorder("<")


@cache
def _mask(message: Any) -> NDArray[np.uint8]:
    """The C image with 0 for padding and 255 for all other bytes."""
    packed: Any = repack_fields(record(message), recurse=True)
    mask = np.zeros(1, dtype=record(message))
    mask[:] = np.frombuffer(b"\xff" * packed.itemsize, dtype=packed)
    return mask.view(np.uint8)


def checksum(image: bytes) -> int:
    """Unitree's checksum of a message's C image, whose last word does not matter."""
    words = np.frombuffer(image, dtype="<u4")[:-1].astype(">u4").tobytes()
    return int(f"{~zlib.crc32(words.translate(_REVERSED)) & 0xFFFFFFFF:032b}"[::-1], 2)


def pack(message: Any, values: NDArray[Any]) -> bytes:
    """Serialize one record (1,) of the C image, whose padding is zero, with header and checksum."""
    image = values.tobytes()
    image = image[:-4] + checksum(image).to_bytes(4, "little")
    wire, place = _FIRST_MOTOR[message]
    mode = image[place : place + 1].ljust(place - wire, b"\x00")
    return HEADER + image[:wire] + mode + image[place + 4 :]


def unpack(message: Any, data: bytes) -> NDArray[Any]:
    """Read a message as one read-only record (1,) of its C image.

    RefusedError: `header`, `length` or `checksum`.
    """
    name, size = message.__name__, len(HEADER) + record(message).itemsize - 4
    if data[:2] not in _READABLE:
        raise RefusedError(
            "header", f"{name} begins with {data[:4].hex()}, expected {HEADER.hex()} (plain CDR)."
        )
    if len(data) != size:
        raise RefusedError("length", f"{name} has {len(data)} bytes, expected {size}.")
    (wire, place), sent = _FIRST_MOTOR[message], data[len(HEADER) :]
    image = sent[:wire].ljust(place, b"\x00") + sent[wire : wire + 1] + bytes(3) + sent[place:]
    image = (np.frombuffer(image, dtype=np.uint8) & _mask(message)).tobytes()
    found, right = int.from_bytes(image[-4:], "little"), checksum(image)
    if found != right:
        raise RefusedError("checksum", f"{name}.crc is {found:#010x}, expected {right:#010x}.")
    return np.frombuffer(image, dtype=record(message))


# --- States and commands ------------------------------------------------------------------------

HEAD = (0xFE, 0xEF)
LOW_LEVEL = 0xFF  # `level_flag` of a command to the motors
SERVO = 0x01  # `mode` of a motor that is on
# `q` and `dq` of a motor whose position or speed is not controlled (PosStopF, VelStopF).
POS_STOP, VEL_STOP = 2.146e9, 16000.0
VIRTUAL = (0x4E4F5250, 0x4D49534B)  # `sn` that identifies a virtual robot: `PRONKSIM`
TICKS_PER_S = 1000
STATE_RATE_HZ = 500.0
_JOINTS = 12
_IMU = 10  # numbers: quaternion, gyroscope, accelerometer
# Plausible targets and gains [rad, N m/rad, N m s/rad]: no joint turns twice, and these gains are
# ten times the usual ones.
_MOST = {"position": 4.0 * math.pi, "stiffness": 1000.0, "damping": 100.0}


class JointMap(NamedTuple):
    """How a robot's joints and the motors of a message correspond."""

    sign: Array  # a motor's angle is sign times the joint's, shape (12,)
    sink_damping: float  # with which the joints sink softly [N m s/rad]
    virtual_only: bool  # no real robot of this name uses these messages


_MAPS = {
    # Unitree's own deployments damp a Go2 with 3 to 8.
    "go2": JointMap(np.ones(_JOINTS), 3.0, virtual_only=False),
    "mini_cheetah": JointMap(np.tile([1.0, -1.0, -1.0], 4), 1.0, virtual_only=True),
}


def joint_map(robot: RobotSpec) -> JointMap:
    """The map of a robot; HardwareError for one that does not fit behind Unitree's messages."""
    if robot.name not in _MAPS:
        raise HardwareError(
            f"{robot.name} has no place in Unitree's messages; "
            f"the robots that have are {', '.join(_MAPS)}."
        )
    return _MAPS[robot.name]


def encode_command(joints: JointMap, command: Command) -> bytes:
    """Encode a `LowCmd` with its checksum; HardwareError for an impossible command."""
    check_command(command, _JOINTS)
    for name, most in _MOST.items():
        if (size := np.abs(getattr(command, name)).max()) > most:
            raise HardwareError(
                f"command.{name} is up to {size:g}, expected at most {most:g}; it was not sent."
            )
    position, stiffness, damping = (np.asarray(getattr(command, name)) for name in _MOST)
    message = _headed(LowCmd)
    motors = message["motor_cmd"]
    motors["mode"], motors["q"], motors["dq"] = SERVO, POS_STOP, VEL_STOP
    q, dq, _, kp, kd = _columns(motors, "q", "kd").T
    q[:] = np.where(stiffness > 0.0, joints.sign * position, POS_STOP)
    dq[:] = np.where(damping > 0.0, 0.0, VEL_STOP)
    kp[:], kd[:] = stiffness, damping
    return pack(LowCmd, message)


def decode_command(joints: JointMap, data: bytes) -> Command:
    """Decode a `LowCmd`. A position that is not controlled reads as 0.

    RefusedError as of `unpack`, or `head`, `level`, `mode`, `not finite`, `out of range`,
    `feed-forward` (a target speed or torque, which a `Command` does not have).
    """
    message = unpack(LowCmd, data)
    if tuple(message["head"][0]) != HEAD:
        raise RefusedError("head", f"LowCmd.head is {message['head'][0]}, expected {HEAD}.")
    if message["level_flag"][0] != LOW_LEVEL:
        raise RefusedError("level", f"level_flag is {message['level_flag'][0]}, expected 255.")
    on = message["motor_cmd"]["mode"][0, :_JOINTS]
    if on.max() > SERVO:
        raise RefusedError("mode", f"a motor's mode is {on.max()}, expected 1 (servo) or 0 (off).")
    # A motor that is off ignores the rest, and a part that is stopped has no gain.
    q, dq, tau, kp, kd = _finite("motor_cmd", _columns(message["motor_cmd"], "q", "kd")).T
    tau = tau * on
    stiffness, damping = kp * on * (q != np.float32(POS_STOP)), kd * on * (dq != VEL_STOP)
    position = np.where(stiffness > 0.0, joints.sign * q, 0.0)
    sizes = {"position": abs(position), "stiffness": stiffness, "damping": damping}
    for name, values in sizes.items():
        if not 0.0 <= values.min() <= values.max() <= _MOST[name]:
            raise RefusedError(
                "out of range",
                f"{name} is {values.min():g} to {values.max():g}, expected 0 to {_MOST[name]:g}.",
            )
    if tau.any() or (damping * dq).any():
        raise RefusedError(
            "feed-forward",
            "LowCmd commands a speed or a torque; only positions, stiffness and damping are "
            "understood.",
        )
    return Command(position=position, stiffness=stiffness, damping=damping)


def encode_state(joints: JointMap, state: State) -> bytes:
    """The `LowState` of a virtual robot; what it does not have (cells, remote) is zero."""
    message = _headed(LowState)
    message["sn"] = VIRTUAL
    stamp = state.time if state.robot_time is None else state.robot_time
    message["tick"] = round(stamp * TICKS_PER_S) % 2**32
    message["power_v"] = state.bus_voltage
    trunk = (state.orientation, state.gyro, state.accelerometer)
    message["imu_state"].view("<f4")[:_IMU] = np.concatenate(trunk)
    motors = message["motor_state"]
    motors["mode"][0, :_JOINTS] = SERVO
    q, dq, _, tau = _columns(motors, "q", "tau_est").T
    q[:], dq[:] = joints.sign * state.position, joints.sign * state.velocity
    tau[:] = joints.sign * state.torque
    if state.temperature is not None:
        motors["temperature"][0, :_JOINTS] = np.clip(np.rint(state.temperature), 0, 255)
    return pack(LowState, message)


class StateDecoder(StateNumbering):
    """Makes states of `rt/lowstate`, numbered by the robot's clock, for they carry no number."""

    def __init__(self, joints: JointMap, counts: Counter[str]) -> None:
        per_state = round(TICKS_PER_S / STATE_RATE_HZ)
        super().__init__(counts, STATE_RATE_HZ, per_state=per_state, bits=32)
        self.virtual = False  # whether the last message was a virtual robot's
        self._joints = joints

    def take(self, data: bytes, arrived: float) -> State | None:
        """Decode a message that arrived at a time [s]; temperatures that are all zero are none.

        RefusedError as of `unpack`, or `not finite`, `quaternion` (not of length 1).
        """
        message, sign = unpack(LowState, data), self._joints.sign
        motors = message["motor_state"]
        q, dq, _, tau = _finite("motor_state", _columns(motors, "q", "tau_est")).T
        imu = _finite("imu_state", message["imu_state"].view("<f4")[:_IMU])
        self.virtual = tuple(int(word) for word in message["sn"][0]) == VIRTUAL
        temperature, tick = motors["temperature"][0, :_JOINTS], int(message["tick"][0])
        values = {
            "position": sign * q,
            "velocity": sign * dq,
            "torque": sign * tau,
            "orientation": unit_quaternion("imu_state.quaternion", imu[:4]),
            "gyro": imu[4:7],
            "accelerometer": imu[7:],
            "bus_voltage": float(message["power_v"][0]),
            "robot_time": tick / TICKS_PER_S,
            "temperature": temperature.astype(np.float64) if temperature.any() else None,
        }
        return self.number(values, tick, arrived)


def _headed(message: Any) -> NDArray[Any]:
    values = np.zeros(1, dtype=record(message))
    values["head"], values["level_flag"] = HEAD, LOW_LEVEL
    return values


def _columns(motors: NDArray[Any], first: str, last: str) -> NDArray[np.float32]:
    """The numbers from one member of the twelve motors to another, shape (12, members); a view."""
    fields = motors.dtype.fields
    assert fields is not None
    words = motors.view("<f4").reshape(motors.size, -1)
    return words[:_JOINTS, fields[first][1] // 4 : fields[last][1] // 4 + 1]


def _finite(name: str, values: NDArray[np.float32]) -> Array:
    """Convert to float64; refuse what is not finite."""
    if not np.isfinite(values).all():
        raise RefusedError("not finite", f"{name} holds a number that is not finite.")
    return values.astype(np.float64)
