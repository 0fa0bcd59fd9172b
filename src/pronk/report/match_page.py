"""One HTML page of a match: verdict first, then what it rests on.

The page is made from the artefacts in a folder alone (`gains.yaml`, `match.npz` and, where there
are any, `*.prediction.npz`), holds its figures in itself and opens without a network.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pronk.errors import ArtefactError, RobotError
from pronk.files import write_text
from pronk.match import gains as gains_file
from pronk.match import prediction as prediction_file
from pronk.match import result as result_file
from pronk.match.gains import MatchedGains
from pronk.match.result import MatchResult
from pronk.report import figures
from pronk.report.paper import published
from pronk.report.shell import Part, fill, page, picture
from pronk.robots import load_robot

PAGE_NAME = "match.html"


def find_gains(folder: Path) -> Path:
    """The gains file of a folder: `gains.yaml`, or the only YAML file with that schema.

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


def group_members(gains: MatchedGains) -> dict[str, list[str]]:
    """Names of the matched joints of each group, by the robot or, failing that, by their names."""
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
    """(stiffness, damping) on the real drive of each matched joint; empty for an unknown robot."""
    try:
        robot = load_robot(gains.robot)
        joints = [robot.joint(name) for name in gains.joints]
    except RobotError:
        return {}
    return {joint.name: (joint.stiffness, joint.damping) for joint in joints}


def failure_flags(result: MatchResult, name: str) -> list[str]:
    """The flags that speak against the match of a joint; that about zero armature speaks for it."""
    joint = result.joints.get(name)
    flags = (*result.gains.joints[name].flags, *(joint.flags if joint is not None else ()))
    return [flag for flag in dict.fromkeys(flags) if not flag.startswith("zero armature")]


def is_match(result: MatchResult, name: str) -> bool:
    """True unless a flag of the joint says that there is no match."""
    return not any(flag.startswith("no match") for flag in failure_flags(result, name))


def rms(values: list[float]) -> float:
    """Root mean square of the finite values; NaN if there are none."""
    finite = np.asarray([v for v in values if np.isfinite(v)])
    return float(np.sqrt(np.mean(finite**2))) if len(finite) else float("nan")


def verdict(result: MatchResult) -> dict[str, Any]:
    """The figures of the first section, also what `--json` gives."""
    joints = result.gains.joints
    errors = {name: joint.error_db for name, joint in joints.items() if joint.error_db >= 0.0}
    return {
        "robot": result.gains.robot,
        "virtual": result.gains.virtual,
        "joints": len(joints),
        "matched": sum(is_match(result, name) for name in joints),
        "naive_error_db": rms([joint.naive_error_db for joint in joints.values()]),
        "error_db": rms([joint.error_db for joint in joints.values()]),
        "worst": max(errors, key=lambda name: errors[name], default=""),
        "flags": {name: found for name in joints if (found := failure_flags(result, name))},
    }


def _excitations(result: MatchResult) -> list[dict[str, Any]]:
    rows = []
    for name, joint in result.joints.items():
        first = joint.responses[0]
        band = first.band(*joint.band_hz)
        rows.append(
            {
                "joint": name,
                "amplitudes": ", ".join(f"{r.amplitude:g}" for r in joint.responses),
                "repeats": len(first.repeats),
                "estimator": first.estimator,
                "window": first.window,
                "band": joint.band_hz,
                "coherence": float(first.coherence[band].min()) if band.any() else float("nan"),
                "delay_ms": 1000.0 * first.delay_s,
                "third": 100.0 * first.third_harmonic,
            }
        )
    return rows


def _scales(gains: MatchedGains, members: Mapping[str, list[str]]) -> list[dict[str, Any]]:
    """Mean matched over real gains, per group: what reading A10 is about."""
    real = drive_gains(gains)
    rows = []
    for group, joints in members.items():
        known = [j for j in joints if j in real and real[j][0] > 0.0 and real[j][1] > 0.0]
        if known:
            rows.append(
                {
                    "group": group,
                    "stiffness": np.mean([gains.joints[j].stiffness / real[j][0] for j in known]),
                    "damping": np.mean([gains.joints[j].damping / real[j][1] for j in known]),
                }
            )
    return rows


def knees_first(names: Iterable[str]) -> list[str]:
    """Joint names, those of knees first: where rotor inertia and mismatch are largest."""
    return sorted(names, key=lambda name: not name.endswith("knee"))


def _predictions(folder: Path) -> list[dict[str, Any]]:
    shown = []
    for path in sorted(folder.glob("*.prediction.npz")):
        prediction = prediction_file.load(path)
        if not prediction.joints:
            continue
        by_joint = {one.joint: one for one in prediction.joints}
        first = by_joint[knees_first(by_joint)[0]]
        where = "the virtual robot" if prediction.virtual else "the robot"
        shown.append(
            {
                "source": prediction.source,
                "virtual": prediction.virtual,
                "joints": prediction.joints,
                "picture": picture(
                    figures.replay(first, virtual=prediction.virtual),
                    f"Position of {first.joint} over time: command, measured on {where}, "
                    "simulated with naive and with matched gains",
                ),
            }
        )
    return shown


def _pictures(result: MatchResult) -> dict[str, Any]:
    gains, joints = result.gains, result.joints
    where = "on the virtual robot" if gains.virtual else "on the robot"
    amplitudes = figures.amplitudes(result)
    zero = {name: joint for name, joint in joints.items() if joint.zero_armature is not None}
    return {
        "overview": picture(
            figures.overview(result),
            f"Gain over frequency of every joint, measured {where} and simulated",
        )
        if joints
        else None,
        "example": (knees_first(joints) or [""])[0],
        "bodes": {
            name: picture(
                figures.bode(joint),
                f"Bode plot of {name}: gain, phase and coherence, measured {where} and simulated",
            )
            for name, joint in joints.items()
        },
        "maps": picture(
            figures.error_maps(result, drive_gains(gains)),
            "Gain error over the grid of stiffness and damping for every joint",
        )
        if any(joint.grid_error.size for joint in joints.values())
        else None,
        "ranges": picture(
            figures.ranges(gains, dict(group_members(gains))),
            "Matched gains of the joints of each group and the ranges that training draws from",
        )
        if group_members(gains)
        else None,
        "zero": picture(
            figures.zero_armature(zero[knees_first(zero)[0]]),
            "Gain over frequency with and without rotor inertia in the simulator",
        )
        if zero
        else None,
        "amplitudes": picture(amplitudes, "Change of the matched gains with the amplitude")
        if amplitudes is not None
        else None,
    }


def _without_armature(result: MatchResult) -> list[dict[str, Any]]:
    rows = []
    for name, joint in result.joints.items():
        if np.isfinite(joint.zero_armature_error_db):
            said = [flag for flag in joint.flags if flag.startswith("zero armature: no match")]
            rows.append(
                {
                    "joint": name,
                    "zero_db": joint.zero_armature_error_db,
                    "error_db": joint.error_db,
                    "ratio": joint.zero_armature_error_db / max(joint.error_db, 1e-6),
                    "no_match": bool(said),
                }
            )
    return rows


def part(
    result: MatchResult,
    folder: Path,
    gains_name: str = "gains.yaml",
    *,
    anchor: str = "",
    title: str | None = None,
) -> Part:
    """The match as a part of a page.

    Args:
        result: The match.
        folder: Where `*.prediction.npz` are looked for.
        gains_name: Name of the gains file, for the commands that the page shows.
        anchor: What the anchors of the part begin with; one for each part of a page.
        title: Of the part; names the robot if None.
    """
    members = group_members(result.gains)
    html = fill(
        "match.html.j2",
        at=f"{anchor}-" if anchor else "",
        gains=result.gains,
        gains_name=gains_name,
        joints=result.joints,
        verdict=verdict(result),
        excitations=_excitations(result),
        members=members,
        scales=_scales(result.gains, members),
        drive=drive_gains(result.gains),
        paper=published(result.gains.robot),
        pictures=_pictures(result),
        predictions=_predictions(folder),
        in_time=not any(joint.grid_error.size for joint in result.joints.values()),
        seconds=result.seconds,
        steps_per_second=result.grid_steps_per_second,
        zero=_without_armature(result),
        delays=any(joint.delay_s > 0.0 for joint in result.gains.joints.values()),
        amplitude_rows={n: j for n, j in result.joints.items() if len(j.amplitude_gains) > 1},
    )
    return Part(anchor=anchor, title=title or f"Match of {result.gains.robot}", html=html)


def render(result: MatchResult, folder: Path, gains_name: str = "gains.yaml") -> str:
    """The page of one match as text; the arguments are those of `part`."""
    return page(
        f"match of {result.gains.robot}",
        [part(result, folder, gains_name)],
        virtual=result.gains.virtual,
        sub="Each joint's answer to a sweep, and the simulator gains that give the same answer.",
        made_from=f"{gains_name} and match.npz",
    )


def write_page(out_dir: Path, *, gains: str | None = None) -> Path:
    """Write the page of the match in `out_dir` and return its path.

    Args:
        out_dir: Folder with the gains and `match.npz`.
        gains: Name of the gains file in it; found by `find_gains` if None.

    Raises:
        ArtefactError: The folder has no gains or no `match.npz`, or one of them is damaged.
    """
    path = out_dir / gains if gains else find_gains(out_dir)
    result = result_file.load(out_dir / "match.npz", gains_file.load(path))
    written = out_dir / PAGE_NAME
    write_text(written, render(result, out_dir, path.name))
    return written
