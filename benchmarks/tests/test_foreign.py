"""Robots of a package go to an export, and the benchmark's logs hold their truth."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.foreign.faults import FAULTS, faulty_log, named_causes, verdict
from benchmarks.foreign.joints import draw_joint
from benchmarks.foreign.logs import (
    STEP_S,
    Drive,
    LogCase,
    Signal,
    draw_case,
    linear_gains,
    motion,
    recorded,
    rest_angle,
    simulator_gains,
)
from benchmarks.foreign.population import Candidate, copy_model, without_variants
from benchmarks.foreign.walk import PEAK_DIFFERENCE, STEPS, walk

SHORT = 4
"""A log of seed 7 that is 9 s long."""
FAULT = {fault.name: fault for fault in FAULTS}


def steady(hz: float, **changes: float) -> tuple[LogCase, complex]:
    """Return a joint that is moved by a sine, and the response of its first harmonic."""
    case = draw_case(3, 1)
    joint = replace(case.joint, gravity_torque=0.0)
    drive = replace(case.drive, coulomb=0.0, delay_s=0.0, limit=math.inf, **changes)
    seconds = 10.0
    offsets = 0.1 * np.sin(2.0 * np.pi * hz * np.arange(0.0, seconds, STEP_S))
    signal = Signal(kind="sine", rate_hz=1.0 / STEP_S, band_hz=(0.5, 10.0), offsets=offsets)
    case = replace(case, joint=joint, moving=joint, drive=drive, signal=signal)
    position, _, _ = motion(joint, drive, signal)
    half = len(position) // 2
    phase = np.exp(-2j * np.pi * hz * STEP_S * np.arange(half, len(position)))
    return case, complex(np.mean(position[half:] * phase) / np.mean(offsets[half:] * phase))


@pytest.mark.parametrize("hz", [0.5, 2.0, 5.0])
def test_the_integrator_has_the_response_of_the_linear_joint(hz: float) -> None:
    case, response = steady(hz)
    omega = 2.0 * math.pi * hz
    drive = case.drive
    impedance = drive.stiffness - omega**2 * case.joint.inertia
    impedance += 1j * omega * (drive.damping + drive.viscous)
    assert abs(response * impedance / drive.stiffness - 1.0) < 5e-3


def test_a_compliant_gear_resonates_where_the_closed_form_says() -> None:
    case, _ = steady(2.0)
    link = case.joint.link_inertia
    spring = link * (2.0 * math.pi * 6.0) ** 2
    damping = 2.0 * 0.05 * math.sqrt(spring * link)
    for hz in (2.0, 6.0):
        geared, response = steady(hz, spring=spring, spring_damping=damping)
        drive = geared.drive
        s = 2j * math.pi * hz
        coupling = spring + damping * s
        reflected = coupling * link * s**2 / (link * s**2 + coupling)
        impedance = geared.joint.armature * s**2 + (drive.damping + drive.viscous) * s
        expected = drive.stiffness / (impedance + drive.stiffness + reflected)
        assert abs(response / expected - 1.0) < 0.02


def test_dry_friction_holds_a_joint_below_its_breakaway_torque() -> None:
    rng = np.random.default_rng(0)
    joint = replace(draw_joint(rng), gravity_torque=0.0)
    drive = Drive(stiffness=10.0, damping=0.1, coulomb=1.0)
    ramp = np.linspace(0.0, 0.2, 20000)
    signal = Signal(kind="chirp", rate_hz=1.0 / STEP_S, band_hz=(0.5, 5.0), offsets=ramp)
    position, _, _ = motion(joint, drive, signal)
    assert np.all(position[ramp < 0.0999] == 0.0)
    assert position[-1] > 0.0


def test_both_ways_to_the_true_gains_agree_without_friction() -> None:
    case = draw_case(7, SHORT)
    case = replace(case, drive=replace(case.drive, coulomb=0.0))
    stiffness, damping, _ = linear_gains(case)
    assert simulator_gains(case) == pytest.approx((stiffness, damping), rel=0.03)


def test_the_model_of_a_joint_has_its_inertia_and_gravity() -> None:
    mujoco = pytest.importorskip("mujoco")
    joint = draw_joint(np.random.default_rng(5))
    model = mujoco.MjModel.from_xml_string(joint.mjcf())
    data = mujoco.MjData(model)
    for angle in (-1.0, 0.0, 0.7):
        data.qpos[0] = angle
        mujoco.mj_forward(model, data)
        assert -data.qfrc_bias[0] == pytest.approx(joint.gravity_at(angle), rel=1e-6, abs=1e-12)
    assert model.dof_M0[0] == pytest.approx(joint.link_inertia, rel=1e-6)


def test_logs_are_drawn_again_by_their_seed_and_rest_at_the_start() -> None:
    case = recorded(draw_case(7, SHORT))
    again = recorded(draw_case(7, SHORT))
    for name, values in case.columns.items():
        assert np.array_equal(values, again.columns[name])
    assert np.all(np.diff(case.columns["time"]) > 0.0)
    start = rest_angle(case.moving, case.drive, 0.0)
    slack = 3.0 * case.recording.resolution + 6.0 * case.recording.noise
    assert np.allclose(case.columns["position"][:10], start, atol=slack)


@pytest.mark.parametrize("name", sorted(FAULT))
def test_a_fault_changes_the_log(name: str) -> None:
    honest = recorded(draw_case(7, SHORT))
    faulty = faulty_log(7, SHORT, FAULT[name])
    changed = False
    for column in ("time", "command", "position", "velocity"):
        if column not in faulty.columns or column not in honest.columns:
            continue
        ours = honest.columns[column]
        theirs = faulty.columns[column]
        changed = changed or ours.shape != theirs.shape or not np.allclose(ours, theirs)
    changed = changed or set(honest.columns) != set(faulty.columns)
    changed = changed or faulty.stated != honest.stated
    assert changed


def test_causes_are_named_by_heads_and_not_by_lists() -> None:
    assert named_causes(["effort limit: for 12 % of the excitation"], "") == {"saturation"}
    assert named_causes(["no match: compliance: a spring"], "") == {"compliance"}
    assert named_causes(["no match: 6 dB. So would look: backlash, a payload"], "") == set()
    assert named_causes([], "log.csv: joint: a sign is flipped: negate it") == {"sign"}
    # A factor says nothing about the clock.
    scaled = "log.csv: joint: the position is 59.1 times the command; degrees are read as radians"
    assert named_causes([], scaled) == {"degrees"}
    assert named_causes([], "log.csv: the position is 3 times the command") == set()
    sine = "log.csv: the command excites only 0.4 Hz (there the position is 1.2 times the command)"
    assert verdict(FAULT["single sine"], [], sine) == "right"
    assert verdict(FAULT["compliance"], [], sine) == "wrong"
    assert named_causes([], "log.csv: time goes back in row 3") == {"clock"}
    assert verdict(FAULT["compliance"], ["no match: 6 dB"], "") == "none"
    assert verdict(FAULT["compliance"], ["backlash: 2 degrees"], "") == "wrong"
    assert verdict(FAULT["compliance"], [], "") == "silent"


def test_variants_of_a_robot_count_once() -> None:
    pairs = tuple((f"joint{number}", "0.5") for number in range(6))
    large = Candidate(
        package="a", path="b/large.urdf", kind="urdf", driven=("joint1",), pairs=pairs
    )
    small = replace(large, path="a/small.urdf", pairs=pairs[:4])
    other = replace(large, path="c.urdf", pairs=(("joint0", "0.7"), ("joint1", "0.5")))
    alone = replace(large, path="d.urdf", pairs=(("wheel", "0.5"),))
    kept = without_variants([small, other, alone, large])
    assert [candidate.path for candidate in kept] == ["b/large.urdf", "d.urdf"]


def test_a_model_is_copied_with_what_it_refers_to(tmp_path: Path) -> None:
    folder = tmp_path / "packages" / "robot"
    (folder / "meshes").mkdir(parents=True)
    (folder / "meshes" / "part.obj").write_text("v 0 0 0\n")
    (folder / "unused.obj").write_text("v 0 0 0\n")
    (folder / "assets.xml").write_text(
        '<mujoco><compiler meshdir="meshes"/><asset><mesh file="part.obj"/></asset></mujoco>'
    )
    (folder / "robot.xml").write_text('<mujoco><include file="assets.xml"/></mujoco>')
    copy = copy_model(tmp_path / "packages", "robot/robot.xml", tmp_path / "scratch")
    copied = sorted(path.name for path in copy.parent.rglob("*") if path.is_file())
    assert copied == ["assets.xml", "part.obj", "robot.xml"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("path", "joint"),
    [
        ("asset_zoo/robots/unitree_go1/xmls/go1.xml", "FR_calf_joint"),
    ],
)
def test_robots_of_mjlab_go_from_their_model_to_exports(
    path: str, joint: str, tmp_path: Path
) -> None:
    mjlab = pytest.importorskip("mjlab")
    packages = Path(mjlab.__file__).parents[1]
    candidate = Candidate(
        package="mjlab", path=f"mjlab/{path}", kind="mjcf", driven=(joint,), pairs=()
    )
    row = walk(packages, candidate, joint, tmp_path / "walk", repeats=1)
    assert row["reached"] == STEPS[-1], row["refusal"]
    assert row["compared"] > 0
    assert row["wrong_numbers"] == {}
    assert row["peaks"]["difference"] <= PEAK_DIFFERENCE
