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
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from pronk.errors import LogError
from pronk.files import sha256
from pronk.logs.columns import Columns
from pronk.robots.robot import RobotSpec

KEYS = ("time", "dof_pos", "des_dof_pos")

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
_FORBIDDEN = (
    *("BUILD", "INST", "OBJ", "NEWOBJ", "NEWOBJ_EX", "EXT1", "EXT2", "EXT4"),
    *("EMPTY_SET", "ADDITEMS", "FROZENSET"),
)
"""Opcodes that a dictionary of tensors does not need: they make objects or hash their input."""
_KEYED = ("SETITEM", "SETITEMS", "DICT")
"""Opcodes that fill dictionaries."""
_MOST_PICKLE = 2**20
"""Largest `data.pkl` [bytes]; that of a PACE file has 500."""
_MOST_BYTES = 2**28
"""Largest tensor data [bytes]: 1.8 hours of 12 joints at 400 Hz in single precision."""


class _Dtype:
    """Stands for a torch storage class. Not callable, so a pickle cannot run it."""

    def __init__(self, code: str) -> None:
        self.code = code


class _Unpickler(pickle._Unpickler):
    """Interprets a pickle of tensors, and nothing else.

    Pure Python: a number in the file cannot make its memo allocate memory.
    """

    dispatch: ClassVar[dict[int, Callable[..., None]]] = dict(pickle._Unpickler.dispatch)

    def __init__(self, data: bytes, storage: Callable[[str, str, int], NDArray[Any]]) -> None:
        super().__init__(io.BytesIO(data))
        self._storage = storage

    def find_class(self, module: str, name: str) -> Any:
        """Replace the three names that torch.save writes; refuse every other."""
        if module == "torch" and name in _STORAGES:
            return _Dtype(_STORAGES[name])
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
        if kind != "storage" or not isinstance(dtype, _Dtype) or not isinstance(key, str):
            raise ValueError
        return self._storage(dtype.code, key, int(count))


def _refuse(name: str) -> Callable[..., None]:
    def refuse(_: Any) -> None:
        raise LogError(
            f"its pickle uses the opcode {name}, which a dictionary of tensors does not need; "
            "nothing of it was run; do not trust the file"
        )

    return refuse


def _text_keys(load: Callable[[Any], None]) -> Callable[..., None]:
    """Let an opcode fill dictionaries with text keys only: nested keys take too long to hash."""

    def checked(unpickler: Any) -> None:
        last = unpickler.stack[-2:-1] if load.__name__ == "load_setitem" else unpickler.stack[::2]
        if not all(isinstance(key, str) for key in last):
            raise ValueError
        load(unpickler)

    return checked


for _name in _FORBIDDEN:
    _Unpickler.dispatch[getattr(pickle, _name)[0]] = _refuse(_name)
for _name in _KEYED:
    _code = getattr(pickle, _name)[0]
    _Unpickler.dispatch[_code] = _text_keys(_Unpickler.dispatch[_code])


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
    """Tensors by name from a file that `torch.save` wrote of a dictionary.

    Raises:
        LogError: Not such a file, or its pickle names something else.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            pickles = [n for n in archive.namelist() if n.split("/")[1:] == ["data.pkl"]]
            if len(pickles) != 1:
                raise LogError("it holds no data.pkl; expected what torch.save writes since 1.6")
            root = pickles[0].split("/")[0]
            if sum(info.file_size for info in archive.infolist()) > _MOST_BYTES:
                raise LogError(f"it unpacks to more than {_MOST_BYTES >> 20} MiB")
            if archive.getinfo(pickles[0]).file_size > _MOST_PICKLE:
                raise LogError(f"its data.pkl is larger than {_MOST_PICKLE >> 10} KiB")
            order = f"{root}/byteorder"
            if order in archive.namelist() and archive.read(order).strip() != b"little":
                raise LogError("it was written on a big-endian machine")

            @functools.cache
            def storage(code: str, key: str, count: int) -> NDArray[Any]:
                numbers = np.frombuffer(archive.read(f"{root}/data/{key}"), dtype=code)
                return numbers[:count]

            found = _Unpickler(archive.read(pickles[0]), storage).load()
    except LogError as error:
        raise LogError(f"{path}: {error}.") from None
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror or error}).") from None
    except Exception as error:
        # A damaged pickle fails in every way there is; none of its code was run.
        raise LogError(
            f"{path}: not a readable .pt file of tensors ({type(error).__name__}); expected a "
            f"dictionary of {', '.join(KEYS)} saved with torch.save."
        ) from error
    if not isinstance(found, dict):
        raise LogError(
            f"{path}: it holds a {type(found).__name__}; expected a dictionary of "
            f"{', '.join(KEYS)}."
        )
    return {k[:40]: v for k, v in found.items() if isinstance(v, np.ndarray)}


def read_pace(path: Path, *, robot: RobotSpec | None = None) -> Columns:
    """Read a PACE recording: `time` (n,), `dof_pos` and `des_dof_pos` (n, joints).

    Raises:
        LogError: Not such a file.
    """
    tensors = load_tensors(path)
    if missing := [key for key in KEYS if key not in tensors]:
        raise LogError(
            f"{path}: no tensor {', '.join(missing)}; it holds {', '.join(tensors) or 'none'} and "
            f"a PACE recording has {', '.join(KEYS)}."
        )
    time, position, command = (np.array(tensors[key], dtype=np.float64) for key in KEYS)
    time = time.reshape(-1)
    if position.ndim != 2 or command.shape != position.shape or 0 in position.shape:
        raise LogError(
            f"{path}: time has shape {time.shape}, dof_pos {position.shape} and des_dof_pos "
            f"{command.shape}; expected (n,), (n, joints) and (n, joints)."
        )
    return Columns(
        where=str(path),
        time=time,
        command=command,
        position=position,
        unit="rad",
        sha256=sha256(path),
        metadata={"format": "pace"},
    )
