"""One folder a robot: `env_cfgs.py` and `rl_cfg.py`."""
