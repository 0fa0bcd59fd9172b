"""NPZ: arrays by name, no pickle."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

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
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(info.file_size for info in archive.infolist()) > _MOST_BYTES:
                raise LogError(f"{path}: it unpacks to more than {_MOST_BYTES >> 20} MiB.")
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
    except LogError:
        raise
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise LogError(f"{path}: cannot be read ({reason}).") from None
    except Exception as error:
        # zipfile, zlib and the npy parser fail in many ways on a damaged file.
        reason = f"{type(error).__name__}: {error}"[:120]
        raise LogError(f"{path}: not a readable NPZ file ({reason}).") from error
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
