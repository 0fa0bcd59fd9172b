"""Tables of a trial as text: the paper's Table III beside ours, landings, drives, criteria.

A cell that could not be measured holds a dash, and its count says why.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pronk.evaluation.criteria import JUMPS, Check, evaluation_checks, trial_checks
from pronk.evaluation.metrics import FIGURES
from pronk.evaluation.published import PAPER_RATIOS, TABLE_III, Pair, in_paper_order
from pronk.evaluation.results import FEWEST, Cell, Ratio, Results, Spread

if TYPE_CHECKING:
    from pronk.evaluation.training_sim.evaluation import Evaluation

DEFINITIONS = "Definitions"
"""Title of the table of equations."""


@dataclass(frozen=True, kw_only=True)
class Sheet:
    """A table of text, for the terminal and the page."""

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()


def number(value: float, digits: int = 3) -> str:
    """Format a number; a dash where it is unknown."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def pair(values: Pair | None) -> str:
    """Format mean and standard deviation of the paper; a dash where it has none."""
    return f"{values[0]:.3f} +- {values[1]:.3f}" if values else "-"


def spread(figure: Spread, digits: int = 3) -> str:
    """Format mean and standard deviation; of one run the value; without any a dash."""
    if not figure.n:
        return "-"
    average = number(figure.mean, digits)
    return f"{average} +- {number(figure.std, digits)}" if figure.n > 1 else average


def interval(ratio: Ratio) -> str:
    """Format a ratio and its interval."""
    if not math.isfinite(ratio.value):
        return "-"
    if not math.isfinite(ratio.low):
        return f"{ratio.value:.2f} (too few)"
    return f"{ratio.value:.2f} ({ratio.low:.2f} to {ratio.high:.2f})"


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
    found = [table_iii(trial, figure) for figure in ("height", "distance")]
    found.append(landings(trial))
    found += [more(trial, subject.name) for subject in trial.subjects]
    found.append(drives(trial))
    found += [scatter(trial, other.name) for other in trial.subjects[1:]]
    return (*found, criteria(trial), definitions())


def table_iii(trial: Results, figure: str) -> Sheet:
    """The paper's Table III beside ours, for `height` or `distance`."""
    subjects = in_paper_order(subject.name for subject in trial.subjects)
    rows = []
    for case in trial.cases:
        paper = TABLE_III.get(case.name)
        published: Mapping[str, Pair] = getattr(paper, figure) if paper else {}
        own = (trial.cell(name, case.name) for name in subjects)
        rows.append(
            (
                case.name,
                *(pair(published.get(gains)) for gains in ("naive", "matched")),
                *(f"{spread(cell.figures[figure])} ({cell.found}/{cell.n})" for cell in own),
            )
        )
    means = []
    for gains in ("naive", "matched"):
        stds = [getattr(paper, figure)[gains][1] for paper in TABLE_III.values()]
        means.append(sum(stds) / len(stds))
    for name in subjects:
        stds = [trial.cell(name, case).figures[figure].std for case in trial.pooled]
        means.append(sum(stds) / len(stds))
    rows.append(
        ("mean scatter", *(f"+- {number(one)}" if math.isfinite(one) else "-" for one in means))
    )
    return Sheet(
        title=f"{figure.capitalize()} [m]: mean +- standard deviation (jumps of commanded)",
        columns=(
            "command",
            "paper, naive",
            "paper, matched",
            *(f"{name}, {place(trial)}" for name in subjects),
        ),
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
    return Sheet(
        title="Landings",
        columns=(
            "policy: command",
            "commanded",
            "standing",
            "jumped",
            "landed",
            "success [%] (95 %)",
            "fell",
            "high flights",
        ),
        rows=tuple(rows),
        notes=(
            "landed: upright 2 s after touchdown, and nothing but feet touched the ground; of all "
            "commanded. fell: at any time of the run.",
        ),
    )


def more(trial: Results, policy: str | None = None) -> Sheet:
    """Every other figure of one policy, or of all, with every command."""
    cells = [cell for cell in trial.cells if policy in (None, cell.policy)]
    whose = f" of {policy}" if policy else ""
    names = [
        name
        for name, figure in FIGURES.items()
        if not figure.joints and name not in ("height", "distance", "flights", "high_flights")
    ]
    return Sheet(
        title=f"Every other figure{whose}: mean +- standard deviation",
        columns=("figure", *(c.case if policy else f"{c.policy}: {c.case}" for c in cells)),
        rows=tuple(figure_row(name, FIGURES[name].unit, cells) for name in names),
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
            loads = {
                name: [cell.joints[name][joint] for cell in cells if cell.joints[name][joint].n]
                for name in ("peak_torque", "peak_speed", "torque_margin")
            }
            torque, speed = (
                max((load.most for load in loads[name]), default=math.nan)
                for name in ("peak_torque", "peak_speed")
            )
            margin = min((load.least for load in loads["torque_margin"]), default=math.nan)
            cell = (number(torque, 1), number(speed, 1), number(margin, 3))
            rows.append((f"{subject.name}: {joint}", *cell))
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
            f"{check.value:.4f}{unit}" if math.isfinite(check.value) else "-",
            f"{check.sense} {check.limit:g}{unit}",
            "yes" if check.passed else "NO",
        )
        for check in checks
        for unit in (f" {check.unit}" if check.unit else "",)
    )


def criteria(trial: Results) -> Sheet:
    """The acceptance criteria of the first policy."""
    found = trial_checks(trial)
    passed = sum(check.passed for check in found)
    least = min(trial.cell(trial.subjects[0].name, case).n for case in trial.pooled)
    few = (f"The criteria are meant for {JUMPS} jumps with each command; these are of {least}.",)
    return Sheet(
        title=f"Acceptance criteria of {trial.subjects[0].name}: the paper's matched column, and "
        "more",
        columns=("what", "measured", "limit", "passed"),
        rows=check_rows(found),
        notes=(
            f"{passed} of {len(found)} acceptance criteria passed.",
            *(few if least < JUMPS else ()),
        ),
    )


def definitions() -> Sheet:
    """The equation of every figure."""
    return Sheet(
        title=DEFINITIONS,
        columns=("figure", "unit", "equation"),
        rows=tuple((name, figure.unit, figure.says) for name, figure in FIGURES.items()),
        notes=(
            "c: the jump input rises. l, d: lift-off and touchdown of the main flight, the longest "
            "in which the trunk rises more than 3 cm over standing. e: d + 0.5 s. p, z, v: "
            "position, height and velocity of the trunk's origin. f_i, r: centre and radius of a "
            "foot. u: direction of p_d - p_l in the plane.",
        ),
    )


def scatter(trial: Results, other: str | None = None) -> Sheet:
    """Standard deviations of another policy, the second if None, over those of the first."""
    first = trial.subjects[0].name
    other = other or trial.subjects[1].name
    cases = (None, *(case.name for case in trial.cases))
    found = {(r.figure, r.case): r for r in trial.ratios if r.other == other}
    return Sheet(
        title=f"Standard deviations, {other} over {first}, with 95 % bootstrap intervals",
        columns=("figure", *(case or "all" for case in cases), "paper, all"),
        rows=tuple(
            (
                figure,
                *(interval(found[figure, case]).replace(" to ", "-") for case in cases),
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
    for figure, claim in (
        ("distance", PAPER_RATIOS["distance"]),
        ("height", PAPER_RATIOS["height"]),
    ):
        ratio = overall[figure]
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
    found = []
    if evaluation.walks:
        found.append(_walks(evaluation))
    if evaluation.jumps:
        found.append(_jumps(evaluation))
    checks, notes = evaluation_checks(evaluation), []
    if evaluation.estimator is not None:
        axes = " / ".join(f"{axis:.3f}" for axis in evaluation.estimator.rmse)
        notes.append(
            f"estimator while walking: velocity RMSE {evaluation.estimator.rmse_vector:.3f} m/s "
            f"(forward / left / up {axes}), contacts right "
            f"{percent(evaluation.estimator.contacts_right)} %"
        )
    notes.append(
        f"{sum(check.passed for check in checks)} of {len(checks)} acceptance criteria passed; "
        f"{evaluation.plan['robots']} robots a command, randomization "
        f"{evaluation.about.get('randomization', '-')}, seed {evaluation.plan['seed']}, "
        f"{evaluation.seconds:.0f} s"
    )
    columns = ("what", "measured", "limit", "passed")
    rows = check_rows(checks)
    found.append(Sheet(title="Acceptance criteria", columns=columns, rows=rows, notes=tuple(notes)))
    return tuple(found)


def percent(share: float) -> str:
    """Format a share in percent."""
    return number(100.0 * share, 1)


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
    return Sheet(
        title="Walking: mean over robots and time; in brackets with the stride averaged out",
        columns=(
            "command",
            "speed error [m/s]",
            "yaw rate error [rad/s]",
            "mean velocity [m/s, m/s, rad/s]",
            "drift [m]",
            "falls [%]",
            "flight over standing [cm]",
        ),
        rows=tuple(rows),
    )


def _jumps(evaluation: Evaluation) -> Sheet:
    spreads = ("distance", "lift_off_velocity", "delay")
    shares = ("single", "found", "upright", "non_foot_contact")
    return Sheet(
        title="Jumping: mean +- standard deviation over robots",
        columns=(
            "command",
            "height [m]",
            "distance [m]",
            "lift-off up [m/s]",
            "after [s]",
            "along [m]",
            "flights",
            "high ones",
            "one [%]",
            "jumped [%]",
            "upright [%]",
            "non-foot contact [%]",
        ),
        rows=tuple(
            (
                jump.name,
                spread(jump.figures["height"]),
                *(spread(jump.figures[name], 2) for name in spreads),
                *(
                    number(jump.figures[name].mean, 2)
                    for name in ("along", "flights", "high_flights")
                ),
                *(percent(jump.shares[name]) for name in shares),
            )
            for jump in evaluation.jumps
        ),
        notes=(
            "non-foot contact: anything but a foot on the ground, from the jump input to 2 s after "
            "touchdown; a trial counts no such jump as a success.",
        ),
    )
