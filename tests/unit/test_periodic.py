"""Multisines and sine steps line by line: periods as repeats, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from analytic import second_order
from pronk.errors import LogError
from pronk.logs.joint_log import JointLog
from pronk.response import Estimator, estimate
from pronk.response.periodic import read_periods
from synthetic_joint import (
    KNEE,
    linear_joint,
    make_log,
    multisine_command,
    steps_command,
)


def multisine(joint, *, excitations: int = 1, noise: float = 0.0, **kw) -> JointLog:  # type: ignore[no-untyped-def]
    return make_log(
        [(*multisine_command(500.0, seed=s, **kw), None) for s in range(excitations)],
        joint,
        kind="multisine",
        period=4.0,
        noise=noise,
    )


def test_lines_of_a_linear_joint_are_exact_without_noise() -> None:
    log = multisine(linear_joint(**KNEE))
    (response,) = estimate(log, "knee")
    known = second_order(response.omega, **KNEE)
    assert np.abs(response.response / known - 1.0).max() < 2e-4
    assert response.estimator == "periodic"
    # Five equal periods, of which the first settles: four repeats.
    assert response.repeats.shape == (4, 36)
    assert np.allclose(response.frequency_hz * 4.0 % 2.0, 1.0)  # odd lines alone


def test_ramped_and_unequal_periods_fall_out() -> None:
    time, command = multisine_command(500.0)
    ramp = np.clip(time / 1.0, 0.0, 1.0)
    log = make_log(
        [(time, command * ramp, None)], linear_joint(**KNEE), kind="multisine", period=4.0
    )
    read = read_periods(log, "knee", Estimator())
    assert len(read.command) == 3
    known = second_order(read.omega, **KNEE)
    assert np.abs(read.position / read.command / read.factor / known - 1.0).max() < 2e-4


def test_three_excitations_are_three_repeats() -> None:
    (response,) = estimate(multisine(linear_joint(**KNEE), excitations=3, noise=1e-3), "knee")
    assert response.repeats.shape == (3, 36)
    assert np.all(response.averages == 12)


def test_too_few_periods_and_missing_metadata_are_refused() -> None:
    with pytest.raises(LogError, match="3 equal periods are needed"):
        estimate(multisine(linear_joint(**KNEE), periods=2), "knee")
    no_period = make_log(
        [(*multisine_command(500.0), None)], linear_joint(**KNEE), kind="multisine"
    )
    with pytest.raises(LogError, match="no period_s"):
        estimate(no_period, "knee")
    time, command, hz = steps_command(500.0, (1.0, 2.0))
    with pytest.raises(LogError, match="without the channel of instantaneous frequency"):
        estimate(make_log([(time, command, None)], linear_joint(**KNEE), kind="sine_steps"), "knee")
    hurried = (time[:600], command[:600], hz[:600])
    with pytest.raises(LogError, match="the step at 1 Hz lasts"):
        estimate(make_log([hurried], linear_joint(**KNEE), kind="sine_steps"), "knee")
