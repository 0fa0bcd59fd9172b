"""`pronk bench`: pronk beside its peers, on the same data, in one run."""

from __future__ import annotations

from typing import Annotated

import typer

from pronk.commands import console


def match(
    trials: Annotated[int, typer.Option(help="Logs of each scenario.")] = 5,
    seed: Annotated[int, typer.Option(help="Of the noise.")] = 0,
    json_file: console.JsonOption = None,
) -> None:
    """Match logs of known truth with pronk, mujoco.sysid and CMA-ES; bias, coverage, time."""
    import orjson

    from pronk.bench.match import run, table

    def one_bar(_: str, share: float) -> None:
        report("bench", share)

    with console.progress() as report:
        result = run(trials, seed, one_bar)
    console.show(table(result))
    console.write_json(json_file, orjson.loads(result.to_json()))
    console.following("pronk bench match --trials 20   # steadier coverage, about 20 s a log")
