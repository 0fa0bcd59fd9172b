"""What follows from the settings of a run: gains, phases, configurations, the policy's contract."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from pronk.errors import ArtefactError
from pronk.files import sha256
from pronk.policy.contract import Contract
from pronk.robots import load_robot
from pronk.train.gains import NAIVE, TrainingGains, training_gains
from pronk.train.mdp.commands import NAME, MotionCommandCfg
from pronk.train.mdp.randomization import Randomization, delay_steps
from pronk.train.phases import Phase, with_iterations
from pronk.train.rl.export import contract_for
from pronk.train.runner.request import ROBOT
from pronk.train.runner.run_folder import plain
from pronk.train.runner.settings import TrainSettings
from pronk.train.tasks import ACTION_SCALE, env_cfg, rl_cfg

_LEARNING = ("num_steps_per_env", "obs_groups", "clip_actions", "actor", "critic", "algorithm")
"""What of rsl_rl's configuration decides what is learned."""


def run_gains(settings: TrainSettings, file: Path | None) -> TrainingGains:
    """The gains of a run.

    Args:
        settings: What is trained.
        file: The `gains.yaml` that the settings name by its hash; not looked at if they name none.

    Raises:
        ArtefactError: The file is missing or another one.
    """
    robot = load_robot(ROBOT)
    if not settings.gains_sha256:
        return training_gains(NAIVE, robot)
    if file is None or not file.is_file() or sha256(file) != settings.gains_sha256:
        raise ArtefactError(
            f"{file}: missing or changed since the run began; put the file with SHA-256 "
            f"{settings.gains_sha256[:12]}... back, or begin a new run."
        )
    if settings.gains == NAIVE:
        return training_gains(NAIVE, robot, like=file)
    return training_gains(file, robot)


def run_phases(settings: TrainSettings) -> tuple[Phase, ...]:
    """The phases of a run, with its numbers of iterations."""
    return tuple(p for p in with_iterations(settings.iterations) if p.name in settings.phases)


def run_randomization(settings: TrainSettings) -> Randomization:
    """What is drawn in a run."""
    return Randomization(gains="ellipsoid" if settings.ellipsoid else "box")


def run_contract(
    settings: TrainSettings, gains: TrainingGains, phase: Phase, *, run: str
) -> Contract:
    """The contract of the policy that a phase ends with.

    Args:
        settings: What is trained.
        gains: With which gains.
        phase: One of `run_phases`.
        run: Name of the run.
    """
    robot, phases = load_robot(ROBOT), run_phases(settings)
    command = env_cfg(gains=gains, num_envs=1).commands[NAME]
    assert isinstance(command, MotionCommandCfg)
    return contract_for(
        robot,
        # A contract has the hash of gains alone, not of the ranges about naive ones.
        gains if gains.name != NAIVE else replace(gains, sha256=""),
        action_scale=ACTION_SCALE,
        delay_steps=delay_steps(robot, gains, run_randomization(settings)),
        command_limits=command.limits,
        lift_off_velocity=command.settings.liftoff_velocity if phase.jump else None,
        provenance={
            "run": run,
            "phases": {p.name: p.iterations for p in phases[: phases.index(phase) + 1]},
            "start_sha256": settings.start_sha256,
            "ranges_sha256": gains.sha256,
            "envs": settings.envs * settings.gpus,
            "seed": settings.seed,
        },
    )


def resolved(settings: TrainSettings, gains: TrainingGains) -> dict[str, Any]:
    """What follows from the settings, for people to read: every number that a run is made of.

    Args:
        settings: What is trained.
        gains: With which gains.
    """
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
    learning = {
        p.name: plain(rl_cfg(jump=p.jump, seed=settings.seed, entropy=p.entropy)) for p in phases
    }
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
