"""`pronk match`: grid, refinement, ranges, page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from pronk.cli import console, logs
from pronk.errors import PronkError

if TYPE_CHECKING:
    from pronk.match.result import MatchResult


Mode = Literal["gains", "drive"]
"""What is looked for."""


Interval = Literal["student", "bootstrap"]
"""How intervals are made from repeats."""


def match(
    paths: tyro.conf.Positional[tuple[Path, ...]],
    robot: str,
    out: Path = Path("gains.yaml"),
    mode: Mode = "gains",
    quick: bool = False,
    zero_armature: bool = True,
    free: Annotated[tuple[str, ...], tyro.conf.arg(name="fit")] = (),
    interval: Interval = "student",
    phase: bool = False,
    simulator: str = "mujoco",
    device: str = "cpu",
    reading: logs.ReadingOptions = logs.ReadingOptions(),  # noqa: B008
    json_file: console.JsonFile = None,
) -> None:
    """Find the gains that make the simulator answer like the robot.

    Args:
        paths: Logs, or folders of logs.
        robot: Robot: a name, or a path to its robot.yaml, MJCF or URDF.
        out: The gains file.
        mode: gains: stiffness and damping (the paper's), the default. drive: stiffness
            is known; damping, armature, friction and delay are looked for.
        quick: Search the linearized model, verify by simulation.
        zero_armature: Repeat the search without rotor inertia.
        free: drive: look for this instead; repeat it. What the sweeps cannot tell is
            refused.
        interval: 95 % intervals over repeats; the bootstrap needs eight.
        phase: Let the refinement see the phase and a free delay.
        simulator: mujoco, FILE.py:NAME, or the name of an installed simulator.
        device: Where the grid is simulated: cpu, or cuda (MuJoCo Warp on a GPU; needs
            pronk[train]).
        json_file: Also write the figures to this file.
        reading: How logs are read.
    """
    from pronk.match.pipeline import match_logs
    from pronk.match.settings import MatchSettings
    from pronk.robots import load_robot

    machine = load_robot(robot)
    if out.suffix not in (".yaml", ".yml"):
        raise PronkError(
            f"--out {out}: expected a name that ends in .yaml, for instance gains.yaml."
        )
    read = logs.read(paths, reading, machine)
    settings = MatchSettings(
        method="quick" if quick else "grid",
        zero_armature=zero_armature,
        use_phase=phase,
        interval=interval,
        device=device,
        simulator=simulator,
    )
    if free and mode != "drive":
        raise PronkError("--fit names what --mode drive looks for; say --mode drive as well.")
    with console.progress() as report:
        result = match_logs(read, machine, mode=mode, free=free, settings=settings, progress=report)
        page = write(result, out, report)
    show(result)
    figures = figures_of(result)
    if any(np.isfinite(joint.rmse) for joint in result.joints.values()):
        show_arm(result)
        held = {name: joint.held for name, joint in result.joints.items() if joint.held}
        figures |= {"mode": mode, "held": held, "rmse": rmse_of(result)}
    console.wrote(out, out.parent / "match.npz", page)
    console.write_json(json_file, figures)
    console.following(
        f"open {page} in a browser",
        f"pronk predict FRESH_LOG --robot {robot} --gains {out}",
        f"pronk export {out} --to mjlab --out actuators.py",
    )


def rmse_of(result: MatchResult) -> dict[str, dict[str, float]]:
    """Error in time of each joint over the logs that were fitted [rad]."""
    return {
        name: {"published": joint.published_rmse, "matched": joint.rmse}
        for name, joint in result.joints.items()
    }


def show_arm(result: MatchResult) -> None:
    """Print what belongs to the gains of an arm, and its error in time."""
    made = console.table(
        "Several joints moved at once, so the whole arm was fitted in time",
        "joint",
        "armature [kg m^2]",
        "dry friction [N m]",
        "command delay [ms]",
        "RMSE published [rad]",
        "RMSE matched [rad]",
    )
    for name, joint in result.joints.items():
        console.row(
            made,
            name,
            console.number(joint.armature, 4),
            console.number(joint.frictionloss, 3),
            console.number(1000.0 * joint.delay_s, 1),
            console.number(joint.published_rmse, 4),
            console.number(joint.rmse, 4),
        )
    console.show(made)
    for name, reason in result.excluded.items():
        console.say(f"left out: {reason if name in reason else f'{name}: {reason}'}")


def write(result: MatchResult, out: Path, report: console.Reporter) -> Path:
    """Write the gains, `match.npz` and the page beside each other; return the page's path."""
    from pronk.match import gains as gains_file
    from pronk.match import result as result_file
    from pronk.report.match_page import write_page

    gains_file.save(out, result.gains)
    result_file.save(out.parent / "match.npz", result)
    report("page", 0.0)
    page = write_page(out.parent, gains=out.name)
    report("page", 1.0)
    return page


def figures_of(result: MatchResult) -> dict[str, Any]:
    """What `--json` gives of a match."""
    from pronk.report.match_page import verdict

    return verdict(result) | {
        "gains": {
            name: {
                "stiffness": gains.stiffness,
                "damping": gains.damping,
                "stiffness_ci95": gains.stiffness_ci95,
                "damping_ci95": gains.damping_ci95,
                "grid": [gains.grid_stiffness, gains.grid_damping],
                "delay_s": gains.delay_s,
                "error_db": gains.error_db,
                "naive_error_db": gains.naive_error_db,
                "zero_armature_error_db": zero_of(result, name),
            }
            for name, gains in result.gains.joints.items()
        },
        "groups": {name: vars(group) for name, group in result.gains.groups.items()},
        "seconds": dict(result.seconds),
        "grid_steps_per_second": result.grid_steps_per_second,
    }


def zero_of(result: MatchResult, name: str) -> float:
    """Best error without rotor inertia [dB]; NaN where it was not looked for."""
    joint = result.joints.get(name)
    return float("nan") if joint is None else joint.zero_armature_error_db


def show(result: MatchResult) -> None:
    """Print the gains, with the paper's beside them where there are any."""
    from pronk.report.match_page import failure_flags
    from pronk.report.paper import published

    paper = published(result.gains.robot)
    where = "the virtual robot" if result.gains.virtual else "the robot"
    made = console.table(
        f"Gains of the simulator that answers like {where} ({result.gains.robot})",
        "joint",
        "stiffness [N m/rad]",
        "95 %",
        "damping [N m s/rad]",
        "95 %",
        *(["paper, Table I"] if paper else []),
        "gain error naive [dB]",
        "matched [dB]",
    )
    for name, gains in result.gains.joints.items():
        known = paper.joints.get(name) if paper else None
        console.row(
            made,
            name + (" *" if failure_flags(result, name) else ""),
            f"{gains.stiffness:.2f}",
            _interval(gains.stiffness_ci95, 2),
            f"{gains.damping:.3f}",
            _interval(gains.damping_ci95, 3),
            *([f"{known[0]:g} / {known[1]:g}" if known else "-"] if paper else []),
            console.number(gains.naive_error_db),
            console.number(gains.error_db),
        )
    console.show(made)
    groups = console.table("For training", "group", "stiffness [N m/rad]", "damping [N m s/rad]")
    for name, group in result.gains.groups.items():
        console.row(
            groups,
            name,
            f"{group.stiffness:g} +- {group.stiffness_range:g}",
            f"{group.damping:g} +- {group.damping_range:g}",
        )
    console.show(groups)
    for name in result.gains.joints:
        for flag in failure_flags(result, name):
            console.say(f"* {name}: {flag}")


def _interval(bounds: tuple[float, float], digits: int) -> str:
    if bounds[0] == bounds[1]:
        return "held"
    return f"{console.number(bounds[0], digits)} to {console.number(bounds[1], digits)}"
