"""Pages of walking, crossing, variation and randomized robots."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pronk.arrays import Array
from pronk.jump.trial import bodies as bodies_file
from pronk.jump.trial import results as results_file
from pronk.jump.trial import tables
from pronk.jump.trial import variation as varied
from pronk.jump.trial.bodies import Bodies, Body
from pronk.jump.trial.criteria import trial_checks
from pronk.jump.trial.crossing import CROSSING, Climb, climbs
from pronk.jump.trial.jumps import FIGURES
from pronk.jump.trial.results import Results, Spread, share_interval
from pronk.jump.trial.tables import Sheet, definitions, number, place, table, tally
from pronk.jump.trial.variation import VARIATION, parameters_of
from pronk.jump.trial.walk import SETTLE_S, WALK, WALK_FIGURES
from pronk.report import trial_figures as draw
from pronk.report import trial_page
from pronk.report.page import Part
from pronk.report.paper import GAPS, WALKS, published_jumps
from pronk.report.style import picture
from pronk.report.trial_figures import Panel

_OBSTACLES = {"gap": "gap", "up": "step up", "down": "step down"}
_WALK_TABLE = (
    *("lasted", "forward", "left", "yaw_rate", "speed_error", "speed_error_averaged"),
    *("yaw_error_averaged", "roll_rate_rms", "pitch_rate_rms", "power", "cost_of_transport"),
)
_OF_POLICY = "training gains of "


def _part(
    kind: str, title: str, origin: Results | Bodies, content: dict[str, Any], **fields: Any
) -> Part:
    content |= {"results": origin, "where": place(origin)}
    return Part(kind=kind, title=title, virtual=origin.virtual, content=content, **fields)


def walk_tables(walks: Results) -> tuple[Sheet, ...]:
    """Return the figures of the walks by velocity, a table a policy."""
    note = (
        "non-foot contact: walks in which something but a foot touched the ground. The first "
        f"{SETTLE_S:g} s after the command are left out."
    )
    sheets, figures = [], [WALK_FIGURES[name] for name in _WALK_TABLE]
    counts = {"walks": "n", "fell": "fell", "non-foot contact": "non_foot_contact"}
    for subject in walks.subjects:
        own = [cell for cell in walks.cells if cell.policy == subject.name]
        rows = [(name, *(str(getattr(c, field)) for c in own)) for name, field in counts.items()]
        title = f"{subject.name}: mean +- standard deviation"
        sheet = tables.of_figures(figures, own, note, title=title, digits=2)
        sheets.append(replace(sheet, rows=(*rows, *sheet.rows)))
    return tuple(sheets)


def walk_part(path: Path) -> Part:
    """Make the part of the walks in `path`, a `walk.json`."""
    walks, figure = results_file.load(path.parent, WALK), "speed_error_averaged"
    first = walks.subjects[0].name
    own = [cell for cell in walks.cells if cell.policy == first]
    own = [cell for cell in own if cell.case in WALKS] or own
    fell, n = sum(cell.fell for cell in own), sum(cell.n for cell in own)
    content = {
        "counted": [cell.case for cell in own],
        "says": WALK_FIGURES[figure].says,
        "cells": picture(draw.cells([("speed error [m/s]", trial_page.values(walks, figure), {})])),
        "tables": walk_tables(walks),
        "definitions": definitions(WALK_FIGURES.values()),
    }
    summary = f"{first}, {place(walks)}: {fell} of {n} walks ended in a fall."
    return _part("walk", "Walking", walks, content, summary=summary, warning=fell > 0)


def climb_line(climb: Climb) -> Array:
    """Return size [m], share of crossed runs with the best lead, and its interval; (4, n)."""
    counts = [(rung.size, rung.crossed, rung.runs) for rung in climb.rungs]
    return np.array([(size, k / n, *share_interval(k, n)) for size, k, n in counts]).T


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
        paper = GAPS.get(climb.case, math.nan) if climb.kind == "gap" else math.nan
        failed = last.size if last and last.size > climb.largest else math.nan
        rows.append((what, climb.largest, climb.ever, paper, failed))
        if last and math.isfinite(failed):
            counted = sorted(last.reasons.items(), key=lambda item: -item[1])
            why = "; ".join(f"{reason} ({count})" for reason, count in counted)
            notes.append(f"{what}, {failed:.2f} m: {why}.")
    columns = "policy: obstacle | crossed;2 | ever crossed;2 | paper, from video;2 | failed at;2"
    return table(columns, rows, *notes, title="Largest obstacles [m]")


def crossing_part(path: Path) -> Part:
    """Make the part of the crossings in `path`, a `crossing.json`."""
    crossings = results_file.load(path.parent, CROSSING)
    first, found = crossings.subjects[0].name, climbs(crossings)
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
            marks=(GAPS[case.name],) if kind == "gap" and case.name in GAPS else (),
            share=True,
        )
        for kind in crossings.settings["kinds"]
        for case in crossings.cases
    ]
    own = [c for c in found if c.policy == first and c.kind == "gap"]
    crossed = ", ".join(f"{number(climb.largest, 2)} m ({climb.case})" for climb in own)
    mark = "paper, hardware: widest gap, from video"
    figure = draw.lines(panels, columns=len(crossings.cases), mark=mark, bar="95 % interval")
    content = {"curves": picture(figure), "sheet": crossing_table(crossings)}
    summary = f"{first}, {place(crossings)}: gaps crossed {crossed or 'none'}."
    return _part("crossing", "Crossing gaps and steps", crossings, content, summary=summary)


def varied_line(variation: Results, parameter: str, policy: str, figure: str) -> Array:
    """Return value, result and the ends of its bar, over the values of a parameter; (4, n).

    The result is the mean of the commands' means, with the mean of their standard deviations; of
    `landed` the share of all jumps, with Wilson's interval.
    """
    cases = [varied.line(variation, parameter, policy, case.name) for case in variation.cases]
    points = []
    for cells in zip(*cases, strict=True):
        if figure == "landed":
            landed, n = tally(cells)
            bar = (landed / n, *share_interval(landed, n))
        else:
            spreads = [cell.figures[figure] for cell in cells]
            y, d = (Spread.of([getattr(s, of) for s in spreads]).mean for of in ("mean", "std"))
            bar = (y, y - d, y + d)
        points.append((cells[0].value, *bar))
    return np.array(points).T


def variation_panels(variation: Results) -> list[Panel]:
    """Return a column for each parameter, rows of height, distance and landed."""
    policies, parameters = trial_page.policies(variation), parameters_of(variation)
    named = [(each, each.name.removesuffix("_s").replace("_", " ")) for each in parameters]
    return [
        Panel(
            title=name if figure == "height" else "",
            x_label=f"{name} [{each.unit}]" if figure == "landed" else "",
            y_label=f"{figure} [{unit}]",
            lines={one: varied_line(variation, each.name, one, figure) for one in policies},
            marks=(variation.settings["nominal"][each.name],),
            share=figure == "landed",
        )
        for figure, unit in (("height", "m"), ("distance", "m"), ("landed", "1"))
        for each, name in named
    ]


def variation_part(path: Path) -> Part:
    """Make the part of the variation in `path`, a `variation.json`."""
    variation = results_file.load(path.parent, VARIATION)
    first, parameters = variation.subjects[0].name, parameters_of(variation)
    landed, n = tally(cell for cell in variation.cells if cell.policy == first)
    panels, bar = variation_panels(variation), "mean standard deviation; 95 % interval of the share"
    content = {
        "curves": picture(draw.lines(panels, columns=len(parameters), mark="nominal", bar=bar)),
        "sheet": varied.table(variation),
        "parameters": parameters,
        "definitions": definitions(FIGURES[name] for name in varied.VARIED_FIGURES),
    }
    summary = f"{first}, {place(variation)}: {landed} of {n} jumps on varied robots landed."
    return _part("variation", "Variation", variation, content, summary=summary)


def errors_db(bodies: Bodies) -> dict[str, float]:
    """Return the error of training gains on each robot's sweep, by `POLICY, BODY` [dB RMS]."""
    return {
        f"{gains.removeprefix(_OF_POLICY)}, {body.name}": error
        for body in bodies.bodies
        for gains, error in body.errors.items()
        if gains.startswith(_OF_POLICY)
    }


def _verdict(body: Body) -> str:
    first, *others = (subject.name for subject in body.trial.subjects)
    checks = trial_checks(body.trial)
    passed = sum(check.passed for check in checks)
    own = f"{body.name}: {passed} of {len(checks)} acceptance criteria passed by {first}"
    return "; ".join([own, *(tables.verdict(body.trial, other) for other in others)])


def _gains_table(bodies: Bodies) -> Sheet:
    names = dict.fromkeys(gains for body in bodies.bodies for gains in body.errors)
    return table(
        " | ".join(["gains", *(f"{body.name};2" for body in bodies.bodies)]),
        [(name, *(body.errors.get(name) for body in bodies.bodies)) for name in names],
        "drive's own: those set on the drives. By group: as training would use them.",
        title="Error of gains on each robot's own sweep [dB RMS]",
    )


def bodies_part(path: Path) -> Part:
    """Make the part of the randomized robots in `path`, a `bodies.json`."""
    bodies = bodies_file.load(path.parent)
    errors = errors_db(bodies)
    landed, n = tally(cell for body in bodies.bodies for cell in body.trial.cells)
    panels, figures = {}, {}
    for name in ("height", "distance"):
        label, paper = f"{name} [m]", published_jumps(name)
        own = {one.name: trial_page.values(one.trial, name) for one in bodies.bodies}
        panels[label] = {f"{p}, {b}": jumps for b, by in own.items() for p, jumps in by.items()}
        figures[name] = picture(draw.cells([(f"{b}\n{label}", by, paper) for b, by in own.items()]))
    content = {
        "sheet": bodies_file.table(bodies),
        "verdicts": list(map(_verdict, bodies.bodies)),
        "gains_table": _gains_table(bodies),
        "scatter": picture(draw.scatter_over_error(errors, panels)) if len(errors) > 1 else None,
        "cells": figures,
    }
    summary = f"{len(bodies.bodies)} other {place(bodies)}s: {landed} of {n} jumps landed."
    return _part("bodies", "Randomized robots", bodies, content, summary=summary)
