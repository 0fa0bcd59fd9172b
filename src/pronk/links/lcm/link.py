"""A robot behind LCM: the Mini Cheetah, a Go1 by the bridge of walk-these-ways, or a virtual robot.

One handle receives, in a thread of its own, because polling one message per tick from LCM's queue
yields data hundreds of milliseconds old; the other publishes. Times are the local monotonic
clock's: a state's is when its last message arrived.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from typing import Any

from pronk.errors import HardwareError
from pronk.links.command_writer import CommandWriter
from pronk.links.lcm.address import open_lcm, url_of
from pronk.links.lcm.codec import (
    BEACON_CHANNEL,
    BENCH_CHANNEL,
    REQUEST_CHANNEL,
    RESPONSE_CHANNEL,
    clamp_message,
    encode_command,
    layout_of,
    mode_request,
)
from pronk.links.lcm.state_decoder import StateDecoder
from pronk.links.machine import State, TorqueKind
from pronk.links.network_link import ANSWER_S, NetworkLink, wait_for
from pronk.robots.robot import Robot

_QUEUE = 100
_REMEMBERED = 512
"""Commands kept to recognize one's own."""


class LcmMachine(NetworkLink):
    """A robot with twelve joints behind LCM. Implements `Machine`.

    Pre-flight, in this order: states arrive at the layout's rate without gaps for 200 ms; no
    other program commands.
    """

    wire = "LCM"

    def __init__(
        self,
        robot: Robot,
        *,
        layout: str = "cheetah",
        port: int | None = None,
        interface: str | None = None,
        **common: Any,
    ) -> None:
        """Describe the link; nothing is opened yet.

        Args:
            robot: Names, order and limits of the joints.
            layout: `cheetah` (or `spi`) or `wtw`.
            port: UDP port; None for the virtual robot's on loopback, the robots' on an interface.
            interface: Network interface of a real robot, `lo` on the robot itself; None never
                leaves this computer and meets no real robot.
            **common: As `NetworkLink` takes them.

        Raises:
            HardwareError: The layout is unknown, the robot has not twelve joints, or the address
                is impossible.
        """
        super().__init__(robot, **common)
        self._layout = layout_of(layout)
        if len(robot.joints) != 12:
            raise HardwareError(
                f"{robot.name} has {len(robot.joints)} joints; the LCM messages of {layout} are "
                "for twelve."
            )
        self.torque_kind: TorqueKind = self._layout.torque_kind
        self._command_topic = self._layout.command_channel
        self._interface = interface
        self._url = url_of(port=port, interface=interface)
        self._foreign = 0
        self._decoder = StateDecoder(self._layout, robot.joint_names)
        self._written: Counter[str] = Counter()

    @property
    def counts(self) -> Counter[str]:
        """States, and why some were not made; commands, `expired`, `foreign`."""
        return self._decoder.counts + self._written + Counter(foreign=self._foreign)

    def _open(self) -> None:
        layout = self._layout
        decoder = self._decoder = StateDecoder(layout, self._robot.joint_names)
        self._foreign = 0
        self._responses: list[bytes] = []
        # Newest first: a message that comes back is nearly always the last one.
        self._own: deque[bytes] = deque(maxlen=_REMEMBERED)
        self._publishing, self._remembering = threading.Lock(), threading.Lock()
        self._in, self._out = open_lcm(self._url), open_lcm(self._url)
        self._writer = CommandWriter(lambda command: encode_command(layout, command), self._command)
        self._written = self._writer.counts
        for channel, handler in (
            (layout.attitude_channel, lambda _, data: decoder.attitude(data, time.monotonic())),
            (layout.joints_channel, lambda _, data: decoder.joints(data, time.monotonic())),
            (layout.command_channel, lambda _, data: self._met_command(data)),
            (BEACON_CHANNEL, lambda _, data: decoder.beacon(data)),
            (RESPONSE_CHANNEL, lambda _, data: self._responses.append(data)),
        ):
            self._in.subscribe(channel, handler).set_queue_capacity(_QUEUE)
        self._reading = True
        self._thread = threading.Thread(target=self._read, name="pronk lcm reader", daemon=True)
        self._thread.start()

    def _shut(self) -> None:
        self._reading = False
        self._thread.join()
        del self._in, self._out

    @property
    def _foreign_commands(self) -> int:
        return self._foreign

    def _newest(self) -> State | None:
        return self._decoder.latest

    def _arrived(self) -> list[State]:
        return self._decoder.drain()

    def _read(self) -> None:
        while self._reading:
            self._in.handle_timeout(50)

    def _publish(self, channel: str, data: bytes) -> None:
        # The handle belongs to one thread at a time.
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
                self._foreign += 1

    def _preflight(self) -> None:
        decoder, layout = self._decoder, self._layout
        begun = time.monotonic()
        if not wait_for(lambda: decoder.latest is not None):
            raise HardwareError(
                f"{self.robot} sent no state on {layout.joints_channel} and "
                f"{layout.attitude_channel} within {ANSWER_S:g} s at {self._url}"
                + (f"; what came was refused: {decoder.last_error}" if decoder.last_error else "")
                + "; check that its program runs, the layout, the port and the network."
            )
        if self._release:
            self._let_go()
        self._foreign, silent_from = 0, time.monotonic()
        self.fresh_states(layout.state_rate_hz, until=begun + 2.0 * ANSWER_S)
        self.check_exclusive(silent_from)
        if self._interface is None:
            # Its beacon comes ten times a second; no other simulator has one.
            wait_for(lambda: decoder.virtual)
        self.virtual = decoder.virtual
        decoder.drain()

    def _let_go(self) -> None:
        data = mode_request(0, time.monotonic_ns())
        self._publish(REQUEST_CHANNEL, data)
        if not wait_for(lambda: data in self._responses):
            raise HardwareError(
                f"{self.robot} did not confirm control_mode 0 on {RESPONSE_CHANNEL} within "
                f"{ANSWER_S:g} s; release it by its own remote."
            )

    def _hold(self, joints: tuple[str, ...]) -> bool:
        names, request = self._robot.joint_names, time.monotonic_ns()
        data = clamp_message(names, joints, request)
        held = (request, tuple(name for name in names if name in joints))
        # Requested again, for the way there may lose messages.
        for _ in range(4):
            self._publish(BENCH_CHANNEL, data)
            if wait_for(lambda: self._decoder.held == held, ANSWER_S / 4):
                return True
        return False
