"""Begin or continue a run, in this process or in one for each GPU."""

from __future__ import annotations

import logging
import os
import shutil
import sys
import time
from pathlib import Path
from typing import Any

from pronk.files import written_whole
from pronk.train import provenance
from pronk.train.devices import Devices
from pronk.train.gains import TrainingGains
from pronk.train.run_folder import RunFolder, plain
from pronk.train.settings import TrainSettings, WatchSettings

_LEARNING = ("num_steps_per_env", "obs_groups", "clip_actions", "actor", "critic", "algorithm")
"""What of rsl_rl's configuration decides what is learned."""
_COPIED = ("MUJOCO*", "MJLAB*", "WARP*", "WANDB*")
"""Variables of the environment that the processes shall have, beside torchrunx's own."""


def begin_run(
    folder: RunFolder, settings: TrainSettings, *, gains_file: Path | None
) -> dict[str, Any]:
    """Make the folder of a new run: the copy of the gains, `config.yaml`, `provenance.json`.

    Args:
        folder: New or empty.
        settings: What is trained.
        gains_file: The `gains.yaml` that it is trained with, if any.

    Returns:
        Its provenance.
    """
    from pronk.train.run import run_gains

    folder.checkpoints.mkdir(parents=True, exist_ok=True)
    if gains_file is not None:
        with written_whole(folder.gains) as aside:
            shutil.copyfile(gains_file, aside)
    gains = run_gains(folder, settings)
    about = {
        "name": gains.name,
        "file": None if gains_file is None else gains_file.name,
        "sha256": gains.sha256,
        "virtual": gains.virtual,
    }
    begun = provenance.begin(settings, gains=about)
    provenance.write(folder.provenance, begun)
    # The last, since a folder with it is a run that can be resumed.
    folder.write_config(settings, resolved(settings, gains))
    return begun


def resolved(settings: TrainSettings, gains: TrainingGains) -> dict[str, Any]:
    """What follows from the settings, for people to read: every number that a run is made of.

    Args:
        settings: What is trained.
        gains: With which gains.
    """
    from pronk.train.run import run_phases, run_randomization
    from pronk.train.tasks import env_cfg, rl_cfg

    phases = run_phases(settings)
    randomization = run_randomization(settings)
    environments = {
        phase.name: env_cfg(
            gains=gains,
            randomization=randomization,
            phase=phase,
            num_envs=settings.envs,
            seed=settings.seed,
        )
        for phase in phases
    }
    environment = plain(environments[phases[0].name])
    del environment["rewards"]
    learning = {p.name: plain(rl_cfg(jump=p.jump, seed=settings.seed)) for p in phases}
    return {
        "phases": phases,
        "rewards": {
            name: {term: {"weight": cfg.weight, **cfg.params} for term, cfg in one.rewards.items()}
            for name, one in environments.items()
        },
        "gains": gains,
        "randomization": randomization,
        "learning": {
            name: {key: value for key, value in one.items() if key in _LEARNING}
            for name, one in learning.items()
        },
        "environment": environment,
    }


def launch(
    folder: RunFolder, settings: TrainSettings, watch: WatchSettings, devices: Devices
) -> dict[str, Any]:
    """Train until the run is over or is stopped.

    Args:
        folder: Of a run that was begun.
        settings: Its settings.
        watch: How it is watched.
        devices: What to compute on; as many as the settings have.

    Returns:
        The run's provenance, with this session in it.

    Raises:
        PronkError: Learning has diverged, or a file of the run is missing, damaged or of another
            run.
    """
    if devices.visible:
        os.environ["CUDA_VISIBLE_DEVICES"] = ",".join(devices.visible)
    os.environ.setdefault("MJLAB_WARP_QUIET", "1")
    begin = time.monotonic()
    with folder.locked():
        with provenance.changed(folder.provenance) as found:
            found["sessions"].append(provenance.session())
        try:
            if devices.count == 1:
                from pronk.train.run import train_run

                train_run(folder, settings, watch)
            else:
                _spawn(folder, settings, watch, devices.count)
        finally:
            with provenance.changed(folder.provenance) as found:
                found["sessions"][-1] |= {
                    "end": provenance.now(),
                    "seconds": time.monotonic() - begin,
                }
    return found


def _spawn(folder: RunFolder, settings: TrainSettings, watch: WatchSettings, count: int) -> None:
    """One process for each GPU, as mjlab starts them."""
    import torchrunx

    from pronk.train.run import train_run

    launcher = torchrunx.Launcher(
        hostnames=["localhost"],
        workers_per_host=count,
        backend=None,  # rsl_rl makes the process group itself
        copy_env_vars=(
            *torchrunx.DEFAULT_ENV_VARS_FOR_COPY,
            "MUJOCO*",
            "MJLAB*",
            "WARP*",
            "WANDB*",
        ),
    )
    launcher.set_logging_handlers(_Handlers(folder.path / "workers.log"))
    launcher.run(train_run, folder, settings, watch)


class _Handlers:
    """Where the words of the processes go: the first one's to this terminal, all to a file."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __call__(self) -> list[logging.Handler]:
        """Made in the process that gathers them."""
        return [_Terminal(), logging.FileHandler(self._path, encoding="utf-8")]


class _Terminal(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        """Print what the first process says."""
        if getattr(record, "local_rank", None) == 0:
            print(record.getMessage(), file=sys.stderr, flush=True)  # noqa: T201
