"""Tables of a trial as text, for the terminal and the page; a dash where nothing was measured."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from pronk.jump.trial.criteria import JUMPS, Check, trial_checks
from pronk.jump.trial.jumps import FIGURES, SYMBOLS, Figure
from pronk.jump.trial.protocol import PAPER_RATIOS, TABLE_III, in_paper_order
from pronk.jump.trial.results import FEWEST, Cell, Ratio, Results, Spread

DEFINITIONS = "Definitions"
"""Title of the table of equations."""


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """A table of text."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()


def table(columns: str, rows: Iterable[Sequence[Any]], *notes: str, title: str = "") -> Sheet:
    """Return a table; without a row it is left out of the page.

    Headers in `columns` have ` | ` between them; `;2` behind one sets the digits of its numbers, 3
    without it. Cells are text, numbers, and intervals as pairs of numbers; `held` for an empty one.
    """
    heads = [head.partition(";") for head in columns.split(" | ")]
    cells = tuple(
        tuple(_cell(cell, int(head[2] or 3)) for cell, head in zip(row, heads, strict=True))
        for row in rows
    )
    return Sheet(title=title, columns=tuple(head[0] for head in heads), rows=cells, notes=notes)


# ---- cells ----


def _cell(value: Any, digits: int) -> str:
    if isinstance(value, str | int):
        return str(value)
    if isinstance(value, tuple):
        same = value[0] == value[1]
        return "held" if same else " to ".join(_cell(one, digits) for one in value)
    return "-" if value is None else number(value, digits)


def number(value: float, digits: int = 3) -> str:
    """Format a number; a dash where it is unknown."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def percent(share: float) -> str:
    """Format a share in percent."""
    return number(100.0 * share, 1)


def spread(figure: Spread, digits: int = 3) -> str:
    """Format mean and standard deviation; of one run the value; without any a dash."""
    average = number(figure.mean, digits)
    return f"{average} +- {number(figure.std, digits)}" if figure.n > 1 else average


def interval(ratio: Ratio) -> str:
    """Format a ratio and its interval."""
    if not math.isfinite(ratio.value):
        return "-"
    known = math.isfinite(ratio.low)
    return f"{ratio.value:.2f} ({f'{ratio.low:.2f} to {ratio.high:.2f}' if known else 'too few'})"


def tally(cells: Iterable[Cell]) -> tuple[int, int]:
    """Count the landings, and all runs."""
    succeeded, n = zip(*((cell.succeeded, cell.n) for cell in cells), strict=True)
    return sum(succeeded), sum(n)


def landed(cells: Iterable[Cell]) -> str:
    """Format the count of landings among all runs."""
    return "{}/{}".format(*tally(cells))


def place(trial: Any) -> str:
    """Where results, or bodies, were measured, in words."""
    return "virtual robot" if trial.virtual else "robot"


def virtual_note(trial: Results) -> str:
    """Where the numbers come from."""
    where = "pronk's virtual robot, not a real one" if trial.virtual else "the real robot"
    params = str(trial.sim_params.get("sha256", "-"))[:12]
    return f"ours: {where}; seed {trial.seed}, sim_params {params}."


# ---- tables of a trial ----


def sheets(trial: Results) -> tuple[Sheet, ...]:
    """Return all tables, in the order in which they are read."""
    return (
        *(table_iii(trial, figure) for figure in ("height", "distance")),
        landings(trial),
        *(more(trial, subject.name) for subject in trial.subjects),
        drives(trial),
        *(scatter(trial, other.name) for other in trial.subjects[1:]),
        criteria(trial),
        definitions(),
    )


def table_iii(trial: Results, figure: str) -> Sheet:
    """The paper's Table III beside ours, for `height` or `distance`."""
    columns: dict[str, tuple[dict[str, str], list[float]]] = {}
    for gains in ("naive", "matched"):
        paper = TABLE_III[figure, gains]
        cells = {case: f"{mean:.3f} +- {std:.3f}" for case, (mean, std) in paper.items()}
        columns[f"paper, {gains}"] = cells, [std for _, std in paper.values()]
    for name in in_paper_order(subject.name for subject in trial.subjects):
        found = {case.name: trial.cell(name, case.name) for case in trial.cases}
        cells = {k: f"{spread(c.figures[figure])} ({c.found}/{c.n})" for k, c in found.items()}
        stds = [found[case].figures[figure].std for case in trial.pooled]
        columns[f"{name}, {place(trial)}"] = cells, stds
    rows = [
        (case.name, *(cells.get(case.name, "-") for cells, _ in columns.values()))
        for case in trial.cases
    ]
    means = [number(sum(stds) / len(stds)) for _, stds in columns.values()]
    scattered = (mean if mean == "-" else f"+- {mean}" for mean in means)
    return Sheet(
        title=f"{figure.capitalize()} [m]: mean +- standard deviation (jumps of commanded)",
        columns=("command", *columns),
        rows=(*rows, ("mean scatter", *scattered)),
        notes=(
            f"{figure}: {FIGURES[figure].says}.",
            f"mean scatter: mean of the standard deviations over {', '.join(trial.pooled)}.",
            "paper: five jumps a cell on the real robot, of one policy each (E2, A21).",
            virtual_note(trial),
        ),
    )


def landings(trial: Results) -> Sheet:
    """The outcome of every commanded jump."""
    rows = []
    for cell in trial.cells:
        shares = (100.0 * share for share in (cell.success, *cell.success_ci95))
        row = (f"{cell.policy}: {cell.case}", cell.n, cell.standing, cell.found, cell.succeeded)
        success, flights = "{:.0f} ({:.0f} to {:.0f})".format(*shares), cell.figures["high_flights"]
        rows.append((*row, success, cell.fell, spread(flights, 2)))
    return table(
        "policy: command | commanded | standing | jumped | landed | success [%] (95 %) | fell"
        " | high flights",
        rows,
        "landed: upright 2 s after touchdown, and nothing but feet touched the ground; of all "
        "commanded. fell: at any time of the run.",
        title="Landings",
    )


def more(trial: Results, policy: str) -> Sheet:
    """Every other figure of one policy, with every command."""
    elsewhere = ("height", "distance", "flights", "high_flights")
    own = [f for name, f in FIGURES.items() if not f.joints and name not in elsewhere]
    cells = [cell for cell in trial.cells if policy == cell.policy]
    title = f"Every other figure of {policy}: mean +- standard deviation"
    return of_figures(own, cells, virtual_note(trial), title=title)


def of_figures(
    figures: Iterable[Figure], cells: Sequence[Cell], *notes: str, title: str, digits: int = 3
) -> Sheet:
    """A row a figure with its unit: the spread of every cell, headed by its command."""
    rows = (
        (
            f"{one.name.replace('_', ' ')} [{one.unit}]",
            *(spread(cell.figures[one.name], digits) for cell in cells),
        )
        for one in figures
    )
    columns = ("figure", *(cell.case for cell in cells))
    return Sheet(title=title, columns=columns, rows=tuple(rows), notes=notes)


def drives(trial: Results) -> Sheet:
    """The largest loads of the drives over all jumps, by joint."""
    rows = []
    for policy in (subject.name for subject in trial.subjects):
        loads = [cell.joints for cell in trial.cells if cell.policy == policy and cell.found]
        for joint in trial.joint_names:
            torque, speed = (
                max((own[name][joint].most for own in loads), default=math.nan)
                for name in ("peak_torque", "peak_speed")
            )
            margin = min((own["torque_margin"][joint].least for own in loads), default=math.nan)
            rows.append((f"{policy}: {joint}", torque, speed, margin))
    columns = "policy: joint | torque [N m];1 | speed [rad/s];1 | margin [1]"
    note = f"margin: {FIGURES['torque_margin'].says}."
    return table(columns, rows, note, title="Drives: the greatest of all jumps")


def check_sheet(title: str, checks: Sequence[Check], *notes: str) -> Sheet:
    """Number, limit, and whether it passed, of every check; PASSED in a note counts them."""
    rows = []
    for check in checks:
        known = math.isfinite(check.value)
        measured = f"{check.value:.4f} {check.unit}".strip() if known else "-"
        limit = f"{check.sense} {check.limit:g} {check.unit}".strip()
        rows.append((check.what, measured, limit, "yes" if check.passed else "NO"))
    passed = f"{sum(check.passed for check in checks)} of {len(checks)} acceptance criteria passed"
    notes = tuple(note.replace("PASSED", passed) for note in notes)
    return table("what | measured | limit | passed", rows, *notes, title=title)


def criteria(trial: Results) -> Sheet:
    """The acceptance criteria of the first policy."""
    first = trial.subjects[0].name
    title = f"Acceptance criteria of {first}: the paper's matched column, and more"
    least = min(trial.cell(first, case).n for case in trial.pooled)
    few = (f"The criteria are meant for {JUMPS} jumps with each command; these are of {least}.",)
    return check_sheet(title, trial_checks(trial), "PASSED.", *few * (least < JUMPS))


def definitions(figures: Iterable[Figure] | None = None) -> Sheet:
    """The equation of every figure; of those of a jump if None."""
    rows = ((one.name, one.unit, one.says) for one in figures or FIGURES.values())
    notes = [SYMBOLS] * (figures is None)
    return table("figure | unit | equation", rows, *notes, title=DEFINITIONS)


def scatter(trial: Results, other: str | None = None) -> Sheet:
    """Standard deviations of another policy, the second if None, over those of the first."""
    first, other = trial.subjects[0].name, other or trial.subjects[1].name
    ratios = [ratio for ratio in trial.ratios if ratio.other == other]
    rows = []
    for figure in trial.kind.compared:
        cells = [interval(r).replace(" to ", "-") for r in ratios if r.figure == figure]
        rows.append((figure, *cells, number(PAPER_RATIOS.get(figure, math.nan), 2)))
    cases = dict.fromkeys(ratio.case or "all" for ratio in ratios)
    return Sheet(
        title=f"Standard deviations, {other} over {first}, with 95 % bootstrap intervals",
        columns=("figure", *cases, "paper, all"),
        rows=tuple(rows),
        notes=(
            f"all: ratio of the means over {', '.join(trial.pooled)}.",
            "paper: naive over matched; its Table III gives 2.08 in distance, its text has 2.30 "
            "(reading A4).",
            verdict(trial, other),
        ),
    )


def verdict(trial: Results, other: str) -> str:
    """One sentence on whether another policy scatters more than the first, as the paper claims."""
    first, parts, more_alike, unknown = trial.subjects[0].name, [], [], False
    overall = {r.figure: r for r in trial.ratios if r.case is None and r.other == other}
    for figure in ("distance", "height"):
        ratio, claim = overall[figure], PAPER_RATIOS[figure]
        if not math.isfinite(ratio.low):
            unknown = True
            parts.append(
                f"in {figure} {ratio.value:.2f} times as much, with fewer than {FEWEST} jumps in a "
                "command, too few for an interval"
                if math.isfinite(ratio.value)
                else f"in {figure} could not be measured"
            )
            continue
        how = "more" if ratio.low > 1.0 else "less" if ratio.high < 1.0 else "no clear difference"
        more_alike += [figure] * (ratio.low > 1.0)
        where = "above" if claim > ratio.high else "below" if claim < ratio.low else "within"
        parts.append(
            f"in {figure} {how}, {interval(ratio)} times, and the paper's {claim:g} is {where} "
            "that interval"
        )
    end = "undecided" if unknown else f"so {first} does not repeat its jumps better here"
    if more_alike:
        end = f"so {first} repeats its jumps better in {' and '.join(more_alike)}"
    return f"scatter of {other} against {first} on the {place(trial)}: {'; '.join(parts)}; {end}."
