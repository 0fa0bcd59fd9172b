"""`python -m benchmarks foreign`: robots and logs that pronk's makers did not make.

Five measurements over robots that come with public packages (`population` says which count):

- `robots`: each drawn robot goes by the command line from `robot new` to two exports (`walk`). Its
  numbers are compared with those of its model, and the planned peaks with those of plain MuJoCo
  (`plain`).
- `honest`: logs of joints of those robots and of joints from 5 g to 50 kg, by an integrator of the
  benchmark's own (`logs`). A log counts as flagged if it is refused, is no match, or a cause is
  named (`faults`); its true gains are inside if the total interval reaches those computed
  (`logs.true_gains`).
- `faults`: the same with one fault each; the rule of right, none, silent and wrong is that of
  `faults`.
- `translate`: gains translated between two frameworks beside gains matched for the second to a log
  of the first (`translations`); they agree within 2 %, or the translation says why not.
- `pack`: copies the files of the drawn robots into a folder that takes the place of `--packages` on
  a machine without them.

What is done is kept in the folder `--out`; the same command goes on where it was ended.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import tyro

from benchmarks.foreign.population import Candidate, drawn_robots, pack
from benchmarks.foreign.tables import faults_table, honest_table, robots_tables, translate_tables
from benchmarks.foreign.translations import translation_trial
from benchmarks.foreign.trials import log_trial
from benchmarks.foreign.walk import walk
from benchmarks.runner import Row, finish, in_parallel, rows_in
from pronk.cli import console
from pronk.errors import PronkError

Measurement = Literal["robots", "honest", "faults", "translate", "pack"]
COUNTS = {"robots": 40, "honest": 200, "faults": 200, "translate": 30, "pack": 40}
"""Robots or logs, where --count is left out."""
ROBOTS = 40
"""Robots whose joints logs are of."""


def foreign(
    measurement: tyro.conf.Positional[Measurement],
    seed: int = 41,
    count: int | None = None,
    packages: Path | None = None,
    out: Path = Path("foreign"),
    jobs: int = 2,
    numbers: tuple[int, ...] = (),
) -> console.Outcome:
    """Take public robots to an export; match and translate gains of their joints.

    Args:
        measurement: robots, honest, faults, translate, or pack.
        seed: Of the draw.
        count: Robots or logs; 40, 200 and 30 if left out.
        packages: Folder in which the packages are installed or unpacked, or a packed one; that of
            this Python if left out.
        out: Folder of the results, or of the packed robots.
        jobs: Processes.
        numbers: Only these robots or logs of the draw, counted from 0; repeat it.
    """
    wanted = COUNTS[measurement] if count is None else count
    robots_wanted = wanted if measurement in ("robots", "translate", "pack") else ROBOTS
    folder, drawn = drawn_robots(packages, seed, robots_wanted)
    if measurement == "pack":
        pack(folder, drawn, out)
        console.say(f"packed {len(drawn)} robots into {out}")
        return console.Outcome(figures={"robots": len(drawn), "seed": seed}, wrote=[out])
    out.mkdir(parents=True, exist_ok=True)
    rows_file = out / f"{measurement}.jsonl"
    done = {row["number"]: row for row in rows_in(rows_file) if row["seed"] == seed}
    todo = []
    for number in numbers or range(wanted):
        if not 0 <= number < wanted:
            raise PronkError(f"--numbers {number}; expected 0 to {wanted - 1}.")
        if number not in done:
            todo.append(number)
    work = partial(
        _trial,
        measurement=measurement,
        seed=seed,
        folder=folder,
        drawn=drawn,
        scratch=(out / "walk").resolve(),
    )
    with console.progress() as report:
        for finished, row in enumerate(in_parallel(work, todo, jobs)):
            row["seed"] = seed
            done[row["number"]] = row
            with rows_file.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
            report(measurement, (finished + 1) / len(todo))
    chosen = numbers or range(wanted)
    rows: list[Row] = [done[number] for number in chosen]
    figures = {"what": measurement, "seed": seed, "rows": rows}
    (out / f"{measurement}.json").write_text(json.dumps(figures, indent=1), encoding="utf-8")
    tables = {
        "robots": robots_tables,
        "honest": honest_table,
        "faults": faults_table,
        "translate": translate_tables,
    }[measurement](rows, seed)
    return finish(figures, *tables)


def _trial(
    number: int,
    *,
    measurement: str,
    seed: int,
    folder: Path,
    drawn: Sequence[tuple[Candidate, str]],
    scratch: Path,
) -> dict[str, Any]:
    """Do one robot or log."""
    if measurement == "robots":
        candidate, joint = drawn[number]
        try:
            row = walk(folder, candidate, joint, scratch / str(number))
        finally:
            shutil.rmtree(scratch / str(number), ignore_errors=True)
        return row | {"number": number}
    if measurement == "translate":
        return translation_trial(seed, number, folder, drawn, scratch / f"translate{number}")
    return log_trial(measurement, seed, number, folder, list(drawn))
