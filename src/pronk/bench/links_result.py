"""What `pronk bench links` found: every jump, and whether the links differ more than repeats do.

The rule, for each figure with each command and each two links a and b, with means m, standard
deviations s and n jumps of each (Welch 1947):

    |m_a - m_b| <= t SE,    SE^2 = u_a + u_b,    u = s^2 / n,
    t: 97.5 % point of Student's t with SE^4 / (u_a^2 / (n_a - 1) + u_b^2 / (n_b - 1)) degrees

that is, 0 lies in the 95 % interval of the difference of the means. Of links that are alike one
difference in 20 falls outside by chance. `all` is the mean of the differences with every command,
its SE^2 and its degrees' denominator those of a mean: sharper, for its n is that of all commands.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pronk.trial.metrics import FIGURES, JumpFigures
from pronk.trial.summary import Spread

Array = NDArray[np.float64]

SCHEMA = "pronk/bench-links/1"
COMPARED = ("height", "distance")
"""The figures of the paper's Table III; the others are in the JSON."""
ALL = "all"
_LEVEL = 0.95
WORDS = {
    "trial": "pronk trial",
    "twin": "in process",
    "lcm": "LCM",
    "dds": "DDS",
}
"""Each link in words."""
REFERENCE = "trial"
"""No link: shown beside them, and no part of the bar."""


@dataclass(frozen=True, kw_only=True)
class Jump:
    """One jump."""

    link: str
    case: str
    """The command's name."""
    number: int
    """Of the repeat: the same jump on every link."""
    figures: JumpFigures
    fault: str = ""
    """What damped the robot; empty if nothing did."""
    disturbed: str = ""
    """What this computer was late with; the jump is then left out. Empty if nothing was."""

    @property
    def landed(self) -> bool:
        """Well, and without a fault."""
        return self.figures.success and not self.fault


@dataclass(frozen=True, kw_only=True)
class Difference:
    """Of the means on two links, with its 95 % interval; all NaN with fewer than two jumps each."""

    figure: str
    case: str
    """`all`: the mean of the differences with every command."""
    links: tuple[str, str]
    value: float
    """The first link's mean less the second's."""
    half_width: float
    n: tuple[int, int]

    @property
    def known(self) -> bool:
        """Whether there is anything to compare."""
        return math.isfinite(self.value) and math.isfinite(self.half_width)

    @property
    def within(self) -> bool:
        """Whether the links differ by no more than the spread of the repeats."""
        return self.known and abs(self.value) <= self.half_width


def difference(pairs: Sequence[tuple[Array, Array]]) -> tuple[float, float]:
    """Mean over commands of the difference of two links' means, and its 95 % half-width.

    Args:
        pairs: For each command what was measured on either link.
    """
    if not pairs or min(len(values) for pair in pairs for values in pair) < 2:
        return math.nan, math.nan
    from scipy.stats import t

    value = sum(float(a.mean() - b.mean()) for a, b in pairs) / len(pairs)
    parts = [(float(v.var(ddof=1)) / len(v), len(v) - 1) for pair in pairs for v in pair]
    square = sum(part for part, _ in parts)
    if square == 0.0:
        return value, 0.0
    degrees = square**2 / sum(part**2 / free for part, free in parts)
    return value, float(t.ppf(0.5 + 0.5 * _LEVEL, degrees)) * math.sqrt(square) / len(pairs)


@dataclass(frozen=True, kw_only=True)
class LinksBench:
    """All of it."""

    policy: str
    sha256: str
    links: tuple[str, ...]
    cases: tuple[str, ...]
    seed: int
    jumps: tuple[Jump, ...]
    rounds: tuple[dict[str, Any], ...]
    """How punctual each round over a link was."""
    refused: tuple[str, ...]
    """Why rounds did not begin."""
    seconds: float
    machine: dict[str, str] = field(default_factory=dict)

    def of(self, link: str, case: str) -> tuple[Jump, ...]:
        """The jumps on one link with one command, those left out that were disturbed."""
        return tuple(
            jump
            for jump in self.jumps
            if (jump.link, jump.case) == (link, case) and not jump.disturbed
        )

    def values(self, link: str, case: str, figure: str) -> Array:
        """One figure of the jumps that were found."""
        rows = (jump.figures for jump in self.of(link, case) if jump.figures.found)
        known = np.array([getattr(figures, figure) for figures in rows], dtype=float)
        finite: Array = known[np.isfinite(known)]
        return finite

    def differences(self, figure: str) -> tuple[Difference, ...]:
        """Of every two links with every command, and with all together."""
        found = []
        for one, other in combinations(self.links, 2):
            pairs = [
                (self.values(one, case, figure), self.values(other, case, figure))
                for case in self.cases
            ]
            for case, part in (*zip(self.cases, ([p] for p in pairs), strict=True), (ALL, pairs)):
                value, half = difference(part)
                found.append(
                    Difference(
                        figure=figure,
                        case=case,
                        links=(one, other),
                        value=value,
                        half_width=half,
                        n=(sum(len(a) for a, _ in part), sum(len(b) for _, b in part)),
                    )
                )
        return tuple(found)

    @property
    def disturbed(self) -> int:
        """Jumps left out, because this computer was late."""
        return sum(bool(jump.disturbed) for jump in self.jumps)

    @property
    def cells(self) -> tuple[Difference, ...]:
        """Of `COMPARED`, command by command, between links: what the bar is about."""
        return tuple(
            each
            for name in COMPARED
            for each in self.differences(name)
            if each.case != ALL and REFERENCE not in each.links
        )

    @property
    def allowed(self) -> int:
        """How many fall outside at most in 19 of 20 benches of links that are alike.

        As if the differences were independent of each other.
        """
        from scipy.stats import binom

        return int(binom.ppf(_LEVEL, len(self.cells), 1.0 - _LEVEL))

    @property
    def outside(self) -> int:
        """Differences that are larger than the spread of repeats, or unknown."""
        return sum(not each.within for each in self.cells)

    @property
    def passed(self) -> bool:
        """No more differences are larger than the spread of repeats than chance alone makes."""
        return bool(self.cells) and self.outside <= self.allowed

    def result(self) -> dict[str, Any]:
        """For JSON: every jump, every spread, every difference."""
        return {
            "schema": SCHEMA,
            "virtual": True,
            "policy": self.policy,
            "policy_sha256": self.sha256,
            "links": self.links,
            "commands": self.cases,
            "seed": self.seed,
            "jumps": [asdict(jump) | {"landed": jump.landed} for jump in self.jumps],
            "spreads": [
                {"link": link, "command": case, "figure": name}
                | asdict(self.spread(link, case, name))
                for link in self.links
                for case in self.cases
                for name, figure in FIGURES.items()
                if not figure.joints
            ],
            "differences": [
                asdict(each) | {"within": each.within}
                for name in COMPARED
                for each in self.differences(name)
            ],
            "outside": self.outside,
            "of": len(self.cells),
            "allowed": self.allowed,
            "passed": self.passed,
            "disturbed": self.disturbed,
            "rounds": self.rounds,
            "refused": self.refused,
            "seconds": self.seconds,
            "machine": self.machine,
        }

    def spread(self, link: str, case: str, figure: str) -> Spread:
        """Mean, standard deviation and n."""
        return Spread.of(self.values(link, case, figure))
