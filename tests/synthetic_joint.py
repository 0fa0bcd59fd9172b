"""Logs of joints whose response is known in closed form."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.signal import chirp, cont2discrete, lfilter

from pronk.arrays import Array, ComplexArray
from pronk.identify.logs.joint_log import JointLog, LogOrigin
from pronk.identify.logs.segment import Segment

KNEE = {"stiffness": 21.9, "damping": 0.54, "inertia": 0.0068}
HIP = {"stiffness": 20.6, "damping": 0.49, "inertia": 0.02}
LIVELY = {"stiffness": 17.0, "damping": 0.2, "inertia": 0.012}
JOINTS = {"knee": KNEE, "hip": HIP, "lively": LIVELY}

AMPLITUDE = 0.25
TICK_HZ = 50.0


def second_order(
    omega: Array, *, stiffness: float, damping: float, inertia: float, delay_s: float = 0.0
) -> ComplexArray:
    """`stiffness exp(-s delay) / (inertia s^2 + damping s + stiffness)` at s = j omega.

    Paper M2 with zero target velocity (reading A9), `damping` of drive and joint together. Units:
    rad/s, N m/rad, N m s/rad, kg m^2 (link and armature), s.
    """
    s = 1j * np.asarray(omega, dtype=np.float64)
    joint = stiffness / (inertia * s**2 + damping * s + stiffness)
    return np.asarray(joint * np.exp(-s * delay_s))


def simulate_second_order(
    command: Array, rate_hz: float, *, stiffness: float, damping: float, inertia: float
) -> Array:
    """Exact response [rad] of the same joint, at rest at first, to a held command [rad]."""
    joint = (np.array([stiffness]), np.array([inertia, damping, stiffness]))
    numerator, denominator, _ = cont2discrete(joint, 1.0 / rate_hz, method="zoh")
    return np.asarray(lfilter(np.ravel(numerator), denominator, command - command[0]) + command[0])


def tick_time(time: Array) -> Array:
    """The policy tick in force at each instant."""
    return np.floor(time * TICK_HZ + 1e-9) / TICK_HZ


def chirp_command(kind: str, rate: float) -> tuple[Array, Array, Array]:
    """Time, command held at 50 Hz, instantaneous frequency of a chirp of 0.1 to 25 Hz in 20 s."""
    duration = 20.0
    settle = 1.0
    time = np.arange(round((duration + settle) * rate)) / rate
    tick = tick_time(time)
    method = "linear" if kind == "chirp" else "logarithmic"
    wave = chirp(tick, 0.1, duration, 25.0, method=method, phi=-90)
    share = np.minimum(time / duration, 1.0)
    hz = 0.1 + 24.9 * share if kind == "chirp" else 0.1 * 250.0**share
    excited = tick < duration - 1e-9
    return time, np.where(excited, AMPLITUDE * wave, 0.0), np.where(excited, hz, np.nan)


def multisine_command(rate: float, *, periods: int = 5, seed: int = 0) -> tuple[Array, Array]:
    """Random-phase multisine of period 4 s on odd lines, every fourth odd line left silent."""
    period = 4.0
    settle = 0.5
    time = np.arange(round((periods * period + settle) * rate)) / rate
    tick = tick_time(time)
    lines = np.arange(1, 96, 2)
    lines = lines[np.arange(len(lines)) % 4 != 2]
    phases = np.random.default_rng(seed + 1000).uniform(0.0, 2.0 * np.pi, len(lines))
    wave = np.cos(2.0 * np.pi * np.outer(tick, lines) / period + phases).sum(axis=1)
    wave *= AMPLITUDE / np.abs(wave).max()
    return time, np.where(tick < periods * period - 1e-9, wave, 0.0)


def steps_command(rate: float, frequencies: tuple[float, ...]) -> tuple[Array, Array, Array]:
    """Sine steps of six periods or two seconds each, whichever is longer."""
    pieces = []
    hz = []
    for f in frequencies:
        length = max(6, int(np.ceil(2.0 * f))) / f
        tick = tick_time(np.arange(round(length * rate)) / rate)
        pieces.append(AMPLITUDE * np.sin(2.0 * np.pi * f * tick))
        hz.append(np.full(len(tick), f))
    command = np.concatenate([*pieces, np.zeros(round(0.5 * rate))])
    frequency = np.concatenate([*hz, np.full(round(0.5 * rate), np.nan)])
    return np.arange(len(command)) / rate, command, frequency


def friction_joint(frictionloss: float) -> Callable[[Array, float], Array]:
    """The knee with dry friction, stepped at 8 times the log rate."""

    def simulate(command: Array, rate: float) -> Array:
        fine = 8
        step = 1.0 / (fine * rate)
        k = KNEE["stiffness"]
        d = KNEE["damping"]
        inertia = KNEE["inertia"]
        q = 0.0
        v = 0.0
        out = np.empty(len(command))
        for i, u in enumerate(command.tolist()):
            out[i] = q
            for _ in range(fine):
                v += step * (k * (u - q) - d * v) / inertia
                slip = abs(v) - step * frictionloss / inertia
                v = np.sign(v) * slip if slip > 0.0 else 0.0
                q += step * v
        return out

    return simulate


def linear_joint(**joint: float) -> Callable[[Array, float], Array]:
    """The exact response of a second-order joint."""
    return lambda command, rate: simulate_second_order(command, rate, **joint)


def make_log(
    signals: list[tuple[Array, Array, Array | None]],
    joint: Callable[[Array, float], Array],
    *,
    kind: str,
    noise: float = 0.0,
    period: float | None = None,
    jitter: float = 0.0,
    seed: int = 0,
) -> JointLog:
    """One log from several signals (time, command, frequency or None), a repeat each.

    `jitter` moves each timestamp by up to that share of an interval. The machine of such a log
    reads its state and puts the command of that row into force at the moved instant.
    """
    rng = np.random.default_rng(seed)
    start = 3.0
    times = []
    commands = []
    positions = []
    frequencies = []
    segments = []
    for repeat, (time, command, frequency) in enumerate(signals):
        rate = round(1.0 / float(time[1] - time[0]))
        # The motion between samples is simulated on a grid forty times as fine.
        fine = 40 if jitter else 1
        index = np.round((np.arange(len(time)) + jitter * rng.random(len(time))) * fine)
        index = (index - index[0]).astype(int)
        moved = start + index / (rate * fine)
        dense = np.repeat(command, np.diff(np.append(index, index[-1] + 1)))
        position = joint(dense, rate * fine)[index] + noise * rng.standard_normal(len(time))
        hz = np.full(len(time), np.nan) if frequency is None else frequency
        times.append(moved)
        commands.append(command)
        positions.append(position)
        frequencies.append(hz)
        segments.append(
            Segment(
                kind=kind,
                joints=("knee",),
                start=float(moved[0]),
                stop=float(moved[-1]),
                amplitude=AMPLITUDE,
                repeat=repeat,
                period_s=period,
            )
        )
        start += float(time[-1]) + 0.5
    all_frequencies = np.concatenate(frequencies)
    return JointLog(
        robot="bench",
        joints=("knee",),
        time=np.concatenate(times),
        command=np.concatenate(commands)[:, None],
        position=np.concatenate(positions)[:, None],
        frequency=all_frequencies if np.isfinite(all_frequencies).any() else None,
        segments=tuple(segments),
        origin=LogOrigin(source="made for a test"),
    )
