"""`pronk response`: frequency responses as a table and as Bode plots."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from pronk.cli import console
from pronk.cli.options import Reading
from pronk.errors import LogError
from pronk.names import file_name

if TYPE_CHECKING:
    from pronk.identify.response.response import FrequencyResponse

COHERENT = 0.95
"""Least coherence of a frequency that counts as measured."""


def response(
    paths: tyro.conf.Positional[tuple[Path, ...]],
    robot: str | None = None,
    out: Path | None = None,
    plots: bool = True,
    reading: Reading = Reading(),  # noqa: B008
) -> console.Outcome:
    """Estimate the frequency response of every joint that was excited.

    Args:
        paths: Logs, or folders of logs.
        robot: A name, or a path to a robot.yaml, MJCF or URDF; the log's if left out.
        out: Folder for what is written; beside the log if left out.
        plots: Draw Bode plots.
        reading: How logs are read.
    """
    from pronk.identify.response import Estimator, estimate, save
    from pronk.report import figures, style
    from pronk.robots import load_robot

    logs = reading.read(paths, load_robot(robot) if robot else None)
    rows: list[dict[str, Any]] = []
    written: list[Path] = []
    with console.progress() as report:
        done = report.bar("estimate")
        for i, log in enumerate(logs):
            source = Path(log.source or "log")
            folder, stem = out or source.parent, source.stem
            found: list[FrequencyResponse] = []
            if not (joints := log.excited_joints):
                raise LogError(f"{log.source or 'log'}: no command moves, so no joint was excited.")
            for joint in joints:
                mine = estimate(log, joint, Estimator())
                found += mine
                if plots:
                    own = file_name(joint)
                    name = stem if len(joints) == 1 and own == stem else f"{stem}.{own}"
                    path = folder / f"{name}.response.svg"
                    written.append(style.save(figures.responses(mine), path))
            save(folder / f"{stem}.response.npz", found)
            written.append(folder / f"{stem}.response.npz")
            rows += [summary(one) | {"log": log.source} for one in found]
            done((i + 1) / len(logs))
    virtual = any(row["virtual"] for row in rows)
    title = "Responses of the virtual robot" if virtual else "Responses"
    console.show_rows(title, COLUMNS, rows)
    for log in logs:
        for note in log.notes:
            console.say(f"note: {Path(log.source).name}: {note}")
    name, where = robot or logs[0].robot or "ROBOT", " ".join(map(str, paths))
    return console.Outcome(
        figures={"responses": rows, "written": written},
        wrote=written,
        following=[f"pronk match {where} --robot {name} --out gains.yaml"],
    )


def summary(found: FrequencyResponse) -> dict[str, Any]:
    """Figures of one response, for the table and for JSON.

    The bandwidth is where the gain falls 3 dB below that at the lowest frequency [Hz]: after the
    last coherent frequency above that level, so that a noisy dip is not taken for it.
    """
    import numpy as np

    hz, level = found.frequency_hz, found.gain[0] / np.sqrt(2.0)
    coherent = hz[found.coherence >= COHERENT]
    band = (float(coherent.min()), float(coherent.max())) if len(coherent) else None
    inside = found.band(*band) if band else hz > 0.0
    peak = int(np.argmax(np.where(inside, found.gain, -np.inf)))
    above = np.flatnonzero((found.gain >= level) & (found.coherence >= 0.5))
    bandwidth = math.nan
    if len(above) and above[-1] + 1 < len(hz):
        ends = slice(above[-1], above[-1] + 2)
        bandwidth = float(np.interp(-level, -found.gain[ends], hz[ends]))
    return {
        "joint": found.joint,
        "virtual": found.virtual,
        "amplitude_rad": found.amplitude,
        "repeats": len(found.repeats),
        "estimator": found.estimator,
        "coherent_hz": band,
        "coherence_min": float(found.coherence[inside].min()),
        "peak_db": float(20.0 * np.log10(found.gain[peak])),
        "peak_hz": float(hz[peak]),
        "bandwidth_hz": bandwidth,
        "delay_s": found.delay_s,
        "third_harmonic": found.third_harmonic,
    }


COLUMNS = {
    "joint": "joint",
    "amplitude [rad]": "amplitude_rad",
    "repeats": "repeats",
    f"coherence >= {COHERENT} [Hz];1": "coherent_hz",
    "least there": "coherence_min",
    "peak [dB];2": "peak_db",
    "at [Hz];2": "peak_hz",
    "-3 dB at [Hz];2": "bandwidth_hz",
    "command delay [s];4": "delay_s",
    "third harmonic": "third_harmonic",
}
"""Heading to field of a summary."""
