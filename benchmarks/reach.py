"""`python -m benchmarks reach`: how far a policy's jumps get by changes of its joint targets alone.

The policy walks up to the moment of the jump command. From there offsets are added to its targets,
the same in every jump and on both sides of the robot, while the policy goes on. CMA-ES looks for
the offsets with which one such jump is longest; a fork of the process tries each candidate, so that
all begin in the same state. The offsets are then added in other jumps, which the search has not
seen. What they reach the virtual robot can do, and so could a policy.
"""

from __future__ import annotations

import json
import math
import multiprocessing
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import tyro
from numpy.typing import ArrayLike

from benchmarks.peers import import_peers
from benchmarks.runner import finish, in_parallel
from pronk.arrays import Array
from pronk.cli import console
from pronk.errors import PronkError
from pronk.files import require_place, write_text
from pronk.jump.trial.jumps import JumpFigures
from pronk.jump.trial.protocol import parse_case
from pronk.jump.trial.trial import TrialJob, TrialPlan, load_subjects, plan_jobs, setup_of
from pronk.jump.virtual.robot import VirtualRobot
from pronk.policy.observation import Measurement
from pronk.policy.rollout import ticks
from pronk.policy.runtime import Policy
from pronk.robots.legged import HIP_ROLL, hips, joints_of_leg
from pronk.robots.quadruped import LEG_JOINTS, require_quadruped
from pronk.robots.robot import RobotSpec
from pronk.tables import Cell, Column, Table

KNOTS_S = (0.0, 0.06, 0.12, 0.17, 0.21, 0.25, 0.29, 0.34, 0.40, 0.48, 0.56)
"""Times after the jump command at which offsets are chosen, with lines between them [s]."""
END_S = 0.62
"""Time after the jump command from which on there is no offset [s]."""
ROWS = 2 * len(LEG_JOINTS)
"""Joints of a front and of a hind leg, each of which has offsets of its own."""
LARGEST_RAD = 1.2
"""Largest offset at a knot [rad]."""
FIRST_STD_RAD = 0.12
"""Standard deviation of the first candidates' offsets [rad]."""
POPULATION = 20
"""Candidates of one generation."""
WATCHED_S = 1.05
"""Time after the jump command for which a candidate is simulated [s]: past the touchdown."""
TOUCH_COST_M = 0.15
"""Length by which a candidate counts less if anything but a foot touches the ground [m]."""
FALL_COST_M = 0.6
"""Length by which a candidate that falls counts less [m]."""
SIZE_COST = 0.002 / 6.0
"""Cost of the sum of all squared offsets [m/rad^2]: of two jumps alike, that with fewer changes."""


class OffsetPolicy:
    """A policy to whose targets offsets are added from the rise of the jump input on."""

    def __init__(self, policy: Policy) -> None:
        """Begin without offsets."""
        self.contract = policy.contract
        self._policy = policy
        self.offsets = np.zeros((0, len(policy.contract.joint_names)))
        """Added in the steps from the rise of the jump input on [rad]. (steps, joints)"""
        self._steps_since: int | None = None

    def reset(self) -> None:
        """Begin a new run."""
        self._policy.reset()
        self._steps_since = None

    def step(self, measurement: Measurement, command: ArrayLike, jump: bool = False) -> Array:
        """Return the policy's targets with the offsets of this step [rad], (joints,)."""
        target: Array = self._policy.step(measurement, command, jump)
        if jump and self._steps_since is None:
            self._steps_since = 0
        if self._steps_since is not None:
            if self._steps_since < len(self.offsets):
                target = target + self.offsets[self._steps_since]
            self._steps_since += 1
        return target


@dataclass(frozen=True, kw_only=True)
class OffsetLayout:
    """Which offsets the joints of a quadruped have."""

    rows: tuple[int, ...]
    """Row of the offsets of each joint: those of a front leg, hip roll, hip pitch and knee, then
    those of a hind leg."""
    signs: tuple[float, ...]
    """-1 for joints that turn the other way: the hip rolls of the left side."""

    @classmethod
    def of(cls, robot: RobotSpec) -> OffsetLayout:
        """Read where the legs are from the robot's model.

        Raises:
            RobotError: It is no quadruped of three joints a leg with alike axes.
        """
        require_quadruped(robot)
        places = hips(robot, robot.build_spec().compile())
        middle = np.mean([place[0] for place in places.values()])
        rows = {}
        signs = {}
        for leg, place in places.items():
            first_row = 0 if place[0] > middle else len(LEG_JOINTS)
            for number, name in enumerate(joints_of_leg(robot, leg)):
                rows[name] = first_row + number
                turns_other_way = number == HIP_ROLL and place[1] > 0.0
                signs[name] = -1.0 if turns_other_way else 1.0
        names = robot.joint_names
        return cls(
            rows=tuple(rows[name] for name in names), signs=tuple(signs[name] for name in names)
        )


def offset_table(values: Array, layout: OffsetLayout, rate_hz: float) -> Array:
    """Return the offsets of every step after the jump command [rad], (steps, joints).

    Args:
        values: Offsets at the knots, row by row of the layout [rad]. (rows * knots,)
        layout: Which row each joint has.
        rate_hz: Rate of the policy [Hz].
    """
    at_knots = values.reshape(ROWS, len(KNOTS_S))
    times = np.arange(round(END_S * rate_hz)) / rate_hz
    offsets = np.zeros((len(times), len(layout.rows)))
    for k, (row, sign) in enumerate(zip(layout.rows, layout.signs, strict=True)):
        knots = [*at_knots[row], 0.0]
        offsets[:, k] = sign * np.interp(times, [*KNOTS_S, END_S], knots)
    return offsets


@dataclass(kw_only=True)
class Approach:
    """A run of a trial, simulated up to the step before the jump command."""

    job: TrialJob
    policy: OffsetPolicy
    layout: OffsetLayout
    machine: VirtualRobot
    began: float
    """When the policy took over, on the robot's clock [s]."""
    steps: Iterator[float]
    """The steps that are left."""

    @classmethod
    def of(cls, job: TrialJob) -> Approach:
        """Simulate a run up to the jump command."""
        machine = job.set_down()
        policy = OffsetPolicy(job.policy())
        script = job.row.script
        began = machine.now()
        # `ticks` reads the contract and calls `reset` and `step`.
        tried = cast("Policy", policy)
        steps = ticks(machine, tried, job.setup.robot, script.commanded, seconds=script.seconds)
        last = script.on - 1.5 / policy.contract.policy_rate_hz
        for time in steps:
            if time > last:
                break
        return cls(
            job=job,
            policy=policy,
            layout=OffsetLayout.of(job.setup.robot),
            machine=machine,
            began=began,
            steps=steps,
        )

    def jump(self, values: Array, watched_s: float = math.inf) -> JumpFigures:
        """Go on with offsets and return the figures of the jump; the approach is used up.

        Args:
            values: Offsets as of `offset_table` [rad].
            watched_s: Time after the jump command for which the run is simulated [s].
        """
        script = self.job.row.script
        self.policy.offsets = offset_table(values, self.layout, self.policy.contract.policy_rate_hz)
        for time in self.steps:
            if time >= script.on + watched_s:
                break
        figures: JumpFigures = self.job.run_kind.measure(
            self.machine.capture(), script, self.job.setup.robot, began=self.began
        )
        return figures


def cost(figures: JumpFigures, values: Array) -> float:
    """Return what the search makes small [m]: a long jump on the feet is best."""
    length = figures.flight.along if figures.found else 0.0
    if not math.isfinite(length):
        length = 0.0
    total = SIZE_COST * float(np.sum(values**2)) - length
    if figures.non_foot_contact:
        total += TOUCH_COST_M
    if figures.fell:
        total += FALL_COST_M
    return total


_approach: list[Approach] = []
"""What a forked process goes on from."""


def _take_over(approach: Approach) -> None:
    """Begin a forked process, which inherits the approach as it is."""
    _approach[:] = [approach]


def _candidate_cost(values: Array) -> float:
    """Jump with offsets and return the cost, in a forked process that does nothing else."""
    return cost(_approach[0].jump(values, WATCHED_S), values)


def search_offsets(approach: Approach, evaluations: int, seed: int, jobs: int) -> Array:
    """Return the offsets in the middle of the last generation of CMA-ES, as of `offset_table`.

    Args:
        approach: Where all candidates begin.
        evaluations: Number of jumps to try.
        seed: Seed of the candidates, 0 or more.
        jobs: Processes, a jump each.
    """
    _, cma = import_peers()
    start = np.zeros(ROWS * len(KNOTS_S))
    options = {
        # A covariance without correlations is learned in far fewer jumps.
        "CMA_diagonal": True,
        "bounds": [-LARGEST_RAD, LARGEST_RAD],
        "popsize": POPULATION,
        "seed": seed + 1,  # 0 would be the time
        "verbose": -9,
    }
    search = cma.CMAEvolutionStrategy(start, FIRST_STD_RAD, options)
    forks = multiprocessing.get_context("fork")
    used = 0
    # A fork for each candidate: all begin in the state in which this process is.
    with (
        console.progress() as report,
        forks.Pool(jobs, _take_over, (approach,), maxtasksperchild=1) as workers,
    ):
        while used < evaluations:
            candidates = search.ask()
            search.tell(candidates, workers.map(_candidate_cost, candidates, chunksize=1))
            used += len(candidates)
            report("searching", min(1.0, used / evaluations))
    middle: Array = np.asarray(search.result.xfavorite)
    return middle


def reach_table(
    shares: Sequence[float], jumps: Sequence[Sequence[JumpFigures]], title: str
) -> Table:
    """Make the table of jumps, a row for each share of the offsets.

    Args:
        shares: Shares of the offsets.
        jumps: Figures of the jumps with each.
        title: Title of the table.
    """
    columns = (
        Column(heading="share of the offsets", digits=2),
        Column(heading="jumps", digits=0),
        Column(heading="landed", digits=0),
        Column(heading="distance", unit="m", digits=3),
        Column(heading="height", unit="m", digits=3),
        Column(heading="upwards", unit="m/s", digits=2),
        Column(heading="horizontally", unit="m/s", digits=2),
    )
    rows: list[tuple[Cell, ...]] = []
    for share, figures in zip(shares, jumps, strict=True):
        found = [jump for jump in figures if jump.found]
        means = [math.nan] * 4
        if found:
            numbers = []
            for jump in found:
                flight = jump.flight
                numbers.append(
                    (
                        flight.distance,
                        jump.height,
                        flight.lift_off_velocity,
                        flight.horizontal_velocity,
                    )
                )
            means = np.mean(numbers, axis=0).tolist()
        landed = sum(jump.success for jump in figures)
        rows.append((share, len(figures), landed, *means))
    notes = (
        "Means of the jumps that left the ground; velocities at lift-off.",
        "The search has seen another run than these.",
    )
    return Table(title=title, columns=columns, rows=tuple(rows), notes=notes)


def _jump_with(work: tuple[TrialJob, Array]) -> JumpFigures:
    """Do a whole run with offsets."""
    job, values = work
    return Approach.of(job).jump(values)


def reach(
    policy: tyro.conf.Positional[Path],
    command: str = "2,0",
    evaluations: int = 1600,
    jumps: int = 10,
    seed: int = 0,
    jobs: int = 1,
    out: Path | None = None,
) -> console.Outcome:
    """Search for offsets to a policy's joint targets with which its jumps are longest.

    Args:
        policy: The policy.onnx.
        command: Forward and left velocity in m/s, and a yaw rate in rad/s if there is one.
        evaluations: Jumps of the search, all from one approach.
        jumps: Other jumps, in which the offsets are then added.
        seed: Seed of the trial and of the search.
        jobs: Processes, a jump each.
        out: File for the offsets and all figures, JSON.
    """
    if evaluations < POPULATION or jumps < 1 or jobs < 1 or seed < 0:
        raise PronkError(
            f"--evaluations {evaluations} --jumps {jumps} --jobs {jobs} --seed {seed}; expected "
            f"{POPULATION} or more, 1 or more, 1 or more, and 0 or more."
        )
    case = parse_case(command)
    if not any(case.command[:2]):
        raise PronkError(
            f"--command {command}: a jump on the spot has no length; give a velocity, as 2,0."
        )
    if out is not None:
        require_place(out)
    setup = setup_of(policy, Path(), processes=1)
    plan = TrialPlan(cases=(case,), jumps=jumps + 1, rates=0, seed=seed)
    subjects = load_subjects([policy], setup.robot)
    first, *others = plan_jobs(subjects, plan, setup)
    values = search_offsets(Approach.of(first), evaluations, seed, jobs)
    shares = (0.0, 0.25, 0.5, 0.75, 1.0)
    figures: list[list[JumpFigures]] = []
    for share in shares:
        work = [(job, share * values) for job in others]
        figures.append(list(in_parallel(_jump_with, work, jobs)))
    title = f"{policy}, {case.name}, offsets of {evaluations} tried jumps; virtual robot"
    table = reach_table(shares, figures, title)
    record: dict[str, Any] = {
        "virtual": True,
        "policy": str(policy),
        "command": command,
        "evaluations": evaluations,
        "seed": seed,
        "knots_s": KNOTS_S,
        "offsets_rad": values.tolist(),
        "table": table,
    }
    if out is not None:
        write_text(out, json.dumps({**record, "table": table.rows}, indent=1))
    return finish(record, table)
