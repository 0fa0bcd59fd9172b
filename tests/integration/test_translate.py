"""Gains translated between drive laws: known pairs, back again, in simulation, refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from chirp_logs import chirp_log
from command_line import accepted, refused
from pronk.errors import PronkError
from pronk.identify.match.gains import FittedValue, load_gains, save_gains
from pronk.identify.match.match import match
from pronk.identify.match.translate import NOT_ALIKE, NOT_UNIQUE, stated_gains, translate
from pronk.identify.response.estimate import estimate_response
from pronk.identify.simulators.profiles import profile
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec
from random_arms import gravity_torque, random_arm

EXACT = "mjlab,timestep_s=0.0001"
# Matched to the drive at 0.1 ms from 1 to 15 Hz, confirmed in MuJoCo, Drake, SAPIEN and PyBullet:
# stiffness, damping, RMS before and after [dB], delay that is missing [ms].
KNOWN = {
    "mjlab": (15.00, 0.356, 0.70, 0.031, 2.27),
    "mjlab-builtin": (18.59, 0.442, 0.41, 0.036, 2.32),
    "drake": (18.59, 0.349, 1.25, 0.036, 2.32),
    "isaaclab-implicit": (17.48, 0.390, 0.35, 0.004, 0.57),
    "isaaclab-implicit,iterations=10": (17.22, 0.397, 0.14, 0.001, 0.20),
    "mjlab,timestep_s=0.01": (12.79, 0.312, None, 0.14, None),
    "genesis": (19.33, 0.473, None, 0.14, None),
    "playground": (15.41, 0.365, None, None, None),
    "isaaclab-implicit,timestep_s=0.01": (17.85, 0.377, None, None, None),
}


@pytest.fixture
def pendulum() -> RobotSpec:
    return load_robot(Path(__file__).parents[2] / "examples" / "pendulum")


@pytest.mark.parametrize("name", KNOWN)
def test_known_gains_of_a_pendulum(pendulum: RobotSpec, name: str) -> None:
    gains, changes = translate(
        stated_gains(pendulum, {"swing": (17.0, 0.4)}, profile(EXACT)), pendulum, profile(name)
    )
    stiffness, damping, before_db, after_db, delay_ms = KNOWN[name]
    joint = gains.joints["swing"]
    assert joint.stiffness.value == pytest.approx(stiffness, rel=0.01)
    assert joint.damping.value == pytest.approx(damping, rel=0.01)
    if before_db is not None:
        assert changes["swing"].before_db == pytest.approx(before_db, abs=0.08)
    if after_db is not None:
        assert changes["swing"].after_db == pytest.approx(after_db, abs=0.02)
    if delay_ms is not None:
        assert 1000.0 * joint.delay_s.value == pytest.approx(delay_ms, abs=0.15)


@pytest.mark.parametrize("name", ["mini_cheetah", "go2"])
def test_gains_return_and_the_joints_stay(name: str) -> None:
    robot = load_robot(name)
    pairs = {joint.name: (joint.stiffness, joint.damping) for joint in robot.joints[:3]}
    first = stated_gains(robot, pairs, profile("mjlab"))
    delay_s = FittedValue(value=0.003)
    joints = {name: replace(joint, delay_s=delay_s) for name, joint in first.joints.items()}
    first = replace(first, joints=joints)
    gains = first
    for step in ("mjlab-builtin", "isaaclab-implicit", "mjlab"):
        gains, changes = translate(gains, robot, profile(step))
        for change in changes.values():
            assert change.after_db < 0.06
    for name, group in first.groups.items():
        assert gains.groups[name].stiffness == pytest.approx(group.stiffness, rel=0.005)
        assert gains.groups[name].damping == pytest.approx(group.damping, rel=0.005)
    for name, joint in first.joints.items():
        translated = gains.joints[name]
        assert translated.stiffness.value == pytest.approx(joint.stiffness.value, rel=0.005)
        assert translated.damping.value == pytest.approx(joint.damping.value, rel=0.005)
        assert translated.delay_s.value == pytest.approx(0.003, abs=1e-4)


def test_the_simulated_joints_respond_alike() -> None:
    robot = load_robot("mini_cheetah")
    first = stated_gains(robot, {"FR_knee": (17.0, 0.4)}, profile("isaaclab-implicit"))
    gains, _ = translate(first, robot, profile("mjlab"))
    knee = gains.joints["FR_knee"]
    translated = (knee.stiffness.value, knee.damping.value, knee.frictionloss.value)

    def gain_db(framework: str, stiffness: float, damping: float, friction: float) -> np.ndarray:
        simulated_robot = profile(framework).robot(robot)
        log = chirp_log(
            simulated_robot,
            "FR_knee",
            (stiffness, damping),
            (0.2, 0.1),
            length_s=12.0,
            frictionloss=friction,
        )
        gains_db = []
        for response in estimate_response(log, "FR_knee"):
            gains_db.append(20.0 * np.log10(response.gain[response.band(1.0, 12.0)]))
        return np.concatenate(gains_db)

    friction = robot.joint("FR_knee").drive.frictionloss
    goal_db = gain_db("isaaclab-implicit", 17.0, 0.4, friction)

    def error_db(stiffness: float, damping: float, friction: float) -> float:
        difference = gain_db("mjlab", stiffness, damping, friction) - goal_db
        return float(np.sqrt(np.mean(difference**2)))

    translated_error_db = error_db(*translated)
    assert translated_error_db < 0.1
    assert translated_error_db < 0.5 * error_db(translated[0], translated[1], friction)
    assert translated_error_db < 0.15 * error_db(17.0, 0.4, friction)


@pytest.mark.parametrize(("seed", "sticking"), [(0, False), (2, False), (1, True), (2, True)])
def test_a_match_for_the_framework_agrees_or_the_translation_says_why_not(
    seed: int, sticking: bool, tmp_path: Path
) -> None:
    """Sticking: the dry friction of every joint is just below what gravity asks of it at rest."""
    arm = random_arm(tmp_path, seed, sticking)
    joint = arm.joints[seed % len(arm.joints)]
    pairs = {other.name: (other.stiffness, other.damping) for other in arm.joints}
    log = chirp_log(
        profile("mjlab").robot(arm),
        joint.name,
        pairs[joint.name],
        (0.12, 0.06),
        noise_rad=1e-6,
    )
    first = stated_gains(arm, {joint.name: pairs[joint.name]}, profile("mjlab"))
    gains, changes = translate(first, arm, profile("mjlab-builtin"))
    translated = gains.joints[joint.name]
    matched = match([log], arm, "mjlab-builtin", drive_gains=pairs).joints[joint.name].gains
    agree = translated.stiffness.value == pytest.approx(matched.stiffness.value, rel=0.02)
    agree &= translated.damping.value == pytest.approx(matched.damping.value, rel=0.02)
    flagged = any(flag.startswith((NOT_ALIKE, NOT_UNIQUE)) for flag in translated.flags)
    assert agree or flagged
    assert flagged or changes[joint.name].criteria_spread < 0.02


def test_the_friction_of_held_joints_does_not_move_a_translation(tmp_path: Path) -> None:
    """From none to twice what gravity asks of each joint, the linearization is the same."""
    arm = random_arm(tmp_path, 5)
    excited = arm.joints[0]
    stated = {excited.name: (excited.stiffness, excited.damping)}
    stiffnesses = []
    for share in (0.0, 0.5, 0.98, 1.0, 2.0):
        joints = []
        for joint in arm.joints:
            friction = share * gravity_torque(arm, joint.name)
            joints.append(replace(joint, drive=replace(joint.drive, frictionloss=friction)))
        robot = replace(arm, joints=tuple(joints))
        gains, _ = translate(
            stated_gains(robot, stated, profile("mjlab")), robot, profile("mjlab-builtin")
        )
        stiffnesses.append(gains.joints[excited.name].stiffness.value)
    np.testing.assert_allclose(stiffnesses, stiffnesses[0], rtol=1e-6)


def test_gains_that_no_response_tells_apart_are_named_and_stay_finite(
    pendulum: RobotSpec,
) -> None:
    """Undamped, or so stiff that the joint follows every command: flagged, with finite gains."""
    for pair in ((17.0, 0.0), (1e6, 4e5)):
        first = stated_gains(pendulum, {"swing": pair}, profile("isaaclab-newton"))
        gains, changes = translate(first, pendulum, profile("isaaclab-implicit"))
        joint = gains.joints["swing"]
        assert pair[0] / 101.0 < joint.stiffness.value < 101.0 * pair[0]
        assert 0.0 <= joint.damping.value < 101.0 * max(pair[1], pair[0])
        assert changes["swing"].scales[0] > 0.0
        assert any(flag.startswith((NOT_ALIKE, NOT_UNIQUE)) for flag in joint.flags)


def test_what_another_framework_cannot_give_is_refused(pendulum: RobotSpec) -> None:
    stiff = stated_gains(pendulum, {"swing": (600.0, 0.4)}, profile("isaaclab-implicit"))
    with pytest.raises(PronkError, match=r"timestep_s=0\.005"):
        translate(stiff, pendulum, profile("mjlab,timestep_s=0.01"))
    late = stated_gains(pendulum, {"swing": (17.0, 0.4)}, profile("mjlab"))
    gains, changes = translate(late, pendulum, profile("isaaclab-implicit"))
    assert gains.joints["swing"].delay_s.value == 0.0
    assert changes["swing"].rest_s == pytest.approx(-1.7e-3, abs=1.5e-4)
    with pytest.raises(PronkError, match="not of go2"):
        translate(late, load_robot("go2"), profile("drake"))


def test_command_line(tmp_path: Path, pendulum: RobotSpec) -> None:
    out = tmp_path / "out.yaml"
    figures = tmp_path / "figures.json"
    stated = ("--robot", pendulum.source, "--from", EXACT, "--drive-gains", "swing=17,.4")
    accepted("translate", *stated, "--to", "mjlab", "--out", out, "--json", figures)
    assert load_gains(out).joints["swing"].stiffness.value == pytest.approx(15.0, rel=0.01)
    assert json.loads(figures.read_text())["translated"]["mjlab"]["swing"]["after_db"] < 0.05
    robot = ("--robot", pendulum.source)
    accepted("translate", out, *robot, "--to", "genesis", "--to", "drake", "--out", out)
    assert load_gains(tmp_path / "genesis" / "out.yaml").simulator.profile == "genesis"
    assert load_gains(tmp_path / "drake" / "out.yaml").simulator.law == "implicit"
    again = tmp_path / "drake" / "out.yaml"
    assert "not for mjlab" in refused(
        "translate", again, *robot, "--from", "mjlab", "--to", "drake"
    )
    assert "--drive-gains" in refused("translate", *robot, "--to", "mjlab")
    assert "isaaclab-newton" in refused("translate", out, *robot, "--to", "isaac")
    save_gains(out, replace(load_gains(out), robot="mine"))
    assert "--robot" in refused("translate", out, "--to", "drake")
