"""Randomized robots: other virtual robots, each matched by its own sweep, and the same trial.

Every robot is drawn around given parameters (`pronk.evaluation.variation.draw_robot`), excited by
its own sweep, matched, and tried with the same script. Its folder holds all of it:

    sim_params.yaml    the robot, for `--sim-params`
    logs/              its sweep
    gains.yaml         its matched gains: `pronk train all --gains` trains a policy with them
    match.npz
    trial/             trials.csv and summary.json

The gains are those of the training simulator; the drives keep their own, 17 / 0.4. A policy that is
tried here was trained with the gains of another robot, or with the robot's own `gains.yaml`. The
error of gains on a robot's sweep, by the estimator of the measured response, over the joint's band
(paper F11), contains nothing that was outside the sweep (ground, mass, delay):

    error(f) = 20 log10 |H_simulated(f)| / |H_measured(f)|                [dB]
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from pronk.errors import PronkError
from pronk.evaluation.results import Results, Subject, load_json, save_json
from pronk.evaluation.results import load as load_results
from pronk.evaluation.tables import Sheet, number, sheet
from pronk.evaluation.trial import Plan, load_subjects, run_trial, versions
from pronk.evaluation.variation import GROUP_TORQUE, TOLERANCES, draw_robot, save_sim_params
from pronk.evaluation.virtual_sweep import sweep_virtual
from pronk.excitation.plan import make_plan
from pronk.files import sha256
from pronk.logs.joint_log import JointLog
from pronk.logs.readers import read_logs
from pronk.match import gains as gains_file
from pronk.match import result as result_file
from pronk.match.gains import MatchedGains
from pronk.match.measured_joint import logs_by_joint, measured_joints
from pronk.match.pipeline import match_logs
from pronk.match.settings import MatchSettings
from pronk.match.simulated import SimRequest, responses
from pronk.robots.robot import RobotSpec
from pronk.simulators.mujoco import MujocoSimulator
from pronk.virtual.sim_params import SimParams, load_sim_params

SCHEMA = "pronk/trial-bodies/4"
FILE = "bodies.json"
FOLDER = "bodies"
WRITER = "pronk trial POLICY --bodies"
SIM_PARAMS, LOGS, GAINS, MATCH = "sim_params.yaml", "logs", "gains.yaml", "match.npz"
TRIAL = "trial"
"""Names in a robot's folder."""
NAIVE = "drive's own"
MATCHED = "matched anew"
TRAINABLE = "matched anew, by group"
"""Names of gains beside those of the policies."""
AMPLITUDE = 0.25
"""Of the paper's chirp (F3) [rad]."""
SETTINGS = MatchSettings(method="quick", zero_armature=False)
"""The quick search; it ends within a hundredth of a cell of the whole grid's optimum."""

Pairs = Mapping[str, tuple[float, float]]
"""Stiffness [N m/rad] and damping [N m s/rad] by joint."""


@dataclass(frozen=True, kw_only=True)
class Body:
    """One randomized robot, and its results."""

    name: str
    folder: str
    """Beside `bodies.json`."""
    seed: int
    """Of its draw and of its sweep's noise."""
    sha256: str
    """Of its sim_params file."""
    errors: Mapping[str, float]
    """Of the simulated gain, RMS over bands and joints [dB], by gains: `training gains of POLICY`,
    `NAIVE`, `MATCHED`, `TRAINABLE`."""
    trial: Results


@dataclass(frozen=True, kw_only=True)
class Bodies:
    """All randomized robots."""

    robot: str
    virtual: bool = True
    subjects: tuple[Subject, ...]
    """Tried on every robot."""
    sim_params: Mapping[str, Any]
    """File and hash of the parameters that are drawn around."""
    seed: int
    versions: Mapping[str, str] = field(default_factory=versions)
    seconds: float = 0.0
    """Wall time [s]."""
    bodies: tuple[Body, ...]


def add_bodies(
    policies: Sequence[Path],
    plan: Plan | None = None,
    *,
    robot: RobotSpec,
    sim_params: SimParams,
    out: Path,
    about: Mapping[str, Any] | None = None,
    count: int = 3,
    own: Sequence[Sequence[Path]] = (),
    repeats: int = 3,
    seed: int = 0,
    processes: int = 1,
    progress: Callable[[str, float], None] | None = None,
) -> Bodies:
    """Draw robots, match each, try policies on each, and write `bodies.json`.

    A robot whose folder has its parameters and gains already is not excited again: a policy trained
    with those gains finds them unchanged.

    Args:
        policies: All of them are tried on every robot.
        plan: Of the trials; 20 jumps with each of the paper's commands if None.
        robot: The robot of the policies.
        sim_params: To draw around.
        out: The robots' folders are made in `bodies` in it.
        about: Source of the parameters, kept with the results.
        count: Robots.
        own: For each robot, in order, policies that were trained with its gains.
        repeats: Of the sweep of each joint.
        seed: The robots are drawn from `1000 seed + 1` and on.
        processes: Jobs at once; the numbers do not depend on it.
        progress: Called with the stage and the share of it that is done.

    Raises:
        PronkError: Of policies, parameters or plan, before the first step.
    """
    begun = time.perf_counter()
    if len(own) > count:
        raise PronkError(f"own policies for {len(own)} bodies; there are {count}.")
    report = progress or (lambda stage, share: None)
    subjects = load_subjects(policies, robot)
    given = [[*policies, *(own[i] if i < len(own) else ())] for i in range(count)]
    for paths in given:
        load_subjects(paths, robot)
    seeds = [1000 * seed + number for number in range(1, count + 1)]
    drawn = [draw_robot(sim_params, robot, seed=one) for one in seeds]
    bodies = []
    for i, (params, paths) in enumerate(zip(drawn, given, strict=True)):
        name, folder = f"body {i + 1}", out / FOLDER / f"body_{i + 1}"
        matched, logs = match_body(
            robot,
            params,
            folder,
            seed=seeds[i],
            repeats=repeats,
            processes=processes,
            progress=lambda what, share, name=name: report(f"{name}: {what}", share),  # type: ignore[misc]
        )
        digest = sha256(folder / SIM_PARAMS)
        trial = run_trial(
            paths,
            plan or Plan(),
            robot=robot,
            sim_params=params,
            out=folder / TRIAL,
            about={"file": str(folder / SIM_PARAMS), "sha256": digest},
            overwrite=True,
            processes=processes,
            progress=partial(report, f"{name}: jump"),
        )
        bodies.append(
            Body(
                name=name,
                folder=str(folder.relative_to(out)),
                seed=seeds[i],
                sha256=digest,
                errors=_errors(robot, logs, matched, trial.subjects),
                trial=trial,
            )
        )
    found = Bodies(
        robot=robot.name,
        subjects=subjects,
        sim_params=dict(about or {}),
        seed=seed,
        seconds=time.perf_counter() - begun,
        bodies=tuple(bodies),
    )
    save(out, found)
    return found


# ---- sweep and match ----


def match_body(
    robot: RobotSpec,
    sim_params: SimParams,
    folder: Path,
    *,
    seed: int,
    repeats: int = 3,
    processes: int = 1,
    progress: Callable[[str, float], None] = lambda stage, share: None,
) -> tuple[MatchedGains, list[JointLog]]:
    """Excite all joints of a virtual robot with the paper's chirp, and match them.

    The match reads the logs and nothing else. A folder that has the robot's gains is read. `seed`
    is of all noise; `repeats` of the sweep of each joint; `processes` sweep legs at once.

    Raises:
        PlanError: The sweep could exceed a limit of the robot.
        HardwareError: It did.
    """
    files = [folder / LOGS / f"{joint}.mcap" for joint in robot.joint_names]
    if not _is_matched(folder, sim_params):
        (folder / GAINS).unlink(missing_ok=True)
        says = f"A randomized virtual robot, drawn by `{WRITER}`, seed {seed}."
        save_sim_params(folder / SIM_PARAMS, sim_params, says=says)
        plan = make_plan(robot, amplitudes=(AMPLITUDE,), repeats=repeats)
        plan.check()
        sweep_virtual(
            plan,
            sim_params,
            folder / LOGS,
            seed=seed,
            processes=processes,
            overwrite=True,
            progress=partial(progress, "sweep"),
        )
        progress("match", 0.0)
        logs = read_logs(files, processes=processes, robot=robot)
        found = match_logs(logs, robot, settings=SETTINGS)
        result_file.save(folder / MATCH, found)
        gains_file.save(folder / GAINS, found.gains)
        progress("match", 1.0)
    return gains_file.load(folder / GAINS), read_logs(files, processes=processes, robot=robot)


def _is_matched(folder: Path, sim_params: SimParams) -> bool:
    """Whether a folder has exactly this robot with its gains, which are written last."""
    if not (folder / SIM_PARAMS).exists() or not (folder / GAINS).exists():
        return False
    try:
        return load_sim_params(folder / SIM_PARAMS) == sim_params
    except PronkError:
        return False


# ---- error of gains ----


def gains_errors(
    logs: Sequence[JointLog],
    robot: RobotSpec,
    gains: Mapping[str, Pairs],
    *,
    settings: MatchSettings = SETTINGS,
) -> dict[str, float]:
    """Return the errors of several sets of gains, by name, on one robot's sweep [dB RMS].

    The largest amplitude of each joint is compared; `robot` is that of the training simulator,
    `settings` are those of the match.

    Raises:
        LogError: The logs excite no joint or cannot be used.
        IdentifiabilityError: A joint's band is mostly incoherent.
    """
    goals = [
        max(
            (goal for log in sources for goal in measured_joints(log, joint, robot, settings)),
            key=lambda goal: goal.measured.amplitude,
        )
        for joint, sources in logs_by_joint(logs, robot).items()
    ]
    requests = [SimRequest(goal, *pairs[goal.joint]) for pairs in gains.values() for goal in goals]
    with MujocoSimulator(robot, threads=settings.threads, device=settings.device) as simulator:
        simulated = iter(responses(simulator, requests))
    return {
        name: float(
            np.sqrt(np.mean([np.mean(goal.error_db(next(simulated)) ** 2) for goal in goals]))
        )
        for name in gains
    }


def _errors(
    robot: RobotSpec, logs: Sequence[JointLog], matched: MatchedGains, subjects: Sequence[Subject]
) -> dict[str, float]:
    """The errors of the gains of the policies, of the robot's drives, and of its own match."""
    pairs: dict[str, Pairs] = {}
    for subject in subjects:
        names, *own = (subject.contract[name] for name in ("joint_names", "stiffness", "damping"))
        pairs[f"training gains of {subject.name}"] = dict(
            zip(names, zip(*own, strict=True), strict=True)
        )
    pairs[NAIVE] = {joint.name: (joint.stiffness, joint.damping) for joint in robot.joints}
    pairs[MATCHED] = {name: (one.stiffness, one.damping) for name, one in matched.joints.items()}
    groups = {name: (one.stiffness, one.damping) for name, one in matched.groups.items()}
    pairs[TRAINABLE] = {joint.name: groups[joint.group] for joint in robot.joints}
    return gains_errors(logs, robot, pairs)


# ---- file ----


def save(folder: Path, found: Bodies) -> Path:
    """Write `bodies.json`; returns its path. Trials and gains are files of their own."""
    entries = [
        {name: value for name, value in vars(body).items() if name != "trial"}
        | {"cells": body.trial.cells}
        for body in found.bodies
    ]
    tolerances = {"torque_scale of a group": GROUP_TORQUE, **TOLERANCES}
    body = {**vars(found), "tolerances": tolerances, "bodies": entries}
    return save_json(folder / FILE, SCHEMA, body)


def load(folder: Path) -> Bodies:
    """Read what `save` wrote, and each robot's trial.

    Raises:
        ArtefactError: A file is missing, damaged or of another schema.
    """
    with load_json(folder / FILE, SCHEMA, WRITER) as stored:
        for body in stored["bodies"]:
            body["trial"] = load_results(folder / body["folder"] / TRIAL)
        return msgspec.convert(stored, Bodies)


def table(found: Bodies) -> Sheet:
    """Every robot: the error of gains on it, and the jumps."""
    rows = []
    for body in found.bodies:
        for name in (subject.name for subject in body.trial.subjects):
            cells = [cell for cell in body.trial.cells if cell.policy == name]
            best = max((c.figures["height"].mean for c in cells if c.found), default=math.nan)
            trained = body.errors[f"training gains of {name}"]
            rows.append(
                {
                    "body: policy": f"{body.name}: {name}",
                    "error of its match [dB]": number(body.errors[MATCHED]),
                    "error of the policy's training gains [dB]": number(trained),
                    "landed": f"{sum(c.succeeded for c in cells)}/{sum(c.n for c in cells)}",
                    "best mean height [m]": number(best),
                }
            )
    return sheet(
        "Randomized virtual robots, each matched by its own sweep",
        rows,
        "The policies were trained with the gains of another robot; the drives of all robots have "
        "their own gains, 17 / 0.4.",
    )
