"""NPZ: arrays by name, no pickle."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from pronk.errors import LogError
from pronk.files import sha256
from pronk.logs.columns import Columns
from pronk.robots.robot import RobotSpec

_COLUMNS = ("time", "command", "position", "velocity", "torque")
_MOST_BYTES = 2**30
"""Largest size that the arrays may unpack to [bytes]."""


def read_npz(path: Path, *, robot: RobotSpec | None = None) -> Columns:
    """Read the arrays `time` (n,), `command` and `position` (n, joints).

    `velocity`, `torque` and `joints` (the names) are read where they are there.

    Raises:
        LogError: Not such a file, or an array is missing.
    """
    arrays = _load(path)
    if missing := [name for name in _COLUMNS[:3] if name not in arrays]:
        raise LogError(
            f"{path}: no array {', '.join(missing)}; it holds {', '.join(arrays) or 'none'}."
        )
    try:
        found = {n: np.asarray(arrays[n], dtype=np.float64) for n in _COLUMNS if n in arrays}
    except (TypeError, ValueError):
        raise LogError(f"{path}: its arrays are not numbers.") from None
    time = found.pop("time")
    for name, values in found.items():
        if time.ndim != 1 or values.shape[:1] != time.shape:
            raise LogError(
                f"{path}: time has shape {time.shape} and {name} {values.shape}; expected (n,) and "
                "(n, joints)."
            )
        found[name] = values.reshape(len(time), -1) if len(time) else values
    return Columns(
        where=str(path),
        joints=tuple(str(name) for name in arrays.get("joints", np.empty(0)).reshape(-1)),
        time=time,
        sha256=sha256(path),
        **found,  # type: ignore[arg-type]
    )


def _load(path: Path) -> dict[str, NDArray[Any]]:
    """All arrays, sizes checked before anything is unpacked."""
    try:
        with zipfile.ZipFile(path) as archive:
            infos = archive.infolist()
            if sum(info.file_size for info in infos) > _MOST_BYTES:
                raise LogError(f"{path}: it unpacks to more than {_MOST_BYTES >> 20} MiB.")
            for info in infos:
                with archive.open(info) as file:
                    _check_size(path, info.filename, file, info.file_size)
        with np.load(path, allow_pickle=False) as stored:
            return {name: stored[name] for name in stored.files}
    except LogError:
        raise
    except OSError as error:
        raise LogError(
            f"{path}: cannot be read ({error.strerror or type(error).__name__})."
        ) from None
    except Exception as error:
        # zipfile, zlib and the npy parser fail in many ways on a damaged file.
        raise LogError(f"{path}: not a readable NPZ file ({type(error).__name__}).") from error


def _check_size(path: Path, name: str, file: IO[bytes], size: int) -> None:
    """Refuse an array whose header promises more than its entry holds, or objects."""
    first = np.lib.format.read_magic(file) == (1, 0)
    header = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
    shape, _, dtype = header(file)
    if dtype.hasobject:
        raise LogError(f"{path}: {name} holds pickled objects, which are not read.")
    if math.prod(shape) * dtype.itemsize > size:
        raise LogError(f"{path}: {name} promises shape {shape}, more than the file holds.")
