"""MCAP files: logs of pronk, and bags of ROS."""

from __future__ import annotations

from pathlib import Path

from pronk.errors import LogError
from pronk.identify.logs.bag import read_bag
from pronk.identify.logs.bag_reader import join_topics, wanted_messages
from pronk.identify.logs.joint_log import JointLog
from pronk.identify.logs.options import ReadOptions
from pronk.identify.logs.recording import RECORDING_PREFIX, read_recording
from pronk.identify.logs.sweep_reader import read_sweep
from pronk.robots.robot import RobotSpec


def read_mcap(path: Path, robot: RobotSpec | None, options: ReadOptions) -> JointLog:
    """Read a log of pronk or a bag.

    A file that was cut anywhere gives the log of what came before, with `complete` False. The
    options are of bags alone.

    Raises:
        LogError: The file is no MCAP file, or holds neither kind of log.
    """
    messages, damage = read_bag(path, wanted_messages(options))
    is_sweep = any(message.topic.startswith("/sweep/") for message in messages)
    is_recording = any(message.topic.startswith(RECORDING_PREFIX) for message in messages)
    if is_sweep or is_recording:
        needless = [name for name in options.stated() if name != "joint_order"]
        if needless or options.joint_order not in (None, "default"):
            raise LogError(
                f"{path}: a log of pronk needs no {', '.join(needless) or 'joint_order'}; it names "
                "its topics, joints and units; leave the options out."
            )
        if is_recording:
            return read_recording(path, messages, damage)
        return read_sweep(path, messages, damage)
    return join_topics(path, messages, damage, robot, options)
