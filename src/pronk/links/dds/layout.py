"""Where each member of a Unitree message lies in its bytes, and Unitree's checksum.

The same message has two images. In the memory of a C compiler a struct is aligned to its largest
member and padded to a multiple of it; the checksum is taken over that image. On the wire (CDR
version 1, little-endian) each number is aligned to its own size and nothing else is padded.

    LowCmd    812 bytes in C,  808 on the wire after 4 of header
    LowState 1180 bytes in C, 1176 on the wire after 4 of header

Both are derived here from the IDL types, so that a member is written down once. pronk works on the
C image as a NumPy record and moves bytes between the two: microseconds, where the general
serializer of cyclonedds takes a hundred or more.

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

from pronk.links.lcm.message import RefusedError

HEADER = b"\x00\x01\x00\x00"
"""Of a serialized message: CDR version 1, little-endian, no options."""
_READABLE = (b"\x00\x01", b"\x00\x07")
"""Little-endian CDR of versions 1 and 2, which differ only for members of 8 bytes."""
_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


@cache
def record(message: Any) -> np.dtype[Any]:
    """The C image of an IDL type of fixed size (numbers, arrays, structs) as a NumPy record."""
    return _record(message)[0]


def _record(member: Any) -> tuple[np.dtype[Any], int]:
    """Record and alignment of a member's type."""
    if not hasattr(member, "__idl__"):
        kind = member.__metadata__[-1]
        if isinstance(kind, str):  # a number by its name, such as uint8
            number = np.dtype(kind).newbyteorder("<")
            return number, number.itemsize
        element, alignment = _record(kind.subtype)
        return np.dtype((element, (kind.length,))), alignment
    names, formats, offsets, end, largest = [], [], [], 0, 1
    for name, hint in get_type_hints(member, include_extras=True).items():
        part, alignment = _record(hint)
        end += -end % alignment
        names.append(name)
        formats.append(part)
        offsets.append(end)
        end += part.itemsize
        largest = max(largest, alignment)
    fields = {"names": names, "formats": formats, "offsets": offsets}
    return np.dtype({**fields, "itemsize": end + -end % largest}), largest  # type: ignore[call-overload]


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
    """Serialize a record, checksum put in.

    Args:
        message: The IDL type.
        values: One record of its C image; padding must be zero. Shape (1,).

    Returns:
        Header and payload.
    """
    image = values.tobytes()
    image = image[:-4] + checksum(image).to_bytes(4, "little")
    data = np.frombuffer(image + b"\x00", dtype=np.uint8)
    return HEADER + data.take(_orders(message)[0]).tobytes()


def unpack(message: Any, data: bytes) -> NDArray[Any]:
    """A serialized message as a record of its C image.

    Args:
        message: The IDL type that it shall be.
        data: What came, from the header on.

    Returns:
        One record, shape (1,), read-only.

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
    said, right = int.from_bytes(image[-4:], "little"), checksum(image)
    if said != right:
        raise RefusedError("checksum", f"{name}.crc is {said:#010x}, expected {right:#010x}.")
    return np.frombuffer(image, dtype=record(message))
