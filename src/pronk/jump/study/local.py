"""Tasks as processes of this host, several on each GPU, or as many on the CPU as it has cores."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from pronk.jump.study.mps import mps_daemon
from pronk.jump.study.packing import (
    GpuRates,
    RateReading,
    free_memory_mib,
    packing_text,
    settled_rates,
)
from pronk.jump.study.schedule import TaskEnd, end_of_log
from pronk.jump.study.tasks import StudyTask, program, program_environment
from pronk.jump.train.training_progress import PROGRESS_FILE, read_progress
from pronk.processes import exit_words

CHECKPOINT_S = 120.0
"""Longest time that a training has to write its checkpoint when it is asked to end [s]."""
MEASURE_S = 5.0
"""Time between two looks at the rates of trainings when none waits [s]."""
_MEMORY_S = 2.0
"""Shortest time between two readings of the memory of the GPUs [s]."""


@dataclass(kw_only=True)
class _Process:
    task: StudyTask
    process: subprocess.Popen[bytes]
    log: IO[bytes]
    gpu: str
    stepping_since: float | None = None
    """Unix time at which its first progress was seen [s]; None before."""
    begun: float
    """Unix time at which it was started [s]."""


@dataclass(kw_only=True)
class _Gpu:
    name: str
    """As `CUDA_VISIBLE_DEVICES` names it."""
    free_at_first_mib: float | None = None
    """Memory that was free before the first training [MiB]; None if it cannot be read."""
    trainings: list[_Process] = field(default_factory=list)
    last_ended_at: float = 0.0
    """Unix time at which a training there ended last [s]; 0 if none has."""


class LocalExecutor:
    """Runs tasks as processes of this host; `local_executor` makes one."""

    def __init__(
        self,
        root: Path,
        *,
        gpus: Sequence[str] = (),
        cores: float = 1.0,
        per_gpu: int | None = None,
        variables: Mapping[str, str] | None = None,
    ) -> None:
        """Note the resources.

        Args:
            root: Folder of the study, in which the tasks run.
            gpus: GPUs as `CUDA_VISIBLE_DEVICES` names them; none for the CPU.
            cores: Number of cores to share.
            per_gpu: Number of trainings on one GPU; None to find it while they run.
            variables: Environment variables of all tasks, as those of MPS.
        """
        self.root = root
        self.cores = cores
        self.rates = GpuRates(limit=per_gpu)
        self._gpus = [_Gpu(name=name) for name in gpus]
        self._variables = dict(variables or {})
        self._processes: list[_Process] = []
        self._memory: Mapping[str, float] = {}
        self._memory_read_at = -_MEMORY_S
        self._measured_at = -MEASURE_S
        self._training_cores = 1.0

    def try_start(self, task: StudyTask) -> str:
        """Start a task if there is room; return where it runs, or nothing if there is no room."""
        used_cores = 0.0
        for process in self._processes:
            used_cores += process.task.cores
        # A task that wants more cores than there are gets all of them.
        if self._processes and used_cores + task.cores > self.cores + 1e-6:
            return ""
        if task.kind == "training":
            self._training_cores = task.cores
        if not task.gpu:
            self._start(task, None)
            return "CPU"
        gpu = self._free_gpu()
        if gpu is None:
            return ""
        self._start(task, gpu)
        return f"GPU {gpu.name}"

    def _free_gpu(self) -> _Gpu | None:
        """Return the GPU with the fewest trainings, if another one may start there."""
        if not self._gpus:
            return None
        gpu = min(self._gpus, key=lambda candidate: len(candidate.trainings))
        if self.rates.may_add(len(gpu.trainings), self._measured(gpu)):
            return gpu
        return None

    def _measured(self, gpu: _Gpu) -> bool:
        """Note rates and memory of a GPU if all trainings there have shown them; say whether so.

        Rates count a while after the last training began to step there and the last one ended.
        """
        readings = []
        same_since = gpu.last_ended_at
        for training in gpu.trainings:
            folder = self.root / training.task.folder
            moment = _progress_time(folder)
            progress = read_progress(folder)
            if progress is None or moment < training.begun:
                return False
            if training.stepping_since is None:
                training.stepping_since = moment
            same_since = max(same_since, training.stepping_since)
            iterations_left = progress.iterations - progress.iteration
            reading = RateReading(
                written_at=moment,
                steps_per_second=progress.steps_per_second,
                iteration_s=progress.seconds_left / max(iterations_left, 1),
                is_last=iterations_left <= 0,
            )
            readings.append(reading)
        if not readings:
            return True
        rates = settled_rates(readings, same_since)
        if not rates:
            return False
        self.rates.note(rates)
        free = self._free_memory(gpu.name)
        if free is not None and gpu.free_at_first_mib is not None:
            needed = (gpu.free_at_first_mib - free) / len(rates)
            self.rates.note_memory(len(rates), free, needed)
        return self.rates.limit is None

    def _free_memory(self, gpu: str) -> float | None:
        """Return the free memory of a GPU [MiB], or None if it cannot be read."""
        if time.monotonic() - self._memory_read_at > _MEMORY_S:
            self._memory_read_at = time.monotonic()
            self._memory = {}
            with suppress(OSError, subprocess.SubprocessError):
                query = ["nvidia-smi", "--query-gpu=index,uuid,memory.free"]
                process = subprocess.run(
                    [*query, "--format=csv,noheader,nounits"],
                    capture_output=True,
                    text=True,
                    timeout=20,
                    check=True,
                )
                self._memory = free_memory_mib(process.stdout)
        return self._memory.get(gpu)

    def _start(self, task: StudyTask, gpu: _Gpu | None) -> None:
        """Start the process of a task."""
        environment = program_environment(task.threads)
        environment.update(self._variables)
        # Numbers of GPUs are those of nvidia-smi.
        environment["CUDA_DEVICE_ORDER"] = "PCI_BUS_ID"
        environment["CUDA_VISIBLE_DEVICES"] = "" if gpu is None else gpu.name
        if gpu is not None and not gpu.trainings:
            gpu.free_at_first_mib = self._free_memory(gpu.name)
        words = task.words(self.root)
        log_file = self.root / task.log()
        log_file.parent.mkdir(parents=True, exist_ok=True)
        log = log_file.open("ab")
        log.write(f"$ pronk {' '.join(words)}\n".encode())
        log.flush()
        process = subprocess.Popen(
            program(words),
            cwd=self.root,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            # Ctrl-C goes to this process alone, which then asks the others to end.
            start_new_session=True,
        )
        begun = time.time()
        started = _Process(
            task=task,
            process=process,
            log=log,
            gpu="" if gpu is None else gpu.name,
            begun=begun,
        )
        self._processes.append(started)
        if gpu is not None:
            gpu.trainings.append(started)

    def poll(self) -> list[TaskEnd]:
        """Return the tasks that have ended since the last call."""
        if time.monotonic() - self._measured_at > MEASURE_S:
            self._measured_at = time.monotonic()
            for gpu in self._gpus:
                self._measured(gpu)
        ends = []
        for process in list(self._processes):
            status = process.process.poll()
            if status is None:
                continue
            self._forget(process)
            if status == 0:
                ends.append(TaskEnd(name=process.task.name, ended="well"))
                continue
            how = exit_words(status, _way_out(process))
            log_end = end_of_log(self.root, process.task)
            if "out of memory" in log_end.lower() and process.gpu:
                beside = max(len(gpu.trainings) for gpu in self._gpus)
                if self.rates.limit is None or self.rates.limit > beside:
                    self.rates.limit = max(beside, 1)
                    self.rates.reason = f"with {beside + 1} the memory of a GPU was used up"
            reason = f"the process {how}: {log_end}"
            ends.append(TaskEnd(name=process.task.name, ended="failed", reason=reason))
        return ends

    def _forget(self, process: _Process) -> None:
        process.log.close()
        self._processes.remove(process)
        for gpu in self._gpus:
            if process in gpu.trainings:
                gpu.trainings.remove(process)
                gpu.last_ended_at = time.time()

    def stop(self) -> None:
        """End all tasks, trainings at a checkpoint, and wait until they have ended."""
        for process in self._processes:
            with suppress(ProcessLookupError):
                process.process.send_signal(signal.SIGTERM)
        deadline = time.monotonic() + CHECKPOINT_S
        for process in list(self._processes):
            try:
                process.process.wait(max(0.1, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                with suppress(ProcessLookupError):
                    os.killpg(process.process.pid, signal.SIGKILL)
                process.process.wait()
            self._forget(process)

    def rooms(self) -> int:
        """Return how many trainings run at once when there are enough."""
        if not self._gpus:
            return max(1, int(self.cores / max(self._training_cores, 1e-6) + 1e-6))
        busiest = max(len(gpu.trainings) for gpu in self._gpus)
        each = max(self.rates.limit or 1, busiest)
        return each * len(self._gpus)

    def summary(self) -> str:
        """Return one sentence on how many trainings ran side by side; empty without a GPU."""
        return packing_text(self.rates)


def _way_out(process: _Process) -> str:
    """Return what can be done if a process was killed for want of memory."""
    if process.gpu:
        return "give fewer --per-gpu"
    if process.task.kind == "training":
        return "give fewer --jobs"
    return "run it on fewer cores, as in `taskset --cpu-list 0-3 pronk study ...`"


def _progress_time(folder: Path) -> float:
    """Return when the progress of a training was written [Unix time, s]; 0 if it was not."""
    try:
        return (folder / PROGRESS_FILE).stat().st_mtime
    except OSError:
        return 0.0


@contextmanager
def local_executor(
    root: Path,
    *,
    gpus: Sequence[str],
    cores: float,
    per_gpu: int | None,
    say: Callable[[str], None],
) -> Iterator[LocalExecutor]:
    """Make an executor on this host, with MPS where several trainings share a GPU.

    Args:
        root: Folder of the study.
        gpus: GPUs as `CUDA_VISIBLE_DEVICES` names them; none for the CPU.
        cores: Number of cores to share.
        per_gpu: Number of trainings on one GPU; None to find it while they run.
        say: Called with a line of text.
    """
    if not gpus or per_gpu == 1:
        yield LocalExecutor(root, gpus=gpus, cores=cores, per_gpu=per_gpu)
        return
    with mps_daemon(root / "mps", say) as variables:
        yield LocalExecutor(root, gpus=gpus, cores=cores, per_gpu=per_gpu, variables=variables)
