"""Ranges: the paper's Table I gives its training gains; all others rest on the evidence."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pronk.errors import RobotError
from pronk.identify.match.gains import FittedValue, JointGains
from pronk.identify.match.ranges import enclosing_ellipsoid, group_gains, range_notes
from pronk.report.paper import TABLE_I
from pronk.robots import load_robot

ROBOT = load_robot("mini_cheetah")
LEGS = ("FR", "FL", "HR", "HL")


def joint(stiffness: float, damping: float, kp: float = 0.0, kd: float = 0.0) -> JointGains:
    """Gains with the half-widths of their intervals."""
    return JointGains(
        stiffness=FittedValue(value=stiffness, repeat95=(stiffness - kp, stiffness + kp)),
        damping=FittedValue(value=damping, repeat95=(damping - kd, damping + kd)),
        armature=FittedValue(value=0.0026),
        covariance=(((kp / 2) ** 2, 0.0), (0.0, (kd / 2) ** 2)),
    )


def test_table_i_gives_the_papers_training_gains_and_the_smallest_ranges_that_cover() -> None:
    table = {name: joint(*gains) for name, gains in TABLE_I.items()}
    groups = group_gains(ROBOT, table, "paper")
    expected = {
        "hip_roll": (20.0, 0.45, 2.0, 0.1),  # A13: the paper's 0.05 leaves FL, 0.516, out
        "hip_pitch": (17.5, 0.4, 1.5, 0.05),
        "knee": (21.5, 0.55, 1.0, 0.05),
    }
    assert list(groups) == list(expected)
    for name, (stiffness, damping, stiffness_range, damping_range) in expected.items():
        group = groups[name]
        assert (group.stiffness, group.damping) == (stiffness, damping)
        assert (group.stiffness_range, group.damping_range) == (stiffness_range, damping_range)


@settings(max_examples=30, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.floats(10, 30), st.floats(0.15, 0.8), st.floats(0.01, 2.0), st.floats(0.001, 0.1)
        ),
        min_size=1,
        max_size=4,
    )
)
def test_every_interval_and_ellipse_is_inside(rows: list[tuple[float, ...]]) -> None:
    joints = {f"{leg}_knee": joint(*row) for leg, row in zip(LEGS, rows, strict=False)}
    group = group_gains(ROBOT, joints, "paper")["knee"]
    inverse = np.linalg.inv(np.array(group.ellipsoid))
    reach = 0.0
    for gains in joints.values():
        about = np.array([gains.stiffness.value, gains.damping.value]) - group.ellipsoid_center
        assert about @ inverse @ about <= 1.0
        low, high = gains.stiffness.repeat95
        reach = max(reach, high - group.stiffness, group.stiffness - low)
        low, high = gains.damping.repeat95
        assert max(high - group.damping, group.damping - low) <= group.damping_range + 1e-6
    assert reach <= group.stiffness_range + 1e-6
    assert reach > group.stiffness_range - 0.5 or group.stiffness_range == 0.5


@settings(max_examples=60, deadline=None)
@given(
    st.floats(-3.0, 4.0),
    st.floats(1e-4, 0.5),
    st.lists(st.floats(0.7, 1.4), min_size=1, max_size=4),
)
def test_gains_of_any_size_rest_on_the_evidence(
    exponent: float, relative: float, factors: list[float]
) -> None:
    """From 0.001 to 10,000 N m/rad: inside the intervals, above zero, as wide as the evidence."""
    size = 10.0**exponent
    joints = {}
    lows = []
    highs = []
    for leg, factor in zip(LEGS, factors, strict=False):
        gain = size * factor
        joints[f"{leg}_knee"] = joint(gain, 0.02 * gain, relative * gain, 0.02 * relative * gain)
        lows.append(gain * (1.0 - relative))
        highs.append(gain * (1.0 + relative))
    group = group_gains(ROBOT, joints)["knee"]
    assert min(lows) <= group.stiffness <= max(highs)
    assert 0.02 * min(lows) <= group.damping <= 0.02 * max(highs) * (1.0 + 1e-9)
    assert float(f"{group.stiffness:.3g}") == group.stiffness or relative < 0.006
    evidence = max(max(highs) - group.stiffness, group.stiffness - min(lows))
    for gain, half_width in (
        (group.stiffness, group.stiffness_range),
        (group.damping, group.damping_range),
    ):
        assert gain - half_width >= 0.09 * gain
        assert half_width >= 0.05 * gain * (1.0 - 1e-9)
    assert group.stiffness_range <= 1.011 * max(evidence, 0.05 * group.stiffness)
    covers = group.stiffness - group.stiffness_range <= min(lows) * (1.0 + 1e-9)
    assert covers or group.stiffness_range < evidence
    (stiffness_row, damping_row), center = group.ellipsoid, group.ellipsoid_center
    assert center[0] > np.sqrt(stiffness_row[0]) * 0.999 or relative > 0.3
    assert center[1] > np.sqrt(damping_row[1]) * 0.999 or relative > 0.3


def test_the_gain_stays_inside_an_interval_narrower_than_three_digits() -> None:
    tight = joint(21.7786, 0.540352, 0.0002, 0.000002)
    group = group_gains(ROBOT, {"FR_knee": tight})["knee"]
    assert abs(group.stiffness - 21.7786) <= 0.0002
    assert abs(group.damping - 0.540352) <= 0.000002


def test_a_range_that_reaches_too_far_is_cut_above_zero_and_said() -> None:
    wide = replace(
        joint(14.0, 0.4, 1.0, 0.01),
        stiffness=FittedValue(value=14.0, total95=(1.3, 150.0)),
        matched=False,
    )
    groups = group_gains(ROBOT, {"FR_knee": wide})
    knee = groups["knee"]
    assert knee.stiffness == 14.0
    assert 0.0 < knee.stiffness - knee.stiffness_range < 2.0
    (wider, narrower) = range_notes(groups, {"knee": ["FR_knee"]}, {"FR_knee": wide})
    assert "damping of knee" in wider
    assert "stiffness of knee (1.3 to 150)" in narrower


def test_a_joint_that_is_no_match_counts_only_where_no_joint_is_one() -> None:
    matched = joint(20.0, 0.5, 0.2, 0.005)
    stuck = replace(joint(126.0, 3.0, 1e5, 1e4), matched=False, reasons=("it sticks",))
    groups = group_gains(ROBOT, {"FR_knee": matched, "FL_knee": stuck, "FR_hip_roll": stuck})
    assert (groups["knee"].stiffness, groups["knee"].stiffness_range) == (20.0, 1.0)
    assert groups["hip_roll"].stiffness == 126.0
    assert groups["hip_roll"].stiffness_range < 126.0


def test_what_the_joints_show_needs_no_note() -> None:
    joints = {"FR_knee": joint(20.0, 0.5, 1.5, 0.03), "FL_knee": joint(22.0, 0.55, 1.5, 0.03)}
    groups = group_gains(ROBOT, joints)
    assert range_notes(groups, {"knee": list(joints)}, joints) == ()
    lattice = group_gains(ROBOT, joints, "paper")
    assert lattice["knee"].damping == pytest.approx(0.5)
    assert range_notes(lattice, {"knee": list(joints)}, joints) == ()


def test_enclosing_ellipse_of_a_square_is_its_circumcircle() -> None:
    centre, shape = enclosing_ellipsoid(np.array([[1.0, 1], [1, 3], [3, 1], [3, 3]]))
    assert centre == pytest.approx([2, 2], abs=1e-6)
    assert shape == pytest.approx(2.0 * np.eye(2), abs=1e-3)


def test_an_unknown_joint_is_refused() -> None:
    with pytest.raises(RobotError, match="FR_hip_roll"):
        group_gains(ROBOT, {"FR_ankle": joint(20, 0.5)})
