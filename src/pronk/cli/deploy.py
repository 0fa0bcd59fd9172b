"""`pronk deploy`: a policy on a machine, virtual or real."""

from __future__ import annotations

import shlex
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from pronk.cli import console
from pronk.cli.link_options import Base, LinkOptions
from pronk.deploy.runtime.poses import RunTiming
from pronk.errors import HardwareError, PronkError
from pronk.exit_status import ExitStatus
from pronk.tables import Column, Table

if TYPE_CHECKING:
    from pronk.deploy.runtime.records import Event
    from pronk.deploy.runtime.run import RunSummary
    from pronk.deploy.runtime.teleop import Operator
    from pronk.policy.deployable import DeployablePolicy
    from pronk.policy.script import Script


@dataclass(frozen=True, kw_only=True)
class SteeringOptions:
    """Who steers, and for how long."""

    script: str | None = None
    """Run this unattended: paper, or a command such as 1,0,0. A keyboard steers if left out."""
    walk_only: bool = False
    """With --script: walk without jumps."""
    gamepad: Path | None = None
    """Steer with this gamepad, such as /dev/input/js0; with the keyboard if left out."""
    remote: bool = False
    """Steer with the robot's own wireless remote (--link dds)."""
    seconds: float | None = None
    """Sit down after this time with the policy in charge, in s; at the end of the script, or when
    told to, if left out."""

    def check(self, scheme: str) -> None:
        """Refuse two ways to steer, and a remote on a link that does not carry its bytes."""
        ways = []
        if self.script is not None:
            ways.append("--script")
        if self.gamepad is not None:
            ways.append("--gamepad")
        if self.remote:
            ways.append("--remote")
        if len(ways) > 1:
            raise HardwareError(f"{' and '.join(ways)} both steer; give one of them.")
        if self.remote and scheme != "dds":
            raise HardwareError(
                f"--remote is of --link dds, and not of {scheme}: Unitree's states alone carry the "
                "bytes of the robot's remote; use --gamepad or the keyboard."
            )


@dataclass(frozen=True, kw_only=True)
class RecordOptions:
    """What is recorded."""

    log: Path | None = None
    """Log of everything, .mcap, for `pronk report`; none if left out."""
    capture: Path | None = None
    """What cameras around the virtual robot would measure, .npz (--link sim); none if left out."""
    overwrite: bool = False
    """Replace a log or a capture that exists."""


@dataclass(frozen=True, kw_only=True)
class TakeoverOptions:
    """When the policy takes over, and when it is stopped."""

    blend: Annotated[float, tyro.conf.arg(name="blend-time-s")] = RunTiming.blend_s
    """Time in which the policy takes over, in s; 0 as in training."""
    tilt: float | None = None
    """Largest tilt of the trunk, in rad; that of the robot's file if left out, inf for a robot that
    hangs."""
    ignore_latency: Annotated[bool, tyro.conf.arg(name="ignore-latency-check")] = False
    """Start the policy even if the measured latency exceeds its training range."""


def deploy_command(
    policy: tyro.conf.Positional[Path],
    deploy: Path | None = None,
    robot: str | None = None,
    base: Base | None = None,
    steering: SteeringOptions = SteeringOptions(),
    record: RecordOptions = RecordOptions(),
    takeover: TakeoverOptions = TakeoverOptions(),
    machine: LinkOptions = LinkOptions(),  # noqa: B008
) -> console.Outcome:
    """Stand up, let the policy walk and jump, sit down; every command through the safety filter.

    Example:
        pronk deploy policies/matched/policy.onnx --script 1,0,0 --log run.mcap

    Args:
        policy: policy.onnx, as `pronk train` writes it; with --deploy any other.
        deploy: Unitree's deploy.yaml of a policy that was trained elsewhere.
        robot: A name, or a path to a robot.yaml, MJCF or URDF; the policy's if left out.
        base: What holds the virtual robot; the ground if left out.
        steering: Who steers, and for how long.
        record: What is recorded.
        takeover: When the policy takes over, and when it is stopped.
        machine: The machine.
    """
    from pronk.deploy.links.address import SIM
    from pronk.deploy.runtime.plan import Link, RunPlan
    from pronk.deploy.runtime.remote_operator import REMOTE_HELP, Remote
    from pronk.deploy.runtime.run import run_plan
    from pronk.deploy.runtime.teleop import (
        HELP,
        PAD_HELP,
        Gamepad,
        Keyboard,
        ScriptedOperator,
        TimeLimit,
    )
    from pronk.files import require_new, require_place
    from pronk.policy.contract import policy_robot_name
    from pronk.policy.deploy_yaml import read_deploy_yaml
    from pronk.policy.deployable import open_policy
    from pronk.policy.foreign import deploy_problems
    from pronk.policy.runtime import load_policy
    from pronk.robots import load_robot

    log = record.log
    capture = record.capture
    seconds = steering.seconds
    robot_name = robot
    if deploy is None:
        robot_name = robot or policy_robot_name(load_policy(policy).contract)
    if robot_name is None:
        raise PronkError("--deploy needs --robot, such as --robot go2; deploy.yaml names none.")
    robot_spec = load_robot(robot_name)
    loaded_policy = open_policy(policy, robot_spec, deploy)
    address = machine.address(base)
    steering.check(address.scheme)
    if capture is not None and (address.scheme != SIM or address.interface == "bench"):
        raise HardwareError("--capture needs --link sim --base ground: no camera sees elsewhere.")
    if seconds is not None and not seconds > 0.0:
        raise HardwareError(f"--seconds {seconds:g}; expected a time above 0 s.")
    for option, path in (("--log", log), ("--capture", capture)):
        if path is not None:
            require_place(path)
            require_new(path, option, overwrite=record.overwrite)
    plan = RunPlan(
        link=Link(robot=robot_name, address=address, release=machine.release),
        policy=policy,
        deploy_yaml=deploy,
        log=log,
        trajectory=capture,
        tilt=takeover.tilt,
        timing=RunTiming(blend_s=takeover.blend),
        ignore_latency=takeover.ignore_latency,
        real_time=machine.real_time,
    )
    scripts = None
    if steering.script is not None:
        scripts = _scripts(steering.script, loaded_policy, steering.walk_only)
    if deploy is not None:
        for problem in deploy_problems(read_deploy_yaml(deploy), robot_spec):
            console.warn(problem)
    if not plan.limits().trunk_is_free:
        console.warn(
            "without a limit of its tilt the robot counts as hung: its inertial unit, the height "
            "of its trunk and joints that do not follow are not judged"
        )
    if not (address.local or machine.yes):
        console.confirm(robot_spec.name, str(address))
    operator: Operator
    if scripts is not None:
        scripted = ScriptedOperator(scripts)
        operator = scripted
        greeting = f"unattended: {len(scripts)} scripts, {scripted.seconds:.0f} s."
        if seconds is None or seconds > scripted.seconds:
            seconds = scripted.seconds
    elif steering.gamepad is not None:
        operator = Gamepad(steering.gamepad, loaded_policy.command_ranges)
        greeting = PAD_HELP
    elif steering.remote:
        operator = Remote(loaded_policy.command_ranges)
        greeting = REMOTE_HELP
    else:
        operator = Keyboard(loaded_policy.command_ranges)
        greeting = HELP
    if seconds is not None:
        operator = TimeLimit(operator, seconds)
    with closing(operator):
        console.say(greeting)
        summary = run_plan(plan, operator, _notify)
    _report(summary)
    if summary.log_error:
        console.warn(f"{summary.log_error}.")
    capture_lost = any(event.kind == "lost" for event in summary.events_seen)
    wrote = []
    if log is not None and not summary.log_error:
        wrote.append(log)
    if capture is not None and not capture_lost:
        wrote.append(capture)
    if log is None:
        words = ["pronk", "deploy", str(policy), "--link", machine.link, "--log", "run.mcap"]
        next_command = f"{shlex.join(words)}   # keeps everything"
    else:
        next_command = shlex.join(["pronk", "report", str(log)])
    status = ExitStatus.DONE
    if summary.faults or summary.refusals or capture_lost or summary.log_error:
        status = ExitStatus.RUN_FAULT
    elif summary.interrupted:
        status = ExitStatus.INTERRUPTED
    return console.Outcome(
        figures=summary.figures(), wrote=wrote, following=[next_command], status=status
    )


def _scripts(text: str, policy: DeployablePolicy, walk_only: bool) -> list[Script]:
    """Return the scripts of an unattended run; PronkError if the policy was not trained for one."""
    from pronk.policy.script import PAPER_VELOCITIES, Script, parse_velocity

    velocities = PAPER_VELOCITIES
    if text.strip() != "paper":
        velocities = {text: parse_velocity(text)}
    jump_s = Script.jump_s if policy.jumps and not walk_only else 0.0
    scripts = []
    for name, velocity in velocities.items():
        for component, (axis, (low, high)) in zip(
            velocity, policy.command_ranges.items(), strict=True
        ):
            if not low <= component <= high:
                raise PronkError(
                    f"--script {text}: {axis} {component:g} of {name!r} is outside of the range "
                    f"that the policy was trained for, {low:g} to {high:g}."
                )
        scripts.append(Script(command=velocity, jump_s=jump_s))
    return scripts


def _notify(event: Event) -> None:
    """Print one line for an event."""
    line = f"{event.kind}: {event.text}"
    if event.kind in ("fault", "refused", "notice", "lost"):
        console.warn(line)
    else:
        console.note(line)


def _report(summary: RunSummary) -> None:
    """Print the figures of the run."""
    console.show(timing_table(summary))
    interventions = summary.servo.get("interventions", {})
    ticks = summary.servo.get("ticks", 0)
    if interventions:
        counts = [f"{name} {count}" for name, count in interventions.items()]
        console.say(f"safety filter: {', '.join(counts)} (ticks of {ticks})")
    else:
        console.say(f"safety filter: no intervention (ticks of {ticks})")
    dropped = sum(summary.servo.get("dropped", {}).values())
    if dropped:
        console.warn(f"{dropped} records were dropped on their way to the log")
    console.say(summary.delay_words())


def timing_table(summary: RunSummary) -> Table:
    """Return the table of everything that was timed in a run."""
    from pronk.deploy.runtime.records import REAL, VIRTUAL

    figures = {
        "servo tick late": summary.servo.get("lateness"),
        "age of the state at a tick": summary.servo.get("state_age"),
        "state to command": summary.servo.get("state_to_command"),
        "policy step late": summary.policy.get("lateness"),
        "policy's decision": summary.policy.get("decision"),
        "the network alone": summary.policy.get("network"),
    }
    rows = []
    for name, quantiles in figures.items():
        if quantiles and quantiles["n"]:
            row = (
                name,
                quantiles["n"],
                quantiles["p50_ms"],
                quantiles["p95_ms"],
                quantiles["p99_ms"],
                quantiles["p99_9_ms"],
                quantiles["max_ms"],
            )
            rows.append(row)
    robot = VIRTUAL if summary.servo.get("virtual") else REAL
    return Table(
        title=f"Deployment on {robot}",
        columns=(
            Column(heading="part"),
            Column(heading="n"),
            Column(heading="median", unit="ms"),
            Column(heading="95 %", unit="ms"),
            Column(heading="99 %", unit="ms"),
            Column(heading="99.9 %", unit="ms"),
            Column(heading="largest", unit="ms"),
        ),
        rows=tuple(rows),
    )
