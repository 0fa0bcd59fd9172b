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


def grid(
    points: Annotated[int, typer.Option(help="Points of each axis; the paper has 50.")] = 50,
    json_file: console.JsonOption = None,
) -> None:
    """The paper's grid on twelve joints of known truth, beside a bare mujoco.rollout loop."""
    from dataclasses import asdict

    from pronk.bench.search import run, table

    with console.progress() as report:
        result = run(report, points=points)
    console.show(table(result))
    derived = {"steps_per_second": result.steps_per_second, "ratio": result.ratio}
    console.write_json(json_file, asdict(result) | derived)
    console.following("pronk bench engine   # what the simulator's step does to a joint")


def engine(json_file: console.JsonOption = None) -> None:
    """The same drive at a 0.25 ms step and in the 5 ms training simulator, before and after."""
    from pronk.bench.engine import run, table

    with console.progress() as report:
        gaps = run(report)
    console.show(table(gaps))
    console.write_json(
        json_file,
        {
            gap.joint: {
                "gains": gap.gains,
                "equal_gains_rms_db": gap.equal_gains_rms_db,
                "equal_gains_max_db": gap.equal_gains_max_db,
                "matched_gains": gap.matched_gains,
                "matched_rms_db": gap.matched_rms_db,
            }
            for gap in gaps
        },
    )
    console.following("pronk bench coverage   # whether the intervals hold what they say")


def coverage(
    trials: Annotated[int, typer.Option(help="Logs of each joint.")] = 200,
    seed: Annotated[int, typer.Option(help="Of the noise.")] = 0,
    json_file: console.JsonOption = None,
) -> None:
    """How often the 95 % intervals hold the truth under coloured noise."""
    from dataclasses import asdict

    from pronk.bench.coverage import run, table

    with console.progress() as report:
        rows = run(trials, seed, report)
    console.show(table(rows))
    console.write_json(json_file, {one.joint: asdict(one) for one in rows})
    console.following("pronk bench match   # the same question to mujoco.sysid and CMA-ES")
