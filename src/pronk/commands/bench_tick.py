"""`pronk bench tick`: how punctual a control loop is on this computer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pronk.commands import console


def tick(
    policy: Annotated[Path, typer.Argument(help="policy.onnx, which decides at each tick.")],
    seconds: Annotated[float, typer.Option(help="Of each of the four cases.")] = 40.0,
    json_file: console.JsonOption = None,
) -> None:
    """Lateness and the policy's answer at 50 Hz: idle, beside CPU hogs, with real time, without."""
    from pronk.bench.tick import bars, figures, run, table

    with console.progress() as report:
        rows = run(policy, seconds, report)
    console.show(table(rows))
    console.show(bars(rows))
    for line in dict.fromkeys(line for row in rows for line in row.granted):
        console.say(line)
    console.write_json(json_file, figures(rows))
    console.following(f"pronk deploy {policy} --script 1,0,0   # the whole loop, on the twin")
