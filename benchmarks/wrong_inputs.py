"""`python -m benchmarks wrong-inputs`: how often wrong recordings are named, right ones flagged.

Logs are sweeps of random virtual robots (chirps of 20 s, 0.25 rad twice and 0.125 rad once, one
joint each, as `pronk sweep` records them). Two kinds of log: `sweep` has all that `pronk sweep`
writes (velocity, torque, frequency, rate of the commands), `bare` only time, command, position and
the drive's gains.

A case counts as named if the check of its corruption flags it, as refused if it is an error, as
other if only other checks flag it, and as silent if none does. Of silent cases the match is run on
the right and on the wrong log; a case whose gains differ by more than the limits below is a wrong
number.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.runner import Progress, finish, in_parallel
from pronk.cli import console
from pronk.deploy.runtime.sweep import SweepTask
from pronk.deploy.runtime.sweep_recorder import record_sweep
from pronk.errors import PronkError
from pronk.identify.excitation.plan import make_plan
from pronk.identify.logs.readers import read_logs
from pronk.identify.match.match import match
from pronk.identify.match.settings import MatchSettings
from pronk.jump.virtual.plant import limb_of
from pronk.jump.virtual.robot import VirtualRobot
from pronk.jump.virtual.sim_params import SimParams, load_sim_params
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec
from pronk.tables import Cell, Column, Table
from tests.corrupted_logs import CORRUPTIONS, REFUSED, Case, judge, without_extra_columns

ROBOT = "mini_cheetah"
RIGHT = "none"
"""Name of the row of logs that nothing was done to."""
KINDS = ("sweep", "bare")
OUTCOMES = ("named", "refused", "other", "silent")
WRONG_STIFFNESS = 0.05
"""Relative change of the matched stiffness that is a wrong number."""
WRONG_DAMPING = 0.1
"""Relative change of the matched damping that is a wrong number."""
WRONG_DELAY_S = 0.002
"""Change of the matched delay that is a wrong number [s]."""


def random_params(robot: RobotSpec, rng: np.random.Generator) -> tuple[str, SimParams]:
    """Draw a joint to excite and the hidden parameters of a virtual robot.

    Ranges: torque constant 0.75 to 1.25 of the drive's, rotor 0.7 to 1.3, belt 0.25 to 2 and dry
    friction 0 to 3 times the shipped one's, delay 0 to 15 ms, encoders of 12 to 16 bits, break-away
    1 to 1.8 times the Coulomb friction, Stribeck speed 0.05 to 0.5 rad/s.
    """
    shipped = load_sim_params()
    excited = str(rng.choice(robot.joint_names))
    joints = {}
    for name, joint in shipped.joints.items():
        # Bristles break away at the same deflection, belts keep their share of critical damping.
        friction_factor = max(rng.uniform(0.0, 3.0), 0.01)
        belt_factor = float(np.exp(rng.uniform(np.log(0.25), np.log(2.0))))
        coulomb = friction_factor * joint.coulomb
        joints[name] = replace(
            joint,
            torque_scale=rng.uniform(0.75, 1.25),
            rotor_inertia=joint.rotor_inertia * rng.uniform(0.7, 1.3),
            belt_stiffness=joint.belt_stiffness * belt_factor,
            belt_damping=joint.belt_damping * np.sqrt(belt_factor),
            coulomb=coulomb,
            breakaway=coulomb * rng.uniform(1.0, 1.8),
            stribeck_speed=float(np.exp(rng.uniform(np.log(0.05), np.log(0.5)))),
            presliding_stiffness=joint.presliding_stiffness * friction_factor,
            presliding_damping=joint.presliding_damping * np.sqrt(friction_factor),
        )
    machine = replace(
        shipped.machine,
        command_delay_s=rng.uniform(0.0, 0.015),
        encoder_bits=int(rng.integers(12, 17)),
    )
    return excited, replace(shipped, joints=joints, machine=machine)


def recorded(robot: RobotSpec, seed: int, number: int, cache: Path) -> Case:
    """Sweep a random virtual robot, or read the sweep if it is in the cache."""
    joint, params = random_params(robot, np.random.default_rng([seed, number]))
    folder = cache / f"{seed}-{number:03d}"
    path = folder / f"{joint}.mcap"
    done = path.with_suffix(".done")
    if not done.exists():
        plan = make_plan(robot, [joint], amplitudes=(0.25, 0.125), repeats=(2, 1))
        task = SweepTask(plan=plan, out_dir=folder, overwrite=True)
        legs = (limb_of(robot, joint),)
        record_sweep(VirtualRobot(robot, params, seed=1000 * seed + number, legs=legs), task)
        done.touch()
    return Case(log=read_logs([path], robot=robot)[0], joint=joint, robot=robot)


def wrong_number(right: Case, corrupted: Case) -> bool:
    """Return whether a corruption moves a matched number by more than the limits."""
    settings = MatchSettings(zero_armature=False, threads=1)
    before = match([right.log], right.robot, settings=settings).gains.joints[right.joint]
    after = match([corrupted.log], corrupted.robot, settings=settings).gains.joints[corrupted.joint]
    return (
        abs(after.stiffness.value / before.stiffness.value - 1.0) > WRONG_STIFFNESS
        or abs(after.damping.value / before.damping.value - 1.0) > WRONG_DAMPING
        or abs(after.delay_s.value - before.delay_s.value) > WRONG_DELAY_S
    )


def judge_corruption(right: Case, name: str, rng: np.random.Generator) -> dict[str, Any]:
    """Judge one corruption of one log; `RIGHT` is no corruption."""
    if name == RIGHT:
        checks, sentences = judge(right)
        outcome = "other" if checks else "silent"
        return {"joint": right.joint, "outcome": outcome, "wrong": False, "sentences": sentences}
    corruption = CORRUPTIONS[name]
    corrupted = corruption.change(right, rng)
    checks, sentences = judge(corrupted)
    if REFUSED in checks:
        outcome = "refused"
    elif corruption.check in checks:
        outcome = "named"
    else:
        outcome = "other" if checks else "silent"
    changed = outcome == "silent" and wrong_number(right, corrupted)
    return {"joint": corrupted.joint, "outcome": outcome, "wrong": changed, "sentences": sentences}


def judge_robot(number: int, *, seed: int, cache: Path) -> list[dict[str, Any]]:
    """Judge every corruption of both kinds of log of one random robot."""
    sweep = recorded(load_robot(ROBOT), seed, number, cache)
    bare = replace(sweep, log=without_extra_columns(sweep.log))
    cases = []
    for index, name in enumerate((RIGHT, *CORRUPTIONS)):
        for kind, right in zip(KINDS, (sweep, bare), strict=True):
            rng = np.random.default_rng([seed, number, index])
            case = judge_corruption(right, name, rng)
            cases.append({"number": number, "corruption": name, "log": kind, **case})
    return cases


def run(
    cases: int, seed: int, cache: Path, progress: Progress, *, jobs: int = 1
) -> list[dict[str, Any]]:
    """Judge the logs of some random robots in `jobs` processes; one row for each case.

    An interrupt ends with the robots that are done.
    """
    if cases < 1:
        raise PronkError(f"{cases} cases; expected 1 or more.")
    rows: list[dict[str, Any]] = []
    try:
        robots = in_parallel(partial(judge_robot, seed=seed, cache=cache), range(cases), jobs)
        for done, robot_cases in enumerate(robots):
            rows.extend(robot_cases)
            progress("judge", (done + 1) / cases)
    except KeyboardInterrupt:
        console.warn("interrupted")
    return rows


def table_rows(cases: Sequence[dict[str, Any]]) -> list[tuple[Cell, ...]]:
    """Count the outcomes of each corruption and kind of log."""
    rows: list[tuple[Cell, ...]] = []
    for name in (RIGHT, *CORRUPTIONS):
        for kind in KINDS:
            of_row = [case for case in cases if (case["corruption"], case["log"]) == (name, kind)]
            outcomes = [case["outcome"] for case in of_row]
            counts = [outcomes.count(outcome) for outcome in OUTCOMES]
            wrong = sum(1 for case in of_row if case["wrong"])
            rows.append((name, kind, *counts, wrong))
    return rows


def wrong_inputs(
    cases: int = 100, seed: int = 0, cache: Path = Path("wrong-inputs-logs"), jobs: int = 1
) -> console.Outcome:
    """How often wrong recordings are named or refused, and right ones flagged.

    Args:
        cases: Random virtual robots for each corruption.
        seed: Of robots, joints and corruptions.
        cache: Folder for the logs, 100 of which take 6 minutes.
        jobs: Processes.
    """
    begin = time.perf_counter()
    with console.progress() as report:
        judged = run(cases, seed, cache, report, jobs=jobs)
    headings = ("corruption", "log", *OUTCOMES, "wrong number, silent")
    note = f"{cases} cases a row, seed {seed}; {time.perf_counter() - begin:.0f} s"
    table = Table(
        title="Wrong inputs",
        columns=tuple(Column(heading=heading) for heading in headings),
        rows=tuple(table_rows(judged)),
        notes=(note,),
    )
    figures = {"schema": "pronk/bench-wrong-inputs/2", "cases": judged}
    return finish(figures, table)
