"""Tables of `python -m benchmarks foreign`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from benchmarks.foreign.faults import FAULTS
from benchmarks.foreign.walk import PEAK_DIFFERENCE, STEPS
from pronk.tables import Cell, Column, Table

Row = dict[str, Any]
SHOWN = 160
"""Characters of a sentence that a table shows."""


def robots_tables(rows: Sequence[Row], seed: int) -> list[Table]:
    """Return a table of the robots, one row each, and one of the numbers that are wrong."""
    cells: list[tuple[Cell, ...]] = []
    exported = 0
    planned = 0
    right_numbers = 0
    compared = 0
    for row in rows:
        seconds = sum(command["seconds"] for command in row["commands"])
        difference = row["peaks"].get("difference")
        exported += row["reached"] == STEPS[-1]
        planned += difference is not None and difference <= PEAK_DIFFERENCE
        compared += row["compared"]
        right_numbers += bool(row["compared"]) and not row["wrong_numbers"]
        wrong = sum(len(numbers) for numbers in row["wrong_numbers"].values())
        cells.append(
            (
                row["number"],
                row["robot"],
                row["joint"],
                row["reached"] or "nothing",
                "" if difference is None else f"{100.0 * difference:.1f}",
                f"{wrong} of {row['compared']}",
                seconds,
                row["refusal"][:SHOWN],
            )
        )
    columns = (
        Column(heading="n"),
        Column(heading="robot"),
        Column(heading="joint"),
        Column(heading="reached"),
        Column(heading="peaks", unit="%"),
        Column(heading="numbers wrong"),
        Column(heading="time", unit="s", digits=0),
        Column(heading="refusal"),
    )
    note = (
        f"{exported} of {len(rows)} reached the exports; planned peaks within 10 % of plain MuJoCo "
        f"in {planned}; all numbers of the model in {right_numbers} ({compared} compared)."
    )
    title = f"Robots of public packages, seed {seed}"
    tables = [Table(title=title, columns=columns, rows=tuple(cells), notes=(note,))]
    wrong_rows: list[tuple[Cell, ...]] = []
    for row in rows:
        for joint, numbers in row["wrong_numbers"].items():
            for name, words in numbers.items():
                wrong_rows.append((row["number"], row["robot"], joint, name, words))
    if wrong_rows:
        headings = ("n", "robot", "joint", "number", "robot.yaml for model")
        wrong_columns = tuple(Column(heading=heading) for heading in headings)
        tables.append(
            Table(title="Numbers that differ", columns=wrong_columns, rows=tuple(wrong_rows))
        )
    return tables


def honest_table(rows: Sequence[Row], seed: int) -> list[Table]:
    """Return a table of honest logs by the mass of the link, and one of those that are flagged."""
    edges = (0.0, 0.05, 0.5, 5.0, 1e9)
    names = ("below 50 g", "50 g to 0.5 kg", "0.5 to 5 kg", "5 kg and more")
    cells: list[tuple[Cell, ...]] = []
    for name, low, high in zip(names, edges[:-1], edges[1:], strict=True):
        cells.append(_honest_cells(name, [row for row in rows if low <= row["mass"] < high]))
    cells.append(_honest_cells("all", rows))
    columns = (
        Column(heading="link"),
        Column(heading="logs"),
        Column(heading="flagged"),
        Column(heading="refused"),
        Column(heading="no match"),
        Column(heading="stiffness inside"),
        Column(heading="damping inside"),
    )
    note = "Inside: of the logs that are matched, those whose total interval reaches the true gain."
    title = f"Honest logs, seed {seed}"
    tables = [Table(title=title, columns=columns, rows=tuple(cells), notes=(note,))]
    flagged: list[tuple[Cell, ...]] = []
    for row in rows:
        if row["flagged"]:
            flagged.append((row["number"], row["robot"], row["mass"], _words(row)))
    if flagged:
        flagged_columns = (
            Column(heading="log"),
            Column(heading="joint"),
            Column(heading="mass", unit="kg"),
            Column(heading="what is said"),
        )
        tables.append(Table(title="Flagged", columns=flagged_columns, rows=tuple(flagged)))
    return tables


def _honest_cells(name: str, rows: Sequence[Row]) -> tuple[Cell, ...]:
    """Return the row of some honest logs."""
    inside: list[Cell] = []
    for gain in ("stiffness", "damping"):
        judged = []
        for row in rows:
            if not row["no_match"] and row[f"{gain}_inside"] is not None:
                judged.append(row[f"{gain}_inside"])
        share = f" ({100.0 * sum(judged) / len(judged):.0f} %)" if judged else ""
        inside.append(f"{sum(judged)} of {len(judged)}{share}")
    return (
        name,
        len(rows),
        sum(row["flagged"] for row in rows),
        sum(bool(row["refusal"] or row["defect"]) for row in rows),
        sum(row["no_match"] for row in rows),
        *inside,
    )


def faults_table(rows: Sequence[Row], seed: int) -> list[Table]:
    """Return a table of logs with faults by fault, and one of the wrong causes."""
    outcomes = ("right", "none", "harmless", "wrong gains", "wrong", "defect")
    cells: list[tuple[Cell, ...]] = []
    for name in (*(fault.name for fault in FAULTS), "all"):
        of_fault = [row for row in rows if name in ("all", row["fault"])]
        counts = [sum(row["verdict"] == outcome for row in of_fault) for outcome in outcomes]
        cells.append((name, len(of_fault), *counts))
    columns = tuple(Column(heading=heading) for heading in ("fault", "logs", *outcomes))
    wrong: list[tuple[Cell, ...]] = []
    for row in rows:
        if row["verdict"] in ("wrong", "defect", "wrong gains"):
            gains = ""
            if row["verdict"] == "wrong gains":
                factors = [row[name][0] / row["true"][name][0] for name in ("stiffness", "damping")]
                gains = f"{factors[0]:.2f}, {factors[1]:.2f}"
            wrong.append((row["number"], row["fault"], row["robot"], gains, _words(row)))
    note = (
        "right: the cause is named; none: refused or no match without a cause; harmless, wrong "
        "gains: matched without a cause, and the drive's gains are found or are not; wrong: "
        "another cause is named; defect: a traceback."
    )
    title = f"Logs with one fault, seed {seed}"
    tables = [Table(title=title, columns=columns, rows=tuple(cells), notes=(note,))]
    if wrong:
        headings = ("log", "fault", "joint", "gains over true", "what is said")
        wrong_columns = tuple(Column(heading=heading) for heading in headings)
        tables.append(
            Table(title="Wrong causes and gains", columns=wrong_columns, rows=tuple(wrong))
        )
    return tables


def translate_tables(rows: Sequence[Row], seed: int) -> list[Table]:
    """Return a table of translations beside matches, one row for each joint."""
    cells: list[tuple[Cell, ...]] = []
    counts = {"agree": 0, "explained": 0, "match flagged": 0, "silent": 0, "refused": 0}
    for row in rows:
        outcome = translate_outcome(row)
        counts[outcome] += 1
        shown: list[Cell] = ["", ""]
        if "differences" in row:
            shown = [f"{100.0 * difference:+.2f}" for difference in row["differences"]]
        said = row["defect"] or row["refusal"] or "; ".join(row["flags"] + row["match_flags"])
        begin = [row[name] for name in ("number", "robot", "joint", "from", "to")]
        cells.append((*begin, *shown, outcome, said[:SHOWN]))
    headings = ("n", "robot", "joint", "from", "to")
    columns = (
        *(Column(heading=heading) for heading in headings),
        Column(heading="stiffness", unit="%"),
        Column(heading="damping", unit="%"),
        Column(heading="outcome"),
        Column(heading="what is said"),
    )
    note = (
        f"{counts['agree']} of {len(rows)} agree within 2 %; of the others the translation says "
        f"why in {counts['explained']}, the match has a flag in {counts['match flagged']}, "
        f"{counts['refused']} were refused, {counts['silent']} differ without a word."
    )
    title = f"Translated over matched gains, seed {seed}"
    return [Table(title=title, columns=columns, rows=tuple(cells), notes=(note,))]


def translate_outcome(row: Row) -> str:
    """Return what became of one joint: agree, explained, match flagged, silent, or refused."""
    if row["refusal"] or row["defect"]:
        return "refused"
    if row["agree"]:
        return "agree"
    if row["explained"]:
        return "explained"
    return "match flagged" if row["match_flags"] else "silent"


def _words(row: Row) -> str:
    """Return what a match says, cut to what a table shows."""
    return (row["defect"] or row["refusal"] or "; ".join(row["flags"]))[: 2 * SHOWN]
