"""Columns of two units, of exchanged joints and of another zero: only what a log shows is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from command_line import refused
from pronk.errors import LogError
from pronk.identify.logs.inspection import inspect_log
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.options import ReadOptions
from pronk.identify.logs.readers import read_log
from pronk.identify.match.checks import check_excitations
from synthetic_joint import HIP, KNEE, chirp_command, simulate_second_order
from virtual_robot import ROBOT

JOINTS = ("FR_hip_pitch", "FR_knee")
DEGREES = np.rad2deg(1.0)
RATE_HZ = 200.0
COUPLING = 0.1
"""Motion of a joint over that of the excited one beside it."""


def columns(amplitude: float = 0.25) -> dict[str, np.ndarray]:
    """Columns in radians of two joints that are excited one after the other, about their zero."""
    _, chirp, _ = chirp_command("chirp", RATE_HZ)
    chirp = amplitude / 0.25 * chirp
    rest = np.zeros(200)
    still = np.zeros_like(chirp)
    commands = (
        np.concatenate([rest, chirp, rest, still, rest]),
        np.concatenate([rest, still, rest, chirp, rest]),
    )
    hip = simulate_second_order(commands[0], RATE_HZ, **HIP)
    knee = simulate_second_order(commands[1], RATE_HZ, **KNEE)
    noise = 1e-4 * np.random.default_rng(0).standard_normal((2, len(hip)))
    return {
        "time": np.arange(len(hip)) / RATE_HZ,
        "command.FR_hip_pitch": commands[0],
        "position.FR_hip_pitch": hip + COUPLING * knee + noise[0],
        "command.FR_knee": commands[1],
        "position.FR_knee": knee + COUPLING * hip + noise[1],
    }


def write(path: Path, table: dict[str, np.ndarray]) -> Path:
    rows = np.column_stack(list(table.values()))
    np.savetxt(path, rows, delimiter=",", header=",".join(table), comments="", fmt="%.7f")
    return path


def read(path: Path, unit: str) -> JointLog:
    return read_log(path, robot=ROBOT, options=ReadOptions(unit=unit), described=False)


def flags(log: JointLog, joint: str) -> tuple[str, ...]:
    return check_excitations(log.excitations(joint), ROBOT)


def sentence(log: JointLog, joint: str) -> str:
    """The error that the checks of a joint end in."""
    with pytest.raises(LogError) as caught:
        flags(log, joint)
    return str(caught.value)


def test_right_columns_pass_in_both_units(tmp_path: Path) -> None:
    table = columns()
    in_degrees = {}
    for name, values in table.items():
        in_degrees[name] = values if name == "time" else DEGREES * values
    for file, unit in ((table, "rad"), (in_degrees, "deg")):
        log = read(write(tmp_path / f"{unit}.csv", file), unit)
        for joint in JOINTS:
            assert flags(log, joint) == ()


@pytest.mark.parametrize("joint", JOINTS)
def test_a_position_in_degrees_is_named_wherever_it_shows(tmp_path: Path, joint: str) -> None:
    table = columns()
    table[f"position.{joint}"] *= DEGREES
    log = read(write(tmp_path / "a.csv", table), "deg")
    # Beside the other joint's excitation too, where the position moves too far for a coupling.
    for excited in JOINTS:
        error = sentence(log, excited)
        assert joint in error
        assert "degrees" in error
        assert "--joint-order" not in error


@pytest.mark.parametrize("joint", JOINTS)
def test_two_joints_of_two_units_are_not_taken_for_exchanged_ones(
    tmp_path: Path, joint: str
) -> None:
    table = columns()
    table[f"command.{joint}"] *= DEGREES
    table[f"position.{joint}"] *= DEGREES
    log = read(write(tmp_path / "a.csv", table), "deg")
    (other,) = set(JOINTS) - {joint}
    error = sentence(log, other)
    assert "--scale" in error
    assert "--joint-order" not in error
    options = ReadOptions(unit="rad", scale={joint: 1.0 / DEGREES})
    mended = read_log(tmp_path / "a.csv", robot=ROBOT, options=options, described=False)
    for name in JOINTS:
        assert flags(mended, name) == ()


def test_exchanged_columns_are_named(tmp_path: Path) -> None:
    table = columns()
    hip = table["position.FR_hip_pitch"]
    table["position.FR_hip_pitch"] = table["position.FR_knee"]
    table["position.FR_knee"] = hip
    log = read(write(tmp_path / "a.csv", table), "rad")
    for joint in JOINTS:
        error = sentence(log, joint)
        assert "--joint-order" in error
        assert "--scale" not in error


@pytest.mark.parametrize(("gain", "may_be_another"), [(-1.0, False), (-0.1, True)])
def test_a_joint_that_is_pushed_the_other_way_has_no_flipped_sign_for_sure(
    tmp_path: Path, gain: float, may_be_another: bool
) -> None:
    table = columns()
    for name in ("command.FR_hip_pitch", "position.FR_hip_pitch"):
        del table[name]
    table["position.FR_knee"] *= gain
    error = sentence(read(write(tmp_path / "a.csv", table), "rad"), "FR_knee")
    assert "sign" in error
    assert ("--joint-order" in error) is may_be_another


def test_a_joint_that_is_pushed_is_no_exchanged_one(tmp_path: Path) -> None:
    table = columns()
    time = table["time"]
    table["position.FR_knee"] += np.where(time < 22.0, np.sin(2.0 * np.pi * 0.3 * time), 0.0)
    log = read(write(tmp_path / "a.csv", table), "rad")
    error = sentence(log, "FR_hip_pitch")
    assert "hand" in error
    assert "--joint-order" not in error


def test_radians_that_are_read_in_degrees_are_said(tmp_path: Path) -> None:
    log = read(write(tmp_path / "a.csv", columns()), "deg")
    for joint in JOINTS:
        assert any("--unit rad" in flag for flag in flags(log, joint))


def test_a_standstill_may_be_a_position_of_another_unit(tmp_path: Path) -> None:
    table = columns()
    table["command.FR_knee"] *= DEGREES
    log = read(write(tmp_path / "a.csv", table), "deg")
    (flag,) = flags(log, "FR_knee")
    assert "radians" in flag
    # A drive that is off does not answer with this gain.
    table["position.FR_knee"][:] = 1e-3 * table["position.FR_knee"]
    log = read(write(tmp_path / "b.csv", table), "deg")
    (flag,) = flags(log, "FR_knee")
    assert "radians" not in flag


@pytest.mark.parametrize(("ratio", "is_named"), [(DEGREES, True), (40.0, False), (90.0, False)])
def test_degrees_are_told_from_a_gear_where_the_factor_tells_them(
    tmp_path: Path, ratio: float, is_named: bool
) -> None:
    table = columns(0.1)
    table["position.FR_knee"] *= ratio
    log = read(write(tmp_path / "a.csv", table), "rad")
    error = sentence(log, "FR_knee")
    assert "degrees" in error
    assert ("gear" in error) is not is_named


@pytest.mark.parametrize("zero", [4.5, -4.5])
def test_another_zero_is_no_other_unit(tmp_path: Path, zero: float) -> None:
    table = columns()
    table["command.FR_knee"] += zero
    table["position.FR_knee"] += zero
    error = sentence(read(write(tmp_path / "a.csv", table), "rad"), "FR_knee")
    assert "zero" in error
    assert "--unit" not in error


@pytest.mark.parametrize("column", ["command.FR_knee", "position.FR_knee"])
def test_no_unit_is_offered_that_fits_one_column_alone(tmp_path: Path, column: str) -> None:
    table = columns()
    table[column] *= DEGREES
    with pytest.raises(LogError) as caught:
        read(write(tmp_path / "a.csv", table), "rad")
    assert "--unit deg" not in str(caught.value)
    questions = inspect_log(tmp_path / "a.csv", ROBOT, ReadOptions()).questions
    assert any("FR_knee" in question and "convert" in question for question in questions)


def test_an_encoder_that_counted_turns_is_not_in_degrees(tmp_path: Path) -> None:
    table = columns()
    table["position.FR_knee"] += 6.0 * np.pi
    with pytest.raises(LogError, match="zero"):
        read(write(tmp_path / "a.csv", table), "rad")


def test_a_clamped_joint_in_another_unit_is_said(tmp_path: Path) -> None:
    table = columns()
    for joint in JOINTS:
        pose = ROBOT.joint(joint).default_position
        table[f"command.{joint}"] += pose
        table[f"position.{joint}"] += pose
    path = write(tmp_path / "a.csv", table)
    words = ("match", path, "--robot", "mini_cheetah", "--unit", "deg")
    printed = refused(*words, "--drive-gains", "default", "--out", tmp_path / "gains.yaml")
    assert "--unit rad" in printed
