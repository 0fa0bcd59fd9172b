"""Physical parameters of drives by mode `drive`, on joints of an integrator of the tests' own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pronk.errors import PronkError
from pronk.identify.match.gains import load_gains, save_gains
from pronk.identify.match.match import match
from pronk.identify.match.physical import LinearLaw, continuous_joint
from pronk.identify.match.result import MatchResult
from pronk.identify.match.settings import MatchSettings
from pronk.identify.match.tables import drives_table
from pronk.robots import load_robot
from tests.fine_joint import JOINT, FineJoint, two_chirps_at


def matched_drive(
    joint: FineJoint, folder: Path, *, uncertainty: float = 0.2, seed: int = 0, **drive: float
) -> MatchResult:
    """Match the drive of a joint of which `drive` is stated wrongly."""
    robot = load_robot(str(joint.write_robot(folder, **drive)))
    sent = np.arange(27 * 50) / 50.0
    log = joint.log(sent, two_chirps_at(sent, length_s=12.0), 500.0, seed=seed)
    settings = MatchSettings(gain_uncertainty=uncertainty)
    return match([log], robot, mode="drive", drive_gains="default", settings=settings)


@given(
    damping=st.floats(0.1, 1.0),
    inertia=st.floats(0.005, 0.03),
    viscous=st.floats(0.0, 0.1),
    step_s=st.floats(2e-5, 2e-4),
)
@settings(max_examples=30, deadline=None)
def test_a_fine_step_takes_half_a_step_of_damping_off_the_inertia(
    damping: float, inertia: float, viscous: float, step_s: float
) -> None:
    law = LinearLaw(
        stiffness=20.0,
        damping=damping,
        inertia=inertia,
        viscous=viscous,
        gravity=0.2,
        step_s=step_s,
    )
    joint = continuous_joint(law, 15.0)
    assert joint is not None
    # The next term of the expansion in the step is that of the stiffness.
    second_order = step_s**2 * (law.stiffness + law.gravity) / 12.0
    expected = inertia - 0.5 * step_s * (damping - viscous) - second_order
    assert joint.inertia == pytest.approx(expected, abs=5.0 * (step_s * damping) ** 2 / inertia)
    assert joint.damping == pytest.approx(damping, rel=0.01)
    assert joint.lead_s == pytest.approx(0.5 * step_s, rel=0.15)


def test_a_law_that_swings_from_step_to_step_is_no_joint() -> None:
    law = LinearLaw(
        stiffness=20.0, damping=2.0, inertia=0.006, viscous=0.0, gravity=0.0, step_s=0.005
    )
    assert continuous_joint(law, 15.0) is None


def test_the_armature_of_an_ideal_joint_is_its_own(tmp_path: Path) -> None:
    truth = FineJoint()
    result = matched_drive(truth, tmp_path, uncertainty=0.02)
    gains = result.joints[JOINT].gains
    armature = gains.physical["armature"]
    assert armature.total95[0] < truth.armature < armature.total95[1]
    assert armature.value == pytest.approx(truth.armature, rel=0.05)
    # The explicit law needs another one.
    assert gains.armature.value > 1.08 * truth.armature
    assert gains.physical["delay"].value == pytest.approx(truth.delay_s, abs=3e-4)
    # The interval follows the stated uncertainty.
    wide = matched_drive(truth, tmp_path, uncertainty=0.2).joints[JOINT].gains
    width = np.ptp(armature.total95)
    assert np.ptp(wide.physical["armature"].total95) > 4.0 * width

    path = tmp_path / "gains.yaml"
    save_gains(path, result.gains)
    read = load_gains(path).joints[JOINT].physical["armature"]
    assert read.value == pytest.approx(armature.value, rel=1e-5)
    rows = drives_table(result).rows
    shown = [row for row in rows if str(row[1]).startswith("armature")]
    assert float(str(shown[0][2])) == pytest.approx(armature.value, rel=1e-3)


def test_intervals_hold_the_truth_of_random_joints(tmp_path: Path) -> None:
    held = []
    for seed in range(200, 208):
        rng = np.random.default_rng(seed)
        joint = FineJoint(
            stiffness=rng.uniform(8.0, 40.0),
            damping=rng.uniform(0.2, 0.9),
            armature=rng.uniform(0.002, 0.012),
            mass=rng.uniform(0.1, 0.6),
            length=rng.uniform(0.06, 0.15),
            inertia=rng.uniform(5e-4, 3e-3),
            frictionloss=rng.uniform(0.02, 0.2),
            viscous=rng.uniform(0.0, 0.04),
            delay_s=rng.uniform(0.001, 0.012),
            velocity_lag_s=rng.uniform(0.0, 1e-3),
            torque_scale=rng.uniform(0.8, 1.2),
        )
        stated_armature = joint.armature * rng.uniform(0.6, 1.6)
        result = matched_drive(
            joint, tmp_path / str(seed), seed=seed, armature=stated_armature, frictionloss=0.1
        )
        physical = result.joints[JOINT].gains.physical
        truth = {
            "damping": joint.damping * joint.torque_scale,
            "armature": joint.armature,
            "frictionloss": joint.frictionloss,
            "delay": joint.delay_s,
        }
        for name, value in truth.items():
            low, high = physical[name].total95
            held.append(low <= value <= high)
    assert np.mean(held) >= 0.9


def test_values_with_a_fitted_stiffness_are_equivalents(tmp_path: Path) -> None:
    truth = FineJoint()
    robot = load_robot(str(truth.write_robot(tmp_path)))
    sent = np.arange(27 * 50) / 50.0
    log = truth.log(sent, two_chirps_at(sent, length_s=12.0), 500.0)
    settings = MatchSettings(fitted=("stiffness", "damping", "delay"))
    result = match([log], robot, mode="drive", drive_gains="default", settings=settings)
    assert not result.joints[JOINT].gains.physical
    table = drives_table(result)
    assert all(row[2] is None for row in table.rows)
    assert any("equivalent" in note for note in table.notes)


def test_an_impossible_uncertainty_is_refused() -> None:
    with pytest.raises(PronkError, match="--gain-uncertainty"):
        MatchSettings(gain_uncertainty=1.5)
