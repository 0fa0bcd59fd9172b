"""`pronk demo`: the whole way, on the virtual robot, on one CPU."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pronk.commands import console
from pronk.commands.sweep import AMPLITUDES, SignalName, make, record_twin

if TYPE_CHECKING:
    from pronk.match.prediction import JointPrediction
    from pronk.match.result import MatchResult

ROBOT = "mini_cheetah"


def demo(
    out: Annotated[Path, typer.Option("--out", help="Folder for everything.")] = Path("out/demo"),
    repeats: Annotated[int, typer.Option(help="Times the matched amplitude is asked.")] = 3,
    seed: Annotated[int, typer.Option(help="Of the virtual robot's noise.")] = 0,
    quick: Annotated[
        bool, typer.Option("--quick", help="Search the linearized model instead of the grid.")
    ] = False,
    json_file: console.JsonOption = None,
) -> None:
    """Ask, match, predict and report all twelve joints of the virtual robot."""
    begin = time.perf_counter()
    console.say(
        "Everything below is about pronk's virtual robot, a simulated stand-in for the Mini "
        "Cheetah whose true parameters the match cannot see."
    )
    with console.progress() as report:
        found = run(out, repeats=repeats, seed=seed, quick=quick, report=report)
    summary(found["result"], found["replays"])
    seconds = time.perf_counter() - begin
    console.say(f"{seconds:.0f} s in all: " + ", ".join(_timed(found["seconds"])))
    console.wrote(out / "logs", out / "gains.yaml", out / "match.npz", found["page"], found["hero"])
    console.write_json(
        json_file, figures_of(found) | {"seconds_total": seconds, "seconds": found["seconds"]}
    )
    console.following(
        f"open {found['page']} in a browser",
        f"pronk export {out / 'gains.yaml'} --to mjlab --out actuators.py",
        f"pronk sweep {ROBOT} --link twin --truth YOUR_TRUTH.yaml --out YOUR_LOGS",
    )


def run(
    out: Path, *, repeats: int, seed: int, quick: bool, report: console.Reporter
) -> dict[str, Any]:
    """The whole way; returns the match, the replays, the paths and the time of each part.

    Args:
        out: Folder; `logs` and `fresh` are made in it.
        repeats: Times the matched amplitude is asked; the smaller one, which only checks whether
            the gains hold there too, is asked once.
        seed: Of the virtual robot's noise.
        quick: Search the linearized model.
        report: Told the stage and the share done.
    """
    from pronk.match import gains as gains_file
    from pronk.match import prediction as prediction_file
    from pronk.match import result as result_file
    from pronk.match.pipeline import match_logs
    from pronk.match.predict import predict
    from pronk.match.settings import MatchSettings
    from pronk.report import figures, style
    from pronk.report.page import write_page
    from pronk.response import save as save_responses
    from pronk.robots import load_robot
    from pronk.sweep.readers import read_logs

    robot = load_robot(ROBOT)
    seconds: dict[str, float] = {}
    begin = time.perf_counter()

    def lap(name: str) -> None:
        nonlocal begin
        now = time.perf_counter()
        seconds[name], begin = now - begin, now

    plan = make(robot, None, SignalName.CHIRP, AMPLITUDES, (repeats, *[1] * len(AMPLITUDES[1:])))
    plan.check()
    fresh_plan = make(robot, None, SignalName.LOG_CHIRP, AMPLITUDES[:1], 1)
    fresh_plan.check()
    lap("plan")
    paths = record_twin(
        robot, plan, out / "logs", seed=seed, overwrite=True, progress=report.bar("ask")
    )
    fresh = record_twin(
        robot,
        fresh_plan,
        out / "fresh",
        seed=seed + 1,
        overwrite=True,
        progress=report.bar("ask something else"),
    )
    lap("sweep")
    logs = read_logs(paths, processes=os.cpu_count() or 1, robot=robot)
    lap("read")
    settings = MatchSettings(method="quick" if quick else "grid")
    result = match_logs(logs, robot, settings=settings, progress=report)
    gains_file.save(out / "gains.yaml", result.gains)
    result_file.save(out / "match.npz", result)
    for name, joint in result.joints.items():
        save_responses(out / "logs" / f"{name}.response.npz", joint.responses)
    lap("match")
    replays: list[JointPrediction] = []
    told = report.bar("predict")
    for i, log in enumerate(read_logs(fresh, robot=robot)):
        replays += predict(log, robot, result.gains).joints
        told((i + 1) / len(fresh))
    prediction_file.save(
        out / "fresh.prediction.npz",
        prediction_file.Prediction(joints=tuple(replays), source="fresh", virtual=True),
    )
    lap("predict")
    report("page", 0.0)
    page = write_page(out)
    hero = style.save(figures.hero(result), out / "hero.svg")
    report("page", 1.0)
    lap("page")
    return {
        "result": result,
        "replays": replays,
        "page": page,
        "hero": hero,
        "seconds": seconds,
    }


def _timed(seconds: dict[str, float]) -> list[str]:
    return [f"{name} {value:.0f} s" for name, value in seconds.items()]


def summary(result: MatchResult, replays: list[JointPrediction]) -> None:
    """Print matched gains beside the paper's, and what became of the errors."""
    from pronk.report.paper import published

    paper = published(ROBOT)
    assert paper is not None
    by_joint = {one.joint: one for one in replays}
    made = console.table(
        "Virtual robot: matched gains beside the paper's Table I (stiffness / damping)",
        "joint",
        "matched",
        "Table I",
        "grid cells apart",
        "gain error naive [dB]",
        "matched [dB]",
        "unseen RMSE naive [rad]",
        "matched [rad]",
        "no rotor inertia [dB]",
    )
    for name, gains in result.gains.joints.items():
        joint, one = result.joints[name], by_joint[name]
        cells = cells_apart(result, name, paper.joints[name])
        console.row(
            made,
            name,
            f"{gains.stiffness:.2f} / {gains.damping:.3f}",
            f"{paper.joints[name][0]:g} / {paper.joints[name][1]:g}",
            f"{cells[0]:.1f} / {cells[1]:.1f}",
            console.number(gains.naive_error_db),
            console.number(gains.error_db),
            console.number(one.rmse_naive, 4),
            console.number(one.rmse_matched, 4),
            console.number(joint.zero_armature_error_db),
        )
    console.show(made)


def cells_apart(result: MatchResult, name: str, pair: tuple[float, float]) -> tuple[float, float]:
    """Distance from the matched gains to another pair, in cells of the grid."""
    joint = result.joints[name]
    cell = (
        joint.grid_stiffness[1] - joint.grid_stiffness[0],
        joint.grid_damping[1] - joint.grid_damping[0],
    )
    return (
        float(abs(joint.stiffness - pair[0]) / cell[0]),
        float(abs(joint.damping - pair[1]) / cell[1]),
    )


def figures_of(found: dict[str, Any]) -> dict[str, Any]:
    """What `--json` gives of the demo."""
    from pronk.commands.match import figures_of as match_figures
    from pronk.commands.predict import row_of
    from pronk.report.paper import published

    result: MatchResult = found["result"]
    paper = published(ROBOT)
    assert paper is not None
    return match_figures(result) | {
        "cells_from_table_1": {
            name: cells_apart(result, name, paper.joints[name]) for name in result.joints
        },
        "predictions": [row_of(one) for one in found["replays"]],
        "page": found["page"],
    }
