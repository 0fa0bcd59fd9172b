"""`pronk bench links`: the same policy in process, over LCM and over DDS."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pronk.commands import console


def links(
    policy: Annotated[Path, typer.Argument(help="policy.onnx.", metavar="POLICY")],
    link: Annotated[
        list[str] | None,
        typer.Option("--link", help="trial, twin, lcm or dds; repeat it. All four if left out."),
    ] = None,
    repeats: Annotated[
        int, typer.Option(help="Jumps with each command on each link; a minute a link each.")
    ] = 4,
    commands: Annotated[
        list[str] | None,
        typer.Option("--commands", help='As "1,0"; repeat it. The paper\'s five if left out.'),
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(help="Body of the virtual robot; the one that ships with pronk if left out."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of noise and of the moments of the jumps.")] = 0,
    real_time: Annotated[
        bool, typer.Option("--real-time/--no-real-time", help="Ask for real-time scheduling.")
    ] = True,
    json_file: console.JsonOption = Path("out/links.json"),
) -> None:
    """The five-command trial on the virtual robot in process, over LCM and over DDS, compared."""
    from pronk.bench.links import LINKS, Settings, run
    from pronk.bench.links_tables import tables
    from pronk.trial.protocol import parse_cases

    settings = Settings(
        links=tuple(link or LINKS),
        cases=parse_cases(commands or ["paper"]),
        repeats=repeats,
        seed=seed,
        truth=truth,
        real_time=real_time,
    )
    with console.progress() as report:
        found = run(policy, settings, progress=report)
    for table in tables(found):
        console.show(table)
    for jump in found.jumps:
        if jump.fault and not jump.disturbed:
            console.warn(f"{jump.link}, {jump.case}, repeat {jump.number}: {jump.fault}")
    console.write_json(json_file, found.result())
    console.following(f"pronk bench links {policy} --repeats 20   # the trial's own number")
