"""Evaluate a policy in the training simulator: every command at once, many robots each.

    plan = Plan(robot=robot, robots=1000)
    env = ManagerBasedRlEnv(evaluation_cfg(env_cfg(gains=gains), plan), device="cuda:0")
    evaluation = evaluate_policy(policy, env, plan, estimate=actor.estimate)
    save(Path("evaluation.json"), evaluation)

Walking robots have one velocity from the first sample on. Jumping robots do what the paper's robot
did (E1): stand, accelerate, jump while running, run on for a moment, stop. The jump input rises at
each robot's own time, so that it meets every phase of the gait. `run` records the robots,
`pronk.evaluation.jumps` and `walk` measure them; `pronk.evaluation.criteria` has the acceptance
criteria; `adapter` has all that is of `pronk.train`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pronk.arrays import Array
from pronk.errors import ArtefactError, PronkError
from pronk.evaluation.criteria import evaluation_checks
from pronk.evaluation.jumps import JumpRules, fallen_at, measure, sample_at, uncommanded_height
from pronk.evaluation.protocol import PAPER_COMMANDS, Case
from pronk.evaluation.results import Spread, load_json, save_json
from pronk.evaluation.tables import Sheet, check_sheet, number, percent, spread, table
from pronk.evaluation.walk import measure_walk, walk_script
from pronk.robots.robot import RobotSpec
from pronk.runtime.script import STILL, Script
from pronk.virtual.capture import Capture

if TYPE_CHECKING:
    from pronk.evaluation.training_sim.run import Estimate, Policy

SCHEMA = "pronk/evaluation/3"
Samples = NDArray[np.int64]

NEVER = 2**30
"""A sample that does not come."""
WALKS = (
    Case(name="forward 2", command=(2.0, 0.0, 0.0)),
    Case(name="back 2", command=(-2.0, 0.0, 0.0)),
    Case(name="left 1", command=(0.0, 1.0, 0.0)),
    Case(name="right 1", command=(0.0, -1.0, 0.0)),
    Case(name="forward 3", command=(3.0, 0.0, 0.0)),
    Case(name="back 3", command=(-3.0, 0.0, 0.0)),
    Case(name="yaw 2", command=(0.0, 0.0, 2.0)),
    Case(name="yaw -2", command=(0.0, 0.0, -2.0)),
    Case(name="stand", command=(0.0, 0.0, 0.0)),
)
"""Velocities to keep."""
JUMPS = PAPER_COMMANDS


@dataclass(frozen=True, kw_only=True)
class Plan:
    """The commands of an evaluation, and their times."""

    robot: RobotSpec
    robots: int = 1000
    """For each command."""
    seed: int = 0
    """Of noise, pushes, starts and the times of the jumps."""
    walks: tuple[Case, ...] = WALKS
    jumps: tuple[Case, ...] = JUMPS
    walk_s: float = 20.0
    """Length of a walk [s]."""
    settle_s: float = 2.0
    """Time to accelerate, left out of the errors [s]."""
    script: Script = field(default_factory=lambda: Script(command=STILL))
    """Times of a jump; the command is each case's."""
    spread_s: float = 0.5
    """The jump input rises up to this much later, uniformly [s]."""
    rules: JumpRules | None = None
    """Those of the robot if None."""

    def __post_init__(self) -> None:
        """Raise `PronkError` for an empty plan."""
        if self.robots < 1:
            raise PronkError(f"{self.robots} robots for each command; expected 1 or more.")

    @property
    def jump_rules(self) -> JumpRules:
        """The definitions of a jump."""
        return self.rules or JumpRules.of(self.robot)

    @property
    def size(self) -> int:
        """Robots in all: first those of each walk, then those of each jump."""
        return self.robots * (len(self.walks) + len(self.jumps))

    @property
    def walkers(self) -> int:
        """Robots that walk."""
        return self.robots * len(self.walks)

    @property
    def jump_seconds(self) -> float:
        """Time until the latest jump is measured [s]; a flight takes less than 1 s."""
        after = self.jump_rules.search_s + 1.0 + self.jump_rules.upright_s
        return self.script.on + self.spread_s + after if self.jumps else 0.0

    @property
    def seconds(self) -> float:
        """Simulated time [s]."""
        return max(self.walk_s if self.walks else 0.0, self.jump_seconds)

    def commands(self) -> Array:
        """The velocity command of each robot. (N, 3)."""
        commands = [case.command for case in (*self.walks, *self.jumps)]
        return np.repeat(np.array(commands, dtype=float), self.robots, axis=0)

    def times(self, dt: float) -> dict[str, Samples]:
        """Return `start` and `stop` of the velocity command, `on` and `off` of the jump input.

        For each robot, in samples of `dt`, (N,); `NEVER` for what does not happen.
        """
        jumping = np.arange(self.size) >= self.walkers
        draws = np.random.default_rng(self.seed).random(self.size - self.walkers)
        on = np.full(self.size, NEVER)
        on[jumping] = np.rint((self.script.on + self.spread_s * draws) / dt)
        off = np.where(jumping, on + round(self.script.jump_s / dt), NEVER)
        return {
            "start": np.where(jumping, round(self.script.start / dt), 0),
            "stop": np.where(jumping, off + round(self.script.keep_s / dt), NEVER),
            "on": on,
            "off": off,
        }


@dataclass(frozen=True, kw_only=True)
class CommandResult:
    """All robots of one command."""

    name: str
    command: tuple[float, float, float]
    figures: Mapping[str, Spread]
    """Over the robots that have it; the mean of a flag is its share.

    Numbers of `pronk.evaluation.jumps` and `walk`; `drift` from the end of settling to the end [m];
    `uncommanded`: the highest flight without a jump input, over standing height [m]. Flags: `fell`,
    `non_finite` (its physics diverged); of jumps `standing` (had not fallen when the jump input
    came), `found` (jumped), `upright` (and were so 2 s after touchdown), `non_foot_contact` (from
    the jump input to then), and of those standing `single` (made exactly one high flight)."""

    def __getitem__(self, name: str) -> Spread:
        """Return a figure; without values if no robot has it."""
        return self.figures.get(name, Spread())


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """The whole evaluation, and what it rests on."""

    walks: tuple[CommandResult, ...]
    jumps: tuple[CommandResult, ...]
    estimator: Mapping[str, float]
    """Over all walks, standing included: root mean square error of the velocity [m/s] by axis
    (`forward`, `left`, `up`) and of the vector (`velocity`), and the share of feet and policy steps
    at which the contact estimate is right (`contacts_right`). Empty without estimator or walks."""
    plan: Mapping[str, Any]
    """Fields of the plan."""
    seconds: float
    """Wall time [s]."""
    about: Mapping[str, Any] = field(default_factory=dict)
    """The policy, gains, randomization, device and versions."""
    before: Mapping[str, float] = field(default_factory=dict)
    """Speed errors of the policy before the jump phases, by walk [m/s]; empty if not compared."""

    def speed_errors(self) -> dict[str, float]:
        """Mean speed error by walk [m/s]."""
        return {walk.name: walk["speed_error"].mean for walk in self.walks}


def evaluate_policy(
    policy: Policy,
    env: Any,
    plan: Plan,
    *,
    estimate: Estimate | None = None,
    progress: Callable[[float], None] = lambda share: None,
    about: Mapping[str, Any] | None = None,
    before: Mapping[str, float] | None = None,
) -> Evaluation:
    """Run the whole plan in one batch and measure every robot.

    `env` was built with `evaluation_cfg` for the same plan, wrapped or not. It is reset, and the
    random generators of the process are seeded with the plan's seed. `estimate` is the policy's
    estimator, if it is evaluated too; `about` and `before` are as of `Evaluation`.
    """
    from pronk.evaluation.training_sim.run import Run

    began = time.perf_counter()
    run = Run(env.unwrapped, plan)
    run.go(policy, estimate, progress)
    facts = [part.cpu().numpy() for part in (run.fell_at, run.on, run.diverged)]
    results = []
    for i, case in enumerate((*plan.walks, *plan.jumps)):
        own = (part[i * plan.robots : (i + 1) * plan.robots] for part in facts)
        robots = []
        for capture, fell, on, diverged in zip(run.captures(i), *own, strict=True):
            if i < len(plan.walks):
                figures = _walk(capture, case, plan)
            else:
                figures = _jump(capture, case, plan, on=float(on) * run.dt)
            robots.append(figures | {"fell": fell < NEVER, "non_finite": diverged})
        spreads = {name: Spread.of([each[name] for each in robots]) for name in robots[0]}
        results.append(CommandResult(name=case.name, command=case.command, figures=spreads))
    return Evaluation(
        walks=tuple(results[: len(plan.walks)]),
        jumps=tuple(results[len(plan.walks) :]),
        estimator=run.estimator_errors(),
        plan=vars(plan) | {"robot": plan.robot.name, "rules": plan.jump_rules},
        seconds=time.perf_counter() - began,
        about=dict(about or {}),
        before=dict(before or {}),
    )


def _walk(capture: Capture, case: Case, plan: Plan) -> dict[str, float]:
    """The figures of a robot that walks."""
    script, rules = walk_script(case.command, seconds=plan.walk_s), plan.jump_rules
    script = replace(script, stand_s=0.0)
    how: Any = {"began": 0.0, "rules": rules, "settle_s": plan.settle_s}
    found = measure_walk(capture, script, plan.robot, **how)
    first, last = round(plan.settle_s / capture.dt), fallen_at(capture) - 1
    x, y, _ = capture.position[last] - capture.position[min(first, last)]
    return vars(found) | {
        "uncommanded": found.uncommanded - rules.standing_height,
        "drift": math.hypot(x, y) if first <= last else math.nan,
    }


def _jump(capture: Capture, case: Case, plan: Plan, *, on: float) -> dict[str, float]:
    """The figures of a robot that jumps; its jump input rises at `on` [s]."""
    rules, run_s = plan.jump_rules, on - plan.script.start
    script = replace(plan.script, command=case.command, run_s=run_s)
    found = measure(capture, script, plan.robot, began=0.0, rules=rules)
    rise = sample_at(capture, on) if found.standing else None
    figures = {name: value for name, value in vars(found).items() if not isinstance(value, tuple)}
    return figures | {
        "uncommanded": uncommanded_height(capture, rise, rules) - rules.standing_height,
        "single": float(found.high_flights == 1.0) if found.standing else math.nan,
    }


def save(path: Path, evaluation: Evaluation) -> None:
    """Write an evaluation and its checks as JSON, whole or not at all; NaN becomes null."""
    checks = [check.row() for check in evaluation_checks(evaluation)]
    save_json(path, SCHEMA, {"checks": checks, **asdict(evaluation)})


def load_speed_errors(path: Path) -> dict[str, float]:
    """Read the mean speed errors by walk [m/s] of a saved evaluation."""
    with load_json(path, SCHEMA, "pronk evaluate") as body:
        errors = {
            str(walk["name"]): float(walk["figures"]["speed_error"]["mean"] or math.nan)
            for walk in body["walks"]
        }
    if not errors:
        raise ArtefactError(f"{path}: has no walks; evaluate that policy with --what walk.")
    return errors


def sheets(evaluation: Evaluation) -> tuple[Sheet, ...]:
    """The tables of an evaluation."""
    walks = []
    for walk in evaluation.walks:
        errors = (
            f"{number(walk[name].mean)} ({number(walk[f'{name}_averaged'].mean)})"
            for name in ("speed_error", "yaw_error")
        )
        velocity = ", ".join(number(walk[n].mean, 2) for n in ("forward", "left", "yaw_rate"))
        shares = percent(walk["fell"].mean), percent(walk["uncommanded"].most)
        walks.append((walk.name, *errors, velocity, walk["drift"].mean, *shares))
    jumps = [
        (
            jump.name,
            spread(jump["height"]),
            *(spread(jump[name], 2) for name in ("distance", "lift_off_velocity", "delay")),
            *(jump[name].mean for name in ("along", "flights", "high_flights")),
            *(percent(jump[n].mean) for n in ("single", "found", "upright", "non_foot_contact")),
        )
        for jump in evaluation.jumps
    ]
    notes, estimator = [], evaluation.estimator
    if estimator:
        axes = " / ".join(f"{estimator[axis]:.3f}" for axis in ("forward", "left", "up"))
        notes.append(
            f"estimator while walking: velocity RMSE {estimator['velocity']:.3f} m/s (forward / "
            f"left / up {axes}), contacts right {percent(estimator['contacts_right'])} %"
        )
    notes.append(
        f"PASSED; {evaluation.plan['robots']} robots a command, randomization "
        f"{evaluation.about.get('randomization', '-')}, seed {evaluation.plan['seed']}, "
        f"{evaluation.seconds:.0f} s"
    )
    found = (
        table(
            "command | speed error [m/s] | yaw rate error [rad/s] | mean velocity [m/s, m/s, rad/s]"
            " | drift [m];2 | falls [%] | flight over standing [cm]",
            walks,
            title="Walking: mean over robots and time; in brackets with the stride averaged out",
        ),
        table(
            "command | height [m] | distance [m] | lift-off up [m/s] | after [s] | along [m];2"
            " | flights;2 | high ones;2 | one [%] | jumped [%] | upright [%]"
            " | non-foot contact [%]",
            jumps,
            "non-foot contact: anything but a foot on the ground, from the jump input to 2 s after "
            "touchdown; a trial counts no such jump as a success.",
            title="Jumping: mean +- standard deviation over robots",
        ),
        check_sheet("Acceptance criteria", evaluation_checks(evaluation), *notes),
    )
    return tuple(one for one in found if one.rows)
