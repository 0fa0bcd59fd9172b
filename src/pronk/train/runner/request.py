"""What a user requested, made into the settings of a run: a new one, or one that is resumed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NoReturn

from pronk.errors import ArtefactError, PronkError
from pronk.files import sha256
from pronk.robots import load_robot
from pronk.train.gains import NAIVE, training_gains
from pronk.train.runner.checkpoint import about
from pronk.train.runner.devices import Devices, find_devices, parse_gpu_ids, require_extra
from pronk.train.runner.run_folder import RunFolder
from pronk.train.runner.settings import PHASES_OF, TrainSettings, check_iterations

ROBOT = "mini_cheetah"
"""The robot that training knows."""

_OPTIONS = {
    "task": "the task",
    "gains": "--gains",
    "gains_sha256": "--gains (or --ranges-from)",
    "start_sha256": "--init-checkpoint",
    "ellipsoid": "--ellipsoid",
    "gpus": "--gpu-ids",
}


@dataclass(frozen=True, kw_only=True)
class Request:
    """What was requested. None: not requested, so a default or, resumed, what the run has."""

    task: str
    gains: str | None = None
    """`naive`, or the path of a `gains.yaml`."""
    like: Path | None = None
    """With naive gains: the `gains.yaml` whose ranges and delay are used."""
    start: Path | None = None
    """`jump`: folder of a walking run, or one of its checkpoints."""
    iterations: Mapping[str, int] = field(default_factory=dict)
    """By name of the phase; those left out keep their default."""
    envs: int | None = None
    seed: int | None = None
    ellipsoid: bool | None = None
    device: str | None = None
    """`auto`, `cpu` or `cuda`."""
    gpu_ids: str | None = None
    """As typed: `0,1` or `all`."""

    def __post_init__(self) -> None:
        """Refuse options that do not go together.

        Raises:
            PronkError: One sentence that names them.
        """
        check_iterations(self.task, self.iterations)
        if self.like is not None and self.gains not in (None, NAIVE):
            raise PronkError(
                f"--ranges-from {self.like} goes with --gains naive; {self.gains} has its own ranges."  # noqa: E501
            )
        if self.start is not None and self.task != "jump":
            raise PronkError(
                f"--init-checkpoint {self.start} goes with jump; {self.task} begins with random weights."  # noqa: E501
            )
        if self.gpu_ids is not None:
            parse_gpu_ids(self.gpu_ids)
            if self.device == "cpu":
                raise PronkError(
                    f"--gpu-ids {self.gpu_ids} goes with a GPU; leave it or --device cpu out."
                )

    @property
    def gains_file(self) -> Path | None:
        """The `gains.yaml` that is read, if any."""
        if self.gains is None or self.gains == NAIVE:
            return self.like
        return Path(self.gains)

    def named(self) -> dict[str, Any]:
        """The settings that were requested by name and need no GPU to be given.

        Raises:
            ArtefactError: The gains cannot be read, or are of another robot or simulator; or there
                is no such checkpoint.
        """
        requested: dict[str, Any] = {"task": self.task}
        for name in ("envs", "seed", "ellipsoid"):
            if getattr(self, name) is not None:
                requested[name] = getattr(self, name)
        if self.gains is not None:
            gains = training_gains(self.gains, load_robot(ROBOT), like=self.like)
            requested |= {"gains": gains.name, "gains_sha256": gains.sha256}
        elif self.like is not None:
            requested |= {"gains": NAIVE, "gains_sha256": _hash(self.like)}
        if self.start is not None:
            path = walking_checkpoint(self.start)
            requested |= {"start": str(path.resolve()), "start_sha256": _hash(path)}
        return requested


def new_settings(request: Request) -> tuple[TrainSettings, Devices]:
    """Settings of a run that begins.

    Raises:
        PronkError: Something that a new run needs was not requested, or what was requested is
            impossible, here or at all.
    """
    if request.gains is None:
        raise PronkError(
            "a new run needs --gains: the gains.yaml of `pronk match`, or naive for the gains of "
            "the real drives as they are."
        )
    if request.task == "jump" and request.start is None:
        raise PronkError(
            "jump needs --init-checkpoint: the folder of a walking run, or one of its checkpoints; "
            "`pronk train all` does both."
        )
    requested = request.named()
    require_extra()
    devices = find_devices(request.device or "auto", request.gpu_ids)
    # What is imported next may look at the GPUs.
    devices.claim()
    from pronk.train.phases import PHASES

    defaults = {phase.name: phase.iterations for phase in PHASES}
    if request.task == "together":
        # As many steps in all as in sequence.
        defaults["jump_a"] += defaults.pop("walk")
    iterations = {
        name: request.iterations.get(name, defaults[name]) for name in PHASES_OF[request.task]
    }
    settings = TrainSettings(
        **requested, iterations=iterations, device=devices.device, gpus=devices.count
    )
    return settings, devices


def resumed_settings(request: Request, folder: RunFolder) -> tuple[TrainSettings, Devices]:
    """Settings of the run in a folder, if nothing else was requested.

    Raises:
        ArtefactError: There is no run in the folder.
        PronkError: A setting is another one; the message names it. Or the run's devices are
            missing.
    """
    stored = folder.settings()
    requested = request.named() | {
        f"iterations of {name}": count for name, count in request.iterations.items()
    }
    has = asdict(stored) | {
        f"iterations of {name}": count for name, count in stored.iterations.items()
    }
    requested.pop("start", None)
    for name, value in requested.items():
        if value != has[name]:
            _refuse(name, value, has[name], folder)
    require_extra()
    ids = request.gpu_ids
    if ids is None and stored.device == "cuda":
        ids = ",".join(str(i) for i in range(stored.gpus))
    devices = find_devices(request.device or stored.device, ids)
    for name, value in (("device", devices.device), ("gpus", devices.count)):
        if value != has[name]:
            _refuse(name, value, has[name], folder)
    return stored, devices


def _refuse(name: str, requested: object, stored: object, folder: RunFolder) -> NoReturn:
    raise PronkError(
        f"--resume: {_OPTIONS.get(name, name)} is {requested}, but the run in {folder.path} has "
        f"{'none' if stored == '' else stored}; leave it out to continue that run, or give a new "
        "--out."
    )


def walking_checkpoint(path: Path) -> Path:
    """The checkpoint of a walking policy.

    Args:
        path: The checkpoint itself, or the folder of a run whose phase 1 is over.

    Raises:
        ArtefactError: There is none, or it is not of phase 1.
    """
    found = RunFolder(path).last_of("walk") if path.is_dir() else path
    if not found.is_file():
        raise ArtefactError(
            f"--init-checkpoint {path}: no {found.name if path.is_dir() else 'such file'}; expected the "  # noqa: E501
            "folder of a run whose phase walk is over, or one of its checkpoints."
        )
    phase = about(found).get("phase")
    if phase != "walk":
        raise ArtefactError(
            f"--init-checkpoint {found}: a checkpoint of phase {phase}; expected one of phase walk, whose "  # noqa: E501
            "networks have no jump input yet."
        )
    return found


def _hash(path: Path) -> str:
    try:
        return sha256(path)
    except OSError as error:
        raise ArtefactError(f"{path}: cannot be read ({error.strerror}).") from None
