"""Recording of another program's commands: for how long, and how it ends."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pronk.deploy.links.listener import HeardMessage, Listener, WireCommand
from pronk.deploy.runtime.recorder import RecordingSummary, record_passively
from pronk.errors import HardwareError
from virtual_robot import KD, KP, POSE, ROBOT, still

_PERIOD_S = 0.005
"""Time between two messages [s]."""


class LateCommands(Listener):
    """States from the begin, and commands of a program that is started later."""

    state_topic = "states"
    command_topic = "commands"

    def __init__(self, late_s: float) -> None:
        super().__init__(ROBOT)
        self.late_s = late_s
        self.is_open = False

    def open(self) -> None:
        self.is_open = True
        self._begun = time.monotonic()

    def receive(self, timeout_s: float) -> list[HeardMessage]:
        time.sleep(_PERIOD_S)
        now = time.monotonic()
        heard = [HeardMessage(arrived=now, sent=now, content=still(time=now))]
        self.counts["states"] += 1
        if now - self._begun > self.late_s:
            zeros = np.zeros(12)
            command = WireCommand(
                position=POSE, velocity=zeros, stiffness=KP, damping=KD, torque=zeros
            )
            heard.append(HeardMessage(arrived=now, sent=now, content=command))
            self.counts["commands"] += 1
        return heard

    def close(self) -> None:
        self.is_open = False


def recorded(
    listener: Listener, path: Path, stop: Callable[[], bool] = lambda: False, wait_s: float = 30.0
) -> RecordingSummary:
    return record_passively(
        listener,
        path,
        seconds=0.5,
        wait_s=wait_s,
        stop=stop,
        metadata={},
        progress=lambda share: None,
    )


def test_the_time_counts_from_the_first_command(tmp_path: Path) -> None:
    listener = LateCommands(late_s=1.0)
    summary = recorded(listener, tmp_path / "recording.mcap")
    # The states before the first command are kept beside the half second that was asked for.
    assert summary.seconds >= 1.4
    assert summary.commands > 10
    assert not listener.is_open


def test_an_interrupt_before_the_first_command_is_no_missing_robot(tmp_path: Path) -> None:
    listener = LateCommands(late_s=60.0)
    end = time.monotonic() + 0.2
    with pytest.raises(KeyboardInterrupt):
        recorded(listener, tmp_path / "recording.mcap", lambda: time.monotonic() > end)
    assert not listener.is_open
    with pytest.raises(HardwareError, match="no command on commands within"):
        recorded(listener, tmp_path / "recording.mcap", wait_s=0.2)
    assert not list(tmp_path.iterdir())
