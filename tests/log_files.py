"""A log, and logs as files: MCAP, and CSV and NPZ as other tools write them; angles in radians."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.mcap_log import LogHeader, McapLogWriter
from pronk.identify.logs.segment import Segment

QUANTITIES = ("command", "position", "velocity", "torque")
LEG = ("FR_hip_roll", "FR_hip_pitch", "FR_knee")


def example(n: int = 2000, joints: tuple[str, ...] = LEG) -> JointLog:
    """Joints that jump about, logged at 500 Hz with everything that a log can hold."""
    rng, width = np.random.default_rng(1), len(joints)
    seconds = np.arange(n) / 500.0 + rng.uniform(0.0, 1e-5, n)
    frequency = np.linspace(0.1, 25.0, n)
    frequency[: n // 10] = np.nan
    signal: dict[str, Any] = {"kind": "multisine", "band_hz": (0.1, 25.0), "period_s": 10.0}
    signal |= {"joints": joints[:1], "clamped": joints[1:2], "amplitude": 0.25}
    ends = seconds[-1] * np.arange(5) / 4.0
    return JointLog(
        robot="mini_cheetah",
        joints=joints,
        time=seconds,
        **{name: rng.normal(size=(n, width)) for name in QUANTITIES},
        frequency=frequency,
        segments=tuple(
            Segment(start=ends[k] + 0.01, stop=ends[k + 1], repeat=k, **signal) for k in range(4)
        ),
        stiffness=np.full(width, 17.0),
        damping=np.full(width, 0.4),
        pose=np.linspace(-1.0, 1.0, width),
        units=("rad",) * width,
        virtual=True,
        metadata={"note": "a line\nbreak"},
    )


def write_csv(path: Path, log: JointLog) -> None:
    there = [name for name in QUANTITIES if getattr(log, name) is not None]
    header = ["time", *(f"{name}.{joint}" for name in there for joint in log.joints)]
    rows = np.hstack([log.time[:, None], *(getattr(log, name) for name in there)]).tolist()
    path.write_text("\n".join([",".join(header), *(",".join(map(repr, row)) for row in rows)]))


def write_npz(path: Path, log: JointLog) -> None:
    arrays = {name: getattr(log, name) for name in QUANTITIES if getattr(log, name) is not None}
    np.savez_compressed(path, time=log.time, joints=np.array(log.joints), **arrays)


def write_mcap(path: Path, log: JointLog) -> None:
    about = {field.name: getattr(log, field.name) for field in fields(LogHeader)}
    columns = {"time": log.time}
    for name in (*QUANTITIES, "frequency"):
        if (values := getattr(log, name)) is not None:
            columns[name] = values
    columns["segment"] = np.full(len(log.time), -1)
    for i, segment in enumerate(log.segments):
        columns["segment"][(log.time >= segment.start) & (log.time <= segment.stop)] = i
    writer = McapLogWriter(path, LogHeader(**about))
    for segment in log.segments:
        writer.segment(segment)
    for row in zip(*columns.values(), strict=True):
        writer.sample(**dict(zip(columns, row, strict=True)))
    writer.end(complete=log.complete)
