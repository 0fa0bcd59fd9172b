"""`python -m benchmarks match`: pronk and its peers on the same logs with known gains.

Every tool gets the same logs, the same bench model (armature and friction in it), the same two
free parameters and the same start; the bounds of the peers are the edges of pronk's grid. Rows
marked `+ delay` give a peer the delay parameter it has of its own, in the scenario where commands
act late: whole steps for CMA-ES in PACE's manner, and for mujoco.sysid a continuous one, which it
realizes by linear interpolation between the 5 ms steps of its simulation.

Read a bias against its standard error, `sd / sqrt(n)`, and a coverage against its own small number:
95 % of 10 intervals are 9.5.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import mujoco
import numpy as np

from benchmarks.known_truth import JOINT, SCENARIOS, KnownTruth, Scenario, Truth
from benchmarks.peers import Estimate, fit_cma, fit_sysid, import_cma, import_sysid
from benchmarks.result import BenchResult, Row, row, table
from pronk.errors import PronkError
from pronk.logs.joint_log import JointLog
from pronk.match.pipeline import match_logs
from pronk.match.settings import MatchSettings
from pronk.robots import load_robot
from pronk.robots.robot import Robot

__all__ = ["BenchResult", "Row", "fit_pronk", "run", "table", "tools"]

Progress = Callable[[str, float], None]
Fit = Callable[[JointLog], Estimate]

TRIALS = 5
"""Logs of each scenario. All tools together take about 20 s a log on two cores."""
MAX_DELAY_S = 0.04
"""Largest delay a tool with such a parameter may find [s]."""
FULL_GRID = "pronk, the paper's grid"
FREE = "stiffness, damping"


def run(
    trials: int = TRIALS,
    seed: int = 0,
    progress: Progress | None = None,
    *,
    scenarios: Sequence[Scenario] = SCENARIOS,
    robot: Robot | None = None,
    repeats: int = 5,
    length_s: float = 20.0,
    full_grid: bool = True,
    threads: int = 2,
) -> BenchResult:
    """Run every tool on every log.

    Args:
        trials: Logs of each scenario.
        seed: Of the noise.
        progress: Told what is being done and the share that is done, 0 to 1.
        scenarios: What the tools are up against.
        robot: The robot; the Mini Cheetah if not given.
        repeats: Chirps in each log.
        length_s: Length of each chirp [s].
        full_grid: Also time the paper's whole grid, on one log.
        threads: Threads of the simulator, the same for every tool.

    Raises:
        PronkError: A peer is not installed, or a number is impossible.
    """
    if trials < 1 or repeats < 1:
        raise PronkError(f"{trials} trials of {repeats} repeats; expected 1 or more of each.")
    # Before any work, so that a missing peer is not found out after minutes.
    import_sysid()
    import_cma()
    begin = time.perf_counter()
    machine = robot or load_robot("mini_cheetah")
    joint = machine.joint(JOINT)
    truth = Truth()
    start = (joint.stiffness, joint.damping)
    bounds = (machine.grid_stiffness, machine.grid_damping)
    requests = [
        (scenario, tools(machine, scenario, bounds=bounds, start=start, seed=seed, threads=threads))
        for scenario in scenarios
    ]
    # The quick way and the full grid end in the same refinement, so that one grid shows its time.
    grid = partial(fit_pronk, robot=machine, method="grid", threads=threads)
    total = trials * sum(len(chosen) for _, chosen in requests) + full_grid
    done = 0
    rows: list[Row] = []
    for index, (scenario, chosen) in enumerate(requests):
        source = KnownTruth(
            machine, scenario, truth=truth, repeats=repeats, length_s=length_s, threads=threads
        )
        found: dict[str, list[Estimate]] = {name: [] for name in chosen}
        if index == 0 and full_grid:
            chosen[FULL_GRID] = FREE, grid
            found[FULL_GRID] = []
        for trial in range(trials):
            log = source.log(np.random.default_rng([seed, index, trial]))
            for name, (_, fit) in chosen.items():
                if name == FULL_GRID and trial > 0:
                    continue
                if progress is not None:
                    progress(f"{scenario.name}: {name}, log {trial + 1} of {trials}", done / total)
                found[name].append(fit(log))
                done += 1
        rows += [
            row(scenario.name, name, chosen[name][0], estimates, truth)
            for name, estimates in found.items()
        ]
    if progress is not None:
        progress("done", 1.0)
    return BenchResult(
        rows=tuple(rows),
        truth=truth,
        scenarios=tuple(scenarios),
        joint=JOINT,
        trials=trials,
        seed=seed,
        repeats=repeats,
        start=start,
        bounds=bounds,
        machine={
            "processor": platform.machine(),
            "cores": str(os.cpu_count()),
            "threads": str(threads),
            "python": platform.python_version(),
            "mujoco": mujoco.__version__,
        },
        seconds=time.perf_counter() - begin,
    )


def tools(
    robot: Robot,
    scenario: Scenario,
    *,
    bounds: tuple[tuple[float, float], tuple[float, float]],
    start: tuple[float, float],
    seed: int,
    threads: int,
) -> dict[str, tuple[str, Fit]]:
    """The tools of a scenario: name to free parameters and fit."""
    shared: dict[str, Any] = {"bounds": bounds, "start": start, "threads": threads}
    sysid = partial(fit_sysid, joint=JOINT, robot=robot, **shared)
    cma = partial(fit_cma, joint=JOINT, robot=robot, seed=seed + 1, **shared)
    chosen: dict[str, tuple[str, Fit]] = {
        "pronk": (FREE, partial(fit_pronk, robot=robot, method="quick", threads=threads)),
        "mujoco.sysid": (FREE, sysid),
        "CMA-ES as PACE": (FREE, cma),
    }
    if scenario.delay_s:
        steps = round(MAX_DELAY_S / robot.timestep_s)
        free = f"{FREE}, delay"
        chosen["mujoco.sysid + delay"] = free, partial(sysid, delay_bounds_s=(0.0, MAX_DELAY_S))
        chosen["CMA-ES as PACE + delay"] = f"{free} in steps", partial(cma, delay_steps=steps)
    return chosen


def fit_pronk(log: JointLog, *, robot: Robot, method: Any, threads: int) -> Estimate:
    """Match a log the way `pronk match` does, and read its intervals.

    Args:
        log: The log.
        robot: The robot.
        method: `grid` or `quick`.
        threads: Threads of the simulator.
    """
    before = time.perf_counter()
    settings = MatchSettings(method=method, zero_armature=False, threads=threads)
    found = match_logs([log], robot, settings=settings).gains.joints[JOINT]
    seconds = time.perf_counter() - before
    return Estimate(
        stiffness=found.stiffness,
        damping=found.damping,
        interval=(found.stiffness_ci95, found.damping_ci95),
        seconds=seconds,
    )
