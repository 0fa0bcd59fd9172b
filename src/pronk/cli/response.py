"""`pronk response`: the answer of every joint, as a table and as Bode plots."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from pronk.cli import console, logs

if TYPE_CHECKING:
    from pronk.response.response import FrequencyResponse


COHERENT = 0.95
"""Coherence from which on a frequency counts as answered."""


def response(
    paths: tyro.conf.Positional[tuple[Path, ...]],
    robot: str | None = None,
    out: Path | None = None,
    plots: bool = True,
    reading: logs.ReadingOptions = logs.ReadingOptions(),  # noqa: B008
    json_file: console.JsonFile = None,
) -> None:
    """Estimate the frequency response of every joint that was excited.

    Args:
        paths: Logs, or folders of logs.
        robot: Robot, where the log does not say.
        out: Folder for what is written; beside the log if left out.
        plots: Draw Bode plots.
        json_file: Also write the figures to this file.
        reading: How logs are read.
    """
    from pronk.report import figures, style
    from pronk.response import Estimator, estimate, save
    from pronk.robots import load_robot

    read = logs.read(paths, reading, load_robot(robot) if robot else None)
    settings = Estimator()
    rows: list[dict[str, Any]] = []
    written: list[Path] = []
    with console.progress() as report:
        done = report.bar("estimate")
        for i, log in enumerate(read):
            excited = logs.excited_joints(log)
            found: list[FrequencyResponse] = []
            for k, joint in enumerate(excited):
                found += estimate(log, joint, settings)
                done((i + (k + 1) / (len(excited) + 1)) / len(read))
            folder, stem = logs.home(log, out)
            path = folder / f"{stem}.response.npz"
            save(path, found)
            written.append(path)
            if plots:
                for joint in excited:
                    mine = [r for r in found if r.joint == joint]
                    name = stem if excited == (stem,) else f"{stem}.{joint}"
                    written.append(
                        style.save(figures.responses(mine), folder / f"{name}.response.svg")
                    )
            rows += [figures_of(r) | {"log": log.source} for r in found]
            done((i + 1) / len(read))
    show(rows, virtual=any(log.virtual for log in read))
    for log in read:
        for note in log.notes:
            console.say(f"note: {Path(log.source).name}: {note}")
    console.wrote(*written)
    console.write_json(json_file, {"responses": rows, "written": written})
    name = robot or read[0].robot or "ROBOT"
    where = " ".join(str(path) for path in paths)
    console.following(f"pronk match {where} --robot {name} --out gains.yaml")


def figures_of(found: FrequencyResponse) -> dict[str, Any]:
    """What the table says of one response."""
    import numpy as np

    hz = found.frequency_hz
    coherent = hz[found.coherence >= COHERENT]
    inside = found.band(float(coherent.min()), float(coherent.max())) if len(coherent) else hz > 0.0
    peak = int(np.argmax(np.where(inside, found.gain, -np.inf)))
    return {
        "joint": found.joint,
        "virtual": found.virtual,
        "amplitude_rad": found.amplitude,
        "repeats": len(found.repeats),
        "estimator": found.estimator,
        "coherent_hz": [float(coherent.min()), float(coherent.max())] if len(coherent) else None,
        "coherence_min": float(found.coherence[inside].min()),
        "peak_db": float(20.0 * np.log10(found.gain[peak])),
        "peak_hz": float(hz[peak]),
        "bandwidth_hz": bandwidth_hz(found),
        "delay_s": found.delay_s,
        "third_harmonic": found.third_harmonic,
    }


def bandwidth_hz(found: FrequencyResponse) -> float:
    """Frequency at which the gain falls 3 dB below that at the lowest frequency [Hz].

    Only frequencies after the last one above that level count, so a noisy dip is not taken for
    the end of the band; NaN if the gain never falls, interpolated between the two neighbours.
    """
    import numpy as np

    level = found.gain[0] / np.sqrt(2.0)
    reliable = found.coherence >= 0.5
    above = np.flatnonzero((found.gain >= level) & reliable)
    if len(above) == 0 or above[-1] + 1 >= len(found.gain):
        return float("nan")
    i = int(above[-1])
    return float(np.interp(-level, -found.gain[i : i + 2], found.frequency_hz[i : i + 2]))


def show(rows: list[dict[str, Any]], *, virtual: bool) -> None:
    """Print the table of responses."""
    made = console.table(
        "Responses of the virtual robot" if virtual else "Responses",
        "joint",
        "amplitude [rad]",
        "repeats",
        f"coherence >= {COHERENT} [Hz]",
        "least there",
        "peak [dB]",
        "at [Hz]",
        "-3 dB at [Hz]",
        "command delay [ms]",
        "third harmonic [%]",
    )
    for row in rows:
        band = row["coherent_hz"]
        console.row(
            made,
            row["joint"],
            f"{row['amplitude_rad']:.3g}",
            str(row["repeats"]),
            f"{band[0]:.2g} to {band[1]:.3g}" if band else "none",
            console.number(row["coherence_min"], 3),
            console.number(row["peak_db"]),
            console.number(row["peak_hz"]),
            console.number(row["bandwidth_hz"]),
            console.number(1000.0 * row["delay_s"], 1),
            console.number(100.0 * row["third_harmonic"], 1),
        )
    console.show(made)
