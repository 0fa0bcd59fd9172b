"""Recording of a robot under another program: whatever a listener hears goes into a file."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pronk.deploy.links.listener import HeardMessage, Listener
from pronk.errors import HardwareError
from pronk.identify.logs.recording import RecordingHeader, RecordingWriter
from pronk.identify.logs.sweep_writer import reason_of
from pronk.robots.machine import State

_PAUSE_S = 0.05
"""Longest wait for a message before time and interrupts are looked at [s]."""


@dataclass(frozen=True, kw_only=True)
class RecordingSummary:
    """What was recorded."""

    seconds: float
    """Time from the first message that was kept to the last [s]."""
    states: int
    """States."""
    commands: int
    """Commands."""
    longest_gap_s: float
    """Longest time between two states, as they arrived [s]."""


def record_passively(
    listener: Listener,
    path: Path,
    *,
    seconds: float | None,
    wait_s: float,
    stop: Callable[[], bool],
    metadata: dict[str, str],
    progress: Callable[[float], None],
) -> RecordingSummary:
    """Record what a listener hears. Nothing is sent.

    Args:
        listener: A listener that is not open yet; it is closed at the end.
        path: The file, which is made when the first state and the first command have come.
        seconds: Time to record, from when a state and a command have come [s]; None until `stop`.
        wait_s: Longest time to the first state and the first command [s].
        stop: Says whether to end.
        metadata: Named remarks for the file.
        progress: Called with the share of the time that has passed.

    Returns:
        What was recorded.

    Raises:
        HardwareError: No state or no command came; the message names the topic.
        KeyboardInterrupt: `stop` said to end before both had come; nothing was written.
    """
    listener.open()
    try:
        heard = _first_messages(listener, wait_s, stop)
        header = RecordingHeader(
            robot=listener.robot.name,
            joints=listener.robot.joint_names,
            virtual=listener.virtual,
            has_torque=listener.torque_kind != "absent",
            metadata={
                **metadata,
                "states": listener.state_topic,
                "commands": listener.command_topic,
                "torque": listener.torque_kind,
            },
        )
        writer = RecordingWriter(path, header)
        begun = time.monotonic()
        first = heard[0].arrived
        last = first
        last_state: float | None = None
        longest_gap_s = 0.0
        states = 0
        commands = 0
        try:
            while True:
                for message in heard:
                    write_message(writer, message)
                    last = message.arrived
                    if not isinstance(message.content, State):
                        commands += 1
                        continue
                    states += 1
                    if last_state is not None:
                        longest_gap_s = max(longest_gap_s, message.arrived - last_state)
                    last_state = message.arrived
                passed = time.monotonic() - begun
                if seconds is not None:
                    progress(min(passed / seconds, 1.0))
                if stop() or (seconds is not None and passed >= seconds):
                    break
                heard = listener.receive(_PAUSE_S)
        except BaseException as error:
            writer.end(complete=False, reason=reason_of(error))
            raise
        writer.end()
    finally:
        listener.close()
    return RecordingSummary(
        seconds=last - first, states=states, commands=commands, longest_gap_s=longest_gap_s
    )


def write_message(writer: RecordingWriter, message: HeardMessage) -> None:
    """Write a state or a command."""
    content = message.content
    if isinstance(content, State):
        writer.state(
            message.arrived, message.sent, content.position, content.velocity, content.torque
        )
        return
    writer.command(
        message.arrived,
        message.sent,
        (content.position, content.velocity),
        (content.stiffness, content.damping, content.torque),
    )


def _first_messages(
    listener: Listener, wait_s: float, stop: Callable[[], bool]
) -> list[HeardMessage]:
    """Wait for a state and a command; return all that came until both were there.

    Raises:
        HardwareError: One of them did not come.
        KeyboardInterrupt: `stop` said to end before.
    """
    heard: list[HeardMessage] = []
    until = time.monotonic() + wait_s
    while time.monotonic() < until:
        if stop():
            raise KeyboardInterrupt
        heard += listener.receive(_PAUSE_S)
        if listener.counts["states"] and listener.counts["commands"]:
            return heard
    missing = []
    if not listener.counts["states"]:
        missing.append(f"no state on {listener.state_topic}")
    if not listener.counts["commands"]:
        missing.append(f"no command on {listener.command_topic}")
    refused = ""
    if listener.last_refusal:
        refused = f"; what came was refused: {listener.last_refusal}"
    raise HardwareError(
        f"{' and '.join(missing)} within {wait_s:g} s, and nothing was written{refused}. Check "
        "that the robot and the program that commands it run, the link's options and the network."
    )
