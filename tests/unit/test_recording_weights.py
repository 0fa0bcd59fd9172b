"""Weights of the samples of a joint that moved alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from chirp_logs import chirp_log
from pronk.identify.match.recordings import joint_recordings
from pronk.identify.simulators.command_trace import command_trace
from pronk.robots import load_robot

ROBOT = load_robot("mini_cheetah")
JOINT = "FR_knee"


def test_an_excitation_without_a_frequency_counts_beside_one_with_it() -> None:
    log = chirp_log(ROBOT, JOINT, (17.0, 0.4), (0.25, 0.125))
    _, second = log.excitations(JOINT)
    frequency = np.full(len(log.time), 5.0)
    frequency[second.samples] = np.nan
    excitations = replace(log, frequency=frequency).excitations(JOINT)
    traces = [command_trace(excitation, ROBOT) for excitation in excitations]
    with_frequency, without = joint_recordings(excitations, traces, [0, 1])
    assert (with_frequency.weight > 0.0).any()
    np.testing.assert_allclose(without.weight, 1.0 / 0.125, rtol=1e-3)
