"""Reward terms: functions of the environment, (N,) each; `pronk.train.reward_weights` has weights.

A penalty's term is positive and its weight negative. Most terms are rates; an event earns its
weight once, however long its step took. A term with `jump_scale` is multiplied by it in jump mode
(see `pronk.train.mdp.jump`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pronk.train.mdp.commands import MotionCommand, motion_command

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv as Env


def _command(env: Env) -> MotionCommand:
    """The command term, after the motion and the jumps of this step were measured."""
    command = motion_command(env)
    _ = command.motion
    return command


# --- The paper's table ---------------------------------------------------------------------------


def tracking_linear(env: Env, variance: float) -> Tensor:
    """exp(-|e|^2 / variance), e the error of the horizontal velocity [m/s] (A3)."""
    command = _command(env)
    error = command.target - command.motion.velocity_heading
    return torch.exp(error.square().sum(dim=-1) / -variance)


def tracking_angular(env: Env, variance: float) -> Tensor:
    """exp(-e^2 / variance), e the error of the yaw rate [rad/s] (A3)."""
    command = _command(env)
    error = command.velocity[:, 2] - command.motion.angular_velocity[:, 2]
    return torch.exp(error.square() / -variance)


def posture(env: Env, standing: float, jump_scale: float) -> Tensor:
    """|q - q_default|^2 [rad^2] ("action magnitude"), `standing` times as much at zero command."""
    command = _command(env)
    away = (command.motion.position - command.default_position).square().sum(dim=-1)
    return away * torch.where(command.standing, standing, 1.0) * command.in_jump_mode(jump_scale)


def vertical_velocity(env: Env, jump_scale: float) -> Tensor:
    """v_z^2 of the trunk [m^2/s^2]."""
    command = _command(env)
    return command.motion.velocity_world[:, 2].square() * command.in_jump_mode(jump_scale)


def smoothness(env: Env, jump_scale: float) -> Tensor:
    """|tau_t - tau_(t-1)|^2 [N^2 m^2]."""
    command = _command(env)
    return command.motion.torque_change.square().sum(dim=-1) * command.in_jump_mode(jump_scale)


def orientation(env: Env, jump_scale: float) -> Tensor:
    """|g_xy|^2 of the unit vector of gravity in the trunk's frame (A2)."""
    command = _command(env)
    return command.motion.gravity[:, :2].square().sum(dim=-1) * command.in_jump_mode(jump_scale)


def collision(env: Env, jump_scale: float) -> Tensor:
    """Number of parts other than feet on the ground (A7)."""
    command = _command(env)
    return command.motion.non_foot_contacts * command.in_jump_mode(jump_scale)


def torque_limits(env: Env, jump_scale: float) -> Tensor:
    """Sum of relu(|tau| - tau_max) [N m], tau the PD law's torque before the drive clips (A7).

    The PD law has the nominal gains.
    """
    command = _command(env)
    motion = command.motion
    torque = command.stiffness * (command.position_target - motion.position)
    torque = torch.addcmul(torque, command.damping, motion.velocity, value=-1.0)
    excess = (torque.abs() - command.effort_limit).clamp_min(0.0).sum(dim=-1)
    return excess * command.in_jump_mode(jump_scale)


def position_limits(env: Env) -> Tensor:
    """Sum of relu(q_low - q) + relu(q - q_high) [rad] (A7): how far q is outside its limits."""
    command = _command(env)
    low, high = command.position_limits.unbind(dim=-1)
    position = command.motion.position
    return (position - position.clamp(low, high)).abs().sum(dim=-1)


def foot_acceleration(env: Env) -> Tensor:
    """|v_feet,t - v_feet,(t-1)| over all feet together [m/s]."""
    change = _command(env).motion.foot_velocity_change
    return torch.linalg.vector_norm(change.flatten(1), dim=-1)


def foot_clearance(env: Env, height: float, jump_scale: float) -> Tensor:
    """Sum of (height - z)^2 |v_xy|^(1/2) over the feet [m^2 (m/s)^(1/2)] (A7; Ji 2022)."""
    command = _command(env)
    motion = command.motion
    speed = torch.linalg.vector_norm(motion.foot_velocity[..., :2], dim=-1)
    below = ((height - motion.foot_height).square() * speed.sqrt()).sum(dim=-1)
    return below * command.in_jump_mode(jump_scale)


def termination(env: Env, jump_scale: float) -> Tensor:
    """1 for a fall; an event."""
    fell = env.termination_manager.terminated / env.step_dt
    return fell * _command(env).in_jump_mode(jump_scale)


def torque(env: Env, jump_scale: float) -> Tensor:
    """|tau|^2 [N^2 m^2]."""
    command = _command(env)
    return command.motion.torque.square().sum(dim=-1) * command.in_jump_mode(jump_scale)


# --- The paper's jump rewards (Table II) ---------------------------------------------------------


def dense_jump(env: Env) -> Tensor:
    """Standard deviation of the force over the four feet, in jump mode [N] (A5)."""
    command = _command(env)
    return command.motion.force.std(dim=-1, unbiased=False) * command.state.mode


def sparse_jump(env: Env) -> Tensor:
    """Improvement of the lift-off score within this command, see `JumpState` (A6); an event."""
    return _command(env).state.score_gain / env.step_dt


# --- Not in the paper ----------------------------------------------------------------------------


def jump_height(env: Env) -> Tensor:
    """Increase of the jump's height within this command [m]; an event."""
    return _command(env).state.travel_gain / env.step_dt


def flight_distance(env: Env) -> Tensor:
    """Increase of the ground covered in flight within this command [m]; an event."""
    return _command(env).state.flight_gain / env.step_dt


def clearance_gap(env: Env) -> Tensor:
    """Increase of the gap cleared by all feet within this command [m]; an event."""
    return _command(env).state.gap_gain / env.step_dt


def countermovement(env: Env) -> Tensor:
    """Similarity of the legs' lengths to a countermovement's, 0 to 1, up to the first lift-off."""
    return _command(env).state.similarity


def hop(env: Env) -> Tensor:
    """1 for a lift-off after the first of one command; an event."""
    return _command(env).state.hop / env.step_dt


def action_rate(env: Env, jump_scale: float) -> Tensor:
    """|a_t - a_(t-1)|^2 of the network's actions."""
    change = env.action_manager.action - env.action_manager.prev_action
    return change.square().sum(dim=-1) * _command(env).in_jump_mode(jump_scale)


def roll_pitch_rate(env: Env) -> Tensor:
    """|omega_xy|^2 of the trunk [rad^2/s^2]."""
    return _command(env).motion.angular_velocity[:, :2].square().sum(dim=-1)


def slip(env: Env, jump_scale: float) -> Tensor:
    """Sum of |v_xy|^2 of the feet on the ground [m^2/s^2]."""
    command = _command(env)
    motion = command.motion
    sliding = (motion.foot_velocity[..., :2].square().sum(dim=-1) * motion.contact).sum(dim=-1)
    return sliding * command.in_jump_mode(jump_scale)


def trunk_height(env: Env, above: float, jump_scale: float) -> Tensor:
    """relu(z - z_standing - above)^2 of the trunk [m^2]."""
    command = _command(env)
    height = command.motion.height - (command.body.standing_height + above)
    return height.clamp_min(0.0).square() * command.in_jump_mode(jump_scale)


def crouch(env: Env, below: float, jump_scale: float) -> Tensor:
    """relu(z_standing - below - z)^2 of the trunk [m^2]."""
    command = _command(env)
    depth = (command.body.standing_height - below) - command.motion.height
    return depth.clamp_min(0.0).square() * command.in_jump_mode(jump_scale)


def knees(env: Env, height: float, jump_scale: float) -> Tensor:
    """Sum of relu(1 - z / height) over the axes of the knees."""
    command = _command(env)
    low = (1.0 - command.motion.knee_height / height).clamp_min(0.0).sum(dim=-1)
    return low * command.in_jump_mode(jump_scale)


def landing(env: Env, height: float) -> Tensor:
    """relu(height - z) of the trunk on the ground after a jump, in jump mode [m]."""
    command = _command(env)
    state = command.state
    landed = (state.liftoffs > 0.0) & ~state.airborne & state.mode
    return (height - command.motion.height).clamp_min(0.0) * landed


def stray_foot(env: Env) -> Tensor:
    """Lowest foot below the mean of the four as a jump comes down, in jump mode [m]."""
    command = _command(env)
    feet, state = command.motion.foot_height, command.state
    below = feet.mean(dim=-1) - feet.amin(dim=-1)
    falls = command.motion.velocity_world[:, 2] < 0.0
    return below * (state.airborne & state.mode & falls)
