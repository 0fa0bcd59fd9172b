"""`pronk train`: from random weights to a policy that walks and jumps."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any

from pronk.cli import console
from pronk.exit_status import ExitStatus
from pronk.jump.train.settings import TrainSettings
from pronk.tables import Column, Table


def train_command(settings: TrainSettings) -> console.Outcome:
    """Train a policy that walks, runs and jumps on command.

    Example:
        pronk train all --gains gains.yaml --out runs/matched

    Args:
        settings: What is trained.
    """
    from pronk.jump.train.devices import require_extra

    require_extra()

    from pronk.jump.train.run import run_training

    resume = shlex.join(["pronk", "train", settings.task, "--resume", "--out", str(settings.out)])
    try:
        record = run_training(settings, report=console.say)
    except KeyboardInterrupt:
        console.following(resume)
        raise
    _show_phases(record["phases"])
    session = record["sessions"][-1]
    console.say(f"{session['seconds']:.0f} s in all")
    if session["stopped"]:
        console.say(f"stopped: {session['stopped']}")
    if record["finished"]:
        return console.Outcome(figures=record, following=_next_steps(settings, record))
    status = ExitStatus.DONE
    if session["stopped"].startswith("SIG"):
        status = ExitStatus.INTERRUPTED
    return console.Outcome(figures=record, following=[resume], status=status)


def _show_phases(phases: Mapping[str, Mapping[str, Any]]) -> None:
    """Print the figures of the phases that are over, if any."""
    if not phases:
        return
    rows = []
    for name, figures in phases.items():
        rows.append(
            (
                name,
                figures["iterations"],
                figures["env_steps"],
                figures["steps_per_second"],
                figures["seconds"],
            )
        )
    columns = (
        Column(heading="phase"),
        Column(heading="iterations"),
        Column(heading="environment steps"),
        Column(heading="steps/s", digits=0),
        Column(heading="wall clock", unit="s", digits=1),
    )
    console.show(Table(title="Training", columns=columns, rows=tuple(rows)))


def _next_steps(settings: TrainSettings, record: Mapping[str, Any]) -> list[str]:
    """Return the commands that may follow a finished run."""
    folder = settings.out
    policy = str(folder / "policy.onnx")
    gains_copy = str(folder / "gains.yaml")
    if record["gains"]["name"] == "matched":
        gains_options = ["--gains", gains_copy]
    else:
        gains_options = ["--gains", "naive"]
        if record["gains"]["sha256"]:
            gains_options += ["--ranges-from", gains_copy]
    evaluation = str(folder / "evaluation.json")
    evaluate = ["pronk", "evaluate", policy, *gains_options, "--out", evaluation]
    if settings.task == "walk":
        start = ["--init-checkpoint", str(folder)]
        out = ["--out", f"{folder}_jump"]
        use = ["pronk", "train", "jump", *start, *gains_options, *out]
    else:
        use = ["pronk", "trial", policy]
    curves = ["tensorboard", "--logdir", str(folder)]
    return [shlex.join(evaluate), shlex.join(use), shlex.join(curves)]
