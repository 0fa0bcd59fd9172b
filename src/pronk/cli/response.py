"""`pronk response`: frequency responses as a table and as Bode plots."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from pronk.cli import console
from pronk.cli.options import Reading, require_distinct_names
from pronk.errors import LogError
from pronk.names import file_name
from pronk.tables import Column, Table

if TYPE_CHECKING:
    from pronk.identify.logs.joint_log import JointLog
    from pronk.identify.response.response import Estimator, FrequencyResponse

COHERENT = 0.95
"""Least coherence of a frequency that counts as measured."""
_LOUD = 0.5
"""Least coherence of a frequency that counts for the bandwidth."""


def response(
    paths: tyro.conf.Positional[tuple[Path, ...]],
    robot: str | None = None,
    out: Path | None = None,
    plots: bool = True,
    wide: bool = False,
    segment_s: float | None = None,
    reading: Reading = Reading(),  # noqa: B008
) -> console.Outcome:
    """Estimate the frequency response of every joint that was excited.

    Example:
        pronk response chirp.csv --robot robot.yaml --out out/responses

    Args:
        paths: Logs, or folders of logs.
        robot: A name, or a path to a robot.yaml, MJCF or URDF; the log's if left out.
        out: Folder for what is written; beside the log if left out.
        plots: Draw Bode plots.
        wide: Print every column: repeats, lowest coherence, third harmonic.
        segment_s: Length of the segments of a response in s, whose inverse is the spacing of its
            frequencies; 8, or less for shorter excitations, if left out.
        reading: How logs are read.
    """
    from pronk.identify.logs.velocity import velocity_note
    from pronk.identify.response.estimate import resolution_note
    from pronk.identify.response.response import Estimator, save_responses
    from pronk.robots import ROBOT_NAMES, load_robot

    logs = reading.read(paths, load_robot(robot) if robot else None)
    require_distinct_names(logs, out)
    estimator = Estimator(segment_s=segment_s)
    rows: list[dict[str, Any]] = []
    notes: list[str] = []
    written: list[Path] = []
    with console.progress() as report:
        progress = report.bar("estimate")
        for count, log in enumerate(logs, start=1):
            source = Path(log.source or "log")
            folder = source.parent if out is None else out
            by_joint = _responses_by_joint(log, estimator)
            notes += [f"{source.name}: {note}" for note in log.notes]
            for joint in by_joint:
                velocity = velocity_note(log, joint, source.name)
                if velocity:
                    notes.append(velocity)
            if plots:
                written += _write_plots(by_joint, folder, source.stem)
            responses = []
            for joint_responses in by_joint.values():
                responses += joint_responses
            path = folder / f"{source.stem}.response.npz"
            save_responses(path, responses)
            written.append(path)
            for joint_response in responses:
                rows.append(response_figures(joint_response) | {"log": log.source})
                resolution = resolution_note(joint_response)
                if resolution:
                    notes.append(f"{source.name}: {resolution}")
            progress(count / len(logs))
    console.show(response_table(rows), wide=wide)
    for note in notes:
        console.say(f"note: {note}")
    robot_words = robot or (logs[0].robot if logs[0].robot in ROBOT_NAMES else "ROBOT")
    words = ["pronk", "match", *map(str, paths), "--robot", robot_words]
    # Without gains in the log, those of the robot's file are the first guess.
    if any(log.stiffness is None for log in logs):
        words += ["--drive-gains", "default"]
    command = shlex.join(words) + reading.words()
    return console.Outcome(
        figures={"responses": rows, "written": written},
        wrote=written,
        following=[f"{command} --out gains.yaml"],
    )


def _responses_by_joint(log: JointLog, estimator: Estimator) -> dict[str, list[FrequencyResponse]]:
    """Responses of every excited joint; a LogError if none was excited."""
    from pronk.identify.response.estimate import estimate_response

    if not log.excited_joints:
        raise LogError(f"{log.source or 'log'}: no command moves, so no joint was excited.")
    return {joint: estimate_response(log, joint, estimator) for joint in log.excited_joints}


def _write_plots(
    by_joint: Mapping[str, Sequence[FrequencyResponse]], folder: Path, stem: str
) -> list[Path]:
    """Draw one plot a joint, named by the log and, where that does not name it, the joint."""
    from pronk.report import figures, style

    written = []
    for joint, responses in by_joint.items():
        name = f"{stem}.{file_name(joint)}"
        if len(by_joint) == 1 and stem == file_name(joint):
            name = stem
        written.append(
            style.save_figure(
                figures.measured_responses(responses), folder / f"{name}.response.svg"
            )
        )
    return written


def response_figures(response: FrequencyResponse) -> dict[str, Any]:
    """Return the figures of one response, for the table and for JSON.

    The bandwidth is the frequency at which the gain falls 3 dB below its value at the lowest
    frequency [Hz]: after the last coherent frequency above that level, so that a noisy dip is not
    taken for it.
    """
    import numpy as np

    hz = response.frequency_hz
    coherent_hz = hz[response.coherence >= COHERENT]
    if len(coherent_hz):
        band = (float(coherent_hz.min()), float(coherent_hz.max()))
        inside = response.band(*band)
    else:
        band = None
        inside = hz > 0.0
    peak = int(np.argmax(np.where(inside, response.gain, -np.inf)))
    level = response.gain[0] / np.sqrt(2.0)
    above = np.flatnonzero((response.gain >= level) & (response.coherence >= _LOUD))
    bandwidth = math.nan
    if len(above) and above[-1] + 1 < len(hz):
        ends = slice(above[-1], above[-1] + 2)
        bandwidth = float(np.interp(-level, -response.gain[ends], hz[ends]))
    return {
        "joint": response.joint,
        "virtual": response.virtual,
        "amplitude_rad": response.amplitude,
        "repeats": len(response.repeats),
        "estimator": response.estimator,
        "coherent_hz": band,
        "coherence_min": float(response.coherence[inside].min()),
        "peak_db": float(20.0 * np.log10(response.gain[peak])),
        "peak_hz": float(hz[peak]),
        "bandwidth_hz": bandwidth,
        "delay_s": response.delay_s,
        "third_harmonic": response.third_harmonic,
    }


def response_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Return the table of `response_figures`, one row a response."""
    cells = []
    for row in rows:
        cells.append(
            (
                row["joint"],
                row["amplitude_rad"],
                row["repeats"],
                row["coherent_hz"],
                row["coherence_min"],
                row["peak_db"],
                row["peak_hz"],
                row["bandwidth_hz"],
                row["delay_s"],
                row["third_harmonic"],
            )
        )
    virtual = any(row["virtual"] for row in rows)
    return Table(
        title="Responses of the virtual robot" if virtual else "Responses",
        columns=(
            Column(heading="joint"),
            Column(heading="amplitude", unit="rad"),
            Column(heading="repeats", is_detail=True),
            Column(heading="coherent", unit="Hz", digits=1),
            Column(heading="lowest coherence", is_detail=True),
            Column(heading="peak", unit="dB", digits=2),
            Column(heading="at", unit="Hz", digits=2),
            Column(heading="-3 dB at", unit="Hz", digits=2),
            Column(heading="delay", unit="s", digits=4),
            Column(heading="third harmonic", digits=4, is_detail=True),
        ),
        rows=tuple(cells),
        notes=(f"coherent: frequencies with a coherence of {COHERENT} or more.",),
    )
