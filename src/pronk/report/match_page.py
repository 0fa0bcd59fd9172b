"""Page of a match: gains, Bode plots, error maps, training ranges, what they rest on."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pronk.errors import ArtefactError, PronkError
from pronk.identify.match import tables
from pronk.identify.match.export.actuators import robot_of
from pronk.identify.match.export.targets import accepts
from pronk.identify.match.gains import MatchedGains, load_gains
from pronk.identify.match.predict import Prediction, load_prediction
from pronk.identify.match.result import HELD_OUT, JointResult, MatchResult, load_match
from pronk.identify.simulators.profiles import profile_of
from pronk.report import figures
from pronk.report.charts import bode_chart
from pronk.report.page import Part
from pronk.report.paper import RANGES, ROBOT, TABLE_I, TRAINING
from pronk.report.style import joint_words, picture
from pronk.robots.robot import Joint
from pronk.tables import Cell, Column, Table, counted

_GAINS_SCHEMA = "schema: pronk/gains/"
"""Text near the beginning of every gains file."""
HEADER_CHARACTERS = 4000
"""Characters in which the schema of a gains file stands, below its header for people."""
ISAAC_LAB = "isaaclab-implicit"
"""Profile of Isaac Lab's default actuator, and its export."""
JOINT = Column(heading="joint")
WRITTEN_DIGITS = 1e-5
"""Relative difference of gains up to which they are the same, for a file has six digits."""


def match_part(path: Path) -> Part:
    """Make the part of the page for a `match.npz` and the gains file beside it.

    Raises:
        ArtefactError: A file is missing or damaged.
    """
    result = load_match(path)
    gains_path = find_gains(path.parent, result.gains)
    matched = len(result.matched_joints)
    compared = {}
    for name, joint in result.joints.items():
        if joint.responses is not None:
            compared[name] = joint
    if compared or not any(joint.gains.torque for joint in result.joints.values()):
        summary = _headline(result, matched)
    else:
        summary = f"{counted(len(result.joints), 'drive')} fitted by torque."
    return Part(
        kind="match",
        title=f"Match of {result.robot}",
        virtual=result.virtual,
        summary=summary,
        warning=matched < len(result.joints) or bool(result.flags),
        content=_content(result, compared, gains_path),
        figures=result.summary(),
    )


def _headline(result: MatchResult, matched: int) -> str:
    """Return the outcome of a match in words: joints, largest error, flags."""
    count = len(result.joints)
    phrases = [f"{counted(count, 'joint')} matched"]
    if matched < count:
        phrases = [f"{matched} of {counted(count, 'joint')} matched"]
    if result.worst_joint:
        error_db = result.joints[result.worst_joint].gains.quality.error_db
        phrases.append(f"largest error {error_db:.2f} dB ({joint_words(result.worst_joint)})")
    flagged = len(result.flags)
    if flagged == 0:
        phrases.append("no flags")
    else:
        phrases.append(f"{counted(flagged, 'joint')} flagged")
    return f"{'; '.join(phrases)}."


def find_gains(folder: Path, gains: MatchedGains | None = None) -> Path:
    """Return the gains file of a folder.

    Args:
        folder: The folder.
        gains: Gains of the match whose file is asked for, where there are several files.

    Returns:
        The file with these gains, or else `gains.yaml`, or the only YAML file with that schema.

    Raises:
        ArtefactError: There is none, or several of which none is called `gains.yaml`.
    """
    if not folder.is_dir():
        raise ArtefactError(
            f"{folder}: no such folder; give the one that `pronk match --out` wrote to."
        )
    usual = folder / "gains.yaml"
    candidates = []
    for path in sorted(folder.glob("*.yaml")):
        if _GAINS_SCHEMA in path.read_text("utf-8", "replace")[:HEADER_CHARACTERS]:
            candidates.append(path)
    if gains is not None and len(candidates) > 1:
        same = [path for path in candidates if _holds(path, gains)]
        if same:
            candidates = same
    if usual in candidates or (usual.exists() and not candidates):
        return usual
    if len(candidates) == 1 or (candidates and gains is not None):
        return candidates[0]
    what = "several gains files and none is called" if candidates else "no"
    raise ArtefactError(f"{folder}: {what} gains.yaml; `pronk match LOG... --out` writes one.")


def _holds(path: Path, gains: MatchedGains) -> bool:
    """Return whether a gains file holds the gains of a match."""
    try:
        stored = load_gains(path)
    except PronkError:
        return False
    if stored.logs != gains.logs or set(stored.joints) != set(gains.joints):
        return False
    for name, joint in gains.joints.items():
        stored_stiffness = stored.joints[name].stiffness.value
        if not math.isclose(stored_stiffness, joint.stiffness.value, rel_tol=1e-3):
            return False
    return True


def _content(
    result: MatchResult, compared: Mapping[str, JointResult], gains_path: Path
) -> dict[str, Any]:
    """Return the variables of the template.

    Args:
        result: The match.
        compared: Its joints with a response.
        gains_path: The gains file beside it.
    """
    gains = result.gains
    fitted_together = any(joint.fit.moved_together for joint in result.joints.values())
    has_grid = any(joint.grid is not None for joint in result.joints.values())
    robot_joints = _robot_joints(result)
    members = result.joints_of_groups(robot_joints)
    drive_gains = {name: (joint.stiffness, joint.damping) for name, joint in robot_joints.items()}
    for name, joint_result in result.joints.items():
        if joint_result.drive_gains is not None:
            drive_gains[name] = joint_result.drive_gains
    order = figures.knees_first(list(compared))
    charts = {}
    chart_notes = {}
    for name in order:
        responses = figures.compared_responses(compared[name])
        charts[name] = bode_chart(responses, joint_words(name))
        chart_notes[name] = (
            f"error {responses.error_db:.2f} dB, with nominal gains "
            f"{responses.nominal_error_db:.2f} dB"
        )
    without_armature = [name for name in order if compared[name].zero_armature is not None]
    estimators = set()
    for joint in compared.values():
        first = figures.compared_responses(joint).measured[0]
        estimators.add(f"{first.estimator}, {first.window}")
    exports = _exports(result)
    predictions = []
    checks = []
    of_other_gains = []
    for prediction_path in sorted(gains_path.parent.glob("*.prediction.npz")):
        prediction = load_prediction(prediction_path)
        if not prediction.joints:
            continue
        if not _is_of(prediction, gains):
            of_other_gains.append(prediction_path.name)
        elif prediction.fitted:
            checks.append(_prediction_section(prediction))
        else:
            predictions.append(_prediction_section(prediction))
    return {
        "result": result,
        "gains": gains,
        "gains_file": gains_path.name,
        "where": "the virtual robot" if result.virtual else "the robot",
        "in_time": fitted_together,
        "gains_table": _gains_table(result),
        "gains_details": tables.gains_table(result),
        "published_table": _published_table(result),
        "drives": tables.drives_table(result),
        "held_out": _held_out_table(result),
        "overview": picture(figures.overview(compared)) if compared else None,
        "charts": charts,
        "chart_notes": chart_notes,
        "maps": picture(figures.error_maps(result, drive_gains)) if has_grid else None,
        "ranges": picture(figures.ranges(gains, members)) if members else None,
        "ranges_table": tables.ranges_table(result, members),
        "published_ranges": _published_ranges_table(result),
        "bare": picture(figures.zero_armature(compared[without_armature[0]]))
        if without_armature
        else None,
        "bare_table": _zero_armature_table(compared),
        "predictions": predictions,
        "checks": checks,
        "of_other_gains": of_other_gains,
        "scale": None if fitted_together else _scale_table(result, members, drive_gains),
        "estimators": sorted(estimators),
        "excitation": _excitation_table(compared),
        "amplitudes": _amplitude_table(compared),
        "logs": _logs_table(result),
        "exports": exports,
        "translated": bool(exports) and result.simulator.profile != ISAAC_LAB,
    }


def _gains_table(result: MatchResult) -> Table:
    """Make the table of the matched gains with the quality of each joint first."""
    table = tables.gains_summary_table(result)
    columns = (
        table.columns[0],
        Column(heading="nominal error", unit="dB", digits=2),
        Column(heading="error", unit="dB", digits=2),
        *table.columns[1:-1],
    )
    rows: list[tuple[Cell, ...]] = []
    for (name, joint), row in zip(result.joints.items(), table.rows, strict=True):
        label = f"{joint_words(name)} (flagged)" if joint.gains.flags else joint_words(name)
        rows.append((label, joint.gains.quality.nominal_error_db, row[-1], *row[1:-1]))
    note = (
        "Behind +-: half of the 95 % interval, with what the model does not explain. The gains are "
        "equivalent gains of this simulator at its step, not those of the drive itself."
    )
    return Table(title=table.title, columns=columns, rows=tuple(rows), notes=(note,))


def _exports(result: MatchResult) -> list[tuple[str, str]]:
    """Return the exports that take these gains as they are, each with the name of its file.

    There are none for a simulator whose drive law pronk does not know.
    """
    try:
        held_profile = profile_of(result.simulator)
    except PronkError:
        return []
    if held_profile.name == ISAAC_LAB:
        return [(ISAAC_LAB, "actuators.py")]
    exports = []
    for target, file in (("mjlab", "actuators.py"), ("mjcf", "robot.xml")):
        if accepts(target, held_profile):
            exports.append((target, file))
    return exports


def _robot_joints(result: MatchResult) -> dict[str, Joint]:
    """Return the robot's description of each matched joint; empty for an unknown robot."""
    try:
        robot = robot_of(result.gains)
    except PronkError:
        return {}
    return {joint.name: joint for joint in robot.joints if joint.name in result.joints}


def _is_papers(result: MatchResult) -> bool:
    """Return whether the match is of the paper's robot in a simulator with the paper's law."""
    return result.robot == ROBOT and result.simulator.law == "explicit"


def _published_table(result: MatchResult) -> Table:
    """Make the table of matched gains beside the paper's Table I; empty for another robot."""
    rows: list[tuple[Cell, ...]] = []
    for name, joint in result.joints.items():
        if _is_papers(result) and name in TABLE_I:
            stiffness, damping = TABLE_I[name]
            gains = joint.gains
            row = (
                joint_words(name),
                gains.stiffness.value,
                stiffness,
                gains.damping.value,
                damping,
            )
            rows.append(row)
    notes: tuple[str, ...] = ()
    if result.virtual:
        notes = (
            "Table I was measured on the paper's robot; the virtual robot's hidden parameters were "
            "set so that a match by magnitude lands near it.",
        )
    columns = (
        JOINT,
        Column(heading="stiffness", unit="N m/rad", digits=2),
        Column(heading="paper, Table I", unit="N m/rad", digits=1),
        Column(heading="damping", unit="N m s/rad"),
        Column(heading="paper, Table I", unit="N m s/rad"),
    )
    return Table(title="Beside the paper's gains", columns=columns, rows=tuple(rows), notes=notes)


def _published_ranges_table(result: MatchResult) -> Table:
    """Make the table of the paper's training gains; empty for another robot."""
    rows: list[tuple[Cell, ...]] = []
    for group in result.groups:
        if _is_papers(result) and group in TRAINING:
            stiffness, damping = TRAINING[group]
            row = (
                joint_words(group),
                f"{stiffness} ± {RANGES[0]}",
                f"{damping} ± {RANGES[1]}",
            )
            rows.append(row)
    columns = (
        Column(heading="group"),
        Column(heading="stiffness", unit="N m/rad"),
        Column(heading="damping", unit="N m s/rad"),
    )
    note = "The paper's hip roll damping of FL, 0.516, is outside its own range 0.45 ± 0.05."
    return Table(
        title="Training gains of the paper", columns=columns, rows=tuple(rows), notes=(note,)
    )


def _held_out_table(result: MatchResult) -> Table:
    """Make the table of the errors on what the fits did not use."""
    rows: list[tuple[Cell, ...]] = []
    for name, joint in result.joints.items():
        if joint.fit.held_out:
            errors_mrad = [1e3 * joint.fit.held_out[drive] for drive in HELD_OUT]
            rows.append((joint_words(name), *errors_mrad))
    columns = (
        JOINT,
        Column(heading="nominal", unit="mrad", digits=2),
        Column(heading="nominal with the best delay", unit="mrad", digits=2),
        Column(heading="plain fit", unit="mrad", digits=2),
        Column(heading="matched", unit="mrad", digits=2),
    )
    note = (
        "RMSE on the last repeat of each amplitude (every fourth part where there is one), which "
        "these fits did not use; each octave counts alike. plain fit: of stiffness, damping and "
        "delay those that the match fits, with the model's friction."
    )
    return Table(
        title="Errors on held-out recordings", columns=columns, rows=tuple(rows), notes=(note,)
    )


def _zero_armature_table(compared: Mapping[str, JointResult]) -> Table:
    """Make the table of the best errors without rotor inertia."""
    rows: list[tuple[Cell, ...]] = []
    for name, joint in compared.items():
        if joint.zero_armature is None:
            continue
        error_db = joint.zero_armature.error_db
        matched_error_db = figures.compared_responses(joint).error_db
        outcome = "no match" if joint.zero_armature.ruled_out else "not excluded"
        ratio = error_db / max(matched_error_db, 1e-6)
        rows.append((joint_words(name), error_db, matched_error_db, ratio, outcome))
    columns = (
        JOINT,
        Column(heading="best error without rotor inertia", unit="dB", digits=2),
        Column(heading="matched error", unit="dB", digits=2),
        Column(heading="ratio", digits=1),
        Column(heading="without rotor inertia"),
    )
    return Table(title="", columns=columns, rows=tuple(rows))


def _is_of(prediction: Prediction, gains: MatchedGains) -> bool:
    """Return whether a log was replayed with these gains; files of earlier versions do not say."""
    for name, (stiffness, damping) in prediction.gains.items():
        if name not in gains.joints:
            return False
        joint = gains.joints[name]
        same_stiffness = math.isclose(stiffness, joint.stiffness.value, rel_tol=WRITTEN_DIGITS)
        same_damping = math.isclose(damping, joint.damping.value, rel_tol=WRITTEN_DIGITS)
        if not (same_stiffness and same_damping):
            return False
    return True


def _prediction_section(prediction: Prediction) -> dict[str, Any]:
    """Return figure and table of a replayed log."""
    by_joint = {joint.joint: joint for joint in prediction.joints}
    drawn_joint = figures.knees_first(list(by_joint))[0]
    rows: list[tuple[Cell, ...]] = []
    for joint in prediction.joints:
        ratio = None
        if joint.rmse_nominal > 0.0:
            ratio = joint.rmse_matched / joint.rmse_nominal
        row = (
            joint_words(joint.joint),
            joint.unit,
            joint.rmse_nominal,
            joint.rmse_nominal_delayed,
            joint.rmse_matched,
            ratio,
            joint.r2_nominal,
            joint.r2_matched,
        )
        rows.append(row)
    columns = (
        JOINT,
        Column(heading="unit"),
        Column(heading="RMSE nominal", digits=4),
        Column(heading="nominal with the delay", digits=4),
        Column(heading="RMSE matched", digits=4),
        Column(heading="matched / nominal", digits=2),
        Column(heading="R² nominal"),
        Column(heading="R² matched"),
    )
    figure = figures.prediction_figure(by_joint[drawn_joint], virtual=prediction.virtual)
    ratios = [float(row[5]) for row in rows if isinstance(row[5], float)]
    summary = f"{prediction.source}: errors of the position, nominal and matched"
    if ratios:
        summary = (
            f"{prediction.source}: the error with matched gains is {min(ratios):.2f} to "
            f"{max(ratios):.2f} of that with nominal gains"
        )
    return {
        "summary": summary,
        "joint": drawn_joint,
        "figure": picture(figure),
        "table": Table(title="", columns=columns, rows=tuple(rows)),
    }


def _scale_table(
    result: MatchResult,
    members: Mapping[str, Sequence[str]],
    drive_gains: Mapping[str, tuple[float, float]],
) -> Table:
    """Make the table of the mean ratios of matched gains and those of the real drive, by group."""
    rows: list[tuple[Cell, ...]] = []
    for group, names in members.items():
        ratios = []
        for name in names:
            stiffness, damping = drive_gains.get(name, (0.0, 0.0))
            if stiffness > 0.0 and damping > 0.0:
                gains = result.joints[name].gains
                ratios.append((gains.stiffness.value / stiffness, gains.damping.value / damping))
        if ratios:
            stiffness_ratio, damping_ratio = np.mean(ratios, axis=0).tolist()
            rows.append((joint_words(group), stiffness_ratio, damping_ratio))
    columns = (
        Column(heading="group"),
        Column(heading="stiffness, matched / real drive", digits=2),
        Column(heading="damping, matched / real drive", digits=2),
    )
    note = (
        "Either the simulated gains are to be scaled, or the simulated inertia is too large by "
        "this ratio. In the air both give the same motion; on the ground they differ."
    )
    return Table(title="", columns=columns, rows=tuple(rows), notes=(note,))


def _excitation_table(compared: Mapping[str, JointResult]) -> Table:
    """Make the table of how each joint was excited, and what the response shows of it."""
    rows: list[tuple[Cell, ...]] = []
    for name, joint in compared.items():
        responses = figures.compared_responses(joint)
        first = responses.measured[0]
        band = first.band(*responses.band_hz)
        coherence_min = float(first.coherence[band].min()) if band.any() else None
        row = (
            joint_words(name),
            ", ".join(f"{response.amplitude:g}" for response in responses.measured),
            len(first.repeats),
            f"{responses.band_hz[0]:g} to {responses.band_hz[1]:g}",
            coherence_min,
            1000.0 * first.delay_s,
            100.0 * first.third_harmonic,
        )
        rows.append(row)
    columns = (
        JOINT,
        Column(heading="amplitudes", unit="rad"),
        Column(heading="repeats"),
        Column(heading="compared", unit="Hz"),
        Column(heading="lowest coherence"),
        Column(heading="delay by phase", unit="ms", digits=1),
        Column(heading="third harmonic", unit="%", digits=1),
    )
    return Table(title="", columns=columns, rows=tuple(rows))


def _amplitude_table(compared: Mapping[str, JointResult]) -> Table:
    """Make the table of the gains of each amplitude by itself, the largest first."""
    rows: list[tuple[Cell, ...]] = []
    for name, joint in compared.items():
        if len(joint.fit.amplitude_gains) < 2:
            continue
        for amplitude, stiffness, damping in sorted(
            joint.fit.amplitude_gains.tolist(), reverse=True
        ):
            rows.append((joint_words(name), amplitude, stiffness, damping))
    columns = (
        JOINT,
        Column(heading="amplitude", unit="rad"),
        Column(heading="stiffness", unit="N m/rad", digits=2),
        Column(heading="damping", unit="N m s/rad"),
    )
    note = "Dry friction and backlash weigh more in small motions."
    return Table(title="", columns=columns, rows=tuple(rows), notes=(note,))


def _logs_table(result: MatchResult) -> Table:
    """Make the table of the hashes of the logs."""
    columns = (Column(heading="log"), Column(heading="SHA-256"))
    return Table(title="", columns=columns, rows=tuple(result.logs.items()))
