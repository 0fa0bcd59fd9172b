"""`pronk export`: the gains as configuration of a simulator."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import tyro

from pronk.cli import console

Target = Literal["mjlab", "mjcf", "isaaclab"]
"""What reads the exported file."""


def export(
    gains: tyro.conf.Positional[Path],
    to: Target,
    out: Path,
    robot: str | None = None,
    json_file: console.JsonFile = None,
) -> None:
    """Write matched gains as actuator configuration of mjlab, MuJoCo or Isaac Lab.

    Args:
        gains: gains.yaml of `pronk match`.
        to: What shall read it.
        out: The file to write.
        robot: Robot: a name, or a path to its robot.yaml, MJCF or URDF; the gains' if left out.
        json_file: Also write the figures to this file.
    """
    from pronk.files import write_text
    from pronk.match import gains as gains_file
    from pronk.match.export import export_text
    from pronk.robots import load_robot

    text = export_text(gains_file.load(gains), to, load_robot(robot) if robot else None)
    write_text(out, text)
    console.wrote(out)
    console.write_json(json_file, {"written": out, "to": to})
