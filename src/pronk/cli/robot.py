"""`pronk robot`: write the robot.yaml of a model, or check one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from pronk.cli import console
from pronk.errors import RobotError
from pronk.tables import Column, Table

if TYPE_CHECKING:
    from pronk.robots.robot import Joint

Action = Literal["new", "check"]

COLUMNS = (
    Column(heading="joint"),
    Column(heading="group"),
    Column(heading="range", unit="rad", digits=2),
    Column(heading="default", unit="rad", digits=2),
    Column(heading="effort limit", unit="N m"),
    Column(heading="chain"),
    Column(heading="clamped"),
)


def robot(
    action: tyro.conf.Positional[Action],
    path: tyro.conf.Positional[Path],
    out: Path | None = None,
    overwrite: bool = False,
) -> None:
    """Write a filled-in robot.yaml for an MJCF or URDF, or check a robot.

    Args:
        action: new: write a robot.yaml; check: list what is missing or inconsistent.
        path: MJCF or URDF for new; robot.yaml, its folder, or a model for check.
        out: The file to write; robot.yaml beside the model if left out.
        overwrite: Replace a file that exists.
    """
    if action == "new":
        _write_robot(path, out or path.with_name("robot.yaml"), overwrite=overwrite)
    else:
        _check_robot(path)


def _write_robot(model: Path, target: Path, *, overwrite: bool) -> None:
    """Write the robot.yaml of a model."""
    from pronk.files import write_text
    from pronk.robots.bare import yaml_of_model

    if target.exists() and not overwrite:
        raise RobotError(f"{target} exists; give another --out, or --overwrite.")
    if target.parent.resolve() != model.parent.resolve():
        raise RobotError(f"--out {target}: the robot.yaml belongs beside its model {model}.")
    write_text(target, yaml_of_model(model))
    console.say(f"wrote {target}")
    console.following(f"pronk robot check {target}")


def _check_robot(path: Path) -> None:
    """Print the joints of a robot, and what is missing or inconsistent."""
    from pronk.robots import load_robot
    from pronk.robots.model import bench_spec

    robot_spec = load_robot(path)
    rows = []
    problems = []
    for joint in robot_spec.joints:
        bench_spec(robot_spec, joint.name).compile()
        row = (
            joint.name,
            joint.group,
            joint.range,
            joint.default_position,
            joint.drive.effort_limit,
            " ".join(joint.chain),
            " ".join(joint.clamped),
        )
        rows.append(row)
        problems.extend(_problems(joint))
    title = f"{robot_spec.name}: {len(robot_spec.joints)} joints"
    console.show(Table(title=title, columns=COLUMNS, rows=tuple(rows)))
    for problem in problems:
        console.warn(problem)
    console.say(f"{len(problems)} to check" if problems else "nothing is inconsistent")


def _problems(joint: Joint) -> list[str]:
    """List what is missing or inconsistent about a joint."""
    problems = []
    low, high = joint.range
    if not low < joint.default_position < high:
        problems.append(f"poses.default of {joint.name} is outside of its range")
    if joint.drive.armature <= 0.0:
        problems.append(f"the rotor inertia (armature) of {joint.name} is 0")
    if joint.drive.frictionloss <= 0.0:
        problems.append(f"the dry friction (frictionloss) of {joint.name} is 0")
    return problems
