"""`pronk bench engine`: the same drive at a fine step and in the training simulator.

The paper's point in three rows: equal gains are not an equal joint, because the training simulator
closes the drive's loop every 5 ms.
"""

from __future__ import annotations

from collections.abc import Callable

from rich.table import Table
from rich.text import Text

from pronk.match.engine import EngineGap, engine_gap
from pronk.match.settings import MatchSettings
from pronk.robots import load_robot

JOINTS = ("FR_hip_roll", "FR_hip_pitch", "FR_knee")
ROBOT = "mini_cheetah"


def run(
    progress: Callable[[str, float], None] | None = None, *, threads: int = 2
) -> tuple[EngineGap, ...]:
    """The gap of one joint of each group, with the gains of the robot's drives."""
    robot = load_robot(ROBOT)
    gaps = []
    for k, joint in enumerate(JOINTS):
        if progress is not None:
            progress("engine", k / len(JOINTS))
        gaps.append(engine_gap(robot, joint, settings=MatchSettings(threads=threads)))
    if progress is not None:
        progress("engine", 1.0)
    return tuple(gaps)


def table(gaps: tuple[EngineGap, ...]) -> Table:
    """A row a joint."""
    made = Table(title=Text("The same drive at a 0.25 ms step and in the 5 ms training simulator"))
    made.title_justify = "left"
    made.add_column("joint")
    for column in (
        "gains of the drive",
        "gap with equal gains, RMS (largest) [dB]",
        "gains that answer alike in training",
        "gap after the match, RMS [dB]",
    ):
        made.add_column(Text(column), justify="right")
    for gap in gaps:
        made.add_row(
            gap.joint,
            "{:g} / {:g}".format(*gap.gains),
            f"{gap.equal_gains_rms_db:.2f} ({gap.equal_gains_max_db:.2f})",
            "{:.2f} / {:.3f}".format(*gap.matched_gains),
            f"{gap.matched_rms_db:.3f}",
        )
    return made
