"""Reward terms: functions of the environment, (N,) each; `tasks.reward_weights` has their weights.

A penalty's term is positive and its weight negative. Most terms are rates; an event earns its
weight once, however long its step took. Terms take `jump_scale`, a factor in jump mode (see
`pronk.jump.train.mdp.jump`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pronk.jump.train.mdp.commands import MotionCommand, motion_command

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv as Env


def _measured(env: Env) -> MotionCommand:
    """The command term, after the motion and the jumps of this step were measured."""
    command = motion_command(env)
    _ = command.motion
    return command


def _term(value: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Make a term of a function of the command term."""

    @wraps(value)
    def term(env: Env, jump_scale: float = 1.0, **params: float) -> Tensor:
        command = _measured(env)
        found = value(command, **params)
        return found if jump_scale == 1.0 else found * command.in_jump_mode(jump_scale)

    return term


def gain(env: Env, of: str) -> Tensor:
    """Increase of a quantity of `JumpState` in this step; an event."""
    found: Tensor = getattr(_measured(env).state, of)
    return found / env.step_dt


# --- The paper's table ---------------------------------------------------------------------------


@_term
def tracking_linear(command: MotionCommand, variance: float) -> Tensor:
    """exp(-|e|^2 / variance), e the error of the horizontal velocity [m/s] (A3)."""
    error = command.target - command.motion.velocity_heading
    return torch.exp(error.square().sum(dim=-1) / -variance)


@_term
def tracking_angular(command: MotionCommand, variance: float) -> Tensor:
    """exp(-e^2 / variance), e the error of the yaw rate [rad/s] (A3)."""
    error = command.velocity[:, 2] - command.motion.angular_velocity[:, 2]
    return torch.exp(error.square() / -variance)


@_term
def posture(command: MotionCommand, standing: float) -> Tensor:
    """|q - q_default|^2 [rad^2] ("action magnitude"), `standing` times as much at zero command."""
    away = (command.motion.position - command.default_position).square().sum(dim=-1)
    return away * torch.where(command.standing, standing, 1.0)


@_term
def vertical_velocity(command: MotionCommand) -> Tensor:
    """v_z^2 of the trunk [m^2/s^2]."""
    return command.motion.velocity_world[:, 2].square()


@_term
def smoothness(command: MotionCommand) -> Tensor:
    """|tau_t - tau_(t-1)|^2 [N^2 m^2]."""
    return command.motion.torque_change.square().sum(dim=-1)


@_term
def orientation(command: MotionCommand) -> Tensor:
    """|g_xy|^2 of the unit vector of gravity in the trunk's frame (A2)."""
    return command.motion.gravity[:, :2].square().sum(dim=-1)


@_term
def collision(command: MotionCommand) -> Tensor:
    """Number of parts other than feet on the ground (A7)."""
    return command.motion.non_foot_contacts


@_term
def torque_limits(command: MotionCommand) -> Tensor:
    """Sum of relu(|tau| - tau_max) [N m], tau the PD law's torque before the drive clips (A7).

    The PD law has the nominal gains.
    """
    motion = command.motion
    torque = command.stiffness * (command.position_target - motion.position)
    torque = torch.addcmul(torque, command.damping, motion.velocity, value=-1.0)
    return (torque.abs() - command.effort_limit).clamp_min(0.0).sum(dim=-1)


@_term
def position_limits(command: MotionCommand) -> Tensor:
    """Sum of relu(q_low - q) + relu(q - q_high) [rad] (A7): how far q is outside its limits."""
    low, high = command.position_limits.unbind(dim=-1)
    position = command.motion.position
    return (position - position.clamp(low, high)).abs().sum(dim=-1)


@_term
def foot_acceleration(command: MotionCommand) -> Tensor:
    """|v_feet,t - v_feet,(t-1)| over all feet together [m/s]."""
    change = command.motion.foot_velocity_change
    return torch.linalg.vector_norm(change.flatten(1), dim=-1)


@_term
def foot_clearance(command: MotionCommand, height: float) -> Tensor:
    """Sum of (height - z)^2 |v_xy|^(1/2) over the feet [m^2 (m/s)^(1/2)] (A7; Ji 2022)."""
    motion = command.motion
    speed = torch.linalg.vector_norm(motion.foot_velocity[..., :2], dim=-1)
    return ((height - motion.foot_height).square() * speed.sqrt()).sum(dim=-1)


def termination(env: Env, jump_scale: float) -> Tensor:
    """1 for a fall; an event."""
    fell = env.termination_manager.terminated / env.step_dt
    return fell * _measured(env).in_jump_mode(jump_scale)


@_term
def torque(command: MotionCommand) -> Tensor:
    """|tau|^2 [N^2 m^2]."""
    return command.motion.torque.square().sum(dim=-1)


# --- The paper's jump rewards (Table II) ---------------------------------------------------------


@_term
def dense_jump(command: MotionCommand) -> Tensor:
    """Standard deviation of the force over the four feet, in jump mode [N] (A5)."""
    return command.motion.force.std(dim=-1, unbiased=False) * command.state.mode


# --- Not in the paper ----------------------------------------------------------------------------


@_term
def countermovement(command: MotionCommand) -> Tensor:
    """Similarity of the legs' lengths to a countermovement's, 0 to 1, up to the first lift-off."""
    return command.state.similarity


def action_rate(env: Env, jump_scale: float) -> Tensor:
    """|a_t - a_(t-1)|^2 of the network's actions."""
    change = env.action_manager.action - env.action_manager.prev_action
    return change.square().sum(dim=-1) * _measured(env).in_jump_mode(jump_scale)


@_term
def roll_pitch_rate(command: MotionCommand) -> Tensor:
    """|omega_xy|^2 of the trunk [rad^2/s^2]."""
    return command.motion.angular_velocity[:, :2].square().sum(dim=-1)


@_term
def slip(command: MotionCommand) -> Tensor:
    """Sum of |v_xy|^2 of the feet on the ground [m^2/s^2]."""
    motion = command.motion
    return (motion.foot_velocity[..., :2].square().sum(dim=-1) * motion.contact).sum(dim=-1)


@_term
def trunk_height(command: MotionCommand, above: float) -> Tensor:
    """relu(z - z_standing - above)^2 of the trunk [m^2]."""
    height = command.motion.height - (command.body.standing_height + above)
    return height.clamp_min(0.0).square()


@_term
def crouch(command: MotionCommand, below: float) -> Tensor:
    """relu(z_standing - below - z)^2 of the trunk [m^2]."""
    depth = (command.body.standing_height - below) - command.motion.height
    return depth.clamp_min(0.0).square()


@_term
def knees(command: MotionCommand, height: float) -> Tensor:
    """Sum of relu(1 - z / height) over the axes of the knees."""
    return (1.0 - command.motion.knee_height / height).clamp_min(0.0).sum(dim=-1)


@_term
def landing(command: MotionCommand, height: float) -> Tensor:
    """relu(height - z) of the trunk on the ground after a jump, in jump mode [m]."""
    state = command.state
    landed = (state.liftoffs > 0.0) & ~state.airborne & state.mode
    return (height - command.motion.height).clamp_min(0.0) * landed


@_term
def stray_foot(command: MotionCommand) -> Tensor:
    """Lowest foot below the mean of the four as a jump comes down, in jump mode [m]."""
    feet, state = command.motion.foot_height, command.state
    below = feet.mean(dim=-1) - feet.amin(dim=-1)
    falls = command.motion.velocity_world[:, 2] < 0.0
    return below * (state.airborne & state.mode & falls)
