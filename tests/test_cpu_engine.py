"""MuJoCo's C engine below mjlab, against MuJoCo Warp."""

from __future__ import annotations

import os
import shutil
from typing import Any

import pytest

from tools_folder import load_tool

os.environ.setdefault("MJLAB_WARP_QUIET", "1")
pytestmark = [
    pytest.mark.train,
    pytest.mark.skipif(shutil.which("gcc") is None, reason="compiles the engine with gcc"),
]


@pytest.fixture(scope="module")
def tool() -> Any:
    return load_tool("cpu_engine")


def test_all_that_training_draws_moves_robots_as_warp_moves_them(tool: Any) -> None:
    import mjlab.envs.manager_based_rl_env as mjlab_env
    import torch

    from pronk.train.phases import phase
    from pronk.train.tasks import env_cfg

    def trajectory(simulation: Any) -> tuple[torch.Tensor, torch.Tensor]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(mjlab_env, "Simulation", simulation)
            cfg = env_cfg(phase=phase("jump_b"), num_envs=8, seed=1)
            env = mjlab_env.ManagerBasedRlEnv(cfg=cfg, device="cpu")
        env.reset(seed=1)
        torch.manual_seed(3)
        states, forces = [], []
        for _ in range(10):
            env.step(0.6 * torch.randn(8, 12))
            data = env.sim.data
            states.append(torch.cat([data.qpos[:], data.qvel[:]], dim=1))
            forces.append(env.scene["feet"].data.force.clone())
        env.close()
        return torch.stack(states), torch.stack(forces)

    states, forces = trajectory(tool.CpuSimulation)
    warp_states, warp_forces = trajectory(tool.Simulation)
    torch.testing.assert_close(states, warp_states, rtol=1e-3, atol=2e-3)
    torch.testing.assert_close(forces, warp_forces, rtol=1e-2, atol=0.2)
    assert float(warp_forces.abs().max()) > 30.0  # a robot of 9 kg does stand on them


def test_a_state_that_is_not_finite_stays_to_be_seen(tool: Any) -> None:
    import mjlab.envs.manager_based_rl_env as mjlab_env
    import torch

    from pronk.train.tasks import env_cfg

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mjlab_env, "Simulation", tool.CpuSimulation)
        env = mjlab_env.ManagerBasedRlEnv(cfg=env_cfg(num_envs=3, seed=1), device="cpu")
    env.reset(seed=1)
    env.sim.data.qvel[1, 4] = float("nan")
    env.sim.step()
    finite = torch.isfinite(env.sim.data.qvel).all(dim=1)
    assert finite.tolist() == [True, False, True]
    env.close()
