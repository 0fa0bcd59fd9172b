"""Recordings of PACE: a `.pt` file of PyTorch with `time`, `dof_pos` and `des_dof_pos`.

PyTorch loads the tensors with `weights_only`, which runs no code of the file.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from pronk.arrays import Array
from pronk.errors import LogError
from pronk.files import check_archive, check_size, sha256
from pronk.identify.logs.columns import Columns, import_columns
from pronk.identify.logs.joint_log import JointLog, LogOrigin
from pronk.identify.logs.options import ReadOptions
from pronk.robots.robot import RobotSpec

KEYS = ("time", "dof_pos", "des_dof_pos")
"""Names of the tensors: timestamps (n,), positions and commanded positions (n, joints)."""
_EXPECTED = f"expected a dictionary of the tensors {', '.join(KEYS)}, saved with torch.save"


def read_pace(path: Path, robot: RobotSpec | None, options: ReadOptions) -> JointLog:
    """Read a PACE recording: `time` (n,), `dof_pos` and `des_dof_pos` (n, joints).

    Raises:
        LogError: PyTorch is not installed, or the file does not hold these tensors.
    """
    tensors = _load(path)
    missing = [key for key in KEYS if key not in tensors]
    if missing:
        names = ", ".join(str(name)[:40] for name in tensors) or "none"
        raise LogError(
            f"{path}: no tensor {', '.join(missing)}; it holds {names} and a PACE recording has "
            f"{', '.join(KEYS)}."
        )
    # A tensor may repeat few stored numbers many times: its size is checked before it is copied.
    check_size(path, sum(8 * tensors[key].numel() for key in KEYS), LogError)
    time = _array(tensors["time"])
    position = _array(tensors["dof_pos"])
    command = _array(tensors["des_dof_pos"])
    if position.ndim != 2 or command.shape != position.shape or 0 in position.shape:
        raise LogError(
            f"{path}: dof_pos has shape {position.shape} and des_dof_pos {command.shape}; expected "
            "(n, joints)."
        )
    columns = Columns(
        origin=LogOrigin(source=str(path), sha256=sha256(path), metadata={"format": "pace"}),
        time=time.reshape(-1),
        command=command,
        position=position,
        unit="rad",
    )
    return import_columns(columns, robot, options)


def _load(path: Path) -> dict[Any, Any]:
    """Load the tensors of a file by name; other entries of its dictionary are left out."""
    try:
        check_archive(path, LogError)
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()  # PyTorch does not check the checksums.
    except LogError:
        raise
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror or error}).") from None
    except Exception as error:
        # zipfile and zlib fail in many ways on a damaged archive.
        reason = type(error).__name__
        raise LogError(f"{path}: not a file of PyTorch ({reason}); {_EXPECTED}.") from None
    if damaged is not None:
        raise LogError(f"{path}: the checksum of its part {damaged!r} does not fit.")
    try:
        import torch
    except ImportError:
        raise LogError(
            f"{path}: recordings of PACE are read by PyTorch, which is not installed; install "
            "pronk[train], or save the tensors as arrays in an .npz file."
        ) from None
    try:
        stored = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        # A damaged file fails in many ways; the words of PyTorch advise to run its code.
        reason = type(error).__name__
        raise LogError(
            f"{path}: PyTorch cannot load it without running code of the file, which was not run "
            f"({reason}); {_EXPECTED}."
        ) from error
    if not isinstance(stored, dict):
        raise LogError(f"{path}: it holds a {type(stored).__name__}; {_EXPECTED}.")
    return {name: value for name, value in stored.items() if isinstance(value, torch.Tensor)}


def _array(tensor: Any) -> Array:
    """Numbers of a tensor in double precision."""
    return np.array(tensor.detach().double().numpy(), dtype=np.float64)
