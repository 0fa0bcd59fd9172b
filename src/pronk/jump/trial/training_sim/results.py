"""The file and the tables of an evaluation in the training simulator."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path

from pronk.errors import ArtefactError
from pronk.jump.trial.criteria import evaluation_checks
from pronk.jump.trial.results import load_json, save_json
from pronk.jump.trial.tables import check_table, spread_text
from pronk.jump.trial.training_sim.evaluation import CommandResult, Evaluation
from pronk.tables import Cell, Column, Table, number, percent

SCHEMA = "pronk/trial/3"

WALK_COLUMNS = (
    Column(heading="command"),
    Column(heading="speed error", unit="m/s"),
    Column(heading="yaw rate error", unit="rad/s"),
    Column(heading="mean velocity", unit="m/s, m/s, rad/s", is_detail=True),
    Column(heading="drift", unit="m", digits=2),
    Column(heading="falls", unit="%"),
    Column(heading="flight over standing", unit="cm", is_detail=True),
)
JUMP_COLUMNS = (
    Column(heading="command"),
    Column(heading="height", unit="m"),
    Column(heading="distance", unit="m"),
    Column(heading="lift-off up", unit="m/s", is_detail=True),
    Column(heading="after", unit="s", is_detail=True),
    Column(heading="along", unit="m", digits=2, is_detail=True),
    Column(heading="flights", digits=2, is_detail=True),
    Column(heading="high ones", digits=2, is_detail=True),
    Column(heading="one", unit="%", is_detail=True),
    Column(heading="jumped", unit="%"),
    Column(heading="upright", unit="%"),
    Column(heading="non-foot contact", unit="%"),
)


def save_evaluation(path: Path, evaluation: Evaluation) -> None:
    """Write an evaluation and its checks as JSON, whole or not at all; NaN becomes null."""
    checks = [check.row() for check in evaluation_checks(evaluation)]
    save_json(path, SCHEMA, {"checks": checks, **asdict(evaluation)})


def load_speed_errors(path: Path) -> dict[str, float]:
    """Read the mean speed errors by walk [m/s] of a saved evaluation.

    Raises:
        ArtefactError: The file is no evaluation, or one without walks.
    """
    errors = {}
    with load_json(path, SCHEMA, "pronk evaluate") as body:
        for walk in body["walks"]:
            mean = walk["figures"]["speed_error"]["mean"]
            errors[str(walk["name"])] = float(mean or math.nan)
    if not errors:
        raise ArtefactError(f"{path}: has no walks; evaluate that policy with --what walk.")
    return errors


def evaluation_tables(evaluation: Evaluation) -> list[Table]:
    """Make the tables of an evaluation: walks, jumps, acceptance criteria."""
    tables = []
    if evaluation.walks:
        tables.append(
            Table(
                title="Walking: mean over robots and time; in brackets with the stride averaged "
                "out",
                columns=WALK_COLUMNS,
                rows=tuple(_walk_row(walk) for walk in evaluation.walks),
            )
        )
    if evaluation.jumps:
        tables.append(
            Table(
                title="Jumping: mean +- standard deviation over robots",
                columns=JUMP_COLUMNS,
                rows=tuple(_jump_row(jump) for jump in evaluation.jumps),
                notes=(
                    "non-foot contact: anything but a foot on the ground, from the jump input to "
                    "2 s after touchdown; a trial counts no such jump as a success.",
                ),
            )
        )
    checks = check_table("Acceptance criteria", evaluation_checks(evaluation), _notes(evaluation))
    if checks.rows:
        tables.append(checks)
    return tables


def _walk_row(walk: CommandResult) -> tuple[Cell, ...]:
    """Return the row of a walk."""
    speed_error = number(walk["speed_error"].mean)
    speed_error_averaged = number(walk["speed_error_averaged"].mean)
    yaw_error = number(walk["yaw_error"].mean)
    yaw_error_averaged = number(walk["yaw_error_averaged"].mean)
    forward = number(walk["forward"].mean, 2)
    left = number(walk["left"].mean, 2)
    yaw_rate = number(walk["yaw_rate"].mean, 2)
    return (
        walk.name,
        f"{speed_error} ({speed_error_averaged})",
        f"{yaw_error} ({yaw_error_averaged})",
        f"{forward}, {left}, {yaw_rate}",
        walk["drift"].mean,
        percent(walk["fell"].mean),
        percent(walk["uncommanded"].maximum),
    )


def _jump_row(jump: CommandResult) -> tuple[Cell, ...]:
    """Return the row of a jump."""
    return (
        jump.name,
        spread_text(jump["height"]),
        spread_text(jump["distance"], 2),
        spread_text(jump["lift_off_velocity"], 2),
        spread_text(jump["delay"], 2),
        jump["along"].mean,
        jump["flights"].mean,
        jump["high_flights"].mean,
        percent(jump["single"].mean),
        percent(jump["found"].mean),
        percent(jump["upright"].mean),
        percent(jump["non_foot_contact"].mean),
    )


def _notes(evaluation: Evaluation) -> list[str]:
    """Return what stands below the acceptance criteria."""
    notes = []
    estimator = evaluation.estimator
    if estimator:
        notes.append(
            f"estimator while walking: velocity RMSE {estimator['velocity']:.3f} m/s (forward / "
            f"left / up {estimator['forward']:.3f} / {estimator['left']:.3f} / "
            f"{estimator['up']:.3f}), contacts right {percent(estimator['contacts_right'])} %"
        )
    notes.append(
        f"PASSED; {evaluation.plan['robots']} robots a command, randomization "
        f"{evaluation.about.get('randomization', '-')}, seed {evaluation.plan['seed']}, "
        f"{evaluation.seconds:.0f} s"
    )
    return notes
