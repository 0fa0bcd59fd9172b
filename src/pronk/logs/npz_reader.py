"""NPZ: arrays by name, no pickle."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import numpy as np
import orjson
from numpy.typing import NDArray

from pronk.errors import LogError
from pronk.files import sha256, written_whole
from pronk.logs.columns import Columns, Names, import_columns
from pronk.logs.joint_log import JointLog, Segment
from pronk.robots.robot import Robot

Array = NDArray[np.float64]

SCHEMA = "pronk/sweep-npz/1"

_ARRAYS = (
    "time",
    "command",
    "position",
    "velocity",
    "torque",
    "frequency",
    "stiffness",
    "damping",
    "pose",
)
_MOST_BYTES = 2**30
"""Largest size that the arrays may unpack to [bytes]."""


def write_npz(path: Path, log: JointLog) -> None:
    """Write a log, whole or not at all."""
    header = {
        "schema": SCHEMA,
        "robot": log.robot,
        "joints": log.joints,
        "segments": [vars(segment) for segment in log.segments],
        "units": log.units,
        "virtual": log.virtual,
        "complete": log.complete,
        "notes": log.notes,
        "metadata": log.metadata,
    }
    arrays = {name: getattr(log, name) for name in _ARRAYS if getattr(log, name) is not None}
    with written_whole(path) as aside, aside.open("wb") as file:
        np.savez_compressed(file, header=np.array(orjson.dumps(header).decode()), **arrays)


def read_npz(
    path: Path,
    *,
    robot: Robot | None = None,
    joint_names: Names | None = None,
    unit: str | None = None,
    time_unit: str = "s",
    rate_hz: float | None = None,
    drop_duplicates: bool = False,
    scale: Mapping[str, float] | None = None,
) -> JointLog:
    """Read what `write_npz` wrote, or the arrays `time`, `command`, `position` of another tool.

    Args:
        path: The file.
        robot: The robot.
        joint_names: Names of the columns, where the file has no array `joints`.
        unit: Unit of the angles, `rad` or `deg`; pronk's own files say it themselves.
        time_unit: Unit of `time`.
        rate_hz: Rate that the file is claimed to have.
        drop_duplicates: Drop rows that repeat the one before in full.
        scale: Radians per unit of joints whose unit is unknown, by joint name.

    Raises:
        LogError: Not such a file, an array is missing, or it cannot be believed.
        RobotError: The robot has no such joint.
    """
    arrays = _load(path)
    if "header" in arrays:
        return _own(path, arrays)
    if missing := [name for name in _ARRAYS[:3] if name not in arrays]:
        raise LogError(
            f"{path}: no array {', '.join(missing)}; it holds {', '.join(arrays) or 'none'}."
        )
    if unit is None:
        raise LogError(
            f"{path}: it does not say whether its angles are radians or degrees; give unit='rad' "
            "or unit='deg'."
        )
    try:
        numbers = {
            name: np.asarray(arrays[name], dtype=np.float64) for name in _ARRAYS if name in arrays
        }
    except (TypeError, ValueError):
        raise LogError(f"{path}: its arrays are not numbers.") from None
    time, command, position = (numbers[name] for name in _ARRAYS[:3])
    for name in ("command", "position", "velocity", "torque"):
        if name in numbers and (time.ndim != 1 or numbers[name].shape[:1] != time.shape):
            raise LogError(
                f"{path}: time has shape {time.shape} and {name} {numbers[name].shape}; expected "
                "(n,) and (n, joints)."
            )
        if name in numbers:
            numbers[name] = numbers[name].reshape(len(time), -1) if len(time) else numbers[name]
    command, position = numbers["command"], numbers["position"]
    width = position.shape[-1]
    if "joints" in arrays:
        joints = tuple(str(name) for name in arrays["joints"].reshape(-1))
    elif joint_names is not None and not isinstance(joint_names, Mapping):
        joints, joint_names = tuple(joint_names), None
    else:
        raise LogError(f"{path}: its {width} columns have no names; give joint_names in order.")
    if len(joints) != width or command.shape != position.shape:
        raise LogError(
            f"{path}: {len(joints)} joint names, command of shape {command.shape} and position of "
            f"shape {position.shape}; expected (n, joints)."
        )
    return import_columns(
        Columns(
            where=str(path),
            joints=joints,
            time=time,
            command=command,
            position=position,
            velocity=numbers.get("velocity"),
            torque=numbers.get("torque"),
            sha256=sha256(path),
        ),
        robot=robot,
        unit=unit,
        time_unit=time_unit,
        joint_names=joint_names,
        rate_hz=rate_hz,
        drop_duplicates=drop_duplicates,
        scale=scale,
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
    version = np.lib.format.read_magic(file)
    read = (
        np.lib.format.read_array_header_1_0
        if version == (1, 0)
        else np.lib.format.read_array_header_2_0
    )
    shape, _, dtype = read(file)
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
        segments = []
        for body in header["segments"]:
            for name in ("joints", "band_hz", "clamped"):
                body[name] = tuple(body[name])
            if body["amplitude"] is None:
                body["amplitude"] = math.nan
            segments.append(Segment(**body))
        return JointLog(
            robot=str(header["robot"]),
            joints=tuple(str(name) for name in header["joints"]),
            segments=tuple(segments),
            units=tuple(str(unit) for unit in header["units"]),
            virtual=bool(header["virtual"]),
            complete=bool(header["complete"]),
            notes=tuple(str(note) for note in header["notes"]),
            metadata={str(k): str(v) for k, v in header["metadata"].items()},
            source=str(path),
            sha256=sha256(path),
            **{
                name: np.asarray(arrays[name], dtype=np.float64)
                for name in _ARRAYS
                if name in arrays
            },
        )
    except LogError:
        raise
    except Exception as error:
        raise LogError(
            f"{path}: damaged, or not of schema {SCHEMA} ({type(error).__name__})."
        ) from error
