"""Bodies never seen: other virtual robots, each matched anew by its own sweep, and the same table.

Every body is drawn around given parameters (`other_params.py`), swept by itself,
matched, and tried with the same script as everything else. Its folder holds all of it:

    sim_params.yaml    the body, for a person and for `--sim-params`
    logs/         its sweep
    gains.yaml    its matched gains: `pronk train all --gains` trains a policy of its own with them
    match.npz
    trial/        trials.csv and summary.json: the table

What matched anew changes, and what not. The gains are those of training's simulator; the drives of
a body keep their own, 17 / 0.4, as everywhere. A policy that is tried here was trained with the
gains of the robot it was made for, not with this body's. So the match of a body says how far those
training gains are from it (`Body.errors`: the policies' gains beside the body's own match, on the
body's own sweep), and the table how well the policies jump all the same. To close the circle, train
a policy with the body's `gains.yaml` (a GPU's job) and give it as the body's own: it is tried
beside the others.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from pronk.errors import PronkError
from pronk.evaluation import result
from pronk.evaluation import result_io as sheet
from pronk.evaluation.result import Subject, Trial
from pronk.evaluation.run import Plan, run
from pronk.evaluation.subjects import load_subjects
from pronk.evaluation.unseen.bode import bode_errors, gains_of, overall_rms_db
from pronk.evaluation.unseen.other_params import GROUP_TORQUE, TOLERANCES, draw, save_sim_params
from pronk.evaluation.unseen.own_sweep import GAINS, LOGS, SETTINGS, ask, match_own
from pronk.files import sha256
from pronk.logs.joint_log import SweepLog
from pronk.logs.readers import read_logs
from pronk.match import gains as gains_file
from pronk.match.gains import GroupGains, JointGains, MatchedGains
from pronk.robots.robot import Robot
from pronk.virtual.sim_params import SimParams, load_sim_params

SCHEMA = "pronk/trial-bodies/1"
FILE = "bodies.json"
FOLDER = "bodies"
WRITER = "pronk trial POLICY --bodies"
SIM_PARAMS, TRIAL = "sim_params.yaml", "trial"
NAIVE = "drive's own"
MATCHED = "matched anew"
TRAINABLE = "matched anew, by group"
"""Names of gains beside those of the policies."""


@dataclass(frozen=True, kw_only=True)
class GainsError:
    """One set of gains on one body's sweep."""

    gains: str
    """`training gains of POLICY`, or one of `NAIVE`, `MATCHED`, `TRAINABLE`."""
    rms_db: float
    """Error of the simulated gain, RMS over bands and joints [dB]."""
    joints_db: Mapping[str, float]
    """RMS over the band of each joint [dB]."""
    pairs: Mapping[str, tuple[float, float]]
    """Stiffness [N m/rad] and damping [N m s/rad] of each joint."""


@dataclass(frozen=True, kw_only=True)
class Body:
    """One body, and what was found of it."""

    name: str
    folder: str
    """Beside `bodies.json`."""
    seed: int
    """Of its draw and of its sweep's noise."""
    sha256: str
    """Of its sim_params file."""
    joints: Mapping[str, JointGains]
    """Matched anew."""
    groups: Mapping[str, GroupGains]
    """What training would use."""
    errors: tuple[GainsError, ...]
    trial: Trial


@dataclass(frozen=True, kw_only=True)
class Bodies:
    """All of them."""

    origin: sheet.Origin
    """Its sim_params are drawn around, its policies given to every body."""
    bodies: tuple[Body, ...]
    tolerances: Mapping[str, Any] = field(default_factory=dict)
    """How far they are drawn."""


def add_bodies(
    policies: Sequence[Path],
    plan: Plan | None = None,
    *,
    robot: Robot,
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
    """Draw bodies, match each anew, try policies on each, and write `bodies.json`.

    A body whose folder holds it already, with its gains, is not asked again: so a policy that was
    trained with those gains finds them as they were.

    Args:
        policies: `policy.onnx` of each; all of them are tried on every body.
        plan: What is tried; the paper's script, 20 jumps with each command, if None.
        robot: Which robot they are for.
        sim_params: What is drawn around.
        out: Folder of the trial; the bodies' folders are made in `bodies` in it.
        about: Where the parameters come from, kept with the result.
        count: Bodies.
        own: For each body, in order, policies that were trained with its own gains; they are tried
            on it beside the others.
        repeats: Times that each joint is asked in a sweep.
        seed: The bodies are drawn from `1000 seed + 1` and on.
        processes: How many things at once; the numbers do not depend on it.
        progress: Called with what is done and the share of it.

    Raises:
        PronkError: Of policies, sim_params or plan, before the first step.
    """
    begun, plan = time.perf_counter(), plan or Plan()
    if count < 1 or len(own) > count:
        raise PronkError(
            f"{count} bodies and own policies for {len(own)}; expected 1 or more bodies, and own "
            "policies for no more than those."
        )
    tell = progress or _silent
    subjects = load_subjects(policies, robot)
    given = [[*policies, *(own[i] if i < len(own) else ())] for i in range(count)]
    for paths in given:
        load_subjects(paths, robot)
    drawn = [draw(sim_params, robot, seed=1000 * seed + number) for number in range(1, count + 1)]
    bodies = []
    for i, (body, paths) in enumerate(zip(drawn, given, strict=True)):
        name = f"body {i + 1}"
        folder = out / FOLDER / name.replace(" ", "_")
        matched, logs = _matched(
            robot,
            body,
            folder,
            name=name,
            seed=1000 * seed + i + 1,
            repeats=repeats,
            processes=processes,
            tell=tell,
        )
        tell(f"{name}: jump", 0.0)
        found = run(
            paths,
            plan,
            robot=robot,
            sim_params=body,
            out=folder / TRIAL,
            about={"file": str(folder / SIM_PARAMS), "sha256": sha256(folder / SIM_PARAMS)},
            overwrite=True,
            processes=processes,
            progress=lambda share, name=name: tell(f"{name}: jump", share),  # type: ignore[misc]
        )
        bodies.append(
            Body(
                name=name,
                folder=str(folder.relative_to(out)),
                seed=1000 * seed + i + 1,
                sha256=sha256(folder / SIM_PARAMS),
                joints=matched.joints,
                groups=matched.groups,
                errors=_errors(robot, logs, matched, found.subjects),
                trial=found,
            )
        )
    bodies_found = Bodies(
        origin=replace(
            sheet.origin(robot, subjects, about=about, seed=seed),
            seconds=time.perf_counter() - begun,
        ),
        bodies=tuple(bodies),
        tolerances={"torque_scale of a group": GROUP_TORQUE, **TOLERANCES},
    )
    save(out, bodies_found)
    return bodies_found


def _matched(
    robot: Robot,
    sim_params: SimParams,
    folder: Path,
    *,
    name: str,
    seed: int,
    repeats: int,
    processes: int,
    tell: Callable[[str, float], None],
) -> tuple[MatchedGains, list[SweepLog]]:
    """The gains of a body and its sweep; asked and matched unless its folder has them."""
    if _known(folder, sim_params):
        files = [folder / LOGS / f"{joint}.mcap" for joint in robot.joint_names]
        return gains_file.load(folder / GAINS), read_logs(files, processes=processes, robot=robot)
    (folder / GAINS).unlink(missing_ok=True)
    save_sim_params(folder / SIM_PARAMS, sim_params, says=_says(name, seed))
    logs = ask(
        robot,
        sim_params,
        folder / LOGS,
        seed=seed,
        repeats=repeats,
        processes=processes,
        progress=lambda share: tell(f"{name}: sweep", share),
    )
    tell(f"{name}: match", 0.0)
    match_own(robot, logs, folder)
    tell(f"{name}: match", 1.0)
    # As a later run will find them, to the last digit.
    return gains_file.load(folder / GAINS), logs


def _known(folder: Path, sim_params: SimParams) -> bool:
    """Whether a folder holds this very body with its gains, which are written last."""
    if not (folder / SIM_PARAMS).exists() or not (folder / GAINS).exists():
        return False
    try:
        return load_sim_params(folder / SIM_PARAMS) == sim_params
    except PronkError:
        return False


def _says(name: str, seed: int) -> str:
    return (
        f"What is true of {name}, a virtual robot that nobody has seen.\n"
        f"Drawn by `{WRITER}`, seed {seed}. How far each number may be from that of\n"
        "the body it is drawn around, and why, is in bodies.json.\n"
        "Fields and units: pronk/virtual/sim_params.py and ground.py."
    )


def _errors(
    robot: Robot, logs: Sequence[SweepLog], matched: MatchedGains, subjects: Sequence[Subject]
) -> tuple[GainsError, ...]:
    """How far gains are from a body: those of the policies, of its drives, and its own."""
    groups = matched.groups
    pairs = {f"training gains of {subject.name}": gains_of(subject) for subject in subjects}
    pairs |= {
        NAIVE: {joint.name: (joint.stiffness, joint.damping) for joint in robot.joints},
        MATCHED: {name: (one.stiffness, one.damping) for name, one in matched.joints.items()},
        TRAINABLE: {
            joint.name: (groups[joint.group].stiffness, groups[joint.group].damping)
            for joint in robot.joints
        },
    }
    found = bode_errors(logs, robot, pairs, settings=SETTINGS)
    return tuple(
        GainsError(
            gains=name,
            rms_db=overall_rms_db(errors),
            joints_db={one.joint: one.rms_db for one in errors},
            pairs=pairs[name],
        )
        for name, errors in found.items()
    )


def _silent(stage: str, share: float) -> None:
    """Nobody watches."""


def save(folder: Path, bodies: Bodies) -> Path:
    """Write `bodies.json`; returns its path. Trials and gains are files of their own."""
    return sheet.save(
        folder / FILE,
        SCHEMA,
        bodies.origin,
        {
            "tolerances": bodies.tolerances,
            "bodies": [
                {
                    "name": body.name,
                    "folder": body.folder,
                    "seed": body.seed,
                    "sha256": body.sha256,
                    "errors": body.errors,
                    "groups": body.groups,
                    "cells": body.trial.cells,
                }
                for body in bodies.bodies
            ],
        },
    )


def load(folder: Path) -> Bodies:
    """Read what `save` wrote, and each body's gains and trial.

    Raises:
        ArtefactError: A file is missing, damaged or of another schema.
    """
    with sheet.load(folder / FILE, SCHEMA, writer=WRITER) as (where, told):
        bodies = tuple(_body(folder, entry) for entry in told["bodies"])
        return Bodies(origin=where, bodies=bodies, tolerances=told["tolerances"])


def _body(folder: Path, entry: Mapping[str, Any]) -> Body:
    own = folder / entry["folder"]
    gains = gains_file.load(own / GAINS)
    return Body(
        name=entry["name"],
        folder=entry["folder"],
        seed=entry["seed"],
        sha256=entry["sha256"],
        joints=gains.joints,
        groups=gains.groups,
        errors=tuple(
            replace(
                sheet.entry_of(GainsError, one),
                pairs={name: (pair[0], pair[1]) for name, pair in one["pairs"].items()},
            )
            for one in entry["errors"]
        ),
        trial=result.load(own / TRIAL),
    )
