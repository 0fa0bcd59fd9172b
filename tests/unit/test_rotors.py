"""Rotors on their belts against plain MuJoCo and against finer steps."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

torch = pytest.importorskip("torch")

from pronk.jump.train.mdp.rotors import Rotors

pytestmark = pytest.mark.train

INERTIA = 0.0063
FREQUENCY_HZ = 45.0
DAMPING_RATIO = 0.2
STIFFNESS = INERTIA * (2.0 * math.pi * FREQUENCY_HZ) ** 2
DAMPING = 2.0 * DAMPING_RATIO * math.sqrt(STIFFNESS * INERTIA)
FINE_S = 2e-5
JOINT = f"""
<mujoco>
  <option timestep="{FINE_S}" gravity="0 0 0"/>
  <worldbody>
    <body name="link">
      <joint name="link" type="hinge" axis="0 1 0"/>
      <inertial pos="0 0 0" mass="1" diaginertia="0.02 0.02 0.02"/>
    </body>
    <body name="rotor">
      <joint name="rotor" type="hinge" axis="0 1 0"/>
      <inertial pos="0 0 0" mass="1" diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>
    </body>
  </worldbody>
  <tendon>
    <fixed name="belt" stiffness="{STIFFNESS}" damping="{DAMPING}" springlength="0">
      <joint joint="rotor" coef="1"/>
      <joint joint="link" coef="-1"/>
    </fixed>
  </tendon>
</mujoco>
"""


def built(timestep_s: float, frequency_hz: float = FREQUENCY_HZ) -> Rotors:
    """One rotor of one robot, in double precision."""
    rotors = Rotors(torch.full((1, 1), INERTIA, dtype=torch.float64), timestep_s)
    frequency = torch.full((1, 1), frequency_hz, dtype=torch.float64)
    rotors.draw(frequency, torch.full_like(frequency, DAMPING_RATIO))
    return rotors


def test_a_rotor_swings_on_its_belt_as_in_mujoco() -> None:
    model = mujoco.MjModel.from_xml_string(JOINT)
    data = mujoco.MjData(model)
    rotors = built(FINE_S)
    offsets = []
    speeds = []
    for step in range(5000):
        torque = 8.0 * math.sin(2.0 * math.pi * 3.0 * step * FINE_S)
        if step > 2500:
            torque -= 6.0
        data.qfrc_applied[:] = (0.0, torque)
        mujoco.mj_step(model, data)
        acceleration = torch.full((1, 1), data.qacc[0], dtype=torch.float64)
        rotors.advance(torch.full_like(acceleration, torque), acceleration)
        offsets.append((data.qpos[1] - data.qpos[0], float(rotors.offset)))
        speeds.append((data.qvel[1] - data.qvel[0], float(rotors.speed)))
    expected_offset, offset = np.transpose(offsets)
    expected_speed, speed = np.transpose(speeds)
    np.testing.assert_allclose(offset, expected_offset, atol=0.005 * np.ptp(expected_offset))
    np.testing.assert_allclose(speed, expected_speed, atol=0.01 * np.ptp(expected_speed))
    assert np.ptp(expected_offset) > 0.01


@pytest.mark.parametrize("frequency_hz", [5.0, 45.0, 1000.0])
def test_one_physics_step_is_exact_whatever_the_stiffness(frequency_hz: float) -> None:
    coarse = built(0.005, frequency_hz)
    fine = built(0.005 / 50, frequency_hz)
    generator = np.random.default_rng(1)
    for _ in range(40):
        torque, acceleration = torch.from_numpy(generator.normal(0.0, (10.0, 300.0)))
        coarse.advance(torque.reshape(1, 1), acceleration.reshape(1, 1))
        for _ in range(50):
            fine.advance(torque.reshape(1, 1), acceleration.reshape(1, 1))
        assert coarse.offset.item() == pytest.approx(fine.offset.item(), rel=1e-6, abs=1e-12)
        assert coarse.speed.item() == pytest.approx(fine.speed.item(), rel=1e-6, abs=1e-9)


def test_rotors_rest_on_their_links_until_belts_are_drawn() -> None:
    rotors = Rotors(torch.full((2, 3), INERTIA), 0.005)
    ones = torch.ones(2, 3)
    rotors.advance(ones, ones)
    assert rotors.rigid
    assert not rotors.offset.any()
    rotors.draw(45.0 * ones, 0.2 * ones)
    rotors.advance(ones, ones)
    rotors.reset(torch.tensor([False, True]))
    assert rotors.offset[0].all()
    assert not rotors.offset[1].any()
    assert not rotors.speed[1].any()
