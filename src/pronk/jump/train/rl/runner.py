"""The runner: mjlab's, with the phases, checkpoints that are not unpickled, and the export.

`mjlab train` and `pronk train` use it alike. After the phase walk and after the last phase it
writes the policy, `walk.onnx` and `policy.onnx`, and a checkpoint named after the phase.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Mapping
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch
from mjlab.rl import MjlabOnPolicyRunner
from rsl_rl.utils.logger import Logger
from torch import Tensor

from pronk.errors import ArtefactError, PronkError
from pronk.jump.train.mdp.commands import motion_command
from pronk.jump.train.mdp.reward_manager import StackedRewardManager
from pronk.jump.train.phases import PHASES, curriculum, phase_at
from pronk.jump.train.rl import checkpoint
from pronk.jump.train.rl.export import TOLERANCE, contract_for, export_policy, verify

_KEPT = 3
"""Numbered checkpoints that are kept."""
_COMPARED = 4096
"""Observations that an exported policy is compared on."""


class Stopped(Exception):  # noqa: N818 (a signal, not an error)
    """Training ends after the present iteration."""


class DeviceLogger(Logger):
    """rsl_rl's logger with episode figures summed on the device, copied once an iteration.

    rsl_rl copies returns and lengths of finished episodes to the host in every environment step,
    and each copy waits for the GPU. Means are over the episodes that ended in the last iterations,
    100 or more of them.
    """

    def __init__(self, runner: PronkRunner) -> None:
        """Take the place of the logger that rsl_rl has given the runner."""
        self.__dict__.update(vars(runner.logger))
        self.device = "cpu"
        """rsl_rl averages the figures of an iteration here."""
        self._runner = runner
        self._sums = torch.zeros(3, device=runner.device)
        """Of the iteration: returns, lengths and number of finished episodes."""
        self._recent: list[list[float]] = []

    def process_env_step(
        self,
        rewards: Tensor,
        dones: Tensor,
        extras: dict[str, Any],
        intrinsic_rewards: Tensor | None = None,
    ) -> None:
        """Add the figures of one environment step."""
        self.ep_extras.append(extras["log"])
        self.cur_reward_sum += rewards
        self.cur_episode_length += 1.0
        ended = dones > 0
        done = ended.to(rewards.dtype)
        returns, lengths = self.cur_reward_sum, self.cur_episode_length
        self._sums += torch.stack([torch.dot(returns, done), torch.dot(lengths, done), done.sum()])
        returns.masked_fill_(ended, 0.0)
        lengths.masked_fill_(ended, 0.0)

    def log(self, it: int, *, loss_dict: dict[str, float], **figures: Any) -> None:
        """Write the figures of an iteration, then let the runner finish it."""
        self._recent.append(self._sums.tolist())
        self._sums.zero_()
        while sum(count for *_, count in self._recent[1:]) >= 100:
            self._recent.pop(0)
        returns, lengths, count = (sum(column) for column in zip(*self._recent, strict=True))
        self.rewbuffer.clear()
        self.lenbuffer.clear()
        if count:
            self.rewbuffer.append(returns / count)
            self.lenbuffer.append(lengths / count)
        self.ep_extras[:] = [_means(self.ep_extras)]
        seconds = figures["collect_time"] + figures["learn_time"]
        if self.writer is not None:
            super().log(it, loss_dict=loss_dict, **figures)
        self.ep_extras.clear()
        self._runner.finish_iteration(it, loss_dict, seconds)


def _means(logs: list[dict[str, Any]]) -> dict[str, Tensor]:
    """Mean of every figure over the steps that have it."""
    gathered: dict[str, list[Tensor]] = {}
    for log in logs:
        for name, value in log.items():
            gathered.setdefault(name, []).append(torch.as_tensor(value))
    return {name: torch.stack(values).double().mean() for name, values in gathered.items()}


class PronkRunner(MjlabOnPolicyRunner):
    """Trains all phases; `current_learning_iteration` counts the finished iterations."""

    def __init__(
        self, env: Any, train_cfg: dict[str, Any], log_dir: str | None = None, device: str = "cpu"
    ) -> None:
        """As mjlab makes its runners; the curriculum's iterations must be as long as its own."""
        StackedRewardManager.install(env.unwrapped)
        self.curriculum = curriculum(env.unwrapped)
        steps = train_cfg["num_steps_per_env"]
        if steps != self.curriculum.steps_per_iteration:
            raise PronkError(
                f"num_steps_per_env is {steps}, but the curriculum counts "
                f"{self.curriculum.steps_per_iteration} steps an iteration; give both alike."
            )
        # The environment ends the episode of a robot whose state is not finite.
        train_cfg["check_for_nan"] = False
        super().__init__(env, train_cfg, log_dir, device)
        self.logger = DeviceLogger(self)
        self.folder = None if log_dir is None else Path(log_dir)
        self.provenance: dict[str, Any] = {}
        """Further entries for the provenance in the contract of exported policies."""
        self.phases: dict[str, dict[str, Any]] = {}
        """Figures of the phases that were finished: iterations, seconds, and so on."""
        self.show_progress = False
        """Print a line after an iteration, at most one in ten seconds."""
        self.stop_reason = ""
        """If not empty, training ends with a checkpoint after the present iteration."""
        self.deadline = math.inf
        """Training stops after the iteration in which `time.monotonic` passes this [s]."""
        self._steps_per_iteration = steps * env.num_envs * self.gpu_world_size
        self._seconds = 0.0
        self._shown = -math.inf
        self._jumping = False

    @property
    def iteration(self) -> int:
        """Finished iterations by the environment's step counter."""
        return int(self.env.unwrapped.common_step_counter) // self.curriculum.steps_per_iteration

    def learn(self, num_learning_iterations: int, init_at_random_ep_len: bool = False) -> None:
        """Train on, until all iterations are done or `stop_reason` is set."""
        self._begin_iteration()
        try:
            super().learn(num_learning_iterations, init_at_random_ep_len)
        except Stopped:
            if self.folder is not None and self.gpu_global_rank == 0:
                self.save(str(self.folder / f"model_{self.current_learning_iteration}.pt"))
        except (ValueError, RuntimeError) as error:
            # torch refuses to draw with a standard deviation that is NaN.
            self._check_finite(self.alg.save(), cause=error)
            raise
        if hasattr(self.logger.writer, "flush"):
            self.logger.writer.flush()

    def _begin_iteration(self) -> None:
        """Set the phase of the iteration that begins."""
        env = self.env.unwrapped
        env.curriculum_manager.compute()
        name, done = phase_at(self.curriculum.iterations, self.iteration)
        phase = PHASES[name]
        self.alg.entropy_coef = phase.entropy
        self.alg.set_estimator_rate(phase.estimator_rate)
        self.alg.get_policy().limit_noise(phase.largest_noise(done))
        if phase.jump and not self._jumping:
            self.alg.reset_jump_moments()
        self._jumping = phase.jump

    def finish_iteration(self, it: int, losses: Mapping[str, float], seconds: float) -> None:
        """Called after every iteration: checks, phase borders, progress, stop."""
        for name, value in losses.items():
            if not math.isfinite(value):
                raise self._diverged(f"the loss {name} is {value}")
        self._seconds += seconds
        before, _ = phase_at(self.curriculum.iterations, self.iteration - 1)
        after, done = phase_at(self.curriculum.iterations, self.iteration)
        if after != before or done == 1.0:
            self._finish_phase(before)
        self._begin_iteration()
        if self.show_progress:
            self._show_progress(before, seconds)
        if time.monotonic() > self.deadline and not self.stop_reason:
            self.stop_reason = "the time given by --minutes is over"
        stops = torch.tensor(float(bool(self.stop_reason)), device=self.device)
        if self.is_distributed:  # if any process stops, all do
            torch.distributed.all_reduce(stops, op=torch.distributed.ReduceOp.MAX)
        if stops:
            raise Stopped

    def _show_progress(self, phase: str, seconds: float) -> None:
        done, total, now = self.iteration, self.curriculum.total, time.monotonic()
        if now - self._shown < 10.0 and done < total:
            return
        self._shown = now
        episodes = ""
        if self.logger.rewbuffer:
            reward, length = self.logger.rewbuffer[0], self.logger.lenbuffer[0]
            episodes = f"reward {reward:.2f}  episode {length:.0f} steps  "
        fraction = float(motion_command(self.env.unwrapped).ranges.fraction)
        note(
            self.gpu_global_rank,
            f"{phase} {done}/{total}  {self._steps_per_iteration / seconds:,.0f} steps/s  "
            f"{episodes}speed range {fraction:.2f}  "
            f"{timedelta(seconds=round(seconds * (total - done)))} left",
        )

    # --- Phases ----------------------------------------------------------------------------------

    def _finish_phase(self, name: str) -> None:
        """Write the checkpoint of a phase and, after walk and the last one, the policy."""
        if self.folder is None or self.gpu_global_rank != 0 or name in self.phases:
            return
        iterations = self.curriculum.iterations[name]
        steps = iterations * self._steps_per_iteration
        seconds = self._seconds - sum(phase["seconds"] for phase in self.phases.values())
        self.phases[name] = {
            "iterations": iterations,
            "env_steps": steps,
            "seconds": seconds,
            "steps_per_second": steps / seconds,
        }
        self.save(str(self.folder / f"{name}.pt"))
        last = self.iteration >= self.curriculum.total
        if last or name == "walk":
            path = self.folder / ("policy.onnx" if last else "walk.onnx")
            self.phases[name]["onnx_difference"] = self._export(path, name)

    def _export(self, path: Path, phase: str) -> float:
        """Write a policy; largest difference of its outputs from PyTorch's on the last rollout."""
        env = self.env.unwrapped
        contract = contract_for(
            env.cfg,
            jump=PHASES[phase].jump,
            provenance={
                "run": path.parent.resolve().name,
                "phases": {n: p["iterations"] for n, p in self.phases.items()},
                "envs": env.num_envs * self.gpu_world_size,
                "seed": self.cfg["seed"],
                "ranges_sha256": motion_command(env).cfg.gains.sha256,
                **self.provenance,
            },
        )
        actor = self.alg.get_policy()
        export_policy(actor, contract, path)
        observations = self.alg.storage.observations.flatten(0, 1)[:_COMPARED]
        difference = verify(path, actor, {n: observations[n] for n in ("measured", "jump")})
        if not difference <= TOLERANCE:
            note(
                self.gpu_global_rank,
                f"warning: {path} differs from PyTorch by {difference:.1e}, over {TOLERANCE:g}",
            )
        return difference

    # --- Checkpoints -----------------------------------------------------------------------------

    def save(self, path: str, infos: Mapping[str, Any] | None = None) -> None:
        """Write a checkpoint, whole or not at all; weights that are not finite are refused."""
        state = self.alg.save()
        self._check_finite(state)
        env = self.env.unwrapped
        state["iter"] = self.current_learning_iteration
        state["infos"] = {
            **(infos or {}),
            "env_state": {"common_step_counter": env.common_step_counter},
            "speed_ranges": float(motion_command(env).ranges.grown),
            "phases": self.phases,
            "seconds": self._seconds,
        }
        checkpoint.write(Path(path), state)
        for old in checkpoint.numbered(Path(path).parent)[:-_KEPT]:
            old.unlink(missing_ok=True)
        if self.cfg["upload_model"]:
            self.logger.save_model(path, self.current_learning_iteration)

    def load(
        self,
        path: str,
        load_cfg: Mapping[str, bool] | None = None,
        strict: bool = True,
        map_location: str | None = None,
    ) -> dict[str, Any]:
        """Resume from a checkpoint, or load parts of it.

        Robots start anew. `load_cfg` is rsl_rl's: `actor`, `critic`, `optimizer`, `iteration`.
        """
        state = checkpoint.read(Path(path), map_location or self.device)
        try:
            resumed = self.alg.load(state, load_cfg, strict)
        except (KeyError, RuntimeError, ValueError) as error:
            reason = str(error).strip().splitlines()[-1].strip()
            raise ArtefactError(
                f"{path}: its networks are not those of this run ({reason})."
            ) from error
        infos: dict[str, Any] = state["infos"] or {}
        env = self.env.unwrapped
        if "env_state" in infos:
            env.common_step_counter = infos["env_state"]["common_step_counter"]
        motion_command(env).ranges.grown.fill_(infos.get("speed_ranges", 0.0))
        if resumed:
            self.current_learning_iteration = state["iter"] + 1
            self.phases = dict(infos.get("phases", {}))
            self._seconds = infos.get("seconds", 0.0)
            name, _ = phase_at(self.curriculum.iterations, self.iteration)
            self._jumping = PHASES[name].jump and checkpoint.jumps(state)
            # Draws other than those of the beginning.
            torch.manual_seed(self.cfg["seed"] + self.current_learning_iteration)
        return infos

    def _check_finite(self, state: Any, cause: Exception | None = None) -> None:
        bad = checkpoint.not_finite(state)
        if bad is not None:
            raise self._diverged(f"{bad} is not finite") from cause

    def _diverged(self, reason: str) -> PronkError:
        last = None if self.folder is None else checkpoint.latest(self.folder)
        good = "" if last is None else f"; {last} is the last good checkpoint"
        return PronkError(
            f"learning diverged in iteration {self.iteration}: {reason}; train with another seed "
            f"or a smaller learning rate{good}."
        )


def note(rank: int, text: str) -> None:
    """Print a line of the first process on standard error."""
    if rank == 0:
        print(text, file=sys.stderr, flush=True)  # noqa: T201
