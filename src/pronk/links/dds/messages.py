"""Unitree's messages over DDS: IDL types, their two byte images, and the checksum.

Layouts: `unitree_go` and `unitree_api` of unitree_sdk2, every type final, members in wire order.
Joint quantities are at the joint, in rad, rad/s and N m; x is forwards, y left, z up; quaternions
are w, x, y, z. Slots 0 to 11 of the motors are FR, FL, RR, RL, each hip, thigh, calf; slots 12 to
19 drive nothing on a Go2.

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
"""

from __future__ import annotations

import re
import zlib
from functools import cache
from typing import Any, get_type_hints

import numpy as np
from cyclonedds.idl import make_idl_struct, types
from numpy.lib.recfunctions import repack_fields
from numpy.typing import NDArray

from pronk.links.machine import RefusedError

HEADER = b"\x00\x01\x00\x00"
"""Of a serialized message: CDR version 1, little-endian, no options."""
_READABLE = (b"\x00\x01", b"\x00\x07")
"""Little-endian CDR of versions 1 and 2, which differ only for members of 8 bytes."""
_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))

MOTORS = 20
"""Motor slots of a message."""
_known: dict[str, Any] = {"string": str, "bool": bool}


def _struct(module: str, name: str, members: str) -> Any:
    """The IDL type `MODULE::msg::dds_::NAME_` of `type name`, `type name[count]`, `type name[]`."""
    made = {}
    for kind, member, array, count in re.findall(r"(\w+) (\w+)(\[(\d*)\])?;", members):
        part = _known[kind] if kind in _known else getattr(types, kind)
        if array:
            part = types.array[part, int(count)] if count else types.sequence[part]
        made[member] = part
    _known[name] = make_idl_struct(name, f"{module}.msg.dds_.{name}_", made)
    return _known[name]


# --- rt/lowcmd ----------------------------------------------------------------------------------

# A motor gives tau + kp (q - q_now) + kd (dq - dq_now); mode 1 is servo, 0 off.
_struct(
    "unitree_go",
    "MotorCmd",
    "uint8 mode; float32 q; float32 dq; float32 tau; float32 kp; float32 kd; uint32 reserve[3];",
)
_struct("unitree_go", "BmsCmd", "uint8 off; uint8 reserve[3];")
LowCmd = _struct(
    "unitree_go",
    "LowCmd",
    "uint8 head[2]; uint8 level_flag; uint8 frame_reserve; uint32 sn[2]; uint32 version[2];"
    "uint16 bandwidth; MotorCmd motor_cmd[20]; BmsCmd bms_cmd; uint8 wireless_remote[40];"
    "uint8 led[12]; uint8 fan[2]; uint8 gpio; uint32 reserve; uint32 crc;",
)

# --- rt/lowstate --------------------------------------------------------------------------------

_struct(
    "unitree_go",
    "IMUState",
    "float32 quaternion[4]; float32 gyroscope[3]; float32 accelerometer[3]; float32 rpy[3];"
    "uint8 temperature;",
)
_struct(
    "unitree_go",
    "MotorState",
    "uint8 mode; float32 q; float32 dq; float32 ddq; float32 tau_est; float32 q_raw;"
    "float32 dq_raw; float32 ddq_raw; uint8 temperature; uint32 lost; uint32 reserve[2];",
)
_struct(
    "unitree_go",
    "BmsState",
    "uint8 version_high; uint8 version_low; uint8 status; uint8 soc; int32 current; uint16 cycle;"
    "uint8 bq_ntc[2]; uint8 mcu_ntc[2]; uint16 cell_vol[15];",
)
LowState = _struct(  # tick is the robot's clock in ms
    "unitree_go",
    "LowState",
    "uint8 head[2]; uint8 level_flag; uint8 frame_reserve; uint32 sn[2]; uint32 version[2];"
    "uint16 bandwidth; IMUState imu_state; MotorState motor_state[20]; BmsState bms_state;"
    "int16 foot_force[4]; int16 foot_force_est[4]; uint32 tick; uint8 wireless_remote[40];"
    "uint8 bit_flag; float32 adc_reel; uint8 temperature_ntc1; uint8 temperature_ntc2;"
    "float32 power_v; float32 power_a; uint16 fan_frequency[4]; uint32 reserve; uint32 crc;",
)

# --- rt/api/SERVICE/request and response --------------------------------------------------------

RequestIdentity = _struct("unitree_api", "RequestIdentity", "int64 id; int64 api_id;")
RequestLease = _struct("unitree_api", "RequestLease", "int64 id;")
RequestPolicy = _struct("unitree_api", "RequestPolicy", "int32 priority; bool noreply;")
RequestHeader = _struct(
    "unitree_api",
    "RequestHeader",
    "RequestIdentity identity; RequestLease lease; RequestPolicy policy;",
)
Request = _struct(
    "unitree_api", "Request", "RequestHeader header; string parameter; uint8 binary[];"
)
ResponseStatus = _struct("unitree_api", "ResponseStatus", "int32 code;")  # 0: done
ResponseHeader = _struct(
    "unitree_api", "ResponseHeader", "RequestIdentity identity; ResponseStatus status;"
)
Response = _struct("unitree_api", "Response", "ResponseHeader header; string data; uint8 binary[];")

# --- bytes --------------------------------------------------------------------------------------

# Place of the first motor's mode on the wire, right after the member before it, and in the C image.
_FIRST_MOTOR = {LowCmd: (22, 24), LowState: (77, 80)}


@cache
def record(message: Any) -> np.dtype[Any]:
    """The C image of an IDL type of fixed size (numbers, arrays, structs) as a NumPy record."""
    return _record(message).newbyteorder("<")


def _record(member: Any) -> np.dtype[Any]:
    if hasattr(member, "__idl__"):
        hints = get_type_hints(member, include_extras=True)
        return np.dtype([(name, _record(hint)) for name, hint in hints.items()], align=True)
    kind = member.__metadata__[-1]
    if isinstance(kind, str):  # a number by its name, such as uint8
        return np.dtype(kind)
    return np.dtype((_record(kind.subtype), (kind.length,)))


@cache
def _mask(message: Any) -> NDArray[np.uint8]:
    """The C image with 0 for padding and 255 for all other bytes."""
    packed: Any = repack_fields(record(message), recurse=True)
    mask = np.zeros(1, dtype=record(message))
    mask[:] = np.frombuffer(b"\xff" * packed.itemsize, dtype=packed)
    return mask.view(np.uint8)


def wire_size(message: Any) -> int:
    """Bytes of a message on the wire, without the header."""
    return record(message).itemsize - 4


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
    """Read a serialized message as one read-only record (1,) of its C image.

    Raises:
        RefusedError: `header`, `length` or `checksum`.
    """
    name, size = message.__name__, len(HEADER) + wire_size(message)
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
