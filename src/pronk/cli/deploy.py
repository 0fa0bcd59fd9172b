"""`pronk deploy`: a policy on a machine, virtual or real."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from pronk.cli import confirm, console
from pronk.cli.choices import Base, Link
from pronk.errors import HardwareError, PronkError

if TYPE_CHECKING:
    from pronk.policy.contract import Contract
    from pronk.runtime.ipc import Event
    from pronk.runtime.run import RunSummary
    from pronk.runtime.script import Script
    from pronk.runtime.teleop import Operator


_FAILED = 1
"""Exit status of a run that a fault ended."""
_INTERRUPTED = 130
"""Exit status of a run that somebody ended by the interrupt key or another signal."""


def deploy(
    policy: Annotated[Path, typer.Argument(help="policy.onnx, as `pronk train` writes it.")],
    link: Annotated[
        Link, typer.Option(help="sim: the virtual robot in this program; lcm, dds: by wire.")
    ] = Link.SIM,
    interface: Annotated[
        str | None,
        typer.Option(help="Network interface to a real robot; without it nothing leaves here."),
    ] = None,
    script: Annotated[
        str | None,
        typer.Option(help="Fly this unattended: paper, or a command such as 1,0,0."),
    ] = None,
    walk_only: Annotated[bool, typer.Option("--walk-only", help="A script without jumps.")] = False,
    gamepad: Annotated[
        Path | None, typer.Option(help="Gamepad, such as /dev/input/js0; a keyboard if left out.")
    ] = None,
    log: Annotated[Path | None, typer.Option(help="Log of everything, MCAP.")] = None,
    capture: Annotated[
        Path | None,
        typer.Option(help="What cameras around the virtual robot saw, .npz (--link sim)."),
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(help="Sit down after this time with the policy in charge.")
    ] = None,
    blend: Annotated[
        float, typer.Option(help="Time in which the policy takes over, in s; 0 as in training.")
    ] = 0.4,
    tilt: Annotated[float, typer.Option(help="Largest tilt of the trunk, in rad.")] = 0.8,
    base: Annotated[Base, typer.Option(help="Of the virtual robot.")] = Base.GROUND,
    sim_params: Annotated[
        Path | None,
        typer.Option(help="Parameters of the virtual robot, instead of the shipped one."),
    ] = None,
    seed: Annotated[int, typer.Option(help="Of the virtual robot's noise.")] = 0,
    layout: Annotated[str, typer.Option(help="Messages on LCM: cheetah or wtw.")] = "cheetah",
    port: Annotated[int | None, typer.Option(help="UDP port of LCM.")] = None,
    domain: Annotated[int | None, typer.Option(help="Domain of DDS.")] = None,
    release: Annotated[
        bool,
        typer.Option("--release", help="Make the robot's own controller let go of the joints."),
    ] = False,
    ignore_latency: Annotated[
        bool, typer.Option("--any-delay", help="Walk whatever delay is measured.")
    ] = False,
    real_time: Annotated[
        bool, typer.Option("--real-time/--no-real-time", help="Ask for real-time scheduling.")
    ] = True,
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not ask before real hardware moves.")
    ] = False,
    json_file: console.JsonOption = None,
) -> None:
    """Stand up, let the policy walk and jump, sit down; every command through the safety filter."""
    from pronk.policy.runtime import load_policy
    from pronk.runtime.link import Link as Opener
    from pronk.runtime.plan import Plan
    from pronk.runtime.run import run
    from pronk.runtime.trajectories import Timing

    contract = load_policy(policy).contract
    if capture is not None and (link is not Link.SIM or base is not Base.GROUND):
        raise HardwareError("--capture needs --link sim --base ground: no camera sees elsewhere.")
    plan = Plan(
        link=Opener(
            kind=link.value,
            robot=contract.robot,
            interface=interface,
            layout=layout,
            port=port,
            domain=domain,
            release=release,
            sim_params=sim_params,
            seed=seed,
            base=base.value,
        ),
        policy=policy,
        log=log,
        capture=capture,
        limits={"tilt": tilt},
        timing=Timing(blend_s=blend),
        ignore_latency=ignore_latency,
        real_time=real_time,
    )
    scripts = None if script is None else _scripts(script, contract, walk_only)
    if interface is not None and link is not Link.SIM and not yes:
        confirm.before_it_moves(contract.robot, f"{link.value} on {interface}")
    with _operator(contract, scripts, gamepad, seconds) as (operator, words):
        console.say(words)
        summary = run(plan, operator, _tell)
    _report(summary)
    lost = [notice.text for notice in summary.events_seen if notice.kind == "lost"]
    console.wrote(*(path for path in (log, None if lost else capture) if path is not None))
    console.write_json(json_file, summary.figures())
    console.following(
        f"pronk report {log}"
        if log is not None
        else f"pronk deploy {policy} --link {link.value} --log run.mcap   # keeps everything"
    )
    if summary.faults or summary.refusals or lost:
        raise typer.Exit(_FAILED)
    if summary.interrupted:
        raise typer.Exit(_INTERRUPTED)


@contextmanager
def _operator(
    contract: Contract,
    scripts: list[Script] | None,
    gamepad: Path | None,
    seconds: float | None,
) -> Iterator[tuple[Operator, str]]:
    """Who holds the stick, and what to tell them."""
    from pronk.runtime.teleop import HELP, PAD_HELP, Gamepad, Keyboard, ScriptedOperator, TimeLimit

    if scripts is not None:
        unattended = ScriptedOperator(scripts)
        what = f"unattended: {len(unattended.scripts)} scripts, {unattended.seconds:.0f} s."
        yield (unattended if seconds is None else TimeLimit(unattended, seconds)), what
        return
    held = (
        Keyboard(contract.command_ranges)
        if gamepad is None
        else Gamepad(gamepad, contract.command_ranges)
    )
    try:
        yield (
            (held if seconds is None else TimeLimit(held, seconds)),
            (HELP if gamepad is None else PAD_HELP),
        )
    finally:
        held.close()


def _scripts(text: str, contract: Contract, walk_only: bool) -> list[Script]:
    """What is asked for, unattended.

    Raises:
        PronkError: It is no command, or none that the policy was trained for.
    """
    from pronk.evaluation.protocol import parse_cases
    from pronk.runtime.script import Script

    cases = parse_cases([text])
    ranges = contract.command_ranges
    for case in cases:
        for value, (name, (low, high)) in zip(case.command, ranges.items(), strict=True):
            if not low <= value <= high:
                raise PronkError(
                    f"--script {text}: {name} {value:g} of {case.name!r} is none that the policy "
                    f"was trained for, {low:g} to {high:g}; ask for one of those."
                )
    jump_s = 0.5 if contract.jump and not walk_only else 0.0
    return [Script(command=case.command, jump_s=jump_s) for case in cases]


def _tell(notice: Event) -> None:
    """One line for each thing that happened."""
    line = f"{notice.kind}: {notice.text}"
    if notice.kind in ("fault", "refused", "notice", "lost"):
        console.warn(line)
    else:
        console.err().print(line, markup=False)


def _report(summary: RunSummary) -> None:
    """The figures of the run."""
    from pronk.runtime.ipc import REAL, VIRTUAL

    servo, policy = summary.servo, summary.policy
    robot = VIRTUAL if servo.get("virtual") else REAL
    made = console.table(
        f"Deployment on {robot}", "what [ms]", "n", "median", "95 %", "99 %", "99.9 %", "largest"
    )
    rows = (
        ("servo tick late", servo.get("lateness")),
        ("age of the state at a tick", servo.get("state_age")),
        ("state to command", servo.get("state_to_command")),
        ("policy step late", policy.get("lateness")),
        ("policy's decision", policy.get("decision")),
        ("the network alone", policy.get("network")),
    )
    keys = ("p50_ms", "p95_ms", "p99_ms", "p99_9_ms", "max_ms")
    for name, figures in rows:
        if figures and figures["n"]:
            cells = [console.number(figures[key], 3) for key in keys]
            console.row(made, name, str(figures["n"]), *cells)
    console.show(made)
    met = ", ".join(f"{name} {count}" for name, count in servo.get("interventions", {}).items())
    console.say(
        f"safety filter: {met or 'nothing to object to'} (ticks of {servo.get('ticks', 0)})"
    )
    dropped = sum(servo.get("dropped", {}).values())
    if dropped:
        console.warn(f"{dropped} records found no room on their way to the log")
    console.say(summary.delay_words())
