"""`python -m benchmarks grid`: the paper's grid on twelve joints, its speed and its gains.

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
from dataclasses import dataclass
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np

from benchmarks.runner import Progress
from pronk.cli import console
from pronk.identify.excitation.signals import Chirp
from pronk.identify.match.magnitude import grid_axes, refine, search_grid
from pronk.identify.match.measured import MeasuredJoint, grouped, measured_joints
from pronk.identify.match.result import GridSearch
from pronk.identify.match.settings import MatchSettings
from pronk.identify.simulators.mujoco import JointTestRig, MujocoSimulator
from pronk.report.paper import TABLE_I
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec
from pronk.tables import Cell, Column, Table
from tests.synthetic_log import Excitation, synthetic_log

BARE_PAIRS = 500
"""Pairs in one run of the bare loop; a fifth of the grid gives its speed."""
ROBOT = "mini_cheetah"


@dataclass(frozen=True, kw_only=True)
class JointRow:
    """What the grid and the refinement found of one joint with known gains."""

    joint: str
    """Name of the joint."""
    known: tuple[float, float]
    """Known stiffness [N m/rad] and damping [N m s/rad]."""
    grid: tuple[float, float]
    """Gains of the grid's best node."""
    nearest_cell: bool
    """True if the best node is the one nearest to the known gains."""
    refined: tuple[float, float]
    """Gains off the grid."""
    cells_apart: tuple[float, float]
    """Distance of the refined gains from the known ones, in cells of the paper's grid."""


def bare_rollout(rig: JointTestRig, target: MeasuredJoint, pairs: int, threads: int) -> float:
    """Return steps per second of `mujoco.rollout` alone over a rig's model and a command."""
    pose, command = target.trace.excitation(rig.robot, target.steps)
    control = np.tile(rig.control(pose), (pairs, target.steps, 1))
    control[:, :, rig.actuator] += command
    models = [copy.copy(rig.model) for _ in range(pairs)]
    data = [mujoco.MjData(rig.model) for _ in range(threads)]
    width = mujoco.mj_stateSize(rig.model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    initial = np.zeros((pairs, width))
    initial[:, 1 : 1 + rig.model.nq] = pose
    with mujoco.rollout.Rollout(nthread=threads) as pool:
        begin = time.perf_counter()
        pool.rollout(models, data, initial, control)
        return pairs * target.steps / (time.perf_counter() - begin)


def known_targets(
    robot: RobotSpec,
    joints: Sequence[str],
    length_s: float,
    settings: MatchSettings,
    progress: Progress,
) -> list[MeasuredJoint]:
    """Simulate chirps of `length_s` [s] with the gains of Table I, and measure the responses."""
    targets = []
    for number, name in enumerate(joints, start=1):
        # Mirrored joints get a mirrored command.
        chirp = Chirp(length_s=length_s).samples(robot.policy_rate_hz)
        excitation = Excitation(offsets=robot.joint(name).original[1] * chirp)
        log = synthetic_log(robot, name, [excitation], *TABLE_I[name], threads=settings.threads)
        targets.append(measured_joints([log], name, robot, settings)[0])
        progress("logs with known gains", number / len(joints))
    return targets


def joint_row(
    robot: RobotSpec, grid: GridSearch, joint: str, refined: tuple[float, float]
) -> JointRow:
    """Compare the gains of one joint with the known ones."""
    known = TABLE_I[joint]
    nearest = []
    cells_apart = []
    paper_axes = grid_axes(robot)
    for axis, paper_axis, value, gain in zip(
        (grid.stiffness, grid.damping), paper_axes, known, refined, strict=True
    ):
        nearest.append(int(np.argmin(np.abs(axis - value))))
        cells_apart.append(float(abs(gain - value) / (paper_axis[1] - paper_axis[0])))
    return JointRow(
        joint=joint,
        known=known,
        grid=grid.gains,
        nearest_cell=grid.cell == tuple(nearest),
        refined=refined,
        cells_apart=(cells_apart[0], cells_apart[1]),
    )


def run(
    progress: Progress,
    *,
    points: int = 50,
    length_s: float = 20.0,
    threads: int = 2,
    joints: Sequence[str] | None = None,
) -> dict[str, Any]:
    """Search the grid for every joint, beside the bare loop, then go off the grid.

    Args:
        progress: Called with a stage and its share that is done.
        points: Points of each axis of the grid.
        length_s: Length of the chirp [s].
        threads: Threads of the simulator.
        joints: Names of the joints; all if None.

    Returns:
        `joints`, a `JointRow` each, wall times, steps per second of the grid and of the bare loop,
        their `ratio`, and the largest resident memory.
    """
    robot = load_robot(ROBOT)
    settings = MatchSettings(grid_points=points, threads=threads)
    targets = known_targets(robot, joints or robot.joint_names, length_s, settings, progress)
    stiffness, damping = grid_axes(robot, points)

    def same_simulation(target: MeasuredJoint, other: MeasuredJoint) -> bool:
        return target.trace.same_as(other.trace, robot)

    groups = grouped(targets, same_simulation)
    grids: dict[str, GridSearch] = {}
    grid_s = 0.0
    bare_s = 0.0
    with MujocoSimulator(robot, threads=threads) as simulator:
        for number, group in enumerate(groups, start=1):
            rig = simulator.rig(group[0].joint)
            pairs = min(BARE_PAIRS, points**2)
            steps_before = simulator.steps
            speed_before = bare_rollout(rig, group[0], pairs, threads)
            begin = time.perf_counter()
            searches = search_grid(simulator, group, stiffness, damping)
            grid_s += time.perf_counter() - begin
            speed_after = bare_rollout(rig, group[0], pairs, threads)
            bare_speed = 0.5 * (speed_before + speed_after)
            bare_s += (simulator.steps - steps_before) / bare_speed
            for target, search in zip(group, searches, strict=True):
                grids[target.joint] = search
            progress("grid", number / len(groups))
        steps = simulator.steps
        begin = time.perf_counter()
        rows = []
        for target in targets:
            fit = refine(simulator, target, grids[target.joint].gains)
            rows.append(joint_row(robot, grids[target.joint], target.joint, fit.gains))
        refine_s = time.perf_counter() - begin
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # in bytes on macOS, else in kB
    return {
        "joints": rows,
        "pairs": points**2,
        "simulations": len(groups),
        "steps": steps,
        "grid_s": grid_s,
        "refine_s": refine_s,
        "bare_steps_per_second": steps / bare_s,
        "memory_mb": peak / (2.0**20 if sys.platform == "darwin" else 2.0**10),
        "steps_per_second": steps / grid_s,
        "ratio": bare_s / grid_s,
    }


def grid(points: int = 50) -> console.Outcome:
    """The paper's grid on twelve joints with known gains, beside a bare mujoco.rollout loop.

    Args:
        points: Points of each axis; the paper has 50.
    """
    with console.progress() as report:
        figures = run(report, points=points)
    rows: list[tuple[Cell, ...]] = []
    for row in figures["joints"]:
        rows.append(
            (
                row.joint,
                "{:g} / {:g}".format(*row.known),
                "{:.2f} / {:.3f}".format(*row.grid),
                "yes" if row.nearest_cell else "NO",
                "{:.3f} / {:.4f}".format(*row.refined),
                "{:.3f} / {:.3f}".format(*row.cells_apart),
            )
        )
    columns = (
        Column(heading="joint"),
        Column(heading="known"),
        Column(heading="grid"),
        Column(heading="nearest cell"),
        Column(heading="refined"),
        Column(heading="grid cells apart"),
    )
    note = (
        f"{len(rows)} joints x {figures['pairs']} pairs, {figures['simulations']} simulated "
        f"groups: {figures['grid_s']:.1f} s, {figures['steps_per_second'] / 1e3:.0f} k steps/s = "
        f"{100.0 * figures['ratio']:.0f} % of a bare mujoco.rollout loop; refinement "
        f"{figures['refine_s']:.1f} s; memory {figures['memory_mb']:.0f} MB"
    )
    title = "Known gains (Table I, training simulator, no noise)"
    console.show(Table(title=title, columns=columns, rows=tuple(rows), notes=(note,)))
    return console.Outcome(figures=figures)
