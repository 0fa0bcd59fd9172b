"""Reward terms: functions of the environment, (N,) each; `tasks.reward_weights` has their weights.

A penalty's term is positive and its weight negative. Most terms are rates; an event earns its
weight once, however long its step took. `jump_scale` is the factor of a term in jump mode (see
`pronk.jump.train.mdp.jump`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from pronk.jump.train.mdp import liftoff
from pronk.jump.train.mdp.commands import MotionCommand, motion_command

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv as Env

Scale = float | Tensor
"""A factor in jump mode; a tensor, (), where rewards are compiled and phases change it."""


def _measured(env: Env) -> MotionCommand:
    """Return the command term, after motion and jumps of this step were measured."""
    command = motion_command(env)
    _ = command.motion
    return command


# --- The paper's table ---------------------------------------------------------------------------


def tracking_linear(env: Env, variance: float, jump_scale: Scale = 1.0) -> Tensor:
    """exp(-|e|^2 / variance), e the error of the horizontal velocity [m/s] (A3)."""
    command = _measured(env)
    error = command.target - command.motion.trunk.velocity_heading
    kernel = torch.exp(error.square().sum(dim=-1) / -variance)
    return command.scaled_in_jump_mode(kernel, jump_scale)


def tracking_angular(env: Env, variance: float, jump_scale: Scale = 1.0) -> Tensor:
    """exp(-e^2 / variance), e the error of the yaw rate [rad/s] (A3)."""
    command = _measured(env)
    error = command.velocity[:, 2] - command.motion.trunk.angular_velocity[:, 2]
    kernel = torch.exp(error.square() / -variance)
    return command.scaled_in_jump_mode(kernel, jump_scale)


def posture(env: Env, standing: float, jump_scale: Scale = 1.0) -> Tensor:
    """|q - q_default|^2 [rad^2] ("action magnitude"), `standing` times as much at zero command."""
    command = _measured(env)
    offset = command.motion.joints.position - command.default_position
    square = offset.square().sum(dim=-1) * torch.where(command.standing, standing, 1.0)
    return command.scaled_in_jump_mode(square, jump_scale)


def vertical_velocity(env: Env, jump_scale: Scale = 1.0) -> Tensor:
    """v_z^2 of the trunk [m^2/s^2]."""
    command = _measured(env)
    square = command.motion.trunk.velocity_world[:, 2].square()
    return command.scaled_in_jump_mode(square, jump_scale)


def smoothness(env: Env, jump_scale: Scale = 1.0) -> Tensor:
    """|tau_t - tau_(t-1)|^2 [N^2 m^2]."""
    command = _measured(env)
    square = command.motion.joints.torque_change.square().sum(dim=-1)
    return command.scaled_in_jump_mode(square, jump_scale)


def orientation(env: Env, jump_scale: Scale = 1.0) -> Tensor:
    """|g_xy|^2 of the unit vector of gravity in the trunk's frame (A2)."""
    command = _measured(env)
    square = command.motion.trunk.gravity[:, :2].square().sum(dim=-1)
    return command.scaled_in_jump_mode(square, jump_scale)


def collision(env: Env, jump_scale: Scale = 1.0) -> Tensor:
    """Number of parts other than feet on the ground (A7)."""
    command = _measured(env)
    return command.scaled_in_jump_mode(command.motion.non_foot_contacts, jump_scale)


def torque_over_limits(env: Env, jump_scale: Scale = 1.0) -> Tensor:
    """Sum of relu(|tau| - tau_max) [N m], tau the PD law's torque before the drive clips (A7).

    The PD law has the nominal gains.
    """
    command = _measured(env)
    joints = command.motion.joints
    torque = command.stiffness * (command.position_target - joints.position)
    torque = torch.addcmul(torque, command.damping, joints.velocity, value=-1.0)
    excess = (torque.abs() - command.effort_limit).clamp_min(0.0).sum(dim=-1)
    return command.scaled_in_jump_mode(excess, jump_scale)


def position_over_limits(env: Env, jump_scale: Scale = 1.0) -> Tensor:
    """Sum of relu(q_low - q) + relu(q - q_high) [rad] (A7): how far q is outside its limits."""
    command = _measured(env)
    low, high = command.position_limits.unbind(dim=-1)
    position = command.motion.joints.position
    excess = (position - position.clamp(low, high)).abs().sum(dim=-1)
    return command.scaled_in_jump_mode(excess, jump_scale)


def foot_acceleration(env: Env, jump_scale: Scale = 1.0) -> Tensor:
    """|v_feet,t - v_feet,(t-1)| over all feet together [m/s]."""
    command = _measured(env)
    change = command.motion.legs.foot_velocity_change
    norm = torch.linalg.vector_norm(change.flatten(1), dim=-1)
    return command.scaled_in_jump_mode(norm, jump_scale)


def foot_clearance(env: Env, height: float, jump_scale: Scale = 1.0) -> Tensor:
    """Sum of (height - z)^2 |v_xy|^(1/2) over the feet [m^2 (m/s)^(1/2)] (A7; Ji 2022)."""
    command = _measured(env)
    legs = command.motion.legs
    speed = torch.linalg.vector_norm(legs.foot_velocity[..., :2], dim=-1)
    clearance = ((height - legs.foot_height).square() * speed.sqrt()).sum(dim=-1)
    return command.scaled_in_jump_mode(clearance, jump_scale)


def fall(env: Env, jump_scale: Scale = 1.0) -> Tensor:
    """1 for a fall; an event."""
    command = _measured(env)
    fell = env.termination_manager.terminated / command.step_s
    return command.scaled_in_jump_mode(fell, jump_scale)


def joint_torque(env: Env, jump_scale: Scale = 1.0) -> Tensor:
    """|tau|^2 [N^2 m^2]."""
    command = _measured(env)
    square = command.motion.joints.torque.square().sum(dim=-1)
    return command.scaled_in_jump_mode(square, jump_scale)


# --- The paper's jump rewards (Table II) ---------------------------------------------------------


def dense_jump(env: Env, jump_scale: Scale = 1.0) -> Tensor:
    """Standard deviation of the force over the four feet, in jump mode [N] (A5)."""
    command = _measured(env)
    deviation = command.motion.legs.force.std(dim=-1, unbiased=False) * command.state.mode
    return command.scaled_in_jump_mode(deviation, jump_scale)


def sparse_jump(env: Env) -> Tensor:
    """Increase of the best score of a lift-off (A6); an event."""
    command = _measured(env)
    return command.state.score_gain / command.step_s


# --- Not in the paper ----------------------------------------------------------------------------


def jump_height(env: Env) -> Tensor:
    """Increase of the trunk's travel from the lowest to the highest point [m]; an event."""
    command = _measured(env)
    return command.scaled_backwards(command.state.travel_gain) / command.step_s


def flight_distance(env: Env) -> Tensor:
    """Increase of the ground that the best flight has covered [m]; an event."""
    command = _measured(env)
    gain = command.scaled_sideways(command.scaled_backwards(command.state.flight_gain))
    return gain / command.step_s


def clearance_gap(env: Env) -> Tensor:
    """Increase of the widest gap that a flight has cleared [m]; an event."""
    command = _measured(env)
    gain = command.scaled_sideways(command.scaled_backwards(command.state.gap_gain))
    return gain / command.step_s


def hop(env: Env) -> Tensor:
    """1 for a lift-off after the first of a command; an event."""
    command = _measured(env)
    return command.state.hop / command.step_s


def countermovement(env: Env, jump_scale: Scale = 1.0) -> Tensor:
    """Similarity of the legs' lengths to a countermovement's, 0 to 1, up to the first lift-off."""
    command = _measured(env)
    return command.scaled_in_jump_mode(command.state.similarity, jump_scale)


def action_rate(env: Env, jump_scale: Scale = 1.0) -> Tensor:
    """|a_t - a_(t-1)|^2 of the network's actions."""
    command = _measured(env)
    change = env.action_manager.action - env.action_manager.prev_action
    return command.scaled_in_jump_mode(change.square().sum(dim=-1), jump_scale)


def roll_pitch_rate(env: Env, jump_scale: Scale = 1.0) -> Tensor:
    """|omega_xy|^2 of the trunk [rad^2/s^2]."""
    command = _measured(env)
    square = command.motion.trunk.angular_velocity[:, :2].square().sum(dim=-1)
    return command.scaled_in_jump_mode(square, jump_scale)


def slip(env: Env, jump_scale: Scale = 1.0) -> Tensor:
    """Sum of |v_xy|^2 of the feet on the ground [m^2/s^2]."""
    command = _measured(env)
    legs = command.motion.legs
    square = (legs.foot_velocity[..., :2].square().sum(dim=-1) * legs.contact).sum(dim=-1)
    return command.scaled_in_jump_mode(square, jump_scale)


def trunk_height(env: Env, above: float, jump_scale: Scale = 1.0) -> Tensor:
    """relu(z - z_standing - above)^2 of the trunk [m^2]."""
    command = _measured(env)
    height = command.motion.trunk.height - (command.body.standing_height + above)
    return command.scaled_in_jump_mode(height.clamp_min(0.0).square(), jump_scale)


def crouch(env: Env, below: float, jump_scale: Scale = 1.0) -> Tensor:
    """relu(z_standing - below - z)^2 of the trunk [m^2]."""
    command = _measured(env)
    depth = (command.body.standing_height - below) - command.motion.trunk.height
    return command.scaled_in_jump_mode(depth.clamp_min(0.0).square(), jump_scale)


def low_knees(env: Env, height: float, jump_scale: Scale = 1.0) -> Tensor:
    """Sum of relu(1 - z / height) over the axes of the knees."""
    command = _measured(env)
    lowness = (1.0 - command.motion.legs.knee_height / height).clamp_min(0.0).sum(dim=-1)
    return command.scaled_in_jump_mode(lowness, jump_scale)


def low_landing(env: Env, height: float, jump_scale: Scale = 1.0) -> Tensor:
    """relu(height - z) of the trunk on the ground after a jump, in jump mode [m]."""
    command = _measured(env)
    state = command.state
    landed = (state.liftoffs > 0.0) & ~state.airborne & state.mode
    depth = (height - command.motion.trunk.height).clamp_min(0.0) * landed
    return command.scaled_in_jump_mode(depth, jump_scale)


def stray_foot(env: Env, jump_scale: Scale = 1.0) -> Tensor:
    """Lowest foot below the mean of the four as a jump comes down, in jump mode [m]."""
    command = _measured(env)
    state = command.state
    feet = command.motion.legs.foot_height
    below = feet.mean(dim=-1) - feet.amin(dim=-1)
    falls = command.motion.trunk.velocity_world[:, 2] < 0.0
    depth = below * (state.airborne & state.mode & falls)
    return command.scaled_in_jump_mode(depth, jump_scale)


# --- Candidates, which only a recipe has ---------------------------------------------------------


def _liftoff_along(command: MotionCommand) -> Tensor:
    """Return the horizontal velocity along the command, zero without one [m/s]."""
    commanded = command.velocity[:, :2]
    speed = torch.linalg.vector_norm(commanded, dim=-1).clamp_min(1e-6)
    return (command.motion.trunk.velocity_heading * commanded).sum(dim=-1) / speed


def liftoff_angle(env: Env, vertical: float, std: float, forward_speed: float) -> Tensor:
    """Similarity of the first lift-off's direction to the asked-for one, 0 to 1; an event.

    It is asked of commands forwards, fully from `forward_speed` on [m/s]: jumps backwards came to
    fly so fast by it that they fell.
    """
    command = _measured(env)
    state = command.state
    kernel = liftoff.angle_kernel(
        _liftoff_along(command),
        torch.linalg.vector_norm(command.target, dim=-1),
        command.motion.trunk.velocity_world[:, 2],
        vertical,
        std,
    )
    return kernel * state.reward_scale * state.first_liftoff / command.step_s


def height_by_speed(env: Env, full_speed: float, least: float) -> Tensor:
    """As `jump_height`, less of it the faster forwards is commanded [m]; an event."""
    command = _measured(env)
    share = liftoff.speed_share(command.velocity[:, 0], full_speed, least)
    return command.scaled_backwards(command.state.travel_gain) * share / command.step_s
