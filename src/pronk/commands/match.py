"""`pronk match`: grid, refinement, ranges, page."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pronk.commands import console, logs
from pronk.errors import PronkError

if TYPE_CHECKING:
    from pronk.match.result import MatchResult


class Mode(StrEnum):
    """What is looked for."""

    GAINS = "gains"
    DRIVE = "drive"


@logs.reads_logs
def match(
    paths: logs.LogsArgument,
    robot: logs.RobotOption,
    out: Annotated[Path, typer.Option("--out", help="The gains file.")] = Path("gains.yaml"),
    mode: Annotated[
        Mode | None,
        typer.Option(
            help="gains: stiffness and damping (the paper's). drive: stiffness is known; damping, "
            "armature, friction and delay are looked for. gains if left out, drive where several "
            "joints move at once."
        ),
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Search the linearized model, verify by simulation.")
    ] = False,
    zero_armature: Annotated[
        bool,
        typer.Option(
            "--zero-armature/--no-zero-armature", help="Repeat the search without rotor inertia."
        ),
    ] = True,
    phase: Annotated[
        bool, typer.Option("--phase", help="Let the refinement see the phase and a free delay.")
    ] = False,
    json_file: console.JsonOption = None,
    *,
    reading: logs.Reading,
) -> None:
    """Find the gains that make the simulator answer like the robot."""
    from pronk.robots import load_robot

    machine = load_robot(robot)
    if out.suffix not in (".yaml", ".yml"):
        raise PronkError(
            f"--out {out}: expected a name that ends in .yaml, for instance gains.yaml."
        )
    read = logs.read(paths, reading, machine)
    together = [log for log in read if logs.moves_together(log)]
    if mode is Mode.DRIVE or (mode is None and together):
        from pronk.commands.match_drive import match_drive

        match_drive(read, machine, out, json_file=json_file, forced=mode is not None)
        return
    if together:
        raise PronkError(
            f"{together[0].source}: several joints move at once, so their answers cannot be told "
            "apart joint by joint; use --mode drive, or ask one joint at a time."
        )

    from pronk.match.pipeline import match_logs
    from pronk.match.settings import MatchSettings

    settings = MatchSettings(
        method="quick" if quick else "grid", zero_armature=zero_armature, use_phase=phase
    )
    with console.progress() as report:
        result = match_logs(read, machine, settings=settings, progress=report)
        page = write(result, out, report)
    show(result)
    console.wrote(out, out.parent / "match.npz", page)
    console.write_json(json_file, figures_of(result))
    console.following(
        f"open {page} in a browser",
        f"pronk predict FRESH_LOG --robot {robot} --gains {out}",
        f"pronk export {out} --to mjlab --out actuators.py",
    )


def write(result: MatchResult, out: Path, report: console.Reporter) -> Path:
    """Write the gains, `match.npz` and the page beside each other; return the page's path."""
    from pronk.match import gains as gains_file
    from pronk.match import result as result_file
    from pronk.report.page import write_page

    gains_file.save(out, result.gains)
    result_file.save(out.parent / "match.npz", result)
    report("page", 0.0)
    page = write_page(out.parent, gains=out.name)
    report("page", 1.0)
    return page


def figures_of(result: MatchResult) -> dict[str, Any]:
    """What `--json` gives of a match."""
    from pronk.report.page import verdict

    return verdict(result) | {
        "gains": {
            name: {
                "stiffness": gains.stiffness,
                "damping": gains.damping,
                "stiffness_ci95": gains.stiffness_ci95,
                "damping_ci95": gains.damping_ci95,
                "grid": [gains.grid_stiffness, gains.grid_damping],
                "error_db": gains.error_db,
                "naive_error_db": gains.naive_error_db,
                "zero_armature_error_db": result.joints[name].zero_armature_error_db,
            }
            for name, gains in result.gains.joints.items()
        },
        "groups": {name: vars(group) for name, group in result.gains.groups.items()},
        "seconds": dict(result.seconds),
        "grid_steps_per_second": result.grid_steps_per_second,
    }


def show(result: MatchResult) -> None:
    """Print the gains, with the paper's beside them where there are any."""
    from pronk.report.page import doubts
    from pronk.report.paper import published

    paper = published(result.gains.robot)
    where = "the virtual robot" if result.gains.virtual else "the robot"
    made = console.table(
        f"Gains of the simulator that answers like {where} ({result.gains.robot})",
        "joint",
        "stiffness",
        "95 %",
        "damping",
        "95 %",
        *(["paper, Table I"] if paper else []),
        "naive [dB]",
        "matched [dB]",
    )
    for name, gains in result.gains.joints.items():
        known = paper.joints.get(name) if paper else None
        console.row(
            made,
            name + (" *" if doubts(result.joints[name]) else ""),
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
    for name, joint in result.joints.items():
        for flag in doubts(joint):
            console.say(f"* {name}: {flag}")


def _interval(bounds: tuple[float, float], digits: int) -> str:
    return f"{console.number(bounds[0], digits)} to {console.number(bounds[1], digits)}"
