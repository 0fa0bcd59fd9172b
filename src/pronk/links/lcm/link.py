"""A robot behind LCM: the Mini Cheetah, a Go1 by the bridge of walk-these-ways, or a virtual robot.

One handle receives, in a thread of its own, because polling one message per tick from LCM's queue
yields data hundreds of milliseconds old; the other publishes. Times are the local monotonic
clock's: a state's is when its last message arrived.
"""

from __future__ import annotations

import threading
import time
from collections import Counter

from pronk.errors import HardwareError
from pronk.links.lcm.address import open_lcm, url_of
from pronk.links.lcm.layout import layout_of
from pronk.links.lcm.reader import StateReader
from pronk.links.lcm.service import (
    BEACON_CHANNEL,
    BENCH_CHANNEL,
    REQUEST_CHANNEL,
    RESPONSE_CHANNEL,
    clamp_message,
    mode_request,
)
from pronk.links.lcm.writer import CommandWriter
from pronk.links.link_checks import ANSWER_S, Hand, check_alone, fresh_states, waited_for
from pronk.links.machine import State, TorqueKind
from pronk.links.network_link import NetworkLink
from pronk.links.preflight import Freshness, check_rest
from pronk.robots.robot import Robot

_QUEUE = 100


class LcmMachine(NetworkLink):
    """A robot with twelve joints behind LCM. Implements `Machine`.

    Pre-flight, in this order: states arrive at the layout's rate without gaps for 200 ms; gravity
    points where the attitude says; every joint is within its limits; nobody else commands.
    """

    wire = "LCM"

    def __init__(
        self,
        robot: Robot,
        *,
        layout: str = "cheetah",
        port: int | None = None,
        interface: str | None = None,
        hand: Hand | None = None,
        release: bool = False,
        alone_s: float = 1.0,
        fresh: Freshness | None = None,
    ) -> None:
        """Describe the link; nothing is opened yet.

        Args:
            robot: Names, order and limits of the joints.
            layout: `cheetah` or `wtw`.
            port: UDP port; None for the virtual robot's on loopback, the robots' on an interface.
            interface: Network interface of a real robot, `lo` on the robot itself; None never
                leaves this computer and meets no real robot.
            hand: Who fixes joints on a real bench; None if nobody.
            release: Ask the robot's own controller to let go of the joints first.
            alone_s: How long the command channel must be silent before pronk writes to it [s].
            fresh: How fresh states must be; None for what moving a robot takes.

        Raises:
            HardwareError: The layout is unknown, the robot has not twelve joints, or the address
                is impossible.
        """
        self._layout = layout_of(layout)
        if len(robot.joints) != 12:
            raise HardwareError(
                f"{robot.name} has {len(robot.joints)} joints; the LCM messages of {layout} are "
                "for twelve."
            )
        super().__init__(robot, hand=hand, release=release, alone_s=alone_s, fresh=fresh)
        self.torque_kind: TorqueKind = self._layout.torque_kind
        self._interface = interface
        self._url = url_of(port=port, interface=interface)
        self._foreign = 0
        self._reader = StateReader(self._layout, robot.joint_names)
        self._commands: CommandWriter | None = None
        self._written: Counter[str] = Counter()

    @property
    def counts(self) -> Counter[str]:
        """What was met: states, and why some were not made; commands, `expired`, `foreign`."""
        met = Counter(self._reader.counts)
        met["foreign"] = self._foreign
        return met + self._written

    def _open(self) -> None:
        layout = self._layout
        reader = self._reader = StateReader(layout, self._robot.joint_names)
        self._foreign = 0
        self._responses: list[bytes] = []
        self._in, self._out = open_lcm(self._url), open_lcm(self._url)
        self._publishing = threading.Lock()
        self._commands = writer = CommandWriter(
            layout, lambda data: self._publish(layout.command_channel, data)
        )

        self._written = writer.counts

        def command(_: str, data: bytes) -> None:
            self._foreign += not writer.is_own(data)

        for channel, handler in (
            (layout.attitude_channel, lambda _, data: reader.attitude(data, time.monotonic())),
            (layout.joints_channel, lambda _, data: reader.joints(data, time.monotonic())),
            (layout.command_channel, command),
            (BEACON_CHANNEL, lambda _, data: reader.beacon(data)),
            (RESPONSE_CHANNEL, lambda _, data: self._responses.append(data)),
        ):
            self._in.subscribe(channel, handler).set_queue_capacity(_QUEUE)
        self._reading = True
        self._thread = threading.Thread(target=self._read, name="pronk lcm reader", daemon=True)
        self._thread.start()

    def _shut(self) -> None:
        if self._commands is not None:
            self._commands.stop()
        self._reading = False
        self._thread.join()
        self._commands = None
        del self._in, self._out

    @property
    def _writer(self) -> CommandWriter | None:
        return self._commands

    @property
    def _command_topic(self) -> str:
        return self._layout.command_channel

    @property
    def _foreign_commands(self) -> int:
        return self._foreign

    def _newest(self) -> State | None:
        return self._reader.latest

    def _arrived(self) -> list[State]:
        return self._reader.drain()

    def _read(self) -> None:
        while self._reading:
            self._in.handle_timeout(50)

    def _publish(self, channel: str, data: bytes) -> None:
        # The handle belongs to one thread at a time.
        with self._publishing:
            self._out.publish(channel, data)

    def _preflight(self) -> None:
        reader, layout = self._reader, self._layout
        begun = time.monotonic()
        if not waited_for(lambda: reader.latest is not None):
            raise HardwareError(
                f"{self.robot} sent no state on {layout.joints_channel} and "
                f"{layout.attitude_channel} within {ANSWER_S:g} s at {self._url}"
                + (f"; what came was refused: {reader.complaint}" if reader.complaint else "")
                + "; check that its program runs, the layout, the port and the network."
            )
        if self._release:
            self._let_go()
        self._foreign, silent_from = 0, time.monotonic()
        states = fresh_states(
            self.robot,
            self.wait,
            layout.state_rate_hz,
            self._fresh,
            until=begun + 2.0 * ANSWER_S,
        )
        check_rest(self._robot, states)
        time.sleep(max(0.0, silent_from + self._alone_s - time.monotonic()))
        check_alone(self._foreign, layout.command_channel, self._alone_s)
        if self._interface is None:
            # It says so ten times a second; someone else's simulator never does.
            waited_for(lambda: reader.virtual)
        self.virtual = reader.virtual
        reader.drain()

    def _let_go(self) -> None:
        data = mode_request(0, time.monotonic_ns())
        self._publish(REQUEST_CHANNEL, data)
        if not waited_for(lambda: data in self._responses):
            raise HardwareError(
                f"{self.robot} did not confirm control_mode 0 on {RESPONSE_CHANNEL} within "
                f"{ANSWER_S:g} s; release it by its own remote."
            )

    def _hold(self, joints: tuple[str, ...]) -> bool:
        """Ask the virtual robot to fix joints; whether it confirmed."""
        names, request = self._robot.joint_names, time.monotonic_ns()
        data = clamp_message(names, joints, request)
        held = (request, tuple(name for name in names if name in joints))
        # Asked again, for the way there may lose messages.
        for _ in range(4):
            self._publish(BENCH_CHANNEL, data)
            if waited_for(lambda: self._reader.held == held, ANSWER_S / 4):
                return True
        return False
