"""MCAP files: JSON messages written as they come, and messages read as far as the file is sound.

Every topic has its JSON Schema in the file, so that Foxglove and PlotJuggler show it. The `mcap`
library writes files and parses the records that are few: schemas, channels and the headers of
chunks. Messages are read here, because that takes 0.12 s for a log of 126 s at 500 Hz where the
library takes 0.27 s, which is more than parsing the messages takes. A file may be cut anywhere: the
format (https://mcap.dev/spec) is a sequence of records, each an opcode, a length and its content.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO, Any

import lz4.frame  # type: ignore[import-untyped]
import msgspec
import numpy as np
import orjson
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Schema
from mcap.writer import MCAP0_MAGIC, CompressionType, IndexType, Writer

from pronk.errors import LogError
from pronk.files import SIZE_LIMIT, max_bytes

NUMBER: dict[str, Any] = {"type": "number"}
INTEGER: dict[str, Any] = {"type": "integer"}
STRING: dict[str, Any] = {"type": "string"}
BOOLEAN: dict[str, Any] = {"type": "boolean"}
NUMBERS: dict[str, Any] = {"type": "array", "items": NUMBER}
STRINGS: dict[str, Any] = {"type": "array", "items": STRING}

_RECORD_BYTES = 400
"""Memory that a message takes beside its data, about [bytes]."""
_PREFIX = struct.Struct("<BQ")
"""Opcode of a record and the length of its content [bytes]."""
_MESSAGE = struct.Struct("<HIQQ")
"""Head of a message: channel, sequence number, log time and publish time [ns]; its data follow."""
_MOST_CHUNK = 256 * 2**20
"""Largest size of one unpacked chunk [bytes]; writers use 1 to 8 MiB."""


def _as_list(value: object) -> object:
    """Return an array that orjson does not take, as one that is not contiguous, as a list."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} cannot be written to a log")


class McapWriter:
    """Writes JSON messages. What was flushed stays readable whatever comes after."""

    def __init__(self, path: Path, topics: Mapping[str, Mapping[str, Any]]) -> None:
        """Open `path`, which is replaced; its folder is made.

        `topics` maps each topic to the properties of its messages, as JSON Schema has them.
        """
        path.parent.mkdir(parents=True, exist_ok=True)
        self._stream: IO[bytes] = path.open("wb")
        self._writer = Writer(
            self._stream, compression=CompressionType.ZSTD, index_types=IndexType.ALL
        )
        self._writer.start(profile="", library="pronk")
        self._channels: dict[str, int] = {}
        for topic, properties in topics.items():
            name = "pronk." + topic.removeprefix("/").replace("/", ".")
            schema = {"title": name, "type": "object", "properties": properties}
            schema_id = self._writer.register_schema(name, "jsonschema", orjson.dumps(schema))
            self._channels[topic] = self._writer.register_channel(topic, "json", schema_id)

    def metadata(self, values: Mapping[str, str]) -> None:
        """Write named strings about the file."""
        self._writer.add_metadata("pronk", dict(values))

    def put(self, topic: str, time: float, body: Mapping[str, Any]) -> None:
        """Write a message; `time` is its log time [s]. NaN and infinity become null."""
        stamp = max(0, round(time * 1e9))
        data = orjson.dumps(body, default=_as_list, option=orjson.OPT_SERIALIZE_NUMPY)
        self._writer.add_message(self._channels[topic], stamp, data, stamp)

    def flush(self) -> None:
        """Finish the chunk and pass everything to the operating system."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._stream.flush()

    def close(self) -> None:
        """Write the index and close the file."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.close()


class DamagedError(Exception):
    """The file cannot be read beyond some record; what came before can."""


class TooLargeError(DamagedError):
    """The file takes more memory than the limit."""


class Record(msgspec.Struct, frozen=True, gc=False):
    """One message of a file; the garbage collector does not track it, as a file has many."""

    topic: str
    """Topic of its channel."""
    encoding: str
    """Encoding of the data, for instance `json` or `cdr`."""
    schema: Schema | None
    """Schema of its channel, if it has one."""
    log_time: int
    """Time at which it was received [ns]."""
    data: bytes
    """The encoded message."""


Wanted = Callable[[Record], bool]
"""Says whether a message is kept; of a topic whose messages are not, the first is kept, empty."""


def records(
    stream: IO[bytes], size: int, memory_limit: int | None = None, is_wanted: Wanted | None = None
) -> Iterator[list[Record]]:
    """Read the messages of a file, chunk by chunk, in the order written.

    Args:
        stream: The file, at its beginning.
        size: Size of the file, which no record can exceed [bytes].
        memory_limit: Most memory that all messages may take [bytes]; `max_bytes()` if None.
        is_wanted: Says which messages are kept and counted; all of them if None.

    Yields:
        Messages of one chunk, or one message that stands outside of chunks.

    Raises:
        DamagedError: The file ends early, or the checksum of a chunk does not fit; what was yielded
            before is sound.
        TooLargeError: The messages take more memory than allowed.
    """
    limit = max_bytes() if memory_limit is None else memory_limit
    memory = 0
    messages = _MessageReader()
    keep = None if is_wanted is None else MessageFilter(is_wanted)
    try:
        for opcode, content in _file_records(stream, size):
            if opcode == Opcode.CHUNK:
                chunk = Chunk.read(ReadDataStream(BytesIO(content)))
                if keep is None:
                    memory += chunk.uncompressed_size
                if memory > limit:
                    raise TooLargeError(f"its chunks unpack to more than {limit >> 20} MiB")
                batch = messages.read(_unpacked_records(chunk))
            else:
                batch = messages.read([(opcode, content)])
            if keep is not None:
                batch = keep.kept(batch)
                memory += sum(len(record.data) for record in batch)
            memory += _RECORD_BYTES * len(batch)
            if memory > limit:
                raise TooLargeError(f"its messages take more than {limit >> 20} MiB")
            if batch:
                yield batch
    except DamagedError:
        raise
    except (EndOfFile, struct.error):
        raise DamagedError("it ends in the middle of a record") from None
    except Exception as error:
        # The library and the decompressors raise many types on a damaged record.
        words = " ".join(str(error).split())[:120]
        raise DamagedError(f"{type(error).__name__} {words}".rstrip()) from None


def _file_records(stream: IO[bytes], size: int) -> Iterator[tuple[int, bytes]]:
    """Opcode and content of each record of a file, from its beginning to its footer."""
    if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise DamagedError("it does not begin as an MCAP file does")
    opcode = 0
    while opcode != Opcode.FOOTER:
        opcode, length = _PREFIX.unpack(stream.read(_PREFIX.size))
        content = stream.read(length) if length <= size else b""
        if len(content) < length:
            raise DamagedError("it ends in the middle of a record")
        yield opcode, content
    if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise DamagedError("it does not end as an MCAP file does")


def _unpacked_records(chunk: Chunk) -> Iterator[tuple[int, bytes]]:
    """Opcode and content of each record in a chunk."""
    data = _unpacked(chunk)
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise DamagedError("the checksum of a chunk does not fit")
    position = 0
    while position < len(data):
        opcode, length = _PREFIX.unpack_from(data, position)
        start = position + _PREFIX.size
        position = start + length
        if position > len(data):
            raise DamagedError("a record reaches beyond its chunk")
        yield opcode, data[start:position]


def _unpacked(chunk: Chunk) -> bytes:
    """Unpack the data of a chunk; no more memory is taken than the chunk claims to need."""
    size = chunk.uncompressed_size
    if size > _MOST_CHUNK:
        raise DamagedError(f"a chunk claims to unpack to {size >> 20} MiB")
    if chunk.compression == "zstd":
        data = zstandard.ZstdDecompressor().stream_reader(chunk.data).read(size + 1)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise DamagedError(f"a chunk is compressed with {chunk.compression!r}, which is unknown")
    if len(data) != size:
        raise DamagedError(f"a chunk unpacks to {len(data)} bytes instead of {size}")
    return bytes(data)


@dataclass
class _MessageReader:
    """Reads messages by the channels and schemas that the file has declared before them."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)

    def read(self, contents: Iterable[tuple[int, bytes]]) -> list[Record]:
        """Read records, given by opcode and content; returns the messages among them."""
        messages = []
        for opcode, content in contents:
            if opcode == Opcode.MESSAGE:
                number, _, log_time, _ = _MESSAGE.unpack_from(content)
                channel = self.channels.get(number)
                if channel is None:
                    raise DamagedError(f"channel {number} is not declared")
                schema = self.schemas.get(channel.schema_id)
                data = content[_MESSAGE.size :]
                message = Record(channel.topic, channel.message_encoding, schema, log_time, data)
                messages.append(message)
            elif opcode == Opcode.SCHEMA:
                schema = Schema.read(ReadDataStream(BytesIO(content)))
                self.schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(ReadDataStream(BytesIO(content)))
                self.channels[channel.id] = channel
        return messages


class MessageFilter:
    """Keeps the messages that are wanted, and one empty message of every other topic."""

    def __init__(self, is_wanted: Wanted) -> None:
        """Begin without a topic."""
        self._is_wanted = is_wanted
        self._topics: set[str] = set()

    def kept(self, messages: Iterable[Record]) -> list[Record]:
        """Return the messages that are kept."""
        kept_messages = []
        for message in messages:
            if self._is_wanted(message):
                kept_messages.append(message)
            elif message.topic not in self._topics:
                kept_messages.append(msgspec.structs.replace(message, data=b""))
            self._topics.add(message.topic)
        return kept_messages


def read_records(path: Path, is_wanted: Wanted | None = None) -> tuple[list[Record], str]:
    """Read the messages of a file as far as it is sound.

    Args:
        path: The file.
        is_wanted: Says which messages are kept; all of them if None.

    Returns:
        The messages in the order written, and why reading ended early ("" if it did not).

    Raises:
        LogError: There is no such file, no message in it, or more than the limit of memory.
    """
    messages: list[Record] = []
    damage = ""
    try:
        with path.open("rb") as stream:
            for batch in records(stream, path.stat().st_size, is_wanted=is_wanted):
                messages += batch
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror or error}).") from None
    except TooLargeError as error:
        raise LogError(f"{path}: {error}; split it, or set {SIZE_LIMIT} to more.") from None
    except DamagedError as error:
        damage = str(error)
    if not messages:
        raise LogError(f"{path}: not a readable MCAP file ({damage or 'it has no messages'}).")
    return messages, damage
