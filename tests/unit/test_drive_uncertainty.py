"""Intervals of fitted parameters: leaving out blocks and repeats of a problem solved exactly."""

from __future__ import annotations

import numpy as np
import pytest

from pronk.identify.match.parameters import PARAMETERS
from pronk.identify.match.uncertainty import (
    block_moves,
    estimate_parameters,
    jackknife,
    repeat_moves,
    time_blocks,
    total_intervals,
)

SAMPLES = 240
RANDOM = np.random.default_rng(3)
DESIGN = RANDOM.normal(size=(SAMPLES, 2))
MEASURED = DESIGN @ np.array([1.0, -2.0]) + 0.1 * RANDOM.normal(size=SAMPLES)
BEST = np.linalg.lstsq(DESIGN, MEASURED, rcond=None)[0]
RESIDUAL = DESIGN @ BEST - MEASURED


def test_an_optimum_moves_as_if_it_were_solved_without_the_block() -> None:
    blocks = np.arange(SAMPLES) // 40
    moves = block_moves(DESIGN, RESIDUAL, blocks)
    assert moves.shape == (6, 2)
    for number in range(6):
        kept = blocks != number
        without = np.linalg.lstsq(DESIGN[kept], MEASURED[kept], rcond=None)[0]
        assert moves[number] == pytest.approx(without - BEST, abs=1e-9)


def test_the_jackknife_of_a_mean_is_the_variance_of_the_mean() -> None:
    repeats = RANDOM.normal(size=(5, 1))
    variance = np.var(repeats, ddof=1) / 5
    assert jackknife(repeats / 4)[0, 0] == pytest.approx(variance)


def test_commands_without_repeats_have_no_moves() -> None:
    recordings = np.arange(SAMPLES) // 60
    commands = np.array([0, 0, 0, 1])[recordings]
    (moves,) = repeat_moves(DESIGN, RESIDUAL, commands, recordings)
    assert moves.shape == (3, 2)
    assert repeat_moves(DESIGN, RESIDUAL, recordings, recordings) == []


def test_blocks_are_counted_through_the_recordings() -> None:
    first, second = time_blocks([np.arange(0.0, 10.0, 0.1), np.arange(5.0, 12.0, 0.1)], 2.5)
    assert list(np.unique(first)) == [0, 1, 2, 3]
    assert list(np.unique(second)) == [4, 5, 6]


def test_a_relative_deviation_beyond_the_limit_is_not_identified() -> None:
    fitted = ("stiffness", "delay")
    x = np.array([np.log(20.0), 0.004])
    values = {"stiffness": 20.0, "damping": 0.5, "delay": 0.004}
    covariance = np.diag([0.5**2, 1e-4**2])
    estimate = estimate_parameters(fitted, x, covariance, 10, values)
    assert estimate.unidentified == ("stiffness",)
    assert estimate.sd["stiffness"] == pytest.approx(0.5)
    low, high = estimate.ci95["stiffness"]
    assert low * high == pytest.approx(20.0**2)
    assert estimate.covariance[0, 0] == pytest.approx((0.5 * 20.0) ** 2)
    assert estimate.covariance[1, 1] == 0.0
    low, high = estimate.ci95["delay"]
    assert 0.5 * (low + high) == pytest.approx(0.004)


def test_total_intervals_reach_over_the_gains_of_each_amplitude() -> None:
    x = np.array([np.log(20.0)])
    by_amplitude = np.array([[0.25, 20.0, 0.5], [0.125, 24.0, 0.5]])
    ci95 = {"stiffness": (19.9, 20.1)}
    part_moves = np.array([[0.001], [-0.001], [0.0]])
    low, high = total_intervals(("stiffness",), x, ci95, part_moves, by_amplitude)["stiffness"]
    assert low <= 20.0 / 1.2 + 1e-9
    assert high >= 24.0 - 1e-9
    one_amplitude = by_amplitude[:1]
    low, high = total_intervals(("stiffness",), x, ci95, part_moves, one_amplitude)["stiffness"]
    assert low < 19.9
    assert 20.1 < high < 20.5


@pytest.mark.parametrize("name", list(PARAMETERS))
def test_a_parameter_comes_back_from_its_searched_number(name: str) -> None:
    parameter = PARAMETERS[name]
    value = parameter.low + 0.25 * (parameter.high - parameter.low)
    assert parameter.unscaled(parameter.scaled(value)) == pytest.approx(value)
    assert parameter.low <= parameter.start <= parameter.high or name == "offset"
