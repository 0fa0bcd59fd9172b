"""Excitations found in the commands of logs that do not name them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from log_files import write_mcap
from pronk.identify.logs.joint_log import JointLog, group_repeats
from pronk.identify.logs.readers import read_log
from pronk.identify.match.measured import measured_joints
from pronk.identify.match.replay import JointReplay
from pronk.identify.match.settings import MatchSettings
from pronk.identify.response.estimate import estimate_response
from pronk.identify.simulators.chain import moves_together
from pronk.identify.simulators.command_trace import command_trace
from pronk.identify.simulators.load import joint_rigs
from pronk.robots import load_robot
from synthetic_joint import KNEE, chirp_command, multisine_command, simulate_second_order

ROBOT = load_robot("mini_cheetah")
LEG = ("FR_hip_roll", "FR_hip_pitch", "FR_knee")
POSE = np.array([ROBOT.joint(name).default_position for name in LEG])
RATE = 500.0
CHIRP = chirp_command("chirp", RATE)[1]  # 20 s at 0.25 rad and 1 s of rest
JITTER_S = 5e-5


def log_of(*parts: tuple[str, np.ndarray], begin: np.ndarray | None = None) -> JointLog:
    """Commands about the pose one after another, each to one joint or to `all` of them.

    With `begin` the leg stands there at first and moves to the pose within a second.
    """
    rows = []
    if begin is not None:
        share = np.clip(np.arange(1000.0) / 500.0 - 0.5, 0.0, 1.0)[:, None]
        rows.append(begin + share * (POSE - begin))
        rows.append(np.tile(POSE, (400, 1)))
    for joint, signal in parts:
        moved = np.array([joint in (name, "all") for name in LEG])
        rows.append(POSE + signal[:, None] * moved)
    command = np.concatenate(rows)
    time = np.arange(len(command)) / RATE
    time += np.random.default_rng(0).uniform(0.0, JITTER_S, len(time))
    position = np.empty_like(command)
    for column in range(len(LEG)):
        position[:, column] = simulate_second_order(command[:, column], RATE, **KNEE)
    return JointLog(robot=ROBOT.name, joints=LEG, time=time, command=command, position=position)


def test_repeats_and_amplitudes_in_one_file_are_separated(tmp_path: Path) -> None:
    knee = [("FR_knee", size * CHIRP) for size in (1.0, 0.4, 1.0, 1.0)]
    write_mcap(tmp_path / "a.mcap", log_of(*knee))
    log = read_log(tmp_path / "a.mcap", robot=ROBOT)
    assert [segment.repeat for segment in log.segments] == [0, 0, 1, 2]
    amplitudes = [round(segment.amplitude, 3) for segment in log.segments]
    assert amplitudes == [0.25, 0.1, 0.25, 0.25]
    for k, segment in enumerate(log.segments):
        # The chirp, and a part of the rest before and after it.
        assert 21.0 * k - 0.6 < segment.start <= 21.0 * k + 0.03
        assert 21.0 * k + 20.3 < segment.stop < 21.0 * k + 21.03
    loud_excitations, quiet_excitations = group_repeats(log.excitations("FR_knee"))
    assert len(loud_excitations) == 3
    assert len(quiet_excitations) == 1
    with joint_rigs("mujoco", ROBOT) as rigs:
        replay = JointReplay(rigs, log.excitations("FR_knee"))
    assert [recording.command for recording in replay.recordings] == [0, 0, 0, 1]
    loud, quiet = estimate_response(log, "FR_knee")
    assert (len(loud.repeats), len(quiet.repeats)) == (3, 1)
    # The same as of the first chirp alone, which a file of its own would hold.
    alone = estimate_response(log_of(knee[0]), "FR_knee")[0]
    for response in (loud, quiet):
        np.testing.assert_allclose(response.response, alone.response, atol=0.02)
    assert len(measured_joints([log], "FR_knee", ROBOT, MatchSettings())) == 2


def test_joints_after_one_another_do_not_move_together() -> None:
    parts = []
    for name in LEG:
        parts.append((name, CHIRP))
        parts.append((name, CHIRP))
    log = log_of(*parts, begin=POSE + np.array([0.3, -0.4, 0.5])).segmented()
    for segment, (name, _) in zip(log.segments, parts, strict=True):
        assert segment.joints[0] == name
    assert not moves_together(log)
    assert any("changes of pose of FR_hip_roll, FR_hip_pitch" in note for note in log.notes)
    assert log.pose is not None
    np.testing.assert_allclose(log.pose, POSE, atol=1e-9)
    for name in LEG:
        with joint_rigs("mujoco", ROBOT) as rigs:
            replay = JointReplay(rigs, log.excitations(name))
        assert [recording.command for recording in replay.recordings] == [0, 0]
        trace = command_trace(log.excitations(name)[0], ROBOT)
        np.testing.assert_allclose(trace.command[0], ROBOT.joint(name).default_position)


def test_a_change_of_pose_between_excitations_is_not_left_out() -> None:
    moved = log_of(("FR_knee", CHIRP), ("FR_knee", CHIRP))
    command = moved.command.copy()
    half = len(moved.time) // 2
    command[half - 100 :, 1] += np.minimum(np.arange(half + 100) / 500.0, 1.0)
    log = replace(moved, command=command).segmented()
    assert set(log.excited_joints) == set(LEG[1:])
    assert moves_together(log)


def test_joints_at_once_move_together_and_repeat() -> None:
    log = log_of(("all", CHIRP), ("all", CHIRP)).segmented()
    assert moves_together(log)
    for name in LEG:
        assert len(log.excitations(name)) == 2
        assert len(group_repeats(log.excitations(name))) == 1


SHORT = CHIRP[: round(2.0 * RATE)].copy()
SHORT[-round(0.5 * RATE) :] = 0.0
STEPS = np.repeat([0.0, 0.1, 0.0, -0.1, 0.0], 500)


@pytest.mark.parametrize(
    "signals",
    [
        (CHIRP,),
        (CHIRP, multisine_command(RATE)[1]),
        (SHORT, SHORT, SHORT),
        (STEPS, STEPS),
        (np.repeat([0.0, 0.1, 0.2, 0.3, 0.4], 500),),
        (CHIRP, STEPS),
        (CHIRP, -CHIRP),
    ],
    ids=["one", "two kinds", "too short", "pulses", "stairs", "with pulses", "negative"],
)
def test_what_is_no_repeat_stays_one_excitation(signals: tuple[np.ndarray, ...]) -> None:
    parts = [("FR_knee", signal) for signal in signals]
    unnamed = log_of(*parts)
    log = unnamed.segmented()
    (segment,) = log.segments
    assert segment.joints == ("FR_knee",)
    assert segment.start == unnamed.time[0]
    assert segment.stop == unnamed.time[-1]


@pytest.mark.parametrize(
    "other", [np.repeat([0.0, 0.1, 0.2, 0.3, 0.4], 500), CHIRP[: round(7.03 * RATE)]]
)
def test_stairs_and_a_chirp_that_is_cut_are_excitations(other: np.ndarray) -> None:
    log = log_of(("FR_knee", CHIRP), ("FR_hip_roll", other)).segmented()
    assert not moves_together(log)
    assert log.excited_joints == ("FR_hip_roll", "FR_knee")


def test_noise_of_another_command_is_no_excitation() -> None:
    unnamed = log_of(("FR_knee", CHIRP))
    noise = 1e-4 * np.random.default_rng(0).random(unnamed.command.shape)
    noise[:, 2] = 0.0
    command = unnamed.command + noise
    log = replace(unnamed, command=command).segmented()
    assert log.excited_joints == ("FR_knee",)
    assert not moves_together(log)


def test_a_log_that_stands_still_has_no_excitation() -> None:
    assert log_of(("FR_knee", np.zeros(2000))).segmented().segments == ()
