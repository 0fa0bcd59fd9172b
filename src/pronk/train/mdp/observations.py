"""What the networks read: the measured vector, the jump input, and what only training knows.

The measured vector is laid out in `pronk.policy.layout`, noise D7 to D10 included. The critic's
vector is free of noise and knows the truth; it never leaves the simulator.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from mjlab.managers import ObservationGroupCfg, ObservationTermCfg
from mjlab.utils.noise import UniformNoiseCfg
from torch import Tensor

from pronk.policy.layout import ACTIONS, HISTORY
from pronk.train.mdp.actions import HeldJointPosition
from pronk.train.mdp.commands import motion_command

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

Noise = dict[str, UniformNoiseCfg | None]

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
"""Parts of the critic's vector, in order, and their sizes. What was drawn for a robot is among
them, and how long its velocity command lasts: to a critic that does not know, what a robot earns
would be luck."""

CRITIC_JUMP = {
    "jump": 1,
    "mode": 1,
    "since": 1,
    "airborne": 1,
    "best": 1,
    "stroke": 1,
    "worth": 1,
    "lead": 1,
    "flown": 1,
    "farthest": 1,
    "jumper": 1,
    "jump_left": 1,
}
"""Parts of what the critic reads of a jump, from phase 2 on. Commands come at random and are worth
more than seconds of walking: whether one will come, and when, would else be the most of what
separates one return from another, and hide what an action did."""

_BODY_WEIGHT = 12.0 * 9.81
"""Unit of the foot forces that the critic reads [N]."""


def angular_velocity(env: ManagerBasedRlEnv) -> Tensor:
    """Of the trunk, in its frame [rad/s]. (N, 3)."""
    return env.sim.data.qvel[:, 3:6]


def projected_gravity(env: ManagerBasedRlEnv) -> Tensor:
    """Direction of gravity in the trunk's frame. (N, 3)."""
    return -_trunk_axes(env)[:, 2]


def joint_position(env: ManagerBasedRlEnv) -> Tensor:
    """Relative to the default pose [rad]. (N, 12)."""
    return env.sim.data.qpos[:, 7:] - motion_command(env).default_position


def joint_velocity(env: ManagerBasedRlEnv) -> Tensor:
    """[rad/s]. (N, 12)."""
    return env.sim.data.qvel[:, 6:]


def action(env: ManagerBasedRlEnv) -> Tensor:
    """The network's last actions. (N, 12)."""
    return env.action_manager.action


def command(env: ManagerBasedRlEnv) -> Tensor:
    """Forward, left [m/s], yaw rate [rad/s]. (N, 3)."""
    return motion_command(env).velocity


def jump(env: ManagerBasedRlEnv) -> Tensor:
    """The jump input, 0 or 1. (N, 1)."""
    return motion_command(env).jump.float()[:, None]


def target(env: ManagerBasedRlEnv) -> Tensor:
    """Truth for the estimator: contacts (0 or 1), velocity in the trunk's frame [m/s]. (N, 7)."""
    contact = env.scene["feet"].data.found > 0
    return torch.cat([contact.float(), _linear_velocity(env)], dim=-1)


def critic(env: ManagerBasedRlEnv) -> Tensor:
    """The parts of `CRITIC`. (N, 96)."""
    robot = env.scene["robot"].data
    ground = env.scene["feet"].data
    terms = motion_command(env)
    return torch.cat(
        [
            angular_velocity(env),
            projected_gravity(env),
            command(env),
            terms.time_left[:, None],
            joint_position(env),
            joint_velocity(env),
            action(env),
            _linear_velocity(env),
            env.sim.data.qpos[:, 2:3],
            (ground.found > 0).float(),
            torch.linalg.vector_norm(ground.force, dim=-1) / _BODY_WEIGHT,
            robot.data.site_xpos[:, terms.feet, 2],
            *body(env),
        ],
        dim=-1,
    )


def body(env: ManagerBasedRlEnv) -> list[Tensor]:
    """The parts of `CRITIC` that were drawn for each robot, in order. (N, size) each.

    As `pronk.train.mdp.draws.draws` has them, but stiffness and damping by kind of joint,
    and of each kind by leg, and `drop` in 1/kW: what is normalised must not be much smaller than 1.
    `voltage` is what is left of the battery's, over the rated one.
    """
    model, held = env.sim.model, env.action_manager.get_term("joint_position")
    assert isinstance(held, HeldJointPosition)
    feet, supply = motion_command(env).foot_geoms, held.supply
    drives = env.scene["robot"].actuators
    parts = [
        supply.voltage,
        supply.no_load,
        1e3 * supply.drop,
        model.geom_friction[:, feet[:1], 0],
        model.body_mass[:, env.scene["robot"].indexing.body_ids[:1]],
        held.lag,
        -model.geom_pos[:, feet, 2],
        *(drive.stiffness for drive in drives),
        *(drive.damping for drive in drives),
    ]
    # A field that is not drawn is stored once for all robots.
    return [part.expand(env.num_envs, -1) for part in parts]


def critic_jump(env: ManagerBasedRlEnv) -> Tensor:
    """The parts of `CRITIC_JUMP`. (N, 12)."""
    command = motion_command(env)
    tracker = command.tracker
    return torch.cat(
        [
            jump(env),
            tracker.mode.float()[:, None],
            tracker.since[:, None],
            tracker.airborne.float()[:, None],
            tracker.best[:, None],
            tracker.stroke[:, None],
            tracker.worth[:, None],
            tracker.lead[:, None],
            tracker.flown[:, None],
            tracker.farthest[:, None],
            command.jumper.float()[:, None],
            command.jump_left[:, None],
        ],
        dim=-1,
    )


def _linear_velocity(env: ManagerBasedRlEnv) -> Tensor:
    """Of the trunk, in its frame [m/s]. (N, 3)."""
    # Not a matrix product: those are rounded to ten bits where TF32 is allowed.
    return (env.sim.data.qvel[:, :3, None] * _trunk_axes(env)).sum(dim=1)


def _trunk_axes(env: ManagerBasedRlEnv) -> Tensor:
    """The trunk's x, y, z axes in the world's frame, as columns. (N, 3, 3).

    Positions are those of the state: mjlab computes them anew before it observes.
    """
    axes: Tensor = env.sim.data.xmat[:, env.scene["robot"].indexing.root_body_id]
    return axes


def groups(noise: Noise) -> dict[str, ObservationGroupCfg]:
    """The observation groups `measured`, `jump`, `critic`, `critic_jump` and `target`.

    Args:
        noise: Noise by measured part (`position`, `velocity`, `angular_velocity`, `gravity`); None
            for none.
    """

    def plain(func: object) -> ObservationGroupCfg:
        return ObservationGroupCfg(terms={"all": ObservationTermCfg(func=func)})

    measured = {
        "angular_velocity": ObservationTermCfg(
            func=angular_velocity, noise=noise["angular_velocity"]
        ),
        "projected_gravity": ObservationTermCfg(func=projected_gravity, noise=noise["gravity"]),
        "joint_position": ObservationTermCfg(
            func=joint_position, noise=noise["position"], history_length=HISTORY
        ),
        "joint_velocity": ObservationTermCfg(
            func=joint_velocity, noise=noise["velocity"], history_length=HISTORY
        ),
        "action": ObservationTermCfg(func=action, history_length=ACTIONS),
        "command": ObservationTermCfg(func=command),
    }
    return {
        "measured": ObservationGroupCfg(terms=measured, enable_corruption=True),
        "jump": plain(jump),
        "critic": plain(critic),
        "critic_jump": plain(critic_jump),
        "target": plain(target),
    }
