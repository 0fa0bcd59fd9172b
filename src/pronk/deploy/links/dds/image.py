"""Images of Unitree's messages: in the memory of C, on the wire, and the checksum.

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

import zlib
from dataclasses import dataclass
from functools import cache
from typing import Any, get_type_hints

import numpy as np
from numpy.lib.recfunctions import repack_fields
from numpy.typing import NDArray

from pronk.deploy.links.dds.messages import LowCmd, LowState
from pronk.robots.machine import RefusedError

HEADER = b"\x00\x01\x00\x00"
"""Start of a serialized message: CDR version 1, little-endian, no options."""
_READABLE_HEADERS = (b"\x00\x01", b"\x00\x07")
"""Little-endian CDR of versions 1 and 2, which differ only for members of 8 bytes."""
_CRC_BYTES = 4
_REVERSED_BITS = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


@dataclass(frozen=True, kw_only=True)
class _FirstMotor:
    """Place of the first motor's mode, the one place where the two images differ."""

    wire: int
    """Offset on the wire after the header, right after the member before it [bytes]."""
    image: int
    """Offset in the C image, where it is padded to 4 bytes [bytes]."""


_FIRST_MOTOR: dict[Any, _FirstMotor] = {
    LowCmd: _FirstMotor(wire=22, image=24),
    LowState: _FirstMotor(wire=77, image=80),
}


@cache
def c_image_dtype(message: Any) -> np.dtype[Any]:
    """The C image of an IDL type of fixed size (numbers, arrays, structs) as a NumPy record."""
    columns = []
    for name, member in get_type_hints(message, include_extras=True).items():
        columns.append((name, _member_dtype(member)))
    return np.dtype(columns, align=True).newbyteorder("<")


def _member_dtype(member: Any) -> np.dtype[Any]:
    """The C image of a member: a struct, a number, or an array of either."""
    if hasattr(member, "__idl__"):
        return c_image_dtype(member)
    annotation = member.__metadata__[-1]
    if isinstance(annotation, str):  # a number by its name, such as uint8
        return np.dtype(annotation)
    return np.dtype((_member_dtype(annotation.subtype), (annotation.length,)))


@cache
def _mask(message: Any) -> NDArray[np.uint8]:
    """The C image with 0 for padding and 255 for all other bytes."""
    packed: Any = repack_fields(c_image_dtype(message), recurse=True)
    mask = np.zeros(1, dtype=c_image_dtype(message))
    mask[:] = np.frombuffer(b"\xff" * packed.itemsize, dtype=packed)
    return mask.view(np.uint8)


def image_checksum(image: bytes) -> int:
    """Compute Unitree's checksum of a message's C image, whose last word does not matter."""
    words = np.frombuffer(image, dtype="<u4")[:-1].astype(">u4").tobytes()
    crc = ~zlib.crc32(words.translate(_REVERSED_BITS)) & 0xFFFFFFFF
    return int(f"{crc:032b}"[::-1], 2)


def serialize_image(message: Any, record: NDArray[Any]) -> bytes:
    """Serialize a C image with header and checksum.

    Args:
        message: IDL type of the message, `LowCmd` or `LowState`.
        record: Its C image, shape (1,), with zeros as padding.
    """
    image = record.tobytes()
    image = image[:-_CRC_BYTES] + image_checksum(image).to_bytes(_CRC_BYTES, "little")
    first = _FIRST_MOTOR[message]
    mode = image[first.image : first.image + 1]
    padding = bytes(first.image - first.wire - 1)
    return HEADER + image[: first.wire] + mode + padding + image[first.image + 4 :]


def deserialize_image(message: Any, data: bytes) -> NDArray[Any]:
    """Read a message as its C image.

    Args:
        message: IDL type of the message, `LowCmd` or `LowState`.
        data: The message with its header.

    Returns:
        A read-only record, shape (1,).

    Raises:
        RefusedError: `header`, `length` or `checksum`.
    """
    name = message.__name__
    if data[:2] not in _READABLE_HEADERS:
        raise RefusedError(
            "header", f"{name} begins with {data[:4].hex()}, expected {HEADER.hex()} (plain CDR)."
        )
    dtype = c_image_dtype(message)
    size = len(HEADER) + dtype.itemsize - 4
    if len(data) != size:
        raise RefusedError("length", f"{name} has {len(data)} bytes, expected {size}.")
    first = _FIRST_MOTOR[message]
    body = data[len(HEADER) :]
    before = body[: first.wire].ljust(first.image, b"\x00")
    mode = body[first.wire : first.wire + 1] + bytes(3)
    padded = np.frombuffer(before + mode + body[first.image :], dtype=np.uint8)
    image = (padded & _mask(message)).tobytes()
    sent_checksum = int.from_bytes(image[-_CRC_BYTES:], "little")
    checksum = image_checksum(image)
    if sent_checksum != checksum:
        raise RefusedError(
            "checksum", f"{name}.crc is {sent_checksum:#010x}, expected {checksum:#010x}."
        )
    return np.frombuffer(image, dtype=dtype)
