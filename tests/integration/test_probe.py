"""`pronk probe` on simulators whose law, parameters and faults are known."""

from __future__ import annotations

import importlib.util
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.probe import ENGINES, ROBOTS, Drawn, Truth, drawn, score
from command_line import accepted, refused
from pronk.errors import PronkError
from pronk.identify.simulators.probe import probe
from pronk.robots import load_robot
from pronk.robots.drive_law import DriveLaw

PENDULUM, SWING = ROBOTS[0]


def truth(**changes: object) -> Truth:
    """A pendulum in NumPy without faults, with changes."""
    robot = load_robot(PENDULUM)
    values = {
        **{"kind": "numpy", "robot": robot, "joint": SWING, "law": DriveLaw()},
        **{"armature": robot.joint(SWING).drive.armature, "frictionloss": 0.1},
        **{"delay_s": 0.0032, "hold": 1, "scale": 1.0, "fault": "", **changes},
    }
    return Truth(**{"stated": values["law"], **values})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("kind", "law"),
    [
        ("mujoco", DriveLaw()),
        ("numpy", DriveLaw(kind="implicit_damping")),
        ("numpy", DriveLaw(kind="implicit")),
    ],
)
def test_law_and_parameters(kind: str, law: DriveLaw) -> None:
    known = truth(law=law, kind=kind)
    found = probe(Drawn(known), known.robot)
    assert (found.law, found.beside_explicit, found.hold) == (law, False, 1)
    assert found.armature == pytest.approx(known.armature, rel=1e-3)
    assert found.frictionloss == pytest.approx(0.1, rel=1e-2)
    assert found.delay_s == pytest.approx(0.0032, abs=1e-5)
    assert found.soft_friction == (kind == "mujoco")
    assert not found.wrong


def named_as_drawn(known: Truth) -> None:
    found = score(known, probe(Drawn(known), known.robot, known.joint))
    assert all(found[right] for right in ("law_right", "hold_right", "fault_right")), found
    assert found["armature_error"] < 0.02
    assert found["delay_error_s"] < 5e-4


@pytest.mark.parametrize(
    ("fault", "changes"),
    [
        ("ignored", {"armature": 0.0}),
        ("armature", {"armature": 0.1063}),
        ("twice", {"scale": 2.0}),
        ("degrees", {"scale": np.pi / 180.0, "frictionloss": 0.0}),
        ("law", {"stated": DriveLaw(kind="implicit_damping")}),
        ("beside", {"law": DriveLaw(kind="implicit_damping"), "stated": DriveLaw()}),
        ("hold", {"hold": 4}),
    ],
)
def test_what_is_wrong_is_named(fault: str, changes: dict[str, object]) -> None:
    named_as_drawn(truth(fault=fault, **changes))


def test_a_joint_that_does_not_move_is_refused() -> None:
    known = truth(frictionloss=1e3)
    with pytest.raises(PronkError, match="does not move"):
        probe(Drawn(known), known.robot)
    with pytest.raises(PronkError, match="no joint"):
        probe(Drawn(replace(known, robot=replace(known.robot, joints=()))), known.robot)


@pytest.mark.slow
def test_random_simulators_are_named() -> None:
    installed = [one for one in ENGINES if importlib.util.find_spec(one.module.split(".")[0])]
    generator = np.random.default_rng(7)
    for kind in ("numpy", "mujoco", *(one.__name__ for one in installed)):
        named_as_drawn(drawn(generator, kind, ""))


def test_the_command_names_law_and_faults(tmp_path: Path) -> None:
    out, words = tmp_path / "probe.json", ["probe", "mujoco", "--robot", PENDULUM]
    accepted(*words, "--json", out)
    found = json.loads(out.read_text())["probe"]
    assert found["law"] == {"kind": "explicit", "iterations": 1, "passive_damping": "implicit"}
    assert found["wrong"] == {}
    assert "swing" in refused(*words, "--joint", "knee")


def test_one_scale_of_gains_inertia_and_gravity_is_not_taken_for_another() -> None:
    robot = replace(load_robot("mini_cheetah"), timestep_s=0.002, decimation=10)
    armature = robot.joint("FR_knee").drive.armature
    known = truth(robot=robot, joint="FR_knee", armature=armature, frictionloss=0.0, delay_s=0.0)
    found = probe(Drawn(known), robot, "FR_knee")
    assert found.law == DriveLaw()
    assert found.stiffness_factor == pytest.approx(1.0, rel=1e-3)
    assert not found.wrong
