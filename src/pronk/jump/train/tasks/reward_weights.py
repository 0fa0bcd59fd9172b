"""Weights of the rewards: the paper's table, and what was changed.

The paper's source carries a table of rewards commented out. Its numbers are read as standing before
the scaling by the step's duration (A23) and divided by `PAPER_UNIT`, which changes no optimum and
brings returns to the order of ten that PPO's usual settings are made for. Each further change is
explained beside its weight. In jump mode a weight is multiplied by the term's `jump_scale`: the
second column of the paper's table. A phase of training changes weights and jump scales
(`pronk.jump.train.phases`).

Heights, and weights of terms in metres or newton metres, follow the size of the robot: a robot that
stands as the Mini Cheetah does, only larger, loses as much by each term.
"""

from __future__ import annotations

from collections.abc import Callable

from mjlab.managers import RewardTermCfg
from torch import Tensor

from pronk.jump.train.mdp import rewards
from pronk.jump.train.tasks.robot_scale import MINI_CHEETAH, RobotScale

PAPER_UNIT = 20.0
"""One unit of a weight here is this many of the paper's."""


def _term(func: Callable[..., Tensor], weight: float, **params: float) -> RewardTermCfg:
    """Return a term of the reward."""
    return RewardTermCfg(func=func, weight=weight, params=params)


def reward_weights(scale: RobotScale = MINI_CHEETAH) -> dict[str, RewardTermCfg]:
    """Return the terms with the weights of phase 1; the paper's are walking | jumping.

    Args:
        scale: Size of the robot over that of the Mini Cheetah, which the numbers below are for.
    """
    length = scale.length
    area = length**2
    torque_square = scale.torque**2
    return {
        # Paper 45 | 45.
        "tracking_linear": _term(rewards.tracking_linear, 2.25, variance=0.25, jump_scale=1.0),
        # Paper 30 | 30, 1.5 here: turning was the last to be learned.
        "tracking_angular": _term(rewards.tracking_angular, 2.0, variance=0.25),
        # Not in the paper: the same with a wide kernel, since the narrow one has no slope for a
        # robot that stands when 3 m/s is commanded. At 0.75 a policy with nominal gains that walked
        # 1 m/s in narrow ranges stayed there as they grew.
        "approach_linear": _term(rewards.tracking_linear, 2.0, variance=4.0),
        # Paper -5 | 0. Eight times as much when standing still: the pose is all there is to do.
        "posture": _term(rewards.posture, -0.25, standing=8.0, jump_scale=0.0),
        # Paper -20 | -120, -6 here. Half: the highest and furthest jumps pitch up by .3 rad.
        "orientation": _term(rewards.orientation, -1.0, jump_scale=3.0),
        # Paper -50 | -50. Twice as much: at -2.5 a policy set a knee down whenever it stopped.
        "collision": _term(rewards.collision, -5.0, jump_scale=1.0),
        # Paper -250 | -250. In a jump feet follow the jump.
        "foot_clearance": _term(
            rewards.foot_clearance, -12.5 / area, height=0.09 * length, jump_scale=0.0
        ),
        # Paper -500 | -500, for one step of 20 ms: -0.5. More of it, and most where most can be
        # earned by a jump that ends on the side.
        "termination": _term(rewards.fall, -2.0, jump_scale=5.0),
        # Paper -0.08 | -0.08, -0.004 here: running takes 1,000 N^2 m^2 and would lose 4 of the 5.5
        # that tracking can earn.
        "torque": _term(rewards.joint_torque, -0.0004 / torque_square, jump_scale=0.25),
        # Table II, phase 1.
        "sparse_jump": _term(rewards.sparse_jump, 0.0),  # A6
        # Not in the paper, from here on.
        "flight_distance": _term(rewards.flight_distance, 0.0),
        "countermovement": _term(rewards.countermovement, 0.0),
        "action_rate": _term(rewards.action_rate, -0.02, jump_scale=0.25),
        # Hops without a jump command.
        "trunk_height": _term(rewards.trunk_height, -1500.0 / area, above=0.0, jump_scale=0.0),
        # A trot dips by 2 cm; waiting for the next jump with bent knees is below that.
        "crouch": _term(rewards.crouch, -500.0 / area, below=0.02 * length, jump_scale=0.0),
        # Stopping from -2 m/s, a policy came down on a hind knee, 2 cm thick.
        "knees": _term(rewards.low_knees, -3.0, height=0.06 * length, jump_scale=1.0),
        # Jumps alike to 7 mm in the air differed by 25 mm in their landing, .16 to .23 m.
        "landing": _term(rewards.low_landing, 0.0, height=0.22 * length),
        # A policy trotted on in the air and landed on one foot: 40 ms early, thighs on the ground.
        "stray_foot": _term(rewards.stray_foot, -30.0),
        # Table III: .318 and .244 m at 1 and 2 m/s forwards, .38 m at most elsewhere. Forwards the
        # knees alone push, and they are at their limit of speed: height is given up there.
        "height_by_speed": _term(rewards.height_by_speed, 0.0, full_speed=2.0, least=0.4),
        # 2 m/s upwards beside 2.6 m/s forwards, as in the paper's jumps at 2 m/s: .97 m in .40 s.
        # A kernel of .15 rad separates 53 degrees (2.2 and 1.67 m/s) from 38.
        "liftoff_angle": _term(
            rewards.liftoff_angle, 0.0, vertical=2.0, std=0.15, forward_speed=1.0
        ),
    }


def candidate_terms() -> dict[str, RewardTermCfg]:
    """Return the terms that a task has only if a recipe gives them a weight.

    They were terms of every task, and trainings without them did as well: see "Recipes" in
    docs/evidence/training.md, and `examples/recipes/thirty_terms.yaml`, which has their weights.
    They are not among the default terms with a weight of zero, since each costs time.
    """
    return {
        # A wide kernel of turning; the ranges grow with the tracking.
        "approach_angular": _term(rewards.tracking_angular, 0.0, variance=4.0),
        # The terms trunk_height and crouch bound the same motion.
        "vertical_velocity": _term(rewards.vertical_velocity, 0.0, jump_scale=0.0),
        # Paper -0.2 | -0.2. At -0.01 a trot, which changes its torques by 5 N m a step and joint,
        # would lose 3 of the 5.5 that tracking can earn; action_rate does its work.
        "smoothness": _term(rewards.smoothness, 0.0, jump_scale=0.5),
        # The drive clips what exceeds the limit, and a position command beyond reach is how a
        # policy commands full torque.
        "torque_limits": _term(rewards.torque_over_limits, 0.0, jump_scale=0.25),
        # The joints have stops.
        "position_limits": _term(rewards.position_over_limits, 0.0),
        # The terms foot_clearance and action_rate shape the swing.
        "foot_acceleration": _term(rewards.foot_acceleration, 0.0),
        # The guidance makes all feet push at once.
        "dense_jump": _term(rewards.dense_jump, 0.0),
        # The same at all speeds as height_by_speed, which replaced it.
        "jump_height": _term(rewards.jump_height, 0.0),
        # Covers the same ground as flight_distance.
        "clearance_gap": _term(rewards.clearance_gap, 0.0),
        # Only the best lift-off of a command is paid anyway.
        "hop": _term(rewards.hop, 0.0),
        # The term orientation bounds what it adds up to.
        "roll_pitch_rate": _term(rewards.roll_pitch_rate, 0.0),
        # The term foot_clearance is a penalty of moving feet near the ground.
        "slip": _term(rewards.slip, 0.0, jump_scale=0.0),
    }
