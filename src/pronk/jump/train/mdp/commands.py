"""Commands: velocities, redrawn at intervals, and the jump input (paper C1 to C4).

The command term also holds what depends on the commands: the state of the jumps, the motion of the
last step, and the ranges of the velocities. Masks are used, so that no step waits for the device.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import torch
import tyro
from mjlab.managers.command_manager import CommandTerm, CommandTermCfg
from torch import Tensor

from pronk.jump.train.compiled import (
    Recorder,
    compiled_step,
    keep_in_place,
    ordinary_tensors,
)
from pronk.jump.train.gains import TrainingGains
from pronk.jump.train.mdp.actions import joint_position_action
from pronk.jump.train.mdp.guidance import foot_sweep, guidance
from pronk.jump.train.mdp.jump import JumpInputs, JumpSettings, JumpState
from pronk.jump.train.mdp.liftoff import speed_share
from pronk.jump.train.mdp.masks import overwrite, robot_mask
from pronk.jump.train.mdp.motion import (
    RobotFrames,
    SimulatorState,
    StepMotion,
    measure_motion,
    mirror_joints,
    simulator_state,
    standing_leg,
)
from pronk.jump.train.mdp.speed_ranges import DIRECTIONS, SpeedRanges, fast_commands
from pronk.robots import load_robot
from pronk.robots.legged import legged

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

NAME = "motion"
"""The command term's name in every environment."""


BACKWARD_FULL_SPEED = 2.0
"""Commanded speed backwards from which on `MotionCommandCfg.backward_share` is left [m/s]: the
fastest of the paper's commands."""


@dataclass(kw_only=True)
class MotionCommandCfg(CommandTermCfg):
    """Velocity ranges and jump intervals."""

    robot: str
    """The robot, as `load_robot` reads it."""
    gains: tyro.conf.Suppress[TrainingGains]
    """Nominal gains of the drives."""
    resampling_time_range: tuple[float, float] = (2.0, 6.0)
    """Time between draws of the velocity command [s]."""
    limits: tuple[float, float, float] = (3.0, 1.0, 2.0)
    """Half-widths of the uniform draws: forward, left [m/s], yaw rate [rad/s] (C1 to C3).

    They grow up to these, see `pronk.jump.train.mdp.speed_ranges`."""
    counted_from: float = 0.0
    """Least command, as a share of the ranges in use, of robots whose tracking lets the ranges
    grow: by the worst of the directions forward, back, left and right. With 0 the mean of all
    decides, also of those that stand or turn."""
    standing: float = 0.1
    """Fraction of the velocity draws that are zero."""
    one_axis: float = 0.4
    """Fraction of the draws along one axis alone, as in the trials."""
    jump_fraction: float = 0.0
    """Fraction of the robots whose jump input is used; a phase sets it."""
    jump_on_s: tuple[float, float] = (0.4, 0.7)
    """Time that the jump input is held [s]: less than preparation and flight together, so that
    one command means one jump."""
    jump_off_s: tuple[float, float] = (1.0, 2.5)
    """Time between jump inputs [s]."""
    jump_speed_added: float = 0.6
    """In jump mode the rewarded horizontal speed is this much higher [m/s], for commands below
    1 m/s in proportion: the paper's robot, too, flew further than command times flight time
    (.60 m at 1 m/s). Ground covered faster is not rewarded."""
    guidance_sweep: float = 1.0
    """Share of the commanded forward velocity with which guided feet are swept backwards; 0 keeps
    them below the hips, where they brake the robot before it pushes."""
    backward_share: float = 1.0
    """Share of the pay for height, distance and gap that is left for commands backwards at
    `BACKWARD_FULL_SPEED` and faster, 0 to 1."""
    sideways_share: float = 1.0
    """Share of the pay for distance and gap that is left for commands straight to a side, 0 to 1;
    of other directions in proportion to their part to the side."""
    settings: JumpSettings = field(default_factory=JumpSettings)
    """Definition of a good jump."""

    def build(self, env: ManagerBasedRlEnv) -> MotionCommand:
        """Build the term of an environment."""
        return MotionCommand(self, env)


class MotionCommand(CommandTerm):
    """Commands of N robots, and their motion in response."""

    cfg: MotionCommandCfg
    time_left: Tensor

    def __init__(self, cfg: MotionCommandCfg, env: ManagerBasedRlEnv) -> None:
        """Begin with commands of zero."""
        super().__init__(cfg, env)
        count = self.num_envs
        device = self.device
        self.body = legged(cfg.robot)
        self.velocity = torch.zeros(count, 3, device=device)
        """Forward, left [m/s], yaw rate [rad/s], in the trunk's frame. (N, 3)"""
        self.jump = torch.zeros(count, dtype=torch.bool, device=device)
        """Jump input. (N,)"""
        entity = env.scene["robot"]
        self.default_position: Tensor = entity.data.default_joint_pos
        """Joint angles of the default pose [rad]. (N, 12)"""
        self.position_limits: Tensor = entity.data.joint_pos_limits
        """Lowest and highest joint angles [rad]. (N, 12, 2)"""
        robot = load_robot(cfg.robot)
        mirror = mirror_joints(self.body)
        nominal = []
        for joint in robot.joints:
            # The mean of both sides: half of the robots that are drawn by joint are mirror images.
            gains = cfg.gains.of(joint)
            other = cfg.gains.of(robot.joint(mirror[joint.name]))
            stiffness = 0.5 * (gains.stiffness + other.stiffness)
            damping = 0.5 * (gains.damping + other.damping)
            nominal.append((stiffness, damping, joint.drive.effort_limit))
        self.stiffness, self.damping, self.effort_limit = torch.tensor(nominal).T.to(device)
        """Nominal [N m/rad, N m s/rad], and of the drives [N m]. (12,)"""
        self.scripted = False
        """True: `velocity` and `jump` are set by the caller alone."""
        self.guidance_scale = 0.0
        """Fraction of the guidance that is added to the actions, 0 to 1; a phase sets it."""
        self._guidance = guidance(
            self.body, cfg.settings, self.stiffness, self.damping, env.step_dt
        )
        self._sweep = foot_sweep(self.body, cfg.settings, env.step_dt).to(device)
        self._standing_leg = standing_leg(self.body)
        self.state = JumpState(count, device, cfg.settings)
        groups = len(DIRECTIONS) if cfg.counted_from > 0.0 else 1
        self.ranges = SpeedRanges(device, groups)
        self._jump_left = torch.zeros(count, device=device)
        self._limits = torch.tensor(cfg.limits, device=device)
        moving = 1.0 - cfg.standing
        self._draw_ends = torch.tensor(
            [
                min(cfg.one_axis * 1 / 3, moving),
                min(cfg.one_axis * 2 / 3, moving),
                min(cfg.one_axis * 3 / 3, moving),
                moving,
            ],
            device=device,
        )
        """Where, in [0, 1], draws along x, y and yaw alone, of all and of none end."""
        self._axes = torch.cat([torch.eye(3), torch.ones(1, 3), torch.zeros(1, 3)]).to(device)
        """Axes that each kind of draw moves along."""
        spans = torch.tensor([cfg.resampling_time_range, cfg.jump_on_s, cfg.jump_off_s])
        self._shortest, self._longest = spans.to(device).T[:, :, None]
        # The golden ratio spreads any fraction evenly over the robots.
        self._rank = (torch.arange(count, device=device) * 0.6180339887) % 1.0
        sites = [f"{leg}_foot" for leg in self.body.legs]
        feet, _ = entity.find_sites(sites, preserve_order=True)
        self.feet: Tensor = entity.indexing.site_ids[feet].long()
        """The foot sites' ids in the model. (4,)"""
        collision_geoms = [f"{site}_collision" for site in sites]
        geoms, _ = entity.find_geoms(collision_geoms, preserve_order=True)
        self.foot_geoms: Tensor = entity.indexing.geom_ids[geoms].long()
        """Ids of the feet's geoms. (4,)"""
        self.frames = RobotFrames(
            body=self.body,
            feet=self.feet,
            shanks=env.sim.model.site_bodyid[self.feet],
            forward=entity.data.forward_vec_b,
            gravity=entity.data.gravity_vec_w,
        )
        """What is needed of the robot's model to measure motion."""
        self._step_s = torch.tensor(env.step_dt, device=device)
        self._next_step_s = self._step_s.clone()
        self._elapsed_s = torch.zeros(count, device=device)
        self._motion: StepMotion | None = None
        self._motion_step = -1
        self._jump_scales: dict[float, Tensor] = {}
        self._is_compiled = False

    @property
    def command(self) -> Tensor:
        """Velocity command. (N, 3)."""
        return self.velocity

    @property
    def target(self) -> Tensor:
        """Horizontal velocity that is rewarded: the command, in jump mode faster. (N, 2).

        The overspeed at the jump command is added, so that braking is not rewarded.
        """
        horizontal = self.velocity[:, :2]
        speed = torch.linalg.vector_norm(horizontal, dim=-1)
        added = self.cfg.jump_speed_added * speed.clamp_max(1.0) + self.state.overspeed
        return horizontal * (1.0 + added * self.state.mode / speed.clamp_min(1e-6))[:, None]

    def scaled_backwards(self, value: Tensor) -> Tensor:
        """Multiply a reward for the size of a jump, (N,), by its share backwards."""
        if self.cfg.backward_share == 1.0:
            return value
        share = speed_share(-self.velocity[:, 0], BACKWARD_FULL_SPEED, self.cfg.backward_share)
        return value * share

    def scaled_sideways(self, value: Tensor) -> Tensor:
        """Multiply a reward for the length of a jump, (N,), by its share to the sides."""
        if self.cfg.sideways_share == 1.0:
            return value
        speed = torch.linalg.vector_norm(self.velocity[:, :2], dim=-1).clamp_min(1e-6)
        sideways = self.velocity[:, 1].abs() / speed
        return value * (1.0 - (1.0 - self.cfg.sideways_share) * sideways)

    @property
    def jumper(self) -> Tensor:
        """Robots that get jump inputs. Bool, (N,)."""
        return self._rank < self.cfg.jump_fraction

    @property
    def jump_left(self) -> Tensor:
        """Time until the jump input changes [s]; 0 where it never does. (N,)."""
        return self._jump_left * self.jumper

    @property
    def standing(self) -> Tensor:
        """Robots commanded to stand still: no velocity and no jump. Bool, (N,)."""
        return (self.velocity.square().sum(dim=-1) < 1e-4) & ~self.state.mode

    @property
    def position_target(self) -> Tensor:
        """Joint position targets of this step [rad]. (N, 12)."""
        return joint_position_action(self._env).position_target

    @property
    def step_s(self) -> float | Tensor:
        """Duration of the step just simulated [s]; a tensor, (), once `compile` was called."""
        return self._step_s if self._is_compiled else self._env.step_dt

    @property
    def motion(self) -> StepMotion:
        """Motion in the step just simulated; measured once a step, on first use."""
        if torch.compiler.is_compiling():
            # Rewards that are compiled are computed after the motion was measured.
            assert self._motion is not None
            return self._motion
        step = self._env.common_step_counter
        if self._motion is None or self._motion_step != step:
            self._motion_step = step
            self._jump_scales.clear()
            if not self._is_compiled:
                self._motion = self._measure(simulator_state(self._env), self._motion, self.state)
                return self._motion
            self._step_s.fill_(self._env.step_dt)
            if self._motion is not None:
                self._recorded_measure()
            else:
                with ordinary_tensors():
                    self._motion = self._measure(simulator_state(self._env), None, self.state)
        return self._motion

    def compile(self, record: Recorder) -> None:
        """Compile and record what is computed in every step.

        Numbers that change become tensors.

        Args:
            record: Prepares a function to be recorded.
        """
        self._is_compiled = True
        self.state.liftoff_std = torch.tensor(self.state.liftoff_std, device=self.device)
        self._compiled_measure = compiled_step(self._measure)
        self._compiled_clear = compiled_step(self._clear)
        self._recorded_measure = record(self._measure_in_place)
        self._recorded_advance = record(self._advance_in_place)
        self._recorded_reset = record(self._reset_in_place)

    def scaled_in_jump_mode(self, value: Tensor, scale: float | Tensor) -> Tensor:
        """Multiply a reward of each robot, (N,), by `scale`, (), where it is in jump mode."""
        if isinstance(scale, Tensor):
            return torch.where(self.state.mode, value * scale, value)
        if scale == 1.0:
            return value
        if scale not in self._jump_scales:
            self._jump_scales[scale] = torch.where(self.state.mode, scale, 1.0)
        return value * self._jump_scales[scale]

    def _measure_in_place(self, _: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
        """Measure the motion in a step, and keep it and the jumps in the memory that they have."""
        assert self._motion is not None
        jumps = copy(self.state)
        motion = self._compiled_measure(simulator_state(self._env), self._motion, jumps)
        keep_in_place(self.state.tensors(), jumps.tensors())
        keep_in_place(self._motion.tensors(), motion.tensors())
        return ()

    def _measure(
        self, state: SimulatorState, before: StepMotion | None, jumps: JumpState
    ) -> StepMotion:
        """Measure the motion in a step; advance the jumps and the ranges of the velocities.

        Args:
            state: What the simulator computed.
            before: Motion in the step before; None where there is none.
            jumps: State of the jumps, which is advanced: `self.state` or a copy of it.
        """
        motion = measure_motion(state, self.frames, before)
        trunk = motion.trunk
        horizontal = trunk.velocity_heading
        target = self.target
        commanded = self.velocity[:, :2]
        speed = torch.linalg.vector_norm(commanded, dim=-1)
        # The part along the command, which `target` is parallel to; zero without one.
        along = (horizontal * commanded).sum(dim=-1) / speed.clamp_min(1e-6)
        left = torch.stack((-trunk.heading[:, 1], trunk.heading[:, 0]), dim=-1)
        way = commanded[:, :1] * trunk.heading + commanded[:, 1:] * left
        way_norm = torch.linalg.vector_norm(way, dim=-1, keepdim=True)
        inputs = JumpInputs(
            command=self.jump,
            contact=motion.legs.contact,
            height=trunk.height,
            vertical=trunk.velocity_world[:, 2],
            velocity_error=torch.linalg.vector_norm(horizontal - target, dim=-1),
            turn=torch.linalg.vector_norm(trunk.angular_velocity[:, :2], dim=-1),
            along=torch.minimum(along, torch.linalg.vector_norm(target, dim=-1)),
            excess=along - speed,
            feet=motion.legs.foot_position,
            direction=way / way_norm.clamp_min(1e-6),
            extension=motion.legs.length - self._standing_leg,
        )
        jumps.advance(inputs, self.step_s)
        if not self.scripted:
            counted = ~jumps.mode[None]
            if self.cfg.counted_from > 0.0:
                counted = counted & fast_commands(
                    commanded, self._limits, self.ranges.fraction, self.cfg.counted_from
                )
            self.ranges.advance(horizontal - commanded, counted)
        return motion

    def reset(self, env_ids: Tensor | slice | None) -> dict[str, float]:
        """Draw commands for robots that start a new episode, and clear their jumps."""
        robots = robot_mask(env_ids, self.num_envs, self.device)
        if self._motion is None:
            self.state.reset(robots)
            self._redraw(robots)
        elif self._is_compiled:
            self._recorded_reset({"robots": robots})
        else:
            self._clear(robots, self._motion)
            self._redraw(robots)
        return {}

    def _reset_in_place(self, inputs: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
        """Do what `reset` does for `robots`, bool (N,)."""
        self._compiled_clear(inputs["robots"], self._motion)
        self._redraw(inputs["robots"])
        return ()

    def _clear(self, robots: Tensor, motion: StepMotion) -> None:
        """Clear jumps and motion of the robots that start a new episode, bool (N,)."""
        self.state.reset(robots)
        motion.reset(robots)

    def _redraw(self, robots: Tensor) -> None:
        """Draw commands for some robots, bool (N,), with the jump input off."""
        if self.scripted:
            return
        velocity, time, _, off = self._draw()
        overwrite(self.velocity, robots[:, None], velocity)
        overwrite(self.time_left, robots, time)
        overwrite(self._jump_left, robots, off)
        self.jump &= ~robots

    def compute(self, dt: float | Tensor, env_ids: Tensor | None = None) -> None:
        """Advance the time by `dt`; draw anew where an interval is over."""
        # Rewards have read the feet before `forward`, and mjlab keeps what was read until a robot
        # resets; observations need the present contacts.
        self._env.scene["feet"].update(0.0)
        if env_ids is not None:
            return
        if not self._is_compiled:
            self._advance_commands(dt)
            return
        self._next_step_s.fill_(self._env.step_dt)
        if isinstance(dt, Tensor):
            self._elapsed_s.copy_(dt)
        else:
            self._elapsed_s.fill_(dt)
        with ordinary_tensors():
            self._recorded_advance()

    def _advance_in_place(self, _: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
        """Advance the commands by the time that is stored."""
        self._advance_commands(self._elapsed_s)
        return ()

    def _advance_commands(self, dt: float | Tensor) -> None:
        """Draw commands anew where an interval is over, and set the guidance."""
        if not self.scripted:
            self.time_left -= dt
            due = self.time_left <= 0.0
            velocity, time, on, off = self._draw()
            overwrite(self.velocity, due[:, None], velocity)
            overwrite(self.time_left, due, time)
            if self.cfg.jump_fraction <= 0.0:
                self.jump.zero_()
            else:
                self._jump_left -= dt
                turn = (self._jump_left <= 0.0) & self.jumper
                self.jump ^= turn
                change = torch.where(self.jump, on, off)
                overwrite(self._jump_left, turn, change)
        self._set_guidance()

    def _set_guidance(self) -> None:
        """Set what the action term adds to the targets of the coming step."""
        action = joint_position_action(self._env)
        if self.guidance_scale == 0.0:
            action.guidance.zero_()
            return
        state = self.state
        last_step = len(self._guidance) - 1
        # The jump state learns of a new command at the end of the step that begins with it.
        begins = self.jump & ~state.commanded
        step_s = self._next_step_s if self._is_compiled else self._env.step_dt
        steps = (state.since / step_s).round().long().clamp_max(last_step)
        on_the_ground = state.mode & (state.liftoffs == 0.0)
        steps = torch.where(begins, 0, torch.where(on_the_ground, steps, last_step))
        offsets = self._guidance[steps]
        if self.cfg.guidance_sweep != 0.0:
            speed = self.cfg.guidance_sweep * self.velocity[:, :1]
            offsets = offsets + speed * self._sweep[steps]
        action.guidance.copy_(self.guidance_scale * offsets)

    def _draw(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Draw velocities (N, 3), and times until the next, with jump and without it [s]."""
        uniform = torch.rand(7, self.num_envs, device=self.device)
        axes = self._axes[torch.bucketize(uniform[3], self._draw_ends)]
        widths = 2.0 * self.ranges.fraction * self._limits
        # The first factor decides how the product lies in memory.
        velocity = axes * ((uniform[:3].T - 0.5) * widths)
        time, on, off = torch.lerp(self._shortest, self._longest, uniform[4:])
        return velocity, time, on, off

    def _update_metrics(self) -> None:
        """Do nothing, as the next two, which mjlab requires: see `compute` and `reset`."""

    def _resample_command(self, env_ids: Tensor) -> None:
        """Do nothing."""

    def _update_command(self, env_ids: Tensor | None) -> None:
        """Do nothing."""


def motion_command(env: ManagerBasedRlEnv) -> MotionCommand:
    """Return the command term of an environment."""
    term = env.command_manager.get_term(NAME)
    assert isinstance(term, MotionCommand)
    return term
