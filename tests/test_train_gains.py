"""Gains of training: naive, matched, and naive with everything else as matched."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import pytest

from pronk.errors import ArtefactError, PronkError
from pronk.match.gains import GroupGains, JointGains, MatchedGains, save
from pronk.robots import load_robot
from pronk.simulators.simulator import SimulatorInfo
from pronk.train.gains import TrainingGains, training_gains

CHEETAH = load_robot("mini_cheetah")
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
JOINT = JointGains(
    stiffness=20.0,
    damping=0.5,
    grid_stiffness=20.0,
    grid_damping=0.5,
    stiffness_ci95=(19.9, 20.1),
    damping_ci95=(0.49, 0.51),
    covariance=((1e-4, 0.0), (0.0, 1e-6)),
    band_hz=(1.0, 10.0),
    error_db=0.1,
    naive_error_db=1.0,
    coherence_min=0.99,
    armature=0.0026,
)


def written(tmp_path: Path, **changes: Any) -> Path:
    gains = MatchedGains(
        robot="mini_cheetah",
        simulator=SimulatorInfo(version=mujoco.__version__),
        joints={
            "FR_knee": replace(JOINT, delay_s=0.004),
            "FL_knee": replace(JOINT, delay_s=0.007),
        },
        groups=GROUPS,
        virtual=True,
    )
    path = tmp_path / "gains.yaml"
    save(path, replace(gains, **changes))
    return path


def test_naive_is_the_drive_and_the_ranges_of_the_paper() -> None:
    gains = training_gains("naive", CHEETAH)
    assert (gains.name, gains.robot) == ("naive", "mini_cheetah")
    assert (gains.delay_s, gains.sha256, gains.virtual) == (0.0, "", False)
    assert tuple(gains.groups) == ("hip_roll", "hip_pitch", "knee")
    for group in gains.groups.values():
        assert (group.stiffness, group.damping) == (17.0, 0.4)
        assert (group.stiffness_range, group.damping_range) == (2.0, 0.05)


def test_matched_is_the_file(tmp_path: Path) -> None:
    path = written(tmp_path)
    for choice in (path, str(path)):
        gains = training_gains(choice, CHEETAH)
        assert gains.name == "matched"
        assert gains.groups == GROUPS
        assert tuple(gains.groups) == CHEETAH.groups, "robot's order, whatever the file's"
        assert gains.delay_s == pytest.approx(0.0055, abs=1e-12)
        assert gains.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
        assert gains.virtual


def test_naive_like_matched_differs_by_the_nominals_alone(tmp_path: Path) -> None:
    path = written(tmp_path)
    matched, naive = training_gains(path, CHEETAH), training_gains("naive", CHEETAH, like=path)
    assert naive.name == "naive"
    for name in ("robot", "delay_s", "sha256", "virtual"):
        assert getattr(naive, name) == getattr(matched, name)
    for group in CHEETAH.groups:
        a, b = naive.groups[group], matched.groups[group]
        assert (a.stiffness, a.damping) == (17.0, 0.4)
        assert (a.stiffness_range, a.damping_range) == (b.stiffness_range, b.damping_range)
        assert a.ellipsoid == b.ellipsoid
    # 17 - 21.5 = -4.5 and .4 - .55 = -.15, from (22, .54)
    assert naive.groups["knee"].ellipsoid_center == pytest.approx((17.5, 0.39))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"robot": "so101"}, "gains of so101; training mini_cheetah needs gains of mini_cheetah"),
        (
            {"groups": {k: v for k, v in GROUPS.items() if k != "knee"}},
            r"no training gains for knee; .*\(hip_roll, hip_pitch, knee\)",
        ),
        ({"joints": {}}, "no joints"),
    ],
)
def test_files_that_do_not_fit_are_refused(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    path = written(tmp_path, **changes)
    for choice, like in ((path, None), ("naive", path)):
        with pytest.raises(ArtefactError, match=message) as error:
            training_gains(choice, CHEETAH, like=like)
        assert str(error.value).startswith(f"{path}: ")


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("engine", "bullet", "mujoco"),
        ("timestep_s", 0.002, "0.005"),
        ("decimation", 10, "4"),
        ("integrator", "Euler", "implicitfast"),
        ("actuator", "position", "dc_motor_pd"),
        ("version", "4.0.0", ".".join(mujoco.__version__.split(".")[:2])),
    ],
)
def test_gains_of_another_simulator_are_refused(
    tmp_path: Path, field: str, value: Any, expected: str
) -> None:
    simulator = replace(SimulatorInfo(version=mujoco.__version__), **{field: value})
    path = written(tmp_path, simulator=simulator)
    shown = "4.0" if field == "version" else str(value)
    with pytest.raises(ArtefactError, match=f"{field} {shown}; training uses {field} {expected}"):
        training_gains(path, CHEETAH)


def test_a_patch_of_mujoco_is_the_same_simulator(tmp_path: Path) -> None:
    minor = ".".join(mujoco.__version__.split(".")[:2])
    path = written(tmp_path, simulator=SimulatorInfo(version=f"{minor}.99"))
    assert training_gains(path, CHEETAH).name == "matched"


def test_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ArtefactError, match="no such file; `pronk match` writes one"):
        training_gains(tmp_path / "gains.yaml", CHEETAH)


def test_ranges_of_another_file_go_with_naive_only(tmp_path: Path) -> None:
    path = written(tmp_path)
    with pytest.raises(PronkError, match="they go with the choice 'naive' only"):
        training_gains(path, CHEETAH, like=path)


@pytest.mark.parametrize("change", [{"stiffness_range": 17.5}, {"damping_range": -0.01}])
def test_a_range_that_reaches_zero_is_refused(tmp_path: Path, change: dict[str, float]) -> None:
    groups = {**GROUPS, "hip_pitch": replace(GROUPS["hip_pitch"], **change)}
    what = next(iter(change)).removesuffix("_range")
    with pytest.raises(PronkError, match=f"{what} of hip_pitch is .*stays above zero"):
        training_gains(written(tmp_path, groups=groups), CHEETAH)


@pytest.mark.parametrize("delay", [-0.001, float("nan")])
def test_a_delay_that_is_none_is_refused(delay: float) -> None:
    with pytest.raises(PronkError, match="it must be 0 or more"):
        TrainingGains(name="naive", robot="mini_cheetah", groups=GROUPS, delay_s=delay)


def test_joints_of_a_group_with_different_gains_have_no_naive_pair() -> None:
    stiff = replace(CHEETAH.joint("FR_knee"), stiffness=30.0)
    robot = replace(
        CHEETAH, joints=tuple(stiff if j.name == "FR_knee" else j for j in CHEETAH.joints)
    )
    with pytest.raises(PronkError, match="group knee have different gains"):
        training_gains("naive", robot)
