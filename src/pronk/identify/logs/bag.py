"""Bags of ROS 1 and ROS 2: their messages, decoded by rosbags with the definitions in the bag.

`rosbags` reads SQLite files (`.db3`) and bags of ROS 1 (`.bag`). MCAP files are read by `mcap`,
which reads what is left of one that was cut. What a file declares of sizes is checked before memory
is taken.
"""

from __future__ import annotations

import bz2
import re
import sqlite3
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.records import Schema

from pronk.errors import LogError, printable
from pronk.files import check_regular, check_size, max_bytes, read_yaml
from pronk.identify.logs.mcap import MessageFilter, Record, Wanted, read_records
from pronk.identify.logs.unitree import DEFINITIONS

METADATA = "metadata.yaml"
"""File that makes a folder a rosbag2."""
_MESSAGE_BYTES = 400
"""Memory that a message takes beside its data, about [bytes]."""
_MAX_DEFINITION = 2**18
"""Longest definition of a message [bytes]; LowState has 3 KiB."""


def read_bag(path: Path, is_wanted: Wanted) -> tuple[list[Record], str]:
    """Read the messages of a bag: an MCAP, SQLite or ROS 1 file, or the folder of a rosbag2.

    Args:
        path: The bag.
        is_wanted: Says which messages are kept, as bags hold images too; of every other topic the
            first message is kept, empty.

    Returns:
        The messages in the order of the file, and why reading ended early ("" if it did not).

    Raises:
        LogError: There is no bag, nothing in it, or more than the limit of memory.
    """
    files = bag_files(path)
    records: list[Record] = []
    damages = []
    for file in files:
        if file.suffix.lower() == ".mcap":
            messages, damage = read_records(file, is_wanted)
        elif file.suffix.lower() == ".bag":
            messages, damage = _read_ros1(file, is_wanted)
        else:
            messages, damage = _read_sqlite(file, _compression(path), is_wanted)
        records += messages
        if damage:
            damages.append(damage)
    size = sum(len(record.data) + _MESSAGE_BYTES for record in records)
    check_size(path, size, LogError)
    if not records:
        raise LogError(f"{path}: no messages in it.")
    return records, "; ".join(damages)


def bag_files(path: Path) -> list[Path]:
    """Files of a bag in the order in which they were recorded; a LogError if there are none."""
    files = [path]
    if path.is_dir():
        files = []
        if (path / METADATA).exists():
            body = read_yaml(path / METADATA, LogError)
            try:
                for name in body["rosbag2_bagfile_information"]["relative_file_paths"]:
                    # Up to version 3 the names hold the folder, which may have been renamed.
                    files.append(path / Path(str(name)).name)
            except (KeyError, TypeError):
                files = []
        if not files:
            files = sorted([*path.glob("*.mcap"), *path.glob("*.db3")])
    for file in files:
        check_regular(file, LogError)
        if not file.is_file():
            raise LogError(f"{file}: no such file, which {METADATA} names.")
    if not files:
        raise LogError(f"{path}: no .mcap or .db3 file in it.")
    return files


def _compression(path: Path) -> str:
    """How a rosbag2 is compressed: `file`, `message`, or "" for not at all."""
    folder = path if path.is_dir() else path.parent
    if not (folder / METADATA).is_file():
        return ""
    body = read_yaml(folder / METADATA, LogError)
    try:
        mode = str(body["rosbag2_bagfile_information"]["compression_mode"]).lower()
    except (KeyError, TypeError):
        return ""
    return "" if mode == "none" else mode


def _read_sqlite(path: Path, compression: str, is_wanted: Wanted) -> tuple[list[Record], str]:
    """Read a `.db3` file; also returns why its end may be missing."""
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    if compression == "file" or path.suffix.lower() != ".db3":
        raise LogError(f"{path}: a compressed file; unpack it first (unzstd), and name the .db3.")
    _check_sqlite(path)
    damage = ""
    journal = path.with_name(f"{path.name}-wal")
    if journal.is_file() and journal.stat().st_size > 0:
        damage = f"the recorder was stopped and the messages in {journal.name} are not read"
    reader = Sqlite3Reader(path)
    reader.open()
    try:
        messages = reader.messages(reader.connections)
        unpack = _zstd if compression == "message" else None
        return _records(path, messages, "cdr", unpack, is_wanted), damage
    finally:
        reader.close()


def _check_sqlite(path: Path) -> None:
    """Refuse a file that is no SQLite database, or whose tables compute what they hold."""
    try:
        with sqlite3.connect(
            f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True
        ) as database:
            rows = database.execute("SELECT type, sql FROM sqlite_master").fetchall()
        database.close()
    except sqlite3.Error as error:
        raise LogError(f"{path}: not a readable SQLite file ({error}).") from None
    for entry_type, definition in rows:
        computes = re.search(r"\b(as|virtual)\b", str(definition), flags=re.IGNORECASE)
        if entry_type in ("view", "trigger") or (entry_type == "table" and computes):
            raise LogError(f"{path}: a database with computed tables, which no recorder writes.")


def _read_ros1(path: Path, is_wanted: Wanted) -> tuple[list[Record], str]:
    """Read a bag of ROS 1; one that was cut has to be indexed again by `rosbag reindex`."""
    from rosbags.rosbag1 import Reader
    from rosbags.rosbag1.reader import ReaderError

    reader = Reader(path)
    try:
        reader.open()
    except ReaderError as error:
        raise LogError(
            f"{path}: not a readable bag of ROS 1 ({error}); `rosbag reindex` repairs one that was "
            "not closed."
        ) from None
    try:
        for position, chunk in reader.chunks.items():
            if chunk.decompressor is bz2.decompress:
                reader.chunks[position] = chunk._replace(decompressor=_bz2)
            elif chunk.decompressor is lz4.frame.decompress:
                reader.chunks[position] = chunk._replace(decompressor=_lz4)
        return _records(path, reader.messages(), "ros1", None, is_wanted), ""
    finally:
        reader.close()


def _records(
    path: Path,
    messages: Iterable[tuple[Any, int, bytes]],
    encoding: str,
    unpack: Callable[[bytes], bytes] | None,
    is_wanted: Wanted,
) -> list[Record]:
    """Records of the messages that a reader of rosbags gives."""
    schemas: dict[tuple[int, str], Schema] = {}
    keep = MessageFilter(is_wanted)
    records = []
    size = 0
    for connection, log_time, data in messages:
        content = bytes(data) if unpack is None else unpack(bytes(data))
        key = (connection.id, connection.topic)
        if key not in schemas:
            definition = connection.msgdef
            notation = "ros2idl" if definition.format.name == "IDL" else f"{encoding}msg"
            schemas[key] = Schema(
                id=len(schemas) + 1,
                name=connection.msgtype,
                encoding=notation.replace("cdr", "ros2"),
                data=definition.data.encode(),
            )
        record = Record(connection.topic, encoding, schemas[key], log_time, content)
        for kept_record in keep.kept([record]):
            records.append(kept_record)
            size += len(kept_record.data) + _MESSAGE_BYTES
        check_size(path, size, LogError)
    return records


def _bz2(data: bytes) -> bytes:
    """Unpack a chunk; no more than the limit of memory."""
    unpacker = bz2.BZ2Decompressor()
    content = unpacker.decompress(data, max_bytes() + 1)
    return _within_limit(content, complete=unpacker.eof)


def _lz4(data: bytes) -> bytes:
    """Unpack a chunk; no more than the limit of memory."""
    unpacker = lz4.frame.LZ4FrameDecompressor()
    content = unpacker.decompress(data, max_length=max_bytes() + 1)
    return _within_limit(bytes(content), complete=unpacker.eof)


def _zstd(data: bytes) -> bytes:
    """Unpack a message; no more than the limit of memory."""
    content = zstandard.ZstdDecompressor().stream_reader(data).read(max_bytes() + 1)
    return _within_limit(content, complete=True)


def _within_limit(content: bytes, *, complete: bool) -> bytes:
    """Return what was unpacked; a LogError if it is cut or more than the limit."""
    if len(content) > max_bytes() or not complete:
        raise LogError(
            f"a compressed part of the bag is cut or unpacks to more than {max_bytes() >> 20} MiB."
        )
    return content


class MessageDecoder:
    """Decodes messages by the definitions in a bag, or by the known ones where it has none."""

    def __init__(self, path: Path) -> None:
        """Begin without definitions; `path` is the bag, for messages."""
        self._path = path
        self._stores: dict[tuple[str, str, bytes], Any] = {}

    def decode(self, record: Record) -> Any:
        """Decode one message; a LogError says why it cannot be."""
        schema = record.schema
        if schema is None or record.encoding not in ("cdr", "ros1"):
            notation = "none" if schema is None else schema.encoding
            raise LogError(
                f"{self._path}: messages on {record.topic} are encoded as {record.encoding!r} with "
                f"schema {notation!r}; expected cdr or ros1 with a definition of ROS."
            )
        key = (schema.name, schema.encoding, schema.data)
        try:
            if key not in self._stores:
                self._stores[key] = _typestore(schema, record.encoding)
            store = self._stores[key]
            name = message_type(schema)
            if record.encoding == "ros1":
                return store.deserialize_ros1(record.data, name)
            return store.deserialize_cdr(record.data, name)
        except LogError as error:
            raise LogError(f"{self._path}: messages on {record.topic}: {error}") from None
        except Exception as error:
            # The decoder is generated from the bag's own definitions and may fail in any way.
            raise LogError(
                f"{self._path}: a message on {record.topic} cannot be decoded "
                f"({type(error).__name__})."
            ) from error


def message_type(schema: Schema) -> str:
    """Name of a message's type as ROS 2 writes it, as in `sensor_msgs/msg/JointState`."""
    package, _, short_name = schema.name.partition("/")
    return schema.name if "/" in short_name else f"{package}/msg/{short_name}"


def _typestore(schema: Schema, encoding: str) -> Any:
    """Types of one kind of message: those of its definition, or the known ones.

    Raises:
        LogError: There is no definition in the bag, and the type is not known.
    """
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    name = message_type(schema)
    text = schema.data.decode()
    if len(text) > _MAX_DEFINITION:
        raise LogError(f"the definition of {printable(name)} has {len(text)} characters.")
    if text.strip():
        types = {}
        if schema.encoding == "ros2idl":
            for part in re.split(r"={80}\n(?:IDL: .*\n)?", text):
                if part.strip():
                    types.update(get_types_from_idl(part.removeprefix("IDL: ")))
        else:
            types.update(get_types_from_msg(text, name))
        store = get_typestore(Stores.EMPTY)
        store.register(types)
        return store
    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    for known_name, definition in DEFINITIONS.items():
        store.register(get_types_from_msg(definition, known_name))
    if name not in store.types:
        raise LogError(
            f"the bag has no definition of {printable(name)}, and it is not one of ROS; convert "
            "the bag to MCAP where the package is installed (`ros2 bag convert`), which adds it."
        )
    return store
