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
from pronk.identify.response.h1 import H1Operator, estimate_averaged
from pronk.identify.response.periodic import estimate_periodic, multisine_operator
from pronk.identify.response.response import Estimator, FrequencyResponse


def log_rate(excitations: Sequence[Excitation]) -> float:
    """Return one rate of the analysis grid for excitations, so that they share frequencies [Hz]."""
    return analysis_rate([excitation.time for excitation in excitations])


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
        estimator: Segments, window and band; the defaults suit a chirp of 0.1 to 25 Hz in 20 s.

    Returns:
        One response an amplitude and kind of signal, the largest amplitude first.

    Raises:
        LogError: The joint was not excited or did not move, or its segments are too short.
    """
    settings = Estimator() if estimator is None else estimator
    excitations = log.excitations(joint)
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
    settings = Estimator() if estimator is None else estimator
    excitations = log.excitations(joint)
    rate_hz = log_rate(excitations)
    rows = []
    for repeats in group_repeats(excitations):
        rows.append([operator(repeat, settings, rate_hz) for repeat in repeats])
    return rows
