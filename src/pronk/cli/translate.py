"""`pronk translate`: gains of one framework as gains of another."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from pronk.cli import console, options
from pronk.errors import PronkError
from pronk.tables import Cell, Column, Table

if TYPE_CHECKING:
    from pronk.identify.match.gains import MatchedGains
    from pronk.identify.match.translate import JointTranslation
    from pronk.identify.simulators.profiles import Profile
    from pronk.robots.robot import RobotSpec

COLUMNS = (
    Column(heading="framework"),
    Column(heading="law", is_detail=True),
    Column(heading="step", unit="ms", digits=1, is_detail=True),
    Column(heading="group"),
    Column(heading="stiffness", unit="N m/rad"),
    Column(heading="damping", unit="N m s/rad"),
    Column(heading="before", unit="dB", digits=2),
    Column(heading="after", unit="dB", digits=2),
    Column(heading="responds earlier", unit="ms", digits=2, is_detail=True),
    Column(heading="left early", unit="ms", digits=2, is_detail=True),
)


def translate_gains(
    to: tuple[str, ...],
    gains: tyro.conf.Positional[Path | None] = None,
    begin: Annotated[str | None, tyro.conf.arg(name="from")] = None,
    robot: str | None = None,
    drive_gains: tuple[str, ...] = (),
    out: Path = Path("translated.yaml"),
    allow_unmatched: bool = False,
    wide: bool = False,
) -> console.Outcome:
    """Translate gains for a framework of another drive law, in which the joints respond alike.

    Example:
        pronk translate out/gains.yaml --to isaaclab-implicit --out out/isaaclab.yaml

    Args:
        to: A name that `pronk profiles` lists, NAME,timestep_s=S,iterations=N, or all. Of several
            each is written into a folder of its name.
        gains: gains.yaml of `pronk match`; without it give --robot, --from and --drive-gains.
        begin: Framework of the gains; that of the gains file if left out.
        robot: A name, or a path to a robot.yaml, MJCF or URDF; the gains' if left out.
        drive_gains: Gains in the first framework, without a gains file: JOINT=STIFFNESS,DAMPING or
            GROUP=STIFFNESS,DAMPING, repeat it; or default, those of the robot's file.
        out: The gains file to write.
        allow_unmatched: Also translate joints that are no match; they stay marked.
        wide: Print every column: law, step and times as well.
    """
    from pronk.identify.match.export.actuators import profile_held
    from pronk.identify.match.gains import require_matched, save_gains
    from pronk.identify.match.translate import translate
    from pronk.identify.simulators.profiles import profile

    if not to:
        raise PronkError(
            "no framework; give --to NAME, one that `pronk profiles` lists, or --to all."
        )
    if gains is None:
        first, robot_spec = _stated_gains(robot, begin, drive_gains)
    else:
        first, robot_spec = _gains_of_file(gains, robot, begin, drive_gains)
        require_matched(first, allow_unmatched, str(gains))
    first_profile = profile_held(first)
    names = _framework_names(to)
    rows: list[tuple[Cell, ...]] = []
    written: dict[Path, MatchedGains] = {}
    figures: dict[str, dict[str, Any]] = {}
    for name in names:
        target_profile = profile(name)
        translated, translations = translate(
            first, robot_spec, target_profile, allow_unmatched=allow_unmatched
        )
        path = out if len(names) == 1 else out.parent / name / out.name
        written[path] = translated
        figures[name] = {}
        for joint, translation in translations.items():
            figures[name][joint] = asdict(translation)
        for group in translated.groups:
            members = []
            for joint, translation in translations.items():
                if robot_spec.joint(joint).group == group:
                    members.append(translation)
            rows.append(_group_row(name, target_profile, group, members))
        for joint, joint_gains in translated.joints.items():
            for flag in joint_gains.flags:
                console.warn(f"{name}, {joint}: {flag}.")
        _warn_of_friction(name, first_profile, target_profile)

    # Nothing is written where one of several frameworks is refused.
    for path, translated in written.items():
        save_gains(path, translated)
    wrote = list(written)

    law = f"law {first_profile.drive_law.label} at {1000.0 * first_profile.timestep_s:g} ms"
    table = Table(
        title="The same joint in other frameworks",
        columns=COLUMNS,
        rows=tuple(rows),
        notes=(
            "Means of each group. before, after: RMS of the magnitude in the band over that of "
            f"{first_profile.name}, {law}.",
            "What responds earlier is added to the delay of the gains file.",
        ),
    )
    console.show(table, wide=wide)
    return console.Outcome(
        figures={"translated": figures},
        wrote=wrote,
        following=[f"pronk export {shlex.quote(str(wrote[0]))} --to mjcf --out robot.xml"],
    )


def _stated_gains(
    robot: str | None, begin: str | None, drive_gains: Sequence[str]
) -> tuple[MatchedGains, RobotSpec]:
    """Return the gains that the options state, and the robot."""
    from pronk.identify.match.nominal_gains import gains_by_joint
    from pronk.identify.match.translate import stated_gains
    from pronk.identify.simulators.profiles import profile
    from pronk.robots import load_robot

    pairs = options.drive_gains(tuple(drive_gains))
    if not (robot and begin and pairs):
        raise PronkError(
            "there are no gains to translate; give a gains.yaml, or --robot, --from and "
            "--drive-gains JOINT=STIFFNESS,DAMPING."
        )
    robot_spec = load_robot(robot)
    by_joint = gains_by_joint(robot_spec, pairs)
    return stated_gains(robot_spec, by_joint, profile(begin)), robot_spec


def _gains_of_file(
    path: Path, robot: str | None, begin: str | None, drive_gains: Sequence[str]
) -> tuple[MatchedGains, RobotSpec]:
    """Return the gains of a file and the robot; refuse options that contradict the file."""
    from pronk.identify.match.export.actuators import profile_held, robot_of
    from pronk.identify.match.gains import load_gains
    from pronk.identify.simulators.profiles import profile
    from pronk.robots import load_robot

    if drive_gains:
        raise PronkError("give a gains file or --drive-gains, not both.")
    gains = load_gains(path)
    robot_spec = load_robot(robot) if robot else robot_of(gains)
    if begin:
        held_profile = profile_held(gains)
        if profile(begin) != held_profile:
            raise PronkError(
                f"{path} holds for {held_profile.name} at "
                f"{1000.0 * gains.simulator.timestep_s:g} ms, not for {begin}; leave --from out."
            )
    return gains, robot_spec


def _framework_names(to: Sequence[str]) -> list[str]:
    """Return each named framework once; `all` names every profile."""
    from pronk.identify.simulators.profiles import load_profiles

    names: list[str] = []
    for name in to:
        names.extend(load_profiles() if name == "all" else [name])
    return list(dict.fromkeys(names))


def _group_row(
    name: str, profile: Profile, group: str, members: Sequence[JointTranslation]
) -> tuple[Cell, ...]:
    """Return the row of a joint group, with the means of its joints."""
    stiffness, damping = np.mean([member.after for member in members], axis=0).tolist()
    return (
        name,
        profile.drive_law.label,
        1000.0 * profile.timestep_s,
        group,
        stiffness,
        damping,
        float(np.mean([member.before_db for member in members])),
        float(np.mean([member.after_db for member in members])),
        1000.0 * float(np.mean([member.lead_s for member in members])),
        1000.0 * float(np.mean([member.rest_s for member in members])),
    )


def _warn_of_friction(name: str, first: Profile, target: Profile) -> None:
    """Warn where one of two frameworks has no dry friction as a torque."""
    if first.friction == "N m" and target.friction != "N m":
        console.warn(f"{name} has no dry friction in N m: the joints lose theirs.")
    elif first.friction != "N m" and target.friction == "N m":
        console.warn(f"the gains hold without dry friction: set none in {name}.")
