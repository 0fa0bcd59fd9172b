"""`python -m benchmarks supervision`: false alarms and detection times of the sensors' supervision.

The state machine and the safety filter run on the virtual clock as in the servo, 500 times a
second, with the policy at 50 Hz: the robot stands up, walks under commands that change every one to
three seconds, and jumps. Each parameter set draws noise, biases, delays, battery, encoders, mass
and friction anew. A third of the flights loses 30 % of the states.

A flight without a fault gives the largest of each compared quantity beside its limit; any fault
that the supervision finds then, unless the robot is falling, is a false alarm. A flight with a
fault of `SENSOR_FAULTS` or `BODY_FAULTS`, and with one of `CLOCKS`, gives the time from its begin
to damping.

On a machine with n cores: `--hours 10 --sets 10 --runs 10 --jobs n --out rows.jsonl`. It needs no
network, and goes on from the rows in the file.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import count, product
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.runner import Row, finish, rows_in, rows_of, write_section
from pronk.cli import console
from pronk.deploy.bench.faults import CLOCKS, SENSOR_FAULTS, SWAPPED, spoiled
from pronk.deploy.runtime.limits import Limits
from pronk.deploy.runtime.modes import Mode, OperatorRequest
from pronk.deploy.runtime.poses import RunTiming
from pronk.deploy.runtime.reasons import Decision, Reason
from pronk.deploy.runtime.records import ACTIONS
from pronk.deploy.runtime.rules import tilt
from pronk.deploy.runtime.safety import SafetyFilter
from pronk.deploy.runtime.state_machine import StateMachine
from pronk.errors import HardwareError
from pronk.jump.virtual.ground import Start
from pronk.jump.virtual.robot import VirtualRobot
from pronk.jump.virtual.sim_params import SimParams, load_sim_params
from pronk.policy.rollout import measurement
from pronk.policy.runtime import load_policy
from pronk.policy.script import STILL, Velocity
from pronk.robots import RobotSpec, load_robot
from pronk.robots.machine import State
from pronk.tables import Cell, Column, Table, counted

SERVO_HZ = 500
STEP_TICKS = 10
"""Of the servo in one step of the policy."""
LATE_TICKS = 1
"""From a state to the action computed from it."""
LOSS = 0.3
FASTEST = (2.0, 0.5, 1.0)
"""Of the commands: forward, left [m/s], yaw rate [rad/s]; within the range of training. In an hour
14 of 38 flights ended early, by a fall or a joint that was too fast."""
_SEEDS = 1_000_000
"""From a seed of the benchmark to those of its flights."""
SUPERVISED = (
    *(Reason.REPEATED, Reason.ATTITUDE, Reason.ENCODER),
    *(Reason.HELD, Reason.CLIPPED, Reason.SWAPPED),
    *(Reason.ROBOT_CLOCK, Reason.INTERRUPTED, Reason.BUS_VOLTAGE, Reason.FAR_TARGET),
    *(Reason.COLLAPSED, Reason.TRACKING, Reason.ORIENTATION),
)


def _attitude(safety: SafetyFilter) -> float:
    return safety.sensors.attitude


def _lean(safety: SafetyFilter) -> float:
    return safety.sensors.lean


def _encoder(safety: SafetyFilter) -> float:
    return float(safety.sensors.encoder.max())


def _path_share(safety: SafetyFilter) -> float:
    path, turned = safety.sensors.paths
    return path / turned if turned > safety.limits.sensors.turned else math.inf


def _repeated(safety: SafetyFilter) -> float:
    return max(safety.sensors.repeated.values())


def _moved(safety: SafetyFilter) -> float:
    is_constant = safety.sensors.constant_s > safety.limits.sensors.repeat_s
    return float(np.where(is_constant, safety.sensors.moved, 0.0).max())


def _others(safety: SafetyFilter) -> float:
    both_constant_s = safety.sensors.constant_s.reshape(2, -1).min(axis=0)
    is_constant = both_constant_s > safety.limits.sensors.repeat_s
    return float(np.where(is_constant, safety.sensors.others, 0.0).max())


def _blocked(safety: SafetyFilter) -> float:
    return float(safety.targets.blocked_s.max())


def _clipped(safety: SafetyFilter) -> float:
    return safety.targets.clipped_s


def _slow_drift(safety: SafetyFilter) -> float:
    return float(safety.sensors.slow_drift.max())


def _clock(safety: SafetyFilter) -> float:
    return safety.sensors.clock.disagreement


def _voltage(safety: SafetyFilter) -> float:
    voltage = safety.sensors.voltage
    return math.inf if math.isnan(voltage) else voltage


def _height(safety: SafetyFilter) -> float:
    return float(safety.response.trunk_height)


def _low(safety: SafetyFilter) -> float:
    return safety.response.low_s


def _pushed(safety: SafetyFilter) -> float:
    return float(safety.response.pushed_s.max())


def _seized(safety: SafetyFilter) -> float:
    response = safety.response
    limits = safety.limits
    far = response.target_range > limits.response.far
    far &= response.torque_range > limits.response.push_share * limits.joints.torque
    return float(np.where(far, response.motion, math.inf).min())


QUANTITIES: dict[str, tuple[Callable[[Limits], float], Callable[[SafetyFilter], float]]] = {
    "attitude less gyro [rad]": (attrgetter("sensors.attitude"), _attitude),
    "force off the vertical [rad]": (attrgetter("sensors.upright"), _lean),
    "position less velocity [rad]": (attrgetter("sensors.encoder"), _encoder),
    "least path of the attitude, share": (attrgetter("sensors.stuck_share"), _path_share),
    "unit repeats [s]": (attrgetter("sensors.repeat_s"), _repeated),
    "moved while constant [rad]": (attrgetter("sensors.moved"), _moved),
    "others moved while constant [rad]": (attrgetter("sensors.others_moved"), _others),
    "limited by torque without moving [s]": (attrgetter("blocked.blocked_s"), _blocked),
    "limited by torque [s]": (attrgetter("blocked.clipped_s"), _clipped),
    "slow drift of a position [rad]": (attrgetter("sensors.drift"), _slow_drift),
    "robot's clock off in a second [s]": (attrgetter("sensors.clock_s"), _clock),
    "least bus voltage [V]": (attrgetter("operating.bus_voltage"), _voltage),
    "least height of the trunk [m]": (attrgetter("collapsed"), _height),
    "trunk collapsed [s]": (attrgetter("response.low_s"), _low),
    "pushed without following [s]": (attrgetter("response.pushed_s"), _pushed),
    "least motion of a joint whose target moves far [rad]": (attrgetter("response.still"), _seized),
}
"""Limit of a robot, and the quantity of the filter."""


def draw_params(number: int, robot: RobotSpec) -> SimParams:
    """Draw a parameter set of a robot; number 0 is the shipped one."""
    base = load_sim_params(robot=robot)
    rng = np.random.default_rng([29, number])
    if number == 0:
        return base
    shipped = base.machine

    def times(value: float, lowest: float, highest: float) -> float:
        return value * float(rng.uniform(lowest, highest))

    def vector(largest: float) -> tuple[float, float, float]:
        x, y, z = rng.uniform(-largest, largest, 3).tolist()
        return x, y, z

    machine = replace(
        shipped,
        command_delay_s=float(rng.uniform(1e-3, 6e-3)),
        measurement_delay_s=float(rng.uniform(0.0, 3e-3)),
        bus_voltage=times(robot.joints[0].drive.bus_voltage, 0.925, 1.05),
        encoder_bits=int(rng.integers(12, 16)),
        velocity_window_s=float(rng.uniform(0.5e-3, 4e-3)),
        velocity_noise=times(shipped.velocity_noise, 1.0, 4.0),
        position_noise=times(shipped.position_noise, 0.5, 2.0),
        torque_noise=times(shipped.torque_noise, 0.5, 2.0),
    )
    imu = replace(
        base.imu,
        gyro_noise=times(base.imu.gyro_noise, 2.5, 10.0),
        gyro_bias=vector(0.02),
        accelerometer_noise=times(base.imu.accelerometer_noise, 2.5, 10.0),
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
    return replace(base, machine=machine, imu=imu, trunk=trunk, attitude=attitude, ground=ground)


def in_steps(state: State) -> State:
    """A state as the Mini Cheetah's drives send it: 16 bits of 25 rad, 12 of 130 rad/s."""
    position = 25.0 / 65535.0
    velocity = 130.0 / 4095.0
    return replace(
        state,
        position=position * np.rint(state.position / position),
        velocity=velocity * (np.floor(state.velocity / velocity) + 0.5),
    )


_FREE_KNEE = 2
_FREE_PITCH = 1
_FREE_ROLL = 0
BODY_FAULTS = {
    "motor-free-knee": _FREE_KNEE,
    "motor-free-hip-pitch": _FREE_PITCH,
    "motor-free-hip-roll": _FREE_ROLL,
    "seized-knee": _FREE_KNEE,
    "seized-hip-pitch": _FREE_PITCH,
    "seized-hip-roll": _FREE_ROLL,
    "battery-6-V": -1,
}
"""Faults of the robot itself, and the joint of each; the bus voltage is that of the battery."""
_SEIZED_STIFFNESS = 10000.0
_SEIZED_DAMPING = 20.0
"""Of a seized rotor against its housing [N m/rad, N m s/rad]."""


def strike_body(machine: VirtualRobot, fault: str) -> None:
    """Make a fault of the robot itself in a virtual one, at each tick that it lasts."""
    physics = machine._physics
    assert physics is not None
    plant = physics.plant
    data = physics.data
    k = BODY_FAULTS[fault]
    if fault == "battery-6-V":
        physics._machine = replace(physics._machine, bus_voltage=6.0)
        return
    rotor = plant.rotor[k]
    if fault.startswith("motor-free"):
        data.qfrc_applied[rotor] = -float(plant.motor_torque(data.act[None])[0][k])
        return
    joint = plant.model.dof_jntid[rotor]
    if plant.model.jnt_stiffness[joint] != _SEIZED_STIFFNESS:
        plant.model.jnt_stiffness[joint] = _SEIZED_STIFFNESS
        plant.model.dof_damping[rotor] += _SEIZED_DAMPING
        plant.model.qpos_spring[plant.rotor_qpos[k]] = data.qpos[plant.rotor_qpos[k]]


FALLING_RAD = 0.5
"""True tilt of the trunk from which a robot is falling [rad]; turns at speed take 0.3."""


def is_falling(machine: VirtualRobot, limits: Limits) -> bool:
    """Whether a virtual robot leans too far, or its trunk is truly down."""
    now = machine.snapshot()
    height = float(now.position[0, 2])
    return tilt(now.orientation[0]) > FALLING_RAD or height < limits.collapsed


@dataclass(kw_only=True)
class Flight:
    """One run of the virtual robot, from damping."""

    policy: Path
    params: SimParams
    seed: int
    steady: Velocity | None = None
    """A command that does not change, without jumps; None for those within `FASTEST`."""
    loss: float = 0.0
    coarse: bool = False
    """Whether positions and velocities come in the steps of the Mini Cheetah's drives."""
    fault: str = ""
    """Of `SENSOR_FAULTS` or `BODY_FAULTS`."""
    clock: str = "right"
    """The robot's own clock from `fault_at` on, of `CLOCKS`."""
    fault_at: float = math.inf
    """[s]"""
    delay_ticks: int = 0
    """Age of the states from `fault_at` on."""
    largest: dict[str, float] = field(default_factory=dict)
    """Of each of `QUANTITIES`."""
    seconds: float = 0.0
    """With a target, so under supervision [s]."""
    jumps: int = 0
    is_falling: bool = False
    """Whether the robot was falling as it was damped."""
    damped: Decision | None = None
    damped_at: float = math.nan
    """[s]"""

    def _stamped(self, state: State) -> State:
        """A state with the robot's own time."""
        if state.time < self.fault_at:
            return replace(state, robot_time=state.time)
        return replace(state, robot_time=CLOCKS[self.clock](self.fault_at, state.time))

    def run(self, seconds: float) -> None:
        """Fly until a time, or until the filter damps."""
        policy = load_policy(self.policy)
        robot = load_robot(policy.contract.robot)
        rng = np.random.default_rng([self.seed, 7])
        start = Start(yaw=float(rng.uniform(-math.pi, math.pi)))
        machine = VirtualRobot(
            robot, self.params, seed=self.seed, base="ground", capture_rate_hz=None, start=start
        )
        machine.connect()
        safety = SafetyFilter(limits=Limits.of(robot))
        modes = StateMachine(robot, RunTiming())
        modes.enter(Mode.DAMP, 0.0)
        modes.request(OperatorRequest.STAND)
        command = STILL
        jump = False
        change = math.inf
        jump_at = math.inf
        mode_count = -1
        under_way: list[tuple[int, Any]] = []
        waiting: list[State] = []
        action = None
        newest = machine.latest()
        sound = machine.latest()
        for tick in range(1, round(seconds * SERVO_HZ) + 1):
            t = tick / SERVO_HZ
            if t >= self.fault_at and self.fault in BODY_FAULTS:
                strike_body(machine, self.fault)
            measured = [state for state in machine.wait(t) if rng.random() >= self.loss]
            if self.coarse:
                measured = [in_steps(state) for state in measured]
            if t < self.fault_at:
                sound = measured[-1] if measured else sound
            elif self.fault in SENSOR_FAULTS:
                measured = [spoiled(self.fault, sound, state) for state in measured]
            measured = [self._stamped(state) for state in measured]
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
                decision = safety.damped()
                machine.damp()
                if safety.faulted:
                    self.damped = decision
                    self.damped_at = t
                    self.is_falling = is_falling(machine, safety.limits)
                    return
            else:
                sent, decision = safety.judge(states or [newest], desired.command, t)
                self.seconds += 1.0 / SERVO_HZ
                if sent is None:
                    self.damped = decision
                    self.damped_at = t
                    self.is_falling = is_falling(machine, safety.limits)
                    return
                machine.send(sent)
                for name, (_, quantity) in QUANTITIES.items():
                    more = min if name.startswith("least") else max
                    value = quantity(safety)
                    self.largest[name] = more(self.largest.get(name, value), value)
            if t >= change and self.steady is not None:
                command = self.steady
                change = math.inf
            elif t >= change:
                share = rng.uniform(-1.0, 1.0, 3) * (rng.random(3) < (0.9, 0.3, 0.3))
                x, y, z = (share * FASTEST).tolist()
                command = (x, y, z)
                change = t + float(rng.uniform(1.0, 3.0))
                jump_at = t + 0.5 if rng.random() < 0.5 else math.inf
                self.jumps += jump_at < math.inf
            jump = jump_at <= t < jump_at + 0.5
            if tick % STEP_TICKS == 0:
                if mode_count != modes.mode_count:
                    policy.reset()
                    mode_count = modes.mode_count
                live = modes.mode is Mode.POLICY
                velocity = command if live else STILL
                target = policy.step(measurement(newest), velocity, live and jump)
                record = np.zeros((), ACTIONS)
                record["sequence"] = tick
                record["state_sequence"] = newest.sequence
                record["mode_count"] = mode_count
                record["made"] = t
                record["valid_for"] = 0.05
                record["position"] = target
                under_way.append((tick + LATE_TICKS, record))


LATE = "states-30-ms-old"
WALK = (1.0, 0.0, 0.0)
"""Forward, left [m/s], yaw rate [rad/s] at the begin of a fault."""
CLOCK_ALONE = "clock-alone"
"""No fault but that of the robot's own clock."""
FAULTS = (*SENSOR_FAULTS, *BODY_FAULTS, LATE, CLOCK_ALONE)


def quiet(policy: Path, sets: int, seed: int, number: int) -> list[Row]:
    """Fly for two minutes without a fault."""
    flight = Flight(
        policy=policy,
        params=draw_params(number % sets, load_robot(load_policy(policy).contract.robot)),
        seed=_SEEDS * seed + number,
        loss=LOSS if number % 3 == 2 else 0.0,
        coarse=number // sets % 2 == 1,
    )
    end = "time"
    try:
        flight.run(120.0)
    except HardwareError:
        end = "physics ran away"
    alarm = ""
    if flight.damped is not None:
        end = flight.damped.reason.name
        # Whatever damps a robot that falls is no false alarm.
        if flight.damped.reason in SUPERVISED and not flight.is_falling:
            alarm = f"{flight.damped_at:.3f} s: {flight.damped.text}"
    names = ("seconds", "jumps", "largest")
    row = {name: getattr(flight, name) for name in names}
    return [{"flight": number, "end": end, "alarm": alarm, **row}]


def struck(policy: Path, seed: int, job: tuple[str, str, int]) -> list[Row]:
    """Time from a fault to damping [s] and the reason; NaN where it is not found in 4 s.

    The job is a fault, the robot's own clock from its begin on, and the number of the run.
    """
    fault, clock, k = job
    begins = 0.0 if fault in SWAPPED else 8.2 + 0.137 * k
    robot = load_robot(load_policy(policy).contract.robot)
    number = k
    while True:
        number += 1
        flight = Flight(
            policy=policy,
            params=draw_params(number, robot),
            seed=_SEEDS * seed + 1000 + number,
            steady=WALK,
            fault="" if fault in (LATE, CLOCK_ALONE) else fault,
            clock=clock,
            fault_at=begins,
            delay_ticks=15 if fault == LATE else 0,
            coarse=k % 2 == 1,
        )
        flight.run(begins + 4.0)
        if not flight.damped_at < begins:  # else it fell before
            break
    reason = "none" if flight.damped is None else flight.damped.reason.name
    time_s = flight.damped_at - begins
    return [{"fault": fault, "clock": clock, "run": k, "time_s": time_s, "reason": reason}]


def fly(
    policy: Path,
    hours: float,
    sets: int,
    runs: int,
    clocks: tuple[str, ...],
    seed: int,
    jobs: int,
    out: Path | None,
) -> Iterator[Row]:
    """Rows in `out`, then of `quiet` until so many hours are flown, then of `struck`."""
    rows = rows_in(out)
    yield from rows
    flown = sum(row.get("seconds", 0.0) for row in rows)
    first = sum("flight" in row for row in rows)
    flights = (partial(quiet, policy, sets, seed, number) for number in count(first))
    for row in rows_of(flights, jobs, out) if flown < 3600.0 * hours else ():
        yield row
        flown += row["seconds"]
        if flown >= 3600.0 * hours:
            break
    done = {(row["fault"], row["clock"], row["run"]) for row in rows if "fault" in row}
    waiting = []
    for job in product(FAULTS, clocks, range(runs)):
        if job not in done and job[:2] != (CLOCK_ALONE, "right"):
            waiting.append(partial(struck, policy, seed, job))
    yield from rows_of(waiting, jobs, out)


def supervision(
    policy: tyro.conf.Positional[Path],
    hours: float = 0.1,
    sets: int = 10,
    runs: int = 10,
    clocks: str = "right,stuck,fast,jumps",
    seed: int = 0,
    jobs: int = 1,
    out: Path | None = None,
    docs: Path | None = None,
) -> console.Outcome:
    """False alarms of the supervision of sensors, and the time in which it finds faults.

    Args:
        policy: policy.onnx that walks and jumps.
        hours: Of walking and jumping without a fault.
        sets: Parameter sets of the virtual robot.
        runs: With each fault, each at another moment of the gait and another parameter set.
        clocks: The robot's own clock from the begin of a fault on, separated by commas.
        seed: Of noise, commands and losses.
        jobs: Processes.
        out: File of rows in JSON, written as they come; a run goes on from those that are there.
        docs: Page whose sections of the rows that are there are written.
    """
    robot = load_robot(load_policy(policy).contract.robot)
    rows: list[Row] = []
    with console.progress() as report:
        for row in fly(policy, hours, sets, runs, tuple(clocks.split(",")), seed, jobs, out):
            rows.append(row)
            if "run" in row:
                report(
                    "faults", min(len(rows) / (len(FAULTS) * len(clocks.split(",")) * runs), 1.0)
                )
            else:
                flown_s = sum(flight.get("seconds", 0.0) for flight in rows)
                share = flown_s / (3600.0 * hours) if hours > 0.0 else 1.0
                report("walking and jumping", min(share, 1.0))
    tables = []
    command = f"python -m benchmarks supervision POLICY --seed {seed} --sets {sets}"
    flights = [row for row in rows if "flight" in row]
    if flights:
        table = table_of_flights(flights, sets, Limits.of(robot))
        tables.append(table)
        if docs is not None:
            write_section(docs, "flights", f"Measured by `{command}`.\n\n{as_markdown(table)}")
    strikes = [row for row in rows if "fault" in row]
    if strikes:
        table = table_of_faults(strikes, clocks.split(","))
        tables.append(table)
        if docs is not None:
            text = f"Measured by `{command} --runs {runs}`.\n\n{as_markdown(table)}"
            write_section(docs, "faults by the robot's clock", text)
    return finish({"rows": rows}, *tables)


def table_of_flights(flights: list[Row], sets: int, limits: Limits) -> Table:
    """Make the table of the largest quantities of flights without a fault.

    Args:
        flights: Rows of `quiet`.
        sets: Number of parameter sets.
        limits: Limits of the robot.
    """
    largest_rows: list[tuple[Cell, ...]] = []
    for name, (limit_of, _) in QUANTITIES.items():
        values = [row["largest"][name] for row in flights if name in row["largest"]]
        value = (min if name.startswith("least") else max)(values, default=math.nan)
        largest_rows.append((name, value, f"{limit_of(limits):g}"))
    for row in flights:
        if row["alarm"]:
            console.say(f"flight {row['flight']}, {row['alarm']}")
    ends = Counter(row["end"] for row in flights)
    title = (
        f"{sum(row['seconds'] for row in flights) / 3600.0:.2f} h, {len(flights)} flights of "
        f"{sets} parameter sets, {sum(row['jumps'] for row in flights)} jumps: "
        f"{counted(sum(bool(row['alarm']) for row in flights), 'false alarm')}"
    )
    end_counts = ", ".join(f"{name} {number}" for name, number in ends.items())
    return Table(
        title=title,
        columns=(
            Column(heading="quantity"),
            Column(heading="largest", digits=4),
            Column(heading="limit"),
        ),
        rows=tuple(largest_rows),
        notes=(f"Ends of the flights: {end_counts}.",),
    )


def table_of_faults(strikes: list[Row], clocks: list[str]) -> Table:
    """Make the table of times from a fault to damping.

    Args:
        strikes: Rows of `struck`.
        clocks: Names of the robot's clocks that are shown.
    """
    fault_rows: list[tuple[Cell, ...]] = []
    for name, clock in product(FAULTS, clocks):
        of_fault = [row for row in strikes if (row["fault"], row["clock"]) == (name, clock)]
        if not of_fault:
            continue
        times = 1e3 * np.array([row["time_s"] for row in of_fault])
        missed = int(np.isnan(times).sum())
        if missed == len(of_fault):
            median = ""
            worst = "not found"
        else:
            median = f"{np.nanmedian(times):.0f}"
            worst = f"{np.nanmax(times):.0f}"
        reasons = Counter(row["reason"] for row in of_fault)
        texts = ", ".join(f"{reason} {number}" for reason, number in reasons.items())
        found = f"{len(of_fault) - missed}/{len(of_fault)}"
        fault_rows.append((name, clock, median, worst, found, texts))
    headings = ("fault", "robot's clock", "median", "worst", "found", "reasons")
    return Table(
        title="From a fault to damping [ms]",
        columns=tuple(Column(heading=heading) for heading in headings),
        rows=tuple(fault_rows),
    )


def as_markdown(table: Table) -> str:
    """Write a table with its title and notes in Markdown."""
    lines = [table.title, "", "| " + " | ".join(column.title for column in table.columns) + " |"]
    lines.append("| " + " | ".join("---" for _ in table.columns) + " |")
    for cells in table.text_rows():
        lines.append("| " + " | ".join(cells) + " |")
    for note in table.notes:
        lines += ["", note]
    return "\n".join(lines)
