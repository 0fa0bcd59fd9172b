"""A sweep of the virtual robot, faster than real time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pronk.deploy.runtime.sweep import SweepTask
from pronk.deploy.runtime.sweep_recorder import record_sweep
from pronk.identify.excitation.plan import SweepPlan
from pronk.jump.virtual.plant import legs_of, limb_of
from pronk.jump.virtual.robot import VirtualRobot
from pronk.jump.virtual.sim_params import SimParams
from pronk.names import file_name
from pronk.processes import in_processes


@dataclass(frozen=True, kw_only=True)
class _LimbSweep:
    """The sweep of one limb of a virtual robot."""

    task: SweepTask
    sim_params: SimParams
    limb: str
    """Name of the limb."""
    seed: int
    """Seed of the limb's noise."""


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
    """Excite the virtual robot and write its logs.

    On a rigid bench limbs do not affect each other: each is simulated by itself, with noise of its
    own derived from the seed.

    Args:
        plan: The sweep, which the caller has checked.
        sim_params: Parameters of the virtual robot.
        out: Folder of the logs.
        seed: Seed of all noise.
        processes: Number of limbs at once, which the logs do not depend on.
        overwrite: Replace logs.
        progress: Called with the share of the limbs that are done, 0 to 1.

    Returns:
        The logs in the order of the robot's joints.
    """
    robot = plan.robot
    joints_by_limb: dict[str, list[str]] = {limb: [] for limb in legs_of(robot)}
    for joint in plan.joints:
        joints_by_limb[limb_of(robot, joint)].append(joint)
    sweeps = []
    for index, (limb, joints) in enumerate(joints_by_limb.items()):
        if joints:
            task = SweepTask(
                plan=plan,
                out_dir=out,
                joints=tuple(joints),
                overwrite=overwrite,
                metadata={"link": "virtual robot, in this program"},
            )
            sweeps.append(
                _LimbSweep(task=task, sim_params=sim_params, limb=limb, seed=1000 * seed + index)
            )
    log_by_stem = {}
    names = [f"the sweep of {sweep.limb or robot.name}" for sweep in sweeps]
    done = in_processes(_sweep_limb, sweeps, processes=processes, names=names, progress=progress)
    for logs in done:
        for log in logs:
            log_by_stem[log.stem] = log
    ordered = []
    for joint in robot.joint_names:
        stem = file_name(joint)
        if stem in log_by_stem:
            ordered.append(log_by_stem[stem])
    return ordered


def _sweep_limb(sweep: _LimbSweep) -> list[Path]:
    machine = VirtualRobot(
        sweep.task.plan.robot, sweep.sim_params, seed=sweep.seed, legs=(sweep.limb,)
    )
    return record_sweep(machine, sweep.task)
