"""Whole files or none: write aside, then rename."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from pronk.errors import ArtefactError

T = TypeVar("T")


@contextmanager
def written_whole(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the same folder; rename it to `path` when the block succeeds.

    A block that raises, or a process that dies, leaves `path` as it was. Missing folders are made.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    aside = Path(name)
    try:
        yield aside
        # mkstemp makes the file private; give it the mode that open() would have given.
        umask = os.umask(0)
        os.umask(umask)
        aside.chmod(0o666 & ~umask)
        aside.replace(path)
    except BaseException:
        aside.unlink(missing_ok=True)
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


def converted(data: Any, kind: type[T], path: Path, hook: Any = None) -> T:
    """Make a dataclass of YAML or JSON data; ArtefactError names a wrong or unknown field."""
    try:
        out = msgspec.convert(data, kind, dec_hook=hook)
    except msgspec.ValidationError as error:
        raise ArtefactError(f"{path}: {error}.") from None
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
