"""What was crossed: every run at an obstacle, and the largest sizes, as `crossing.json`.

What crossed means is said in `pronk.evaluation.terrain.course`, how sizes grow in
`pronk.evaluation.terrain.climbing`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from pronk.evaluation import result_io as sheet
from pronk.evaluation.protocol import Case
from pronk.evaluation.terrain.course import Kind

SCHEMA = "pronk/trial-crossing/1"
FILE = "crossing.json"
WRITER = "pronk trial POLICY --crossing"


@dataclass(frozen=True, kw_only=True)
class Crossing:
    """One run at an obstacle."""

    policy: str
    case: str
    kind: Kind
    """`flat` for practice."""
    size: float
    """[m]"""
    lead: float
    """From the trunk to the edge when the jump input was to rise [m]."""
    number: int
    why: str
    """Empty if it was crossed."""
    take_off: float
    """From the front-most last stand of a foot to the edge [m]."""
    landing: float
    """From the far edge to the hind-most first touch of a foot [m]."""
    reach: float
    """From the trunk at the jump input to that front-most last stand [m]."""
    speed: float
    """Along the course at the jump input [m/s]."""

    @property
    def crossed(self) -> bool:
        """All conditions were met."""
        return not self.why


@dataclass(frozen=True, kw_only=True)
class Rung:
    """One size, with the lead that did best."""

    size: float
    lead: float
    crossed: int
    runs: int
    """With that lead."""
    reasons: Mapping[str, int]
    """Why the others were not crossed, with all leads."""


@dataclass(frozen=True, kw_only=True)
class Climb:
    """All sizes that one policy tried with one command."""

    policy: str
    case: str
    kind: Kind
    rungs: tuple[Rung, ...]
    largest: float
    """Largest size crossed in `enough` of its runs, as were all smaller ones; 0 for none [m]."""
    ever: float
    """Largest size crossed in any run; 0 for none [m]."""


@dataclass(frozen=True, kw_only=True)
class Crossings:
    """All of it."""

    origin: sheet.Origin
    cases: tuple[Case, ...]
    kinds: tuple[Kind, ...]
    runs: int
    enough: int
    rows: tuple[Crossing, ...]
    """Practice first; then in the order they were tried."""

    @cached_property
    def climbs(self) -> tuple[Climb, ...]:
        """Every policy with every command and kind of obstacle."""
        return tuple(
            self._climb(subject.name, case.name, kind)
            for subject in self.origin.subjects
            for case in self.cases
            for kind in self.kinds
        )

    def _climb(self, policy: str, case: str, kind: Kind) -> Climb:
        rows = [r for r in self.rows if (r.policy, r.case, r.kind) == (policy, case, kind)]
        rungs = tuple(
            rung_of(size, [row for row in rows if row.size == size])
            for size in sorted({row.size for row in rows})
        )
        largest = 0.0
        for rung in rungs:
            if rung.crossed < self.enough:
                break
            largest = rung.size
        ever = max((row.size for row in rows if row.crossed), default=0.0)
        return Climb(policy=policy, case=case, kind=kind, rungs=rungs, largest=largest, ever=ever)


def rung_of(size: float, rows: Sequence[Crossing]) -> Rung:
    """Sum up the runs at obstacles of one size.

    Args:
        size: [m]
        rows: With any lead, one or more.
    """
    leads = sorted({row.lead for row in rows})
    counts = {lead: sum(row.crossed for row in rows if row.lead == lead) for lead in leads}
    # With equal counts the shorter lead: the one nearer to the edge.
    best = max(leads, key=lambda lead: (counts[lead], -lead))
    reasons: dict[str, int] = {}
    for row in rows:
        if row.why:
            reasons[row.why] = reasons.get(row.why, 0) + 1
    return Rung(
        size=size,
        lead=best,
        crossed=counts[best],
        runs=sum(row.lead == best for row in rows),
        reasons=reasons,
    )


def save(folder: Path, crossings: Crossings) -> Path:
    """Write `crossing.json`; returns its path."""
    return sheet.save(
        folder / FILE,
        SCHEMA,
        crossings.origin,
        {
            "cases": crossings.cases,
            "kinds": crossings.kinds,
            "runs": crossings.runs,
            "enough": crossings.enough,
            "climbs": crossings.climbs,
            "rows": crossings.rows,
        },
    )


def load(folder: Path) -> Crossings:
    """Read what `save` wrote.

    Raises:
        ArtefactError: Missing, damaged or of another schema.
    """
    with sheet.load(folder / FILE, SCHEMA, writer=WRITER) as (where, told):
        return Crossings(
            origin=where,
            cases=tuple(sheet.entry_of(Case, entry) for entry in told["cases"]),
            kinds=tuple(told["kinds"]),
            runs=told["runs"],
            enough=told["enough"],
            rows=tuple(sheet.entry_of(Crossing, entry) for entry in told["rows"]),
        )
