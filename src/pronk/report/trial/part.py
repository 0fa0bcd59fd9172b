"""A trial as a part of a page: the paper's table beside ours, and what it rests on."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pronk.errors import RobotError
from pronk.evaluation import tables
from pronk.evaluation.criteria import trial_checks
from pronk.evaluation.protocol import RATES
from pronk.evaluation.results import Results, Subject, load, share_interval
from pronk.evaluation.tables import Sheet, place
from pronk.match.result import MatchResult
from pronk.report import shell, style
from pronk.report.shell import Part, Picture
from pronk.report.trial.argument import bode_errors_db, joint_errors, match_near
from pronk.report.trial.cells import Published, cells, scatter
from pronk.report.trial.clips import Clips, clips
from pronk.report.trial.data import Seen, naive_over_matched, policies, published, see, values
from pronk.report.trial.ratios import ratios
from pronk.report.trial.sweeps import argument
from pronk.report.trial.traces import heights, rates, torque_speed
from pronk.robots import load_robot
from pronk.robots.robot import Robot

_PAPER_GAPS: Published = {
    "matched": {
        "forward 2": (0.55, math.nan),
        "back 2": (0.50, math.nan),
        "side -1": (0.40, math.nan),
        "side +1": (0.40, math.nan),
    }
}
"""R3: the widest gap a jump could cross, from video; the paper does not say of which policy, and
gives no spread."""


@dataclass(frozen=True, kw_only=True)
class Material:
    """All that the part of a trial is made from, read and found good."""

    trial: Results
    seen: Seen | None
    """What its captures hold; None without any."""
    clips: Clips
    match: MatchResult | None
    """Of the sweep that lies nearest, for the error of the policies' training gains."""


def read(folder: Path, root: Path, told: Callable[[float], None] = lambda share: None) -> Material:
    """Read a trial and what lies beside it.

    Args:
        folder: Of the trial.
        root: No match is looked for above it.
        told: Told the share of the captures that is read.

    Raises:
        ArtefactError: The trial, a capture or a picture is damaged.
    """
    trial = load(folder)
    return Material(
        trial=trial,
        clips=clips(folder),
        match=match_near(folder, root),
        seen=see(trial, folder, told=told),
    )


def part(material: Material, *, anchor: str, title: str = "Trial") -> Part:
    """The trial as a part of a page.

    Args:
        material: What it is made from.
        anchor: What the anchors of the part begin with.
        title: Of the part.
    """
    trial, seen, match = material.trial, material.seen, material.match
    errors = bode_errors_db(trial, match) if match else {}
    html = shell.fill(
        "trial.html.j2",
        at=f"{anchor}-" if anchor else "",
        trial=trial,
        first=trial.subjects[0].name,
        totals=totals(trial),
        checks=trial_checks(trial),
        verdicts=[tables.verdict(trial, other.name) for other in trial.subjects[1:]],
        table_iii=[tables.table_iii(trial, figure) for figure in ("height", "distance")],
        landings=tables.landings(trial),
        criteria=tables.criteria(trial),
        scatter=tables.scatter(trial) if trial.ratios else None,
        more=[_by_policy(trial, subject.name) for subject in trial.subjects],
        drives=tables.drives(trial),
        definitions=tables.definitions(),
        pictures=_pictures(trial, seen, errors),
        clips=material.clips,
        errors=errors,
        joint_errors=joint_errors(trial, match) if match else None,
        kept=_kept(trial, seen),
        rates_case=f"{RATES.command[0]:g}",
        groups={subject.name: _groups(subject) for subject in trial.subjects},
    )
    return Part(anchor=anchor, title=title, html=html)


@dataclass(frozen=True, kw_only=True)
class Total:
    """What became of all jumps of one policy."""

    n: int
    found: int
    succeeded: int
    fell: int

    @property
    def share(self) -> float:
        """Of all jumps that were asked for, those that landed well."""
        return self.succeeded / self.n

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of it."""
        return share_interval(self.succeeded, self.n)


def totals(trial: Results) -> dict[str, Total]:
    """Over all commands, by policy."""
    return {
        name: Total(
            n=sum(cell.n for cell in own),
            found=sum(cell.found for cell in own),
            succeeded=sum(cell.succeeded for cell in own),
            fell=sum(cell.fell for cell in own),
        )
        for name in policies(trial)
        if (own := [cell for cell in trial.cells if cell.policy == name])
    }


def _pictures(
    trial: Results, seen: Seen | None, errors: Mapping[str, float]
) -> dict[str, Picture | None]:
    cases = [case.name for case in trial.cases]
    where = place(trial)
    height, distance, gap = (values(trial, name, cases) for name in ("height", "distance", "gap"))
    panels = [(words, naive_over_matched(trial, words)) for words in ("distance", "height")]
    drawn: dict[str, Picture | None] = {
        "cells": shell.picture(
            cells(
                [
                    ("height [m]", height, published("height")),
                    ("distance [m]", distance, published("distance")),
                ]
            ),
            f"Height and distance of every jump on the {where}, by command and policy, with the "
            "paper's means and standard deviations",
        ),
        "scatter": shell.picture(
            scatter(height, distance, published("height"), published("distance")),
            f"Height over distance of every jump on the {where}, one panel a command, with the "
            "paper's means and standard deviations",
        ),
        "gaps": shell.picture(
            cells([("gap [m]", gap, _PAPER_GAPS)]),
            f"Gap of every jump on the {where}, by command and policy, with the paper's",
        ),
        "ratios": shell.picture(
            ratios(panels, over=("naive", "matched")),
            "Ratios of the standard deviations of distance and height, naive over matched, with "
            "95 % intervals, beside the paper's",
        )
        if any(found for _, found in panels)
        else None,
        "argument": shell.picture(
            argument(errors, {"height [m]": height, "distance [m]": distance}),
            "Standard deviation of height and distance over the error of each policy's training "
            "gains on the sweep",
        )
        if len(errors) > 1
        else None,
    }
    return drawn | _seen_pictures(trial, seen)


def _seen_pictures(trial: Results, seen: Seen | None) -> dict[str, Picture | None]:
    """Those that need captures."""
    drawn: dict[str, Picture | None] = dict.fromkeys(("heights", "rates", "torque_speed"))
    if seen is None:
        return drawn
    where = place(trial)
    standing = float(trial.rules.get("standing_height", math.nan))
    drawn["heights"] = shell.picture(
        heights(seen.height, standing=standing),
        f"Height of the trunk of the {where} over the time since the jump input, by policy and "
        "command",
        dense=True,
    )
    if any(seen.roll.values()):
        drawn["rates"] = shell.picture(
            rates(seen.roll, seen.pitch),
            f"Roll and pitch rate of the {where} while it accelerates to 2.25 m/s, by policy",
            dense=True,
        )
    if seen.hardest is not None and (robot := _robot(trial)) is not None:
        row = seen.hardest.row
        drawn["torque_speed"] = shell.picture(
            torque_speed(
                robot,
                seen.hardest.velocity,
                seen.hardest.torque,
                look_of=row.policy,
                words=f"{row.policy}, {row.case}, jump {row.number}, {where}",
            ),
            f"Torque over speed of every joint in one jump of the {where}, with the limits of the "
            "drives",
            dense=True,
        )
    return drawn


def _robot(trial: Results) -> Robot | None:
    """The robot of a trial; None for one that this pronk does not know."""
    try:
        return load_robot(trial.robot)
    except RobotError:
        return None


def _kept(trial: Results, seen: Seen | None) -> str:
    """How many jumps the captures are of, in words."""
    if seen is None:
        return ""
    shown = sum(len(runs) for found in seen.height.values() for runs in found.values())
    missing = f" {seen.missing} captures are missing from the folder." if seen.missing else ""
    if shown == len(trial.rows):
        return f"All {shown} jumps."
    return (
        f"{shown} of {len(trial.rows)} jumps, those whose captures were kept; pronk trial "
        f"--keep-captures keeps all.{missing}"
    )


def _by_policy(trial: Results, name: str) -> Sheet:
    """The columns of one policy of the table of all other figures."""
    whole = tables.more(trial)
    head = f"{name}: "
    kept = [i for i, column in enumerate(whole.columns) if column.startswith(head)]
    return Sheet(
        title=f"{name}: mean +- standard deviation",
        columns=(whole.columns[0], *(whole.columns[i].removeprefix(head) for i in kept)),
        rows=tuple((row[0], *(row[i] for i in kept)) for row in whole.rows),
    )


def _groups(subject: Subject) -> list[dict[str, Any]]:
    """Gains that a policy was trained with, once for each group of joints."""
    told = (subject.contract.get(name, ()) for name in ("joint_names", "stiffness", "damping"))
    found: dict[str, dict[str, Any]] = {}
    for name, stiffness, damping in zip(*told, strict=False):
        leg = style.leg_of(name)
        group = name.removeprefix(f"{leg}_") if leg else name
        found.setdefault(group, {"group": group, "stiffness": stiffness, "damping": damping})
    return list(found.values())
