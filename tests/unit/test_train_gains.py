"""Gains of training: naive, matched, and naive with everything else as matched."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import pytest

from pronk.errors import ArtefactError, PronkError
from pronk.identify.match.gains import FittedValue, GroupGains, JointGains, MatchedGains, save_gains
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
