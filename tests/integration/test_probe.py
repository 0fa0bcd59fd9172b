"""`pronk probe` on simulators whose law, parameters and faults are known."""

from __future__ import annotations

import importlib.util
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.probe import ENGINES, ROBOTS, Drawn, Truth, drawn, score
from pronk.actuator.law import DriveLaw
from pronk.arrays import Array
from pronk.cli.main import run
from pronk.errors import PronkError
from pronk.robots import load_robot
from pronk.simulators.engines.mujoco import Mujoco
from pronk.simulators.probe import probe

PENDULUM, SWING = ROBOTS[0]


def truth(**changes: object) -> Truth:
    """A pendulum in NumPy without faults, with changes."""
    robot = load_robot(PENDULUM)
    values = {
        **{"kind": "numpy", "robot": robot, "joint": SWING, "law": DriveLaw()},
        **{"armature": robot.joint(SWING).drive.armature, "frictionloss": 0.1},
        **{"delay_s": 0.0032, "hold": 1, "scale": 1.0, "fault": ""},
    }
    values |= changes
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
    known = truth(fault=fault, **changes)
    found = score(known, probe(Drawn(known), known.robot))
    assert found["law_right"]
    assert found["hold_right"]
    assert found["fault_right"], found["named"]
    assert found["armature_error"] < 0.02
    assert found["delay_error_s"] < 5e-4


class TorqueBesideDrive(Mujoco):
    """MuJoCo's position actuator, with the same torque applied once more before each step."""

    def _stepped(self, model: Any, command: Array, start: Array) -> Array:
        kp, kd = model.actuator_gainprm[:, 0], -model.actuator_biasprm[:, 2]
        data, out = self.engine.MjData(model), np.empty(command.shape)
        data.qpos[:] = start
        for row, target in zip(out, command, strict=True):
            row[:], data.ctrl[:] = data.qpos, target
            data.qfrc_applied[:] = kp * (target - data.qpos) - kd * data.qvel
            self.engine.mj_step(model, data)
        return out


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "word"), [("implicit_damping", "beside"), ("explicit", "twice")])
def test_torques_beside_a_drive_of_an_engine_are_named(kind: Any, word: str) -> None:
    robot = load_robot(PENDULUM)
    found = probe(TorqueBesideDrive(robot, law=DriveLaw(kind=kind)), robot)
    assert set(found.wrong) - {"law"} == {word}
    assert found.law.kind == kind
    assert found.armature == pytest.approx(robot.joint(SWING).drive.armature, rel=0.02)


def test_a_joint_that_does_not_move_is_refused() -> None:
    known = truth(frictionloss=1e3)
    with pytest.raises(PronkError, match="does not move"):
        probe(Drawn(known), known.robot)
    with pytest.raises(PronkError, match="no joint"):
        probe(Drawn(replace(known, robot=replace(known.robot, joints=()))), known.robot)


@pytest.mark.slow
def test_random_simulators_are_named() -> None:
    installed = [
        one.__name__ for one in ENGINES if importlib.util.find_spec(one.module.split(".")[0])
    ]
    generator = np.random.default_rng(7)
    for kind in ["numpy", "mujoco", *installed]:
        known = drawn(generator, kind, "")
        found = score(known, probe(Drawn(known), known.robot, known.joint))
        assert found["law_right"], found
        assert found["fault_right"], found
        assert found["armature_error"] < 0.02
        assert found["delay_error_s"] < 5e-4


def test_the_command_names_law_and_faults(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "probe.json"
    assert run(["probe", "mujoco", "--robot", PENDULUM, "--json", str(out)]) == 0
    found = json.loads(out.read_text())["probe"]
    assert found["law"] == {"kind": "explicit", "iterations": 1, "passive_damping": "implicit"}
    assert found["wrong"] == {}
    assert run(["probe", "mujoco", "--robot", PENDULUM, "--joint", "knee"]) == 2
    assert "swing" in capsys.readouterr().err


def test_one_scale_of_gains_inertia_and_gravity_is_not_taken_for_another() -> None:
    robot = load_robot(ROBOTS[1][0])
    robot = replace(robot, timestep_s=0.002, decimation=10)
    armature = robot.joint("FR_knee").drive.armature
    known = truth(robot=robot, joint="FR_knee", armature=armature, frictionloss=0.0, delay_s=0.0)
    found = probe(Drawn(known), robot, "FR_knee")
    assert found.law == DriveLaw()
    assert found.stiffness_factor == pytest.approx(1.0, rel=1e-3)
    assert not found.wrong
