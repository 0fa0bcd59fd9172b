"""The file and the tables of an evaluation in the training simulator."""

from __future__ import annotations

import math
from dataclasses import asdict
from pathlib import Path

from pronk.errors import ArtefactError
from pronk.jump.trial.criteria import evaluation_checks
from pronk.jump.trial.results import load_json, save_json
from pronk.jump.trial.tables import Sheet, check_table, spread_text, table
from pronk.jump.trial.training_sim.evaluation import Evaluation
from pronk.tables import Table, number, percent

SCHEMA = "pronk/trial/3"


def save(path: Path, evaluation: Evaluation) -> None:
    """Write an evaluation and its checks as JSON, whole or not at all; NaN becomes null."""
    checks = [check.row() for check in evaluation_checks(evaluation)]
    save_json(path, SCHEMA, {"checks": checks, **asdict(evaluation)})


def load_speed_errors(path: Path) -> dict[str, float]:
    """Read the mean speed errors by walk [m/s] of a saved evaluation."""
    with load_json(path, SCHEMA, "pronk evaluate") as body:
        errors = {
            str(walk["name"]): float(walk["figures"]["speed_error"]["mean"] or math.nan)
            for walk in body["walks"]
        }
    if not errors:
        raise ArtefactError(f"{path}: has no walks; evaluate that policy with --what walk.")
    return errors


def sheets(evaluation: Evaluation) -> tuple[Sheet | Table, ...]:
    """The tables of an evaluation."""
    walks = []
    for walk in evaluation.walks:
        errors = (
            f"{number(walk[name].mean)} ({number(walk[f'{name}_averaged'].mean)})"
            for name in ("speed_error", "yaw_error")
        )
        velocity = ", ".join(number(walk[n].mean, 2) for n in ("forward", "left", "yaw_rate"))
        shares = percent(walk["fell"].mean), percent(walk["uncommanded"].most)
        walks.append((walk.name, *errors, velocity, walk["drift"].mean, *shares))
    jumps = [
        (
            jump.name,
            spread_text(jump["height"]),
            *(spread_text(jump[name], 2) for name in ("distance", "lift_off_velocity", "delay")),
            *(jump[name].mean for name in ("along", "flights", "high_flights")),
            *(percent(jump[n].mean) for n in ("single", "found", "upright", "non_foot_contact")),
        )
        for jump in evaluation.jumps
    ]
    notes, estimator = [], evaluation.estimator
    if estimator:
        axes = " / ".join(f"{estimator[axis]:.3f}" for axis in ("forward", "left", "up"))
        notes.append(
            f"estimator while walking: velocity RMSE {estimator['velocity']:.3f} m/s (forward / "
            f"left / up {axes}), contacts right {percent(estimator['contacts_right'])} %"
        )
    notes.append(
        f"PASSED; {evaluation.plan['robots']} robots a command, randomization "
        f"{evaluation.about.get('randomization', '-')}, seed {evaluation.plan['seed']}, "
        f"{evaluation.seconds:.0f} s"
    )
    found = (
        table(
            "command | speed error [m/s] | yaw rate error [rad/s] | mean velocity [m/s, m/s, rad/s]"
            " | drift [m];2 | falls [%] | flight over standing [cm]",
            walks,
            title="Walking: mean over robots and time; in brackets with the stride averaged out",
        ),
        table(
            "command | height [m] | distance [m] | lift-off up [m/s] | after [s] | along [m];2"
            " | flights;2 | high ones;2 | one [%] | jumped [%] | upright [%]"
            " | non-foot contact [%]",
            jumps,
            "non-foot contact: anything but a foot on the ground, from the jump input to 2 s after "
            "touchdown; a trial counts no such jump as a success.",
            title="Jumping: mean +- standard deviation over robots",
        ),
        check_table("Acceptance criteria", evaluation_checks(evaluation), notes),
    )
    return tuple(one for one in found if one.rows)
