"""The runner: mjlab's, with the phases, checkpoints that are not unpickled, and the export.

`mjlab train` and `pronk train` use it alike. After the phase walk and after the last phase it
writes the policy, `walk.onnx` and `policy.onnx`, and a checkpoint named after the phase.
"""

from __future__ import annotations

import math
import os
import signal
import statistics
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from mjlab.rl import MjlabOnPolicyRunner, RslRlOnPolicyRunnerCfg

from pronk.errors import ArtefactError, PronkError
from pronk.jump.train import compiled
from pronk.jump.train.devices import check_cuda_graphs
from pronk.jump.train.mdp.commands import motion_command
from pronk.jump.train.mdp.reward_manager import StackedRewardManager
from pronk.jump.train.mdp.step_graphs import StepGraphs
from pronk.jump.train.phases import PHASES, curriculum, phase_at
from pronk.jump.train.recipe import (
    CONTACT_DAMPING,
    DECIMATION_SPREAD,
    ROTOR_FREQUENCY,
    task_numbers,
)
from pronk.jump.train.rl import checkpoint
from pronk.jump.train.rl.export import TOLERANCE, contract_for, export_policy, verify
from pronk.jump.train.training_progress import TrainingProgress, write_progress

KEPT_CHECKPOINTS = 3
"""Numbered checkpoints that are kept."""
COMPARED_OBSERVATIONS = 4096
"""Observations that an exported policy is compared on."""
PROGRESS_S = 10.0
"""Shortest time between two lines of progress [s]."""
PROGRESS_FILE_S = 2.0
"""Shortest time between two writings of `progress.json` [s]."""


@dataclass
class JumpRunnerCfg(RslRlOnPolicyRunnerCfg):
    """mjlab's configuration of a runner, and what `pronk train` adds."""

    show_progress: bool = False
    """Whether a line about the progress is printed now and then, on standard error."""
    stop_at: float | None = None
    """Time at which training stops, at a checkpoint [Unix time, s]; None for no limit."""
    start_sha256: str = ""
    """Hash of the checkpoint that training began with, for the exported policy's contract."""
    recipe_sha256: str = ""
    """Hash of the recipe, likewise; empty without one."""
    torch_compile_mode: str | None = None
    """`default` to compile the steps of robots and networks (`pronk.jump.train.compiled`), which
    changes how they round; None for none. The name is rsl_rl's."""


class PronkRunner(MjlabOnPolicyRunner):
    """Trains all phases; `current_learning_iteration` is the number of the iteration under way."""

    current_learning_iteration: int

    def __init__(
        self, env: Any, train_cfg: dict[str, Any], log_dir: str | None = None, device: str = "cpu"
    ) -> None:
        """Build algorithm and logger, as mjlab builds its runners.

        Args:
            env: The wrapped environment.
            train_cfg: Fields of `JumpRunnerCfg`, or of mjlab's configuration; its iterations must
                be as long as the curriculum's.
            log_dir: Folder of the run; None writes nothing.
            device: Device of the networks.

        Raises:
            PronkError: Iterations of another length than the curriculum's.
        """
        StackedRewardManager.install(env.unwrapped)
        self.curriculum = curriculum(env.unwrapped)
        self.curriculum.restart()
        steps = train_cfg["num_steps_per_env"]
        if steps != self.curriculum.steps_per_iteration:
            raise PronkError(
                f"num_steps_per_env is {steps}, but the curriculum counts "
                f"{self.curriculum.steps_per_iteration} steps an iteration; give both alike."
            )
        compiles = train_cfg.get("torch_compile_mode") is not None
        self._step_graphs: StepGraphs | None = None
        if compiles:
            compiled.prepare(device)
        super().__init__(env, train_cfg, log_dir, device)
        if compiles:
            self._step_graphs = StepGraphs(env.unwrapped)
            for part in self._step_graphs.left_out:
                self.note(f"note: --compile leaves {part} as it is: not all of it is pronk's own.")
        warning = check_cuda_graphs(env.unwrapped.sim, device)
        if warning is not None:
            self.note(f"warning: {warning}")
        if compiles and not self.alg.is_compiled:
            self.note(
                "warning: --compile leaves the networks as they are: it knows PPO with a Gaussian "
                "of one standard deviation an action, an adaptive learning rate, values that are "
                "not clipped and advantages of the whole rollout, without a mirror loss."
            )
        self.folder = None if log_dir is None else Path(log_dir)
        self.phases: dict[str, dict[str, Any]] = {}
        """Figures of the phases that were finished: iterations, seconds, and so on."""
        self.stop_reason = ""
        """If not empty, training ends with a checkpoint after the present iteration."""
        self._steps_per_iteration = steps * env.num_envs * self.gpu_world_size
        self._seconds = 0.0
        self._shown_at = -math.inf
        self._wrote_progress_at = -math.inf
        self._jumping = False

    def _configure_multi_gpu(self) -> None:
        """Make the process group, of GPUs as rsl_rl does; it has none of CPUs."""
        world_size = int(os.environ.get("WORLD_SIZE", "1"))
        if self.device != "cpu" or world_size == 1:
            super()._configure_multi_gpu()
            return
        self.gpu_world_size = world_size
        self.is_distributed = True
        self.gpu_local_rank = int(os.environ["LOCAL_RANK"])
        self.gpu_global_rank = int(os.environ["RANK"])
        self.cfg["multi_gpu"] = {
            "global_rank": self.gpu_global_rank,
            "local_rank": self.gpu_local_rank,
            "world_size": world_size,
        }
        torch.distributed.init_process_group(
            backend="gloo", rank=self.gpu_global_rank, world_size=world_size
        )

    @property
    def iteration(self) -> int:
        """Number of finished iterations, by the environment's step counter."""
        return int(self.env.unwrapped.common_step_counter) // self.curriculum.steps_per_iteration

    def learn(self, num_learning_iterations: int, init_at_random_ep_len: bool = False) -> None:
        """Train on, until the last phase is over or `stop_reason` is set.

        This is rsl_rl's loop, with the phase set before every iteration, the logger behind the
        rollout, and the checks of `_finish_iteration` at the end. The first SIGINT or SIGTERM ends
        training after the present iteration.

        Args:
            num_learning_iterations: Iterations to train, at most.
            init_at_random_ep_len: Whether the robots begin anywhere in their episodes.

        Raises:
            PronkError: Learning has diverged.
        """
        self._begin_iteration()
        if init_at_random_ep_len:
            self.env.episode_length_buf = torch.randint_like(
                self.env.episode_length_buf, high=int(self.env.max_episode_length)
            )
        with torch.inference_mode():
            # Of the kind of all later ones, which compiled functions are compiled for.
            obs = self.env.get_observations().to(self.device).clone()
        self.alg.train_mode()
        if self.is_distributed:
            self.alg.broadcast_parameters()
        self.logger.init_logging_writer()
        start_it = self.current_learning_iteration
        total_it = start_it + min(num_learning_iterations, self.curriculum.total - self.iteration)
        with stop_signals(self):
            for it in range(start_it, total_it):
                self.current_learning_iteration = it
                start = time.time()
                try:
                    with torch.inference_mode():
                        steps = []
                        for _ in range(self.cfg["num_steps_per_env"]):
                            actions = self.alg.act(obs)
                            # The environment ends the episode of a robot whose state is not finite.
                            obs, rewards, dones, extras = self.env.step(actions)
                            self.alg.process_env_step(obs, rewards, dones, extras)
                            # mjlab returns one dictionary, whose entries it replaces.
                            steps.append((rewards, dones, dict(extras)))
                        # The logger waits for the device three times a step, and keeps it from
                        # being given the next step meanwhile; after the rollout it waits once.
                        logs = []
                        for rewards, dones, extras in steps:
                            logs.append(extras.pop("log"))
                            self.logger.process_env_step(rewards, dones, extras)
                        if self.logger.writer is not None:
                            self.logger.ep_extras.append(mean_log(logs))
                        collect_time = time.time() - start
                        self.alg.compute_returns(obs)
                    losses = self.alg.update()
                except (ValueError, RuntimeError) as error:
                    # PyTorch refuses to draw with a standard deviation that is NaN.
                    self._check_finite(self.alg.save(), cause=error)
                    raise
                learn_time = time.time() - start - collect_time
                self.logger.log(
                    it=it,
                    start_it=start_it,
                    total_it=total_it,
                    collect_time=collect_time,
                    learn_time=learn_time,
                    loss_dict=losses,
                    learning_rate=self.alg.learning_rate,
                    action_std=self.alg.get_policy().output_std,
                    rnd_weight=None,
                )
                self._finish_iteration(losses, collect_time + learn_time)
                self._begin_iteration()
                is_last = it == total_it - 1 or self._stops()
                if is_last or it % self.cfg["save_interval"] == 0:
                    self._save_numbered()
                if is_last:
                    break
        if hasattr(self.logger.writer, "flush"):
            self.logger.writer.flush()
        self.logger.stop_logging_writer()

    def _begin_iteration(self) -> None:
        """Set the phase of the iteration that begins."""
        if self._step_graphs is not None:
            self._step_graphs.begin()
        self.env.unwrapped.curriculum_manager.compute()
        name, done = phase_at(self.curriculum.iterations, self.iteration)
        phase = PHASES[name]
        self.alg.entropy_coef = phase.entropy
        self.alg.set_estimator_rate(phase.estimator_rate)
        self.alg.get_policy().limit_noise(phase.largest_noise(done))
        if phase.jump and not self._jumping:
            self.alg.reset_jump_moments()
        self._jumping = phase.jump

    def _finish_iteration(self, losses: Mapping[str, float], seconds: float) -> None:
        """Check the losses, finish a phase that is over, and show the progress.

        Args:
            losses: Mean losses of the iteration by name.
            seconds: Duration of the iteration [s].
        """
        for name, value in losses.items():
            if not math.isfinite(value):
                raise self._diverged(f"the loss {name} is {value}")
        self._seconds += seconds
        phase_name, _ = phase_at(self.curriculum.iterations, self.iteration - 1)
        next_phase_name, done = phase_at(self.curriculum.iterations, self.iteration)
        if next_phase_name != phase_name or done == 1.0:
            self._finish_phase(phase_name)
        self._write_progress(phase_name, seconds)
        if self.cfg.get("show_progress"):
            self._show_progress(phase_name, seconds)

    def _stops(self) -> bool:
        """Return whether training ends here; if any process stops, all do."""
        stop_at = self.cfg.get("stop_at")
        if stop_at is not None and time.time() > stop_at and not self.stop_reason:
            self.stop_reason = "the time given by --minutes is over"
        stops = self.stop_reason != ""
        if self.is_distributed:
            any_stops = torch.tensor(float(stops), device=self.device)
            torch.distributed.all_reduce(any_stops, op=torch.distributed.ReduceOp.MAX)
            stops = bool(any_stops)
        return stops

    def _write_progress(self, phase: str, seconds: float) -> None:
        """Write `progress.json`, unless that was done a moment ago and this is not the end."""
        if self.folder is None or self.gpu_global_rank != 0:
            return
        total = self.curriculum.total
        now = time.monotonic()
        if now - self._wrote_progress_at < PROGRESS_FILE_S and self.iteration < total:
            return
        self._wrote_progress_at = now
        reward = None
        episode_steps = None
        if self.logger.rewbuffer:
            reward = float(statistics.mean(self.logger.rewbuffer))
            episode_steps = float(statistics.mean(self.logger.lenbuffer))
        progress = TrainingProgress(
            phase=phase,
            iteration=self.iteration,
            iterations=total,
            steps_per_second=self._steps_per_iteration / seconds,
            seconds_left=seconds * (total - self.iteration),
            reward=reward,
            episode_steps=episode_steps,
            speed_range=float(motion_command(self.env.unwrapped).ranges.fraction),
        )
        write_progress(self.folder, progress)

    def _show_progress(self, phase: str, seconds: float) -> None:
        """Print a line about the progress, unless another was printed a moment ago."""
        done = self.iteration
        total = self.curriculum.total
        now = time.monotonic()
        if now - self._shown_at < PROGRESS_S and done < total:
            return
        self._shown_at = now
        episodes = ""
        if self.logger.rewbuffer:
            reward = statistics.mean(self.logger.rewbuffer)
            length = statistics.mean(self.logger.lenbuffer)
            episodes = f"reward {reward:.2f}  episode {length:.0f} steps  "
        fraction = float(motion_command(self.env.unwrapped).ranges.fraction)
        self.note(
            f"{phase} {done}/{total}  {self._steps_per_iteration / seconds:,.0f} steps/s  "
            f"{episodes}speed range {fraction:.2f}  "
            f"{timedelta(seconds=round(seconds * (total - done)))} left"
        )

    def note(self, text: str) -> None:
        """Print a line of the first process on standard error."""
        if self.gpu_global_rank == 0:
            print(text, file=sys.stderr, flush=True)  # noqa: T201

    # --- Phases ----------------------------------------------------------------------------------

    def _finish_phase(self, name: str) -> None:
        """Write the checkpoint of a phase and, after walk and the last one, the policy."""
        if self.folder is None or self.gpu_global_rank != 0 or name in self.phases:
            return
        iterations = self.curriculum.iterations[name]
        steps = iterations * self._steps_per_iteration
        seconds = self._seconds
        for phase in self.phases.values():
            seconds -= phase["seconds"]
        self.phases[name] = {
            "iterations": iterations,
            "env_steps": steps,
            "seconds": seconds,
            "steps_per_second": steps / seconds,
        }
        self.save(str(self.folder / f"{name}.pt"))
        is_last = self.iteration >= self.curriculum.total
        if is_last or name == "walk":
            path = self.folder / ("policy.onnx" if is_last else "walk.onnx")
            self.phases[name]["onnx_difference"] = self._export(path, name)

    def _export(self, path: Path, phase: str) -> float:
        """Write a policy.

        Args:
            path: The file to write.
            phase: The phase that is over.

        Returns:
            Largest difference of its outputs from PyTorch's on the last rollout.
        """
        env = self.env.unwrapped
        iterations = {name: figures["iterations"] for name, figures in self.phases.items()}
        provenance: dict[str, Any] = {
            "run": path.parent.resolve().name,
            "phases": iterations,
            "envs": env.num_envs * self.gpu_world_size,
            "seed": self.cfg["seed"],
            "ranges_sha256": motion_command(env).cfg.gains.sha256,
            "start_sha256": self.cfg.get("start_sha256", ""),
        }
        if motion_command(env).cfg.gains.joints:
            provenance["by_joint"] = True
        if "strength" in env.cfg.events:
            provenance["weakest_drive"] = env.cfg.events["strength"].params["weakest"]
        # The scale of the actions is in the contract.
        numbers = task_numbers(env.cfg)
        for name in (CONTACT_DAMPING, DECIMATION_SPREAD, ROTOR_FREQUENCY):
            provenance[name] = numbers[name]
        if env.cfg.events["gains"].params.get("shape") == "ellipsoid":
            provenance["ellipsoid"] = True
        if self.cfg.get("recipe_sha256"):
            provenance["recipe_sha256"] = self.cfg["recipe_sha256"]
        unmatched = motion_command(env).cfg.gains.unmatched
        if unmatched:
            # Joints that were no match, with the reasons (`pronk train --allow-unmatched`).
            provenance["unmatched"] = {joint: list(reasons) for joint, reasons in unmatched.items()}
        contract = contract_for(env.cfg, jump=PHASES[phase].jump, provenance=provenance)
        actor = self.alg.get_policy()
        export_policy(actor, contract, path)
        rollout = self.alg.storage.observations.flatten(0, 1)[:COMPARED_OBSERVATIONS]
        inputs = {"measured": rollout["measured"], "jump": rollout["jump"]}
        difference = verify(path, actor, inputs)
        if not difference <= TOLERANCE:
            self.note(
                f"warning: {path} differs from PyTorch by {difference:.1e}, over {TOLERANCE:g}"
            )
        return difference

    # --- Checkpoints -----------------------------------------------------------------------------

    def _save_numbered(self) -> None:
        """Write the checkpoint of the last iteration, and remove old ones."""
        if self.folder is None or self.gpu_global_rank != 0:
            return
        self.save(str(self.folder / f"model_{self.current_learning_iteration}.pt"))
        for path in checkpoint.numbered_checkpoints(self.folder)[:-KEPT_CHECKPOINTS]:
            path.unlink(missing_ok=True)

    def save(self, path: str, infos: Mapping[str, Any] | None = None) -> None:
        """Write a checkpoint, whole or not at all.

        Args:
            path: The file to write.
            infos: Further entries beside the counters.

        Raises:
            PronkError: Weights that are not finite.
        """
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
            "processes": self.gpu_world_size,
            "stopped": self.stop_reason,
        }
        checkpoint.write_checkpoint(Path(path), state)
        if self.cfg["upload_model"]:
            self.logger.save_model(path, self.current_learning_iteration)

    def load(
        self,
        path: str,
        load_cfg: Mapping[str, bool] | None = None,
        strict: bool = True,
        map_location: str | None = None,
    ) -> dict[str, Any]:
        """Resume from a checkpoint, or load parts of it; robots start anew.

        Args:
            path: The checkpoint.
            load_cfg: rsl_rl's `actor`, `critic`, `optimizer`, `iteration`; None for everything.
            strict: Whether all weights must be there.
            map_location: Device to load to; the runner's if None.

        Returns:
            The entries beside the counters.

        Raises:
            ArtefactError: No checkpoint, or one of other networks.
        """
        state = checkpoint.read_checkpoint(Path(path), map_location or self.device)
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
            self._jumping = PHASES[name].jump and checkpoint.uses_jump_input(state)
            # Draws other than those of the beginning.
            torch.manual_seed(self.cfg["seed"] + self.current_learning_iteration)
        return infos

    def _check_finite(self, state: Any, cause: Exception | None = None) -> None:
        """Refuse a state with a number that is not finite."""
        tensor_path = checkpoint.not_finite(state)
        if tensor_path is not None:
            raise self._diverged(f"{tensor_path} is not finite") from cause

    def _diverged(self, reason: str) -> PronkError:
        """Return the error of learning that has diverged."""
        text = (
            f"learning diverged in iteration {self.iteration}: {reason}; train with another seed "
            "or a smaller learning rate"
        )
        good_checkpoint = None if self.folder is None else checkpoint.latest_checkpoint(self.folder)
        if good_checkpoint is not None:
            text += f"; {good_checkpoint} is the last good checkpoint"
        return PronkError(f"{text}.")


def mean_log(logs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Average what the steps of a rollout log, which the logger does with a copy for each step.

    Args:
        logs: Numbers or tensors, (), by name, of each step; a name may be missing in some.

    Returns:
        Mean over the steps that have it, by name.
    """
    values_of: dict[str, list[Any]] = {}
    for log in logs:
        for name, value in log.items():
            values_of.setdefault(name, []).append(value)
    means: dict[str, Any] = {}
    for name, values in values_of.items():
        if isinstance(values[0], torch.Tensor):
            means[name] = torch.stack(values).float().mean()
        else:
            means[name] = statistics.fmean(values)
    return means


@contextmanager
def stop_signals(runner: Any) -> Iterator[None]:
    """Let the first SIGINT or SIGTERM inside the block set the runner's `stop_reason`.

    The next one has its usual effect. Python delivers signals to the main thread alone; in another
    thread the block changes nothing.
    """
    handlers = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            handlers[number] = signal.getsignal(number)

    def stop(number: int, _: FrameType | None) -> None:
        signal.signal(number, handlers[signal.Signals(number)])
        runner.stop_reason = signal.Signals(number).name

    for number in handlers:
        signal.signal(number, stop)
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
