"""Logs of a joint by an integrator of the benchmark's own, and what a right match finds in them.

A drive pulls the rigid joint of `joints` by `stiffness (command - position) - damping velocity`,
with dry and viscous friction and a delay. The integrator steps by 0.1 ms or less (the trapezoidal
rule for what is linear in the velocity, forces at the middle of the step, exact rest under dry
friction); nothing of pronk's simulators is used. Encoder, noise, clock and rates are those of the
`Recording`.

A match finds the gains of a simulator that steps by 5 ms, which are not those of the continuous
drive. The gains of that law that respond like the true joint are computed in two ways that know
nothing of pronk: `linear_gains` by the linear response, `simulator_gains` by plain MuJoCo. Where
dry friction is strong and the log short, they differ, since no gains of a 5 ms step give the
motion: an interval that reaches between the two is right.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from benchmarks.foreign.joints import (
    NAME,
    RigidJoint,
    StatedDrive,
    draw_armature,
    draw_joint,
    write_robot,
)

Array = NDArray[np.float64]

STEP_S = 1e-4
"""Step of the integrator for a rigid joint [s]: a hundredth of a turn of 100 Hz."""
FINE_STEP_S = 2.5e-5
"""Step where a spring is between motor and link [s]."""
MATCHED_STEP_S = 0.005
"""Step of the simulator that pronk matches (mjlab's)."""
REST_S = 0.5
"""Rest at either end of a log and between signals [s]."""
RATE_OVER_NATURAL = 6.0
"""Least rate of the commands over the natural frequency of the joint."""
COMMAND_RATES_HZ = (20.0, 25.0, 40.0, 50.0, 100.0, 125.0, 200.0, 250.0, 333.0, 400.0, 500.0)


@dataclass(frozen=True, kw_only=True)
class Drive:
    """A drive with its gear, friction and controller; the defaults have no fault."""

    stiffness: float
    """[N m/rad]."""
    damping: float
    """[N m s/rad]."""
    viscous: float = 0.0
    """Viscous friction [N m s/rad]."""
    coulomb: float = 0.0
    """Dry friction in motion [N m]."""
    delay_s: float = 0.0
    """From the instant of a command to its effect [s]."""
    limit: float = math.inf
    """Largest torque [N m]."""
    stiction: float = 0.0
    """Dry friction at rest over that in motion, less one (Stribeck)."""
    stribeck_speed: float = 0.1
    """Speed at which a third of that excess is left [rad/s]."""
    load_friction: float = 0.0
    """Dry friction for each N m of torque of the drive."""
    dead_band: float = 0.0
    """Error of the position below which the controller gives no torque, and which it subtracts from
    larger errors [rad]."""
    integral: float = 0.0
    """Integral gain over stiffness [1/s]."""
    spring: float = 0.0
    """Stiffness between motor and link [N m/rad]; 0 for a rigid gear."""
    spring_damping: float = 0.0
    """Damping of that spring [N m s/rad]."""
    play: float = 0.0
    """Angle through which the gear turns freely [rad]."""
    encoder_on_link: bool = False
    """Where the drive and the log measure, where the gear is not rigid."""


@dataclass(frozen=True, kw_only=True)
class Signal:
    """Offsets of the command about 0."""

    kind: str
    """chirp, multisine, repeats or sine."""
    rate_hz: float
    """Rate of the commands [Hz]."""
    band_hz: tuple[float, float]
    """Lowest and highest frequency [Hz]."""
    offsets: Array
    """Commands at the rate, from the first sample of the log [rad], shape (n,)."""
    logged: Array | None = None
    """Commands as they are logged, where the drive did not get all of them."""


@dataclass(frozen=True, kw_only=True)
class Recording:
    """How the motion is recorded."""

    rate_hz: float
    """Samples a second."""
    resolution: float
    """Step of the encoder [rad]."""
    noise: float
    """Standard deviation of the noise of the position, before the encoder [rad]."""
    jitter_s: float
    """Standard deviation of the instants of sampling, which the log has right [s]."""
    has_velocity: bool
    """Whether the log has a velocity column."""


@dataclass(frozen=True, kw_only=True)
class LogCase:
    """A log with the truth behind it."""

    number: int
    joint: RigidJoint
    """The joint as the robot.yaml has it."""
    moving: RigidJoint
    """The joint that moves; another one where a payload is on it."""
    drive: Drive
    stated: StatedDrive
    signal: Signal
    recording: Recording
    seed: int = 0
    """Of noise and jitter."""
    columns: dict[str, Array] = field(default_factory=dict)
    """Columns of the log by name, `time`, `command`, `position` and maybe `velocity`."""


# ---- the joint ----


def delayed_commands(drive: Drive, signal: Signal) -> list[float]:
    """Return the commands that a drive has at steps of `STEP_S`, late by its delay [rad]."""
    duration_s = len(signal.offsets) / signal.rate_hz
    instants = np.arange(round(duration_s / STEP_S)) * STEP_S - drive.delay_s
    index = np.clip(np.floor(instants * signal.rate_hz + 1e-9), 0, len(signal.offsets) - 1)
    commands: list[float] = signal.offsets[index.astype(int)].tolist()
    return commands


def rigid_motion(joint: RigidJoint, drive: Drive, signal: Signal) -> tuple[Array, Array, Array]:
    """Integrate a joint with a rigid gear.

    Returns:
        Position [rad], velocity [rad/s] and torque of the drive [N m] at steps of `STEP_S`.
    """
    step = STEP_S
    commands = delayed_commands(drive, signal)
    position = np.empty(len(commands))
    velocity = np.empty(len(commands))
    torque = np.empty(len(commands))
    stiffness = drive.stiffness
    inertia = joint.inertia
    gravity_cos = -joint.gravity_torque * math.cos(joint.gravity_phase)
    gravity_sin = -joint.gravity_torque * math.sin(joint.gravity_phase)
    limit = drive.limit
    # The drive holds the joint against gravity before the log begins.
    q = rest_angle(joint, drive, commands[0])
    v = 0.0
    summed = 0.0
    last_torque = stiffness * (commands[0] - q)
    if drive.integral:
        q = commands[0]
        summed = -joint.gravity_at(q) / (stiffness * drive.integral)
        last_torque = -joint.gravity_at(q)
    cos = math.cos
    sin = math.sin
    for number, command in enumerate(commands):
        position[number] = q
        velocity[number] = v
        middle = q + 0.5 * step * v
        error = command - middle
        if drive.dead_band:
            error = math.copysign(max(abs(error) - drive.dead_band, 0.0), error)
        spring_torque = stiffness * error
        if drive.integral:
            summed += step * error
            spring_torque += stiffness * drive.integral * summed
        damping = drive.damping
        demanded = spring_torque - damping * v
        if demanded > limit or demanded < -limit:
            spring_torque = limit if demanded > 0.0 else -limit
            damping = 0.0
        gravity = gravity_cos * cos(middle) + gravity_sin * sin(middle)
        friction = drive.coulomb
        if drive.load_friction:
            friction += drive.load_friction * abs(last_torque)
        at_rest = friction
        if drive.stiction:
            at_rest = friction * (1.0 + drive.stiction)
            excess = math.exp(-((v / drive.stribeck_speed) ** 2))
            friction *= 1.0 + drive.stiction * excess
        push = spring_torque + gravity
        linear = 0.5 * step * (damping + drive.viscous) / inertia
        if v == 0.0:
            if -at_rest <= push <= at_rest:
                torque[number] = spring_torque
                last_torque = spring_torque
                continue
            sign = 1.0 if push > 0.0 else -1.0
        else:
            sign = 1.0 if v > 0.0 else -1.0
        after = ((1.0 - linear) * v + step * (push - sign * friction) / inertia) / (1.0 + linear)
        if v * after < 0.0:
            after = 0.0
        torque[number] = spring_torque - damping * 0.5 * (v + after)
        last_torque = torque[number]
        q += 0.5 * step * (v + after)
        v = after
    return position, velocity, torque


def geared_motion(joint: RigidJoint, drive: Drive, signal: Signal) -> tuple[Array, Array, Array]:
    """Integrate a motor and a link with a spring, and maybe play, between them.

    The semi-implicit rule at `FINE_STEP_S`; friction acts on the motor.

    Returns:
        Measured position [rad], its velocity [rad/s] and torque of the drive [N m], at steps of
        `STEP_S`.
    """
    step = FINE_STEP_S
    skip = round(STEP_S / step)
    commands = delayed_commands(drive, signal)
    position = np.empty(len(commands))
    velocity = np.empty(len(commands))
    torque = np.empty(len(commands))
    motor_inertia = joint.armature
    link_inertia = joint.link_inertia
    half_play = 0.5 * drive.play
    link = rest_angle(joint, drive, commands[0])
    twist = -joint.gravity_at(link) / drive.spring
    motor = link + twist + math.copysign(half_play, twist)
    motor_speed = 0.0
    link_speed = 0.0
    applied = 0.0
    for number, command in enumerate(commands):
        position[number] = link if drive.encoder_on_link else motor
        velocity[number] = link_speed if drive.encoder_on_link else motor_speed
        for _ in range(skip):
            angle = link if drive.encoder_on_link else motor
            speed = link_speed if drive.encoder_on_link else motor_speed
            applied = drive.stiffness * (command - angle) - drive.damping * speed
            applied = min(max(applied, -drive.limit), drive.limit)
            twist = motor - link
            stretch = math.copysign(max(abs(twist) - half_play, 0.0), twist)
            coupling = 0.0
            if stretch:
                coupling = drive.spring * stretch
                coupling += drive.spring_damping * (motor_speed - link_speed)
            push = applied - coupling - drive.viscous * motor_speed
            if motor_speed == 0.0:
                slowing = min(max(push, -drive.coulomb), drive.coulomb)
            else:
                slowing = math.copysign(drive.coulomb, motor_speed)
            after = motor_speed + step * (push - slowing) / motor_inertia
            if motor_speed * after < 0.0:
                after = 0.0
            motor_speed = after
            link_speed += step * (coupling + joint.gravity_at(link)) / link_inertia
            motor += step * motor_speed
            link += step * link_speed
        torque[number] = applied
    return position, velocity, torque


def motion(joint: RigidJoint, drive: Drive, signal: Signal) -> tuple[Array, Array, Array]:
    """Integrate a joint: position, velocity and torque of the drive at steps of `STEP_S`."""
    if drive.spring:
        return geared_motion(joint, drive, signal)
    return rigid_motion(joint, drive, signal)


def rest_angle(joint: RigidJoint, drive: Drive, command: float) -> float:
    """Return the angle at which gravity and the drive balance [rad]."""
    angle = command
    for _ in range(200):
        angle = 0.5 * angle + 0.5 * (command + joint.gravity_at(angle) / drive.stiffness)
    return angle


# ---- the log ----


def recorded(case: LogCase) -> LogCase:
    """Return a case with the columns of its log."""
    position, velocity, _ = motion(case.moving, case.drive, case.signal)
    rng = np.random.default_rng([case.seed, case.number, 1])
    recording = case.recording
    duration_s = len(position) * STEP_S
    count = int(duration_s * recording.rate_hz) - 1
    time = np.arange(count) / recording.rate_hz
    if recording.jitter_s:
        # A tenth of a sample at most, so that instants stay in order.
        deviations = rng.normal(0.0, recording.jitter_s, count)
        time = time + np.clip(deviations, -0.1 / recording.rate_hz, 0.1 / recording.rate_hz)
    fine = np.arange(len(position)) * STEP_S
    measured = np.interp(time, fine, position) + rng.normal(0.0, recording.noise, count)
    measured = recording.resolution * np.round(measured / recording.resolution)
    logged = case.signal.offsets if case.signal.logged is None else case.signal.logged
    index = np.clip(np.floor(time * case.signal.rate_hz + 1e-9), 0, len(logged) - 1)
    columns = {"time": time, "command": logged[index.astype(int)], "position": measured}
    if recording.has_velocity:
        speed = np.interp(time, fine, velocity)
        noise = 0.005 * float(np.std(speed)) + 1e-6
        columns["velocity"] = speed + rng.normal(0.0, noise, count)
    return replace(case, columns=columns)


def write_csv(path: Path, case: LogCase) -> Path:
    """Write the log of a case as CSV with pronk's names of the columns."""
    header = ["time"]
    for name in case.columns:
        if name != "time":
            header.append(name if "." in name else f"{name}.{NAME}")
    table = np.column_stack(list(case.columns.values()))
    np.savetxt(path, table, fmt="%.10g", delimiter=",", header=",".join(header), comments="")
    return path


def write_case(folder: Path, case: LogCase) -> tuple[Path, Path]:
    """Write robot and log of a case; return the paths of the robot.yaml and of the log."""
    robot = write_robot(folder, case.joint, case.stated)
    return robot, write_csv(folder / "log.csv", case)


# ---- drawing ----


def draw_signal(
    rng: np.random.Generator, kind: str, natural_hz: float, rate_hz: float, duration_s: float
) -> Signal:
    """Draw an excitation of unit amplitude whose band goes past a joint's natural frequency.

    Args:
        rng: Source of randomness.
        kind: chirp; multisine: three or more periods; repeats: a chirp three times at each of two
            amplitudes.
        natural_hz: Undamped natural frequency of the joint [Hz].
        rate_hz: Rate of the commands [Hz].
        duration_s: Length of the log [s].
    """
    low_hz = 0.2
    high_hz = min(natural_hz * rng.uniform(1.8, 3.5), 0.35 * rate_hz, 25.0)
    rest = np.zeros(math.ceil(REST_S * rate_hz))
    parts = [rest]
    if kind == "multisine":
        periods = 3
        length = int((duration_s - 2.0 * REST_S) * rate_hz / periods)
        low_hz = max(low_hz, rate_hz / length)
        lines = np.arange(1, length // 2) * rate_hz / length
        lines = lines[(lines >= low_hz) & (lines <= high_hz)]
        ticks = np.arange(length) / rate_hz
        wave = np.zeros(length)
        for hz in lines:
            wave += np.sin(2.0 * math.pi * (hz * ticks + rng.uniform()))
        wave = np.tile(wave / np.abs(wave).max(), periods)
        parts.append(_ramped(wave, rate_hz))
        parts.append(rest)
    else:
        scales = (1.0,) if kind == "chirp" else (1.0, 0.5, 1.0, 0.5, 1.0, 0.5)
        length = int((duration_s - REST_S) * rate_hz / len(scales)) - len(rest)
        ticks = np.arange(length) / rate_hz
        low_hz = max(low_hz, 1.0 * rate_hz / length)
        slope = (high_hz - low_hz) / (length / rate_hz)
        wave = np.sin(2.0 * math.pi * (low_hz * ticks + 0.5 * slope * ticks**2))
        for scale in scales:
            parts.append(scale * _ramped(wave, rate_hz))
            parts.append(rest)
    return Signal(
        kind=kind, rate_hz=rate_hz, band_hz=(low_hz, high_hz), offsets=np.concatenate(parts)
    )


def _ramped(wave: Array, rate_hz: float) -> Array:
    """Return a wave with half a cosine at either end."""
    ramp = min(math.ceil(0.5 * rate_hz), len(wave) // 8)
    rise = 0.5 - 0.5 * np.cos(math.pi * np.arange(ramp) / ramp)
    window = np.ones(len(wave))
    window[:ramp] = rise
    window[len(wave) - ramp :] = rise[::-1]
    return wave * window


def draw_case(seed: int, number: int, joint: RigidJoint | None = None) -> LogCase:
    """Draw an honest log without its columns.

    Args:
        seed: Of the benchmark.
        number: Of the log; the same numbers for the same arguments.
        joint: Joint of a robot; drawn if None. Its armature is drawn.
    """
    rng = np.random.default_rng([seed, number])
    if joint is None:
        joint = draw_joint(rng)
    else:
        joint = replace(joint, armature=draw_armature(rng, joint.link_inertia))
    kind = ("chirp", "multisine", "repeats")[int(rng.integers(3))]
    # A joint sags by a quarter of a radian under gravity at most.
    natural_hz = float(np.exp(rng.uniform(math.log(1.5), math.log(8.0))))
    stiffness = joint.inertia * (2.0 * math.pi * natural_hz) ** 2
    stiffness = max(stiffness, 4.0 * joint.gravity_torque)
    natural_hz = math.sqrt(stiffness / joint.inertia) / (2.0 * math.pi)
    # Commands reach past the resonance.
    rates_hz = [rate for rate in COMMAND_RATES_HZ if rate >= RATE_OVER_NATURAL * natural_hz]
    command_rate_hz = float(rng.choice(rates_hz))
    least_rate_hz = max(100.0, command_rate_hz)
    rate_hz = round(float(np.exp(rng.uniform(math.log(least_rate_hz), math.log(1000.0)))))
    duration_s = float(np.exp(rng.uniform(math.log(6.0), math.log(60.0))))
    if kind == "repeats":
        duration_s = max(duration_s, 30.0)
    amplitude = rng.uniform(0.06, 0.3)
    damping = 2.0 * rng.uniform(0.3, 1.0) * math.sqrt(stiffness * joint.inertia)
    drive = Drive(
        stiffness=stiffness,
        damping=damping,
        viscous=damping * rng.uniform(0.0, 0.2),
        coulomb=stiffness * amplitude * rng.uniform(0.0, 0.08),
        delay_s=rng.uniform(0.0, 0.02),
    )
    signal = draw_signal(rng, kind, natural_hz, command_rate_hz, duration_s)
    signal = replace(signal, offsets=amplitude * signal.offsets)
    bits = int(rng.integers(12, 17))
    recording = Recording(
        rate_hz=rate_hz,
        resolution=2.0 * math.pi / 2**bits,
        noise=rng.uniform(0.0, 3e-4),
        jitter_s=rng.uniform(0.0, 0.05) / rate_hz,
        has_velocity=bool(rng.integers(2)),
    )
    _, velocity, torque = motion(joint, drive, signal)
    limit = float(np.abs(torque).max()) * rng.uniform(1.3, 4.0)
    top_hz = min(signal.band_hz[1], rate_hz / 8.0)
    stated = StatedDrive(
        stiffness=stiffness * rng.uniform(0.7, 1.4),
        damping=damping * rng.uniform(0.7, 1.4),
        effort_limit=limit,
        no_load_speed=4.0 * float(np.abs(velocity).max()),
        band_hz=(signal.band_hz[0], top_hz),
    )
    return LogCase(
        number=number,
        joint=joint,
        moving=joint,
        drive=replace(drive, limit=limit),
        stated=stated,
        signal=signal,
        recording=recording,
        seed=seed,
    )


# ---- the truth of the matched simulator ----


def linear_gains(case: LogCase) -> tuple[float, float, float]:
    """Return the gains of an explicit drive at 5 ms whose linear response is the true joint's.

    With the slope g of gravity, `z = exp(i w h)` and the speed `s = (1 - 1/z) / h` that such a
    drive sees, the response of the simulator is `k / ((z - 1) s J / h + d s + k + g)`, that of the
    joint `k / (k + g - w^2 J + i w d)`. Weighted by the spectrum of the command; no dry friction.

    Returns:
        Stiffness [N m/rad], damping [N m s/rad], and the delay that goes with them [s].
    """
    step = MATCHED_STEP_S
    signal = case.signal
    hz = np.linspace(signal.band_hz[0], signal.band_hz[1], 200)
    spectrum = np.abs(np.fft.rfft(signal.offsets))
    spectrum_hz = np.fft.rfftfreq(len(signal.offsets), 1.0 / signal.rate_hz)
    weight = np.interp(hz, spectrum_hz, np.convolve(spectrum, np.full(9, 1.0 / 9.0), mode="same"))
    omega = 2.0 * math.pi * hz
    drive = case.drive
    inertia = case.joint.inertia
    angle = rest_angle(case.moving, drive, 0.0)
    slope = -case.moving.gravity_torque * math.sin(angle - case.moving.gravity_phase)
    damping = drive.damping + drive.viscous
    static = drive.stiffness + slope
    true = drive.stiffness / (static - omega**2 * inertia + 1j * omega * damping)
    shift = np.exp(1j * omega * step)
    speed = (1.0 - 1.0 / shift) / step
    scale = np.array([drive.stiffness, damping, step])

    def difference(parameters: Array) -> Array:
        stiffness, damping, delay_s = parameters * scale
        law = damping * speed + stiffness + slope
        response = stiffness / ((shift - 1.0) * speed * inertia / step + law)
        residual = weight / weight.max() * (response * np.exp(-1j * omega * delay_s) - true)
        return np.concatenate([residual.real, residual.imag])

    best = least_squares(difference, np.array([0.9, 0.9, 0.0]))
    stiffness, damping, delay_s = best.x * scale
    return float(stiffness), float(damping), float(delay_s)


def simulator_gains(case: LogCase) -> tuple[float, float]:
    """Return the gains with which a plain MuJoCo model at 5 ms moves like the true joint.

    Integrator Euler, a torque `k (u - q) - d v` computed at the beginning of a step and held over
    it, dry friction as of the model. From `linear_gains` on, stiffness, damping, dry friction and
    delay are fitted to the motion without noise, encoder and jitter, by least squares in the band
    of the command. A step has the command in force in its middle; the delay shifts the motion.

    Returns:
        Stiffness [N m/rad] and damping, with that of viscous friction [N m s/rad].
    """
    step = MATCHED_STEP_S
    signal = case.signal
    position, _, _ = motion(case.moving, case.drive, signal)
    skip = round(step / STEP_S)
    true = position[::skip]
    spec = mujoco.MjSpec.from_string(case.joint.mjcf())
    spec.option.timestep = step
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    hinge = spec.joint(NAME)
    hinge.armature = case.joint.armature
    hinge.frictionloss = 1.0  # compiled with friction, so that it can be changed
    spec.add_actuator(name=NAME, target=NAME, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    model = spec.compile()
    data = mujoco.MjData(model)
    starts = np.arange(len(true)) * step
    # Where friction holds a joint at the end is chance, and below the band.
    hz = np.fft.rfftfreq(len(true), step)
    in_band = (hz >= 0.7 * signal.band_hz[0]) & (hz <= 1.3 * signal.band_hz[1])
    index = np.floor((starts + 0.5 * step) * signal.rate_hz).astype(int)
    commands = signal.offsets[np.minimum(index, len(signal.offsets) - 1)].tolist()
    drive = case.drive
    stiffness, damping, delay_s = linear_gains(case)
    friction = max(drive.coulomb, 1e-3 * drive.stiffness)
    scale = np.array([drive.stiffness, drive.damping + drive.viscous, friction, step])

    def simulated(parameters: Array) -> Array:
        stiffness, damping, frictionloss, delay_s = parameters * scale
        model.dof_frictionloss[0] = max(frictionloss, 0.0)
        mujoco.mj_resetData(model, data)
        data.qpos[0] = true[0]
        angles = np.empty(len(true))
        position_now = data.qpos
        velocity_now = data.qvel
        control = data.ctrl
        for number, command in enumerate(commands):
            angle = position_now[0]
            angles[number] = angle
            control[0] = stiffness * (command - angle) - damping * velocity_now[0]
            mujoco.mj_step(model, data)
        spectrum = np.fft.rfft(np.interp(starts - delay_s, starts, angles) - true)[in_band]
        return np.concatenate([spectrum.real, spectrum.imag]) / len(true)

    start = np.array([stiffness, damping, drive.coulomb, delay_s + drive.delay_s]) / scale
    differences = np.full(4, 0.01)
    best = least_squares(simulated, start, diff_step=differences, max_nfev=10)
    stiffness, damping, _, _ = best.x * scale
    return float(stiffness), float(damping)


def true_gains(case: LogCase) -> dict[str, tuple[float, float]]:
    """Return the lowest and highest true stiffness [N m/rad] and damping [N m s/rad] of a log."""
    stiffness, damping, _ = linear_gains(case)
    other_stiffness, other_damping = simulator_gains(case)
    return {
        "stiffness": (min(stiffness, other_stiffness), max(stiffness, other_stiffness)),
        "damping": (min(damping, other_damping), max(damping, other_damping)),
    }
