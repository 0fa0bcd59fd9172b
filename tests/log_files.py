"""A log, and logs as files: MCAP, and CSV and NPZ as other tools write them; angles in radians."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np

from pronk.logs.joint_log import JointLog, Segment
from pronk.logs.mcap_log import LogHeader, McapLogWriter

QUANTITIES = ("command", "position", "velocity", "torque")
LEG = ("FR_hip_roll", "FR_hip_pitch", "FR_knee")


def example(n: int = 2000, joints: tuple[str, ...] = LEG) -> JointLog:
    """Joints that jump about, logged at 500 Hz with everything that a log can hold."""
    rng = np.random.default_rng(1)
    seconds = np.arange(n) / 500.0 + rng.uniform(0.0, 1e-5, n)
    frequency = np.linspace(0.1, 25.0, n)
    frequency[: n // 10] = np.nan
    segments = tuple(
        Segment(
            kind="multisine",
            joints=joints[:1],
            start=seconds[-1] * k / 4.0 + 0.01,
            stop=seconds[-1] * (k + 1) / 4.0,
            amplitude=0.25,
            repeat=k,
            band_hz=(0.1, 25.0),
            period_s=10.0,
            clamped=joints[1:2],
        )
        for k in range(4)
    )
    columns = {
        name: rng.normal(size=(n, len(joints)))
        for name in ("command", "position", "velocity", "torque")
    }
    return JointLog(
        robot="mini_cheetah",
        joints=joints,
        time=seconds,
        **columns,
        frequency=frequency,
        segments=segments,
        stiffness=np.full(len(joints), 17.0),
        damping=np.full(len(joints), 0.4),
        pose=np.linspace(-1.0, 1.0, len(joints)),
        units=("rad",) * len(joints),
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
    lists = {
        name: values.tolist() if isinstance(values, np.ndarray) else values
        for name, values in vars(log).items()
    }
    header = LogHeader(**{field.name: lists[field.name] for field in fields(LogHeader)})
    columns = {
        name: lists[name] for name in ("time", *QUANTITIES, "frequency") if lists[name] is not None
    }
    columns["segment"] = np.full(len(log.time), -1)
    for i, segment in enumerate(log.segments):
        columns["segment"][(log.time >= segment.start) & (log.time <= segment.stop)] = i
    writer = McapLogWriter(path, header)
    for segment in log.segments:
        writer.segment(segment)
    for row in zip(*columns.values(), strict=True):
        writer.sample(**dict(zip(columns, row, strict=True)))
    writer.end(complete=log.complete)
