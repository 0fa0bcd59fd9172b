"""What is recorded as CUDA graphs of the step of an environment, for `pronk train --compile`.

A step of thousands of robots is hundreds of kernels that take longer to launch one by one than to
compute. What is computed alike in every step of an iteration, on memory that stays, is recorded
once an iteration. Robots whose episodes end are given to recordings as masks. Physics has graphs of
its own; histories of measurements, which Python numbers, are computed as they are.

A CUDA graph does not run Python again, and what is compiled is compiled again for another number.
So rewards and terminations with a term of somebody else's `env_cfgs.py`, which may read what Python
counts, are computed as they are. What a phase sets is read when a function is recorded: a phase
that begins in the last step of an iteration, where mjlab calls the curriculum, takes effect in the
graphs with the next one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import torch
import warp
from mjlab.actuator import DcMotorActuator
from mjlab.utils.noise import NoiseModelCfg
from torch import Tensor

from pronk.jump.train.compiled import RecordedFunction, TensorFunction
from pronk.jump.train.mdp import observations
from pronk.jump.train.mdp.actions import joint_position_action
from pronk.jump.train.mdp.commands import motion_command
from pronk.jump.train.mdp.events import Pushes, reset_state
from pronk.jump.train.mdp.masks import robot_mask

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

_OBSERVATIONS = (
    observations.critic_state,
    observations.critic_jump_state,
    observations.estimator_target,
)
"""Observations of many operations each, without noise and history."""


class StepGraphs:
    """The recorded parts of the step of an environment."""

    def __init__(self, env: ManagerBasedRlEnv) -> None:
        """Compile and record the step of an environment from now on.

        Args:
            env: The environment, with a `StackedRewardManager`.
        """
        self.left_out: list[str] = []
        """Parts that are computed without graphs, with the terms that are not pronk's."""
        self._env = env
        self._functions: list[RecordedFunction] = []
        self._stream = None
        if env.device != "cpu":
            # mjlab writes to the simulator on the simulator's stream.
            physics_stream = warp.get_stream(env.sim.wp_device)
            self._stream = torch.cuda.ExternalStream(physics_stream.cuda_stream)
        motion_command(env).compile(self.record)
        if self._knows("rewards", env.reward_manager):
            env.reward_manager.compile(self.record)
        if self._knows("terminations", env.termination_manager):
            self._record_terminations()
        self._record_drives()
        self._record_events()
        self._record_observations()
        self._record_action_reset()

    def begin(self) -> None:
        """Begin an iteration: everything is recorded again."""
        for function in self._functions:
            function.begin()

    def record(self, function: TensorFunction) -> RecordedFunction:
        """Prepare a function to be recorded once an iteration."""
        recorded_function = RecordedFunction(function, self._env.device, self._stream)
        self._functions.append(recorded_function)
        return recorded_function

    def _knows(self, part: str, manager: Any) -> bool:
        """Return whether all terms of a manager are pronk's functions; note those that are not."""
        unknown = []
        for name in manager.active_terms:
            if not _is_ours(manager.get_term_cfg(name).func):
                unknown.append(name)
        if unknown:
            self.left_out.append(f"{part} ({', '.join(unknown)})")
        return not unknown

    def _record_terminations(self) -> None:
        """Record which episodes end, and the counts of them for the log."""
        manager = self._env.termination_manager
        compute = manager.compute
        recorded_compute = self.record(lambda _: (compute(),))
        manager.compute = lambda: recorded_compute()[0]

        def count(inputs: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
            ended = torch.stack([manager.get_term(name) for name in manager.active_terms])
            return ((ended & inputs["robots"]).sum(dim=1),)

        recorded_count = self.record(count)

        def reset(env_ids: Tensor | slice | None = None) -> dict[str, Tensor]:
            (counts,) = recorded_count({"robots": self._mask(env_ids)})
            log = {}
            for name, number in zip(manager.active_terms, counts, strict=True):
                log[f"Episode_Termination/{name}"] = number
            return log

        manager.reset = reset

    def _record_drives(self) -> None:
        """Record drives and batteries, which are computed in every physics step."""
        env = self._env
        unknown = []
        for name, entity in env.scene.entities.items():
            for drive in entity.actuators:
                if type(drive) is not DcMotorActuator or drive.cfg.delay_max_lag > 0:
                    unknown.append(name)
        if unknown:
            self.left_out.append(f"drives ({', '.join(sorted(set(unknown)))})")
            return
        action = joint_position_action(env)
        action.advance_battery = self._recorded_call(action.battery.advance)
        env.scene.write_data_to_sim = self._recorded_call(env.scene.write_data_to_sim)

    def _record_events(self) -> None:
        """Record pushes and the state in which an episode begins."""
        manager = self._env.event_manager
        for names in manager.active_terms.values():
            for name in names:
                term = manager.get_term_cfg(name)
                if isinstance(term.func, Pushes):
                    term.func.record(self.record)
                elif term.func is reset_state:
                    self._record_start(term)

    def _record_start(self, term: Any) -> None:
        """Record the event that draws the state in which an episode begins."""

        def draw(inputs: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
            reset_state(self._env, inputs["robots"], **term.params)
            return ()

        recorded_draw = self.record(draw)
        term.func = lambda env, env_ids, **_: recorded_draw({"robots": self._mask(env_ids)})

    def _record_observations(self) -> None:
        """Record observations of many operations, and how histories are cleared."""
        manager = self._env.observation_manager
        is_plain = True
        for group, names in manager.active_terms.items():
            for name in names:
                term = manager.get_term_cfg(group, name)
                has_state = hasattr(term.func, "reset") or isinstance(term.noise, NoiseModelCfg)
                is_plain = is_plain and not has_state and term.delay_max_lag == 0
                if term.func in _OBSERVATIONS:
                    term.func = self._recorded_term(term.func)
        if is_plain:
            self._record_reset(manager)

    def _recorded_term(
        self, function: Callable[[ManagerBasedRlEnv], Tensor]
    ) -> Callable[[ManagerBasedRlEnv], Tensor]:
        """Return the recording of an observation."""
        recorded_function = self.record(lambda _: (function(self._env),))
        return lambda _: recorded_function()[0]

    def _record_action_reset(self) -> None:
        """Record how actions, delays and batteries begin an episode."""
        manager = self._env.action_manager
        if len(manager.active_terms) > 1:
            return
        self._record_reset(manager)
        reset = manager.reset

        def reset_after_step(env_ids: Tensor | slice | None = None) -> dict[str, float]:
            # The action counts by Python whether a step of the rotors is open.
            joint_position_action(self._env).finish_step()
            log: dict[str, float] = reset(env_ids)
            return log

        manager.reset = reset_after_step

    def _record_reset(self, manager: Any) -> None:
        """Put a recording in the place of a manager's `reset`, which logs nothing."""
        reset = manager.reset

        def clear(inputs: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
            # mjlab assigns zeros to an index, which may be a mask.
            reset(inputs["robots"])
            return ()

        recorded_clear = self.record(clear)

        def replay(env_ids: Tensor | slice | None = None) -> dict[str, float]:
            recorded_clear({"robots": self._mask(env_ids)})
            return {}

        manager.reset = replay

    def _recorded_call(self, function: Callable[[], None]) -> Callable[[], None]:
        """Return the recording of a function without arguments and results."""

        def call(_: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
            function()
            return ()

        recorded_function = self.record(call)

        def replay() -> None:
            recorded_function()

        return replay

    def _mask(self, env_ids: Tensor | slice | None) -> Tensor:
        """Return robots as a mask, bool (N,)."""
        return robot_mask(env_ids, self._env.num_envs, self._env.device)


def _is_ours(function: Any) -> bool:
    """Return whether a term is a function of pronk's."""
    module = getattr(function, "__module__", "")
    return str(module).startswith("pronk.jump.train.mdp.")
