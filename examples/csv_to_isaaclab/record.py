"""Record `chirp.csv` and `fresh.csv` on a simulated leg that stands in for a robot.

The leg is plain MuJoCo at 0.1 ms with the drive written out below. It differs from what
`robot.yaml` states: the motors give 0.9 of the stated torque, commands arrive 6 ms late, the
joints have dry friction, and the encoders have 14 bits and 0.2 mrad of noise. pronk never
reads this file.

    python record.py        # writes chirp.csv (hip, then knee) and fresh.csv, beside this file
"""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

HERE = Path(__file__).parent
TIMESTEP_S = 1e-4
"""Step of the simulation, 50 times shorter than that of a training simulator."""
RATE_HZ = 200
"""Rate of the commands and of the log."""
STIFFNESS = np.array([30.0, 25.0])
"""Gains that the drives are set to, hip and knee [N m/rad]."""
DAMPING = np.array([0.8, 0.6])
"""Damping that the drives are set to [N m s/rad]."""
TORQUE_SHARE = 0.9
"""Torque of the motors over the stated one."""
DRY_FRICTION = np.array([0.30, 0.20])
"""Dry friction of the joints [N m]."""
VISCOUS_FRICTION = 0.02
"""Viscous friction of the joints [N m s/rad]."""
ARMATURE = 0.006
"""Rotor inertia at the joint, through the gear [kg m^2]."""
DELAY_S = 0.006
"""Time from a command to its effect."""
ENCODER_BITS = 14
NOISE_RAD = 2e-4
POSE = np.array([0.4, -0.9])
"""Pose about which the joints are excited, hip and knee [rad]."""
PAUSE_S = 1.0
CHIRP_S = 16.0
BAND_HZ = (0.2, 16.0)


def linear_chirp(amplitude: float, rng: np.random.Generator) -> np.ndarray:
    """Return a chirp that fades in over a second, at the rate of the log [rad], (n,)."""
    del rng
    time = np.arange(0.0, CHIRP_S, 1.0 / RATE_HZ)
    low_hz, high_hz = BAND_HZ
    phase = 2.0 * np.pi * (low_hz * time + 0.5 * (high_hz - low_hz) / CHIRP_S * time**2)
    fade = np.minimum(1.0, np.minimum(time, CHIRP_S - time))
    return amplitude * fade * np.sin(phase)


def random_steps(amplitude: float, rng: np.random.Generator) -> np.ndarray:
    """Return random positions, held for 0.1 to 0.5 s, at the rate of the log [rad], (n,)."""
    signal = []
    while len(signal) < CHIRP_S * RATE_HZ:
        samples = int(rng.uniform(0.1, 0.5) * RATE_HZ)
        signal.extend([rng.uniform(-amplitude, amplitude)] * samples)
    return np.array(signal[: int(CHIRP_S * RATE_HZ)])


def commands(signal, amplitudes: tuple[float, ...], rng: np.random.Generator) -> np.ndarray:
    """Return the commands of hip and knee, one joint after the other [rad], (n, 2)."""
    pause = np.tile(POSE, (int(PAUSE_S * RATE_HZ), 1))
    parts = [pause]
    for joint in range(2):
        for amplitude in amplitudes:
            values = signal(amplitude, rng)
            part = np.tile(POSE, (len(values), 1))
            part[:, joint] += values
            parts.append(part)
            parts.append(pause)
    return np.concatenate(parts)


def leg() -> mujoco.MjModel:
    """Return the leg with its friction and rotor inertia."""
    spec = mujoco.MjSpec.from_file(str(HERE / "leg.urdf"))
    spec.option.timestep = TIMESTEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for joint, friction in zip(spec.joints, DRY_FRICTION, strict=True):
        joint.armature = ARMATURE
        joint.frictionloss = friction
        joint.damping[0] = VISCOUS_FRICTION
    return spec.compile()


def record(command: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the measured positions of the joints for their commands [rad], (n, 2)."""
    model = leg()
    data = mujoco.MjData(model)
    data.qpos[:] = POSE
    steps_per_sample = round(1.0 / (RATE_HZ * TIMESTEP_S))
    delay_steps = round(DELAY_S / TIMESTEP_S)
    sent = np.repeat(command, steps_per_sample, axis=0)
    measured = np.empty_like(command)
    count = 2.0**ENCODER_BITS / (2.0 * np.pi)
    for step in range(len(sent)):
        if step % steps_per_sample == 0:
            noisy = data.qpos + NOISE_RAD * rng.standard_normal(2)
            measured[step // steps_per_sample] = np.round(noisy * count) / count
        target = sent[max(step - delay_steps, 0)]
        torque = STIFFNESS * (target - data.qpos) - DAMPING * data.qvel
        data.qfrc_applied[:] = TORQUE_SHARE * torque
        mujoco.mj_step(model, data)
    return measured


def write_csv(path: Path, command: np.ndarray, measured: np.ndarray) -> None:
    """Write milliseconds and degrees, as many loggers do."""
    milliseconds = 1000.0 * np.arange(len(command)) / RATE_HZ
    columns = [
        milliseconds,
        np.degrees(command[:, 0]),
        np.degrees(measured[:, 0]),
        np.degrees(command[:, 1]),
        np.degrees(measured[:, 1]),
    ]
    header = "t_ms,hip_des,hip_act,knee_des,knee_act"
    np.savetxt(
        path,
        np.column_stack(columns),
        fmt=["%.0f", "%.3f", "%.3f", "%.3f", "%.3f"],
        delimiter=",",
        header=header,
        comments="",
    )


def main() -> None:
    """Record both logs."""
    rng = np.random.default_rng(0)
    chirp = commands(linear_chirp, (0.2, 0.1), rng)
    write_csv(HERE / "chirp.csv", chirp, record(chirp, rng))
    steps = commands(random_steps, (0.2,), rng)
    write_csv(HERE / "fresh.csv", steps, record(steps, rng))


if __name__ == "__main__":
    main()
