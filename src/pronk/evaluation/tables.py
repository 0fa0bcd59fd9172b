"""Tables of a trial as text, for the terminal and the page; a dash where nothing was measured."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pronk.evaluation.criteria import JUMPS, Check, evaluation_checks, trial_checks
from pronk.evaluation.jumps import FIGURES, SYMBOLS
from pronk.evaluation.protocol import PAPER_RATIOS, TABLE_III, Pair, in_paper_order
from pronk.evaluation.results import FEWEST, Cell, Ratio, Results, Spread

if TYPE_CHECKING:
    from pronk.evaluation.training_sim.evaluation import Evaluation

DEFINITIONS = "Definitions"
"""Title of the table of equations."""
_CHECKS = ("what", "measured", "limit", "passed")


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """A table of text."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()


def number(value: float, digits: int = 3) -> str:
    """Format a number; a dash where it is unknown."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def percent(share: float) -> str:
    """Format a share in percent."""
    return number(100.0 * share, 1)


def pair(values: Pair | None) -> str:
    """Format mean and standard deviation of the paper; a dash where it has none."""
    return f"{values[0]:.3f} +- {values[1]:.3f}" if values else "-"


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


def place(trial: Results) -> str:
    """Where it was measured, in words."""
    return "virtual robot" if trial.virtual else "robot"


def virtual_note(trial: Results) -> str:
    """Where the numbers come from."""
    where = "pronk's virtual robot, not a real one" if trial.virtual else "the real robot"
    params = str(trial.sim_params.get("sha256", "-"))[:12]
    return f"ours: {where}; seed {trial.seed}, sim_params {params}."


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
    names, gains = in_paper_order(s.name for s in trial.subjects), ("naive", "matched")
    paper = {case: getattr(cell, figure) for case, cell in TABLE_III.items()}
    rows = []
    for case in trial.cases:
        own = (trial.cell(name, case.name) for name in names)
        published = paper.get(case.name, {})
        ours = (f"{spread(cell.figures[figure])} ({cell.found}/{cell.n})" for cell in own)
        rows.append((case.name, *(pair(published.get(each)) for each in gains), *ours))
    scatter = [[cell[each][1] for cell in paper.values()] for each in gains]
    scatter += [[trial.cell(n, case).figures[figure].std for case in trial.pooled] for n in names]
    means = (number(sum(stds) / len(stds)) for stds in scatter)
    rows.append(("mean scatter", *(one if one == "-" else f"+- {one}" for one in means)))
    ours = (f"{name}, {place(trial)}" for name in names)
    return Sheet(
        title=f"{figure.capitalize()} [m]: mean +- standard deviation (jumps of commanded)",
        columns=("command", "paper, naive", "paper, matched", *ours),
        rows=tuple(rows),
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
        low, high = (100.0 * share for share in cell.success_ci95)
        counts = map(str, (cell.n, cell.standing, cell.found, cell.succeeded))
        share = f"{100.0 * cell.success:.0f} ({low:.0f} to {high:.0f})"
        flights = spread(cell.figures["high_flights"], 2)
        rows.append((f"{cell.policy}: {cell.case}", *counts, share, str(cell.fell), flights))
    head = ("policy: command", "commanded", "standing", "jumped", "landed", "success [%] (95 %)")
    return Sheet(
        title="Landings",
        columns=(*head, "fell", "high flights"),
        rows=tuple(rows),
        notes=(
            "landed: upright 2 s after touchdown, and nothing but feet touched the ground; of all "
            "commanded. fell: at any time of the run.",
        ),
    )


def more(trial: Results, policy: str) -> Sheet:
    """Every other figure of one policy, with every command."""
    cells = [cell for cell in trial.cells if policy == cell.policy]
    shown = ("height", "distance", "flights", "high_flights")
    return Sheet(
        title=f"Every other figure of {policy}: mean +- standard deviation",
        columns=("figure", *(cell.case for cell in cells)),
        rows=tuple(
            figure_row(name, figure.unit, cells)
            for name, figure in FIGURES.items()
            if not figure.joints and name not in shown
        ),
        notes=(virtual_note(trial),),
    )


def figure_row(name: str, unit: str, cells: Iterable[Cell], digits: int = 3) -> tuple[str, ...]:
    """A row of one figure: its name with the unit, and the spread of every cell."""
    words = f"{name.replace('_', ' ')} [{unit}]"
    return (words, *(spread(cell.figures[name], digits) for cell in cells))


def drives(trial: Results) -> Sheet:
    """The largest loads of the drives over all jumps, by joint."""
    rows = []
    for subject in trial.subjects:
        cells = [cell for cell in trial.cells if cell.policy == subject.name]
        for joint in trial.joint_names:
            torque, speed = (
                max((c.joints[name][joint].most for c in cells if c.found), default=math.nan)
                for name in ("peak_torque", "peak_speed")
            )
            margins = (c.joints["torque_margin"][joint].least for c in cells if c.found)
            margin = number(min(margins, default=math.nan))
            rows.append((f"{subject.name}: {joint}", number(torque, 1), number(speed, 1), margin))
    return Sheet(
        title="Drives: the greatest of all jumps",
        columns=("policy: joint", "torque [N m]", "speed [rad/s]", "margin [1]"),
        rows=tuple(rows),
        notes=(f"margin: {FIGURES['torque_margin'].says}.",),
    )


def check_rows(checks: Sequence[Check]) -> tuple[tuple[str, ...], ...]:
    """Rows of number, limit, and whether it passed."""
    return tuple(
        (
            check.what,
            f"{check.value:.4f} {check.unit}".strip() if math.isfinite(check.value) else "-",
            f"{check.sense} {check.limit:g} {check.unit}".strip(),
            "yes" if check.passed else "NO",
        )
        for check in checks
    )


def criteria(trial: Results) -> Sheet:
    """The acceptance criteria of the first policy."""
    found, first = trial_checks(trial), trial.subjects[0].name
    passed = sum(check.passed for check in found)
    least = min(trial.cell(first, case).n for case in trial.pooled)
    few = (f"The criteria are meant for {JUMPS} jumps with each command; these are of {least}.",)
    notes = (f"{passed} of {len(found)} acceptance criteria passed.", *few * (least < JUMPS))
    title = f"Acceptance criteria of {first}: the paper's matched column, and more"
    return Sheet(title=title, columns=_CHECKS, rows=check_rows(found), notes=notes)


def definitions() -> Sheet:
    """The equation of every figure."""
    return Sheet(
        title=DEFINITIONS,
        columns=("figure", "unit", "equation"),
        rows=tuple((name, figure.unit, figure.says) for name, figure in FIGURES.items()),
        notes=(SYMBOLS,),
    )


def scatter(trial: Results, other: str | None = None) -> Sheet:
    """Standard deviations of another policy, the second if None, over those of the first."""
    first, other = trial.subjects[0].name, other or trial.subjects[1].name
    cases = (None, *(case.name for case in trial.cases))
    found = {(r.figure, r.case): interval(r) for r in trial.ratios if r.other == other}
    return Sheet(
        title=f"Standard deviations, {other} over {first}, with 95 % bootstrap intervals",
        columns=("figure", *(case or "all" for case in cases), "paper, all"),
        rows=tuple(
            (
                figure,
                *(found[figure, case].replace(" to ", "-") for case in cases),
                number(PAPER_RATIOS.get(figure, math.nan), 2),
            )
            for figure in trial.kind.compared
        ),
        notes=(
            f"all: ratio of the means over {', '.join(trial.pooled)}.",
            "paper: naive over matched; its Table III gives 2.08 in distance, its text says 2.30 "
            "(reading A4).",
            verdict(trial, other),
        ),
    )


def verdict(trial: Results, other: str) -> str:
    """One sentence on whether another policy scatters more than the first, as the paper claims."""
    parts, more_alike, unknown = [], [], False
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
    first = trial.subjects[0].name
    end = f"so {first} does not repeat its jumps better here"
    if more_alike:
        end = f"so {first} repeats its jumps better in {' and '.join(more_alike)}"
    elif unknown:
        end = "undecided"
    return f"scatter of {other} against {first} on the {place(trial)}: {'; '.join(parts)}; {end}."


def evaluation_sheets(evaluation: Evaluation) -> tuple[Sheet, ...]:
    """The tables of an evaluation in the training simulator."""
    checks, notes = evaluation_checks(evaluation), []
    if (found := evaluation.estimator) is not None:
        axes = " / ".join(f"{axis:.3f}" for axis in found.rmse)
        notes.append(
            f"estimator while walking: velocity RMSE {found.rmse_vector:.3f} m/s (forward / left / "
            f"up {axes}), contacts right {percent(found.contacts_right)} %"
        )
    notes.append(
        f"{sum(check.passed for check in checks)} of {len(checks)} acceptance criteria passed; "
        f"{evaluation.plan['robots']} robots a command, randomization "
        f"{evaluation.about.get('randomization', '-')}, seed {evaluation.plan['seed']}, "
        f"{evaluation.seconds:.0f} s"
    )
    rows = check_rows(checks)
    return (
        *([_walks(evaluation)] if evaluation.walks else ()),
        *([_jumps(evaluation)] if evaluation.jumps else ()),
        Sheet(title="Acceptance criteria", columns=_CHECKS, rows=rows, notes=tuple(notes)),
    )


def _walks(evaluation: Evaluation) -> Sheet:
    rows = []
    for walk in evaluation.walks:
        of = walk.figures
        errors = (
            f"{number(of[name].mean)} ({number(of[f'{name}_averaged'].mean)})"
            for name in ("speed_error", "yaw_error")
        )
        velocity = ", ".join(number(of[name].mean, 2) for name in ("forward", "left", "yaw_rate"))
        drift, high = number(of["drift"].mean, 2), number(100.0 * of["uncommanded"].most, 1)
        rows.append((walk.name, *errors, velocity, drift, percent(walk.shares["fell"]), high))
    columns = (
        "command;speed error [m/s];yaw rate error [rad/s];mean velocity [m/s, m/s, rad/s];"
        "drift [m];falls [%];flight over standing [cm]"
    )
    return Sheet(
        title="Walking: mean over robots and time; in brackets with the stride averaged out",
        columns=tuple(columns.split(";")),
        rows=tuple(rows),
    )


def _jumps(evaluation: Evaluation) -> Sheet:
    columns = (
        "command;height [m];distance [m];lift-off up [m/s];after [s];along [m];flights;"
        "high ones;one [%];jumped [%];upright [%];non-foot contact [%]"
    )
    rows = []
    for jump in evaluation.jumps:
        of, shares = jump.figures, ("single", "found", "upright", "non_foot_contact")
        spreads = (spread(of[name], 2) for name in ("distance", "lift_off_velocity", "delay"))
        means = (number(of[name].mean, 2) for name in ("along", "flights", "high_flights"))
        counted = (percent(jump.shares[name]) for name in shares)
        rows.append((jump.name, spread(of["height"]), *spreads, *means, *counted))
    return Sheet(
        title="Jumping: mean +- standard deviation over robots",
        columns=tuple(columns.split(";")),
        rows=tuple(rows),
        notes=(
            "non-foot contact: anything but a foot on the ground, from the jump input to 2 s after "
            "touchdown; a trial counts no such jump as a success.",
        ),
    )
