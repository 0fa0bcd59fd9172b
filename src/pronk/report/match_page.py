"""Page of a match: gains, Bode plots, error maps, training ranges, what they rest on."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from pronk.errors import ArtefactError, RobotError
from pronk.files import write_text
from pronk.match import gains as gains_file
from pronk.match import result as result_file
from pronk.match.gains import MatchedGains
from pronk.match.predict import load_prediction
from pronk.match.result import ZERO_ARMATURE, JointFit, MatchResult
from pronk.report import figures
from pronk.report.page import Code, Content, Fold, Part, Section, page, picture, table
from pronk.report.paper import published
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
    if (folder / "gains.yaml").exists():
        return folder / "gains.yaml"
    schema = f"schema: {gains_file.SCHEMA}"
    texts = {path: path.read_text("utf-8", "replace") for path in folder.glob("*.yaml")}
    found = [path for path, text in texts.items() if schema in text[:200]]
    if len(found) == 1:
        return found[0]
    what = "several gains files and none is called" if found else "no"
    raise ArtefactError(f"{folder}: {what} gains.yaml; `pronk match LOG... --out` writes one.")


def load(folder: Path) -> MatchResult:
    """Read the match of a folder.

    Raises:
        ArtefactError: The folder has no gains or no `match.npz`, or one of them is damaged.
    """
    return result_file.load(folder / "match.npz", gains_file.load(find_gains(folder)))


def group_members(gains: MatchedGains) -> dict[str, list[str]]:
    """Return the matched joints of each group, by the robot or, if unknown, by their names."""
    try:
        group_of = {joint.name: joint.group for joint in load_robot(gains.robot).joints}
    except RobotError:
        group_of = {j: name for name in gains.groups for j in gains.joints if j.endswith(name)}
    found = {n: [j for j in gains.joints if group_of.get(j) == n] for n in gains.groups}
    return {name: joints for name, joints in found.items() if joints}


def drive_gains(gains: MatchedGains) -> dict[str, tuple[float, float]]:
    """Return (stiffness, damping) of each joint's real drive; empty for an unknown robot."""
    try:
        joints = load_robot(gains.robot).joints
    except RobotError:
        return {}
    return {one.name: (one.stiffness, one.damping) for one in joints if one.name in gains.joints}


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


def write_page(out_dir: Path, *, gains: str | None = None) -> tuple[Path, Part]:
    """Write the page of the match in `out_dir`; return its path and its part.

    `gains` is the name of the gains file in it, found by `find_gains` if None.

    Raises:
        ArtefactError: The folder has no gains or no `match.npz`, or one of them is damaged.
    """
    made = part(out_dir / "match.npz", out_dir, gains=gains)
    write_text(out_dir / PAGE_NAME, page(made.title, [made]))
    return out_dir / PAGE_NAME, made


def _where(virtual: bool) -> str:
    return "the virtual robot" if virtual else "the robot"


def part(
    path: Path, root: Path, *, anchor: str = "match", title: str = "Match", gains: str | None = None
) -> Part:
    """Make the part of the match in `path`, a `match.npz`; arguments as of `write_page`.

    Raises:
        ArtefactError: An artefact is missing or damaged.
    """
    folder = path.parent
    gains_path = folder / gains if gains else find_gains(folder)
    result = result_file.load(path, gains_file.load(gains_path))
    own, found, worst = result.gains, verdict(result), verdict(result)["worst"]
    lines = [
        f"Gain error in the compared band, RMS over the joints of {_where(own.virtual)}: "
        f"{found['naive_error_db']:.2f} dB with the nominal gains of the real drive, "
        f"{found['error_db']:.2f} dB with the matched gains."
    ]
    if worst:
        lines.append(f"Largest error: {joint_words(worst)}, {own.joints[worst].error_db:.2f} dB.")
    if own.virtual:
        lines.append(
            "Every measured number on this page is of pronk's virtual robot, a simulated machine "
            "that stands in for hardware; none is of a real robot."
        )
    lines += [f"{joint_words(name)}: {'; '.join(flags)}." for name, flags in found["flags"].items()]
    fits = {name: fit for name, fit in result.joints.items() if fit.responses}
    # Without a grid several joints moved at once and were fitted in time.
    in_time = not any(fit.grid_error.size for fit in result.joints.values())
    return Part(
        anchor=anchor,
        title=f"{title} of {own.robot}",
        source=str(path.relative_to(root)),
        virtual=own.virtual,
        summary=f"{found['matched']} of {found['joints']} joints matched.",
        lines=lines,
        warning=found["matched"] < found["joints"] or bool(found["flags"]),
        sections=[
            _gains(own, in_time),
            _bode(fits, in_time) if fits else None,
            None if in_time else _maps(result),
            _ranges(own),
            _without_armature(fits),
            _predictions(folder),
            _identifiability(own, in_time),
            _use(own, gains_path.name),
            _excitation(own, fits),
        ],
        note="; ".join(f"{joint_words(stage)} {s:.1f} s" for stage, s in result.seconds.items()),
        figures=found,
    )


def _gains(gains: MatchedGains, in_time: bool) -> Section:
    paper = published(gains.robot)
    delays = any(joint.delay_s > 0.0 for joint in gains.joints.values())
    columns = "joint | stiffness [N m/rad];2 | 95 %;2 | damping [N m s/rad] | 95 %"
    columns += " | paper, Table I" * bool(paper) + " | friction [N m]" * in_time
    columns += " | delay [ms];1" * delays
    columns += " | nominal error [dB];2 | error [dB];2 | lowest coherence"
    rows = []
    for name, one in gains.joints.items():
        row: list[Any] = [joint_words(name) + " (flagged)" * bool(one.flags)]
        row += [one.stiffness, one.stiffness_ci95, one.damping, one.damping_ci95]
        row += [" / ".join(map(str, paper.joints.get(name, ("-",))))] if paper else []
        row += [one.frictionloss] * in_time + [1000.0 * one.delay_s] * delays
        rows.append([*row, one.naive_error_db, one.error_db, one.coherence_min])
    unit = "blocks of the recordings" if in_time else "repeats"
    notes = [f"95 % intervals over {unit}, not samples."]
    if delays and not in_time:
        notes.append("delay: lag of the measured phase behind the matched simulation.")
    if paper and gains.virtual:
        notes.append(
            "Table I was measured on the paper's robot; the virtual robot's hidden parameters were "
            "set so that a match lands near it."
        )
    return Section("Matched gains", table(columns, rows, *notes))


def _bode(fits: Mapping[str, JointFit], in_time: bool) -> Section:
    names = figures.knees_first(list(fits))
    where = _where(fits[names[0]].responses[0].virtual)
    compared = (
        "Several joints moved at once and were fitted in time."
        if in_time
        else "Only the gain at the tinted frequencies was compared."
    )
    words = f"measured on {where} and simulated"
    first, *rest = (
        picture(figures.bode(fits[name]), f"Bode plot of {name}: gain and phase, {words}")
        for name in names
    )
    return Section(
        "Bode plots",
        f"From the held position command to the position of {where}. Numbers in the corners: gain "
        f"error with nominal and with matched gains. {compared}",
        picture(figures.overview(fits), f"Gain over frequency of every joint, {words}"),
        first,
        Fold(f"Bode plots of the other {len(rest)} joints", *rest),
    )


def _maps(result: MatchResult) -> Section:
    figure = figures.error_maps(result, drive_gains(result.gains))
    return Section(
        "Error maps",
        "Error of the simulated gain at every pair of the grid. A long valley means that the data "
        "determine a combination of stiffness and damping better than either alone.",
        picture(figure, "Gain error over the grid of stiffness and damping for every joint"),
    )


def _ranges(gains: MatchedGains) -> Section:
    paper, members, rows = published(gains.robot), group_members(gains), []
    for name, one in gains.groups.items():
        row = [joint_words(name), f"{one.stiffness:.2f} ± {one.stiffness_range:.2f}"]
        row.append(f"{one.damping:.3f} ± {one.damping_range:.3f}")
        if paper:
            k, d = paper.training.get(name, ("-", "-"))
            row.append(f"{k} ± {paper.stiffness_range}, {d} ± {paper.damping_range}")
        rows.append([*row, ", ".join(map(joint_words, members.get(name, [])))])
    columns = "group | stiffness [N m/rad] | damping [N m s/rad]"
    columns += " | paper's training gains" * bool(paper) + " | joints"
    note = (
        "One cell of the paper's data lies outside its own range: the hip roll damping of FL, "
        "0.516, outside 0.45 ± 0.05 (reading A13).",
    )
    words = "Matched gains of the joints of each group and the ranges that training draws from"
    return Section(
        "Training ranges",
        "The box covers the intervals of all joints of a group, in the paper's steps (0.5 N m/rad "
        "and 0.05 N m s/rad); the smallest ellipse leaves out its corners, which no joint has.",
        picture(figures.ranges(gains, members), words) if members else None,
        table(columns, rows, *(note if paper else ())),
    )


def _without_armature(fits: Mapping[str, JointFit]) -> Section | None:
    drawn = [name for name, fit in fits.items() if fit.zero_armature is not None]
    if not drawn:
        return None
    rows = []
    for name, fit in fits.items():
        error = fit.zero_armature_error_db
        lost = any(flag.startswith(f"{ZERO_ARMATURE}no match") for flag in fit.flags)
        if np.isfinite(error):
            ratio = error / max(fit.error_db, 1e-6)
            found = "no match" if lost else "not excluded"
            rows.append((joint_words(name), error, fit.error_db, ratio, found))
    columns = "joint | best error without rotor inertia [dB];2 | matched error [dB];2 | ratio;1"
    figure = figures.zero_armature(fits[figures.knees_first(drawn)[0]])
    return Section(
        "Without rotor inertia",
        "The same search with zero armature. Through the gear the rotor is much of the inertia of "
        "a light link, and no gains make up for it; a heavy link hides it.",
        picture(figure, "Gain over frequency with and without rotor inertia in the simulator"),
        table(f"{columns} | without rotor inertia", rows),
    )


def _predictions(folder: Path) -> Section | None:
    content: list[Content | None] = []
    columns = "joint | unit | RMSE nominal;4 | nominal with the delay;4 | RMSE matched;4"
    columns += " | matched / nominal;2 | R² nominal | R² matched"
    for path in sorted(folder.glob("*.prediction.npz")):
        found = load_prediction(path)
        if not found.joints:
            continue
        by_joint = {one.joint: one for one in found.joints}
        first = by_joint[figures.knees_first(list(by_joint))[0]]
        rows = []
        for one in found.joints:
            errors = (one.rmse_naive, one.rmse_naive_delayed, one.rmse_matched)
            ratio = one.rmse_matched / one.rmse_naive if one.rmse_naive > 0.0 else None
            rows.append(
                (joint_words(one.joint), one.unit, *errors, ratio, one.r2_naive, one.r2_matched)
            )
        where = _where(found.virtual)
        words = f"Position of {first.joint} over time: command, measured on {where}, simulated"
        content += [
            f"{found.source}, measured on {where}, was not used by the match.",
            picture(figures.prediction(first, virtual=found.virtual), words),
            table(columns, rows),
        ]
    return Section("Prediction of fresh logs", *content) if content else None


def _identifiability(gains: MatchedGains, in_time: bool) -> Section:
    rows, drive = [], drive_gains(gains)
    for group, joints in group_members(gains).items():
        ratios = [
            (
                gains.joints[name].stiffness / drive[name][0],
                gains.joints[name].damping / drive[name][1],
            )
            for name in joints
            if min(drive.get(name, (0.0,))) > 0.0
        ]
        if ratios and not in_time:
            rows.append((joint_words(group), *np.mean(ratios, axis=0)))
    text = (
        "The magnitude of a response determines stiffness over inertia and damping over inertia. "
        "The gains on this page rest on the inertia of the simulator's model, which was held "
        "fixed: if it is ten per cent too large, both gains come out ten per cent too large, and "
        "no plot here would show it."
    )
    in_time_text = (
        "Parameters that these recordings do not determine were held at their published values "
        "and are flagged. Stiffness, damping and inertia scaled by the same factor give the same "
        "motion, except where gravity loads the joint."
    )
    return Section(
        "What cannot be identified",
        in_time_text if in_time else text,
        table(
            "group | stiffness, matched / real drive;2 | damping, matched / real drive;2",
            rows,
            "Either the simulated gains are to be scaled, or the simulated inertia is too large by "
            "this ratio. In the air both give the same motion; on the ground they differ.",
        ),
        "The same sweep in a second pose, with a known payload, with recorded torque or with other "
        "gains on the drive separates stiffness, damping and inertia.",
    )


def _use(gains: MatchedGains, name: str) -> Section:
    one = gains.simulator
    text = Markup(
        "<p>They hold for <strong>{} {}</strong> alone: physics step {:g} ms, decimation {}, "
        "integrator {}, actuator {}, with the armatures in <code>{}</code>. Match again for "
        "another step or another actuator law.</p>"
    )
    settings = (1000.0 * one.timestep_s, one.decimation, one.integrator, one.actuator)
    commands = [f"pronk export {name} --to {to}" for to in ("mjlab", "mjcf", "isaaclab")]
    commands.append(f"pronk predict LOG --robot {gains.robot} --gains {name}")
    return Section(
        "Use the gains",
        text.format(one.engine, one.version, *settings, name),
        Code("\n".join(commands)),
    )


def _excitation(gains: MatchedGains, fits: Mapping[str, JointFit]) -> Section:
    rows, amplitudes = [], []
    for name, fit in fits.items():
        first = fit.responses[0]
        band = first.band(*fit.band_hz)
        row = [joint_words(name), ", ".join(f"{r.amplitude:g}" for r in fit.responses)]
        row += [str(len(first.repeats)), f"{fit.band_hz[0]:g} to {fit.band_hz[1]:g}"]
        coherence = first.coherence[band].min() if band.any() else None
        rows.append([*row, coherence, 1000.0 * first.delay_s, 100.0 * first.third_harmonic])
        one = sorted(fit.amplitude_gains.tolist(), reverse=True)
        amplitudes += [(joint_words(name), *gains_at) for gains_at in one if len(one) > 1]
    columns = "joint | amplitudes [rad] | repeats | compared [Hz] | lowest coherence"
    columns += " | delay by phase [ms];1 | third harmonic [%];1"
    used = {f"{fit.responses[0].estimator}, {fit.responses[0].window}" for fit in fits.values()}
    at = "joint | amplitude [rad] | stiffness [N m/rad];2 | damping [N m s/rad]"
    why = "Dry friction and backlash weigh more in small motions."
    return Section(
        "Excitation",
        f"Logs of {_where(gains.virtual)} ({gains.robot}). {'; '.join(sorted(used))}.",
        table(columns, rows),
        Fold("Gains matched at each amplitude by itself", table(at, amplitudes, why)),
        Fold("SHA-256 of the logs", table("log | SHA-256", gains.logs.items())),
    )
