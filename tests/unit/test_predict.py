"""Replays: the gains that made a log replay it exactly; naive gains do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from benchmarks.synthetic_log import simulate
from pronk.errors import LogError
from pronk.logs.joint_log import JointLog, Segment
from pronk.match.gains import JointGains, MatchedGains
from pronk.match.predict import predict, r2, rmse
from pronk.robots import load_robot
from pronk.simulators.command_trace import command_trace
from pronk.simulators.simulator import SimulatorInfo

ROBOT = load_robot("mini_cheetah")
MADE_WITH = {"FL_hip_roll": (20.0, 0.5), "HR_knee": (22.0, 0.55)}


def gains(names: tuple[str, ...], **extra: float) -> MatchedGains:
    return MatchedGains(
        robot=ROBOT.name,
        simulator=SimulatorInfo(),
        joints={
            name: JointGains(
                stiffness=MADE_WITH[name][0],
                damping=MADE_WITH[name][1],
                armature=ROBOT.joint(name).drive.armature,
                **extra,
            )
            for name in names
        },
        groups={},
    )


def chirp_log(late_ticks: int = 0) -> JointLog:
    """Two joints, one after the other, recorded in the training simulator."""
    seconds, rate = 4.0, 500
    time = np.arange(round(2 * seconds * rate)) / rate
    tick = np.floor(time * 50.0 + 1e-9) / 50.0
    names = ROBOT.joint_names
    pose = np.array([joint.default_position for joint in ROBOT.joints])
    position = np.tile(pose, (len(time), 1))
    command = position.copy()
    segments = []
    for i, name in enumerate(MADE_WITH):
        start, stop = i * seconds, (i + 1) * seconds - 1.0 / rate
        inside = (time >= start) & (time <= stop)
        at = tick[inside] - start
        column = names.index(name)
        signal = 0.2 * np.sin(2.0 * np.pi * (0.5 + 1.5 * at) * at)
        command[inside, column] += signal
        segments.append(
            Segment(kind="chirp", joints=(name,), start=start, stop=stop, amplitude=0.2)
        )
    log = JointLog(
        robot=ROBOT.name,
        joints=names,
        time=time,
        command=command,
        position=position,
        segments=tuple(segments),
        pose=pose,
        stiffness=np.full(len(names), 17.0),
        damping=np.full(len(names), 0.4),
        virtual=True,
    )
    for segment in segments:
        name = segment.joints[0]
        trace = command_trace(log, segment, name, ROBOT)
        steps = late_ticks * ROBOT.decimation
        if steps:
            held = np.concatenate([np.full(steps, trace.command[0]), trace.command[:-steps]])
            trace = replace(trace, command=held)
        response = simulate(ROBOT, trace, *MADE_WITH[name])[0]
        inside = (time >= segment.start) & (time <= segment.stop)
        log.position[inside, names.index(name)] = CubicSpline(trace.time, response)(time[inside])
    return log


def test_gains_that_made_the_log_replay_it_and_naive_ones_do_not() -> None:
    found = predict(chirp_log(), ROBOT, gains(tuple(MADE_WITH)))
    assert found.virtual
    assert [one.joint for one in found.joints] == list(MADE_WITH)
    for one in found.joints:
        assert one.signal == "chirp"
        assert one.rmse_matched < 1e-5
        assert one.rmse_naive > 20 * one.rmse_matched
        assert one.r2_matched > 0.9999 > one.r2_naive
        assert len(one.time) == len(one.command) == len(one.measured) == len(one.naive)


def test_matched_delay_is_applied_to_the_command() -> None:
    log = chirp_log(late_ticks=1)
    late = predict(log, ROBOT, gains(tuple(MADE_WITH), delay_s=0.02))
    without = predict(log, ROBOT, gains(tuple(MADE_WITH)))
    for delayed, prompt in zip(late.joints, without.joints, strict=True):
        assert delayed.rmse_matched < 1e-5 < 0.05 * prompt.rmse_matched
        # The delay alone helps the naive gains too, and the table says by how much.
        assert delayed.rmse_matched < delayed.rmse_naive_delayed < delayed.rmse_naive
        assert prompt.rmse_naive_delayed == prompt.rmse_naive


def test_friction_of_the_gains_is_used() -> None:
    names = ("HR_knee",)
    more = predict(chirp_log(), ROBOT, gains(names, frictionloss=1.5)).joints[0]
    same = predict(chirp_log(), ROBOT, gains(names)).joints[0]
    assert more.rmse_matched > 10 * same.rmse_matched
    assert more.rmse_naive == same.rmse_naive


def test_joint_without_gains_is_left_out_with_a_reason() -> None:
    found = predict(chirp_log(), ROBOT, gains(("HR_knee",)))
    assert [one.joint for one in found.joints] == ["HR_knee"]
    assert "FL_hip_roll" in found.excluded["FL_hip_roll"]
    with pytest.raises(LogError, match="nothing to replay"):
        predict(chirp_log(), ROBOT, replace(gains(("HR_knee",)), joints={}))


def test_gains_of_another_robot_are_refused() -> None:
    with pytest.raises(LogError, match=r"mini_cheetah.*so101"):
        predict(chirp_log(), load_robot("so101"), gains(("HR_knee",)))


def test_rmse_and_r2_by_hand() -> None:
    measured, simulated = np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.0, 5.0])
    assert rmse(simulated, measured) == pytest.approx(np.sqrt(4.0 / 3.0))
    assert r2(simulated, measured) == pytest.approx(1.0 - 4.0 / 2.0)
    assert np.isnan(r2(simulated, np.ones(3)))
