"""`python -m benchmarks go2-feet`: how stiff a foot of the virtual Go2 may be.

A policy that ran on real Go2s walks forwards on the virtual Go2 with feet of several stiffnesses,
by the function of `pronk policy check`. All other parameters are those that are shipped, except
the torque scales and the delays where options change them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np

from benchmarks.go2 import FAST, FOLDER
from benchmarks.runner import Row, finish, in_parallel
from pronk.cli import console
from pronk.errors import PronkError
from pronk.jump.trial.foreign_check import run_on_virtual_robot
from pronk.jump.virtual.sim_params import SimParams, load_sim_params
from pronk.policy.deploy_yaml import read_deploy_yaml
from pronk.policy.foreign import ForeignPolicy, load_foreign_network
from pronk.robots import load_robot
from pronk.tables import Cell, Column, Table

GO2 = "go2"
LEG_MASS_KG = 0.9
"""Inertia of a leg of the Go2 at its foot [kg]."""
MILLI = 1e-3


@dataclass(frozen=True, kw_only=True)
class FootCase:
    """What is changed on the virtual Go2."""

    stiffness: float
    """Stiffness of a foot [N/m]."""
    damping: float
    """Damping of a foot [N s/m]."""
    torque_scale: float
    """Factor of the shipped torque scales, which are drawn about 1 [1]."""
    command_delay_s: float
    """Delay from a command to the drives [s]."""
    measurement_delay_s: float
    """Delay from a measurement to its state [s]."""

    def applied_to(self, params: SimParams) -> SimParams:
        """Return parameters with the changes of this case."""
        joints = {}
        for name, joint in params.joints.items():
            joints[name] = replace(joint, torque_scale=joint.torque_scale * self.torque_scale)
        machine = replace(
            params.machine,
            command_delay_s=self.command_delay_s,
            measurement_delay_s=self.measurement_delay_s,
        )
        ground = replace(params.ground, stiffness=self.stiffness, damping=self.damping)
        return replace(params, machine=machine, ground=ground, joints=joints)


def critical_damping(stiffness: float) -> float:
    """Return the critical damping of a leg on a foot of a stiffness [N s/m].

    Args:
        stiffness: Stiffness of the foot [N/m].
    """
    return 2.0 * math.sqrt(stiffness * LEG_MASS_KG)


def run_case(work: tuple[FootCase, int], *, policy: Path, speed: float, seconds: float) -> Row:
    """Run a policy once on a virtual Go2.

    Args:
        work: What is changed on the virtual Go2, and the seed of all noise.
        policy: Folder of the policy, with its `policy.onnx` and `deploy.yaml`.
        speed: Commanded forward velocity [m/s].
        seconds: How long the policy runs [s].
    """
    case, seed = work
    robot = load_robot(GO2)
    deploy = read_deploy_yaml(policy / "deploy.yaml")
    network = load_foreign_network(policy / "policy.onnx", deploy)
    run = run_on_virtual_robot(
        robot,
        case.applied_to(load_sim_params(None, robot)),
        ForeignPolicy(network, deploy),
        (speed, 0.0, 0.0),
        seconds=seconds,
        seed=seed,
    )
    return asdict(case) | {
        "seed": seed,
        "fell_s": run.fell_s,
        "speed": run.velocity[0],
        "foot_depth": run.foot_depth,
    }


def cases_of(
    stiffness: str, torque_scale: str, delays: str, damping: float | None
) -> list[FootCase]:
    """Return every combination of the values of the options.

    Args:
        stiffness: Stiffnesses of a foot [kN/m], with commas between them.
        torque_scale: Factors of the torque scales, with commas between them.
        delays: Delays of commands and of measurements [ms], as `2+1`, with commas between them.
        damping: Damping of a foot [N s/m]; None for the critical one of each stiffness.

    Raises:
        PronkError: A value is not a number, or not a pair of numbers.
    """
    cases = []
    for pair, scale, kilonewtons in product(
        _delay_pairs(delays),
        _numbers("--torque-scale", torque_scale),
        _numbers("--stiffness", stiffness),
    ):
        newtons = kilonewtons / MILLI
        case = FootCase(
            stiffness=newtons,
            damping=critical_damping(newtons) if damping is None else damping,
            torque_scale=scale,
            command_delay_s=pair[0] * MILLI,
            measurement_delay_s=pair[1] * MILLI,
        )
        if case not in cases:
            cases.append(case)
    return cases


def _numbers(option: str, text: str, separator: str = ",") -> list[float]:
    """Read the numbers of an option, none of which is below 0."""
    numbers = []
    for word in text.split(separator):
        try:
            number = float(word)
        except ValueError:
            number = math.nan
        if not 0.0 <= number < math.inf:
            raise PronkError(
                f"{option} {text}: {word!r} is not a number of 0 or more; give numbers with "
                f"{separator!r} between them."
            )
        numbers.append(number)
    return numbers


def _delay_pairs(text: str) -> list[tuple[float, float]]:
    """Read pairs of delays [ms]."""
    pairs = []
    for word in text.split(","):
        numbers = _numbers("--delays", word, "+")
        if len(numbers) != 2:
            raise PronkError(
                f"--delays {text}: {word!r} is not a pair of numbers; give the delays of "
                "commands and of measurements in ms, as 2+1."
            )
        pairs.append((numbers[0], numbers[1]))
    return pairs


def falls_table(cases: Sequence[FootCase], rows: Sequence[Row], title: str) -> Table:
    """Make the table of falls, speeds and depths, a row for each case.

    Args:
        cases: What was changed on the virtual Go2.
        rows: Rows of `run_case`, in any order.
        title: Title of the table.
    """
    columns = (
        Column(heading="stiffness", unit="kN/m", digits=1),
        Column(heading="damping", unit="N s/m", digits=0),
        Column(heading="torque scale", digits=2),
        Column(heading="delays", unit="ms"),
        Column(heading="runs", digits=0),
        Column(heading="falls", digits=0),
        Column(heading="speed", unit="m/s", digits=2),
        Column(heading="foot pressed in", unit="mm", digits=1),
    )
    table_rows: list[tuple[Cell, ...]] = []
    for case in cases:
        runs = [row for row in rows if _case_of(row) == case]
        upright = [row for row in runs if row["fell_s"] is None]
        speed = math.nan
        depth = math.nan
        if upright:
            speed = float(np.mean([row["speed"] for row in upright]))
            depth = max(row["foot_depth"] for row in upright)
        table_row: tuple[Cell, ...] = (
            case.stiffness * MILLI,
            case.damping,
            case.torque_scale,
            f"{case.command_delay_s / MILLI:g} + {case.measurement_delay_s / MILLI:g}",
            len(runs),
            len(runs) - len(upright),
            speed,
            depth / MILLI,
        )
        table_rows.append(table_row)
    notes = (
        "torque scale: factor of the shipped ones; delays: of commands and of measurements",
        "speed: mean over the second half; foot pressed in: at most; both of runs without a fall",
    )
    return Table(title=title, columns=columns, rows=tuple(table_rows), notes=notes)


def _case_of(row: Row) -> FootCase:
    """Return what was changed in a run."""
    changes = {entry.name: row[entry.name] for entry in fields(FootCase)}
    return FootCase(**changes)


def go2_feet(
    policy: Path = FOLDER / FAST,
    stiffness: str = "20,25,30",
    damping: float | None = None,
    torque_scale: str = "1",
    delays: str = "2+1",
    speed: float = 4.0,
    seconds: float = 10.0,
    seeds: int = 10,
    jobs: int = 1,
) -> console.Outcome:
    """Count the falls of a policy on virtual Go2s with feet of several stiffnesses.

    Every combination of the stiffnesses, torque scales and delays is run with every seed.

    Args:
        policy: Folder of the policy, with its policy.onnx and deploy.yaml.
        stiffness: Stiffnesses of a foot in kN/m, with commas between them.
        damping: Of a foot, in N s/m; critical for 0.9 kg, a leg's inertia at the foot, if left out.
        torque_scale: Factors of the shipped torque scales, which are drawn about 1.
        delays: Of commands and of measurements in ms, as 3+2,2+1.
        speed: Commanded forward velocity, in m/s.
        seconds: Length of a run, in s.
        seeds: Runs of each combination, with the seeds from 0 on.
        jobs: Processes, a run each.
    """
    if seeds < 1 or not 2.0 <= seconds <= 120.0:
        raise PronkError(
            f"--seeds {seeds} --seconds {seconds:g}; expected 1 or more, and 2 to 120 s."
        )
    if not policy.is_dir():
        raise PronkError(f"{policy}: no such folder; expected policy.onnx and deploy.yaml in it.")
    cases = cases_of(stiffness, torque_scale, delays, damping)
    work = list(product(cases, range(seeds)))
    one_run = partial(run_case, policy=policy, speed=speed, seconds=seconds)
    rows: list[Row] = []
    with console.progress() as report:
        for row in in_parallel(one_run, work, jobs):
            rows.append(row)
            report("runs", len(rows) / len(work))
    rows.sort(key=_place)
    title = f"{policy.name}, virtual Go2, {speed:g} m/s commanded, {seconds:g} s"
    figures = {
        "schema": "pronk/bench-go2-feet/1",
        "policy": policy.name,
        "speed": speed,
        "seconds": seconds,
        "rows": rows,
    }
    return finish(figures, falls_table(cases, rows, title))


def _place(row: Row) -> tuple[float, ...]:
    """Return where a run stands among the rows."""
    return (
        row["command_delay_s"],
        row["measurement_delay_s"],
        row["torque_scale"],
        row["stiffness"],
        row["seed"],
    )
