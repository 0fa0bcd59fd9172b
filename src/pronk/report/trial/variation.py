"""How results move with the robot's body, one number at a time, as a part of a page."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from pronk.evaluation.metrics import FIGURES
from pronk.evaluation.published import in_paper_order
from pronk.evaluation.results import Cell, Results, share_interval
from pronk.evaluation.tables import Sheet, number, spread
from pronk.evaluation.variation import NOMINAL, VARIED_FIGURES, Parameter, line, parameters_of
from pronk.report import shell
from pronk.report.shell import Part
from pronk.report.trial.extra import Block, part, place
from pronk.report.trial.sweeps import Line, Panel, lines

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


def panels(variation: Results) -> list[Panel]:
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


def _table(variation: Results, parameter: Parameter) -> Sheet:
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
                panels(variation),
                across=len(parameters_of(variation)),
                mark="nominal",
                bar="mean standard deviation; 95 % interval of the share",
            ),
            f"Height, distance and success on the {where} over trunk mass, friction, delay and "
            "bus voltage",
        ),
        sheets=tuple(_table(variation, each) for each in parameters_of(variation)),
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
