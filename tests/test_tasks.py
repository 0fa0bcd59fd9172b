"""The tasks: known to mjlab, in the robot's order, and standing on firm ground."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib.metadata import entry_points
from typing import Any

import mujoco
import numpy as np
import pytest

from pronk.robots.legged import legged

BODY = legged("mini_cheetah")

pytest.importorskip("mjlab")
pytestmark = pytest.mark.train

import torch
from mjlab.scripts.list_envs import list_environments
from mjlab.tasks.registry import (
    list_tasks,
    load_env_cfg,
    load_rl_cfg,
    load_runner_cls,
)

import small_env
from pronk.robots import load_robot
from pronk.train.mdp.commands import NAME, motion_command
from pronk.train.mdp.scene import FOOT_CONTACT
from pronk.train.phases import phase
from pronk.train.runner.runner import PronkRunner
from pronk.train.tasks import ACTION_SCALE, JUMP_TASK, WALK_TASK, env_cfg

N = small_env.ROBOTS
ROBOT = load_robot("mini_cheetah")
TASKS = ["Pronk-Jump-MiniCheetah", "Pronk-Walk-MiniCheetah"]


@pytest.fixture(scope="module")
def built() -> Any:
    return small_env.quiet()


@pytest.fixture
def env(built: Any) -> Any:
    small_env.fresh(built)
    motion_command(built).scripted = True
    return built


# --- Known to mjlab -------------------------------------------------------------------------------


def test_entry_point_leads_to_the_tasks() -> None:
    found = {point.name: point.value for point in entry_points(group="mjlab.tasks")}
    assert found["pronk"] == "pronk.train.tasks"


def test_mjlabs_list_shows_the_tasks(capsys: pytest.CaptureFixture[str]) -> None:
    assert sorted(TASKS) == sorted([WALK_TASK, JUMP_TASK])
    assert set(TASKS) <= set(list_tasks())
    assert list_environments("MiniCheetah") == 2
    printed = capsys.readouterr().out
    assert all(task in printed for task in TASKS)


def test_tasks_are_known_whatever_is_imported_first() -> None:
    """mjlab loads the entry point while it is itself imported: here by a module of ours."""
    code = (
        "import pronk.train.mdp.commands, pronk.train.tasks\n"
        "from mjlab.tasks.registry import list_tasks\n"
        "print(*list_tasks())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"MJLAB_WARP_QUIET": "1"},
    )
    assert "Failed to load task package" not in done.stderr
    assert set(TASKS) <= set(done.stdout.split())


@pytest.mark.parametrize(("task", "jump"), [(WALK_TASK, False), (JUMP_TASK, True)])
def test_tasks_load(task: str, jump: bool) -> None:
    cfg, learning = load_env_cfg(task), load_rl_cfg(task)
    assert cfg.scene.num_envs == 4096
    assert cfg.commands[NAME].jump_fraction == (0.5 if jump else 0.0)
    assert ("jump" in learning.obs_groups["actor"]) == jump
    assert ("critic_jump" in learning.obs_groups["critic"]) == jump
    assert load_runner_cls(task) is PronkRunner


@pytest.mark.parametrize("task", TASKS)
def test_playing_is_of_the_nominal_robot_undisturbed(task: str) -> None:
    cfg = load_env_cfg(task, play=True)
    assert cfg.scene.num_envs == 1
    noise = [term.noise for term in cfg.observations["measured"].terms.values()]
    assert noise == [None] * len(noise)
    assert set(cfg.events) == {"start"}
    assert cfg.terminations["time_out"].params["steps"] > 10**6


def test_physics_is_that_of_the_match() -> None:
    cfg = env_cfg(num_envs=2)
    assert cfg.decimation == ROBOT.decimation == 4
    assert cfg.sim.mujoco.timestep == ROBOT.timestep_s == 0.005
    assert cfg.sim.mujoco.integrator == "implicitfast"


def test_phases_differ_in_commands_and_rewards_alone() -> None:
    one, other = env_cfg(num_envs=2), env_cfg(num_envs=2, phase=phase("jump_b"))
    for part in ("observations", "actions", "events", "terminations", "decimation"):
        assert str(getattr(one, part)) == str(getattr(other, part))


# --- In the robot's order -------------------------------------------------------------------------


def test_actuators_are_in_the_robots_order_of_joints(env: Any) -> None:
    """Torques and targets are read by index: FR, FL, HR, HL; hip_roll, hip_pitch, knee."""
    model = env.sim.mj_model
    names = [f"robot/{name}" for name in ROBOT.joint_names]
    driven = [model.joint(model.actuator_trnid[i, 0]).name for i in range(model.nu)]
    assert driven == names
    assert [model.joint(1 + i).name for i in range(12)] == names
    assert list(env.scene["robot"].joint_names) == list(ROBOT.joint_names)
    assert model.jnt_dofadr[1:].tolist() == list(range(6, 18))
    np.testing.assert_array_equal(model.actuator_gear[:, 0], 1.0)
    feet = [f"robot/{leg}_foot" for leg in ("FR", "FL", "HR", "HL")]
    assert [model.site(int(i)).name for i in motion_command(env).feet] == feet


def test_an_action_moves_its_own_joint(env: Any) -> None:
    """Robot i moves joint i by .35 rad, in the air, and hardly any other."""
    env.sim.data.qpos[:, 2] = 2.0
    command = motion_command(env)
    env.sim.data.qpos[:, 7:] = command.default_position
    action = torch.eye(12)[:N]
    for _ in range(4):
        env.step(action)
    expected = command.default_position + ACTION_SCALE * action
    assert torch.equal(command.position_target, expected)
    moved = env.sim.data.qpos[:, 7:] - command.default_position
    assert moved.abs().argmax(dim=1).tolist() == list(range(N))
    assert (moved.diagonal() > 0.2).all()


# --- On firm ground -------------------------------------------------------------------------------


def test_zero_action_stays_up_and_feet_do_not_sink() -> None:
    """On feet of friction 3.0, the most that D2 draws.

    With a pyramidal cone the floor was so soft at that friction that feet sank 2 cm.
    """
    env = small_env.fresh(small_env.noisy())
    motion_command(env).scripted = True
    assert env.sim.model.geom_friction.amax() == pytest.approx(small_env.GRIP)
    feet = motion_command(env).feet
    lowest = []
    for _ in range(60):
        _, _, terminated, truncated, _ = env.step(torch.zeros(N, 12))
        assert not (terminated | truncated).any()
        lowest.append(float(env.sim.data.site_xpos[:, feet, 2].min()) - BODY.foot_radius)
    # An episode may begin with feet in the floor, or in the air.
    assert min(lowest[20:]) > -0.006
    assert min(lowest) > -0.02
    assert (env.sim.data.qpos[:, 2] > 0.2).all()
    upright = 1.0 - 2.0 * env.sim.data.qpos[:, 4:6].square().sum(dim=1)
    assert (upright > 0.9).all()


def test_the_feet_alone_are_firm(env: Any) -> None:
    """Here, and in Warp; the robot itself, which match builds on, is as MuJoCo has it."""
    usual = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom size='1'/></worldbody></mujoco>"
    )
    model = env.sim.mj_model
    assert usual.geom_solref[0, 0] > FOOT_CONTACT[0] >= 2.0 * model.opt.timestep
    feet = {model.geom(f"robot/{leg}_foot_collision").id for leg in BODY.legs}
    assert len(feet) == 4
    expected = [FOOT_CONTACT if i in feet else usual.geom_solref[0] for i in range(model.ngeom)]
    np.testing.assert_array_equal(model.geom_solref, expected)
    in_warp = np.broadcast_to(expected, (N, model.ngeom, 2))
    np.testing.assert_allclose(env.sim.model.geom_solref.expand(N, -1, -1), in_warp, rtol=1e-6)
    alone = ROBOT.build_spec().compile().geom_solref
    np.testing.assert_array_equal(alone, np.broadcast_to(usual.geom_solref[0], alone.shape))


def test_a_contact_of_a_foot_is_as_firm_as_the_foot(env: Any) -> None:
    """MuJoCo would take the mean of foot and floor, had the foot no priority."""
    data = mujoco.MjData(env.sim.mj_model)
    # On four feet, with the trunk in the floor: the corners of the trunk are as soft as ever.
    data.qpos[2], data.qpos[3] = 0.04, 1.0
    mujoco.mj_forward(env.sim.mj_model, data)
    seen = set()
    for contact in data.contact:
        names = {env.sim.mj_model.geom(int(i)).name for i in contact.geom}
        foot = any(name.endswith("_foot_collision") for name in names)
        assert tuple(contact.solref) == (FOOT_CONTACT if foot else (0.02, 1.0)), names
        seen.add(foot)
    assert seen == {True, False}


def test_feet_of_a_robot_that_lands_sink_little(env: Any) -> None:
    """Coming down at up to 3 m/s, by 1 cm; with MuJoCo's usual softness it is 2."""
    command, qpos, qvel = motion_command(env), env.sim.data.qpos, env.sim.data.qvel
    qpos[:, 2], qpos[:, 3:7] = 0.32, torch.tensor([1.0, 0.0, 0.0, 0.0])
    qpos[:, 7:] = command.default_position
    qvel[:] = 0.0
    qvel[:, 2] = -torch.linspace(0.5, 3.0, N)
    env.cfg.decimation = 1
    lowest = []
    for _ in range(40):
        _, _, terminated, truncated, _ = env.step(torch.zeros(N, 12))
        assert not (terminated | truncated).any()
        lowest.append(command.motion.foot_height.amin(dim=1))
    sunk = -torch.stack(lowest).amin(dim=0)
    assert (sunk > 0.0).all(), "all have landed"
    assert float(sunk.max()) < 0.013


def test_there_is_room_for_all_contacts_that_can_be(env: Any) -> None:
    """A robot pressed into the floor touches it with everything it has."""
    env.sim.data.qpos[:, 2] = -0.03
    env.sim.data.qpos[:, 3:7] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    env.sim.forward()
    data = env.sim.wp_data
    # Four feet, two ends of eight capsules, four corners of the trunk.
    assert int(data.nacon.numpy()[0]) == N * 24
    assert env.cfg.sim.nconmax >= 24
    # Three rows a contact; dry friction and a limit for each joint.
    assert int(data.nefc.numpy().max()) == 24 * 3 + 12
    assert env.cfg.sim.njmax >= 24 * 3 + 12 + 12
