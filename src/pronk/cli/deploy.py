"""`pronk deploy`: a policy on a machine, virtual or real."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from pronk.cli import console
from pronk.cli.options import Base, Layout
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
    policy: tyro.conf.Positional[Path],
    link: str = "sim",
    interface: str | None = None,
    script: str | None = None,
    walk_only: bool = False,
    gamepad: Path | None = None,
    log: Path | None = None,
    capture: Path | None = None,
    seconds: float | None = None,
    blend: Annotated[float, tyro.conf.arg(name="blend-time-s")] = 0.4,
    tilt: float = 0.8,
    base: Base | None = None,
    sim_params: Path | None = None,
    seed: int = 0,
    layout: Layout | None = None,
    port: int | None = None,
    domain: int | None = None,
    release: Annotated[bool, tyro.conf.arg(name="disable-onboard-controller")] = False,
    ignore_latency: Annotated[bool, tyro.conf.arg(name="ignore-latency-check")] = False,
    real_time: bool = True,
    yes: bool = False,
    json_file: console.JsonFile = None,
) -> int:
    """Stand up, let the policy walk and jump, sit down; every command through the safety filter.

    Args:
        policy: policy.onnx, as `pronk train` writes it.
        link: sim, the virtual robot in this program; lcm or dds, by wire; or a URI such as
            dds://eth0, lcm://eth0?layout=wtw, sim://ground.
        interface: Network interface to a real robot; without it nothing leaves here.
        script: Fly this unattended: paper, or a command such as 1,0,0.
        walk_only: A script without jumps.
        gamepad: Gamepad, such as /dev/input/js0; a keyboard if left out.
        log: Log of everything, MCAP.
        capture: What cameras around the virtual robot saw, .npz (--link sim).
        seconds: Sit down after this time with the policy in charge.
        blend: Time in which the policy takes over, in s; 0 as in training.
        tilt: Largest tilt of the trunk, in rad.
        base: Of the virtual robot; the ground if left out.
        sim_params: Parameters of the virtual robot, instead of the shipped one.
        seed: Of the virtual robot's noise.
        layout: Messages on LCM; cheetah if left out.
        port: UDP port of LCM.
        domain: Domain of DDS.
        release: Make the robot's own controller let go of the joints.
        ignore_latency: Start the policy even if the measured latency exceeds its training range.
        real_time: Ask for real-time scheduling.
        yes: Do not ask before real hardware moves.
        json_file: Also write the figures to this file.
    """
    from pronk.links.address import SIM, Address
    from pronk.policy.runtime import load_policy
    from pronk.runtime.plan import Link as Opener
    from pronk.runtime.plan import Plan
    from pronk.runtime.run import run
    from pronk.runtime.state_machine import Timing

    contract = load_policy(policy).contract
    if link.partition(":")[0] == SIM:
        params = None if sim_params is None else str(sim_params)
        address = Address.parse(link, base, seed=seed or None, params=params)
    else:
        address = Address.parse(link, interface, layout=layout, port=port, domain=domain)
    if capture is not None and (address.kind != SIM or address.interface == "bench"):
        raise HardwareError("--capture needs --link sim --base ground: no camera sees elsewhere.")
    plan = Plan(
        link=Opener(robot=contract.robot, address=address, release=release),
        policy=policy,
        log=log,
        capture=capture,
        limits={"tilt": tilt},
        timing=Timing(blend_s=blend),
        ignore_latency=ignore_latency,
        real_time=real_time,
    )
    scripts = None if script is None else _scripts(script, contract, walk_only)
    if not address.local and not yes:
        console.confirm(contract.robot, str(address))
    operator, words = _operator(contract, scripts, gamepad, seconds)
    with closing(operator):
        console.say(words)
        summary = run(plan, operator, _tell)
    _report(summary)
    lost = [notice.text for notice in summary.events_seen if notice.kind == "lost"]
    console.wrote(*(path for path in (log, None if lost else capture) if path is not None))
    console.write_json(json_file, summary.figures())
    console.following(
        f"pronk report {log}"
        if log is not None
        else f"pronk deploy {policy} --link {link} --log run.mcap   # keeps everything"
    )
    if summary.faults or summary.refusals or lost:
        return _FAILED
    if summary.interrupted:
        return _INTERRUPTED
    return 0


def _operator(
    contract: Contract,
    scripts: list[Script] | None,
    gamepad: Path | None,
    seconds: float | None,
) -> tuple[Operator, str]:
    """The operator of the run, and its help."""
    from pronk.runtime.teleop import HELP, PAD_HELP, Gamepad, Keyboard, ScriptedOperator, TimeLimit

    operator: Operator
    if scripts is not None:
        operator = scripted = ScriptedOperator(scripts)
        words = f"unattended: {len(scripts)} scripts, {scripted.seconds:.0f} s."
    elif gamepad is not None:
        operator, words = Gamepad(gamepad, contract.command_ranges), PAD_HELP
    else:
        operator, words = Keyboard(contract.command_ranges), HELP
    return (operator if seconds is None else TimeLimit(operator, seconds)), words


def _scripts(text: str, contract: Contract, walk_only: bool) -> list[Script]:
    """The commands of an unattended run.

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
