"""`python -m benchmarks grid`: the grid on twelve joints, its speed and the gains that it finds.

The peer is a bare `mujoco.rollout` loop over the same model, commands and threads, run right
before and right after each part of the grid, so that a machine that speeds up or slows down does
not decide. The truth is the paper's Table I, put into the training simulator, logged without
noise.
"""

from __future__ import annotations

import copy
import resource
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import mujoco.rollout
import numpy as np
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text

from benchmarks.synthetic_log import Excitation, synthetic_log
from pronk.excitation.signals import Chirp
from pronk.match.grid import GridSearch, alike, axes, search
from pronk.match.measured_joint import MeasuredJoint, measured_joints
from pronk.match.quick import quick_search
from pronk.match.refine import Fit, refine
from pronk.match.settings import MatchSettings
from pronk.report.paper import published
from pronk.robots import load_robot
from pronk.robots.robot import Robot
from pronk.simulators.mujoco import JointTestRig, MujocoSimulator

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

BARE_PAIRS = 500
"""Pairs in one run of the bare loop; a fifth of the grid gives its speed."""
ROBOT = "mini_cheetah"


@dataclass(frozen=True, kw_only=True)
class JointFound:
    """One joint of known truth, and what the searches found."""

    joint: str
    truth: tuple[float, float]
    grid: tuple[float, float]
    nearest_cell: bool
    """The grid's best node is the node nearest to the truth."""
    refined: tuple[float, float]
    quick: tuple[float, float]
    quick_same_cell: bool

    @property
    def error_percent(self) -> tuple[float, float]:
        """Refined stiffness and damping against the truth [%]."""
        pairs = zip(self.refined, self.truth, strict=True)
        stiffness, damping = (100.0 * (found / true - 1.0) for found, true in pairs)
        return stiffness, damping

    @property
    def quick_percent(self) -> tuple[float, float]:
        """Quick stiffness and damping against the refined ones of the grid [%]."""
        pairs = zip(self.quick, self.refined, strict=True)
        stiffness, damping = (100.0 * (found / true - 1.0) for found, true in pairs)
        return stiffness, damping


@dataclass(frozen=True, kw_only=True)
class SearchBench:
    """What one run gave."""

    joints: tuple[JointFound, ...]
    pairs: int
    """Gain pairs of the grid, for each joint."""
    simulations: int
    """Families of mirror-image joints that were simulated."""
    steps: int
    grid_s: float
    """Wall time of the grid, everything included [s]."""
    refine_s: float
    quick_s: float
    bare_steps_per_second: float
    """Of the bare loop, weighted as the grid's own steps are."""
    memory_mb: float
    """Largest resident memory of the process [MB]."""

    @property
    def steps_per_second(self) -> float:
        """Of the grid, everything included."""
        return self.steps / self.grid_s

    @property
    def ratio(self) -> float:
        """Speed of the grid over that of the bare loop."""
        return self.steps_per_second / self.bare_steps_per_second


def bare_rollout(rig: JointTestRig, goal: MeasuredJoint, pairs: int, threads: int) -> float:
    """Steps per second of `mujoco.rollout` alone over a bench's model and a target's command."""
    command = goal.trace.mirrored(rig.robot)[2][: goal.steps]
    control = np.tile(rig.control(rig.pose(goal.trace)), (pairs, goal.steps, 1))
    control[:, :, rig.actuator] += command
    models = [copy.copy(rig.model) for _ in range(pairs)]
    data = [mujoco.MjData(rig.model) for _ in range(threads)]
    width = mujoco.mj_stateSize(rig.model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    initial = np.zeros((pairs, width))
    initial[:, 1 : 1 + rig.model.nq] = rig.pose(goal.trace)
    with mujoco.rollout.Rollout(nthread=threads) as pool:
        begin = time.perf_counter()
        pool.rollout(models, data, initial, control)
        return pairs * goal.steps / (time.perf_counter() - begin)


def run(
    progress: Progress | None = None,
    *,
    points: int = 50,
    length_s: float = 20.0,
    threads: int = 2,
    joints: Sequence[str] | None = None,
) -> SearchBench:
    """Search the grid for every joint, beside the bare loop; then the quick way.

    Args:
        progress: Told the stage and the share done, 0 to 1.
        points: Points of each axis of the grid; the paper has 50.
        length_s: Length of the chirp [s].
        threads: Threads of both.
        joints: Joints to search; all of them if not given.
    """
    told = progress or (lambda _stage, _share: None)
    robot = load_robot(ROBOT)
    paper = published(ROBOT)
    assert paper is not None
    truth = {name: paper.joints[name] for name in joints or robot.joint_names}
    settings = MatchSettings(grid_points=points, threads=threads)
    goals = []
    for k, (name, gains) in enumerate(truth.items()):
        told("logs with known truth", k / len(truth))
        goals.append(_known(robot, name, gains, length_s, settings))
    told("logs with known truth", 1.0)
    stiffness, damping = axes(robot, points)
    groups = alike(goals, robot)
    grids: dict[str, GridSearch] = {}
    grid_s = bare_s = 0.0
    with MujocoSimulator(robot, threads=threads) as simulator:
        for k, group in enumerate(groups):
            rig = simulator.rig(group[0].joint)
            before = simulator.count.steps
            pairs = min(BARE_PAIRS, points**2)
            speeds = [bare_rollout(rig, group[0], pairs, threads)]
            begin = time.perf_counter()
            found = search(
                rig,
                group,
                stiffness,
                damping,
                progress=lambda share, k=k: told("grid", (k + share) / len(groups)),  # type: ignore[misc]
            )
            grid_s += time.perf_counter() - begin
            speeds.append(bare_rollout(rig, group[0], pairs, threads))
            bare_s += (simulator.count.steps - before) / float(np.mean(speeds))
            grids |= {goal.joint: grid for goal, grid in zip(group, found, strict=True)}
        steps = simulator.count.steps
        begin = time.perf_counter()
        fits = refine(simulator, goals, [grids[goal.joint].gains for goal in goals])
        refine_s = time.perf_counter() - begin
    begin = time.perf_counter()
    with MujocoSimulator(robot, threads=threads) as simulator:
        quick = quick_search(simulator, goals, stiffness, damping)
    quick_s = time.perf_counter() - begin
    return SearchBench(
        joints=tuple(
            _found(goal, truth[goal.joint], grids[goal.joint], fit, one.grid, one.fit)
            for goal, fit, one in zip(goals, fits, quick, strict=True)
        ),
        pairs=points**2,
        simulations=len(groups),
        steps=steps,
        grid_s=grid_s,
        refine_s=refine_s,
        quick_s=quick_s,
        bare_steps_per_second=steps / bare_s,
        memory_mb=_memory_mb(),
    )


def _known(
    robot: Robot, name: str, gains: tuple[float, float], length_s: float, settings: MatchSettings
) -> MeasuredJoint:
    """A joint's chirp in the training simulator; mirrored joints are asked mirrored."""
    sign = robot.joint(name).original[1]
    ask = Excitation(offsets=sign * Chirp(length_s=length_s).samples(robot.policy_rate_hz))
    log = synthetic_log(robot, name, [ask], *gains, threads=settings.threads)
    return measured_joints(log, name, robot, settings)[0]


def _found(
    goal: MeasuredJoint,
    truth: tuple[float, float],
    grid: GridSearch,
    fit: Fit,
    quick: GridSearch,
    quick_fit: Fit,
) -> JointFound:
    nearest = (
        int(np.argmin(np.abs(grid.stiffness - truth[0]))),
        int(np.argmin(np.abs(grid.damping - truth[1]))),
    )
    return JointFound(
        joint=goal.joint,
        truth=truth,
        grid=grid.gains,
        nearest_cell=grid.cell == nearest,
        refined=(fit.stiffness, fit.damping),
        quick=(quick_fit.stiffness, quick_fit.damping),
        quick_same_cell=quick.cell == grid.cell,
    )


def _memory_mb() -> float:
    """Largest resident memory so far; Linux counts in kB, macOS in bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2.0**20 if sys.platform == "darwin" else 2.0**10)


def table(result: SearchBench) -> Table:
    """Joint by joint; the speeds are in the caption."""
    made = Table(title=Text("Known truth (Table I, training simulator, no noise)"))
    made.title_justify = made.caption_justify = "left"
    for column in ("joint", "truth", "grid", "nearest cell", "refined off by [%]", "quick off [%]"):
        made.add_column(Text(column), justify="left" if column == "joint" else "right")
    for one in result.joints:
        made.add_row(
            one.joint,
            f"{one.truth[0]:g} / {one.truth[1]:g}",
            f"{one.grid[0]:.2f} / {one.grid[1]:.3f}",
            "yes" if one.nearest_cell else "NO",
            "{:+.3f} / {:+.3f}".format(*one.error_percent),
            "{:+.3f} / {:+.3f}".format(*one.quick_percent)
            + ("" if one.quick_same_cell else " (another cell)"),
        )
    made.caption = Text(
        f"{len(result.joints)} joints x {result.pairs} pairs, {result.simulations} simulated "
        f"families: {result.grid_s:.1f} s, {result.steps_per_second / 1e3:.0f} k steps/s = "
        f"{100 * result.ratio:.0f} % of a bare mujoco.rollout loop; refinement "
        f"{result.refine_s:.1f} s; quick way {result.quick_s:.1f} s; memory "
        f"{result.memory_mb:.0f} MB"
    )
    return made
