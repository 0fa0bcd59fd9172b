"""A whole arm at once: known drives recovered, refusals, and the recorded SO-101."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pronk.errors import IdentifiabilityError, LogError, PronkError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.options import ReadOptions
from pronk.identify.logs.readers import read_log
from pronk.identify.logs.segment import Segment
from pronk.identify.match import gains as gains_file
from pronk.identify.match.arm import fit_together, trusted_frequency, trusted_samples
from pronk.identify.match.match import match
from pronk.identify.match.parameters import DRIVE_MODE
from pronk.identify.match.predict import drives_of, predict
from pronk.identify.match.result import MatchResult
from pronk.identify.match.settings import MatchSettings
from pronk.identify.simulators.chain import ChainSimulation, moves_together
from pronk.robots import load_robot

SO101 = Path(__file__).resolve().parents[3] / "shared" / "data" / "so101"
recorded = pytest.mark.skipif(not SO101.is_dir(), reason="the SO-101 recordings are not here")

ARM = load_robot("so101")
JOINTS = ARM.joint_names[:5]
COUNT = 2.0 * np.pi / 4096
"""Encoder of the servo: 12 bits."""
KNOWN = {
    name: {
        "stiffness": 17.8,
        "damping": 0.75 + 0.1 * i,
        "armature": 0.02 + 0.004 * i,
        "frictionloss": 0.1 + 0.05 * i,
        "stribeck": 0.15 * i,
        "delay": 0.012,
    }
    for i, name in enumerate(JOINTS)
}


def commands(seconds: float, lines_hz: tuple[float, float], amplitude: float) -> JointLog:
    """Every joint on lines of its own; positions are not there yet."""
    time, random = np.arange(0.0, seconds, 0.02), np.random.default_rng(1)
    start = np.array([ARM.joint(name).default_position for name in JOINTS])
    position = np.tile(start, (len(time), 1))
    command = position.copy()
    for i in range(len(JOINTS)):
        hz = np.geomspace(*lines_hz, 12) * (1.0 + 0.015 * i)
        phase = random.uniform(0.0, 2.0 * np.pi, len(hz))
        signal = np.sin(2.0 * np.pi * time[:, None] * hz + phase).sum(axis=1)
        command[:, i] += amplitude * np.minimum(time, 1.0) * signal / np.abs(signal).max()
    return JointLog(robot="so101", joints=JOINTS, time=time, command=command, position=position)


def recorded_with_known_drives(log: JointLog) -> JointLog:
    """What an arm with the known drives and 12-bit encoders would have recorded."""
    with ChainSimulation(ARM, [log]) as bench:
        position = bench.run([KNOWN])[0][0]
    return replace(log, position=np.round(position / COUNT) * COUNT)


def test_known_drives_are_recovered_from_all_joints_moving_at_once() -> None:
    log = recorded_with_known_drives(commands(65.0, (0.15, 8.0), 0.35))
    chains, _ = fit_together([log], ARM, DRIVE_MODE, most_held=0)
    for name, known in KNOWN.items():
        fit, _ = chains[name]
        assert fit.values["stiffness"] == known["stiffness"]
        assert fit.values["damping"] == pytest.approx(known["damping"], rel=0.03)
        assert fit.values["armature"] == pytest.approx(known["armature"], rel=0.08)
        assert fit.values["frictionloss"] == pytest.approx(known["frictionloss"], rel=0.05)
        assert fit.values["stribeck"] == pytest.approx(known["stribeck"], abs=0.08)
        assert fit.values["delay"] == pytest.approx(known["delay"], abs=1e-3)
        assert fit.rmse < 1e-3 < fit.nominal_rmse


@pytest.mark.parametrize("speed", [0.05, 0.15, 0.6])
def test_dry_friction_falls_with_speed(speed: float) -> None:
    stiffness, damping, dry, share = 18.0, 1.5, 0.2, 0.8
    drive = {"stiffness": stiffness, "damping": damping, "frictionloss": dry, "stribeck": share}
    lag = []
    for sign in (1.0, -1.0):  # gravity, which hardly loads this joint, pulls one way
        log = commands(4.0, (0.2, 3.0), 0.0)
        command = log.command.copy()
        command[:, -1] = sign * speed * log.time
        with ChainSimulation(ARM, [replace(log, command=command)]) as bench:
            position = bench.run([{"wrist_roll": drive}])[0][0][:, 0]
        lag.append(sign * (command[-1, -1] - position[-1]))
    slow = np.exp(-((speed / ARM.joint("wrist_roll").drive.stribeck_speed) ** 2))
    # Each command is held for four steps of 5 ms: on average it is 7.5 ms old at their starts.
    torque = stiffness * (np.mean(lag) - 0.0075 * speed) - damping * speed
    assert torque == pytest.approx(dry * (1.0 - share * (1.0 - slow)), abs=0.01)


def test_slow_motion_does_not_tell_armature_from_delay_and_is_refused() -> None:
    log = recorded_with_known_drives(commands(65.0, (0.03, 0.2), 0.1))
    with pytest.raises(IdentifiabilityError, match=r"armature.*a sweep to higher frequencies"):
        fit_together([log], ARM, DRIVE_MODE, most_held=0)


def test_command_that_is_logged_late_is_flagged() -> None:
    log = recorded_with_known_drives(commands(30.0, (0.2, 6.0), 0.3))
    late = np.concatenate([log.command[:1], log.command[:-1]])
    late_log = replace(log, command=late)
    result = match([late_log], ARM, mode="drive", drive_gains="default")
    for joint in result.joints.values():
        assert joint.fit.values["delay"] < 0.0
        assert joint.gains.delay_s.value == 0.0
        flags = joint.gains.flags
        assert any("delay -8.0 ms" in flag and "command later" in flag for flag in flags)


def test_named_parameters_alone_are_fitted() -> None:
    log = recorded_with_known_drives(commands(20.0, (0.2, 3.0), 0.2))
    damping = MatchSettings(fitted=("damping",))
    result = match([log], ARM, mode="drive", settings=damping, drive_gains="default")
    for joint in result.joints.values():
        assert set(joint.fit.ci95) == {"damping"}
        assert joint.gains.stiffness.value == 17.8
    intervals = set()
    for fit, _ in fit_together([log], ARM, ("delay",))[0].values():
        assert set(fit.ci95) == {"delay"}
        intervals.add(fit.ci95["delay"])
    # The delay is one for the chain.
    ((low, high),) = intervals
    assert low < high
    offset = MatchSettings(fitted=("offset",))
    with pytest.raises(PronkError, match="offset"):
        match([log], ARM, mode="drive", settings=offset, drive_gains="default")


def test_what_cannot_be_fitted_is_refused() -> None:
    log = commands(5.0, (0.2, 3.0), 0.2)
    with pytest.raises(LogError, match="at least 3"):
        match([log], ARM, drive_gains="default")
    with pytest.raises(PronkError, match="stiffness, damping"):
        fit_together([log], ARM, ("kd",))
    with pytest.raises(LogError, match="at least one"):
        fit_together([], ARM, DRIVE_MODE)
    with pytest.raises(LogError, match="radians"):
        ChainSimulation(ARM, [commands(30.0, (0.2, 3.0), 0.0)])


def test_moving_together_differs_from_taking_turns() -> None:
    log = commands(10.0, (0.2, 3.0), 0.2)
    assert moves_together(log)
    first, after, during = (
        Segment(kind="unknown", joints=(joint,), start=start, stop=start + 4.0, amplitude=0.1)
        for joint, start in ((JOINTS[0], 0.0), (JOINTS[1], 5.0), (JOINTS[1], 3.0))
    )
    assert not moves_together(replace(log, segments=(first, after)))
    assert moves_together(replace(log, segments=(first, during)))


def test_sweep_is_used_up_to_where_it_breaks() -> None:
    time = np.arange(0.0, 120.0, 0.02)
    hz = 0.1 * 50.0 ** (time / time[-1])
    phase = 2.0 * np.pi * np.cumsum(hz) * 0.02
    command = 0.15 * np.sin(phase)
    noise = 0.05 * np.random.default_rng(0).standard_normal(len(time))
    position = np.where(hz < 2.5, command, noise)
    assert trusted_frequency(time, command, position) == pytest.approx(2.5, abs=0.3)
    assert trusted_frequency(time, command, command) == np.inf
    one = {"joints": ("elbow_flex",), "command": command[:, None], "position": position[:, None]}
    log = JointLog(robot="so101", time=time, **one)  # type: ignore[arg-type]
    mask, _ = trusted_samples(log, "elbow_flex")
    assert hz[mask].max() == pytest.approx(2.5, abs=0.3)
    assert mask[hz < 2.0].all()


@pytest.fixture(scope="module")
def matched() -> MatchResult:
    return match([read_log(SO101 / "chirp_sweep", robot=ARM)], ARM, drive_gains="default")


@recorded
def test_recorded_arm_steps_are_predicted_better_than_with_published_figures(
    matched: MatchResult, tmp_path: Path
) -> None:
    gains_file.save_gains(tmp_path / "gains.yaml", matched.gains)
    gains = gains_file.load_gains(tmp_path / "gains.yaml")
    friction = matched.joints["elbow_flex"].fit.values["frictionloss"]
    assert drives_of(ARM, gains)["elbow_flex"]["frictionloss"] == pytest.approx(friction, rel=1e-5)
    found = predict(read_log(SO101 / "step_response", robot=ARM), ARM, gains, drive_gains="default")
    assert tuple(one.joint for one in found.joints) == JOINTS
    for one in found.joints:
        assert one.rmse_matched < 0.7 * one.rmse_nominal
        assert one.r2_matched > one.r2_nominal
    # The jaw moved too, on a scale that is not radians: left out, with the way out.
    assert "give the reader its travel in radians" in found.excluded["gripper"]


@recorded
def test_recorded_sweep_is_matched_and_what_it_does_not_identify_held(matched: MatchResult) -> None:
    # Commands go out together, so no joint has a delay of its own to pass for stiffer gains: the
    # servos, all alike, come out alike, also those that gravity does not load.
    stiffness = [joint.stiffness.value for joint in matched.gains.joints.values()]
    assert max(stiffness) < 1.25 * min(stiffness)
    for joint in matched.gains.joints.values():
        assert joint.delay_s.value == 0.0
        assert any("delay held at 0" in f for f in joint.flags)
    for name in ("shoulder_lift", "elbow_flex"):
        low, high = matched.gains.joints[name].stiffness.repeat95
        assert high - low < 0.3 * matched.gains.joints[name].stiffness.value
    assert set(matched.joints) == set(JOINTS)
    for name, joint in matched.joints.items():
        assert joint.responses is not None
        assert joint.responses.error_db < 0.5 * joint.responses.nominal_error_db, name
        assert joint.responses.band_hz[1] < 3.0  # the chirp outran the servos above


@recorded
def test_jaw_is_included_once_its_travel_is_given() -> None:
    log = read_log(SO101 / "step_response", robot=ARM, options=ReadOptions(scale={"gripper": 1.5}))
    with ChainSimulation(ARM, [log]) as bench:
        assert bench.joints == ARM.joint_names
        assert bench.excluded == {}
