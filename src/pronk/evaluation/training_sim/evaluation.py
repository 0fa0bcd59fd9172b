"""Evaluate a policy in the training simulator: every command at once, many robots each.

    plan = Plan(robots=1000)
    env = ManagerBasedRlEnv(evaluation_cfg(env_cfg(gains=gains), plan), device="cuda:0")
    evaluation = evaluate_policy(policy, env, plan, estimate=actor.estimate)
    save(Path("evaluation.json"), evaluation)

Walking robots have one velocity from the first sample on. Jumping robots do what the paper's robot
did (E1): stand, accelerate, jump while running, run on for a moment, stop. The jump input rises at
each robot's own time, so that it meets every phase of the gait. `run` records the robots,
`pronk.evaluation.jumps` and `walk` measure them; `pronk.evaluation.criteria` has the acceptance
criteria.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pronk.errors import ArtefactError, PronkError
from pronk.evaluation.criteria import evaluation_checks
from pronk.evaluation.jumps import JumpRules, Series, measure_jump, steps, uncommanded_height
from pronk.evaluation.protocol import PAPER_COMMANDS, Case
from pronk.evaluation.results import Spread, load_json, save_json
from pronk.evaluation.walk import velocity_errors

if TYPE_CHECKING:
    from pronk.evaluation.training_sim.run import Estimate, Policy, Recording

SCHEMA = "pronk/evaluation/3"
Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
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

    robots: int = 1000
    """Robots for each command."""
    seed: int = 0
    """Of noise, pushes, starts and the times of the jumps."""
    walks: tuple[Case, ...] = WALKS
    jumps: tuple[Case, ...] = JUMPS
    walk_s: float = 20.0
    """Length of a walk [s]."""
    settle_s: float = 2.0
    """Time to accelerate, left out of the errors [s]."""
    average_s: float = 0.5
    """Window of the moving average, which takes the stride out of the velocity [s]."""
    stand_s: float = 1.0
    """Of a jumping robot, before the velocity command [s]."""
    run_s: float = 2.5
    """From there to the jump input, at least [s]."""
    spread_s: float = 0.5
    """The jump input rises up to this much later, uniformly [s]."""
    jump_s: float = 0.5
    """Its length [s]."""
    keep_s: float = 0.5
    """From its end to the zero command [s]."""
    rules: JumpRules = field(default_factory=JumpRules)

    def __post_init__(self) -> None:
        """Raise `PronkError` for an empty plan."""
        if self.robots < 1:
            raise PronkError(f"{self.robots} robots for each command; expected 1 or more.")

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
        latest = self.stand_s + self.run_s + self.spread_s
        return latest + self.rules.search_s + 1.0 + self.rules.upright_s if self.jumps else 0.0

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
        count = self.size - self.walkers
        rng = np.random.default_rng(self.seed)
        on = np.rint((self.stand_s + self.run_s + self.spread_s * rng.random(count)) / dt)
        off = on + steps(self.jump_s, dt)
        jumping = {
            "start": np.full(count, steps(self.stand_s, dt)),
            "stop": off + steps(self.keep_s, dt),
            "on": on,
            "off": off,
        }
        walking = {"start": 0, "stop": NEVER, "on": NEVER, "off": NEVER}
        return {
            name: np.concatenate([np.full(self.walkers, walking[name]), times]).astype(np.int64)
            for name, times in jumping.items()
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
    """Times, counts and the seed: `asdict` of the plan."""
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
    progress: Callable[[float], None] | None = None,
    about: Mapping[str, Any] | None = None,
    before: Mapping[str, float] | None = None,
) -> Evaluation:
    """Run the whole plan in one batch and measure every robot.

    Args:
        policy: Under evaluation.
        env: Built with `evaluation_cfg` for the same plan, wrapped or not. It is reset, and the
            random generators of the process are seeded with the plan's seed.
        plan: Of the evaluation.
        estimate: The policy's estimator, if it is evaluated too.
        progress: Called with the share done, 0 to 1.
        about: As of `Evaluation`.
        before: As of `Evaluation`.

    Raises:
        PronkError: The environment was not built for this plan.
    """
    from pronk.evaluation.training_sim.run import Run

    began = time.perf_counter()
    run = Run(env.unwrapped, plan).go(policy, estimate, progress or (lambda share: None))
    fell_at, on, diverged = (each.cpu().numpy() for each in (run.fell_at, run.on, run.non_finite))
    results = []
    for i, (case, recording) in enumerate(
        zip((*plan.walks, *plan.jumps), run.recordings, strict=True)
    ):
        own = slice(i * plan.robots, (i + 1) * plan.robots)
        robots = zip(_series(recording, fell_at[own], run.dt), fell_at[own], on[own], strict=True)
        measured = [
            (
                _walk(case, *seen, int(fell), plan)
                if i < len(plan.walks)
                else _jump(case, *seen, int(fell), int(rise), plan.rules)
            )
            for seen, fell, rise in robots
        ]
        names = dict.fromkeys(name for figures in measured for name in figures)
        figures = {n: Spread.of([each.get(n, math.nan) for each in measured]) for n in names}
        figures["non_finite"] = Spread.of(diverged[own])
        results.append(CommandResult(name=case.name, command=case.command, figures=figures))
    *squares, right, count = run.estimates.tolist()
    estimator = {}
    if count:
        estimator = {
            name: math.sqrt(total / count)
            for name, total in zip(
                ("forward", "left", "up", "velocity"), (*squares, sum(squares)), strict=True
            )
        }
        estimator["contacts_right"] = right / count
    return Evaluation(
        walks=tuple(results[: len(plan.walks)]),
        jumps=tuple(results[len(plan.walks) :]),
        estimator=estimator,
        plan=asdict(plan),
        seconds=time.perf_counter() - began,
        about=dict(about or {}),
        before=dict(before or {}),
    )


def _series(
    recording: Recording, fell_at: Samples, dt: float
) -> Iterator[tuple[Series, Array, Mask]]:
    """Motion, angular velocity and non-foot contacts of each robot.

    The motion ends at the robot's fall or at its first number that is not finite.
    """
    state, feet, other = (
        getattr(recording, name).cpu().numpy() for name in ("state", "feet", "other")
    )
    for i, fell in enumerate(fell_at):
        finite = np.isfinite(state[:, i]).all(axis=-1)
        end = min(int(fell), len(finite) if finite.all() else int(np.argmin(finite)))
        own = state[:end, i].astype(float)
        series = Series(
            position=own[:, :3],
            orientation=own[:, 3:7],
            velocity=own[:, 7:10],
            contact=feet[:end, i],
            dt=dt,
        )
        yield series, own[:, 10:], other[:, i]


def _walk(
    case: Case, series: Series, turning: Array, _: Mask, fell: int, plan: Plan
) -> dict[str, float]:
    """The figures of a robot that walks."""
    first, rules = series.steps(plan.settle_s), plan.rules
    over = uncommanded_height(series, None, rules) - rules.standing_height
    figures = {"fell": fell <= series.steps(plan.walk_s), "uncommanded": over}
    if len(series.position) > first:
        figures |= velocity_errors(
            series.velocity,
            series.orientation,
            turning,
            case.command,
            first=first,
            average=series.steps(plan.average_s),
        )[0]
        way = series.position[-1, :2] - series.position[first, :2]
        figures["drift"] = float(np.hypot(*way))
    return figures


def _jump(
    case: Case, series: Series, _: Array, other: Mask, fell: int, rise: int, rules: JumpRules
) -> dict[str, float]:
    """The figures of a robot that jumps; its jump input rises at sample `rise`."""
    count = len(series.position)
    standing = rise < count
    over = uncommanded_height(series, rise if standing else None, rules) - rules.standing_height
    flags = dict.fromkeys(("found", "upright", "non_foot_contact"), False)
    figures = {"fell": fell < NEVER, "standing": standing, "uncommanded": over, **flags}
    if standing:
        measured, main = measure_jump(series, rise, case.command, rules)
        seconds = rules.search_s if main is None else rules.upright_s
        settled = (rise if main is None else main.touchdown) + series.steps(seconds)
        # A robot that fell within that time after a jump lies on the ground.
        lies = main is not None and count <= settled and fell < NEVER
        touches = bool(other[rise : min(count, settled + 1)].any())
        figures |= measured
        figures["non_foot_contact"] = lies or touches
        figures["single"] = measured["high_flights"] == 1.0
    return figures


def save(path: Path, evaluation: Evaluation) -> None:
    """Write an evaluation and its checks as JSON, whole or not at all; NaN becomes null."""
    checks = [check.row() for check in evaluation_checks(evaluation)]
    save_json(path, SCHEMA, {"checks": checks, **asdict(evaluation)})


def load_speed_errors(path: Path) -> dict[str, float]:
    """Read the mean speed errors by walk [m/s] of a saved evaluation.

    Raises:
        ArtefactError: Missing, damaged or of another schema, or it has no walks.
    """
    with load_json(path, SCHEMA, "pronk evaluate") as body:
        errors = {
            str(walk["name"]): float(walk["figures"]["speed_error"]["mean"] or math.nan)
            for walk in body["walks"]
        }
    if not errors:
        raise ArtefactError(f"{path}: has no walks; evaluate that policy with --what walk.")
    return errors
