"""The commands of a trial, and what the paper published about its jumps with them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from pronk.policy.script import PAPER_VELOCITIES, STILL, Velocity, parse_velocity

MeanStd = tuple[float, float]
"""Mean and standard deviation."""
PAPER_ROBOT = "mini_cheetah"
"""The paper's robot. Its figures stand beside no other robot's."""


@dataclass(frozen=True, kw_only=True)
class Case:
    """A velocity at which jumps are commanded."""

    name: str
    command: Velocity
    """Forward, left [m/s], yaw rate [rad/s], in the trunk's frame."""


_COMMANDS: Mapping[str, Velocity] = {
    "forward 1": (1.0, 0.0, 0.0),
    "forward 2": (2.0, 0.0, 0.0),
    "forward 2.25": (2.25, 0.0, 0.0),
    "forward 3": (3.0, 0.0, 0.0),
    "back 2": (-2.0, 0.0, 0.0),
    "back 3": (-3.0, 0.0, 0.0),
    "side +1": (0.0, 1.0, 0.0),
    "left 1": (0.0, 1.0, 0.0),
    "side -1": (0.0, -1.0, 0.0),
    "right 1": (0.0, -1.0, 0.0),
    "side +0.8": (0.0, 0.8, 0.0),
    "left 0.8": (0.0, 0.8, 0.0),
    "side -0.8": (0.0, -0.8, 0.0),
    "right 0.8": (0.0, -0.8, 0.0),
    "turn +2": (0.0, 0.0, 2.0),
    "yaw 2": (0.0, 0.0, 2.0),
    "turn -2": (0.0, 0.0, -2.0),
    "yaw -2": (0.0, 0.0, -2.0),
    "stand": STILL,
}


def named(*names: str) -> tuple[Case, ...]:
    """Return commands by name. Positive sideways and positive turns are to the left.

    The paper does not define the side, and its robot is symmetric.
    """
    return tuple(Case(name=name, command=_COMMANDS[name]) for name in names)


PAPER_COMMANDS = tuple(Case(name=name, command=PAPER_VELOCITIES[name]) for name in PAPER_VELOCITIES)
"""The jumps of Table III of the paper."""
# Paper R7.
RATES = Case(name="forward 2.25", command=_COMMANDS["forward 2.25"])
"""The command of the paper's figure of roll and pitch rates."""


def parse_cases(texts: Iterable[str]) -> tuple[Case, ...]:
    """Return the cases of several commands, in their order; `paper` stands for the paper's five."""
    cases: list[Case] = []
    for text in texts:
        if text.strip() == "paper":
            cases += PAPER_COMMANDS
        else:
            cases.append(parse_case(text))
    return tuple(cases)


def parse_case(text: str) -> Case:
    """Return the case of a command as `1,0` or `1,0,0`; one of the paper's keeps its name."""
    command = parse_velocity(text)
    for case in (*PAPER_COMMANDS, RATES):
        if case.command == command:
            return case
    return Case(name=",".join(f"{value:g}" for value in command), command=command)


TABLE_III: Mapping[tuple[str, str], Mapping[str, MeanStd]] = {
    ("height", "naive"): {
        "forward 1": (0.332, 0.008),
        "forward 2": (0.246, 0.022),
        "side -1": (0.304, 0.061),
        "side +1": (0.249, 0.041),
        "back 2": (0.346, 0.031),
    },
    ("height", "matched"): {
        "forward 1": (0.318, 0.014),
        "forward 2": (0.244, 0.013),
        "side -1": (0.374, 0.016),
        "side +1": (0.366, 0.052),
        "back 2": (0.381, 0.015),
    },
    ("distance", "naive"): {
        "forward 1": (0.690, 0.076),
        "forward 2": (0.944, 0.030),
        "side -1": (0.636, 0.092),
        "side +1": (0.701, 0.183),
        "back 2": (0.944, 0.030),
    },
    ("distance", "matched"): {
        "forward 1": (0.597, 0.042),
        "forward 2": (0.969, 0.026),
        "side -1": (0.587, 0.054),
        "side +1": (0.542, 0.051),
        "back 2": (0.932, 0.025),
    },
}
"""arXiv 2404.15096, Table III: mean and standard deviation of five jumps [m], by figure and gains,
then by command; for comparison, never fitted to. The naive distance of `back 2` is that of
`forward 2`, digit by digit: most likely an error of the table (reading A4)."""

PAPER_GAPS = {"forward 2": 0.55, "back 2": 0.5, "side -1": 0.4, "side +1": 0.4}
"""Widest gaps by command, read off the paper's video (R3) [m]; of which policy is not stated."""
PAPER_RATIOS = {"height": 1.48, "distance": 2.08}
"""Ratio of the mean standard deviations, naive over matched, as Table III gives it; the text has
2.30 for the distance (reading A4)."""


def in_paper_order(names: Iterable[str]) -> list[str]:
    """Sort names of policies as the columns of Table III: `naive` first, others as they came."""
    return sorted(names, key=lambda name: name != "naive")
