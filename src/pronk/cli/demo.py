"""`pronk demo`: the whole way, on the virtual robot, on one CPU."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pronk.cli import console, demo_trial
from pronk.cli.sweep import AMPLITUDES, make
from pronk.cli.sweep_virtual import record_virtual
from pronk.errors import PronkError

if TYPE_CHECKING:
    from pronk.match.prediction import JointPrediction
    from pronk.match.result import MatchResult
    from pronk.robots.robot import Robot

ROBOT = "mini_cheetah"


class Clock:
    """How long each part of the demo takes, and what is done beside them meanwhile."""

    def __init__(self) -> None:
        """Start."""
        self.seconds: dict[str, float] = {}
        self.beside: dict[str, float] = {}
        self._begun = self._lap = time.perf_counter()

    def lap(self, name: str) -> None:
        """A part is done."""
        now = time.perf_counter()
        self.seconds[name], self._lap = now - self._lap, now

    @property
    def total(self) -> float:
        """Since the start [s]."""
        return time.perf_counter() - self._begun

    def words(self) -> str:
        """All of it, as one line."""
        parts, beside = (
            ", ".join(f"{name} {value:.0f} s" for name, value in each.items())
            for each in (self.seconds, self.beside)
        )
        return f"{self.total:.0f} s in all: {parts}" + (f"; meanwhile: {beside}" if beside else "")


def demo(
    out: Path = Path("out/demo"),
    policies: Path | None = None,
    jumps: int = 2,
    repeats: int = 3,
    seed: int = 0,
    quick: bool = False,
    json_file: console.JsonFile = None,
) -> None:
    """Ask and match all joints of the virtual robot, let trained policies jump on it, report.

    Args:
        out: Folder for everything.
        policies: Folder of policies to try; those that come with pronk if left out.
        jumps: Jumps with each of the paper's commands.
        repeats: Times the matched amplitude is asked.
        seed: Of the virtual robot's noise.
        quick: Search the linearized model instead of the grid.
        json_file: Also write the figures to this file.
    """
    if jumps < 1:
        raise PronkError(f"--jumps {jumps}; expected 1 or more.")
    console.say(
        "Everything below is about pronk's virtual robot, a simulated stand-in for the Mini "
        "Cheetah whose true parameters the match cannot see."
    )
    clock = Clock()
    with console.progress() as report:
        found = run(
            out,
            policies,
            jumps=jumps,
            repeats=repeats,
            seed=seed,
            quick=quick,
            report=report,
            clock=clock,
        )
    summary(found["result"], found["replays"])
    if found["trial"] is not None:
        demo_trial.summary(found["trial"])
    console.say(
        "Training is left out: it needs a CUDA GPU and `pip install 'pronk[train]'`; the policies "
        "were trained before."
    )
    console.say(clock.words())
    wrote = [out / "logs", out / "gains.yaml", out / "match.npz", found["hero"], *found["videos"]]
    console.wrote(*wrote, found["page"])
    console.write_json(
        json_file,
        figures_of(found)
        | {
            "seconds_total": clock.total,
            "seconds": clock.seconds,
            "seconds_meanwhile": clock.beside,
        },
    )
    console.following(
        f"open {found['page']} in a browser",
        f"pronk train all --gains {out / 'gains.yaml'} --out runs/matched   # on a GPU",
        *(f"pronk trial {path} --out out/trial" for path in found["policies"][:1]),
        f"pronk sweep {ROBOT} --link sim --sim-params YOUR_SIM_PARAMS.yaml --out YOUR_LOGS",
    )


def run(
    out: Path,
    policies: Path | None = None,
    *,
    jumps: int,
    repeats: int,
    seed: int,
    quick: bool,
    report: console.Reporter,
    clock: Clock,
) -> dict[str, Any]:
    """The whole way; returns the match, the replays, the trial and the paths.

    Args:
        out: Folder; `logs`, `fresh` and `trial` are made in it.
        policies: Folder of policies; those that come with pronk if None.
        jumps: With each command.
        repeats: Times the matched amplitude is asked; the smaller one, which only checks whether
            the gains hold there too, is asked once.
        seed: Of the virtual robot's noise.
        quick: Search the linearized model.
        report: Told the stage and the share done.
        clock: Told when a part is done.
    """
    from pronk.report import figures, style
    from pronk.report.whole import write_report
    from pronk.robots import load_robot

    robot = load_robot(ROBOT)
    tried, lack = demo_trial.find(policies, robot)
    if lack:
        console.warn(lack)
    # The jumps need nothing of the match: they fill the cores that it leaves idle.
    with demo_trial.beside(
        tried, out / demo_trial.FOLDER, robot=robot, jumps=jumps, seed=seed, report=report
    ) as jumped:
        found = ask_and_match(
            robot, out, repeats=repeats, seed=seed, quick=quick, report=report, clock=clock
        )
        came = jumped()
    clock.lap("wait for the jumps")
    clock.beside |= came.seconds
    found |= {"policies": tried, "trial": came.trial, "videos": came.videos}
    found["hero"] = style.save(figures.hero(found["result"]), out / "hero.svg")
    found["page"], _ = write_report(out, report)
    clock.lap("page")
    return found


def ask_and_match(
    robot: Robot,
    out: Path,
    *,
    repeats: int,
    seed: int,
    quick: bool,
    report: console.Reporter,
    clock: Clock,
) -> dict[str, Any]:
    """Sweep all joints, match them, and predict a sweep that was not matched; as `run`."""
    from pronk.logs.readers import read_logs
    from pronk.match import gains as gains_file
    from pronk.match import prediction as prediction_file
    from pronk.match import result as result_file
    from pronk.match.pipeline import match_logs
    from pronk.match.predict import predict
    from pronk.match.settings import MatchSettings
    from pronk.response import save as save_responses

    report("plan", 0.0)
    plan = make(robot, None, "chirp", AMPLITUDES, (repeats, *[1] * len(AMPLITUDES[1:])))
    plan.check()
    report("plan", 0.5)
    fresh_plan = make(robot, None, "log-chirp", AMPLITUDES[:1], 1)
    fresh_plan.check()
    report("plan", 1.0)
    clock.lap("plan")
    paths = record_virtual(
        robot, plan, out / "logs", seed=seed, overwrite=True, progress=report.bar("ask")
    )
    fresh = record_virtual(
        robot,
        fresh_plan,
        out / "fresh",
        seed=seed + 1,
        overwrite=True,
        progress=report.bar("ask something else"),
    )
    clock.lap("sweep")
    logs = read_logs(paths, processes=os.cpu_count() or 1, robot=robot)
    clock.lap("read")
    settings = MatchSettings(method="quick" if quick else "grid")
    result = match_logs(logs, robot, settings=settings, progress=report)
    gains_file.save(out / "gains.yaml", result.gains)
    result_file.save(out / "match.npz", result)
    for name, joint in result.joints.items():
        save_responses(out / "logs" / f"{name}.response.npz", joint.responses)
    clock.lap("match")
    replays: list[JointPrediction] = []
    told = report.bar("predict")
    for i, log in enumerate(read_logs(fresh, robot=robot)):
        replays += predict(log, robot, result.gains).joints
        told((i + 1) / len(fresh))
    prediction_file.save(
        out / "fresh.prediction.npz",
        prediction_file.Prediction(joints=tuple(replays), source="fresh", virtual=True),
    )
    clock.lap("predict")
    return {"result": result, "replays": replays}


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
    from pronk.cli.match import figures_of as match_figures
    from pronk.cli.predict import row_of
    from pronk.cli.trial import figures as trial_figures
    from pronk.report.paper import published

    result: MatchResult = found["result"]
    paper = published(ROBOT)
    assert paper is not None
    return match_figures(result) | {
        "cells_from_table_1": {
            name: cells_apart(result, name, paper.joints[name]) for name in result.joints
        },
        "predictions": [row_of(one) for one in found["replays"]],
        "trial": trial_figures(found["trial"]) if found["trial"] is not None else None,
        "videos": found["videos"],
        "page": found["page"],
    }
