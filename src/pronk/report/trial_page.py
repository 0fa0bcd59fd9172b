"""Page of a trial: outcome, Table III beside the paper's, figures, films, definitions."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pronk.errors import ArtefactError
from pronk.evaluation import tables
from pronk.evaluation.criteria import trial_checks
from pronk.evaluation.protocol import RATES, TABLE_III, in_paper_order
from pronk.evaluation.results import SUMMARY, Results, Subject, load, share_interval
from pronk.match.result import JointFit, MatchResult
from pronk.report import match_page, style
from pronk.report import trial_figures as draw
from pronk.report.page import Content, Fold, Part, Picture, Section, picture, table
from pronk.report.trial_figures import Published, Values
from pronk.virtual import capture as capture_file

Array = NDArray[np.float64]

BEFORE_S, AFTER_S = 0.5, 2.0
"""Window of the height traces about the jump input [s]."""
TRACE_RATE_HZ = 250.0
"""Rate of drawn traces."""
Captured = dict[str, dict[str, dict[str, list[Array]]]]
"""By quantity, policy and command: runs as time [s] and value, each (2, T). `height` [m] over the
time since the jump input; `roll` and `pitch` rate [rad/s] over the time since the command to run,
of `RATES` alone."""
_PAPER_GAPS: Published = {
    "matched": {
        case: (gap, float("nan"))
        for case, gap in (("forward 2", 0.55), ("back 2", 0.5), ("side -1", 0.4), ("side +1", 0.4))
    }
}
"""R3: the widest gaps, from video; of which policy is not stated, and no spread is given."""


def policies(trial: Results) -> list[str]:
    """Return the names of the policies, `naive` first."""
    return in_paper_order(subject.name for subject in trial.subjects)


def values(trial: Results, figure: str) -> Values:
    """Return one figure of every jump, by policy and command."""
    return {
        name: {case.name: trial.values(name, case.name, figure) for case in trial.cases}
        for name in policies(trial)
    }


def published(figure: str) -> Published:
    """Return the paper's `height`, `distance` or `gap` by policy and command."""
    if figure == "gap":
        return _PAPER_GAPS
    return {
        gains: {case: getattr(cell, figure)[gains] for case, cell in TABLE_III.items()}
        for gains in ("naive", "matched")
    }


def _cut(time: Array, value: Array, start: float, end: float) -> Array:
    """Return `value` between two times, thinned to `TRACE_RATE_HZ`, as (2, T)."""
    inside = np.flatnonzero((time >= start) & (time <= end))
    if len(inside) > 1:
        dt = float(time[inside[-1]] - time[inside[0]]) / (len(inside) - 1)
        inside = inside[:: max(1, round(1.0 / (TRACE_RATE_HZ * dt)))]
    return np.stack([time[inside], value[inside]])


def captured(trial: Results, folder: Path) -> tuple[Captured, int] | None:
    """Read the captures of a trial, and count missing ones; None if there are none.

    Raises:
        ArtefactError: A capture is damaged.
    """
    kept = [(row, folder / row.capture) for row in trial.rows if row.capture]
    present = [(row, path) for row, path in kept if path.exists()]
    if not present:
        return None
    traces: Captured = {
        what: {name: {} for name in policies(trial)} for what in ("height", "roll", "pitch")
    }
    for row, path in present:
        capture = capture_file.load(path)
        time, turn = capture.time - row.began, capture.angular_velocity
        since, run = time - row.script.on, time - row.script.start
        found = {"height": _cut(since, capture.position[:, 2], -BEFORE_S, AFTER_S)}
        if row.case == RATES.name:
            found["roll"] = _cut(run, turn[:, 0], 0.0, row.script.run_s)
            found["pitch"] = _cut(run, turn[:, 1], 0.0, row.script.run_s)
        for what, trace in found.items():
            traces[what][row.policy].setdefault(row.case, []).append(trace)
    return traces, len(kept) - len(present)


def joint_error_db(joint: JointFit, stiffness: float, damping: float) -> float:
    """Return the RMS gain error [dB] with these gains [N m/rad, N m s/rad] over the joint's band.

    It is interpolated in the joint's error map; NaN outside of it, or without one.
    """
    from scipy.interpolate import RectBivariateSpline

    k, d = joint.grid_stiffness, joint.grid_damping
    inside = k[0] <= stiffness <= k[-1] and d[0] <= damping <= d[-1] if len(k) else False
    if not inside or min(joint.grid_error.shape) < 4:
        return float("nan")
    # The square of the error is smooth between nodes; its root has a cusp at a match.
    square = float(RectBivariateSpline(k, d, joint.grid_error).ev([stiffness], [damping])[0])
    return float(np.sqrt(max(square, 0.0)))


def gains_errors(trial: Results, result: MatchResult) -> dict[str, float]:
    """Return the error of each policy's training gains on a sweep, RMS over the joints [dB].

    Empty unless it is known for all joints of every policy.
    """
    found = {}
    for subject in trial.subjects:
        gains = _training_gains(subject)
        errors = [
            joint_error_db(joint, *gains.get(name, (np.nan, np.nan)))
            for name, joint in result.joints.items()
        ]
        found[subject.name] = float(np.sqrt(np.mean(np.square(errors)))) if errors else np.nan
    return found if np.isfinite(list(found.values())).all() else {}


def _training_gains(subject: Subject) -> dict[str, tuple[float, float]]:
    """Stiffness [N m/rad] and damping [N m s/rad] by joint, as of the contract."""
    fields = (subject.contract.get(name, ()) for name in ("joint_names", "stiffness", "damping"))
    return {name: (stiffness, damping) for name, stiffness, damping in zip(*fields, strict=False)}


def match_near(folder: Path, root: Path) -> MatchResult | None:
    """Return the match nearest to a trial: in its folder or one above it, up to `root`."""
    for near in (folder, *folder.parents):
        if (near / "match.npz").exists():
            try:
                return match_page.load(near)
            except ArtefactError:
                return None  # reported where the match itself is shown
        if near == root:
            return None
    return None


def films(folder: Path) -> list[Content]:
    """Return the moving pictures and frames in a trial's folder, and the names of its films.

    Raises:
        ArtefactError: A picture is damaged.
    """
    # A folder with a trial of its own is a part of its own.
    inner = [path for path in folder.iterdir() if path.is_dir() and not (path / SUMMARY).exists()]
    found: dict[str, list[Path]] = {
        kind: sorted(path for place in (folder, *inner) for path in place.glob(f"*.{kind}"))
        for kind in ("png", "gif", "mp4")
    }
    content: list[Content] = [_image(path) for path in (*found["png"], *found["gif"])]
    if found["mp4"]:
        names = ", ".join(str(path.relative_to(folder)) for path in found["mp4"])
        content.append(f"Films in the trial's folder: {names}.")
    return content


def _image(path: Path) -> Picture:
    from PIL import Image

    data = path.read_bytes()
    try:
        with Image.open(io.BytesIO(data)) as opened:
            opened.load()
    except Exception as error:
        raise ArtefactError(
            f"{path}: not a readable picture ({type(error).__name__}); delete it, or run `pronk "
            "trial` again."
        ) from error
    words = f"{path.stem.replace('_', ' ')}, virtual robot"
    kind = path.suffix[1:]
    return Picture(src=style.data_uri(data, kind), alt=f"Film frames: {words}", caption=words)


def part(path: Path, root: Path, *, anchor: str = "trial", title: str = "Trial") -> Part:
    """Make the part of the trial in `path`, a `summary.json`.

    Raises:
        ArtefactError: The trial, a capture or a picture is damaged.
    """
    folder = path.parent
    trial, match = load(folder), match_near(folder, root)
    checks, first = trial_checks(trial), trial.subjects[0].name
    passed = sum(check.passed for check in checks)
    where, shown = tables.place(trial), films(folder)
    verdicts = [tables.verdict(trial, other.name) for other in trial.subjects[1:]]
    lines = [_total(trial, name) for name in policies(trial)]
    if trial.virtual:
        lines.append(
            "Every jump on this page is of pronk's virtual robot, a simulated machine whose "
            "parameters neither match nor training can read. The paper's figures are of hardware."
        )
    more = [Fold(f"Figures of {s.name}", tables.more(trial, s.name)) for s in trial.subjects]
    more += [Fold("Drives", tables.drives(trial)), Fold("Definitions", tables.definitions())]
    return Part(
        anchor=anchor,
        title=title,
        source=str(path.relative_to(root)),
        virtual=trial.virtual,
        summary=f"{first}, {where}: {passed} of {len(checks)} acceptance criteria passed.",
        lines=[*lines, *(f"{one[0].upper()}{one[1:]}" for one in verdicts)],
        warning=passed < len(checks),
        sections=[
            _table_iii(trial),
            Section("Acceptance criteria", tables.criteria(trial)),
            _scatter(trial, gains_errors(trial, match) if match else {}),
            Section("Films", *shown) if shown else None,
            Section("Landings", tables.landings(trial)),
            *_traces(trial, captured(trial, folder)),
            Section("All figures", *more),
            _setup(trial),
        ],
        figures={"checks": [check.row() for check in checks]},
    )


def _total(trial: Results, name: str) -> str:
    own = [cell for cell in trial.cells if cell.policy == name]
    n, found, landed, fell = (
        sum(getattr(cell, field) for cell in own) for field in ("n", "found", "succeeded", "fell")
    )
    low, high = share_interval(landed, n)
    return (
        f"{name}, {tables.place(trial)}: {n} jumps commanded, {found} jumped, {landed} landed "
        f"({100 * landed / n:.1f} %, interval {100 * low:.1f} to {100 * high:.1f}), {fell} fell."
    )


def _table_iii(trial: Results) -> Section:
    names = ("height", "distance", "gap")
    panels = [(f"{name} [m]", values(trial, name), published(name)) for name in names]
    words = f"Height, distance and gap of every jump on the {tables.place(trial)}, and the paper's"
    return Section(
        "Table III",
        "Every jump is a small mark, with mean and standard deviation beside. Open marks are the "
        "paper's: five jumps a cell on hardware; gaps are its widest, read off video.",
        picture(draw.cells(panels), words),
        *(tables.table_iii(trial, figure) for figure in ("height", "distance")),
    )


def _scatter(trial: Results, errors: Mapping[str, float]) -> Section | None:
    if not trial.ratios:
        return None
    panels = {f"{name} [m]": values(trial, name) for name in ("height", "distance")}
    words = "Standard deviation of height and distance over the error of the training gains"
    return Section(
        "Scatter",
        "The paper reports less scatter with matched gains. Intervals are over the jumps of these "
        "policies, not over other trainings.",
        tables.scatter(trial),
        picture(draw.scatter_over_error(errors, panels), words) if len(errors) > 1 else None,
    )


def _traces(trial: Results, seen: tuple[Captured, int] | None) -> list[Section]:
    """Sections that need captures."""
    if seen is None:
        return []
    (height, roll, pitch), missing = seen[0].values(), seen[1]
    where, found = tables.place(trial), []
    if any(roll.values()):
        rates = {"roll rate [rad/s]": roll, "pitch rate [rad/s]": pitch}
        figure = draw.traces(rates, x_label="time since the command to run [s]", level=0.0)
        rows = [
            (name, *(draw.rms(one[name].get(RATES.name, [])) for one in (roll, pitch)))
            for name in roll
        ]
        found.append(
            Section(
                "Roll and pitch rates",
                f"In the trunk's frame, until the jump input, at {RATES.name} (paper, figure 6).",
                picture(figure, f"Rates of the {where} while it accelerates", dense=True),
                table("policy | roll rate, RMS [rad/s];2 | pitch rate, RMS [rad/s];2", rows),
            )
        )
    count = sum(len(runs) for cases in height.values() for runs in cases.values())
    text = f"{count} of {len(trial.rows)} jumps, those with a capture. Dashed: standing."
    text += f" {missing} captures are missing from the folder." * bool(missing)
    standing = float(trial.rules.get("standing_height", np.nan))
    heights, x_label = {"trunk height [m]": height}, "time since input [s]"
    figure = draw.traces(heights, x_label=x_label, level=standing)
    drawn = picture(figure, f"Trunk height of the {where} since the jump input", dense=True)
    return [*found, Section("Trunk height over time", text, drawn)]


def _setup(trial: Results) -> Section:
    script, params, timing = trial.script, trial.sim_params, trial.timing
    rows = [
        (one.name, one.contract.get("gains", "unknown"), _groups(one), one.path, one.sha256)
        for one in trial.subjects
    ]
    versions = ", ".join(f"{name} {version}" for name, version in trial.versions.items())
    where = f"the virtual {trial.robot}" if trial.virtual else trial.robot
    times = ", ".join(f"{name} {value:.0f}" for name, value in timing.items())
    return Section(
        "Setup",
        f"{len(trial.cases)} commands, {len(trial.rows)} jumps on {where}, seed {trial.seed}. "
        f"Each: stand {script.stand_s:.1f} s, run {script.run_s:.1f} s and up to "
        f"{trial.spread_s:.1f} s more, jump input {script.jump_s:.1f} s, run on "
        f"{script.keep_s:.1f} s, stop {script.stop_s:.1f} s. Heading, joint offsets and noise are "
        "drawn for each jump; all policies meet the same draws.",
        table("policy | gains | stiffness [N m/rad] / damping [N m s/rad] | file | SHA-256", rows),
        f"Parameters: {params.get('file', 'unknown')}, SHA-256 {params.get('sha256', 'unknown')}. "
        f"Versions: {versions}. Timing [s, processes]: {times}.",
    )


def _groups(subject: Subject) -> str:
    """Gains that a policy was trained with, once for each joint group."""
    found: dict[str, str] = {}
    for name, (stiffness, damping) in _training_gains(subject).items():
        group = style.joint_words(name.removeprefix(f"{style.leg_of(name)}_"))
        found.setdefault(group, f"{group} {stiffness:.1f} / {damping:.3f}")
    return ", ".join(found.values())
