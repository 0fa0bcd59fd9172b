"""Commands: velocities, redrawn at intervals, and the jump input.

Checklist C1 to C4. Speed ranges grow from a part of the full range to the whole: with +-3 m/s
from the first step a policy learns to stand, since the tracking reward has no slope so far away
(seen in a probe), and they wait for a policy that does not keep up. Everything is computed for all
robots with masks: no step waits for the device.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Self

import torch
from mjlab.managers.command_manager import CommandTerm, CommandTermCfg
from torch import Tensor

from pronk.robots.legged import legged
from pronk.robots.robot import RobotSpec
from pronk.train.gains import TrainingGains
from pronk.train.mdp.actions import HeldJointPosition
from pronk.train.mdp.guidance import guidance
from pronk.train.mdp.jump import JumpSettings, JumpTracker
from pronk.train.mdp.motion import STANDING_LEG, Motion, measure_motion
from pronk.train.mdp.scene import FEET, FOOT_GEOMS
from pronk.train.mdp.speed_ranges import Growth, SpeedRanges

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

BODY = legged("mini_cheetah")

NAME = "motion"
"""The command term's name in every environment."""


@dataclass(kw_only=True)
class NominalDrive:
    """Nominal gains and limit of every joint, in joint order."""

    stiffness: tuple[float, ...]
    """[N m/rad]"""
    damping: tuple[float, ...]
    """[N m s/rad]"""
    effort_limit: tuple[float, ...]
    """[N m]"""

    @classmethod
    def of(cls, robot: RobotSpec, gains: TrainingGains) -> Self:
        """Of a robot with the gains it is trained with."""
        groups = [gains.groups[joint.group] for joint in robot.joints]
        return cls(
            stiffness=tuple(group.stiffness for group in groups),
            damping=tuple(group.damping for group in groups),
            effort_limit=tuple(joint.drive.effort_limit for joint in robot.joints),
        )


@dataclass(kw_only=True)
class MotionCommandCfg(CommandTermCfg):
    """Velocity ranges and jump intervals."""

    drive: NominalDrive
    """Of the robot that is commanded."""
    resampling_time_range: tuple[float, float] = (2.0, 6.0)
    """Time between draws of the velocity command [s]."""
    limits: tuple[float, float, float] = (3.0, 1.0, 2.0)
    """Half-widths of the uniform draws: forward, left [m/s], yaw rate [rad/s] (C1 to C3)."""
    growth: Growth = field(default_factory=Growth)
    """How the ranges become as wide."""
    standing: float = 0.1
    """Part of the draws that are zero."""
    one_axis: float = 0.4
    """Part of the draws along one axis alone, as the trials ask."""
    jump_fraction: float = 0.0
    """Part of the robots whose jump input is used (0 in phase 1, 0.5 in phase 2)."""
    jump_on_s: tuple[float, float] = (0.4, 0.7)
    """Time that the jump input is held [s]: less than preparation and flight together, so that
    one command means one jump."""
    jump_off_s: tuple[float, float] = (1.0, 2.5)
    """Time between jump inputs [s]."""
    leap: float = 0.6
    """In jump mode the horizontal speed commanded is this much higher [m/s], for commands below
    1 m/s in proportion: the paper's robot, too, flew further than command times flight time
    (.60 m at 1 m/s). Ground covered faster is not paid."""
    width: float = 1.0
    """Standard deviation of the lift-off kernel [m/s], see `JumpTracker`."""
    settings: JumpSettings = field(default_factory=JumpSettings)

    def build(self, env: ManagerBasedRlEnv) -> MotionCommand:
        """The term of an environment."""
        return MotionCommand(self, env)


class MotionCommand(CommandTerm):
    """Commands of N robots, and what they do about it."""

    cfg: MotionCommandCfg
    time_left: Tensor

    def __init__(self, cfg: MotionCommandCfg, env: ManagerBasedRlEnv) -> None:
        super().__init__(cfg, env)
        count, device = self.num_envs, self.device
        self.velocity = torch.zeros(count, 3, device=device)
        """Forward, left [m/s], yaw rate [rad/s], in the trunk's frame. Shape (N, 3)."""
        self.jump = torch.zeros(count, dtype=torch.bool, device=device)
        """Jump input. Shape (N,)."""
        data = env.scene["robot"].data
        self.default_position: Tensor = data.default_joint_pos
        """[rad]. (N, 12)"""
        self.position_limits: Tensor = data.joint_pos_limits
        """[rad]. (N, 12, 2)"""
        self.stiffness = torch.tensor(cfg.drive.stiffness, device=device)
        """Nominal [N m/rad]. (12,)"""
        self.damping = torch.tensor(cfg.drive.damping, device=device)
        """Nominal [N m s/rad]. (12,)"""
        self.effort_limit = torch.tensor(cfg.drive.effort_limit, device=device)
        """[N m]. (12,)"""
        self.scripted = False
        """True: nobody but the caller changes `velocity` and `jump`."""
        self.led = 0.0
        """Part of a countermovement's guidance that is given, 0 to 1; a phase sets it."""
        self._guidance = guidance(
            cfg.settings, self.stiffness, self.damping, BODY.total_mass, env.step_dt
        )
        self.tracker = JumpTracker(count, device, cfg.settings, cfg.width)
        self.ranges = SpeedRanges(cfg.growth, device)
        self._jump_left = torch.zeros(count, device=device)
        self._limits = torch.tensor(cfg.limits, device=device)
        moving = 1.0 - cfg.standing
        kinds = [min(cfg.one_axis * i / 3, moving) for i in (1, 2, 3)]
        self._kinds = torch.tensor([*kinds, moving], device=device)
        """Where, in [0, 1], draws along x, y and yaw alone, of all and of none end."""
        self._axes = torch.cat([torch.eye(3), torch.ones(1, 3), torch.zeros(1, 3)]).to(device)
        """Axes that each kind of draw moves along."""
        spans = torch.tensor([cfg.resampling_time_range, cfg.jump_on_s, cfg.jump_off_s])
        self._least, self._most = spans.to(device).T[:, :, None]
        # The golden ratio spreads any fraction evenly over the robots.
        self._rank = (torch.arange(count, device=device) * 0.6180339887) % 1.0
        feet, _ = env.scene["robot"].find_sites(FEET, preserve_order=True)
        self.feet: Tensor = env.scene["robot"].indexing.site_ids[feet].long()
        """The foot sites' ids in the model. (4,)"""
        geoms, _ = env.scene["robot"].find_geoms(FOOT_GEOMS, preserve_order=True)
        self.foot_geoms: Tensor = env.scene["robot"].indexing.geom_ids[geoms].long()
        """Ids of the feet themselves. (4,)"""
        self._motion: Motion | None = None
        self._motion_step = -1

    @property
    def command(self) -> Tensor:
        """Velocity command, shape (N, 3)."""
        return self.velocity

    @property
    def target(self) -> Tensor:
        """Horizontal velocity that is rewarded: the command, in jump mode with `leap`. (N, 2).

        What a robot ran too fast when the jump command came is requested on top.
        """
        horizontal = self.velocity[:, :2]
        speed = torch.linalg.vector_norm(horizontal, dim=-1)
        faster = (self.cfg.leap * speed.clamp_max(1.0) + self.tracker.lead) * self.tracker.mode
        return horizontal * (1.0 + faster / speed.clamp_min(1e-6))[:, None]

    @property
    def jumper(self) -> Tensor:
        """Gets jump inputs. Bool, (N,)."""
        return self._rank < self.cfg.jump_fraction

    @property
    def jump_left(self) -> Tensor:
        """Time until the jump input changes [s]; 0 where it never does. (N,)."""
        return self._jump_left * self.jumper

    @property
    def standing(self) -> Tensor:
        """Commanded to stand still: no velocity and no jump. Bool, (N,)."""
        return (self.velocity.square().sum(dim=-1) < 1e-4) & ~self.tracker.mode

    @property
    def fell(self) -> Tensor:
        """Episodes that end in this step, and not for time. Bool, (N,)."""
        terminated: Tensor = self._env.termination_manager.terminated
        return terminated

    @property
    def position_target(self) -> Tensor:
        """What the joints were sent in this step [rad]. (N, 12)."""
        target: Tensor = self._env.action_manager.get_term("joint_position")._processed_actions
        return target

    def per_event(self, value: Tensor) -> Tensor:
        """A reward for an event, as the rate that mjlab will multiply by the step's duration.

        Args:
            value: What the event is worth. (N,)
        """
        return value / self._env.step_dt

    @property
    def action_change(self) -> Tensor:
        """Change of the network's actions in the last step. (N, 12)."""
        actions = self._env.action_manager
        return actions.action - actions.prev_action

    @property
    def motion(self) -> Motion:
        """What the robots did in the step just simulated; measured once a step, on first use."""
        step = self._env.common_step_counter
        if self._motion is None or self._motion_step != step:
            self._motion = measure_motion(self._env, self.feet, self._motion)
            self._motion_step = step
            self._follow(self._motion)
        return self._motion

    def _follow(self, motion: Motion) -> None:
        """Tell the tracker what the robots did in the step just simulated."""
        horizontal, target = motion.velocity_heading, self.target
        commanded = self.velocity[:, :2]
        speed = torch.linalg.vector_norm(commanded, dim=-1)
        # The part towards the command, which `target` lies along; zero without one.
        along = (horizontal * commanded).sum(dim=-1) / speed.clamp_min(1e-6)
        self.tracker.advance(
            jump=self.jump,
            contact=motion.contact,
            height=motion.height,
            vertical=motion.velocity_world[:, 2],
            miss=torch.linalg.vector_norm(horizontal - target, dim=-1),
            turn=torch.linalg.vector_norm(motion.angular_velocity[:, :2], dim=-1),
            along=torch.minimum(along, torch.linalg.vector_norm(target, dim=-1)),
            excess=along - speed,
            feet=motion.foot_position,
            direction=self._direction(motion.heading),
            stretch=motion.leg_length - STANDING_LEG,
            dt=self._env.step_dt,
        )
        if not self.scripted:
            self.ranges.advance(horizontal - commanded, ~self.tracker.mode)

    def _direction(self, heading: Tensor) -> Tensor:
        """Unit vector of the velocity commanded, world frame, or zero. (N, 2).

        Args:
            heading: Unit vector of where the trunk heads, world frame. (N, 2)
        """
        left = torch.stack((-heading[:, 1], heading[:, 0]), dim=-1)
        way = self.velocity[:, :1] * heading + self.velocity[:, 1:2] * left
        return way / torch.linalg.vector_norm(way, dim=-1, keepdim=True).clamp_min(1e-6)

    def reset(self, env_ids: Tensor | slice | None) -> dict[str, float]:
        """Fresh commands for robots that start anew; jumps under way are forgotten."""
        assert isinstance(env_ids, Tensor)
        self.tracker.reset(env_ids)
        if self._motion is not None:
            self._motion.forget(env_ids)
        if self.scripted:
            return {}
        velocity, time, _, off = self._draw(len(env_ids))
        self.velocity[env_ids] = velocity
        self.time_left[env_ids] = time
        self.jump[env_ids] = False
        self._jump_left[env_ids] = off
        return {}

    def compute(self, dt: float | Tensor, env_ids: Tensor | None = None) -> None:
        """Let time pass; draw anew where it has run out."""
        # Rewards have read the feet before `forward`, and mjlab keeps what was read until a robot
        # resets; what is observed after this shall be of now.
        self._env.scene["feet"].update(0.0)
        if env_ids is not None:
            return
        if not self.scripted:
            self._pass(dt)
        self._lead()

    def _pass(self, dt: float | Tensor) -> None:
        """Draw anew what has run out after a time."""
        self.time_left -= dt
        due = self.time_left <= 0.0
        velocity, time, on, off = self._draw(self.num_envs)
        self.velocity = torch.where(due[:, None], velocity, self.velocity)
        self.time_left = torch.where(due, time, self.time_left)
        if self.cfg.jump_fraction <= 0.0:
            self.jump.zero_()
            return
        self._jump_left -= dt
        turn = (self._jump_left <= 0.0) & self.jumper
        self.jump = self.jump ^ turn
        self._jump_left = torch.where(turn, torch.where(self.jump, on, off), self._jump_left)

    def _lead(self) -> None:
        """Tell the action what a hand adds in the coming step."""
        action = self._env.action_manager.get_term("joint_position")
        assert isinstance(action, HeldJointPosition)
        if self.led == 0.0:
            action.led = None
            return
        tracker, last = self.tracker, len(self._guidance) - 1
        # The tracker hears of a new command when the step that it began is over.
        begins = self.jump & ~tracker.commanded
        steps = (tracker.since / self._env.step_dt).round().long().clamp_max(last)
        on_the_ground = tracker.mode & (tracker.liftoffs == 0.0)
        steps = torch.where(begins, 0, torch.where(on_the_ground, steps, last))
        action.led = self.led * self._guidance[steps]

    def _draw(self, count: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Velocity (count, 3), and times until the next, with jump and without it (count,) [s]."""
        drawn = torch.rand(7, count, device=self.device)
        axes = self._axes[torch.bucketize(drawn[3], self._kinds)]
        velocity = (drawn[:3].T - 0.5) * (2.0 * self.ranges.part * self._limits) * axes
        time, on, off = torch.lerp(self._least, self._most, drawn[4:])
        return velocity, time, on, off

    def _update_metrics(self) -> None:
        """Nothing: rewards tell the story."""

    def _resample_command(self, env_ids: Tensor) -> None:
        """Nothing: `compute` and `reset` draw with masks."""

    def _update_command(self, env_ids: Tensor | None) -> None:
        """Nothing: `compute` does it all."""


def motion_command(env: ManagerBasedRlEnv) -> MotionCommand:
    """The command term of an environment."""
    term = env.command_manager.get_term(NAME)
    assert isinstance(term, MotionCommand)
    return term
