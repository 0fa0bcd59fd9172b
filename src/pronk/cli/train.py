"""`pronk train`: from random weights to a policy that walks and jumps."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any

from pronk.cli import console
from pronk.jump.train.settings import TrainSettings


def train(settings: TrainSettings) -> console.Outcome:
    """Train a policy that walks, runs and jumps on command.

    Args:
        settings: What is trained.
    """
    from pronk.jump.train.devices import require_extra

    require_extra()

    from pronk.jump.train.run import train as run

    again = shlex.join(["pronk", "train", settings.task, "--resume", "--out", str(settings.out)])
    try:
        found = run(settings, report=console.say)
    except KeyboardInterrupt:
        console.following(again)
        raise
    columns = "phase | iterations | environment steps | steps/s;0 | wall clock [s];1"
    fields = ("iterations", "env_steps", "steps_per_second", "seconds")
    rows = [(name, *(one[f] for f in fields)) for name, one in found["phases"].items()]
    if rows:
        console.show_table(columns, rows, title="Training")
    session = found["sessions"][-1]
    console.say(f"{session['seconds']:.0f} s, {session['build_s'] or 0.0:.0f} s of it building")
    if stopped := session["stopped"]:
        console.say(f"stopped: {stopped}")
    if found["finished"]:
        return console.Outcome(figures=found, following=_next_steps(settings, found))
    status = 130 if stopped.startswith("SIG") else 0
    return console.Outcome(figures=found, following=[again], status=status)


def _next_steps(settings: TrainSettings, found: Mapping[str, Any]) -> list[str]:
    folder = settings.out
    policy, copy = folder / "policy.onnx", folder / "gains.yaml"
    matched = found["gains"]["name"] == "matched"
    gains = ["--gains", copy if matched else "naive"]
    if not matched and found["gains"]["sha256"]:
        gains += ["--ranges-from", copy]
    walked = ["pronk", "train", "jump", "--init-checkpoint", folder, *gains]
    steps = [
        ["pronk", "evaluate", policy, *gains, "--out", folder / "evaluation.json"],
        [*walked, "--out", f"{folder}_jump"]
        if settings.task == "walk"
        else ["pronk", "trial", policy],
        ["tensorboard", "--logdir", folder],
    ]
    return [shlex.join(map(str, words)) for words in steps]
