"""What experiments identify: a table of them, closed forms, and refusals with experiments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pronk.errors import IdentifiabilityError, PronkError
from pronk.match.identifiability import (
    Experiment,
    bench_experiment,
    identifiability,
    require_identifiable,
    response,
)
from pronk.robots import load_robot

ONE = Experiment(inertia=0.02)
NOMINAL = {
    "stiffness": 20.0,
    "damping": 1.5,
    "armature": 0.01,
    "viscous": 0.1,
    "delay": 0.005,
    "frictionloss": 0.2,
}
GAINS = ("stiffness", "damping", "armature")


def nominal(*names: str) -> dict[str, float]:
    """Only what is fitted is not zero, so that each row stands by itself."""
    return {k: v for k, v in NOMINAL.items() if k in (*GAINS, *names)}


TABLE = [
    ("magnitude, one pose", GAINS, [ONE], set(GAINS)),
    ("magnitude and phase, one pose", GAINS, [replace(ONE, phase=True)], set(GAINS)),
    ("gravity pulls back", GAINS, [replace(ONE, gravity=2.0)], set()),
    ("two poses", GAINS, [ONE, replace(ONE, inertia=0.06)], set()),
    ("torque channel", GAINS, [replace(ONE, torque=True)], set()),
    ("stiffness known", GAINS[1:], [ONE], set()),
    ("with viscous", (*GAINS[1:], "viscous"), [ONE], {"damping", "viscous"}),
    (
        "with viscous, two dampings on the drive",
        (*GAINS[1:], "viscous"),
        [ONE, replace(ONE, damping_scale=0.5)],
        set(),
    ),
    ("delay, magnitude", (*GAINS[1:], "delay"), [ONE], {"delay"}),
    ("delay, phase", (*GAINS[1:], "delay"), [replace(ONE, phase=True)], set()),
    ("armature known", GAINS[:2], [ONE], set()),
    ("torque scale", ("torque_scale", "armature"), [ONE], {"torque_scale", "armature"}),
    ("torque scale, torque", ("torque_scale", "armature"), [replace(ONE, torque=True)], set()),
    ("friction, one amplitude", (*GAINS[:2], "frictionloss"), [ONE], {"frictionloss"}),
    (
        "friction, two amplitudes",
        (*GAINS[:2], "frictionloss"),
        [ONE, replace(ONE, amplitude=0.0625)],
        set(),
    ),
]


@pytest.mark.parametrize(
    ("fitted", "experiments", "confused"), [row[1:] for row in TABLE], ids=[row[0] for row in TABLE]
)
def test_which_experiments_identify_what(
    fitted: tuple[str, ...], experiments: list[Experiment], confused: set[str]
) -> None:
    found = identifiability(fitted, experiments, nominal(*fitted))
    assert set(found.confused) == confused
    if confused:
        # Blind directions are infinitely uncertain; one amplitude only makes friction faint.
        assert all(found.sd[name] > 0.3 for name in confused)
    else:
        assert found.condition < 1e3


def test_deviations_agree_with_the_published_analysis() -> None:
    # sd of the log parameters, 60 points 0.1 to 20 Hz with 3 % noise; research table, two rows.
    gravity = identifiability(GAINS, [replace(ONE, gravity=2.0)], nominal())
    assert [gravity.sd[n] for n in GAINS] == pytest.approx([0.06, 0.07, 0.19], abs=0.01)
    poses = identifiability(GAINS, [ONE, replace(ONE, inertia=0.06)], nominal())
    assert [poses.sd[n] for n in GAINS] == pytest.approx([0.02, 0.02, 0.08], abs=0.01)


def test_blind_direction_leaves_the_response_as_it_is() -> None:
    values = {"viscous": 0.0, "delay": 0.0, "frictionloss": 0.0, "torque_scale": 1.0}
    a = {**values, "stiffness": 20.0, "damping": 1.5, "armature": 0.01}
    b = {**values, "stiffness": 40.0, "damping": 3.0, "armature": 0.04}
    assert response(ONE, a)[0] == pytest.approx(response(ONE, b)[0])


def test_response_is_the_second_order_joint() -> None:
    values = dict.fromkeys(("viscous", "frictionloss"), 0.0) | {"torque_scale": 1.0, "delay": 0.01}
    values |= {"stiffness": 20.0, "damping": 1.5, "armature": 0.01}
    s = 2j * np.pi * ONE.frequency_hz
    expected = 20.0 * np.exp(-0.01 * s) / (0.03 * s**2 + 1.5 * s + 20.0)
    h, torque = response(ONE, values)
    assert h == pytest.approx(expected)
    assert torque == pytest.approx(0.03 * s**2 * expected)


def test_friction_lowers_small_motions_more() -> None:
    values = dict.fromkeys(("viscous", "delay"), 0.0) | {"torque_scale": 1.0, "frictionloss": 0.7}
    values |= {"stiffness": 20.0, "damping": 1.5, "armature": 0.01}
    gains = [
        abs(response(replace(ONE, amplitude=a, frequency_hz=np.array([1.5])), values)[0][0])
        for a in (0.1, 0.3, 0.6)
    ]
    assert gains[0] < gains[1] < gains[2] < 1.0


def test_refusal_names_parameters_and_experiments() -> None:
    with pytest.raises(IdentifiabilityError) as refused:
        require_identifiable(GAINS, [ONE], nominal())
    message = str(refused.value)
    assert "stiffness, damping, armature" in message
    assert "second pose or a known payload" in message
    assert "record the joint torque" in message
    assert "phase" not in message
    with pytest.raises(IdentifiabilityError, match=r"delay.*use the phase"):
        require_identifiable((*GAINS[1:], "delay"), [ONE], nominal("delay"))


def test_scale_of_the_torque_never_separates_from_both_gains() -> None:
    with pytest.raises(IdentifiabilityError, match="fewer"):
        require_identifiable(("stiffness", "damping", "torque_scale"), [ONE], nominal())


def test_pairs_of_experiments_are_found_where_no_single_one_will_do() -> None:
    fitted = (*GAINS, "delay")
    found = identifiability(fitted, [ONE], nominal("delay"))
    assert any("use the phase as well and" in cure for cure in found.cures)


def test_bench_experiment_of_the_papers_robot_allows_the_papers_search() -> None:
    robot = load_robot("mini_cheetah")
    experiment, values = bench_experiment(robot, "FR_hip_roll")
    assert identifiability(("stiffness", "damping"), [experiment], values).ok
    # A10: with the armature fitted as well the weak pull of gravity is not enough.
    assert not identifiability(GAINS, [experiment], values).ok


def test_bad_questions_are_refused() -> None:
    with pytest.raises(PronkError, match="stiffness, damping"):
        identifiability(("kp",), [ONE], nominal())
    with pytest.raises(PronkError, match="must be positive"):
        identifiability(("delay",), [ONE], nominal())
    with pytest.raises(PronkError, match="at least one"):
        identifiability((), [ONE], nominal())
