"""Gains of training: naive, matched, and naive with everything else as matched."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import pytest

from pronk.errors import ArtefactError, PronkError
from pronk.identify.match.gains import (
    FittedValue,
    GroupGains,
    JointGains,
    MatchedGains,
    MatchQuality,
    save_gains,
)
from pronk.identify.simulators.info import SimulatorInfo
from pronk.jump.train.gains import TrainingGains, training_gains
from pronk.robots import load_robot

ROBOT = load_robot("mini_cheetah")
MINOR = ".".join(mujoco.__version__.split(".")[:2])
SIMULATOR = SimulatorInfo(version=mujoco.__version__)
GROUPS = {
    "knee": GroupGains(
        stiffness=21.5,
        damping=0.55,
        stiffness_range=1.0,
        damping_range=0.05,
        ellipsoid=((0.09, 0.0002), (0.0002, 0.0004)),
        ellipsoid_center=(22.0, 0.54),
    ),
    "hip_roll": GroupGains(stiffness=20.0, damping=0.45, stiffness_range=2.0, damping_range=0.1),
    "hip_pitch": GroupGains(stiffness=17.5, damping=0.4, stiffness_range=1.5, damping_range=0.05),
}


def written(tmp_path: Path, **changes: Any) -> Path:
    joint = JointGains(
        stiffness=FittedValue(value=20.0),
        damping=FittedValue(value=0.5),
        armature=FittedValue(value=0.0026),
    )
    delays = {"FR_knee": 4e-3, "FL_knee": 7e-3}
    joints = {}
    for name, delay_s in delays.items():
        joints[name] = replace(joint, delay_s=FittedValue(value=delay_s))
    gains = MatchedGains(
        robot="mini_cheetah",
        simulator=SIMULATOR,
        joints=joints,
        groups=GROUPS,
        virtual=True,
    )
    path = tmp_path / "gains.yaml"
    save_gains(path, replace(gains, **changes))
    return path


def test_naive_is_the_drive_and_the_ranges_of_the_paper() -> None:
    gains = training_gains("naive", ROBOT)
    assert (gains.name, gains.robot) == ("naive", "mini_cheetah")
    assert (gains.delay_s, gains.sha256, gains.virtual) == (0.0, "", False)
    assert tuple(gains.groups) == ("hip_roll", "hip_pitch", "knee")
    for group in gains.groups.values():
        assert (group.stiffness, group.damping) == (17.0, 0.4)
        assert (group.stiffness_range, group.damping_range) == (2.0, 0.05)


@pytest.mark.parametrize("version", [mujoco.__version__, f"{MINOR}.99"])
def test_matched_is_the_file(tmp_path: Path, version: str) -> None:
    """Patches of MuJoCo are the same simulator."""
    path = written(tmp_path, simulator=SimulatorInfo(version=version))
    for choice in (path, str(path)):
        gains = training_gains(choice, ROBOT)
        assert gains.name == "matched"
        assert gains.groups == GROUPS
        assert tuple(gains.groups) == ROBOT.groups, "in the robot's order, not in the file's"
        assert gains.delay_s == pytest.approx(0.0055, abs=1e-12)
        assert gains.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
        assert gains.virtual


def test_naive_like_matched_differs_by_the_nominals_alone(tmp_path: Path) -> None:
    path = written(tmp_path)
    matched, naive = training_gains(path, ROBOT), training_gains("naive", ROBOT, like=path)
    assert naive == replace(matched, name="naive", groups=naive.groups)
    for group in ROBOT.groups:
        a, b = naive.groups[group], matched.groups[group]
        assert (a.stiffness, a.damping) == (17.0, 0.4)
        moved = replace(b, stiffness=17.0, damping=0.4, ellipsoid_center=a.ellipsoid_center)
        assert a == moved
    # 17 - 21.5 = -4.5 and .4 - .55 = -.15, from (22, .54)
    assert naive.groups["knee"].ellipsoid_center == pytest.approx((17.5, 0.39))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"robot": "so101"}, "so101"),
        ({"groups": {k: v for k, v in GROUPS.items() if k != "knee"}}, "knee"),
        ({"joints": {}}, "no joints"),
        ({"engine": "bullet"}, "engine bullet"),
        ({"timestep_s": 0.002}, r"timestep_s 0\.002"),
        ({"decimation": 10}, "decimation 10"),
        ({"integrator": "Euler"}, "integrator Euler"),
        ({"actuator": "position"}, "actuator position"),
        ({"version": "4.0.0"}, r"version 4\.0"),
    ],
)
def test_files_that_do_not_fit_are_refused(
    tmp_path: Path, changes: dict[str, Any], named: str
) -> None:
    if changes.keys() <= vars(SIMULATOR).keys():
        changes = {"simulator": replace(SIMULATOR, **changes)}
    path = written(tmp_path, **changes)
    for choice, like in ((path, None), ("naive", path)):
        with pytest.raises(ArtefactError, match=named) as error:
            training_gains(choice, ROBOT, like=like)
        assert str(error.value).startswith(f"{path}: ")


def test_missing_file_and_wrong_choices_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ArtefactError, match=r"gains\.yaml"):
        training_gains(tmp_path / "gains.yaml", ROBOT)
    path = written(tmp_path)
    with pytest.raises(PronkError, match="'naive' only"):
        training_gains(path, ROBOT, like=path)


@pytest.mark.parametrize(
    ("name", "value"),
    [("stiffness", 17.5), ("damping", -0.01), ("damping", 0.4), ("stiffness", float("nan"))],
)
def test_a_range_that_reaches_zero_is_refused(name: str, value: float) -> None:
    changed = replace(GROUPS["hip_pitch"], **{f"{name}_range": value})
    with pytest.raises(PronkError, match=f"{name} of hip_pitch"):
        TrainingGains(name="matched", robot="mini_cheetah", groups=GROUPS | {"hip_pitch": changed})


@pytest.mark.parametrize("delay", [-0.001, float("nan"), float("inf")])
def test_an_impossible_delay_is_refused(delay: float) -> None:
    with pytest.raises(PronkError, match="delay"):
        TrainingGains(name="naive", robot="mini_cheetah", groups=GROUPS, delay_s=delay)


def test_joints_of_a_group_with_different_gains_have_no_naive_pair() -> None:
    stiff = replace(ROBOT.joint("FR_knee"), stiffness=30.0)
    joints = tuple(stiff if j.name == "FR_knee" else j for j in ROBOT.joints)
    with pytest.raises(PronkError, match="group knee"):
        training_gains("naive", replace(ROBOT, joints=joints))


# --- By joint ------------------------------------------------------------------------------------


def measured_joints() -> dict[str, JointGains]:
    """Every joint with a stiffness of its own, and what is known about it."""
    joints = {}
    for number, name in enumerate(ROBOT.joint_names):
        joints[name] = JointGains(
            stiffness=FittedValue(value=20.0 + number, total95=(19.0 + number, 20.5 + number)),
            damping=FittedValue(value=0.5, repeat95=(0.49, 0.51), total95=(0.45, 0.52)),
            armature=FittedValue(value=0.0026),
            frictionloss=FittedValue(value=0.2, total95=(0.15, 0.3)),
            delay_s=FittedValue(value=5e-3, total95=(4e-3, 7e-3)),
            covariance=((1e-4, 1.6e-6), (1.6e-6, 4e-8)),
        )
    return joints


def by_joint(tmp_path: Path, joints: dict[str, JointGains]) -> TrainingGains:
    return training_gains(written(tmp_path, joints=joints), ROBOT, by_joint=True)


def test_by_joint_each_has_its_own_pair_interval_and_correlation(tmp_path: Path) -> None:
    gains = by_joint(tmp_path, measured_joints())
    for number, joint in enumerate(ROBOT.joints):
        drawn = gains.of(joint)
        assert (drawn.stiffness, drawn.damping) == (20.0 + number, 0.5)
        assert drawn.ellipsoid_center == (20.0 + number, 0.5)
        # The farther end of each total interval.
        assert drawn.stiffness_range == pytest.approx(1.0)
        assert drawn.damping_range == pytest.approx(0.05)
        # 1.6e-6 / sqrt(1e-4 4e-8) = .8.
        (a, b), (c, d) = drawn.ellipsoid
        assert (a, b, c, d) == pytest.approx((1.0, 0.04, 0.04, 0.0025))
        assert gains.frictions[joint.name] == (0.15, 0.3)
    assert gains.delay_span_s == (4e-3, 7e-3)
    by_group = training_gains(tmp_path / "gains.yaml", ROBOT)
    assert (by_group.joints, by_group.frictions, by_group.delay_span_s) == ({}, {}, None)
    assert by_group.of(ROBOT.joint("FL_knee")) == GROUPS["knee"]


@pytest.mark.parametrize(
    ("changes", "stiffness_range", "damping_range"),
    [
        # The spread over amplitudes, 12 % of 20, beyond the interval; the damping has its own.
        ({"quality": MatchQuality(amplitude_spread=0.12)}, 2.4, 0.05),
        # No total interval: that of repeats for the stiffness, the spread for the damping.
        (
            {
                "stiffness": FittedValue(value=20.0, repeat95=(19.9, 20.6)),
                "damping": FittedValue(value=0.5, repeat95=(0.499, 0.501)),
                "quality": MatchQuality(amplitude_spread=0.02),
            },
            0.6,
            0.01,
        ),
        # Nothing known: half a percent.
        ({"stiffness": FittedValue(value=20.0), "damping": FittedValue(value=0.5)}, 0.1, 0.0025),
        # Never down to zero.
        ({"stiffness": FittedValue(value=20.0, total95=(1.0, 400.0))}, 18.0, 0.05),
    ],
)
def test_widths_by_what_is_known(
    tmp_path: Path, changes: dict[str, Any], stiffness_range: float, damping_range: float
) -> None:
    joints = measured_joints()
    joints["FR_hip_roll"] = replace(joints["FR_hip_roll"], **changes)
    drawn = by_joint(tmp_path, joints).joints["FR_hip_roll"]
    assert drawn.stiffness_range == pytest.approx(stiffness_range)
    assert drawn.damping_range == pytest.approx(damping_range)


def test_by_joint_without_friction_correlation_or_delay_interval(tmp_path: Path) -> None:
    joint = JointGains(
        stiffness=FittedValue(value=20.0),
        damping=FittedValue(value=0.5),
        armature=FittedValue(value=0.0026),
        delay_s=FittedValue(value=5e-3),
    )
    gains = by_joint(tmp_path, dict.fromkeys(ROBOT.joint_names, joint))
    assert gains.joints["FL_knee"].ellipsoid[0][1] == 0.0
    assert gains.frictions["FL_knee"] == (0.2, 0.2), "that of the robot's drives"
    assert gains.delay_span_s == (5e-3, 5e-3)


def test_naive_by_joint_differs_by_the_middles_alone(tmp_path: Path) -> None:
    path = written(tmp_path, joints=measured_joints())
    matched = training_gains(path, ROBOT, by_joint=True)
    naive = training_gains("naive", ROBOT, like=path, by_joint=True)
    assert naive.delay_span_s == matched.delay_span_s
    for name, own in naive.joints.items():
        assert (own.stiffness, own.damping) == (17.0, 0.4)
        assert own.ellipsoid_center == pytest.approx((17.0, 0.4))
        assert own.ellipsoid == matched.joints[name].ellipsoid
    with pytest.raises(PronkError, match=r"gains\.yaml"):
        training_gains("naive", ROBOT, by_joint=True)


def test_by_joint_needs_all_joints(tmp_path: Path) -> None:
    joints = measured_joints()
    del joints["HL_knee"]
    with pytest.raises(ArtefactError, match="HL_knee"):
        by_joint(tmp_path, joints)


def test_the_shipped_gains_have_ellipses_by_joint() -> None:
    """A file of the first schema: no total interval, the spread over amplitudes of 1 to 2 %."""
    path = Path(__file__).parents[2] / "policies" / "gains.yaml"
    gains = training_gains(path, ROBOT, by_joint=True)
    for drawn in gains.joints.values():
        assert 0.01 < drawn.stiffness_range / drawn.stiffness < 0.03
        assert 0.01 < drawn.damping_range / drawn.damping < 0.03
        (a, b), (_, d) = drawn.ellipsoid
        assert 0.3 < b / (a * d) ** 0.5 < 1.0
