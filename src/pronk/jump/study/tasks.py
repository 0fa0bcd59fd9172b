"""Tasks of a study, and the file that remembers which of them are done.

A task is one `pronk` command with the files that it reads and writes. All paths are relative to the
folder of the study, so that the same command runs in that folder on this host, or in a copy of it
on another. `state.json` holds the hash of what each task depends on and of what it wrote: a study
that is run again does only what is new.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Literal

import msgspec

import pronk
from pronk.errors import ArtefactError, PronkError
from pronk.files import locked_folder, sha256, write_text, written_whole
from pronk.jump.train.versions import sources_sha256

STATE_FILE = "state.json"
"""Name of the file with the states of all tasks, in the folder of the study."""
STATE_SCHEMA = "pronk/study-state/1"
LOGS = "logs"
"""Folder with what each task printed."""
INPUTS = "inputs"
"""Folder with copies of the files that tasks read, named by their content."""

TaskKind = Literal["training", "trial"]
_SOURCES: Mapping[TaskKind, tuple[str, ...]] = {
    "training": ("identify/match", "jump/train", "policy", "robots"),
    "trial": ("jump/trial", "jump/virtual", "policy", "robots"),
}
"""Folders of the package whose files decide what a task computes. That of trainings that are
compared with one another has to be one pronk, as has that of trials; its version alone does not
tell two commits apart."""


@dataclass(frozen=True, kw_only=True)
class StudyTask:
    """One command of a study; all paths are relative to the folder of the study."""

    name: str
    """Name in tables, unlike that of any other task."""
    kind: TaskKind
    folder: str
    """Folder that the command writes to."""
    command: tuple[str, ...]
    """Words after `pronk`."""
    settings: Mapping[str, Any]
    """What decides the result beside the inputs, as JSON holds it."""
    inputs: tuple[str, ...] = ()
    """Files that the command reads."""
    outputs: tuple[str, ...] = ()
    """Files that a finished command has written."""
    needs: tuple[str, ...] = ()
    """Names of the tasks that have to be done before."""
    resume_command: tuple[str, ...] = ()
    """Words after `pronk` that go on where the task was interrupted."""
    resume_marker: str = ""
    """File that is there if the task can go on; without it the folder is made anew."""
    gpu: bool = False
    """True if the task needs a share of a GPU."""
    cores: float = 1.0
    """Number of cores that the task needs."""
    processes: int = 1
    """Number of processes of the command, which share these cores."""

    @property
    def threads(self) -> int:
        """Threads that the libraries of each process get."""
        return max(1, int(self.cores / self.processes))

    def log(self) -> str:
        """Return the file of what the command prints."""
        return f"{LOGS}/{self.folder.replace('/', '_')}.log"

    def key(self, root: Path) -> str:
        """Return the hash of all that the result depends on; the inputs must be there."""
        hashes = {path: file_hash(root / path) for path in sorted(self.inputs)}
        text = json.dumps([self.kind, dict(self.settings), hashes], sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    def goes_on(self, root: Path) -> bool:
        """Return whether the next start goes on with what an earlier one has written."""
        if self.resume_marker:
            return (root / self.resume_marker).is_file()
        folder = root / self.folder
        return folder.is_dir() and any(folder.iterdir())

    def words(self, root: Path) -> tuple[str, ...]:
        """Return the words after `pronk` to start or go on with, and make the folder fit for it."""
        if not self.resume_marker:
            return self.command
        if self.goes_on(root):
            return self.resume_command
        # The command was killed before it could write what it needs to go on.
        shutil.rmtree(root / self.folder, ignore_errors=True)
        return self.command


def program(words: Sequence[str]) -> list[str]:
    """Return the command line of a `pronk` command whose process ends with this one."""
    return [sys.executable, "-m", "pronk.jump.study.task_process", str(os.getpid()), *words]


def program_environment(threads: int) -> dict[str, str]:
    """Return the environment of a task's process.

    Args:
        threads: Number of threads that its libraries get.
    """
    environment = dict(os.environ)
    # The process runs in another folder, where relative entries would mean something else.
    paths = [str(Path(pronk.__file__).resolve().parents[1])]
    for entry in environment.get("PYTHONPATH", "").split(os.pathsep):
        if entry:
            paths.append(str(Path(entry).resolve()))
    environment["PYTHONPATH"] = os.pathsep.join(dict.fromkeys(paths))
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        environment[name] = str(threads)
    return environment


@dataclass(kw_only=True)
class TaskRecord:
    """What is remembered of a task."""

    key: str
    """Hash of all that the result depends on."""
    status: Literal["started", "done", "failed"]
    outputs: dict[str, str] = field(default_factory=dict)
    """SHA-256 of each file that the finished command wrote."""
    attempts: int = 1
    """Number of starts since the study was last begun or continued."""
    seconds: float = 0.0
    """Wall time of the last attempt [s]."""
    place: str = ""
    """Where it ran last: a GPU, a CPU or a node."""
    reason: str = ""
    """Why it failed."""
    sources: tuple[str, ...] = ()
    """Hashes of pronk's sources at its starts, of those that the result goes back to; empty where
    an earlier pronk started it."""


class StudyState:
    """The records of all tasks in `state.json`, written whole at every change."""

    def __init__(self, root: Path) -> None:
        """Read the file, if it is there.

        Args:
            root: Folder of the study.

        Raises:
            ArtefactError: The file is damaged.
        """
        self.root = root
        self.path = root / STATE_FILE
        self.records: dict[str, TaskRecord] = {}
        if not self.path.exists():
            return
        try:
            body = json.loads(self.path.read_text(encoding="utf-8"))
            if body["schema"] != STATE_SCHEMA:
                raise ValueError(f"schema {body['schema']!r}; this pronk reads {STATE_SCHEMA!r}")
            self.records = msgspec.convert(body["tasks"], dict[str, TaskRecord])
        except (OSError, ValueError, LookupError, TypeError) as error:
            raise ArtefactError(
                f"{self.path}: cannot be read ({type(error).__name__}: {error}); delete it, and "
                "run the command again: trainings go on from their checkpoints."
            ) from None

    def set(self, name: str, record: TaskRecord) -> None:
        """Remember the record of a task."""
        self.records[name] = record
        self._write()

    def _write(self) -> None:
        body = {"schema": STATE_SCHEMA, "tasks": msgspec.to_builtins(self.records)}
        write_text(self.path, json.dumps(body, indent=2) + "\n")

    def forget(self, name: str) -> None:
        """Forget the record of a task, which then is run again."""
        del self.records[name]
        self._write()

    def is_done(self, task: StudyTask) -> bool:
        """Return whether a task was done with these inputs, and its outputs are unchanged."""
        record = self.records.get(task.name)
        if record is None or record.status != "done":
            return False
        for path in (*task.inputs, *task.outputs):
            if not (self.root / path).is_file():
                return False
        if record.key != task.key(self.root):
            return False
        hashes = {path: file_hash(self.root / path) for path in task.outputs}
        return hashes == record.outputs

    def check_settings(self, tasks: Sequence[StudyTask]) -> None:
        """Refuse trainings that were begun in this folder with other settings or inputs.

        A policy of which nothing says how it was trained is no start of a training, and is not
        replaced by one either.

        Raises:
            PronkError: There is such a training or policy; nothing was changed.
        """
        changed = []
        folders = []
        has_robot_file = False
        for task in tasks:
            record = self.records.get(task.name)
            if task.kind != "training":
                continue
            if record is None:
                has_marker = (self.root / task.resume_marker).is_file()
                for path in task.outputs:
                    if not has_marker and (self.root / path).is_file():
                        raise PronkError(
                            f"--out {self.root}: {path} is there, but neither {STATE_FILE} nor "
                            f"{task.resume_marker} says how it was trained; copy these files as "
                            "well, or move it away to train again."
                        )
                continue
            # Without the marker the training would begin again, and the policy there be lost.
            is_begun = any(
                (self.root / path).is_file() for path in (task.resume_marker, *task.outputs)
            )
            if is_begun and record.key != task.key(self.root):
                changed.append(task.name)
                folders.append(str(self.root / task.folder))
                has_robot_file |= str(task.settings.get("robot")).startswith(f"{INPUTS}/")
        if changed:
            text = (
                f"--out {self.root}: {', '.join(changed)} was begun there with other settings, "
                "gains, recipe or robot; give another folder, or delete "
                f"{', '.join(folders)} to train anew."
            )
            if has_robot_file:
                text += (
                    " Trainings of a robot.yaml are known by its content. An earlier pronk knew "
                    "them by its path, so that those that it began cannot go on here; name their "
                    "finished policies as `policies` of an arm."
                )
            raise PronkError(text)

    def start(self, task: StudyTask, record: TaskRecord, *, goes_on: bool) -> None:
        """Remember a task that has just been started, and the sources of pronk that it rests on.

        Args:
            task: The task.
            record: Its record, without sources.
            goes_on: Whether it goes on with what earlier starts have written, whose sources then
                count as well.
        """
        sources = [sources_of(task.kind)]
        before = self.records.get(task.name)
        if goes_on and before is not None and before.key == record.key:
            sources = [*before.sources, *sources]
        record.sources = tuple(dict.fromkeys(sources))
        self.set(task.name, record)

    def finish(self, task: StudyTask, record: TaskRecord) -> TaskRecord:
        """Remember a task whose command has ended well; it has failed if an output is missing."""
        missing = [path for path in task.outputs if not (self.root / path).is_file()]
        if missing:
            record.status = "failed"
            record.reason = f"the command ended without {', '.join(missing)}"
        else:
            record.status = "done"
            record.reason = ""
            record.outputs = {path: file_hash(self.root / path) for path in task.outputs}
        self.set(task.name, record)
        return record


def file_hash(path: Path) -> str:
    """Return the SHA-256 of a file, which is read again only if its time or size has changed.

    Every robot of a study has a trial of the same policies.
    """
    status = path.stat()
    return _hash_of_version(path, status.st_mtime_ns, status.st_size)


@cache
def sources_of(kind: TaskKind) -> str:
    """Return the beginning of the hash of the sources that decide what a task computes."""
    return sources_sha256(_SOURCES[kind], (".py", ".xml", ".yaml"))[:12]


@lru_cache(maxsize=10_000)
def _hash_of_version(path: Path, _mtime_ns: int, _size: int) -> str:
    return sha256(path)


def copied_input(root: Path, source: Path, stem: str) -> str:
    """Copy a file to the inputs of a study, under a name with its content's hash.

    Args:
        root: Folder of the study.
        source: The file.
        stem: Beginning of the name of the copy.

    Returns:
        Path of the copy, relative to the folder of the study.
    """
    try:
        content = source.read_bytes()
    except OSError as error:
        raise ArtefactError(f"{source}: {(error.strerror or 'cannot be read').lower()}.") from None
    return written_input(root, content, stem, source.suffix)


def written_input(root: Path, content: bytes, stem: str, suffix: str) -> str:
    """Write a file of the inputs of a study, under a name with its content's hash.

    Args:
        root: Folder of the study.
        content: What the file holds.
        stem: Beginning of its name.
        suffix: Ending of its name.

    Returns:
        Path of the file, relative to the folder of the study.
    """
    digest = hashlib.sha256(content).hexdigest()[:12]
    relative = f"{INPUTS}/{stem}-{digest}{suffix}"
    store_file(root / relative, content)
    return relative


def store_file(path: Path, content: bytes) -> None:
    """Write a file whole, unless it is there with the same content."""
    if path.is_file() and path.read_bytes() == content:
        return
    with written_whole(path) as temporary:
        temporary.write_bytes(content)


def last_lines(path: Path, count: int = 3) -> str:
    """Return the message at the end of a log, or its last lines that are not empty, as one text."""
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            file.seek(max(0, size - 4096))
            text = file.read().decode(errors="replace")
    except OSError:
        return ""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    if lines and lines[-1].startswith("pronk: "):
        return lines[-1].removeprefix("pronk: ")
    return " / ".join(lines[-count:])


@contextmanager
def study_folder(root: Path) -> Iterator[None]:
    """Keep the folder of a study to this process inside the block; missing folders are made.

    Args:
        root: A folder that is new, empty, or that of a study.

    Raises:
        PronkError: It is anything else, or another command writes to it.
    """
    if root.exists() and not root.is_dir():
        raise PronkError(f"--out {root}: a file; expected the name of a folder.")
    if root.is_dir() and not (root / STATE_FILE).exists() and not (root / INPUTS).is_dir():
        names = sorted(path.name for path in root.iterdir())
        if names:
            raise PronkError(
                f"--out {root}: not empty ({', '.join(names[:3])}), and not the folder of several "
                "trainings or a study, which would go on; give another folder."
            )
    with locked_folder(root):
        yield
