"""`pronk record`: listen to a robot that another program commands, and write a log."""

from __future__ import annotations

import shlex
from pathlib import Path

import tyro

from pronk.cli import console
from pronk.cli.link_options import Layout
from pronk.errors import LogError, PronkError

_PRIORITY = 20
"""Priority of SCHED_FIFO: below the servo's and the virtual robot's, which must not wait."""


def record(
    robot: tyro.conf.Positional[str],
    link: str,
    out: Path = Path("recording.mcap"),
    seconds: float | None = None,
    wait: float = 10.0,
    interface: str | None = None,
    layout: Layout | None = None,
    port: int | None = None,
    domain: int | None = None,
    real_time: bool = True,
    overwrite: bool = False,
) -> console.Outcome:
    """Listen to states and commands under another program, and write a log that match reads.

    Nothing is sent and nothing moves. The log has the commands with their gains and torques as they
    were sent, and the states at their own rate. It ends after --seconds or by Ctrl-C.

    Example:
        pronk record go2 --link dds://eth0 --seconds 120 --out recording.mcap

    Args:
        robot: A name, or a path to a robot.yaml, MJCF or URDF.
        link: dds or lcm, by wire; or a URI such as dds://eth0, lcm://eth0?layout=wtw.
        out: The log to write, whose name ends in .mcap.
        seconds: Time to record in s; until Ctrl-C if left out.
        wait: Longest time to the first state and the first command in s.
        interface: Network interface to a real robot; without it this computer alone is heard.
        layout: Messages on LCM; cheetah if left out.
        port: UDP port of LCM.
        domain: Domain of DDS.
        real_time: Request real-time scheduling, below that of what commands.
        overwrite: Replace a log that exists.
    """
    from dataclasses import asdict

    from pronk.deploy.links.address import Address
    from pronk.deploy.links.listener import find_listener
    from pronk.deploy.links.realtime import Interrupts, RealTimeSettings, enter
    from pronk.deploy.runtime.recorder import record_passively
    from pronk.files import require_new, require_place
    from pronk.identify.logs.mcap_reader import read_mcap
    from pronk.identify.logs.options import ReadOptions
    from pronk.robots import load_robot

    if out.suffix != ".mcap":
        raise PronkError(f"--out {out}: expected a name that ends in .mcap.")
    require_new(out, "--out", overwrite=overwrite)
    for option, time_s in (("--seconds", seconds), ("--wait", wait)):
        if time_s is not None and not 0.0 < time_s < 1e6:
            raise PronkError(f"{option} {time_s:g}; expected a time above 0 s.")
    require_place(out)
    robot_spec = load_robot(robot)
    address = Address.parse(link, interface, layout=layout, port=port, domain=domain)
    listener = find_listener(address, robot_spec)
    if real_time:
        # Before the wire is open, so that its threads are scheduled alike.
        for line in enter(RealTimeSettings(priority=_PRIORITY, lock=False)):
            console.note(line)
    console.note(
        f"listening to {listener.state_topic} and {listener.command_topic}; nothing is sent, "
        "Ctrl-C ends it"
    )
    with console.progress() as report, Interrupts() as interrupts:
        summary = record_passively(
            listener,
            out,
            seconds=seconds,
            wait_s=wait,
            stop=lambda: interrupts.received,
            metadata={"link": str(address)},
            progress=report.bar("record"),
        )
    console.say(
        f"{summary.states} states and {summary.commands} commands in {summary.seconds:.1f} s of "
        f"{'the virtual robot' if listener.virtual else 'a robot that is not the virtual one'}; "
        f"longest gap {1e3 * summary.longest_gap_s:.0f} ms"
    )
    dropped = {}
    for reason, count in listener.counts.items():
        if reason not in ("states", "commands"):
            dropped[reason] = count
    if dropped:
        words = ", ".join(f"{count} {reason}" for reason, count in dropped.items())
        console.say(f"dropped: {words}")
    if len(listener.command_senders) > 1:
        console.warn(
            f"{len(listener.command_senders)} programs sent commands; the robot follows the last "
            "one that comes, and so does the log."
        )
    figures = {
        **asdict(summary),
        "link": str(address),
        "virtual": listener.virtual,
        "dropped": dropped,
        "command_senders": len(listener.command_senders),
    }
    following = []
    try:
        log = read_mcap(out, robot_spec, ReadOptions()).segmented()
    except LogError as error:
        # The recording is whole, and may be read in another way.
        console.warn(f"match cannot use it: {error}")
    else:
        for remark in log.notes:
            console.say(f"note: {remark}")
        excited = log.excited_joints
        console.say(f"excited: {', '.join(excited) or 'no joint'}")
        figures["excited"] = excited
        if excited:
            quoted = shlex.quote(str(out))
            following = [f"pronk match {quoted} --robot {shlex.quote(robot)} --out gains.yaml"]
    return console.Outcome(figures=figures, wrote=[out], following=following)
