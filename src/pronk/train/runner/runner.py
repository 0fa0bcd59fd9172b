"""The training run: rollouts and updates, saved so that it can be killed and resumed.

mjlab's and rsl_rl's runner, with three things changed: a checkpoint is never unpickled;
environment steps do not wait for the device; progress is one line.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch
from mjlab.rl import MjlabOnPolicyRunner
from rich.console import Console

from pronk.errors import ArtefactError, PronkError
from pronk.train.mdp.commands import motion_command
from pronk.train.rl.rollout import roll_out
from pronk.train.runner import checkpoint
from pronk.train.runner.checkpoint import Checkpoint
from pronk.train.runner.processes import in_any
from pronk.train.runner.progress import Episodes, ProgressLine
from pronk.train.runner.provenance import versions
from pronk.train.runner.stop import stop_signals

OnIteration = Callable[["PronkRunner"], None]


class PronkRunner(MjlabOnPolicyRunner):
    """Trains one phase; `current_learning_iteration` counts the iterations that are complete."""

    def __init__(
        self,
        env: Any,
        train_cfg: dict[str, Any],
        log_dir: str | None = None,
        device: str = "cpu",
    ) -> None:
        """As mjlab makes its runners.

        Args:
            env: mjlab's `RslRlVecEnvWrapper`, on `device`.
            train_cfg: The configuration of `rsl_rl.runners.OnPolicyRunner`, as a mapping.
            log_dir: Where figures and checkpoints go; None for neither.
            device: What to compute on.
        """
        super().__init__(env, train_cfg, log_dir, device)
        # rsl_rl would copy the differences of any git repository it finds about it.
        self.logger.git_status_repos.clear()
        self.folder = None if log_dir is None else Path(log_dir)
        """Where checkpoints go; None: nowhere."""
        self.keep = 3
        """Numbered checkpoints that are kept."""
        self.phase = ""
        """Name of what is trained, for people and for the checkpoint."""
        self.provenance: dict[str, Any] = {}
        """What else a checkpoint shall say about itself: seeds, hash of the gains, ..."""
        self.watched: dict[str, Callable[[], float]] = {}
        """Figures of the curriculum by name, requested once an iteration."""
        self.console = Console(stderr=True)
        """Where progress goes."""
        self.figures: dict[str, float] = {}
        """Figures of the last iteration, by TensorBoard's names."""
        self.stopped = ""
        """Why the run was requested to stop; empty if it was not."""
        self.env_steps = 0
        """Environment steps so far, of all processes."""
        self.seconds = 0.0
        """Time spent in iterations so far [s]."""
        self._episodes = Episodes(env.num_envs, device)
        self._under_way = False
        self._saved = -1

    # --- Training --------------------------------------------------------------------------------

    def learn(
        self,
        num_learning_iterations: int,
        init_at_random_ep_len: bool = False,
        on_iteration: OnIteration | None = None,
    ) -> None:
        """Train on; saves every `save_interval` iterations and at the end.

        SIGINT and SIGTERM end training after the iteration under way, with a checkpoint; a second
        one ends it at once.

        Args:
            num_learning_iterations: How many iterations more.
            init_at_random_ep_len: Spread the episodes of a new run in time, so that they do not
                all end together. A run under way is left as it is.
            on_iteration: Called with the runner after every iteration; may `save` or `stop`.

        Raises:
            PronkError: Learning has diverged.
        """
        self.stopped = ""
        if init_at_random_ep_len and not self._under_way:
            lengths = self.env.unwrapped.episode_length_buf
            lengths.copy_(torch.randint_like(lengths, high=int(self.env.max_episode_length)))
        self._under_way = True
        self.alg.train_mode()
        if self.is_distributed:
            self.alg.broadcast_parameters()
        self._open_writer()
        first = self.current_learning_iteration
        last = first + num_learning_iterations
        obs = self.env.get_observations()
        with stop_signals(self.stop), self._progress(first, last) as show:
            while self.current_learning_iteration < last:
                obs = self._iterate(obs)
                self._write_figures()
                show()
                if on_iteration is not None:
                    on_iteration(self)
                stop = in_any(bool(self.stopped), size=self.gpu_world_size, device=self.device)
                if self.current_learning_iteration % self.cfg["save_interval"] == 0 or stop:
                    self._save_numbered()
                if stop:
                    break
        self._save_numbered()
        if hasattr(self.logger.writer, "flush"):
            self.logger.writer.flush()

    def stop(self, why: str) -> None:
        """Ask the run to end, with a checkpoint, after the iteration under way."""
        self.stopped = why

    def _iterate(self, obs: Any) -> Any:
        """One rollout and one update.

        Returns:
            The observations after it.
        """
        begin = time.monotonic()
        try:
            obs = roll_out(self.env, self.alg, obs, self.cfg["num_steps_per_env"], self._episodes)
            self._synchronize()
            collected = time.monotonic()
            with torch.no_grad():
                self.alg.compute_returns(obs)
            losses = self.alg.update()
        except RuntimeError as error:
            # torch refuses to draw with a deviation that is NaN.
            self._check_finite(cause=error)
            raise
        end = time.monotonic()
        self.current_learning_iteration += 1
        self.env_steps += self.steps_per_iteration
        self.seconds += end - begin
        self.figures = {
            **self._episodes.figures(),
            **{f"Curriculum/{name}": float(figure()) for name, figure in self.watched.items()},
            **{f"Loss/{name}": float(value) for name, value in losses.items()},
            "Loss/learning_rate": float(self.alg.learning_rate),
            "Policy/mean_std": self.alg.get_policy().output_std.mean().item(),
            "Perf/total_fps": self.steps_per_iteration / (end - begin),
            "Perf/collection_time": collected - begin,
            "Perf/learning_time": end - collected,
        }
        bad = [name for name in losses if not math.isfinite(self.figures[f"Loss/{name}"])]
        if bad:
            raise PronkError(self._diverged(f"the loss {bad[0]} is {losses[bad[0]]}"))
        return obs

    @property
    def non_finite(self) -> int:
        """Environments of this process whose physics went wrong so far."""
        return self._episodes.non_finite

    @property
    def steps_per_iteration(self) -> int:
        """Environment steps of one iteration, of all processes."""
        return int(self.cfg["num_steps_per_env"] * self.env.num_envs * self.gpu_world_size)

    def _synchronize(self) -> None:
        """Wait for the device once a rollout, so that its time is given from the update's."""
        if torch.device(self.device).type == "cuda":
            torch.cuda.synchronize(self.device)

    def _check_finite(self, cause: Exception | None = None) -> dict[str, Any]:
        """The algorithm's state; PronkError if a weight or a moment in it is not finite."""
        state: dict[str, Any] = self.alg.save()
        bad = checkpoint.not_finite(state)
        if bad is not None:
            raise PronkError(self._diverged(f"{bad} is not finite")) from cause
        return state

    def _diverged(self, what: str) -> str:
        last = checkpoint.latest(self.folder) if self.folder is not None else None
        way_out = "train with another seed or a smaller learning rate"
        if last is not None:
            way_out += f"; {last} is the last good checkpoint"
        return (
            f"learning diverged in iteration {self.current_learning_iteration}: {what}; {way_out}."
        )

    # --- Figures ---------------------------------------------------------------------------------

    @contextmanager
    def _progress(self, first: int, last: int) -> Iterator[Callable[[], None]]:
        if self.gpu_global_rank != 0:
            yield lambda: None
            return
        what = self.phase or "training"
        with ProgressLine(what, done=first, total=last, console=self.console) as line:
            yield lambda: line.show(
                self.current_learning_iteration, self.figures, self.steps_per_iteration
            )

    def _open_writer(self) -> None:
        if self.logger.writer is not None or self.logger.log_dir is None:
            return
        self.logger.init_logging_writer()
        # rsl_rl makes a folder for differences of git repositories, of which it was given none.
        with suppress(OSError):
            (Path(self.logger.log_dir) / "git").rmdir()

    def _write_figures(self) -> None:
        if self.logger.writer is not None:
            for name, value in self.figures.items():
                self.logger.writer.add_scalar(name, value, self.current_learning_iteration)

    # --- Checkpoints -----------------------------------------------------------------------------

    def save(self, path: str | Path, infos: Mapping[str, Any] | None = None) -> None:
        """Write a checkpoint, whole or not at all, whatever the name ends with.

        With several processes all of them must call; the first one writes.

        Args:
            path: Where to.
            infos: What the caller wants back from `load`.

        Raises:
            PronkError: A weight is not finite.
        """
        algorithm = self._check_finite()
        if self.gpu_global_rank != 0:
            return
        about = {
            **self.provenance,
            "iteration": self.current_learning_iteration,
            "phase": self.phase,
            "envs": self.env.num_envs,
            "processes": self.gpu_world_size,
            "env_steps": self.env_steps,
            "seconds": self.seconds,
            "non_finite": self.non_finite,
            "written": datetime.now(UTC).isoformat(timespec="seconds"),
            "versions": versions(),
        }
        tree = {
            "algorithm": algorithm,
            "learning_rate": self.alg.learning_rate,
            "speed_ranges": motion_command(self.env.unwrapped).ranges.grown,
            "infos": dict(infos or {}),
        }
        checkpoint.save(Path(path), Checkpoint(about=about, tree=tree))
        if self.cfg.get("upload_model"):
            self.logger.save_model(str(path), self.current_learning_iteration)

    def load(
        self,
        path: str | Path,
        load_cfg: Mapping[str, bool] | None = None,
        strict: bool = True,
        map_location: str | None = None,
    ) -> dict[str, Any]:
        """Go on from a checkpoint, or take over parts of it.

        Args:
            path: The checkpoint.
            load_cfg: None to resume: networks, optimizers and counters; robots start anew. Else
                what the algorithm shall take over (`actor`, `critic`, `optimizer`, `iteration`).
            strict: Refuse missing and unknown weights.
            map_location: As mjlab calls it; tensors go where they belong in any case.

        Returns:
            What `save` was given as `infos`.

        Raises:
            ArtefactError: The file is no checkpoint, or one of another run than this.
        """
        found = checkpoint.load(Path(path))
        if load_cfg is None and found.about["processes"] != self.gpu_world_size:
            raise ArtefactError(
                f"{path}: a run of {found.about['processes']} processes; it cannot be resumed "
                f"with {self.gpu_world_size}."
            )
        try:
            iteration = self.alg.load(dict(found.tree["algorithm"]), load_cfg, strict)
        except (KeyError, RuntimeError, ValueError) as error:
            reason = str(error).strip().splitlines()[-1].strip()
            raise ArtefactError(
                f"{path}: its networks are not those of this run ({reason})."
            ) from error
        if iteration:
            self.current_learning_iteration = found.about["iteration"]
        motion_command(self.env.unwrapped).ranges.resume(found.tree)
        if load_cfg is None:
            self._resume(found)
        return dict(found.tree["infos"])

    def _resume(self, found: Checkpoint) -> None:
        self.alg.storage.clear()
        self.alg.learning_rate = found.tree["learning_rate"]
        self.env_steps = found.about["env_steps"]
        self.seconds = found.about["seconds"]
        if self.gpu_global_rank == 0:
            self._episodes.non_finite = found.about["non_finite"]
        self._saved = self.current_learning_iteration

    def _save_numbered(self) -> None:
        if self.folder is None or self._saved == self.current_learning_iteration:
            return
        self.save(checkpoint.numbered(self.folder, self.current_learning_iteration))
        self._saved = self.current_learning_iteration
        if self.gpu_global_rank == 0:
            checkpoint.prune(self.folder, self.keep)
