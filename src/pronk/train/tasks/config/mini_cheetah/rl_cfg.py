"""PPO of the Mini Cheetah: the shared one."""

from pronk.train.tasks.jump_rl_cfg import jump_rl_cfg as rl_cfg

__all__ = ["rl_cfg"]
