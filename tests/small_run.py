"""A small training run on Warp's CPU device: 16 robots, short rollouts, the real everything else.

Run as a program it trains until it is killed: `python small_run.py FOLDER`.
"""

from __future__ import annotations

import os
import sys
from dataclasses import asdict
from io import StringIO
from pathlib import Path
from typing import Any

os.environ.setdefault("MJLAB_WARP_QUIET", "1")

ROBOTS = 16
STEPS = 8


def build(folder: Path | None, *, seed: int, save_interval: int = 2, phase: str = "jump_a") -> Any:
    """A runner of one phase, and its environment."""
    import torch
    from mjlab.envs import ManagerBasedRlEnv
    from mjlab.rl import RslRlVecEnvWrapper
    from rich.console import Console

    from pronk.train import phases
    from pronk.train.runner.runner import PronkRunner
    from pronk.train.tasks import env_cfg, rl_cfg

    torch.set_num_threads(1)
    begun = phases.phase(phase)
    # So short that episodes end and jumps are asked for within a few iterations.
    environment = env_cfg(phase=begun, num_envs=ROBOTS, seed=seed, episode_s=0.4)
    environment.commands["motion"].jump_off_s = (0.04, 0.2)
    learning = rl_cfg(jump=begun.jump, seed=seed)
    learning.num_steps_per_env = STEPS
    learning.save_interval = save_interval
    env = RslRlVecEnvWrapper(ManagerBasedRlEnv(environment, device="cpu"))
    runner = PronkRunner(env, asdict(learning), None if folder is None else str(folder), "cpu")
    runner.phase = phase
    runner.console = Console(file=StringIO())
    return runner


if __name__ == "__main__":
    build(Path(sys.argv[1]), seed=5, save_interval=1).learn(1000, init_at_random_ep_len=True)
