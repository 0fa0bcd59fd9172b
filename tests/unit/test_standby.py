"""The standby process at a wire that fails for a while."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from multiprocessing import get_context
from multiprocessing.connection import Connection
from types import SimpleNamespace
from typing import Any

import numpy as np

from pronk.deploy.links.link import NetworkLink
from pronk.deploy.links.writer import Encode, Publish
from pronk.deploy.runtime.memory import Shared
from pronk.deploy.runtime.modes import Mode
from pronk.deploy.runtime.records import state_dtype
from pronk.deploy.runtime.standby import serve_standby
from virtual_robot import ROBOT


class CutWire(NetworkLink):
    """A wire whose cable is out for the first messages."""

    def __init__(self, log: Connection) -> None:
        super().__init__(ROBOT)
        self.log = log

    def open_damper(self) -> Callable[[], None]:
        tries: Counter[str] = Counter()

        def damp() -> None:
            tries["damp"] += 1
            if tries["damp"] <= 5:
                raise OSError(101, "Network is unreachable")
            self.log.send_bytes(b"damped")

        return damp

    def _open(self) -> tuple[Encode, Publish]:
        raise NotImplementedError

    def _receive(self) -> None:
        raise NotImplementedError

    def _shut(self) -> None:
        raise NotImplementedError


def test_a_cable_that_is_out_for_a_moment_does_not_end_the_damping() -> None:
    context = get_context("fork")
    heard, log = context.Pipe(duplex=False)
    ready, end = context.Pipe(duplex=False)
    plan: Any = SimpleNamespace(
        link=lambda: CutWire(log), robot=ROBOT, real_time=False, silence_s=0.04
    )
    shared = Shared(joints=12)
    record = np.zeros((), dtype=state_dtype(12))
    record["mode"] = Mode.POLICY
    record["now"] = time.monotonic() - 1.0  # a servo that was killed a second ago
    shared.state.write(record)
    process = context.Process(target=serve_standby, args=(plan, shared.name, end))
    process.start()
    try:
        assert ready.poll(20.0)
        assert heard.poll(20.0), process.exitcode
        assert shared.standby.written == 1
        assert process.is_alive()
    finally:
        process.terminate()
        process.join(10.0)
        assert process.exitcode == 0
        shared.close()
