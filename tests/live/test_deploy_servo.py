"""The servo's loop on the virtual robot, in a thread here: links that open badly or break."""

from __future__ import annotations

import gc
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deploy_faults import FaultyLink
from deploy_runs import PATIENT
from pronk.deploy.links.address import Address
from pronk.deploy.runtime.memory import Shared
from pronk.deploy.runtime.modes import Mode, OperatorRequest
from pronk.deploy.runtime.plan import Link, RunPlan
from pronk.deploy.runtime.poses import RunTiming
from pronk.deploy.runtime.records import ACTIONS, OPERATOR, REQUEST, TICK, Event
from pronk.deploy.runtime.servo import Servo
from pronk.errors import HardwareError
from virtual_robot import POSE

QUICK = RunTiming(damp_s=0.05, fold_s=0.1, check_s=0.0, rise_s=0.1, ramp_s=0.1, sit_s=0.1)
WAITING = replace(PATIENT, hold_s=1.0)
"""On a busy computer the newest state may be old when the pre-flight checks end."""
NOWHERE = Path("policy.onnx")
"""The servo knows nothing of the policy but its actions."""


@pytest.fixture
def link(tmp_path: Path) -> FaultyLink:
    events = {name: threading.Event() for name in ("freeze", "broken")}
    return FaultyLink(wire=tmp_path / "wire.txt", faults=events)


class Run:
    """A servo in a thread, and the operator's end of it."""

    def __init__(self, plan: RunPlan, shared: Shared) -> None:
        self.servo = Servo(plan, shared, (0.0, 1.0))
        self.shared = shared
        self.said: list[tuple[str, str]] = []
        self._record = np.zeros((), dtype=OPERATOR)
        self._thread = threading.Thread(target=self.servo.run)
        self._thread.start()

    @property
    def over(self) -> bool:
        return not self._thread.is_alive()

    def until(self, condition: Callable[[], bool], *requests: OperatorRequest) -> None:
        """Make requests at once, and hold the dead-man button until something is so."""
        record = self._record
        end = time.monotonic() + 20.0
        for request in requests:
            self.shared.requests.put(np.array((request,), dtype=REQUEST))
        while not condition():
            assert time.monotonic() < end, (self.servo.modes.mode, self.said)
            record["time"] = time.monotonic()
            record["held"] = 1
            self.shared.operator.write(record)
            self._receive()
            time.sleep(0.005)
        self._receive()

    def spend(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > end)

    def mode(self, mode: Mode, *requests: OperatorRequest) -> None:
        self.until(lambda: self.servo.modes.mode is mode, *requests)

    def texts(self, event_kind: str) -> list[str]:
        """Texts of the events of a kind."""
        return [text for said_kind, text in self.said if said_kind == event_kind]

    def leave(self) -> None:
        self.until(lambda: self.over, OperatorRequest.QUIT)
        self._thread.join()

    def _receive(self) -> None:
        for record in self.shared.events_seen.take():
            event = Event.of(record)
            self.said.append((event.kind, event.text))


@contextmanager
def flown(link: Any, **more: Any) -> Iterator[Run]:
    shared = Shared()
    switch_interval = sys.getswitchinterval()
    plan = RunPlan(
        link=link,
        policy=NOWHERE,
        timing=QUICK,
        ages=WAITING,
        real_time=False,
        operator_timeout_s=10.0,
        **more,
    )
    run = Run(plan, shared)
    try:
        yield run
    finally:
        run.servo.stop()
        run.leave()
        shared.close()
        # Real-time scheduling is left out here.
        sys.setswitchinterval(switch_interval)
        gc.unfreeze()
        gc.enable()


def test_a_link_that_cannot_be_opened_says_why() -> None:
    with flown(Link(robot="mini_cheetah", address=Address.parse("sim://moon"))) as run:
        run.until(lambda: run.over)
        assert run.said == [("refused", "base 'moon'; expected 'bench' or 'ground'.")]
        assert run.servo.figures()["virtual"] is None


def test_without_any_state_requests_are_read(link: FaultyLink) -> None:
    link.faults["freeze"].set()
    with flown(link) as run:
        # A process that waits for the servo's start gets the error.
        run.until(lambda: run.shared.state.written > 0)
        run.until(lambda: bool(run.texts("refused")))
        run.mode(Mode.IDLE)
        record = run.shared.state.read()
        assert record is not None
        assert Mode(int(record["mode"])) in (Mode.PREFLIGHT, Mode.IDLE)
        # No robot moves, whatever is requested; leaving is granted at once.
        run.until(lambda: len(run.texts("mode")) == 1, OperatorRequest.STAND)
        since = time.monotonic()
        run.leave()
        assert time.monotonic() - since < 5.0
    assert run.texts("mode") == ["IDLE", "ENDED"]
    assert not link.wire.read_text()


@pytest.mark.parametrize(
    "requests",
    [
        (OperatorRequest.DAMP, OperatorRequest.QUIT),
        (OperatorRequest.QUIT, OperatorRequest.DAMP, OperatorRequest.STAND),
    ],
)
def test_of_requests_that_wait_for_a_late_servo_none_hides_that_to_quit(
    link: FaultyLink, requests: tuple[OperatorRequest, ...]
) -> None:
    with flown(link) as run:
        run.mode(Mode.DAMP)
        run.mode(Mode.STAND, OperatorRequest.STAND)
        run.until(lambda: run.over, *requests)
    assert run.texts("mode")[-2:] == ["DAMP", "ENDED"]


def test_a_request_to_damp_is_not_lost_with_another_beside_it(link: FaultyLink) -> None:
    with flown(link) as run:
        run.mode(Mode.DAMP)
        run.mode(Mode.STAND, OperatorRequest.STAND)
        run.mode(Mode.DAMP, OperatorRequest.DAMP, OperatorRequest.WALK)


def test_a_link_that_breaks_does_not_make_time_run_ahead(link: FaultyLink) -> None:
    with flown(link) as run:
        run.mode(Mode.DAMP)
        run.mode(Mode.STAND, OperatorRequest.STAND)
        link.faults["broken"].set()
        run.mode(Mode.FAULT)
        run.spend(0.5)
        pace = run.servo.pace
        # Damped tick by tick, not thousands of times in between.
        ahead = pace.deadline - time.monotonic()
        assert ahead <= 1.1 / 500.0
        link.faults["broken"].clear()
        ticks = run.servo.lateness.count
        run.spend(0.2)
        assert run.servo.lateness.count > ticks
        assert run.texts("fault") == ["the cable was pulled out."]
    assert pace.tick <= 500.0 * (time.monotonic() - pace.start) + 1


@pytest.mark.parametrize("log", [None, Path("run.mcap")])
def test_nothing_is_lost_where_nothing_is_kept(link: FaultyLink, log: Path | None) -> None:
    with flown(link, log=log) as run:
        run.mode(Mode.DAMP)
        # No process empties the queue here; fill it.
        while run.shared.ticks.put(np.zeros((), TICK)):
            pass
        run.until(lambda: run.shared.ticks.dropped > 0)
        dropped = run.servo.figures()["dropped"]
        assert (dropped == {}) if log is None else (dropped["ticks"] > 0)


def test_a_full_disk_does_not_keep_the_link_open(tmp_path: Path) -> None:
    folder = tmp_path / "file"
    folder.write_text("no folder")
    ground = Link(robot="mini_cheetah", address=Address.parse("sim://ground"))
    with flown(ground, trajectory=folder / "seen.npz") as run:
        run.mode(Mode.DAMP)
    (why,) = run.texts("lost")
    assert "Not a directory" in why or "exists" in why
    assert run.texts("mode")[-1] == "ENDED"
    machine: Any = run.servo.machine
    with pytest.raises(HardwareError, match="connect"):
        machine.latest()
    # Without --capture nothing is kept in memory.
    with flown(ground) as run:
        run.mode(Mode.DAMP)
    machine = run.servo.machine
    with pytest.raises(HardwareError, match="nothing was captured"):
        machine.inner.capture()


def test_a_trajectory_is_refused_where_the_machine_keeps_none(
    link: FaultyLink, tmp_path: Path
) -> None:
    with flown(link, trajectory=tmp_path / "seen.npz") as run:
        run.until(lambda: run.over)
        (sentence,) = run.texts("refused")
        assert "--link sim" in sentence
        assert run.servo.machine is None


def test_a_pause_of_the_servo_is_no_clock_that_disagrees(link: FaultyLink) -> None:
    number = 0
    paused = False
    with flown(link, ignore_latency=True) as run:

        def action() -> np.ndarray | None:
            """The policy acts during a pause of 15 ms, in the middle of the servo's tick."""
            nonlocal number
            if paused:
                time.sleep(0.015)
            number += 1
            record = np.zeros((), ACTIONS)
            state = run.shared.state.read()
            now = time.monotonic()
            if state is None:
                return None
            record["sequence"] = number
            record["state_sequence"] = state["sequence"]
            record["state_time"] = now
            record["made"] = now
            record["valid_for"] = 2.0
            record["mode_count"] = run.servo.modes.mode_count
            record["position"] = POSE
            return record

        run.shared.actions.read = action  # type: ignore[method-assign]
        run.mode(Mode.DAMP)
        run.mode(Mode.STAND, OperatorRequest.STAND)
        run.mode(Mode.POLICY, OperatorRequest.WALK)
        paused = True
        begun = number
        run.until(lambda: number > begun + 30 or bool(run.texts("fault")))
        assert run.texts("fault") == []
