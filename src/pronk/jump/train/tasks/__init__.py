"""The tasks: configurations of the environment and of PPO for each robot, registered with mjlab.

mjlab finds this package by its entry point, so its `train`, `play` and `list-envs` have the tasks
`Pronk-Jump-ROBOT` (the whole recipe) and `Pronk-Walk-ROBOT` (phase 1 alone), with nominal gains.
`pronk train` builds the same configurations with the given gains.

What differs for a robot lies beside its `robot.yaml`: `env_cfgs.py` (with `env_cfg`) and,
optionally, `rl_cfg.py` (with `rl_cfg`). With them a robot outside this package has a task, too.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from mjlab.envs import ManagerBasedRlEnvCfg
from mjlab.rl import RslRlOnPolicyRunnerCfg
from mjlab.tasks.registry import register_mjlab_task

from pronk.errors import PronkError
from pronk.jump.train.gains import NAIVE, training_gains
from pronk.jump.train.phases import TASKS
from pronk.jump.train.rl.runner import PronkRunner
from pronk.jump.train.tasks.jump_env_cfg import play_cfg
from pronk.jump.train.tasks.jump_rl_cfg import jump_rl_cfg
from pronk.jump.train.tasks.term_check import check_terms
from pronk.robots import load_robot, robot_file_path
from pronk.robots.robot import RobotSpec

ROBOTS = ("mini_cheetah", "go2")
"""Robots of this package with a task."""
JUMP_TASK = "Pronk-Jump-MiniCheetah"
"""Name of the registered task with all phases."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """The configurations of one robot; arguments are those of `jump_env_cfg`, `jump_rl_cfg`."""

    robot: RobotSpec
    env_cfg: Callable[..., ManagerBasedRlEnvCfg]
    rl_cfg: Callable[..., RslRlOnPolicyRunnerCfg]


def load_task(robot: str) -> Task:
    """Load the task of a robot.

    Args:
        robot: Name or robot.yaml of the robot.

    Raises:
        PronkError: The robot has no task, or a file of it cannot be used.
    """
    spec = load_robot(robot)
    folder = robot_file_path(spec.source).parent
    env_file = folder / "env_cfgs.py"
    rl_file = folder / "rl_cfg.py"
    if not env_file.is_file():
        raise PronkError(
            f"{robot} has no training task: expected {env_file} with a function env_cfg, as "
            f"docs/train-your-robot.md has one, or one of the robots {', '.join(ROBOTS)}."
        )
    make_env_cfg = _function(env_file, "env_cfg")

    def env_cfg(*arguments: Any, **options: Any) -> ManagerBasedRlEnvCfg:
        cfg: ManagerBasedRlEnvCfg = make_env_cfg(*arguments, **options)
        check_terms(cfg, env_file)
        return cfg

    rl_cfg = _function(rl_file, "rl_cfg") if rl_file.is_file() else jump_rl_cfg
    return Task(robot=spec, env_cfg=env_cfg, rl_cfg=rl_cfg)


def _function(path: Path, name: str) -> Callable[..., Any]:
    """Import a function from a file."""
    module_spec = importlib.util.spec_from_file_location(path.stem, path)
    assert module_spec is not None
    assert module_spec.loader is not None
    module: ModuleType = importlib.util.module_from_spec(module_spec)
    try:
        module_spec.loader.exec_module(module)
    except Exception as error:
        raise PronkError(
            f"{path}: cannot be imported ({type(error).__name__}: {error})."
        ) from error
    function = getattr(module, name, None)
    if not callable(function):
        raise PronkError(f"{path}: has no function {name}.")
    return function


def _register() -> None:
    """Register the tasks of all robots of this package with mjlab."""
    for robot in ROBOTS:
        task = load_task(robot)
        gains = training_gains(NAIVE, task.robot)
        robot_name = "".join(word.capitalize() for word in robot.split("_"))
        for task_name in ("Jump", "Walk"):
            iterations = TASKS[task_name.lower()]
            register_mjlab_task(
                task_id=f"Pronk-{task_name}-{robot_name}",
                env_cfg=task.env_cfg(task.robot, gains, iterations=iterations),
                play_env_cfg=play_cfg(task.env_cfg(task.robot, gains, iterations=iterations)),
                rl_cfg=task.rl_cfg(iterations=sum(iterations.values())),
                runner_cls=PronkRunner,
            )


_register()
