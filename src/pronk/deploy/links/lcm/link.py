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
from pronk.deploy.links.lcm.layouts import find_layout
from pronk.deploy.links.lcm.messages import (
    BEACON_CHANNEL,
    CONTROL_PARAMETER,
    RESPONSE_CHANNEL,
    VIRTUAL_ROBOT,
)
from pronk.deploy.links.link import (
    RESPONSE_S,
    Encode,
    NetworkLink,
    Publish,
    port_or_domain,
    wait_for,
)
from pronk.errors import HardwareError
from pronk.robots.robot import RobotSpec

# LCM's multicast group and port, those of every robot too.
GROUP, ROBOT_PORT = "239.255.76.67", 7667
VIRTUAL_PORT = 7768
"""The virtual robot's, so that nothing here ever reaches a real one."""
_ROUTES = Path("/proc/net/route")
_PORTS = range(1024, 65536)
_QUEUE = 100
_REMEMBERED = 512  # commands kept to recognize one's own


def url_of(*, port: int | None = None, interface: str | None = None) -> str:
    """LCM's address of an `interface` (`lo` on the robot itself), None for this computer only.

    HardwareError for an impossible UDP port, or where multicast does not leave by that interface.
    """
    number = port_or_domain("LCM port", port, interface, ROBOT_PORT, VIRTUAL_PORT, _PORTS)
    if interface in (None, "lo"):
        return f"udpm://{GROUP}:{number}?ttl=0"
    way = multicast_interface(_ROUTES.read_text(encoding="ascii")) if _ROUTES.exists() else None
    if way != interface:
        raise HardwareError(
            f"LCM's multicast leaves by {way or 'no interface'}, expected {interface}; set the "
            f"route: `sudo ip route add {GROUP} dev {interface}`."
        )
    # One hop: the robot's own cable, and no router.
    return f"udpm://{GROUP}:{number}?ttl=1"


def multicast_interface(table: str) -> str | None:
    """The interface by which LCM's packets leave, or None, by a table as in /proc/net/route."""
    group = int(ipaddress.IPv4Address(GROUP))
    found: list[tuple[int, int, str]] = []
    for words in map(str.split, table.splitlines()[1:]):
        if len(words) < 8 or not int(words[3], 16) & 1:
            continue
        target, mask = (int.from_bytes(bytes.fromhex(words[k])[::-1], "big") for k in (1, 7))
        if group & mask == target:
            found.append((mask, -int(words[6]), words[0]))
    # The longest mask wins, then the smallest metric.
    return max(found)[2] if found else None


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
            f"`sudo ip route add {GROUP} dev lo`."
        ) from None


class Senders:
    """Addresses that publish on each channel of a port, without their messages.

    A small message of LCM is `LC02`, a number of four bytes, the channel, a zero byte, and data.
    """

    def __init__(self, port: int, channels: tuple[str, ...]) -> None:
        """Join the multicast group."""
        self._found = {name.encode(): set[object]() for name in channels}
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._socket.bind((GROUP, port))
        group = socket.inet_aton(GROUP) + socket.inet_aton("0.0.0.0")
        self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, group)
        self._socket.setblocking(False)

    @property
    def most(self) -> int:
        """Largest number of senders on one channel."""
        return max(map(len, self._found.values()))

    def look(self) -> None:
        """Note the senders of what has come."""
        while True:
            try:
                head, sender = self._socket.recvfrom(64)
            except BlockingIOError:
                return
            channel = self._found.get(head[8:].partition(b"\0")[0])
            if channel is not None and head.startswith(b"LC02"):
                channel.add(sender)

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
        **common: Any,
    ) -> None:
        """Describe the link; see `LAYOUTS`, `url_of` and, for `common`, `NetworkLink`."""
        super().__init__(robot, **common)
        self._layout = known = find_layout(layout)
        if len(robot.joints) != 12:
            raise HardwareError(
                f"{robot.name} has {len(robot.joints)} joints; the LCM messages of {layout} are "
                "for twelve."
            )
        self.torque_kind, self.state_rate_hz = known.torque_kind, known.state_rate_hz
        self._command_topic = known.command.channel
        self._interface = interface
        self._url = url_of(port=port, interface=interface)
        self._port = int(self._url.partition("?")[0].rpartition(":")[2])
        self._address = f"{known.joints.channel} and {known.attitude.channel} at {self._url}"

    def open_damper(self) -> Callable[[], None]:
        """Open a handle of its own, and return what writes damping."""
        out = open_lcm(self._url)
        data = codec.encode_lcm_command(self._layout, self._sinking)
        return lambda: out.publish(self._command_topic, data)

    def _open(self) -> tuple[Encode, Publish]:
        layout = self._layout
        decoder = codec.LcmStateDecoder(layout, self.counts)
        # Last request for clamps that the virtual robot received, and the joints it holds.
        self._held: tuple[int, tuple[str, ...]] | None = None
        self._responses: list[bytes] = []
        # Newest first: a message that comes back is nearly always the last one.
        self._own: deque[bytes] = deque(maxlen=_REMEMBERED)
        # A handle belongs to one thread at a time.
        self._publishing, self._remembering = threading.Lock(), threading.Lock()
        self._in, self._out = open_lcm(self._url), open_lcm(self._url)
        self._senders = Senders(self._port, (layout.joints.channel, layout.attitude.channel))
        for channel, handler in (
            (layout.attitude.channel, lambda data: decoder.attitude(data, time.monotonic())),
            (layout.joints.channel, lambda data: decoder.joints(data, time.monotonic())),
            (layout.command.channel, self._met_command),
            (BEACON_CHANNEL, self._met_beacon),
            (RESPONSE_CHANNEL, self._responses.append),
        ):
            subscription = self._in.subscribe(
                channel, lambda _, data, handler=handler: self._take(handler, data)
            )
            subscription.set_queue_capacity(_QUEUE)
        return partial(codec.encode_lcm_command, layout), self._command

    def _shut(self) -> None:
        self._senders.close()
        del self._in, self._out

    def _receive(self) -> None:
        self._in.handle_timeout(50)
        self._senders.look()

    @property
    def sources(self) -> int:
        """Senders of states."""
        return self._senders.most

    def _publish(self, channel: str, data: bytes) -> None:
        with self._publishing:
            self._out.publish(channel, data)

    def _command(self, data: bytes) -> None:
        with self._remembering:
            self._own.appendleft(data)
        self._publish(self._command_topic, data)

    def _met_command(self, data: bytes) -> None:
        """Count a command that was not written here; each of one's own comes back once."""
        with self._remembering:
            try:
                self._own.remove(data)
            except ValueError:
                self.counts["foreign"] += 1

    def _met_beacon(self, data: bytes) -> None:
        self._held = codec.decode_clamps(self._robot.joint_names, data)

    def _prepare(self) -> None:
        if not self._release:
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
            wait_for(lambda: self._held is not None)
        self.virtual = self._held is not None

    def _hold(self, joints: tuple[str, ...]) -> bool:
        names, request = self._robot.joint_names, time.monotonic_ns()
        data = codec.encode_clamps(names, joints, request)
        held = (request, tuple(name for name in names if name in joints))
        for _ in range(4):  # for messages may be lost
            self._publish(VIRTUAL_ROBOT.channel, data)
            if wait_for(lambda: self._held == held, RESPONSE_S / 4):
                return True
        return False
