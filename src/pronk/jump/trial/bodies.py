"""Randomized robots: other virtual robots, each matched by its own sweep, and the same trial.

Every robot is drawn around given parameters within `TOLERANCES`, excited by its own sweep, matched,
and tried with the same script. Its folder holds all of it:

    sim_params.yaml    the robot, for `--sim-params`
    logs/              its sweep
    gains.yaml         its matched gains: `pronk train all --gains` trains a policy with them
    match.npz
    trial/             trials.csv and summary.json

The error of gains on a robot, over each joint's band (paper F11), contains nothing that was outside
the sweep (ground, mass, delay):

    error(f) = 20 log10 |H_simulated(f)| / |H_measured(f)|                [dB]
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import yaml

from pronk.deploy.bench.virtual_sweep import sweep_virtual
from pronk.errors import PronkError
from pronk.files import sha256, write_text
from pronk.identify.excitation.plan import make_plan
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.readers import read_logs
from pronk.identify.match import gains as gains_file
from pronk.identify.match import result as result_file
from pronk.identify.match.gains import MatchedGains
from pronk.identify.match.measured_joint import logs_by_joint, measured_joints
from pronk.identify.match.pipeline import match_logs
from pronk.identify.match.settings import MatchSettings
from pronk.identify.match.simulated import SimRequest, responses
from pronk.identify.simulators.mujoco import MujocoSimulator
from pronk.jump.trial import tables
from pronk.jump.trial.results import Results, Subject, load_json, save_json
from pronk.jump.trial.results import load as load_results
from pronk.jump.trial.tables import Sheet, landed
from pronk.jump.trial.trial import Plan, Setup, load_subjects, run_trial, versions
from pronk.jump.virtual.sim_params import SCHEMA as PARAMS_SCHEMA
from pronk.jump.virtual.sim_params import JointParams, SimParams, load_sim_params
from pronk.names import file_name
from pronk.robots.robot import RobotSpec

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
COUNT = 3
"""Of robots."""
AMPLITUDE = 0.25
"""Of the paper's chirp (F3) [rad]."""
REPEATS = 3
"""Of each joint's sweep."""
SETTINGS = MatchSettings(method="paper", zero_armature=False)
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
    plan: Plan,
    setup: Setup,
    *,
    own: Sequence[Path] = (),
    stages: Callable[[str, float], None],
) -> Bodies:
    """Draw robots, match each, try policies on each, and write `bodies.json`.

    A robot whose folder has its parameters and gains already is not excited again: a policy trained
    with those gains finds them unchanged. Robots are drawn from `1000 seed + 1` and on around the
    parameters of `setup`; `own` has for each, in order, a policy that was trained with its gains.
    `stages` is called with a stage and its share done.
    """
    begun, robot, bodies = time.perf_counter(), setup.robot, []
    if len(own) > COUNT:
        raise PronkError(f"own policies for {len(own)} bodies; there are {COUNT}.")
    subjects = load_subjects(policies, robot)
    given = [[*policies, *own[i : i + 1]] for i in range(COUNT)]
    for paths in given:
        load_subjects(paths, robot)
    for number, paths in enumerate(given, start=1):
        name, folder = f"body {number}", f"{FOLDER}/body_{number}"
        seed, place = 1000 * plan.seed + number, setup.out / folder
        params = draw_robot(setup.sim_params, robot, seed=seed)
        changed = replace(setup, sim_params=params, out=place / TRIAL)
        matched, logs = match_body(changed, place, name=name, seed=seed, stages=stages)
        about = {"file": str(place / SIM_PARAMS), "sha256": sha256(place / SIM_PARAMS)}
        how: Any = {"overwrite": True, "progress": partial(stages, f"{name}: jump")}
        trial = run_trial(paths, plan, replace(changed, about=about), **how)
        errors = _errors(robot, logs, matched, trial.subjects)
        head: Any = {"name": name, "folder": folder, "seed": seed, "sha256": about["sha256"]}
        bodies.append(Body(**head, errors=errors, trial=trial))
    found = Bodies(
        robot=robot.name,
        subjects=subjects,
        sim_params=setup.about,
        seed=plan.seed,
        seconds=time.perf_counter() - begun,
        bodies=tuple(bodies),
    )
    save(setup.out, found)
    return found


# ---- draws ----


@dataclass(frozen=True)
class Tolerance:
    """How far a number is drawn from the one it is drawn around, uniformly."""

    kind: Literal["relative", "about"]
    """`relative`: a share of the number; `about`: about `centre`, whatever the number was."""
    centre: float
    half: float
    """Half-width of the draw."""
    why: str


_relative = partial(Tolerance, "relative", 0.0)
_about = partial(Tolerance, "about")
GROUP_TORQUE = 0.06
"""Relative half-width of a factor on `torque_scale` that the joints of one group share: motors of
one batch have one magnet material and one winding."""

TOLERANCES: Mapping[str, Mapping[str, Tolerance]] = {
    "joints": {
        "torque_scale": _relative(0.03, "beside the batch: motor to motor, current sensor"),
        "link_inertia_scale": _relative(0.03, "castings, screws, cables"),
        "rotor_inertia": _relative(0.05, "makers give +-5 to 10 %"),
        "belt_stiffness": _relative(0.2, "belt tension, gear preload"),
        "belt_damping": _relative(0.3, "the same"),
        "coulomb": _relative(0.3, "preload of gears and seals, grease"),
        "breakaway": _relative(0.3, "moves with coulomb"),
        "stribeck_speed": _relative(0.3, "grease"),
        "presliding_stiffness": _relative(0.2, "grease, preload"),
        "presliding_damping": _relative(0.2, "the same"),
        "viscous": _relative(0.3, "grease and its temperature"),
        "encoder_offset": _about(0.0, 0.004, "zeroed by hand against a stop [rad]"),
    },
    "machine": {
        "command_delay_s": _about(0.003, 0.002, "half to two and a half 500 Hz cycles [s]"),
        "measurement_delay_s": _about(0.00125, 0.00075, "up to a 500 Hz cycle [s]"),
        "drive_lag_s": _about(0.0005, 0.0002, "filter of the speed, current loop [s]"),
        "bus_voltage": _about(24.1, 1.1, "a 6S battery from nearly flat to full [V]"),
        "bus_resistance": _relative(0.5, "age and cold of the cells"),
        "gyro_bias": _about(0.0, 0.006, "after some minutes of warming up [rad/s]"),
        "accelerometer_bias": _about(0.0, 0.08, "8 mg, a MEMS unit's data sheet [m/s^2]"),
    },
    "trunk": {
        "mass_offset": _about(0.3, 0.6, "another battery, a payload [kg]; training drew -0.4..1.6"),
        "com_offset": _about(0.0, 0.008, "where battery and computer sit [m]"),
        "inertia_scale": _relative(0.02, "castings, screws, cables"),
    },
    "attitude": {
        "bias": _about(0.0, 0.012, "IMU mounted askew by 0.7 degrees [rad]"),
        "yaw_drift": _about(0.0, 0.004, "gyro bias that is left [rad/s]"),
    },
    "ground": {
        "friction": _about(0.8, 0.2, "rubber on vinyl to rubber on concrete [1]"),
        "stiffness": _relative(0.4, "shore hardness of the feet, mats"),
        "damping": _relative(0.4, "the same"),
    },
}
"""By part of the parameters and name of the number."""


def draw_robot(sim_params: SimParams, robot: RobotSpec, *, seed: int) -> SimParams:
    """Draw a random robot: every number of `TOLERANCES` anew about given parameters."""
    sim_params.check_joints(robot.joint_names)
    rng = np.random.default_rng([seed, 0x707])
    batch = {group: 1.0 + GROUP_TORQUE * rng.uniform(-1.0, 1.0) for group in robot.groups}
    joints: dict[str, JointParams] = {}
    for joint in robot.joints:
        own = sim_params.joints[joint.name]
        drawn = _drawn(own, "joints", rng)
        drawn["torque_scale"] = _rounded(drawn["torque_scale"] * batch[joint.group])
        # Break-away is friction's peak: it moves with the friction, and is never below it.
        ratio = own.breakaway / own.coulomb if own.coulomb else 1.0
        drawn["breakaway"] = max(_rounded(drawn["coulomb"] * ratio), drawn["coulomb"])
        joints[joint.name] = replace(own, **drawn)
    parts: dict[str, Any] = {"joints": joints}
    for name in ("machine", "trunk", "attitude", "ground"):
        part = getattr(sim_params, name)
        parts[name] = replace(part, **_drawn(part, name, rng))
    return replace(sim_params, **parts)


def _drawn(part: object, name: str, rng: np.random.Generator) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for field_, tolerance in TOLERANCES[name].items():
        value = getattr(part, field_)
        spread = tolerance.half * rng.uniform(-1.0, 1.0, np.shape(value))
        centre = np.asarray(tolerance.centre if tolerance.kind == "about" else value)
        new = centre * (1.0 + spread) if tolerance.kind == "relative" else centre + spread
        values[field_] = tuple(map(_rounded, new)) if np.ndim(new) else _rounded(float(new))
    return values


def _rounded(value: float) -> float:
    """Five digits, so that a written file holds the number exactly."""
    return float(f"{value:.5g}")


def save_sim_params(path: Path, sim_params: SimParams, *, says: str) -> None:
    """Write parameters as YAML for `--sim-params`, whole, under a comment; terrain is refused."""
    if sim_params.ground != replace(sim_params.ground, terrain=(), floor=0.0):
        raise PronkError(f"{path}: a sim_params file holds no terrain; take the blocks away first.")
    body = msgspec.to_builtins(sim_params)
    for name in ("terrain", "floor"):
        del body["ground"][name]
    joints = body.pop("joints")
    whole = {"schema": PARAMS_SCHEMA, **body, "joints": joints}
    text = yaml.safe_dump(whole, default_flow_style=None, sort_keys=False, width=100)
    head = "".join(f"# {line}".rstrip() + "\n" for line in says.splitlines())
    write_text(path, f"{head}\n{text}")


# ---- sweep and match ----


def match_body(
    setup: Setup, folder: Path, *, name: str, seed: int, stages: Callable[[str, float], None]
) -> tuple[MatchedGains, list[JointLog]]:
    """Excite all joints of a virtual robot with the paper's chirp, and match them.

    The match reads the logs and nothing else. A folder that has the robot's gains is read. `seed`
    is of all noise; `stages` are named after `name`.
    """
    robot, processes = setup.robot, setup.processes
    files = [folder / LOGS / f"{file_name(joint)}.mcap" for joint in robot.joint_names]
    same = False
    if (folder / GAINS).exists():  # written last
        with suppress(PronkError):
            same = load_sim_params(folder / SIM_PARAMS) == setup.sim_params
    if not same:
        (folder / GAINS).unlink(missing_ok=True)
        says = f"A randomized virtual robot, drawn by `{WRITER}`, seed {seed}."
        save_sim_params(folder / SIM_PARAMS, setup.sim_params, says=says)
        plan = make_plan(robot, amplitudes=(AMPLITUDE,), repeats=REPEATS)
        plan.check()
        how: Any = {"processes": processes, "progress": partial(stages, f"{name}: sweep")}
        sweep_virtual(plan, setup.sim_params, folder / LOGS, seed=seed, overwrite=True, **how)
        stages(f"{name}: match", 0.0)
        logs = read_logs(files, processes=processes, robot=robot)
        found = match_logs(logs, robot, settings=SETTINGS)
        result_file.save(folder / MATCH, found)
        gains_file.save_gains(folder / GAINS, found.gains)
        stages(f"{name}: match", 1.0)
    return gains_file.load_gains(folder / GAINS), read_logs(files, processes=processes, robot=robot)


# ---- error of gains ----


def gains_errors(
    logs: Sequence[JointLog],
    robot: RobotSpec,
    gains: Mapping[str, Pairs],
    *,
    settings: MatchSettings = SETTINGS,
) -> dict[str, float]:
    """Return the errors of several sets of gains, by name, on one robot's sweep [dB RMS].

    The largest amplitude of each joint is compared; `settings` are those of the match.
    """
    goals = [
        max(
            (goal for log in sources for goal in measured_joints(log, joint, robot, settings)),
            key=lambda goal: goal.measured.amplitude,
        )
        for joint, sources in logs_by_joint(logs, robot).items()
    ]
    requests = [SimRequest(goal, *pairs[goal.joint]) for pairs in gains.values() for goal in goals]
    with MujocoSimulator(robot, threads=settings.threads) as simulator:
        simulated = iter(responses(simulator, requests))
    squares = {
        name: [np.mean(goal.error_db(next(simulated)) ** 2) for goal in goals] for name in gains
    }
    return {name: float(np.sqrt(np.mean(each))) for name, each in squares.items()}


def _errors(
    robot: RobotSpec, logs: Sequence[JointLog], matched: MatchedGains, subjects: Sequence[Subject]
) -> dict[str, float]:
    """The errors of the gains of the policies, of the robot's drives, and of its own match."""
    pairs: dict[str, Pairs] = {}
    for subject in subjects:
        names, *own = (subject.contract[name] for name in ("joint_names", "stiffness", "damping"))
        both = zip(*own, strict=True)
        pairs[f"training gains of {subject.name}"] = dict(zip(names, both, strict=True))
    pairs[NAIVE] = {joint.name: (joint.stiffness, joint.damping) for joint in robot.joints}
    pairs[MATCHED] = {
        name: (joint.stiffness.value, joint.damping.value) for name, joint in matched.joints.items()
    }
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
    """Read what `save` wrote, and each robot's trial."""
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
            errors = (body.errors[MATCHED], body.errors[f"training gains of {name}"])
            rows.append((f"{body.name}: {name}", *errors, landed(cells), best))
    return tables.table(
        "body: policy | error of its match [dB] | error of the policy's training gains [dB]"
        " | landed | best mean height [m]",
        rows,
        "The policies were trained with the gains of another robot; the drives of all robots have "
        "their own gains, 17 / 0.4.",
        title="Randomized virtual robots, each matched by its own sweep",
    )
