"""Page of a match: gains, Bode plots, error maps, training ranges, what they rest on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pronk.errors import ArtefactError, RobotError
from pronk.files import write_text
from pronk.identify.match import result as result_file
from pronk.identify.match.gains import Interval, MatchedGains
from pronk.identify.match.parameters import PARAMETERS
from pronk.identify.match.predict import Prediction, load_prediction
from pronk.identify.match.result import HELD_OUT, JointResult, MatchResult
from pronk.identify.match.torque_fit import UNITS
from pronk.jump.trial.tables import Sheet, table
from pronk.report import figures
from pronk.report.page import Part, page
from pronk.report.paper import RANGES, ROBOT, TABLE_I, TRAINING
from pronk.report.style import joint_words, picture
from pronk.robots import load_robot
from pronk.robots.robot import Joint

PAGE_NAME = "match.html"


def find_gains(folder: Path) -> Path:
    """Return the gains file of a folder: `gains.yaml`, or the only YAML file with that schema."""
    if not folder.is_dir():
        raise ArtefactError(
            f"{folder}: no such folder; give the one that `pronk match --out` wrote to."
        )
    if (usual := folder / "gains.yaml").exists():
        return usual
    schema, files = "schema: pronk/gains/", folder.glob("*.yaml")
    found = [path for path in files if schema in path.read_text("utf-8", "replace")[:200]]
    if len(found) == 1:
        return found[0]
    what = "several gains files and none is called" if found else "no"
    raise ArtefactError(f"{folder}: {what} gains.yaml; `pronk match LOG... --out` writes one.")


def robot_joints(gains: MatchedGains) -> dict[str, Joint]:
    """Return the robot's description of each matched joint; empty for an unknown robot."""
    try:
        known = load_robot(gains.robot).joints
    except RobotError:
        return {}
    return {joint.name: joint for joint in known if joint.name in gains.joints}


def group_members(gains: MatchedGains) -> dict[str, list[str]]:
    """Return the matched joints of each group, by the robot or, if unknown, by their names."""
    known = robot_joints(gains)
    found: dict[str, list[str]] = {}
    for group in gains.groups:
        for name in gains.joints:
            if known[name].group == group if name in known else name.endswith(group):
                found.setdefault(group, []).append(name)
    return found


def verdict(result: MatchResult) -> dict[str, Any]:
    """Return the figures of the summary."""
    return {
        "robot": result.robot,
        "virtual": result.virtual,
        "joints": len(result.joints),
        "matched": len(result.matched_joints),
        "naive_error_db": result.nominal_error_db,
        "error_db": result.error_db,
        "worst": result.worst_joint,
        "flags": result.flags,
    }


def write_page(folder: Path, *, gains: str | None = None) -> tuple[Path, Part]:
    """Write the page of the match in a folder, as of `part`; return its path and its part."""
    made = replace(part(folder / "match.npz", gains), source="match.npz")
    write_text(folder / PAGE_NAME, page(made.title, [made]))
    return folder / PAGE_NAME, made


def part(path: Path, gains: str | None = None) -> Part:
    """Make the part of a `match.npz` and the gains file beside it, of this name or found."""
    gains_path = path.parent / gains if gains else find_gains(path.parent)
    result = result_file.load(path)
    own, found, drives = result.gains, verdict(result), drives_table(result)
    fits = {name: one for name, one in result.joints.items() if one.responses is not None}
    in_time = any(joint.fit.moved_together for joint in result.joints.values())
    searched = any(one.grid is not None for one in result.joints.values())
    order = figures.knees_first(list(fits))
    members = group_members(own)
    drive = {name: (one.stiffness, one.damping) for name, one in robot_joints(own).items()}
    bare = [name for name in order if fits[name].zero_armature is not None]
    content = {
        "found": found,
        "gains": own,
        "gains_file": gains_path.name,
        "where": "the virtual robot" if own.virtual else "the robot",
        "in_time": in_time,
        "gains_table": gains_table(own, in_time),
        "drives": drives,
        "held_out": _held_out_table(result),
        "overview": picture(figures.overview(fits)) if fits else None,
        "bode": {name: picture(figures.bode(fits[name])) for name in order},
        "maps": picture(figures.error_maps(result, drive)) if searched else None,
        "ranges": picture(figures.ranges(own, members)) if members else None,
        "ranges_table": ranges_table(own, members),
        "bare": picture(figures.zero_armature(fits[bare[0]])) if bare else None,
        "bare_table": _zero_armature_table(fits),
        "predictions": [
            _prediction_section(found)
            for found in map(load_prediction, sorted(path.parent.glob("*.prediction.npz")))
            if found.joints
        ],
        "scale": None if in_time else _scale_table(own, members, drive),
        "estimators": sorted(
            {
                f"{measured.estimator}, {measured.window}"
                for measured in (figures.compared(fit).measured[0] for fit in fits.values())
            }
        ),
        "excitation": _excitation_table(fits),
        "amplitudes": _amplitude_table(fits),
        "logs": table("log | SHA-256", own.logs.items()),
    }
    return Part(
        kind="match",
        title=f"Match of {own.robot}",
        virtual=own.virtual,
        summary=f"{found['matched']} of {found['joints']} joints matched."
        if fits or not drives.rows
        else f"Drives of {found['joints']} joints fitted by torque.",
        warning=found["matched"] < found["joints"] or bool(found["flags"]),
        content=content,
        figures=found,
    )


def gains_table(gains: MatchedGains, in_time: bool) -> Sheet:
    """Return the matched gains of each joint, beside the paper's for its robot."""
    paper, joints = _comparable(gains), gains.joints.values()
    delays = any(joint.delay_s.value > 0.0 for joint in joints)
    total = any(np.isfinite(joint.stiffness.total95).all() for joint in joints)
    friction = any(np.isfinite(joint.frictionloss.value) for joint in joints)
    falls = any(joint.stribeck.value > 0.0 for joint in joints)
    names = (joint_words(k) + " (flagged)" * bool(v.flags) for k, v in gains.joints.items())
    published = (" / ".join(map(str, TABLE_I.get(name, ("-",)))) for name in gains.joints)
    repeats = "repeat 95 %" if total else "95 %"
    moving = [one.frictionloss.value * (1.0 - one.stribeck.value) for one in joints]
    columns: list[tuple[bool, str, Iterable[Any]]] = [
        (True, "joint", names),
        (True, "stiffness [N m/rad];2", (one.stiffness.value for one in joints)),
        (True, f"{repeats};2", (_interval(one.stiffness.repeat95) for one in joints)),
        (total, "total 95 %;2", (_interval(one.stiffness.total95) for one in joints)),
        (True, "damping [N m s/rad]", (one.damping.value for one in joints)),
        (True, repeats, (_interval(one.damping.repeat95) for one in joints)),
        (total, "total 95 %", (_interval(one.damping.total95) for one in joints)),
        (friction, "friction [N m]", (one.frictionloss.value for one in joints)),
        (falls, "in motion [N m]", moving),
        (delays, "delay [ms];1", (1000.0 * one.delay_s.value for one in joints)),
        (paper, "paper, Table I", published),
        (True, "nominal error [dB];2", (one.quality.nominal_error_db for one in joints)),
        (True, "error [dB];2", (one.quality.error_db for one in joints)),
        (True, "lowest coherence", (one.quality.coherence_min for one in joints)),
    ]
    shown = [(head, cells) for wanted, head, cells in columns if wanted]
    simulator = gains.simulator
    notes = [
        f"Equivalent gains of {simulator.engine} at a step of {1000.0 * simulator.timestep_s:g} ms "
        "and with the inertia of this model, not the gains of the drive itself."
    ]
    if total:
        notes.append(
            "repeat: spread of the repeats. total: also the change between amplitudes and between "
            "parts of the excitation."
        )
    else:
        notes.append(f"95 % intervals over {'blocks of the recordings' if in_time else 'repeats'}.")
    if delays and not (in_time or total):
        notes.append("delay: lag of the measured phase behind the matched simulation.")
    if paper and gains.virtual:
        notes.append(
            "Table I was measured on the paper's robot; the virtual robot's hidden parameters were "
            "set so that a match by magnitude lands near it."
        )
    rows = zip(*(cells for _, cells in shown), strict=True)
    return table(" | ".join(head for head, _ in shown), rows, *notes)


def _interval(ends: Interval) -> Interval | str:
    """Return an interval as the cell of a table; a value without one was held."""
    return ends if np.isfinite(ends).all() else "held"


def _comparable(gains: MatchedGains) -> bool:
    """True for the paper's robot in a simulator with the paper's drive law."""
    return gains.robot == ROBOT and gains.simulator.law == "explicit"


def drives_table(result: MatchResult) -> Sheet:
    """Every fitted parameter of each joint with its interval, by position and by torque."""
    rows = []
    for name, joint in result.gains.joints.items():
        found: list[tuple[str, str, float, tuple[float, float], str]] = []
        if fit := result.joints.get(name):
            for one in (one for one in PARAMETERS if one in fit.fit.ci95):
                value = fit.fit.values[one]
                ends = fit.fit.total95.get(one, fit.fit.ci95[one])
                found.append((one, PARAMETERS[one].unit, value, ends, "position"))
        for term, by in joint.torque.items():
            words = "torque" if by.identified else f"not identified by torque: {by.reason}"
            found.append((term, UNITS[term], by.value if by.identified else np.nan, by.ci95, words))
        for term, unit, value, ends, words in found:
            known = np.isfinite(value)
            cells = (f"{value:.4g}", "{:.4g} to {:.4g}".format(*ends)) if known else ("-", "-")
            rows.append((joint_words(name), f"{term} [{unit}]", *cells, words))
    note = (
        "scale: torque column over the joint's torque. dry and viscous: friction of the joint. "
        "Where the scale is not identified, values by torque are in the column's unit of torque. "
        "The column is taken for measured torque; a commanded one is not what the drive gave."
    )
    by_torque = any(joint.torque for joint in result.gains.joints.values())
    return table("joint | parameter | value | 95 % | by", rows, *[note] * by_torque)


def _held_out_table(result: MatchResult) -> Sheet:
    """Errors on what the fits did not use."""
    rows = [
        (joint_words(name), *(1e3 * one.fit.held_out[key] for key in HELD_OUT))
        for name, one in result.joints.items()
        if one.fit.held_out
    ]
    return table(
        "joint | nominal;2 | nominal with the best delay;2 | plain fit;2 | matched;2",
        rows,
        "RMSE [mrad] on the last repeat of each amplitude (every fourth part where there is one), "
        "which these fits did not use; each octave counts alike. plain fit: stiffness, damping "
        "and delay, with the model's friction.",
    )


def ranges_table(gains: MatchedGains, members: Mapping[str, list[str]]) -> Sheet:
    """Return the range that training draws from for each joint group."""
    paper, rows = _comparable(gains), []
    for name, one in gains.groups.items():
        row = [joint_words(name), f"{one.stiffness:.2f} ± {one.stiffness_range:.2f}"]
        row.append(f"{one.damping:.3f} ± {one.damping_range:.3f}")
        if paper:
            k, d = TRAINING.get(name, ("-", "-"))
            row.append(f"{k} ± {RANGES[0]}, {d} ± {RANGES[1]}")
        rows.append([*row, ", ".join(map(joint_words, members.get(name, [])))])
    columns = "group | stiffness [N m/rad] | damping [N m s/rad]"
    columns += " | paper's training gains" * paper + " | joints"
    note = (
        "The paper's hip roll damping of FL, 0.516, is outside its own range 0.45 ± 0.05 "
        "(reading A13)."
    )
    return table(columns, rows, *[note] * paper)


def _zero_armature_table(fits: Mapping[str, JointResult]) -> Sheet:
    rows = []
    for name, fit in fits.items():
        if fit.zero_armature is not None:
            error = fit.zero_armature.error_db
            matched = figures.compared(fit).error_db
            verdict = "no match" if fit.zero_armature.ruled_out else "not excluded"
            rows.append((joint_words(name), error, matched, error / max(matched, 1e-6), verdict))
    columns = "joint | best error without rotor inertia [dB];2 | matched error [dB];2 | ratio;1"
    return table(f"{columns} | without rotor inertia", rows)


def _prediction_section(found: Prediction) -> dict[str, Any]:
    """Figure and table of a replayed log."""
    by_joint, rows = {one.joint: one for one in found.joints}, []
    first = figures.knees_first(list(by_joint))[0]
    for one in found.joints:
        errors = (one.rmse_nominal, one.rmse_nominal_delayed, one.rmse_matched)
        ratio = one.rmse_matched / one.rmse_nominal if one.rmse_nominal > 0.0 else None
        fits = (one.r2_nominal, one.r2_matched)
        rows.append((joint_words(one.joint), one.unit, *errors, ratio, *fits))
    columns = "joint | unit | RMSE nominal;4 | nominal with the delay;4 | RMSE matched;4"
    columns += " | matched / nominal;2 | R² nominal | R² matched"
    figure = picture(figures.prediction(by_joint[first], virtual=found.virtual))
    shown = {"figure": figure, "table": table(columns, rows)}
    return {"source": found.source, "joint": first} | shown


def _scale_table(
    gains: MatchedGains, members: Mapping[str, list[str]], drive: Mapping[str, tuple[float, float]]
) -> Sheet:
    """Mean ratio of matched gains and those of the real drive, by joint group."""
    rows = []
    for group, names in members.items():
        if known := [name for name in names if min(drive.get(name, (0.0,))) > 0.0]:
            joints = [gains.joints[name] for name in known]
            own = [(joint.stiffness.value, joint.damping.value) for joint in joints]
            ratios = np.array(own) / np.array([drive[name] for name in known])
            rows.append((joint_words(group), *ratios.mean(axis=0)))
    return table(
        "group | stiffness, matched / real drive;2 | damping, matched / real drive;2",
        rows,
        "Either the simulated gains are to be scaled, or the simulated inertia is too large by "
        "this ratio. In the air both give the same motion; on the ground they differ.",
    )


def _excitation_table(fits: Mapping[str, JointResult]) -> Sheet:
    rows = []
    for name, fit in fits.items():
        responses = figures.compared(fit)
        first = responses.measured[0]
        band = first.band(*responses.band_hz)
        amplitudes = ", ".join(f"{one.amplitude:g}" for one in responses.measured)
        compared = f"{responses.band_hz[0]:g} to {responses.band_hz[1]:g}"
        coherence = first.coherence[band].min() if band.any() else None
        row = (joint_words(name), amplitudes, len(first.repeats), compared, coherence)
        rows.append((*row, 1000.0 * first.delay_s, 100.0 * first.third_harmonic))
    columns = "joint | amplitudes [rad] | repeats | compared [Hz] | lowest coherence"
    return table(f"{columns} | delay by phase [ms];1 | third harmonic [%];1", rows)


def _amplitude_table(fits: Mapping[str, JointResult]) -> Sheet:
    rows = [
        (joint_words(name), *gains)
        for name, one in fits.items()
        if len(one.fit.amplitude_gains) > 1
        for gains in sorted(one.fit.amplitude_gains.tolist(), reverse=True)
    ]
    columns = "joint | amplitude [rad] | stiffness [N m/rad];2 | damping [N m s/rad]"
    return table(columns, rows, "Dry friction and backlash weigh more in small motions.")
