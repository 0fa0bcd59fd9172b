"""What one process of a training does: a session of mjlab's training, with a log of its own."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import torch
from mjlab.envs import ManagerBasedRlEnv
from mjlab.rl import RslRlVecEnvWrapper
from mjlab.scripts import train as mjlab_train
from mjlab.utils.os import dump_yaml
from mjlab.utils.torch import configure_torch_backends
from mjlab.utils.wandb import add_wandb_tags

from pronk.jump.train import devices
from pronk.jump.train.provenance import RunFolder
from pronk.jump.train.rl.runner import PronkRunner


def train_process(config: mjlab_train.TrainConfig, log_dir: Path) -> None:
    """Do what one process does: all of a session, with what the libraries print in a file.

    It is mjlab's `run_train` for tasks of this package, which on a CPU knows one process only.

    Args:
        config: mjlab's configuration of the training.
        log_dir: Folder of the run.
    """
    rank = int(os.environ.get("RANK", "0"))
    log_file = log_dir / ("train.log" if rank == 0 else f"train.{rank}.log")
    device = "cpu"
    if os.environ["CUDA_VISIBLE_DEVICES"]:
        local_rank = os.environ.get("LOCAL_RANK", "0")
        device = f"cuda:{local_rank}"
        torch.cuda.set_device(device)
        # The device that MuJoCo renders on.
        os.environ["MUJOCO_EGL_DEVICE_ID"] = local_rank
    config.agent.seed += rank
    config.env.seed = config.agent.seed
    with (
        log_file.open("a", encoding="utf-8", buffering=1) as file,
        contextlib.redirect_stdout(file),
        _closed_process_group(),
    ):
        devices.compile_kernels(device)
        configure_torch_backends()
        env = RslRlVecEnvWrapper(
            ManagerBasedRlEnv(cfg=config.env, device=device), clip_actions=config.agent.clip_actions
        )
        agent_values = asdict(config.agent)
        if rank == 0:
            # The runner changes what it is given.
            dump_yaml(log_dir / "params" / "env.yaml", asdict(config.env))
            dump_yaml(log_dir / "params" / "agent.yaml", agent_values)
        runner = PronkRunner(env, agent_values, str(log_dir), device)
        add_wandb_tags(config.agent.wandb_tags)
        runner.add_git_repo_to_log(mjlab_train.__file__)
        if config.agent.resume:
            runner.load(str(RunFolder(log_dir).checkpoint()))
        runner.learn(config.agent.max_iterations, init_at_random_ep_len=True)
        env.close()


@contextlib.contextmanager
def _closed_process_group() -> Iterator[None]:
    """Leave the process group of a CPU after the block.

    If one process fails, the others then notice at once that it is gone, where they would wait half
    an hour for it.
    """
    try:
        yield
    finally:
        distributed = torch.distributed
        if distributed.is_initialized() and distributed.get_backend() == "gloo":
            distributed.destroy_process_group()
