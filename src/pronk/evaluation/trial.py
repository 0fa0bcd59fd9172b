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
import os
import platform
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

import pronk
from pronk.errors import ArtefactError, HardwareError, PronkError
from pronk.evaluation.jumps import JumpRules
from pronk.evaluation.metrics import measure
from pronk.evaluation.pictures.video import ENDINGS
from pronk.evaluation.processes import in_processes
from pronk.evaluation.protocol import PAPER_COMMANDS, RATES, Case
from pronk.evaluation.results import JUMPS, SUMMARY, TABLE, Kind, Results, Row, Subject, save
from pronk.policy.contract import Contract, check
from pronk.policy.runtime import Policy, load_policy
from pronk.robots import load_robot
from pronk.robots.robot import Robot
from pronk.runtime.rollout import check_standing, ticks
from pronk.runtime.script import STILL, Script
from pronk.virtual import capture as captures
from pronk.virtual.ground import Ground, Start
from pronk.virtual.robot import VirtualRobot
from pronk.virtual.sim_params import SimParams

CAPTURES, VIDEOS = "captures", "videos"
"""Folders beside the table."""
_OFFSETS = (1.0, 0.5, 0.0)
"""Shares of the drawn joint offsets that are tried until the robot stands."""
_LEFT_OUT = ("observation", "provenance", "waits_for_stride")
"""Fields of a policy's contract that a trial does not keep."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The commands and draws of a trial."""

    cases: tuple[Case, ...] = PAPER_COMMANDS
    jumps: int = 20
    """With each command."""
    rates: int = 0
    """Jumps at `RATES` besides, their captures kept: for the paper's figure of roll and pitch
    rates (R7)."""
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
        """Refuse an empty or impossible plan.

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


def case_rng(seed: int, case: Case, number: int) -> np.random.Generator:
    """Return a generator that depends on seed, command and number of a run alone."""
    digest = hashlib.sha256(np.array(case.command, dtype="<f8").tobytes()).digest()
    return np.random.default_rng([seed, int.from_bytes(digest[:8], "little"), number])


def draw(plan: Plan, case: Case, number: int, robot: Robot) -> tuple[Script, Start, int]:
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
    keep: Path | None = None
    """File for the capture; None for none."""
    measure: Callable[..., Any] = measure
    """From capture to figures; a function of a module."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """The figures of one run, and its cost."""

    figures: Any
    began: float
    """When the policy took over, on the capture's clock [s]."""
    seconds: float
    """Wall time [s]."""
    cpu_s: float
    """Processor time [s]."""


@lru_cache(maxsize=4)
def _policy(path: Path, sha256: str) -> Policy:
    """Open the policy once in each process."""
    policy = load_policy(path)
    if policy.sha256 != sha256:
        raise ArtefactError(f"{path}: was changed while the trial ran; run the trial again.")
    return policy


def build(job: Job, offset: float = 1.0) -> VirtualRobot:
    """Build the virtual robot of a job, not connected, at a share of its joint offsets."""
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


def record(job: Job) -> tuple[captures.Capture, float]:
    """Run one job; return the capture and when the policy started [s]."""
    machine, policy = set_down(job), _policy(job.policy, job.sha256)
    robot, seconds = load_robot(job.robot), job.script.seconds
    taken = list(ticks(machine, policy, robot, job.script.commanded, seconds=seconds))
    if not taken:
        raise HardwareError("the policy made no step; let it run for one tick or more.")
    return machine.capture(), taken[0].time


def run_job(job: Job) -> Outcome:
    """Run one job and measure it."""
    begun, begun_cpu = time.perf_counter(), time.process_time()
    seen, began = record(job)
    robot = load_robot(job.robot)
    figures = job.measure(seen, job.script, robot, began=began, mass=job.mass, rules=job.rules)
    if job.keep is not None:
        captures.save(job.keep, seen)
    return Outcome(
        figures=figures,
        began=began,
        seconds=time.perf_counter() - begun,
        cpu_s=time.process_time() - begun_cpu,
    )


# ---- many runs ----


@lru_cache(maxsize=4)
def _mass(name: str) -> float:
    return float(load_robot(name).build_spec().compile().body_mass.sum())


def mass_of(robot: Robot) -> float:
    """Mass of the whole robot, from its model [kg]."""
    return _mass(robot.name)


def planned_run(
    subject: Subject,
    case: Case,
    number: int,
    *,
    drawn: tuple[Script, Start, int],
    robot: Robot,
    sim_params: SimParams,
    rules: JumpRules,
    ground: Ground | None = None,
    keep: tuple[Path, str] | None = None,
    measure: Callable[..., Any] = measure,
) -> tuple[Row, Job]:
    """Return one run as a row without figures, and as a job.

    `drawn` has script, start and noise seed; `keep` folder and name of the capture's file.
    """
    script, start, seed = drawn
    row = Row(
        policy=subject.name,
        case=case.name,
        number=number,
        seed=seed,
        figures=None,
        script=script,
        capture=keep[1] if keep else "",
    )
    return row, Job(
        policy=Path(subject.path),
        sha256=subject.sha256,
        robot=robot.name,
        sim_params=sim_params,
        ground=ground,
        start=start,
        seed=seed,
        script=script,
        rules=rules,
        mass=mass_of(robot),
        keep=keep[0] / keep[1] if keep else None,
        measure=measure,
    )


def plan_jobs(
    subjects: Sequence[Subject],
    plan: Plan,
    *,
    robot: Robot,
    sim_params: SimParams,
    out: Path,
    ground: Ground | None = None,
    keep: Literal["none", "some", "all"] = "some",
    measure: Callable[..., Any] = measure,
) -> list[tuple[Row, Job]]:
    """Return every run of a plan, with its row except for the figures.

    With `keep="some"` the captures of the first jump with each command and of those at `RATES` are
    kept.
    """
    found = []
    for subject in subjects:
        for case in plan.tried:
            for number in range(plan.jumps if case in plan.cases else plan.rates):
                stem = f"{subject.name}_{case.name}_{number:03d}".replace(" ", "_")
                some = number == 0 or case not in plan.cases
                kept = keep == "all" or (keep == "some" and some)
                found.append(
                    planned_run(
                        subject,
                        case,
                        number,
                        drawn=draw(plan, case, number, robot),
                        robot=robot,
                        sim_params=sim_params,
                        rules=plan.rules,
                        ground=ground,
                        keep=(out, f"{CAPTURES}/{stem}.npz") if kept else None,
                        measure=measure,
                    )
                )
    return found


def run_jobs(
    planned: Sequence[tuple[Row, Job]],
    *,
    kind: Kind,
    subjects: tuple[Subject, ...],
    plan: Plan,
    robot: Robot,
    out: Path,
    about: Mapping[str, Any] | None,
    settings: Mapping[str, Any] | None = None,
    processes: int = 1,
    progress: Callable[[float], None] | None = None,
) -> Results:
    """Run planned jobs, and save and return their results."""
    begun, jobs = time.perf_counter(), [job for _, job in planned]
    done = in_processes(run_job, jobs, processes=processes, progress=progress)
    simulated = sum(job.script.seconds for job in jobs)
    results = Results(
        kind=kind,
        robot=robot.name,
        subjects=subjects,
        cases=plan.tried,
        rows=tuple(
            replace(row, figures=each.figures, began=each.began)
            for (row, _), each in zip(planned, done, strict=True)
        ),
        joint_names=robot.joint_names,
        seed=plan.seed,
        sim_params=dict(about or {}),
        script=plan.script,
        spread_s=plan.spread_s,
        rules=asdict(plan.rules),
        mass=mass_of(robot),
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
    robot: Robot,
    sim_params: SimParams,
    out: Path,
    about: Mapping[str, Any] | None = None,
    ground: Ground | None = None,
    keep_captures: bool = False,
    overwrite: bool = False,
    processes: int = 1,
    progress: Callable[[float], None] | None = None,
) -> Results:
    """Let policies jump on the virtual robot and write the results.

    Args:
        policies: `policy.onnx` of each; scatter is compared with that of the first.
        plan: Commands and draws.
        robot: The robot of the policies.
        sim_params: Of the virtual robot.
        out: Folder for table, summary and captures.
        about: Source of the parameters, kept with the results.
        ground: Under the robot; None for that of the parameters.
        keep_captures: Keep the capture of every jump, not of the first with each command alone.
        overwrite: Replace a trial in `out`.
        processes: Jumps at once; the numbers do not depend on it.
        progress: Called with the share done, 0 to 1.

    Raises:
        PronkError: Of policies, parameters or folder, before the first step.
    """
    subjects = load_subjects(policies, robot)
    planned = plan_jobs(
        subjects,
        plan,
        robot=robot,
        sim_params=sim_params,
        out=out,
        ground=ground,
        keep="all" if keep_captures else "some",
    )
    build(planned[0][1])  # refuses impossible parameters
    prepare(out, overwrite=overwrite)
    return run_jobs(
        planned,
        kind=JUMPS,
        subjects=subjects,
        plan=plan,
        robot=robot,
        out=out,
        about=about,
        processes=processes,
        progress=progress,
    )


def load_subjects(paths: Sequence[Path], robot: Robot, *, jump: bool = True) -> tuple[Subject, ...]:
    """Open, check and name policies.

    A policy is named after the gains of its training; two of a kind, after their files.

    Raises:
        ArtefactError: Missing, damaged, not for the robot, or without the jump input; the sentence
            names file and field.
        PronkError: The same policy twice.
    """
    found = []
    for path in paths:
        policy = load_policy(path)
        try:
            check(policy.contract, robot)
        except ArtefactError as error:
            raise ArtefactError(f"{path}: {error}") from None
        if jump and not policy.contract.jump:
            raise ArtefactError(
                f"{path}: this policy was trained to walk only and has no jump input; "
                "`pronk train jump` adds it."
            )
        found.append((path, policy))
    if len({policy.sha256 for _, policy in found}) != len(found):
        raise PronkError(
            f"{', '.join(map(str, paths))}: the same policy twice; give each policy once."
        )
    names = _names([(path, policy.contract) for path, policy in found])
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
        for name, (path, policy) in zip(names, found, strict=True)
    )


def _names(policies: Sequence[tuple[Path, Contract]]) -> list[str]:
    gains = [contract.gains for _, contract in policies]
    stems = [path.stem for path, _ in policies]
    for names in (gains, stems, [path.parent.name for path, _ in policies]):
        if len(set(names)) == len(names) and all(names):
            return names
    return [f"{name} {i}" for i, name in enumerate(gains, start=1)]


def prepare(out: Path, *, overwrite: bool = False) -> None:
    """Make the folder of a trial, before anything is computed.

    Args:
        out: The folder.
        overwrite: Take a folder that holds a trial, and delete that trial's own files.

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
        # Finds out now, not after an hour, that the folder cannot be written to.
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
