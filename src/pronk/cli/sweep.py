"""`pronk sweep`: plan, check, ask, record."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pronk.cli import confirm, console, sweep_wire
from pronk.cli.choices import Layout, Link
from pronk.cli.sweep_virtual import record_virtual as record_virtual
from pronk.errors import HardwareError

if TYPE_CHECKING:
    from pronk.excitation.plan import SweepPlan
    from pronk.excitation.signals import Signal
    from pronk.robots.robot import Robot


class SignalName(StrEnum):
    """What can be asked."""

    CHIRP = "chirp"
    LOG_CHIRP = "log-chirp"
    MULTISINE = "multisine"
    SINE_STEPS = "sine-steps"


AMPLITUDES = (0.25, 0.125)
"""The paper's amplitude (F3) and half of it, so that friction shows [rad]."""


def sweep(
    robot: Annotated[str, typer.Argument(help="Robot, for instance mini_cheetah.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the logs, one MCAP per joint.")],
    link: Annotated[
        Link, typer.Option(help="sim: the virtual robot in this program; lcm, dds: by wire.")
    ] = Link.SIM,
    interface: Annotated[
        str | None,
        typer.Option(help="Network interface to a real robot; without it nothing leaves here."),
    ] = None,
    layout: Annotated[
        Layout | None, typer.Option(help="Messages on LCM; cheetah if left out.")
    ] = None,
    port: Annotated[int | None, typer.Option(help="UDP port of LCM.")] = None,
    domain: Annotated[int | None, typer.Option(help="Domain of DDS.")] = None,
    release: Annotated[
        bool,
        typer.Option("--release", help="Make the robot's own controller let go of the joints."),
    ] = False,
    real_time: Annotated[
        bool,
        typer.Option("--real-time/--no-real-time", help="Ask for real-time scheduling (by wire)."),
    ] = True,
    sim_params: Annotated[
        Path | None,
        typer.Option(help="Parameters of the virtual robot, instead of the shipped one."),
    ] = None,
    joints: Annotated[
        list[str] | None,
        typer.Option("--joints", help="Joints to ask; repeat it. All if left out."),
    ] = None,
    signal: Annotated[SignalName, typer.Option(help="What to ask.")] = SignalName.CHIRP,
    amplitude: Annotated[
        list[float] | None, typer.Option(help="Peak of the command in rad; repeat it for several.")
    ] = None,
    repeats: Annotated[int, typer.Option(help="Times each amplitude is asked.")] = 3,
    seed: Annotated[int, typer.Option(help="Of the virtual robot's noise.")] = 0,
    plan_only: Annotated[
        bool, typer.Option("--plan-only", help="Show what it would do to the robot and leave.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace logs that are already there.")
    ] = False,
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not ask before real hardware moves.")
    ] = False,
    json_file: console.JsonOption = None,
) -> None:
    """Ask every joint: plan, check against the limits, ask, record."""
    from pronk.robots import load_robot

    machine = load_robot(robot)
    address = None
    if link is Link.SIM:
        sweep_wire.refuse_without_wire(
            interface=interface, layout=layout, port=port, domain=domain, release=release
        )
    else:
        from pronk.links.open import Address

        if sim_params is not None:
            raise HardwareError(
                "--sim-params is of --link sim; give it to `pronk simulate` instead."
            )
        address = Address(
            kind=link.value,
            interface=interface,
            layout=layout and layout.value,
            port=port,
            domain=domain,
        )
    names = [part for entry in joints or () for part in entry.split(",") if part]
    with console.progress() as report:
        report("forecast", 0.0)
        plan = make(machine, names or None, signal, tuple(amplitude or AMPLITUDES), repeats)
        report("forecast", 1.0)
    show_plan(plan)
    plan.check()
    figures: dict[str, Any] = {
        "robot": machine.name,
        "link": str(address or "sim"),
        "duration_s": plan.duration_s,
        "plan": plan.rows(),
        "logs": [],
    } | ({"virtual": True} if address is None else {})
    if plan_only:
        console.write_json(json_file, figures)
        console.say("next: the same command without --plan-only")
        return
    if address is None:
        with console.progress() as report:
            paths = record_virtual(
                machine,
                plan,
                out,
                sim_params=sim_params,
                seed=seed,
                overwrite=overwrite,
                progress=report.bar("ask the virtual robot"),
            )
        figures["logs"] = paths
        console.say(f"wrote {len(paths)} logs of the virtual robot to {out}")
    else:
        if not address.local and not yes:
            confirm.before_it_moves(machine.name, str(address))
        with console.progress() as report:
            recorded = sweep_wire.record_wire(
                machine,
                plan,
                out,
                address,
                release=release,
                overwrite=overwrite,
                real_time=real_time,
                progress=report.bar(f"ask over {link.value}"),
            )
        figures |= {
            "virtual": recorded.virtual,
            "logs": recorded.logs,
            "servo": recorded.servo,
        }
        sweep_wire.tell(recorded, out)
    console.write_json(json_file, figures)
    console.following(
        f"pronk response {out}",
        f"pronk match {out} --robot {robot} --out {out}/gains.yaml",
    )


def make_signal(name: SignalName) -> Signal:
    """The signal of that name with its usual settings."""
    from pronk.excitation import signals

    kinds = {
        SignalName.CHIRP: signals.Chirp,
        SignalName.LOG_CHIRP: signals.LogChirp,
        SignalName.MULTISINE: signals.Multisine,
        SignalName.SINE_STEPS: signals.SineSteps,
    }
    made: Signal = kinds[name]()
    return made


def make(
    robot: Robot,
    joints: Sequence[str] | None,
    signal: SignalName,
    amplitudes: Sequence[float],
    repeats: int | Sequence[int],
) -> SweepPlan:
    """The plan of a sweep, one joint after another."""
    from pronk.excitation.plan import make_plan

    return make_plan(robot, joints, make_signal(signal), amplitudes=amplitudes, repeats=repeats)


def show_plan(plan: SweepPlan) -> None:
    """Print what the sweep will do to each joint, against its limits."""
    made = console.table(
        f"Plan: {len(plan.asks)} questions, {plan.duration_s:.0f} s of the robot's time; "
        "worst case over what is uncertain",
        "joint",
        "amplitude [rad]",
        "position [rad]",
        "of",
        "speed [rad/s]",
        "of",
        "torque [N m]",
        "of",
        "power [W]",
        "bus [A]",
    )
    for row in plan.rows():
        low, high = float(row["lowest_rad"]), float(row["highest_rad"])
        console.row(
            made,
            str(row["joint"]),
            f"{row['amplitude_rad']:g}",
            f"{low:.2f} to {high:.2f}",
            f"{float(row['range_low_rad']):.2f} to {float(row['range_high_rad']):.2f}",
            f"{float(row['speed_rad_s']):.1f}",
            f"{float(row['no_load_speed_rad_s']):.1f}",
            f"{float(row['torque_nm']):.1f}",
            f"{float(row['effort_limit_nm']):.1f}",
            f"{float(row['electrical_power_w']):.0f}",
            f"{float(row['bus_current_a']):.1f}",
        )
    console.show(made)
    for warning in plan.warnings:
        console.warn(warning)
