"""MCAP files: JSON messages written as they come, and messages read as far as the file is sound.

Every topic has its JSON Schema in the file, so that Foxglove and PlotJuggler show it. The `mcap`
library reads records; this module opens the chunks itself, because a file may be cut anywhere and
may claim to unpack to more than there is memory.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import lz4.frame  # type: ignore[import-untyped]
import msgspec
import orjson
import zstandard
from mcap.exceptions import EndOfFile, RecordLengthLimitExceeded
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk, get_chunk_data_stream
from mcap.writer import CompressionType, IndexType, Writer

from pronk.errors import LogError
from pronk.files import SIZE_LIMIT, max_bytes

NUMBER: dict[str, Any] = {"type": "number"}
INTEGER: dict[str, Any] = {"type": "integer"}
STRING: dict[str, Any] = {"type": "string"}
BOOLEAN: dict[str, Any] = {"type": "boolean"}
NUMBERS: dict[str, Any] = {"type": "array", "items": NUMBER}
STRINGS: dict[str, Any] = {"type": "array", "items": STRING}

_RECORD_BYTES = 400
"""What a message takes in memory beside its data, about [bytes]."""
_MESSAGE = struct.Struct("<BQHIQQ")
"""Beginning of a message: opcode, length of what follows, channel, sequence, times."""
_MOST_CHUNK = 256 * 2**20
"""Largest size of one unpacked chunk [bytes]; writers use 1 to 8 MiB."""


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
        data = orjson.dumps(body, option=orjson.OPT_SERIALIZE_NUMPY)
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
    """The rest of the file cannot be read; what came before can."""


class TooLargeError(DamagedError):
    """The file takes more memory than the limit."""


class Record(msgspec.Struct, frozen=True, gc=False):
    """One message; the garbage collector skips the many of a file."""

    topic: str
    encoding: str
    """Encoding of the data, for instance `json` or `cdr`."""
    schema: Schema | None
    log_time: int
    """When it was received [ns]."""
    data: bytes


def records(stream: IO[bytes], size: int, most: int | None = None) -> Iterator[list[Record]]:
    """Messages of a file, chunk by chunk, in the order written.

    No record can be longer than the file's `size`, and all messages may take `most` [bytes];
    `max_bytes` if left out. A DamagedError says that the file ends early, or a chunk's checksum
    does not fit; what was yielded before is sound.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    unpacked, most = 0, most or max_bytes()
    reader = _Reader(stream, emit_chunks=True, record_size_limit=size)
    try:
        for record in reader.records:
            inside: Sequence[McapRecord] = [record]
            if isinstance(record, Chunk):
                unpacked += record.uncompressed_size
                if unpacked > most:
                    raise TooLargeError(f"its chunks unpack to more than {most >> 20} MiB")
                inside = _contents(_unpacked(record))
            batch: list[Record] = []
            for item in inside:
                if isinstance(item, Channel):
                    channels[item.id] = item
                elif isinstance(item, Schema):
                    schemas[item.id] = item
                elif isinstance(item, Message):
                    if item.channel_id not in channels:
                        raise DamagedError(f"channel {item.channel_id} is not declared")
                    channel = channels[item.channel_id]
                    schema = schemas.get(channel.schema_id)
                    encoding = channel.message_encoding
                    batch.append(Record(channel.topic, encoding, schema, item.log_time, item.data))
            unpacked += _RECORD_BYTES * len(batch)
            if unpacked > most:
                raise TooLargeError(f"its messages take more than {most >> 20} MiB")
            yield batch
    except DamagedError:
        raise
    except (EndOfFile, RecordLengthLimitExceeded, struct.error):
        raise DamagedError("it ends in the middle of a record") from None
    except Exception as error:
        # The library raises many types on a damaged record.
        words = " ".join(str(error).split())[:120]
        raise DamagedError(f"{type(error).__name__} {words}".rstrip()) from None


class _Reader(StreamReader):
    """Passes over the indices of messages, which nothing here uses."""

    def _read_record(self, opcode: int, length: int) -> McapRecord | None:
        if opcode != Opcode.MESSAGE_INDEX:
            return super()._read_record(opcode, length)
        self._stream.read2()
        # Entries of 16 bytes, as many as it claims: blocks, as the claim may be false.
        end = self._stream.read4() + self._stream.count
        while (left := end - self._stream.count) > 0:
            self._stream.read(min(-(-left // 16) * 16, 2**16))
        return None


def _contents(chunk: Chunk) -> Sequence[McapRecord]:
    """The records of an unpacked chunk. Where all are whole messages, each is read in one step."""
    get_chunk_data_stream(chunk, validate_crc=True)
    found: list[McapRecord] = []
    data, at = chunk.data, 0
    while at + _MESSAGE.size <= len(data):
        opcode, length, channel, sequence, logged, published = _MESSAGE.unpack_from(data, at)
        first, at = at + _MESSAGE.size, at + 9 + length
        if opcode != Opcode.MESSAGE or not first <= at <= len(data):
            break
        found.append(Message(channel, logged, data[first:at], published, sequence))
    else:
        if at == len(data):
            return found
    return breakup_chunk(chunk)


def _unpacked(chunk: Chunk) -> Chunk:
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
    return replace(chunk, compression="", data=data)


def read_records(path: Path) -> tuple[list[Record], str]:
    """Every readable message of a file, and what ended the reading early ("" if nothing did).

    No such file, no message in it, and more than the limit are LogErrors.
    """
    found: list[Record] = []
    damage = ""
    try:
        with path.open("rb") as stream:
            for batch in records(stream, path.stat().st_size):
                found += batch
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror or error}).") from None
    except TooLargeError as error:
        raise LogError(f"{path}: {error}; split it, or set {SIZE_LIMIT} to more.") from None
    except DamagedError as error:
        damage = str(error)
    if not found:
        raise LogError(f"{path}: not a readable MCAP file ({damage or 'it has no messages'}).")
    return found, damage
