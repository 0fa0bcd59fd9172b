"""Predictions: the gains that made a log replay it exactly; the nominal gains do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from chirp_logs import chirp_log
from pronk.errors import LogError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match.gains import FittedValue, JointGains, MatchedGains
from pronk.identify.match.predict import predict, r2, rmse
from pronk.identify.simulators.info import SimulatorInfo
from pronk.robots import load_robot

ROBOT = load_robot("mini_cheetah")
MADE_WITH = {"FL_hip_roll": (20.0, 0.5), "HR_knee": (22.0, 0.55)}


def gains(*names: str, **extra: float) -> MatchedGains:
    extra_values = {}
    for parameter, value in extra.items():
        extra_values[parameter] = FittedValue(value=value)
    joints = {}
    for name in names or MADE_WITH:
        stiffness, damping = MADE_WITH[name]
        joints[name] = JointGains(
            stiffness=FittedValue(value=stiffness),
            damping=FittedValue(value=damping),
            armature=FittedValue(value=ROBOT.joint(name).drive.armature),
            **extra_values,
        )
    return MatchedGains(robot=ROBOT.name, simulator=SimulatorInfo(), joints=joints, groups={})


def two_joints(delay_s: float = 0.0) -> JointLog:
    """Two joints, one after the other, recorded in the training simulator."""
    logs = []
    for name, pair in MADE_WITH.items():
        logs.append(chirp_log(ROBOT, name, pair, (0.2,), length_s=4.0, delay_s=delay_s))
    first, second = logs
    assert first.pose is not None
    assert second.pose is not None
    offset_s = first.time[-1] + 0.002
    first_still = np.full_like(first.position, first.pose)
    second_still = np.full_like(second.position, second.pose)
    (segment,) = second.segments
    segment = replace(segment, start=segment.start + offset_s, stop=segment.stop + offset_s)
    return replace(
        first,
        joints=tuple(MADE_WITH),
        time=np.concatenate([first.time, offset_s + second.time]),
        command=np.block([[first.command, second_still], [first_still, second.command]]),
        position=np.block([[first.position, second_still], [first_still, second.position]]),
        segments=(*first.segments, segment),
        stiffness=np.full(2, 17.0),
        damping=np.full(2, 0.4),
        pose=np.concatenate([first.pose, second.pose]),
    )


def test_gains_that_made_the_log_replay_it_and_nominal_gains_do_not() -> None:
    prediction = predict(two_joints(), ROBOT, gains())
    assert prediction.virtual
    assert [joint.joint for joint in prediction.joints] == list(MADE_WITH)
    for joint in prediction.joints:
        assert joint.signal == "chirp"
        assert joint.rmse_matched < 1e-5
        assert joint.rmse_nominal > 20 * joint.rmse_matched
        assert joint.r2_matched > 0.9999 > joint.r2_nominal
        assert len(joint.time) == len(joint.command) == len(joint.measured) == len(joint.nominal)


def test_matched_delay_is_applied_to_the_command() -> None:
    log = two_joints(delay_s=0.02)
    late = predict(log, ROBOT, gains(delay_s=0.02))
    without = predict(log, ROBOT, gains())
    for delayed, prompt in zip(late.joints, without.joints, strict=True):
        assert delayed.rmse_matched < 1e-5 < 0.05 * prompt.rmse_matched
        # The delay alone helps the nominal gains too, and the table says by how much.
        assert delayed.rmse_matched < delayed.rmse_nominal_delayed < delayed.rmse_nominal
        assert prompt.rmse_nominal_delayed == prompt.rmse_nominal


def test_friction_of_the_gains_is_used() -> None:
    more = predict(two_joints(), ROBOT, gains("HR_knee", frictionloss=1.5)).joints[0]
    same = predict(two_joints(), ROBOT, gains("HR_knee")).joints[0]
    assert more.rmse_matched > 10 * same.rmse_matched
    assert more.rmse_nominal == same.rmse_nominal


def test_joint_without_gains_is_left_out_with_a_reason() -> None:
    prediction = predict(two_joints(), ROBOT, gains("HR_knee"))
    assert [joint.joint for joint in prediction.joints] == ["HR_knee"]
    assert "FL_hip_roll" in prediction.excluded["FL_hip_roll"]
    with pytest.raises(LogError, match="nothing to replay"):
        predict(two_joints(), ROBOT, replace(gains(), joints={}))
    with pytest.raises(LogError, match=r"mini_cheetah.*so101"):
        predict(two_joints(), load_robot("so101"), gains("HR_knee"))


def test_rmse_and_r2_by_hand() -> None:
    measured = np.array([1.0, 2.0, 3.0])
    simulated = np.array([1.0, 2.0, 5.0])
    assert rmse(simulated, measured) == pytest.approx(np.sqrt(4.0 / 3.0))
    assert r2(simulated, measured) == pytest.approx(1.0 - 4.0 / 2.0)
    assert np.isnan(r2(simulated, np.ones(3)))
