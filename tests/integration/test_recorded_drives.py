"""Batteries and drives that are recorded on a GPU give the torques that they give without it."""

from __future__ import annotations

from typing import Any

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("mjlab")
from mjlab.envs import ManagerBasedRlEnv

import training_env
from pronk.jump.train.gains import training_gains
from pronk.jump.train.mdp.actions import joint_position_action

pytestmark = pytest.mark.train

ROBOTS = 16
STEPS = 12
DEVICES = [
    "cpu",
    pytest.param(
        "cuda:0",
        marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU of NVIDIA"),
    ),
]


def torques(device: str, *, records: bool) -> tuple[Any, Any]:
    """Step robots; half way all batteries become weaker. Returns torques and voltages."""
    gains = training_gains("naive", training_env.ROBOT)
    env = ManagerBasedRlEnv(training_env.config(ROBOTS, gains), device=device)
    action = joint_position_action(env)
    drives = action.record_drives() if records else None
    env.reset(seed=0)
    generator = torch.Generator().manual_seed(1)
    torque_history = []
    voltage_history = []
    with torch.inference_mode():
        for step in range(STEPS):
            if step == STEPS // 2:
                voltage = torch.full((ROBOTS, 1), 18.0, device=device)
                action.battery.set(voltage, 0.1 * torch.ones_like(voltage), rated=24.0)
            if drives is not None and step % 3 == 0:
                drives.begin()
            env.step(torch.randn(ROBOTS, 12, generator=generator).to(device))
            torque_history.append(env.sim.data.ctrl[:].clone())
            voltage_history.append(action.battery.voltage.clone())
    env.close()
    return torch.stack(torque_history).cpu(), torch.stack(voltage_history).cpu()


@pytest.mark.parametrize("device", DEVICES)
def test_recorded_drives_give_the_same_torques(device: str) -> None:
    expected_torques, expected_voltages = torques(device, records=False)
    recorded_torques, recorded_voltages = torques(device, records=True)
    # In twelve steps rounding grows to this much where feet slip.
    tolerance = 0.0 if device == "cpu" else 0.05
    torch.testing.assert_close(recorded_torques, expected_torques, rtol=0.0, atol=tolerance)
    torch.testing.assert_close(recorded_voltages, expected_voltages, rtol=0.0, atol=tolerance)
    assert expected_voltages[-1].mean() < 0.8 < expected_voltages[0].mean()
    assert expected_torques.std() > 1.0
