"""Pages of walking, crossing, variation and randomized robots."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from pronk.evaluation.bodies import Bodies, Body
from pronk.evaluation.criteria import trial_checks
from pronk.evaluation.crossing import Climb, climbs
from pronk.evaluation.metrics import FIGURES, Figure
from pronk.evaluation.published import in_paper_order
from pronk.evaluation.results import Cell, Results, share_interval
from pronk.evaluation.tables import Sheet, number, spread, table_iii, verdict
from pronk.evaluation.variation import NOMINAL, VARIED_FIGURES, Parameter, line, parameters_of
from pronk.evaluation.walk_metrics import SETTLE_S, WALK_FIGURES
from pronk.report import shell
from pronk.report.shell import Block, Part
from pronk.report.trial_figures import Array, Line, Panel, Values, argument, cells, lines
from pronk.report.trial_page import policies, published, values


def place(origin: Results | Bodies) -> str:
    """Where it was measured, in words."""
    return "virtual robot" if origin.virtual else "robot"


def part(
    blocks: Sequence[Block],
    *,
    anchor: str,
    title: str,
    says: str,
    origin: Results | Bodies,
    lines: Iterable[str] = (),
    warning: bool = False,
    definitions: Iterable[Figure] = (),
) -> Part:
    """Put a part together.

    Args:
        blocks: Its sections.
        anchor: What the anchors of the part begin with.
        title: Of the part.
        says: The verdict, one sentence.
        origin: Where the numbers come from.
        lines: Below the verdict.
        warning: Some result is not as expected.
        definitions: Of its figures.
    """
    versions = ", ".join(f"{name} {version}" for name, version in origin.versions.items())
    hashes = ", ".join(f"{subject.name} {subject.sha256[:12]}" for subject in origin.subjects)
    body = str(origin.sim_params.get("sha256", "unknown"))[:12]
    html = shell.fill(
        "extra.html.j2",
        at=f"{anchor}-" if anchor else "",
        says=says,
        lines=list(lines),
        warning=warning,
        blocks=blocks,
        definitions=list(definitions),
        origin=f"Measured on the {place(origin)}, seed {origin.seed}, body {body}; policies: "
        f"{hashes}; versions: {versions}.",
    )
    return Part(anchor=anchor, title=title, html=html)


PAPER_WALKS = ("forward 2", "back 2", "side -1", "side +1")
"""Velocities of the paper's R4."""
_SHOWN = (
    "lasted",
    "forward",
    "left",
    "yaw_rate",
    "speed_error",
    "speed_error_averaged",
    "yaw_error_averaged",
    "roll_rate_rms",
    "pitch_rate_rms",
    "power",
    "cost_of_transport",
)


def walk_values(walks: Results, figure: str) -> Values:
    """One figure of every walk, by policy and command."""
    return {
        name: {
            case.name: np.array(
                [
                    getattr(row.figures, figure)
                    for row in walks.rows
                    if (row.policy, row.case) == (name, case.name)
                ],
                dtype=float,
            )
            for case in walks.cases
        }
        for name in in_paper_order(subject.name for subject in walks.subjects)
    }


def walk_tables(walks: Results) -> tuple[Sheet, ...]:
    """One for each policy: figures by velocity."""
    return tuple(_walk_table(walks, subject.name) for subject in walks.subjects)


def _walk_table(walks: Results, policy: str) -> Sheet:
    own = [cell for cell in walks.cells if cell.policy == policy]
    counts = {
        "walks": [cell.n for cell in own],
        "fell": [cell.fell for cell in own],
        "non-foot contact": [cell.non_foot_contact for cell in own],
    }
    return Sheet(
        title=f"{policy}: mean ± standard deviation",
        columns=("figure", *(cell.case for cell in own)),
        rows=(
            *((name, *map(str, walk_values)) for name, walk_values in counts.items()),
            *(
                (
                    f"{name.replace('_', ' ')} [{WALK_FIGURES[name].unit}]",
                    *(spread(cell.figures[name], 2) for cell in own),
                )
                for name in _SHOWN
            ),
        ),
        notes=(
            "non-foot contact: walks in which something but a foot touched the ground. The first "
            f"{SETTLE_S:g} s after the command are left out; a walk that ended "
            "in a fall counts with what came before.",
        ),
    )


def walk_part(walks: Results, *, anchor: str, title: str = "Walking") -> Part:
    """The walks as a part of a page."""
    first = walks.subjects[0].name
    own = [cell for cell in walks.cells if cell.policy == first and cell.case in PAPER_WALKS] or [
        cell for cell in walks.cells if cell.policy == first
    ]
    fell, n = sum(cell.fell for cell in own), sum(cell.n for cell in own)
    where = place(walks)
    names = ", ".join(cell.case for cell in own)
    lines = [
        "The paper says that its robot walks stably at 2 m/s forward and backward and at 1 m/s "
        f"sideways (R4). Counted here: {names}, each for {walks.script.run_s:g} s.",
    ]
    shown = Block(
        anchor="errors",
        title="How well the velocities were kept",
        lines=(f"{WALK_FIGURES['speed_error_averaged'].says}: every walk, mean and spread.",),
        picture=shell.picture(
            cells([("speed error [m/s]", walk_values(walks, "speed_error_averaged"), {})]),
            f"Speed error of every walk of the {where}, by command and policy",
        ),
        sheets=walk_tables(walks),
    )
    return part(
        [shown],
        anchor=anchor,
        title=title,
        says=f"{first}, {where}: {fell} of {n} walks ended in a fall.",
        origin=walks,
        lines=lines,
        warning=fell > 0,
        definitions=WALK_FIGURES.values(),
    )


PAPER_GAPS = {"forward 2": 0.55, "back 2": 0.50, "side -1": 0.40, "side +1": 0.40}
"""Widest gaps that the paper says its robot could cross, read off video (R3) [m]."""
_WORDS = {"gap": "gap", "up": "step up", "down": "step down"}


def climb_line(climb: Climb) -> Line:
    """Share of crossed runs over the size, each with the lead that did best."""
    shares = [rung.crossed / rung.runs for rung in climb.rungs]
    ends = [share_interval(rung.crossed, rung.runs) for rung in climb.rungs]
    return Line(
        x=np.array([rung.size for rung in climb.rungs]),
        y=np.array(shares),
        low=np.array([low for low, _ in ends]),
        high=np.array([high for _, high in ends]),
    )


def crossing_panels(crossings: Results) -> list[Panel]:
    """A row for each kind of obstacle, a column for each command."""
    return [
        Panel(
            title=f"{_WORDS.get(kind, kind)}, {case.name}",
            x_label="size [m]",
            y_label="crossed [1]",
            lines={
                climb.policy: climb_line(climb)
                for climb in climbs(crossings)
                if (climb.case, climb.kind) == (case.name, kind) and climb.rungs
            },
            marks=(PAPER_GAPS[case.name],) if kind == "gap" and case.name in PAPER_GAPS else (),
            share=True,
        )
        for kind in crossings.settings["kinds"]
        for case in crossings.cases
    ]


def table(crossings: Results) -> Sheet:
    """Largest sizes, and why larger ones were not crossed."""
    rows, reasons = [], []
    for climb in climbs(crossings):
        what = f"{climb.policy}: {_WORDS.get(climb.kind, climb.kind)}, {climb.case}"
        last = climb.rungs[-1] if climb.rungs else None
        paper = PAPER_GAPS.get(climb.case, math.nan) if climb.kind == "gap" else math.nan
        failed = last.size if last and last.size > climb.largest else math.nan
        sizes = (climb.largest, climb.ever, paper, failed)
        rows.append((what, *(number(size, 2) for size in sizes)))
        if last and math.isfinite(failed):
            counted = sorted(last.reasons.items(), key=lambda item: -item[1])
            why = "; ".join(f"{reason} ({count})" for reason, count in counted)
            reasons.append(f"{what}, {number(failed, 2)} m: {why}.")
    return Sheet(
        title="Largest obstacles [m]",
        columns=("policy: obstacle", "crossed", "ever crossed", "paper, from video", "failed at"),
        rows=tuple(rows),
        notes=(
            f"crossed: in {crossings.settings['enough']} or more of {crossings.settings['runs']} "
            "runs, as were all smaller ones. ever: in any run. The paper's gaps were judged "
            "from video of jumps over flat floor, not crossed.",
            *reasons,
        ),
    )


def crossing_part(
    crossings: Results, *, anchor: str, title: str = "Crossing gaps and steps"
) -> Part:
    """The crossings as a part of a page."""
    where, first = place(crossings), crossings.subjects[0].name
    own = [c for c in climbs(crossings) if c.policy == first and c.kind == "gap"]
    reached = ", ".join(f"{number(climb.largest, 2)} m ({climb.case})" for climb in own)
    drawn = Block(
        anchor="sizes",
        title="Growing, until it fails",
        lines=(
            "Real gaps and steps in the floor; somebody who sees the robot from outside has it "
            "jump. Share of runs that crossed, with the lead that did best.",
        ),
        picture=shell.picture(
            lines(
                crossing_panels(crossings),
                across=len(crossings.cases),
                mark="paper, hardware: widest gap, from video",
                bar="95 % interval",
                sharex="row",
            ),
            f"Share of runs in which the {where} crossed an obstacle, over its size",
        ),
        sheets=(table(crossings),),
    )
    return part(
        [drawn],
        anchor=anchor,
        title=title,
        says=f"{first}, {where}: gaps crossed {reached}." if own else f"{first}, {where}.",
        origin=crossings,
    )


_DRAWN = ("height", "distance")
_TABLED = ("height", "distance", "gap")


def known_mean(values: Sequence[float]) -> float:
    """Mean of those that are numbers; NaN without any."""
    kept = [value for value in values if np.isfinite(value)]
    return float(np.mean(kept)) if kept else float("nan")


def by_value(variation: Results, parameter: str, policy: str) -> list[tuple[Cell, ...]]:
    """The points of a policy, those of all commands at one value together, in its order."""
    per_case = [line(variation, parameter, policy, case.name) for case in variation.cases]
    return list(zip(*per_case, strict=True))


def figure_line(together: Sequence[Sequence[Cell]], figure: str) -> Line:
    """Mean of the commands' means over the value, with the mean of their standard deviations.

    Args:
        together: By value, the points of every command.
        figure: Which.
    """
    y = np.array([known_mean([p.figures[figure].mean for p in points]) for points in together])
    std = np.array([known_mean([p.figures[figure].std for p in points]) for points in together])
    x = np.array([points[0].value for points in together])
    return Line(x=x, y=y, low=y - std, high=y + std)


def success_line(together: Sequence[Sequence[Cell]]) -> Line:
    """Share of good landings of all jumps over the value, with Wilson's interval."""
    counts = [(sum(p.succeeded for p in points), sum(p.n for p in points)) for points in together]
    ends = [share_interval(*count) for count in counts]
    return Line(
        x=np.array([points[0].value for points in together]),
        y=np.array([good / n for good, n in counts]),
        low=np.array([low for low, _ in ends]),
        high=np.array([high for _, high in ends]),
    )


def variation_panels(variation: Results) -> list[Panel]:
    """A column for each parameter; rows of height, distance and success."""
    policies = in_paper_order(subject.name for subject in variation.subjects)
    rows: list[tuple[str, bool, Callable[[Sequence[Sequence[Cell]]], Line]]] = [
        *(
            (f"{name} [m]", False, lambda together, name=name: figure_line(together, name))
            for name in _DRAWN
        ),
        ("landed well [1]", True, success_line),
    ]
    return [
        Panel(
            title=_title(each) if i == 0 else "",
            x_label=f"{_title(each)} [{each.unit}]" if i == len(rows) - 1 else "",
            y_label=label,
            lines={name: draw(by_value(variation, each.name, name)) for name in policies},
            marks=(variation.settings["nominal"][each.name],),
            share=share,
        )
        for i, (label, share, draw) in enumerate(rows)
        for each in parameters_of(variation)
    ]


def _title(parameter: Parameter) -> str:
    """Short: the name without its unit."""
    return parameter.name.removesuffix("_s").replace("_", " ")


def _variation_table(variation: Results, parameter: Parameter) -> Sheet:
    """One row a value; means over the commands."""
    names = [subject.name for subject in variation.subjects]
    by_policy = {name: by_value(variation, parameter.name, name) for name in names}
    rows = []
    for i, points in enumerate(by_policy[names[0]]):
        value = points[0].value
        own = f" ({NOMINAL})" if value == variation.settings["nominal"][parameter.name] else ""
        cells = [f"{value:g}{own}"]
        for name in names:
            here = by_policy[name][i]
            good, n = sum(p.succeeded for p in here), sum(p.n for p in here)
            cells += [f"{good}/{n}", *(_mean_spread(here, figure) for figure in _TABLED)]
        rows.append(tuple(cells))
    return Sheet(
        title=f"{parameter.says} [{parameter.unit}]",
        columns=(
            _title(parameter),
            *(f"{name}: {what}" for name in names for what in ("landed", *_TABLED)),
        ),
        rows=tuple(rows),
        notes=(f"Training had {parameter.trained.replace('`', '')}.",),
    )


def _mean_spread(points: Sequence[Cell], figure: str) -> str:
    mean = known_mean([p.figures[figure].mean for p in points])
    std = known_mean([p.figures[figure].std for p in points])
    return f"{number(mean)} ± {number(std)}"


def _everything(variation: Results) -> Sheet:
    """Every point of every command, in full."""
    return Sheet(
        title="Every command",
        columns=(
            "varied",
            "value",
            "policy",
            "command",
            "jumped",
            "landed",
            "fell",
            *(f"{name.replace('_', ' ')} [{FIGURES[name].unit}]" for name in VARIED_FIGURES),
        ),
        rows=tuple(
            (
                point.parameter.replace("_", " "),
                "-" if point.parameter == NOMINAL else f"{point.value:g}",
                point.policy,
                point.case,
                f"{point.found}/{point.n}",
                f"{point.succeeded}/{point.n}",
                str(point.fell),
                *(spread(point.figures[name]) for name in VARIED_FIGURES),
            )
            for point in variation.cells
        ),
    )


def variation_part(variation: Results, *, anchor: str, title: str = "Variation") -> Part:
    """The variation as a part of a page."""
    where, first = place(variation), variation.subjects[0].name
    own = [point for point in variation.cells if point.policy == first]
    good, n = sum(p.succeeded for p in own), sum(p.n for p in own)
    drawn = Block(
        anchor="moves",
        title="How results move",
        lines=(
            "One number of the body is changed, everything else, starts and noise included, stays. "
            "Lines: means over the commands, each counting alike; a command without a jump is left "
            "out of the mean and shows in the landings.",
        ),
        picture=shell.picture(
            lines(
                variation_panels(variation),
                across=len(parameters_of(variation)),
                mark="nominal",
                bar="mean standard deviation; 95 % interval of the share",
            ),
            f"Height, distance and success on the {where} over trunk mass, friction, delay and "
            "bus voltage",
        ),
        sheets=tuple(_variation_table(variation, each) for each in parameters_of(variation)),
        folded=(_everything(variation),),
    )
    return part(
        [drawn],
        anchor=anchor,
        title=title,
        says=f"{first}, {where}: {good} of {n} jumps on varied bodies landed well.",
        origin=variation,
        definitions=[FIGURES[name] for name in VARIED_FIGURES],
    )


_OF_POLICY = "training gains of "


def errors_db(bodies: Bodies) -> dict[str, float]:
    """Error of each policy's training gains on each body's own sweep [dB RMS].

    Returns:
        By `POLICY, BODY`.
    """
    return {
        f"{one.gains.removeprefix(_OF_POLICY)}, {body.name}": one.rms_db
        for body in bodies.bodies
        for one in body.errors
        if one.gains.startswith(_OF_POLICY)
    }


def by_body(bodies: Bodies, figure: str) -> Values:
    """One figure of every jump, by `POLICY, BODY` and command."""
    found: dict[str, Mapping[str, Array]] = {}
    for body in bodies.bodies:
        cases = [case.name for case in body.trial.cases]
        for policy, own in values(body.trial, figure, cases).items():
            found[f"{policy}, {body.name}"] = own
    return found


def _bodies_summary(bodies: Bodies) -> Sheet:
    """One row for each body and policy."""
    rows = []
    for body in bodies.bodies:
        errors = {one.gains: one.rms_db for one in body.errors}
        for name in policies(body.trial):
            own = [cell for cell in body.trial.cells if cell.policy == name]
            commanded, landed = sum(cell.n for cell in own), sum(cell.succeeded for cell in own)
            stds = {
                figure: [cell.figures[figure].std for cell in own]
                for figure in ("height", "distance")
            }
            best = max((c.figures["height"].mean for c in own if c.found), default=math.nan)
            rows.append(
                (
                    f"{body.name}: {name}",
                    number(errors.get(f"{_OF_POLICY}{name}", math.nan), 2),
                    f"{landed}/{commanded}",
                    number(best),
                    *(number(sum(each) / len(each)) for each in stds.values()),
                    _passed(body) if name == body.trial.subjects[0].name else "-",
                )
            )
    return Sheet(
        title="Every body",
        columns=(
            "body: policy",
            "gains [dB RMS]",
            "landed",
            "best height [m]",
            "height scatter [m]",
            "distance scatter [m]",
            "criteria",
        ),
        rows=tuple(rows),
        notes=(
            "gains: error of the policy's training gains on the body's own sweep. scatter: mean of "
            "the commands' standard deviations. criteria: passed by the first policy.",
            *(
                f"{body.name}: {verdict(body.trial, other.name)}"
                for body in bodies.bodies
                for other in body.trial.subjects[1:]
            ),
        ),
    )


def _passed(body: Body) -> str:
    found = trial_checks(body.trial)
    return f"{sum(check.passed for check in found)}/{len(found)}"


def _bodies_gains(bodies: Bodies) -> Sheet:
    """Error of every set of gains on each body's own sweep."""
    names = list(dict.fromkeys(one.gains for body in bodies.bodies for one in body.errors))
    found = [{one.gains: one.rms_db for one in body.errors} for body in bodies.bodies]
    return Sheet(
        title="Error of gains on each body's own sweep [dB RMS]",
        columns=("gains", *(body.name for body in bodies.bodies)),
        rows=tuple(
            (name, *(number(errors.get(name, math.nan), 2) for errors in found)) for name in names
        ),
        notes=(
            "drive's own: those set on the drives, put into the simulator as they are. Matched "
            "anew: by the sweep of this body; by group: as training would use them.",
        ),
    )


def bodies_part(bodies: Bodies, *, anchor: str, title: str = "Bodies never seen") -> Part:
    """The bodies as a part of a page."""
    where, count = place(bodies), len(bodies.bodies)
    blocks = [
        Block(
            anchor="summary",
            title="Every body, matched anew by its own sweep",
            lines=(
                "The policies were trained with the gains of the robot they were made for, not "
                "with those of these bodies. The match of a body says how far off those gains are; "
                "the jumps say what becomes of it.",
            ),
            sheets=(_bodies_summary(bodies), _bodies_gains(bodies)),
        )
    ]
    errors = errors_db(bodies)
    if len(errors) > 1:
        panels = {f"{name} [m]": by_body(bodies, name) for name in ("height", "distance")}
        blocks.append(
            Block(
                anchor="argument",
                title="Error of the training gains beside the scatter of the jumps",
                lines=("Every mark is a command of a policy on a body.",),
                picture=shell.picture(
                    argument(errors, panels, named=False),
                    f"Standard deviation of height and distance on each {where} over the error of "
                    "the training gains on its sweep",
                ),
            )
        )
    for figure in ("height", "distance"):
        shown = [
            (
                f"{body.name}\n{figure} [m]",
                values(body.trial, figure, [case.name for case in body.trial.cases]),
                published(figure),
            )
            for body in bodies.bodies
        ]
        blocks.append(
            Block(
                anchor=figure,
                title=f"{figure.capitalize()} on every body",
                picture=shell.picture(
                    cells(shown),
                    f"{figure.capitalize()} of every jump on each {where}, by command and policy, "
                    "with the paper's means and standard deviations",
                ),
                folded=tuple(_titled(body, figure) for body in bodies.bodies),
            )
        )
    landed = sum(c.succeeded for b in bodies.bodies for c in b.trial.cells)
    commanded = sum(c.n for b in bodies.bodies for c in b.trial.cells)
    return part(
        blocks,
        anchor=anchor,
        title=title,
        says=f"{count} other {where}s: {landed} of {commanded} jumps landed well.",
        origin=bodies,
        lines=(
            "Each was drawn within stated tolerances, swept and matched anew; its "
            f"folder ({', '.join(body.folder for body in bodies.bodies)}) has a page of its own: "
            "pronk report FOLDER.",
        ),
    )


def _titled(body: Body, figure: str) -> Sheet:
    sheet = table_iii(body.trial, figure)
    return Sheet(
        title=f"{body.name}: {sheet.title}",
        columns=sheet.columns,
        rows=sheet.rows,
        notes=sheet.notes[-1:],
    )
