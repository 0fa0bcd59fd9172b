"""`pronk evaluate`: a policy in the training simulator, beside the acceptance criteria."""

from __future__ import annotations

import io
import time
from collections.abc import Callable
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
    robot: str | None = None
    """A name, or a path to a robot.yaml; the policy's if left out."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """auto: a GPU if there is one. On the CPU take a few robots: the time grows with their number,
    and is said once it is known."""
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
    evaluated_policy = load_evaluated_policy(policy, simulation_device, simulated.robot)
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
            progress=PaceReport(report, evaluated.robots),
        )
    save_evaluation(out, evaluation)
    for table in evaluation_tables(evaluation):
        console.show(table, wide=wide)
    console.say(f"wrote {out}")


class PaceReport:
    """Progress of an evaluation, with a warning once it is known to take long."""

    LONG_S = 600.0
    """Time to go beyond which the warning is given [s]."""
    MEASURED_S = 20.0
    """Time over which the pace is measured [s]."""

    def __init__(
        self,
        report: Callable[[str, float], None],
        robots: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin without a pace.

        Args:
            report: Called with the name of a stage and the fraction of it that is over.
            robots: Robots for each command.
            clock: The time [s].
        """
        self._report = report
        self._robots = robots
        self._clock = clock
        self._start: tuple[str, float, float] | None = None
        """Stage, fraction and time from which the pace is measured."""
        self._is_known = False

    def __call__(self, stage: str, share: float) -> None:
        """Show the fraction of a stage that is over."""
        self._report(stage, share)
        now = self._clock()
        if self._start is None or self._start[0] != stage:
            # The first step of a stage compiles what it needs, so that the pace begins behind it.
            self._start = (stage, share, now) if share > 0.0 else None
            return
        _, start_share, start_time = self._start
        seconds = now - start_time
        if self._is_known or seconds < self.MEASURED_S or share <= start_share:
            return
        self._is_known = True
        left_s = seconds * (1.0 - share) / (share - start_share)
        if left_s > self.LONG_S:
            fewer = max(int(self._robots * self.LONG_S / left_s), 1)
            console.warn(
                f"about {left_s / 3600.0:.1f} h to go at the pace of the first {seconds:.0f} s, "
                f"with {self._robots} robots a command; Ctrl-C and --robots {fewer} take about "
                f"{self.LONG_S / 60.0:.0f} minutes, a GPU less"
            )
