"""`pronk bench train`: steps per second beside mjlab's own task."""

from __future__ import annotations

import time
from typing import Annotated

import typer

from pronk.commands import console
from pronk.errors import PronkError


def train(
    envs: Annotated[str, typer.Option(help="Numbers of environments.")] = "4096,16384",
    steps: Annotated[int, typer.Option(help="Steps in a block of stepping.")] = 50,
    iterations: Annotated[int, typer.Option(help="Iterations in a block of training.")] = 1,
    repeats: Annotated[int, typer.Option(help="Blocks of each task, taken in turn.")] = 4,
    device: Annotated[str, typer.Option(help="auto, cuda or cpu (to try it out).")] = "auto",
    gpu_ids: Annotated[
        str | None,
        typer.Option(help="GPUs, such as 0,1: training on one and on all of them as well."),
    ] = None,
    json_file: console.JsonOption = None,
) -> None:
    """Steps per second of the jump task and of mjlab's own Go1 task, stage by stage."""
    from pronk.bench.train import run, stage_table, table

    begin = time.perf_counter()

    def line(text: str) -> None:
        seconds = time.perf_counter() - begin
        console.err().print(f"{seconds:6.1f} s  {text}", markup=False)

    result = run(
        line,
        envs=_numbers(envs),
        steps=steps,
        iterations=iterations,
        repeats=repeats,
        device=device,
        gpu_ids=gpu_ids,
    )
    console.show(table(result))
    console.show(stage_table(result))
    console.write_json(json_file, result.figures())
    console.following("pronk train all   # trains with the environment that was measured")


def _numbers(text: str) -> list[int]:
    words = [word.strip() for word in text.split(",")]
    if not all(word.isdigit() for word in words):
        raise PronkError(f"--envs {text!r}: expected whole numbers, such as 4096,16384.")
    return [int(word) for word in words]
