"""A robot behind Unitree's DDS messages: a Go2, or the virtual robot.

A thread sleeps until a state arrives, stamps and keeps it, so that a state's age is right however
late the caller is. The command in force is repeated, because Unitree's drives are written to all
the time and it is not published what they do when that stops.

No state is made, and the reason counted, of a message that is refused, above all for its checksum;
of a clock that went back or stood still; of values that repeat to the last bit, as no live
sensor's do (frozen data behind a live clock).
"""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from typing import Any

from pronk.errors import HardwareError
from pronk.links.command_writer import CommandWriter
from pronk.links.dds import messages
from pronk.links.dds.address import COMMANDS, STATES, DdsNetwork, Participant, take, write
from pronk.links.dds.codec import encode_command, joint_map
from pronk.links.dds.service import BENCH, CLAMP, Client, check_own_controller
from pronk.links.dds.state_decoder import STATE_RATE_HZ, StateDecoder
from pronk.links.machine import State, TorqueKind
from pronk.links.network_link import ANSWER_S, NetworkLink, wait_for
from pronk.robots.robot import Robot

_LONGEST_BURST_S = 0.1
_LONGEST_PAUSE_S = 0.05
_KEPT_STATES = 10_000
_REPEAT_S = 0.004
"""Silence after which the command in force is written again; Unitree's examples write every 1 to
10 ms."""


class DdsMachine(NetworkLink):
    """A robot with twelve joints behind Unitree's messages. Implements `Machine`.

    Pre-flight, in this order: states arrive with right checksums; none of the robot's own
    controllers holds the joints (or it lets go of them); states come at 500 Hz without gaps, from
    one robot; no other program commands.
    """

    wire = "DDS"
    torque_kind: TorqueKind = "measured"  # tau_est, by the drives from their currents

    def __init__(
        self,
        robot: Robot,
        *,
        interface: str | None = None,
        domain: int | None = None,
        **common: Any,
    ) -> None:
        """Describe the link; nothing is opened yet.

        Args:
            robot: Names, order and limits of the joints.
            interface: Network interface to a real robot; None for loopback.
            domain: DDS domain; None for pronk's own on loopback, 0 on an interface.
            **common: As `NetworkLink` takes them.

        Raises:
            HardwareError: The robot does not fit behind these messages, or the domain is
                impossible.
        """
        super().__init__(robot, **common)
        self.counts: Counter[str] = Counter()
        """What was met: states, commands, `repeats`, `expired`, `foreign`, and why states were
        not made."""
        self._joints = joint_map(robot)
        self._network = DdsNetwork(interface=interface, domain=domain)
        self._bench: Client | None = None
        self._command_topic = COMMANDS

    # --- beginning and end ----------------------------------------------------------------------

    def _open(self) -> None:
        self.counts.clear()
        self._latest: State | None = None
        self._met: deque[State] = deque(maxlen=_KEPT_STATES)
        self._decoder = StateDecoder(self._joints, self.counts)
        self._speakers: set[int] = set()
        self._participant = Participant(self._network)
        self._states_in = self._participant.reader(STATES, messages.LowState, raw=True)
        self._others = self._participant.reader(COMMANDS, messages.LowCmd, raw=True, own=False)
        out = self._participant.writer(COMMANDS, messages.LowCmd, raw=True)
        self._writer = CommandWriter(
            lambda command: encode_command(self._joints, command),
            lambda data: write(out, data, self.counts),
            damping=self._joints.sink_damping,
            repeat_s=_REPEAT_S,
            counts=self.counts,
        )
        self._wake = self._participant.wake_on(self._states_in, self._others)
        self._serving = True
        self._thread = threading.Thread(target=self._serve, name="pronk dds", daemon=True)
        self._thread.start()

    def _shut(self) -> None:
        self._serving = False
        self._thread.join()
        self._bench = None
        del self._wake, self._states_in, self._others, self._participant

    @property
    def _foreign_commands(self) -> int:
        return self.counts["foreign"]

    def _newest(self) -> State | None:
        return self._latest

    def _arrived(self) -> list[State]:
        states = []
        while self._met:
            states.append(self._met.popleft())
        return states

    def _preflight(self) -> None:
        begun = time.monotonic()
        if not wait_for(lambda: self._latest is not None):
            raise HardwareError(
                f"{self.robot} sent no state on {STATES} within {ANSWER_S:g} s in {self._network}"
                + (f"; what came was refused: {why}" if (why := self._decoder.last_error) else "")
                + "; check that the robot or the virtual one runs, the domain and the interface."
            )
        self.virtual = self._decoder.virtual
        if self._joints.virtual_only and not self.virtual:
            raise HardwareError(
                f"what answers in {self._network} is not pronk's virtual robot, and no real "
                f"{self.robot} speaks Unitree's messages; name the robot that it is."
            )
        self._bench = Client(self._participant, BENCH)
        check_own_controller(self._participant, release=self._release, timeout_s=ANSWER_S)
        silent_from = time.monotonic()
        self.counts["foreign"] = 0
        self._check_states(begun)
        self.check_exclusive(silent_from)
        self.wait(0.0)

    def _hold(self, joints: tuple[str, ...]) -> bool:
        request = {"joints": list(joints)}
        return self._bench is not None and (
            self._bench.call(CLAMP, request, timeout_s=ANSWER_S) is not None
        )

    def _check_states(self, begun: float) -> None:
        self.fresh_states(STATE_RATE_HZ, until=begun + 2.0 * ANSWER_S)
        if len(self._speakers) > 1:
            raise HardwareError(
                f"{len(self._speakers)} robots speak on {STATES} in {self._network}, expected one; "
                "switch the others off, or take another domain."
            )

    # --- the thread -----------------------------------------------------------------------------

    def _serve(self) -> None:
        while self._serving:
            self._wake.wait(int(_LONGEST_PAUSE_S * 1e9))
            self._receive()

    def _receive(self) -> None:
        arrived = time.monotonic()
        if take(self._others, self.counts):
            self._foreign()
        messages = take(self._states_in, self.counts)
        for message in messages:
            # Those that waited together are distinguished by when they were sent.
            before = (
                messages[-1].sample_info.source_timestamp - message.sample_info.source_timestamp
            )
            stamp = arrived - min(max(before * 1e-9, 0.0), _LONGEST_BURST_S)
            self._speakers.add(message.sample_info.publication_handle)
            state = self._decoder.take(message.data, stamp)
            if state is not None:
                self._latest = state
                self._met.append(state)

    def _foreign(self) -> None:
        """Damp when there is another writer, for it is unknown which command the drives follow."""
        self.counts["foreign"] += 1
        if self._writer is not None and self._writer.wrote:
            self._writer.damp()
