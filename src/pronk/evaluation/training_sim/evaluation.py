"""Evaluate a policy in the training simulator: every command at once, many robots each.

    plan = Plan(robots=1000)
    env = ManagerBasedRlEnv(evaluation_cfg(env_cfg(gains=gains), plan), device="cuda:0")
    evaluation = evaluate_policy(policy, env, plan, estimate=actor.estimate)
    save(Path("evaluation.json"), evaluation)

`run` records the robots, `pronk.evaluation.jumps` and `walk_metrics` measure them, and
`pronk.evaluation.criteria` has the acceptance criteria.
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

from pronk.errors import ArtefactError
from pronk.evaluation.criteria import evaluation_checks
from pronk.evaluation.jumps import RISE, JumpRules, Series, measure_jump, steps, uncommanded_height
from pronk.evaluation.protocol import Case
from pronk.evaluation.results import Spread, load_json, save_json
from pronk.evaluation.training_sim.plan import NEVER, Plan
from pronk.evaluation.walk_metrics import velocity_errors

if TYPE_CHECKING:
    from pronk.evaluation.training_sim.run import Estimate, Policy, Recording

SCHEMA = "pronk/evaluation/2"
Array = NDArray[np.float64]


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
    """As of `pronk.evaluation.jumps` and `walk_metrics`; `drift` from the end of settling to the
    end [m], `uncommanded` the highest flight without a jump input, over standing height [m]."""


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
    estimates = run.estimates.tolist()
    return Evaluation(
        walks=tuple(results[: len(plan.walks)]),
        jumps=tuple(results[len(plan.walks) :]),
        estimator=_estimator(estimates) if estimates[-1] else None,
        plan=asdict(plan),
        seconds=time.perf_counter() - began,
        about=dict(about or {}),
        before=dict(before or {}),
    )


def _robots(
    recording: Recording, fell_at: NDArray[np.int64], dt: float
) -> list[tuple[Series, Array]]:
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
    case: Case, recording: Recording, fell_at: NDArray[np.int64], plan: Plan, dt: float
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
    case: Case,
    recording: Recording,
    fell_at: NDArray[np.int64],
    on: NDArray[np.int64],
    plan: Plan,
    dt: float,
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


def _summary(
    case: Case, measured: Sequence[Mapping[str, float]], diverged: NDArray[np.bool_], plan: Plan
) -> CommandResult:
    names = list(dict.fromkeys(name for figures in measured for name in figures))
    columns = {
        name: np.array([figures.get(name, math.nan) for figures in measured]) for name in names
    }
    high = columns["uncommanded"]
    shares = {name: columns.pop(name) for name in (*_SHARES, "single") if name in columns}
    single = shares.pop("single", np.zeros(0))
    single = single[np.isfinite(single)]
    jumps = {"upright", "found", "non_foot_contact", "single"} if "standing" in shares else set()
    return CommandResult(
        name=case.name,
        command=case.command,
        robots=plan.robots,
        shares=dict.fromkeys(sorted(jumps), 0.0)
        | {name: float(np.nansum(values) / plan.robots) for name, values in shares.items()}
        | ({"single": float(single.mean())} if len(single) else {})
        | {
            "non_finite": float(diverged.mean()),
            "uncommanded": float(np.isfinite(high).mean()),
            "too_high": float((np.nan_to_num(high, nan=-1.0) > RISE).mean()),
        },
        figures={name: Spread.of(values) for name, values in columns.items()}
        | {name: Spread() for name in _NEEDED[bool(jumps)].split() if name not in columns},
    )


_NEEDED = (
    "speed_error yaw_error speed_error_averaged yaw_error_averaged forward left yaw_rate drift",
    "height distance along lift_off_velocity delay flights high_flights",
)
"""Figures of a walk and of a jump that are there even if no robot has them."""


def _estimator(sums: Sequence[float]) -> EstimatorResult:
    forward, left, up, right = (each / sums[-1] for each in sums[:-1])
    return EstimatorResult(
        rmse=(math.sqrt(forward), math.sqrt(left), math.sqrt(up)),
        rmse_vector=math.sqrt(forward + left + up),
        contacts_right=right,
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
