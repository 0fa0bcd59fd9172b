"""NPZ: arrays by name, no pickle."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import IO, Any

import msgspec
import numpy as np
import orjson
from numpy.typing import NDArray

from pronk.errors import LogError
from pronk.files import sha256, written_whole
from pronk.logs.columns import Columns
from pronk.logs.joint_log import JointLog
from pronk.robots.robot import RobotSpec

SCHEMA = "pronk/sweep-npz/1"

_COLUMNS = ("time", "command", "position", "velocity", "torque")
_ARRAYS = (*_COLUMNS, "frequency", "stiffness", "damping", "pose")
_FIELDS = ("robot", "joints", "segments", "units", "virtual", "complete", "notes", "metadata")
_MOST_BYTES = 2**30
"""Largest size that the arrays may unpack to [bytes]."""


def write_npz(path: Path, log: JointLog) -> None:
    """Write a log, whole or not at all."""
    header = {"schema": SCHEMA} | {name: getattr(log, name) for name in _FIELDS}
    arrays = {name: getattr(log, name) for name in _ARRAYS if getattr(log, name) is not None}
    with written_whole(path) as aside, aside.open("wb") as file:
        np.savez_compressed(file, header=np.array(orjson.dumps(header).decode()), **arrays)


def read_npz(path: Path, *, robot: RobotSpec | None = None) -> Columns | JointLog:
    """Read what `write_npz` wrote, or the arrays `time`, `command`, `position` of another tool.

    Raises:
        LogError: Not such a file, or an array is missing.
    """
    arrays = _load(path)
    if "header" in arrays:
        return _own(path, arrays)
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


def _own(path: Path, arrays: dict[str, NDArray[Any]]) -> JointLog:
    """A file of `write_npz`."""
    try:
        header = orjson.loads(str(arrays["header"]))
        if header["schema"] != SCHEMA:
            raise LogError(f"{path}: schema {header['schema']!r}; this pronk reads {SCHEMA!r}.")
        for segment in header["segments"]:
            if segment["amplitude"] is None:
                segment["amplitude"] = math.nan
        fields = {name: header[name] for name in _FIELDS}
        fields |= {name: name for name in _ARRAYS if name in arrays}
        fields |= {"source": str(path), "sha256": sha256(path)}
        return msgspec.convert(
            fields, JointLog, dec_hook=lambda _, name: np.asarray(arrays[name], dtype=np.float64)
        )
    except LogError:
        raise
    except Exception as error:
        raise LogError(
            f"{path}: damaged, or not of schema {SCHEMA} ({type(error).__name__})."
        ) from error
