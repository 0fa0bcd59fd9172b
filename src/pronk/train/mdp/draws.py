"""What each simulated robot is given: mjlab event functions that draw, and a record of the draws.

Which of them run, and over which ranges, `randomization` says. Draws come from PyTorch's global
generator of the environment's device, which the seed of the environment sets.
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import torch
from mjlab.managers.event_manager import RecomputeLevel, requires_model_fields
from mjlab.managers.scene_entity_config import SceneEntityCfg
from numpy.typing import NDArray

from pronk.errors import PronkError
from pronk.match.gains import GroupGains
from pronk.train.mdp.actions import HeldJointPosition

ENTITY = "robot"
"""Name of the robot in the scene."""
FEET = ".*_foot_collision"
"""Geoms of the feet."""
SHANKS = ".*_shank_collision"
"""Capsules of the shanks, along z, as many as feet and in the same order."""
FOOT_SITES = ".*_foot"
"""Sites at the centres of the feet."""

Range = tuple[float, float]
Shape = Literal["box", "ellipsoid"]

# --- Drawn once, when the environments are built ------------------------------------------------


def _uniform(env: Any, span: Range, *shape: int) -> torch.Tensor:
    return torch.empty(shape, device=env.device).uniform_(*span)


@requires_model_fields("geom_friction")  # type: ignore[untyped-decorator]
def draw_friction(env: Any, env_ids: None, span: Range, feet: SceneEntityCfg) -> None:
    """One sliding friction for all feet of a robot; torsion and rolling keep the model's.

    The feet have priority over the floor, so theirs is the friction of the contact.
    """
    ids = env.scene[ENTITY].indexing.geom_ids[feet.geom_ids]
    env.sim.model.geom_friction[:, ids, 0] = _uniform(env, span, env.num_envs, 1)


def draw_gains(env: Any, env_ids: None, ranges: Mapping[str, GroupGains], shape: Shape) -> None:
    """Stiffness and damping of every joint, independent of every other joint's.

    Of `dr.pd_gains`, mjlab's own, one event could not serve boxes and ellipsoids alike.
    """
    for drive in env.scene[ENTITY].actuators:
        names = drive.target_names
        pairs = [sample_gains(ranges[name], shape, env.num_envs, env.device) for name in names]
        kp, kd = torch.stack(pairs, dim=-1).unbind(dim=1)
        drive.set_gains(slice(None), kp=kp, kd=kd)


def sample_gains(gains: GroupGains, shape: Shape, n: int, device: str) -> torch.Tensor:
    """Draws of (stiffness, damping), shape (n, 2).

    Box: uniform in nominal +- range. Ellipsoid: uniform in {x : (x - c)^T E^-1 (x - c) <= 1}, as
    x = c + L u with L L^T = E and u uniform in the unit disc.
    """
    if shape == "box":
        nominal = torch.tensor([gains.stiffness, gains.damping], device=device)
        half = torch.tensor([gains.stiffness_range, gains.damping_range], device=device)
        return nominal + half * (2.0 * torch.rand(n, 2, device=device) - 1.0)
    angle, area = torch.rand(2, n, device=device).unbind()
    angle = 2.0 * torch.pi * angle
    disc = area.sqrt() * torch.stack([angle.cos(), angle.sin()])
    root: torch.Tensor = torch.linalg.cholesky(torch.tensor(gains.ellipsoid, device=device))
    center = torch.tensor(gains.ellipsoid_center, device=device)
    return center + (root @ disc).transpose(0, 1)


@requires_model_fields("geom_pos", "geom_size", "geom_rbound", "geom_aabb", "site_pos")  # type: ignore[untyped-decorator]
def draw_shank_length(
    env: Any,
    env_ids: None,
    span: Range,
    feet: SceneEntityCfg,
    shanks: SceneEntityCfg,
    sites: SceneEntityCfg,
) -> None:
    """Length of every shank: its foot moves along it, its capsule ends as far from the foot.

    Mass and inertia of the shank (64 g) stay; a tube's length cut by 7 % changes no more.
    """
    robot, model = env.scene[ENTITY], env.sim.model
    foot, shank = (robot.indexing.geom_ids[cfg.geom_ids] for cfg in (feet, shanks))
    site = robot.indexing.site_ids[sites.site_ids]
    default = env.sim.get_default_field
    length = _uniform(env, span, env.num_envs, len(foot))
    longer = length + default("geom_pos")[foot, 2]
    model.geom_pos[:, foot, 2] = -length
    model.site_pos[:, site, 2] = -length
    # A capsule's size is (radius, half length); one of its ends moves.
    half = default("geom_size")[shank, 1] + longer / 2
    tip = default("geom_size")[shank, 0] + half
    model.geom_pos[:, shank, 2] = default("geom_pos")[shank, 2] - longer / 2
    model.geom_size[:, shank, 1] = half
    model.geom_rbound[:, shank] = tip
    model.geom_aabb[:, shank, 1, 2] = tip


@requires_model_fields("body_mass", "body_inertia", recompute=RecomputeLevel.set_const)  # type: ignore[untyped-decorator]
def draw_base_mass(env: Any, env_ids: None, span: Range, base: SceneEntityCfg) -> None:
    """Mass of the trunk; its inertia grows in proportion, its centre of mass stays.

    Raises:
        PronkError: The trunk could be left without mass.
    """
    ids = env.scene[ENTITY].indexing.body_ids[base.body_ids]
    mass, inertia = (env.sim.get_default_field(f)[ids] for f in ("body_mass", "body_inertia"))
    if not float(mass) + span[0] > 0.0:
        raise PronkError(
            f"the trunk of {float(mass):.3g} kg is drawn with {span[0]:g} kg added; some of it "
            "must be left."
        )
    drawn = mass + _uniform(env, span, env.num_envs, 1)
    env.sim.model.body_mass[:, ids] = drawn
    env.sim.model.body_inertia[:, ids] = inertia * (drawn / mass)[..., None]


def draw_supply(env: Any, env_ids: None, voltage: Range, resistance: Range, rated: float) -> None:
    """A robot's battery: voltage at no load [V], resistance with the wires [ohm].

    Args:
        env: The environment.
        env_ids: Not used; all robots draw.
        voltage: Range of the one.
        resistance: Range of the other.
        rated: Voltage that the drives' law is for [V].
    """
    volts, ohms = (_uniform(env, span, env.num_envs, 1) for span in (voltage, resistance))
    _held(env).supply.set(volts, ohms, rated=rated)


def _held(env: Any) -> HeldJointPosition:
    """The action term that feeds the drives."""
    terms = [env.action_manager.get_term(name) for name in env.action_manager.active_terms]
    (found,) = (term for term in terms if isinstance(term, HeldJointPosition))
    return found


# --- Per episode and per step -------------------------------------------------------------------


def draw_start(
    env: Any, env_ids: torch.Tensor, place: float, speed: float, heading: float, joints: float
) -> None:
    """State in which an episode begins: about the initial state, which stands upright.

    mjlab's events for this draw all six axes of pose and twist, in four times the operations: of a
    training step with thousands of robots, in which some always start anew, a seventh.

    Args:
        env: The environment.
        env_ids: Robots that start anew. (n,)
        place: Half-width of the position along world x and y [m].
        speed: Half-width of the velocity along world x and y [m/s].
        heading: Half-width of the yaw angle [rad].
        joints: Half-width of joint positions about the default pose [rad].
    """
    robot = env.scene[ENTITY]
    root = robot.data.default_root_state[env_ids]
    pose = robot.data.default_joint_pos[env_ids]
    drawn = _uniform(env, (-1.0, 1.0), len(env_ids), 5 + pose.shape[1])
    root[:, :3] += env.scene.env_origins[env_ids]
    root[:, :2].add_(drawn[:, :2], alpha=place)
    half = drawn[:, 2] * (heading / 2)
    root[:, 3], root[:, 6] = half.cos(), half.sin()
    root[:, 7:9].add_(drawn[:, 3:5], alpha=speed)
    pose.add_(drawn[:, 5:], alpha=joints)
    robot.write_root_state_to_sim(root, env_ids=env_ids)
    robot.write_joint_state_to_sim(pose, torch.zeros_like(pose), env_ids=env_ids)


def draw_decimation(env: Any, env_ids: None, nominal: int, span: tuple[int, int]) -> None:
    """Physics steps of the next policy step, one draw for all robots (as in the paper's simulator).

    Has no state: the draw is a function of the count of policy steps, so a resumed run goes on as
    the uninterrupted one once `env.common_step_counter` is restored and this is called. It is the
    same in every process of a run, so that GPUs need not wait for one another.
    """
    env.cfg.decimation = nominal + random.Random(env.common_step_counter).randint(*span)


# --- Record -------------------------------------------------------------------------------------


def draws(env: Any) -> dict[str, NDArray[np.float64]]:
    """What every robot of an environment has now, drawn or not.

    Returns:
        `friction` (n,), `base_mass` [kg] (n,), `shank_length` [m] (n, legs), `stiffness`
        [N m/rad] and `damping` [N m s/rad] (n, joints), `delay` of the command in this episode
        [physics steps] (n,), `no_load` voltage over the rated one and `drop`, four times the
        battery's resistance over its square [1/W] (n,); joints and legs in the order of the entity.
    """
    robot, model, n = env.scene[ENTITY], env.sim.model, env.num_envs
    feet = robot.indexing.geom_ids[robot.find_geoms(FEET)[0]]
    gains = {name: torch.zeros(n, robot.num_joints) for name in ("stiffness", "damping")}
    held = _held(env)
    for drive in robot.actuators:
        for name, table in gains.items():
            table[:, drive.target_ids.cpu()] = getattr(drive, name).cpu()
    found = {
        "friction": model.geom_friction[:, feet[0], 0],
        "base_mass": model.body_mass[:, robot.indexing.body_ids[0]],
        "shank_length": -model.geom_pos[:, feet, 2],
        **gains,
        "delay": held.lag[:, 0],
        "no_load": held.supply.no_load[:, 0],
        "drop": held.supply.drop[:, 0],
    }
    return {name: value.cpu().double().numpy() for name, value in found.items()}
