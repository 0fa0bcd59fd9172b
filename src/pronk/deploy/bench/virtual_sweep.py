"""A sweep of the virtual robot, faster than real time."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pronk.deploy.runtime.sweep import SweepTask
from pronk.deploy.runtime.sweep_recorder import record_sweep
from pronk.identify.excitation.plan import SweepPlan
from pronk.jump.virtual.plant import legs_of, limb_of
from pronk.jump.virtual.robot import VirtualRobot
from pronk.jump.virtual.sim_params import SimParams
from pronk.names import file_name
from pronk.processes import in_processes


def sweep_virtual(
    plan: SweepPlan,
    sim_params: SimParams,
    out: Path,
    *,
    seed: int = 0,
    processes: int = 1,
    overwrite: bool = False,
    progress: Callable[[float], None] | None = None,
) -> list[Path]:
    """Excite the virtual robot and return the logs in the order of its joints.

    On a rigid bench limbs do not affect each other: each is simulated by itself, with noise of its
    own derived from `seed`, `processes` at once, which the logs do not depend on. The caller has
    checked the plan; `overwrite` replaces logs; `progress` is called with the share done.
    """
    robot, metadata, jobs = plan.robot, {"link": "virtual robot, in this program"}, []
    for index, limb in enumerate(legs_of(robot)):
        joints = tuple(name for name in plan.joints if limb_of(robot, name) == limb)
        task = SweepTask(
            plan=plan, out_dir=out, joints=joints, overwrite=overwrite, metadata=metadata
        )
        jobs += [(task, sim_params, limb, 1000 * seed + index)] if joints else []
    logs = in_processes(_sweep_limb, jobs, processes=processes, progress=progress)
    order = {file_name(name): i for i, name in enumerate(robot.joint_names)}
    return sorted((path for paths in logs for path in paths), key=lambda path: order[path.stem])


def _sweep_limb(job: tuple[SweepTask, SimParams, str, int]) -> list[Path]:
    task, sim_params, limb, seed = job
    return record_sweep(VirtualRobot(task.plan.robot, sim_params, seed=seed, legs=(limb,)), task)
