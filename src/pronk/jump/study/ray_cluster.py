"""Tasks on the nodes of a Ray cluster (`pronk[cluster]`); their files come home by their hashes.

A node gets the files that a task reads, runs the same command as a single host would in a folder of
its own, and sends home what it wrote: a training whenever it has a new checkpoint, so that a lost
node loses no more than the iterations since the last one. Messages go through an actor on the head
node, which Ray's client (`ray://`) can reach as well. pronk itself counts failures and losses; Ray
restarts nothing.
"""

from __future__ import annotations

import hashlib
import signal
import socket
import subprocess
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pronk.errors import PronkError
from pronk.jump.study.schedule import TaskEnd, end_of_log
from pronk.jump.study.tasks import (
    StudyTask,
    last_lines,
    program,
    program_environment,
    sources_of,
    store_file,
)
from pronk.processes import exit_words
from pronk.tables import counted
from pronk.version import VERSION

CHECKPOINTS = "model_*.pt"
"""Files whose change makes a training send everything home."""
SMALL_BYTES = 64 * 1024
"""Largest file that is sent home whenever it changes, as the progress and the log."""
LOOK_S = 1.0
"""Time between two looks of a node at its task [s]."""
CHECKPOINT_S = 120.0
"""Longest time that trainings have to write their checkpoint when a study is interrupted [s]."""
CAPACITY_S = 5.0
"""Time between two looks at what the cluster has [s]."""
_MESSAGES = 4
"""Largest number of messages that are fetched at once."""


def require_ray() -> None:
    """Refuse a cluster where the extra is not installed, with a PronkError."""
    if find_spec("ray") is None:
        raise PronkError(
            'a cluster needs Ray, which this installation lacks; pip install "pronk[cluster]".'
        )


class HomeMailbox:
    """What nodes send home, until it is fetched; an actor on the head node."""

    def __init__(self) -> None:
        """Begin empty."""
        self._messages: list[dict[str, Any]] = []
        self._stops = False

    def put(self, message: dict[str, Any]) -> bool:
        """Add a message; return whether the study is to stop."""
        self._messages.append(message)
        return self._stops

    def stops(self) -> bool:
        """Return whether the study is to stop."""
        return self._stops

    def stop(self) -> None:
        """Have all tasks end at a checkpoint."""
        self._stops = True

    def take(self, count: int) -> list[dict[str, Any]]:
        """Return the oldest messages and forget them."""
        messages = self._messages[:count]
        del self._messages[:count]
        return messages


@dataclass(frozen=True, kw_only=True)
class RemoteTask:
    """What a node needs to run a task."""

    task: StudyTask
    words: tuple[str, ...]
    """Words after `pronk`."""
    attempt: str
    """Name of this start, with which its messages are marked."""
    version: str
    """Version of pronk that started it."""
    sources: str
    """Hash of its sources, as of `sources_of`."""


@dataclass
class _SentFiles:
    """What of a folder has been sent home."""

    root: Path
    folder: str
    stamps: dict[str, tuple[int, int]] = field(default_factory=dict)
    checkpoints: tuple[str, ...] = ()

    def changed(self, log: str, *, everything: bool) -> dict[str, Any]:
        """Return files that are new or changed, with their hashes.

        All of them if a checkpoint is new or `everything` is true, small ones otherwise.
        """
        folder = self.root / self.folder
        checkpoints = tuple(sorted(path.name for path in folder.glob(CHECKPOINTS)))
        everything = everything or checkpoints != self.checkpoints
        paths = [self.root / log]
        paths += sorted(folder.rglob("*"))
        files = {}
        for path in paths:
            # Names of files that are being written begin with a dot.
            if path.name.startswith("."):
                continue
            with suppress(FileNotFoundError):
                if not path.is_file():
                    continue
                state = path.stat()
                stamp = (state.st_mtime_ns, state.st_size)
                relative = path.relative_to(self.root).as_posix()
                if self.stamps.get(relative) == stamp:
                    continue
                if state.st_size > SMALL_BYTES and not everything:
                    continue
                content = path.read_bytes()
                files[relative] = (hashlib.sha256(content).hexdigest(), content)
                self.stamps[relative] = stamp
        self.checkpoints = checkpoints
        return {"files": files, "checkpoints": list(checkpoints)}


def run_remote_task(
    remote: RemoteTask, paths: Sequence[str], contents: Sequence[Any], mailbox: Any
) -> dict[str, Any]:
    """Run a task on this node, and send home what it writes.

    Args:
        remote: The task.
        paths: Files that it reads, relative to the folder of the study.
        contents: References to their contents.
        mailbox: The actor that takes messages.

    Returns:
        How the task ended, as fields of `TaskEnd`.
    """
    import ray

    if remote.version != VERSION:
        return {
            "ended": "failed",
            "reason": f"{socket.gethostname()} has pronk {VERSION}, not {remote.version}; install "
            "the same version on all nodes",
        }
    task = remote.task
    if remote.sources != sources_of(task.kind):
        return {
            "ended": "failed",
            "reason": f"{socket.gethostname()} has other sources of pronk than this host, though "
            f"of the same version {VERSION}; install the same on all nodes",
        }
    with tempfile.TemporaryDirectory(prefix="pronk-task-") as folder:
        root = Path(folder)
        for path, content in zip(paths, ray.get(list(contents)), strict=True):
            store_file(root / path, content)
        log_file = root / task.log()
        log_file.parent.mkdir(parents=True, exist_ok=True)
        sent = _SentFiles(root=root, folder=task.folder)
        # What came from home is there.
        sent.changed(task.log(), everything=True)

        def send(*, everything: bool = False) -> bool:
            message = sent.changed(task.log(), everything=everything)
            if not message["files"]:
                return bool(ray.get(mailbox.stops.remote()))
            message["attempt"] = remote.attempt
            return bool(ray.get(mailbox.put.remote(message)))

        with log_file.open("ab") as log:
            log.write(f"$ pronk {' '.join(remote.words)}\n".encode())
            log.flush()
            process = subprocess.Popen(
                program(remote.words),
                cwd=root,
                env=program_environment(task.threads),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            is_stopped = False
            try:
                while process.poll() is None:
                    time.sleep(LOOK_S)
                    if send() and not is_stopped:
                        is_stopped = True
                        process.send_signal(signal.SIGTERM)
            finally:
                if process.poll() is None:
                    process.kill()
                    process.wait()
        send(everything=True)
        if process.returncode == 0:
            return {"ended": "well", "reason": ""}
        how = exit_words(process.returncode, "give fewer --per-gpu or nodes with more of it")
        reason = f"the process on {socket.gethostname()} {how}"
        return {"ended": "failed", "reason": f"{reason}: {last_lines(log_file)}"}


@dataclass(kw_only=True)
class _Submitted:
    task: StudyTask
    attempt: str
    result: Any
    """Reference to what `run_remote_task` returns."""
    needs: dict[str, float]
    """What it takes of the cluster, by Ray's names."""


class RayExecutor:
    """Runs tasks on the nodes of a Ray cluster; `ray_executor` makes one."""

    def __init__(self, root: Path, mailbox: Any, *, per_gpu: int) -> None:
        """Note the cluster, to which this process is connected.

        Args:
            root: Folder of the study on this host.
            mailbox: The actor that takes messages.
            per_gpu: Number of trainings on one GPU.
        """
        self.root = root
        self.per_gpu = per_gpu
        self._mailbox = mailbox
        self._submitted: list[_Submitted] = []
        self._references: dict[str, Any] = {}
        self._capacity: Mapping[str, float] = {}
        self._looked_at = -CAPACITY_S

    def try_start(self, task: StudyTask) -> str:
        """Give a task to the cluster if it has room; return a word for where, or nothing."""
        import ray

        capacity = self.capacity()
        needs = {"CPU": min(task.cores, max(capacity.get("CPU", 0.0), 1.0)), "GPU": 0.0}
        if task.gpu:
            needs["GPU"] = 1.0 / self.per_gpu
        for resource, amount in needs.items():
            used = sum(submitted.needs[resource] for submitted in self._submitted)
            if amount > 0.0 and used + amount > capacity.get(resource, 0.0) + 1e-6:
                return ""
        words = task.words(self.root)
        paths = sorted({*task.inputs, *self._resumed_files(task)})
        attempt = uuid.uuid4().hex
        remote = RemoteTask(
            task=task,
            words=words,
            attempt=attempt,
            version=VERSION,
            sources=sources_of(task.kind),
        )
        function = ray.remote(run_remote_task).options(
            num_cpus=needs["CPU"], num_gpus=needs["GPU"], max_retries=0, name=task.name
        )
        contents = [self._reference(path) for path in paths]
        result = function.remote(remote, paths, contents, self._mailbox)
        self._submitted.append(_Submitted(task=task, attempt=attempt, result=result, needs=needs))
        return "cluster"

    def _resumed_files(self, task: StudyTask) -> list[str]:
        """Return what a task has written so far: all but the older numbered checkpoints."""
        folder = self.root / task.folder
        checkpoints = sorted(folder.glob(CHECKPOINTS), key=lambda path: path.stat().st_mtime_ns)
        paths = []
        for path in folder.rglob("*"):
            if path.is_file() and not path.name.startswith(".") and path not in checkpoints[:-1]:
                paths.append(path.relative_to(self.root).as_posix())
        return paths

    def _reference(self, path: str) -> Any:
        """Put the content of a file into the cluster once, however many tasks read it."""
        import ray

        content = (self.root / path).read_bytes()
        digest = hashlib.sha256(content).hexdigest()
        if digest not in self._references:
            self._references[digest] = ray.put(content)
        return self._references[digest]

    def capacity(self) -> Mapping[str, float]:
        """Return what the nodes have that are there now, by Ray's names."""
        import ray

        if time.monotonic() - self._looked_at > CAPACITY_S:
            self._looked_at = time.monotonic()
            self._capacity = ray.cluster_resources()
        return self._capacity

    def poll(self) -> list[TaskEnd]:
        """Store what came home, and return the tasks that have ended since the last call."""
        import ray

        if not self._submitted:
            return []
        results = [submitted.result for submitted in self._submitted]
        ready, _ = ray.wait(results, num_returns=len(results), timeout=0.0)
        # A task sends its last message before it ends.
        self._fetch()
        ends = []
        for submitted in list(self._submitted):
            if submitted.result not in ready:
                continue
            self._submitted.remove(submitted)
            ends.append(self._end_of(submitted))
        return ends

    def _end_of(self, submitted: _Submitted) -> TaskEnd:
        """Return how a task ended whose result is there."""
        import ray

        name = submitted.task.name
        try:
            end = ray.get(submitted.result)
        except (ray.exceptions.OutOfMemoryError, ray.exceptions.RayTaskError) as error:
            return TaskEnd(name=name, ended="failed", reason=" ".join(str(error).split())[-300:])
        except ray.exceptions.RayError as error:
            self._looked_at = -CAPACITY_S
            self._references.clear()
            return TaskEnd(name=name, ended="lost", reason=type(error).__name__)
        reason = end["reason"]
        if end["ended"] == "failed" and (self.root / submitted.task.log()).exists():
            reason = f"{reason.partition(':')[0]}: {end_of_log(self.root, submitted.task)}"
        return TaskEnd(name=name, ended=end["ended"], reason=reason)

    def _fetch(self) -> None:
        """Store the files of all messages of tasks that run."""
        import ray

        folders = {}
        for submitted in self._submitted:
            folders[submitted.attempt] = self.root / submitted.task.folder
        while True:
            messages = ray.get(self._mailbox.take.remote(_MESSAGES))
            if not messages:
                return
            for message in messages:
                folder = folders.get(message["attempt"])
                # A start that was given up may still send.
                if folder is None:
                    continue
                for path, (digest, content) in message["files"].items():
                    if hashlib.sha256(content).hexdigest() != digest:
                        raise PronkError(f"{path}: arrived from its node with another hash.")
                    store_file(self.root / path, content)
                for checkpoint in folder.glob(CHECKPOINTS):
                    if checkpoint.name not in message["checkpoints"]:
                        checkpoint.unlink(missing_ok=True)

    def stop(self) -> None:
        """End all tasks, trainings at a checkpoint, and wait until they have ended."""
        import ray

        if not self._submitted:
            return
        ray.get(self._mailbox.stop.remote())
        deadline = time.monotonic() + CHECKPOINT_S
        while self._submitted and time.monotonic() < deadline:
            self.poll()
            time.sleep(LOOK_S)
        for submitted in self._submitted:
            ray.cancel(submitted.result, force=True)

    def rooms(self) -> int:
        """Return how many trainings run at once when there are enough."""
        capacity = self.capacity()
        gpus = capacity.get("GPU", 0.0)
        if gpus:
            return max(1, int(gpus * self.per_gpu))
        return max(1, int(capacity.get("CPU", 1.0)))


@contextmanager
def ray_executor(
    root: Path, address: str, *, per_gpu: int, say: Callable[[str], None]
) -> Iterator[RayExecutor]:
    """Connect to a cluster inside the block.

    Args:
        root: Folder of the study on this host.
        address: `ray://HOST:PORT`, `local` for a cluster of this host alone, or what else Ray
            takes.
        per_gpu: Number of trainings on one GPU.
        say: Called with a line of text.

    Raises:
        PronkError: There is no cluster at the address.
    """
    require_ray()
    import ray

    options: dict[str, Any] = {"address": address}
    if address == "local":
        options["include_dashboard"] = False
    try:
        ray.init(**options, log_to_driver=False, logging_level="error")
    except Exception as error:  # Ray raises errors of many kinds here.
        raise PronkError(
            f"--cluster {address}: no Ray cluster there ({' '.join(str(error).split())[:200]}); "
            "start one by `ray start --head` and `ray start --address HEAD:6379` on other nodes."
        ) from None
    try:
        resources = ray.cluster_resources()
        say(
            f"Ray cluster: {counted(len(ray.nodes()), 'node')}, "
            f"{counted(resources.get('CPU', 0.0), 'core')}, "
            f"{counted(resources.get('GPU', 0.0), 'GPU')}"
        )
        head = {"node:__internal_head__": 0.001}
        mailbox = ray.remote(HomeMailbox).options(num_cpus=0, resources=head).remote()
        yield RayExecutor(root, mailbox, per_gpu=per_gpu)
    finally:
        ray.shutdown()
