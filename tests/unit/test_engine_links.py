"""Chains as numbers, delays, and engines of files, beside what MuJoCo and the match compute."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from pronk.errors import PronkError, RobotError
from pronk.identify.response.grid import held_mean
from pronk.identify.simulators.engine import delayed
from pronk.identify.simulators.factory import simulator_factory
from pronk.identify.simulators.links import along_x, links_of, principal, quaternion, rotation
from pronk.identify.simulators.mujoco import Chain
from pronk.robots import load_robot


@pytest.mark.parametrize(
    ("name", "joint"),
    [("mini_cheetah", "FR_hip_roll"), ("go2", "RL_hip_pitch"), ("so101", "shoulder_pan")],
)
def test_gravity_and_rest_are_those_of_the_bench_model(name: str, joint: str) -> None:
    robot = load_robot(name)
    links = links_of(robot, joint)
    with Chain(robot, joint, threads=1) as chain:
        data = mujoco.MjData(chain.model)
        for position in np.random.default_rng(0).uniform(-1.0, 1.0, (5, chain.model.nq)):
            data.qpos[:] = position
            mujoco.mj_forward(chain.model, data)
            assert np.ptp(data.qfrc_bias) > 1e-3
            np.testing.assert_allclose(links.gravity_torque(position), -data.qfrc_bias, atol=1e-12)
        target = np.full(chain.model.nq, 0.3)
        stiffness = np.full(chain.model.nq, 20.0)
        expected = chain.rest_position(target, stiffness)
        np.testing.assert_allclose(links.rest(target, stiffness), expected, atol=1e-12)


def test_two_hinges_on_a_body_are_refused(tmp_path: Path) -> None:
    model = tmp_path / "two.xml"
    model.write_text(
        "<mujoco><worldbody><body><joint name='turn' axis='0 1 0'/><joint name='more'/>"
        "<geom size='.1' pos='.1 .1 .1'/></body></worldbody></mujoco>"
    )
    robot = load_robot(model)
    with pytest.raises(RobotError, match="hinges"):
        links_of(robot, robot.joint_names[0])


def test_delays_of_any_length_are_those_of_the_match() -> None:
    generator = np.random.default_rng(1)
    command = generator.normal(size=(3, 40, 2))
    steps = generator.uniform(0.0, 5.0, (3, 2))
    edges = 0.005 * np.arange(41)
    delayed_command = delayed(command, steps)
    for run, joint in np.ndindex(steps.shape):
        late = edges - 0.005 * steps[run, joint]
        expected = held_mean(edges[:-1], command[run, :, joint], late)
        np.testing.assert_allclose(delayed_command[run, :, joint], expected, atol=1e-12)


def test_rotations() -> None:
    generator = np.random.default_rng(2)
    for _ in range(20):
        axis = generator.normal(size=3)
        axis /= np.linalg.norm(axis)
        turn = rotation(axis, generator.uniform(-3.0, 3.0))
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, quaternion(turn))
        np.testing.assert_allclose(matrix.reshape(3, 3), turn, atol=1e-12)
        np.testing.assert_allclose(along_x(axis) @ [1.0, 0.0, 0.0], axis, atol=1e-12)
        assert np.linalg.det(along_x(axis)) == pytest.approx(1.0)
        moments, axes = principal(turn @ np.diag([1.0, 2.0, 2.5]) @ turn.T)
        np.testing.assert_allclose(moments, [1.0, 2.0, 2.5])
        assert np.linalg.det(axes) == pytest.approx(1.0)


def test_a_file_whose_engine_is_missing_names_the_module_and_the_way_out(tmp_path: Path) -> None:
    file = tmp_path / "adapter.py"
    file.write_text("import an_engine_that_is_missing\n")
    with pytest.raises(PronkError, match=r"an_engine_that_is_missing.*--simulator-python"):
        simulator_factory(f"{file}:Adapter")
