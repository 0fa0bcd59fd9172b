"""Randomization events (paper D1 to D6), and the state in which an episode begins.

What a real robot has once is drawn once for each simulated robot, when the environment is built
(mode `startup`): friction of the feet, gains, shank lengths, mass of the trunk, battery. Gains are
drawn by group (`randomize_gains`, the paper's box) or by joint, with dry friction
(`randomize_drives`); weak drives (`randomize_strength`) and contacts of less damping
(`randomize_contact`) on request. The command delay is drawn in each episode (`actions`), the length
of the policy step in each step, pushes at intervals (`Pushes`), noise in each observation. All
draws are uniform, from PyTorch's generator of the device.
"""

from __future__ import annotations

import random
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch
from mjlab.managers.event_manager import EventTermCfg, RecomputeLevel, requires_model_fields
from mjlab.managers.scene_entity_config import SceneEntityCfg
from mjlab.utils.noise import UniformNoiseCfg
from torch import Tensor

from pronk.errors import PronkError
from pronk.identify.match.gains import GroupGains
from pronk.jump.train.compiled import Recorder, TensorFunction
from pronk.jump.train.mdp.actions import joint_position_action
from pronk.jump.train.mdp.masks import overwrite, robot_mask
from pronk.jump.train.mdp.observations import gravity_direction

Range = tuple[float, float]
Shape = Literal["box", "ellipsoid"]


class UniformNoise(UniformNoiseCfg):
    """mjlab's uniform noise, drawn in place by two operations instead of five."""

    def apply(self, data: Tensor) -> Tensor:
        """Add noise to a measurement of any shape."""
        return torch.empty_like(data).uniform_(self.n_min, self.n_max).add_(data)


def _uniform(env: Any, span: Range, *shape: int) -> Tensor:
    """Draw numbers that are uniform in `span`."""
    return torch.empty(shape, device=env.device).uniform_(*span)


def randomize_gains(
    env: Any, env_ids: None, ranges: Mapping[str, GroupGains], shape: Shape
) -> None:
    """Draw stiffness and damping of every joint independently (D3, D4).

    Args:
        env: The environment.
        env_ids: All robots.
        ranges: Gains and their ranges by joint name.
        shape: Whether they are drawn in the box or in the ellipsoid of their ranges.
    """
    for drive in env.scene["robot"].actuators:
        gains = []
        for name in drive.target_names:
            gains.append(sample_gains(ranges[name], shape, env.num_envs, env.device))
        stiffness, damping = torch.stack(gains, dim=-1).unbind(dim=1)
        drive.set_gains(slice(None), kp=stiffness, kd=damping)


@requires_model_fields("dof_frictionloss")  # type: ignore[untyped-decorator]
def randomize_drives(
    env: Any,
    env_ids: None,
    gains: Mapping[str, GroupGains],
    friction: Mapping[str, Range],
    mirror: Mapping[str, str],
    nominal: bool = False,
) -> None:
    """Draw stiffness, damping and dry friction of every joint about its own match.

    Every robot is the measured one or, as likely, its mirror image, whose joints have what is drawn
    for those on the other side: see `rl.symmetry` for the reason.

    Args:
        env: The environment.
        env_ids: All robots.
        gains: Pair and ellipse of each joint by its name.
        friction: Lowest and highest dry friction of each joint by its name [N m].
        mirror: The joint on the other side, by the name of each joint.
        nominal: True to give all robots the middle of each draw, and none the mirror image.
    """
    robot = env.scene["robot"]
    is_mirrored = torch.rand(env.num_envs, 1, 1, device=env.device) < (0.0 if nominal else 0.5)
    for drive in robot.actuators:
        names = list(drive.target_names)
        drives = []
        for name in names:
            pair = torch.tensor([gains[name].stiffness, gains[name].damping], device=env.device)
            pairs = pair.expand(env.num_envs, 2)
            low, high = friction[name]
            if nominal:
                low = high = 0.5 * (low + high)
            else:
                pairs = sample_gains(gains[name], "ellipsoid", env.num_envs, env.device)
            drives.append(torch.cat([pairs, _uniform(env, (low, high), env.num_envs, 1)], dim=1))
        drawn = torch.stack(drives, dim=1)  # (N, joints, 3)
        other = [names.index(mirror[name]) for name in names]
        stiffness, damping, frictionloss = torch.where(is_mirrored, drawn[:, other], drawn).unbind(
            dim=-1
        )
        drive.set_gains(slice(None), kp=stiffness, kd=damping)
        dofs = robot.indexing.joint_v_adr[drive.target_ids].long()
        env.sim.model.dof_frictionloss[:, dofs] = frictionloss


def randomize_strength(env: Any, env_ids: None, weakest: float) -> None:
    """Draw by how much the drives of each robot are weaker than nominal, all of a robot alike.

    A motor whose torque constant is the share s of what its drive assumes gives s of each torque
    that is commanded, of the effort limit and of the stall torque, and turns 1 / s as fast without
    load: its stiffness and damping are s of those drawn.

    Args:
        env: The environment.
        env_ids: All robots; their gains have just been drawn.
        weakest: Smallest share; the largest is 1.
    """
    strength = _uniform(env, (weakest, 1.0), env.num_envs, 1)
    for drive in env.scene["robot"].actuators:
        drive.set_gains(slice(None), kp=drive.stiffness * strength, kd=drive.damping * strength)
        limit = drive.cfg.effort_limit * strength
        drive.set_effort_limit(slice(None), limit.expand(-1, len(drive.target_names)))
    joint_position_action(env).battery.weaken(strength)


@requires_model_fields("geom_solref")  # type: ignore[untyped-decorator]
def randomize_contact(env: Any, env_ids: None, least: float, feet: SceneEntityCfg) -> None:
    """Draw by how much the feet of each robot are damped less on the ground, all of a robot alike.

    With time constant T and damping ratio z MuJoCo gives a foot that is r deep in the ground, and
    moves at v, the acceleration -(2 / T) v - r / (T z)^2, which friction follows too. The first
    number becomes the share of it that is drawn; the second one stays.

    Args:
        env: The environment.
        env_ids: All robots.
        least: Smallest share, above 0; the largest is 1.
        feet: Geoms of the feet, whose contacts have a time constant.
    """
    foot = env.scene["robot"].indexing.geom_ids[feet.geom_ids]
    time_constant, damping_ratio = env.sim.get_default_field("geom_solref")[foot].unbind(dim=-1)
    stiffness = (time_constant * damping_ratio) ** -2
    damping = _uniform(env, (least, 1.0), env.num_envs, 1) * (2.0 / time_constant)
    # Negative numbers are stiffness and damping themselves.
    contact = torch.stack(torch.broadcast_tensors(-stiffness, -damping), dim=-1)
    env.sim.model.geom_solref[:, foot] = contact


ROTOR_FREQUENCIES = 4.0
"""Highest natural frequency of a rotor over the lowest one that is drawn [1]."""
ROTOR_DAMPING = (0.05, 0.2)
"""Damping ratios of rotors on their belts. The drive's damping of some 0.5 N m s/rad is 0.15 of the
critical one for a knee of the Mini Cheetah at 45 Hz; the drive's lag takes some of it away, and
friction adds to it."""


def randomize_rotors(env: Any, env_ids: None, lowest_hz: float) -> None:
    """Draw the natural frequency and damping of the rotors of each joint group on belts or gears.

    The joints of a group are built alike: a robot has one frequency and one damping ratio for each
    group. Frequencies are drawn uniformly in their logarithm. A frequency f is a stiffness of
    I (2 pi f)^2 between rotor and link, with the armature I.

    Args:
        env: The environment.
        env_ids: All robots.
        lowest_hz: Lowest frequency while the link is held, above 0 [Hz]; the highest is
            `ROTOR_FREQUENCIES` times as much.
    """
    rotors = joint_position_action(env).rotors
    frequency_hz = torch.empty_like(rotors.offset)
    damping_ratio = torch.empty_like(rotors.offset)
    for drive in env.scene["robot"].actuators:
        factor = ROTOR_FREQUENCIES ** _uniform(env, (0.0, 1.0), env.num_envs, 1)
        frequency_hz[:, drive.target_ids] = lowest_hz * factor
        damping_ratio[:, drive.target_ids] = _uniform(env, ROTOR_DAMPING, env.num_envs, 1)
    rotors.draw(frequency_hz, damping_ratio)


def sample_gains(gains: GroupGains, shape: Shape, n: int, device: str) -> Tensor:
    """Draw pairs of gains.

    Box: uniform in nominal +- range. Ellipsoid, which `check_ellipsoid` accepts: uniform in
    {x : (x - c)^T E^-1 (x - c) <= 1}, as x = c + L u with L L^T = E, u uniform in the unit disc.

    Args:
        gains: Nominal gains and their ranges.
        shape: Box or ellipsoid.
        n: Number of pairs.
        device: Device of the result.

    Returns:
        Stiffness [N m/rad] and damping [N m s/rad], (n, 2).
    """
    if shape == "box":
        nominal = torch.tensor([gains.stiffness, gains.damping], device=device)
        half_width = torch.tensor([gains.stiffness_range, gains.damping_range], device=device)
        return nominal + half_width * (2.0 * torch.rand(n, 2, device=device) - 1.0)
    turn, area = torch.rand(2, n, device=device).unbind()
    angle = 2.0 * torch.pi * turn
    disc = area.sqrt() * torch.stack([angle.cos(), angle.sin()])
    root: Tensor = torch.linalg.cholesky(torch.tensor(gains.ellipsoid, device=device))
    center = torch.tensor(gains.ellipsoid_center, device=device)
    return center + (root @ disc).transpose(0, 1)


def check_ellipsoid(gains: GroupGains) -> None:
    """Refuse gains without an ellipsoid, or whose ellipsoid reaches gains of 0 or less."""
    (a, b), (c, d) = gains.ellipsoid
    stiffness, damping = gains.ellipsoid_center
    lowest_stiffness = stiffness - max(a, 0.0) ** 0.5
    lowest_damping = damping - abs(d) ** 0.5
    is_ellipsoid = a > 0.0 and a * d - b * c > 0.0
    if not (is_ellipsoid and lowest_stiffness > 0.0 and lowest_damping > 0.0):
        raise PronkError(
            f"the gains about {gains.stiffness:g} and {gains.damping:g} have no ellipsoid of "
            f"positive gains (it reaches down to {lowest_stiffness:g} and {lowest_damping:g}); "
            "draw them in the box, or use a gains.yaml whose joints differ."
        )


@requires_model_fields("geom_pos", "geom_size", "geom_rbound", "geom_aabb", "site_pos")  # type: ignore[untyped-decorator]
def randomize_shank_length(
    env: Any, env_ids: None, span: Range, feet: SceneEntityCfg, shanks: SceneEntityCfg
) -> None:
    """Draw the length of every shank, knee axis to foot centre (D5).

    The foot moves along the shank, and the shank's capsule ends as far from the foot as before.
    Mass and inertia of the shank stay: a tube cut by 7 % changes them no more.

    Args:
        env: The environment.
        env_ids: All robots.
        span: Shortest and longest shank [m].
        feet: Geoms and sites of the feet.
        shanks: Capsules along z, as many as `feet` and in the same order.
    """
    robot = env.scene["robot"]
    model = env.sim.model
    foot = robot.indexing.geom_ids[feet.geom_ids]
    shank = robot.indexing.geom_ids[shanks.geom_ids]
    site = robot.indexing.site_ids[feet.site_ids]
    default = env.sim.get_default_field
    length = _uniform(env, span, env.num_envs, len(foot))
    longer = length + default("geom_pos")[foot, 2]
    model.geom_pos[:, foot, 2] = -length
    model.site_pos[:, site, 2] = -length
    # A capsule's size is (radius, half length); one of its ends moves.
    half_length = default("geom_size")[shank, 1] + longer / 2
    tip = default("geom_size")[shank, 0] + half_length
    model.geom_pos[:, shank, 2] = default("geom_pos")[shank, 2] - longer / 2
    model.geom_size[:, shank, 1] = half_length
    model.geom_rbound[:, shank] = tip
    model.geom_aabb[:, shank, 1, 2] = tip


@requires_model_fields("body_mass", "body_inertia", recompute=RecomputeLevel.set_const)  # type: ignore[untyped-decorator]
def randomize_base_mass(env: Any, env_ids: None, added: Range, base: SceneEntityCfg) -> None:
    """Draw the mass added to the trunk [kg] (D6); its inertia grows in proportion."""
    ids = env.scene["robot"].indexing.body_ids[base.body_ids]
    mass = env.sim.get_default_field("body_mass")[ids]
    inertia = env.sim.get_default_field("body_inertia")[ids]
    if not float(mass) + added[0] > 0.0:
        raise PronkError(
            f"base_mass adds {added[0]:g} kg to a trunk of {float(mass):.3g} kg; expected a mass "
            "above 0."
        )
    new_mass = mass + _uniform(env, added, env.num_envs, 1)
    env.sim.model.body_mass[:, ids] = new_mass
    env.sim.model.body_inertia[:, ids] = inertia * (new_mass / mass)[..., None]


def randomize_battery(
    env: Any, env_ids: None, voltage: Range, resistance: Range, rated: float
) -> None:
    """Draw each robot's battery.

    Args:
        env: The environment.
        env_ids: All robots.
        voltage: Lowest and highest voltage at no load [V].
        resistance: Lowest and highest resistance with the wires [ohm].
        rated: Rated voltage of the drives [V].
    """
    no_load = _uniform(env, voltage, env.num_envs, 1)
    internal = _uniform(env, resistance, env.num_envs, 1)
    joint_position_action(env).battery.set(no_load, internal, rated=rated)


def randomize_decimation(env: Any, env_ids: None, nominal: int, added: tuple[int, int]) -> None:
    """Draw the physics steps of the next policy step, once for all robots (D1, A1).

    The draw is a function of the step counter: the same in every process, so that GPUs need not
    wait for one another.

    Args:
        env: The environment.
        env_ids: All robots.
        nominal: Physics steps of a policy step without randomization.
        added: Smallest and largest number of steps added to that.
    """
    if nominal + added[0] < 1:
        raise PronkError(
            f"decimation {nominal} with {added[0]} added is below 1; expected 1 physics step or "
            "more in a policy step."
        )
    env.cfg.decimation = nominal + random.Random(env.common_step_counter).randint(*added)


@dataclass(frozen=True, kw_only=True)
class PushSettings:
    """Parameters of `Pushes`."""

    interval_s: Range
    """Shortest and longest time from one push to the next [s]."""
    speed: float
    """Half-width of what is added to the velocity along world x and y [m/s]."""
    yaw_rate: float
    """Half-width of what is added to the angular velocity about world z [rad/s]."""


class Pushes:
    """Sudden changes of the velocity of each robot's trunk, at intervals.

    mjlab's event waits for the device in every step, to learn which robots are due. Here a push is
    computed for all robots and is zero for those that are not due. Intervals run on when episodes
    end.
    """

    def __init__(self, cfg: EventTermCfg, env: Any) -> None:
        """Draw the time of each robot's first push; mjlab gives configuration and environment."""
        self._env = env
        self._time_left = _uniform(env, cfg.params["interval_s"], env.num_envs)
        self._step_s = torch.zeros((), device=env.device)
        self._push: TensorFunction = self._push_robots
        self._settings: PushSettings

    def record(self, record: Recorder) -> None:
        """Record what is computed in every step; `record` prepares a function for it."""
        self._push = record(self._push_robots)

    def __call__(
        self, env: Any, env_ids: None, interval_s: Range, speed: float, yaw_rate: float
    ) -> None:
        """Push the robots whose interval is over, and draw the next one.

        Args:
            env: The environment.
            env_ids: All robots.
            interval_s: Shortest and longest time from one push to the next [s].
            speed: Half-width of what is added to the velocity along world x and y [m/s].
            yaw_rate: Half-width of what is added to the angular velocity about world z [rad/s].
        """
        self._settings = PushSettings(interval_s=interval_s, speed=speed, yaw_rate=yaw_rate)
        self._step_s.fill_(env.step_dt)
        self._push({})

    def _push_robots(self, _: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
        """Push the robots whose interval is over after the time that is stored."""
        env = self._env
        settings = self._settings
        self._time_left -= self._step_s
        due = self._time_left <= 0.0
        interval = _uniform(env, settings.interval_s, env.num_envs)
        overwrite(self._time_left, due, interval)
        uniform = _uniform(env, (-1.0, 1.0), env.num_envs, 3) * due[:, None]
        velocity = env.sim.data.qvel[:]
        velocity[:, :2] += settings.speed * uniform[:, :2]
        # The angular velocity of a free joint is in the trunk's frame. Its attitude is that of the
        # last physics step.
        velocity[:, 3:6] -= gravity_direction(env) * (settings.yaw_rate * uniform[:, 2:])
        return ()


def reset_state(
    env: Any,
    env_ids: Tensor | slice | None,
    place: float,
    speed: float,
    heading: float,
    joints: float,
) -> None:
    """Draw the state in which an episode begins, about the initial state, which stands upright.

    mjlab's events for this take four times the operations: a seventh of a training step with
    thousands of robots.

    Args:
        env: The environment.
        env_ids: Robots whose episode begins, as `robot_mask` takes them.
        place: Half-width of the position along world x and y [m].
        speed: Half-width of the velocity along world x and y [m/s].
        heading: Half-width of the yaw angle [rad].
        joints: Half-width of the joint positions about the default pose [rad].
    """
    robots = robot_mask(env_ids, env.num_envs, env.device)[:, None]
    robot = env.scene["robot"].data
    root = robot.default_root_state.clone()
    joint_position = robot.default_joint_pos.clone()
    uniform = _uniform(env, (-1.0, 1.0), env.num_envs, 5 + joint_position.shape[1])
    root[:, :3] += env.scene.env_origins
    root[:, :2].add_(uniform[:, :2], alpha=place)
    half_angle = uniform[:, 2] * (heading / 2)
    root[:, 3] = half_angle.cos()
    root[:, 6] = half_angle.sin()
    root[:, 7:9].add_(uniform[:, 3:5], alpha=speed)
    joint_position.add_(uniform[:, 5:], alpha=joints)
    # An index makes mjlab's arrays tensors without a copy. The robot is all that is simulated.
    positions = torch.cat([root[:, :7], joint_position], dim=1)
    overwrite(env.sim.data.qpos[:], robots, positions)
    at_rest = torch.zeros_like(uniform[:, 2:])  # all but the velocity of the trunk
    velocities = torch.cat([root[:, 7:10], at_rest], dim=1)
    overwrite(env.sim.data.qvel[:], robots, velocities)
