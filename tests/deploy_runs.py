"""What the live tests of processes share: quick times, patience, an operator, `pronk simulate`."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pronk.deploy.links.link import Freshness
from pronk.deploy.runtime.limits import AgeLimits
from pronk.deploy.runtime.modes import Mode, OperatorRequest
from pronk.deploy.runtime.poses import RunTiming
from pronk.deploy.runtime.reasons import Reason
from pronk.deploy.runtime.run import Deployment
from pronk.deploy.runtime.teleop import OperatorCommand

QUICK = RunTiming(
    damp_s=0.05, fold_s=0.3, check_s=0.0, rise_s=0.3, ramp_s=0.1, blend_s=0.1, halt_s=0.1, sit_s=0.3
)
LATE = (Reason.NO_STATE, Reason.STATE_LOST, Reason.EXPIRED, Reason.LAG, Reason.HELD, Reason.ENDED)
"""Reasons of a process that the operating system stops for a moment."""
PATIENT = AgeLimits(held_s=100.0, damp_s=2.0, latch_s=4.0, expiry_s=2.0, lag=2000.0)
"""A busy computer must not look like a fault."""
FRESH = Freshness(share=0.02, longest_gap_s=10.0)
"""Nor like a link that is slow to open."""
DAMPED_S = 0.060
"""Longest time from a fault to damping on the wire."""


def met(
    deployment: Deployment,
    seconds: float,
    modes: tuple[Mode, ...],
    *requests: OperatorRequest,
    **inputs: Any,
) -> bool:
    """Hold the dead-man button until one of some modes comes, or for a time; whether it came."""
    waiting = list(requests)
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        request = waiting.pop(0) if waiting else OperatorRequest.NONE
        deployment.write(OperatorCommand(request=request, dead_man=True, **inputs))
        if deployment.mode in modes:
            return True
        time.sleep(0.01)
    return False


def hold(
    deployment: Deployment,
    seconds: float,
    mode: Mode | None = None,
    *requests: OperatorRequest,
    **inputs: Any,
) -> None:
    """Hold the dead-man button until a mode comes, or for a time."""
    if mode is None:
        met(deployment, seconds, (), *requests, **inputs)
        return
    came = met(deployment, seconds, (mode,), *requests, **inputs)
    assert came, f"{mode.name} did not come: {notified(deployment)}"


def notified(deployment: Deployment) -> str:
    deployment.events_seen()
    return f"{deployment.mode.name}, {[notice.text for notice in deployment.summary.events_seen]}"


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])


@contextmanager
def simulated(*words: str) -> Iterator[None]:
    """A `pronk simulate` process that is ready."""
    running = subprocess.Popen(
        [sys.executable, "-m", "pronk.cli.main", "simulate", *words],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    assert running.stdout is not None
    try:
        assert any(line.startswith("ready: the virtual ") for line in running.stdout)
        yield
    finally:
        running.kill()
        running.communicate()
