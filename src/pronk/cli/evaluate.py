"""`pronk evaluate`: a policy in the training simulator, beside the acceptance criteria."""

from __future__ import annotations

import io
from contextlib import redirect_stdout
from pathlib import Path
from typing import Annotated, Literal

import tyro

from pronk.cli import console
from pronk.errors import PronkError
from pronk.tables import Table


def evaluate(
    policy: tyro.conf.Positional[Path],
    gains: str,
    out: Annotated[Path, tyro.conf.arg(aliases=("--json",))] = Path("evaluation.json"),
    like: Annotated[Path | None, tyro.conf.arg(name="ranges-from")] = None,
    what: Literal["all", "walk", "jump"] = "all",
    robots: int = 1000,
    randomization: Literal["full", "noise", "none"] = "full",
    before: Path | None = None,
    seed: int = 0,
    device: Literal["auto", "cpu", "cuda"] = "auto",
) -> None:
    """Walk and jump with many robots at once; errors, heights, falls, acceptance criteria.

    Args:
        policy: policy.onnx, a checkpoint, or the folder of a run (its last checkpoint).
        gains: Gains of the simulated drives: gains.yaml, or naive.
        out: The evaluation, as JSON.
        like: With naive gains: the gains.yaml whose ranges and delay are used.
        what: walk: velocities. jump: the paper's jumps. all: both.
        robots: Robots for each command.
        randomization: full: as in training. noise: one nominal robot many times, with noise, timing
            and delay as in training. none: the nominal robot, undisturbed.
        before: Evaluation of the policy before the jump phases, to compare the walk.
        seed: Of all draws.
        device: auto: a GPU if there is one. On the CPU take a few robots.
    """
    from pronk.jump.train.devices import find_devices, require_extra
    from pronk.jump.trial.training_sim.evaluation import JUMPS, WALKS, Plan

    require_extra()
    if out.suffix != ".json":
        raise PronkError(f"--out {out}: expected a name that ends in .json, as in evaluation.json.")
    where = "cuda:0" if find_devices(device) else "cpu"

    from pronk.jump.train.gains import training_gains
    from pronk.jump.train.tasks import load_task
    from pronk.jump.trial.training_sim import adapter
    from pronk.jump.trial.training_sim.results import load_speed_errors, save, sheets

    errors = {} if before is None else load_speed_errors(before)
    subject = adapter.load_subject(policy, where)
    robot = load_task(subject.robot).robot
    plan = Plan(
        robot=robot,
        robots=robots,
        seed=seed,
        walks=() if what == "jump" else WALKS,
        jumps=() if what == "walk" else JUMPS,
    )
    if plan.jumps and not subject.jump:
        raise PronkError(f"{policy}: no jump input; evaluate it with --what walk.")
    drives = training_gains(gains, robot, like=like)
    if not subject.knows(drives):
        console.warn(
            f"{policy} was not trained with these gains; it is evaluated with {drives.name} ones"
        )
    # mjlab and Warp print to standard output.
    with console.progress() as report, redirect_stdout(io.StringIO()):
        found = adapter.evaluate(
            subject,
            drives,
            plan,
            device=where,
            randomization=randomization,
            before=errors,
            progress=report,
        )
    save(out, found)
    for sheet in sheets(found):
        if isinstance(sheet, Table):
            console.show(sheet)
        else:
            console.show_sheet(sheet)
    console.say(f"wrote {out}")
