"""Unitree's messages over DDS: IDL types, their two byte images, and the checksum.

Layouts: `unitree_go` and `unitree_api` of unitree_sdk2, every type final, members in wire order.
Joint quantities are at the joint, in rad, rad/s and N m; x is forwards, y left, z up; quaternions
are w, x, y, z. Slots 0 to 11 of the motors are FR, FL, RR, RL, each hip, thigh, calf; slots 12 to
19 drive nothing on a Go2.

The same message has two images. In the memory of a C compiler a struct is aligned to its largest
member and padded to a multiple of it; the checksum is taken over that image. On the wire (CDR
version 1, little-endian) each number is aligned to its own size and nothing else is padded.

    LowCmd    812 bytes in C,  808 on the wire after 4 of header
    LowState 1180 bytes in C, 1176 on the wire after 4 of header

Both follow from the IDL types. pronk works on the C image as a NumPy record and moves bytes between
the two: microseconds, where the general serializer of cyclonedds takes a hundred or more.

Checksum: CRC-32 with polynomial 0x04C11DB7, start 0xFFFFFFFF, not reflected, nothing added at the
end, over the little-endian 32-bit words of the C image but the last, each most significant bit
first. That is zlib's CRC-32 but for the order of bits and the last inversion.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from functools import cache
from typing import Any, get_type_hints

import numpy as np
from numpy.typing import NDArray

from pronk.errors import HardwareError
from pronk.links.machine import RefusedError

try:
    from cyclonedds.idl import make_idl_struct
    from cyclonedds.idl.types import (
        array,
        float32,
        int16,
        int32,
        int64,
        sequence,
        uint8,
        uint16,
        uint32,
    )
except ImportError:
    raise HardwareError(
        "the DDS link needs the package cyclonedds, which is not installed; "
        "install it with: pip install 'pronk[hardware]'."
    ) from None

HEADER = b"\x00\x01\x00\x00"
"""Of a serialized message: CDR version 1, little-endian, no options."""
_READABLE = (b"\x00\x01", b"\x00\x07")
"""Little-endian CDR of versions 1 and 2, which differ only for members of 8 bytes."""
_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))

MOTORS = 20
"""Motor slots of a message."""


def _struct(module: str, name: str, **members: Any) -> Any:
    """The IDL type `MODULE::msg::dds_::NAME_`."""
    return make_idl_struct(name, f"{module}.msg.dds_.{name}_", members)


# --- rt/lowcmd ----------------------------------------------------------------------------------

# A motor gives tau + kp (q - q_now) + kd (dq - dq_now).
MotorCmd = _struct(
    "unitree_go",
    "MotorCmd",
    mode=uint8,  # 1: servo, 0: off
    q=float32,
    dq=float32,
    tau=float32,
    kp=float32,
    kd=float32,
    reserve=array[uint32, 3],
)
BmsCmd = _struct("unitree_go", "BmsCmd", off=uint8, reserve=array[uint8, 3])
LowCmd = _struct(
    "unitree_go",
    "LowCmd",
    head=array[uint8, 2],
    level_flag=uint8,  # 0xFF: low level
    frame_reserve=uint8,
    sn=array[uint32, 2],
    version=array[uint32, 2],
    bandwidth=uint16,
    motor_cmd=array[MotorCmd, MOTORS],
    bms_cmd=BmsCmd,
    wireless_remote=array[uint8, 40],
    led=array[uint8, 12],
    fan=array[uint8, 2],
    gpio=uint8,
    reserve=uint32,
    crc=uint32,
)

# --- rt/lowstate --------------------------------------------------------------------------------

IMUState = _struct(
    "unitree_go",
    "IMUState",
    quaternion=array[float32, 4],
    gyroscope=array[float32, 3],
    accelerometer=array[float32, 3],
    rpy=array[float32, 3],
    temperature=uint8,
)
MotorState = _struct(
    "unitree_go",
    "MotorState",
    mode=uint8,
    q=float32,
    dq=float32,
    ddq=float32,
    tau_est=float32,
    q_raw=float32,
    dq_raw=float32,
    ddq_raw=float32,
    temperature=uint8,
    lost=uint32,
    reserve=array[uint32, 2],
)
BmsState = _struct(
    "unitree_go",
    "BmsState",
    version_high=uint8,
    version_low=uint8,
    status=uint8,
    soc=uint8,
    current=int32,
    cycle=uint16,
    bq_ntc=array[uint8, 2],
    mcu_ntc=array[uint8, 2],
    cell_vol=array[uint16, 15],
)
LowState = _struct(
    "unitree_go",
    "LowState",
    head=array[uint8, 2],
    level_flag=uint8,
    frame_reserve=uint8,
    sn=array[uint32, 2],
    version=array[uint32, 2],
    bandwidth=uint16,
    imu_state=IMUState,
    motor_state=array[MotorState, MOTORS],
    bms_state=BmsState,
    foot_force=array[int16, 4],
    foot_force_est=array[int16, 4],
    tick=uint32,  # the robot's clock, ms
    wireless_remote=array[uint8, 40],
    bit_flag=uint8,
    adc_reel=float32,
    temperature_ntc1=uint8,
    temperature_ntc2=uint8,
    power_v=float32,
    power_a=float32,
    fan_frequency=array[uint16, 4],
    reserve=uint32,
    crc=uint32,
)

# --- rt/api/SERVICE/request and response --------------------------------------------------------

RequestIdentity = _struct("unitree_api", "RequestIdentity", id=int64, api_id=int64)
RequestLease = _struct("unitree_api", "RequestLease", id=int64)
RequestPolicy = _struct("unitree_api", "RequestPolicy", priority=int32, noreply=bool)
RequestHeader = _struct(
    "unitree_api",
    "RequestHeader",
    identity=RequestIdentity,
    lease=RequestLease,
    policy=RequestPolicy,
)
Request = _struct(
    "unitree_api", "Request", header=RequestHeader, parameter=str, binary=sequence[uint8]
)
ResponseStatus = _struct("unitree_api", "ResponseStatus", code=int32)  # 0: done
ResponseHeader = _struct(
    "unitree_api", "ResponseHeader", identity=RequestIdentity, status=ResponseStatus
)
Response = _struct(
    "unitree_api", "Response", header=ResponseHeader, data=str, binary=sequence[uint8]
)

# --- bytes --------------------------------------------------------------------------------------


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


def _numbers(part: np.dtype[Any], at: int) -> Iterator[tuple[int, int]]:
    """Place in the C image and size of every number, in wire order."""
    if part.subdtype is not None:
        element, shape = part.subdtype
        for k in range(shape[0]):
            yield from _numbers(element, at + k * element.itemsize)
    elif part.fields is not None:
        for inner, offset, *_ in part.fields.values():
            yield from _numbers(inner, at + offset)
    else:
        yield at, part.itemsize


@cache
def _orders(message: Any) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """For each byte on the wire its place in the C image, and the other way round.

    Padding points to the byte after the last, which the callers set to zero.
    """
    image = record(message)
    to_wire: list[int] = []
    for at, size in _numbers(image, 0):
        to_wire += [image.itemsize] * (-len(to_wire) % size)
        to_wire += range(at, at + size)
    to_image = np.full(image.itemsize + 1, len(to_wire), dtype=np.intp)
    to_image[to_wire] = np.arange(len(to_wire))
    to_image[-1] = len(to_wire)
    return np.array(to_wire, dtype=np.intp), to_image[:-1]


def wire_size(message: Any) -> int:
    """Bytes of a message on the wire, without the header."""
    return len(_orders(message)[0])


def checksum(image: bytes) -> int:
    """Unitree's checksum of a message's C image, whose last word does not matter."""
    words = np.frombuffer(image, dtype="<u4")[:-1].astype(">u4").tobytes()
    return int(f"{~zlib.crc32(words.translate(_REVERSED)) & 0xFFFFFFFF:032b}"[::-1], 2)


def pack(message: Any, values: NDArray[Any]) -> bytes:
    """Serialize one record (1,) of the C image, whose padding is zero, with header and checksum."""
    image = values.tobytes()
    image = image[:-4] + checksum(image).to_bytes(4, "little")
    data = np.frombuffer(image + b"\x00", dtype=np.uint8)
    return HEADER + data.take(_orders(message)[0]).tobytes()


def unpack(message: Any, data: bytes) -> NDArray[Any]:
    """Read a serialized message as one read-only record (1,) of its C image.

    Raises:
        RefusedError: `header`, `length` or `checksum`.
    """
    to_wire, to_image = _orders(message)
    name, size = message.__name__, len(HEADER) + len(to_wire)
    if data[:2] not in _READABLE:
        raise RefusedError(
            "header", f"{name} begins with {data[:4].hex()}, expected {HEADER.hex()} (plain CDR)."
        )
    if len(data) != size:
        raise RefusedError("length", f"{name} has {len(data)} bytes, expected {size}.")
    payload = np.frombuffer(data[len(HEADER) :] + b"\x00", dtype=np.uint8)
    image = payload.take(to_image).tobytes()
    found, right = int.from_bytes(image[-4:], "little"), checksum(image)
    if found != right:
        raise RefusedError("checksum", f"{name}.crc is {found:#010x}, expected {right:#010x}.")
    return np.frombuffer(image, dtype=record(message))
