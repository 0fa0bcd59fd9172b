"""Logs of joints whose mechanism is known: honest ones, and ones that no rigid joint explains.

The integrator is written out here (semi-implicit Euler at a tenth of a millisecond, all joints of a
batch at once) and shares nothing with the simulators of the match.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy import signal
from scipy.optimize import least_squares

from pronk.arrays import Array
from pronk.identify.logs.joint_log import JointLog
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec

STEP_S = 1e-4
"""Step of the integration [s]: a fiftieth of that of the match."""
GRAVITY = 9.81
SWEEP_S = 16.0
"""Length of a chirp [s]."""
REST_S = 1.0
"""Rest after a chirp [s]."""
MATCH_STEP_S = 0.005
"""Physics step of the simulator that is matched [s]."""
HELD_S = (0.001, 0.005, 0.01, 0.02)
"""Times for which a sender may hold a command [s]."""
LOG_HZ = (100.0, 188.0, 250.0, 500.0, 1000.0)
"""Rates of a log [Hz]."""
FAULTS = (
    "compliance, motor encoder",
    "compliance, link encoder",
    "saturation, limit wrong",
    "saturation, limit known",
    "backlash",
    "dead band",
    "stribeck",
    "load friction",
    "integral",
    "velocity feed-forward",
    "filtered position",
    "filtered command",
    "scale",
    "delayed command column",
    "coarse encoder",
    "cogging",
    "payload",
    "torque lag",
    "speed lag",
    "speed limit",
    "acceleration limit",
)
"""What can be wrong with a joint or its log."""


@dataclass(frozen=True, kw_only=True)
class Mechanism:
    """A joint, its drive and its log."""

    stiffness: float
    damping: float
    armature: float
    """Inertia of the rotor at the joint [kg m^2]."""
    mass: float
    """Mass of the link, a point at its end [kg]."""
    length: float
    """Length of the link [m]."""
    hangs: bool
    """True if gravity pulls the link to zero; False if its axis is vertical."""
    frictionloss: float
    delay_s: float
    amplitude: float
    top_hz: float
    noise: float
    """Noise on the position: its deviation [rad], white; below zero the step of the encoder."""
    log_hz: float
    held_s: float
    """Time for which the sender holds a command [s]."""
    fault: str = ""
    """One of `FAULTS`, or nothing."""
    size: float = 0.0
    """Size of the fault, 0 (small) to 1 (large)."""
    effort_limit: float = 0.0
    """Torque limit in the robot's file [N m]; 0 for that of the drive."""

    @property
    def link_inertia(self) -> float:
        """Inertia of the link about the joint [kg m^2]."""
        return self.mass * self.length**2

    @property
    def inertia(self) -> float:
        """Inertia of the joint, rotor included [kg m^2]."""
        return self.link_inertia + self.armature

    @property
    def gravity_stiffness(self) -> float:
        """How much gravity pulls the link back [N m/rad]."""
        return self.mass * GRAVITY * self.length if self.hangs else 0.0

    @property
    def spring(self) -> float:
        """Stiffness between motor and link where the fault is a compliance [N m/rad]."""
        return self.stiffness * (2.5 - 1.9 * self.size)

    @property
    def true_limit(self) -> float:
        """Torque limit of the drive [N m]; where it is wrong in the file, that has another."""
        peak = self.stiffness * self.amplitude
        if self.fault.startswith("saturation"):
            return peak * (0.6 - 0.4 * self.size)
        return 20.0 * peak


def draw_mechanism(rng: np.random.Generator, fault: str = "") -> Mechanism:
    """Draw a joint: 0.5 to 500 N m/rad, links of 5 g to 50 kg, natural frequency 2 to 9 Hz."""
    stiffness = float(np.exp(rng.uniform(np.log(0.5), np.log(500.0))))
    natural = 2.0 * np.pi * float(np.exp(rng.uniform(np.log(2.0), np.log(9.0))))
    inertia = stiffness / natural**2
    armature = inertia * float(rng.uniform(0.1, 0.8))
    link = inertia - armature
    mass = float(np.clip(60.0 * link**0.6, 0.005, 50.0))
    amplitude = float(rng.uniform(0.1, 0.4))
    frictionless = rng.random() < 0.15
    friction = 0.0 if frictionless else float(rng.uniform(0.0, 0.08)) * stiffness * amplitude
    encoder = -2.0 * np.pi / 2.0 ** int(rng.integers(12, 17))
    white = float(np.exp(rng.uniform(np.log(5e-5), np.log(1e-3))))
    log_hz = float(rng.choice(LOG_HZ))
    top_hz = float(np.clip(2.0 * natural / (2.0 * np.pi), 4.0, min(16.0, log_hz / 8.0)))
    return Mechanism(
        stiffness=stiffness,
        damping=2.0 * float(rng.uniform(0.25, 0.9)) * stiffness / natural,
        armature=armature,
        mass=mass,
        length=float(np.sqrt(link / mass)),
        hangs=bool(rng.random() < 0.4),
        frictionloss=friction,
        delay_s=float(rng.uniform(0.0, 0.012)),
        amplitude=amplitude,
        top_hz=top_hz,
        noise=encoder if rng.random() < 0.5 else white,
        log_hz=log_hz,
        held_s=float(rng.choice(HELD_S)),
        fault=fault,
        size=float(rng.uniform(0.0, 1.0)) if fault else 0.0,
    )


def chirp_commands(mechanisms: list[Mechanism]) -> Array:
    """Commands at the steps of the integration [rad], shape (steps, mechanisms)."""
    time = STEP_S * np.arange(round((SWEEP_S + REST_S) / STEP_S))
    columns = []
    for joint in mechanisms:
        held = np.floor(time / joint.held_s + 1e-6) * joint.held_s
        phase = 2.0 * np.pi * (0.1 * held + 0.5 * (joint.top_hz - 0.1) / SWEEP_S * held**2)
        wave = np.minimum(held / 0.5, 1.0) * np.sin(phase)
        columns.append(np.where(held < SWEEP_S - 1e-9, joint.amplitude * wave, 0.0))
    return np.array(columns).T


def simulate_mechanisms(mechanisms: list[Mechanism], command: Array) -> Array:
    """Integrate all joints from rest; the readings of their encoders [rad], as `command`."""

    def of_fault(name: str, values: list[float], otherwise: float = 0.0) -> Array:
        chosen = []
        for joint, value in zip(mechanisms, values, strict=True):
            chosen.append(value if joint.fault.startswith(name) else otherwise)
        return np.array(chosen)

    sizes = np.array([joint.size for joint in mechanisms])
    stiffness = np.array([joint.stiffness for joint in mechanisms])
    damping = np.array([joint.damping for joint in mechanisms])
    armature = np.array([joint.armature for joint in mechanisms])
    link = np.array([joint.link_inertia for joint in mechanisms])
    pull = np.array([joint.gravity_stiffness for joint in mechanisms])
    coulomb = np.array([joint.frictionloss for joint in mechanisms])
    amplitude = np.array([joint.amplitude for joint in mechanisms])
    peak = stiffness * amplitude
    natural = np.sqrt(stiffness / (armature + link))
    compliant = np.array([joint.fault.startswith("compliance") for joint in mechanisms])
    reads_link = np.array([joint.fault == "compliance, link encoder" for joint in mechanisms])
    spring = np.array([joint.spring for joint in mechanisms])
    limit = np.array([joint.true_limit for joint in mechanisms])
    gap = of_fault("backlash", list(amplitude * (0.1 + 0.4 * sizes)))
    band = of_fault("dead band", list(amplitude * (0.05 + 0.25 * sizes)))
    stribeck = of_fault("stribeck", list(peak * (0.1 + 0.2 * sizes)))
    load = of_fault("load friction", list(0.2 + 0.4 * sizes))
    integral = of_fault("integral", list(stiffness * natural * (0.1 + 0.3 * sizes)))
    forward = of_fault("velocity feed-forward", list(damping * (0.5 + 0.5 * sizes)))
    filter_position = of_fault("filtered position", list((0.1 + 0.5 * sizes) / natural))
    filter_command = of_fault("filtered command", list((0.2 + 0.8 * sizes) / natural))
    cogging = of_fault("cogging", list(peak * (0.1 + 0.2 * sizes)))
    payload = of_fault("payload", list(0.3 + 1.0 * sizes))
    torque_lag = of_fault("torque lag", list((0.1 + 0.3 * sizes) / natural))
    speed_lag = of_fault("speed lag", list((0.3 + 1.0 * sizes) / natural))
    speed_limit = of_fault("speed limit", list(amplitude * natural * (0.6 - 0.4 * sizes)), np.inf)
    rate_limit = of_fault(
        "acceleration limit", list(amplitude * natural**2 * (0.6 - 0.4 * sizes)), np.inf
    )
    link = link * (1.0 + payload)
    pull = pull * (1.0 + payload)
    total = armature + link
    command_share = STEP_S / np.maximum(filter_command, STEP_S)
    torque_share = STEP_S / np.maximum(torque_lag, STEP_S)
    speed_share = STEP_S / np.maximum(speed_lag, STEP_S)
    late = np.zeros_like(command)
    for column, joint in enumerate(mechanisms):
        rows = round(joint.delay_s / STEP_S)
        late[rows:, column] = command[: len(command) - rows, column]

    count = len(mechanisms)
    motor = np.zeros(count)
    speed = np.zeros(count)
    end = np.zeros(count)
    end_speed = np.zeros(count)
    target = np.zeros(count)
    target_speed = np.zeros(count)
    summed = np.zeros(count)
    torque = np.zeros(count)
    slow_speed = np.zeros(count)
    last_command = np.zeros(count)
    last_sent = np.zeros(count)
    command_speed = np.zeros(count)
    reading = np.empty_like(command)
    shaped = bool(np.isfinite(speed_limit).any() or np.isfinite(rate_limit).any())
    has_compliance = bool(compliant.any())
    has_cogging = bool(cogging.any())
    has_load_friction = bool(load.any())
    has_stribeck = bool(stribeck.any())
    for step, sent in enumerate(late):
        measured = np.where(reads_link, end, motor) if has_compliance else motor
        reading[step] = measured
        target = target + command_share * (sent - target)
        goal = target
        if shaped:
            # A servo's own profile: the fastest approach within its speed and acceleration.
            error = sent - last_command
            approach = np.where(np.isfinite(rate_limit), rate_limit, 0.0)
            braking = np.sign(error) * np.sqrt(2.0 * approach * np.abs(error))
            direct = np.clip(error / STEP_S, -speed_limit, speed_limit)
            wanted = np.where(np.isfinite(rate_limit), braking, direct)
            change = np.where(np.isfinite(rate_limit), rate_limit * STEP_S, np.inf)
            command_speed = command_speed + np.clip(wanted - command_speed, -change, change)
            profiled = np.isfinite(speed_limit) | np.isfinite(rate_limit)
            last_command = np.where(profiled, last_command + STEP_S * command_speed, sent)
            goal = np.where(profiled, last_command, goal)
        sent_speed = (sent - last_sent) / STEP_S
        target_speed = target_speed + 0.01 * (sent_speed - target_speed)
        last_sent = sent
        error = goal - measured
        error = np.sign(error) * np.maximum(np.abs(error) - band, 0.0)
        summed = summed + STEP_S * error
        slow_speed = slow_speed + speed_share * (speed - slow_speed)
        asked = (
            stiffness * error + integral * summed + forward * target_speed - damping * slow_speed
        )
        torque = torque + torque_share * (np.clip(asked, -limit, limit) - torque)
        applied = torque
        if has_cogging:
            applied = torque + cogging * np.sin(40.0 * motor)
        friction = coulomb
        if has_load_friction:
            weight = np.abs(pull * np.sin(motor))
            friction = coulomb + load * weight + load * 0.3 * np.abs(torque)
        if has_stribeck:
            friction = friction + stribeck * np.exp(-((speed / (0.1 * amplitude * natural)) ** 2))
        if has_compliance:
            twist = spring * (motor - end) + 0.02 * damping * (speed - end_speed)
            end_speed = end_speed + STEP_S * (twist - pull * np.sin(end)) / link
            end = end + STEP_S * end_speed
            load_torque = np.where(compliant, twist, pull * np.sin(motor))
            moved = np.where(compliant, armature, total)
        else:
            load_torque = pull * np.sin(motor)
            moved = total
        free = speed + STEP_S * (applied - load_torque) / moved
        stop = STEP_S * friction / moved
        speed = np.sign(free) * np.maximum(np.abs(free) - stop, 0.0)
        motor = motor + STEP_S * speed
    for column, joint in enumerate(mechanisms):
        if joint.fault == "filtered position":
            share = STEP_S / max(filter_position[column], STEP_S)
            reading[:, column] = signal.lfilter([share], [1.0, share - 1.0], reading[:, column])
        if joint.fault == "backlash":
            reading[:, column] = _with_play(reading[:, column], gap[column])
    return reading


def _with_play(position: Array, gap: float) -> Array:
    """The angle of a part that follows another with play [rad], shape (n,)."""
    followed = np.empty_like(position)
    value = 0.0
    half = 0.5 * gap
    for index, angle in enumerate(position.tolist()):
        value = min(max(value, angle - half), angle + half)
        followed[index] = value
    return followed


def mechanism_log(
    joint: Mechanism, command: Array, reading: Array, rng: np.random.Generator
) -> JointLog:
    """The log of one joint, at its rate, with noise and jitter; arrays have shape (steps,)."""
    ticks = np.arange(0.0, SWEEP_S + REST_S - 0.01, 1.0 / joint.log_hz)
    rows = np.round(ticks / STEP_S).astype(int)
    jitter_s = rng.uniform(0.0, 0.05, len(rows)) / joint.log_hz
    rows = rows + np.round(jitter_s / STEP_S).astype(int)
    position = reading[rows]
    if joint.fault == "scale":
        position = position * (1.3 + 0.5 * joint.size)
    noise = joint.noise
    if joint.fault == "coarse encoder":
        noise = -joint.amplitude * (0.05 + 0.2 * joint.size)
    if noise < 0.0:
        position = -noise * np.round(position / -noise)
    else:
        position = position + noise * rng.standard_normal(len(position))
    logged = command[rows]
    if joint.fault == "delayed command column":
        late = round((0.015 + 0.03 * joint.size) / STEP_S)
        logged = command[np.maximum(rows - late, 0)]
    return JointLog(
        robot="mechanism",
        joints=("j",),
        time=rows * STEP_S,
        command=logged[:, None],
        position=position[:, None],
        stiffness=np.array([joint.stiffness]),
        damping=np.array([joint.damping]),
    )


def mechanism_robot(joint: Mechanism, folder: Path) -> RobotSpec:
    """Write the model and the robot's file of a joint, and load them."""
    folder.mkdir(parents=True, exist_ok=True)
    axis = "0 1 0" if joint.hangs else "0 0 1"
    place = f"0 0 {-joint.length:.9g}" if joint.hangs else f"{joint.length:.9g} 0 0"
    (folder / "joint.xml").write_text(
        f"""<mujoco model="mechanism"><compiler angle="radian"/><worldbody>
  <body name="base"><inertial pos="0 0 0" mass="1" diaginertia="1e-3 1e-3 1e-3"/>
    <body name="link"><joint name="j" type="hinge" axis="{axis}" range="-3 3"/>
      <inertial pos="{place}" mass="{joint.mass:.9g}" diaginertia="1e-12 1e-12 1e-12"/>
    </body></body></worldbody></mujoco>"""
    )
    limit = joint.effort_limit or joint.true_limit
    if joint.fault == "saturation, limit wrong":
        limit = 10.0 * joint.stiffness * joint.amplitude
    speed = 100.0 * joint.amplitude * np.sqrt(joint.stiffness / joint.inertia)
    (folder / "robot.yaml").write_text(
        f"""schema: pronk/robot/1
name: mechanism
model: joint.xml
policy_rate_hz: 50.0
timestep_s: {MATCH_STEP_S}
decimation: 4
grid_stiffness: [{0.3 * joint.stiffness:.9g}, {3.0 * joint.stiffness:.9g}]
grid_damping: [{0.1 * joint.damping:.9g}, {4.0 * joint.damping:.9g}]
drives:
  j: {{effort_limit: {limit:.9g}, stall_torque: {20.0 * limit:.9g}, no_load_speed: {speed:.9g},
    bus_voltage: 24.0, gear_ratio: 1.0, armature: {joint.armature:.9g}, frictionloss: 0.0,
    viscous_damping: 0.0}}
groups:
  j: {{drive: j, stiffness: {joint.stiffness:.9g}, damping: {joint.damping:.9g},
    band_hz: [0.2, {joint.top_hz:.6g}]}}
poses:
  default: {{j: 0.0}}
"""
    )
    return load_robot(folder / "robot.yaml")


def equivalent_gains(joint: Mechanism) -> tuple[float, float]:
    """Stiffness and damping of the explicit step of the match that move as the real joint does.

    The step holds the position of its start, which acts as less damping; the closed forms of both
    are compared over the joint's band, with a delay that is free.
    """
    omega = 2.0 * np.pi * np.linspace(0.2, joint.top_hz, 60)
    s = 1j * omega
    pull = joint.gravity_stiffness
    real = joint.stiffness / (joint.inertia * s**2 + joint.damping * s + joint.stiffness + pull)
    z = np.exp(s * MATCH_STEP_S)
    speed = MATCH_STEP_S / (joint.inertia * (z - 1.0))
    position = MATCH_STEP_S * z * speed / (z - 1.0)
    half_turn = omega * MATCH_STEP_S / 2.0
    hold = np.exp(-1j * half_turn) * np.sinc(half_turn / np.pi)

    def difference(x: Array) -> Array:
        stiffness = joint.stiffness * np.exp(x[0])
        damping = joint.damping * np.exp(x[1])
        stepped = stiffness * position
        stepped = stepped / (1.0 + (stiffness + pull) * position + damping * speed) / hold
        error = np.log(stepped * np.exp(-s * x[2]) / real)
        return np.asarray(np.concatenate([error.real, error.imag]))

    best = least_squares(difference, np.zeros(3), x_scale=[0.1, 0.1, 1e-3]).x
    return joint.stiffness * float(np.exp(best[0])), joint.damping * float(np.exp(best[1]))


def with_fault(joint: Mechanism, fault: str, size: float = 0.5) -> Mechanism:
    """The same joint with a fault."""
    return replace(joint, fault=fault, size=size)
