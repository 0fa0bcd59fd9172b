"""Logs with one fault each, and the rule by which a named cause is right or wrong.

A flag of a match, or a refusal, names a cause if the words before its first colon (after "no
match", if it begins so) are one of `HEADS`, or, in a refusal, if it has the words of `REFUSALS`. A
sentence that lists what would look so, or says that a parameter was held or is not known, names
none. A log counts as

    right   a named cause is one that the fault accepts, and no other is named
    none    nothing is named, and the log is refused or is no match, or a list is given
    silent  nothing is named, and the log counts as matched; `trials` tells whether its gains are
            harmless or wrong
    wrong   a named cause is none that the fault accepts
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.foreign.joints import NAME, RigidJoint
from benchmarks.foreign.logs import (
    REST_S,
    Array,
    LogCase,
    Signal,
    draw_case,
    motion,
    recorded,
)

HEADS = {
    "effort limit": "saturation",
    "clock": "clock",
    "command column": "command",
    "position column": "position",
    "velocity column": "velocity",
    "compliance": "compliance",
    "backlash": "backlash",
    "dead band": "dead band",
    "friction": "friction",
    "load friction": "friction",
    "single frequency": "single sine",
    "missed commands": "missed commands",
    "payload": "inertia",
    "integral": "integral",
    "standstill": "standstill",
    "delay": "delay",
    "sample rate": "sample rate",
}
"""Words before the first colon of a flag, and the cause that they name."""
REFUSALS = {
    "degree": "degrees",
    "degrees": "degrees",
    "sign": "sign",
    "another joint": "wrong joint",
    "does not move": "standstill",
    "stands still": "standstill",
    "excites only": "single sine",
    "time": "clock",
    "timestamp": "clock",
    "timestamps": "clock",
    "gap": "lost rows",
    "gaps": "lost rows",
    "rows are missing": "lost rows",
    "jump": "reset",
    "jumps": "reset",
}
"""Whole words of a refusal, in lower case, and the cause that they name; those that come first in
it count. So a position that is so many "times" the command says nothing about time."""
Change = Callable[[LogCase, np.random.Generator], LogCase]


@dataclass(frozen=True, kw_only=True)
class Fault:
    """A fault of a joint, its drive or a recording."""

    name: str
    accepted: tuple[str, ...]
    """Causes, of `HEADS` and `REFUSALS`, that are right."""
    change: Change | None = None
    """What it does to a case before the motion."""
    change_columns: Change | None = None
    """What it does to the columns of the log."""


# ---- of the joint and its drive ----


def make_compliant(case: LogCase, rng: np.random.Generator) -> LogCase:
    """Put a spring between motor and link, whose link resonates inside the band."""
    joint = case.joint
    drive = case.drive
    natural_hz = math.sqrt(drive.stiffness / joint.inertia) / (2.0 * math.pi)
    locked_hz = natural_hz * rng.uniform(0.9, 2.5)
    spring = joint.link_inertia * (2.0 * math.pi * locked_hz) ** 2
    spring = max(spring, 4.0 * joint.gravity_torque)
    damping = 2.0 * rng.uniform(0.02, 0.1) * math.sqrt(spring * joint.link_inertia)
    return replace(case, drive=replace(drive, spring=spring, spring_damping=damping))


def add_play(case: LogCase, rng: np.random.Generator) -> LogCase:
    """Let the gear turn freely by 1.5 to 5 degrees; the encoder is on the motor."""
    joint = case.joint
    spring = joint.link_inertia * (2.0 * math.pi * 60.0) ** 2
    spring = max(spring, 20.0 * joint.gravity_torque)
    reduced = joint.link_inertia * joint.armature / joint.inertia
    damping = 2.0 * 0.3 * math.sqrt(spring * reduced)
    play = math.radians(rng.uniform(1.5, 5.0))
    drive = replace(case.drive, spring=spring, spring_damping=damping, play=play)
    return replace(case, drive=drive)


def saturate(case: LogCase, rng: np.random.Generator) -> LogCase:
    """Limit the torque to 30 to 60 % of what it would be about that of rest, as stated."""
    _, _, torque = motion(case.moving, case.drive, case.signal)
    held = abs(case.moving.gravity_at(0.0))
    limit = held + (float(np.abs(torque).max()) - held) * rng.uniform(0.3, 0.6)
    limit = max(limit, 1.3 * held)
    drive = replace(case.drive, limit=limit)
    return replace(case, drive=drive, stated=replace(case.stated, effort_limit=limit))


def saturate_unknown(case: LogCase, rng: np.random.Generator) -> LogCase:
    """Limit the torque, and state a limit twice to five times as high."""
    saturated = saturate(case, rng)
    limit = saturated.drive.limit * rng.uniform(2.0, 5.0)
    return replace(saturated, stated=replace(saturated.stated, effort_limit=limit))


def add_dead_band(case: LogCase, rng: np.random.Generator) -> LogCase:
    """Let the controller ignore errors of 10 to 30 % of the amplitude."""
    amplitude = float(np.abs(case.signal.offsets).max())
    drive = replace(case.drive, dead_band=amplitude * rng.uniform(0.1, 0.3))
    return replace(case, drive=drive)


def add_stribeck(case: LogCase, rng: np.random.Generator) -> LogCase:
    """Add dry friction of 8 to 15 % of the largest spring torque, 1.5 to 3 times that at rest."""
    amplitude = float(np.abs(case.signal.offsets).max())
    drive = case.drive
    drive = replace(
        drive,
        coulomb=drive.stiffness * amplitude * rng.uniform(0.08, 0.15),
        stiction=rng.uniform(0.5, 2.0),
        stribeck_speed=amplitude * rng.uniform(0.5, 2.0),
    )
    return replace(case, drive=drive)


def add_load_friction(case: LogCase, rng: np.random.Generator) -> LogCase:
    """Let dry friction grow by 15 to 35 % of the torque of the drive."""
    return replace(case, drive=replace(case.drive, load_friction=rng.uniform(0.15, 0.35)))


def add_integral(case: LogCase, rng: np.random.Generator) -> LogCase:
    """Give the controller an integral part of 1.5 to 5 a second."""
    natural = math.sqrt(case.drive.stiffness / case.joint.inertia)
    # Half of the limit of stability at most.
    ratio = case.drive.damping / (2.0 * math.sqrt(case.drive.stiffness * case.joint.inertia))
    rate = min(rng.uniform(1.5, 5.0), ratio * natural)
    return replace(case, drive=replace(case.drive, integral=rate))


def add_payload(case: LogCase, rng: np.random.Generator) -> LogCase:
    """Fix a payload to the link that the robot.yaml does not have, of 0.5 to 1.5 of its inertia."""
    joint = case.joint
    factor = rng.uniform(1.5, 2.5)
    heavier = replace(
        joint,
        mass=factor * joint.mass,
        link_inertia=factor * joint.link_inertia,
        gravity_torque=factor * joint.gravity_torque,
    )
    return replace(case, moving=heavier)


def miss_commands(case: LogCase, rng: np.random.Generator) -> LogCase:
    """Let the drive miss 15 to 40 % of the commands and keep the one before."""
    offsets = case.signal.offsets
    kept = rng.uniform(size=len(offsets)) >= rng.uniform(0.15, 0.4)
    kept[0] = True
    last = np.maximum.accumulate(np.where(kept, np.arange(len(offsets)), 0))
    return replace(case, signal=replace(case.signal, offsets=offsets[last], logged=offsets))


def single_sine(case: LogCase, rng: np.random.Generator) -> LogCase:
    """Excite by one sine alone."""
    signal = case.signal
    low_hz, high_hz = signal.band_hz
    hz = float(np.exp(rng.uniform(math.log(max(low_hz, 0.3)), math.log(0.7 * high_hz))))
    amplitude = float(np.abs(signal.offsets).max())
    rest = math.ceil(REST_S * signal.rate_hz)
    length = len(signal.offsets) - 2 * rest
    wave = amplitude * np.sin(2.0 * math.pi * hz * np.arange(length) / signal.rate_hz)
    ramp = min(math.ceil(0.5 * signal.rate_hz), length // 8)
    wave[:ramp] *= np.linspace(0.0, 1.0, ramp)
    wave[length - ramp :] *= np.linspace(1.0, 0.0, ramp)
    offsets = np.concatenate([np.zeros(rest), wave, np.zeros(rest)])
    sine = Signal(kind="sine", rate_hz=signal.rate_hz, band_hz=(low_hz, high_hz), offsets=offsets)
    return replace(case, signal=sine)


# ---- of the recording ----


def with_column(case: LogCase, name: str, values: Array) -> LogCase:
    """Return a case with another column."""
    return replace(case, columns=case.columns | {name: values})


def delay_command_column(case: LogCase, rng: np.random.Generator) -> LogCase:
    """Log the command 10 to 40 ms after the drive had it, and 5 ms later than its effect."""
    time = case.columns["time"]
    late_s = case.drive.delay_s + rng.uniform(0.01, 0.04)
    rows = np.clip(np.searchsorted(time, time - late_s, side="right") - 1, 0, None)
    return with_column(case, "command", case.columns["command"][rows])


def scale_position(case: LogCase, rng: np.random.Generator) -> LogCase:
    """Scale the position by 0.7 to 0.85 or 1.2 to 1.5."""
    factor = rng.uniform(0.7, 0.85) if rng.integers(2) else rng.uniform(1.2, 1.5)
    return with_column(case, "position", factor * case.columns["position"])


def filter_position(case: LogCase, rng: np.random.Generator) -> LogCase:
    """Filter the position by a first-order low-pass of 1 to 2 natural frequencies."""
    natural_hz = math.sqrt(case.drive.stiffness / case.joint.inertia) / (2.0 * math.pi)
    corner_hz = natural_hz * rng.uniform(1.0, 2.0)
    share = 1.0 - math.exp(-2.0 * math.pi * corner_hz / case.recording.rate_hz)
    position = case.columns["position"]
    filtered = np.empty_like(position)
    value = position[0]
    for row, sample in enumerate(position.tolist()):
        value += share * (sample - value)
        filtered[row] = value
    return with_column(case, "position", filtered)


def scale_velocity(case: LogCase, rng: np.random.Generator) -> LogCase:
    """Log a velocity that is 0.4 or 2.5 times the right one, or has the other sign."""
    if "velocity" in case.columns:
        velocity = case.columns["velocity"]
    else:
        velocity = np.gradient(case.columns["position"], case.columns["time"])
    factor = float(rng.choice([0.4, 2.5, -1.0]))
    return with_column(case, "velocity", factor * velocity)


def to_degrees(case: LogCase, rng: np.random.Generator) -> LogCase:
    """Write the position, the command or both in degrees."""
    changed = case
    for name in (("position",), ("command",), ("position", "command"))[int(rng.integers(3))]:
        changed = with_column(changed, name, np.degrees(case.columns[name]))
    return changed


def flip_sign(case: LogCase, rng: np.random.Generator) -> LogCase:
    """Turn the sign of the position."""
    return with_column(case, "position", -case.columns["position"])


def rest_instead(case: LogCase, rng: np.random.Generator) -> LogCase:
    """Log a joint that rests, which the excited one moves by 0.1 to 3 % of its own motion."""
    position = case.columns["position"]
    noise = rng.normal(0.0, case.recording.noise, len(position))
    share = float(np.exp(rng.uniform(math.log(0.001), math.log(0.03))))
    resting = 0.2 + share * (position - position[0]) + noise
    resolution = case.recording.resolution
    return with_column(case, "position", resolution * np.round(resting / resolution))


def jump_clock(case: LogCase, rng: np.random.Generator) -> LogCase:
    """Let the clock jump forwards by 0.3 to 3 s or backwards by 0.05 to 0.5 s in mid-log."""
    time = case.columns["time"].copy()
    row = int(len(time) * rng.uniform(0.25, 0.75))
    jump_s = rng.uniform(0.3, 3.0) if rng.integers(2) else -rng.uniform(0.05, 0.5)
    time[row:] += jump_s
    return with_column(case, "time", time)


def lose_rows(case: LogCase, rng: np.random.Generator) -> LogCase:
    """Lose two to six stretches of 0.1 to 0.5 s."""
    time = case.columns["time"]
    kept = np.ones(len(time), dtype=bool)
    for _ in range(int(rng.integers(2, 7))):
        begin = time[-1] * rng.uniform(0.15, 0.85)
        kept &= (time < begin) | (time > begin + rng.uniform(0.1, 0.5))
    columns = {}
    for name, values in case.columns.items():
        columns[name] = values[kept]
    return replace(case, columns=columns)


def reset_encoder(case: LogCase, rng: np.random.Generator) -> LogCase:
    """Let the encoder lose 0.3 to 1.5 rad at once in mid-log."""
    position = case.columns["position"].copy()
    row = int(len(position) * rng.uniform(0.3, 0.7))
    position[row:] -= float(rng.choice([-1.0, 1.0])) * rng.uniform(0.3, 1.5)
    return with_column(case, "position", position)


FAULTS = (
    Fault(name="compliance", accepted=("compliance",), change=make_compliant),
    Fault(name="backlash", accepted=("backlash",), change=add_play),
    Fault(name="saturation", accepted=("saturation",), change=saturate),
    Fault(name="saturation, limit unknown", accepted=("saturation",), change=saturate_unknown),
    Fault(name="dead band", accepted=("dead band",), change=add_dead_band),
    Fault(name="Stribeck friction", accepted=("friction",), change=add_stribeck),
    Fault(name="load friction", accepted=("friction",), change=add_load_friction),
    Fault(name="integral part", accepted=("integral",), change=add_integral),
    Fault(name="payload", accepted=("inertia",), change=add_payload),
    Fault(name="missed commands", accepted=("missed commands", "command"), change=miss_commands),
    Fault(name="single sine", accepted=("single sine",), change=single_sine),
    Fault(
        name="late command column",
        accepted=("command", "delay"),
        change_columns=delay_command_column,
    ),
    Fault(name="position scale", accepted=("position",), change_columns=scale_position),
    Fault(name="filtered position", accepted=("position",), change_columns=filter_position),
    Fault(name="velocity column", accepted=("velocity",), change_columns=scale_velocity),
    Fault(name="degrees", accepted=("degrees",), change_columns=to_degrees),
    Fault(name="sign", accepted=("sign",), change_columns=flip_sign),
    Fault(name="wrong joint", accepted=("wrong joint", "standstill"), change_columns=rest_instead),
    Fault(name="clock jump", accepted=("clock", "lost rows"), change_columns=jump_clock),
    Fault(name="lost rows", accepted=("lost rows", "clock"), change_columns=lose_rows),
    Fault(name="encoder reset", accepted=("reset", "position"), change_columns=reset_encoder),
)
"""Every fault; log k of a run has fault k modulo their number."""


def honest_log(seed: int, number: int, joint: RigidJoint | None = None) -> LogCase:
    """Draw an honest log with its columns; `joint` as of `logs.draw_case`."""
    return recorded(draw_case(seed, number, joint))


def faulty_log(seed: int, number: int, fault: Fault, joint: RigidJoint | None = None) -> LogCase:
    """Draw a log with one fault, with its columns; `joint` as of `logs.draw_case`."""
    case = draw_case(seed, number, joint)
    rng = np.random.default_rng([seed, number, 2])
    if fault.change is not None:
        case = fault.change(case, rng)
    case = recorded(case)
    if fault.change_columns is not None:
        case = fault.change_columns(case, rng)
    return case


def named_causes(flags: Sequence[str], refusal: str) -> set[str]:
    """Return the causes that flags and a refusal name, by the rule of this module."""
    named = set()
    for sentence in (*flags, refusal):
        words = sentence.removeprefix("no match: ")
        head = words.split(":")[0].strip()
        if head in HEADS:
            named.add(HEADS[head])
    # A refusal begins with the file and the joint, and then has a head or words of its own.
    for part in refusal.split(": "):
        if part.strip() in HEADS:
            named.add(HEADS[part.strip()])
    if refusal and not named:
        text = refusal.lower().split(f"{NAME}: ")[-1]
        first = {}
        for words, cause in REFUSALS.items():
            found = re.search(rf"\b{words}\b", text)
            if found is not None:
                first[found.start()] = cause
        if first:
            named.add(first[min(first)])
    return named


def verdict(fault: Fault, flags: Sequence[str], refusal: str) -> str:
    """Return right, none, silent or wrong for a log with a fault."""
    named = named_causes(flags, refusal)
    if named - set(fault.accepted):
        return "wrong"
    if named:
        return "right"
    no_match = any(flag.startswith("no match") for flag in flags)
    return "none" if no_match or refusal else "silent"
