"""`pronk simulate`: the virtual robot as a process, behind the messages of a real one."""

from __future__ import annotations

import math
import shlex
import time
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, Literal

import tyro

from pronk.cli import console
from pronk.cli.link_options import Base, Layout
from pronk.cli.options import check_seed
from pronk.errors import HardwareError

if TYPE_CHECKING:
    from pronk.deploy.bench.server import ServerTransport

_PRIORITY = 30
"""Priority of SCHED_FIFO, below that of the commanding process."""
_LATE_MS = 5.0
"""Lateness of one tick in a hundred above which the measured timing is not representative."""

_CAPTURE_RATE_HZ = 1000.0
"""Samples per second of a capture."""

_SERVERS = {
    "lcm": "pronk.deploy.bench.lcm_server:LcmServerTransport",
    "dds": "pronk.deploy.bench.dds_server:DdsServerTransport",
}


@dataclass(frozen=True, kw_only=True)
class WireOptions:
    """The wire, on which nothing leaves this computer."""

    link: Literal["lcm", "dds"] = "lcm"
    """The messages of a Mini Cheetah, or of a Unitree robot."""
    layout: Layout = "cheetah"
    """Messages on LCM: Cheetah-Software's, or walk-these-ways'."""
    port: int | None = None
    """UDP port on this computer (LCM); 7768 if left out."""
    domain: int | None = None
    """Domain on this computer (DDS); 77 if left out, never 0."""


@dataclass(frozen=True, kw_only=True)
class StandInOptions:
    """The virtual robot."""

    base: Base = "bench"
    """bench: the trunk is fixed; ground: it stands and moves freely."""
    sim_params: Path | None = None
    """Parameters of the virtual robot, instead of the shipped ones."""
    seed: int = 0
    """Seed of all noise and all faults."""
    mode: str = ""
    """The robot's own controller that holds the joints at first; released if left out. LCM:
    stand_up, balance_stand, locomotion, recovery_stand; DDS: normal, ai, advanced, mcf."""


@dataclass(frozen=True, kw_only=True)
class FaultOptions:
    """What goes wrong."""

    faults: str = ""
    """Faults with commas between them, as in loss=0.3,delay=5ms,after=2s; none if left out. Of
    messages: loss, duplicate, reorder, nan and flip as a share of them, delay and jitter as a time;
    of one direction with state. or command. before it. Of the machine: freeze=3s:0.5s,
    clock=5s:0.2s, rival=4s, sensor=9s:gyro-zero."""
    silence: Literal["hold", "zero", "damp"] = "hold"
    """What the drives do when commands stop."""
    silence_after: float = 0.1
    """Time without a command after which they do it, in s."""


@dataclass(frozen=True, kw_only=True)
class ServingOptions:
    """How long it runs, and what is kept."""

    duration: float | None = None
    """End after this time, in s; at Ctrl-C if left out."""
    capture: Path | None = None
    """Write what a motion-capture rig would measure to this .npz (--base ground); nothing if left
    out."""
    realtime: bool = False
    """Request real-time scheduling."""


def simulate(
    robot: tyro.conf.Positional[str] = "mini_cheetah",
    wire_options: WireOptions = WireOptions(),
    stand_in: StandInOptions = StandInOptions(),
    fault: FaultOptions = FaultOptions(),
    serving: ServingOptions = ServingOptions(),
) -> console.Outcome:
    """Run the virtual robot in real time, behind the messages of a real one.

    Nothing leaves this computer. It prints one line when it is ready, and runs until Ctrl-C.

    Example:
        pronk simulate mini_cheetah --link lcm --base bench --duration 60

    Args:
        robot: A name, or a path to a robot.yaml, MJCF or URDF.
        wire_options: The wire.
        stand_in: The virtual robot.
        fault: What goes wrong.
        serving: How long it runs, and what is kept.
    """
    from pronk.deploy.bench.faults import parse_faults
    from pronk.deploy.bench.server import RobotServer, Watchdog
    from pronk.deploy.links.address import Address
    from pronk.deploy.links.realtime import Interrupts, RealTimeSettings, enter
    from pronk.files import require_place
    from pronk.jump.virtual.capture import save_capture
    from pronk.jump.virtual.robot import VirtualRobot, hold_of
    from pronk.jump.virtual.sim_params import load_sim_params
    from pronk.robots import load_robot

    check_seed(stand_in.seed)
    link = wire_options.link
    base = stand_in.base
    seed = stand_in.seed
    capture = serving.capture
    duration = serving.duration
    if capture is not None and base != "ground":
        raise HardwareError("--capture needs --base ground: on the bench the trunk cannot move.")
    if duration is not None and not duration > 0.0:
        raise HardwareError(f"--duration {duration:g}; expected a time above 0 s.")
    if capture is not None:
        require_place(capture)
    robot_spec = load_robot(robot)
    link_faults = parse_faults(fault.faults)
    watchdog = Watchdog(silence=fault.silence, silence_after=fault.silence_after)
    lcm_layout = wire_options.layout if link == "lcm" else None
    address = Address.parse(
        link, layout=lcm_layout, port=wire_options.port, domain=wire_options.domain
    )
    machine = VirtualRobot(
        robot_spec,
        load_sim_params(stand_in.sim_params, robot_spec),
        seed=seed,
        base=base,
        capture_rate_hz=None if capture is None else _CAPTURE_RATE_HZ,
    )
    if serving.realtime:
        # Before the wire is open, so that its threads are scheduled alike.
        for line in enter(RealTimeSettings(priority=_PRIORITY, lock=False)):
            console.say(line)
    transport_class: Any = resolve_name(_SERVERS[link])
    wire: ServerTransport = transport_class(robot_spec, mode=stand_in.mode, **address.options)
    try:
        machine.connect()
        server = RobotServer(
            machine,
            wire,
            hold=hold_of(robot_spec),
            faults=link_faults,
            watchdog=watchdog,
            seed=seed,
        )
        console.say(
            f"ready: the virtual {robot_spec.name} on the {base}, seed {seed}, at {address}; "
            "Ctrl-C ends it"
        )
        end = time.monotonic() + (math.inf if duration is None else duration)
        with Interrupts() as interrupts:
            server.run(lambda: interrupts.received or time.monotonic() >= end)
        figures = server.figures()
        if capture is not None:
            save_capture(capture, machine.capture())
    finally:
        wire.close()
        machine.close()
    _report(figures)
    return console.Outcome(
        figures=figures,
        wrote=[capture] if capture else [],
        following=[
            f"pronk sweep {shlex.quote(robot)} --link {shlex.quote(str(address))} --out DIR   "
            "# while it runs"
        ],
    )


def _report(figures: dict[str, Any]) -> None:
    """Print counts and punctuality."""
    wire: dict[str, int] = figures["wire"]
    refused = 0
    for name, count in wire.items():
        if name.startswith("refused"):
            refused += count
    lateness = figures["lateness"]
    console.say(
        f"the virtual robot ran {figures['duration_s']:.1f} s: {wire.get('states', 0)} states, "
        f"{wire.get('commands', 0)} commands, {refused} messages refused; ticks late by "
        f"{lateness['p50_ms']:.2f} ms (median), {lateness['p99_ms']:.2f} ms (p99); "
        f"{100 * figures['cpu_share']:.0f} % of one core"
    )
    if lateness["p99_ms"] > _LATE_MS:
        console.warn(
            f"1 in 100 ticks was late by {lateness['p99_ms']:.0f} ms or more: this computer is too "
            "busy for timing measurements"
        )
    if figures["slipped_s"]:
        console.warn(
            f"this computer was too busy for real time: the robot stood still for "
            f"{figures['slipped_s']:.2f} s in {figures['server']['slips']} pieces"
        )
