"""Files: written whole or not at all, read within limits of size and depth."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
import zipfile
from collections.abc import Hashable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import yaml

from pronk.errors import ArtefactError, PronkError

Artefact = TypeVar("Artefact")

SIZE_LIMIT = "PRONK_MOST_MIB"
"""Environment variable: the most that a log or artefact may unpack to [MiB]."""
_DEFAULT_LIMIT_MIB = 1024
_MAX_YAML_BYTES = 2**19
"""Largest YAML file: 500 joints in `gains.yaml`."""
_MAX_YAML_VALUES = 2**16
"""Most values in a YAML file, with aliases followed."""
_MAX_YAML_DEPTH = 32
"""Deepest nesting in a YAML file."""
_MAX_YAML_CHARACTERS = 4096
"""Longest single value in a YAML file."""


def max_bytes() -> int:
    """Return the most that a log or artefact may unpack to [bytes], by `SIZE_LIMIT`."""
    text = os.environ.get(SIZE_LIMIT, str(_DEFAULT_LIMIT_MIB))
    if not text.isdecimal() or not 0 < len(text) < 9:
        raise PronkError(
            f"{SIZE_LIMIT} is {text!r}; expected a number of MiB, as in {_DEFAULT_LIMIT_MIB}."
        )
    return int(text) << 20


def check_size(path: Path, size: int, kind: type[PronkError]) -> None:
    """Refuse what takes or unpacks to more bytes than `max_bytes`.

    Args:
        path: The file, for the message.
        size: Its size [bytes].
        kind: Class of the error.
    """
    limit = max_bytes()
    if size > limit:
        raise kind(
            f"{path}: it unpacks to more than {limit >> 20} MiB; split it, or set {SIZE_LIMIT} to "
            f"more than {size >> 20}."
        )


def check_regular(path: Path, kind: type[PronkError]) -> None:
    """Refuse a pipe, a socket or a device, from which reading might never return.

    Args:
        path: The file; a folder and a path without a file pass.
        kind: Class of the error.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        raise kind(
            f"{path}: a pipe or a device and no regular file; write the data to a file and name "
            "that."
        )


def check_archive(path: Path, kind: type[PronkError]) -> None:
    """Refuse a zip archive that claims to unpack to more than `max_bytes`.

    The module zipfile holds the archive to what it claims.
    """
    check_regular(path, kind)
    with zipfile.ZipFile(path) as archive:
        unpacked = sum(member.file_size for member in archive.infolist())
    check_size(path, unpacked, kind)


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """The safe loader, which also refuses keys that are there twice."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Hashable, Any]:
        """Return a mapping as a dictionary; a ConstructorError names a key that is there twice."""
        keys = set()
        for key_node, _ in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                continue
            key = key_node.value
            if key in keys:
                raise yaml.constructor.ConstructorError(None, None, f"{key[:40]!r} is there twice")
            keys.add(key)
        mapping: dict[Hashable, Any] = super().construct_mapping(node, deep)
        return mapping


def read_yaml(path: Path, kind: type[PronkError] = ArtefactError, missing: str = "") -> Any:
    """Read a YAML file of limited size and depth.

    Args:
        path: The file.
        kind: Class of the error where it is missing or cannot be read.
        missing: What to do where there is no such file, for the message.
    """
    check_regular(path, kind)
    try:
        with path.open("rb") as file:
            content = file.read(_MAX_YAML_BYTES + 1)
        if len(content) > _MAX_YAML_BYTES:
            raise ValueError(f"larger than {_MAX_YAML_BYTES >> 10} KiB")
        text = content.decode()
        _check_yaml(text)
        return yaml.load(text, _Loader)
    except FileNotFoundError:
        remedy = f"; {missing}" if missing else ""
        raise kind(f"{path}: no such file{remedy}.") from None
    except OSError as error:
        reason = str(error.strerror or error)
    except yaml.MarkedYAMLError as error:
        reason = str(error.problem or error)
    except (ValueError, OverflowError, AttributeError, yaml.YAMLError) as error:
        reason = str(error)
    sentence = " ".join(reason.split())[:120].rstrip(".")
    raise kind(f"{path}: cannot be read as YAML ({sentence}).")


def _check_yaml(text: str) -> None:
    """Refuse depth and size, with aliases followed, before anything is built.

    Raises:
        ValueError: The text is nested too deep, or has too many or too long values.
    """
    anchor_sizes: dict[str, int] = {}
    open_anchors: list[str | None] = []
    sizes = [0]  # Values in each open collection, the whole text first.
    for event in yaml.parse(text, _Loader):
        if isinstance(event, yaml.CollectionStartEvent):
            open_anchors.append(event.anchor)
            sizes.append(1)
        elif isinstance(event, yaml.CollectionEndEvent):
            size = sizes.pop()
            anchor = open_anchors.pop()
            if anchor:
                anchor_sizes[anchor] = size
            sizes[-1] += size
        elif isinstance(event, yaml.AliasEvent):
            sizes[-1] += anchor_sizes.get(event.anchor or "", 1)
        elif isinstance(event, yaml.ScalarEvent):
            sizes[-1] += 1
            if len(event.value) > _MAX_YAML_CHARACTERS:
                raise ValueError(f"a value of {len(event.value)} characters")
        if len(sizes) > _MAX_YAML_DEPTH:
            raise ValueError(f"nested deeper than {_MAX_YAML_DEPTH} levels")
        if sizes[-1] > _MAX_YAML_VALUES:
            raise ValueError(f"more than {_MAX_YAML_VALUES} values")


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder; rename it to `path` when the block succeeds.

    A block that raises, or a process that dies, leaves `path` as it was. Missing folders are made.

    Raises:
        PronkError: The file cannot be written.
    """
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(
            prefix=f".{path.name[:100]}.", suffix=path.suffix, dir=path.parent
        )
        os.close(handle)
        temporary = Path(name)
        yield temporary
        # mkstemp makes the file private; give it the mode that open() would have given.
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(path)
    except BaseException as error:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise PronkError(f"{path}: cannot be written ({error.strerror or error}).") from error
        raise


@contextmanager
def locked_folder(path: Path) -> Iterator[None]:
    """Keep a folder to this process inside the block; missing folders are made.

    No file is left behind. A folder that was made for the block is removed if the block raises and
    leaves it empty.

    Raises:
        PronkError: Another process has the folder, or it cannot be made.
    """
    import fcntl  # Not on every system; only recordings need it.

    is_new = not path.exists()
    try:
        path.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_RDONLY)
    except OSError as error:
        raise PronkError(f"{path}: no folder to write to ({error.strerror or error}).") from None
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise PronkError(
                f"{path}: another command is writing to this folder; wait until it has ended, or "
                "give another folder."
            ) from None
        try:
            yield
        except BaseException:
            if is_new:
                with suppress(OSError):
                    path.rmdir()
            raise
    finally:
        os.close(descriptor)


def require_place(path: Path) -> None:
    """Refuse a file that cannot be written where it is named, before work is done for it.

    Args:
        path: The file; its folder is made when it is written.

    Raises:
        PronkError: It is a folder, lies below a file, or its folder cannot be written to.
    """
    if path.is_dir():
        raise PronkError(f"{path} is a folder; give the name of a file.")
    folder = path.resolve().parent
    while not folder.exists():
        folder = folder.parent
    if not folder.is_dir():
        raise PronkError(f"{path}: {folder} is a file, not a folder; give another path.")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise PronkError(f"{path}: {folder} cannot be written to; give another folder.")


def require_new(
    path: Path, option: str, *, overwrite: bool, kind: type[PronkError] = PronkError
) -> None:
    """Refuse a file that exists and is not to be replaced.

    Args:
        path: The file.
        option: The option that names it, for the message.
        overwrite: Whether it may be replaced.
        kind: Class of the error.
    """
    if path.exists() and not overwrite:
        raise kind(f"{path} exists; give another {option}, or --overwrite.")


def write_text(path: Path, text: str) -> None:
    """Write text to a file, whole or not at all."""
    with written_whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def sha256(path: Path) -> str:
    """Return the SHA-256 of the bytes of a file as hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def save_arrays(path: Path, header: Mapping[str, Any], arrays: Mapping[str, Any]) -> None:
    """Write named arrays and a JSON header with a `schema` to one `.npz`; no pickle."""
    with written_whole(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, header=np.array(json.dumps(header)), **arrays)


@contextmanager
def stored_arrays(
    path: Path, schema: str, *, what: str, writer: str
) -> Iterator[tuple[dict[str, Any], Mapping[str, Any]]]:
    """Yield the header and the arrays by name of a file that `save_arrays` wrote.

    Args:
        path: The file.
        schema: The schema that is expected.
        what: What the file is, for the message, as in `a match file`.
        writer: The command that writes one, for the message.

    Raises:
        ArtefactError: The file is missing, damaged or of another schema, or the block failed.
    """
    try:
        check_archive(path, ArtefactError)
        with np.load(path, allow_pickle=False) as stored:
            header = json.loads(str(stored["header"]))
            if header.get("schema") != schema:
                raise ArtefactError(
                    f"{path}: schema {header.get('schema')!r}; this pronk reads {schema!r}."
                )
            yield header, stored
    except ArtefactError:
        raise
    except FileNotFoundError:
        raise ArtefactError(f"{path}: no such file; `{writer}` writes one.") from None
    except Exception as error:
        raise ArtefactError(
            f"{path}: not {what} of pronk ({type(error).__name__}); `{writer}` writes one."
        ) from error


def save_artefact(path: Path, value: Any, schema: str) -> None:
    """Write a dataclass of numbers, text, arrays and further dataclasses to one `.npz`.

    Arrays are stored under their number, which stands in the header in their place.
    """
    arrays: dict[str, Any] = {}

    def encode(item: Any) -> Any:
        if isinstance(item, np.ndarray):
            number = str(len(arrays))
            arrays[number] = item
            return number
        if isinstance(item, np.generic):
            return item.item()
        return dict(item)

    content = msgspec.to_builtins(value, enc_hook=encode)
    save_arrays(path, {"schema": schema, "content": content}, arrays)


def load_artefact(
    path: Path, kind: type[Artefact], schema: str, *, what: str, writer: str
) -> Artefact:
    """Read what `save_artefact` wrote.

    Args:
        path: The file.
        kind: Class of the artefact.
        schema: The schema that is expected.
        what: What the file is, for the message, as in `a match file`.
        writer: The command that writes one, for the message.

    Raises:
        ArtefactError: The file is missing, damaged or of another schema.
    """
    with stored_arrays(path, schema, what=what, writer=writer) as (header, arrays):
        return converted(header["content"], kind, path, lambda _, number: arrays[number])


def converted(
    data: Any,
    kind: type[Artefact],
    path: Path,
    hook: Any = None,
    error: type[PronkError] = ArtefactError,
) -> Artefact:
    """Make a dataclass of YAML or JSON data.

    Args:
        data: Mappings, lists, text and numbers.
        kind: Class of the result.
        path: Where the data come from, for the message.
        hook: Makes objects of classes that msgspec does not know.
        error: Class of the error, which names a wrong or unknown field.
    """
    try:
        artefact = msgspec.convert(data, kind, dec_hook=hook)
    except msgspec.ValidationError as refusal:
        raise error(f"{path}: {str(refusal).rstrip('.')}.") from None
    if hook is None:
        _refuse_unknown(data, msgspec.to_builtins(artefact), path, "")
    return artefact


def _refuse_unknown(data: Any, expected: Any, path: Path, where: str) -> None:
    """Refuse a key of nested mappings that the expected ones do not have."""
    if not isinstance(data, dict) or not isinstance(expected, dict):
        return
    for name in data:
        if name not in expected:
            place = f" of {where}" if where else ""
            raise ArtefactError(
                f"{path}: unknown field {name!r}{place}; the fields are {', '.join(expected)}."
            )
        inner = f"{where}.{name}" if where else name
        _refuse_unknown(data[name], expected[name], path, inner)
