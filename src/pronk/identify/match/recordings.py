"""What a fit of drives compares with simulations: samples of one joint's position in one motion.

Two kinds of log become recordings, and differ in what counts as a repeat, a block and a weight:

- A joint that was excited alone (`joint_recordings`): each excitation is a recording. Repeats of
  one command are the unit of uncertainty. A sample is divided by the amplitude, so that every
  amplitude counts alike, and by the square root of its frequency: in a linear chirp, which has as
  many samples in each hertz, every octave then counts alike. A log without a frequency channel, as
  CSV may be, has samples that count alike, so that the upper octaves of a linear chirp count most.
  The mean of each recording is left out, for the zero of an encoder is no dynamics.
- Joints that moved together (`chain_recordings`): each joint of each log is a recording. Nothing
  was repeated, so pieces of time are the unit of uncertainty. Samples count alike, and the mean
  counts too: how far a joint sags under gravity shows its stiffness. Samples that the drive could
  not follow are left out (`trusted_samples`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pronk.arrays import Array, Mask
from pronk.errors import LogError
from pronk.identify.logs.checks import examine_time
from pronk.identify.logs.joint_log import Excitation, JointLog
from pronk.identify.match.uncertainty import time_blocks
from pronk.identify.simulators.chain import ChainSimulation
from pronk.identify.simulators.command_trace import CommandTrace

LOWEST_HZ = 0.3
"""Lower frequencies count alike: a chirp is ramped up there, and the joint follows one to one."""
PARTS = 8
"""Parts of an excitation; blocks of joints that moved together where the blocks are short."""
SAMPLES_PER_STEP = 2.0
"""Samples in a physics step from which on only some of them are used."""
SHORTEST_BLOCK_S = 2.5
"""Shortest block of the jackknife [s]: five times the joints' memory of half a second."""
LONGEST_BLOCK_S = 20.0
"""Longest block of the jackknife [s]."""
SHORTEST_OF_SHORT_S = 0.5
"""Shortest block of recordings that are too short for `FEWEST_BLOCKS` of `SHORTEST_BLOCK_S` [s]:
the joints' memory."""
FEWEST_BLOCKS = 3
"""Fewest blocks that give an interval."""
COHERENT = 0.95
"""Coherence of a sweep below which its drive no longer follows as a linear joint does."""
COHERENCE_SEGMENT_S = 5.0
"""Length of the segments that the coherence is averaged over [s]."""
SHARE_IN_GAPS = 0.01
"""Largest share of a segment without samples with which it counts for the coherence."""
KNOWN_POWER = 0.5
"""Share of the power of the command in the segments that count, from which on they tell the
coherence at a frequency."""
EXCITED_POWER = 1e-3
"""Power of the command, over its largest, from which on a frequency counts as excited."""
COHERENT_BELOW = 8.0
"""A recording shows where its coherence ends only if it was coherent over three octaves below: a
sweep does; a few lines, or a motion that mostly sticks, do not."""
POWER_WINDOW_S = 2.0
"""Window over which the power of the command above the trusted frequency is compared [s]."""
POWER_AT_LIMIT = 0.25
"""Share of its power that a sine at the trusted frequency keeps when it is filtered forwards and
backwards."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording:
    """Samples of the position of one joint during one motion, shape (n,) each."""

    joint: str
    command: int
    """Number of the command, from 0; repeats of a command share it."""
    amplitude: float
    """Peak of the command [rad]; NaN where joints moved together."""
    time: Array
    """When the position was read, after the first step of the simulation [s]."""
    position: Array
    """Measured position [rad]."""
    weight: Array
    """Weight of the difference between simulated and measured position [1/rad]."""
    block: NDArray[np.int64]
    """Number of the block of the jackknife that a sample is in, through all recordings."""
    mean_free: bool
    """True if the mean of the difference is left out."""


def joint_recordings(
    excitations: Sequence[Excitation], traces: Sequence[CommandTrace], commands: Sequence[int]
) -> list[Recording]:
    """Make a recording of each excitation of a joint that moved alone.

    Args:
        excitations: What was recorded.
        traces: The command of each at the physics steps.
        commands: Number of the command of each; repeats share it.

    Returns:
        A recording of each, in the same order.
    """
    recordings = []
    for excitation, trace, command in zip(excitations, traces, commands, strict=True):
        time = excitation.time
        stride = max(1, int(excitation.rate_hz * trace.timestep / SAMPLES_PER_STEP + 1e-6))
        during = (time >= trace.time[0]) & (time <= trace.time[-1])
        samples = np.flatnonzero(during)[::stride]
        weight = np.full(len(samples), 1.0 / trace.amplitude)
        frequency = excitation.frequency
        # A multisine has no frequency of its own, and may be in one log with a chirp.
        if frequency is not None and np.isfinite(frequency[samples]).any():
            # Between excitations the joint is at rest, which holds nothing of its dynamics.
            frequency_hz = np.nan_to_num(frequency[samples], nan=np.inf)
            weight = weight / np.sqrt(np.maximum(frequency_hz, LOWEST_HZ))
        part = PARTS * np.arange(len(samples)) // len(samples)
        recordings.append(
            Recording(
                joint=excitation.joint,
                command=command,
                amplitude=trace.amplitude,
                time=time[samples] - trace.start,
                position=excitation.position[samples],
                weight=weight,
                block=command * PARTS + part,
                mean_free=True,
            )
        )
    return recordings


@dataclass(frozen=True, kw_only=True, eq=False)
class ChainRecordings:
    """Recordings of joints that moved together, and where they are in the logs."""

    recordings: list[Recording]
    log: list[int]
    """Number of the log of each recording."""
    samples: list[NDArray[np.int64]]
    """Rows of the log that each recording has."""
    trusted_hz: dict[str, float]
    """Frequency up to which each joint's samples are used [Hz]; infinite if all are."""
    trusted_share: dict[str, float]
    """Share of each joint's samples that is used."""


def chain_recordings(simulation: ChainSimulation) -> ChainRecordings:
    """Make a recording of each joint in each log of joints that moved together.

    Raises:
        LogError: The logs are too short for `FEWEST_BLOCKS` blocks.
    """
    blocks = _chain_blocks([log.time for log in simulation.logs])
    recordings: list[Recording] = []
    log_numbers = []
    log_samples = []
    trusted_hz = dict.fromkeys(simulation.joints, float("inf"))
    used_count = dict.fromkeys(simulation.joints, 0)
    all_count = dict.fromkeys(simulation.joints, 0)
    for number, log in enumerate(simulation.logs):
        for joint in simulation.excited[number]:
            mask, limit_hz = trusted_samples(log, joint)
            if not mask.all():
                trusted_hz[joint] = min(trusted_hz[joint], limit_hz)
            samples = np.flatnonzero(mask)
            used_count[joint] += len(samples)
            all_count[joint] += len(mask)
            recordings.append(
                Recording(
                    joint=joint,
                    command=len(recordings),
                    amplitude=float("nan"),
                    time=log.time[samples] - log.time[0],
                    position=log.position[samples, log.column(joint)],
                    weight=np.ones(len(samples)),
                    block=blocks[number][samples],
                    mean_free=False,
                )
            )
            log_numbers.append(number)
            log_samples.append(samples)
    share = {joint: used_count[joint] / all_count[joint] for joint in simulation.joints}
    return ChainRecordings(
        recordings=recordings,
        log=log_numbers,
        samples=log_samples,
        trusted_hz=trusted_hz,
        trusted_share=share,
    )


def _chain_blocks(times: Sequence[Array]) -> list[NDArray[np.int64]]:
    """Number of the block of each timestamp of some logs, blocks of 2.5 to 20 s.

    Recordings of less than three blocks of 2.5 s are cut in three blocks of half a second or more.
    """
    total_s = 0.0
    for time in times:
        total_s += float(time[-1] - time[0])
    length_s = LONGEST_BLOCK_S
    if total_s < FEWEST_BLOCKS * LONGEST_BLOCK_S:
        length_s = max(SHORTEST_BLOCK_S, total_s / PARTS)
    if total_s < FEWEST_BLOCKS * SHORTEST_BLOCK_S:
        length_s = max(SHORTEST_OF_SHORT_S, total_s / FEWEST_BLOCKS)
    blocks = time_blocks(times, length_s)
    count = int(blocks[-1][-1]) + 1
    if count < FEWEST_BLOCKS:
        raise LogError(
            f"the recordings of {total_s:.2g} s make {count} blocks of {SHORTEST_OF_SHORT_S:g} s "
            f"or more; intervals need at least {FEWEST_BLOCKS}: record longer, or give more logs."
        )
    return blocks


def training_samples(recordings: Sequence[Recording]) -> list[Mask]:
    """Choose the samples that a fit may see when the others are to judge it, shape (n,) each.

    Where a command was repeated, its last repeat judges; where it was not, every fourth block
    does, or the last one if there are fewer than four.
    """
    repeats: dict[int, int] = {}
    last_repeat: dict[int, int] = {}
    for number, recording in enumerate(recordings):
        repeats[recording.command] = repeats.get(recording.command, 0) + 1
        last_repeat[recording.command] = number
    every_block = np.concatenate([recording.block for recording in recordings])
    has_fourth = bool((every_block % 4 == 3).any())
    masks = []
    for number, recording in enumerate(recordings):
        if repeats[recording.command] > 1:
            judges = number == last_repeat[recording.command]
            masks.append(np.full(len(recording.time), not judges))
        elif has_fourth:
            masks.append(recording.block % 4 != 3)
        else:
            masks.append(recording.block != every_block.max())
    return masks


def trusted_frequency(time: Array, command: Array, position: Array) -> float:
    """Find the frequency at which the coherence of a sweep falls below `COHERENT` [Hz].

    A servo has limits of its own (acceleration, speed, torque) that no gain describes. Beyond them
    the response is no longer that of a linear joint, and the coherence of a sweep that runs into
    them falls.

    Args:
        time: Timestamps [s], shape (n,).
        command: Commanded position [rad], shape (n,).
        position: Measured position [rad], shape (n,).

    Returns:
        The frequency; infinity if the coherence does not fall, or if the recording is too narrow to
        show it.
    """
    if np.ptp(command) == 0.0 or np.ptp(position) == 0.0:
        return float("inf")
    frequency_hz, power, coherence = _coherence(time, command, position)
    if power.max() == 0.0:
        return float("inf")
    excited = power > EXCITED_POWER * power.max()
    excited[0] = False  # each segment's mean is removed, so 0 Hz is not excited
    coherent = excited & (coherence >= COHERENT)
    if not coherent.any():
        return float("inf")
    first = int(np.argmax(coherent))
    fallen = np.flatnonzero(excited[first:] & ~coherent[first:])
    if len(fallen) == 0:
        return float("inf")
    end = first + int(fallen[0])
    if frequency_hz[end - 1] < COHERENT_BELOW * frequency_hz[first]:
        return float("inf")
    return float(frequency_hz[end])


def _coherence(time: Array, command: Array, position: Array) -> tuple[Array, Array, Array]:
    """Return frequencies [Hz], power of the command up to a factor, and coherence of the position.

    Where samples are missing, both columns are interpolated at the typical rate, and segments with
    more than `SHARE_IN_GAPS` of missing samples are left out: a motion that is cut out of a segment
    would lower its coherence. The power is zero where most of it is in segments that are left out.
    """
    from scipy import signal  # slow to import

    timing = examine_time(time)
    if not timing.gaps:
        rate_hz = timing.rate_hz
        width = min(round(COHERENCE_SEGMENT_S * rate_hz), len(time))
        frequency_hz, power = signal.welch(command, rate_hz, nperseg=width)
        _, coherence = signal.coherence(command, position, rate_hz, nperseg=width)
        return frequency_hz, power, coherence

    grid = np.arange(time[0], time[-1], timing.typical_s)
    missing = np.zeros(len(grid), dtype=bool)
    for start, length in timing.gaps:
        missing |= (grid > start) & (grid < start + length)
    command = np.interp(grid, time, command)
    position = np.interp(grid, time, position)
    width = min(round(COHERENCE_SEGMENT_S / timing.typical_s), len(grid))
    firsts = np.arange(0, len(grid) - width + 1, max(width // 2, 1))
    rows = firsts[:, None] + np.arange(width)
    window = signal.get_window("hann", width)
    command_spectra = np.fft.rfft(window * signal.detrend(command[rows], type="constant"))
    position_spectra = np.fft.rfft(window * signal.detrend(position[rows], type="constant"))
    is_whole = missing[rows].mean(axis=1) <= SHARE_IN_GAPS
    whole_command = command_spectra[is_whole]
    whole_position = position_spectra[is_whole]
    command_power = np.sum(np.abs(whole_command) ** 2, axis=0)
    position_power = np.sum(np.abs(whole_position) ** 2, axis=0)
    cross = np.sum(np.conj(whole_command) * whole_position, axis=0)
    products = np.maximum(command_power * position_power, np.finfo(float).tiny)
    # What was excited in the segments that are left out cannot be judged by the others.
    is_known = command_power >= KNOWN_POWER * np.sum(np.abs(command_spectra) ** 2, axis=0)
    segment_hz = np.asarray(np.fft.rfftfreq(width, timing.typical_s), dtype=np.float64)
    return segment_hz, np.where(is_known, command_power, 0.0), np.abs(cross) ** 2 / products


def trusted_samples(log: JointLog, joint: str) -> tuple[Mask, float]:
    """Choose the samples of a joint that a fit may use.

    Args:
        log: A log of joints that moved together.
        joint: One of them.

    Returns:
        A mask, shape (n,), that is false where the command is, over two seconds, mostly above the
        trusted frequency; and that frequency [Hz], infinite if there is none.
    """
    from scipy import signal  # slow to import

    column = log.column(joint)
    command = log.command[:, column]
    limit_hz = trusted_frequency(log.time, command, log.position[:, column])
    if not limit_hz < 0.45 * log.rate_hz:
        return np.ones(len(log.time), dtype=bool), limit_hz
    about_mean = command - command.mean()
    sections = signal.butter(4, limit_hz, "highpass", fs=log.rate_hz, output="sos")
    fast = signal.sosfiltfilt(sections, about_mean)
    window = np.ones(max(round(POWER_WINDOW_S * log.rate_hz), 1))
    fast_power = signal.fftconvolve(fast**2, window, "same")
    power = signal.fftconvolve(about_mean**2, window, "same")
    return np.asarray(fast_power <= POWER_AT_LIMIT * np.maximum(power, 0.0)), limit_hz
