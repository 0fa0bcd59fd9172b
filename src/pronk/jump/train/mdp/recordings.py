"""What is recorded as CUDA graphs of the step of an environment, for `pronk train --compile`.

A step of thousands of robots is hundreds of kernels that take longer to launch one by one than to
compute. What is computed alike in every step of an iteration, on memory that stays, is recorded
once an iteration. Physics has graphs of its own; ends of episodes, whose robots are others in each
step, and histories of measurements, which Python numbers, are computed as they are.

What a phase sets is read when a function is recorded. A phase that begins in the last step of an
iteration, where mjlab calls the curriculum, takes effect in recordings with the next one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import torch
import warp
from torch import Tensor

from pronk.jump.train.compiled import RecordedFunction
from pronk.jump.train.mdp import observations
from pronk.jump.train.mdp.actions import joint_position_action
from pronk.jump.train.mdp.commands import motion_command
from pronk.jump.train.mdp.events import Pushes

if TYPE_CHECKING:
    from mjlab.envs import ManagerBasedRlEnv

_OBSERVATIONS = (
    observations.critic_state,
    observations.critic_jump_state,
    observations.estimator_target,
)
"""Observations of many operations each, without noise and history."""


class StepRecordings:
    """Recorded parts of the step of an environment."""

    def __init__(self, env: ManagerBasedRlEnv) -> None:
        """Compile and record the step of an environment from now on.

        Args:
            env: The environment, with a `StackedRewardManager`.
        """
        self._functions: list[RecordedFunction] = []
        self._device = env.device
        self._stream = None
        if env.device != "cpu":
            # mjlab writes to the simulator on the simulator's stream.
            physics_stream = warp.get_stream(env.sim.wp_device)
            self._stream = torch.cuda.ExternalStream(physics_stream.cuda_stream)
        motion_command(env).compile(self.record)
        env.reward_manager.compile(self.record)
        self._record_method(joint_position_action(env).battery, "advance")
        self._record_method(env.scene, "write_data_to_sim")
        self._record_method(env.termination_manager, "compute")
        for names in env.event_manager.active_terms.values():
            for name in names:
                event = env.event_manager.get_term_cfg(name).func
                if isinstance(event, Pushes):
                    event.record(self.record)
        for group, names in env.observation_manager.active_terms.items():
            for name in names:
                term = env.observation_manager.get_term_cfg(group, name)
                if term.func in _OBSERVATIONS:
                    term.func = self._recorded_term(env, term.func)

    def begin(self) -> None:
        """Begin an iteration: everything is recorded again."""
        for function in self._functions:
            function.begin()

    def record(
        self, function: Callable[[Mapping[str, Tensor]], tuple[Tensor, ...]]
    ) -> RecordedFunction:
        """Prepare a function to be recorded once an iteration."""
        recorded_function = RecordedFunction(function, self._device, self._stream)
        self._functions.append(recorded_function)
        return recorded_function

    def _record_method(self, owner: Any, name: str) -> None:
        """Put a recording in the place of a method that returns a tensor or nothing."""
        method = getattr(owner, name)

        def compute(_: Mapping[str, Tensor]) -> tuple[Tensor, ...]:
            result = method()
            return () if result is None else (result,)

        recorded_function = self.record(compute)

        def replay() -> Tensor | None:
            results = recorded_function()
            return results[0] if results else None

        setattr(owner, name, replay)

    def _recorded_term(
        self, env: ManagerBasedRlEnv, function: Callable[[ManagerBasedRlEnv], Tensor]
    ) -> Callable[[ManagerBasedRlEnv], Tensor]:
        """Return the recording of an observation."""
        recorded_function = self.record(lambda _: (function(env),))
        return lambda _: recorded_function()[0]
