"""One policy's scatter over another's, beside the paper's: a table, and a sentence that decides."""

from __future__ import annotations

import math

from pronk.evaluation.outcome.published import PAPER_RATIOS
from pronk.evaluation.outcome.table_text import Sheet, interval, number, place
from pronk.evaluation.result import COMPARED, Trial
from pronk.evaluation.summary import FEWEST


def scatter(trial: Trial, other: str | None = None) -> Sheet:
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
            for figure in COMPARED
        ),
        notes=(
            f"all: ratio of the means over {', '.join(trial.pooled)}.",
            "paper: naive over matched; its Table III gives 2.08 in distance, its text says 2.30 "
            "(reading A4).",
            verdict(trial, other),
        ),
    )


def verdict(trial: Trial, other: str) -> str:
    """One sentence on whether the paper's claim holds between the first policy and another."""
    parts: list[str] = []
    shown: list[str] = []
    unknown = False
    for figure in ("distance", "height"):
        ratio = next(
            r for r in trial.ratios if (r.figure, r.case, r.other) == (figure, None, other)
        )
        claim = PAPER_RATIOS[figure]
        if not math.isfinite(ratio.value):
            parts.append(f"in {figure} could not be measured")
            unknown = True
            continue
        if not math.isfinite(ratio.low):
            parts.append(
                f"in {figure} {ratio.value:.2f} times as much, with fewer than {FEWEST} jumps "
                "in a command, too few for an interval and for an answer"
            )
            unknown = True
            continue
        if ratio.low > 1.0:
            says = "more"
            shown.append(figure)
        elif ratio.high < 1.0:
            says = "less"
        else:
            says = "cannot be told apart"
        where = "above" if claim > ratio.high else "below" if claim < ratio.low else "within"
        parts.append(
            f"in {figure} {says}, {interval(ratio)} times, and the paper's {claim:g} is {where} "
            "that interval"
        )
    first = trial.subjects[0].name
    if shown:
        answer = f"so {first} jumps more alike in {' and '.join(shown)}"
    else:
        answer = "no answer yet" if unknown else f"so {first} does not jump more alike here"
    return (
        f"scatter of {other} against {first} on the {place(trial)}: {'; '.join(parts)}; {answer}."
    )
