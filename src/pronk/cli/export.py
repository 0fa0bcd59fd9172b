"""`pronk export`: matched gains as configuration of a simulator."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import tyro

from pronk.cli import console

TargetName = Literal[
    "isaaclab-implicit",
    "mjlab",
    "mjlab-idealpd",
    "mjlab-builtin",
    "isaaclab-dcmotor",
    "isaaclab-delayed",
    "isaaclab-implicit-2.3",
    "isaaclab-dcmotor-2.3",
    "isaaclab-delayed-2.3",
    "isaaclab-newton",
    "newton-usd",
    "genesis",
    "playground",
    "mjcf",
    "mjcf-snippet",
]
"""Names in `TARGETS`, which takes too long to import for `--help`; a test holds them together."""


def export_gains(
    gains: tyro.conf.Positional[Path],
    to: TargetName,
    out: Path,
    robot: str | None = None,
    per: Literal["group", "joint"] = "group",
    allow_unmatched: bool = False,
) -> console.Outcome:
    """Write matched gains as actuator configuration of a simulator.

    Example:
        pronk export out/isaaclab-implicit/gains.yaml --to isaaclab-implicit --out actuators.py

    Args:
        gains: gains.yaml of `pronk match` or `pronk translate`.
        to: What reads the file, as isaaclab-implicit, the default actuator of Isaac Lab. It must
            have the drive law and the step that the gains hold for.
        out: The file to write.
        robot: A name, or a path to a robot.yaml, MJCF or URDF; the gains' if left out.
        per: One actuator per joint group, with the group's gains, or per joint, with its own.
        allow_unmatched: Also export joints that are no match; the header of the file names them.
    """
    from pronk.files import write_text
    from pronk.identify.match.export.targets import export
    from pronk.identify.match.gains import load_gains, require_matched
    from pronk.robots import load_robot

    robot_spec = load_robot(robot) if robot else None
    matched_gains = load_gains(gains)
    require_matched(matched_gains, allow_unmatched, str(gains))
    text = export(matched_gains, to, robot_spec, per=per, allow_unmatched=allow_unmatched)
    write_text(out, text)
    return console.Outcome(figures={"written": out, "to": to}, wrote=[out])
