"""Reward terms: pure functions of commands and motion, shape (N,) each.

The first group are the terms of the table that the paper's source carries commented out, in its
order, each read as the checklist says (A2 to A7, A23). Signs are in the weights: a penalty gives
the positive quantity. Most terms are rates; an event is worth its weight once, however long its
step took. The weights stand in `pronk.train.mdp.reward_table`.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pronk.train.mdp.commands import MotionCommand

# --- The paper's table ---------------------------------------------------------------------------


def tracking_linear(command: MotionCommand, variance: float) -> Tensor:
    """exp(-|e|^2 / variance), e the error of the horizontal velocity [m/s] (A3)."""
    error = command.target - command.motion.velocity_heading
    return torch.exp(error.square().sum(dim=-1) / -variance)


def tracking_angular(command: MotionCommand, variance: float) -> Tensor:
    """exp(-e^2 / variance), e the error of the yaw rate [rad/s] (A3)."""
    error = command.velocity[:, 2] - command.motion.angular_velocity[:, 2]
    return torch.exp(error.square() / -variance)


def posture(command: MotionCommand, standing: float) -> Tensor:
    """|q - q_default|^2 [rad^2] ("action magnitude"), `standing` times as much at zero command."""
    away = (command.motion.position - command.default_position).square().sum(dim=-1)
    return away * torch.where(command.standing, standing, 1.0)


def vertical_velocity(command: MotionCommand) -> Tensor:
    """v_z^2 of the trunk [m^2/s^2]."""
    return command.motion.velocity_world[:, 2].square()


def smoothness(command: MotionCommand) -> Tensor:
    """|tau_t - tau_(t-1)|^2 [N^2 m^2]."""
    return command.motion.torque_change.square().sum(dim=-1)


def orientation(command: MotionCommand) -> Tensor:
    """|g_xy|^2 of the unit vector of gravity in the trunk's frame (A2)."""
    return command.motion.gravity[:, :2].square().sum(dim=-1)


def collision(command: MotionCommand) -> Tensor:
    """Number of parts other than feet on the ground (A7)."""
    return command.motion.touching


def torque_limits(command: MotionCommand) -> Tensor:
    """Sum of relu(|tau| - tau_max) [N m], tau what the PD asks for before the drive clips (A7).

    The PD's gains are the nominal ones.
    """
    motion = command.motion
    commanded = command.stiffness * (command.position_target - motion.position)
    commanded = torch.addcmul(commanded, command.damping, motion.velocity, value=-1.0)
    return (commanded.abs() - command.effort_limit).clamp_min(0.0).sum(dim=-1)


def position_limits(command: MotionCommand) -> Tensor:
    """Sum of relu(q_low - q) + relu(q - q_high) [rad] (A7): how far outside its limits q is."""
    low, high = command.position_limits.unbind(dim=-1)
    position = command.motion.position
    return (position - position.clamp(low, high)).abs().sum(dim=-1)


def foot_acceleration(command: MotionCommand) -> Tensor:
    """|v_feet,t - v_feet,(t-1)| over all feet together [m/s]."""
    return torch.linalg.vector_norm(command.motion.foot_velocity_change.flatten(1), dim=-1)


def foot_clearance(command: MotionCommand, height: float) -> Tensor:
    """Sum of (height - z)^2 |v_xy|^(1/2) over the feet [m^2 (m/s)^(1/2)] (A7; Ji 2022)."""
    motion = command.motion
    speed = torch.linalg.vector_norm(motion.foot_velocity[..., :2], dim=-1)
    return ((height - motion.foot_height).square() * speed.sqrt()).sum(dim=-1)


def termination(command: MotionCommand) -> Tensor:
    """1 per fall; an event."""
    return command.per_event(command.fell)


def torque(command: MotionCommand) -> Tensor:
    """|tau|^2 [N^2 m^2]."""
    return command.motion.torque.square().sum(dim=-1)


# --- The paper's jump rewards (Table II) ---------------------------------------------------------


def dense_jump(command: MotionCommand) -> Tensor:
    """Standard deviation of the force over the four feet [N] (A5)."""
    return command.motion.force.std(dim=-1, unbiased=False)


def sparse_jump(command: MotionCommand) -> Tensor:
    """Improvement of the lift-off score within this command, see `JumpTracker` (A6); an event."""
    return command.per_event(command.tracker.gain)


# --- What the paper does not have ----------------------------------------------------------------


def rise(command: MotionCommand) -> Tensor:
    """New height of the jump, lowest to highest trunk [m]: lift-off made dense; an event."""
    return command.per_event(command.tracker.rise)


def reach(command: MotionCommand) -> Tensor:
    """New ground covered in flight along the command [m], within this jump command; an event."""
    return command.per_event(command.tracker.reach)


def gap(command: MotionCommand) -> Tensor:
    """Ground newly cleared by all feet within this command [m], where commanded to go; an event."""
    return command.per_event(command.tracker.gap)


def countermovement(command: MotionCommand) -> Tensor:
    """How alike the legs' lengths are to those of a jump that falls, brakes and pushes, 0 to 1.

    From the command to the first lift-off, see `JumpSettings.countermovement`.
    """
    return command.tracker.likeness


def hop(command: MotionCommand) -> Tensor:
    """1 per lift-off after the first of one command; an event."""
    return command.per_event(command.tracker.hop)


def action_rate(command: MotionCommand) -> Tensor:
    """|a_t - a_(t-1)|^2 of the network's actions."""
    return command.action_change.square().sum(dim=-1)


def roll_pitch_rate(command: MotionCommand) -> Tensor:
    """|omega_xy|^2 of the trunk [rad^2/s^2]."""
    return command.motion.angular_velocity[:, :2].square().sum(dim=-1)


def slip(command: MotionCommand) -> Tensor:
    """Sum of |v_xy|^2 of the feet on the ground [m^2/s^2]."""
    motion = command.motion
    return (motion.foot_velocity[..., :2].square().sum(dim=-1) * motion.contact).sum(dim=-1)


def trunk_height(command: MotionCommand, height: float) -> Tensor:
    """relu(z - height)^2 of the trunk [m^2]: hops without a command."""
    return (command.motion.height - height).clamp_min(0.0).square()


def knees(command: MotionCommand, height: float) -> Tensor:
    """Sum of relu(1 - z / height) over the knees' axes: no knee shall come near the ground."""
    return (1.0 - command.motion.knee_height / height).clamp_min(0.0).sum(dim=-1)


def stray_foot(command: MotionCommand) -> Tensor:
    """How far the lowest foot hangs below the mean of the four as a jump comes down [m].

    It is the one that ends the flight, and then stands alone.
    """
    feet, tracker = command.motion.foot_height, command.tracker
    below = feet.mean(dim=-1) - feet.amin(dim=-1)
    falls = command.motion.velocity_world[:, 2] < 0.0
    return below * (tracker.airborne & tracker.mode & falls)


def landing(command: MotionCommand, height: float) -> Tensor:
    """relu(height - z) of the trunk on the ground after a jump [m]: as deep a landing every time.

    The height of a jump is counted from its lowest trunk, and that was where it landed.
    """
    tracker = command.tracker
    landed = (tracker.liftoffs > 0.0) & ~tracker.airborne & tracker.mode
    return (height - command.motion.height).clamp_min(0.0) * landed


def crouch(command: MotionCommand, height: float) -> Tensor:
    """relu(height - z)^2 of the trunk [m^2]: nobody waits for the next jump with bent knees."""
    return (height - command.motion.height).clamp_min(0.0).square()
