"""`pronk probe` on simulators whose law, parameters and faults are known."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from command_line import accepted, refused
from drawn_simulator import (
    DEFAULT_ARMATURE,
    ENGINES,
    ROBOTS,
    DrawnSimulator,
    Truth,
    draw_truth,
    score,
)
from pronk.arrays import Array
from pronk.errors import PronkError
from pronk.identify.simulators.probe.experiments import Bench
from pronk.identify.simulators.probe.probe import probe_joint
from pronk.identify.simulators.probe.result import Probe
from pronk.robots import load_robot
from pronk.robots.drive_law import DriveLaw

PENDULUM = ROBOTS[0][0]
FAULTLESS = Truth(
    kind="numpy",
    robot=load_robot(PENDULUM),
    joint="swing",
    law=DriveLaw(),
    stated=DriveLaw(),
    armature=load_robot(PENDULUM).joint("swing").drive.armature,
    frictionloss=0.1,
    delay_s=0.0032,
    hold=1,
    scale=1.0,
    fault="",
)
"""A pendulum in NumPy without faults."""


def probed(truth: Truth) -> Probe:
    return probe_joint(DrawnSimulator(truth), truth.robot, truth.joint)


@pytest.mark.parametrize(
    ("engine", "law"),
    [
        ("mujoco", DriveLaw()),
        ("numpy", DriveLaw(kind="implicit_damping")),
        ("numpy", DriveLaw(kind="implicit")),
    ],
)
def test_law_and_parameters(engine: str, law: DriveLaw) -> None:
    truth = replace(FAULTLESS, law=law, stated=law, kind=engine)
    probe = probed(truth)
    assert probe.law.drive == law
    assert not probe.law.beside_explicit
    assert probe.law.soft_friction == (engine == "mujoco")
    assert probe.hold == 1
    assert probe.armature == pytest.approx(truth.armature, rel=1e-3)
    assert probe.frictionloss == pytest.approx(0.1, rel=1e-2)
    assert probe.delay_s == pytest.approx(0.0032, abs=1e-5)
    assert set(probe.faults) == {"delay"}


def assert_named_as_drawn(truth: Truth) -> None:
    scores = score(truth, probed(truth))
    assert scores["law_right"], scores
    assert scores["hold_right"], scores
    assert scores["fault_right"], scores
    assert scores["armature_error"] < 0.02  # type: ignore[operator]
    assert scores["delay_error_s"] < 5e-4  # type: ignore[operator]


@pytest.mark.parametrize(
    ("fault", "changes"),
    [
        ("ignored", {"armature": 0.0}),
        ("armature", {"armature": 0.1063}),
        ("twice", {"scale": 2.0}),
        ("degrees", {"scale": np.pi / 180.0, "frictionloss": 0.0}),
        ("law", {"stated": DriveLaw(kind="implicit_damping")}),
        ("beside", {"law": DriveLaw(kind="implicit_damping")}),
        ("hold", {"hold": 4}),
    ],
)
def test_what_acts_otherwise_than_it_is_set_is_named(fault: str, changes: dict[str, Any]) -> None:
    assert_named_as_drawn(replace(FAULTLESS, fault=fault, **changes))


def test_a_joint_that_does_not_move_is_refused() -> None:
    with pytest.raises(PronkError, match="does not move"):
        probed(replace(FAULTLESS, frictionloss=1e3))
    without_joints = replace(FAULTLESS, robot=replace(FAULTLESS.robot, joints=()))
    with pytest.raises(PronkError, match="no joint"):
        probe_joint(DrawnSimulator(without_joints), FAULTLESS.robot)


@pytest.mark.parametrize(
    ("timestep_s", "iterations", "armature_acts"), [(0.002, 10, True), (0.005, 4, False)]
)
def test_less_torque_near_the_no_load_speed_is_no_fault(
    timestep_s: float, iterations: int, armature_acts: bool
) -> None:
    """With half its damping this knee would turn at its no-load speed in resonance."""
    law = DriveLaw(kind="implicit", iterations=iterations)
    mini_cheetah = replace(load_robot("mini_cheetah"), timestep_s=timestep_s)
    knee = mini_cheetah.joint("FR_knee")
    drive = replace(knee.drive, rotor_inertia=4.3e-5)
    knee = replace(knee, drive=drive, stiffness=20.0, damping=0.21)
    joints = [knee if joint.name == knee.name else joint for joint in mini_cheetah.joints]
    truth = Truth(
        kind="mujoco",
        robot=replace(mini_cheetah, joints=tuple(joints)),
        joint="FR_knee",
        law=law,
        stated=law,
        armature=knee.drive.armature if armature_acts else 0.0,
        frictionloss=0.2,
        delay_s=0.0,
        hold=1,
        scale=1.0,
        fault="" if armature_acts else "ignored",
    )
    assert_named_as_drawn(truth)


class SinglePrecision(DrawnSimulator):
    """A simulator whose positions have the 24 bits of engines on GPUs."""

    def rollout(
        self, command: Array, values: Mapping[str, Array], *, locked: Sequence[str] = ()
    ) -> Array:
        positions = super().rollout(command, values, locked=locked)
        return positions.astype(np.float32).astype(np.float64)


@pytest.mark.parametrize("stiffness", [14.0, 20.0])
def test_rounding_of_small_motions_is_no_limit_of_the_torque(stiffness: float) -> None:
    """A heavy joint moves by less than 1e-6 rad in the first millisecond of a small command."""
    mini_cheetah = replace(load_robot("mini_cheetah"), timestep_s=0.001, decimation=20)
    knee = replace(mini_cheetah.joint("FR_knee"), stiffness=stiffness, damping=0.45)
    joints = [knee if joint.name == knee.name else joint for joint in mini_cheetah.joints]
    truth = replace(
        FAULTLESS,
        kind="mujoco",
        robot=replace(mini_cheetah, joints=tuple(joints)),
        joint="FR_knee",
        armature=knee.drive.armature + DEFAULT_ARMATURE,
        frictionloss=0.0,
        delay_s=0.0,
        fault="armature",
    )
    probe = probe_joint(SinglePrecision(truth), truth.robot, truth.joint)
    assert set(probe.faults) == {"armature"}
    assert probe.armature == pytest.approx(truth.armature, rel=1e-3)


@pytest.mark.parametrize("delay_steps", [1.9904, 1.9906, 1.9908])
def test_a_motion_as_small_as_rounding_is_no_hold(delay_steps: float) -> None:
    """The delay leaves a hundredth of a step, in which the joint moves by 18 roundings or 19."""
    law = DriveLaw(kind="implicit", iterations=10)
    go2 = replace(load_robot("go2"), timestep_s=0.002, decimation=10)
    truth = replace(
        FAULTLESS,
        robot=go2,
        joint="RL_knee",
        law=law,
        stated=law,
        frictionloss=0.0,
        delay_s=0.002 * delay_steps,
    )
    bench = Bench(SinglePrecision(truth), go2, "RL_knee")
    delay, hold, _ = bench.latency(1.0)
    assert hold == 1
    assert delay in (1, 2)


@pytest.mark.parametrize("engine", ["numpy", "mujoco"])
def test_gains_with_which_a_joint_swings_at_its_torque_limit_are_no_stable_ones(
    engine: str,
) -> None:
    """Per degree, not per radian, they are 57 times as large; the limit keeps the joint near."""
    mini_cheetah = replace(load_robot("mini_cheetah"), timestep_s=0.002, decimation=10)
    truth = replace(
        FAULTLESS,
        kind=engine,
        robot=mini_cheetah,
        joint="FR_knee",
        frictionloss=0.0,
        delay_s=0.0,
        scale=180.0 / np.pi,
    )
    probe = probed(truth)
    assert set(probe.faults) == {"degrees", "unstable"}
    assert probe.gains.stable_share == 0.25
    assert probe.law.drive == DriveLaw()


def test_passive_damping_that_is_little_beside_the_drives_is_not_named() -> None:
    """Of 57 times the drive's damping the fit takes or gives 0.05 N m s/rad."""
    law = DriveLaw(kind="implicit_damping")
    truth = replace(
        FAULTLESS,
        kind="mujoco",
        robot=replace(load_robot("go2"), timestep_s=0.002, decimation=10),
        joint="RL_knee",
        law=law,
        stated=law,
        frictionloss=0.0877,
        delay_s=0.0,
        scale=180.0 / np.pi,
    )
    assert set(probed(truth).faults) == {"degrees"}


@pytest.mark.slow
def test_random_simulators_are_named() -> None:
    engines = ["numpy", "mujoco"]
    for name, engine in ENGINES.items():
        if importlib.util.find_spec(engine.module):
            engines.append(name)
    generator = np.random.default_rng(7)
    for engine_name in engines:
        assert_named_as_drawn(draw_truth(generator, engine_name, ""))


def test_the_command_names_law_and_faults(tmp_path: Path) -> None:
    out = tmp_path / "probe.json"
    words = ["probe", "mujoco", "--robot", PENDULUM]
    accepted(*words, "--json", out)
    probe = json.loads(out.read_text())["probe"]
    drive = {"kind": "explicit", "iterations": 1, "passive_damping": "implicit"}
    assert probe["law"]["drive"] == drive
    assert probe["faults"] == {}
    assert "swing" in refused(*words, "--joint", "knee")


def test_one_scale_of_gains_inertia_and_gravity_is_not_taken_for_another() -> None:
    robot = replace(load_robot("mini_cheetah"), timestep_s=0.002, decimation=10)
    truth = replace(
        FAULTLESS,
        robot=robot,
        joint="FR_knee",
        armature=robot.joint("FR_knee").drive.armature,
        frictionloss=0.0,
        delay_s=0.0,
    )
    probe = probed(truth)
    assert probe.law.drive == DriveLaw()
    assert probe.gains.stiffness_factor == pytest.approx(1.0, rel=1e-3)
    assert not probe.faults
