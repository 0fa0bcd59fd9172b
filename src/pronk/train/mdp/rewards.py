"""Rewards: terms (functions of the environment, (N,) each) and their weights (`REWARDS`).

The paper's source carries a table of rewards commented out. Its numbers are read as standing before
the scaling by the step's duration (A23) and divided by `PAPER_UNIT`, which changes no optimum and
brings returns to the order of ten that PPO's usual settings are made for. Each further change is
explained beside its weight. A penalty's term is positive and its weight negative. Most terms are
rates; an event earns its weight once, however long its step took.

A term with `jump_scale` has that factor in jump mode (see `pronk.train.mdp.jump`), so its weight
there is `weight * jump_scale`: the second column of the paper's table. A phase of training changes
weights and jump scales (`pronk.train.phases`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from mjlab.managers import RewardTermCfg
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


# --- Weights -------------------------------------------------------------------------------------

PAPER_UNIT = 20.0
"""One unit of a weight here is this many of the paper's."""


def _term(func: Callable[..., Tensor], weight: float, **params: float) -> RewardTermCfg:
    return RewardTermCfg(func=func, weight=weight, params=params)


def rewards() -> dict[str, RewardTermCfg]:
    """The terms with the weights of phase 1; the paper's are walking | jumping."""
    return {
        # Paper 45 | 45.
        "tracking_linear": _term(tracking_linear, 2.25, variance=0.25),
        # Paper 30 | 30, 1.5 here: turning was the last to be learned.
        "tracking_angular": _term(tracking_angular, 2.0, variance=0.25),
        # Not in the paper: the same with a wide kernel, since the narrow one has no slope for a
        # robot that stands when 3 m/s is commanded. At 0.75 a policy with nominal gains that walked
        # 1 m/s in narrow ranges stayed there as they grew.
        "approach_linear": _term(tracking_linear, 2.0, variance=4.0),
        "approach_angular": _term(tracking_angular, 0.5, variance=4.0),
        # Paper -5 | 0. Eight times as much when standing still: the pose is all there is to do.
        "posture": _term(posture, -0.25, standing=8.0, jump_scale=0.0),
        # Paper -50 | 0.
        "vertical_velocity": _term(vertical_velocity, -2.5, jump_scale=0.0),
        # Paper -0.2 | -0.2, which is -0.01 here: a trot changes its torques by 5 N m a step and
        # joint and would lose 3 of the 5.5 that tracking can earn.
        "smoothness": _term(smoothness, -0.0002, jump_scale=0.5),
        # Paper -20 | -120, -6 here. Half: the highest and furthest jumps pitch up by .3 rad.
        "orientation": _term(orientation, -1.0, jump_scale=3.0),
        # Paper -50 | -50. Twice as much: at -2.5 a policy set a knee down whenever it stopped.
        "collision": _term(collision, -5.0, jump_scale=1.0),
        # Paper -900 | -900, -45 here: the drive clips what exceeds the limit, and a position
        # command beyond reach is how a policy commands full torque.
        "torque_limits": _term(torque_limits, -0.02, jump_scale=0.25),
        # Paper -150 | -150.
        "position_limits": _term(position_limits, -7.5),
        # Paper -0.5 | -0.5.
        "foot_acceleration": _term(foot_acceleration, -0.025),
        # Paper -250 | -250. In a jump feet follow the jump.
        "foot_clearance": _term(foot_clearance, -12.5, height=0.09, jump_scale=0.0),
        # Paper -500 | -500, for one step of 20 ms: -0.5. More of it, and most where most can be
        # earned by a jump that ends on the side.
        "termination": _term(termination, -2.0, jump_scale=5.0),
        # Paper -0.08 | -0.08, -0.004 here: running takes 1,000 N^2 m^2 and would lose 4 of the 5.5
        # that tracking can earn.
        "torque": _term(torque, -0.0004, jump_scale=0.25),
        # Table II, phase 1.
        "dense_jump": _term(dense_jump, 0.0),
        "sparse_jump": _term(sparse_jump, 0.0),
        # Not in the paper.
        "jump_height": _term(jump_height, 0.0),
        "flight_distance": _term(flight_distance, 0.0),
        "clearance_gap": _term(clearance_gap, 0.0),
        "countermovement": _term(countermovement, 0.0),
        "hop": _term(hop, 0.0),
        "action_rate": _term(action_rate, -0.02, jump_scale=0.25),
        "roll_pitch_rate": _term(roll_pitch_rate, -0.02),
        "slip": _term(slip, -0.1, jump_scale=0.0),
        # Hops without a jump command.
        "trunk_height": _term(trunk_height, -1500.0, above=0.0, jump_scale=0.0),
        # A trot dips by 2 cm; waiting for the next jump with bent knees is below that.
        "crouch": _term(crouch, -500.0, below=0.02, jump_scale=0.0),
        # Stopping from -2 m/s, a policy came down on a hind knee, 2 cm thick.
        "knees": _term(knees, -3.0, height=0.06, jump_scale=1.0),
        # Jumps alike to 7 mm in the air differed by 25 mm in their landing, .16 to .23 m.
        "landing": _term(landing, 0.0, height=0.22),
        # A policy trotted on in the air and landed on one foot: 40 ms early, thighs on the ground.
        "stray_foot": _term(stray_foot, -30.0),
    }
