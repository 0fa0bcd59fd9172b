"""The policy's process: at 50 Hz from the newest state to an action for the servo.

It decides from the moment the robot is damped, heard or not: so the network is warm, and the
latency is known, before the policy's turn comes. Every change of mode begins a new past for it,
except that it comes to a halt as it was.

Just before each step it decides a few times for nothing, with a sibling of the policy that has a
past of its own: so the step that counts finds all it needs in the caches, and no bit of what it
decides is another (`pronk.runtime.warmup`).
"""

from __future__ import annotations

import os
import signal
import time
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import orjson

from pronk.errors import PronkError
from pronk.links.machine import State
from pronk.links.realtime import Histogram, Pace, enter
from pronk.links.terminal import leave
from pronk.policy.contract import Contract
from pronk.policy.observation import History
from pronk.policy.runtime import Policy, load_policy
from pronk.runtime.ipc import ACTIONS, STEP, Mode, Names, Shared, event, get_state
from pronk.runtime.plan import POLICY_PRIORITY, Plan
from pronk.runtime.rollout import PolicyRunner, measurement
from pronk.runtime.script import STILL, Commanded
from pronk.runtime.warmup import warm_up_until

WARM_UP = 20
"""Rehearsals before the first step."""
_PHASE_S = 0.4e-3
"""After the servo's tick, when its record are there: nothing waits for the next tick [s]."""
_LIVE = (Mode.POLICY, Mode.HALT)


def serve_policy(plan: Plan, names: Names, end: Connection) -> None:
    """Body of the policy process.

    Args:
        plan: What to do.
        names: Of the shared memory.
        end: Where the figures of the run go when it is over, as JSON.
    """
    leave()
    policy = plan.policy
    assert policy is not None
    shared = Shared(names)
    process = PolicyProcess(plan, shared, load_policy(policy))
    signal.signal(signal.SIGTERM, lambda *_: process.stop())
    for line in enter(plan.wanted(POLICY_PRIORITY, 1)):
        shared.policy_events.put(event(time.monotonic(), "system", f"policy: {line}"))
    try:
        process.run()
    finally:
        with suppress(OSError):  # nobody is there any more
            end.send_bytes(orjson.dumps(process.figures()))
        end.close()
        shared.close()


def standing(contract: Contract) -> State:
    """A robot that stands in its default pose."""
    return State(
        time=0.0,
        sequence=0,
        position=np.array(contract.default_position),
        velocity=np.zeros(len(contract.joint_names)),
        torque=np.zeros(len(contract.joint_names)),
        gyro=np.zeros(3),
        accelerometer=np.array([0.0, 0.0, 9.81]),
        bus_voltage=0.0,
    )


class PolicyProcess:
    """The loop and what it counts."""

    def __init__(self, plan: Plan, shared: Shared, policy: Policy) -> None:
        """Warm the network up.

        Raises:
            ArtefactError: The policy is not for this robot, or gives no numbers.
        """
        self.plan = plan
        self.shared = shared
        self.runner = PolicyRunner(policy, plan.robot)
        self.rate_hz = policy.contract.policy_rate_hz
        self.lateness = Histogram()
        self.decision = Histogram()
        """Observation built and network run."""
        self.network = Histogram()
        """The network alone."""
        self._stand_in = PolicyRunner(policy.sibling(), plan.robot)
        self._standing = standing(policy.contract)
        self._history = History(policy.contract.default_position)
        self._jumps = policy.contract.jump
        self._least, self._most = zip(*policy.contract.command_ranges.values(), strict=True)
        self._pace: Pace | None = None
        self._entry = -1
        self._mode = Mode.IDLE
        self._stopping = False
        self._parent = os.getppid()
        self._last_error = ""
        self._order = np.zeros((), dtype=ACTIONS)
        self._step = np.zeros((), dtype=STEP)
        self._count = 0
        for _ in range(WARM_UP):
            self.warm_up()

    def stop(self) -> None:
        """End at the next step."""
        self._stopping = True

    def run(self) -> None:
        """Step until the servo has ended."""
        while not self._stopping and os.getppid() == self._parent:
            record = self.shared.state.read()
            if record is None:
                time.sleep(1.0 / self.rate_hz)
                continue
            mode = Mode(int(record["mode"]))
            if mode is Mode.ENDED:
                return
            if self._pace is None:
                # On the servo's own grid, so that record are always as young.
                self._pace = Pace(self.rate_hz, float(record["start"]) + _PHASE_S)
                self._pace.advance(time.monotonic())
            warm_up_until(self._pace.deadline, self.warm_up)
            self.step(self._pace)

    def warm_up(self) -> None:
        """Decide for nothing: always the first step of a robot that stands."""
        self._stand_in.reset()
        self._stand_in.decide(self._standing, (STILL, False), 0.0)

    def figures(self) -> dict[str, Any]:
        """Of the run so far."""
        pace = self._pace
        return {
            "steps": self.decision.count,
            "missed_steps": 0 if pace is None else pace.missed,
            "lateness": self.lateness.figures(),
            "decision": self.decision.figures(),
            "network": self.network.figures(),
        }

    def step(self, pace: Pace) -> None:
        """The step whose deadline has come: from the newest record to an action."""
        begun = time.monotonic()
        self.lateness.add(begun - pace.deadline)
        deadline = pace.deadline
        record = self.shared.state.read()
        if record is not None and Mode(int(record["mode"])) not in (Mode.IDLE, Mode.PREFLIGHT):
            mode, entry = Mode(int(record["mode"])), int(record["entry"])
            if entry != self._entry and not (mode is Mode.HALT and self._mode is Mode.POLICY):
                self.runner.reset()
                self._history.reset()
                self._entry = entry
            self._mode = mode
            try:
                self._answer(record, deadline, begun)
            except PronkError as error:
                # No action: the servo's filter says what is wrong and lets the last one expire.
                self._report_error(str(error))
        pace.advance(time.monotonic())

    def _answer(self, record: np.void, deadline: float, begun: float) -> None:
        state = get_state(record)
        velocity, jump = self._commanded()
        now = time.monotonic()
        command, tick = self.runner.decide(state, (velocity, jump), now)
        inferred = time.monotonic()
        self.decision.add(inferred - now)
        self.network.add(self.runner.policy.network_s)
        action = self._order
        action["sequence"] = self._count
        action["state_sequence"], action["state_time"] = state.sequence, state.time
        action["made"], action["valid_for"] = begun, self.plan.action_valid_s
        action["entry"] = self._entry
        action["position"] = command.position
        self.shared.actions.write(action)
        done = time.monotonic()
        self._count += 1
        # The observation for the log, built again after the action is out.
        observation = self._history.observe(measurement(state), velocity)
        self._history.acted(tick.action.astype(np.float32))
        step = self._step
        step["observation"] = observation
        step["sequence"], step["deadline"], step["begun"] = action["sequence"], deadline, begun
        step["observed"], step["inferred"], step["done"] = now, inferred, done
        step["state_sequence"], step["state_time"] = state.sequence, state.time
        step["live"] = self._mode in _LIVE
        step["command"], step["jump"] = velocity, jump
        step["action"], step["target"] = tick.action, tick.target
        step["contact"], step["linear_velocity"] = tick.contact, tick.linear_velocity
        self.shared.steps.put(step)
        self._last_error = ""

    def _commanded(self) -> Commanded:
        """What the operator wants now: to stand still unless the policy is in charge.

        Never more than the policy was trained for.
        """
        stick = self.shared.operator.read()
        if stick is None or self._mode is not Mode.POLICY:
            return STILL, False
        forward, left, yaw = np.clip(stick["command"], self._least, self._most).tolist()
        return (forward, left, yaw), bool(stick["jump"]) and self._jumps

    def _report_error(self, text: str) -> None:
        """Once for each new last_error."""
        if text != self._last_error:
            self._last_error = text
            self.shared.policy_events.put(event(time.monotonic(), "policy", text))
