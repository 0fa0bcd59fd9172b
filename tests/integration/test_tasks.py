"""The registered tasks: known to mjlab, and with the simulator that gains are matched in."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import entry_points
from typing import Any

import mujoco
import numpy as np
import pytest

from synthetic_log import simulate

pytest.importorskip("mjlab")

import torch
from mjlab.entity import EntityArticulationInfoCfg, EntityCfg
from mjlab.envs import ManagerBasedRlEnv
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg, load_runner_cls
from scipy.signal import chirp

from pronk.identify.simulators.command_trace import CommandTrace
from pronk.jump.train.mdp.actions import NAME as ACTION
from pronk.jump.train.mdp.actuators import drive_cfgs
from pronk.jump.train.phases import TASKS
from pronk.jump.train.rl.runner import PronkRunner
from pronk.robots.model import bench_spec
from training_env import MATCHED, ROBOT, config, fresh, nominal

pytestmark = pytest.mark.train
NAMES = {
    "Pronk-Jump-MiniCheetah": "jump",
    "Pronk-Walk-MiniCheetah": "walk",
    "Pronk-Jump-Go2": "jump",
    "Pronk-Walk-Go2": "walk",
}


def test_mjlab_knows_the_tasks_whatever_is_imported_first() -> None:
    """mjlab loads the entry point while it is itself imported: here by a module of pronk."""
    (entry_point,) = entry_points(group="mjlab.tasks", name="pronk")
    assert entry_point.value == "pronk.jump.train.tasks"
    code = (
        "from pronk import garbage\n"
        "garbage.collect_less_often()\n"
        "import pronk.jump.train.mdp.commands, pronk.jump.train.tasks\n"
        "from mjlab.tasks.registry import list_tasks\n"
        "print(*list_tasks())\n"
        "garbage.end_without_collection()"
    )
    process = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"MJLAB_WARP_QUIET": "1"},
    )
    assert "Failed to load task package" not in process.stderr
    assert set(NAMES) <= set(process.stdout.split())


@pytest.mark.parametrize("name", NAMES)
def test_a_task_has_its_phases_and_a_nominal_robot_to_play_with(name: str) -> None:
    cfg = load_env_cfg(name)
    learning = load_rl_cfg(name)
    iterations = TASKS[NAMES[name]]
    params = cfg.curriculum["phases"].params
    for phase, count in iterations.items():
        assert params[phase] == count
    assert learning.max_iterations == sum(iterations.values())
    assert params["steps_per_iteration"] == learning.num_steps_per_env
    assert load_runner_cls(name) is PronkRunner
    assert cfg.decimation == ROBOT.decimation
    assert cfg.sim.mujoco.timestep == ROBOT.timestep_s
    assert cfg.sim.mujoco.integrator == "implicitfast"
    play = load_env_cfg(name, play=True)
    assert play.scene.num_envs == 1
    assert set(play.events) == {"reset"}
    assert play.curriculum == {}
    assert "time_out" not in play.terminations


def test_there_is_room_for_all_contacts() -> None:
    """A robot pressed into the floor touches it with all its geoms."""
    env = fresh(nominal(), scripted=True)
    env.sim.data.qpos[:, 2] = -0.03
    env.sim.data.qpos[:, 3:7] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    env.sim.forward()
    data = env.sim.wp_data
    # Four feet, two ends of eight capsules, four corners of the trunk.
    assert int(data.nacon.numpy()[0]) == env.num_envs * 24 <= env.num_envs * env.cfg.sim.nconmax
    # Three rows a contact; dry friction and a limit for each joint.
    assert int(data.nefc.numpy().max()) == 24 * 3 + 12 <= env.cfg.sim.njmax - 12


def at_rest(joint: str) -> dict[str, float]:
    """Return where gravity leaves the chain of a joint whose drives hold the default pose."""
    model = bench_spec(ROBOT, joint).compile()
    data = mujoco.MjData(model)
    chain = ROBOT.joint(joint).chain
    target = np.zeros(len(chain))
    stiffness = np.zeros(len(chain))
    for i, name in enumerate(chain):
        chain_joint = ROBOT.joint(name)
        target[i] = chain_joint.default_position
        stiffness[i] = MATCHED.groups[chain_joint.group].stiffness
    data.qpos[:] = target
    for _ in range(10):
        mujoco.mj_forward(model, data)
        data.qpos[:] = target - data.qfrc_bias / stiffness
    return dict(zip(chain, data.qpos, strict=True))


def on_the_bench(joint: str, delay: int) -> Any:
    """Return the training environment with one joint's chain on a fixed base, without the robot."""

    def passive() -> mujoco.MjSpec:
        spec = bench_spec(ROBOT, joint)
        for element in (*spec.actuators, *spec.keys):
            spec.delete(element)
        # The scene has options of its own.
        spec.option.timestep = 0.002
        spec.option.disableflags = 0
        return spec

    chain = ROBOT.joint(joint).chain
    drives = []
    for drive in drive_cfgs(ROBOT, MATCHED):
        names = tuple(name for name in drive.target_names_expr if name in chain)
        if names:
            drives.append(replace(drive, target_names_expr=names))
    cfg = config(1, MATCHED)
    cfg.scene.entities["robot"] = EntityCfg(
        spec_fn=passive,
        init_state=EntityCfg.InitialStateCfg(
            joint_pos={name: ROBOT.joint(name).default_position for name in chain},
            joint_vel={".*": 0.0},
        ),
        articulation=EntityArticulationInfoCfg(actuators=tuple(drives)),
    )
    cfg.scene.sensors = ()
    cfg.observations = {}
    cfg.commands = {}
    cfg.events = {}
    cfg.rewards = {}
    cfg.terminations = {}
    cfg.curriculum = {}
    action = cfg.actions[ACTION]
    action.actuator_names = (".*",)
    action.scale = 1.0
    action.delay_steps = (delay, delay)
    cfg.viewer.body_name = "trunk"
    return ManagerBasedRlEnv(cfg, device="cpu")


@pytest.mark.slow
@pytest.mark.parametrize(("joint", "delay"), [("FR_hip_roll", 0), ("FR_knee", 6)])
def test_the_training_simulator_responds_like_the_matched_one(joint: str, delay: int) -> None:
    """The same chirp at policy rate; a delay of the action is that delay of the command."""
    ticks = np.arange(150) / ROBOT.policy_rate_hz
    offset = 0.25 * chirp(ticks, 0.1, ticks[-1], 15.0, phi=-90)
    steps = np.repeat(offset, ROBOT.decimation)
    trace = CommandTrace(
        joint=joint,
        start=0.0,
        timestep=ROBOT.timestep_s,
        command=ROBOT.joint(joint).default_position
        + np.concatenate([np.zeros(delay), steps[: len(steps) - delay]]),
        pose=np.array([robot_joint.default_position for robot_joint in ROBOT.joints]),
    )
    joints = []
    for robot_joint in ROBOT.joints:
        group = MATCHED.groups[robot_joint.group]
        joints.append(replace(robot_joint, stiffness=group.stiffness, damping=group.damping))
    robot = replace(ROBOT, joints=tuple(joints))
    gains = MATCHED.groups[ROBOT.joint(joint).group]
    ticks_only = slice(None, None, ROBOT.decimation)
    expected = simulate(robot, trace, gains.stiffness, gains.damping)[0, ticks_only]
    softer = simulate(robot, trace, gains.stiffness - 0.1, gains.damping)[0, ticks_only]
    env = on_the_bench(joint, delay)
    env.reset()
    entity = env.scene["robot"]
    angles = at_rest(joint)
    start = torch.tensor([[angles[name] for name in entity.joint_names]], dtype=torch.float32)
    entity.write_joint_state_to_sim(start, torch.zeros_like(start))
    excited = entity.joint_names.index(joint)
    response = []
    action = torch.zeros_like(start)
    for value in offset:
        response.append(float(entity.data.joint_pos[0, excited]))
        action[0, excited] = float(value)
        env.step(action)
    assert np.ptp(expected) > 0.3
    np.testing.assert_allclose(response, expected, atol=2e-5)
    assert np.abs(softer - expected).max() > 2e-4
