"""ROS 2 bags: states and commands joined; wrong topics refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap_ros2.writer import Writer as RosWriter

from command_line import invoke
from pronk.errors import LogError
from pronk.logs.readers import read_log

JOINT_STATE = """\
std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
ARRAY = "float64[] data\n"


def bag(path: Path, *, stamped: bool = True, command: str = "/joint_command") -> None:
    """Two joints at 200 Hz, commands at 50 Hz, recorded by rosbag2 into MCAP."""
    with path.open("wb") as stream, RosWriter(stream) as writer:
        state = writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE)
        plain = writer.register_msgdef("std_msgs/msg/Float64MultiArray", ARRAY)
        for k in range(400):
            when = 100.0 + k / 200.0
            nano = round(when * 1e9)
            stamp = {"sec": int(when), "nanosec": round(when % 1.0 * 1e9)}
            header = {"stamp": stamp if stamped else {"sec": 0, "nanosec": 0}, "frame_id": ""}
            message = {"header": header, "velocity": [], "effort": []}
            if k >= 8 and k % 4 == 0:
                values = [np.sin(0.1 * k), 2.0]
                if command == "/array":
                    writer.write_message(command, plain, {"data": values}, nano, nano)
                else:
                    order = {"name": ["hip", "knee"], "position": values[::-1]}
                    writer.write_message(command, state, message | order, nano, nano)
            states = {"name": ["knee", "hip"], "position": [np.sin(0.1 * k - 0.2), 2.1]}
            writer.write_message("/joint_states", state, message | states, nano, nano)


def test_a_bag_with_two_joint_state_topics(tmp_path: Path) -> None:
    path = tmp_path / "bag.mcap"
    bag(path)
    log = read_log(path, command_topic="/joint_command")
    assert log.joints == ("knee", "hip")
    assert log.rate_hz == pytest.approx(200.0)
    # States before the first command are dropped; the command is the last at or before a state.
    assert len(log.time) == 392
    k = np.arange(8, 400)
    np.testing.assert_allclose(log.command[:, 0], np.sin(0.1 * (k - k % 4)))
    np.testing.assert_allclose(log.command[:, 1], 2.0)
    np.testing.assert_allclose(log.position[:, 0], np.sin(0.1 * k - 0.2))
    assert log.velocity is None
    assert any("8 states before the first command" in note for note in log.notes)


def test_a_bag_folder_and_commands_of_another_type(tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_text("rosbag2_bagfile_information: {}\n")
    bag(tmp_path / "bag_0.mcap", stamped=False, command="/array")
    log = read_log(tmp_path, command_topic="/array", command_field="data")
    k = np.arange(8, 400)
    np.testing.assert_allclose(log.command[:, 0], np.sin(0.1 * (k - k % 4)))
    assert any("times of reception" in note for note in log.notes)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "command_topic is missing"),
        ({"command_topic": "/elsewhere"}, "no commands on /elsewhere"),
        ({"measured_topic": "/imu", "command_topic": "/joint_command"}, "no sensor_msgs.* on /imu"),
        ({"command_topic": "/joint_command", "command_field": "velocity"}, "holds 0 values"),
        ({"command_topic": "/joint_command", "command_field": "points.0"}, "no field 'points.0'"),
        ({"command_topic": "/joint_command", "command_field": "header"}, "not a list of numbers"),
    ],
)
def test_a_wrong_topic_or_field_lists_what_there_is(
    tmp_path: Path, options: dict[str, str], words: str
) -> None:
    path = tmp_path / "bag.mcap"
    bag(path)
    with pytest.raises(LogError, match=words) as caught:
        read_log(path, **options)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    if "topic" in words:
        assert "/joint_states (sensor_msgs/msg/JointState)" in str(caught.value)


def test_the_topics_are_options_of_the_command_line(tmp_path: Path) -> None:
    path = tmp_path / "bag.mcap"
    bag(path)
    done = invoke(["response", path, "--command-topic", "/elsewhere"])
    assert done.exit_code == 2
    assert "no commands on /elsewhere" in done.stderr
