"""Pages of walking, crossing, variation and randomized robots."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pronk.evaluation import bodies as bodies_file
from pronk.evaluation import results as results_file
from pronk.evaluation import variation as varied
from pronk.evaluation.bodies import Bodies
from pronk.evaluation.criteria import trial_checks
from pronk.evaluation.crossing import CROSSING, Climb, climbs
from pronk.evaluation.jumps import FIGURES
from pronk.evaluation.results import Cell, Results, share_interval
from pronk.evaluation.tables import Sheet, figure_row, number, verdict
from pronk.evaluation.variation import VARIATION, parameters_of
from pronk.evaluation.walk import SETTLE_S, WALK, WALK_FIGURES
from pronk.report import trial_figures as draw
from pronk.report import trial_page
from pronk.report.page import Fold, Part, Section, picture, table
from pronk.report.trial_figures import Array, Panel, Values

PAPER_WALKS = ("forward 2", "back 2", "side -1", "side +1")
"""Velocities of the paper's R4."""
PAPER_GAPS = {case: gap for case, (gap, _) in trial_page.published("gap")["matched"].items()}
"""Widest gaps that the paper's robot could cross, read off video (R3) [m]."""
_OBSTACLES = {"gap": "gap", "up": "step up", "down": "step down"}
_WALK_TABLE = (
    *("lasted", "forward", "left", "yaw_rate", "speed_error", "speed_error_averaged"),
    *("yaw_error_averaged", "roll_rate_rms", "pitch_rate_rms", "power", "cost_of_transport"),
)
_OF_POLICY = "training gains of "


def place(origin: Results | Bodies) -> str:
    """Return where it was measured, in words."""
    return "virtual robot" if origin.virtual else "robot"


def _part(path: Path, root: Path, origin: Results | Bodies, **fields: Any) -> Part:
    """Make a part of results with seed, hashes and versions below it."""
    hashes = ", ".join(f"{subject.name} {subject.sha256[:12]}" for subject in origin.subjects)
    versions = ", ".join(f"{name} {version}" for name, version in origin.versions.items())
    params = str(origin.sim_params.get("sha256", "unknown"))[:12]
    return Part(
        source=str(path.relative_to(root)),
        virtual=origin.virtual,
        note=f"Measured on the {place(origin)}, seed {origin.seed}, parameters {params}; policies: "
        f"{hashes}; versions: {versions}.",
        **fields,
    )


def walk_tables(walks: Results) -> tuple[Sheet, ...]:
    """Return the figures of the walks by velocity, a table a policy."""
    note = (
        "non-foot contact: walks in which something but a foot touched the ground. The first "
        f"{SETTLE_S:g} s after the command are left out."
    )
    sheets = []
    for subject in walks.subjects:
        own = [cell for cell in walks.cells if cell.policy == subject.name]
        rows = [("walks", *(str(cell.n) for cell in own))]
        rows.append(("fell", *(str(cell.fell) for cell in own)))
        rows.append(("non-foot contact", *(str(cell.non_foot_contact) for cell in own)))
        rows += [figure_row(name, WALK_FIGURES[name].unit, own, 2) for name in _WALK_TABLE]
        title = f"{subject.name}: mean +- standard deviation"
        columns = ("figure", *(cell.case for cell in own))
        sheets.append(Sheet(title=title, columns=columns, rows=tuple(rows), notes=(note,)))
    return tuple(sheets)


def walk_part(path: Path, root: Path, **names: str) -> Part:
    """Make the part of the walks in `path`, a `walk.json`; `names` are its anchor and title."""
    walks = results_file.load(path.parent, WALK)
    first, where = walks.subjects[0].name, place(walks)
    own = [cell for cell in walks.cells if cell.policy == first]
    own = [cell for cell in own if cell.case in PAPER_WALKS] or own
    fell, n = sum(cell.fell for cell in own), sum(cell.n for cell in own)
    figure = "speed_error_averaged"
    drawn = draw.cells([("speed error [m/s]", trial_page.values(walks, figure), {})])
    section = Section(
        "Velocity errors",
        f"{WALK_FIGURES[figure].says}: every walk, mean and spread.",
        picture(drawn, f"Speed error of every walk of the {where}, by command and policy"),
        *walk_tables(walks),
        Fold("Definitions", _definitions(WALK_FIGURES.values())),
    )
    line = (
        "The paper reports stable walking at 2 m/s forward and backward and at 1 m/s sideways "
        f"(R4). Counted: {', '.join(c.case for c in own)}, {walks.script.run_s:g} s each."
    )
    text = f"{first}, {where}: {fell} of {n} walks ended in a fall."
    fields = {"summary": text, "lines": [line], "warning": fell > 0, "sections": [section]}
    return _part(path, root, walks, **fields, **names)


def _definitions(figures: Any) -> Sheet:
    return table("figure | unit | equation", ((f.name, f.unit, f.says) for f in figures))


def climb_line(climb: Climb) -> Array:
    """Return size [m], share of crossed runs with the best lead, and its interval; (4, n)."""
    return np.array(
        [
            (rung.size, rung.crossed / rung.runs, *share_interval(rung.crossed, rung.runs))
            for rung in climb.rungs
        ]
    ).T


def crossing_table(crossings: Results) -> Sheet:
    """Return the largest sizes, and why larger ones were not crossed."""
    rows, settings = [], crossings.settings
    notes = [
        f"crossed: in {settings['enough']} or more of {settings['runs']} runs, as were all smaller "
        "ones. ever crossed: in any run. The paper's gaps were judged from video of jumps over "
        "flat floor."
    ]
    for climb in climbs(crossings):
        what = f"{climb.policy}: {_OBSTACLES.get(climb.kind, climb.kind)}, {climb.case}"
        last = climb.rungs[-1] if climb.rungs else None
        paper = PAPER_GAPS.get(climb.case, math.nan) if climb.kind == "gap" else math.nan
        failed = last.size if last and last.size > climb.largest else math.nan
        rows.append((what, climb.largest, climb.ever, paper, failed))
        if last and math.isfinite(failed):
            counted = sorted(last.reasons.items(), key=lambda item: -item[1])
            why = "; ".join(f"{reason} ({count})" for reason, count in counted)
            notes.append(f"{what}, {failed:.2f} m: {why}.")
    columns = "policy: obstacle | crossed;2 | ever crossed;2 | paper, from video;2 | failed at;2"
    return table(columns, rows, *notes, title="Largest obstacles [m]")


def crossing_part(path: Path, root: Path, **names: str) -> Part:
    """Make the part of the crossings in `path`, a `crossing.json`, as `walk_part`."""
    crossings = results_file.load(path.parent, CROSSING)
    where, first, found = place(crossings), crossings.subjects[0].name, climbs(crossings)
    panels = [
        Panel(
            title=f"{_OBSTACLES.get(kind, kind)}, {case.name}",
            x_label="size [m]",
            y_label="crossed [1]",
            lines={
                climb.policy: climb_line(climb)
                for climb in found
                if (climb.case, climb.kind) == (case.name, kind) and climb.rungs
            },
            marks=(PAPER_GAPS[case.name],) if kind == "gap" and case.name in PAPER_GAPS else (),
            share=True,
        )
        for kind in crossings.settings["kinds"]
        for case in crossings.cases
    ]
    own = [c for c in found if c.policy == first and c.kind == "gap"]
    crossed = ", ".join(f"{number(climb.largest, 2)} m ({climb.case})" for climb in own)
    mark = "paper, hardware: widest gap, from video"
    figure = draw.lines(panels, columns=len(crossings.cases), mark=mark, bar="95 % interval")
    section = Section(
        "Share of crossed obstacles over size",
        "Gaps and steps in the floor; an operator who sees the robot gives the jump input. Share "
        "of runs that crossed, with the lead that did best.",
        picture(figure, f"Share of runs in which the {where} crossed, over obstacle size"),
        crossing_table(crossings),
    )
    text = f"{first}, {where}: gaps crossed {crossed or 'none'}."
    return _part(path, root, crossings, summary=text, sections=[section], **names)


def by_value(variation: Results, parameter: str, policy: str) -> list[tuple[Cell, ...]]:
    """Return the cells of a policy, all commands of a value together, by value."""
    cases = [varied.line(variation, parameter, policy, case.name) for case in variation.cases]
    return list(zip(*cases, strict=True))


def mean(values: Sequence[float]) -> float:
    """Return the mean of the finite values; NaN without any."""
    kept = [value for value in values if np.isfinite(value)]
    return float(np.mean(kept)) if kept else float("nan")


def varied_line(cells: Sequence[Sequence[Cell]], figure: str) -> Array:
    """Return value, result and the ends of its bar; (4, n).

    The result is the mean of the commands' means, with the mean of their standard deviations; of
    `landed` the share of all jumps, with Wilson's interval.
    """
    points = []
    for together in cells:
        if figure == "landed":
            landed, n = sum(c.succeeded for c in together), sum(c.n for c in together)
            bar = (landed / n, *share_interval(landed, n))
        else:
            y, d = (
                mean([getattr(c.figures[figure], of) for c in together]) for of in ("mean", "std")
            )
            bar = (y, y - d, y + d)
        points.append((together[0].value, *bar))
    return np.array(points).T


def variation_panels(variation: Results) -> list[Panel]:
    """Return a column for each parameter, rows of height, distance and landed."""
    rows = {"height [m]": "height", "distance [m]": "distance", "landed [1]": "landed"}
    found = []
    for label, figure in rows.items():
        for each in parameters_of(variation):
            name = each.name.removesuffix("_s").replace("_", " ")
            lines = {
                policy: varied_line(by_value(variation, each.name, policy), figure)
                for policy in trial_page.policies(variation)
            }
            found.append(
                Panel(
                    title=name if figure == "height" else "",
                    x_label=f"{name} [{each.unit}]" if figure == "landed" else "",
                    y_label=label,
                    lines=lines,
                    marks=(variation.settings["nominal"][each.name],),
                    share=figure == "landed",
                )
            )
    return found


def variation_part(path: Path, root: Path, **names: str) -> Part:
    """Make the part of the variation in `path`, a `variation.json`, as `walk_part`."""
    variation = results_file.load(path.parent, VARIATION)
    where, first = place(variation), variation.subjects[0].name
    own = [cell for cell in variation.cells if cell.policy == first]
    landed, n = sum(c.succeeded for c in own), sum(c.n for c in own)
    parameters, panels = parameters_of(variation), variation_panels(variation)
    bar = "mean standard deviation; 95 % interval of the share"
    figure = draw.lines(panels, columns=len(parameters), mark="nominal", bar=bar)
    varying = ", ".join(each.says for each in parameters)
    trained = "; ".join(f"{each.says}: {each.trained.replace('`', '')}" for each in parameters)
    section = Section(
        "Results over varied parameters",
        "One parameter of the robot is varied at a time; starts and noise are the same. Lines are "
        "means over the commands, without those that gave no jump.",
        picture(figure, f"Height, distance and landings on the {where} over {varying}"),
        varied.table(variation),
        f"Training ranges: {trained}.",
        Fold("Definitions", _definitions(FIGURES[n] for n in varied.VARIED_FIGURES)),
    )
    text = f"{first}, {where}: {landed} of {n} jumps on varied robots landed."
    return _part(path, root, variation, summary=text, sections=[section], **names)


def errors_db(bodies: Bodies) -> dict[str, float]:
    """Return the error of training gains on each robot's sweep, by `POLICY, BODY` [dB RMS]."""
    return {
        f"{gains.removeprefix(_OF_POLICY)}, {body.name}": error
        for body in bodies.bodies
        for gains, error in body.errors.items()
        if gains.startswith(_OF_POLICY)
    }


def by_body(bodies: Bodies, figure: str) -> Values:
    """Return one figure of every jump, by `POLICY, BODY` and command."""
    return {
        f"{policy}, {body.name}": own
        for body in bodies.bodies
        for policy, own in trial_page.values(body.trial, figure).items()
    }


def _bodies_gains(bodies: Bodies) -> Sheet:
    names = dict.fromkeys(gains for body in bodies.bodies for gains in body.errors)
    found = [body.errors for body in bodies.bodies]
    return table(
        " | ".join(["gains", *(f"{body.name};2" for body in bodies.bodies)]),
        [(name, *(errors.get(name) for errors in found)) for name in names],
        "drive's own: those set on the drives. By group: as training would use them.",
        title="Error of gains on each robot's own sweep [dB RMS]",
    )


def bodies_part(path: Path, root: Path, **names: str) -> Part:
    """Make the part of the randomized robots in `path`, a `bodies.json`, as `walk_part`."""
    bodies = bodies_file.load(path.parent)
    where, errors = place(bodies), errors_db(bodies)
    cells = [cell for body in bodies.bodies for cell in body.trial.cells]
    landed, n = sum(c.succeeded for c in cells), sum(c.n for c in cells)
    verdicts = []
    for body in bodies.bodies:
        first, *others = (subject.name for subject in body.trial.subjects)
        checks = trial_checks(body.trial)
        passed = f"{sum(check.passed for check in checks)} of {len(checks)}"
        own = f"{body.name}: {passed} acceptance criteria passed by {first}"
        verdicts.append("; ".join([own, *(verdict(body.trial, other) for other in others)]))
    sections = [
        Section(
            "Each robot, matched by its own sweep",
            "The policies were trained with the gains of another robot. The match of each gives "
            "the error of those gains on it.",
            bodies_file.table(bodies),
            *verdicts,
            _bodies_gains(bodies),
        )
    ]
    if len(errors) > 1:
        panels = {f"{name} [m]": by_body(bodies, name) for name in ("height", "distance")}
        words = f"Standard deviation of height and distance on each {where} over the gain error"
        drawn = picture(draw.scatter_over_error(errors, panels), words)
        text = "Each mark is a command of a policy on a robot."
        sections.append(Section("Scatter over gain error", text, drawn))
    for name in ("height", "distance"):
        paper, label = trial_page.published(name), f"{name} [m]"
        shown = [
            (f"{one.name}\n{label}", trial_page.values(one.trial, name), paper)
            for one in bodies.bodies
        ]
        words = f"{name.capitalize()} of every jump on each {where}, with the paper's means"
        drawn = picture(draw.cells(shown), words)
        sections.append(Section(f"{name.capitalize()} on each robot", drawn))
    folders = ", ".join(body.folder for body in bodies.bodies)
    line = f"pronk report FOLDER makes a page of each folder: {folders}."
    text = f"{len(bodies.bodies)} other {where}s: {landed} of {n} jumps landed."
    return _part(path, root, bodies, summary=text, lines=[line], sections=sections, **names)
