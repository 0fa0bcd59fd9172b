"""Many jumps of the virtual robot: every policy with every command, each jump from its own start.

    results = run_trial([Path("policy.onnx")], Plan(), setup_of(Path("policy.onnx"), out))

Each jump has a new virtual robot with its own heading, joint offsets and noise, and a jump input
that rises up to `spread_s` later, so that it meets every phase of the gait. All of it is drawn from
seed, command and number of the jump alone. Walks, crossings and varied robots run the same way.

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
from itertools import product
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

import pronk
from pronk.errors import ArtefactError, HardwareError, PronkError
from pronk.files import sha256
from pronk.jump.trial.jumps import JumpRules
from pronk.jump.trial.protocol import PAPER_COMMANDS, RATES, Case
from pronk.jump.trial.results import JUMPS, SUMMARY, TABLE, Kind, Results, Row, Subject, save
from pronk.jump.virtual import capture as captures
from pronk.jump.virtual.ground import Start
from pronk.jump.virtual.robot import VirtualRobot
from pronk.jump.virtual.sim_params import SHIPPED, SHIPPED_ROBOT, SimParams, load_sim_params
from pronk.policy.contract import check
from pronk.policy.rollout import check_standing, ticks
from pronk.policy.runtime import Policy, load_policy
from pronk.policy.script import STILL, Script
from pronk.processes import in_processes
from pronk.robots import load_robot
from pronk.robots.legged import legged
from pronk.robots.robot import RobotSpec

CAPTURES, VIDEOS = "captures", "videos"
"""Folders beside the table."""
OFFSET = 0.05
"""Half-width of the joints' offsets from the default pose at the start [rad]. With drives this soft
it tilts the trunk by 5 degrees, by 13 at most; 0.1 may tip the robot over."""
_OFFSETS = (1.0, 0.5, 0.0)
"""Shares of the drawn joint offsets that are tried until the robot stands."""


@dataclass(frozen=True, kw_only=True)
class Setup:
    """What every kind of trial runs on."""

    robot: RobotSpec
    """Of the policies."""
    sim_params: SimParams
    """Of the virtual robot; its ground is the terrain."""
    out: Path
    about: Mapping[str, Any] = field(default_factory=dict)
    """Source of the parameters, kept with the results."""
    processes: int = 1
    """Runs at once; no number depends on it."""


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

    def __post_init__(self) -> None:
        """Raise `PronkError` for an empty plan or a negative seed."""
        if self.jumps < 1:
            raise PronkError(f"{self.jumps} jumps for each command; expected 1 or more.")
        if self.seed < 0:
            raise PronkError(f"seed {self.seed}; expected 0 or more.")
        names = [case.name for case in self.tried]
        if not names or len(set(names)) != len(names):
            given = ", ".join(names) or "none"
            raise PronkError(f"the commands are {given}; expected one or more, all different.")

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
    later = plan.script.run_s + ticks / robot.policy_rate_hz
    script = replace(plan.script, command=case.command, run_s=later)
    yaw = float(rng.uniform(-math.pi, math.pi))
    offset = rng.uniform(-OFFSET, OFFSET, len(robot.joints))
    start = Start(yaw=yaw, joint_offset=tuple(offset.tolist()))
    return script, start, int(rng.integers(2**31))


# ---- one run ----


@dataclass(frozen=True, kw_only=True)
class Job:
    """One run with all that it depends on, so that every process runs it alike."""

    row: Row
    """The run, without figures."""
    subject: Subject
    setup: Setup
    start: Start
    kind: Kind

    def build(self, share: float = 1.0) -> VirtualRobot:
        """Build the virtual robot, not connected, at a share of the joint offsets."""
        offset = tuple(share * each for each in self.start.joint_offset or ())
        return VirtualRobot(
            self.setup.robot,
            self.setup.sim_params,
            seed=self.row.seed,
            base="ground",
            start=replace(self.start, joint_offset=offset or None),
        )

    def set_down(self) -> VirtualRobot:
        """Return the virtual robot, standing, held by its drives alone.

        A robot that tips over, as a heavier one may, is set down again nearer to the default pose;
        one that does not stand even in it raises a `HardwareError`.
        """
        for share in _OFFSETS:
            machine = self.build(share)
            machine.connect()
            try:
                check_standing(self.setup.robot, machine.latest())
                break
            except HardwareError:
                if share == _OFFSETS[-1]:
                    raise
        return machine

    def policy(self) -> Policy:
        """Return the policy, which each process opens once."""
        return _opened(self.subject.path, self.subject.sha256)


@lru_cache(maxsize=4)
def _opened(path: str, sha256: str) -> Policy:
    policy = load_policy(Path(path))
    if policy.sha256 != sha256:
        raise ArtefactError(f"{path}: was changed while the trial ran; run the trial again.")
    return policy


def run_job(job: Job) -> Row:
    """Run one job and measure it."""
    machine, robot, script = job.set_down(), job.setup.robot, job.row.script
    began = machine.now()
    if not list(ticks(machine, job.policy(), robot, script.commanded, seconds=script.seconds)):
        raise HardwareError("the policy made no step; let it run for one tick or more.")
    recorded = machine.capture()
    figures = job.kind.measure(recorded, script, robot, began=began)
    if job.row.capture:
        captures.save(job.setup.out / job.row.capture, recorded)
    return replace(job.row, figures=figures, began=began)


def _timed(job: Job) -> tuple[Row, float, float]:
    """The run, its wall time and its processor time [s]."""
    begun, begun_cpu = time.perf_counter(), time.process_time()
    return run_job(job), time.perf_counter() - begun, time.process_time() - begun_cpu


# ---- many runs ----


def cores() -> int:
    """Cores that this process may use."""
    some = getattr(os, "sched_getaffinity", None)  # not on every system
    return len(some(0)) if some else os.cpu_count() or 1


def plan_jobs(
    subjects: Sequence[Subject],
    plan: Plan,
    setup: Setup,
    kind: Kind = JUMPS,
    *,
    keep: Callable[[Case, int], bool] = lambda case, number: False,
) -> list[Job]:
    """Return every run of a plan; captures are kept of those that `keep` says."""
    found: list[Job] = []
    for subject, case in product(subjects, plan.tried):
        for number in range(plan.jumps if case in plan.cases else plan.rates):
            script, start, seed = draw(plan, case, number, setup.robot)
            stem = f"{subject.name}_{case.name}_{number:03d}".replace(" ", "_")
            row = Row(
                policy=subject.name,
                case=case.name,
                number=number,
                seed=seed,
                script=script,
                capture=f"{CAPTURES}/{stem}.npz" if keep(case, number) else "",
            )
            found.append(Job(row=row, subject=subject, setup=setup, start=start, kind=kind))
    return found


def run_trial(
    policies: Sequence[Path],
    plan: Plan,
    setup: Setup,
    *,
    kind: Kind = JUMPS,
    varied: Sequence[tuple[str, float, SimParams]] = (),
    settings: Mapping[str, Any] | None = None,
    keep_captures: bool = False,
    overwrite: bool = False,
    progress: Callable[[float], None] | None = None,
) -> Results:
    """Run policies on the virtual robot, measure and save; scatter is compared with the first's.

    Of jumps the captures of the first with each command and of those at `RATES` are kept, with
    `keep_captures` all, and `overwrite` replaces a trial in the folder; other kinds are added to
    it. `varied` has parameter, value and body of every body, if there are more than that of
    `setup`. Impossible policies, parameters and folders are refused before the first step.
    `progress` is called with the share done, 0 to 1.
    """
    robot, jobs = setup.robot, []
    subjects = load_subjects(policies, robot, jump=kind.jump)

    def keep(case: Case, number: int) -> bool:
        some = number == 0 or case not in plan.cases
        return kind is JUMPS and (keep_captures or some)

    for parameter, value, params in varied or [("", math.nan, setup.sim_params)]:
        made = plan_jobs(subjects, plan, replace(setup, sim_params=params), kind, keep=keep)
        made[0].build()  # refuses impossible parameters
        jobs += [replace(j, row=replace(j.row, parameter=parameter, value=value)) for j in made]
    if kind is JUMPS:
        prepare(setup.out, overwrite=overwrite)
    begun = time.perf_counter()
    done = in_processes(_timed, jobs, processes=setup.processes, progress=progress)
    rows, seconds, cpu_s = zip(*done, strict=True)
    simulated = sum(row.script.seconds for row in rows)
    timing = {
        "seconds": time.perf_counter() - begun,
        "simulated_s": simulated,
        "processes": setup.processes,
        "cores": os.cpu_count() or 1,
        "simulated_s_per_s_and_process": simulated / sum(seconds),
        # Does not depend on other work on the machine.
        "simulated_s_per_cpu_s": simulated / sum(cpu_s),
    }
    return finished(
        kind,
        subjects,
        rows,
        setup,
        cases=plan.tried,
        joint_names=robot.joint_names,
        seed=plan.seed,
        script=plan.script,
        spread_s=plan.spread_s,
        rules=asdict(JumpRules.of(robot)),
        mass=legged(robot.source).total_mass,
        settings=dict(settings or {}),
        timing=timing,
    )


def finished(
    kind: Kind, subjects: tuple[Subject, ...], rows: Sequence[Row], setup: Setup, **rest: Any
) -> Results:
    """Save and return the results of runs; `rest` are further fields of `Results`."""
    results = Results(
        kind=kind,
        robot=setup.robot.name,
        subjects=subjects,
        rows=tuple(rows),
        sim_params=setup.about,
        versions=versions(),
        **rest,
    )
    save(setup.out, results)
    return results


def setup_of(
    policy: Path,
    out: Path,
    sim_params: Path | None = None,
    robot: str | None = None,
    *,
    processes: int | None = None,
) -> Setup:
    """Return what a trial of a policy runs on: its robot, on as many processes as there are cores.

    Without a file of parameters they are those that ship with pronk, or derived from the robot.
    """
    known = load_robot(robot or load_policy(policy).contract.robot)
    file = sim_params or (SHIPPED if known.name == SHIPPED_ROBOT else None)
    source = "shipped with pronk" if file else f"derived from the model of {known.name}"
    return Setup(
        robot=known,
        sim_params=load_sim_params(sim_params, known),
        out=out,
        about={"file": str(sim_params or source), "sha256": sha256(file) if file else ""},
        processes=cores() if processes is None else processes,
    )


def load_subjects(
    paths: Sequence[Path], robot: RobotSpec, *, jump: bool = True
) -> tuple[Subject, ...]:
    """Open, check and name policies.

    A policy is named after the gains of its training; two of a kind, after their files. With `jump`
    it needs the jump input. The same policy twice is refused.
    """
    policies = [load_policy(path) for path in paths]
    for path, policy in zip(paths, policies, strict=True):
        try:
            check(policy.contract, robot)
        except ArtefactError as error:
            raise ArtefactError(f"{path}: {error}") from None
        if jump and not policy.contract.jump:
            raise ArtefactError(
                f"{path}: this policy was trained to walk only and has no jump input; "
                "`pronk train jump` adds it."
            )
    if len({policy.sha256 for policy in policies}) != len(policies):
        raise PronkError(
            f"{', '.join(map(str, paths))}: the same policy twice; give each policy once."
        )
    gains = [policy.contract.gains for policy in policies]
    choices = (gains, [path.stem for path in paths], [path.parent.name for path in paths])
    numbered = [f"{name} {i}" for i, name in enumerate(gains, start=1)]
    distinct = (names for names in choices if len(set(names)) == len(names) and all(names))
    names, found = next(distinct, numbered), []
    for name, path, policy in zip(names, paths, policies, strict=True):
        contract = msgspec.to_builtins(policy.contract)
        for unused in ("schema", "observation", "provenance"):
            contract.pop(unused, None)
        found.append(Subject(name=name, path=str(path), sha256=policy.sha256, contract=contract))
    return tuple(found)


def prepare(out: Path, *, overwrite: bool = False) -> None:
    """Make the folder of a trial, before anything is computed.

    With `overwrite` a folder that holds a trial is taken, and that trial's own files are deleted.
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
        films = [f"{VIDEOS}/*.{kind}" for kind in ("mp4", "gif", "png")]
        for pattern in (SUMMARY, TABLE, f"{CAPTURES}/*.npz", *films):
            for path in out.glob(pattern):
                path.unlink()
    except OSError as error:
        raise PronkError(
            f"--out {out}: cannot be written to ({error.strerror}); give another folder."
        ) from None


def versions() -> dict[str, str]:
    """Versions of the software that a trial is computed with."""
    import mujoco
    import onnxruntime
    import scipy

    modules = (pronk, mujoco, np, scipy, onnxruntime)
    found = {module.__name__: str(module.__version__) for module in modules}
    return {"python": platform.python_version()} | found
