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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pronk.errors import ArtefactError, PronkError
from pronk.evaluation.criteria import evaluation_checks
from pronk.evaluation.jumps import RISE, JumpRules, Series, measure_jump, steps, uncommanded_height
from pronk.evaluation.protocol import PAPER_COMMANDS, Case
from pronk.evaluation.results import Spread, load_json, save_json
from pronk.evaluation.walk import velocity_errors

if TYPE_CHECKING:
    from pronk.evaluation.training_sim.run import Estimate, Policy, Recording

SCHEMA = "pronk/evaluation/2"
Array = NDArray[np.float64]
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
        """Time until the latest jump is judged [s]; a flight takes less than 1 s."""
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
    robots: int
    shares: Mapping[str, float]
    """Of the robots. `fell`, `non_finite` (fell because its physics diverged), `uncommanded` (had
    a flight without a jump input), `too_high` (one higher than `RISE`); of jumps `standing` (had
    not fallen when the jump input came), `found` (jumped), `upright` (and were so 2 s after
    touchdown), `non_foot_contact` (from the jump input to then), and of those standing `single`
    (made exactly one high flight)."""
    figures: Mapping[str, Spread]
    """As of `pronk.evaluation.jumps` and `walk`; `drift` from the end of settling to the end [m],
    `uncommanded` the highest flight without a jump input, over standing height [m]."""


@dataclass(frozen=True, kw_only=True)
class EstimatorResult:
    """The estimator over all walks, standing included."""

    rmse: tuple[float, float, float]
    """Root mean square error of the velocity by axis, trunk's frame [m/s]."""
    rmse_vector: float
    """Root of the mean squared length of the error [m/s]."""
    contacts_right: float
    """Share of feet and policy steps at which (p > 0.5) is true."""


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """The whole evaluation, and what it rests on."""

    walks: tuple[CommandResult, ...]
    jumps: tuple[CommandResult, ...]
    estimator: EstimatorResult | None
    """None if the policy has no estimator to read, or there are no walks."""
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
        return {walk.name: walk.figures["speed_error"].mean for walk in self.walks}


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
        estimate: The policy's estimator, to be judged as well.
        progress: Called with the share done, 0 to 1.
        about: Kept with the result: where policy and gains come from.
        before: Speed errors of the policy before the jump phases, `Evaluation.speed_errors`.

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
        measured = (
            _walks(case, recording, fell_at[own], plan, run.dt)
            if i < len(plan.walks)
            else _jumps(case, recording, fell_at[own], on[own], plan, run.dt)
        )
        results.append(_summary(case, measured, diverged[own], plan))
    *squares, right, count = run.estimates.tolist()
    estimator = None
    if count:
        means = [each / count for each in squares]
        forward, left, up = map(math.sqrt, means)
        estimator = EstimatorResult(
            rmse=(forward, left, up),
            rmse_vector=math.sqrt(sum(means)),
            contacts_right=right / count,
        )
    return Evaluation(
        walks=tuple(results[: len(plan.walks)]),
        jumps=tuple(results[len(plan.walks) :]),
        estimator=estimator,
        plan=asdict(plan),
        seconds=time.perf_counter() - began,
        about=dict(about or {}),
        before=dict(before or {}),
    )


def _robots(recording: Recording, fell_at: Samples, dt: float) -> list[tuple[Series, Array]]:
    """Motion and angular velocity of each robot, up to its fall or its first number not finite."""
    found = []
    state, feet = recording.state.cpu().numpy(), recording.feet.cpu().numpy()
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
        found.append((series, own[:, 10:]))
    return found


def _walks(
    case: Case, recording: Recording, fell_at: Samples, plan: Plan, dt: float
) -> list[dict[str, float]]:
    """The figures of every robot that walks with one command."""
    first, end = steps(plan.settle_s, dt), steps(plan.walk_s, dt)
    found = []
    for fell, (series, turning) in zip(fell_at, _robots(recording, fell_at, dt), strict=True):
        figures = {"fell": float(fell <= end), "uncommanded": _over(series, None, plan.rules)}
        if len(series.position) > first:
            figures |= velocity_errors(
                series.velocity,
                series.orientation,
                turning,
                case.command,
                first=first,
                average=steps(plan.average_s, dt),
            )[0]
            way = series.position[-1, :2] - series.position[first, :2]
            figures["drift"] = float(np.hypot(*way))
        found.append(figures)
    return found


def _jumps(
    case: Case, recording: Recording, fell_at: Samples, on: Samples, plan: Plan, dt: float
) -> list[dict[str, float]]:
    """The figures of every robot that jumps with one command."""
    rules, found = plan.rules, []
    other = recording.other.cpu().numpy()
    for i, (series, _) in enumerate(_robots(recording, fell_at, dt)):
        count, rise = len(series.position), int(on[i])
        standing = rise < count
        figures: dict[str, Any] = {
            "fell": fell_at[i] < NEVER,
            "standing": standing,
            "uncommanded": _over(series, rise if standing else None, rules),
        }
        if standing:
            measured, main = measure_jump(series, rise, case.command, rules)
            seconds = rules.search_s if main is None else rules.upright_s
            judged = (rise if main is None else main.touchdown) + steps(seconds, dt)
            # A robot that fell within that time after a jump lies on the ground.
            lies = main is not None and count <= judged and fell_at[i] < NEVER
            touches = bool(other[rise : min(count, judged + 1), i].any())
            figures |= measured | {
                "non_foot_contact": lies or touches,
                "single": measured["high_flights"] == 1.0,
            }
        found.append({name: float(value) for name, value in figures.items()})
    return found


def _over(series: Series, on: int | None, rules: JumpRules) -> float:
    """Highest flight without a jump input, over standing height [m]; NaN without one."""
    return uncommanded_height(series, on, rules) - rules.standing_height


_SHARES = ("fell", "standing", "found", "upright", "non_foot_contact")
_NEEDED = (
    "speed_error yaw_error speed_error_averaged yaw_error_averaged forward left yaw_rate drift",
    "height distance along lift_off_velocity delay flights high_flights",
)
"""Figures of a walk and of a jump that are there even if no robot has them."""


def _summary(
    case: Case, measured: Sequence[Mapping[str, float]], diverged: NDArray[np.bool_], plan: Plan
) -> CommandResult:
    names = list(dict.fromkeys(name for figures in measured for name in figures))
    columns = {
        name: np.array([figures.get(name, math.nan) for figures in measured]) for name in names
    }
    high = columns["uncommanded"]
    single = columns.pop("single", np.zeros(0))
    shares = {name: columns.pop(name) for name in _SHARES if name in columns}
    jumps = "standing" in shares
    zero = ("found", "non_foot_contact", "single", "upright") if jumps else ()
    counted = {name: float(np.nansum(values) / plan.robots) for name, values in shares.items()}
    if np.isfinite(single).any():
        counted["single"] = float(np.nanmean(single))
    return CommandResult(
        name=case.name,
        command=case.command,
        robots=plan.robots,
        shares={
            **dict.fromkeys(zero, 0.0),
            **counted,
            "non_finite": float(diverged.mean()),
            "uncommanded": float(np.isfinite(high).mean()),
            "too_high": float((np.nan_to_num(high, nan=-1.0) > RISE).mean()),
        },
        figures={name: Spread() for name in _NEEDED[jumps].split()}
        | {name: Spread.of(values) for name, values in columns.items()},
    )


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
