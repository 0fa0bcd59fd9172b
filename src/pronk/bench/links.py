"""The same policy in process, over LCM and over DDS: the five-command trial on each, compared.

    trial   as `pronk trial` runs it: the robot's own time, no safety filter, no other process
    twin    as `pronk deploy --link twin`: real time, the robot in the servo's process
    lcm     as `pronk deploy --link lcm`: the robot in a process of its own, behind LCM's bytes
    dds     the same behind DDS's

Repeat k is the same on every link: noise and the moments of the jump inputs are drawn from the seed
and k alone. In `trial` every jump has a robot of its own, set down as the trial does; on the other
links one robot stands up, is asked all commands one after another, and sits down.
"""

from __future__ import annotations

import os
import platform
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from pronk.bench.links_result import WORDS, Jump, LinksBench
from pronk.bench.links_round import Round, Way, fly_round
from pronk.errors import HardwareError, PronkError
from pronk.hardware.truth import load_truth
from pronk.robots import load_robot
from pronk.robots.robot import Robot
from pronk.trial.job import Job, jump
from pronk.trial.protocol import PAPER_COMMANDS, STILL, Case, Script
from pronk.trial.rows import Row
from pronk.trial.run import Plan, draw, jobs_of, mass_of, versions
from pronk.trial.subjects import load_subjects

LINKS = tuple(WORDS)
REPEATS = 4
_TRIES = 4
"""Rounds in which this computer may be too busy, for one repeat."""
_ROBOT = "mini_cheetah"

Progress = Callable[[str, float], None]


@dataclass(frozen=True, kw_only=True)
class Settings:
    """What is compared."""

    links: tuple[str, ...] = LINKS
    cases: tuple[Case, ...] = PAPER_COMMANDS
    repeats: int = REPEATS
    """Jumps with each command on each link."""
    seed: int = 0
    script: Script = field(default_factory=lambda: Script(command=STILL))
    """Times; the command is each case's."""
    truth: Path | None = None
    """Of the virtual robot; None for the shipped one."""
    real_time: bool = True
    """Ask for real-time scheduling."""

    def __post_init__(self) -> None:
        """Refuse what cannot be compared.

        Raises:
            PronkError: One sentence that names what.
        """
        for link in self.links:
            if link not in LINKS:
                raise PronkError(f"link {link!r}; the links are {', '.join(LINKS)}.")
        if not self.links or len(set(self.links)) != len(self.links):
            raise PronkError(
                f"links {', '.join(self.links) or 'none'}; expected one or more, each once."
            )
        self.plan()

    def plan(self) -> Plan:
        """The trial whose jumps are asked for.

        Raises:
            PronkError: Repeats, seed or commands that are none.
        """
        return Plan(cases=self.cases, jumps=self.repeats, seed=self.seed, script=self.script)


def run(policy: Path, settings: Settings, *, progress: Progress | None = None) -> LinksBench:
    """Run the trial on every link.

    Args:
        policy: `policy.onnx`.
        settings: What is compared.
        progress: Told how far each link has come.

    Raises:
        PronkError: The policy or the truth does not fit, or a link never let a policy take over.
    """
    begun = time.perf_counter()
    robot = load_robot(_ROBOT)
    (subject,) = load_subjects([policy], robot)
    truth = load_truth(settings.truth)
    truth.check_joints(robot.joint_names, str(settings.truth or "truth"))
    trial = jobs_of([subject], settings.plan(), robot=robot, truth=truth, out=Path())
    jumps: list[Jump] = []
    rounds: list[dict[str, Any]] = []
    refused: list[str] = []
    tell = progress or (lambda stage, share: None)
    # Turn about, so that whatever else this computer does meets all links.
    for number in range(settings.repeats):
        for link in settings.links:
            if link == "trial":
                jumps += _trial(trial, number)
            else:
                flown = _rounds(policy, settings, link, number, robot)
                jumps += flown[0]
                rounds += flown[1]
                refused += flown[2]
            tell(WORDS[link], (number + 1) / settings.repeats)
    return LinksBench(
        policy=subject.name,
        sha256=subject.sha256,
        links=settings.links,
        cases=tuple(case.name for case in settings.cases),
        seed=settings.seed,
        jumps=tuple(jumps),
        rounds=tuple(rounds),
        refused=tuple(refused),
        seconds=time.perf_counter() - begun,
        machine={
            "cores": str(os.cpu_count()),
            "processor": platform.processor() or platform.machine(),
            **versions(),
        },
    )


def _trial(jobs: Sequence[tuple[Row, Job]], number: int) -> Iterator[Jump]:
    """One repeat as `pronk trial` does it."""
    for row, job in jobs:
        if row.number == number:
            figures = jump(replace(job, keep=None)).figures
            yield Jump(link="trial", case=row.case, number=number, figures=figures)


def _rounds(
    policy: Path, settings: Settings, link: str, number: int, robot: Robot
) -> tuple[list[Jump], list[dict[str, Any]], list[str]]:
    """One repeat over a link: one round, or more for what a fault cut off or this computer spoilt.

    Returns:
        Jumps, how punctual each round was, and why rounds did not begin.
    """
    plan, mass = settings.plan(), mass_of(robot)
    drawn = [draw(plan, case, number, robot) for case in settings.cases]
    left = [(case, script) for case, (script, _, _) in zip(settings.cases, drawn, strict=True)]
    jumps: list[Jump] = []
    rounds: list[dict[str, Any]] = []
    refused: list[str] = []
    # Every command may end a round by a fault, and that is no reason to give up.
    for _ in range(_TRIES + len(left)):
        if not left or len(refused) == _TRIES:
            break
        try:
            flown = _round(policy, settings, link, [s for _, s in left], drawn[0][2], mass)
        except HardwareError as error:
            refused.append(f"{WORDS[link]}: {error}")
            if len(refused) == _TRIES and not rounds:
                raise
            continue
        rounds.append({"link": link, "number": number, **flown.health})
        spoilt = []
        for (case, script), asked in zip(left, flown.asked, strict=False):
            jumps.append(
                Jump(
                    link=link,
                    case=case.name,
                    number=number,
                    figures=asked.figures,
                    fault=asked.fault,
                    disturbed=asked.disturbed,
                )
            )
            if asked.disturbed:
                spoilt.append((case, script))
        left = [*left[len(flown.asked) :], *spoilt]
    return jumps, rounds, refused


def _round(
    policy: Path, settings: Settings, link: str, scripts: Sequence[Script], seed: int, mass: float
) -> Round:
    way = Way(
        kind=link,
        robot=_ROBOT,
        truth=settings.truth,
        port=_free_port(),
        # Not the one of a virtual robot that somebody else may have running.
        domain=100 + os.getpid() % 100,
        real_time=settings.real_time,
    )
    with TemporaryDirectory(prefix="pronk-links-") as folder:
        return fly_round(
            way,
            policy,
            scripts,
            seed=seed,
            folder=Path(folder),
            mass=mass,
            rules=settings.plan().rules,
        )


def _free_port() -> int:
    """A UDP port of this computer that nobody uses."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])
