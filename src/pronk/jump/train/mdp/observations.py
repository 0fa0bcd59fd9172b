"""Observations: the measured vector, the jump input, and the state that only training has.

The measured vector is laid out in `pronk.policy.observation`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pronk.jump.train.mdp.actions import joint_position_action
from pronk.jump.train.mdp.commands import motion_command

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

RANDOMIZED = {
    "voltage": 1,
    "no_load": 1,
    "drop": 1,
    "friction": 1,
    "base_mass": 1,
    "delay": 1,
    "shank_length": 4,
    "stiffness": 12,
    "damping": 12,
}
"""Parameters that are drawn for each robot and their sizes, see `randomized_parameters`."""
CRITIC = {
    "angular_velocity": 3,
    "projected_gravity": 3,
    "command": 3,
    "time_left": 1,
    "joint_position": 12,
    "joint_velocity": 12,
    "action": 12,
    "linear_velocity": 3,
    "height": 1,
    "foot_contact": 4,
    "foot_force": 4,
    "foot_height": 4,
    **RANDOMIZED,
}
"""Parts of the critic's vector, in order, and their sizes. With the randomized parameters of the
robot and the time that its velocity command lasts, they explain differences between returns."""
CRITIC_JUMP = {
    "jump": 1,
    "mode": 1,
    "since": 1,
    "airborne": 1,
    "best_score": 1,
    "travel": 1,
    "reward_scale": 1,
    "overspeed": 1,
    "flight": 1,
    "best_flight": 1,
    "jumper": 1,
    "jump_left": 1,
}
"""Parts of the critic's jump vector; zeros as long as no robot gets a jump input. Jump commands
come at random and earn more than seconds of walking: without knowing whether and when one comes,
most of the difference between two returns would hide the effect of an action."""


def angular_velocity(env: ManagerBasedRlEnv) -> Tensor:
    """Return the trunk's angular velocity in its frame [rad/s]. (N, 3)."""
    return env.sim.data.qvel[:, 3:6]


def gravity_direction(env: ManagerBasedRlEnv) -> Tensor:
    """Return the direction of gravity in the trunk's frame. (N, 3)."""
    return -_trunk_axes(env)[:, 2]


def joint_position(env: ManagerBasedRlEnv) -> Tensor:
    """Return the joint angles relative to the default pose [rad]. (N, 12)."""
    return env.sim.data.qpos[:, 7:] - motion_command(env).default_position


def joint_velocity(env: ManagerBasedRlEnv) -> Tensor:
    """Return the joint speeds [rad/s]. (N, 12)."""
    return env.sim.data.qvel[:, 6:]


def measured_joint_position(env: ManagerBasedRlEnv) -> Tensor:
    """Return the joint angles as encoders on the rotors measure them, likewise. (N, 12)."""
    return joint_position(env) + joint_position_action(env).finish_step().offset


def measured_joint_velocity(env: ManagerBasedRlEnv) -> Tensor:
    """Return the joint speeds as encoders on the rotors measure them [rad/s]. (N, 12)."""
    return joint_velocity(env) + joint_position_action(env).finish_step().speed


def last_action(env: ManagerBasedRlEnv) -> Tensor:
    """Return the network's last actions. (N, 12)."""
    return env.action_manager.action


def velocity_command(env: ManagerBasedRlEnv) -> Tensor:
    """Return the command: forward, left [m/s], yaw rate [rad/s]. (N, 3)."""
    return motion_command(env).velocity


def jump_input(env: ManagerBasedRlEnv) -> Tensor:
    """Return the jump input, 0 or 1. (N, 1)."""
    return motion_command(env).jump.float()[:, None]


def estimator_target(env: ManagerBasedRlEnv) -> Tensor:
    """Return contacts (0 or 1), then the velocity in the trunk's frame [m/s]. (N, 7)."""
    contact = env.scene["feet"].data.found > 0
    return torch.cat([contact.float(), _linear_velocity(env)], dim=-1)


def critic_state(env: ManagerBasedRlEnv) -> Tensor:
    """Return the parts of `CRITIC`. (N, 96)."""
    ground = env.scene["feet"].data
    command = motion_command(env)
    weight = 9.81 * command.body.total_mass
    return torch.cat(
        [
            angular_velocity(env),
            gravity_direction(env),
            velocity_command(env),
            command.time_left[:, None],
            joint_position(env),
            joint_velocity(env),
            last_action(env),
            _linear_velocity(env),
            env.sim.data.qpos[:, 2:3],
            (ground.found > 0).float(),
            torch.linalg.vector_norm(ground.force, dim=-1) / weight,
            env.sim.data.site_xpos[:, command.feet, 2],
            *randomized_parameters(env),
        ],
        dim=-1,
    )


def randomized_parameters(env: ManagerBasedRlEnv) -> list[Tensor]:
    """Return the parts of `RANDOMIZED`, in order, (N, size) each.

    Voltages over the rated one, `drop` in 1/kW, mass in kg, delay in physics steps, foot to knee
    axis in m, stiffness and damping by joint group and leg.
    """
    model = env.sim.model
    action = joint_position_action(env)
    battery = action.battery
    robot = env.scene["robot"]
    feet = motion_command(env).foot_geoms
    parts = [
        battery.voltage,
        battery.no_load,
        1e3 * battery.drop,
        model.geom_friction[:, feet[:1], 0],
        model.body_mass[:, robot.indexing.body_ids[:1]],
        action.lag,
        -model.geom_pos[:, feet, 2],
    ]
    for drive in robot.actuators:
        parts.append(drive.stiffness)
    for drive in robot.actuators:
        parts.append(drive.damping)
    # A field that is not drawn is stored once for all robots.
    return [part.expand(env.num_envs, -1) for part in parts]


def critic_jump_state(env: ManagerBasedRlEnv) -> Tensor:
    """Return the parts of `CRITIC_JUMP`. (N, 12)."""
    command = motion_command(env)
    if not (command.cfg.jump_fraction > 0.0 or command.scripted):
        return env.sim.data.qpos.new_zeros(env.num_envs, len(CRITIC_JUMP))
    state = command.state
    parts = [
        command.jump,
        state.mode,
        state.since,
        state.airborne,
        state.best_score,
        state.travel,
        state.reward_scale,
        state.overspeed,
        state.flight,
        state.best_flight,
        command.jumper,
        command.jump_left,
    ]
    return torch.stack([part.float() for part in parts], dim=-1)


def _linear_velocity(env: ManagerBasedRlEnv) -> Tensor:
    """Return the trunk's velocity in its frame [m/s]. (N, 3)."""
    # Not a matrix product: those are rounded to ten bits where TF32 is allowed.
    return (env.sim.data.qvel[:, :3, None] * _trunk_axes(env)).sum(dim=1)


def _trunk_axes(env: ManagerBasedRlEnv) -> Tensor:
    """Return the trunk's x, y, z axes in the world's frame, as columns. (N, 3, 3)."""
    axes: Tensor = env.sim.data.xmat[:, env.scene["robot"].indexing.root_body_id]
    return axes
