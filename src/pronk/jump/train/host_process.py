"""The function that torchrunx takes to each host.

The agents of torchrunx read it as they pass it on. This module imports nothing that is large, and
the configuration is bytes, so that only the processes that train import mjlab.
"""

from __future__ import annotations


def train_packed(packed: bytes) -> None:
    """Train in this process.

    Args:
        packed: Configuration and folder of the run, as `launch` packs them.
    """
    import cloudpickle

    from pronk.garbage import collect_less_often, end_without_collection

    collect_less_often()
    # From the agent, which has unpickled this function just so.
    config, log_dir = cloudpickle.loads(packed)

    from pronk.jump.train.train_process import train_process

    train_process(config, log_dir)
    end_without_collection()
