"""`pronk deploy`: a policy on a machine, virtual or real."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from pronk.cli import console
from pronk.cli.options import Base, LinkOptions
from pronk.deploy.runtime.safety import Limits
from pronk.deploy.runtime.state_machine import Timing
from pronk.errors import HardwareError, PronkError

if TYPE_CHECKING:
    from pronk.deploy.runtime.ipc import Event
    from pronk.deploy.runtime.run import RunSummary
    from pronk.deploy.runtime.teleop import Operator
    from pronk.policy.contract import Contract
    from pronk.policy.script import Script


def deploy(
    policy: tyro.conf.Positional[Path],
    robot: str | None = None,
    machine: LinkOptions = LinkOptions(),  # noqa: B008
    base: Base | None = None,
    script: str | None = None,
    walk_only: bool = False,
    gamepad: Path | None = None,
    log: Path | None = None,
    capture: Path | None = None,
    seconds: float | None = None,
    blend: Annotated[float, tyro.conf.arg(name="blend-time-s")] = Timing.blend_s,
    tilt: float = Limits.tilt,
    ignore_latency: Annotated[bool, tyro.conf.arg(name="ignore-latency-check")] = False,
) -> console.Outcome:
    """Stand up, let the policy walk and jump, sit down; every command through the safety filter.

    Args:
        policy: policy.onnx, as `pronk train` writes it.
        robot: A name, or a path to a robot.yaml, MJCF or URDF; the policy's if left out.
        machine: The machine.
        base: Of the virtual robot; the ground if left out.
        script: Run this unattended: paper, or a command such as 1,0,0.
        walk_only: A script without jumps.
        gamepad: Gamepad, such as /dev/input/js0; a keyboard if left out.
        log: Log of everything, MCAP.
        capture: What cameras around the virtual robot would measure, .npz (--link sim).
        seconds: Sit down after this time with the policy in charge.
        blend: Time in which the policy takes over, in s; 0 as in training.
        tilt: Largest tilt of the trunk, in rad.
        ignore_latency: Start the policy even if the measured latency exceeds its training range.
    """
    from pronk.deploy.bench.paced import CaptureRecorder
    from pronk.deploy.links.address import SIM
    from pronk.deploy.runtime.plan import Link, Plan
    from pronk.deploy.runtime.run import run
    from pronk.deploy.runtime.teleop import (
        HELP,
        PAD_HELP,
        Gamepad,
        Keyboard,
        ScriptedOperator,
        TimeLimit,
    )
    from pronk.policy.runtime import load_policy

    contract = load_policy(policy).contract
    address = machine.address(base)
    if capture is not None and (address.kind != SIM or address.interface == "bench"):
        raise HardwareError("--capture needs --link sim --base ground: no camera sees elsewhere.")
    plan = Plan(
        link=Link(robot=robot or contract.robot, address=address, release=machine.release),
        policy=policy,
        log=log,
        recorder=None if capture is None else CaptureRecorder(path=capture),
        limits={"tilt": tilt},
        timing=Timing(blend_s=blend),
        ignore_latency=ignore_latency,
        real_time=machine.real_time,
    )
    scripts = None if script is None else _scripts(script, contract, walk_only)
    if not (address.local or machine.yes):
        console.confirm(contract.robot, str(address))
    operator: Operator
    if scripts is not None:
        operator = scripted = ScriptedOperator(scripts)
        words = f"unattended: {len(scripts)} scripts, {scripted.seconds:.0f} s."
        seconds = scripted.seconds if seconds is None else min(seconds, scripted.seconds)
    elif gamepad is not None:
        operator, words = Gamepad(gamepad, contract.command_ranges), PAD_HELP
    else:
        operator, words = Keyboard(contract.command_ranges), HELP
    with closing(operator if seconds is None else TimeLimit(operator, seconds)) as limited:
        console.say(words)
        summary = run(plan, limited, _notify)
    _report(summary)
    lost = any(event.kind == "lost" for event in summary.events_seen)
    again = f"pronk deploy {policy} --link {machine.link} --log run.mcap   # keeps everything"
    if summary.log_error:
        console.warn(f"{summary.log_error}.")
    failed = bool(summary.faults or summary.refusals or lost or summary.log_error)
    whole = None if summary.log_error else log
    return console.Outcome(
        figures=summary.figures(),
        wrote=[path for path in (whole, None if lost else capture) if path is not None],
        following=[again if log is None else f"pronk report {log}"],
        status=1 if failed else 130 if summary.interrupted else 0,
    )


def _scripts(text: str, contract: Contract, walk_only: bool) -> list[Script]:
    """The commands of an unattended run, those that the policy was trained for."""
    from pronk.jump.trial.protocol import parse_cases
    from pronk.policy.script import Script

    cases = parse_cases([text])
    ranges = contract.command_ranges
    for case in cases:
        for value, (name, (low, high)) in zip(case.command, ranges.items(), strict=True):
            if not low <= value <= high:
                raise PronkError(
                    f"--script {text}: {name} {value:g} of {case.name!r} is outside of the "
                    f"range that the policy was trained for, {low:g} to {high:g}."
                )
    jump_s = 0.5 if contract.jump and not walk_only else 0.0
    return [Script(command=case.command, jump_s=jump_s) for case in cases]


def _notify(event: Event) -> None:
    """Print one line for an event."""
    bad = event.kind in ("fault", "refused", "notice", "lost")
    (console.warn if bad else console.note)(f"{event.kind}: {event.text}")


def _report(summary: RunSummary) -> None:
    """Print the figures of the run."""
    from pronk.deploy.runtime.ipc import REAL, VIRTUAL

    servo, policy = summary.servo, summary.policy
    times = {
        "servo tick late": servo.get("lateness"),
        "age of the state at a tick": servo.get("state_age"),
        "state to command": servo.get("state_to_command"),
        "policy step late": policy.get("lateness"),
        "policy's decision": policy.get("decision"),
        "the network alone": policy.get("network"),
    }
    keys = ("n", "p50_ms", "p95_ms", "p99_ms", "p99_9_ms", "max_ms")
    rows = [(name, *(one[key] for key in keys)) for name, one in times.items() if one and one["n"]]
    columns = "what [ms] | n | median | 95 % | 99 % | 99.9 % | largest"
    title = f"Deployment on {VIRTUAL if servo.get('virtual') else REAL}"
    console.show_table(columns, rows, title=title)
    met = ", ".join(f"{name} {count}" for name, count in servo.get("interventions", {}).items())
    console.say(f"safety filter: {met or 'no intervention'} (ticks of {servo.get('ticks', 0)})")
    if dropped := sum(servo.get("dropped", {}).values()):
        console.warn(f"{dropped} records were dropped on their way to the log")
    console.say(summary.delay_words())
