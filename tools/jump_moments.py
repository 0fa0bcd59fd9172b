r"""What the moment of the stride makes of jumps on the virtual robot.

    python tools/jump_moments.py policies/matched/policy.onnx --jumps 60

The jumps are those of `pronk trial`, with starts, noise and moments of their own, and the policy is
told of each at once, whatever its contract says of waiting (`pronk.policy.stride`). Printed are,
for every number of policy steps since the legs changed over, how many jumps were told then, how
many of them were well, and how high and far they went.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pronk.evaluation.job import Job, set_down
from pronk.evaluation.metrics import JumpFigures, measure
from pronk.evaluation.processes import cores, in_processes
from pronk.evaluation.run import Plan, jobs_of
from pronk.evaluation.subjects import load_subjects
from pronk.policy.runtime import load_policy
from pronk.policy.stride import apart, changes_over
from pronk.robots import load_robot
from pronk.runtime.rollout import run_policy
from pronk.virtual.sim_params import SHIPPED, load_sim_params


def since_change(position: NDArray[np.float64], step: int) -> int | None:
    """Policy steps since the legs changed over; None if they never did.

    Args:
        position: Of the joints, policy step by policy step [rad]. (steps, 12)
        step: Until this one; 0 if it is the first after the change.
    """
    bent = apart(position[: step + 1])
    changes = np.flatnonzero(changes_over(bent[:-1], bent[1:])) + 1
    return step - int(changes[-1]) if len(changes) else None


def told_at_once(job: Job) -> tuple[int | None, JumpFigures]:
    """One jump: policy steps since the legs changed over as it was told, and what became of it."""
    policy, robot = load_policy(job.policy), load_robot(job.robot)
    policy.contract = replace(policy.contract, waits_for_stride=False)
    machine = set_down(job)
    flown = run_policy(machine, policy, robot, job.script.commanded, seconds=job.script.seconds)
    figures = measure(
        machine.capture(), job.script, robot, began=flown.began, mass=job.mass, rules=job.rules
    )
    return since_change(flown.position, int(flown.jump.argmax())), figures


def table(found: list[tuple[int | None, JumpFigures]]) -> list[str]:
    """A line for every moment that was met, the earliest first."""
    moments = sorted({-1 if since is None else since for since, _ in found})
    lines = []
    for moment in moments:
        jumps = [figures for since, figures in found if (-1 if since is None else since) == moment]
        high, far = (
            np.array([getattr(jump, name) for jump in jumps]) for name in ("height", "distance")
        )
        lines.append(
            f"{'no stride' if moment < 0 else moment:>9} {len(jumps):>3} "
            f"{sum(jump.success for jump in jumps):>4}  {high.mean():.3f} +- {high.std():.3f} m  "
            f"{far.mean():.2f} +- {far.std():.2f} m"
        )
    return lines


def main() -> None:
    """Jump, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policy", type=Path, help="policy.onnx.")
    parser.add_argument("--jumps", type=int, default=60, help="A command.")
    asked = parser.parse_args()
    robot, plan = load_robot("mini_cheetah"), Plan(jumps=asked.jumps)
    planned = jobs_of(
        load_subjects([asked.policy], robot),
        plan,
        robot=robot,
        sim_params=load_sim_params(SHIPPED),
        out=Path(),
    )
    jobs = [replace(job, keep=None) for _, job in planned]
    found = in_processes(told_at_once, jobs, processes=cores())
    for case in plan.cases:
        mine = [
            each for (row, _), each in zip(planned, found, strict=True) if row.case == case.name
        ]
        print(f"{case.name} (virtual robot): steps since the legs changed over, jumps, well, ...")
        print("\n".join(table(mine)))


if __name__ == "__main__":
    main()
