"""`python -m benchmarks wrong-inputs`: how often wrong inputs are named, and right ones flagged.

Logs are sweeps of random virtual robots (chirps of 20 s, 0.25 rad twice and 0.125 rad once, one
joint each, as `pronk sweep` records them). Every corruption but that of the friction is applied to
the recorded log. Two kinds of log: `sweep` has all that `pronk sweep` writes (velocity, torque,
frequency, rate of the commands), `bare` only time, command, position and the drive's gains.

The delay of a match is that behind the command column: where that column is late by less than the
joint is, the right number is what remains, and nothing in a `bare` log shows it.

A case counts as named if a finding holds the true cause, as refused if reading, estimating or
matching the log raises an error, as unchecked if the match states that the log would not show the
cause; `other` is a finding of other causes alone, `silent` none.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy import signal

from benchmarks.runner import Progress, finish, in_parallel
from pronk.arrays import Array
from pronk.cli import console
from pronk.deploy.runtime.sweep import SweepTask, record
from pronk.errors import PronkError
from pronk.identify.excitation.plan import make_plan
from pronk.identify.logs.checks import check_radians
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.readers import read_logs
from pronk.identify.match.pipeline import match_logs
from pronk.identify.match.plausibility import CAUSES, findings, require_plausible
from pronk.identify.match.settings import MatchSettings
from pronk.jump.virtual.plant import leg_of
from pronk.jump.virtual.robot import VirtualRobot
from pronk.jump.virtual.sim_params import SimParams, load_sim_params
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec

ROBOT = "mini_cheetah"
FRICTION = {"random": 0, "wrong": 1, "right": 2}
"""How dry friction is drawn: 0 to 3 times the shipped parameters', three times or a third of the
model's, or 0.75 to 1.33 times the model's. The numbers go into the seed."""
WRONG_NUMBER = {"stiffness": 0.05, "damping": 0.1}
"""Relative change of a matched gain by the corruption that is a wrong number."""
WRONG_DELAY_S = 0.002
OUTCOMES = ("named", "refused", "unchecked", "other", "silent")


@dataclass(frozen=True, kw_only=True)
class Case:
    """One log of one random virtual robot."""

    log: JointLog
    joint: str
    robot: RobotSpec
    late_s: float = 0.0
    """Delay of its command column."""


def random_params(
    robot: RobotSpec, rng: np.random.Generator, friction: str
) -> tuple[str, SimParams]:
    """Draw a joint to excite and the hidden parameters of a virtual robot.

    Ranges: torque constant 0.75 to 1.25 of the drive's, rotor 0.7 to 1.3 and belt 0.25 to 2 times
    the shipped one's, delay 0 to 15 ms, encoders of 12 to 16 bits, break-away 1 to 1.8 times the
    Coulomb friction, Stribeck speed 0.05 to 0.5 rad/s; friction by `FRICTION`.
    """
    shipped, joints = load_sim_params(), {}
    joint = str(rng.choice(robot.joint_names))
    model = robot.joint(joint).drive.frictionloss
    for name, own in shipped.joints.items():
        if friction == "random":
            coulomb = own.coulomb * max(rng.uniform(0.0, 3.0), 0.01)
        elif friction == "wrong":
            coulomb = model * float(rng.choice([3.0, 1.0 / 3.0]))
        else:
            coulomb = model * rng.uniform(0.75, 1.33)
        # Bristles break away at the same deflection, belts keep their share of critical damping.
        factor, belt = coulomb / own.coulomb, float(np.exp(rng.uniform(*np.log([0.25, 2.0]))))
        joints[name] = replace(
            own,
            torque_scale=rng.uniform(0.75, 1.25),
            rotor_inertia=own.rotor_inertia * rng.uniform(0.7, 1.3),
            belt_stiffness=own.belt_stiffness * belt,
            belt_damping=own.belt_damping * np.sqrt(belt),
            coulomb=coulomb,
            breakaway=coulomb * rng.uniform(1.0, 1.8),
            stribeck_speed=float(np.exp(rng.uniform(*np.log([0.05, 0.5])))),
            presliding_stiffness=own.presliding_stiffness * factor,
            presliding_damping=own.presliding_damping * np.sqrt(factor),
        )
    machine = replace(
        shipped.machine,
        command_delay_s=rng.uniform(0.0, 0.015),
        encoder_bits=int(rng.integers(12, 17)),
    )
    return joint, replace(shipped, joints=joints, machine=machine)


def recorded(robot: RobotSpec, seed: int, number: int, friction: str, cache: Path) -> Case:
    """Sweep a random virtual robot, or read the sweep if it is in the cache."""
    rng = np.random.default_rng([seed, FRICTION[friction], number])
    joint, params = random_params(robot, rng, friction)
    folder = cache / f"{friction}-{seed}-{number:03d}"
    path = folder / f"{joint}.mcap"
    if not path.with_suffix(".done").exists():
        plan = make_plan(robot, [joint], amplitudes=(0.25, 0.125), repeats=(2, 1))
        task = SweepTask(plan=plan, out_dir=folder, overwrite=True)
        limb = leg_of(robot, joint)
        record(VirtualRobot(robot, params, seed=1000 * seed + number, legs=(limb,)), task)
        path.with_suffix(".done").touch()
    return Case(log=read_logs([path], robot=robot)[0], joint=joint, robot=robot)


def bare(log: JointLog) -> JointLog:
    """Time, command, position and the drive's gains alone."""
    return replace(
        log,
        origin=replace(log.origin, metadata={}),
        frequency=None,
        velocity=None,
        torque=None,
    )


def _columns(case: Case, **changes: Callable[[Array], Array]) -> Case:
    """Change whole columns of a log; velocity and torque where there."""
    log = case.log
    changed: dict[str, Any] = {
        name: change(np.asarray(getattr(log, name), dtype=np.float64))
        for name, change in changes.items()
        if getattr(log, name) is not None
    }
    return replace(case, log=replace(log, **changed))


def _also_velocity(rng: np.random.Generator, change: Callable[[Array], Array]) -> dict[str, Any]:
    """A change of the position, in half of the cases of the velocity as well."""
    return {"position": change} | ({"velocity": change} if rng.random() < 0.5 else {})


def _renamed(case: Case, rng: np.random.Generator, pairs: Mapping[str, str]) -> Case:
    """Name another leg, or (half of the cases) take the measured columns of a leg at rest."""
    log = case.log
    if rng.random() < 0.5:
        rest = log.time < log.segments[0].start
        row = np.arange(len(log.time)) % int(rest.sum())
        return _columns(case, **dict.fromkeys(("position", "velocity", "torque"), lambda a: a[row]))

    def other(name: str) -> str:
        leg, _, rest = name.partition("_")
        return f"{pairs[leg]}_{rest}"

    segments = tuple(
        replace(
            one,
            joints=tuple(map(other, one.joints)),
            clamped=tuple(map(other, one.clamped)),
        )
        for one in log.segments
    )
    changed = replace(log, joints=tuple(map(other, log.joints)), segments=segments)
    return replace(case, log=changed, joint=other(case.joint))


def _drive_gains(case: Case, rng: np.random.Generator) -> Case:
    factor, log = float(rng.choice([1.25, 0.8])), case.log
    assert log.stiffness is not None
    assert log.damping is not None
    damping = log.damping * (factor if rng.random() < 0.5 else 1.0)
    return replace(case, log=replace(log, stiffness=log.stiffness * factor, damping=damping))


def _legs(case: Case, rng: np.random.Generator) -> Case:
    return _renamed(case, rng, {"FR": "HR", "HR": "FR", "FL": "HL", "HL": "FL"})


def _sides(case: Case, rng: np.random.Generator) -> Case:
    return _renamed(case, rng, {"FR": "FL", "FL": "FR", "HR": "HL", "HL": "HR"})


def _sign(case: Case, rng: np.random.Generator) -> Case:
    return _columns(case, **_also_velocity(rng, np.negative))


def _degrees(case: Case, rng: np.random.Generator) -> Case:
    which = [("command",), ("position", "velocity"), ("command", "position", "velocity")]
    chosen = which[int(rng.integers(3))]
    return _columns(case, **dict.fromkeys(chosen, lambda a: np.rad2deg(a)))


def _encoder_scale(case: Case, rng: np.random.Generator) -> Case:
    factor = float(rng.choice([1.05, 1.0 / 1.05]))
    return _columns(case, **_also_velocity(rng, lambda a: factor * a))


def _time(case: Case, rng: np.random.Generator) -> Case:
    factor, log = float(rng.choice([1.03, 1.0 / 1.03])), case.log
    segments = tuple(
        replace(one, start=factor * one.start, stop=factor * one.stop) for one in log.segments
    )
    return replace(case, log=replace(log, time=factor * log.time, segments=segments))


def _slow(case: Case, rng: np.random.Generator) -> Case:
    rows, log = slice(int(rng.integers(10)), None, 10), case.log
    names = ("time", "command", "position", "velocity", "torque", "frequency")
    kept: dict[str, Any] = {
        name: getattr(log, name)[rows] for name in names if getattr(log, name) is not None
    }
    return replace(case, log=replace(log, **kept))


def _low_pass(case: Case, rng: np.random.Generator) -> Callable[[Array], Array]:
    """A Butterworth filter of first or second order, 10 to 30 Hz."""
    corner = float(np.exp(rng.uniform(*np.log([10.0, 30.0]))))
    sections = signal.butter(int(rng.integers(1, 3)), corner, fs=case.log.rate_hz, output="sos")

    def change(values: Array) -> Array:
        return np.asarray(values[0] + signal.sosfilt(sections, values - values[0], axis=0))

    return change


def _position_filter(case: Case, rng: np.random.Generator) -> Case:
    return _columns(case, **_also_velocity(rng, _low_pass(case, rng)))


def _command_filter(case: Case, rng: np.random.Generator) -> Case:
    return _columns(case, command=_low_pass(case, rng))


def _command_delay(case: Case, rng: np.random.Generator) -> Case:
    late = round(rng.uniform(0.003, 0.015) * case.log.rate_hz)
    case = replace(case, late_s=late / case.log.rate_hz)
    return _columns(case, command=lambda a: np.concatenate([np.repeat(a[:1], late, 0), a[:-late]]))


def _dead(case: Case, rng: np.random.Generator) -> Case:
    """Let the excited joint's columns stand still, in half of the cases for 3 to 10 s alone."""
    log, column = case.log, case.log.column(case.joint)
    first, last = log.segments[0].start, log.segments[-1].stop
    begin = rng.uniform(first, first + 0.7 * (last - first))
    end = begin + (rng.uniform(3.0, 10.0) if rng.random() < 0.5 else np.inf)
    still = (log.time >= begin) & (log.time < end)

    def freeze(values: Array) -> Array:
        out = values.copy()
        out[still, column] = out[int(np.argmax(still)), column]
        return out

    def stop(values: Array) -> Array:
        out = values.copy()
        out[still, column] = 0.0
        return out

    return _columns(case, position=freeze, velocity=stop)


CORRUPTIONS: Mapping[str, tuple[Callable[[Case, np.random.Generator], Case] | None, set[str]]] = {
    "none": (None, {"friction"}),
    "none, friction right": (None, set()),
    "drive gains": (_drive_gains, {"drive gains"}),
    "legs swapped": (_legs, {"other leg", "dead joint"}),
    "sides swapped": (_sides, {"other leg", "other side", "dead joint"}),
    "sign flipped": (_sign, {"sign"}),
    "degrees": (_degrees, {"degrees"}),
    "encoder scale 1.05": (_encoder_scale, {"encoder scale"}),
    "time x 1.03": (_time, {"time"}),
    "50 Hz": (_slow, {"sample rate"}),
    "position filtered": (_position_filter, {"position filter"}),
    "command filtered": (_command_filter, {"command filter"}),
    "command delayed": (_command_delay, {"command delay"}),
    "friction x 3 or / 3": (None, {"friction"}),
    "joint dead": (_dead, {"dead joint"}),
}
"""What is done to a log, and the causes that name it."""


SETTINGS = MatchSettings(zero_armature=False, threads=1)


def judged(
    case: Case, expected: Collection[str] = ()
) -> tuple[set[str], list[str], tuple[str, ...]]:
    """Causes that a match names, its flags, and what it states that the log would not show.

    {"refused"} and the message for an error. The fit is left out where the log alone names one of
    the `expected` causes.
    """
    try:
        check_radians(case.log, case.joint)
        require_plausible({case.joint: [case.log]}, case.robot)
        flags = [str(one) for one in findings([case.log], case.joint, case.robot)[0]]
        unchecked: tuple[str, ...] = ()
        if not _causes(flags) & set(expected):
            found = match_logs([case.log], case.robot, settings=SETTINGS).joints[case.joint]
            flags, unchecked = list(found.flags), found.unchecked
    except PronkError as error:
        return {"refused"}, [str(error)], ()
    return _causes(flags), flags, unchecked


def _causes(flags: Sequence[str]) -> set[str]:
    return {cause for cause, (words, _) in CAUSES.items() if any(words in one for one in flags)}


def wrong_number(clean: Case, case: Case) -> bool:
    """Whether a corruption moves a matched number by more than `WRONG_NUMBER`, `WRONG_DELAY_S`."""
    before, after = (
        match_logs([one.log], one.robot, settings=SETTINGS).joints[one.joint]
        for one in (clean, case)
    )
    moved = [
        abs(getattr(after, name) / getattr(before, name) - 1.0) > limit
        for name, limit in WRONG_NUMBER.items()
    ]
    delay = max(before.delay_s - case.late_s, 0.0)
    return any(moved) or abs(after.delay_s - delay) > WRONG_DELAY_S


def run(
    cases: int,
    seed: int,
    cache: Path,
    progress: Progress,
    *,
    kinds: Sequence[str] = ("sweep", "bare"),
    corruptions: Sequence[str] = tuple(CORRUPTIONS),
    jobs: int = 1,
) -> list[dict[str, Any]]:
    """Judge `cases` logs of each corruption and kind of log in `jobs` processes; one row for each.

    An interrupt ends with the robots that are done.
    """
    if cases < 1:
        raise PronkError(f"{cases} cases; expected 1 or more.")
    judge = partial(_robot, seed=seed, cache=cache, kinds=kinds, corruptions=corruptions)
    rows: dict[tuple[str, str], list[dict[str, Any]]] = {}
    try:
        for done, found in enumerate(in_parallel(judge, range(cases), jobs)):
            for key, one in found:
                rows.setdefault(key, []).append(one)
            progress("judge", (done + 1) / cases)
    except KeyboardInterrupt:
        console.warn("interrupted")
    return [{"corruption": n, "log": k, "cases": each} for (n, k), each in rows.items()]


def _robot(
    number: int, *, seed: int, cache: Path, kinds: Sequence[str], corruptions: Sequence[str]
) -> list[tuple[tuple[str, str], dict[str, Any]]]:
    """Every corruption of the logs of one number, by corruption and kind of log."""
    robot, rows = load_robot(ROBOT), []
    for friction in FRICTION:
        if names := [n for n in corruptions if _friction_of(n) == friction]:
            sweep = recorded(robot, seed, number, friction, cache)
            for kind in kinds:
                clean = sweep if kind == "sweep" else replace(sweep, log=bare(sweep.log))
                rows += [((name, kind), _judge(clean, name, number, seed)) for name in names]
    return rows


def _friction_of(name: str) -> str:
    """How the friction of the robots of a corruption is drawn."""
    return {"none, friction right": "right", "friction x 3 or / 3": "wrong"}.get(name, "random")


def _judge(clean: Case, name: str, number: int, seed: int) -> dict[str, Any]:
    """Outcome of one corruption of one log."""
    change, expected = CORRUPTIONS[name]
    rng = np.random.default_rng([seed, number, list(CORRUPTIONS).index(name)])
    case = clean if change is None else change(clean, rng)
    causes, words, unchecked = judged(case, expected)
    outcome = "other" if causes else "silent"
    if causes == {"refused"}:
        outcome = "refused"
    elif causes & expected:
        outcome = "named"
    elif _causes(unchecked) & expected:
        outcome = "unchecked"
    wrong = outcome in ("silent", "unchecked") and change is not None and wrong_number(clean, case)
    return {
        "number": number,
        "joint": case.joint,
        "outcome": outcome,
        "wrong": wrong,
        "causes": sorted(causes),
        "flags": words,
    }


def wrong_inputs(
    cases: int = 100, seed: int = 0, cache: Path = Path("wrong-inputs-logs"), jobs: int = 1
) -> console.Outcome:
    """How often wrong inputs are named or refused, and right ones flagged.

    Args:
        cases: Random virtual robots for each corruption.
        seed: Of robots, joints and corruptions.
        cache: Folder for the logs, 100 of which take 6 minutes.
        jobs: Processes.
    """
    begin = time.perf_counter()
    with console.progress() as report:
        rows = run(cases, seed, cache, report, jobs=jobs)
    cells = []
    for row in rows:
        outcomes = [one["outcome"] for one in row["cases"]]
        counts = [outcomes.count(each) for each in OUTCOMES]
        wrong = sum(one["wrong"] for one in row["cases"])
        cells.append((row["corruption"], row["log"], *map(str, (*counts, wrong))))
    columns = ("corruption", "log", *OUTCOMES, "wrong number, silent or unchecked")
    caption = f"{cases} cases a row, seed {seed}; {time.perf_counter() - begin:.0f} s"
    figures = {"schema": "pronk/bench-wrong-inputs/1", "rows": rows}
    return finish(figures, console.table("Wrong inputs", columns, cells, caption))
