"""Logs of `logs` and `faults`, matched, and what the match says beside the truth."""

from __future__ import annotations

import math
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.foreign.faults import FAULTS, faulty_log, honest_log, named_causes, verdict
from benchmarks.foreign.joints import NAME, RigidJoint
from benchmarks.foreign.logs import LogCase, draw_case, linear_gains, true_gains, write_case
from benchmarks.foreign.plain import rigid_joint
from benchmarks.foreign.population import Candidate
from pronk.errors import PronkError
from pronk.identify.logs.options import ReadOptions
from pronk.identify.logs.readers import read_logs
from pronk.identify.match.match import match
from pronk.identify.match.result import NO_MATCH
from pronk.identify.match.settings import MatchSettings
from pronk.robots import load_robot

Row = dict[str, Any]
RIGHT_SHARE = 0.15
"""Share by which gains of a log with a fault may be off and still be right: that of the torque
constants of drives."""
DRAWS = 20
"""Hinges that are tried for one log until one has a mass and is in a model that loads."""


def joint_of_log(
    packages: Path | None, drawn: list[tuple[Candidate, str]], seed: int, number: int
) -> RigidJoint | None:
    """Return the joint of a log: that of a drawn robot, or None for a drawn joint.

    Even logs are of hinges of the drawn robots, odd ones of joints drawn from 5 g to 50 kg.
    """
    if packages is None or not drawn or number % 2:
        return None
    rng = np.random.default_rng([seed, number, 3])
    for _ in range(DRAWS):
        candidate, _ = drawn[int(rng.integers(len(drawn)))]
        name = candidate.driven[int(rng.integers(len(candidate.driven)))]
        try:
            joint = rigid_joint(packages / candidate.path, name, f"{candidate.label} {name}")
        except (ValueError, KeyError):
            continue
        if joint is not None:
            return joint
    return None


def log_trial(
    kind: str, seed: int, number: int, packages: Path | None, drawn: list[tuple[Candidate, str]]
) -> Row:
    """Make a log, match it, and judge what the match says.

    Args:
        kind: honest or faults.
        seed: Of the benchmark.
        number: Of the log.
        packages: Folder of the packages; None for drawn joints alone.
        drawn: Robots whose joints are taken.
    """
    begin = time.perf_counter()
    joint = joint_of_log(packages, drawn, seed, number)
    fault = FAULTS[number % len(FAULTS)] if kind == "faults" else None
    if fault is None:
        case = honest_log(seed, number, joint)
    else:
        case = faulty_log(seed, number, fault, joint)
    row = described(case)
    row["kind"] = kind
    row["fault"] = fault.name if fault else ""
    with tempfile.TemporaryDirectory() as folder:
        row |= match_case(Path(folder), case)
    flags = row["flags"]
    row["named"] = sorted(named_causes(flags, row["refusal"]))
    if fault is not None:
        row["verdict"] = verdict(fault, flags, row["refusal"])
        # What the drive has without the fault, by which a silent match is harmless or not.
        stiffness, damping, _ = linear_gains(draw_case(seed, number, joint))
        row["true"] = {"stiffness": (stiffness, stiffness), "damping": (damping, damping)}
        if row["verdict"] == "silent":
            row["verdict"] = silent_verdict(row)
    if row["defect"]:
        row["verdict"] = "defect"
    if kind == "honest":
        row["true"] = true_gains(case)
        row["flagged"] = bool(row["named"] or row["refusal"] or row["defect"] or row["no_match"])
        for name in ("stiffness", "damping"):
            row[f"{name}_inside"] = overlaps(row.get(name), row["true"][name])
    row["seconds"] = time.perf_counter() - begin
    return row


def silent_verdict(row: Row) -> str:
    """Tell a match without a cause whose gains are right from one whose gains are not.

    Gains are right if the total interval reaches the drive's, or they are within `RIGHT_SHARE` of
    them. A damping that is wrong counts where it is wrong by that share of the larger of the two.
    """
    for name in ("stiffness", "damping"):
        true = row["true"][name]
        value = row[name][0]
        near = abs(value - true[0]) <= RIGHT_SHARE * max(value, true[0])
        if not near and not overlaps(row[name], true):
            return "wrong gains"
    return "harmless"


def described(case: LogCase) -> Row:
    """Return what a log is of."""
    return {
        "number": case.number,
        "robot": case.joint.robot,
        "mass": case.joint.mass,
        "inertia": case.joint.inertia,
        "signal": case.signal.kind,
        "command_rate_hz": case.signal.rate_hz,
        "rate_hz": case.recording.rate_hz,
        "duration_s": len(case.signal.offsets) / case.signal.rate_hz,
        "amplitude": float(np.abs(case.signal.offsets).max()),
        "drive": {
            "stiffness": case.drive.stiffness,
            "damping": case.drive.damping + case.drive.viscous,
            "coulomb": case.drive.coulomb,
            "delay_s": case.drive.delay_s,
        },
    }


def match_case(folder: Path, case: LogCase) -> Row:
    """Match the log of a case; return its gains, flags, or how it was refused."""
    robot_path, log_path = write_case(folder, case)
    row: Row = {"flags": [], "refusal": "", "defect": "", "no_match": False, "error_db": math.nan}
    try:
        robot = load_robot(str(robot_path))
        logs = read_logs([log_path], robot=robot, options=ReadOptions(unit="rad"))
        stated = {NAME: (case.stated.stiffness, case.stated.damping)}
        settings = MatchSettings(threads=1)
        result = match(logs, robot, drive_gains=stated, settings=settings)
    except PronkError as error:
        row["refusal"] = str(error).replace(str(folder), "")
        return row
    except Exception as error:  # a defect of pronk, which the table shows
        row["defect"] = f"{type(error).__name__}: {error}"
        return row
    gains = result.joints[NAME].gains
    row["flags"] = list(gains.flags)
    row["no_match"] = any(flag.startswith(NO_MATCH) for flag in gains.flags)
    row["error_db"] = gains.quality.error_db
    row["stiffness"] = [gains.stiffness.value, *gains.stiffness.total95]
    row["damping"] = [gains.damping.value, *gains.damping.total95]
    row["frictionloss"] = gains.frictionloss.value
    row["delay_s"] = gains.delay_s.value
    return row


def overlaps(value: list[float] | None, true: tuple[float, float]) -> bool | None:
    """Return whether a total interval reaches the true gains; None without an interval."""
    if value is None or not all(math.isfinite(number) for number in value):
        return None
    _, low, high = value
    return low <= true[1] and high >= true[0]
