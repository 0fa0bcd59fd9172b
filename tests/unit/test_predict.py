"""Replays: the gains that made a log replay it exactly; naive gains do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from chirp_logs import chirp_log
from pronk.errors import LogError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match.gains import FittedValue, JointGains, MatchedGains
from pronk.identify.match.predict import predict, r2, rmse
from pronk.identify.simulators.simulator import SimulatorInfo
from pronk.robots import load_robot

ROBOT = load_robot("mini_cheetah")
MADE_WITH = {"FL_hip_roll": (20.0, 0.5), "HR_knee": (22.0, 0.55)}


def gains(*names: str, **extra: float) -> MatchedGains:
    joints = {}
    for name in names or MADE_WITH:
        stiffness, damping = MADE_WITH[name]
        joints[name] = JointGains(
            stiffness=FittedValue(value=stiffness),
            damping=FittedValue(value=damping),
            armature=FittedValue(value=ROBOT.joint(name).drive.armature),
            **{parameter: FittedValue(value=value) for parameter, value in extra.items()},
        )
    return MatchedGains(robot=ROBOT.name, simulator=SimulatorInfo(), joints=joints, groups={})


def two_joints(delay_s: float = 0.0) -> JointLog:
    """Two joints, one after the other, recorded in the training simulator."""
    one, two = (
        chirp_log(ROBOT, name, pair, (0.2,), length_s=4.0, delay_s=delay_s)
        for name, pair in MADE_WITH.items()
    )
    later = one.time[-1] + 0.002
    still = [np.full_like(log.position, log.pose) for log in (one, two)]
    (segment,) = two.segments
    segment = replace(segment, start=segment.start + later, stop=segment.stop + later)
    return replace(
        one,
        joints=tuple(MADE_WITH),
        time=np.concatenate([one.time, later + two.time]),
        command=np.block([[one.command, still[1]], [still[0], two.command]]),
        position=np.block([[one.position, still[1]], [still[0], two.position]]),
        segments=(*one.segments, segment),
        stiffness=np.full(2, 17.0),
        damping=np.full(2, 0.4),
        pose=np.concatenate([one.pose, two.pose]),
    )


def test_gains_that_made_the_log_replay_it_and_naive_ones_do_not() -> None:
    found = predict(two_joints(), ROBOT, gains())
    assert found.virtual
    assert [one.joint for one in found.joints] == list(MADE_WITH)
    for one in found.joints:
        assert one.signal == "chirp"
        assert one.rmse_matched < 1e-5
        assert one.rmse_nominal > 20 * one.rmse_matched
        assert one.r2_matched > 0.9999 > one.r2_nominal
        assert len(one.time) == len(one.command) == len(one.measured) == len(one.nominal)


def test_matched_delay_is_applied_to_the_command() -> None:
    log = two_joints(delay_s=0.02)
    late = predict(log, ROBOT, gains(delay_s=0.02))
    without = predict(log, ROBOT, gains())
    for delayed, prompt in zip(late.joints, without.joints, strict=True):
        assert delayed.rmse_matched < 1e-5 < 0.05 * prompt.rmse_matched
        # The delay alone helps the naive gains too, and the table says by how much.
        assert delayed.rmse_matched < delayed.rmse_nominal_delayed < delayed.rmse_nominal
        assert prompt.rmse_nominal_delayed == prompt.rmse_nominal


def test_friction_of_the_gains_is_used() -> None:
    more = predict(two_joints(), ROBOT, gains("HR_knee", frictionloss=1.5)).joints[0]
    same = predict(two_joints(), ROBOT, gains("HR_knee")).joints[0]
    assert more.rmse_matched > 10 * same.rmse_matched
    assert more.rmse_nominal == same.rmse_nominal


def test_joint_without_gains_is_left_out_with_a_reason() -> None:
    found = predict(two_joints(), ROBOT, gains("HR_knee"))
    assert [one.joint for one in found.joints] == ["HR_knee"]
    assert "FL_hip_roll" in found.excluded["FL_hip_roll"]
    with pytest.raises(LogError, match="nothing to replay"):
        predict(two_joints(), ROBOT, replace(gains(), joints={}))
    with pytest.raises(LogError, match=r"mini_cheetah.*so101"):
        predict(two_joints(), load_robot("so101"), gains("HR_knee"))


def test_rmse_and_r2_by_hand() -> None:
    measured, simulated = np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.0, 5.0])
    assert rmse(simulated, measured) == pytest.approx(np.sqrt(4.0 / 3.0))
    assert r2(simulated, measured) == pytest.approx(1.0 - 4.0 / 2.0)
    assert np.isnan(r2(simulated, np.ones(3)))
