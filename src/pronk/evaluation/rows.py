"""The jumps of a trial, one by one, and `trials.csv`, which has one row for each."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pronk.errors import ArtefactError
from pronk.evaluation.metrics import FIGURES, FLAGS, JumpFigures
from pronk.evaluation.protocol import Case
from pronk.runtime.script import Script

_OWN = ("policy", "command", "number", "seed", "capture", "success")
"""Columns before the figures."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One jump."""

    policy: str
    """Name of the subject."""
    case: str
    """Name of the command."""
    number: int
    """0 for the first jump with this command."""
    seed: int
    """Of its virtual robot's noise."""
    figures: JumpFigures
    script: Script
    """What was asked, with the time of its own of the jump input."""
    capture: str = ""
    """What was seen, a file beside this table; empty if it was not kept."""
    began: float = 0.0
    """When the policy took over, on the capture's clock [s]."""


def _columns(joint_names: Sequence[str]) -> list[tuple[str, str, int | None]]:
    """Column, figure, and which joint, of every figure."""
    found: list[tuple[str, str, int | None]] = []
    for name, figure in FIGURES.items():
        if figure.joints:
            unit = figure.column.removeprefix(name)
            found += [(f"{name}_{joint}{unit}", name, i) for i, joint in enumerate(joint_names)]
        else:
            found.append((figure.column, name, None))
    return found


def to_csv(rows: Iterable[Row], joint_names: Sequence[str]) -> str:
    """One row a jump; unknown figures are empty, truths 1 and 0, numbers exact.

    Args:
        rows: The jumps.
        joint_names: Of the robot, in its order.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    columns = _columns(joint_names)
    times = ("run_s", "began_s")
    writer.writerow([*_OWN, *times, *FLAGS, *(column for column, _, _ in columns)])
    for row in rows:
        figures = row.figures
        own = (row.policy, row.case, row.number, row.seed, row.capture, int(figures.success))
        flags = (int(getattr(figures, name)) for name in FLAGS)
        numbers = (_text(figures, name, joint) for _, name, joint in columns)
        writer.writerow([*own, repr(row.script.run_s), repr(row.began), *flags, *numbers])
    return text.getvalue()


def _text(figures: JumpFigures, name: str, joint: int | None) -> str:
    value = getattr(figures, name)
    if joint is not None:
        value = value[joint] if value else math.nan
    return repr(value) if math.isfinite(value) else ""


def of_csv(
    table: str,
    *,
    cases: Sequence[Case],
    times: Mapping[str, float],
    joint_names: Sequence[str],
    path: Path,
) -> Iterator[Row]:
    """Read what `to_csv` wrote.

    Args:
        table: The text.
        cases: The commands.
        times: Of the script, the time of the jump input left out.
        joint_names: Of the robot, in its order.
        path: Where the text is from, for errors.

    Raises:
        ArtefactError: A line cannot be read; the sentence names it.
    """
    commands = {case.name: case.command for case in cases}
    columns = _columns(joint_names)
    for line, entry in enumerate(csv.DictReader(io.StringIO(table)), start=2):
        try:
            figures: dict[str, Any] = {name: bool(int(entry[name])) for name in FLAGS}
            for column, name, joint in columns:
                if joint is None:
                    figures[name] = float(entry[column] or "nan")
                elif entry[column]:
                    figures[name] = (*figures.get(name, ()), float(entry[column]))
            yield Row(
                policy=entry["policy"],
                case=entry["command"],
                number=int(entry["number"]),
                seed=int(entry["seed"]),
                figures=JumpFigures(**figures),
                script=Script(
                    command=commands[entry["command"]],
                    **{**times, "run_s": float(entry["run_s"])},
                ),
                capture=entry["capture"],
                began=float(entry["began_s"]),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise ArtefactError(
                f"{path}: line {line} cannot be read ({type(error).__name__}: {error}); "
                "run the trial again."
            ) from None
