"""Send chirps to one joint of a ros2_control robot, and record it.

    python ros2_control.py --joint knee --joints hip,knee --controller forward_position_controller

Needs a ROS 2 installation (rclpy, sensor_msgs, std_msgs), a running position controller and the
joint state broadcaster. `ros2 bag record` of the two topics serves as well, as pronk reads bags.
Not run on hardware by pronk's developers. Clamp the base, and begin with a small amplitude.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import rclpy
from chirp import command_at, write_csv
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray


class Recorder(Node):
    """Node that sends the command at every joint state, and keeps both."""

    def __init__(self, options: argparse.Namespace) -> None:
        super().__init__("chirp_recorder")
        self.options = options
        self.joints = options.joints.split(",")
        self.pose: dict[str, float] = {}
        self.rows: list[tuple[float, float, float]] = []
        self.begin = 0.0
        self.done = False
        topic = f"/{options.controller}/commands"
        self.commands = self.create_publisher(Float64MultiArray, topic, 10)
        self.create_subscription(JointState, "/joint_states", self.on_state, 10)

    def on_state(self, state: JointState) -> None:
        """Send the next command, and keep it beside the position of this state."""
        positions = dict(zip(state.name, state.position, strict=False))
        if not set(self.joints) <= set(positions):
            return
        if not self.pose:
            self.pose = positions
            self.begin = time.monotonic()
        now = time.monotonic() - self.begin
        relative = command_at(now, self.options.amplitudes, self.options.high_hz)
        self.done = relative is None
        targets = []
        for joint in self.joints:
            moved = relative or 0.0
            targets.append(self.pose[joint] + (moved if joint == self.options.joint else 0.0))
        self.commands.publish(Float64MultiArray(data=targets))
        command = targets[self.joints.index(self.options.joint)]
        self.rows.append((now, command, positions[self.options.joint]))


def main() -> None:
    """Record."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--joint", required=True, help="the joint to excite")
    parser.add_argument("--joints", required=True, help="the controller's joints, in its order")
    parser.add_argument("--controller", default="forward_position_controller")
    parser.add_argument("--amplitudes", type=float, nargs="+", default=[0.1, 0.2, 0.2])
    parser.add_argument("--high-hz", type=float, default=12.0)
    parser.add_argument("--out", type=Path, default=Path("chirp.csv"))
    options = parser.parse_args()
    rclpy.init()
    recorder = Recorder(options)
    try:
        while not recorder.done:
            rclpy.spin_once(recorder)
    finally:
        write_csv(options.out, options.joint, recorder.rows)
        rclpy.shutdown()


if __name__ == "__main__":
    main()
