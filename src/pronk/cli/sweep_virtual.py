"""`pronk sweep` on the virtual robot in this program: faster than real time, legs side by side."""

from __future__ import annotations

import os
import queue
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ProcessPoolExecutor, wait
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING

from pronk.errors import PlanError

if TYPE_CHECKING:
    from pronk.excitation.plan import SweepPlan
    from pronk.robots.robot import Robot


def record_virtual(
    robot: Robot,
    plan: SweepPlan,
    out_dir: Path,
    *,
    sim_params: Path | None = None,
    seed: int = 0,
    overwrite: bool = False,
    progress: Callable[[float], None] | None = None,
) -> list[Path]:
    """Excite the joints of the virtual robot, legs side by side in processes of their own.

    On a rigid bench legs do not feel each other, so each process simulates one leg.

    Args:
        robot: The robot.
        plan: What to excite; checked by the caller.
        out_dir: Folder for the logs.
        sim_params: sim_params file; the shipped one if None.
        seed: Of all noise; each leg takes its own from it.
        overwrite: Replace logs that are already there.
        progress: Called with the share done, 0 to 1.

    Returns:
        The logs, in the order of the robot's joints.
    """
    from pronk.virtual.plant import leg_of, legs_of
    from pronk.virtual.sim_params import load_sim_params

    # Read it here once, so that a bad file is one message and not one per process.
    hidden = load_sim_params(sim_params, robot)
    hidden.check_joints(robot.joint_names, str(sim_params or "sim_params"))
    if len(plan.sets) != len(plan.joints):
        raise PlanError("several joints excited at once: the virtual robot excites one at a time.")
    jobs = []
    for index, leg in enumerate(legs_of(robot)):
        excited = tuple(name for name in plan.joints if leg_of(robot, name) == leg)
        if excited:
            jobs.append((leg, excited, seed * 1000 + index))
    context = get_context("spawn")
    with (
        context.Manager() as manager,
        ProcessPoolExecutor(min(len(jobs), os.cpu_count() or 1), mp_context=context) as pool,
    ):
        done_in: queue.Queue[tuple[str, float]] = manager.Queue()
        running = {
            pool.submit(_record_leg, plan, leg, excited, out_dir, sim_params, s, overwrite, done_in)
            for leg, excited, s in jobs
        }
        shares = {leg: 0.0 for leg, _, _ in jobs}
        weight = {leg: len(excited) / len(plan.joints) for leg, excited, _ in jobs}
        done: list[Path] = []
        while running:
            finished, running = wait(running, timeout=0.2, return_when=FIRST_EXCEPTION)
            while not done_in.empty():
                leg, share = done_in.get()
                shares[leg] = share
            if progress is not None:
                progress(sum(weight[leg] * share for leg, share in shares.items()))
            for future in finished:
                done += future.result()
    if progress is not None:
        progress(1.0)
    order = {name: i for i, name in enumerate(robot.joint_names)}
    return sorted(done, key=lambda path: order.get(path.stem, len(order)))


def _record_leg(
    plan: SweepPlan,
    leg: str,
    joints: Sequence[str],
    out_dir: Path,
    sim_params: Path | None,
    seed: int,
    overwrite: bool,
    done_in: queue.Queue[tuple[str, float]],
) -> list[Path]:
    """Excite one leg; runs in a process of its own."""
    from pronk.runtime.sweep import record
    from pronk.virtual.robot import VirtualRobot
    from pronk.virtual.sim_params import load_sim_params

    hidden = load_sim_params(sim_params, plan.robot)
    machine = VirtualRobot(plan.robot, hidden, seed=seed, legs=(leg,))
    return record(
        machine,
        plan.robot,
        plan,
        out_dir,
        progress=lambda share, _: done_in.put((leg, share)),
        joints=joints,
        overwrite=overwrite,
        metadata={"link": "virtual robot, in this program"},
    )
