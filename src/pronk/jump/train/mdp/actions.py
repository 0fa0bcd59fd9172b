"""The policy's action: joint position targets, which reach the drives after a delay.

A target takes effect a number of physics steps after the policy issued it, one number for each
robot and episode, the same for all its joints, as on one bus. The delay may be longer than a policy
step: ages of targets are counted in physics steps.

mjlab's actuators can delay too, with a buffer that is read and written in every physics step. A
target changes once in a policy step, so it is enough to choose between the last targets in the
first few physics steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from mjlab.envs.mdp.actions import JointPositionAction, JointPositionActionCfg
from torch import Tensor

from pronk.errors import PronkError
from pronk.jump.train.mdp.actuators import Battery
from pronk.jump.train.mdp.masks import overwrite, robot_mask
from pronk.jump.train.mdp.rotors import Rotors

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

NAME = "joint_position"
"""The action term's name in every environment."""


@dataclass(kw_only=True)
class DelayedJointPositionActionCfg(JointPositionActionCfg):
    """Joint position targets with a command delay."""

    delay_steps: tuple[int, int] = (0, 0)
    """Smallest and largest delay, drawn uniformly at the start of an episode [physics steps]."""
    delay_span: tuple[float, float] | None = None
    """If not None: the delay is drawn uniformly in this span, within `delay_steps`, and rounded up
    or down by chance so that its mean is right [physics steps]."""

    def __post_init__(self) -> None:
        """Refuse a delay that is negative or falls."""
        super().__post_init__()
        low, high = self.delay_steps
        if self.delay_span is not None and not (
            low <= self.delay_span[0] <= self.delay_span[1] <= high
        ):
            raise PronkError(
                f"delay_span is {self.delay_span}; expected it rising within {low} to {high} "
                "physics steps."
            )
        if not 0 <= low <= high:
            raise PronkError(
                f"delay_steps is {low} to {high} physics steps; expected 0 or more, rising."
            )

    def build(self, env: ManagerBasedRlEnv) -> DelayedJointPositionAction:
        """Build the term of an environment."""
        return DelayedJointPositionAction(self, env)


class DelayedJointPositionAction(JointPositionAction):
    """Targets of N robots: default pose + scale * action, in force `lag` physics steps later."""

    cfg: DelayedJointPositionActionCfg

    def __init__(self, cfg: DelayedJointPositionActionCfg, env: ManagerBasedRlEnv) -> None:
        """Begin with the default pose in force."""
        super().__init__(cfg, env)
        low, high = cfg.delay_steps
        self.lag = torch.full((self.num_envs, 1), low, device=self.device)
        """Delay in this episode [physics steps]. (N, 1)"""
        self.battery = Battery(self._entity)
        self.advance_battery = self.battery.advance
        """What is called before each physics step; a recording may take its place."""
        self.rotors = Rotors(self._armatures(), env.physics_dt)
        """Rotors of the joints, as of the last `finish_step`."""
        self.position_target = torch.zeros_like(self._processed_actions)
        """Joint position targets of the policy step under way [rad]. (N, joints)"""
        self._is_step_open = False
        self.guidance = torch.zeros_like(self._processed_actions)
        """Added to the coming targets [rad]; stays in its memory, which recordings write to.
        (N, joints)"""
        all_joints = list(range(self._entity.num_joints))
        self._joints: slice | Tensor = self._target_ids
        if self._target_ids.tolist() == all_joints:
            # A slice costs a view where a list of indices costs a kernel.
            self._joints = slice(None)
        self._default: Tensor = self._entity.data.default_joint_pos[:, self._joints]
        # With a policy step of at least one physics step no older target can be in force.
        count = high + 1
        self._targets = self._default.repeat(count, 1, 1)
        """The last targets, as a ring that begins at `_newest` [rad]. (count, N, joints)"""
        self._newest = 0
        self._ages = [high] * count
        """Physics steps since each target was issued, newest first."""

    def process_actions(self, actions: Tensor) -> None:
        """Issue the targets of a policy step, of the network's actions (N, joints)."""
        super().process_actions(actions)
        self._processed_actions += self.guidance
        self.position_target.copy_(self._processed_actions)
        count = len(self._ages)
        self._newest = (self._newest + 1) % count
        self._ages = [0, *self._ages[:-1]]
        bias = self._entity.data.encoder_bias[:, self._joints]
        torch.sub(self._processed_actions, bias, out=self._targets[self._newest])

    def apply_actions(self) -> None:
        """Give the drives the targets that are in force in the coming physics step."""
        self.finish_step()
        low, high = self.cfg.delay_steps
        # A reset clears the drives' targets: the first physics step writes them in any case.
        changes = self._ages[0] == 0
        for age in self._ages:
            changes = changes or low <= age <= high
        if changes:
            self._entity.set_joint_position_target(self._in_force(), joint_ids=self._joints)
        self._ages = [age + 1 for age in self._ages]
        self.advance_battery()
        self._is_step_open = True

    def finish_step(self) -> Rotors:
        """Advance the rotors by the last physics step, if that has not been done; return them."""
        if self._is_step_open and not self.rotors.rigid:
            self.rotors.advance(self._entity.data.qfrc_actuator, self._entity.data.joint_acc)
        self._is_step_open = False
        return self.rotors

    def _armatures(self) -> Tensor:
        """Return the armatures of all joints [kg m^2], (N, joints)."""
        armatures = torch.ones_like(self._entity.data.joint_pos)
        for drive in self._entity.actuators:
            armatures[:, drive.target_ids] = drive.cfg.armature
        return armatures

    def _in_force(self) -> Tensor:
        """Return of each robot the newest target that is at least as old as its delay."""
        low, high = self.cfg.delay_steps
        count = len(self._ages)
        # The newest target that is old enough for every robot, then the newer ones.
        index = 0
        while self._ages[index] < high:
            index += 1
        target = self._targets[(self._newest - index) % count]
        for i in reversed(range(index)):
            if self._ages[i] >= low:
                newer_target = self._targets[(self._newest - i) % count]
                target = torch.where(self.lag <= self._ages[i], newer_target, target)
        return target

    def reset(self, env_ids: Tensor | slice | None = None) -> None:
        """Draw the delays of new episodes; the default pose is in force until a target arrives."""
        super().reset(env_ids)
        robots = robot_mask(env_ids, self.num_envs, self.device)
        self.battery.reset(robots)
        self.finish_step()
        self.rotors.reset(robots)
        self.guidance.masked_fill_(robots[:, None], 0.0)
        low, high = self.cfg.delay_steps
        if high == 0:
            return
        overwrite(self._targets, robots[:, None], self._default)
        if low < high:
            if self.cfg.delay_span is None:
                delays = torch.randint(low, high + 1, self.lag.shape, device=self.device)
            else:
                delays = self._rounded_delays(self.cfg.delay_span).clamp(low, high)
            overwrite(self.lag, robots[:, None], delays)

    def _rounded_delays(self, span: tuple[float, float]) -> Tensor:
        """Draw delays in a span, rounded by chance to physics steps of the same mean."""
        delays = torch.empty(self.lag.shape, device=self.device).uniform_(*span)
        return (delays + torch.rand_like(delays)).floor().to(self.lag.dtype)


def joint_position_action(env: ManagerBasedRlEnv) -> DelayedJointPositionAction:
    """Return the action term of an environment."""
    term = env.action_manager.get_term(NAME)
    assert isinstance(term, DelayedJointPositionAction)
    return term
