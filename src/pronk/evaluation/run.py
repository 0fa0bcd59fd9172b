"""Many jumps: every policy with every command, each jump from a start of its own.

    trial = run([Path("policy.onnx")], Plan(), robot=robot, sim_params=load_sim_params(), out=out)

A jump is one life of a virtual robot: set down with a heading and joint offsets of its own, noise
of its own, and a jump input that comes up to `spread_s` later, so that it meets every phase of the
gait. All of that is drawn from the seed, the command and the number of the jump alone: every policy
meets the same starts, and another command beside it changes nothing.
"""

from __future__ import annotations

import hashlib
import math
import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

import pronk
from pronk.errors import PronkError
from pronk.evaluation import result
from pronk.evaluation.folder import CAPTURES, prepare
from pronk.evaluation.job import Job, Jumped, body, jump
from pronk.evaluation.jumps import JumpRules
from pronk.evaluation.metrics import JumpFigures
from pronk.evaluation.processes import in_processes
from pronk.evaluation.protocol import PAPER_COMMANDS, RATES, Case
from pronk.evaluation.result import Subject, Trial
from pronk.evaluation.rows import Row
from pronk.evaluation.subjects import load_subjects
from pronk.robots import load_robot
from pronk.robots.robot import Robot
from pronk.runtime.script import STILL, Script
from pronk.virtual.ground import Ground, Start
from pronk.virtual.sim_params import SimParams


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is tried."""

    cases: tuple[Case, ...] = PAPER_COMMANDS
    jumps: int = 20
    """With each command."""
    rates: int = 0
    """Jumps at `RATES` beside them, all of them kept: what the paper's figure of roll and pitch
    rates is drawn from (R7)."""
    seed: int = 0
    script: Script = field(default_factory=lambda: Script(command=STILL))
    """Times; the command is each case's."""
    spread_s: float = 0.5
    """The jump input comes up to this much later, uniformly, in policy steps [s]."""
    yaw: float = math.pi
    """Half-width of the headings at the start [rad]."""
    joint_offset: float = 0.05
    """Half-width of what each joint is held beside the default pose at the start [rad]. On drives
    as soft as these it tilts the trunk by 5 degrees, by 13 at most; .1 may tip the robot over."""
    rules: JumpRules = field(default_factory=JumpRules)

    def __post_init__(self) -> None:
        """Refuse a plan that tries nothing, or draws the impossible.

        Raises:
            PronkError: One sentence that names the field.
        """
        if self.jumps < 1:
            raise PronkError(f"{self.jumps} jumps for each command; expected 1 or more.")
        if self.rates < 0:
            raise PronkError(f"{self.rates} jumps at {RATES.name}; expected 0 or more.")
        if self.seed < 0:
            raise PronkError(f"seed {self.seed}; expected 0 or more.")
        names = [case.name for case in self.tried]
        if not names or len(set(names)) != len(names):
            raise PronkError(
                f"the commands are {', '.join(names) or 'none'}; expected one or more, all "
                "different."
            )
        for name in ("spread_s", "yaw", "joint_offset"):
            value = getattr(self, name)
            if not 0.0 <= value < math.inf:
                raise PronkError(f"Plan.{name} is {value}; it must be finite, not negative.")

    @property
    def tried(self) -> tuple[Case, ...]:
        """All commands."""
        return (*self.cases, RATES) if self.rates else self.cases


def draw(plan: Plan, case: Case, number: int, robot: Robot) -> tuple[Script, Start, int]:
    """What is drawn for one jump: its script, its start, and the seed of its noise.

    Args:
        plan: What is tried.
        case: The command.
        number: Of the jump, from 0.
        robot: Whose policy rate and joints.
    """
    # The command's own digest, so that a command draws alike whatever stands beside it.
    digest = hashlib.sha256(np.array(case.command, dtype="<f8").tobytes()).digest()
    rng = np.random.default_rng([plan.seed, int.from_bytes(digest[:8], "little"), number])
    ticks = int(rng.integers(round(plan.spread_s * robot.policy_rate_hz) + 1))
    yaw = float(rng.uniform(-plan.yaw, plan.yaw))
    offset = rng.uniform(-plan.joint_offset, plan.joint_offset, len(robot.joints))
    later = plan.script.run_s + ticks / robot.policy_rate_hz
    return (
        replace(plan.script, command=case.command, run_s=later),
        Start(yaw=yaw, joint_offset=tuple(offset.tolist())),
        int(rng.integers(2**31)),
    )


def jobs_of(
    subjects: Sequence[Subject],
    plan: Plan,
    *,
    robot: Robot,
    sim_params: SimParams,
    out: Path,
    ground: Ground | None = None,
    keep_captures: bool = False,
) -> list[tuple[Row, Job]]:
    """Every jump of a plan, with its row as far as it is known before.

    What was seen is kept of the first jump with each command and of those at `RATES`, or of all.
    """
    mass = mass_of(robot)
    found = []
    for subject in subjects:
        for case, number in _numbered(plan):
            script, start, seed = draw(plan, case, number, robot)
            keep = ""
            if number == 0 or keep_captures or case not in plan.cases:
                stem = f"{subject.name}_{case.name}_{number:03d}".replace(" ", "_")
                keep = f"{CAPTURES}/{stem}.npz"
            row = Row(
                policy=subject.name,
                case=case.name,
                number=number,
                seed=seed,
                figures=JumpFigures(told=False),
                script=script,
                capture=keep,
            )
            job = Job(
                policy=Path(subject.path),
                sha256=subject.sha256,
                robot=robot.name,
                sim_params=sim_params,
                ground=ground,
                start=start,
                seed=seed,
                script=script,
                rules=plan.rules,
                mass=mass,
                keep=out / keep if keep else None,
            )
            found.append((row, job))
    return found


def _numbered(plan: Plan) -> Iterator[tuple[Case, int]]:
    """Every jump of one policy: its command and its number."""
    for case in plan.tried:
        for number in range(plan.jumps if case in plan.cases else plan.rates):
            yield case, number


@lru_cache(maxsize=4)
def _mass(name: str) -> float:
    model = load_robot(name).build_spec().compile()
    return float(model.body_mass.sum())


def mass_of(robot: Robot) -> float:
    """Of the whole robot, as its model has it [kg]."""
    return _mass(robot.name)


def run(
    policies: Sequence[Path],
    plan: Plan,
    *,
    robot: Robot,
    sim_params: SimParams,
    out: Path,
    about: Mapping[str, Any] | None = None,
    ground: Ground | None = None,
    keep_captures: bool = False,
    overwrite: bool = False,
    processes: int = 1,
    progress: Callable[[float], None] | None = None,
) -> Trial:
    """Try policies on the virtual robot and write what was found.

    Args:
        policies: `policy.onnx` of each; scatter is compared with that of the first.
        plan: What is tried.
        robot: Which robot they are for.
        sim_params: Body of the virtual robot.
        out: Folder for the table, the summary and what was seen.
        about: Where the parameters come from, kept with the result.
        ground: Under the robot; None for the parameters'.
        keep_captures: Keep what was seen of every jump, not of the first with each command alone.
        overwrite: Replace a trial in `out`.
        processes: How many jumps at once; the numbers do not depend on it.
        progress: Called with the share done, 0 to 1.

    Raises:
        PronkError: Of policies, sim_params or folder, before the first step.
    """
    begun = time.perf_counter()
    subjects = load_subjects(policies, robot)
    planned = jobs_of(
        subjects,
        plan,
        robot=robot,
        sim_params=sim_params,
        out=out,
        ground=ground,
        keep_captures=keep_captures,
    )
    rows, jobs = [row for row, _ in planned], [job for _, job in planned]
    body(jobs[0])  # a body that cannot exist is refused here
    prepare(out, overwrite=overwrite)
    jumped = in_processes(jump, jobs, processes=processes, progress=progress)
    trial = Trial(
        robot=robot.name,
        virtual=True,
        subjects=subjects,
        cases=plan.tried,
        rows=tuple(
            replace(row, figures=each.figures, began=each.began)
            for row, each in zip(rows, jumped, strict=True)
        ),
        joint_names=robot.joint_names,
        seed=plan.seed,
        sim_params=dict(about or {}),
        script=plan.script,
        spread_s=plan.spread_s,
        rules=asdict(plan.rules),
        mass=mass_of(robot),
        versions=versions(),
        timing=_timing(jobs, jumped, processes, time.perf_counter() - begun),
    )
    result.save(out, trial)
    return trial


def _timing(
    jobs: Sequence[Job], jumped: Sequence[Jumped], processes: int, seconds: float
) -> dict[str, float]:
    simulated = sum(job.script.seconds for job in jobs)
    return {
        "seconds": seconds,
        "simulated_s": simulated,
        "processes": processes,
        "cores": os.cpu_count() or 1,
        "simulated_s_per_s_and_process": simulated / sum(each.seconds for each in jumped),
        # Does not depend on who else uses the machine.
        "simulated_s_per_cpu_s": simulated / sum(each.cpu_s for each in jumped),
    }


def versions() -> dict[str, str]:
    """Versions of what a trial is computed with."""
    import mujoco
    import onnxruntime
    import scipy

    modules = {"mujoco": mujoco, "numpy": np, "scipy": scipy, "onnxruntime": onnxruntime}
    found = {"python": platform.python_version(), "pronk": pronk.__version__}
    return found | {name: str(module.__version__) for name, module in modules.items()}
