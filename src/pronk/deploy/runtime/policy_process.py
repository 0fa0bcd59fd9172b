"""The policy's process: at 50 Hz from the newest state to an action for the servo.

It steps from the moment the robot is damped, whether its actions are used or not: so the network is
warm, and the latency is known, before the policy starts. At the first step after a change of mode
the policy's history is reset, except from `POLICY` to `HALT`: there it is reset at the second step,
20 ms later.

Just before each step a second instance of the policy runs for warm-up: between two steps, 20 ms
apart, the network's weights (2.8 MB) leave the caches, and a step takes five times as long as it
does back to back. `python -m benchmarks tick` measures it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from pronk.arrays import Array
from pronk.deploy.links.realtime import Histogram, Pace, enter, leave, sleep_until
from pronk.deploy.runtime.memory import Shared
from pronk.deploy.runtime.modes import POLICY_MODES, Mode
from pronk.deploy.runtime.plan import POLICY_PRIORITY, RunPlan
from pronk.deploy.runtime.process_body import run_to_end
from pronk.deploy.runtime.records import ACTIONS, STEP, event_record, get_state
from pronk.errors import PronkError
from pronk.policy.deployable import DeployablePolicy, open_policy
from pronk.policy.observation import History
from pronk.policy.rollout import measurement
from pronk.policy.script import STILL, Commanded
from pronk.processes import die_with_parent
from pronk.robots.machine import State

WARM_UP = 20
"""Warm-up steps before the first step."""
LEAD_S = 2e-3
"""Begin of the warm-up before a deadline: a tenth of a policy's step [s]."""
_FIRST_S = 1e-3
"""Time allowed for the first warm-up step [s]."""
_SHARE = 0.5
"""Time allowed for the next step, as a share of what the one before took."""
_SPIN_S = 0.2e-3
"""Longest wait that is spun; a sleep ends up to so much late [s]."""
_PHASE_S = 0.4e-3
"""Time of a step after the servo's tick, when its state is there: nothing waits for the next tick
[s]."""


def warm_up_until(deadline: float, act: Callable[[], object]) -> int:
    """Wait for a deadline, and repeat something in the last 2 ms before it.

    Nothing is begun in less than half of the time that it took before, because each repeat is
    quicker than the one before.

    Args:
        deadline: Time of CLOCK_MONOTONIC [s].
        act: What is repeated.

    Returns:
        The number of repeats.
    """
    sleep_until(deadline - LEAD_S)
    repeats = 0
    needed_s = _FIRST_S
    now = time.monotonic()
    while now + needed_s < deadline:
        act()
        repeats += 1
        done = time.monotonic()
        needed_s = _SHARE * (done - now)
        now = done
    sleep_until(deadline - _SPIN_S)
    while time.monotonic() < deadline:
        pass
    return repeats


def serve_policy(plan: RunPlan, name: str, end: Connection) -> None:
    """Run the policy's process.

    Args:
        plan: Plan of the run.
        name: Name of the shared memory.
        end: Pipe to the operator's process.
    """
    leave()
    die_with_parent()
    assert plan.policy is not None
    shared = Shared(name, len(plan.robot.joints))
    policy = open_policy(plan.policy, plan.robot, plan.deploy_yaml)
    process = PolicyProcess(plan, shared, policy)
    for line in enter(plan.real_time_settings(POLICY_PRIORITY, 1)):
        notice = event_record(time.monotonic(), "system", f"policy: {line}")
        shared.policy_events.put(notice)
    run_to_end(process, shared, end)


def standing(position: Array) -> State:
    """Return the state of a robot that stands with its joints at a position [rad]."""
    count = len(position)
    return State(
        time=0.0,
        sequence=0,
        position=np.array(position),
        velocity=np.zeros(count),
        torque=np.zeros(count),
        gyro=np.zeros(3),
        accelerometer=np.array([0.0, 0.0, 9.81]),
        bus_voltage=0.0,
    )


class PolicyProcess:
    """The loop and its figures."""

    def __init__(self, plan: RunPlan, shared: Shared, policy: DeployablePolicy) -> None:
        """Warm the network up.

        Args:
            plan: Plan of the run.
            shared: Memory of the run.
            policy: The policy, as `open_policy` has checked it.

        Raises:
            ArtefactError: The policy's output is not finite.
        """
        self.plan = plan
        self.shared = shared
        self.policy = policy
        self.rate_hz = policy.rate_hz
        self.lateness = Histogram()
        """Lateness of steps [s]."""
        self.decision = Histogram()
        """Times in which the observation was built and the network run [s]."""
        self.network = Histogram()
        """Times of the network alone [s]."""
        self._stand_in = policy.sibling()
        self._standing = measurement(standing(policy.start_position))
        self._history: History | None = None
        """History of the observations for the log; None for a policy that has others."""
        if policy.logs_observation:
            self._history = History(policy.start_position)
        self._jumps = policy.jumps
        ranges = policy.command_ranges.values()
        self._lowest_command = [low for low, _ in ranges]
        self._highest_command = [high for _, high in ranges]
        self._pace: Pace | None = None
        """Pace of the steps, once the servo has written a state."""
        self._mode_count = -1
        """Number of mode changes (`state_dtype`) for which the history was last reset."""
        self._mode = Mode.IDLE
        """Mode of the servo at the last step."""
        self._stopping = False
        self._parent = os.getppid()
        self._last_error = ""
        self._action = np.zeros((), dtype=ACTIONS)
        self._step = np.zeros((), dtype=STEP)
        self._count = 0
        """Actions given."""
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
                # On the servo's grid, so that states always have the same age.
                self._pace = Pace(self.rate_hz, float(record["start"]) + _PHASE_S)
                self._pace.advance(time.monotonic())
            warm_up_until(self._pace.deadline, self.warm_up)
            self.step(self._pace)

    def warm_up(self) -> None:
        """Run the first step of a robot that stands, with the second instance of the policy."""
        self._stand_in.reset()
        self._stand_in.step(self._standing, STILL)

    def figures(self) -> dict[str, Any]:
        """Return the figures of the run since it started."""
        return {
            "steps": self.decision.count,
            "missed_steps": 0 if self._pace is None else self._pace.missed,
            "lateness": self.lateness.figures(),
            "decision": self.decision.figures(),
            "network": self.network.figures(),
        }

    def step(self, pace: Pace) -> None:
        """Compute an action from the newest state."""
        begun = time.monotonic()
        deadline = pace.deadline
        self.lateness.add(begun - deadline)
        record = self.shared.state.read()
        if record is not None and Mode(int(record["mode"])) not in (Mode.IDLE, Mode.PREFLIGHT):
            mode = Mode(int(record["mode"]))
            mode_count = int(record["mode_count"])
            is_first_of_halt = mode is Mode.HALT and self._mode is Mode.POLICY
            if mode_count != self._mode_count and not is_first_of_halt:
                self.policy.reset()
                if self._history is not None:
                    self._history.reset()
                self._mode_count = mode_count
            self._mode = mode
            try:
                self._act(record, deadline, begun)
            except PronkError as error:
                # Without an action the last one expires in the servo's filter.
                if str(error) != self._last_error:
                    self._last_error = str(error)
                    notice = event_record(time.monotonic(), "policy", self._last_error)
                    self.shared.policy_events.put(notice)
        pace.advance(time.monotonic())

    def _act(self, record: np.void, deadline: float, begun: float) -> None:
        """Send the action of a state record, then log the step."""
        state = get_state(record)
        velocity, jump = self._commanded()
        observed = time.monotonic()
        target = self.policy.step(measurement(state), velocity, jump)
        inferred = time.monotonic()
        self.decision.add(inferred - observed)
        self.network.add(self.policy.network_s)
        outputs = self.policy.inference
        assert outputs is not None
        action = self._action
        action["sequence"] = self._count
        action["state_sequence"] = state.sequence
        action["state_time"] = state.time
        action["mode_count"] = self._mode_count
        action["position"] = target
        action["made"] = begun
        action["valid_for"] = self.plan.action_valid_s
        self.shared.actions.write(action)
        done = time.monotonic()
        self._count += 1
        step = self._step
        step["observation"] = np.nan
        if self._history is not None:
            # The observation for the log, built again after the action is out.
            step["observation"] = self._history.observe(measurement(state), velocity)
            self._history.acted(outputs.action[0])
        step["sequence"] = action["sequence"]
        step["state_sequence"] = state.sequence
        step["state_time"] = state.time
        step["live"] = self._mode in POLICY_MODES
        step["deadline"] = deadline
        step["begun"] = begun
        step["observed"] = observed
        step["inferred"] = inferred
        step["done"] = done
        step["command"] = velocity
        step["jump"] = jump
        step["target"] = target
        step["action"] = outputs.action[0]
        step["contact"] = outputs.contact[0]
        step["linear_velocity"] = outputs.linear_velocity[0]
        self.shared.steps.put(step)
        self._last_error = ""

    def _commanded(self) -> Commanded:
        """Return the operator's command within the ranges of training; zero unless it is live."""
        record = self.shared.operator.read()
        if record is None or self._mode is not Mode.POLICY:
            return STILL, False
        command = np.clip(record["command"], self._lowest_command, self._highest_command)
        forward, sideways, yaw_rate = command.tolist()
        return (forward, sideways, yaw_rate), bool(record["jump"]) and self._jumps
