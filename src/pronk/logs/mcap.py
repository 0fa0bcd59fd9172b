"""MCAP files: JSON messages written as they come, and messages read as far as the file is sound.

Every topic has its JSON Schema in the file, so that Foxglove and PlotJuggler show it. The `mcap`
library reads records; this module opens the chunks itself, because a file may be cut anywhere and
may claim to unpack to more than there is memory.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import lz4.frame  # type: ignore[import-untyped]
import orjson
import zstandard
from mcap.exceptions import EndOfFile, RecordLengthLimitExceeded
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, IndexType, Writer

NUMBER: dict[str, Any] = {"type": "number"}
INTEGER: dict[str, Any] = {"type": "integer"}
STRING: dict[str, Any] = {"type": "string"}
BOOLEAN: dict[str, Any] = {"type": "boolean"}
NUMBERS: dict[str, Any] = {"type": "array", "items": NUMBER}
STRINGS: dict[str, Any] = {"type": "array", "items": STRING}

MOST_BYTES = 2 * 2**30
"""Largest size that all chunks of a file may unpack to by default [bytes]."""
_MOST_CHUNK = 256 * 2**20
"""Largest size of one unpacked chunk [bytes]; writers use 1 to 8 MiB."""


class McapWriter:
    """Writes JSON messages. What was flushed stays readable whatever comes after."""

    def __init__(self, path: Path, topics: Mapping[str, Mapping[str, Any]]) -> None:
        """Open `path`, which is replaced.

        Args:
            path: The file; its folder is made.
            topics: Topic to the properties of its messages, as JSON Schema has them.

        Raises:
            OSError: The file cannot be made.
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
        """Finish the chunk and hand everything to the operating system."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._stream.flush()

    def close(self) -> None:
        """Write the index and close the file."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.close()


class DamagedError(Exception):
    """The rest of the file cannot be read; what came before can."""


@dataclass(frozen=True, slots=True)
class Record:
    """One message."""

    topic: str
    encoding: str
    """Encoding of the data, for instance `json` or `cdr`."""
    schema: Schema | None
    log_time: int
    """When it was received [ns]."""
    data: bytes


def records(stream: IO[bytes], size: int, most: int = MOST_BYTES) -> Iterator[list[Record]]:
    """Messages of a file, chunk by chunk, in the order written.

    Args:
        stream: The file.
        size: Its length [bytes]; no record can be longer.
        most: Largest size that all its chunks may unpack to [bytes].

    Raises:
        DamagedError: The file ends early, or a chunk's checksum does not fit. What was yielded
            before is sound.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    unpacked = 0
    reader = StreamReader(stream, emit_chunks=True, record_size_limit=size)
    try:
        for record in reader.records:
            if isinstance(record, Chunk):
                unpacked += record.uncompressed_size
                if unpacked > most:
                    raise DamagedError(f"its chunks unpack to more than {most >> 20} MiB")
                inside = breakup_chunk(_unpacked(record))
            elif isinstance(record, Schema | Channel | Message):
                inside = [record]
            else:
                continue
            batch = []
            for item in inside:
                if isinstance(item, Message):
                    channel = channels.get(item.channel_id)
                    if channel is None:
                        raise DamagedError(
                            f"a message on channel {item.channel_id}, which is not declared"
                        )
                    batch.append(
                        Record(
                            topic=channel.topic,
                            encoding=channel.message_encoding,
                            schema=schemas.get(channel.schema_id),
                            log_time=item.log_time,
                            data=item.data,
                        )
                    )
                elif isinstance(item, Channel):
                    channels[item.id] = item
                elif isinstance(item, Schema):
                    schemas[item.id] = item
            yield batch
    except DamagedError:
        raise
    except (EndOfFile, RecordLengthLimitExceeded, struct.error):
        raise DamagedError("it ends in the middle of a record") from None
    except Exception as error:
        # The library raises many types on a damaged record.
        words = " ".join(str(error).split())[:120]
        raise DamagedError(f"{type(error).__name__} {words}".rstrip()) from None


def _unpacked(chunk: Chunk) -> Chunk:
    """The chunk with its data unpacked and checked.

    Raises:
        DamagedError: It does not unpack, is too large, or its checksum does not fit.
    """
    if chunk.uncompressed_size > _MOST_CHUNK:
        raise DamagedError(f"a chunk claims to unpack to {chunk.uncompressed_size >> 20} MiB")
    limit = chunk.uncompressed_size
    try:
        if chunk.compression == "zstd":
            data = zstandard.ZstdDecompressor().stream_reader(chunk.data).read(limit + 1)
        elif chunk.compression == "lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=limit + 1)
        elif chunk.compression == "":
            data = chunk.data
        else:
            raise DamagedError(
                f"a chunk is compressed with {chunk.compression!r}, which is unknown"
            )
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise DamagedError(
            f"a chunk does not unpack: {' '.join(str(error).split())[:120]}"
        ) from None
    if len(data) != limit:
        raise DamagedError(f"a chunk unpacks to {len(data)} bytes instead of {limit}")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise DamagedError("the checksum of a chunk does not fit")
    return Chunk(
        compression="",
        data=data,
        message_start_time=chunk.message_start_time,
        message_end_time=chunk.message_end_time,
        uncompressed_crc=0,
        uncompressed_size=limit,
    )
