"""`pronk translate`: gains of one framework as gains of another."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from pronk.cli import console, options
from pronk.errors import PronkError


def translate(
    to: tuple[str, ...],
    gains: tyro.conf.Positional[Path | None] = None,
    begin: Annotated[str | None, tyro.conf.arg(name="from")] = None,
    robot: str | None = None,
    drive_gains: tuple[str, ...] = (),
    out: Path = Path("translated.yaml"),
) -> console.Outcome:
    """Translate gains for a framework of another drive law, in which the joints respond alike.

    Args:
        to: A name that `pronk profiles` lists, NAME,timestep_s=S,iterations=N, or all. Of several
            each is written into a folder of its name.
        gains: gains.yaml of `pronk match`; without it give --robot, --from and --drive-gains.
        begin: Framework of the gains; that of the gains file if left out.
        robot: A name, or a path to a robot.yaml, MJCF or URDF; the gains' if left out.
        drive_gains: Gains in the first framework, without a gains file: JOINT=STIFFNESS,DAMPING or
            GROUP=STIFFNESS,DAMPING, repeat it; or default, those of the robot's file.
        out: The gains file to write.
    """
    from pronk.identify.match import gains as gains_file
    from pronk.identify.match import translate as translation
    from pronk.identify.match.export.actuators import profile_held, robot_of
    from pronk.identify.match.measured_joint import gains_by_joint
    from pronk.identify.simulators.profiles import load_profiles, profile
    from pronk.robots import load_robot

    stated = options.drive_gains(drive_gains)
    if gains is None:
        if not (robot and begin and stated):
            raise PronkError(
                "there are no gains to translate; give a gains.yaml, or --robot, --from and "
                "--drive-gains NAME=STIFFNESS,DAMPING."
            )
        known = load_robot(robot)
        first = translation.stated_gains(known, gains_by_joint(known, stated), profile(begin))
    else:
        if stated:
            raise PronkError("give a gains file or --drive-gains, not both.")
        first = gains_file.load_gains(gains)
        known = load_robot(robot) if robot else robot_of(first)
        if begin and profile(begin) != (held := profile_held(first)):
            raise PronkError(
                f"{gains} holds for {held.name} at "
                f"{1000.0 * first.simulator.timestep_s:g} ms, not for {begin}; leave --from out."
            )
    origin = profile_held(first)
    names = [name for one in to for name in (load_profiles() if one == "all" else [one])]
    rows: list[list[Any]] = []
    wrote, figures = [], {}
    for name in dict.fromkeys(names):
        target = profile(name)
        found, changes = translation.translate(first, known, target)
        path = out if len(names) == 1 else out.parent / name / out.name
        gains_file.save_gains(path, found)
        wrote.append(path)
        figures[name] = {joint: asdict(one) for joint, one in changes.items()}
        for group in found.groups:
            members = [one for joint, one in changes.items() if known.joint(joint).group == group]
            kp, kd = np.mean([one.after for one in members], axis=0).tolist()
            fields = ("before_db", "after_db", "lead_s", "rest_s")
            values = [float(np.mean([getattr(one, field) for one in members])) for field in fields]
            law, step = target.drive_law.label, 1000.0 * target.timestep_s
            ms = (1000.0 * value for value in values[2:])
            rows.append([name, law, step, group, kp, kd, *values[:2], *ms])
        for joint, one in found.joints.items():
            for flag in one.flags:
                console.warn(f"{name}, {joint}: {flag}.")
        if origin.friction == "N m" != target.friction:
            console.warn(f"{name} has no dry friction in N m: the joints lose theirs.")
        elif target.friction == "N m" != origin.friction:
            console.warn(f"the gains hold without dry friction: set none in {name}.")
    console.show_table(
        "framework | law | step [ms];1 | group | stiffness [N m/rad] | damping [N m s/rad] | "
        "untranslated [dB] | translated [dB] | responds earlier [ms];2 | left early [ms];2",
        rows,
        "Means of each group. dB: RMS of the magnitude in the band over that of "
        f"{origin.name}, law {origin.drive_law.label} at {1000.0 * origin.timestep_s:g} ms.",
        "What responds earlier is added to the delay of the gains file.",
        title="The same joint in other frameworks",
    )
    return console.Outcome(
        figures={"translated": figures},
        wrote=wrote,
        following=[f"pronk export {wrote[0]} --to mjcf --out robot.xml"],
    )
