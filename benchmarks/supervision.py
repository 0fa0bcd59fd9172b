"""`python -m benchmarks supervision`: false alarms and detection times of the sensors' supervision.

The state machine and the safety filter run on the virtual clock as in the servo, 500 times a
second, with the policy at 50 Hz: the robot stands up, walks under commands that change every one to
three seconds, and jumps. Each parameter set draws noise, biases, delays, battery, encoders, mass
and friction anew. A third of the flights loses 30 % of the states.

A flight without a fault gives the largest of each compared quantity beside its limit; any fault
that the supervision finds then is a false alarm. A flight with a fault of `SENSOR_FAULTS` gives the
time from its begin to damping.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.runner import Progress, finish
from pronk.cli import console
from pronk.errors import HardwareError
from pronk.links.machine import State
from pronk.policy.runtime import Policy, load_policy
from pronk.robots import load_robot
from pronk.runtime.ipc import ACTIONS, Mode, OperatorRequest, fill
from pronk.runtime.rollout import PolicyRunner
from pronk.runtime.safety import Decision, Limits, Reason, SafetyFilter
from pronk.runtime.script import STILL, Velocity
from pronk.runtime.state_machine import StateMachine, Timing
from pronk.virtual.faults import SENSOR_FAULTS, spoiled
from pronk.virtual.ground import Start
from pronk.virtual.robot import VirtualRobot
from pronk.virtual.sim_params import SimParams, load_sim_params

SERVO_HZ = 500
STEP_TICKS = 10
"""Of the servo in one step of the policy."""
LATE_TICKS = 1
"""From a state to the action computed from it."""
LOSS = 0.3
FASTEST = (2.0, 0.5, 1.0)
"""Of the commands: forward, left [m/s], yaw rate [rad/s]; within the range of training. In an hour
14 of 38 flights ended early, by a fall or a joint that was too fast."""
SUPERVISED = (Reason.REPEATED, Reason.ATTITUDE, Reason.ENCODER, Reason.HELD, Reason.CLIPPED)
LIMITS = Limits.of(load_robot("mini_cheetah"))
QUANTITIES: dict[str, tuple[float, Callable[[Any], float]]] = {
    "attitude less gyro [rad]": (LIMITS.attitude, lambda seen: seen.attitude),
    "force off the vertical [rad]": (LIMITS.upright, lambda seen: seen.lean),
    "position less velocity [rad]": (LIMITS.encoder, lambda seen: float(seen.encoder.max())),
    "least path of the attitude, share": (
        0.25,
        lambda seen: seen.paths[0] / seen.paths[1] if seen.paths[1] > LIMITS.turned else math.inf,
    ),
    "unit repeats [s]": (LIMITS.repeat_s, lambda seen: max(seen.repeated.values())),
    "moved while constant [rad]": (
        LIMITS.moved,
        lambda seen: float(np.where(seen.constant_s > LIMITS.repeat_s, seen.moved, 0.0).max()),
    ),
}
"""Limit, and the quantity, of `Supervision`."""


def draw_params(number: int) -> SimParams:
    """Draw a parameter set; number 0 is the shipped one."""
    base, rng = load_sim_params(), np.random.default_rng([29, number])
    if number == 0:
        return base
    shipped = base.machine

    def times(value: float, least: float, most: float) -> float:
        return value * float(rng.uniform(least, most))

    def vector(most: float) -> tuple[float, float, float]:
        x, y, z = rng.uniform(-most, most, 3).tolist()
        return x, y, z

    machine = replace(
        shipped,
        command_delay_s=float(rng.uniform(1e-3, 6e-3)),
        measurement_delay_s=float(rng.uniform(0.0, 3e-3)),
        bus_voltage=float(rng.uniform(22.2, 25.2)),
        encoder_bits=int(rng.integers(12, 16)),
        velocity_window_s=float(rng.uniform(0.5e-3, 4e-3)),
        velocity_noise=times(shipped.velocity_noise, 1.0, 4.0),
        position_noise=times(shipped.position_noise, 0.5, 2.0),
        torque_noise=times(shipped.torque_noise, 0.5, 2.0),
        gyro_noise=times(shipped.gyro_noise, 2.5, 10.0),
        gyro_bias=vector(0.02),
        accelerometer_noise=times(shipped.accelerometer_noise, 2.5, 10.0),
        accelerometer_bias=vector(0.3),
    )
    trunk = replace(base.trunk, mass_offset=float(rng.uniform(-0.3, 1.2)), com_offset=vector(0.01))
    attitude = replace(
        base.attitude,
        bias=vector(0.015),
        noise=times(base.attitude.noise, 0.5, 1.5),
        noise_corner_hz=times(base.attitude.noise_corner_hz, 0.5, 1.5),
    )
    ground = replace(base.ground, friction=float(rng.uniform(0.5, 1.2)))
    return replace(base, machine=machine, trunk=trunk, attitude=attitude, ground=ground)


@dataclass(kw_only=True)
class Flight:
    """One run of the virtual robot, from damping."""

    policy: Policy
    params: SimParams
    seed: int
    steady: Velocity | None = None
    """A command that does not change, without jumps; None for those within `FASTEST`."""
    loss: float = 0.0
    fault: str = ""
    """Of `SENSOR_FAULTS`."""
    fault_at: float = math.inf
    """[s]"""
    delay_ticks: int = 0
    """Age of the states from `fault_at` on."""
    largest: dict[str, float] = field(default_factory=dict)
    """Of each of `QUANTITIES`."""
    seconds: float = 0.0
    """With a target, so under supervision [s]."""
    jumps: int = 0
    damped: Decision | None = None
    damped_at: float = math.nan
    """[s]"""

    def run(self, seconds: float) -> None:
        """Fly until a time, or until the filter damps."""
        robot = load_robot(self.policy.contract.robot)
        rng = np.random.default_rng([self.seed, 7])
        start = Start(yaw=float(rng.uniform(-math.pi, math.pi)))
        machine = VirtualRobot(
            robot, self.params, seed=self.seed, base="ground", capture_rate_hz=None, start=start
        )
        machine.connect()
        safety, modes = SafetyFilter(limits=Limits.of(robot)), StateMachine(robot, Timing())
        runner = PolicyRunner(self.policy, robot)
        modes.enter(Mode.DAMP, 0.0)
        modes.request(OperatorRequest.STAND)
        command, jump, change = STILL, False, math.inf
        jump_at, entry = math.inf, -1
        under_way: list[tuple[int, Any]] = []
        waiting: list[State] = []
        action, newest, sound = None, machine.latest(), machine.latest()
        for tick in range(1, round(seconds * SERVO_HZ) + 1):
            t = tick / SERVO_HZ
            measured = [each for each in machine.wait(t) if rng.random() >= self.loss]
            if t < self.fault_at:
                sound = measured[-1] if measured else sound
            elif self.fault:
                measured = [spoiled(self.fault, sound, each) for each in measured]
            waiting += measured
            keep = self.delay_ticks if t >= self.fault_at else 0
            states = waiting[: max(0, len(waiting) - keep)]
            waiting = waiting[len(states) :]
            newest = states[-1] if states else newest
            if under_way and under_way[0][0] <= tick:
                action = under_way.pop(0)[1]
            if modes.mode is Mode.STAND:
                modes.request(OperatorRequest.WALK)
            desired = modes.step(t, newest.position, safety, action)
            if modes.mode is Mode.POLICY and math.isinf(change):
                change = t + 1.0
            if desired.command is None:
                safety.damped()
                machine.damp()
            else:
                sent, decision = safety.judge(states or [newest], desired.command, t)
                self.seconds += 1.0 / SERVO_HZ
                if sent is None:
                    self.damped, self.damped_at = decision, t
                    return
                machine.send(sent)
                for name, (_, quantity) in QUANTITIES.items():
                    more = min if name.startswith("least") else max
                    value = quantity(safety.supervision)
                    self.largest[name] = more(self.largest.get(name, value), value)
            if t >= change and self.steady is not None:
                command, change = self.steady, math.inf
            elif t >= change:
                share = rng.uniform(-1.0, 1.0, 3) * (rng.random(3) < (0.9, 0.3, 0.3))
                x, y, z = (share * FASTEST).tolist()
                command, change = (x, y, z), t + float(rng.uniform(1.0, 3.0))
                jump_at = t + 0.5 if rng.random() < 0.5 else math.inf
                self.jumps += jump_at < math.inf
            jump = jump_at <= t < jump_at + 0.5
            if tick % STEP_TICKS == 0:
                if entry != modes.entry:
                    runner.reset()
                    entry = modes.entry
                live = modes.mode is Mode.POLICY
                made = runner.decide(newest, (command, jump) if live else (STILL, False), t)
                record = np.zeros((), ACTIONS)
                fill(record, sequence=tick, state_sequence=newest.sequence, entry=entry)
                fill(record, made=t, valid_for=0.05, position=made.position)
                under_way.append((tick + LATE_TICKS, record))


def alarms(policy: Policy, hours: float, sets: int, progress: Progress) -> dict[str, Any]:
    """Fly without faults for a time; false alarms, falls and the largest of each quantity."""
    largest: dict[str, float] = {}
    ends: Counter[str] = Counter()
    flown, jumps, number = 0.0, 0, 0
    found: list[str] = []
    while flown < 3600.0 * hours:
        flight = Flight(
            policy=policy,
            params=draw_params(number % sets),
            seed=number,
            loss=LOSS if number % 3 == 2 else 0.0,
        )
        try:
            flight.run(120.0)
        except HardwareError:
            ends["physics ran away"] += 1
        flown, jumps, number = flown + flight.seconds, jumps + flight.jumps, number + 1
        if flight.damped is not None:
            ends[flight.damped.reason.name] += 1
            if flight.damped.reason in SUPERVISED:
                found.append(f"flight {number - 1}, {flight.damped_at:.3f} s: {flight.damped.text}")
        for name, value in flight.largest.items():
            more = min if name.startswith("least") else max
            largest[name] = more(largest.get(name, value), value)
        progress("walking and jumping", min(flown / (3600.0 * hours), 1.0))
    return {
        "hours": flown / 3600.0,
        "flights": number,
        "sets": sets,
        "jumps": jumps,
        "false_alarms": found,
        "ends": dict(ends),
        "largest": dict(largest),
    }


LATE = "states-30-ms-old"
WALK = (1.0, 0.0, 0.0)
"""Forward, left [m/s], yaw rate [rad/s] at the begin of a fault."""


def detection(policy: Policy, runs: int, progress: Progress) -> dict[str, dict[str, Any]]:
    """Time from each fault to damping [s], and the reasons; NaN where the fault is not found."""
    rows: dict[str, dict[str, Any]] = {}
    for row, fault in enumerate((*SENSOR_FAULTS, LATE)):
        times: list[float] = []
        reasons: Counter[str] = Counter()
        number = 0
        while len(times) < runs:
            begins, number = 7.0 + 0.137 * len(times), number + 1
            flight = Flight(
                policy=policy,
                params=draw_params(number),
                seed=1000 + number,
                steady=WALK,
                fault="" if fault == LATE else fault,
                fault_at=begins,
                delay_ticks=15 if fault == LATE else 0,
            )
            flight.run(begins + 3.0)
            if flight.damped_at < begins:
                continue  # it fell before
            times.append(flight.damped_at - begins)
            reasons["none" if flight.damped is None else flight.damped.reason.name] += 1
        rows[fault] = {"times_s": times, "reasons": dict(reasons)}
        progress("faults", (row + 1) / (len(SENSOR_FAULTS) + 1))
    return rows


def supervision(
    policy: tyro.conf.Positional[Path], hours: float = 0.1, sets: int = 10, runs: int = 10
) -> console.Outcome:
    """False alarms of the supervision of sensors, and the time in which it finds faults.

    Args:
        policy: policy.onnx that walks and jumps.
        hours: Of walking and jumping without a fault.
        sets: Parameter sets of the virtual robot.
        runs: With each fault, each at another moment of the gait and another parameter set.
    """
    network = load_policy(policy)
    with console.progress() as report:
        quiet = alarms(network, hours, sets, report)
        found = detection(network, runs, report)
    largest = [
        (name, f"{quiet['largest'].get(name, 0.0):.4f}", f"{limit:g}")
        for name, (limit, _) in QUANTITIES.items()
    ]
    title = (
        f"{quiet['hours']:.2f} h, {quiet['flights']} flights of {sets} parameter sets, "
        f"{quiet['jumps']} jumps: {len(quiet['false_alarms'])} false alarms"
    )
    cells = []
    for name, row in found.items():
        times = 1e3 * np.array(row["times_s"])
        missed = int(np.isnan(times).sum())
        worst = "not found" if missed else f"{times.max():.0f}"
        reasons = ", ".join(f"{reason} {count}" for reason, count in row["reasons"].items())
        cells.append(
            (name, f"{np.nanmedian(times):.0f}", worst, f"{runs - missed}/{runs}", reasons)
        )
    for line in quiet["false_alarms"]:
        console.say(line)
    return finish(
        {"alarms": quiet, "faults": found},
        console.table(title, ["quantity", "largest", "limit"], largest),
        console.table(
            "From a fault to damping [ms]", ["fault", "median", "worst", "found", "reasons"], cells
        ),
    )
