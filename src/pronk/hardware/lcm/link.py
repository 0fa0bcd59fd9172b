"""A robot behind LCM: the Mini Cheetah, a Go1 behind the bridge of walk-these-ways, or the twin.

One handle receives, in a thread of its own, because polling one message per tick from LCM's queue
yields data hundreds of milliseconds old; the other publishes. Times are the local monotonic
clock's: a state's is when its last message arrived.
"""

from __future__ import annotations

import threading
import time
from collections import Counter

import numpy as np

from pronk.errors import HardwareError
from pronk.hardware.lcm.layout import layout_of
from pronk.hardware.lcm.reader import StateReader
from pronk.hardware.lcm.service import (
    BEACON_CHANNEL,
    BENCH_CHANNEL,
    REQUEST_CHANNEL,
    RESPONSE_CHANNEL,
    clamp_message,
    mode_request,
)
from pronk.hardware.lcm.url import open_lcm, url_of
from pronk.hardware.lcm.writer import CommandWriter
from pronk.hardware.link_rules import (
    ANSWER_S,
    Hand,
    await_rest,
    check_alone,
    check_still_alone,
    clamp,
    fresh_states,
    waited_for,
)
from pronk.hardware.machine import Command, State, TorqueKind
from pronk.hardware.preflight import Freshness, check_rest
from pronk.robots.robot import Robot

_QUEUE = 100


class LcmMachine:
    """A robot with twelve joints behind LCM. Implements `Machine`.

    `virtual` is known once connected: the virtual robot says on a channel of its own what it is.
    """

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
            port: UDP port; None for the twin's on loopback, the robots' on an interface.
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
        self.robot = robot.name
        self.virtual = False
        self.torque_kind: TorqueKind = self._layout.torque_kind
        self._robot = robot
        self._interface = interface
        self._url = url_of(port=port, interface=interface)
        self._hand = hand
        self._release = release
        self._alone_s = alone_s
        self._fresh = fresh
        self._foreign = 0
        self._reader = StateReader(self._layout, robot.joint_names)
        self._writer: CommandWriter | None = None
        self._written: Counter[str] = Counter()

    @property
    def counts(self) -> Counter[str]:
        """What was met: states, and why some were not made; commands, `expired`, `foreign`."""
        met = Counter(self._reader.counts)
        met["foreign"] = self._foreign
        return met + self._written

    def connect(self) -> None:
        """Open the link and check that the robot is fit to move. About a second.

        In this order: states arrive at the layout's rate without gaps for 200 ms; gravity points
        where the attitude says; every joint is within its limits; nobody else commands.

        Raises:
            HardwareError: A check failed; nothing was written to the robot's joints.
        """
        self.close()
        layout = self._layout
        reader = self._reader = StateReader(layout, self._robot.joint_names)
        self.virtual, self._foreign = False, 0
        self._responses: list[bytes] = []
        self._in, self._out = open_lcm(self._url), open_lcm(self._url)
        self._publishing = threading.Lock()
        self._writer = writer = CommandWriter(
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
        try:
            self._preflight()
        except BaseException:
            self.close()
            raise

    def now(self) -> float:
        """The local monotonic clock [s]."""
        return time.monotonic()

    def latest(self) -> State:
        """The newest state, without waiting.

        Raises:
            HardwareError: Not connected.
        """
        state = self._reader.latest if self._writer else None
        if state is None:
            raise HardwareError(f"the LCM link to {self.robot} is not open; call connect() first.")
        return state

    def wait(self, until: float) -> list[State]:
        """Sleep to `until` [s]; return the states that arrived since the last call."""
        delay = until - time.monotonic()
        if delay > 0.0:
            time.sleep(delay)
        return self._reader.drain()

    def send(self, command: Command) -> None:
        """Put a command on the wire, once. One that has expired already becomes damping.

        Raises:
            HardwareError: Not connected, not finite, or someone else has commanded since.
        """
        if self._writer is None:
            raise HardwareError(f"the LCM link to {self.robot} is not open; call connect() first.")
        check_still_alone(self._foreign, self._layout.command_channel)
        values = (command.position, command.stiffness, command.damping)
        if not all(np.isfinite(value).all() for value in values):
            raise HardwareError("a command holds a number that is not finite; it was not sent.")
        self._writer.send(command)

    def clamp(self, joints: tuple[str, ...]) -> None:
        """Have joints fixed: by the virtual robot itself, or by a person's hand.

        Raises:
            HardwareError: A joint is unknown, nobody is there to fix it, or no answer came.
        """
        virtual = self.virtual and self._writer is not None
        clamp(self._robot, joints, hold=self._hold if virtual else None, hand=self._hand)

    def damp(self) -> None:
        """Write damping now and go on until a command or the end. Never raises."""
        if self._writer is not None:
            self._writer.damp()

    def close(self) -> None:
        """Leave the robot damped and at rest, and close; closing twice does no harm.

        Takes 1 s of damping at least, 3 s at most; no time at all if nothing was ever sent.
        """
        writer = self._writer
        if writer is None:
            return
        if writer.wrote:
            writer.damp()
            await_rest(lambda: self._reader.latest)
        writer.stop()
        self._reading = False
        self._thread.join()
        self._writer = None
        del self._in, self._out

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
