"""`pronk evaluate`: a policy in the training simulator, beside the acceptance criteria."""

from __future__ import annotations

import io
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from pronk.cli import console
from pronk.errors import PronkError


@dataclass(frozen=True, kw_only=True)
class EvaluationOptions:
    """What the robots do."""

    what: Literal["all", "walk", "jump"] = "all"
    """walk: velocities. jump: the paper's jumps. all: both."""
    robots: int = 1000
    """Robots for each command."""
    seed: int = 0
    """Seed of all draws."""
    before: Path | None = None
    """Evaluation of the policy before the jump phases, to compare the walk; none if left out."""


@dataclass(frozen=True, kw_only=True)
class TrainingSimOptions:
    """What is simulated."""

    like: Annotated[Path | None, tyro.conf.arg(name="ranges-from")] = None
    """With naive gains: the gains.yaml whose ranges and delay are used; the paper's ranges and no
    delay if left out."""
    randomization: Literal["full", "noise", "none"] = "full"
    """full: as in training. noise: one nominal robot many times, with noise, timing and delay as in
    training. none: the nominal robot, undisturbed."""
    by_joint: bool | None = None
    """Draw each joint about its own gains, as `pronk train` does; as the policy was trained if left
    out, about those of its group where that is not known."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """auto: a GPU if there is one. On the CPU take a few robots."""
    allow_unmatched: bool = False
    """Also take a gains.yaml with joints that are no match."""


def evaluate_command(
    policy: tyro.conf.Positional[Path],
    gains: str,
    out: Annotated[Path, tyro.conf.arg(aliases=("--json",))] = Path("evaluation.json"),
    wide: bool = False,
    evaluated: EvaluationOptions = EvaluationOptions(),
    simulated: TrainingSimOptions = TrainingSimOptions(),
) -> None:
    """Walk and jump with many robots at once; errors, heights, falls, acceptance criteria.

    Example:
        pronk evaluate runs/matched --gains gains.yaml --robots 1000 --out evaluation.json

    Args:
        policy: policy.onnx, a checkpoint, or the folder of a run (its last checkpoint).
        gains: Gains of the simulated drives: gains.yaml, or naive.
        out: The evaluation, as JSON.
        wide: Print every column: mean velocity, and how and when the robots flew, as well.
        evaluated: What the robots do.
        simulated: What is simulated.
    """
    from pronk.jump.train.devices import find_devices, require_extra
    from pronk.jump.trial.training_sim.evaluation import (
        JUMPS,
        ROBOT_WALKS,
        WALKS,
        EvaluationPlan,
    )

    require_extra()
    if out.suffix != ".json":
        raise PronkError(f"--out {out}: expected a name that ends in .json, as in evaluation.json.")
    simulation_device = "cuda:0" if find_devices(simulated.device) else "cpu"

    from pronk.jump.train.gains import NAIVE, training_gains
    from pronk.jump.train.tasks import load_task
    from pronk.jump.trial.training_sim.adapter import load_evaluated_policy, run_evaluation
    from pronk.jump.trial.training_sim.results import (
        evaluation_tables,
        load_speed_errors,
        save_evaluation,
    )

    errors_before = {}
    if evaluated.before is not None:
        errors_before = load_speed_errors(evaluated.before)
    evaluated_policy = load_evaluated_policy(policy, simulation_device)
    robot = load_task(evaluated_policy.robot).robot
    plan = EvaluationPlan(
        robot=robot,
        robots=evaluated.robots,
        seed=evaluated.seed,
        walks=() if evaluated.what == "jump" else ROBOT_WALKS.get(robot.name, WALKS),
        jumps=() if evaluated.what == "walk" else JUMPS,
    )
    if plan.jumps and not evaluated_policy.jump:
        raise PronkError(f"{policy}: no jump input; evaluate it with --what walk.")
    by_joint = simulated.by_joint
    if by_joint is None:
        # Nominal gains without a file have no intervals to draw from.
        has_file = gains != NAIVE or simulated.like is not None
        by_joint = bool(evaluated_policy.draws.by_joint) and has_file
    simulated_gains = training_gains(
        gains,
        robot,
        like=simulated.like,
        allow_unmatched=simulated.allow_unmatched,
        by_joint=by_joint,
    )
    if not evaluated_policy.knows(simulated_gains):
        console.warn(
            f"{policy} was not trained with these gains; it is evaluated with "
            f"{simulated_gains.name} ones"
        )
    # mjlab and Warp print to standard output.
    with console.progress() as report, redirect_stdout(io.StringIO()):
        evaluation = run_evaluation(
            evaluated_policy,
            simulated_gains,
            plan,
            device=simulation_device,
            randomization=simulated.randomization,
            before=errors_before,
            progress=report,
        )
    save_evaluation(out, evaluation)
    for table in evaluation_tables(evaluation):
        console.show(table, wide=wide)
    console.say(f"wrote {out}")
