"""`pronk demo`: sweep, match, predict and jump on the virtual robot, on one CPU."""

from __future__ import annotations

import importlib.util
import os
import shlex
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pronk.cli import console
from pronk.cli.match import summary
from pronk.cli.options import check_seed
from pronk.cli.predict import prediction_rows
from pronk.cli.sweep import AMPLITUDES
from pronk.errors import PronkError
from pronk.names import file_name
from pronk.processes import pool

if TYPE_CHECKING:
    from pronk.identify.excitation.plan import SweepPlan
    from pronk.identify.match.predict import JointPrediction
    from pronk.identify.match.result import MatchResult
    from pronk.jump.trial.results import TrialResults
    from pronk.robots.robot import RobotSpec

ROBOT = "mini_cheetah"
QUICK_LEG = "FR"
"""The leg that `--quick` sweeps."""
QUICK_CHIRP_S = 10.0
"""Length of a chirp with `--quick`, half of the usual [s]: most of the time goes into the simulated
robot and the safety filter, in proportion to it. The gains are the same to 0.5 %."""
QUICK_COMMAND = "forward 2"
"""The command that `--quick` jumps with."""
FILMED = (QUICK_COMMAND, "back 2")
"""The commands of which one jump of each policy is filmed. At the second one the policy of nominal
gains lands on its belly, and that of matched gains on its feet."""


def demo(
    out: Path = Path("out/demo"),
    policies: Path | None = None,
    jumps: int = 2,
    repeats: int = 3,
    seed: int = 0,
    quick: bool = False,
    wide: bool = False,
) -> console.Outcome:
    """Sweep and match all joints of the virtual robot, let trained policies jump on it, report.

    Example:
        pronk demo --quick

    Args:
        quick: One leg, chirps of half the length, two repeats, one policy and one jump: half a
            minute.
        out: Folder for everything.
        policies: Folder of policies to try; those that come with pronk if left out.
        jumps: Jumps with each of the paper's commands.
        repeats: Repeats of the matched amplitude.
        seed: Seed of the virtual robot's noise.
        wide: Print every column: distances from the paper's Table I, replays, and all phases of a
            jump as well.
    """
    from pronk.files import require_place
    from pronk.identify.excitation.signals import Chirp
    from pronk.jump.trial import tables
    from pronk.report import figures, style
    from pronk.report.build import write_report
    from pronk.robots import load_robot

    if jumps < 1:
        raise PronkError(f"--jumps {jumps}; expected 1 or more.")
    check_seed(seed)
    require_place(out / "gains.yaml")
    console.say(
        "All results below are of pronk's virtual robot, a simulated stand-in for the Mini "
        "Cheetah whose parameters the match cannot read."
    )
    begin = time.perf_counter()
    robot = load_robot(ROBOT)
    tried = find_policies(policies, robot)
    joints = robot.joint_names
    if quick:
        joints = tuple(name for name in joints if name.startswith(f"{QUICK_LEG}_"))
        repeats = min(repeats, 2)
        jumps = 1
        tried = tried[:1]
    # The jumps need nothing of the match; their process uses the cores that it leaves idle.
    names = ("the jumps and their films",)
    with console.progress() as report, pool(1, names=names) as process:
        jumping = process.submit(jump_and_film, tried, out / "trial", jumps, seed, quick)
        chirp_s = QUICK_CHIRP_S if quick else Chirp.length_s
        result, replays = sweep_and_match(robot, joints, out, repeats, seed, report, chirp_s)
        report("jumps and film", 0.0)
        trial, films = jumping.result()
        report("jumps and film", 1.0)
        hero = style.save_figure(figures.hero(result), out / "hero.svg")
        page, _ = write_report(out, report)
    seconds = time.perf_counter() - begin
    cells = show_match(result, replays, wide=wide)
    if trial is not None and not quick:
        console.show(tables.paper_table(trial, "height"), wide=wide)
        console.show(tables.paper_table(trial, "distance"), wide=wide)
    if trial is not None:
        console.show(tables.landings(trial), wide=wide)
    console.say(
        "Training is left out: it needs a CUDA GPU and `pip install 'pronk[train]'`. The policies "
        f"come with pronk. {seconds:.0f} s in all."
    )
    demo_figures = {
        "cells_from_table_1": cells,
        "predictions": prediction_rows(replays),
        "trial": out / "trial" / "summary.json" if trial is not None else None,
        "page": page,
        "seconds_total": seconds,
    }
    following = [f"open {page} in a browser"]
    if quick:
        following.append("pronk demo   # all joints, two policies: some minutes")
    else:
        gains_file = shlex.quote(str(out / "gains.yaml"))
        following.append(f"pronk train all --gains {gains_file} --out runs/matched   # on a GPU")
    if tried:
        following.append(f"pronk trial {shlex.quote(str(tried[0]))} --out out/trial")
    following.append(f"pronk sweep {ROBOT} --joints FL_knee --out logs")
    return console.Outcome(
        figures=summary(result) | demo_figures,
        wrote=[out / "logs", out / "gains.yaml", out / "match.npz", hero, *films, page],
        following=following,
    )


def find_policies(folder: Path | None, robot: RobotSpec) -> list[Path]:
    """Return the policies of a folder, or of pronk's source if None; the matched one first."""
    from pronk.jump.trial.trial import load_subjects

    policies_folder = folder or Path(__file__).parents[1] / "policies"
    policies = [
        *policies_folder.glob("policy.onnx"),
        *policies_folder.glob("*/policy.onnx"),
    ]
    policies.sort(key=lambda path: (path.parent.name != "matched", path.parent.name))
    if folder is not None and not policies:
        raise PronkError(
            f"--policies {folder}: no policy.onnx in it or in a folder in it; give one that "
            "`pronk train` wrote to, or leave the option out."
        )
    if folder is None and importlib.util.find_spec("onnxruntime") is None:
        console.warn("no jumps: onnxruntime is missing; `pip install 'pronk[policy]'`.")
        return []
    if policies:
        load_subjects(policies, robot)
    else:
        console.warn(
            f"no jumps: there are no policies in {policies_folder}; --policies DIR names others."
        )
    return policies


def jump_and_film(
    policies: Sequence[Path], out: Path, jumps: int, seed: int, quick: bool = False
) -> tuple[TrialResults | None, tuple[Path, ...]]:
    """Run a short trial on the shipped virtual robot and film jumps of each policy.

    An existing trial is replaced. Without policies the results are None and no film. A quick trial
    has one command alone.
    """
    from pronk.jump.trial.films.record import record_trial
    from pronk.jump.trial.protocol import PAPER_COMMANDS
    from pronk.jump.trial.trial import VIDEOS, TrialPlan, run_trial, setup_of

    if not policies:
        return None, ()
    setup = setup_of(policies[0], out)
    cases = PAPER_COMMANDS
    if quick:
        cases = tuple(case for case in cases if case.name == QUICK_COMMAND)
    plan = TrialPlan(cases=cases, jumps=jumps, seed=seed)
    trial = run_trial(policies, plan, setup, overwrite=True)
    films = record_trial(
        trial, out, out / VIDEOS, robot=setup.robot, cases=FILMED, slow=2.0, warn=console.warn
    )
    return trial, films


def sweep_and_match(
    robot: RobotSpec,
    joints: Sequence[str],
    out: Path,
    repeats: int,
    seed: int,
    report: console.Reporter,
    chirp_s: float,
) -> tuple[MatchResult, list[JointPrediction]]:
    """Sweep joints, match them, and predict a sweep that was not matched.

    The smaller amplitude only shows whether the gains hold there too; it has one repeat.

    Args:
        robot: The robot.
        joints: Names of the joints.
        out: Folder for everything.
        repeats: Repeats of the larger amplitude.
        seed: Seed of the virtual robot's noise.
        report: Progress.
        chirp_s: Length of a chirp [s].

    Returns:
        The match, and the prediction of each joint of the sweep that was not matched.
    """
    from pronk.deploy.bench.virtual_sweep import sweep_virtual
    from pronk.identify.excitation.plan import make_plan
    from pronk.identify.excitation.signals import Chirp, LogChirp
    from pronk.identify.logs.readers import read_logs
    from pronk.identify.match import gains as gains_file
    from pronk.identify.match.match import match
    from pronk.identify.match.predict import Prediction, predict, save_prediction
    from pronk.identify.match.result import save_match
    from pronk.identify.response.response import save_responses
    from pronk.jump.virtual.sim_params import load_sim_params

    sim_params = load_sim_params()
    processes = os.cpu_count() or 1

    def record(folder: str, plan: SweepPlan, seed: int) -> list[Path]:
        plan.check()
        return sweep_virtual(
            plan,
            sim_params,
            out / folder,
            seed=seed,
            processes=processes,
            overwrite=True,
            progress=report.bar(f"sweep ({folder})"),
        )

    repeats_by_amplitude = (repeats, *[1] * len(AMPLITUDES[1:]))
    sweep = make_plan(
        robot,
        joints,
        Chirp(length_s=chirp_s),
        amplitudes=AMPLITUDES,
        repeats=repeats_by_amplitude,
    )
    # One joint of a leg shows whether the gains hold on another signal.
    fresh_joints = joints if len(joints) == len(robot.joint_names) else joints[-1:]
    fresh_sweep = make_plan(
        robot,
        fresh_joints,
        LogChirp(length_s=chirp_s),
        amplitudes=AMPLITUDES[:1],
        repeats=1,
    )
    log_paths = record("logs", sweep, seed)
    fresh_paths = record("fresh", fresh_sweep, seed + 1)
    logs = read_logs(log_paths, processes=processes, robot=robot)
    result = match(logs, robot, progress=report)
    gains_file.save_gains(out / "gains.yaml", result.gains)
    save_match(out / "match.npz", result)
    for name, joint in result.joints.items():
        if joint.responses is not None:
            response_path = out / "logs" / f"{file_name(name)}.response.npz"
            save_responses(response_path, joint.responses.measured)
    replays: list[JointPrediction] = []
    for log in read_logs(fresh_paths, robot=robot):
        replays += predict(log, robot, result.gains).joints
    prediction = Prediction(joints=tuple(replays), source="fresh", virtual=True)
    save_prediction(out / "fresh.prediction.npz", prediction)
    return result, replays


def show_match(
    result: MatchResult, replays: Sequence[JointPrediction], *, wide: bool
) -> dict[str, tuple[float, float]]:
    """Print matched gains beside the paper's Table I, and the errors with both sets of gains.

    Return the distance of each joint's stiffness and damping from Table I, in cells of the grid.
    """
    from pronk.identify.match.magnitude import grid_axes
    from pronk.report.paper import ROBOT, TABLE_I
    from pronk.robots import load_robot
    from pronk.tables import Cell, Column, Table

    robot = load_robot(ROBOT)
    stiffness_axis, damping_axis = grid_axes(robot)
    stiffness_cell = stiffness_axis[1] - stiffness_axis[0]
    damping_cell = damping_axis[1] - damping_axis[0]
    replay_by_joint = {replay.joint: replay for replay in replays}
    cells = {}
    rows: list[tuple[Cell, ...]] = []
    for name, joint in result.joints.items():
        gains = joint.gains
        stiffness, damping = TABLE_I[name]
        stiffness_distance = abs(gains.stiffness.value - stiffness) / stiffness_cell
        damping_distance = abs(gains.damping.value - damping) / damping_cell
        cells[name] = (stiffness_distance, damping_distance)
        replay = replay_by_joint.get(name)
        rows.append(
            (
                name,
                f"{gains.stiffness.value:.2f} / {gains.damping.value:.3f}",
                f"{stiffness:g} / {damping:g}",
                f"{stiffness_distance:.1f} / {damping_distance:.1f}",
                gains.quality.nominal_error_db,
                gains.quality.error_db,
                replay.rmse_nominal if replay else None,
                replay.rmse_matched if replay else None,
            )
        )
    columns = (
        Column(heading="joint"),
        Column(heading="matched"),
        Column(heading="Table I"),
        Column(heading="grid cells apart", is_detail=True),
        Column(heading="error nominal", unit="dB", digits=2),
        Column(heading="error matched", unit="dB", digits=2),
        Column(heading="replay nominal", unit="rad", digits=4, is_detail=True),
        Column(heading="replay matched", unit="rad", digits=4, is_detail=True),
    )
    title = "Virtual robot: matched gains beside the paper's Table I (stiffness / damping)"
    console.show(Table(title=title, columns=columns, rows=tuple(rows)), wide=wide)
    return cells
