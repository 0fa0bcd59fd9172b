"""The plan: order of the excitations, and the forecast of their effect."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plain_mujoco import peaks_in_mujoco
from pronk.errors import PlanError, RobotError
from pronk.identify.excitation.plan import SweepPlan, make_plan
from pronk.identify.excitation.signals import Chirp, Signal
from pronk.identify.excitation.worst_case import Forecast, Uncertainty, forecast
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec
from sized_joint import JOINT, SIZES, Size, sized_robot

ROBOT = load_robot("mini_cheetah")
SHORT = Chirp(length_s=4.0, stop_hz=15.0)
EXACT = Uncertainty(inertia=0.0, stiffness=0.0, friction=0.0)
STIFFNESS = {joint.name: joint.stiffness for joint in ROBOT.joints}
DAMPING = {joint.name: joint.damping for joint in ROBOT.joints}


def forecasts(joint: str, signal: Signal, **options: Any) -> dict[str, Forecast]:
    chain_forecasts, _ = forecast(
        ROBOT,
        joint,
        signal.samples(50.0),
        rate_hz=50.0,
        stiffness=STIFFNESS,
        damping=DAMPING,
        **options,
    )
    return {joint_forecast.joint: joint_forecast for joint_forecast in chain_forecasts}


@pytest.fixture(scope="module")
def plan() -> SweepPlan:
    return make_plan(ROBOT)


def test_the_papers_sweep_of_all_joints_passes(plan: SweepPlan) -> None:
    plan.check()
    assert plan.joints == ROBOT.joint_names
    assert len(plan.rows()) == 12
    assert len(plan.excitations) == 12 * 2 * 3
    first = plan.excitations[:6]
    assert [excitation.signal.amplitude for excitation in first] == [0.25] * 3 + [0.125] * 3
    assert [excitation.repeat for excitation in first] == [0, 1, 2, 0, 1, 2]
    assert plan.duration_s == pytest.approx(72 * 20.5 + 12 * 3.0)
    # The thigh is clamped for the knee only.
    for excitation in plan.excitations:
        leg, joint = excitation.joint.split("_", 1)
        expected = (f"{leg}_hip_roll", f"{leg}_hip_pitch") if joint == "knee" else ()
        assert excitation.clamped == expected


def test_mirrored_joints_have_mirrored_forecasts(plan: SweepPlan) -> None:
    rows = {row["joint"]: row for row in plan.rows()}
    # The chirp begins to the same side for both legs, which is outward for one and inward for the
    # other, so their extremes mirror nearly, not exactly.
    right_row = rows["FR_hip_roll"]
    left_row = rows["FL_hip_roll"]
    assert left_row["highest_rad"] == pytest.approx(-float(right_row["lowest_rad"]), abs=0.01)
    assert left_row["lowest_rad"] == pytest.approx(-float(right_row["highest_rad"]), abs=0.01)
    assert {**rows["HL_knee"], "joint": ""} == {**rows["FR_knee"], "joint": ""}


def test_mirrored_forecast_equals_the_simulation_of_the_joint_itself() -> None:
    plan = make_plan(ROBOT, ["FL_hip_roll"], SHORT, amplitudes=(0.25,), repeats=1)
    # Mirror-image joints are excited mirrored.
    np.testing.assert_array_equal(plan.excitations[0].offsets(50.0), -SHORT.samples(50.0))
    itself = forecasts("FL_hip_roll", SHORT)
    mirrored = forecasts("FR_hip_roll", SHORT)
    planned_by_joint = {planned.joint: planned for planned in plan.forecasts}
    for name in ("FL_hip_roll", "FL_hip_pitch", "FL_knee"):
        planned = planned_by_joint[name]
        for value in ("speed", "torque", "electrical_power"):
            expected = getattr(mirrored[name.replace("FL", "FR")], value)
            assert getattr(planned, value) == pytest.approx(expected, rel=1e-6, abs=1e-9)
            assert getattr(planned, value) == pytest.approx(getattr(itself[name], value), rel=0.1)


def test_a_slow_excitation_is_followed_statically() -> None:
    """At 0.2 Hz position follows the command; peak torque is stiffness times friction's lag."""
    slow = Chirp(start_hz=0.1, stop_hz=0.3, length_s=10.0, amplitude=0.2)
    worst = forecasts("FR_knee", slow, uncertainty=EXACT)["FR_knee"]
    rest_position = ROBOT.joint("FR_knee").default_position
    assert worst.highest == pytest.approx(rest_position + 0.2, abs=0.03)
    assert worst.lowest == pytest.approx(rest_position - 0.2, abs=0.03)
    assert worst.speed < 2.0
    # Power from the bus is the mechanical power and the loss in the winding.
    assert 0.0 < worst.mechanical_power < worst.electrical_power
    assert worst.bus_current == pytest.approx(worst.electrical_power / 24.0)


def test_the_corners_enclose_the_model_itself() -> None:
    wide = forecasts("FR_hip_pitch", SHORT)["FR_hip_pitch"]
    narrow = forecasts("FR_hip_pitch", SHORT, uncertainty=EXACT)["FR_hip_pitch"]
    assert wide.lowest < narrow.lowest
    for value in ("highest", "speed", "torque"):
        assert getattr(wide, value) > getattr(narrow, value)


def test_the_step_of_the_forecast_has_converged() -> None:
    coarse = forecasts("FR_knee", SHORT, uncertainty=EXACT, timestep_s=0.001)["FR_knee"]
    fine = forecasts("FR_knee", SHORT, uncertainty=EXACT, timestep_s=0.00025)["FR_knee"]
    for value in ("speed", "torque", "lowest", "highest"):
        assert getattr(coarse, value) == pytest.approx(getattr(fine, value), rel=0.02)


@pytest.mark.parametrize(
    ("joint", "amplitude", "words"),
    [("FR_knee", 1.5, "above its range at 2.600"), ("FL_hip_roll", 1.7, "its range at")],
)
def test_a_sweep_that_could_exceed_a_range_is_refused(
    joint: str, amplitude: float, words: str
) -> None:
    def check(*amplitudes: float) -> None:
        make_plan(ROBOT, [joint], SHORT, amplitudes=amplitudes, repeats=1).check()

    with pytest.raises(PlanError, match=words) as caught:
        check(amplitude, 0.1)
    message = str(caught.value)
    assert joint in message
    fits = float(message.split("an amplitude of ")[1].split(" rad fits")[0])
    assert 0.1 < fits < amplitude
    check(fits)
    with pytest.raises(PlanError):
        check(1.2 * fits)


def test_what_no_amplitude_fits_and_what_the_drives_cannot_give_are_refused() -> None:
    joints = list(ROBOT.joints)
    knee = ROBOT.joint_names.index("FR_knee")
    joints[knee] = replace(joints[knee], range=(-2.6, 1.0))
    bent = replace(ROBOT, joints=tuple(joints))
    with pytest.raises(PlanError, match="no amplitude fits"):
        make_plan(bent, ["FR_knee"], SHORT, repeats=1).check()
    strong = {"FR_hip_pitch": (150.0, ROBOT.joint("FR_hip_pitch").damping)}
    plan = make_plan(ROBOT, ["FR_hip_pitch"], SHORT, drive_gains=strong, amplitudes=(0.25,))
    with pytest.raises(PlanError, match="times the torque that its drive gives"):
        plan.check()


def test_each_amplitude_may_have_repeats_of_its_own() -> None:
    plan = make_plan(ROBOT, ["FR_knee"], amplitudes=(0.125, 0.25), repeats=(1, 3))
    amplitudes = [excitation.signal.amplitude for excitation in plan.excitations]
    assert amplitudes == [0.25, 0.25, 0.25, 0.125]
    assert [excitation.repeat for excitation in plan.excitations] == [0, 1, 2, 0]


@pytest.mark.parametrize(
    ("joints", "options", "error", "words"),
    [
        ([], {}, PlanError, "excites nothing"),
        (["FR_knee"], {"repeats": 0}, PlanError, "excites nothing"),
        (["FR_knee"], {"repeats": (3,)}, PlanError, "one an amplitude"),
        (["FR_knee"], {"amplitudes": (0.2, 0.1, 0.2)}, PlanError, "0.2 rad"),
        (["FR_elbow"], {}, RobotError, "FR_hip_roll, FR_hip_pitch"),
        (["FR_knee"], {"drive_gains": {"FR_knee": (-1.0, 0.4)}}, PlanError, "stiffness"),
    ],
)
def test_impossible_plans_are_refused(
    joints: list[str], options: dict[str, Any], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        make_plan(ROBOT, joints, **options)


@pytest.mark.parametrize("name", SIZES)
def test_the_forecast_has_the_peaks_of_plain_mujoco(name: str, tmp_path: Path) -> None:
    robot = sized_robot(SIZES[name], tmp_path)
    # Commands at 60 Hz: a tick is no whole number of milliseconds.
    for rate_hz in (50.0, 60.0):
        robot = replace(robot, policy_rate_hz=rate_hz)
        plan = make_plan(robot, [JOINT], SHORT, amplitudes=(0.05,), repeats=1)
        plan.check()
        (row,) = plan.rows()
        peaks = peaks_in_mujoco(robot, JOINT, replace(SHORT, amplitude=0.05).samples(rate_hz))
        pose = robot.joint(JOINT).default_position
        highest = float(row["nominal_highest_rad"])
        lowest = float(row["nominal_lowest_rad"])
        assert row["nominal_torque_nm"] == pytest.approx(peaks.torque, rel=0.05)
        assert row["nominal_speed_rad_s"] == pytest.approx(peaks.speed, rel=0.05)
        assert max(highest - pose, pose - lowest) == pytest.approx(peaks.reach, rel=0.05)
        # The worst case holds what the model does.
        assert row["torque_nm"] >= row["nominal_torque_nm"]
        assert row["highest_rad"] >= highest


def test_a_held_joint_stays_still_beside_a_stiff_one(tmp_path: Path) -> None:
    robot = sized_robot(SIZES["wrist of a stiff arm"], tmp_path)
    plan = make_plan(robot, [JOINT], SHORT, amplitudes=(0.005,), repeats=1)
    plan.check()
    (held,) = [worst for worst in plan.forecasts if worst.joint != JOINT]
    assert held.excited == JOINT
    assert held.speed < 0.5
    assert held.highest - held.lowest < 0.01


@pytest.mark.parametrize("effort_limit", [30.0, 1.5])
def test_small_amplitudes_that_fit_are_found(effort_limit: float, tmp_path: Path) -> None:
    """Of a step of the command the drive needs nearly the stiffness times its height."""
    size = replace(SIZES["wrist of a stiff arm"], effort_limit=effort_limit)
    robot = sized_robot(size, tmp_path)
    plan = make_plan(robot, [JOINT], SHORT, amplitudes=(0.25,), repeats=1)
    fitting = plan.fitting_amplitude(JOINT)
    assert 0.1 * effort_limit / size.stiffness < fitting < effort_limit / size.stiffness
    with pytest.raises(PlanError, match=f"{fitting:.3g} rad fits"):
        plan.check()
    make_plan(robot, [JOINT], SHORT, amplitudes=(fitting,), repeats=1).check()
    with pytest.raises(PlanError):
        make_plan(robot, [JOINT], SHORT, amplitudes=(1.1 * fitting,), repeats=1).check()


def test_gains_that_no_step_can_follow_are_said_to_be_so(tmp_path: Path) -> None:
    undamped = Size(mass=0.001, length=0.01, stiffness=2000.0, damping=0.0001, effort_limit=1e4)
    robot = sized_robot(undamped, tmp_path)
    with pytest.raises(PlanError, match="cannot be forecast") as caught:
        make_plan(robot, [JOINT], Chirp(length_s=1.0, stop_hz=15.0), repeats=1)
    assert "2000 / 0.0001" in str(caught.value)


def test_the_fall_into_the_pose_is_no_part_of_a_forecast(tmp_path: Path) -> None:
    path = tmp_path / "sagging.xml"
    path.write_text(
        """\
<mujoco model="sagging">
  <worldbody>
    <body name="link">
      <inertial pos="0.3 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
      <joint name="lift" axis="0 -1 0" range="-90 90" limited="true"/>
    </body>
  </worldbody>
  <actuator>
    <position joint="lift" kp="30" kv="3" forcerange="-20 20"/>
  </actuator>
</mujoco>
"""
    )
    plan = make_plan(load_robot(str(path)), ["lift"], amplitudes=(0.001,), repeats=1)
    (row,) = plan.rows()
    assert float(row["highest_rad"]) < -0.05  # it hangs below its command
    assert float(row["speed_rad_s"]) < 0.1


def with_range(robot: RobotSpec, name: str, low: float, high: float) -> RobotSpec:
    """Return the robot with another range of a joint."""
    joints = []
    for joint in robot.joints:
        joints.append(replace(joint, range=(low, high)) if joint.name == name else joint)
    return replace(robot, joints=tuple(joints))


def test_an_amplitude_that_a_narrow_range_allows_is_found(tmp_path: Path) -> None:
    robot = with_range(sized_robot(SIZES["servo"], tmp_path), JOINT, 0.29, 0.31)
    plan = make_plan(robot, [JOINT], SHORT, amplitudes=(0.25,), repeats=1)
    fitting = plan.fitting_amplitude(JOINT)
    assert 1e-3 < fitting < 0.01
    make_plan(robot, [JOINT], SHORT, amplitudes=(fitting,), repeats=1).check()


def test_amplitudes_that_no_encoder_resolves_are_refused(tmp_path: Path) -> None:
    robot = sized_robot(SIZES["finger of 5 g"], tmp_path)
    with pytest.raises(PlanError, match="encoder"):
        make_plan(robot, [JOINT], SHORT, amplitudes=(1e-5,), repeats=1)
    (least,) = make_plan(robot, [JOINT], SHORT, amplitudes=(1e-4,), repeats=1).forecasts
    narrow = with_range(robot, JOINT, least.lowest + 3e-5, least.highest - 3e-5)
    plan = make_plan(narrow, [JOINT], SHORT, amplitudes=(0.05,), repeats=1)
    assert 0.0 < plan.fitting_amplitude(JOINT) < 1e-4
    with pytest.raises(PlanError, match="no encoder resolves"):
        plan.check()


def test_where_a_held_joint_rests_is_no_effect_of_the_excitation(tmp_path: Path) -> None:
    robot = sized_robot(SIZES["knee without armature"], tmp_path)
    quiet = make_plan(robot, [JOINT], SHORT, amplitudes=(1e-4,), repeats=1)
    (held,) = [worst for worst in quiet.forecasts if worst.joint != JOINT]
    # Its weight takes it half a milliradian beyond its stop.
    at_stop = with_range(robot, held.joint, held.lowest + 5e-4, 2.5)
    plan = make_plan(at_stop, [JOINT], SHORT, amplitudes=(1e-4,), repeats=1)
    plan.check()
    # No more is allowed than it does by itself, and a milliradian.
    (held_at_stop,) = [worst for worst in plan.forecasts if worst.joint != JOINT]
    assert held_at_stop.range[0] == pytest.approx(held.lowest - 1e-3, abs=2e-4)
    assert held_at_stop.range[1] == 2.5
    farther = replace(held_at_stop, lowest=held_at_stop.range[0] - 1e-3)
    assert "below its range" in next(farther.breaches())


def with_drive(robot: RobotSpec, **drive: float) -> RobotSpec:
    """Return the robot with other numbers of its drives."""
    joints = []
    for joint in robot.joints:
        joints.append(replace(joint, drive=replace(joint.drive, **drive)))
    return replace(robot, joints=tuple(joints))


def test_a_plan_leaves_room_below_the_no_load_speed(tmp_path: Path) -> None:
    """A sweep ends where a measured speed, which has noise, exceeds it."""
    size = replace(SIZES["servo"], effort_limit=100.0)
    robot = with_drive(sized_robot(size, tmp_path), no_load_speed=1.0, stall_torque=1e4)
    plan = make_plan(robot, [JOINT], SHORT, amplitudes=(0.25,), repeats=1)
    fitting = plan.fitting_amplitude(JOINT)
    (row,) = make_plan(robot, [JOINT], SHORT, amplitudes=(fitting,), repeats=1).rows()
    assert 0.85 < float(row["speed_rad_s"]) < 0.96


def test_a_joint_that_nothing_damps_is_refused_with_the_cause(tmp_path: Path) -> None:
    undamped = Size(mass=0.06, length=0.1, stiffness=8.0, damping=0.0, effort_limit=20.0)
    robot = with_range(sized_robot(undamped, tmp_path), JOINT, 0.288, 0.312)
    plan = make_plan(robot, [JOINT], SHORT, amplitudes=(0.25,), repeats=1)
    with pytest.raises(PlanError, match="damp"):
        plan.check()
    damped = replace(undamped, damping=0.12)
    robot = with_range(sized_robot(damped, tmp_path), JOINT, 0.288, 0.312)
    with pytest.raises(PlanError, match="rad fits") as caught:
        make_plan(robot, [JOINT], SHORT, amplitudes=(0.25,), repeats=1).check()
    assert "damp" not in str(caught.value)


def test_a_plan_that_dry_friction_stops_is_warned_of(tmp_path: Path) -> None:
    size = replace(SIZES["servo"], frictionloss=0.2, effort_limit=30.0)
    robot = sized_robot(size, tmp_path)
    for amplitude, count in ((0.25, 0), (0.04, 1)):
        plan = make_plan(robot, [JOINT], SHORT, amplitudes=(amplitude,), repeats=1)
        plan.check()
        assert len(plan.warnings()) == count
