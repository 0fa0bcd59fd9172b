"""`pronk predict`: replay a log that the fit never saw."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from pronk.cli import console, logs

if TYPE_CHECKING:
    from pronk.match.prediction import JointPrediction


def predict(
    paths: tyro.conf.Positional[tuple[Path, ...]],
    robot: str,
    gains: Path,
    out: Path | None = None,
    simulator: str = "mujoco",
    reading: logs.ReadingOptions = logs.ReadingOptions(),  # noqa: B008
    json_file: console.JsonFile = None,
) -> None:
    """Replay logs in the simulator with naive and with matched gains; RMSE and R2 per joint.

    Args:
        paths: Logs, or folders of logs.
        robot: Robot: a name, or a path to its robot.yaml, MJCF or URDF.
        gains: gains.yaml of `pronk match`.
        out: Folder for replays and figure; beside the gains.
        simulator: mujoco, FILE.py:NAME, or the name of an installed simulator.
        json_file: Also write the figures to this file.
        reading: How logs are read.
    """
    from pronk.match import gains as gains_file
    from pronk.match import prediction as prediction_file
    from pronk.match.predict import predict as predict_log
    from pronk.report import figures, style
    from pronk.robots import load_robot

    machine = load_robot(robot)
    matched = gains_file.load(gains)
    read = logs.read(paths, reading, machine)
    seen = [log.source for log in read if log.sha256 and log.sha256 in matched.logs.values()]
    folder = out if out is not None else gains.parent
    rows: list[dict[str, Any]] = []
    written: list[Path] = []
    excluded: dict[str, str] = {}
    with console.progress() as report:
        done = report.bar("predict")
        for i, log in enumerate(read):
            found = predict_log(log, machine, matched, simulator=simulator)
            excluded |= found.excluded
            stem = Path(log.source or "log").stem
            path = folder / f"{stem}.prediction.npz"
            prediction_file.save(path, replace(found, source=Path(log.source).name))
            written.append(path)
            for one in found.joints:
                name = stem if stem == one.joint else f"{stem}.{one.joint}"
                figure = figures.prediction(one, virtual=log.virtual)
                written.append(style.save(figure, folder / f"{name}.prediction.svg"))
            rows += [row_of(one) | {"log": log.source} for one in found.joints]
            done((i + 1) / len(read))
    show(rows, virtual=any(log.virtual for log in read))
    for source in seen:
        console.warn(
            f"{source} went into these gains: this is no prediction but a check of the fit."
        )
    for reason in excluded.values():
        console.say(f"left out: {reason}")
    console.wrote(*written)
    console.write_json(json_file, {"predictions": rows, "fitted_on": seen, "excluded": excluded})
    if (folder / "match.npz").exists():
        console.following(f"pronk report {folder}   # puts these replays on the page")


def show(rows: list[dict[str, Any]], *, virtual: bool) -> None:
    """Print the table of predictions."""
    made = console.table(
        "Replayed logs of the virtual robot" if virtual else "Replayed logs",
        "joint",
        "signal",
        "RMSE naive",
        "naive with the delay",
        "RMSE matched",
        "unit",
        "matched / naive",
        "R2 naive",
        "R2 matched",
    )
    for row in rows:
        naive, matched = row["rmse_naive"], row["rmse_matched"]
        console.row(
            made,
            row["joint"],
            row["signal"].replace("_", " "),
            console.number(naive, 4),
            console.number(row["rmse_naive_delayed"], 4),
            console.number(matched, 4),
            row["unit"],
            console.number(matched / naive if naive > 0.0 else float("nan")),
            console.number(row["r2_naive"], 3),
            console.number(row["r2_matched"], 3),
        )
    console.show(made)


def row_of(one: JointPrediction) -> dict[str, Any]:
    """What `--json` gives of one replay."""
    return {
        "joint": one.joint,
        "signal": one.signal,
        "unit": one.unit,
        "rmse_naive": one.rmse_naive,
        "rmse_naive_delayed": one.rmse_naive_delayed,
        "rmse_matched": one.rmse_matched,
        "r2_naive": one.r2_naive,
        "r2_matched": one.r2_matched,
    }
