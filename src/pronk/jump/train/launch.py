"""Trainings by several processes, one for each GPU of each host, started by torchrunx.

torchrunx starts an agent on each host, which starts the processes; on other hosts over SSH. Process
r of all draws from seed + r. The processes average gradients, and process 0 alone, on the first
host, writes the run.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import torch
from mjlab.scripts import train as mjlab_train

from pronk.errors import ArtefactError, PronkError
from pronk.jump.train.host_process import train_packed
from pronk.jump.train.hosts import COPIED_VARIABLES
from pronk.jump.train.rl import checkpoint
from pronk.signals import interrupt

LOCAL_HOST = "localhost"
"""Name of this machine for torchrunx, which needs no SSH for it."""
LOG_FOLDER = "torchrunx"
"""Folder in that of the run, with what each agent and process prints."""
AGENT_S = 180
"""Longest silence of an agent until its host counts as lost [s]."""
STOP_S = 60.0
"""Longest wait for the checkpoint of a training that is interrupted [s]; the agents kill processes
that have not ended 30 s after they were told to."""


def launch(
    config: mjlab_train.TrainConfig, log_dir: Path, hosts: Sequence[str], processes: int
) -> None:
    """Train by several processes, until the last phase is over or training is stopped.

    `CUDA_VISIBLE_DEVICES` of this process holds for all of them, as do the other
    `COPIED_VARIABLES`.

    Args:
        config: mjlab's configuration of the training.
        log_dir: Folder of the run, which all hosts share.
        hosts: Names of the hosts; process 0 is on the first.
        processes: Number of processes on each host.

    Raises:
        PronkError: Learning has diverged, or a process was lost.
        KeyboardInterrupt: A signal stopped the training, whose name it has.
    """
    import cloudpickle
    import torchrunx
    from torchrunx.utils.errors import AgentFailedError, WorkerFailedError

    first_checkpoint = checkpoint.latest_checkpoint(log_dir)
    launcher = torchrunx.Launcher(
        hostnames=list(hosts),
        workers_per_host=processes,
        backend=None,  # the runner makes the process group itself
        agent_timeout=AGENT_S,
        copy_env_vars=COPIED_VARIABLES,
    ).set_logging_handlers(partial(_log_handlers, tuple(hosts), processes, log_dir))
    signal_name = ""
    try:
        with _terminated_as_interrupted():
            launcher.run(train_packed, cloudpickle.dumps((config, log_dir)))
    except KeyboardInterrupt as error:
        signal_name = str(error) or signal.SIGINT.name
    except (AgentFailedError, WorkerFailedError, torch.distributed.DistError) as error:
        reason = str(error) or type(error).__name__
        raise PronkError(
            f"the training on {', '.join(hosts)} lost a process ({reason}); "
            f"{log_dir / LOG_FOLDER} has what each printed. --resume goes on from the last "
            "checkpoint."
        ) from error
    if signal_name:
        # The agents wait for this process, deaf to the signal that torchrunx has sent them, as long
        # as its connections are open; the frames of the interrupt held them.
        gc.collect()
        _wait_for_checkpoint(log_dir, first_checkpoint)
        raise KeyboardInterrupt(signal_name)


def _log_handlers(hosts: tuple[str, ...], processes: int, log_dir: Path) -> list[logging.Handler]:
    """Return where what is printed goes: all of it to files, that of process 0 here as well."""
    from torchrunx.utils.log_handling import RedirectHandler, file_handlers, get_handler_filter

    handlers = file_handlers(
        list(hosts), [processes] * len(hosts), log_dir / LOG_FOLDER, logging.INFO
    )
    progress = RedirectHandler()
    progress.addFilter(get_handler_filter(hosts[0], 0))
    return [progress, *handlers]


@contextlib.contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """Let SIGTERM raise KeyboardInterrupt in the block, so that torchrunx ends its agents."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, handler)


def _wait_for_checkpoint(log_dir: Path, first: Path | None) -> None:
    """Wait until processes that were told to stop have written their checkpoint.

    Args:
        log_dir: Folder of the run.
        first: The last checkpoint before this session.
    """
    end = time.monotonic() + STOP_S
    seen = first
    while time.monotonic() < end:
        path = checkpoint.latest_checkpoint(log_dir)
        if path is not None and path != seen:
            seen = path
            with contextlib.suppress(ArtefactError):
                if checkpoint.read_checkpoint(path)["infos"].get("stopped"):
                    return
        time.sleep(0.2)
