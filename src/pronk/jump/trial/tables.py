"""Tables of a trial, for the terminal and the page; a dash where nothing was measured."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence

from pronk.jump.trial.condition_trial import ConditionResults
from pronk.jump.trial.criteria import CRITERIA_JUMPS, GOALS, Check, trial_checks, walk_checks
from pronk.jump.trial.crossing import Climb, climbs
from pronk.jump.trial.jumps import FIGURES, SYMBOLS, Figure, JumpFigures
from pronk.jump.trial.protocol import (
    PAPER_GAPS,
    PAPER_RATIOS,
    PAPER_ROBOT,
    TABLE_III,
    in_paper_order,
)
from pronk.jump.trial.results import FEWEST, RunCell, ScatterRatio, Spread, TrialResults
from pronk.jump.trial.walk import SETTLE_S, WALK_FIGURES
from pronk.policy.rollout import MAX_STANDING_DEVIATION_RAD, MAX_STANDING_TILT_DEG
from pronk.tables import NOT_MEASURED, Cell, Column, Table, counted, number

DEFINITIONS = "Definitions"
"""Title of the table of equations."""
_ALL = "all"
"""Heading of the column over all commands."""
_ELSEWHERE = ("height", "distance", "flights", "high_flights")
"""Figures of a jump that have a table of their own."""
_WALK_TABLE = (
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
"""Figures of a walk, in the order of its table."""
_OBSTACLES = {"gap": "gap", "up": "step up", "down": "step down"}


# ---- cells ----


def spread_text(spread: Spread, digits: int = 3) -> str:
    """Return mean and standard deviation; of one run its value, without any a dash."""
    mean = number(spread.mean, digits)
    if spread.n < 2:
        return mean
    return f"{mean} +- {number(spread.std, digits)}"


def ratio_text(ratio: ScatterRatio) -> str:
    """Return a ratio and its interval."""
    if not math.isfinite(ratio.value):
        return NOT_MEASURED
    interval = "too few"
    if math.isfinite(ratio.low):
        interval = f"{ratio.low:.2f} to {ratio.high:.2f}"
    return f"{ratio.value:.2f} ({interval})"


def interval_text(interval: tuple[float, float]) -> str:
    """Return the interval of a share, in percent without a decimal."""
    low, high = interval
    return f"{100.0 * low:.0f} to {100.0 * high:.0f}"


def place_words(virtual: bool) -> str:
    """Return where results were measured, in words."""
    return "virtual robot" if virtual else "robot"


def origin_note(trial: TrialResults) -> str:
    """Return a note that says where the numbers come from."""
    machine = "pronk's virtual robot, not a real one" if trial.virtual else "the real robot"
    params = str(trial.sim_params.get("sha256", NOT_MEASURED))[:12]
    return f"ours: {machine}; seed {trial.seed}, sim_params {params}."


# ---- tables of a trial ----


def trial_tables(trial: TrialResults) -> list[Table]:
    """Return all tables of a trial, in the order in which they are read."""
    tables = [paper_table(trial, "height"), paper_table(trial, "distance"), landings(trial)]
    for subject in trial.subjects:
        tables.append(other_figures(trial, subject.name))
    tables.append(drive_loads(trial))
    for subject in trial.subjects[1:]:
        tables.append(scatter_table(trial, subject.name))
    if GOALS.get(trial.robot) is not None:
        tables.append(criteria_table(trial))
    tables.append(definitions())
    return tables


def paper_table(trial: TrialResults, figure: str) -> Table:
    """Return the paper's Table III beside ours, for `height` or `distance`; ours of another robot.

    Its last row is the mean of the standard deviations over the pooled commands.
    """
    columns = [Column(heading="command")]
    columns_of_cells: list[dict[str, str]] = []
    mean_scatter: list[float] = []
    is_paper_robot = trial.robot == PAPER_ROBOT
    for gains in ("naive", "matched") if is_paper_robot else ():
        columns.append(Column(heading=f"paper, {gains}"))
        cells = {}
        stds = []
        for command, (mean, std) in TABLE_III[figure, gains].items():
            cells[command] = f"{mean:.3f} +- {std:.3f}"
            stds.append(std)
        columns_of_cells.append(cells)
        mean_scatter.append(sum(stds) / len(stds))
    for policy in in_paper_order(trial.policy_names):
        columns.append(Column(heading=f"{policy}, {place_words(trial.virtual)}"))
        cells = {}
        for case in trial.cases:
            cell = trial.cell(policy, case.name)
            cells[case.name] = f"{spread_text(cell.figures[figure])} ({cell.found}/{cell.n})"
        columns_of_cells.append(cells)
        stds = []
        for command in trial.pooled:
            stds.append(trial.cell(policy, command).figures[figure].std)
        mean_scatter.append(sum(stds) / len(stds))
    rows: list[tuple[Cell, ...]] = []
    for case in trial.cases:
        row = [case.name]
        for cells in columns_of_cells:
            row.append(cells.get(case.name, NOT_MEASURED))
        rows.append(tuple(row))
    scatter_cells = []
    for std in mean_scatter:
        scatter_cells.append(f"+- {std:.3f}" if math.isfinite(std) else NOT_MEASURED)
    rows.append(("mean scatter", *scatter_cells))
    notes = [
        f"{figure}: {FIGURES[figure].equation}.",
        f"mean scatter: mean of the standard deviations over {', '.join(trial.pooled)}.",
    ]
    if is_paper_robot:
        # Paper E2; that each column is of one policy is reading A21.
        notes.append("paper: five jumps a cell on the real robot, of one policy each.")
    return Table(
        title=f"{figure.capitalize()} [m]: mean +- standard deviation (jumps of commanded)",
        columns=tuple(columns),
        rows=tuple(rows),
        notes=(*notes, origin_note(trial)),
    )


def landings(trial: TrialResults) -> Table:
    """Return the outcome of every commanded jump."""
    rows: list[tuple[Cell, ...]] = []
    for cell in trial.cells:
        rows.append(
            (
                f"{cell.policy}: {cell.case}",
                cell.n,
                cell.standing,
                cell.found,
                cell.succeeded,
                f"{100.0 * cell.success:.0f} ({interval_text(cell.success_ci95)})",
                cell.fell,
                cell.non_foot_contact,
                spread_text(cell.figures["high_flights"], 2),
            )
        )
    notes = [
        "landed: upright 2 s after touchdown, and nothing but feet touched the ground; of all "
        "commanded. fell: at any time of the run. touched: something but a foot touched the "
        "ground, from the command to 2 s after touchdown."
    ]
    for policy in trial.policy_names:
        first_touches = _first_touches(trial, policy)
        if first_touches:
            notes.append(first_touches)
    soft_note = _soft_ground_note(trial)
    if soft_note:
        notes.append(soft_note)
    return Table(
        title="Landings",
        columns=(
            Column(heading="policy: command"),
            Column(heading="commanded"),
            Column(heading="standing", is_detail=True),
            Column(heading="jumped"),
            Column(heading="landed"),
            Column(heading="success [%]"),
            Column(heading="fell"),
            Column(heading="touched"),
            Column(heading="high flights", is_detail=True),
        ),
        rows=tuple(rows),
        notes=tuple(notes),
    )


def _first_touches(trial: TrialResults, policy: str) -> str:
    """Return which parts of a robot touched the ground first, and when; "" without a touch."""
    counts: Counter[str] = Counter()
    times = []
    for run in trial.rows:
        figures: JumpFigures = run.figures
        if run.policy != policy or not figures.touched_part:
            continue
        counts[figures.touched_part] += 1
        if math.isfinite(figures.touch):
            times.append(figures.touch)
    if not counts:
        return ""
    phrases = []
    for part, count in counts.most_common():
        phrases.append(f"{part} {count}")
    note = f"{policy}, touched first by: {', '.join(phrases)}"
    if times:
        low = f"{min(times):.2f}"
        high = f"{max(times):.2f}"
        span = low if low == high else f"{low} to {high}"
        note += f"; {span} s after touchdown"
        if min(times) < 0.0:
            note += " (negative: before it)"
        without_touchdown = counts.total() - len(times)
        if without_touchdown:
            note += f", {counted(without_touchdown, 'jump')} without touchdown left out"
    return f"{note}."


def _soft_ground_note(trial: TrialResults) -> str:
    """Return what to think of touches of shanks whose feet were pressed in deeply; "" without."""
    touched = 0
    presses = []
    for run in trial.rows:
        figures: JumpFigures = run.figures
        if not figures.non_foot_contact or figures.fell:
            continue
        touched += 1
        if figures.touch_press > 1.0:
            presses.append(figures.touch_press)
    if not presses:
        return ""
    return (
        f"In {len(presses)} of the {counted(touched, 'jump')} without a fall in which something "
        "but a foot touched the ground, only shanks touched it, and their own feet were pressed in "
        f"beyond their centres whenever they did, by {min(presses):.1f} times the radius or more. "
        "It may be the lower end of the shank that came to the floor with the foot; on harder "
        "ground (ground.stiffness of the virtual robot's parameters) it may not touch."
    )


def other_figures(trial: TrialResults, policy: str) -> Table:
    """Return the figures of one policy that have no table of their own, with every command."""
    figures = []
    for name, figure in FIGURES.items():
        if not figure.joints and name not in _ELSEWHERE:
            figures.append(figure)
    cells = trial.cells_of(policy)
    return Table(
        title=f"Every other figure of {policy}: mean +- standard deviation",
        columns=_command_columns(cells),
        rows=_figure_rows(figures, cells),
        notes=(origin_note(trial),),
        is_detail=True,
    )


def _command_columns(cells: Sequence[RunCell]) -> tuple[Column, ...]:
    columns = [Column(heading="figure")]
    for cell in cells:
        columns.append(Column(heading=cell.case))
    return tuple(columns)


def _figure_rows(
    figures: Iterable[Figure], cells: Sequence[RunCell], digits: int = 3
) -> tuple[tuple[Cell, ...], ...]:
    """Return a row for each figure, with its unit and its spread in each cell."""
    rows: list[tuple[Cell, ...]] = []
    for figure in figures:
        row = [f"{figure.name.replace('_', ' ')} [{figure.unit}]"]
        for cell in cells:
            row.append(spread_text(cell.figures[figure.name], digits))
        rows.append(tuple(row))
    return tuple(rows)


def drive_loads(trial: TrialResults) -> Table:
    """Return the largest loads of the drives over all jumps, by policy and joint."""
    rows: list[tuple[Cell, ...]] = []
    for subject in trial.subjects:
        for joint in trial.joint_names:
            torques = []
            speeds = []
            margins = []
            for cell in trial.cells_of(subject.name):
                if cell.found:
                    torques.append(cell.joints["peak_torque"][joint].maximum)
                    speeds.append(cell.joints["peak_speed"][joint].maximum)
                    margins.append(cell.joints["torque_margin"][joint].minimum)
            rows.append(
                (
                    f"{subject.name}: {joint}",
                    max(torques, default=None),
                    max(speeds, default=None),
                    min(margins, default=None),
                )
            )
    return Table(
        title="Drives: the greatest of all jumps",
        columns=(
            Column(heading="policy: joint"),
            Column(heading="torque", unit="N m", digits=1),
            Column(heading="speed", unit="rad/s", digits=1),
            Column(heading="margin", unit="1"),
        ),
        rows=tuple(rows),
        notes=(f"margin: {FIGURES['torque_margin'].equation}.",),
        is_detail=True,
    )


def check_table(title: str, checks: Sequence[Check], notes: Sequence[str] = ()) -> Table:
    """Return number, limit and outcome of every check; PASSED in a note becomes their count."""
    rows: list[tuple[Cell, ...]] = []
    passed_count = 0
    for check in checks:
        measured = NOT_MEASURED
        if math.isfinite(check.value):
            measured = f"{check.value:.4f} {check.unit}".strip()
        limit = f"{check.sense} {check.limit:g} {check.unit}".strip()
        rows.append((check.name, measured, limit, "yes" if check.passed else "NO"))
        if check.passed:
            passed_count += 1
    passed = f"{passed_count} of {len(checks)} acceptance criteria passed"
    return Table(
        title=title,
        columns=(
            Column(heading="criterion"),
            Column(heading="measured"),
            Column(heading="limit"),
            Column(heading="passed"),
        ),
        rows=tuple(rows),
        notes=tuple(note.replace("PASSED", passed) for note in notes),
    )


def criteria_table(trial: TrialResults) -> Table:
    """Return the acceptance criteria of the first policy."""
    policy = trial.subjects[0].name
    notes = ["PASSED."]
    fewest = min(trial.cell(policy, command).n for command in trial.pooled)
    if fewest < CRITERIA_JUMPS:
        notes.append(
            f"The criteria are meant for {CRITERIA_JUMPS} jumps with each command; these are of "
            f"{fewest}."
        )
    title = f"Acceptance criteria of {policy}: {GOALS[trial.robot].source}"
    return check_table(title, trial_checks(trial), notes)


def definitions() -> Table:
    """Return unit and equation of every figure of a jump."""
    rows: list[tuple[Cell, ...]] = []
    for figure in FIGURES.values():
        rows.append((figure.name, figure.unit, figure.equation))
    return Table(
        title=DEFINITIONS,
        columns=(Column(heading="figure"), Column(heading="unit"), Column(heading="equation")),
        rows=tuple(rows),
        notes=(SYMBOLS,),
    )


def scatter_table(trial: TrialResults, other: str) -> Table:
    """Return the standard deviations of another policy over those of the first."""
    policy = trial.subjects[0].name
    ratios = [ratio for ratio in trial.ratios if ratio.other == other]
    commands: list[str] = []
    for ratio in ratios:
        command = ratio.case or _ALL
        if command not in commands:
            commands.append(command)
    is_paper_robot = trial.robot == PAPER_ROBOT
    rows: list[tuple[Cell, ...]] = []
    for figure in trial.run_kind.compared:
        texts = []
        for ratio in ratios:
            if ratio.figure == figure:
                texts.append(ratio_text(ratio).replace(" to ", "-"))
        if is_paper_robot:
            texts.append(number(PAPER_RATIOS.get(figure, math.nan), 2))
        rows.append((figure.replace("_", " "), *texts))
    columns = [Column(heading="figure")]
    for command in commands:
        columns.append(Column(heading=command, is_detail=command != _ALL))
    notes = [f"all: ratio of the means over {', '.join(trial.pooled)}."]
    if is_paper_robot:
        columns.append(Column(heading="paper, all"))
        # Reading A4: the table's own numbers are taken.
        notes.append(
            "paper: naive over matched; its Table III gives 2.08 in distance, its text has 2.30."
        )
    return Table(
        title=f"Standard deviations, {other} over {policy}, with 95 % bootstrap intervals",
        columns=tuple(columns),
        rows=tuple(rows),
        notes=(*notes, scatter_verdict(trial, other)),
    )


def scatter_verdict(trial: TrialResults, other: str) -> str:
    """Return one sentence on whether another policy scatters more than the first."""
    policy = trial.subjects[0].name
    overall = {}
    for ratio in trial.ratios:
        if ratio.case is None and ratio.other == other:
            overall[ratio.figure] = ratio
    sentences = []
    repeated_better = []
    is_known = True
    for figure in ("distance", "height"):
        ratio = overall[figure]
        if not math.isfinite(ratio.value):
            is_known = False
            sentences.append(f"in {figure} could not be measured")
        elif not math.isfinite(ratio.low):
            is_known = False
            sentences.append(
                f"in {figure} {ratio.value:.2f} times as much, with fewer than {FEWEST} jumps in a "
                "command, too few for an interval"
            )
        else:
            sentence = f"in {figure} {_direction(ratio)}, {ratio_text(ratio)} times"
            if trial.robot == PAPER_ROBOT:
                sentence += _paper_position(ratio, PAPER_RATIOS[figure])
            sentences.append(sentence)
            if ratio.low > 1.0:
                repeated_better.append(figure)
    if repeated_better:
        end = f"so {policy} repeats its jumps better in {' and '.join(repeated_better)}"
    elif is_known:
        end = f"so {policy} does not repeat its jumps better here"
    else:
        end = "undecided"
    place = place_words(trial.virtual)
    return f"scatter of {other} against {policy} on the {place}: {'; '.join(sentences)}; {end}."


def _direction(ratio: ScatterRatio) -> str:
    """Return how a ratio with its interval compares with 1."""
    if ratio.low > 1.0:
        return "more"
    return "less" if ratio.high < 1.0 else "no clear difference"


def _paper_position(ratio: ScatterRatio, claim: float) -> str:
    """Return where the paper's ratio lies, by the interval of ours."""
    position = "within"
    if claim > ratio.high:
        position = "above"
    elif claim < ratio.low:
        position = "below"
    return f", and the paper's {claim:g} is {position} that interval"


# ---- tables of walks, crossings and conditions ----


def walk_table(walks: TrialResults, policy: str) -> Table:
    """Return the figures of one policy's walks by velocity."""
    cells = walks.cells_of(policy)
    rows: list[tuple[Cell, ...]] = [
        ("walks", *(cell.n for cell in cells)),
        ("fell", *(cell.fell for cell in cells)),
        ("non-foot contact", *(cell.non_foot_contact for cell in cells)),
    ]
    figures = [WALK_FIGURES[name] for name in _WALK_TABLE]
    rows += _figure_rows(figures, cells, digits=2)
    return Table(
        title=f"{_capital_place(walks)}, walking, {policy}: mean +- standard deviation",
        columns=_command_columns(cells),
        rows=tuple(rows),
        notes=(
            "non-foot contact: walks in which something but a foot touched the ground. The first "
            f"{SETTLE_S:g} s after the command are left out.",
        ),
    )


def walk_criteria_table(walks: TrialResults) -> Table:
    """Return the acceptance criteria of the first policy's walks, those that its robot has."""
    policy = walks.subjects[0].name
    return check_table(
        f"Acceptance criteria of {policy}, walking", walk_checks(walks), notes=["PASSED."]
    )


def crossing_table(crossings: TrialResults) -> Table:
    """Return the largest obstacles that were crossed, and why larger ones were not."""
    settings = crossings.settings
    is_paper_robot = crossings.robot == PAPER_ROBOT
    note = (
        f"crossed: in {settings['enough']} or more of {counted(settings['runs'], 'run')}, as were "
        "all smaller ones. ever crossed: in any run."
    )
    if is_paper_robot:
        note += " The paper's gaps were judged from video of jumps over flat floor."
    notes = [note]
    rows: list[tuple[Cell, ...]] = []
    for climb in climbs(crossings):
        obstacle = f"{climb.policy}: {_OBSTACLES.get(climb.shape, climb.shape)}, {climb.case}"
        failed_at = _failed_at(climb)
        row: list[Cell] = [obstacle, climb.largest, climb.ever]
        if is_paper_robot:
            row.append(PAPER_GAPS.get(climb.case) if climb.shape == "gap" else None)
        rows.append((*row, failed_at))
        if failed_at is not None:
            reasons = sorted(climb.rungs[-1].reasons.items(), key=lambda item: -item[1])
            words = "; ".join(f"{reason} ({count})" for reason, count in reasons)
            notes.append(f"{obstacle}, {failed_at:.2f} m: {words}.")
    columns = [
        Column(heading="policy: obstacle"),
        Column(heading="crossed", digits=2),
        Column(heading="ever crossed", digits=2),
    ]
    if is_paper_robot:
        columns.append(Column(heading="paper, from video", digits=2))
    return Table(
        title=f"{_capital_place(crossings)}, crossing: largest obstacles [m]",
        columns=(*columns, Column(heading="failed at", digits=2)),
        rows=tuple(rows),
        notes=tuple(notes),
    )


def _failed_at(climb: Climb) -> float | None:
    """Return the size at which a climb ended [m]; None if it ended with the sizes."""
    if climb.rungs and climb.rungs[-1].size > climb.largest:
        return climb.rungs[-1].size
    return None


def _capital_place(trial: TrialResults) -> str:
    return place_words(trial.virtual).capitalize()


def condition_table(results: ConditionResults) -> Table:
    """Return landings, height, distance and velocity error under every condition."""
    rows: list[tuple[Cell, ...]] = []
    unable = []
    for cell in results.cells:
        if cell.stood < cell.jumps:
            unable.append(
                f"{cell.condition}: {cell.policy} ({cell.jumps - cell.stood} of {cell.jumps})"
            )
        rows.append(
            (
                f"{cell.condition}: {cell.policy}",
                f"{cell.landed}/{cell.jumps}",
                interval_text(cell.landed_interval),
                NOT_MEASURED if cell.fell is None else f"{cell.fell}/{cell.stood}",
                spread_text(cell.height),
                spread_text(cell.distance),
                spread_text(cell.velocity_error),
            )
        )
    notes = [
        f"Commands: {', '.join(results.commands)}; {counted(results.jumps, 'jump')} with each, "
        f"seed {results.seed}. Mean +- standard deviation; height and distance of the jumps that "
        "left the ground.",
        "landed: of all commanded. fell: at any time of the run, of the runs in which the robot "
        "stood when the policy was to start.",
        "velocity error: difference of mean and commanded velocity along the command before the "
        "jump input.",
    ]
    if unable:
        notes.append(
            f"Never stood, in this number of runs: {', '.join(unable)}. When the policy was to "
            f"start, a joint was more than {MAX_STANDING_DEVIATION_RAD:g} rad from its default "
            f"position, or the trunk tilted by more than {MAX_STANDING_TILT_DEG:g} degrees, as on "
            "drives that are too weak for the robot's weight. These runs count as not landed, and "
            "have no value in the other columns."
        )
    return Table(
        title=f"{place_words(results.virtual).capitalize()} under conditions, all commands",
        columns=(
            Column(heading="condition: policy"),
            Column(heading="landed"),
            Column(heading="95 % interval", unit="%"),
            Column(heading="fell"),
            Column(heading="height", unit="m"),
            Column(heading="distance", unit="m"),
            Column(heading="velocity error", unit="m/s"),
        ),
        rows=tuple(rows),
        notes=tuple(notes),
    )
