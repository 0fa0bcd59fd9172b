"""A virtual robot's own sweep and match: what a person does first with a robot never seen.

The body is asked as `pronk sweep --link sim` asks it, and matched as `pronk match --quick` does:
the match reads the logs and nothing else of the body.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pronk.evaluation.processes import in_processes
from pronk.excitation.plan import SweepPlan, make_plan
from pronk.logs.joint_log import SweepLog
from pronk.logs.readers import read_logs
from pronk.match import gains as gains_file
from pronk.match import result as result_file
from pronk.match.pipeline import match_logs
from pronk.match.result import MatchResult
from pronk.match.settings import MatchSettings
from pronk.robots.robot import Robot
from pronk.runtime.sweep import record
from pronk.virtual.plant import legs_of
from pronk.virtual.robot import VirtualRobot
from pronk.virtual.sim_params import SimParams

AMPLITUDE = 0.25
"""Of the paper's chirp (F3) [rad]."""
LOGS, GAINS, MATCH = "logs", "gains.yaml", "match.npz"
"""What lies where in a body's folder."""
SETTINGS = MatchSettings(method="quick", zero_armature=False)
"""The quick search; it ends within a hundredth of a cell of the whole grid's optimum."""


@dataclass(frozen=True, kw_only=True)
class _Leg:
    """The questions to one leg; on a rigid bench legs do not feel each other."""

    plan: SweepPlan
    sim_params: SimParams
    leg: str
    out: Path
    seed: int


def _ask(leg: _Leg) -> list[Path]:
    robot = leg.plan.robot
    machine = VirtualRobot(robot, leg.sim_params, seed=leg.seed, legs=(leg.leg,))
    asked = [name for name in leg.plan.joints if name.split("_")[0] == leg.leg]
    return record(machine, robot, leg.plan, leg.out, joints=asked, overwrite=True)


def ask(
    robot: Robot,
    sim_params: SimParams,
    out: Path,
    *,
    seed: int = 0,
    repeats: int = 3,
    processes: int = 1,
    progress: Callable[[float], None] | None = None,
) -> list[SweepLog]:
    """Ask all joints of a body the paper's chirp, on the bench.

    Args:
        robot: What the body is of.
        sim_params: The body.
        out: Folder for the logs, one MCAP a joint; logs that are there are replaced.
        seed: Of all noise.
        repeats: Times that every joint is asked; three or more give honest intervals.
        processes: How many legs at once; the logs do not depend on it.
        progress: Called with the share done, 0 to 1.

    Returns:
        The logs, in the robot's order of joints.

    Raises:
        PlanError: The sweep could exceed a limit of the robot.
        HardwareError: It did.
    """
    plan = make_plan(robot, amplitudes=(AMPLITUDE,), repeats=repeats)
    plan.check()
    legs = [
        _Leg(plan=plan, sim_params=sim_params, leg=leg, out=out, seed=1000 * seed + index)
        for index, leg in enumerate(legs_of(robot))
    ]
    written = in_processes(_ask, legs, processes=processes, progress=progress)
    files = {path.stem: path for paths in written for path in paths}
    return read_logs([files[name] for name in robot.joint_names], processes=processes, robot=robot)


def match_own(
    robot: Robot, logs: Sequence[SweepLog], folder: Path, *, settings: MatchSettings | None = None
) -> MatchResult:
    """Match a body's logs and write `gains.yaml` and `match.npz`.

    Args:
        robot: What the body is of.
        logs: Its sweep.
        folder: Where to.
        settings: How to match; `SETTINGS` if None.
    """
    found = match_logs(logs, robot, settings=settings or SETTINGS)
    gains_file.save(folder / GAINS, found.gains)
    result_file.save(folder / MATCH, found)
    return found
