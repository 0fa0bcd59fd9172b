"""A robot behind LCM: the Mini Cheetah, a Go1 by the bridge of walk-these-ways, or a virtual robot.

LCM is UDP multicast. With a time-to-live of 0 a packet never leaves the host. LCM itself cannot
choose an interface: the system's routes do (a missing one is the commonest first failure on the
Mini Cheetah, Cheetah-Software issue 8), so the route must lead out of the interface that was named.

One handle receives, in a thread of its own, because polling one message per tick from LCM's queue
yields data hundreds of milliseconds old; the other publishes. LCM does not tell who sent a message;
a socket beside it, in the same multicast group, does.
"""

from __future__ import annotations

import ipaddress
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from pronk.deploy.links.lcm import codec
from pronk.deploy.links.lcm.layouts import layout_for
from pronk.deploy.links.lcm.messages import (
    BEACON_CHANNEL,
    CONTROL_PARAMETER,
    RESPONSE_CHANNEL,
    VIRTUAL_ROBOT,
)
from pronk.deploy.links.link import (
    RESPONSE_S,
    LinkSettings,
    NetworkLink,
    port_or_domain,
    wait_for,
)
from pronk.deploy.links.writer import Encode, Publish
from pronk.errors import HardwareError
from pronk.robots.machine import State
from pronk.robots.robot import RobotSpec

MULTICAST_GROUP = "239.255.76.67"
"""LCM's default multicast group, that of every robot."""
ROBOT_PORT = 7667
"""LCM's default UDP port, that of every robot."""
VIRTUAL_PORT = 7768
"""UDP port of the virtual robot, so that nothing here ever reaches a real one."""
_ROUTES = Path("/proc/net/route")
_ROUTE_UP = 1
"""Flag of a route in use, RTF_UP of route(8)."""
_PORTS = range(1024, 65536)
_QUEUE = 100
"""Messages of a channel kept between two reads."""
_REMEMBERED_COMMANDS = 512
"""Commands kept to recognize one's own."""


def url_of(*, port: int | None = None, interface: str | None = None) -> str:
    """LCM's address of an `interface` (`lo` on the robot itself), None for this computer only.

    HardwareError for an impossible UDP port, or where multicast does not leave by that interface.
    """
    number = port_or_domain(
        "LCM port", port, interface, real=ROBOT_PORT, virtual=VIRTUAL_PORT, allowed=_PORTS
    )
    if interface in (None, "lo"):
        return f"udpm://{MULTICAST_GROUP}:{number}?ttl=0"
    route = None
    if _ROUTES.exists():
        route = multicast_interface(_ROUTES.read_text(encoding="ascii"))
    if route != interface:
        raise HardwareError(
            f"LCM's multicast leaves by {route or 'no interface'}, expected {interface}; set the "
            f"route: `sudo ip route add {MULTICAST_GROUP} dev {interface}`."
        )
    # One hop: the robot's own cable, and no router.
    return f"udpm://{MULTICAST_GROUP}:{number}?ttl=1"


def multicast_interface(table: str) -> str | None:
    """Find the interface by which LCM's packets leave, or None.

    Args:
        table: Routes as in /proc/net/route: interface, destination, gateway, flags, two counts,
            metric, mask; addresses in hexadecimal digits, last byte first.
    """
    group = int(ipaddress.IPv4Address(MULTICAST_GROUP))
    routes: list[tuple[int, int, str]] = []
    for line in table.splitlines()[1:]:
        words = line.split()
        if len(words) < 8 or not int(words[3], 16) & _ROUTE_UP:
            continue
        interface = words[0]
        destination = int.from_bytes(bytes.fromhex(words[1]), "little")
        metric = int(words[6])
        mask = int.from_bytes(bytes.fromhex(words[7]), "little")
        if group & mask == destination:
            routes.append((mask, -metric, interface))
    if not routes:
        return None
    # The longest mask wins, then the smallest metric.
    _, _, interface = max(routes)
    return interface


def open_lcm(url: str) -> Any:
    """Open an LCM handle (`lcm.LCM`), which belongs to one thread."""
    try:
        import lcm
    except ImportError:
        raise HardwareError(
            'the package lcm is not installed; install it with `pip install "pronk[hardware]"`.'
        ) from None
    try:
        return lcm.LCM(url)
    except (RuntimeError, OSError) as error:
        raise HardwareError(
            f"LCM cannot open {url} ({error}); without a network, multicast needs a route: "
            f"`sudo ip route add {MULTICAST_GROUP} dev lo`."
        ) from None


class Senders:
    """Addresses that publish on each channel of a port, without their messages.

    A small message of LCM is `LC02`, a number of four bytes, the channel, a zero byte, and data.
    """

    def __init__(self, port: int, channels: tuple[str, ...]) -> None:
        """Join the multicast group."""
        self._senders_by_channel: dict[bytes, set[object]] = {}
        for name in channels:
            self._senders_by_channel[name.encode()] = set()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._socket.bind((MULTICAST_GROUP, port))
        group = socket.inet_aton(MULTICAST_GROUP) + socket.inet_aton("0.0.0.0")
        self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
        self._socket.setblocking(False)

    @property
    def count(self) -> int:
        """Largest number of senders on one channel."""
        return max(len(senders) for senders in self._senders_by_channel.values())

    def look(self) -> None:
        """Note the senders of what has come."""
        while True:
            try:
                head, sender = self._socket.recvfrom(64)
            except BlockingIOError:
                return
            channel, _, _ = head[8:].partition(b"\0")
            senders = self._senders_by_channel.get(channel)
            if senders is not None and head.startswith(b"LC02"):
                senders.add(sender)

    def close(self) -> None:
        """Leave the group."""
        self._socket.close()


class LcmMachine(NetworkLink):
    """A robot with twelve joints behind LCM. Implements `Machine`."""

    def __init__(
        self,
        robot: RobotSpec,
        *,
        layout: str = "cheetah",
        port: int | None = None,
        interface: str | None = None,
        settings: LinkSettings | None = None,
    ) -> None:
        """Describe the link.

        Args:
            robot: The robot.
            layout: Messages, a name of `LAYOUTS`.
            port: UDP port; the robots' with an interface, else the virtual robot's if None.
            interface: Network interface to a real robot, None for this computer only.
            settings: Settings of every link; the usual if None.
        """
        super().__init__(robot, settings)
        self._layout = layout_for(robot, layout)
        self.torque_kind = self._layout.torque_kind
        self.state_rate_hz = self._layout.state_rate_hz
        self._command_topic = self._layout.command.channel
        self._interface = interface
        self._url = url_of(port=port, interface=interface)
        self._port = int(self._url.partition("?")[0].rpartition(":")[2])
        self._address = (
            f"{self._layout.joints.channel} and {self._layout.attitude.channel} at {self._url}"
        )

    def open_damper(self) -> Callable[[], None]:
        """Open a handle of its own, and return what writes damping."""
        sender = open_lcm(self._url)
        data = codec.encode_lcm_command(self._layout, self._sinking)
        return lambda: sender.publish(self._command_topic, data)

    def _open(self) -> tuple[Encode, Publish]:
        layout = self._layout
        decoder = codec.LcmStateDecoder(layout, self.counts)
        # Last request for clamps that the virtual robot received, and the joints it clamps.
        self._beacon: tuple[int, tuple[str, ...]] | None = None
        self._responses: list[bytes] = []
        # Newest first: a message that comes back is nearly always the last one.
        self._sent_commands: deque[bytes] = deque(maxlen=_REMEMBERED_COMMANDS)
        # A handle belongs to one thread at a time.
        self._publishing = threading.Lock()
        self._remembering = threading.Lock()
        self._receiver = open_lcm(self._url)
        self._sender = open_lcm(self._url)
        self._senders = Senders(self._port, (layout.joints.channel, layout.attitude.channel))
        self._subscribe(layout.attitude.channel, decoder.attitude)
        self._subscribe(layout.joints.channel, decoder.joints)
        self._subscribe(layout.command.channel, self._receive_command)
        self._subscribe(BEACON_CHANNEL, self._receive_beacon)
        self._subscribe(RESPONSE_CHANNEL, self._receive_response)
        return partial(codec.encode_lcm_command, layout), self._publish_command

    def _subscribe(self, channel: str, decode: Callable[[bytes, float], State | None]) -> None:
        """Have each message of a channel decoded when it arrives."""

        def receive(_: str, data: bytes) -> None:
            self._take(decode, data, time.monotonic())

        self._receiver.subscribe(channel, receive).set_queue_capacity(_QUEUE)

    def _shut(self) -> None:
        self._senders.close()
        del self._receiver, self._sender

    def _receive(self) -> None:
        self._receiver.handle_timeout(50)
        self._senders.look()

    @property
    def sources(self) -> int:
        """Senders of states."""
        return self._senders.count

    def _publish(self, channel: str, data: bytes) -> None:
        with self._publishing:
            self._sender.publish(channel, data)

    def _publish_command(self, data: bytes) -> None:
        with self._remembering:
            self._sent_commands.appendleft(data)
        self._publish(self._command_topic, data)

    def _receive_command(self, data: bytes, _arrived: float) -> None:
        """Count a command that was not written here; each of one's own comes back once."""
        with self._remembering:
            try:
                self._sent_commands.remove(data)
            except ValueError:
                self.counts["foreign"] += 1

    def _receive_beacon(self, data: bytes, _arrived: float) -> None:
        self._beacon = codec.decode_clamps(self._robot.joint_names, data)

    def _receive_response(self, data: bytes, _arrived: float) -> None:
        self._responses.append(data)

    def _prepare(self) -> None:
        if not self._settings.release:
            return
        data = codec.encode_mode_request(0, time.monotonic_ns())
        self._publish(CONTROL_PARAMETER.channel, data)
        if not wait_for(lambda: data in self._responses):
            raise HardwareError(
                f"{self.robot} did not confirm control_mode 0 on {RESPONSE_CHANNEL} within "
                f"{RESPONSE_S:g} s; release it by its own remote."
            )

    def _confirm(self) -> None:
        if self._interface is None:
            # Its beacon comes ten times a second; no other simulator has one.
            wait_for(lambda: self._beacon is not None)
        self.virtual = self._beacon is not None

    def _hold(self, joints: tuple[str, ...]) -> bool:
        names = self._robot.joint_names
        request = time.monotonic_ns()
        data = codec.encode_clamps(names, joints, request)
        confirmation = codec.decode_clamps(names, data)
        for _ in range(4):  # for messages may be lost
            self._publish(VIRTUAL_ROBOT.channel, data)
            if wait_for(lambda: self._beacon == confirmation, RESPONSE_S / 4):
                return True
        return False
