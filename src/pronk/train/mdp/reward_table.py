"""The weights of the rewards: the paper's table, and what became of it.

The paper's source carries a table of rewards commented out. Its numbers are read as standing
before the scaling by the step's duration (A23) and divided by `PAPER_UNIT`, which changes no
optimum and brings returns to the order of ten that PPO's usual settings are made for. What was
changed beyond that, and why, stands beside each weight.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from torch import Tensor

from pronk.errors import PronkError
from pronk.robots.legged import legged
from pronk.train.mdp import rewards

BODY = legged("mini_cheetah")

PAPER_UNIT = 20.0
"""One unit of ours is this many of the paper's."""


@dataclass(frozen=True)
class Row:
    """One reward term and its two weights."""

    term: Callable[..., Tensor]
    """Of a `MotionCommand` and `arguments`; gives (N,)."""
    walk: float
    """Weight outside jump mode (see `pronk.train.mdp.jump`)."""
    jump: float
    """Weight in jump mode."""
    arguments: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, kw_only=True)
class JumpWeights:
    """What changes from phase to phase (Table II)."""

    dense: float
    """On the standard deviation of foot forces, in jump mode [1/N]."""
    sparse: float
    """On the lift-off score, per event."""
    width: float
    """Standard deviation of the lift-off kernel [m/s]; the paper's expression has 1."""
    rise: float
    """Per metre of the jump's height."""
    reach: float
    """Per metre of ground newly covered in flight."""
    gap: float
    """Per metre of ground newly cleared by all feet."""
    countermovement: float
    """On likeness to a countermovement from the command to lift-off [1/s]."""
    hop: float
    """Per lift-off after the first."""
    collision: float
    """Per part other than a foot on the ground in jump mode [1/s]."""
    knees: float
    """On knees near the ground in jump mode [1/s]."""
    landing: float
    """On how deep a jump is landed [1/(m s)]."""


ROWS: Mapping[str, Row] = {
    # Paper 45 | 45.
    "tracking_linear": Row(rewards.tracking_linear, 2.25, 2.25, {"variance": 0.25}),
    # Paper 30 | 30, 1.5 here: turning came last of all that was learned.
    "tracking_angular": Row(rewards.tracking_angular, 2.0, 2.0, {"variance": 0.25}),
    # Not in the paper: the same with a wide kernel. Of a command of 3 m/s the narrow one says
    # nothing to a robot that stands, and some runs never found out. At 0.75 a naive policy that
    # walked 1 m/s when ranges were narrow stayed there as they grew.
    "approach_linear": Row(rewards.tracking_linear, 2.0, 2.0, {"variance": 4.0}),
    "approach_angular": Row(rewards.tracking_angular, 0.5, 0.5, {"variance": 4.0}),
    # Paper -5 | 0. Standing still, eight times as much: the pose is all there is to do.
    "posture": Row(rewards.posture, -0.25, 0.0, {"standing": 8.0}),
    # Paper -50 | 0.
    "vertical_velocity": Row(rewards.vertical_velocity, -2.5, 0.0),
    # Paper -0.2 | -0.2, which is -0.01 here: a trot changes its torques by 5 N m a step and
    # joint and would pay 3 of the 5.5 that tracking can earn. A fiftieth, jumping a hundredth.
    "smoothness": Row(rewards.smoothness, -0.0002, -0.0001),
    # Paper -20 | -120, -6 here. Half: what leaps highest and furthest rears up by .3 rad.
    "orientation": Row(rewards.orientation, -1.0, -3.0),
    # Paper -50 | -50. Twice as much: at -2.5 a policy set a knee down whenever it stopped. While it
    # has to find out how to jump, more would teach it not to; then a phase asks for more.
    "collision": Row(rewards.collision, -5.0, -5.0),
    # Paper -900 | -900, -45 here: the drive clips what exceeds the limit, and a position
    # command beyond reach is how a policy asks for full torque. A trace is left.
    "torque_limits": Row(rewards.torque_limits, -0.02, -0.005),
    # Paper -150 | -150.
    "position_limits": Row(rewards.position_limits, -7.5, -7.5),
    # Paper -0.5 | -0.5.
    "foot_acceleration": Row(rewards.foot_acceleration, -0.025, -0.025),
    # Paper -250 | -250. In a jump feet are where the jump wants them.
    "foot_clearance": Row(rewards.foot_clearance, -12.5, 0.0, {"height": 0.09}),
    # Paper -500 | -500, for one step of 20 ms: -0.5. More of it, and most where there is most to
    # win by a leap that ends on the side.
    "termination": Row(rewards.termination, -2.0, -10.0),
    # Paper -0.08 | -0.08, -0.004 here: running costs 1,000 N^2 m^2 and would pay 4 of the 5.5
    # that tracking can earn. A tenth of it, jumping a fortieth.
    "torque": Row(rewards.torque, -0.0004, -0.0001),
    # Table II, phase 1.
    "dense_jump": Row(rewards.dense_jump, 0.0, 0.0),
    "sparse_jump": Row(rewards.sparse_jump, 0.0, 0.0),
    # Not in the paper.
    "rise": Row(rewards.rise, 0.0, 0.0),
    "reach": Row(rewards.reach, 0.0, 0.0),
    "gap": Row(rewards.gap, 0.0, 0.0),
    "countermovement": Row(rewards.countermovement, 0.0, 0.0),
    "hop": Row(rewards.hop, 0.0, 0.0),
    "action_rate": Row(rewards.action_rate, -0.02, -0.005),
    "roll_pitch_rate": Row(rewards.roll_pitch_rate, -0.02, -0.02),
    "slip": Row(rewards.slip, -0.1, 0.0),
    "trunk_height": Row(rewards.trunk_height, -1500.0, 0.0, {"height": BODY.standing_height}),
    # A trot dips by 2 cm. A jump pays for its stroke, and a robot that is always low saves the way.
    "crouch": Row(rewards.crouch, -500.0, 0.0, {"height": BODY.standing_height - 0.02}),
    # Stopping from -2 m/s, a policy came down on a hind knee. Its skin is 2 cm below its axis.
    "knees": Row(rewards.knees, -3.0, -3.0, {"height": 0.06}),
    # Jumps alike to 7 mm in the air differed by 25 mm in how deep they landed, .16 to .23 m.
    "landing": Row(rewards.landing, 0.0, 0.0, {"height": 0.22}),
    # A policy trotted on in the air and came down on one foot: 40 ms early, thighs on the ground.
    "stray_foot": Row(rewards.stray_foot, 0.0, -30.0),
}
"""Every reward, with the weights of phase 1."""


def with_jump_weights(rows: Mapping[str, Row], weights: JumpWeights) -> dict[str, Row]:
    """The table of a phase.

    Args:
        rows: The table of phase 1.
        weights: The phase's.

    Raises:
        PronkError: The table lacks one of the rewards that phases weigh.
    """
    changed = {
        "dense_jump": -weights.dense,
        "sparse_jump": weights.sparse,
        "rise": weights.rise,
        "reach": weights.reach,
        "gap": weights.gap,
        "countermovement": weights.countermovement,
        "hop": -weights.hop,
        "collision": -weights.collision,
        "knees": -weights.knees,
        "landing": -weights.landing,
    }
    if missing := sorted(set(changed) - set(rows)):
        raise PronkError(f"the reward table has no {', '.join(missing)}.")
    return {
        name: replace(row, jump=changed[name]) if name in changed else row
        for name, row in rows.items()
    }
