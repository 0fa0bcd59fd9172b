"""Matching for other frameworks: known joints found again under each drive law."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from chirp_logs import chirp_log
from command_line import accepted, refused
from pronk.errors import ArtefactError, PronkError
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.match.gains import load_gains, save_gains
from pronk.identify.match.match import Method, match
from pronk.identify.match.predict import predict
from pronk.identify.match.settings import MatchSettings
from pronk.identify.simulators.profiles import load_profiles, profile, profile_of
from pronk.jump.train.gains import training_gains
from pronk.robots import load_robot

ROBOT = load_robot("mini_cheetah")
GAINS = 21.8, 0.541
CHOSEN = ("mjlab-builtin", "isaaclab-implicit", "drake,timestep_s=0.004")


def recorded(name: str) -> JointLog:
    """A knee that a framework simulates, two amplitudes, two repeats, 0.1 mrad of noise."""
    robot = profile(name).robot(ROBOT)
    log = chirp_log(robot, "FR_knee", GAINS, repeats=2, noise_rad=1e-4, seed=3)
    return replace(log, origin=replace(log.origin, source="a.csv"))


@pytest.mark.parametrize("name", CHOSEN)
@pytest.mark.parametrize("method", ["time", "paper"])
def test_the_gains_of_a_simulated_framework_are_found(name: str, method: Method) -> None:
    settings = MatchSettings(zero_armature=False, grid_points=8)
    log = recorded(name)
    result = match([log], ROBOT, name, method=method, settings=settings)
    gains = result.gains.joints["FR_knee"]
    assert (gains.stiffness.value, gains.damping.value) == pytest.approx(GAINS, rel=0.005)
    assert gains.delay_s.value == pytest.approx(0.0, abs=2e-4)
    assert gains.quality.error_db < 0.02
    # The explicit law needs other gains, by far more than they are known to.
    explicit = match([log], ROBOT, method=method, settings=settings).gains.joints["FR_knee"]
    assert explicit.stiffness.value < 0.95 * GAINS[0]
    assert profile_of(result.simulator).drive_law == profile(name).drive_law


def test_gains_of_a_framework_are_replayed_and_not_trained_with(tmp_path: Path) -> None:
    log = recorded("isaaclab-implicit")
    gains = match([log], ROBOT, "isaaclab-implicit").gains
    save_gains(tmp_path / "gains.yaml", gains)
    assert load_gains(tmp_path / "gains.yaml").simulator == gains.simulator
    [joint] = predict(log, ROBOT, gains).joints
    assert joint.rmse_matched < 3e-4
    assert joint.rmse_matched < 0.05 * joint.rmse_nominal
    with pytest.raises(ArtefactError, match="pronk translate"):
        training_gains(tmp_path / "gains.yaml", ROBOT)


def test_frameworks_with_one_law_need_the_same_gains() -> None:
    log = recorded("mjlab")
    robot_gains = match([log], ROBOT).gains.joints["FR_knee"]
    for name, engine in (("mjlab", "mujoco"), ("isaaclab-explicit", "physx")):
        result = match([log], ROBOT, name)
        gains = result.gains.joints["FR_knee"]
        assert gains.stiffness.value == pytest.approx(robot_gains.stiffness.value, rel=1e-6)
        assert gains.damping.value == pytest.approx(robot_gains.damping.value, rel=1e-6)
        assert result.simulator.engine == engine


def test_profiles_are_named_with_other_steps_and_iterations() -> None:
    changed = profile("isaaclab-implicit,timestep_s=0.0025,iterations=8")
    assert changed.name == "isaaclab-implicit"
    assert changed.timestep_s == 0.0025
    assert changed.iterations == 8
    assert changed.robot(ROBOT).decimation == 8
    assert profile_of(changed.info) == changed
    for text in (
        "isaac",
        "drake,step=1",
        "drake,timestep_s=x",
        "drake,timestep_s=-1",
        "drake,friction=low",
    ):
        with pytest.raises(PronkError, match="expected"):
            profile(text)
    with pytest.raises(PronkError, match="iterations"):
        profile("genesis,iterations=3")
    with pytest.raises(PronkError, match="whole number"):
        profile("drake,timestep_s=0.003").robot(ROBOT)


def test_the_command_line_writes_a_folder_for_each_framework(tmp_path: Path) -> None:
    from log_files import write_mcap

    write_mcap(tmp_path / "knee.mcap", recorded("mjlab-builtin"))
    words = ["match", tmp_path / "knee.mcap", "--robot", "mini_cheetah"]
    text = accepted(*words, "--for", "mjlab-builtin", "--out", tmp_path / "out" / "gains.yaml")
    assert "mjlab-builtin" in text
    robot_gains = load_gains(tmp_path / "out" / "gains.yaml").joints["FR_knee"]
    framework_file = tmp_path / "out" / "mjlab-builtin" / "gains.yaml"
    framework_gains = load_gains(framework_file).joints["FR_knee"]
    assert framework_gains.stiffness.value == pytest.approx(GAINS[0], rel=0.005)
    assert robot_gains.stiffness.value < 0.95 * framework_gains.stiffness.value
    assert (tmp_path / "out" / "mjlab-builtin" / "match.html").is_file()
    listed = accepted("profiles")
    assert all(name in listed for name in load_profiles())
    assert "isaaclab-implicit" in refused(*words, "--for", "isaac")
    assert "mode" in refused(*words, "--for", "genesis", "--mode", "drive")
