"""`pronk robot`: write the robot.yaml of a model, or check one."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import tyro

from pronk.cli import console
from pronk.errors import RobotError

Action = Literal["new", "check"]


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
    from pronk.files import write_text
    from pronk.robots.bare import yaml_of_model

    if action == "check":
        _check(path)
        return
    target = out or path.with_name("robot.yaml")
    if target.exists() and not overwrite:
        raise RobotError(f"{target} exists; give another --out, or --overwrite.")
    if target.parent.resolve() != path.parent.resolve():
        raise RobotError(f"--out {target}: the robot.yaml belongs beside its model {path}.")
    write_text(target, yaml_of_model(path))
    console.say(f"wrote {target}")
    console.following(f"pronk robot check {target}")


def _check(path: Path) -> None:
    from pronk.robots import load_robot
    from pronk.robots.model import bench_spec

    found = load_robot(path)
    rows, problems = [], []
    for joint in found.joints:
        bench_spec(found, joint.name).compile()
        (low, high), at, drive = joint.range, joint.default_position, joint.drive
        chain, clamped = " ".join(joint.chain), " ".join(joint.clamped)
        rows.append((joint.name, joint.group, joint.range, at, drive.effort_limit, chain, clamped))
        checks = {
            f"poses.default of {joint.name} is outside of its range": low < at < high,
            f"the rotor inertia (armature) of {joint.name} is 0": drive.armature > 0.0,
            f"the dry friction (frictionloss) of {joint.name} is 0": drive.frictionloss > 0.0,
        }
        problems += [problem for problem, met in checks.items() if not met]
    columns = "joint | group | range [rad];2 | default [rad];2 | effort limit [N m]"
    title = f"{found.name}: {len(found.joints)} joints"
    console.show_table(f"{columns} | chain | clamped", rows, title=title)
    for problem in problems:
        console.warn(problem)
    console.say(f"{len(problems)} to check" if problems else "nothing is inconsistent")
