"""NVIDIA's MPS: kernels of several processes run on one GPU at the same time.

Without it the processes take turns, and several trainings on a GPU are no faster than one after
another. The control daemon belongs to the driver; it is started for a study and ended with it.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

CONTROL = "nvidia-cuda-mps-control"
"""Program of the driver that starts and ends MPS."""
PLACES = ("/usr/local/nvidia/bin", "/usr/bin")
"""Folders in which it may lie beside those of PATH; containers have the first."""
PIPE = "CUDA_MPS_PIPE_DIRECTORY"
LOG = "CUDA_MPS_LOG_DIRECTORY"
_LONGEST_PIPE = 80
"""Longest path of the folder of pipes [characters]; names of sockets have 107 at most."""
_TIMEOUT_S = 30.0
"""Longest time that the daemon has to start or to end [s]."""


def find_mps() -> str | None:
    """Return the program that starts MPS, or None where the driver has none."""
    path = os.pathsep.join([os.environ.get("PATH", ""), *PLACES])
    return shutil.which(CONTROL, path=path)


@contextmanager
def mps_daemon(folder: Path, say: Callable[[str], None]) -> Iterator[Mapping[str, str]]:
    """Run MPS inside the block, and yield the environment variables of its clients.

    Where MPS runs already (`CUDA_MPS_PIPE_DIRECTORY` is set), that one is used. Where there is
    none, or it does not start, that is said and no variable is yielded.

    Args:
        folder: Folder for its pipes and logs.
        say: Called with a line of text.
    """
    if os.environ.get(PIPE):
        say(f"MPS that runs already is used ({PIPE}={os.environ[PIPE]})")
        yield {}
        return
    control = find_mps()
    if control is None:
        say(
            f"no MPS ({CONTROL} is neither on PATH nor in {', '.join(PLACES)}): trainings on one "
            "GPU take turns; give --per-gpu 1 if that is slower"
        )
        yield {}
        return
    pipes = folder.resolve() / "pipes"
    temporary = ""
    if len(str(pipes)) > _LONGEST_PIPE:
        temporary = tempfile.mkdtemp(prefix="pronk-mps-")
        pipes = Path(temporary)
    logs = folder.resolve() / "log"
    pipes.mkdir(parents=True, exist_ok=True)
    logs.mkdir(parents=True, exist_ok=True)
    variables = {PIPE: str(pipes), LOG: str(logs)}
    environment = {**os.environ, **variables}
    # The daemon serves all GPUs; its clients choose among them.
    environment.pop("CUDA_VISIBLE_DEVICES", None)
    try:
        try:
            subprocess.run(
                [control, "-d"],
                env=environment,
                check=True,
                capture_output=True,
                text=True,
                timeout=_TIMEOUT_S,
            )
        except (OSError, subprocess.SubprocessError) as error:
            detail = getattr(error, "stderr", "") or str(error)
            say(f"MPS did not start ({detail.strip()}): trainings on one GPU take turns")
            yield {}
            return
        say(f"MPS runs for this command, with pipes and logs in {pipes} and {logs}")
        try:
            yield variables
        finally:
            _quit(control, environment, say)
    finally:
        if temporary:
            shutil.rmtree(temporary, ignore_errors=True)


def _quit(control: str, environment: Mapping[str, str], say: Callable[[str], None]) -> None:
    """End the daemon."""
    try:
        subprocess.run(
            [control],
            input="quit\n",
            env=environment,
            check=True,
            capture_output=True,
            text=True,
            timeout=_TIMEOUT_S,
        )
    except (OSError, subprocess.SubprocessError) as error:
        say(
            f"warning: MPS did not end ({error}); end it by "
            f"`echo quit | {PIPE}={environment[PIPE]} {control}`"
        )
