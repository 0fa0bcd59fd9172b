"""From a log to responses: group the repeats of each excitation and choose the estimator."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pronk.errors import PronkError
from pronk.identify.logs.checks import check_motion
from pronk.identify.logs.joint_log import Excitation, JointLog, group_repeats
from pronk.identify.response.diagnostics import fit_delay, third_harmonic
from pronk.identify.response.grid import analysis_rate
from pronk.identify.response.h1 import H1Operator, estimate_averaged, rests
from pronk.identify.response.periodic import estimate_periodic, multisine_operator
from pronk.identify.response.response import LONGEST_SEGMENT_S, Estimator, FrequencyResponse

_SEGMENTS_S = (8.0, 6.0, 5.0, 4.0, 3.0, 2.5, 2.0, 1.5, 1.0, 0.8, 0.6, 0.5, 0.4, 0.3, 0.2)
"""Lengths of segments to choose from [s]: logs of about one length then share frequencies."""
_IN_MOTION = 1.5
"""Least length of an excitation that does not end at rest, in the longest segments: two of them
that overlap by half."""
_SEGMENTS_IN_SHORT = 2.0
"""Length of a shorter excitation in segments, which overlap: of one segment alone, or of two that
hardly differ, the coherence says nothing."""


def log_rate(excitations: Sequence[Excitation]) -> float:
    """Return one rate of the analysis grid for excitations, so that they share frequencies [Hz]."""
    return analysis_rate([excitation.time for excitation in excitations])


def fitting_estimator(excitations: Sequence[Excitation], estimator: Estimator) -> Estimator:
    """Choose the length of the segments by the shortest of some excitations, if none was chosen.

    A shorter segment has fewer frequencies, further apart. Multisines and sine steps that say so
    are read without segments.

    Args:
        excitations: Excitations of one joint.
        estimator: The settings; with a length of the segments they are returned as they are.
    """
    if estimator.segment_s is not None:
        return estimator
    longest_s = LONGEST_SEGMENT_S
    for excitation in excitations:
        if excitation.segment.kind in ("multisine", "sine_steps"):
            continue
        span_s = float(excitation.time[-1] - excitation.time[0]) + 1.0 / excitation.rate_hz
        at_rest = rests(excitation.command, excitation.rate_hz)
        long_enough_s = LONGEST_SEGMENT_S if at_rest else _IN_MOTION * LONGEST_SEGMENT_S
        fitting_s = span_s if span_s >= long_enough_s else span_s / _SEGMENTS_IN_SHORT
        longest_s = min(longest_s, fitting_s)
    for length_s in _SEGMENTS_S:
        if length_s <= longest_s * (1.0 + 1e-6):
            return replace(estimator, segment_s=length_s)
    return replace(estimator, segment_s=longest_s)


def resolution_note(response: FrequencyResponse) -> str:
    """Say how coarse a response of a short excitation is; empty for one of full length."""
    if response.estimator != "H1" or response.segment_s >= LONGEST_SEGMENT_S:
        return ""
    return (
        f"{response.joint}: the response at {response.amplitude:.3g} rad is of segments of "
        f"{response.segment_s:g} s, for the excitation is short: its frequencies are "
        f"{1.0 / response.segment_s:.2g} Hz apart, from {response.frequency_hz[0]:.2g} Hz on"
    )


def estimate_response(
    log: JointLog, joint: str, estimator: Estimator | None = None
) -> list[FrequencyResponse]:
    """Estimate the responses of one joint, from its held command to its position.

    Chirps and excitations of unknown kind are averaged over segments (Welch); multisines and sine
    steps are read line by line. Repeats are combined by averaging their spectra, and each repeat's
    response is kept in `repeats`. A single long excitation is one repeat: its segments are its
    averages. Several kinds of signals with one amplitude are several responses.

        log = pronk.read_log("logs/FR_knee.mcap")
        loudest = pronk.response(log, "FR_knee")[0]
        loudest.plot().savefig("FR_knee.png")

    Args:
        log: The log.
        joint: Name of an excited joint, one of `log.excited_joints`.
        estimator: Segments, window and band; the defaults suit a chirp of 0.1 to 25 Hz in 20 s,
            and have shorter segments for shorter excitations.

    Returns:
        One response an amplitude and kind of signal, the largest amplitude first.

    Raises:
        LogError: The joint was not excited or did not move.
        ShortExcitationError: An excitation is too short for the segments that were chosen.
    """
    excitations = log.excitations(joint)
    settings = fitting_estimator(excitations, estimator or Estimator())
    rate_hz = log_rate(excitations)
    responses = []
    for repeats in group_repeats(excitations):
        for repeat in repeats:
            check_motion(repeat)
        if repeats[0].segment.kind in ("multisine", "sine_steps"):
            response = estimate_periodic(repeats, settings, rate_hz)
        else:
            response = estimate_averaged(repeats, settings, rate_hz)
        ratios = np.array([third_harmonic(repeat) for repeat in repeats])
        ratios = ratios[np.isfinite(ratios)]
        mean_ratio = float(ratios.mean()) if len(ratios) else math.nan
        responses.append(replace(response, delay_s=fit_delay(response), third_harmonic=mean_ratio))
    return responses


def operator(excitation: Excitation, estimator: Estimator, rate_hz: float) -> H1Operator:
    """Return the estimate of one excitation as a linear map; equal repeats share it.

    Args:
        excitation: The excitation.
        estimator: Segments, window and band.
        rate_hz: Rate of the analysis grid, by `log_rate` [Hz].

    Raises:
        PronkError: The signal is sine steps, which have no common grid.
    """
    segment = excitation.segment
    time = excitation.time
    command = excitation.command
    if segment.kind == "sine_steps":
        raise PronkError(
            f"{excitation.source or 'log'}: sine steps cannot be matched through one matrix; "
            "match a chirp or a multisine and keep the steps to check it."
        )
    if segment.kind == "multisine" and segment.period_s is not None:
        return multisine_operator(time, command, segment.period_s, estimator, rate_hz)
    return H1Operator.build(time, command, estimator, rate_hz=rate_hz)


def operators(
    log: JointLog, joint: str, estimator: Estimator | None = None
) -> list[list[H1Operator]]:
    """Return the `operator` of every repeat, a row for each response of `estimate_response`."""
    excitations = log.excitations(joint)
    settings = fitting_estimator(excitations, estimator or Estimator())
    rate_hz = log_rate(excitations)
    rows = []
    for repeats in group_repeats(excitations):
        rows.append([operator(repeat, settings, rate_hz) for repeat in repeats])
    return rows
