"""What a terminal does to a deployment that runs in front of it: the joints are damped, always."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hopper import write_hopper
from pronk.deploy.runtime.deploy_log import DeployLog, read_deploy_log
from pronk.deploy.runtime.modes import Mode

pytest.importorskip("onnxruntime")

PROGRAM = Path(__file__).parent.parent / "deploy_alone.py"
DAMPED_S = 0.9
"""A fault and an end damp for a second; what comes after the last tick is not in the log."""


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_hopper(tmp_path_factory.mktemp("policy") / "policy.onnx", strength=0.2)


class Flight:
    """A deployment by a script, leader of a terminal's processes."""

    def __init__(self, process: subprocess.Popen[str], log: Path) -> None:
        self.process = process
        self.log = log

    def says(self, word: str) -> None:
        assert self.process.stdout is not None
        received = []
        for line in self.process.stdout:
            received.append(line.strip())
            if received[-1] == word:
                return
        pytest.fail(f"{word} was not printed: {received}")

    def signal(self, number: signal.Signals) -> None:
        """As a terminal does: to every process in front of it."""
        os.killpg(self.process.pid, number)

    def ended(self) -> tuple[int, DeployLog]:
        self.process.communicate(timeout=60)
        return self.process.returncode, read_deploy_log(self.log)


@contextmanager
def flown(policy: Path, log: Path) -> Iterator[Flight]:
    words = [sys.executable, str(PROGRAM), str(policy), str(log)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
    with subprocess.Popen(words, **pipes, start_new_session=True, env=environment) as process:
        flight = Flight(process, log)
        try:
            flight.says("POLICY")
            time.sleep(0.3)
            yield flight
        finally:
            process.kill()


def course(log: DeployLog) -> list[Mode]:
    """The modes from where the policy took over."""
    modes = [Mode(mode) for mode, _ in itertools.groupby(log.ticks.mode.tolist())]
    return modes[modes.index(Mode.POLICY) :]


def damped_at_the_end(log: DeployLog) -> float:
    """How long the joints were damped without a break before the log ended [s]."""
    free = np.flatnonzero(~log.ticks.damped)
    return float(log.ticks.begun[-1] - log.ticks.begun[free[-1]])


def test_a_lost_connection_and_impatient_keys_damp_and_keep_the_log(
    policy: Path, tmp_path: Path
) -> None:
    with flown(policy, tmp_path / "run.mcap") as flight:
        flight.signal(signal.SIGHUP)
        # Repeated Ctrl-C does not interrupt the end.
        for number in (signal.SIGINT, signal.SIGQUIT, signal.SIGINT, signal.SIGTERM, signal.SIGINT):
            time.sleep(0.2)
            flight.signal(number)
        status, log = flight.ended()
    assert status == 130
    assert log.complete
    assert course(log) == [Mode.POLICY, Mode.DAMP]
    assert damped_at_the_end(log) >= DAMPED_S
    assert log.figures["interrupted"] is True
    assert log.figures["faults"] == []


def test_a_stopped_program_damps_and_can_be_ended_later(policy: Path, tmp_path: Path) -> None:
    with flown(policy, tmp_path / "run.mcap") as flight:
        # As Ctrl-Z does in a shell's terminal.
        stopped = time.monotonic()
        flight.signal(signal.SIGSTOP)
        time.sleep(1.0)
        continued = time.monotonic()
        flight.signal(signal.SIGCONT)
        flight.says("FAULT")
        status, log = flight.ended()
    assert status == 0
    assert log.complete
    assert course(log) == [Mode.POLICY, Mode.FAULT]
    assert damped_at_the_end(log) >= DAMPED_S
    # It did not wait for the program to go on.
    (fault,) = [event for event in log.events if event.kind == "fault"]
    assert fault.reason == "ENDED"
    assert stopped < fault.time < continued


def test_a_killed_program_damps_and_the_log_holds_it(policy: Path, tmp_path: Path) -> None:
    with flown(policy, tmp_path / "run.mcap") as flight:
        flight.process.kill()
        killed = time.monotonic()
        until = killed + 20.0
        while time.monotonic() < until:
            log = read_deploy_log(flight.log)
            if "ENDED" in [event.text for event in log.events]:
                break
            time.sleep(0.1)
    assert not log.complete
    assert log.figures == {}
    # A released dead-man button is found as well.
    assert course(log) in ([Mode.POLICY, Mode.DAMP], [Mode.POLICY, Mode.DAMP, Mode.FAULT])
    assert damped_at_the_end(log) >= DAMPED_S
    texts = [event.text for event in log.events]
    assert "the operator's program has ended" in texts
    assert log.ticks.begun[log.ticks.damped & (log.ticks.begun > killed - 0.5)][0] - killed < 0.5
