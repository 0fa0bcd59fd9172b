"""The Go2's training task: its proportions, and the guided jump that it begins with."""

from __future__ import annotations

from functools import cache
from typing import Any

import mujoco
import numpy as np
import pytest

pytest.importorskip("mjlab")

import torch
from mjlab.envs import ManagerBasedRlEnv

from pronk.identify.match.gains import GroupGains
from pronk.jump.train.gains import TrainingGains, training_gains
from pronk.jump.train.mdp.commands import motion_command
from pronk.jump.train.mdp.guidance import foot_sweep, leg_angles
from pronk.jump.train.mdp.motion import standing_leg
from pronk.jump.train.phases import PHASES, curriculum
from pronk.jump.train.tasks import load_task
from pronk.jump.train.tasks.jump_env_cfg import without_randomization
from pronk.jump.train.tasks.robot_scale import RobotScale, robot_scale
from pronk.robots.legged import legged
from pronk.robots.model import free_spec
from pronk.robots.robot import RobotSpec

pytestmark = pytest.mark.train
N = 8
TASK = load_task("go2")
ROBOT = TASK.robot
BODY = legged("go2")


def go2_cfg(gains: TrainingGains) -> Any:
    """Return the configuration of `N` robots."""
    return TASK.env_cfg(ROBOT, gains, iterations=dict.fromkeys(PHASES, 10**9), num_envs=N)


@cache
def nominal() -> Any:
    """Return `N` nominal robots without noise."""
    cfg = go2_cfg(training_gains("naive", ROBOT))
    without_randomization(cfg)
    torch.set_num_threads(1)
    return ManagerBasedRlEnv(cfg, device="cpu")


def knee_torque(robot: RobotSpec) -> float:
    """Return the torque of the first knee, of four that carry the robot in its default pose."""
    model = free_spec(robot).compile()
    data = mujoco.MjData(model)
    data.qpos[7:] = [joint.default_position for joint in robot.joints]
    mujoco.mj_forward(model, data)
    leg = robot.legs[0]
    jacobian = np.zeros((3, model.nv))
    mujoco.mj_jacSite(model, data, jacobian, None, model.site(f"{leg}_foot").id)
    knee = model.joint(f"{leg}_knee").dofadr[0]
    return abs(float(jacobian[2, knee])) * 9.81 * float(model.body_mass.sum()) / 4.0


def test_numbers_of_the_mini_cheetah_are_its_own() -> None:
    """A ratio of exactly 1: the numbers in the table are those of its training, to the last bit."""
    assert robot_scale(legged("mini_cheetah")) == RobotScale(length=1.0, torque=1.0)


def test_terms_are_in_proportion_to_the_robot() -> None:
    scale = robot_scale(BODY)
    cheetah = load_task("mini_cheetah").robot
    assert scale.length == pytest.approx(0.28837 / 0.29897, abs=1e-3)
    assert scale.torque == pytest.approx(knee_torque(ROBOT) / knee_torque(cheetah), rel=0.01)
    rewards = go2_cfg(training_gains("naive", ROBOT)).rewards
    assert rewards["torque"].weight == pytest.approx(-0.0004 / scale.torque**2)
    # As large a crouch beside the standing height loses as much.
    assert rewards["crouch"].weight * scale.length**2 == pytest.approx(-500.0)
    assert rewards["landing"].params["height"] < BODY.standing_height


def test_countermovement_of_the_go2_is_within_reach() -> None:
    """Feet below the hips, knees within their range, from a crouch that clears the ground."""
    settings = motion_command(nominal()).cfg.settings
    since = torch.linspace(0.0, settings.prompt_s, 200, dtype=torch.float64)
    length = standing_leg(BODY) + settings.countermovement(since)
    pitch, knee = leg_angles(BODY, "FR", length)
    assert pitch[0].item() == pytest.approx(BODY.default_position["hip_pitch"], abs=1e-3)
    assert knee[0].item() == pytest.approx(BODY.default_position["knee"], abs=1e-3)
    foot = BODY.thigh_length * pitch.sin() + BODY.shank_length * (pitch + knee).sin()
    assert foot.abs().max().item() < 1e-6
    low, high = ROBOT.joint("FR_knee").range
    assert low + 0.1 < knee.min().item() < knee.max().item() < high - 0.1
    assert length.min().item() + BODY.foot_radius >= settings.crouch
    # The speed of the knees stays below that without load.
    rate = knee.diff() / since.diff()
    assert rate.abs().max().item() < ROBOT.joint("FR_knee").drive.no_load_speed
    # Swept feet move backwards: the axes of the Go2's hips are those of the Mini Cheetah reversed.
    turn = foot_sweep(BODY, settings, 0.02)[:, 1]
    assert turn[0] < 0.0 < turn[-2]


def test_a_guided_jump_leaves_the_ground() -> None:
    """Actions of zero with the guidance of the first jump phase: upwards at 1 m/s and more."""
    env = nominal()
    command = motion_command(env)
    command.scripted = True
    env.reset(seed=0)
    curriculum(env).apply(env, PHASES["jump_a"], 0.0)
    command.velocity.zero_()
    command.jump.zero_()
    liftoff = torch.zeros(N)
    highest = torch.zeros(N)
    for step in range(60):
        command.jump[:] = 20 <= step < 40
        env.step(torch.zeros(N, 12))
        motion = command.motion
        if step >= 20:
            jumps = command.state.first_liftoff > 0.0
            speed = motion.trunk.velocity_world[:, 2]
            liftoff = torch.where(jumps, torch.maximum(liftoff, speed), liftoff)
            highest = torch.maximum(highest, motion.trunk.height)
    assert (liftoff > 1.0).all()
    assert (highest > BODY.standing_height + 0.1).all()


def test_there_is_room_for_all_contacts_of_the_go2() -> None:
    """A robot pressed into the floor touches it with all its geoms."""
    env = nominal()
    motion_command(env).scripted = True
    env.reset(seed=0)
    env.sim.data.qpos[:, 2] = -0.03
    env.sim.data.qpos[:, 3:7] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    env.sim.forward()
    data = env.sim.wp_data
    assert int(data.nacon.numpy()[0]) == N * 24 <= N * env.cfg.sim.nconmax
    assert int(data.nefc.numpy().max()) == 24 * 3 + 12 <= env.cfg.sim.njmax - 12


def test_drives_of_the_go2_have_their_flat_torque_and_corner() -> None:
    """Full torque up to 5.54 rad/s, none at 15.7: the line begins above the effort limit."""
    groups = {}
    for group in ROBOT.groups:
        groups[group] = GroupGains(
            stiffness=21.0, damping=0.6, stiffness_range=1.0, damping_range=0.1
        )
    gains = TrainingGains(name="matched", robot="go2", groups=groups, delay_s=0.004)
    knee = go2_cfg(gains).scene.entities["robot"].articulation.actuators[2]
    assert knee.target_names_expr == ("FR_knee", "FL_knee", "RR_knee", "RL_knee")
    assert (knee.stiffness, knee.damping) == (21.0, 0.6)
    corner = knee.velocity_limit * (1.0 - knee.effort_limit / knee.saturation_effort)
    assert corner == pytest.approx(5.54, abs=0.01)
    assert knee.velocity_limit == pytest.approx(15.70, abs=1e-3)
    assert knee.effort_limit == pytest.approx(45.43)
