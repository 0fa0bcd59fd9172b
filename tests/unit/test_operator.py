"""The estimate as a matrix is the estimate."""

from __future__ import annotations

import numpy as np
import pytest

from analytic import simulate_second_order
from pronk.errors import LogError, PronkError
from pronk.logs.joint_log import JointLog
from pronk.response import Estimator, H1Operator, estimate, operators
from synthetic_joint import (
    HIP,
    KNEE,
    LIVELY,
    chirp_command,
    linear_joint,
    make_log,
    multisine_command,
    steps_command,
)


def applied(log: JointLog, settings: Estimator) -> tuple[np.ndarray, np.ndarray]:
    """Responses of each repeat and of all, by the operators."""
    (row,) = operators(log, "knee", settings)
    parts = [log.cut(segment) for segment in log.segments]
    each = np.array([p.position[:, 0] @ o.matrix(o.time) for o, p in zip(row, parts, strict=True)])
    weight = np.array([one.excitation for one in row])
    return each, (each * weight).sum(axis=0) / weight.sum(axis=0)


@pytest.mark.parametrize("jitter", [0.0, 0.4])
@pytest.mark.parametrize("kind", ["chirp", "unknown"])
@pytest.mark.parametrize("segment_s", [4.0, 7.3])
def test_operator_is_the_estimate(kind: str, jitter: float, segment_s: float) -> None:
    settings = Estimator(segment_s=segment_s, max_hz=20.0)
    log = make_log(
        [chirp_command("chirp", 200.0)] * 2,
        linear_joint(**KNEE),
        kind=kind,
        jitter=jitter,
        noise=1e-3,
    )
    (response,) = estimate(log, "knee", settings)
    each, whole = applied(log, settings)
    scale = np.abs(response.response).max()
    assert np.abs(each - response.repeats).max() < 1e-10 * scale
    assert np.abs(whole - response.response).max() < 1e-10 * scale


def test_operator_is_the_estimate_of_an_excitation_that_ends_in_motion() -> None:
    time, command, hz = chirp_command("chirp", 200.0)
    cut = slice(0, 3500)
    log = make_log(
        [(time[cut], command[cut], hz[cut])], linear_joint(**KNEE), kind="unknown", noise=1e-3
    )
    (response,) = estimate(log, "knee")
    assert "inside the excitation" in response.window
    assert np.abs(applied(log, Estimator())[1] - response.response).max() < 1e-9


def test_operator_is_the_estimate_of_a_multisine() -> None:
    log = make_log(
        [(*multisine_command(200.0, seed=s), None) for s in range(3)],
        linear_joint(**KNEE),
        kind="multisine",
        period=4.0,
        noise=1e-3,
        jitter=0.1,
    )
    (response,) = estimate(log, "knee")
    each, whole = applied(log, Estimator())
    assert np.abs(each - response.repeats).max() < 1e-10
    assert np.abs(whole - response.response).max() < 1e-10


def test_matrix_takes_positions_at_physics_steps() -> None:
    """Positions every 5 ms give the response of those every 2 ms, but for the interpolation."""
    time, command, _ = chirp_command("chirp", 500.0)
    operator = H1Operator.build(time, command, Estimator())
    steps = np.arange(round(time[-1] / 0.005)) * 0.005
    matrix = operator.matrix(steps)
    assert matrix.shape == (len(steps), len(operator.omega))
    ticks = command[::10]
    for joint in (KNEE, HIP, LIVELY):
        fine = simulate_second_order(command, 500.0, **joint) @ operator.matrix(time)
        coarse = simulate_second_order(np.repeat(ticks, 4), 200.0, **joint)[: len(steps)]
        low = operator.omega < 2.0 * np.pi * 15.0
        assert np.abs((coarse @ matrix / fine - 1.0)[low]).max() < 1e-3
        assert np.abs(coarse @ matrix / fine - 1.0).max() < 5e-3


def test_an_offset_does_not_matter() -> None:
    time, command, _ = chirp_command("chirp", 200.0)
    matrix = H1Operator.build(time, command, Estimator()).matrix(time)
    noise = np.random.default_rng(0).standard_normal(len(time))
    assert np.allclose((noise + 1.7) @ matrix, noise @ matrix, atol=1e-8)


def test_what_is_not_linear_or_does_not_span_is_refused() -> None:
    time, command, _ = chirp_command("chirp", 200.0)
    operator = H1Operator.build(time, command, Estimator())
    with pytest.raises(LogError, match="do not span"):
        operator.matrix(time[:-100])
    steps = make_log([steps_command(200.0, (1.0, 2.0))], linear_joint(**KNEE), kind="sine_steps")
    with pytest.raises(PronkError, match="match a chirp or a multisine"):
        operators(steps, "knee")
