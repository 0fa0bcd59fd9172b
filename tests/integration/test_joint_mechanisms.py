"""Joints that pronk does not ship, of any size: right gains, no false flag, no wrong cause.

The logs are those of `joint_mechanisms`, whose integrator shares nothing with the match.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from joint_mechanisms import (
    FAULTS,
    Mechanism,
    chirp_commands,
    draw_mechanism,
    equivalent_gains,
    mechanism_log,
    mechanism_robot,
    simulate_mechanisms,
    with_fault,
)
from pronk.arrays import Array
from pronk.identify.logs.checks import unwrapped
from pronk.identify.match.checks import wrong_unit
from pronk.identify.match.gains import JointGains
from pronk.identify.match.match import match
from pronk.identify.match.tables import dead_band_notes


def drawn(seed: int, faults: tuple[str, ...]) -> list[Mechanism]:
    """One joint for each fault, an honest one where it is empty."""
    rng = np.random.default_rng(seed)
    return [draw_mechanism(rng, fault) for fault in faults]


HONEST = drawn(3, ("",) * 12)
WRONG_LIMIT = drawn(5, ("saturation, limit wrong",) * 2)
STATED = drawn(29, ("", "", "", "saturation, limit known"))
(AT_REST,) = drawn(31, ("",))
BY_MOTOR = [with_fault(joint, "compliance, motor encoder", 0.6) for joint in drawn(8, ("",) * 2)]
BY_LINK = [with_fault(joint, "compliance, link encoder", 0.6) for joint in drawn(8, ("",) * 2)]
OTHER_FAULTS = drawn(11, FAULTS[4:])
"""Neither a torque limit nor a compliance."""
(EXPLAINED,) = drawn(17, ("",))
UNEXPLAINED = [
    with_fault(EXPLAINED, "velocity feed-forward", 0.9),
    with_fault(EXPLAINED, "backlash", 0.9),
]
PARTLY_EXPLAINED = [
    with_fault(EXPLAINED, "backlash", 0.3),
    with_fault(EXPLAINED, "stribeck", 0.9),
    with_fault(EXPLAINED, "dead band", 0.5),
    with_fault(EXPLAINED, "integral", 0.1),
]
LATE = with_fault(drawn(21, ("",))[0], "delayed command column", 0.3)
EARLY = replace(LATE, delay_s=0.0)
(TURNED,) = drawn(23, ("",))
(RUBBING,) = drawn(4, ("",))
RUBBING = replace(RUBBING, frictionloss=0.05 * RUBBING.stiffness * RUBBING.amplitude)


@cache
def motions() -> dict[Mechanism, tuple[Array, Array]]:
    """Command and reading of every joint of this module [rad], each of shape (steps,).

    A step of the integration takes as long for all of them as for one.
    """
    mechanisms = [*HONEST, *WRONG_LIMIT, *STATED, AT_REST, *BY_MOTOR, *BY_LINK]
    mechanisms += [*OTHER_FAULTS, *UNEXPLAINED, *PARTLY_EXPLAINED, LATE, EARLY, TURNED, RUBBING]
    command = chirp_commands(mechanisms)
    reading = simulate_mechanisms(mechanisms, command)
    found = {}
    for number, joint in enumerate(mechanisms):
        found[joint] = (command[:, number], reading[:, number])
    return found


def matched(mechanisms: list[Mechanism], folder: Path) -> list[JointGains]:
    """The gains that a match finds from the log of each joint."""
    rng = np.random.default_rng(0)
    gains = []
    for number, joint in enumerate(mechanisms):
        robot = mechanism_robot(joint, folder / str(number))
        log = mechanism_log(joint, *motions()[joint], rng)
        gains.append(match([log.segmented()], robot).gains.joints["j"])
    return gains


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Mechanism, JointGains]]:
    gains = matched(HONEST, tmp_path_factory.mktemp("honest"))
    return list(zip(HONEST, gains, strict=True))


def test_joints_of_any_size_are_not_flagged(honest: list[tuple[Mechanism, JointGains]]) -> None:
    for mechanism, gains in honest:
        assert gains.flags == (), mechanism


def test_their_true_gains_are_in_the_total_interval(
    honest: list[tuple[Mechanism, JointGains]],
) -> None:
    stiffnesses = [mechanism.stiffness for mechanism, _ in honest]
    assert max(stiffnesses) > 50.0 * min(stiffnesses)
    inside = 0
    for mechanism, gains in honest:
        stiffness, damping = equivalent_gains(mechanism)
        low, high = gains.stiffness.total95
        inside += low <= stiffness <= high
        low, high = gains.damping.total95
        inside += low <= damping <= high
        # An interval says something: motion that is not explained widens a few of them.
        assert high < 2.5 * low
    assert inside >= 0.9 * 2 * len(honest)


def test_a_wrong_torque_limit_is_named_first_and_gives_no_wrong_gains(tmp_path: Path) -> None:
    for mechanism, gains in zip(WRONG_LIMIT, matched(WRONG_LIMIT, tmp_path), strict=True):
        first = gains.flags[0]
        assert first.startswith("effort limit:")
        assert not any("So would look" in flag for flag in gains.flags)
        stiffness, _ = equivalent_gains(mechanism)
        low, high = gains.stiffness.total95
        assert low <= stiffness <= high
        # The limit and the recommended amplitude are in the sentence.
        numbers = [float(word) for word in re.findall(r"\d+\.?\d*(?:e[-+]\d+)?", first)]
        assert any(abs(number / mechanism.true_limit - 1.0) < 0.1 for number in numbers)
        fitting = 0.9 * mechanism.true_limit / stiffness
        assert any(abs(number / fitting - 1.0) < 0.15 for number in numbers)


@pytest.fixture(scope="module")
def other_faults(tmp_path_factory: pytest.TempPathFactory) -> list[tuple[Mechanism, JointGains]]:
    gains = matched(OTHER_FAULTS, tmp_path_factory.mktemp("others"))
    return list(zip(OTHER_FAULTS, gains, strict=True))


def test_no_other_mechanism_is_taken_for_a_torque_limit(
    other_faults: list[tuple[Mechanism, JointGains]],
) -> None:
    for mechanism, gains in other_faults:
        limited = [flag for flag in gains.flags if flag.startswith("effort limit")]
        # What a speed limit does at an amplitude is what a torque limit does.
        assert limited == [] or mechanism.fault == "speed limit", mechanism


def test_stated_gains_do_not_tell_a_torque_limit(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for number, joint in enumerate(STATED):
        command, reading = motions()[joint]
        log = mechanism_log(joint, command, reading, rng)
        asked = float(np.abs(joint.stiffness * (command - reading)).max())
        if not joint.fault:
            joint = replace(joint, effort_limit=1.3 * asked)
        # The gains that are stated ask for 1.6 times what those of the drive do.
        stated = replace(log, stiffness=1.6 * log.stiffness, damping=1.6 * log.damping)
        robot = mechanism_robot(joint, tmp_path / str(number))
        gains = match([stated.segmented()], robot).gains.joints["j"]
        limited = [flag for flag in gains.flags if flag.startswith("effort limit")]
        assert len(limited) == (1 if joint.fault else 0), (joint, gains.flags)
        stiffness, _ = equivalent_gains(joint)
        assert gains.stiffness.value == pytest.approx(stiffness, rel=0.1)


def test_a_joint_at_rest_is_not_taken_for_one_in_degrees(tmp_path: Path) -> None:
    log = mechanism_log(AT_REST, *motions()[AT_REST], np.random.default_rng(0))
    robot = mechanism_robot(AT_REST, tmp_path)
    (shaken,) = replace(log, position=log.position / 55.0).segmented().excitations("j")
    (in_degrees,) = replace(log, command=np.rad2deg(log.command)).segmented().excitations("j")
    assert wrong_unit(shaken, robot.joint("j")) == ""
    assert "degrees" in wrong_unit(in_degrees, robot.joint("j"))
    # A joint that something holds moves as little of a large command in radians.
    scale = 2.0 * 0.8 / np.ptp(log.command)
    held_log = replace(log, command=scale * log.command, position=scale * log.position / 55.0)
    (held,) = held_log.segmented().excitations("j")
    assert "stuck" in wrong_unit(held, robot.joint("j"))


@pytest.mark.parametrize("mechanisms", [BY_MOTOR, BY_LINK], ids=["motor encoder", "link encoder"])
def test_a_compliance_is_named_with_its_stiffness(
    mechanisms: list[Mechanism], tmp_path: Path
) -> None:
    for mechanism, gains in zip(mechanisms, matched(mechanisms, tmp_path), strict=True):
        assert not gains.matched
        named = [flag for flag in gains.flags if "compliance:" in flag]
        assert len(named) == 1
        assert not any("So would look" in flag for flag in gains.flags)
        numbers = [float(word) for word in re.findall(r"\d+\.?\d*(?:e[-+]\d+)?", named[0])]
        assert any(abs(number / mechanism.spring - 1.0) < 0.05 for number in numbers)


def test_no_other_mechanism_is_taken_for_a_compliance(
    other_faults: list[tuple[Mechanism, JointGains]],
) -> None:
    for mechanism, gains in other_faults:
        assert not any("compliance:" in flag for flag in gains.flags), mechanism


def test_what_a_fit_leaves_unexplained_is_said_without_a_cause(tmp_path: Path) -> None:
    for mechanism, gains in zip(UNEXPLAINED, matched(UNEXPLAINED, tmp_path), strict=True):
        warnings = [flag for flag in gains.flags if "So would look" in flag]
        assert len(warnings) == 1, mechanism
        assert "friction" in warnings[0]
        assert "backlash" in warnings[0]


def test_intervals_hold_the_gains_where_the_motion_is_not_all_explained(tmp_path: Path) -> None:
    all_gains = matched(PARTLY_EXPLAINED, tmp_path)
    for mechanism, gains in zip(PARTLY_EXPLAINED, all_gains, strict=True):
        warned = any("So would look" in flag for flag in gains.flags)
        inside = []
        fitted_gains = (gains.stiffness, gains.damping)
        for fitted, true in zip(fitted_gains, equivalent_gains(EXPLAINED), strict=True):
            low, high = fitted.total95
            inside.append(low <= true <= high)
        assert warned or all(inside), mechanism


def test_a_late_command_column_is_named_where_the_rest_is_explained(tmp_path: Path) -> None:
    for gains in matched([LATE, EARLY], tmp_path):
        (flag,) = (flag for flag in gains.flags if flag.startswith("lead:"))
        assert "command column" in flag
        assert gains.delay_s.value == 0.0


def test_a_reading_that_wraps_is_unwrapped() -> None:
    log = mechanism_log(TURNED, *motions()[TURNED], np.random.default_rng(0))
    turned = np.angle(np.exp(1j * (log.position + np.pi)))
    wrapped = replace(log, command=log.command + np.pi, position=turned)
    assert np.ptp(turned) > 6.0
    level = unwrapped(wrapped)
    np.testing.assert_allclose(level.position, log.position + np.pi, atol=1e-9)
    assert "wraps" in level.notes[-1]
    assert unwrapped(log) is log


def test_the_dead_band_of_dry_friction_is_beside_the_gains(tmp_path: Path) -> None:
    log = mechanism_log(RUBBING, *motions()[RUBBING], np.random.default_rng(0))
    result = match([log.segmented()], mechanism_robot(RUBBING, tmp_path))
    (note,) = dead_band_notes(result)
    band = float(note.split("[deg]: j ")[1].split(".  ")[0].split(". ")[0])
    assert band == pytest.approx(np.rad2deg(2.0 * 0.05 * RUBBING.amplitude), rel=0.1)
