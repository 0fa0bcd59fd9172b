"""What `pronk bench links` found, as tables for a terminal."""

from __future__ import annotations

import math
from collections.abc import Iterable

from rich.table import Table
from rich.text import Text

from pronk.bench.links_result import ALL, COMPARED, WORDS, Difference, LinksBench


def tables(bench: LinksBench) -> Iterable[Table]:
    """What was measured, how the links differ, and how punctual they were."""
    yield _means(bench)
    if len(bench.links) > 1:
        yield _differences(bench)
    if bench.rounds:
        yield _health(bench)


def _made(title: str, columns: Iterable[str], caption: str = "") -> Table:
    made = Table(
        title=Text(title),
        caption=Text(caption) if caption else None,
        title_justify="left",
        caption_justify="left",
    )
    for i, column in enumerate(columns):
        made.add_column(Text(column), justify="left" if i == 0 else "right", no_wrap=True)
    return made


def _means(bench: LinksBench) -> Table:
    made = _made(
        "The same policy on the same virtual robot, link by link: mean +- standard deviation [cm]",
        ("command", *(WORDS[link] for link in bench.links)),
        "Landed: jumps that landed well, of those asked for and not disturbed.",
    )
    for case in bench.cases:
        for name in COMPARED:
            spreads = [bench.spread(link, case, name) for link in bench.links]
            made.add_row(
                f"{case}: {name}", *(f"{_cm(each.mean)} +- {_cm(each.std)}" for each in spreads)
            )
        jumps = [bench.of(link, case) for link in bench.links]
        landed = (f"{sum(jump.landed for jump in each)} of {len(each)}" for each in jumps)
        made.add_row(f"{case}: landed", *landed)
    return made


def _cm(metres: float) -> str:
    return f"{100.0 * metres:.1f}" if math.isfinite(metres) else "-"


def _differences(bench: LinksBench) -> Table:
    verdict = "reached" if bench.passed else "MISSED"
    count = len(bench.cells)
    bar = (
        f"Of links that are alike 1 in 20 falls outside by chance: between links, "
        f"{count - bench.outside} of {count} within; bar, {bench.allowed} outside at most: "
        f"{verdict}."
    )
    made = _made(
        "Differences of the means, with 95 % intervals [cm]",
        ("links", *bench.cases, ALL),
        "Within the spread of repeats: 0 is in Welch's 95 % interval of the difference; * is not. "
        + (bar if count else ""),
    )
    for name in COMPARED:
        rows = bench.differences(name)
        for one, other in dict.fromkeys(each.links for each in rows):
            cells = (_signed(each) for each in rows if each.links == (one, other))
            made.add_row(f"{name}: {WORDS[one]} - {WORDS[other]}", *cells)
    return made


def _signed(each: Difference) -> str:
    if not each.known:
        return "-"
    mark = "" if each.within else " *"
    return f"{100.0 * each.value:+.1f} +- {100.0 * each.half_width:.1f}{mark}"


def _health(bench: LinksBench) -> Table:
    made = _made(
        "Punctuality, worst round of each link [ms]",
        (
            "link",
            "rounds",
            "state to command: median",
            "99 %",
            "servo late: 99 %",
            "robot late: 99 %",
        ),
        f"{bench.disturbed} jumps were left out and asked again: something on this computer was "
        f"late by half a policy step; {len(bench.refused)} rounds did not begin.",
    )
    for link in bench.links:
        rounds = [each for each in bench.rounds if each["link"] == link]
        if not rounds:
            continue
        numbers = (
            [each["state_to_command"]["p50_ms"] for each in rounds],
            [each["state_to_command"]["p99_ms"] for each in rounds],
            [each["servo_lateness"]["p99_ms"] for each in rounds],
            [each["twin_lateness"].get("p99", math.nan) for each in rounds],
        )
        worst = (f"{max(each):.2f}" if math.isfinite(max(each)) else "-" for each in numbers)
        made.add_row(WORDS[link], str(len(rounds)), *worst)
    return made
