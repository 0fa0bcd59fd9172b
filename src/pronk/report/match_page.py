"""Page of a match: gains, Bode plots, error maps, training ranges, what they rest on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from pronk.errors import ArtefactError, RobotError
from pronk.files import write_text
from pronk.match import gains as gains_file
from pronk.match import prediction as prediction_file
from pronk.match import result as result_file
from pronk.match.gains import MatchedGains
from pronk.match.result import ZERO_ARMATURE, JointFit, MatchResult
from pronk.report import figures
from pronk.report.page import Code, Content, Fold, Part, Section, interval, number, page, picture
from pronk.report.page import table as sheet
from pronk.report.paper import Published, published
from pronk.report.style import joint_words
from pronk.robots import load_robot

PAGE_NAME = "match.html"


def find_gains(folder: Path) -> Path:
    """Return the gains file of a folder: `gains.yaml`, or the only YAML file with that schema.

    Raises:
        ArtefactError: There is none, or several and none called `gains.yaml`.
    """
    if not folder.is_dir():
        raise ArtefactError(
            f"{folder}: no such folder; give the one that `pronk match --out` wrote to."
        )
    usual = folder / "gains.yaml"
    if usual.exists():
        return usual
    schema = f"schema: {gains_file.SCHEMA}"
    found = [
        path
        for path in sorted(folder.glob("*.yaml"))
        if schema in path.read_text(encoding="utf-8", errors="replace")[:200]
    ]
    if len(found) == 1:
        return found[0]
    what = "several gains files and none is called" if found else "no"
    raise ArtefactError(f"{folder}: {what} gains.yaml; `pronk match LOG... --out` writes one.")


def load(folder: Path, gains: Path | None = None) -> MatchResult:
    """Read the match of a folder; its gains are found by `find_gains` if None.

    Raises:
        ArtefactError: The folder has no gains or no `match.npz`, or one of them is damaged.
    """
    path = gains or find_gains(folder)
    return result_file.load(folder / "match.npz", gains_file.load(path))


def group_members(gains: MatchedGains) -> dict[str, list[str]]:
    """Return the matched joints of each group, by the robot or, if unknown, by their names."""
    try:
        robot = load_robot(gains.robot)
        found = {
            name: [joint.name for joint in robot.group(name) if joint.name in gains.joints]
            for name in gains.groups
        }
    except RobotError:
        found = {name: [j for j in gains.joints if j.endswith(name)] for name in gains.groups}
    return {name: joints for name, joints in found.items() if joints}


def drive_gains(gains: MatchedGains) -> dict[str, tuple[float, float]]:
    """Return (stiffness, damping) of each joint's real drive; empty for an unknown robot."""
    try:
        robot = load_robot(gains.robot)
        joints = [robot.joint(name) for name in gains.joints]
    except RobotError:
        return {}
    return {joint.name: (joint.stiffness, joint.damping) for joint in joints}


def failure_flags(result: MatchResult, name: str) -> list[str]:
    """Return the warnings about the match of a joint; that about zero armature is none."""
    fit = result.joints.get(name)
    flags = (*result.gains.joints[name].flags, *(fit.flags if fit is not None else ()))
    return [flag for flag in dict.fromkeys(flags) if not flag.startswith(ZERO_ARMATURE)]


def _rms(values: list[float]) -> float:
    finite = np.asarray([v for v in values if np.isfinite(v)])
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else float("nan")


def verdict(result: MatchResult) -> dict[str, Any]:
    """Return the figures of the summary, also those of `--json`."""
    joints = result.gains.joints
    errors = {name: joint.error_db for name, joint in joints.items() if joint.error_db >= 0.0}
    flags = {name: found for name in joints if (found := failure_flags(result, name))}
    unmatched = [f for f in flags.values() if any(flag.startswith("no match") for flag in f)]
    return {
        "robot": result.gains.robot,
        "virtual": result.gains.virtual,
        "joints": len(joints),
        "matched": len(joints) - len(unmatched),
        "naive_error_db": _rms([joint.naive_error_db for joint in joints.values()]),
        "error_db": _rms([joint.error_db for joint in joints.values()]),
        "worst": max(errors, key=lambda name: errors[name], default=""),
        "flags": flags,
    }


def part(path: Path, root: Path, *, anchor: str = "match", title: str = "Match") -> Part:
    """Make the part of the match in `path`, a `match.npz`.

    Raises:
        ArtefactError: An artefact is missing or damaged.
    """
    gains_path = find_gains(path.parent)
    result = load(path.parent, gains_path)
    source = str(path.relative_to(root))
    made = _part(result, path.parent, gains_path.name)
    return replace(made, anchor=anchor, title=title, source=source)


def write_page(out_dir: Path, *, gains: str | None = None) -> Path:
    """Write the page of the match in `out_dir` and return its path.

    Args:
        out_dir: Folder with the gains and `match.npz`.
        gains: Name of the gains file in it; found by `find_gains` if None.

    Raises:
        ArtefactError: The folder has no gains or no `match.npz`, or one of them is damaged.
    """
    path = out_dir / gains if gains else find_gains(out_dir)
    result = load(out_dir, path)
    written = out_dir / PAGE_NAME
    title = f"match of {result.gains.robot}"
    write_text(written, page(title, [_part(result, out_dir, path.name)]))
    return written


def _part(result: MatchResult, folder: Path, gains_name: str) -> Part:
    gains, found = result.gains, verdict(result)
    errors = (number(found[name], 2) for name in ("naive_error_db", "error_db"))
    lines = [
        "Gain error in the compared band, RMS over the joints: {} dB with the nominal gains of the "
        "real drive, {} dB with the matched gains.".format(*errors)
    ]
    if found["worst"]:
        worst = gains.joints[found["worst"]].error_db
        lines.append(f"Largest error: {joint_words(found['worst'])}, {number(worst, 2)} dB.")
    if gains.virtual:
        lines.append(
            "Every measured number on this page is of pronk's virtual robot, a simulated machine "
            "that stands in for hardware. It says nothing about a real robot."
        )
    lines += [f"{joint_words(name)}: {'; '.join(flags)}." for name, flags in found["flags"].items()]
    fits = {name: fit for name, fit in result.joints.items() if fit.responses}
    return Part(
        anchor="match",
        title=f"Match of {gains.robot}",
        source=f"{gains_name} and match.npz",
        virtual=gains.virtual,
        summary=f"{found['matched']} of {found['joints']} joints matched.",
        lines=lines,
        warning=found["matched"] < found["joints"] or bool(found["flags"]),
        sections=[
            _gains(result),
            _bode(result, fits),
            _maps(result),
            _ranges(gains),
            _without_armature(fits),
            _amplitudes(fits),
            _predictions(folder),
            _identifiability(result),
            _use(gains, gains_name),
            _excitation(gains, fits),
        ],
        note="; ".join(f"{joint_words(stage)} {s:.1f} s" for stage, s in result.seconds.items()),
        figures=found,
    )


def _in_time(result: MatchResult) -> bool:
    """Whether several joints moved at once and were fitted in time, without a grid."""
    return not any(fit.grid_error.size for fit in result.joints.values())


def _gains(result: MatchResult) -> Section:
    gains, paper, in_time = result.gains, published(result.gains.robot), _in_time(result)
    delays = any(joint.delay_s > 0.0 for joint in gains.joints.values())
    rows = []
    for name, joint in gains.joints.items():
        row = {
            "joint": joint_words(name) + (" (flagged)" if joint.flags else ""),
            "stiffness [N m/rad]": number(joint.stiffness, 2),
            "95 %": interval(joint.stiffness_ci95, 2),
            "damping [N m s/rad]": number(joint.damping),
            "95 % ": interval(joint.damping_ci95),
        }
        if paper:
            known = paper.joints.get(name)
            row["paper, Table I"] = f"{known[0]} / {known[1]}" if known else "-"
        if in_time:
            row["friction [N m]"] = number(joint.frictionloss)
        if delays:
            row["delay [ms]"] = number(1000.0 * joint.delay_s, 1)
        row |= {
            "nominal error [dB]": number(joint.naive_error_db, 2),
            "error [dB]": number(joint.error_db, 2),
            "lowest coherence": number(joint.coherence_min),
        }
        rows.append(row)
    unit = "blocks of the recordings" if in_time else "repeats"
    lag = "the lag of the measured phase behind the matched simulation, command and measurement"
    notes = [f"95 % intervals over {unit}, not samples."]
    notes += [f"delay: {lag} together."] if delays and not in_time else []
    if paper and gains.virtual:
        notes.append(
            "Table I was measured on the paper's robot; the virtual robot's hidden parameters were "
            "set so that a match lands near it."
        )
    return Section("gains", "Matched gains", sheet(rows, notes=tuple(notes)))


def _bode(result: MatchResult, fits: Mapping[str, JointFit]) -> Section | None:
    if not fits:
        return None
    where = "the virtual robot" if result.gains.virtual else "the robot"
    compared = (
        "Several joints moved at once and were fitted in time."
        if _in_time(result)
        else "Only the gain at the tinted frequencies was compared."
    )
    pictures = [
        picture(
            figures.bode(fits[name]),
            f"Bode plot of {name}: gain, phase and coherence, measured on {where} and simulated",
        )
        for name in figures.knees_first(list(fits))
    ]
    rest = pictures[1:]
    return Section(
        "bode",
        "Bode plots",
        f"From the held position command to the position of {where}. Numbers in the corners: gain "
        f"error with nominal and with matched gains. {compared}",
        picture(
            figures.overview(fits),
            f"Gain over frequency of every joint, measured on {where} and simulated",
        ),
        pictures[0],
        Fold(f"Bode plots of the other {len(rest)} joints", *rest),
    )


def _maps(result: MatchResult) -> Section | None:
    if _in_time(result):
        return None
    return Section(
        "maps",
        "Error maps",
        "Error of the simulated gain at every pair of the grid. A long valley means that the data "
        "determine a combination of stiffness and damping better than either alone.",
        picture(
            figures.error_maps(result, drive_gains(result.gains)),
            "Gain error over the grid of stiffness and damping for every joint",
        ),
    )


def _ranges(gains: MatchedGains) -> Section:
    paper, members, rows = published(gains.robot), group_members(gains), []
    for name, group in gains.groups.items():
        row = {
            "group": joint_words(name),
            "stiffness [N m/rad]": f"{group.stiffness:.2f} ± {group.stiffness_range:.2f}",
            "damping [N m s/rad]": f"{group.damping:.3f} ± {group.damping_range:.3f}",
        }
        if paper:
            row["paper's training gains"] = _paper_range(paper, name)
        rows.append(row | {"joints": ", ".join(map(joint_words, members.get(name, [])))})
    drawn = {name: members[name] for name in gains.groups if name in members}
    outside = (
        "One cell of the paper's data lies outside its own range: the hip roll damping of FL, "
        "0.516, outside 0.45 ± 0.05 (reading A13).",
    )
    return Section(
        "ranges",
        "Training ranges",
        "The box covers the intervals of all joints of a group, in the paper's steps (0.5 N m/rad "
        "and 0.05 N m s/rad); the smallest ellipse leaves out its corners, which no joint has.",
        picture(
            figures.ranges(gains, drawn),
            "Matched gains of the joints of each group and the ranges that training draws from",
        )
        if drawn
        else None,
        sheet(rows, notes=outside if paper else ()),
    )


def _paper_range(paper: Published, group: str) -> str:
    if group not in paper.training:
        return "-"
    stiffness, damping = paper.training[group]
    return f"{stiffness} ± {paper.stiffness_range}, {damping} ± {paper.damping_range}"


def _without_armature(fits: Mapping[str, JointFit]) -> Section | None:
    drawn = [name for name, fit in fits.items() if fit.zero_armature is not None]
    if not drawn:
        return None
    rows = [
        {
            "joint": joint_words(name),
            "best error without rotor inertia [dB]": number(fit.zero_armature_error_db, 2),
            "matched error [dB]": number(fit.error_db, 2),
            "ratio": number(fit.zero_armature_error_db / max(fit.error_db, 1e-6), 1),
            "without rotor inertia": "no match"
            if any(flag.startswith(f"{ZERO_ARMATURE}no match") for flag in fit.flags)
            else "not excluded",
        }
        for name, fit in fits.items()
        if np.isfinite(fit.zero_armature_error_db)
    ]
    return Section(
        "armature",
        "Without rotor inertia",
        "The same search with zero armature. Through the gear the rotor is much of the inertia of "
        "a light link, and no gains make up for it; a heavy link hides it.",
        picture(
            figures.zero_armature(fits[figures.knees_first(drawn)[0]]),
            "Gain over frequency with and without rotor inertia in the simulator",
        ),
        sheet(rows),
    )


def _amplitudes(fits: Mapping[str, JointFit]) -> Section | None:
    rows = [
        {
            "joint": joint_words(name),
            "amplitude [rad]": number(amplitude),
            "stiffness [N m/rad]": number(stiffness, 2),
            "damping [N m s/rad]": number(damping),
            "change of stiffness [%]": number(100.0 * (stiffness / first[1] - 1.0), 1),
            "change of damping [%]": number(100.0 * (damping / first[2] - 1.0), 1),
        }
        for name, fit in fits.items()
        if len(fit.amplitude_gains) > 1
        for first in [max(fit.amplitude_gains.tolist())]
        for amplitude, stiffness, damping in sorted(fit.amplitude_gains.tolist(), reverse=True)
    ]
    if not rows:
        return None
    return Section(
        "amplitudes",
        "Amplitudes",
        "Each amplitude matched by itself. Dry friction and backlash weigh more in small motions: "
        "large changes mean that one pair of gains does not hold for all motions.",
        Fold("Gains at each amplitude", sheet(rows)),
    )


def _predictions(folder: Path) -> Section | None:
    content: list[Content | None] = []
    for path in sorted(folder.glob("*.prediction.npz")):
        found = prediction_file.load(path)
        if not found.joints:
            continue
        by_joint = {one.joint: one for one in found.joints}
        first = by_joint[figures.knees_first(list(by_joint))[0]]
        where = "the virtual robot" if found.virtual else "the robot"
        content += [
            f"{found.source}, measured on {where}, was not used by the match.",
            picture(
                figures.prediction(first, virtual=found.virtual),
                f"Position of {first.joint} over time: command, measured on {where}, simulated "
                "with nominal and with matched gains",
            ),
            sheet(
                {
                    "joint": joint_words(one.joint),
                    "unit": one.unit,
                    "RMSE nominal": number(one.rmse_naive, 4),
                    "nominal with the delay": number(one.rmse_naive_delayed, 4),
                    "RMSE matched": number(one.rmse_matched, 4),
                    "matched / nominal": number(
                        one.rmse_matched / one.rmse_naive if one.rmse_naive > 0.0 else None, 2
                    ),
                    "R² nominal": number(one.r2_naive),
                    "R² matched": number(one.r2_matched),
                }
                for one in found.joints
            ),
        ]
    return Section("prediction", "Prediction of fresh logs", *content) if content else None


def _identifiability(result: MatchResult) -> Section:
    gains, rows = result.gains, []
    if _in_time(result):
        text = (
            "All joints moved at once and were fitted in time. Parameters that these recordings do "
            "not determine were held at their published values and are flagged. The inertia of the "
            "links is the model's: stiffness, damping and inertia scaled by the same factor give "
            "the same motion, except where gravity loads the joint."
        )
    else:
        text = (
            "The magnitude of a response determines stiffness over inertia and damping over "
            "inertia. The gains on this page rest on the inertia of the simulator's model, which "
            "was held fixed: if it is ten per cent too large, both gains come out ten per cent too "
            "large, and no plot here would show it."
        )
        drive = drive_gains(gains)
        for group, joints in group_members(gains).items():
            known = [j for j in joints if drive.get(j) and min(drive[j]) > 0.0]
            ratios = [
                (gains.joints[j].stiffness / drive[j][0], gains.joints[j].damping / drive[j][1])
                for j in known
            ]
            if ratios:
                stiffness, damping = np.mean(ratios, axis=0)
                rows.append(
                    {
                        "group": joint_words(group),
                        "stiffness, matched / real drive": number(stiffness, 2),
                        "damping, matched / real drive": number(damping, 2),
                    }
                )
    note = (
        "Either the simulated gains are to be scaled, or the simulated inertia is too large by "
        "this ratio. In the air both give the same motion; on the ground they differ.",
    )
    return Section(
        "identifiability",
        "What cannot be identified",
        text,
        sheet(rows, notes=note),
        "The same sweep in a second pose, with a known payload, with recorded torque or with other "
        "gains on the drive separates stiffness, damping and inertia.",
    )


def _use(gains: MatchedGains, name: str) -> Section:
    simulator = gains.simulator
    return Section(
        "use",
        "Use the gains",
        Markup(
            "<p>They hold for <strong>{} {}</strong> alone: physics step {:g} ms, decimation {}, "
            "integrator {}, actuator {}, with the armatures in <code>{}</code>. Match again for "
            "another step or another actuator law.</p>"
        ).format(
            *(simulator.engine, simulator.version, 1000.0 * simulator.timestep_s),
            *(simulator.decimation, simulator.integrator, simulator.actuator, name),
        ),
        Code(
            f"pronk export {name} --to mjlab --out actuators.py\n"
            f"pronk export {name} --to mjcf --out actuators.xml\n"
            f"pronk export {name} --to isaaclab --out actuators.py  # match again in Isaac Lab\n"
            f"pronk predict LOG --robot {gains.robot} --gains {name}"
        ),
    )


def _excitation(gains: MatchedGains, fits: Mapping[str, JointFit]) -> Section:
    rows = []
    for name, fit in fits.items():
        first = fit.responses[0]
        band = first.band(*fit.band_hz)
        rows.append(
            {
                "joint": joint_words(name),
                "amplitudes [rad]": ", ".join(f"{r.amplitude:g}" for r in fit.responses),
                "repeats": str(len(first.repeats)),
                "compared [Hz]": f"{fit.band_hz[0]:g} to {fit.band_hz[1]:g}",
                "lowest coherence": number(first.coherence[band].min() if band.any() else None),
                "delay by phase [ms]": number(1000.0 * first.delay_s, 1),
                "third harmonic [%]": number(100.0 * first.third_harmonic, 1),
                "estimator": f"{first.estimator}, {first.window}",
            }
        )
    hashes = ({"log": name, "SHA-256": sha} for name, sha in gains.logs.items())
    return Section(
        "excitation",
        "Excitation",
        f"Logs of {'the virtual robot' if gains.virtual else 'the robot'} ({gains.robot}).",
        sheet(rows),
        Fold("SHA-256 of the logs", sheet(hashes)),
    )
