"""One job: one life of a virtual robot under a policy, from set-down to the end of its script.

A job is all that such a life depends on, so that another process does it alike.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from pronk.errors import ArtefactError, HardwareError
from pronk.evaluation.jumps import JumpRules
from pronk.evaluation.metrics import JumpFigures, measure
from pronk.policy.runtime import Policy, load_policy
from pronk.robots import load_robot
from pronk.runtime.rollout import Rollout, check_standing, run_policy
from pronk.runtime.script import Script
from pronk.virtual import capture as captures
from pronk.virtual.ground import Ground, Start
from pronk.virtual.robot import VirtualRobot
from pronk.virtual.sim_params import SimParams

_OFFSETS = (1.0, 0.5, 0.0)
"""Shares of the drawn joint offsets with which a robot is set down until it stands."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """One jump, with all that it depends on."""

    policy: Path
    sha256: str
    robot: str
    sim_params: SimParams
    ground: Ground | None
    start: Start
    seed: int
    """Of the virtual robot's noise."""
    script: Script
    rules: JumpRules
    mass: float
    """[kg]"""
    keep: Path | None
    """Where to what was seen is written; None for nowhere."""


@dataclass(frozen=True, kw_only=True)
class Jumped:
    """What became of a job."""

    figures: JumpFigures
    began: float
    """When the policy took over, on the capture's clock [s]."""
    seconds: float
    """Wall time [s]."""
    cpu_s: float
    """Time of the processor [s]."""


@lru_cache(maxsize=4)
def _policy(path: Path, sha256: str) -> Policy:
    """The policy, opened once in each process."""
    policy = load_policy(path)
    if policy.sha256 != sha256:
        raise ArtefactError(f"{path}: was changed while the trial ran; run the trial again.")
    return policy


def body(job: Job, offset: float = 1.0) -> VirtualRobot:
    """The virtual robot of a job, not connected yet.

    Args:
        job: Whose.
        offset: Share of the start's joint offsets.
    """
    start = job.start
    if start.joint_offset is not None:
        start = replace(start, joint_offset=tuple(offset * each for each in start.joint_offset))
    return VirtualRobot(
        load_robot(job.robot),
        job.sim_params,
        seed=job.seed,
        base="ground",
        ground=job.ground,
        start=start,
    )


def set_down(job: Job) -> VirtualRobot:
    """The virtual robot of a job, standing: before the policy, its drives alone hold it.

    Where it tips over, as a heavier body may, it is set down again nearer to the default pose.

    Raises:
        HardwareError: It does not even stand in the default pose.
    """
    for offset in _OFFSETS:
        machine = body(job, offset)
        machine.connect()
        try:
            check_standing(load_robot(job.robot), machine.latest())
            break
        except HardwareError:
            if offset == _OFFSETS[-1]:
                raise
    return machine


def flight(job: Job) -> tuple[captures.Capture, Rollout]:
    """Run one job: what was seen, and what the policy decided."""
    machine = set_down(job)
    policy = _policy(job.policy, job.sha256)
    script = job.script
    flown = run_policy(
        machine, policy, load_robot(job.robot), script.commanded, seconds=script.seconds
    )
    return machine.capture(), flown


def jump(job: Job) -> Jumped:
    """Run one job and measure it."""
    begun, begun_cpu = time.perf_counter(), time.process_time()
    seen, flown = flight(job)
    figures = measure(
        seen,
        job.script,
        load_robot(job.robot),
        began=flown.began,
        mass=job.mass,
        rules=job.rules,
    )
    if job.keep is not None:
        captures.save(job.keep, seen)
    return Jumped(
        figures=figures,
        began=flown.began,
        seconds=time.perf_counter() - begun,
        cpu_s=time.process_time() - begun_cpu,
    )
