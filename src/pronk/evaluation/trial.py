"""Many jumps of the virtual robot: every policy with every command, each jump from its own start.

    results = run_trial([Path("policy.onnx")], Plan(), robot=robot, sim_params=params, out=out)

Each jump has a new virtual robot with its own heading, joint offsets and noise, and a jump input
that rises up to `spread_s` later, so that it meets every phase of the gait. All of it is drawn from
seed, command and number of the jump alone: every policy meets the same starts, and another command
changes nothing. Walks and varied bodies run the same way.

    trials.csv, summary.json    one row a jump; what was run, and the sums
    captures/, videos/          recorded runs, and films of them
"""

from __future__ import annotations

import hashlib
import math
import multiprocessing
import os
import platform
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal, NotRequired, TypedDict, TypeVar, Unpack

import msgspec
import numpy as np

import pronk
from pronk.errors import ArtefactError, HardwareError, PronkError
from pronk.evaluation.jumps import JumpRules, measure
from pronk.evaluation.pictures.video import ENDINGS
from pronk.evaluation.protocol import PAPER_COMMANDS, RATES, Case
from pronk.evaluation.results import JUMPS, SUMMARY, TABLE, Kind, Results, Row, Subject, save
from pronk.policy.contract import check
from pronk.policy.runtime import Policy, load_policy
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec
from pronk.runtime.rollout import check_standing, ticks
from pronk.runtime.script import STILL, Script
from pronk.virtual import capture as captures
from pronk.virtual.ground import Ground, Start
from pronk.virtual.robot import VirtualRobot
from pronk.virtual.sim_params import SimParams

J = TypeVar("J")
R = TypeVar("R")
Keep = Literal["none", "some", "all"]
Progress = Callable[[float], None]
"""Called with the share done, 0 to 1."""

CAPTURES, VIDEOS = "captures", "videos"
"""Folders beside the table."""
_OFFSETS = (1.0, 0.5, 0.0)
"""Shares of the drawn joint offsets that are tried until the robot stands."""
_LEFT_OUT = ("observation", "provenance")
"""Fields of a policy's contract that a trial does not keep."""


class Setup(TypedDict):
    """What every kind of trial runs on: the policies' robot, the virtual robot, the folder.

    `about` is the source of the parameters, kept with the results; `processes` are the runs at
    once, on which no number depends.
    """

    robot: RobotSpec
    sim_params: SimParams
    out: Path
    about: NotRequired[Mapping[str, Any] | None]
    processes: NotRequired[int]
    progress: NotRequired[Progress | None]


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The commands and draws of a trial."""

    cases: tuple[Case, ...] = PAPER_COMMANDS
    jumps: int = 20
    """With each command."""
    rates: int = 0
    """Jumps at `RATES` besides, for the paper's figure of roll and pitch rates (R7)."""
    seed: int = 0
    script: Script = field(default_factory=lambda: Script(command=STILL))
    """Times; the command is each case's."""
    spread_s: float = 0.5
    """The jump input rises up to this much later, uniformly, in policy steps [s]."""
    yaw: float = math.pi
    """Half-width of the headings at the start [rad]."""
    joint_offset: float = 0.05
    """Half-width of the joints' offsets from the default pose at the start [rad]. With drives this
    soft it tilts the trunk by 5 degrees, by 13 at most; 0.1 may tip the robot over."""
    rules: JumpRules = field(default_factory=JumpRules)

    def __post_init__(self) -> None:
        """Raise `PronkError` for an empty plan or a negative seed."""
        if self.jumps < 1:
            raise PronkError(f"{self.jumps} jumps for each command; expected 1 or more.")
        if self.seed < 0:
            raise PronkError(f"seed {self.seed}; expected 0 or more.")
        names = [case.name for case in self.tried]
        if not names or len(set(names)) != len(names):
            shown = ", ".join(names) or "none"
            raise PronkError(f"the commands are {shown}; expected one or more, all different.")

    @property
    def tried(self) -> tuple[Case, ...]:
        """All commands."""
        return (*self.cases, RATES) if self.rates else self.cases


def case_rng(seed: int, case: Case, number: int) -> np.random.Generator:
    """Return a generator that depends on seed, command and number of a run alone."""
    digest = hashlib.sha256(np.array(case.command, dtype="<f8").tobytes()).digest()
    return np.random.default_rng([seed, int.from_bytes(digest[:8], "little"), number])


def draw(plan: Plan, case: Case, number: int, robot: RobotSpec) -> tuple[Script, Start, int]:
    """Draw the script, the start and the noise seed of one jump, numbered from 0."""
    rng = case_rng(plan.seed, case, number)
    ticks = int(rng.integers(round(plan.spread_s * robot.policy_rate_hz) + 1))
    yaw = float(rng.uniform(-plan.yaw, plan.yaw))
    offset = rng.uniform(-plan.joint_offset, plan.joint_offset, len(robot.joints))
    later = plan.script.run_s + ticks / robot.policy_rate_hz
    return (
        replace(plan.script, command=case.command, run_s=later),
        Start(yaw=yaw, joint_offset=tuple(offset.tolist())),
        int(rng.integers(2**31)),
    )


# ---- one run ----


@dataclass(frozen=True, kw_only=True)
class Job:
    """One run with all that it depends on, so that every process runs it alike."""

    row: Row
    """The run, without figures."""
    policy: Path
    sha256: str
    robot: str
    sim_params: SimParams
    start: Start
    ground: Ground | None = None
    """None for that of the parameters."""
    rules: JumpRules
    keep: Path | None = None
    """File for the capture; None for none."""
    measure: Callable[..., Any] = measure
    """From capture to figures; a function of a module."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """One run with its figures, its wall time and its processor time [s]."""

    row: Row
    seconds: float
    cpu_s: float


@lru_cache(maxsize=4)
def opened(path: Path, sha256: str) -> Policy:
    """Open a policy once in each process.

    Raises:
        ArtefactError: It was changed since the trial began.
    """
    policy = load_policy(path)
    if policy.sha256 != sha256:
        raise ArtefactError(f"{path}: was changed while the trial ran; run the trial again.")
    return policy


@lru_cache(maxsize=4)
def mass_of(robot: str) -> float:
    """Mass of a whole robot, by name, from its model [kg]."""
    return float(load_robot(robot).build_spec().compile().body_mass.sum())


def build(job: Job, offset: float = 1.0) -> VirtualRobot:
    """Build the virtual robot of a job, not connected, at a share of its joint offsets."""
    start = job.start
    if start.joint_offset is not None:
        start = replace(start, joint_offset=tuple(offset * each for each in start.joint_offset))
    return VirtualRobot(
        load_robot(job.robot),
        job.sim_params,
        seed=job.row.seed,
        base="ground",
        ground=job.ground,
        start=start,
    )


def set_down(job: Job) -> VirtualRobot:
    """Return the virtual robot of a job, standing, held by its drives alone.

    A robot that tips over, as a heavier one may, is set down again nearer to the default pose.

    Raises:
        HardwareError: It does not stand even in the default pose.
    """
    for offset in _OFFSETS:
        machine = build(job, offset)
        machine.connect()
        try:
            check_standing(load_robot(job.robot), machine.latest())
            break
        except HardwareError:
            if offset == _OFFSETS[-1]:
                raise
    return machine


def run_job(job: Job) -> Outcome:
    """Run one job and measure it."""
    begun, begun_cpu = time.perf_counter(), time.process_time()
    machine, robot, script = set_down(job), load_robot(job.robot), job.row.script
    policy = opened(job.policy, job.sha256)
    taken = list(ticks(machine, policy, robot, script.commanded, seconds=script.seconds))
    if not taken:
        raise HardwareError("the policy made no step; let it run for one tick or more.")
    seen, began, mass = machine.capture(), taken[0].time, mass_of(job.robot)
    figures = job.measure(seen, script, robot, began=began, mass=mass, rules=job.rules)
    if job.keep is not None:
        captures.save(job.keep, seen)
    return Outcome(
        row=replace(job.row, figures=figures, began=began),
        seconds=time.perf_counter() - begun,
        cpu_s=time.process_time() - begun_cpu,
    )


# ---- many runs ----


def cores() -> int:
    """Cores that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        return os.cpu_count() or 1


def in_processes(
    work: Callable[[J], R],
    jobs: Sequence[J],
    *,
    processes: int = 1,
    progress: Progress | None = None,
) -> list[R]:
    """Do every job, in this process or in several, and return the results in the order of the jobs.

    `work` is a function of a module; jobs are pickled.

    Raises:
        PronkError: Fewer than one process, or one was killed; and what `work` raises.
    """
    if processes < 1:
        raise PronkError(f"{processes} processes; expected 1 or more.")
    report = progress or (lambda share: None)
    if processes == 1 or len(jobs) <= 1:
        done = []
        for job in jobs:
            done.append(work(job))
            report(len(done) / len(jobs))
        return done
    # A fork of a process that has threads can deadlock.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(processes, len(jobs)), mp_context=context) as pool:
        futures: list[Future[R]] = [pool.submit(work, job) for job in jobs]
        try:
            for count, future in enumerate(as_completed(futures), start=1):
                future.result()
                report(count / len(jobs))
        except BrokenProcessPool:
            raise PronkError(
                "one of the processes was killed, most likely for want of memory; "
                "try again with --processes 1."
            ) from None
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return [future.result() for future in futures]


def job_of(
    subject: Subject,
    case: Case,
    number: int,
    script: Script,
    start: Start,
    seed: int,
    robot: RobotSpec,
    sim_params: SimParams,
    rules: JumpRules,
) -> Job:
    """Return one run of a policy with one command."""
    who: Any = {"policy": subject.name, "case": case.name, "number": number, "seed": seed}
    return Job(
        row=Row(**who, figures=None, script=script),
        policy=Path(subject.path),
        sha256=subject.sha256,
        robot=robot.name,
        sim_params=sim_params,
        start=start,
        rules=rules,
    )


def plan_jobs(
    subjects: Sequence[Subject],
    plan: Plan,
    *,
    robot: RobotSpec,
    sim_params: SimParams,
    out: Path = Path(),
    keep: Keep = "none",
    measure: Callable[..., Any] = measure,
) -> list[Job]:
    """Return every run of a plan.

    With `keep="some"` the captures of the first jump with each command and of those at `RATES` are
    kept in `out`.
    """
    found = []
    runs = [
        (subject, case, number)
        for subject in subjects
        for case in plan.tried
        for number in range(plan.jumps if case in plan.cases else plan.rates)
    ]
    for subject, case, number in runs:
        stem = f"{subject.name}_{case.name}_{number:03d}".replace(" ", "_")
        some = number == 0 or case not in plan.cases
        kept = out if keep == "all" or (keep == "some" and some) else None
        capture = f"{CAPTURES}/{stem}.npz" if kept else ""
        script, start, seed = draw(plan, case, number, robot)
        job = job_of(subject, case, number, script, start, seed, robot, sim_params, plan.rules)
        row = replace(job.row, capture=capture)
        where = kept / capture if kept else None
        found.append(replace(job, row=row, keep=where, measure=measure))
    return found


def run_plan(
    policies: Sequence[Path],
    plan: Plan,
    *,
    kind: Kind = JUMPS,
    jump: bool = True,
    varied: Sequence[tuple[str, float, SimParams]] = (),
    settings: Mapping[str, Any] | None = None,
    keep: Keep = "none",
    overwrite: bool | None = None,
    measure: Callable[..., Any] = measure,
    **setup: Unpack[Setup],
) -> Results:
    """Run, measure, save and return all jobs of a plan, as `run_trial` does.

    With `jump` the policies need the jump input. `varied` has parameter, value and body of every
    body, if there are more than that of `setup`. With `overwrite` None the results are added to the
    folder. `measure` is as in `Job`.
    """
    robot, out, processes = setup["robot"], setup["out"], setup.get("processes", 1)
    subjects, jobs = load_subjects(policies, robot, jump=jump), []
    how: Any = {"robot": robot, "out": out, "keep": keep, "measure": measure}
    for parameter, value, params in varied or [("", math.nan, setup["sim_params"])]:
        made = plan_jobs(subjects, plan, sim_params=params, **how)
        build(made[0])  # refuses impossible parameters
        jobs += [replace(j, row=replace(j.row, parameter=parameter, value=value)) for j in made]
    if overwrite is not None:
        prepare(out, overwrite=overwrite)
    begun = time.perf_counter()
    done = in_processes(run_job, jobs, processes=processes, progress=setup.get("progress"))
    simulated = sum(job.row.script.seconds for job in jobs)
    results = Results(
        kind=kind,
        robot=robot.name,
        subjects=subjects,
        cases=plan.tried,
        rows=tuple(each.row for each in done),
        joint_names=robot.joint_names,
        seed=plan.seed,
        sim_params=dict(setup.get("about") or {}),
        script=plan.script,
        spread_s=plan.spread_s,
        rules=asdict(plan.rules),
        mass=mass_of(robot.name),
        settings=dict(settings or {}),
        versions=versions(),
        timing={
            "seconds": time.perf_counter() - begun,
            "simulated_s": simulated,
            "processes": processes,
            "cores": os.cpu_count() or 1,
            "simulated_s_per_s_and_process": simulated / sum(each.seconds for each in done),
            # Does not depend on other work on the machine.
            "simulated_s_per_cpu_s": simulated / sum(each.cpu_s for each in done),
        },
    )
    save(out, results)
    return results


def run_trial(
    policies: Sequence[Path],
    plan: Plan,
    *,
    keep_captures: bool = False,
    overwrite: bool = False,
    **setup: Unpack[Setup],
) -> Results:
    """Let policies jump on the virtual robot and write the results.

    Args:
        policies: `policy.onnx` of each; scatter is compared with that of the first.
        plan: Commands and draws.
        keep_captures: Keep the capture of every jump, not of the first with each command alone.
        overwrite: Replace a trial in the folder.
        setup: What it runs on.

    Raises:
        PronkError: Of policies, parameters or folder, before the first step.
    """
    keep: Keep = "all" if keep_captures else "some"
    return run_plan(policies, plan, keep=keep, overwrite=overwrite, **setup)


def load_subjects(
    paths: Sequence[Path], robot: RobotSpec, *, jump: bool = True
) -> tuple[Subject, ...]:
    """Open, check and name policies.

    A policy is named after the gains of its training; two of a kind, after their files.

    Raises:
        ArtefactError: Missing, damaged, not for the robot, or without the jump input where `jump`.
        PronkError: The same policy twice.
    """
    policies = []
    for path in paths:
        policies.append(load_policy(path))
        contract = policies[-1].contract
        try:
            check(contract, robot)
        except ArtefactError as error:
            raise ArtefactError(f"{path}: {error}") from None
        if jump and not contract.jump:
            raise ArtefactError(
                f"{path}: this policy was trained to walk only and has no jump input; "
                "`pronk train jump` adds it."
            )
    if len({policy.sha256 for policy in policies}) != len(policies):
        raise PronkError(
            f"{', '.join(map(str, paths))}: the same policy twice; give each policy once."
        )
    return tuple(
        Subject(
            name=name,
            path=str(path),
            sha256=policy.sha256,
            contract={
                key: dict(value) if isinstance(value, Mapping) else value
                for key, value in msgspec.structs.asdict(policy.contract).items()
                if key not in _LEFT_OUT
            },
        )
        for name, path, policy in zip(
            _names(paths, [policy.contract.gains for policy in policies]),
            paths,
            policies,
            strict=True,
        )
    )


def _names(paths: Sequence[Path], gains: list[str]) -> list[str]:
    for names in (gains, [path.stem for path in paths], [path.parent.name for path in paths]):
        if len(set(names)) == len(names) and all(names):
            return names
    return [f"{name} {i}" for i, name in enumerate(gains, start=1)]


def prepare(out: Path, *, overwrite: bool = False) -> None:
    """Make the folder of a trial, before anything is computed.

    With `overwrite` a folder that holds a trial is taken, and that trial's own files are deleted.

    Raises:
        PronkError: A file, a folder that is not empty, or one that cannot be written to.
    """
    if out.exists() and not out.is_dir():
        raise PronkError(f"--out {out}: a file; expected the name of a folder.")
    try:
        filled = out.is_dir() and any(out.iterdir())
        old = (out / SUMMARY, out / TABLE)
        if filled and not overwrite:
            raise PronkError(
                f"--out {out}: not empty; give another folder, or --overwrite to replace the "
                "trial in it."
            )
        # An interrupted trial leaves captures alone.
        if filled and not any(path.exists() for path in (*old, out / CAPTURES)):
            raise PronkError(
                f"--out {out}: holds no trial to overwrite; give a new or an empty folder."
            )
        out.mkdir(parents=True, exist_ok=True)
        # Fails now, not after an hour, if the folder cannot be written to.
        with tempfile.NamedTemporaryFile(dir=out):
            pass
        films = (path for ending in ENDINGS for path in (out / VIDEOS).glob(f"*{ending}"))
        for path in (*old, *(out / CAPTURES).glob("*.npz"), *films):
            path.unlink(missing_ok=True)
    except OSError as error:
        raise PronkError(
            f"--out {out}: cannot be written to ({error.strerror}); give another folder."
        ) from None


def versions() -> dict[str, str]:
    """Versions of the software that a trial is computed with."""
    import mujoco
    import onnxruntime
    import scipy

    modules = {"mujoco": mujoco, "numpy": np, "scipy": scipy, "onnxruntime": onnxruntime}
    found = {"python": platform.python_version(), "pronk": pronk.__version__}
    return found | {name: str(module.__version__) for name, module in modules.items()}
