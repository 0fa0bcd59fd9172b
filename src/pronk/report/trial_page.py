"""Page of a trial: verdict, tables beside the paper, figures and film clips."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pronk.errors import ArtefactError, RobotError
from pronk.evaluation import tables
from pronk.evaluation.criteria import trial_checks
from pronk.evaluation.protocol import RATES
from pronk.evaluation.published import PAPER_RATIOS, TABLE_III, in_paper_order
from pronk.evaluation.results import SUMMARY, Results, Row, Subject, load, share_interval
from pronk.evaluation.tables import Sheet, number, place
from pronk.match import gains as gains_file
from pronk.match import result as result_file
from pronk.match.result import JointFit, MatchResult
from pronk.report import shell, style
from pronk.report.match_page import find_gains
from pronk.report.shell import Part, Picture
from pronk.report.trial_figures import (
    Published,
    Ratio,
    Trace,
    Values,
    argument,
    cells,
    heights,
    rates,
    ratios,
    scatter,
    torque_speed,
)
from pronk.robots import load_robot
from pronk.robots.robot import Robot
from pronk.virtual import capture as capture_file
from pronk.virtual.capture import Capture

Array = NDArray[np.float64]

BEFORE_S, AFTER_S = 0.5, 2.0
"""Window of the height traces about the jump input [s]."""
TRACE_RATE_HZ = 250.0
"""Rate that traces are drawn at: no figure is wide enough to show more."""


def policies(trial: Results) -> list[str]:
    """Names of the policies, a naive one first, as in the paper's table."""
    return in_paper_order(subject.name for subject in trial.subjects)


def values(trial: Results, figure: str, cases: Sequence[str]) -> Values:
    """One figure of every jump that was found, by policy and command."""
    return {
        name: {case: trial.values(name, case, figure) for case in cases} for name in policies(trial)
    }


def published(figure: str) -> Published:
    """The paper's Table III, `height` or `distance`, by policy and command; empty for others."""
    if figure not in ("height", "distance"):
        return {}
    return {
        gains: {case: getattr(cell, figure)[gains] for case, cell in TABLE_III.items()}
        for gains in ("naive", "matched")
    }


def naive_over_matched(trial: Results, figure: str) -> list[Ratio]:
    """Ratios of the standard deviations with the naive policy above the line, whichever came first.

    Empty unless the trial has the paper's two policies, and without those of too few jumps for an
    interval. The first is over all commands.
    """
    found = []
    paper = published(figure)
    for ratio in trial.ratios:
        if ratio.figure != figure or {ratio.policy, ratio.other} != {"naive", "matched"}:
            continue
        value, low, high = ratio.value, ratio.low, ratio.high
        if not (math.isfinite(value) and value > 0.0 and math.isfinite(low)):
            continue
        if ratio.other == "matched":
            value, low, high = 1.0 / value, 1.0 / high, 1.0 / low if low > 0.0 else math.inf
        if ratio.case is None:
            theirs = PAPER_RATIOS.get(figure)
        elif ratio.case in paper.get("naive", {}):
            theirs = paper["naive"][ratio.case][1] / paper["matched"][ratio.case][1]
        else:
            theirs = None
        found.append(
            Ratio(
                words=ratio.case or "mean over the commands",
                value=value,
                interval=(low, high),
                paper=theirs,
                overall=ratio.case is None,
            )
        )
    return found


@dataclass(frozen=True, kw_only=True)
class Seen:
    """What the captures of a trial give the figures, by policy and then by command."""

    height: dict[str, dict[str, list[Trace]]]
    """Trunk height [m] over the time since the jump input [s]."""
    roll: dict[str, dict[str, list[Trace]]]
    """Roll rate [rad/s] over the time since the command to run [s], at `RATES` alone."""
    pitch: dict[str, dict[str, list[Trace]]]
    """Pitch rate, the same."""
    hardest: HardestJump | None
    """Of the first policy."""
    missing: int
    """Captures that the table names and the folder does not hold."""


@dataclass(frozen=True, kw_only=True)
class HardestJump:
    """The jump that comes nearest to the drives' torque-speed curves."""

    row: Row
    velocity: Array
    """Of the joints, from the input to `AFTER_S` later [rad/s]. (T, joints)"""
    torque: Array
    """Of the motors, joint side [N m]. (T, joints)"""


def hardest(rows: Sequence[Row]) -> Row | None:
    """The jump with the least torque margin of any joint; None without a jump."""
    found = [row for row in rows if row.figures.found and len(row.figures.torque_margin)]
    return min(found, key=lambda row: min(row.figures.torque_margin), default=None)


def cut(time: Array, value: Array, start: float, end: float) -> Trace:
    """A stretch of a series, from a new zero at 0, thinned to `TRACE_RATE_HZ`.

    Args:
        time: Since the new zero [s]. (T,)
        value: (T,)
        start: First time of the stretch [s].
        end: Last time [s].
    """
    inside = np.flatnonzero((time >= start) & (time <= end))
    if len(inside) > 1:
        dt = float(time[inside[-1]] - time[inside[0]]) / (len(inside) - 1)
        inside = inside[:: max(1, round(1.0 / (TRACE_RATE_HZ * dt)))]
    return Trace(time=time[inside], value=value[inside])


def _captures(trial: Results, folder: Path) -> Iterator[tuple[Row, Path]]:
    for row in trial.rows:
        if row.capture:
            yield row, folder / row.capture


def see(
    trial: Results, folder: Path, *, progress: Callable[[float], None] = lambda share: None
) -> Seen | None:
    """Read the captures of a trial; None if it kept none, or none is there any more.

    Args:
        trial: Whose table names them.
        folder: Where they are.
        progress: Called with the share of them that is read.

    Raises:
        ArtefactError: A capture is damaged.
    """
    kept = list(_captures(trial, folder))
    present = [(row, path) for row, path in kept if path.exists()]
    if not present:
        return None
    found: dict[str, dict[str, dict[str, list[Trace]]]] = {
        what: {name: {} for name in policies(trial)} for what in ("height", "roll", "pitch")
    }
    worst = hardest([row for row, _ in present if row.policy == trial.subjects[0].name])
    jump = None
    for i, (row, path) in enumerate(present):
        seen = capture_file.load(path)
        for what, trace in _traces(row, seen).items():
            found[what][row.policy].setdefault(row.case, []).append(trace)
        if row is worst:
            jump = _hardest(row, seen)
        progress((i + 1) / len(present))
    return Seen(**found, hardest=jump, missing=len(kept) - len(present))


def _traces(row: Row, seen: Capture) -> dict[str, Trace]:
    since = seen.time - row.began
    script = row.script
    found = {
        "height": cut(since - script.on, seen.position[:, 2], -BEFORE_S, AFTER_S),
    }
    if row.case == RATES.name:
        for i, what in enumerate(("roll", "pitch")):
            rate = seen.angular_velocity[:, i]
            found[what] = cut(since - script.start, rate, 0.0, script.run_s)
    return found


def _hardest(row: Row, seen: Capture) -> HardestJump:
    since = seen.time - row.began - row.script.on
    inside = (since >= 0.0) & (since <= AFTER_S)
    return HardestJump(row=row, velocity=seen.joint_velocity[inside], torque=seen.torque[inside])


def joint_error_db(joint: JointFit, stiffness: float, damping: float) -> float:
    """Error of a joint's simulated gain with these gains, RMS over its band [dB].

    Args:
        joint: Its map: mean squares in dB^2 over a grid.
        stiffness: [N m/rad]
        damping: [N m s/rad]

    Returns:
        NaN outside of the grid, or without a map.
    """
    from scipy.interpolate import RectBivariateSpline

    k, d = joint.grid_stiffness, joint.grid_damping
    if not joint.grid_error.size or min(len(k), len(d)) < 2:
        return float("nan")
    if not (k[0] <= stiffness <= k[-1] and d[0] <= damping <= d[-1]):
        return float("nan")
    # The error is smooth between nodes, its square root has a cusp at a match.
    kx, ky = min(3, len(k) - 1), min(3, len(d) - 1)
    surface = RectBivariateSpline(k, d, joint.grid_error, kx=kx, ky=ky)
    square = float(surface.ev([stiffness], [damping])[0])
    return float(np.sqrt(max(square, 0.0)))


def errors_db(result: MatchResult, subject: Subject) -> dict[str, float]:
    """Error of a policy's training gains for each joint of a match [dB]; NaN if it is unknown."""
    fields = (subject.contract.get(name, ()) for name in ("joint_names", "stiffness", "damping"))
    gains = {name: (stiffness, damping) for name, stiffness, damping in zip(*fields, strict=False)}
    return {
        name: joint_error_db(joint, *gains.get(name, (np.nan, np.nan)))
        for name, joint in result.joints.items()
    }


def bode_error_db(result: MatchResult, subject: Subject) -> float:
    """Error of a policy's training gains, RMS over the joints [dB]; NaN if one is unknown."""
    errors = list(errors_db(result, subject).values())
    return float(np.sqrt(np.mean(np.square(errors)))) if errors else float("nan")


def joint_errors(trial: Results, result: MatchResult) -> Sheet:
    """Errors of every policy's training gains, and of the matched gains of each joint by itself."""
    found = {subject.name: errors_db(result, subject) for subject in trial.subjects}
    return Sheet(
        title="Error of the training gains on the sweep [dB RMS over the joint's band]",
        columns=("joint", *found, "its own matched gains"),
        rows=tuple(
            (
                style.joint_words(name),
                *(number(errors[name], 2) for errors in found.values()),
                number(joint.error_db, 2),
            )
            for name, joint in result.joints.items()
        ),
        notes=(
            "Training has one pair of gains for each group of joints, so even matched gains miss a "
            "joint that differs from its group.",
        ),
    )


def match_near(folder: Path, root: Path) -> MatchResult | None:
    """The match that lies nearest to a trial: in its folder or one above it, down from `root`."""
    for near in (folder, *folder.parents):
        if (near / "match.npz").exists():
            try:
                return result_file.load(near / "match.npz", gains_file.load(find_gains(near)))
            except ArtefactError:
                # The page reports it where the match itself is shown.
                return None
        if near == root:
            return None
    return None


def bode_errors_db(trial: Results, result: MatchResult) -> Mapping[str, float]:
    """By policy; empty unless every policy's is known."""
    found = {subject.name: bode_error_db(result, subject) for subject in trial.subjects}
    return found if all(np.isfinite(value) for value in found.values()) else {}


LARGEST_BYTES = 1_500_000
"""A moving picture larger than this is made smaller before it goes into the page."""
SMALL_WIDTH = 320
"""Width that it is made smaller to [px]."""
EVERY = 2
"""Of its frames, every which is kept."""


@dataclass(frozen=True, kw_only=True)
class Clips:
    """What a trial's folder has to look at."""

    moving: tuple[Picture, ...]
    strips: tuple[Picture, ...]
    films: tuple[str, ...]
    """Names of video files, which a page only names: they are large."""

    def __bool__(self) -> bool:
        """True if there is anything."""
        return bool(self.moving or self.strips or self.films)


def clips(folder: Path) -> Clips:
    """Everything to look at in a folder and in those in it, in the order of their names.

    Raises:
        ArtefactError: A picture is damaged.
    """
    return Clips(
        moving=tuple(_moving(path) for path in _files(folder, "gif")),
        strips=tuple(_still(path) for path in _files(folder, "png")),
        films=tuple(str(path.relative_to(folder)) for path in _files(folder, "mp4")),
    )


def _files(folder: Path, kind: str) -> list[Path]:
    # A folder with a trial of its own is a part of its own, with its pictures.
    inner = [path for path in folder.iterdir() if path.is_dir() and not (path / SUMMARY).exists()]
    return sorted(path for place in (folder, *inner) for path in place.glob(f"*.{kind}"))


def _words(path: Path) -> str:
    return f"{path.stem.replace('_', ' ')}, virtual robot"


def _still(path: Path) -> Picture:
    coded = base64.b64encode(_checked(path)).decode("ascii")
    return Picture(
        src=f"data:image/png;base64,{coded}",
        alt=f"Still frames: {_words(path)}",
        caption=_words(path),
    )


def _moving(path: Path) -> Picture:
    data = _checked(path)
    coded = base64.b64encode(smaller(data) if len(data) > LARGEST_BYTES else data).decode("ascii")
    return Picture(
        src=f"data:image/gif;base64,{coded}",
        alt=f"Moving picture: {_words(path)}",
        caption=_words(path),
    )


def _checked(path: Path) -> bytes:
    """The bytes of a picture that can be opened.

    Raises:
        ArtefactError: It cannot.
    """
    from PIL import Image

    data = path.read_bytes()
    try:
        with Image.open(io.BytesIO(data)) as opened:
            opened.load()
    except Exception as error:
        raise ArtefactError(
            f"{path}: no picture that can be opened ({type(error).__name__}); delete it, or let "
            "`pronk trial` make it anew."
        ) from error
    return data


def smaller(data: bytes) -> bytes:
    """A GIF at most `SMALL_WIDTH` wide with every `EVERY`-th frame, at its own speed."""
    from PIL import Image, ImageSequence

    with Image.open(io.BytesIO(data)) as film:
        scale = min(1.0, SMALL_WIDTH / film.width)
        size = (max(1, round(film.width * scale)), max(1, round(film.height * scale)))
        frames: list[Image.Image] = []
        times: list[int] = []
        for i, frame in enumerate(ImageSequence.Iterator(film)):
            shown = int(frame.info.get("duration", 40))
            if i % EVERY:
                times[-1] += shown
            else:
                frames.append(frame.convert("RGB").resize(size))
                times.append(shown)
    out = io.BytesIO()
    frames[0].save(
        out, format="GIF", save_all=True, append_images=frames[1:], duration=times, loop=0
    )
    return out.getvalue()


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


def read(
    folder: Path, root: Path, progress: Callable[[float], None] = lambda share: None
) -> Material:
    """Read a trial and what lies beside it.

    Args:
        folder: Of the trial.
        root: No match is looked for above it.
        progress: Called with the share of the captures that is read.

    Raises:
        ArtefactError: The trial, a capture or a picture is damaged.
    """
    trial = load(folder)
    return Material(
        trial=trial,
        clips=clips(folder),
        match=match_near(folder, root),
        seen=see(trial, folder, progress=progress),
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
        """Of all commanded jumps, those that landed well."""
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
    fields = (subject.contract.get(name, ()) for name in ("joint_names", "stiffness", "damping"))
    found: dict[str, dict[str, Any]] = {}
    for name, stiffness, damping in zip(*fields, strict=False):
        leg = style.leg_of(name)
        group = name.removeprefix(f"{leg}_") if leg else name
        found.setdefault(group, {"group": group, "stiffness": stiffness, "damping": damping})
    return list(found.values())
