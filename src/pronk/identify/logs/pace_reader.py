"""Recordings of PACE: a `.pt` file with `time`, `dof_pos` and `des_dof_pos`.

A `.pt` file is a zip archive of raw numbers and a pickle that arranges them. A pickle is a program,
so it is not run: an unpickler interprets its opcodes and accepts three names, each replaced by a
function of this module that can only build an array. Anything else is refused by name. PyTorch is
not needed.
"""

from __future__ import annotations

import functools
import io
import math
import pickle
import pickletools
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pronk.errors import LogError
from pronk.files import check_archive, check_size, sha256
from pronk.identify.logs.columns import Columns
from pronk.robots.robot import RobotSpec

KEYS = ("time", "dof_pos", "des_dof_pos")
_Storage = Callable[[np.dtype[Any], str, int], NDArray[Any]]
"""Numbers of a storage: their type, its key, how many."""
_STORAGES = {
    "DoubleStorage": "<f8",
    "FloatStorage": "<f4",
    "HalfStorage": "<f2",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "ShortStorage": "<i2",
    "CharStorage": "i1",
    "ByteStorage": "u1",
    "BoolStorage": "?",
}
"""Storage classes of torch; a dtype stands for each, which a pickle cannot call."""
_OPCODES = (
    *("PROTO", "FRAME", "STOP", "MARK", "GLOBAL", "STACK_GLOBAL", "REDUCE", "BINPERSID"),
    *("BINPUT", "LONG_BINPUT", "MEMOIZE", "BINGET", "LONG_BINGET"),
    *("EMPTY_DICT", "SETITEM", "SETITEMS", "EMPTY_LIST", "APPEND", "APPENDS"),
    *("EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3"),
    *("NONE", "NEWTRUE", "NEWFALSE", "BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT"),
    *("BINUNICODE", "SHORT_BINUNICODE"),
)
"""Opcodes that torch.save uses for a dictionary of tensors."""
_MOST_PICKLE = 2**20
"""Largest `data.pkl` [bytes]; that of a PACE file has 500."""


class _Dispatch(dict[int, Callable[..., None]]):
    """Functions of the permitted opcodes."""

    def __missing__(self, code: int) -> Callable[..., None]:
        names = [opcode.name for opcode in pickletools.opcodes if opcode.code == chr(code)]
        raise LogError(
            f"its pickle uses the opcode {names[0] if names else code}, which a dictionary of "
            "tensors does not need; nothing of it was run; do not trust the file"
        )


class _Unpickler(pickle._Unpickler):
    """Interprets a pickle of tensors, in Python: no number in it makes a memo allocate memory."""

    stack: list[Any]
    pop_mark: Callable[[], list[Any]]
    dispatch: ClassVar[dict[int, Callable[..., None]]] = _Dispatch(
        {
            getattr(pickle, name)[0]: pickle._Unpickler.dispatch[getattr(pickle, name)[0]]
            for name in _OPCODES
        }
    )

    def __init__(self, data: bytes, storage: _Storage) -> None:
        super().__init__(io.BytesIO(data))
        self._storage = storage

    def find_class(self, module: str, name: str) -> Any:
        """Replace the three names that torch.save writes; refuse every other."""
        if module == "torch" and name in _STORAGES:
            return np.dtype(_STORAGES[name])
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _rebuild_tensor
        if (module, name) == ("collections", "OrderedDict"):
            return _empty
        raise LogError(
            f"its pickle names {module}.{name}, which a dictionary of tensors does not need; "
            "nothing of it was run; do not trust the file"
        )

    def persistent_load(self, pid: Any) -> NDArray[Any]:
        """The numbers of one storage."""
        kind, dtype, key, _, count = pid
        if kind != "storage" or not isinstance(dtype, np.dtype) or not isinstance(key, str):
            raise ValueError
        return self._storage(dtype, key, int(count))

    def _put(self, key: Any, value: Any) -> None:
        """Fill a dictionary with text keys only: nested tuples take too long to hash."""
        if not isinstance(key, str):
            raise ValueError
        self.stack[-1][key] = value

    def _set_item(self) -> None:
        self._put(self.stack.pop(-2), self.stack.pop())

    def _set_items(self) -> None:
        items = self.pop_mark()
        for key, value in zip(items[::2], items[1::2], strict=True):
            self._put(key, value)

    dispatch[pickle.SETITEM[0]], dispatch[pickle.SETITEMS[0]] = _set_item, _set_items


def _empty(*args: Any) -> dict[Any, Any]:
    """In place of OrderedDict, for the backward hooks that every saved tensor carries."""
    if args:
        raise ValueError
    return {}


def _rebuild_tensor(storage: Any, offset: Any, size: Any, stride: Any, *_: Any) -> NDArray[Any]:
    """In place of `torch._utils._rebuild_tensor_v2`: a view of a storage."""
    if not isinstance(storage, np.ndarray) or len(size) != len(stride) or len(size) > 2:
        raise ValueError
    numbers = [offset, *size, *stride]
    if any(type(n) is not int or n < 0 for n in numbers):
        raise ValueError
    if math.prod(size) == 0:
        return np.zeros(size)
    last = offset + sum((n - 1) * s for n, s in zip(size, stride, strict=True))
    # A stride of zero would make much of little.
    if last >= len(storage) or math.prod(size) > len(storage):
        raise ValueError
    return np.lib.stride_tricks.as_strided(
        storage[offset:], size, [s * storage.itemsize for s in stride], writeable=False
    )


def load_tensors(path: Path) -> dict[str, NDArray[Any]]:
    """Tensors by name from a file that `torch.save` wrote of a dictionary; any other: LogError."""
    expected = f"expected a dictionary of {', '.join(KEYS)} saved with torch.save"
    try:
        check_archive(path, LogError)
        with zipfile.ZipFile(path) as archive:
            sizes = {info.filename: info.file_size for info in archive.infolist()}
            pickles = [name for name in sizes if name.split("/")[1:] == ["data.pkl"]]
            if len(pickles) != 1:
                raise LogError(f"it holds no data.pkl; {expected}")
            root = pickles[0].split("/")[0]
            if sizes[pickles[0]] > _MOST_PICKLE:
                raise LogError(f"its data.pkl unpacks to more than {_MOST_PICKLE >> 10} KiB")
            order = f"{root}/byteorder"
            if order in sizes and archive.read(order).strip() != b"little":
                raise LogError("it was written on a big-endian machine")

            @functools.cache
            def storage(dtype: np.dtype[Any], key: str, count: int) -> NDArray[Any]:
                return np.frombuffer(archive.read(f"{root}/data/{key}"), dtype)[:count]

            found = _Unpickler(archive.read(pickles[0]), storage).load()
        if not isinstance(found, dict):
            raise LogError(f"it holds a {type(found).__name__}; {expected}")
    except LogError as error:
        text = str(error)
        raise LogError(text if text.startswith(str(path)) else f"{path}: {text}.") from None
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror or error}).") from None
    except Exception as error:
        # A damaged pickle fails in every way there is; none of its code was run.
        reason = type(error).__name__
        raise LogError(f"{path}: not readable as tensors ({reason}); {expected}.") from error
    return {k[:40]: v for k, v in found.items() if isinstance(v, np.ndarray)}


def read_pace(path: Path, *, robot: RobotSpec | None = None) -> Columns:
    """Read a PACE recording: `time` (n,), `dof_pos` and `des_dof_pos` (n, joints)."""
    tensors = load_tensors(path)
    if missing := [key for key in KEYS if key not in tensors]:
        raise LogError(
            f"{path}: no tensor {', '.join(missing)}; it holds {', '.join(tensors) or 'none'} and "
            f"a PACE recording has {', '.join(KEYS)}."
        )
    check_size(path, 8 * sum(tensors[key].size for key in KEYS), LogError)
    time, position, command = (np.array(tensors[key], dtype=np.float64) for key in KEYS)
    if position.ndim != 2 or command.shape != position.shape or 0 in position.shape:
        raise LogError(
            f"{path}: dof_pos has shape {position.shape} and des_dof_pos {command.shape}; expected "
            "(n, joints)."
        )
    return Columns(
        where=str(path),
        time=time.reshape(-1),
        command=command,
        position=position,
        unit="rad",
        sha256=sha256(path),
        metadata={"format": "pace"},
    )
