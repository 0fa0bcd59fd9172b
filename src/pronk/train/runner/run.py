"""One training run in one process: build once, walk, widen, jump, export; from any checkpoint on.

One environment serves all phases, since building it and compiling its kernels takes a minute.
Every phase has a runner of its own, which takes over networks, optimizers and counters from the
one before. A resumed run builds the runner of the phase it was in and loads networks, optimizers
and counters from the last checkpoint; its robots start anew.

Iterations are counted through all phases, so that curves and checkpoints stand in one row.
"""

from __future__ import annotations

import contextlib
import os
import time
from dataclasses import asdict
from functools import partial
from pathlib import Path

import torch
from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl import RslRlVecEnvWrapper
from mjlab.utils.torch import configure_torch_backends
from rich.console import Console

from pronk.errors import ArtefactError
from pronk.files import sha256
from pronk.train.mdp.commands import motion_command
from pronk.train.phases import Phase, enter_phase
from pronk.train.rl.export import TOLERANCE, export_policy, verify
from pronk.train.rl.widen import widen_state
from pronk.train.runner import checkpoint, provenance
from pronk.train.runner.devices import check_cuda_graphs
from pronk.train.runner.kernels import compile_ahead, kernel_seconds
from pronk.train.runner.resolve import run_contract, run_gains, run_phases, run_randomization
from pronk.train.runner.run_folder import RunFolder
from pronk.train.runner.runner import PronkRunner
from pronk.train.runner.settings import TrainSettings, WatchSettings
from pronk.train.tasks import env_cfg, rl_cfg

_COMPARED = 4096
"""Observations that an exported policy is compared on."""


class PhaseRunner(PronkRunner):
    """The runner of one phase; in a group of processes, the next one joins the same group."""

    def _configure_multi_gpu(self) -> None:
        if not torch.distributed.is_initialized():
            super()._configure_multi_gpu()
            return
        self.is_distributed = True
        self.gpu_world_size = torch.distributed.get_world_size()
        self.gpu_global_rank = torch.distributed.get_rank()
        self.gpu_local_rank = int(os.environ["LOCAL_RANK"])
        self.cfg["multi_gpu"] = {
            "global_rank": self.gpu_global_rank,
            "local_rank": self.gpu_local_rank,
            "world_size": self.gpu_world_size,
        }


def train_run(folder: RunFolder, settings: TrainSettings, watch: WatchSettings) -> None:
    """What one process does: all of a run, or the rest of it.

    Args:
        folder: With `config.yaml`, `provenance.json` and the copy of the gains in it.
        settings: What is trained.
        watch: How it is watched.

    Raises:
        PronkError: Learning has diverged, or a file of the run is missing, damaged or of another
            run.
    """
    rank = int(os.environ.get("RANK", "0"))
    log = folder.log if rank == 0 else folder.log.with_suffix(f".{rank}.log")
    with log.open("a", encoding="utf-8", buffering=1) as file, contextlib.redirect_stdout(file):
        _Run(folder, settings, watch, rank, log).train()


class _Run:
    """The state of `train_run`."""

    def __init__(
        self,
        folder: RunFolder,
        settings: TrainSettings,
        watch: WatchSettings,
        rank: int,
        log: Path,
    ) -> None:
        self.begin = time.monotonic()
        self.folder = folder
        self.settings = settings
        self.watch = watch
        self.rank = rank
        self.log = log
        self.console = Console(stderr=True, highlight=False, soft_wrap=True)
        self.gains = run_gains(settings, folder.gains)
        self.phases = run_phases(settings)
        self.device = "cpu"
        if settings.device == "cuda":
            self.device = f"cuda:{os.environ.get('LOCAL_RANK', '0')}"
            torch.cuda.set_device(self.device)
        configure_torch_backends()

    def train(self) -> None:
        """Everything that is left to do."""
        printed = self.log.stat().st_size
        last = checkpoint.latest(self.folder.checkpoints)
        first = 0 if last is None else self._phase_of(last)
        self.env = self._build()
        runner: PhaseRunner | None = None
        for phase in self.phases[first:]:
            fresh = runner is None
            if runner is None and last is not None:
                # A checkpoint is of one configuration, which changes within a phase.
                done = self._part_of(phase, checkpoint.about(last)["iteration"])
                enter_phase(self.env.unwrapped, phase, done)
                runner = self._runner(phase)
                runner.load(last)
                # Draws other than those of the beginning.
                seed = self.settings.seed + self.rank
                torch.manual_seed(seed + runner.current_learning_iteration)
            else:
                enter_phase(self.env.unwrapped, phase)
                runner = self._successor(runner, phase)
            end = self._end_of(phase)
            left = end - runner.current_learning_iteration
            if left > 0:
                self._go_on(runner, phase)
                runner.learn(
                    left,
                    init_at_random_ep_len=fresh,
                    on_iteration=partial(self._after_iteration, phase=phase),
                )
            finished = runner.current_learning_iteration == end
            if finished:
                self._finish(runner, phase)
            if runner.stopped or not finished:
                break
        self.env.close()
        if self.rank == 0 and runner is not None:
            text = self.log.read_bytes()[printed:].decode("utf-8", "replace")
            with provenance.changed(self.folder.provenance) as found:
                found["sessions"][-1] |= {
                    "stopped": runner.stopped,
                    "kernel_compile_s": self.compiled_ahead + kernel_seconds(text),
                }
                found["finished"] = set(found["phases"]) == set(self.settings.phases)

    # --- Building --------------------------------------------------------------------------------

    def _build(self) -> RslRlVecEnvWrapper:
        """The environment as the first phase begins, also where a later one is resumed."""
        self._say(
            f"building {self.settings.envs} robots on {self.device} and compiling kernels "
            "(a minute or two on a fresh machine)"
        )
        begin = time.monotonic()
        cfg = env_cfg(
            gains=self.gains,
            randomization=run_randomization(self.settings),
            phase=self.phases[0],
            num_envs=self.settings.envs,
            seed=self.settings.seed + self.rank,
        )
        learning = rl_cfg(jump=self.phases[0].jump)
        self.compiled_ahead = compile_ahead(self.device)
        env = RslRlVecEnvWrapper(
            ManagerBasedRlEnv(cfg=cfg, device=self.device), clip_actions=learning.clip_actions
        )
        built = time.monotonic() - begin
        self._say(f"built in {built:.0f} s")
        if self.device != "cpu":
            shout = check_cuda_graphs(env.unwrapped.sim)
            if shout is not None:
                self.console.print(shout, style="bold red")
        if self.rank == 0:
            with provenance.changed(self.folder.provenance) as found:
                found["sessions"][-1] |= {
                    "device": provenance.device_facts(self.settings.device, self.settings.gpus),
                    "build_s": built,
                }
        return env

    def _runner(self, phase: Phase) -> PhaseRunner:
        cfg = rl_cfg(jump=phase.jump, seed=self.settings.seed + self.rank, entropy=phase.entropy)
        cfg.save_interval = self.watch.save_interval
        cfg.upload_model = False
        if self.watch.logger == "wandb":
            cfg.logger, cfg.wandb_project = "wandb", "pronk"
        events = None if self.watch.logger == "none" else str(self.folder.path)
        runner = PhaseRunner(self.env, asdict(cfg), events, self.device)
        runner.folder = self.folder.checkpoints
        runner.phase = phase.name
        runner.provenance = {
            "task": self.settings.task,
            "seed": self.settings.seed,
            "gains": self.settings.gains,
            "gains_sha256": self.settings.gains_sha256,
        }
        command = motion_command(self.env.unwrapped)
        runner.watched = {"speed_range": lambda: float(command.ranges.part)}
        return runner

    def _successor(self, before: PronkRunner | None, phase: Phase) -> PhaseRunner:
        """The runner of a phase that begins, with what was learned before it."""
        runner = self._runner(phase)
        if before is not None:
            state, rate = before.alg.save(), before.alg.learning_rate
            runner.current_learning_iteration = before.current_learning_iteration
            runner.env_steps, runner.seconds = before.env_steps, before.seconds
            narrow = before.phase == "walk"
        elif self.settings.start:
            found = checkpoint.load(self._start())
            state, rate = found.tree["algorithm"], found.tree["learning_rate"]
            # Speed ranges do not begin anew.
            motion_command(self.env.unwrapped).ranges.resume(found.tree)
            narrow = True
        else:
            runner.alg.set_estimator_rate(phase.estimator_rate)
            return runner
        runner.alg.load(widen_state(state, runner.alg) if narrow else state)
        runner.alg.learning_rate = rate
        runner.alg.set_estimator_rate(phase.estimator_rate)
        return runner

    def _start(self) -> Path:
        path = Path(self.settings.start)
        if not path.is_file() or sha256(path) != self.settings.start_sha256:
            raise ArtefactError(
                f"{path}: the walking policy that this run starts from is missing or was changed; "
                "put it back, or begin a new run."
            )
        return path

    # --- Between phases --------------------------------------------------------------------------

    def _phase_of(self, path: Path) -> int:
        name = checkpoint.about(path).get("phase")
        names = [phase.name for phase in self.phases]
        if name not in names:
            raise ArtefactError(
                f"{path}: a checkpoint of phase {name}; this run has {', '.join(names)}."
            )
        return names.index(name)

    def _index(self, phase: Phase) -> int:
        return self.phases.index(phase)

    def _end_of(self, phase: Phase) -> int:
        """Iterations of the run when the phase is over."""
        return sum(p.iterations for p in self.phases[: self._index(phase) + 1])

    def _part_of(self, phase: Phase, iteration: int) -> float:
        """Part of a phase that is over after so many iterations of the run."""
        return 1.0 - (self._end_of(phase) - iteration) / phase.iterations

    def _go_on(self, runner: PronkRunner, phase: Phase) -> None:
        """Set what changes within a phase, which the iteration alone decides."""
        done = self._part_of(phase, runner.current_learning_iteration)
        runner.alg.get_policy().limit_noise(phase.largest_noise(done))
        if phase.changes:
            enter_phase(self.env.unwrapped, phase, done)

    def _after_iteration(self, runner: PronkRunner, phase: Phase) -> None:
        self._go_on(runner, phase)
        minutes = self.watch.minutes
        if minutes is not None and time.monotonic() - self.begin > 60.0 * minutes:
            runner.stop(f"{minutes:g} minutes are over")

    def _finish(self, runner: PhaseRunner, phase: Phase) -> None:
        """Keep what a phase has come to. May be done twice, if it was killed in between."""
        runner.save(self.folder.last_of(phase.name))
        non_finite = self._sum(runner.non_finite)
        if self.rank != 0:
            return
        difference = self._export(runner, phase)
        with provenance.changed(self.folder.provenance) as found:
            earlier = [
                entry
                for name, entry in found["phases"].items()
                if name in self.settings.phases[: self.settings.phases.index(phase.name)]
            ]
            steps = runner.env_steps - sum(entry["env_steps"] for entry in earlier)
            seconds = runner.seconds - sum(entry["seconds"] for entry in earlier)
            found["phases"][phase.name] = {
                "iterations": phase.iterations,
                "env_steps": steps,
                "seconds": seconds,
                "steps_per_second": steps / seconds,
                "non_finite": non_finite,
                "onnx_difference": difference,
            }

    def _export(self, runner: PhaseRunner, phase: Phase) -> float | None:
        """Write the policy after phase 1 and after the last phase.

        Returns:
            Largest difference between ONNX Runtime and PyTorch on the last rollout; None if
            nothing is written or ONNX Runtime is not installed.
        """
        last = phase is self.phases[-1]
        if not (last or phase.name == "walk"):
            return None
        path = self.folder.policy if last else self.folder.walk
        actor = runner.alg.get_policy()
        contract = run_contract(
            self.settings, self.gains, phase, run=self.folder.path.resolve().name
        )
        export_policy(actor, contract, path)
        seen = runner.alg.storage.observations.flatten(0, 1)[:_COMPARED]
        difference = verify(path, actor, {name: seen[name] for name in ("measured", "jump")})
        if difference is not None and not difference <= TOLERANCE:
            self.console.print(
                f"{path} differs from PyTorch by {difference:.1e}, more than {TOLERANCE:g}",
                style="bold red",
            )
        return difference

    def _sum(self, value: int) -> int:
        """Over all processes; every one must call."""
        if self.settings.gpus == 1:
            return value
        total = torch.tensor(value, device=self.device)
        torch.distributed.all_reduce(total)
        return int(total.item())

    def _say(self, text: str) -> None:
        if self.rank == 0:
            self.console.print(text, markup=False)
