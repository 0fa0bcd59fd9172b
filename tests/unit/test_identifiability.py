"""What experiments identify: a table of them, closed forms, and refusals with experiments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pronk.errors import IdentifiabilityError, PronkError
from pronk.identify.match.identifiability import (
    Experiment,
    bench_experiment,
    identifiability,
    require_identifiable,
    response,
)
from pronk.robots import load_robot

ONE = Experiment(inertia=0.02)
PHASE, SMALL = replace(ONE, phase=True), replace(ONE, amplitude=0.0625)
POSES = [ONE, replace(ONE, inertia=0.06)]
GAINS = ("stiffness", "damping", "armature")
NOMINAL = {"stiffness": 20.0, "damping": 1.5, "armature": 0.01}
OTHERS = {"delay": 0.005, "frictionloss": 0.2}


def nominal(*names: str) -> dict[str, float]:
    """Only what is fitted is not zero, so that each row stands by itself."""
    return NOMINAL | {k: v for k, v in OTHERS.items() if k in names}


TABLE = [
    ("magnitude, one pose", GAINS, [ONE], set(GAINS)),
    ("magnitude and phase, one pose", GAINS, [PHASE], set(GAINS)),
    ("gravity pulls back", GAINS, [replace(ONE, gravity=2.0)], set()),
    ("two poses", GAINS, POSES, set()),
    ("stiffness known", GAINS[1:], [ONE], set()),
    ("armature known", GAINS[:2], [ONE], set()),
    ("delay, magnitude", (*GAINS[1:], "delay"), [ONE], {"delay"}),
    ("delay, phase", (*GAINS[1:], "delay"), [PHASE], set()),
    ("friction, one amplitude", (*GAINS[:2], "frictionloss"), [ONE], {"frictionloss"}),
    ("friction, two amplitudes", (*GAINS[:2], "frictionloss"), [ONE, SMALL], set()),
]


@pytest.mark.parametrize(("fitted", "experiments", "confused"), [row[1:] for row in TABLE])
def test_which_experiments_identify_what(
    fitted: tuple[str, ...], experiments: list[Experiment], confused: set[str]
) -> None:
    found = identifiability(fitted, experiments, nominal(*fitted))
    assert set(found.confused) == confused
    assert confused or found.condition < 1e3


def test_deviations_agree_with_the_published_analysis() -> None:
    # sd of the log parameters, 60 points 0.1 to 20 Hz with 3 % noise; research table, two rows.
    gravity = [replace(ONE, gravity=2.0)]
    for experiments, sd in ((gravity, [0.06, 0.07, 0.19]), (POSES, [0.02, 0.02, 0.08])):
        found = identifiability(GAINS, experiments, nominal()).sd
        assert [found[name] for name in GAINS] == pytest.approx(sd, abs=0.01)


def test_response_is_the_second_order_joint_and_friction_lowers_small_motions_more() -> None:
    values = {"delay": 0.01, "frictionloss": 0.0, **NOMINAL}
    s = 2j * np.pi * ONE.frequency_hz
    expected = 20.0 * np.exp(-0.01 * s) / (0.03 * s**2 + 1.5 * s + 20.0)
    assert response(ONE, values) == pytest.approx(expected)
    values["frictionloss"] = 0.7
    gains = [
        abs(response(replace(ONE, amplitude=a, frequency_hz=np.array([1.5])), values)[0])
        for a in (0.1, 0.3, 0.6)
    ]
    assert gains[0] < gains[1] < gains[2] < 1.0


@pytest.mark.parametrize(
    ("fitted", "message"),
    [
        (GAINS, "stiffness, damping, armature.*second pose or a known payload"),
        ((*GAINS[1:], "delay"), r"delay.*use the phase"),
        ((*GAINS, "delay"), "fewer"),
    ],
)
def test_refusal_names_parameters_and_experiments(fitted: tuple[str, ...], message: str) -> None:
    with pytest.raises(IdentifiabilityError, match=message):
        require_identifiable(fitted, [ONE], nominal(*fitted))


def test_bench_experiment_of_the_papers_robot_allows_the_papers_search() -> None:
    experiment, values = bench_experiment(load_robot("mini_cheetah"), "FR_hip_roll")
    assert not identifiability(GAINS[:2], [experiment], values).confused
    # A10: with the armature fitted as well the weak pull of gravity is not enough.
    assert identifiability(GAINS, [experiment], values).confused


@pytest.mark.parametrize(
    ("fitted", "experiments", "message"),
    [
        (("kp",), [ONE], "stiffness, damping"),
        (("delay",), [ONE], "delay"),
        ((), [ONE], "stiffness, damping"),
        (GAINS, [], "experiments"),
    ],
)
def test_bad_parameters_and_no_experiment_are_refused(
    fitted: tuple[str, ...], experiments: list[Experiment], message: str
) -> None:
    with pytest.raises(PronkError, match=message):
        require_identifiable(fitted, experiments, nominal())
