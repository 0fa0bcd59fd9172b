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
from pronk.train.runner import provenance
from pronk.train.runner.devices import Devices
from pronk.train.runner.run_folder import RunFolder
from pronk.train.runner.settings import TrainSettings, WatchSettings

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

    Raises:
        PronkError: What was requested is impossible; then nothing is written.
    """
    from pronk.train.runner.resolve import resolved, run_gains

    gains = run_gains(settings, gains_file)
    config = resolved(settings, gains)
    folder.checkpoints.mkdir(parents=True, exist_ok=True)
    if gains_file is not None:
        with written_whole(folder.gains) as aside:
            shutil.copyfile(gains_file, aside)
    about = {
        "name": gains.name,
        "file": None if gains_file is None else gains_file.name,
        "sha256": gains.sha256,
        "virtual": gains.virtual,
    }
    begun = provenance.begin(settings, gains=about)
    provenance.write(folder.provenance, begun)
    # The last, since a folder with it is a run that can be resumed.
    folder.write_config(settings, config)
    return begun


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
    devices.claim()
    os.environ.setdefault("MJLAB_WARP_QUIET", "1")
    begin = time.monotonic()
    with folder.locked():
        with provenance.changed(folder.provenance) as found:
            found["sessions"].append(provenance.session())
        try:
            if devices.count == 1:
                from pronk.train.runner.run import train_run

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

    from pronk.train.runner.run import train_run

    launcher = torchrunx.Launcher(
        hostnames=["localhost"],
        workers_per_host=count,
        backend=None,  # rsl_rl makes the process group itself
        copy_env_vars=(*torchrunx.DEFAULT_ENV_VARS_FOR_COPY, *_COPIED),
    )
    launcher.set_logging_handlers(_Handlers(folder.path / "workers.log"))
    launcher.run(train_run, folder, settings, watch)


class _Handlers:
    """Where the words of the processes go: the first one's to this terminal, all to a file."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __call__(self) -> list[logging.Handler]:
        """Made in the process that gathers them."""
        terminal, file = _Terminal(), logging.FileHandler(self._path, encoding="utf-8")
        # What a process prints to standard error arrives as errors. Libraries log for themselves
        # down to the last detail. Levels have no effect where the messages are gathered; filters
        # do.
        terminal.addFilter(lambda record: record.levelno >= logging.ERROR)
        file.addFilter(lambda record: record.levelno >= logging.INFO)
        return [terminal, file]


class _Terminal(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        """Print what the first process says."""
        if getattr(record, "local_rank", None) == 0:
            print(record.getMessage(), file=sys.stderr, flush=True)  # noqa: T201
