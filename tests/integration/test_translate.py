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
from pronk.identify.match.translate import stated_gains, translate
from pronk.identify.response.estimate import estimate_response
from pronk.identify.simulators.profiles import profile
from pronk.robots import load_robot
from pronk.robots.robot import RobotSpec

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
    kp, kd, before, after, delay = KNOWN[name]
    joint, change = gains.joints["swing"], changes["swing"]
    assert (joint.stiffness.value, joint.damping.value) == pytest.approx((kp, kd), rel=0.01)
    for found, expected, within in (
        (change.before_db, before, 0.08),
        (change.after_db, after, 0.02),
        (1000.0 * joint.delay_s.value, delay, 0.15),
    ):
        assert expected is None or found == pytest.approx(expected, abs=within)


@pytest.mark.parametrize("name", ["mini_cheetah", "go2"])
def test_gains_return_and_the_joints_stay(name: str) -> None:
    robot = load_robot(name)
    pairs = {joint.name: (joint.stiffness, joint.damping) for joint in robot.joints[:3]}
    first = stated_gains(robot, pairs, profile("mjlab"))
    delay_s = FittedValue(value=0.003)
    joints = {joint: replace(own, delay_s=delay_s) for joint, own in first.joints.items()}
    first = gains = replace(first, joints=joints)
    for step in ("mjlab-builtin", "isaaclab-implicit", "mjlab"):
        gains, changes = translate(gains, robot, profile(step))
        assert max(one.after_db for one in changes.values()) < 0.05
    for name, group in first.groups.items():
        assert gains.groups[name].stiffness == pytest.approx(group.stiffness, rel=0.005)
        assert gains.groups[name].damping == pytest.approx(group.damping, rel=0.005)
    for name, joint in first.joints.items():
        translated = gains.joints[name]
        assert translated.stiffness.value == pytest.approx(joint.stiffness.value, rel=0.005)
        assert translated.damping.value == pytest.approx(joint.damping.value, rel=0.005)
        assert translated.delay_s.value == pytest.approx(0.003, abs=1e-4)


def test_the_simulated_joints_respond_alike() -> None:
    robot, hz = load_robot("mini_cheetah"), (1.0, 12.0)
    first = stated_gains(robot, {"FR_knee": (17.0, 0.4)}, profile("isaaclab-implicit"))
    found = translate(first, robot, profile("mjlab"))[0].joints["FR_knee"]

    def gain_db(target: str, kp: float, kd: float, friction: float) -> np.ndarray:
        known = profile(target).robot(robot)
        how = {"length_s": 12.0, "frictionloss": friction}
        log = chirp_log(known, "FR_knee", (kp, kd), (0.2, 0.1), **how)
        found = [one.gain[one.band(*hz)] for one in estimate_response(log, "FR_knee")]
        return 20.0 * np.log10(np.concatenate(found))

    own = robot.joint("FR_knee").drive.frictionloss
    goal = gain_db("isaaclab-implicit", 17.0, 0.4, own)

    def apart(*values: float) -> float:
        return float(np.sqrt(np.mean((gain_db("mjlab", *values) - goal) ** 2)))

    translated = apart(found.stiffness.value, found.damping.value, found.frictionloss.value)
    assert translated < 0.1
    assert translated < 0.5 * apart(found.stiffness.value, found.damping.value, own)
    assert translated < 0.15 * apart(17.0, 0.4, own)


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
    out, figures = tmp_path / "out.yaml", tmp_path / "figures.json"
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
