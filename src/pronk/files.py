"""Files: written whole or not at all, read within limits of size and depth."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
import zipfile
from collections.abc import Hashable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import yaml

from pronk.errors import ArtefactError, PronkError

T = TypeVar("T")

LIMIT = "PRONK_MOST_MIB"
"""Environment variable: the most that a log or artefact may unpack to [MiB]."""
_MOST_MIB = 1024
_YAML_BYTES, _YAML_NODES, _YAML_DEPTH, _YAML_SCALAR = 2**19, 2**16, 32, 4096
"""Largest YAML file (500 joints in `gains.yaml`), most nodes with aliases followed, deepest
nesting, longest scalar."""


def most_bytes() -> int:
    """The most that a log or artefact may unpack to [bytes], by `LIMIT`."""
    text = os.environ.get(LIMIT, str(_MOST_MIB))
    if not text.isdecimal() or not 0 < len(text) < 9:
        raise PronkError(f"{LIMIT} is {text!r}; expected a number of MiB, as in {_MOST_MIB}.")
    return int(text) << 20


def check_size(path: Path, size: int, kind: type[PronkError]) -> None:
    """Refuse what takes or unpacks to more bytes than `most_bytes`."""
    if size > (most := most_bytes()):
        raise kind(
            f"{path}: it unpacks to more than {most >> 20} MiB; split it, or set {LIMIT} to more "
            f"than {size >> 20}."
        )


def check_archive(path: Path, kind: type[PronkError]) -> None:
    """Refuse a zip archive that claims to unpack to more than `most_bytes`; zipfile holds it so."""
    with zipfile.ZipFile(path) as archive:
        check_size(path, sum(info.file_size for info in archive.infolist()), kind)


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """The safe loader, which also refuses keys that are there twice."""

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Hashable, Any]:
        keys = [key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode)]
        if len(set(keys)) < len(keys):
            twice = next(key for key in keys if keys.count(key) > 1)
            raise yaml.constructor.ConstructorError(None, None, f"{twice[:40]!r} is there twice")
        found: dict[Hashable, Any] = super().construct_mapping(node, deep)
        return found


def read_yaml(path: Path, kind: type[PronkError] = ArtefactError, missing: str = "") -> Any:
    """Read a YAML file of limited size and depth; `missing` is the way out where there is none."""
    try:
        with path.open("rb") as file:
            data = file.read(_YAML_BYTES + 1)
        if len(data) > _YAML_BYTES:
            raise ValueError(f"larger than {_YAML_BYTES >> 10} KiB")
        text = data.decode()
        _check_yaml(text)
        return yaml.load(text, _Loader)
    except FileNotFoundError:
        raise kind(f"{path}: no such file{missing and f'; {missing}'}.") from None
    except (OSError, ValueError, OverflowError, AttributeError, yaml.YAMLError) as error:
        reason = getattr(error, "strerror", None) or getattr(error, "problem", None) or error
        words = " ".join(str(reason).split())[:120].rstrip(".")
        raise kind(f"{path}: cannot be read as YAML ({words}).") from None


def _check_yaml(text: str) -> None:
    """Refuse depth and size, with aliases followed, before anything is built; a ValueError."""
    sizes, anchors, total = [0], dict[str, int](), 0
    names: list[str | None] = []
    for event in yaml.parse(text, _Loader):
        if isinstance(event, yaml.CollectionStartEvent):
            names.append(event.anchor)
            sizes.append(1)
        elif isinstance(event, yaml.CollectionEndEvent):
            size = sizes.pop()
            if anchor := names.pop():
                anchors[anchor] = size
            sizes[-1] += size
        elif isinstance(event, yaml.AliasEvent):
            sizes[-1] += anchors.get(event.anchor or "", 1)
        elif isinstance(event, yaml.ScalarEvent):
            sizes[-1] += 1
            if len(event.value) > _YAML_SCALAR:
                raise ValueError(f"a value of {len(event.value)} characters")
        total = max(total, sizes[-1])
        if len(sizes) > _YAML_DEPTH:
            raise ValueError(f"nested deeper than {_YAML_DEPTH} levels")
        if total > _YAML_NODES:
            raise ValueError(f"more than {_YAML_NODES} values")


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder; rename it to `path` when the block succeeds.

    A block that raises, or a process that dies, leaves `path` as it was. Missing folders are made.
    An OSError becomes a PronkError.
    """
    aside = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(
            prefix=f".{path.name[:100]}.", suffix=path.suffix, dir=path.parent
        )
        os.close(handle)
        aside = Path(name)
        yield aside
        # mkstemp makes the file private; give it the mode that open() would have given.
        umask = os.umask(0)
        os.umask(umask)
        aside.chmod(0o666 & ~umask)
        aside.replace(path)
    except BaseException as error:
        if aside is not None:
            aside.unlink(missing_ok=True)
        if isinstance(error, OSError):
            raise PronkError(f"{path}: cannot be written ({error.strerror or error}).") from error
        raise


def write_text(path: Path, text: str) -> None:
    """Write `text` to `path` whole or not at all."""
    with written_whole(path) as aside:
        aside.write_text(text, encoding="utf-8")


def sha256(path: Path) -> str:
    """Hex SHA-256 of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def save_arrays(path: Path, header: Mapping[str, Any], arrays: Mapping[str, Any]) -> None:
    """Write named arrays and a JSON header with a `schema` to one `.npz`; no pickle."""
    with written_whole(path) as aside, aside.open("wb") as file:
        np.savez_compressed(file, header=np.array(json.dumps(header)), **arrays)


@contextmanager
def stored_arrays(
    path: Path, schema: str, *, what: str, writer: str
) -> Iterator[tuple[dict[str, Any], Mapping[str, Any]]]:
    """Open what `save_arrays` wrote: the header and the arrays by name, read inside the block.

    An ArtefactError says that the file is missing, damaged, of another schema, or that the block
    failed; it names `what` the file is (as in `a match file`) and the command that writes one.
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
    """Write a dataclass of numbers, text, arrays and further dataclasses to one `.npz`."""
    arrays: dict[str, Any] = {}

    def hook(item: Any) -> Any:
        if isinstance(item, np.ndarray):
            arrays[str(len(arrays))] = item
            return str(len(arrays) - 1)
        return item.item() if isinstance(item, np.generic) else dict(item)

    content = msgspec.to_builtins(value, enc_hook=hook)
    save_arrays(path, {"schema": schema, "content": content}, arrays)


def load_artefact(path: Path, kind: type[T], schema: str, *, what: str, writer: str) -> T:
    """Read what `save_artefact` wrote; arguments and errors are those of `stored_arrays`."""
    with stored_arrays(path, schema, what=what, writer=writer) as (header, arrays):
        return converted(header["content"], kind, path, lambda _, key: arrays[key])


def converted(
    data: Any, kind: type[T], path: Path, hook: Any = None, error: type[PronkError] = ArtefactError
) -> T:
    """Make a dataclass of YAML or JSON data; an error names a wrong or unknown field."""
    try:
        out = msgspec.convert(data, kind, dec_hook=hook)
    except msgspec.ValidationError as wrong:
        raise error(f"{path}: {str(wrong).rstrip('.')}.") from None
    if hook is None:
        _refuse_unknown(data, msgspec.to_builtins(out), path, "")
    return out


def _refuse_unknown(data: Any, known: Any, path: Path, where: str) -> None:
    """Compare the keys of two trees."""
    if not isinstance(data, dict) or not isinstance(known, dict):
        return
    for name in data:
        if name not in known:
            place = f" of {where}" if where else ""
            raise ArtefactError(
                f"{path}: unknown field {name!r}{place}; the fields are {', '.join(known)}."
            )
        _refuse_unknown(data[name], known[name], path, f"{where}.{name}" if where else name)
