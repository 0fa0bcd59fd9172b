"""Many jumps of the virtual robot: every policy with every command, each jump from its own start.

    results = run_trial([Path("policy.onnx")], TrialPlan(), setup_of(Path("policy.onnx"), out))

Each jump has a new virtual robot with its own heading, joint offsets and noise, and a jump input
that rises up to `spread_s` later, so that it meets every phase of the gait. All of it is drawn from
seed, command and number of the jump alone. Walks and crossings run the same way.

    summary.json, trials.csv    what was run, every jump and the sums; a table of the jumps
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
from typing import Any

import msgspec
import numpy as np

from pronk.errors import ArtefactError, HardwareError, PronkError
from pronk.files import sha256
from pronk.jump.trial.jumps import JumpRules
from pronk.jump.trial.protocol import PAPER_COMMANDS, RATES, Case
from pronk.jump.trial.results import (
    JUMPS,
    SUMMARY,
    TABLE,
    RunKind,
    TrialResults,
    TrialRun,
    TriedPolicy,
    save_results,
)
from pronk.jump.virtual import capture as captures
from pronk.jump.virtual.ground import Start
from pronk.jump.virtual.robot import VirtualRobot
from pronk.jump.virtual.sim_params import SimParams, load_sim_params, shipped_file
from pronk.policy.contract import check, policy_robot_name
from pronk.policy.rollout import check_standing, ticks
from pronk.policy.runtime import Policy, load_policy
from pronk.policy.script import STILL, Script
from pronk.processes import FEWER_PROCESSES, in_processes
from pronk.robots import load_robot
from pronk.robots.legged import legged
from pronk.robots.robot import RobotSpec
from pronk.version import VERSION

CAPTURES = "captures"
"""Folder of captures beside the table."""
VIDEOS = "videos"
"""Folder of films beside the table."""
OFFSET = 0.05
"""Half-width of the joints' offsets from the default pose at the start [rad]. With drives this soft
it tilts the trunk by 5 degrees, by 13 at most; 0.1 may tip the robot over."""
_OFFSET_SHARES = (1.0, 0.5, 0.0)
"""Shares of the drawn joint offsets that are tried until the robot stands [1]."""


@dataclass(frozen=True, kw_only=True)
class TrialSetup:
    """What every kind of trial runs on."""

    robot: RobotSpec
    """Robot of the policies."""
    sim_params: SimParams
    """Parameters of the virtual robot; their ground is the terrain."""
    out: Path
    """Folder of the results."""
    about: Mapping[str, Any] = field(default_factory=dict)
    """Source of the parameters, kept with the results."""
    processes: int = 1
    """Number of runs at once; no number depends on it."""


@dataclass(frozen=True, kw_only=True)
class TrialPlan:
    """The commands and draws of a trial."""

    cases: tuple[Case, ...] = PAPER_COMMANDS
    jumps: int = 20
    """Number of jumps with each command."""
    # Paper R7.
    rates: int = 0
    """Number of jumps at `RATES` besides, for the paper's figure of roll and pitch rates."""
    seed: int = 0
    """Seed of all draws."""
    script: Script = field(default_factory=lambda: Script(command=STILL))
    """Times of every run; the command is each case's."""
    spread_s: float = 0.5
    """Time by which the jump input rises later at most, uniformly, in policy steps [s]."""

    def __post_init__(self) -> None:
        """Raise `PronkError` for an empty plan or a negative seed."""
        if self.jumps < 1:
            raise PronkError(f"{self.jumps} jumps for each command; expected 1 or more.")
        if self.seed < 0:
            raise PronkError(f"seed {self.seed}; expected 0 or more.")
        names = [case.name for case in self.tried]
        if not names or len(set(names)) != len(names):
            commands = ", ".join(names) or "none"
            raise PronkError(f"the commands are {commands}; expected one or more, all different.")

    @property
    def tried(self) -> tuple[Case, ...]:
        """All commands."""
        return (*self.cases, RATES) if self.rates else self.cases


def case_rng(seed: int, case: Case, number: int) -> np.random.Generator:
    """Return a generator that depends on seed, command and number of a run alone."""
    digest = hashlib.sha256(np.array(case.command, dtype="<f8").tobytes()).digest()
    return np.random.default_rng([seed, int.from_bytes(digest[:8], "little"), number])


@dataclass(frozen=True, kw_only=True)
class DrawnRun:
    """What is drawn for one run."""

    script: Script
    """Commands over time, with the time of the jump input."""
    start: Start
    """Heading and joint offsets at the start."""
    seed: int
    """Seed of the virtual robot's noise."""


def draw_run(plan: TrialPlan, case: Case, number: int, robot: RobotSpec) -> DrawnRun:
    """Draw the script, the start and the noise seed of one jump, numbered from 0."""
    rng = case_rng(plan.seed, case, number)
    later_ticks = int(rng.integers(round(plan.spread_s * robot.policy_rate_hz) + 1))
    run_s = plan.script.run_s + later_ticks / robot.policy_rate_hz
    yaw = float(rng.uniform(-math.pi, math.pi))
    offset = rng.uniform(-OFFSET, OFFSET, len(robot.joints))
    return DrawnRun(
        script=replace(plan.script, command=case.command, run_s=run_s),
        start=Start(yaw=yaw, joint_offset=tuple(offset.tolist())),
        seed=int(rng.integers(2**31)),
    )


# ---- one run ----


@dataclass(frozen=True, kw_only=True)
class TrialJob:
    """One run with all that it depends on, so that every process runs it alike."""

    row: TrialRun
    """The run, without figures."""
    subject: TriedPolicy
    setup: TrialSetup
    start: Start
    run_kind: RunKind

    @property
    def name(self) -> str:
        """Policy, command and number of the run from 1, in a few words."""
        return f"{self.subject.name}, {self.row.case}, run {self.row.number + 1}"

    def build(self, share: float = 1.0) -> VirtualRobot:
        """Build the virtual robot, not connected, at a share of the joint offsets."""
        joint_offset = None
        if self.start.joint_offset:
            joint_offset = tuple(share * offset for offset in self.start.joint_offset)
        return VirtualRobot(
            self.setup.robot,
            self.setup.sim_params,
            seed=self.row.seed,
            base="ground",
            start=replace(self.start, joint_offset=joint_offset),
        )

    def set_down(self) -> VirtualRobot:
        """Return the virtual robot, standing, with its drives alone holding it.

        A robot that tips over, as a heavier one may, is set down again nearer to the default pose.

        Raises:
            HardwareError: The robot does not stand even in the default pose.
        """
        for share in _OFFSET_SHARES:
            machine = self.build(share)
            machine.connect()
            try:
                check_standing(self.setup.robot, machine.latest())
                break
            except HardwareError:
                if share == _OFFSET_SHARES[-1]:
                    raise
        return machine

    def policy(self) -> Policy:
        """Return the policy, which each process opens once."""
        return _open_policy(self.subject.path, self.subject.sha256)


@lru_cache(maxsize=4)
def _open_policy(path: str, expected_sha256: str) -> Policy:
    policy = load_policy(Path(path))
    if policy.sha256 != expected_sha256:
        raise ArtefactError(f"{path}: was changed while the trial ran; run the trial again.")
    return policy


def run_job(job: TrialJob) -> TrialRun:
    """Run one job and measure it."""
    machine = job.set_down()
    robot = job.setup.robot
    script = job.row.script
    began = machine.now()
    steps = list(ticks(machine, job.policy(), robot, script.commanded, seconds=script.seconds))
    if not steps:
        raise HardwareError("the policy made no step; let it run for one tick or more.")
    capture = machine.capture()
    figures = job.run_kind.measure(capture, script, robot, began=began)
    if job.row.capture:
        captures.save_capture(job.setup.out / job.row.capture, capture)
    return replace(job.row, figures=figures, began=began)


@dataclass(frozen=True, kw_only=True)
class _TimedRun:
    """A run and what it took."""

    row: TrialRun
    wall_s: float
    """Wall time [s]."""
    cpu_s: float
    """Processor time [s]."""


def _run_timed(job: TrialJob) -> _TimedRun:
    begun = time.perf_counter()
    begun_cpu = time.process_time()
    row = run_job(job)
    return _TimedRun(
        row=row, wall_s=time.perf_counter() - begun, cpu_s=time.process_time() - begun_cpu
    )


# ---- many runs ----


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not on every system
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def plan_jobs(
    subjects: Sequence[TriedPolicy],
    plan: TrialPlan,
    setup: TrialSetup,
    run_kind: RunKind = JUMPS,
    *,
    keeps_capture: Callable[[Case, int], bool] = lambda case, number: False,
) -> list[TrialJob]:
    """Return every run of a plan.

    Args:
        subjects: The policies.
        plan: Commands, numbers of runs and seed.
        setup: What the runs are on.
        run_kind: What is measured.
        keeps_capture: Called with command and number of a run; whether its capture is kept.
    """
    jobs = []
    for subject in subjects:
        for case in plan.tried:
            count = plan.jumps if case in plan.cases else plan.rates
            for number in range(count):
                drawn = draw_run(plan, case, number, setup.robot)
                capture = ""
                if keeps_capture(case, number):
                    stem = f"{subject.name}_{case.name}_{number:03d}".replace(" ", "_")
                    capture = f"{CAPTURES}/{stem}.npz"
                row = TrialRun(
                    policy=subject.name,
                    case=case.name,
                    number=number,
                    seed=drawn.seed,
                    script=drawn.script,
                    capture=capture,
                )
                jobs.append(
                    TrialJob(
                        row=row, subject=subject, setup=setup, start=drawn.start, run_kind=run_kind
                    )
                )
    return jobs


def run_trial(
    policies: Sequence[Path],
    plan: TrialPlan,
    setup: TrialSetup,
    *,
    run_kind: RunKind = JUMPS,
    keep_captures: bool = False,
    overwrite: bool = False,
    progress: Callable[[float], None] | None = None,
) -> TrialResults:
    """Run policies on the virtual robot, measure and save.

    Args:
        policies: Files of the policies; scatter is compared with that of the first.
        plan: Commands, numbers of runs and seed.
        setup: What the runs are on.
        run_kind: What is measured. Jumps make a new folder, other kinds are added to it.
        keep_captures: Keep the captures of all jumps, not only of the first with each command and
            of those at `RATES`.
        overwrite: Replace a trial in the folder.
        progress: Called with the share of the runs that are done, 0 to 1.

    Raises:
        PronkError: A policy, parameter or folder is impossible; nothing was run then.
    """
    robot = setup.robot
    subjects = load_subjects(policies, robot, jump=run_kind.jump)

    def keeps_capture(case: Case, number: int) -> bool:
        return run_kind is JUMPS and (keep_captures or number == 0 or case not in plan.cases)

    jobs = plan_jobs(subjects, plan, setup, run_kind, keeps_capture=keeps_capture)
    jobs[0].build()  # refuses impossible parameters
    if run_kind is JUMPS:
        prepare_folder(setup.out, overwrite=overwrite)
    begun = time.perf_counter()
    timed_runs = in_processes(
        _run_timed,
        jobs,
        processes=setup.processes,
        names=[job.name for job in jobs],
        way_out=FEWER_PROCESSES,
        progress=progress,
    )
    seconds = time.perf_counter() - begun
    rows = tuple(run.row for run in timed_runs)
    simulated_s = sum(row.script.seconds for row in rows)
    results = TrialResults(
        run_kind=run_kind,
        rows=rows,
        robot=robot.name,
        subjects=subjects,
        cases=plan.tried,
        joint_names=robot.joint_names,
        seed=plan.seed,
        sim_params=setup.about,
        script=plan.script,
        spread_s=plan.spread_s,
        rules=asdict(JumpRules.of(robot)),
        mass=legged(robot.source).total_mass,
        versions=software_versions(),
        timing={
            "seconds": seconds,
            "simulated_s": simulated_s,
            "processes": setup.processes,
            "cores": os.cpu_count() or 1,
            "simulated_s_per_s_and_process": simulated_s / sum(run.wall_s for run in timed_runs),
            # Does not depend on other work on the machine.
            "simulated_s_per_cpu_s": simulated_s / sum(run.cpu_s for run in timed_runs),
        },
    )
    save_results(setup.out, results)
    return results


def setup_of(
    policy: Path,
    out: Path,
    sim_params: Path | None = None,
    robot: str | None = None,
    *,
    processes: int | None = None,
) -> TrialSetup:
    """Return what a trial of a policy runs on.

    Args:
        policy: File of the policy.
        out: Folder of the results.
        sim_params: File of the virtual robot's parameters. None: those that ship with pronk, or
            derived from the robot.
        robot: Name or path of the robot; that of the policy if None.
        processes: Number of runs at once; as many as there are cores if None.
    """
    spec = load_robot(robot or policy_robot_name(load_policy(policy).contract))
    file = sim_params or shipped_file(spec)
    if sim_params is not None:
        source = str(sim_params)
    elif file is not None:
        source = "shipped with pronk"
    else:
        source = f"derived from the model of {spec.name}"
    return TrialSetup(
        robot=spec,
        sim_params=load_sim_params(sim_params, spec),
        out=out,
        about={"file": source, "sha256": "" if file is None else sha256(file)},
        processes=usable_cores() if processes is None else processes,
    )


def load_subjects(
    paths: Sequence[Path], robot: RobotSpec, *, jump: bool = True
) -> tuple[TriedPolicy, ...]:
    """Open, check and name policies.

    A policy is named after the gains of its training; two of a kind, after their files.

    Args:
        paths: Files of the policies.
        robot: Robot that they must be for.
        jump: Whether they need the jump input.

    Raises:
        ArtefactError: A policy is damaged, or not for this robot.
        PronkError: One policy is there twice.
    """
    policies = []
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
        policies.append(policy)
    if len({policy.sha256 for policy in policies}) != len(policies):
        raise PronkError(
            f"{', '.join(map(str, paths))}: the same policy twice; give each policy once."
        )
    names = _subject_names(paths, [policy.contract.gains for policy in policies])
    subjects = []
    for name, path, policy in zip(names, paths, policies, strict=True):
        contract = msgspec.to_builtins(policy.contract)
        for unused in ("schema", "observation", "provenance"):
            contract.pop(unused, None)
        subjects.append(
            TriedPolicy(name=name, path=str(path), sha256=policy.sha256, contract=contract)
        )
    return tuple(subjects)


def _subject_names(paths: Sequence[Path], gains: Sequence[str]) -> list[str]:
    """Return distinct names: by gains, files or folders, whichever tells the policies apart."""
    for names in (list(gains), [path.stem for path in paths], [path.parent.name for path in paths]):
        if len(set(names)) == len(names) and all(names):
            return names
    return [f"{name} {number}" for number, name in enumerate(gains, start=1)]


def prepare_folder(out: Path, *, overwrite: bool = False) -> None:
    """Make the folder of a trial, before anything is computed.

    Args:
        out: The folder.
        overwrite: Take a folder that holds a trial, and delete that trial's own files.

    Raises:
        PronkError: The folder cannot be taken or written to.
    """
    if out.exists() and not out.is_dir():
        raise PronkError(f"--out {out}: a file; expected the name of a folder.")
    try:
        if out.is_dir() and any(out.iterdir()):
            if not overwrite:
                raise PronkError(
                    f"--out {out}: not empty; give another folder, or --overwrite to replace the "
                    "trial in it."
                )
            # An interrupted trial leaves captures alone.
            if not any((out / name).exists() for name in (SUMMARY, TABLE, CAPTURES)):
                raise PronkError(
                    f"--out {out}: holds no trial to overwrite; give a new or an empty folder."
                )
        out.mkdir(parents=True, exist_ok=True)
        # Fails now, not after an hour, if the folder cannot be written to.
        with tempfile.NamedTemporaryFile(dir=out):
            pass
        patterns = [SUMMARY, TABLE, f"{CAPTURES}/*.npz"]
        for ending in ("mp4", "gif", "png"):
            patterns.append(f"{VIDEOS}/*.{ending}")
        for pattern in patterns:
            for path in out.glob(pattern):
                path.unlink()
    except OSError as error:
        raise PronkError(
            f"--out {out}: cannot be written to ({error.strerror}); give another folder."
        ) from None


def software_versions() -> dict[str, str]:
    """Return the versions of the software that a trial is computed with."""
    import mujoco
    import onnxruntime
    import scipy

    return {
        "python": platform.python_version(),
        "pronk": VERSION,
        "mujoco": mujoco.__version__,
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "onnxruntime": onnxruntime.__version__,
    }
