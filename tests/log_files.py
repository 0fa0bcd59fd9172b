"""Logs as CSV and NPZ files, as other tools write them; angles in radians."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pronk.logs.joint_log import JointLog

QUANTITIES = ("command", "position", "velocity", "torque")


def write_csv(path: Path, log: JointLog) -> None:
    there = [name for name in QUANTITIES if getattr(log, name) is not None]
    header = ["time", *(f"{name}.{joint}" for name in there for joint in log.joints)]
    rows = np.hstack([log.time[:, None], *(getattr(log, name) for name in there)]).tolist()
    path.write_text("\n".join([",".join(header), *(",".join(map(repr, row)) for row in rows)]))


def write_npz(path: Path, log: JointLog) -> None:
    arrays = {name: getattr(log, name) for name in QUANTITIES if getattr(log, name) is not None}
    np.savez_compressed(path, time=log.time, joints=np.array(log.joints), **arrays)
