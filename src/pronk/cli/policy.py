"""`pronk policy`: check a policy that was trained elsewhere."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import tyro

from pronk.cli import console
from pronk.cli.options import check_seed
from pronk.errors import PronkError
from pronk.exit_status import ExitStatus
from pronk.tables import Column, Table

if TYPE_CHECKING:
    from pronk.jump.trial.foreign_check import ForeignRun, TriedChange
    from pronk.policy.deploy_yaml import DeployFile
    from pronk.robots.robot import RobotSpec

_LONGEST_S = 120.0
"""Longest run [s]."""
OFF = 0.3
"""Distance from the command beyond which a velocity is said to be another one, as a share of the
command, at least of 1 m/s and 1 rad/s together."""

COLUMNS = (
    Column(heading="change"),
    Column(heading="fell", unit="s", digits=1),
    Column(heading="forward", unit="m/s", digits=2),
    Column(heading="left", unit="m/s", digits=2),
    Column(heading="yaw rate", unit="rad/s", digits=2),
)


def policy(
    action: tyro.conf.Positional[Literal["check"]],
    path: tyro.conf.Positional[Path],
    deploy: Path,
    robot: str,
    command: str = "1,0,0",
    seconds: float = 10.0,
    seed: int = 0,
    sim_params: Path | None = None,
    wide: bool = False,
) -> console.Outcome:
    """Check a policy that was trained elsewhere, by Unitree's deploy.yaml, on the virtual robot.

    Widths, order of the joints, gains, history and scales are compared with the network and the
    robot's file. Then the policy walks on the virtual robot, a simulated stand-in for hardware;
    where it falls, every single change that people often need is tried, and those are named with
    which it does not fall.

    Example:
        pronk policy check policy.onnx --deploy params/deploy.yaml --robot go2

    Args:
        action: check.
        path: The network, an ONNX file.
        deploy: Its deploy.yaml, as unitree_rl_lab and its forks write it.
        robot: A name, or a path to a robot.yaml, MJCF or URDF, whose joints are in the order of the
            messages.
        command: Forward, left [m/s] and yaw rate [rad/s], after 1 s of standing.
        seconds: How long it runs, in s.
        seed: Of all noise.
        sim_params: Parameters of the virtual robot, instead of the shipped ones.
        wide: Print every column, and every change that was tried.
    """
    from pronk.jump.trial.foreign_check import (
        remedies,
        run_on_virtual_robot,
        single_changes,
        try_changes,
    )
    from pronk.jump.virtual.sim_params import load_sim_params
    from pronk.policy.deploy_yaml import RANGE_NAMES, read_deploy_yaml
    from pronk.policy.foreign import ForeignPolicy, deploy_problems, load_foreign_network
    from pronk.policy.script import parse_velocity
    from pronk.robots import load_robot

    check_seed(seed)
    velocity = parse_velocity(command)
    if not 2.0 <= seconds <= _LONGEST_S:
        raise PronkError(f"--seconds {seconds:g}; expected 2 to {_LONGEST_S:g} s.")
    robot_spec = load_robot(robot)
    deploy_file = read_deploy_yaml(deploy)
    problems = deploy_problems(deploy_file, robot_spec)
    network = load_foreign_network(path, deploy_file)
    params = load_sim_params(sim_params, robot_spec)

    def run(changed: DeployFile) -> ForeignRun:
        foreign = ForeignPolicy(network, changed)
        return run_on_virtual_robot(
            robot_spec, params, foreign, velocity, seconds=seconds, seed=seed
        )

    console.show(_file_table(deploy_file, robot_spec), wide=wide)
    for problem in problems:
        console.warn(problem)
    for name, value in zip(RANGE_NAMES, velocity, strict=True):
        low, high = deploy_file.command_ranges.get(name, (-math.inf, math.inf))
        if not low <= value <= high:
            console.warn(f"{name} {value:g} is outside the {low:g} to {high:g} of deploy.yaml")
    outcome = run(deploy_file)
    tried: tuple[TriedChange, ...] = ()
    if outcome.fell_s is not None:
        changes = single_changes(deploy_file, robot_spec)
        console.note(f"fell after {outcome.fell_s:.1f} s; trying {len(changes)} single changes")
        tried = try_changes(changes, run)
    helpful = remedies(tried, velocity)
    rows = [_row("none", outcome)]
    for change in tried if wide else helpful:
        rows.append(_row(change.text, change.run))
    title = f"on the virtual {robot_spec.name}, command {velocity}, {seconds:g} s, seed {seed}"
    console.show(Table(title=title, columns=COLUMNS, rows=tuple(rows)))
    console.say(_verdict(outcome, helpful))
    if outcome.fell_s is None and math.dist(outcome.velocity, velocity) > OFF * max(
        1.0, math.hypot(*velocity)
    ):
        console.warn(
            "its velocity is not the commanded one: a scale of the command or of an observation "
            "may be another one, or the command is beyond what it was trained for"
        )
    return console.Outcome(
        figures={
            "robot": robot_spec.name,
            "virtual": True,
            "command": velocity,
            "seconds": seconds,
            "seed": seed,
            "problems": problems,
            "run": _figures(outcome),
            "tried": [{"change": change.text, **_figures(change.run)} for change in tried],
            "remedies": [change.text for change in helpful],
        },
        status=ExitStatus.DONE if outcome.fell_s is None else ExitStatus.POLICY_FELL,
    )


def _file_table(deploy: DeployFile, robot: RobotSpec) -> Table:
    """Make the table of what deploy.yaml says of each joint."""
    columns = (
        Column(heading="network"),
        Column(heading="message", is_detail=True),
        Column(heading="joint"),
        Column(heading="maker's name"),
        Column(heading="pose", unit="rad", digits=2),
        Column(heading="scale", unit="rad", digits=3, is_detail=True),
        Column(heading="stiffness", unit="N m/rad", digits=1),
        Column(heading="damping", unit="N m s/rad", digits=2),
    )
    rows = []
    for number, place in enumerate(deploy.joint_ids):
        joint = robot.joints[place]
        row = (
            str(number),
            str(place),
            joint.name,
            joint.own_name,
            deploy.default_position[number],
            deploy.action_scale[number],
            deploy.stiffness[place],
            deploy.damping[place],
        )
        rows.append(row)
    layout = "sample after sample" if deploy.by_sample else "term after term"
    terms = ", ".join(
        f"{term.name} {len(term.scale)} x {term.history_length}" for term in deploy.terms
    )
    notes = (
        f"{deploy.width} numbers in, {layout}, oldest first: {terms}",
        f"{1.0 / deploy.step_s:g} actions a second",
    )
    title = "deploy.yaml: joints in the order of the network"
    return Table(title=title, columns=columns, rows=tuple(rows), notes=notes)


def _row(text: str, run: ForeignRun) -> tuple[str, float | None, float, float, float]:
    """Make a row of the table of runs."""
    forward, left, yaw_rate = run.velocity
    return text, run.fell_s, forward, left, yaw_rate


def _figures(run: ForeignRun) -> dict[str, Any]:
    """Return the figures of a run for programs."""
    return {"fell_s": run.fell_s, "lasted_s": run.lasted_s, "velocity": run.velocity}


def _verdict(outcome: ForeignRun, helpful: tuple[TriedChange, ...]) -> str:
    """Say whether it fell, and what helps."""
    if outcome.fell_s is None:
        return "it did not fall"
    if not helpful:
        return "it fell, and with every single change that was tried it fell as well"
    if len(helpful) == 1:
        return f"it fell; with one change it does not: {helpful[0].text}"
    names = "; ".join(change.text for change in helpful)
    return (
        f"it fell; with any one of {len(helpful)} changes it does not, the nearest to the command "
        f"first: {names}"
    )
