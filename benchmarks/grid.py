"""`python -m benchmarks grid`: the grid on twelve joints, its speed and the gains that it finds.

The peer is a bare `mujoco.rollout` loop over the same model, commands and threads, run right
before and right after each part of the grid. The known gains are the paper's Table I, put into the
training simulator, logged without noise.
"""

from __future__ import annotations

import copy
import resource
import sys
import time
from collections.abc import Sequence
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np

from benchmarks.runner import Progress, finish
from pronk.cli import console
from pronk.identify.excitation.signals import Chirp
from pronk.identify.match.grid import GridSearch, alike, axes, quick_search, search
from pronk.identify.match.measured_joint import MeasuredJoint, measured_joints
from pronk.identify.match.response_fit import refine
from pronk.identify.match.settings import MatchSettings
from pronk.identify.simulators.mujoco import JointTestRig, MujocoSimulator
from pronk.report.paper import TABLE_I
from pronk.robots import load_robot
from tests.synthetic_log import Excitation, synthetic_log

Gains = tuple[float, float]
"""Stiffness [N m/rad] and damping [N m s/rad]."""

BARE_PAIRS = 500
"""Pairs in one run of the bare loop; a fifth of the grid gives its speed."""
ROBOT = "mini_cheetah"


def bare_rollout(rig: JointTestRig, goal: MeasuredJoint, pairs: int, threads: int) -> float:
    """Steps per second of `mujoco.rollout` alone over a rig's model and a target's command."""
    pose, command = goal.trace.excitation(rig.robot, goal.steps)
    control = np.tile(rig.control(pose), (pairs, goal.steps, 1))
    control[:, :, rig.actuator] += command
    models = [copy.copy(rig.model) for _ in range(pairs)]
    data = [mujoco.MjData(rig.model) for _ in range(threads)]
    width = mujoco.mj_stateSize(rig.model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    initial = np.zeros((pairs, width))
    initial[:, 1 : 1 + rig.model.nq] = pose
    with mujoco.rollout.Rollout(nthread=threads) as pool:
        begin = time.perf_counter()
        pool.rollout(models, data, initial, control)
        return pairs * goal.steps / (time.perf_counter() - begin)


def run(
    progress: Progress,
    *,
    points: int = 50,
    length_s: float = 20.0,
    threads: int = 2,
    joints: Sequence[str] | None = None,
) -> dict[str, Any]:
    """Search the grid for every joint, beside the bare loop; then the linearized search.

    `points` are of each axis of the grid, `length_s` of the chirp.

    Returns:
        `joints`, a row each (gains in N m/rad, N m s/rad; `nearest_cell`: the grid's best node is
        the one nearest to the known gains), the wall times, `bare_steps_per_second` weighted as the
        grid's own steps are, `ratio` of the grid's speed to it, and the largest resident memory.
    """
    robot = load_robot(ROBOT)
    known = {name: TABLE_I[name] for name in joints or robot.joint_names}
    settings = MatchSettings(grid_points=points, threads=threads)
    goals = []
    for k, (name, gains) in enumerate(known.items(), start=1):
        # Mirrored joints get a mirrored command.
        offsets = robot.joint(name).original[1] * Chirp(length_s=length_s).samples(
            robot.policy_rate_hz
        )
        log = synthetic_log(robot, name, [Excitation(offsets=offsets)], *gains, threads=threads)
        goals.append(measured_joints(log, name, robot, settings)[0])
        progress("logs with known gains", k / len(known))
    grid_axes = axes(robot, points)
    groups = alike(goals, robot)
    grids: dict[str, GridSearch] = {}
    grid_s = bare_s = 0.0
    with MujocoSimulator(robot, threads=threads) as simulator:
        for k, group in enumerate(groups):
            rig, pairs = simulator.rig(group[0].joint), min(BARE_PAIRS, points**2)
            before = simulator.steps
            speeds = [bare_rollout(rig, group[0], pairs, threads)]
            begin = time.perf_counter()
            found = search(simulator, group, *grid_axes)
            grid_s += time.perf_counter() - begin
            speeds.append(bare_rollout(rig, group[0], pairs, threads))
            bare_s += (simulator.steps - before) / float(np.mean(speeds))
            grids |= {goal.joint: grid for goal, grid in zip(group, found, strict=True)}
            progress("grid", (k + 1) / len(groups))
        steps = simulator.steps
        begin = time.perf_counter()
        fits = refine(simulator, goals, [grids[goal.joint].gains for goal in goals])
        refine_s = time.perf_counter() - begin
    begin = time.perf_counter()
    with MujocoSimulator(robot, threads=threads) as simulator:
        quick = zip(*quick_search(simulator, goals, *grid_axes), strict=True)
    quick_s = time.perf_counter() - begin
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # in bytes on macOS, else in kB
    rows = []
    for (name, gains), fit, (cells, off_grid) in zip(known.items(), fits, quick, strict=True):
        best, pairs_of = grids[name], zip(grid_axes, gains, strict=True)
        nearest = tuple(int(np.argmin(np.abs(axis - value))) for axis, value in pairs_of)
        rows.append(
            {
                "joint": name,
                "known": gains,
                "grid": best.gains,
                "nearest_cell": best.cell == nearest,
                "refined": fit.gains,
                "quick": off_grid.gains,
                "quick_same_cell": cells.cell == best.cell,
            }
        )
    return {
        "joints": rows,
        "pairs": points**2,
        "simulations": len(groups),
        "steps": steps,
        "grid_s": grid_s,
        "refine_s": refine_s,
        "quick_s": quick_s,
        "bare_steps_per_second": steps / bare_s,
        "memory_mb": peak / (2.0**20 if sys.platform == "darwin" else 2.0**10),
        "steps_per_second": steps / grid_s,
        "ratio": bare_s / grid_s,
    }


def _percent(found: Gains, expected: Gains) -> str:
    errors = (100.0 * (a / b - 1.0) for a, b in zip(found, expected, strict=True))
    return "{:+.3f} / {:+.3f}".format(*errors)


def grid(points: int = 50) -> console.Outcome:
    """The paper's grid on twelve joints with known gains, beside a bare mujoco.rollout loop.

    Args:
        points: Points of each axis; the paper has 50.
    """
    with console.progress() as report:
        found = run(report, points=points)
    rows = [
        (
            one["joint"],
            "{:g} / {:g}".format(*one["known"]),
            "{:.2f} / {:.3f}".format(*one["grid"]),
            "yes" if one["nearest_cell"] else "NO",
            _percent(one["refined"], one["known"]),
            _percent(one["quick"], one["refined"])
            + ("" if one["quick_same_cell"] else " (another cell)"),
        )
        for one in found["joints"]
    ]
    caption = (
        "{n} joints x {pairs} pairs, {simulations} simulated families: {grid_s:.1f} s, "
        "{speed:.0f} k steps/s = {percent:.0f} % of a bare mujoco.rollout loop; refinement "
        "{refine_s:.1f} s; quick way {quick_s:.1f} s; memory {memory_mb:.0f} MB"
    ).format(
        n=len(rows),
        speed=found["steps_per_second"] / 1e3,
        percent=100.0 * found["ratio"],
        **found,
    )
    columns = ("joint", "known", "grid", "nearest cell", "refined off by [%]", "quick off [%]")
    title = "Known gains (Table I, training simulator, no noise)"
    return finish(found, console.table(title, columns, rows, caption))
