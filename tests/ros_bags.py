"""Bags of ROS as rosbags writes them: MCAP, SQLite and ROS 1."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

START_NS = 1_700_000_000 * 10**9
"""Time of the first message [ns]."""
CONTROLLER_STATE = """\
std_msgs/Header header
string[] joint_names
trajectory_msgs/JointTrajectoryPoint reference
trajectory_msgs/JointTrajectoryPoint feedback
"""

Message = tuple[str, str, int, Any]
"""Topic, type, time of reception [ns] and the message itself."""
Build = Callable[["Builder"], Sequence[Message]]


class Builder:
    """Makes messages of one ROS."""

    def __init__(self, ros1: bool, definitions: dict[str, str] | None = None) -> None:
        self.ros1 = ros1
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
        for name, definition in (definitions or {}).items():
            self.store.register(get_types_from_msg(definition, name))

    def header(self, nano: int) -> Any:
        stamp = self.store.types["builtin_interfaces/msg/Time"](
            sec=nano // 10**9, nanosec=nano % 10**9
        )
        header = self.store.types["std_msgs/msg/Header"]
        if self.ros1:
            return header(seq=0, stamp=stamp, frame_id="")
        return header(stamp=stamp, frame_id="")

    def joint_state(
        self,
        nano: int,
        names: Sequence[str],
        position: Sequence[float],
        velocity: Sequence[float] = (),
        effort: Sequence[float] = (),
    ) -> Any:
        return self.store.types["sensor_msgs/msg/JointState"](
            header=self.header(nano),
            name=list(names),
            position=np.array(position, dtype=np.float64),
            velocity=np.array(velocity, dtype=np.float64),
            effort=np.array(effort, dtype=np.float64),
        )

    def numbers(self, data: Sequence[float]) -> Any:
        layout = self.store.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
        return self.store.types["std_msgs/msg/Float64MultiArray"](
            layout=layout, data=np.array(data, dtype=np.float64)
        )

    def point(self, positions: Sequence[float]) -> Any:
        duration = self.store.types["builtin_interfaces/msg/Duration"](sec=0, nanosec=0)
        empty = np.empty(0)
        return self.store.types["trajectory_msgs/msg/JointTrajectoryPoint"](
            positions=np.array(positions, dtype=np.float64),
            velocities=empty,
            accelerations=empty,
            effort=empty,
            time_from_start=duration,
        )


def write_bag(
    path: Path,
    build: Build,
    kind: str = "mcap",
    *,
    definitions: dict[str, str] | None = None,
    without_definitions: bool = False,
) -> Path:
    """Write a bag and return what a user names: the folder of ROS 2, or the file of ROS 1.

    Args:
        path: The folder to make; a bag of ROS 1 becomes a file in it.
        build: Makes the messages.
        kind: `mcap`, `sqlite3`, `sqlite3 message` (compressed), or `ros1` and its compression.
        definitions: Types that ROS itself does not have.
        without_definitions: True for a bag that holds none, as those of Humble and before.
    """
    builder = Builder(kind.startswith("ros1"), definitions)
    store = builder.store
    messages = build(builder)
    if builder.ros1:
        path.mkdir()
        ros1_writer = Ros1Writer(path / "a.bag")
        compression = kind.removeprefix("ros1").strip()
        if compression:
            ros1_writer.set_compression(Ros1Writer.CompressionFormat[compression.upper()])
        with ros1_writer:
            connections = {}
            for topic, name, nano, message in messages:
                if topic not in connections:
                    connections[topic] = ros1_writer.add_connection(topic, name, typestore=store)
                ros1_writer.write(connections[topic], nano, store.serialize_ros1(message, name))
        return path / "a.bag"
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    writer = Ros2Writer(path, version=8 if without_definitions else 9, storage_plugin=plugin)
    if kind.endswith("message"):
        writer.set_compression(CompressionMode.MESSAGE, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for topic, name, nano, message in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, name, typestore=store)
            writer.write(connections[topic], nano, store.serialize_cdr(message, name))
    if without_definitions:
        _forget_definitions(path)
    return path


def _forget_definitions(path: Path) -> None:
    """Take the definitions out of a SQLite bag, as recorders before Iron leave them out."""
    import sqlite3

    (file,) = path.glob("*.db3")
    with sqlite3.connect(file) as database:
        database.execute("DELETE FROM message_definitions")
    database.close()
