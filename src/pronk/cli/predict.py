"""`pronk predict`: replay logs that no fit has used, with nominal and with matched gains."""

from __future__ import annotations

import shlex
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from pronk.cli import console, options
from pronk.cli.options import Reading
from pronk.names import file_name
from pronk.tables import Column, Table

if TYPE_CHECKING:
    from pronk.identify.logs.joint_log import JointLog
    from pronk.identify.match.predict import JointPrediction, Prediction


def predict_logs(
    paths: tyro.conf.Positional[tuple[Path, ...]],
    gains: Path,
    robot: str | None = None,
    out: Path | None = None,
    drive_gains: tuple[str, ...] = (),
    simulator: str = "mujoco",
    simulator_python: Path | None = None,
    allow_unmatched: bool = False,
    wide: bool = False,
    reading: Reading = Reading(),  # noqa: B008
) -> console.Outcome:
    """Replay logs in the simulator with nominal and with matched gains; RMSE and R² per joint.

    Example:
        pronk predict fresh.csv --gains out/gains.yaml --drive-gains default

    Args:
        paths: Logs, or folders of logs.
        gains: gains.yaml of `pronk match`.
        robot: A name, or a path to a robot.yaml, MJCF or URDF; the gains' if left out.
        out: Folder for replays and figures; beside the gains if left out.
        drive_gains: Gains on the real drives if the logs do not have them: JOINT=STIFFNESS,DAMPING
            or GROUP=STIFFNESS,DAMPING, repeat it; or default, those of the robot's file.
        simulator: mujoco, FILE.py:NAME, or the name of an installed simulator.
        simulator_python: Python that the simulator runs in (3.11 or later, with NumPy).
        allow_unmatched: Also replay joints whose gains are no match.
        wide: Print every column: signal, R² and nominal gains with the delay as well.
        reading: How logs are read.
    """
    from pronk.identify.match.export.actuators import robot_of
    from pronk.identify.match.gains import load_gains, require_matched
    from pronk.identify.match.predict import predict, save_prediction
    from pronk.robots import load_robot

    matched_gains = load_gains(gains)
    require_matched(matched_gains, allow_unmatched, str(gains))
    robot_spec = load_robot(robot) if robot else robot_of(matched_gains)
    stated_gains = options.drive_gains(drive_gains)
    logs = reading.read(paths, robot_spec)
    folder = out if out is not None else gains.parent
    options.require_distinct_names(logs, folder)
    rows: list[dict[str, Any]] = []
    fitted_logs: list[str] = []
    wrote: list[Path] = []
    excluded: dict[str, str] = {}
    with console.progress() as report:
        done = report.bar("predict")
        for index, log in enumerate(logs):
            prediction = predict(
                log,
                robot_spec,
                matched_gains,
                drive_gains=stated_gains,
                simulator=simulator,
                simulator_python=simulator_python,
                allow_unmatched=allow_unmatched,
            )
            excluded |= prediction.excluded
            path = folder / f"{_stem(log)}.prediction.npz"
            save_prediction(path, replace(prediction, source=Path(log.source).name))
            wrote.append(path)
            wrote.extend(_save_figures(prediction, log, folder))
            for row in prediction_rows(prediction.joints):
                rows.append({**row, "log": log.source})
            if prediction.fitted:
                fitted_logs.append(log.source)
            done((index + 1) / len(logs))

    virtual = any(log.virtual for log in logs)
    console.show(prediction_table(rows, virtual=virtual), wide=wide)
    for source in fitted_logs:
        console.warn(f"{source} was used by these gains: this is a check of the fit.")
    for name, reasons in matched_gains.unmatched.items():
        console.warn(f"{name} is no match: {'; '.join(reasons)}")
    for reason in excluded.values():
        console.say(f"left out: {reason}")
    following = []
    if (folder / "match.npz").exists():
        following.append(
            f"pronk report {shlex.quote(str(folder))}   # puts these replays on the page"
        )
    return console.Outcome(
        figures={"predictions": rows, "fitted_on": fitted_logs, "excluded": excluded},
        wrote=wrote,
        following=following,
    )


def prediction_rows(joints: Iterable[JointPrediction]) -> list[dict[str, Any]]:
    """Return the figures of some predicted joints, for the table and for JSON."""
    rows = []
    for joint in joints:
        row = {
            "joint": joint.joint,
            "signal": joint.signal,
            "unit": joint.unit,
            "rmse_nominal": joint.rmse_nominal,
            "rmse_nominal_delayed": joint.rmse_nominal_delayed,
            "rmse_matched": joint.rmse_matched,
            "r2_nominal": joint.r2_nominal,
            "r2_matched": joint.r2_matched,
        }
        rows.append(row)
    return rows


PREDICTION_COLUMNS = {
    "joint": Column(heading="joint"),
    "signal": Column(heading="signal", is_detail=True),
    "unit": Column(heading="unit"),
    "rmse_nominal": Column(heading="RMSE nominal", digits=4),
    "rmse_nominal_delayed": Column(heading="nominal with the delay", digits=4, is_detail=True),
    "rmse_matched": Column(heading="RMSE matched", digits=4),
    "r2_nominal": Column(heading="R² nominal", is_detail=True),
    "r2_matched": Column(heading="R² matched"),
}
"""Columns of the table, by the figures of `prediction_rows`."""


def prediction_table(rows: Iterable[dict[str, Any]], *, virtual: bool) -> Table:
    """Return the table of predicted joints."""
    cells = []
    for row in rows:
        cells.append(tuple(row[name] for name in PREDICTION_COLUMNS))
    return Table(
        title="Replayed logs of the virtual robot" if virtual else "Replayed logs",
        columns=tuple(PREDICTION_COLUMNS.values()),
        rows=tuple(cells),
    )


def _stem(log: JointLog) -> str:
    """Return the beginning of the names of a log's files."""
    return Path(log.source or "log").stem


def _save_figures(prediction: Prediction, log: JointLog, folder: Path) -> list[Path]:
    """Draw each predicted joint of a log; return the files."""
    from pronk.report import figures, style

    stem = _stem(log)
    wrote = []
    for joint in prediction.joints:
        joint_name = file_name(joint.joint)
        name = stem if stem == joint_name else f"{stem}.{joint_name}"
        figure = figures.prediction_figure(joint, virtual=log.virtual)
        wrote.append(style.save_figure(figure, folder / f"{name}.prediction.svg"))
    return wrote
