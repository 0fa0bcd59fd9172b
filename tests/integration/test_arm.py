"""A whole arm at once: known drives recovered, refusals, and the recorded SO-101."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pronk.errors import IdentifiabilityError, LogError, PronkError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.options import ReadOptions
from pronk.identify.logs.readers import read_log
from pronk.identify.logs.segment import Segment
from pronk.identify.match.drive_fit import Unidentified, fit_drives, nominal_drives
from pronk.identify.match.gains import load_gains, save_gains
from pronk.identify.match.match import match
from pronk.identify.match.parameters import DRIVE_MODE
from pronk.identify.match.predict import drives_of, predict
from pronk.identify.match.recordings import trusted_frequency, trusted_samples
from pronk.identify.match.replay import ChainReplay
from pronk.identify.match.result import DriveFit, MatchResult
from pronk.identify.simulators.chain import ChainSimulation, moves_together
from pronk.robots import load_robot

SO101 = Path(__file__).resolve().parents[3] / "shared" / "data" / "so101"
recorded = pytest.mark.skipif(not SO101.is_dir(), reason="the SO-101 recordings are not here")

ARM = load_robot("so101")
JOINTS = ARM.joint_names[:5]
COUNT = 2.0 * np.pi / 4096
"""Resolution of the servo's encoder of 12 bits [rad]."""


def known_drives() -> dict[str, dict[str, float]]:
    """Drives that are not the published ones, each joint's different."""
    drives = {}
    for number, joint in enumerate(JOINTS):
        drives[joint] = {
            "stiffness": 17.8,
            "damping": 0.75 + 0.1 * number,
            "armature": 0.02 + 0.004 * number,
            "frictionloss": 0.1 + 0.05 * number,
            "stribeck": 0.15 * number,
            "delay": 0.012,
        }
    return drives


KNOWN = known_drives()


def commands(seconds: float, lowest_hz: float, highest_hz: float, amplitude: float) -> JointLog:
    """Every joint on lines of its own; positions are not there yet."""
    time = np.arange(0.0, seconds, 0.02)
    random = np.random.default_rng(1)
    start = np.array([ARM.joint(joint).default_position for joint in JOINTS])
    position = np.tile(start, (len(time), 1))
    command = position.copy()
    for column in range(len(JOINTS)):
        lines_hz = np.geomspace(lowest_hz, highest_hz, 12) * (1.0 + 0.015 * column)
        phase = random.uniform(0.0, 2.0 * np.pi, len(lines_hz))
        signal = np.sin(2.0 * np.pi * time[:, None] * lines_hz + phase).sum(axis=1)
        ramp = np.minimum(time, 1.0)
        command[:, column] += amplitude * ramp * signal / np.abs(signal).max()
    return JointLog(robot="so101", joints=JOINTS, time=time, command=command, position=position)


def recorded_with_known_drives(log: JointLog) -> JointLog:
    """What an arm with the known drives and 12-bit encoders would have recorded."""
    with ChainSimulation(ARM, [log]) as simulation:
        position = simulation.run([KNOWN])[0][0]
    return replace(log, position=np.round(position / COUNT) * COUNT)


def fit(
    log: JointLog, parameters: Sequence[str], unidentified: Unidentified = "refuse"
) -> dict[str, DriveFit]:
    """Fit the drives of the arm to one log."""
    with ChainSimulation(ARM, [log]) as simulation:
        nominal = nominal_drives([log], simulation.joints, ARM)
        return fit_drives(
            ChainReplay(simulation),
            parameters=parameters,
            nominal=nominal,
            unidentified=unidentified,
        )


def test_known_drives_are_recovered_from_all_joints_moving_at_once() -> None:
    log = recorded_with_known_drives(commands(65.0, 0.15, 8.0, 0.35))
    fits = fit(log, DRIVE_MODE)
    for joint, true_values in KNOWN.items():
        values = fits[joint].values
        assert values["stiffness"] == true_values["stiffness"]
        assert values["damping"] == pytest.approx(true_values["damping"], rel=0.03)
        assert values["armature"] == pytest.approx(true_values["armature"], rel=0.08)
        assert values["frictionloss"] == pytest.approx(true_values["frictionloss"], rel=0.05)
        assert values["stribeck"] == pytest.approx(true_values["stribeck"], abs=0.08)
        assert values["delay"] == pytest.approx(true_values["delay"], abs=1e-3)
        assert fits[joint].rmse < 1e-3 < fits[joint].nominal_rmse


@pytest.mark.parametrize("speed", [0.05, 0.15, 0.6])
def test_dry_friction_falls_with_speed(speed: float) -> None:
    stiffness = 18.0
    damping = 1.5
    friction = 0.2
    share = 0.8
    drive = {
        "stiffness": stiffness,
        "damping": damping,
        "frictionloss": friction,
        "stribeck": share,
    }
    lags = []
    for sign in (1.0, -1.0):  # gravity, which hardly loads this joint, pulls one way
        log = commands(4.0, 0.2, 3.0, 0.0)
        command = log.command.copy()
        command[:, -1] = sign * speed * log.time
        with ChainSimulation(ARM, [replace(log, command=command)]) as simulation:
            position = simulation.run([{"wrist_roll": drive}])[0][0][:, 0]
        lags.append(sign * (command[-1, -1] - position[-1]))
    slow_share = np.exp(-((speed / ARM.joint("wrist_roll").drive.stribeck_speed) ** 2))
    # Each command is held for four steps of 5 ms: on average it is 7.5 ms old at their starts.
    torque = stiffness * (np.mean(lags) - 0.0075 * speed) - damping * speed
    assert torque == pytest.approx(friction * (1.0 - share * (1.0 - slow_share)), abs=0.01)


def test_slow_motion_does_not_tell_armature_from_delay_and_is_refused() -> None:
    log = recorded_with_known_drives(commands(65.0, 0.03, 0.2, 0.1))
    with pytest.raises(IdentifiabilityError, match=r"armature.*a sweep to higher frequencies"):
        fit(log, DRIVE_MODE)


def test_command_that_is_logged_late_is_flagged() -> None:
    log = recorded_with_known_drives(commands(30.0, 0.2, 6.0, 0.3))
    # A lead of less than a sample is within what timestamps tell; this one is of two less 12 ms.
    late = np.concatenate([log.command[:1], log.command[:1], log.command[:-2]])
    late_log = replace(log, command=late)
    for drive in fit(late_log, DRIVE_MODE, "hold").values():
        assert drive.values["delay"] == pytest.approx(-0.028, abs=1e-3)
        assert any(flag.startswith("lead: ") and "28" in flag for flag in drive.flags)
    result = match([late_log], ARM, mode="drive", drive_gains="default")
    for joint in result.gains.joints.values():
        assert joint.delay_s.value == 0.0


def test_named_parameters_alone_are_fitted() -> None:
    log = recorded_with_known_drives(commands(20.0, 0.2, 3.0, 0.2))
    for drive in fit(log, ("damping",), "hold").values():
        assert set(drive.ci95) == {"damping"}
        assert drive.values["stiffness"] == 17.8
    delays = set()
    for drive in fit(log, ("delay",), "hold").values():
        assert set(drive.ci95) == {"delay"}
        delays.add(drive.ci95["delay"])
    assert len(delays) == 1
    low, high = delays.pop()
    assert low < high


def test_progress_rises_to_almost_all() -> None:
    log = recorded_with_known_drives(commands(20.0, 0.2, 3.0, 0.2))
    shares: list[float] = []
    with ChainSimulation(ARM, [log]) as simulation:
        fit_drives(
            ChainReplay(simulation),
            parameters=("damping",),
            nominal=nominal_drives([log], simulation.joints, ARM),
            progress=shares.append,
        )
    assert shares == sorted(shares)
    assert 0.0 < shares[0] < shares[-1] <= 0.99


def test_what_cannot_be_fitted_is_refused() -> None:
    log = commands(5.0, 0.2, 3.0, 0.2)
    # Five seconds in which no joint moves: whatever is named, nothing is fitted.
    with pytest.raises(IdentifiabilityError, match="do not identify"):
        match([log], ARM, drive_gains="default")
    with pytest.raises(PronkError, match="stiffness, damping"):
        fit(commands(20.0, 0.2, 3.0, 0.2), ("kd",))
    with pytest.raises(LogError, match="radians"):
        ChainSimulation(ARM, [commands(30.0, 0.2, 3.0, 0.0)])


def test_moving_together_differs_from_taking_turns() -> None:
    log = commands(10.0, 0.2, 3.0, 0.2)
    assert moves_together(log)

    def segment(joint: str, start: float) -> Segment:
        return Segment(
            kind="unknown", joints=(joint,), start=start, stop=start + 4.0, amplitude=0.1
        )

    first = segment(JOINTS[0], 0.0)
    after = segment(JOINTS[1], 5.0)
    during = segment(JOINTS[1], 3.0)
    assert not moves_together(replace(log, segments=(first, after)))
    assert moves_together(replace(log, segments=(first, during)))


def test_sweep_is_used_up_to_where_it_breaks() -> None:
    time = np.arange(0.0, 120.0, 0.02)
    frequency_hz = 0.1 * 50.0 ** (time / time[-1])
    phase = 2.0 * np.pi * np.cumsum(frequency_hz) * 0.02
    command = 0.15 * np.sin(phase)
    noise = 0.05 * np.random.default_rng(0).standard_normal(len(time))
    position = np.where(frequency_hz < 2.5, command, noise)
    assert trusted_frequency(time, command, position) == pytest.approx(2.5, abs=0.3)
    assert trusted_frequency(time, command, command) == np.inf
    log = JointLog(
        robot="so101",
        time=time,
        joints=("elbow_flex",),
        command=command[:, None],
        position=position[:, None],
    )
    mask, _ = trusted_samples(log, "elbow_flex")
    assert frequency_hz[mask].max() == pytest.approx(2.5, abs=0.3)
    assert mask[frequency_hz < 2.0].all()


@pytest.fixture(scope="module")
def matched() -> MatchResult:
    return match([read_log(SO101 / "chirp_sweep", robot=ARM)], ARM, drive_gains="default")


@recorded
def test_recorded_arm_steps_are_predicted_better_than_with_published_figures(
    matched: MatchResult, tmp_path: Path
) -> None:
    save_gains(tmp_path / "gains.yaml", matched.gains)
    gains = load_gains(tmp_path / "gains.yaml")
    friction = matched.gains.joints["elbow_flex"].frictionloss.value
    assert drives_of(ARM, gains)["elbow_flex"]["frictionloss"] == pytest.approx(friction, rel=1e-5)
    steps = read_log(SO101 / "step_response", robot=ARM)
    prediction = predict(steps, ARM, gains, drive_gains="default")
    assert tuple(joint.joint for joint in prediction.joints) == JOINTS
    for joint in prediction.joints:
        assert joint.rmse_matched < 0.7 * joint.rmse_nominal
        assert joint.r2_matched > joint.r2_nominal
    # The jaw moved too, on a scale that is not radians: left out, with the way out.
    assert "give the reader its travel in radians" in prediction.excluded["gripper"]


@recorded
def test_recorded_sweep_is_matched_and_what_it_does_not_identify_held(matched: MatchResult) -> None:
    # Commands go out together, so no joint has a delay of its own to pass for stiffer gains: the
    # servos, all alike, come out alike, also those that gravity does not load.
    stiffness = [joint.stiffness.value for joint in matched.gains.joints.values()]
    assert max(stiffness) < 1.25 * min(stiffness)
    for joint in matched.gains.joints.values():
        assert joint.delay_s.value == 0.0
        assert any("delay held at 0" in flag for flag in joint.flags)
    for name in ("shoulder_lift", "elbow_flex"):
        low, high = matched.gains.joints[name].stiffness.repeat95
        assert high - low < 0.3 * matched.gains.joints[name].stiffness.value
    assert set(matched.joints) == set(JOINTS)
    for name, joint in matched.gains.joints.items():
        assert joint.quality.error_db < 0.5 * joint.quality.nominal_error_db, name
        assert joint.quality.band_hz[1] < 3.0  # the chirp outran the servos above


@recorded
def test_jaw_is_included_once_its_travel_is_given() -> None:
    options = ReadOptions(scale={"gripper": 1.5})
    log = read_log(SO101 / "step_response", robot=ARM, options=options)
    with ChainSimulation(ARM, [log]) as simulation:
        assert simulation.joints == ARM.joint_names
        assert simulation.excluded == {}
