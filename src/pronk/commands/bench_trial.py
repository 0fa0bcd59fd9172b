"""`pronk bench trial`: the trial loop beside a bare MuJoCo loop."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pronk.commands import console


def trial(
    policy: Annotated[Path, typer.Argument(help="policy.onnx.", metavar="POLICY")],
    repeats: Annotated[int, typer.Option(help="Runs of each loop, taken in turn.")] = 7,
    truth: Annotated[
        Path | None,
        typer.Option(help="Body of the virtual robot; the one that ships with pronk if left out."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the jump's start and noise.")] = 0,
    json_file: console.JsonOption = None,
) -> None:
    """Simulated seconds per second of the whole trial loop and of bare mj_step, over one run."""
    from pronk.bench.trial import run, table
    from pronk.hardware.truth import load_truth

    with console.progress() as report:
        result = run(policy, truth=load_truth(truth), repeats=repeats, seed=seed, progress=report)
    console.show(table(result))
    console.write_json(json_file, result.figures())
    console.following(f"pronk trial {policy} --out out/trial   # 20 jumps with each command")
