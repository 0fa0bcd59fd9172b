"""`pronk predict`: replay a log that the fit never saw."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pronk.commands import console, logs

if TYPE_CHECKING:
    from pronk.match.gains import MatchedGains
    from pronk.report.replay import Replay
    from pronk.robots.robot import Robot
    from pronk.sweep.log import SweepLog


@logs.reads_logs
def predict(
    paths: logs.LogsArgument,
    robot: logs.RobotOption,
    gains: Annotated[Path, typer.Option("--gains", help="gains.yaml of `pronk match`.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for replays and figure; beside the gains.")
    ] = None,
    json_file: console.JsonOption = None,
    *,
    reading: logs.Reading,
) -> None:
    """Replay logs in the simulator with naive and with matched gains; RMSE and R2 per joint."""


def replays_of(log: SweepLog, robot: Robot, gains: MatchedGains) -> list[Replay]:
    raise NotImplementedError


def row_of(one: Replay) -> dict[str, Any]:
    """What `--json` gives of one replay."""
    return {
        "joint": one.joint,
        "signal": one.signal,
        "unit": one.unit,
        "rmse_naive": one.rmse_naive,
        "rmse_matched": one.rmse_matched,
        "r2_naive": one.r2_naive,
        "r2_matched": one.r2_matched,
    }
