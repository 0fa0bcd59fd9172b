"""`pronk predict`: replay logs that no fit has used, with nominal and with matched gains."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from pronk.cli import console, options
from pronk.cli.options import Reading
from pronk.names import file_name

if TYPE_CHECKING:
    from pronk.identify.match.predict import JointPrediction


def predict(
    paths: tyro.conf.Positional[tuple[Path, ...]],
    robot: str,
    gains: Path,
    out: Path | None = None,
    drive_gains: tuple[str, ...] = (),
    simulator: str = "mujoco",
    simulator_python: Path | None = None,
    reading: Reading = Reading(),  # noqa: B008
) -> console.Outcome:
    """Replay logs in the simulator with nominal and with matched gains; RMSE and R2 per joint.

    Args:
        paths: Logs, or folders of logs.
        robot: A name, or a path to a robot.yaml, MJCF or URDF.
        gains: gains.yaml of `pronk match`.
        out: Folder for replays and figures; beside the gains.
        drive_gains: As of `pronk match`.
        simulator: mujoco, FILE.py:NAME, or the name of an installed simulator.
        simulator_python: Python that the simulator runs in (3.11 or later, with NumPy).
        reading: How logs are read.
    """
    from pronk.identify.match import gains as gains_file
    from pronk.identify.match.predict import predict as predict_log
    from pronk.identify.match.predict import save_prediction
    from pronk.report import figures, style
    from pronk.robots import load_robot

    known, matched = load_robot(robot), gains_file.load_gains(gains)
    given, logs = options.drive_gains(drive_gains), reading.read(paths, known)
    fitted = [
        log.source
        for log in logs
        if log.origin.sha256 and log.origin.sha256 in matched.logs.values()
    ]
    folder = out if out is not None else gains.parent
    rows: list[dict[str, Any]] = []
    written: list[Path] = []
    excluded: dict[str, str] = {}
    with console.progress() as report:
        done = report.bar("predict")
        for i, log in enumerate(logs):
            found = predict_log(
                *(log, known, matched),
                drive_gains=given,
                simulator=simulator,
                simulator_python=simulator_python,
            )
            excluded |= found.excluded
            stem = Path(log.source or "log").stem
            path = folder / f"{stem}.prediction.npz"
            save_prediction(path, replace(found, source=Path(log.source).name))
            written.append(path)
            for one in found.joints:
                own = file_name(one.joint)
                name = stem if stem == own else f"{stem}.{own}"
                figure = figures.prediction(one, virtual=log.virtual)
                written.append(style.save(figure, folder / f"{name}.prediction.svg"))
            rows += [row | {"log": log.source} for row in prediction_rows(found.joints)]
            done((i + 1) / len(logs))
    virtual = any(log.virtual for log in logs)
    columns = "joint | signal | unit | RMSE nominal;4 | nominal with the delay;4 | RMSE matched;4"
    cells = [list(row.values())[:-1] for row in rows]
    title = "Replayed logs of the virtual robot" if virtual else "Replayed logs"
    console.show_table(f"{columns} | R2 nominal | R2 matched", cells, title=title)
    for source in fitted:
        console.warn(f"{source} was used by these gains: this is a check of the fit.")
    for reason in excluded.values():
        console.say(f"left out: {reason}")
    shown = f"pronk report {folder}   # puts these replays on the page"
    return console.Outcome(
        figures={"predictions": rows, "fitted_on": fitted, "excluded": excluded},
        wrote=written,
        following=[shown] if (folder / "match.npz").exists() else [],
    )


def prediction_rows(found: Iterable[JointPrediction]) -> list[dict[str, Any]]:
    """Figures of replays, for the table and for JSON."""
    names = ("joint", "signal", "unit", "rmse_naive", "rmse_naive_delayed", "rmse_matched")
    return [{n: getattr(one, n) for n in (*names, "r2_naive", "r2_matched")} for one in found]
