"""`python -m benchmarks probe`: name the laws, parameters and faults of random simulators, blind.

A simulator is drawn with its law, step, armature, friction, delay and hold, and half of them with a
fault. It is an integrator of its own in NumPy, MuJoCo, or an engine of `examples/engines` that is
installed. `pronk.identify.simulators.probe` sees the `Simulator` only.
"""

from __future__ import annotations

import importlib.util
import json
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.runner import finish, in_parallel
from pronk.cli import console
from pronk.errors import PronkError
from pronk.identify.simulators.probe.probe import probe_joint
from pronk.tables import Cell, Column, Table
from tests.drawn_simulator import ENGINES, FAULTS, DrawnSimulator, draw_truth, score


def case(number: int, *, seed: int, kinds: Sequence[str]) -> dict[str, float | bool | str]:
    """Draw and probe one simulator of a seed: its score, and the seconds that it took."""
    generator = np.random.default_rng(seed)
    # All simulators before it are drawn too, as the draws of a seed follow one another.
    for k in range(number + 1):
        kind = kinds[k % len(kinds)]
        fault = ""
        if generator.random() < 0.5:
            fault = FAULTS[k // 2 % len(FAULTS)]
        if fault == "beside":
            kind = "numpy"
        truth = draw_truth(generator, kind, fault)
    begin = time.perf_counter()
    result = probe_joint(DrawnSimulator(truth), truth.robot, truth.joint)
    seconds = time.perf_counter() - begin
    return {"number": number, **score(truth, result), "seconds": seconds}


def probe(
    seed: int = 0, count: int = 50, jobs: int = 1, rows: Path | None = None
) -> console.Outcome:
    """Name the law, parameters and faults of random simulators.

    Args:
        seed: Seed of the draw.
        count: Simulators; a quarter of them in each engine that is installed, at most.
        jobs: Processes, a simulator each.
        rows: A file to which each simulator adds a line of JSON as it is done.
    """
    if count < 1:
        raise PronkError(f"--count {count}; expected 1 or more.")
    kinds = ["numpy", "mujoco"]
    for name, engine in ENGINES.items():
        if importlib.util.find_spec(engine.module):
            kinds.append(name)
    scores = []
    work = partial(case, seed=seed, kinds=kinds)
    with console.progress() as report:
        for case_score in in_parallel(work, range(count), jobs):
            scores.append(case_score)
            if rows is not None:
                with rows.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(case_score) + "\n")
            report("probe", len(scores) / count)
    faulty = sum(bool(case_score["fault"]) for case_score in scores)
    cells: list[tuple[Cell, ...]] = []
    for title, key in (
        ("law", "law_right"),
        ("hold", "hold_right"),
        (f"faults named and no others; {faulty} have one", "fault_right"),
        ("armature within 2 %", "armature_right"),
        ("delay within 0.5 ms", "delay_right"),
    ):
        right = sum(bool(case_score[key]) for case_score in scores)
        cells.append((title, f"{right} of {count}"))
    for title, key, factor in (
        ("armature, error [%]", "armature_error", 100.0),
        ("delay, error [ms]", "delay_error_s", 1000.0),
        ("dry friction, error [N m]", "friction_error", 1.0),
        ("time [s]", "seconds", 1.0),
    ):
        values = factor * np.array([float(case_score[key]) for case_score in scores])
        cells.append((title, f"{np.median(values):.2g} (largest {values.max():.2g})"))
    title = f"Random simulators, seed {seed}: {', '.join(kinds)}"
    table = Table(
        title=title,
        columns=(Column(heading="of the joint"), Column(heading="probe")),
        rows=tuple(cells),
    )
    figures = {str(case_score["number"]): case_score for case_score in scores}
    return finish(figures, table)
