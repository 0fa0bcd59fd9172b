"""`pronk evaluate`: a policy in the training simulator, beside the bars."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from pronk.cli import console
from pronk.errors import PronkError

if TYPE_CHECKING:
    from pronk.evaluation.training_sim.plan import Plan
    from pronk.evaluation.training_sim.result import Evaluation, Spread
    from pronk.evaluation.training_sim.subject import Subject
    from pronk.train.gains import TrainingGains


What = Literal["all", "walk", "jump"]
"""What is asked."""


Drawn = Literal["full", "noise", "none"]
"""What differs from robot to robot."""


Device = Literal["auto", "cpu", "cuda"]
"""What computes."""


def evaluate(
    policy: tyro.conf.Positional[Path],
    gains: str,
    out: Annotated[Path, tyro.conf.arg(aliases=("--json",))] = Path("evaluation.json"),
    like: Annotated[Path | None, tyro.conf.arg(name="ranges-from")] = None,
    what: What = "all",
    robots: int = 1000,
    randomization: Drawn = "full",
    before: Path | None = None,
    seed: int = 0,
    device: Device = "auto",
) -> None:
    """Walk and jump with many robots at once; errors, heights and falls beside the bars.

    Args:
        policy: policy.onnx, a checkpoint, or the folder of a run (its last checkpoint).
        gains: Gains of the simulated drives: gains.yaml, or naive.
        out: The evaluation, as JSON.
        like: With naive gains: the gains.yaml whose ranges and delay are used.
        what: walk: velocities. jump: the paper's jumps. all: both.
        robots: Robots for each command.
        randomization: full: as in training. noise: one nominal robot many times, with
            noise, timing and delay as in training. none: the nominal robot,
            undisturbed.
        before: Evaluation of the policy before the jump phases, to compare the walk.
        seed: Of all draws.
        device: auto: a GPU if there is one. On the CPU take a few robots.
    """
    from pronk.evaluation.training_sim.plan import JUMPS, WALKS, Plan
    from pronk.robots import load_robot
    from pronk.train.gains import training_gains
    from pronk.train.runner.devices import find_devices, require_extra
    from pronk.train.runner.request import ROBOT

    require_extra()
    if out.suffix != ".json":
        raise PronkError(f"--out {out}: expected a name that ends in .json, as in evaluation.json.")
    plan = Plan(
        robots=robots,
        seed=seed,
        walks=() if what == "jump" else WALKS,
        jumps=() if what == "walk" else JUMPS,
    )
    drives = training_gains(gains, load_robot(ROBOT), like=like)
    where = "cuda:0" if find_devices(device).device == "cuda" else "cpu"

    from pronk.evaluation.training_sim import result as evaluate_result
    from pronk.evaluation.training_sim.evaluate import write
    from pronk.evaluation.training_sim.subject import load_subject

    errors = {} if before is None else evaluate_result.load(before).speed_errors()
    subject = load_subject(policy, where)
    if plan.jumps and not subject.jump:
        raise PronkError(
            f"{policy}: a policy without the jump input; evaluate it with --what walk."
        )
    if not subject.knows(drives):
        console.warn(
            f"{policy} was not trained with these gains; what follows is how it does with "
            f"{drives.name} ones"
        )
    found = run(subject, drives, plan, where, randomization, errors)
    write(out, found)
    show(found)
    console.wrote(out)


def run(
    subject: Subject,
    gains: TrainingGains,
    plan: Plan,
    device: str,
    randomization: str,
    before: dict[str, float],
) -> Evaluation:
    """Build the simulator and evaluate in it.

    Args:
        subject: Who.
        gains: Of the simulated drives.
        plan: What is asked.
        device: `cpu` or `cuda:0`.
        randomization: One of `evaluation.run.RANDOMIZATIONS`.
        before: Speed errors to compare with; empty for none.
    """
    from mjlab.envs import ManagerBasedRlEnv

    from pronk.evaluation.training_sim.evaluate import evaluate_policy, evaluation_cfg
    from pronk.evaluation.training_sim.run import RANDOMIZATIONS
    from pronk.train.runner.provenance import device_facts, versions
    from pronk.train.tasks import env_cfg

    drawn = RANDOMIZATIONS[randomization]
    # mjlab and Warp tell standard output all about themselves.
    with console.progress() as report, redirect_stdout(io.StringIO()):
        report("building", 0.0)
        cfg = evaluation_cfg(env_cfg(gains=gains, randomization=drawn, seed=plan.seed), plan)
        env = ManagerBasedRlEnv(cfg=cfg, device=device)
        report("building", 1.0)
        about = {
            "policy": subject.about,
            "gains": {"name": gains.name, "sha256": gains.sha256, "virtual": gains.virtual},
            "randomization": randomization,
            "device": device_facts(device.partition(":")[0], 1),
            "versions": versions(),
        }
        try:
            return evaluate_policy(
                subject.act,
                env,
                plan,
                waits=subject.waits,
                estimate=subject.estimate,
                progress=report.bar("walking and jumping"),
                about=about,
                before=before,
            )
        finally:
            env.close()


def show(evaluation: Evaluation) -> None:
    """Print what was measured, and every bar beside its figure."""
    from pronk.evaluation.training_sim.bars import checks

    if evaluation.walks:
        show_walks(evaluation)
    if evaluation.jumps:
        show_jumps(evaluation)
    if evaluation.estimator is not None:
        seen = evaluation.estimator
        axes = " / ".join(f"{axis:.3f}" for axis in seen.rmse)
        console.say(
            f"estimator while walking: velocity RMSE {seen.rmse_vector:.3f} m/s (forward / left / "
            f"up {axes}), contacts right {percent(seen.contacts_right)} %"
        )
    bars = checks(evaluation)
    made = console.table("Bars", "what", "measured", "bar", "passed")
    for bar in bars:
        unit = f" {bar.unit}" if bar.unit else ""
        console.row(
            made,
            bar.what,
            console.number(bar.value, 3) + unit if math.isfinite(bar.value) else "-",
            f"{bar.sense} {bar.bar:g}{unit}",
            "yes" if bar.passed else "NO",
        )
    console.show(made)
    console.say(
        f"{sum(bar.passed for bar in bars)} of {len(bars)} bars passed; "
        f"{evaluation.plan['robots']} robots a command, randomization "
        f"{evaluation.about.get('randomization', '-')}, seed {evaluation.plan['seed']}, "
        f"{evaluation.seconds:.0f} s"
    )


def show_walks(evaluation: Evaluation) -> None:
    """Print the table of velocities."""
    made = console.table(
        "Walking: mean over robots and time; in brackets with the stride averaged out",
        "told",
        "speed error [m/s]",
        "yaw rate error [rad/s]",
        "mean velocity [m/s, m/s, rad/s]",
        "drift [m]",
        "falls [%]",
        "flight over standing [cm]",
    )
    for walk in evaluation.walks:
        console.row(
            made,
            walk.name,
            pair(walk.speed_error.mean, walk.speed_error_averaged.mean),
            pair(walk.yaw_error.mean, walk.yaw_error_averaged.mean),
            triple(walk.velocity),
            console.number(walk.drift.mean),
            percent(walk.falls),
            console.number(100.0 * walk.unasked.highest, 1),
        )
    console.show(made)


def show_jumps(evaluation: Evaluation) -> None:
    """Print the table of jumps."""
    made = console.table(
        "Jumping: mean +- standard deviation over robots",
        "told",
        "height [m]",
        "distance [m]",
        "along [m]",
        "lift-off up [m/s]",
        "after [s]",
        "flights",
        "of 60 ms or more",
        "high ones",
        "one [%]",
        "jumped [%]",
        "upright [%]",
        "touched [%]",
    )
    for jump in evaluation.jumps:
        console.row(
            made,
            jump.name,
            spread(jump.height, 3),
            spread(jump.distance),
            console.number(jump.along.mean),
            spread(jump.vertical),
            spread(jump.delay),
            console.number(jump.flights.mean),
            console.number(jump.long_flights.mean),
            console.number(jump.high_flights.mean),
            percent(jump.single),
            percent(jump.found),
            percent(jump.upright),
            percent(jump.touched),
        )
    console.show(made)
    console.say(
        "  touched: anything but a foot on the ground, from the command to 2 s after touchdown; a "
        "trial counts no such jump as a success."
    )
    waited = [jump.waited for jump in evaluation.jumps if jump.waited >= 0.0]
    if waited:
        console.say(
            f"  after: since the jump input, which came {max(waited):.2f} s at most after it was "
            "asked for."
        )


def spread(figure: Spread, digits: int = 2) -> str:
    """Mean and standard deviation; a dash if nobody has the figure."""
    if not figure.n:
        return "-"
    return f"{console.number(figure.mean, digits)} +- {console.number(figure.std, digits)}"


def pair(raw: float, averaged: float) -> str:
    """A figure, and the same with the stride averaged out."""
    return f"{console.number(raw, 3)} ({console.number(averaged, 3)})"


def triple(values: Sequence[Any]) -> str:
    """Three figures."""
    return ", ".join(console.number(value) for value in values)


def percent(share: float) -> str:
    """A share, in percent."""
    return console.number(100.0 * share, 1)
