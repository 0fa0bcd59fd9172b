"""`pronk robot`: write the robot.yaml of a model, or check one."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Literal

import tyro

from pronk.cli import console
from pronk.errors import RobotError
from pronk.tables import Column, Table, counted

Action = Literal["new", "check"]

COLUMNS = (
    Column(heading="joint"),
    Column(heading="group"),
    Column(heading="range", unit="rad", digits=2),
    Column(heading="pose", unit="rad", digits=2),
    Column(heading="effort limit", unit="N m", digits=1),
    Column(heading="chain", is_detail=True),
    Column(heading="clamped", is_detail=True),
)


def robot(
    action: tyro.conf.Positional[Action],
    path: tyro.conf.Positional[Path],
    out: Path | None = None,
    overwrite: bool = False,
    wide: bool = False,
) -> None:
    """Write a filled-in robot.yaml for an MJCF or URDF, or check a robot.

    Example:
        pronk robot new my_robot.urdf

    Args:
        action: new: write a robot.yaml; check: list what is missing or inconsistent.
        path: MJCF or URDF for new; robot.yaml, its folder, or a model for check.
        out: The file to write; robot.yaml beside the model if left out.
        overwrite: Replace a file that exists.
        wide: check: print every column, with the joints that move together or are clamped.
    """
    if action == "new":
        _write_robot(path, out or path.with_name("robot.yaml"), overwrite=overwrite)
    else:
        _check_robot(path, wide=wide)


def _write_robot(model: Path, target: Path, *, overwrite: bool) -> None:
    """Write the robot.yaml of a model, and say what cannot be used or is assumed."""
    from pronk.files import require_new, write_text
    from pronk.robots.bare import describe_model, yaml_of_model
    from pronk.robots.consistency import marked_lines

    require_new(target, "--out", overwrite=overwrite, kind=RobotError)
    if target.parent.resolve() != model.parent.resolve():
        raise RobotError(f"--out {target}: the robot.yaml belongs beside its model {model}.")
    text = yaml_of_model(model)
    write_text(target, text)
    description = describe_model(model)
    for note in description.notes:
        console.warn(note)
    if description.held_joints:
        console.say(_held_sentence(tuple(description.held_joints)))
    assumed = []
    for name, group in description.file.groups.items():
        if group.servo != "position":
            assumed.append(name)
    if assumed:
        console.say(f"without a position servo, gains assumed: {', '.join(assumed)}")
    console.say(f"wrote {target}; {counted(marked_lines(text), 'line')} of it marked CHECK")
    console.following(f"pronk robot check {shlex.quote(str(target))}")


def _held_sentence(names: tuple[str, ...]) -> str:
    """Say which joints are held."""
    return (
        "held at the pose, as they are no hinges or nothing drives them to a position: "
        f"{', '.join(names)}"
    )


def _check_robot(path: Path, *, wide: bool) -> None:
    """Print the joints of a robot, and what is missing or inconsistent."""
    from pronk.robots import load_robot
    from pronk.robots.consistency import problems_of, unchecked_lines
    from pronk.robots.model import bench_spec
    from pronk.robots.quadruped import PAGE, quadruped_problems

    robot_spec = load_robot(path)
    rows = []
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
    problems = problems_of(robot_spec)
    marks = unchecked_lines(robot_spec)
    title = f"{robot_spec.name}: {len(robot_spec.joints)} joints"
    console.show(Table(title=title, columns=COLUMNS, rows=tuple(rows)), wide=wide)
    if robot_spec.held_joints:
        console.say(_held_sentence(robot_spec.held_joints))
    for problem in problems:
        console.warn(problem)
    to_check = []
    if marks:
        console.warn(
            f"{counted(marks, 'line')} of the robot's file marked CHECK: compare their numbers "
            "with the data sheet and remove the marks"
        )
        to_check.append(f"{counted(marks, 'line')} marked CHECK")
    if problems:
        to_check.append(counted(len(problems), "finding"))
    if to_check:
        console.say(f"to check: {' and '.join(to_check)}")
    else:
        console.say("nothing is inconsistent")
    if robot_spec.legs:
        training_problems = quadruped_problems(robot_spec)
        for problem in training_problems:
            console.say(f"not ready for `pronk train`: {problem}")
        if training_problems:
            console.say(
                f"  {PAGE} lists what a model needs, and has a script that writes such a one."
            )
