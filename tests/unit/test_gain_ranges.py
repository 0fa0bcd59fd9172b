"""Ranges: the paper's Table I gives its training gains; every interval is covered."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pronk.errors import RobotError
from pronk.identify.match.gains import FittedValue, JointGains
from pronk.identify.match.ranges import enclosing_ellipsoid, group_gains
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
    groups = group_gains(ROBOT, {name: joint(*gains) for name, gains in TABLE_I.items()})
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
    group = group_gains(ROBOT, joints)["knee"]
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


def test_enclosing_ellipse_of_a_square_is_its_circumcircle() -> None:
    centre, shape = enclosing_ellipsoid(np.array([[1.0, 1], [1, 3], [3, 1], [3, 3]]))
    assert centre == pytest.approx([2, 2], abs=1e-6)
    assert shape == pytest.approx(2.0 * np.eye(2), abs=1e-3)


def test_an_unknown_joint_is_refused() -> None:
    with pytest.raises(RobotError, match="FR_hip_roll"):
        group_gains(ROBOT, {"FR_ankle": joint(20, 0.5)})
