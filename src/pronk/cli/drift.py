"""`pronk drift`: which gains of a robot have changed since an earlier match."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from pronk.cli import console, options
from pronk.cli.options import Reading
from pronk.errors import PronkError
from pronk.exit_status import ExitStatus
from pronk.tables import Cell, Column, Table

if TYPE_CHECKING:
    from pronk.identify.match.drift import Drift
    from pronk.identify.match.gains import MatchedGains

_WORDS = {
    "stiffness": "stiffness",
    "damping": "damping",
    "frictionloss": "dry friction",
    "delay": "delay",
}
"""Words of the table for the parameters."""


def drift(
    old: tyro.conf.Positional[Path],
    new: tyro.conf.Positional[tuple[Path, ...]],
    matters: float = 0.1,
    robot: str | None = None,
    drive_gains: tuple[str, ...] = (),
    out: Path | None = None,
    reading: Reading = Reading(),  # noqa: B008
) -> console.Outcome:
    """Say which gains have changed since an earlier match: within, outside or not resolved.

    Two values differ where they are further apart than the root of the summed squares of their
    total intervals. Exit status 0: all within; 6: at least one outside; 7: none outside, and of at
    least one gain a change that matters would not show.

    Example:
        pronk drift OLD.yaml NEW.yaml
        pronk drift OLD.yaml FRESH --robot mini_cheetah --out NEW.yaml

    Args:
        old: Gains file of the earlier match.
        new: Gains file of the later match; or fresh logs, or folders of logs, which are matched for
            the simulator of the earlier one.
        matters: Relative change of a stiffness or damping that matters. Where the intervals are
            wider than that, the gain is not resolved.
        robot: For fresh logs: a name, or a path to a robot.yaml, MJCF or URDF; the earlier gains'
            if left out.
        drive_gains: For fresh logs, as of `pronk match`.
        out: For fresh logs: also write their gains to this file.
        reading: How fresh logs are read.
    """
    from pronk.identify.match.drift import compare_gains
    from pronk.identify.match.gains import load_gains, save_gains

    if not new:
        raise PronkError(
            f"nothing to compare {old} with; give the gains file of a later match, or fresh logs, "
            "after it."
        )
    earlier = load_gains(old)
    wrote: list[Path] = []
    if len(new) == 1 and new[0].suffix in (".yaml", ".yml"):
        if robot is not None or drive_gains or out is not None or reading != Reading():
            raise PronkError(
                f"--robot, --drive-gains, --out and the options of reading are of fresh logs, and "
                f"{new[0]} is a gains file; leave them out."
            )
        later = load_gains(new[0])
    else:
        later = matched_for(earlier, new, robot, drive_gains, reading)
        if out is not None:
            save_gains(out, later)
            wrote.append(out)
    result = compare_gains(earlier, later, matters)
    virtual = earlier.virtual or later.virtual
    console.show(drift_table(result, matters=matters, virtual=virtual))
    reasons: dict[str, list[str]] = {}
    for parameter in result.parameters:
        if parameter.reason:
            joints = reasons.setdefault(parameter.reason, [])
            if parameter.joint not in joints:
                joints.append(parameter.joint)
    for reason, joints in reasons.items():
        console.say(f"not resolved, {', '.join(joints)}: {reason}")
    if result.only_old:
        console.say(f"not compared: {', '.join(result.only_old)}, in {old} alone")
    if result.only_new:
        console.say(f"not compared: {', '.join(result.only_new)}, in the later gains alone")
    outside = len(result.outside)
    unresolved = len(result.unresolved_gains)
    console.say(
        f"{outside} of {len(result.parameters)} outside; of {unresolved} stiffnesses and dampings "
        f"a change of {100.0 * matters:g} % would not show"
    )
    status = ExitStatus.DONE
    if outside:
        status = ExitStatus.DRIFTED
    elif unresolved:
        status = ExitStatus.NOT_RESOLVED
    parameters = []
    for parameter in result.parameters:
        parameters.append({**asdict(parameter), "unit": parameter.unit, "change": parameter.change})
    figures = {
        "parameters": parameters,
        "outside": outside,
        "unresolved_gains": unresolved,
        "only_old": result.only_old,
        "only_new": result.only_new,
        "virtual": virtual,
    }
    return console.Outcome(figures=figures, wrote=wrote, status=status)


def matched_for(
    earlier: MatchedGains,
    paths: Sequence[Path],
    robot: str | None,
    drive_gains: Sequence[str],
    reading: Reading,
) -> MatchedGains:
    """Match fresh logs for the simulator of earlier gains.

    Args:
        earlier: The earlier gains.
        paths: Logs, or folders of logs.
        robot: The robot, as it was given; that of the earlier gains if None.
        drive_gains: Gains on the real drives, as of `pronk match`.
        reading: How the logs are read.
    """
    from pronk.identify.match.export.actuators import profile_held, robot_of
    from pronk.identify.match.match import match
    from pronk.identify.simulators.info import mujoco_info
    from pronk.robots import load_robot

    robot_spec = load_robot(robot) if robot else robot_of(earlier)
    if robot_spec.name != earlier.robot:
        raise PronkError(
            f"--robot {robot} is {robot_spec.name}, and the earlier gains are of {earlier.robot}; "
            "expected the same robot."
        )
    framework = profile_held(earlier)
    own = mujoco_info(robot_spec)
    simulator = "mujoco"
    if framework.name != own.profile or earlier.simulator.timestep_s != own.timestep_s:
        simulator = (
            f"{framework.name},timestep_s={earlier.simulator.timestep_s!r},"
            f"iterations={earlier.simulator.iterations}"
        )
    logs = reading.read(paths, robot_spec)
    with console.progress() as report:
        result = match(
            logs,
            robot_spec,
            simulator,
            drive_gains=options.drive_gains(drive_gains),
            progress=report,
        )
    for name, flags in result.flags.items():
        console.warn(f"{name}: {'; '.join(flags)}")
    return result.gains


def drift_table(result: Drift, *, matters: float, virtual: bool) -> Table:
    """Return the table of two matches, a row for each parameter."""
    rows: list[tuple[Cell, ...]] = []
    previous = ""
    for parameter in result.parameters:
        factor = 1e3 if parameter.parameter == "delay" else 1.0
        numbers: list[Cell] = []
        for value in (parameter.old, parameter.new, parameter.change, parameter.interval):
            numbers.append(f"{factor * value:.4g}" if math.isfinite(value) else None)
        name = "" if parameter.joint == previous else parameter.joint
        previous = parameter.joint
        rows.append((name, _WORDS[parameter.parameter], *numbers, parameter.verdict))
    title = "Gains then and now"
    return Table(
        title=f"{title}, of the virtual robot" if virtual else title,
        columns=(
            Column(heading="joint"),
            Column(heading="parameter"),
            Column(heading="old"),
            Column(heading="new"),
            Column(heading="change"),
            Column(heading="by chance"),
            Column(heading="verdict"),
        ),
        rows=tuple(rows),
        notes=(
            "Stiffness in N m/rad, damping in N m s/rad, dry friction in N m, delay in ms.",
            "by chance: root of the summed squares of the total intervals.",
            f"not resolved: the intervals are wider than {100.0 * matters:g} % of a gain, 10 mrad "
            "of friction, 2 ms.",
        ),
    )
