"""`pronk train`: from random weights to a policy that walks and jumps."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any

from pronk.cli import console
from pronk.train.settings import TrainSettings

CPU_RATE = 300.0
"""Environment steps a second that two cores were seen to train with."""


def train(settings: TrainSettings, json_file: console.JsonFile = None) -> None:
    """Train a policy that walks, runs and jumps on command.

    Args:
        settings: What is trained.
        json_file: Also write the figures to this file.
    """
    from pronk.train.run import train as run

    try:
        found = run(settings, report=console.say)
    except KeyboardInterrupt:
        console.following(_again(settings))
        raise
    _show(found)
    console.write_json(json_file, found)
    if not found["finished"]:
        console.following(_again(settings))
        if found["sessions"][-1]["stopped"].startswith("SIG"):
            raise KeyboardInterrupt
        return
    console.following(*_next_steps(settings, found))


def _show(found: Mapping[str, Any]) -> None:
    rows = [
        {
            "phase": name,
            "iterations": f"{one['iterations']}",
            "environment steps": f"{one['env_steps']:,}",
            "steps/s": f"{one['steps_per_second']:,.0f}",
            "wall clock [s]": f"{one['seconds']:.1f}",
        }
        for name, one in found["phases"].items()
    ]
    if rows:
        console.show(console.table("Training", *rows[0], rows=[list(row.values()) for row in rows]))
    session = found["sessions"][-1]
    console.say(f"{session['seconds']:.0f} s, {session['build_s'] or 0.0:.0f} s of it building")
    if session["stopped"]:
        console.say(f"stopped: {session['stopped']}")


def _again(settings: TrainSettings) -> str:
    return shlex.join(["pronk", "train", settings.task, "--resume", "--out", str(settings.out)])


def _next_steps(settings: TrainSettings, found: Mapping[str, Any]) -> list[str]:
    folder = settings.out
    copy = str(folder / "gains.yaml")
    matched = found["gains"]["name"] == "matched"
    gains = ["--gains", copy if matched else "naive"]
    if not matched and found["gains"]["sha256"]:
        gains += ["--ranges-from", copy]
    policy = folder / "policy.onnx"
    steps = [
        shlex.join(
            ["pronk", "evaluate", str(policy), *gains, "--out", str(folder / "evaluation.json")]
        )
    ]
    if settings.task == "walk":
        words = ["pronk", "train", "jump", "--init-checkpoint", str(folder), *gains]
        steps.append(shlex.join([*words, "--out", f"{folder}_jump"]))
    else:
        steps.append(shlex.join(["pronk", "trial", str(policy)]))
    steps.append(shlex.join(["tensorboard", "--logdir", str(folder)]))
    return steps
