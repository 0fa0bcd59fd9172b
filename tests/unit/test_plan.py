"""The plan: order of the questions, and the forecast of what they will do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pronk.errors import PlanError, RobotError
from pronk.excitation.plan import SweepPlan, make_plan
from pronk.excitation.signals import Chirp
from pronk.excitation.worst_case import Uncertainty, forecast
from pronk.robots import load_robot

ROBOT = load_robot("mini_cheetah")
SHORT = Chirp(length_s=4.0, stop_hz=15.0)
STIFFNESS = {joint.name: joint.stiffness for joint in ROBOT.joints}
DAMPING = {joint.name: joint.damping for joint in ROBOT.joints}
EXACT = Uncertainty(inertia=0.0, stiffness=0.0, friction=0.0)


@pytest.fixture(scope="module")
def plan() -> SweepPlan:
    return make_plan(ROBOT)


def test_the_papers_sweep_of_all_joints_passes(plan: SweepPlan) -> None:
    plan.check()
    assert plan.joints == ROBOT.joint_names
    assert len(plan.rows()) == 12


def test_one_joint_at_a_time_each_amplitude_and_repeat(plan: SweepPlan) -> None:
    assert len(plan.asks) == 12 * 2 * 3
    assert all(len(ask.joints) == 1 for ask in plan.asks)
    first = plan.asks[:6]
    assert [ask.amplitude for ask in first] == [0.25] * 3 + [0.125] * 3
    assert [ask.repeat for ask in first] == [0, 1, 2, 0, 1, 2]
    assert plan.duration_s == pytest.approx(72 * 20.5 + 12 * 3.0)


def test_the_thigh_is_clamped_for_the_knee_only(plan: SweepPlan) -> None:
    for ask in plan.asks:
        leg, joint = ask.joints[0].split("_", 1)
        expected = (f"{leg}_hip_roll", f"{leg}_hip_pitch") if joint == "knee" else ()
        assert ask.clamped == expected


def test_mirrored_joints_have_mirrored_forecasts(plan: SweepPlan) -> None:
    rows = {row["joint"]: row for row in plan.rows()}
    # The chirp begins to the same side for both legs, which is outward for one and inward for the
    # other, so their extremes mirror nearly, not exactly.
    right, left = rows["FR_hip_roll"], rows["FL_hip_roll"]
    assert left["highest_rad"] == pytest.approx(-float(right["lowest_rad"]), abs=0.01)
    assert left["lowest_rad"] == pytest.approx(-float(right["highest_rad"]), abs=0.01)
    assert {**rows["HL_knee"], "joint": ""} == {**rows["FR_knee"], "joint": ""}


def test_mirrored_forecast_equals_the_simulation_of_the_joint_itself() -> None:
    plan = make_plan(ROBOT, ["FL_hip_roll"], SHORT, amplitudes=(0.25,), repeats=1)
    offsets = plan.asks[0].offsets(50.0)[:, 0]
    own = forecast(
        ROBOT, {"FL_hip_roll": offsets}, rate_hz=50.0, stiffness=STIFFNESS, damping=DAMPING
    )
    planned = {f.joint: f for f in plan.forecasts}
    for name in ("FL_hip_roll", "FL_hip_pitch", "FL_knee"):
        for value in ("lowest", "highest", "speed", "torque", "electrical_power"):
            assert getattr(planned[name], value) == pytest.approx(
                getattr(own[name], value), rel=1e-6, abs=1e-9
            )


def test_a_slow_question_is_followed_as_statics_say() -> None:
    """At 0.2 Hz position follows the command; peak torque is stiffness times friction's lag."""
    slow = Chirp(start_hz=0.1, stop_hz=0.3, length_s=10.0, amplitude=0.2)
    found = forecast(
        ROBOT,
        {"FR_knee": slow.samples(50.0)},
        rate_hz=50.0,
        stiffness=STIFFNESS,
        damping=DAMPING,
        uncertainty=EXACT,
    )["FR_knee"]
    rest = ROBOT.joint("FR_knee").default_position
    assert found.highest == pytest.approx(rest + 0.2, abs=0.03)
    assert found.lowest == pytest.approx(rest - 0.2, abs=0.03)
    assert found.speed < 2.0
    # Power from the bus is what is done on the joint and lost in the winding.
    assert 0.0 < found.mechanical_power < found.electrical_power
    assert found.bus_current == pytest.approx(found.electrical_power / 24.0)


def test_the_corners_enclose_the_model_itself() -> None:
    offsets = {"FR_hip_pitch": SHORT.samples(50.0)}
    found = forecast(ROBOT, offsets, rate_hz=50.0, stiffness=STIFFNESS, damping=DAMPING)
    exact = forecast(
        ROBOT, offsets, rate_hz=50.0, stiffness=STIFFNESS, damping=DAMPING, uncertainty=EXACT
    )
    wide, narrow = found["FR_hip_pitch"], exact["FR_hip_pitch"]
    assert wide.lowest < narrow.lowest
    assert wide.highest > narrow.highest
    assert wide.speed > narrow.speed
    assert wide.torque > narrow.torque
    assert wide.nominal_torque == pytest.approx(narrow.torque, rel=1e-9)
    assert wide.nominal_speed == pytest.approx(narrow.speed, rel=1e-9)


def test_the_step_of_the_forecast_has_converged() -> None:
    offsets = {"FR_knee": SHORT.samples(50.0)}
    coarse, fine = (
        forecast(
            ROBOT,
            offsets,
            rate_hz=50.0,
            stiffness=STIFFNESS,
            damping=DAMPING,
            uncertainty=EXACT,
            timestep_s=step,
        )["FR_knee"]
        for step in (0.001, 0.00025)
    )
    for value in ("speed", "torque", "nominal_excursion"):
        assert getattr(coarse, value) == pytest.approx(getattr(fine, value), rel=0.02)


@pytest.mark.parametrize(
    ("joint", "amplitude", "words"),
    [("FR_knee", 1.5, "above its range at 2.600"), ("FL_hip_roll", 1.7, "its range at")],
)
def test_a_sweep_that_could_exceed_a_range_is_refused(
    joint: str, amplitude: float, words: str
) -> None:
    plan = make_plan(ROBOT, [joint], SHORT, amplitudes=(amplitude, 0.1), repeats=1)
    with pytest.raises(PlanError, match=words) as caught:
        plan.check()
    message = str(caught.value)
    assert joint in message
    assert "\n" not in message
    fits = float(message.split("an amplitude of ")[1].split(" rad fits")[0])
    assert 0.1 < fits < amplitude
    make_plan(ROBOT, [joint], SHORT, amplitudes=(fits,), repeats=1).check()
    with pytest.raises(PlanError):
        make_plan(ROBOT, [joint], SHORT, amplitudes=(1.2 * fits,), repeats=1).check()


def test_a_sweep_beyond_the_drives_torque_is_refused() -> None:
    strong = {"FR_hip_pitch": 150.0}
    plan = make_plan(ROBOT, ["FR_hip_pitch"], SHORT, stiffness=strong, amplitudes=(0.25,))
    with pytest.raises(PlanError, match="times the torque that its drive gives"):
        plan.check()


def test_a_pose_outside_the_range_fits_no_amplitude() -> None:
    joints = tuple(
        replace(j, range=(-2.6, 1.0)) if j.name == "FR_knee" else j for j in ROBOT.joints
    )
    plan = make_plan(replace(ROBOT, joints=joints), ["FR_knee"], SHORT, repeats=1)
    with pytest.raises(PlanError, match="no amplitude fits"):
        plan.check()


def test_each_amplitude_may_have_repeats_of_its_own() -> None:
    plan = make_plan(ROBOT, ["FR_knee"], amplitudes=(0.125, 0.25), repeats=(1, 3))
    assert [(ask.amplitude, ask.repeat) for ask in plan.asks] == [
        (0.25, 0),
        (0.25, 1),
        (0.25, 2),
        (0.125, 0),
    ]
    with pytest.raises(PlanError, match="one number of repeats for all or one an amplitude"):
        make_plan(ROBOT, ["FR_knee"], amplitudes=(0.25, 0.125), repeats=(3,))


def test_mirror_image_joints_are_asked_mirrored() -> None:
    plan = make_plan(ROBOT, ["FR_hip_roll", "FL_hip_roll", "HL_knee"], amplitudes=(0.2,), repeats=1)
    right, left, knee = (ask.offsets(50.0)[:, 0] for ask in plan.asks)
    assert np.array_equal(left, -right)
    assert np.array_equal(knee, right)


def test_a_plan_of_nothing_and_unknown_joints() -> None:
    with pytest.raises(PlanError, match="asks nothing"):
        make_plan(ROBOT, [])
    with pytest.raises(PlanError, match="asks nothing"):
        make_plan(ROBOT, ["FR_knee"], repeats=0)
    with pytest.raises(RobotError, match="FR_hip_roll, FR_hip_pitch"):
        make_plan(ROBOT, ["FR_elbow"])
    with pytest.raises(PlanError, match="stiffness"):
        make_plan(ROBOT, ["FR_knee"], stiffness={"FR_knee": -1.0})


def test_offsets_of_shorter_signals_end_early() -> None:
    plan = make_plan(ROBOT, ["FR_knee"], SHORT, amplitudes=(0.2,), repeats=1)
    ask = replace(
        plan.asks[0],
        joints=("FR_knee", "FL_knee"),
        signals=(SHORT, replace(SHORT, length_s=2.0)),
    )
    offsets = ask.offsets(50.0)
    assert offsets.shape == (200, 2)
    assert not offsets[100:, 1].any()
    assert np.abs(offsets[100:, 0]).max() > 0.1
