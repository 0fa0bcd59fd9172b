"""The robot's end of an LCM link, as of a Mini Cheetah or of the bridge on a Go1.

A message that is not a possible command is refused and counted, where Cheetah-Software would pass
it to the motors.
"""

from __future__ import annotations

from pronk.deploy.bench.server import ServerTransport
from pronk.deploy.links.lcm import codec
from pronk.deploy.links.lcm.layouts import layout_for
from pronk.deploy.links.lcm.link import open_lcm, url_of
from pronk.deploy.links.lcm.messages import (
    BEACON_CHANNEL,
    CONTROL_PARAMETER,
    RESPONSE_CHANNEL,
    VIRTUAL_ROBOT,
)
from pronk.robots.machine import Command, State
from pronk.robots.robot import RobotSpec

_BEACON_STATES = 50
"""States between two beacons: 10 Hz."""
_QUEUE = 1000
"""Messages read in one poll; a sender of more cannot stop the robot's time."""


class LcmServerTransport(ServerTransport):
    """The robot's end in the messages of a layout."""

    def __init__(
        self,
        robot: RobotSpec,
        *,
        layout: str = "cheetah",
        port: int | None = None,
        mode: str = "",
        url: str | None = None,
    ) -> None:
        """Open the robot's end.

        Args:
            robot: The robot.
            layout: Messages, a name of `LAYOUTS`.
            port: UDP port on this computer; the virtual robot's if None.
            mode: Controller that holds the joints at first, one of `CONTROL_MODES`.
            url: An LCM address instead of the port.
        """
        super().__init__(robot, mode, tuple(codec.CONTROL_MODES.values()))
        self._layout = layout_for(robot, layout)
        if url is None:
            url = url_of(port=port)
        self._lcm = open_lcm(url)
        # Another writer is another sender.
        self._rival = open_lcm(url)
        self._arrived: list[Command] = []
        self._clamp_request = 0  # number of the last request for clamps
        self._beacon_due = False
        channels = (
            self._layout.command.channel,
            CONTROL_PARAMETER.channel,
            VIRTUAL_ROBOT.channel,
        )
        for channel in channels:
            self._lcm.subscribe(channel, self.receive).set_queue_capacity(_QUEUE)

    def poll(self) -> list[Command]:
        """Commands that arrived since the last poll, oldest first."""
        for _ in range(_QUEUE):
            if self._lcm.handle_timeout(0) == 0:
                break
        commands = self._arrived
        self._arrived = []
        return commands

    def receive(self, channel: str, data: bytes) -> None:
        """Take one message, whatever it is. Never raises."""
        with self.refusing():
            if channel == self._layout.command.channel:
                self._arrived.append(codec.decode_lcm_command(self._layout, self.corrupt_in(data)))
                self.counts["commands"] += 1
            elif channel == CONTROL_PARAMETER.channel:
                self.mode = codec.decode_mode_request(data)
                self.counts["mode switches"] += 1
                self._lcm.publish(RESPONSE_CHANNEL, data)
            elif channel == VIRTUAL_ROBOT.channel:
                self._clamp_request, self.clamps = codec.decode_clamps(self._joint_names, data)
                self._beacon_due = True

    def publish(self, state: State) -> None:
        """Put a state on the wire, and at 10 Hz the beacon of the virtual robot."""
        attitude, joints = codec.encode_lcm_state(self._layout, state)
        self._lcm.publish(self._layout.attitude.channel, self.corrupt_out(attitude))
        self._lcm.publish(self._layout.joints.channel, self.corrupt_out(joints))
        if self._beacon_due or self.counts["states"] % _BEACON_STATES == 0:
            self._beacon_due = False
            beacon = codec.encode_clamps(self._joint_names, self.clamps, self._clamp_request)
            self._lcm.publish(BEACON_CHANNEL, beacon)
        self.counts["states"] += 1

    def contend(self, command: Command) -> None:
        """Command the joints as another program would."""
        data = codec.encode_lcm_command(self._layout, command)
        self._rival.publish(self._layout.command.channel, data)

    def close(self) -> None:
        """Leave the wire."""
        del self._lcm, self._rival
