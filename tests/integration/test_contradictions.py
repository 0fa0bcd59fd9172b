"""Logs that contradict the robot's file, the stated gains or the drive law, and what is said."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from command_line import accepted, invoke
from compliant_joint import DAMPING, ROTOR_INERTIA, STIFFNESS, write_log, write_model
from joint_mechanisms import (
    chirp_commands,
    draw_mechanism,
    mechanism_log,
    mechanism_robot,
    simulate_mechanisms,
)
from pronk.errors import IdentifiabilityError
from pronk.exit_status import ExitStatus
from pronk.identify.excitation.signals import Chirp
from pronk.identify.logs.joint_log import JointLog, LogOrigin
from pronk.identify.match.gains import load_gains
from pronk.identify.match.match import match
from pronk.identify.match.result import MatchResult
from pronk.identify.simulators.chain import ChainSimulation
from pronk.identify.simulators.profiles import profile
from pronk.robots import load_robot
from tests.fine_joint import JOINT, FineJoint, two_chirps_at
from tests.synthetic_log import Excitation, synthetic_log

GAINS = f"j={STIFFNESS},{DAMPING}"


def flags_of(result: MatchResult, joint: str, word: str) -> list[str]:
    """The flags of a joint that have a word."""
    return [flag for flag in result.gains.joints[joint].flags if word in flag]


# ---- a rotor inertia that the file does not have ----


def test_an_armature_of_zero_ends_in_setting_it_not_in_another_recording(tmp_path: Path) -> None:
    """The way out is walked: mode drive gives the armature, with which the log is a match."""
    bare = write_model(tmp_path / "bench.xml")
    model = bare.read_text()
    assert 'armature="0.03"' in model
    log = write_log(tmp_path / "log.csv", gear=float("inf"))
    words = ("match", log, "--unit", "rad", "--drive-gains", GAINS, "--out", tmp_path / "g.yaml")
    bare.write_text(model.replace('armature="0.03"', ""))
    command = invoke([*words, "--robot", bare])
    assert command.exit_code == ExitStatus.NO_MATCH
    following = command.output.split("next:")[1]
    assert "armature of j" in following
    assert "--mode drive" in following
    assert "record" not in following

    accepted(*words, "--robot", bare, "--mode", "drive")
    armature = load_gains(tmp_path / "g.yaml").joints["j"].physical["armature"]
    low, high = armature.total95
    assert low < ROTOR_INERTIA < high
    bare.write_text(model.replace("0.03", f"{armature.value:.4f}"))
    accepted(*words, "--robot", bare)
    gains = load_gains(tmp_path / "g.yaml").joints["j"]
    assert gains.matched
    assert gains.stiffness.value == pytest.approx(STIFFNESS, rel=0.08)


# ---- joints that moved together, in another order ----

LEGS = ("FL", "FR")
KINDS = ("hip_roll", "hip_pitch", "knee")


def leg_log(names: tuple[str, ...]) -> JointLog:
    """Both front legs of a Go2 that hangs, rolled outward, under the names of some columns.

    The drives have other gains than the robot's file; the columns are those of FL, then FR.
    """
    robot = load_robot("go2")
    joints = tuple(f"{leg}_{kind}" for leg in LEGS for kind in KINDS)
    time = np.arange(0.0, 8.0, 0.005)
    rng = np.random.default_rng(4)
    command = np.empty((len(time), len(joints)))
    for column, name in enumerate(joints):
        lines_hz = rng.uniform(0.3, 5.0, 10)
        phases = rng.uniform(0.0, 2.0 * np.pi, 10)
        wave = np.sin(2.0 * np.pi * np.outer(time, lines_hz) + phases).sum(axis=1)
        wave *= 0.15 * np.minimum(time, 1.0) / np.abs(wave).max()
        start = robot.joint(name).default_position
        if name.endswith("hip_roll"):
            start = 0.4 if name.startswith("FL") else -0.4
        command[:, column] = start + wave
    log = JointLog(robot="go2", joints=joints, time=time, command=command, position=command)
    drives = {}
    for name in joints:
        nominal = robot.joint(name).parameters
        drives[name] = nominal | {"stiffness": 25.0, "damping": 0.9, "stribeck": 0.0}
        drives[name] |= {"delay": 0.004, "offset": 0.0}
    position = command.copy()
    for leg in LEGS:
        own = tuple(name for name in joints if name.startswith(leg))
        with ChainSimulation(robot, [log], joints=own) as simulation:
            simulated = simulation.run([{name: drives[name] for name in own}])[0][0]
        for column, name in enumerate(own):
            position[:, joints.index(name)] = simulated[:, column]
    position += 2e-4 * rng.standard_normal(position.shape)
    return replace(log, joints=names, position=position)


def test_left_and_right_exchanged_is_no_match_of_the_joints_that_gravity_tells() -> None:
    robot = load_robot("go2")
    stated = {"hip_roll": (25.0, 0.9), "hip_pitch": (25.0, 0.9), "knee": (25.0, 0.9)}
    right = tuple(f"{leg}_{kind}" for leg in LEGS for kind in KINDS)
    wrong = right[3:] + right[:3]
    result = match([leg_log(right)], robot, drive_gains=stated)
    for name in right:
        gains = result.gains.joints[name]
        assert gains.matched, (name, gains.reasons)
        assert gains.stiffness.value == pytest.approx(25.0, rel=0.05)
    result = match([leg_log(wrong)], robot, drive_gains=stated)
    for leg in LEGS:
        gains = result.gains.joints[f"{leg}_hip_roll"]
        assert not gains.matched
        assert any("--joint-order" in reason for reason in gains.reasons)


# ---- drive laws ----


@pytest.mark.parametrize(
    ("of_log", "matched_for"), [("mjlab", "isaaclab-implicit"), ("genesis", "playground")]
)
def test_a_lead_of_the_drive_law_is_not_called_a_late_command(
    of_log: str, matched_for: str
) -> None:
    """A log of one law, matched for another; only a command that is logged late is flagged."""
    robot = load_robot("mini_cheetah")
    of_framework = profile(of_log).robot(robot)
    tick_hz = 1.0 / (of_framework.timestep_s * of_framework.decimation)
    excitations = []
    for amplitude in (0.2, 0.1):
        chirp = Chirp(start_hz=0.2, stop_hz=18.0, length_s=10.0, amplitude=amplitude)
        excitations.append(Excitation(offsets=chirp.samples(tick_hz), band_hz=chirp.band_hz))
    rng = np.random.default_rng(0)
    noise = [1e-5 * rng.standard_normal(10000) for _ in excitations]
    log = synthetic_log(of_framework, "FR_knee", excitations, 22.0, 0.6, noise=noise)
    result = match([log], robot, matched_for)
    assert result.gains.joints["FR_knee"].matched
    assert not flags_of(result, "FR_knee", "lead")
    rows = round(0.02 * log.rate_hz)
    late = np.concatenate([np.repeat(log.command[:1], rows, axis=0), log.command[:-rows]])
    result = match([replace(log, command=late)], robot, matched_for)
    assert flags_of(result, "FR_knee", "command column")


def test_gains_that_the_drive_law_cannot_have_are_no_silent_match(tmp_path: Path) -> None:
    """A stiff, overdamped joint: far smaller gains of the same ratio follow its command alike."""
    joint = FineJoint(
        stiffness=2200.0, damping=220.0, armature=0.04, frictionloss=0.0, velocity_lag_s=0.0
    )
    robot = load_robot(str(joint.write_robot(tmp_path, effort_limit=2e4, stall_torque=2e4)))
    sent = np.arange(27 * 50) / 50.0
    log = joint.log(sent, two_chirps_at(sent, length_s=12.0), 500.0, noise_rad=1e-4)
    result = match([log], robot, drive_gains="default")
    gains = result.gains.joints[JOINT]
    assert not gains.matched
    assert any(reason.startswith("stability") for reason in gains.reasons)
    # No torque limit is blamed for what the law does.
    assert not flags_of(result, JOINT, "effort limit")
    # An implicit drive has no such limit, and its step leaves the size of the gains open.
    result = match([log], robot, "isaaclab-implicit", drive_gains="default")
    gains = result.gains.joints[JOINT]
    assert not flags_of(result, JOINT, "stability")
    assert flags_of(result, JOINT, "step")
    ratio = gains.damping.value / gains.stiffness.value
    assert ratio == pytest.approx(joint.damping / joint.stiffness, rel=0.1)
    low, high = gains.stiffness.total95
    assert low < joint.stiffness < high


# ---- torque ----


def test_a_drive_at_its_limit_with_a_wrong_speed_line_gives_its_gains(tmp_path: Path) -> None:
    """The limit of the file is right, and the torque-speed line falls too early."""
    rng = np.random.default_rng(12)
    mechanisms = []
    for _ in range(3):
        drawn = draw_mechanism(rng, "saturation, limit known")
        mechanisms.append(replace(drawn, size=0.5, hangs=False, log_hz=250.0))
    command = chirp_commands(mechanisms)
    reading = simulate_mechanisms(mechanisms, command)
    line_is_named = 0
    for number, joint in enumerate(mechanisms):
        robot = mechanism_robot(joint, tmp_path / str(number))
        only = robot.joints[0]
        assert only.drive.effort_limit == pytest.approx(joint.true_limit)
        fastest = float(np.abs(np.diff(reading[:, number])).max() / 1e-4)
        drive = replace(
            only.drive, stall_torque=only.drive.effort_limit, no_load_speed=1.3 * fastest
        )
        robot = replace(robot, joints=(replace(only, drive=drive),))
        log = mechanism_log(joint, command[:, number], reading[:, number], rng)
        result = match([log.segmented()], robot)
        gains = result.gains.joints["j"]
        (flag,) = flags_of(result, "j", "effort limit")
        amplitude = float(re.findall(r"with ([\d.e-]+) rad or less", flag)[0])
        assert amplitude == pytest.approx(0.9 * joint.true_limit / joint.stiffness, rel=0.2)
        low, high = gains.stiffness.total95
        assert low < 1.1 * joint.stiffness
        assert high > 0.9 * joint.stiffness
        line_is_named += "no_load_speed" in flag
    assert line_is_named >= 2


@pytest.mark.parametrize("factor", [1.0, 2.0])
def test_a_torque_column_tells_an_inertia_that_the_file_does_not_have(
    tmp_path: Path, factor: float
) -> None:
    """A payload leaves the motion as it is with smaller gains; the measured torque is larger."""
    joint = FineJoint(armature=0.0063 * factor, mass=0.2 * factor, inertia=0.001 * factor)
    light = FineJoint()
    robot = load_robot(str(light.write_robot(tmp_path)))
    sent = np.arange(27 * 50) / 50.0
    log = joint.log(sent, two_chirps_at(sent, length_s=12.0), 500.0)
    late = np.interp(log.time - joint.delay_s, log.time, log.command[:, 0])
    speed = np.gradient(log.position[:, 0], log.time)
    torque = joint.stiffness * (late - log.position[:, 0]) - joint.damping * speed
    log = replace(log, torque=torque[:, None], origin=LogOrigin())
    result = match([log], robot, drive_gains={JOINT: (17.0, 0.4)})
    stiffness = result.gains.joints[JOINT].stiffness.value
    assert stiffness == pytest.approx(joint.stiffness / factor, rel=0.15)
    flags = flags_of(result, JOINT, "torque column")
    assert len(flags) == (factor != 1.0)
    for flag in flags:
        said = float(re.findall(r"it is ([\d.]+) times", flag)[0])
        assert said == pytest.approx(factor, rel=0.15)


def test_a_torque_column_of_the_opposite_sign_is_said(tmp_path: Path) -> None:
    """The sign of a torque says nothing about the gains, so that they stay what they are."""
    joint = FineJoint()
    robot = load_robot(str(joint.write_robot(tmp_path)))
    sent = np.arange(27 * 50) / 50.0
    log = joint.log(sent, two_chirps_at(sent, length_s=12.0), 500.0)
    late = np.interp(log.time - joint.delay_s, log.time, log.command[:, 0])
    speed = np.gradient(log.position[:, 0], log.time)
    torque = joint.stiffness * (late - log.position[:, 0]) - joint.damping * speed
    opposite = replace(log, torque=-torque[:, None], origin=LogOrigin())
    result = match([opposite], robot, drive_gains={JOINT: (17.0, 0.4)})
    (flag,) = flags_of(result, JOINT, "torque column")
    assert "opposite sign" in flag
    assert result.gains.joints[JOINT].stiffness.value == pytest.approx(joint.stiffness, rel=0.15)


# ---- a pose that is another than that of the file ----


@pytest.mark.parametrize("offset", [0.0, 0.5])
def test_a_joint_that_stands_elsewhere_than_in_the_file_is_said(
    tmp_path: Path, offset: float
) -> None:
    """Exchanged columns and encoders with another zero may show in nothing else."""
    joint = FineJoint()
    robot = load_robot(str(joint.write_robot(tmp_path)))
    sent = np.arange(27 * 50) / 50.0
    log = joint.log(sent, two_chirps_at(sent, length_s=12.0), 500.0)
    moved = replace(log, command=log.command + offset, position=log.position + offset)
    result = match([moved], robot, drive_gains={JOINT: (17.0, 0.4)})
    notes = [note for note in result.notes if "another pose" in note]
    assert len(notes) == (offset != 0.0)
    for note in notes:
        default = robot.joint(JOINT).default_position
        assert f"{JOINT} {default + offset:.3g} rad" in note


# ---- a stiffness that is stated wrongly ----


def test_mode_drive_refuses_a_wrong_stiffness_with_the_one_that_the_log_gives(
    tmp_path: Path,
) -> None:
    """A short slow log of a servo that gravity pulls at, stated twice as stiff as it is."""
    joint = FineJoint(
        stiffness=0.8,
        damping=0.04,
        armature=0.002,
        mass=0.5,
        length=0.1,
        inertia=2e-5,
        frictionloss=0.05,
        viscous=0.0,
        delay_s=0.0,
    )
    path = joint.write_robot(tmp_path)
    path.write_text(path.read_text().replace("[1, 15]", "[0.1, 1.9]"))
    robot = load_robot(str(path))
    sent = np.arange(6 * 190) / 190.0
    log = joint.log(sent, np.sin(sent**2), 190.0).segmented()
    with pytest.raises(IdentifiabilityError) as refusal:
        match([log], robot, mode="drive", drive_gains={JOINT: (1.7, 0.04)})
    said = re.findall(r"gives ([\d.]+) N m/rad \(([\d.]+) to ([\d.]+)\)", str(refusal.value))
    value, low, high = (float(number) for number in said[0])
    assert value == pytest.approx(0.8, rel=0.1)
    assert low < 0.8 < high
    # With the right stiffness the same log is a match of its drive.
    result = match([log], robot, mode="drive", drive_gains={JOINT: (0.8, 0.04)})
    low, high = result.gains.joints[JOINT].physical["armature"].total95
    assert low < 0.002 < high
