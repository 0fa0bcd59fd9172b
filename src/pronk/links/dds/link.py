"""A robot behind Unitree's DDS messages: a Go2, or the virtual robot.

One thread beside the caller's sleeps until a state arrives or a write is due. It stamps and keeps
what comes, so that a state's age is right however late the caller is, and it repeats the command
in force, because Unitree's drives are written to all the time and nobody has published what they
do when that stops. A command that expires becomes damping there and then, without the caller.

What keeps states from being made, each counted: a message that is not what it must be, above all
one with a wrong checksum; a clock that went back or stood still; values that repeat to the last
bit, which no live sensor's do (frozen data behind a live clock). A link that makes no states grows
old, and age is what whoever commands watches.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, deque

from pronk.errors import HardwareError
from pronk.links.dds import idl
from pronk.links.dds.address import COMMANDS, STATES, DdsNetwork, Participant, take
from pronk.links.dds.codec import joint_map
from pronk.links.dds.service import BENCH, CLAMP, Client, own_controller
from pronk.links.dds.state_decoder import STATE_RATE_HZ, Intake
from pronk.links.dds.writer import CommandWriter
from pronk.links.link_checks import ANSWER_S, Hand, check_alone, fresh_states, waited_for
from pronk.links.machine import State, TorqueKind
from pronk.links.network_link import NetworkLink
from pronk.links.preflight import Freshness, check_rest
from pronk.robots.robot import Robot

_LONGEST_BURST_S = 0.1
_LONGEST_PAUSE_S = 0.05
_KEPT_STATES = 10_000


class DdsMachine(NetworkLink):
    """A robot with twelve joints behind Unitree's messages. Implements `Machine`.

    Pre-flight, in this order: states arrive with right checksums; none of the robot's own
    controllers holds the joints (or it lets go of them); states come at 500 Hz without gaps, from
    one robot; gravity points where the attitude says; every joint is within its limits; nobody
    else commands.
    """

    wire = "DDS"
    torque_kind: TorqueKind = "measured"  # tau_est, by the drives from their currents

    def __init__(
        self,
        robot: Robot,
        *,
        network: DdsNetwork | None = None,
        hand: Hand | None = None,
        release: bool = False,
        alone_s: float = 1.0,
        fresh: Freshness | None = None,
    ) -> None:
        """Describe the link; nothing is opened yet.

        Args:
            robot: Names, order and limits of the joints.
            network: Where; None for pronk's own domain on loopback.
            hand: Who fixes joints on a real bench; None if nobody.
            release: Make the robot's own controller let go of the joints first; a standing robot
                falls then.
            alone_s: How long `rt/lowcmd` must be silent before pronk writes to it [s].
            fresh: How fresh states must be; None for what moving a robot takes.

        Raises:
            HardwareError: The robot does not fit behind these messages.
        """
        super().__init__(robot, hand=hand, release=release, alone_s=alone_s, fresh=fresh)
        self.counts: Counter[str] = Counter()
        """What was met: states, commands, `repeats`, `expired`, `foreign`, and why states were
        not made."""
        self._joints = joint_map(robot)
        self._network = network or DdsNetwork()
        self._bench: Client | None = None
        self._serving = False

    # --- beginning and end ----------------------------------------------------------------------

    def _open(self) -> None:
        self.counts.clear()
        self._latest: State | None = None
        self._met: deque[State] = deque(maxlen=_KEPT_STATES)
        self._intake = Intake(self._joints, self.counts)
        self._speakers: set[int] = set()
        self._participant = Participant(self._network)
        self._states_in = self._participant.reader(STATES, idl.LowState, raw=True)
        self._others = self._participant.reader(COMMANDS, idl.LowCmd, raw=True, own=False)
        out = self._participant.writer(COMMANDS, idl.LowCmd, raw=True)
        self._commands = CommandWriter(self._joints, out, self.counts)
        self._wake = self._participant.wake_on(self._states_in, self._others)
        self._serving = True
        self._thread = threading.Thread(target=self._serve, name="pronk dds", daemon=True)
        self._thread.start()

    def _shut(self) -> None:
        self._serving = False
        self._thread.join()
        self._bench = None
        del self._wake, self._states_in, self._others, self._commands, self._participant

    @property
    def _writer(self) -> CommandWriter | None:
        return self._commands if self._serving else None

    @property
    def _command_topic(self) -> str:
        return COMMANDS

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
        if not waited_for(lambda: self._latest is not None):
            raise HardwareError(
                f"{self.robot} sent no state on {STATES} within {ANSWER_S:g} s in {self._network}"
                + (f"; what came was refused: {why}" if (why := self._intake.complaint) else "")
                + "; check that the robot or its double runs, the domain and the interface."
            )
        self.virtual = self._intake.virtual
        if self._joints.virtual_only and not self.virtual:
            raise HardwareError(
                f"what answers in {self._network} is not pronk's virtual robot, and no real "
                f"{self.robot} speaks Unitree's messages; name the robot that it is."
            )
        self._bench = Client(self._participant, BENCH)
        own_controller(self._participant, release=self._release, timeout_s=ANSWER_S)
        silent_from = time.monotonic()
        self.counts["foreign"] = 0
        self._check_states(begun)
        time.sleep(max(0.0, silent_from + self._alone_s - time.monotonic()))
        check_alone(self.counts["foreign"], COMMANDS, self._alone_s)
        self.wait(0.0)

    def _hold(self, joints: tuple[str, ...]) -> bool:
        """Ask the virtual robot to fix joints; whether it confirmed."""
        asked = {"joints": list(joints)}
        return self._bench is not None and (
            self._bench.ask(CLAMP, asked, timeout_s=ANSWER_S) is not None
        )

    def _check_states(self, begun: float) -> None:
        states = fresh_states(
            self.robot, self.wait, STATE_RATE_HZ, self._fresh, until=begun + 2.0 * ANSWER_S
        )
        if len(self._speakers) > 1:
            raise HardwareError(
                f"{len(self._speakers)} robots speak on {STATES} in {self._network}, expected one; "
                "switch the others off, or take another domain."
            )
        check_rest(self._robot, states)

    # --- the thread -----------------------------------------------------------------------------

    def _serve(self) -> None:
        while self._serving:
            pause = min(max(self._commands.due - time.monotonic(), 0.0), _LONGEST_PAUSE_S)
            self._wake.wait(int(pause * 1e9))
            self._receive()
            self._commands.keep()

    def _receive(self) -> None:
        arrived = time.monotonic()
        if take(self._others, self.counts):
            self._foreign()
        messages = take(self._states_in, self.counts)
        for message in messages:
            # Those that waited together are told apart by when they were sent.
            before = (
                messages[-1].sample_info.source_timestamp - message.sample_info.source_timestamp
            )
            stamp = arrived - min(max(before * 1e-9, 0.0), _LONGEST_BURST_S)
            self._speakers.add(message.sample_info.publication_handle)
            state = self._intake.take(message.data, stamp)
            if state is not None:
                self._latest = state
                self._met.append(state)

    def _foreign(self) -> None:
        """Another writer: nobody can tell any more what the drives will do, so damp."""
        self.counts["foreign"] += 1
        if self._commands.wrote:
            self._commands.damp()
