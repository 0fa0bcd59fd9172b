"""A log, and logs as files: MCAP, and CSV and NPZ as other tools write them; angles in radians."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pronk.identify.logs.joint_log import JointLog, LogOrigin
from pronk.identify.logs.segment import Segment
from pronk.identify.logs.sweep_writer import LogHeader, McapLogWriter

LEG = ("FR_hip_roll", "FR_hip_pitch", "FR_knee")


def example(n: int = 2000, joints: tuple[str, ...] = LEG) -> JointLog:
    """Joints that jump about, logged at 500 Hz with everything that a log can hold."""
    rng = np.random.default_rng(1)
    width = len(joints)
    time = np.arange(n) / 500.0 + rng.uniform(0.0, 1e-5, n)
    frequency = np.linspace(0.1, 25.0, n)
    frequency[: n // 10] = np.nan
    ends = time[-1] * np.arange(5) / 4.0
    segments = []
    for repeat in range(4):
        segment = Segment(
            kind="multisine",
            joints=joints[:1],
            start=ends[repeat] + 0.01,
            stop=ends[repeat + 1],
            amplitude=0.25,
            repeat=repeat,
            band_hz=(0.1, 25.0),
            period_s=10.0,
            clamped=joints[1:2],
        )
        segments.append(segment)
    return JointLog(
        robot="mini_cheetah",
        joints=joints,
        time=time,
        command=rng.normal(size=(n, width)),
        position=rng.normal(size=(n, width)),
        velocity=rng.normal(size=(n, width)),
        torque=rng.normal(size=(n, width)),
        frequency=frequency,
        segments=tuple(segments),
        stiffness=np.full(width, 17.0),
        damping=np.full(width, 0.4),
        pose=np.linspace(-1.0, 1.0, width),
        units=("rad",) * width,
        origin=LogOrigin(virtual=True, metadata={"note": "a line\nbreak"}),
    )


def quantities(log: JointLog) -> dict[str, np.ndarray]:
    """Arrays of a log with a row for each sample and a column for each joint, by name."""
    arrays = {"command": log.command, "position": log.position}
    if log.velocity is not None:
        arrays["velocity"] = log.velocity
    if log.torque is not None:
        arrays["torque"] = log.torque
    return arrays


def write_csv(path: Path, log: JointLog) -> None:
    """Write a log as a table with a header."""
    header = ["time"]
    columns = [log.time]
    for name, values in quantities(log).items():
        for joint, column in zip(log.joints, values.T, strict=True):
            header.append(f"{name}.{joint}")
            columns.append(column)
    lines = [",".join(header)]
    for row in np.column_stack(columns).tolist():
        lines.append(",".join(repr(number) for number in row))
    path.write_text("\n".join(lines))


def write_npz(path: Path, log: JointLog) -> None:
    """Write a log as arrays by name."""
    np.savez_compressed(path, time=log.time, joints=np.array(log.joints), **quantities(log))


def write_mcap(path: Path, log: JointLog) -> None:
    """Write a log as pronk writes it while it records."""
    header = LogHeader(
        robot=log.robot,
        joints=log.joints,
        stiffness=None if log.stiffness is None else log.stiffness.tolist(),
        damping=None if log.damping is None else log.damping.tolist(),
        pose=None if log.pose is None else log.pose.tolist(),
        units=log.units,
        virtual=log.virtual,
        metadata=log.origin.metadata,
    )
    writer = McapLogWriter(path, header)
    numbers = np.full(len(log.time), -1)
    for number, segment in enumerate(log.segments):
        writer.segment(segment)
        numbers[(log.time >= segment.start) & (log.time <= segment.stop)] = number
    for k in range(len(log.time)):
        writer.sample(
            log.time[k],
            log.command[k],
            log.position[k],
            velocity=None if log.velocity is None else log.velocity[k],
            torque=None if log.torque is None else log.torque[k],
            frequency=np.nan if log.frequency is None else log.frequency[k],
            segment=numbers[k],
        )
    writer.end(complete=log.origin.complete)
