"""Listening to the LCM channels of states and commands.

LCM is UDP multicast. A plain socket receives it here, which cannot publish on a channel, and the
system notes the time at which each message came, so that a busy computer does not delay it.
"""

from __future__ import annotations

import select
import socket
import struct
import time
from collections.abc import Callable, Sequence

import numpy as np

from pronk.deploy.links.lcm.codec import LcmStateDecoder
from pronk.deploy.links.lcm.layouts import JOINT_COUNT, LcmLayout, layout_for
from pronk.deploy.links.lcm.link import MULTICAST_GROUP, url_of
from pronk.deploy.links.lcm.messages import BEACON_CHANNEL
from pronk.deploy.links.listener import HeardMessage, Listener, WireCommand
from pronk.errors import HardwareError
from pronk.robots.machine import RefusedError, State
from pronk.robots.robot import RobotSpec

_MOST_MESSAGES = 5000
"""Messages of one call: ten seconds at 500 Hz."""
_BUFFER_BYTES = 1 << 22
"""Room for messages that wait in the system [bytes]: seconds of them."""
_LARGEST_BYTES = 65536
"""Largest datagram [bytes]."""
_REMARK_BYTES = 64
"""Room for the system's remarks on a datagram [bytes]."""
_SO_TIMESTAMPNS = 35
"""Option of a socket, and kind of a remark, with the time of reception (Linux, socket(7))."""
_TIME = struct.Struct("@qq")
"""A time of Linux: seconds and nanoseconds."""
_CHANNEL_BEGIN = 8
"""Bytes before the channel of a message."""


def read_lcm_command(layout: LcmLayout, data: bytes) -> WireCommand:
    """Decode a command as it was sent, whatever it commands.

    Of Cheetah-Software's message the robot reads positions, stiffness and damping alone.

    Args:
        layout: Messages of the stack.
        data: The message.

    Raises:
        RefusedError: As of `LcmMessage.decode`, or `not finite`.
    """
    message = layout.command
    fields = message.decode(data)
    names = ["q_des", layout.stiffness_field, layout.damping_field]
    if layout.obeys_feed_forward:
        names += ["qd_des", "tau_ff"]
    numbers = {"qd_des": np.zeros(JOINT_COUNT), "tau_ff": np.zeros(JOINT_COUNT)}
    for name in names:
        if not np.isfinite(fields[name]).all():
            raise RefusedError("not finite", f"{name} of {message.name} is not a finite number.")
        numbers[name] = np.asarray(fields[name], dtype=np.float64)
    stiffness = numbers[layout.stiffness_field] / layout.gain_ratios
    damping = numbers[layout.damping_field] / layout.gain_ratios
    return WireCommand(
        position=np.where(stiffness > 0.0, numbers["q_des"] * layout.signs, 0.0),
        velocity=np.where(damping > 0.0, numbers["qd_des"] * layout.signs, 0.0),
        stiffness=stiffness,
        damping=damping,
        torque=numbers["tau_ff"] * layout.signs,
    )


class LcmListener(Listener):
    """Listens to a robot with twelve joints behind LCM."""

    def __init__(
        self,
        robot: RobotSpec,
        *,
        layout: str = "cheetah",
        port: int | None = None,
        interface: str | None = None,
    ) -> None:
        """Describe the wire.

        Args:
            robot: The robot.
            layout: Messages, a name of `LAYOUTS`.
            port: UDP port; the robots' with an interface, else the virtual robot's if None.
            interface: Network interface to a real robot, None for this computer only.
        """
        super().__init__(robot)
        self._layout = layout_for(robot, layout)
        self._url = url_of(port=port, interface=interface)
        self._port = int(self._url.partition("?")[0].rpartition(":")[2])
        self.torque_kind = self._layout.torque_kind
        self.state_topic = (
            f"{self._layout.joints.channel} and {self._layout.attitude.channel} at {self._url}"
        )
        self.command_topic = f"{self._layout.command.channel} at {self._url}"

    def open(self) -> None:
        """Join the multicast group with a socket that receives."""
        layout = self._layout
        decoder = LcmStateDecoder(layout, self.counts)
        self._decoders: dict[str, Callable[[bytes, float], State | None]] = {
            layout.attitude.channel: decoder.attitude,
            layout.joints.channel: decoder.joints,
        }
        try:
            self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            self._socket.bind((MULTICAST_GROUP, self._port))
            group = socket.inet_aton(MULTICAST_GROUP) + socket.inet_aton("0.0.0.0")
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
            self._socket.setblocking(False)
        except OSError as error:
            raise HardwareError(
                f"LCM cannot be heard at {self._url} ({error.strerror or error}); without a "
                f"network, multicast needs a route: `sudo ip route add {MULTICAST_GROUP} dev lo`."
            ) from None

    def receive(self, timeout_s: float) -> list[HeardMessage]:
        """Return the states and commands that have come."""
        heard: list[HeardMessage] = []
        readable, _, _ = select.select([self._socket], [], [], timeout_s)
        while readable and len(heard) < _MOST_MESSAGES:
            try:
                data, remarks, _, sender = self._socket.recvmsg(_LARGEST_BYTES, _REMARK_BYTES)
            except BlockingIOError:
                break
            message = self._message(data, _kernel_time(remarks), sender)
            if message is not None:
                heard.append(message)
        return heard

    def close(self) -> None:
        """Leave the multicast group."""
        self._socket.close()

    def _message(self, datagram: bytes, sent: float | None, sender: object) -> HeardMessage | None:
        """Decode a small message of LCM: `LC02`, a number, the channel, a zero byte, and data."""
        arrived = time.monotonic()
        head, _, data = datagram[_CHANNEL_BEGIN:].partition(b"\0")
        channel = head.decode("ascii", "replace")
        if not datagram.startswith(b"LC02"):
            return None
        content: State | WireCommand | None = None
        if channel == BEACON_CHANNEL:
            self.virtual = True
        elif channel == self._layout.command.channel:
            content = self.decoded_command(lambda body: read_lcm_command(self._layout, body), data)
            self.command_senders.add(hash(sender))
        elif channel in self._decoders:
            content = self.decoded_state(self._decoders[channel], data, arrived)
        if content is None:
            return None
        return HeardMessage(arrived=arrived, sent=sent, content=content)


def _kernel_time(remarks: Sequence[tuple[int, int, bytes]]) -> float | None:
    """Return when the system received a datagram, on its clock [s]; None where it does not say."""
    for level, kind, value in remarks:
        if (level, kind) == (socket.SOL_SOCKET, _SO_TIMESTAMPNS) and len(value) == _TIME.size:
            seconds, nanoseconds = _TIME.unpack(value)
            return float(seconds) + 1e-9 * float(nanoseconds)
    return None
