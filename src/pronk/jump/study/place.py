"""Where the tasks of a study run: the GPUs or cores of this host, or a Ray cluster."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from pronk.errors import PronkError
from pronk.jump.study.local import local_executor
from pronk.jump.study.schedule import Executor
from pronk.jump.study.trainings import TrainingPlace
from pronk.tables import counted

CLUSTER_PER_GPU = 4
"""Trainings of 4,096 robots on one GPU of a cluster, where nothing is measured first: on an H200
under MPS four reach 87,000 steps/s each, 2.1 times one alone."""


@dataclass(frozen=True, kw_only=True)
class StudyPlace:
    """Where tasks run. None: left out."""

    gpus: str | None = None
    """GPUs of this host to spread trainings over, as in 0,1; all if left out."""
    per_gpu: int | None = None
    """Trainings on one GPU at once; found from memory and measured rates if left out."""
    jobs: int | None = None
    """Without a GPU: trainings at once; as many as there are cores if left out."""
    cluster: str | None = None
    """Run on a Ray cluster instead, ray://HOST:PORT, or local for this host under Ray."""

    def __post_init__(self) -> None:
        """Refuse numbers out of range and options that do not go together."""
        for option, value in (("--per-gpu", self.per_gpu), ("--jobs", self.jobs)):
            if value is not None and not 1 <= value <= 1000:
                raise PronkError(f"{option} is {value}; expected 1 to 1000.")
        if self.gpus is not None and self.jobs is not None:
            raise PronkError(
                "--jobs is for trainings without a GPU; give --per-gpu with --gpus instead."
            )
        if self.cluster is not None:
            if self.gpus is not None or self.jobs is not None:
                raise PronkError(
                    "--cluster takes what its nodes have; leave --gpus and --jobs out, and give "
                    "--per-gpu for the number of trainings on one GPU."
                )
            is_address = self.cluster.startswith("ray://") and len(self.cluster) > len("ray://")
            if self.cluster != "local" and not is_address:
                raise PronkError(
                    f"--cluster {self.cluster!r}: expected ray://HOST:PORT, or local for this host."
                )

    @property
    def is_given(self) -> bool:
        """True if any of the options was given."""
        return (self.gpus, self.per_gpu, self.jobs, self.cluster) != (None, None, None, None)

    @property
    def words(self) -> list[str]:
        """The options as on the command line."""
        words = []
        for option, value in (
            ("--gpus", self.gpus),
            ("--per-gpu", self.per_gpu),
            ("--jobs", self.jobs),
            ("--cluster", self.cluster),
        ):
            if value is not None:
                words += [option, str(value)]
        return words


@dataclass(frozen=True, kw_only=True)
class ChosenPlace:
    """Devices of this host that were found, or the address of a cluster."""

    training: TrainingPlace
    gpus: tuple[str, ...] = ()
    """GPUs as `CUDA_VISIBLE_DEVICES` names them."""
    cores: float = 1.0
    """Number of cores to share."""
    per_gpu: int | None = None
    cluster: str | None = None

    def trial_processes(self, trials: int) -> int:
        """Return how many jumps of each trial may run at once, so that all cores have work.

        The cores of a cluster's nodes are not known before, so a trial has one there.
        """
        if self.cluster is not None or trials == 0:
            return 1
        return max(1, int(self.cores / trials))

    @property
    def words(self) -> str:
        """What it is, in a few words."""
        if self.cluster is not None:
            return f"the Ray cluster {self.cluster}"
        if self.gpus:
            return f"{counted(len(self.gpus), 'GPU')} and {counted(self.cores, 'core')}"
        trainings = counted(round(self.cores / self.training.cores), "training")
        return f"{counted(self.cores, 'core')}, {trainings} at once"


def choose_place(place: StudyPlace, device: Literal["auto", "cpu", "cuda"]) -> ChosenPlace:
    """Find the devices.

    Args:
        place: The options.
        device: auto: GPUs if there are any.

    Raises:
        PronkError: There are no such devices.
    """
    from pronk.jump.train.devices import find_devices
    from pronk.jump.trial.trial import usable_cores

    if place.cluster is not None:
        from pronk.jump.study.ray_cluster import require_ray

        require_ray()
        kind = "cpu" if device == "cpu" else "cuda"
        per_gpu = place.per_gpu or CLUSTER_PER_GPU
        training = TrainingPlace(device=kind)
        return ChosenPlace(training=training, per_gpu=per_gpu, cluster=place.cluster)
    cores = float(usable_cores())
    gpus: tuple[str, ...] = ()
    if device == "cpu" and place.gpus is None:
        gpus = ()
    else:
        requested = place.gpus
        if requested is None and device != "cpu" and find_devices(device):
            requested = "all"
        if requested is not None:
            gpus = find_devices(device, requested, option="--gpus")
    if gpus:
        if place.jobs is not None:
            raise PronkError(
                "--jobs is for trainings without a GPU; give --per-gpu, or --device cpu."
            )
        training = TrainingPlace(device="cuda")
        return ChosenPlace(training=training, gpus=gpus, cores=cores, per_gpu=place.per_gpu)
    if place.per_gpu is not None:
        raise PronkError("--per-gpu goes with a GPU; give --jobs with --device cpu.")
    jobs = place.jobs or int(cores)
    training = TrainingPlace(device="cpu", cores=cores / jobs)
    return ChosenPlace(training=training, cores=cores)


@dataclass(frozen=True, kw_only=True)
class PlannedGpus:
    """The GPUs for which a study is planned; they need not be in this host."""

    count: int | None
    """Number of GPUs; None where the trainings would have none, or it is not known."""
    per_gpu: int = CLUSTER_PER_GPU
    """Trainings on one GPU at once."""
    is_per_gpu_given: bool = False
    """False where it is the number that was measured, for want of another."""
    words: str
    """Where the number of GPUs comes from, or why there is none, in a few words."""


def planned_gpus(place: StudyPlace, device: Literal["auto", "cpu", "cuda"]) -> PlannedGpus:
    """Return the GPUs to plan for: those that are named, or those of this host.

    Args:
        place: The options.
        device: auto: GPUs if there are any.

    Raises:
        PronkError: GPUs that are no numbers.
    """
    from pronk.jump.train.devices import parse_gpu_ids, visible_gpus

    count = None
    if device == "cpu":
        if place.gpus is not None:
            raise PronkError(f"--gpus {place.gpus} goes with a GPU; leave it or --device cpu out.")
        words = "--device cpu"
    elif place.cluster is not None:
        words = "those of the cluster are not counted before; plan with --gpus 0,1,2,3 for four"
    elif place.gpus is not None and place.gpus.strip() != "all":
        count = len(parse_gpu_ids(place.gpus, "--gpus"))
        words = f"--gpus {place.gpus}"
    elif find_spec("torch") is not None and visible_gpus():
        count = len(visible_gpus())
        words = "those of this host"
    else:
        words = "no GPU here; --gpus 0,1,2,3 plans for a host with four"
    return PlannedGpus(
        count=count,
        per_gpu=place.per_gpu or CLUSTER_PER_GPU,
        is_per_gpu_given=place.per_gpu is not None,
        words=words,
    )


@contextmanager
def open_executor(place: ChosenPlace, root: Path, say: Callable[[str], None]) -> Iterator[Executor]:
    """Make the executor of a place.

    Args:
        place: The devices or the cluster.
        root: Folder of the study.
        say: Called with a line of text.
    """
    if place.cluster is not None:
        from pronk.jump.study.ray_cluster import ray_executor

        with ray_executor(root, place.cluster, per_gpu=place.per_gpu or 1, say=say) as executor:
            yield executor
        return
    with local_executor(
        root, gpus=place.gpus, cores=place.cores, per_gpu=place.per_gpu, say=say
    ) as executor:
        yield executor
        if executor.summary():
            say(executor.summary())
